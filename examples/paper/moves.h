/* moves.h - what builders that improve another one's tree share, by moving its subtrees.
 *
 * A subtree moves by a copy of its topmost node to another slot; all that is below stays where it is. Pairs
 * are soon in no order, so the way through the tree is by links to the parents. What stays the same of an
 * inner node wherever it moves is its children's place: nodes are named by that where slots may change.
 */
#ifndef PAPER_MOVES_H
#define PAPER_MOVES_H
#include "paper.h"

typedef struct paper_moves_settings {
  paper_builder *start;                /* whose tree it is; NULL = paper_lbvh */
} paper_moves_settings;

typedef struct paper_mover {
  paper_build *p;
  trbvh_node  *nodes;                  /* p's; boxes are right at all times, inner counts only at the end */
  uint32_t    *parent;                 /* by pair (half its left node's index): where the node above it is */
  double       cost;                   /* the inner nodes' areas: what moves can change of the SAH cost */
} paper_mover;

/* Children before parents: the first node of the subtree at slot ... */
static inline uint32_t paper_first_below(const paper_mover *m, uint32_t slot)
{
  while (!paper_is_leaf(&m->nodes[slot])) slot = m->nodes[slot].first;
  return slot;
}
/* ... and the one after slot, the last being 0, the root. What has changed below slot does not matter. */
static inline uint32_t paper_next(const paper_mover *m, uint32_t slot)
{
  return slot & 1 ? m->parent[slot / 2] : paper_first_below(m, slot + 1);
}
/* The next inner node; from 0, the first. */
static inline uint32_t paper_next_inner(const paper_mover *m, uint32_t slot)
{
  do slot = slot ? paper_next(m, slot) : paper_first_below(m, 0);
  while (paper_is_leaf(&m->nodes[slot]));
  return slot;
}

static inline void paper_put(paper_mover *m, uint32_t slot, trbvh_node node)
{
  m->nodes[slot] = node;
  if (!paper_is_leaf(&node)) m->parent[node.first / 2] = slot;
}
/* Gives the inner node at slot its children's box. */
static inline void paper_fit_box(paper_mover *m, uint32_t slot)
{
  uint32_t first = m->nodes[slot].first;
  m->nodes[slot] = paper_union(m->nodes[first], &m->nodes[first + 1]);
  paper_set_inner(m->p, slot, first);
}
/* For a tree that is new in nodes: links, and the cost. */
static inline void paper_link(paper_mover *m)
{
  m->cost = 0;
  for (uint32_t i = 0; i < 2 * m->p->pair_end; i++) {
    if (i == 1 || paper_is_leaf(&m->nodes[i])) continue;
    m->parent[m->nodes[i].first / 2] = i;
    m->cost += trb_area(m->nodes[i]);
  }
}
static inline paper_mover paper_start_moves(paper_build *p)
{
  const paper_moves_settings *settings = (const paper_moves_settings *)p->parameters;
  p->parameters = NULL;                /* ours; the other builder has its own defaults */
  if (settings && settings->start) settings->start(p);
  else paper_lbvh(p);
  paper_mover m = {p, p->nodes, (uint32_t *)ex_allocate(p->pair_end, sizeof(uint32_t)), 0};
  paper_link(&m);
  return m;
}
static inline void paper_end_moves(paper_mover *m)
{
  uint32_t slot = 0;
  do {
    slot = paper_next_inner(m, slot);
    m->nodes[slot] = paper_parent(m->p, m->nodes[slot].first);
  } while (slot);
  free(m->parent);
}

#endif
