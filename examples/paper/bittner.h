/* bittner.h - insertion-based optimization (Bittner, Hapala and Havran 2013, "Fast Insertion-Based
 * Optimization of Bounding Volume Hierarchies").
 *
 * The inner nodes that are worst by a measure of their inefficiency are dissolved, a batch at a time: such a
 * node goes with its parent, and its two children are inserted again, one after the other, each where it
 * costs least in the whole tree. That place is found by branch and bound.
 *
 * In two things this differs from what we remember of the article. Its batches are the worst 1 % of all
 * nodes, and when those do not help any more, nodes by chance; here they are the worst 1 % of the nodes that
 * have not had a turn yet, and all have had one before the next round: otherwise the same few, which no place
 * is good for, come again and again. And a node whose children have found no better places together goes back
 * to where it was, so that the cost never rises. The last round is one that gains less than 0.1 %.
 *
 * The paper's table: 103.3 % of SweepSAH's performance, 87.7 % of its SAH cost, 1083 % of its time.
 */
#ifndef PAPER_BITTNER_H
#define PAPER_BITTNER_H
#include "moves.h"

enum { PAPER_MEASURE_BINS = 65536 };
typedef struct paper_lead { float induced; uint32_t pair; } paper_lead;   /* growth of the nodes above pair */
typedef struct paper_place { uint32_t slot; double cost; } paper_place;   /* a new parent of what is there */
typedef struct paper_inserter {
  paper_mover    m;
  paper_lead    *leads;                /* a heap, the cheapest first */
  uint32_t       lead_count;
  uint64_t      *keys;                 /* of a batch: inverse measure | pair */
  uint32_t      *bins;                 /* how many keys begin with these 16 bits */
  unsigned char *had_turn;             /* by pair */
  uint32_t       waiting;              /* how many have not had one */
} paper_inserter;

static inline void paper_add_lead(paper_inserter *s, paper_lead lead)
{
  uint32_t at = s->lead_count++;
  for (; at && lead.induced < s->leads[(at - 1) / 2].induced; at = (at - 1) / 2) {
    s->leads[at] = s->leads[(at - 1) / 2];
  }
  s->leads[at] = lead;
}
static inline paper_lead paper_take_lead(paper_inserter *s)
{
  paper_lead *leads = s->leads, cheapest = leads[0], last = leads[--s->lead_count];
  uint32_t at = 0;
  for (uint32_t child; (child = 2 * at + 1) < s->lead_count; at = child) {
    child += child + 1 < s->lead_count && leads[child + 1].induced < leads[child].induced;
    if (leads[child].induced >= last.induced) break;
    leads[at] = leads[child];
  }
  leads[at] = last;
  return cheapest;
}
/* Where it costs least to insert node: the new parent's area and what it adds to those above, which is
 * known for a whole subtree. Below it, no parent can be smaller than node itself. */
static inline paper_place paper_find_place(paper_inserter *s, const trbvh_node *node)
{
  const trbvh_node *n = s->m.nodes;
  float area = trb_area(*node), whole = trb_area(paper_union(n[0], node));
  paper_place best = {0, whole};
  s->lead_count = 0;
  if (!paper_is_leaf(&n[0])) paper_add_lead(s, (paper_lead){whole - trb_area(n[0]), n[0].first});
  while (s->lead_count) {
    paper_lead lead = paper_take_lead(s);
    if ((double)lead.induced + area >= best.cost) break;
    for (uint32_t i = lead.pair; i < lead.pair + 2; i++) {
      float here = trb_area(paper_union(n[i], node)), induced = lead.induced + (here - trb_area(n[i]));
      double cost = (double)lead.induced + here;
      if (cost < best.cost) best = (paper_place){i, cost};
      if (!paper_is_leaf(&n[i]) && (double)induced + area < best.cost) {
        paper_add_lead(s, (paper_lead){induced, n[i].first});
      }
    }
  }
  return best;
}

static inline void paper_refit_above(paper_mover *m, uint32_t slot)
{
  while (slot) {
    slot = m->parent[slot / 2];
    trbvh_node old = m->nodes[slot], *now = &m->nodes[slot];
    paper_fit_box(m, slot);
    if (!memcmp(old.min, now->min, sizeof old.min) && !memcmp(old.max, now->max, sizeof old.max)) break;
    m->cost += (double)trb_area(*now) - trb_area(old);
  }
}
/* Removes the subtree at slot and its parent; their pair is free then. */
static inline void paper_take_out(paper_mover *m, uint32_t slot)
{
  uint32_t parent = m->parent[slot / 2];
  m->cost -= trb_area(m->nodes[parent]);
  paper_put(m, parent, m->nodes[slot ^ 1]);
  paper_refit_above(m, parent);
}
/* Inserts node at slot: what is there and node are the new children, in a pair that is free, node the
 * right one. */
static inline void paper_insert(paper_mover *m, trbvh_node node, uint32_t pair, uint32_t slot)
{
  paper_put(m, pair, m->nodes[slot]);
  paper_put(m, pair + 1, node);
  m->nodes[slot].first = pair;
  m->parent[pair / 2] = slot;
  paper_fit_box(m, slot);
  m->cost += trb_area(m->nodes[slot]);
  paper_refit_above(m, slot);
}
/* Dissolves the node above this pair, and its parent. */
static inline void paper_reinsert(paper_inserter *s, uint32_t pair)
{
  paper_mover *m = &s->m;
  trbvh_node *n = m->nodes;
  uint32_t slot = m->parent[pair / 2], own = slot & ~1u, old_place = m->parent[slot / 2];
  uint32_t larger = pair + (trb_area(n[pair]) < trb_area(n[pair + 1]));
  trbvh_node first = n[larger], second = n[larger ^ 1];
  double old_cost = m->cost;
  if (slot == 0) return;
  m->cost -= trb_area(n[slot]);
  paper_take_out(m, slot);
  paper_insert(m, first, own, paper_find_place(s, &first).slot);
  paper_insert(m, second, pair, paper_find_place(s, &second).slot);
  if (m->cost < old_cost) return;
  paper_take_out(m, pair + 1);
  paper_take_out(m, own + 1);
  paper_insert(m, first, own, old_place);
  paper_insert(m, second, pair, own + 1);
  m->cost = old_cost;
}

/* M = M_sum M_min M_area: area by the children's mean area, area by the smaller one's, area. With a little
 * added where children have no area: from there to what the largest areas give, M is far from the ends of
 * double. */
static inline double paper_inefficiency(const paper_mover *m, uint32_t pair)
{
  double area = trb_area(m->nodes[m->parent[pair / 2]]);
  double left = trb_area(m->nodes[pair]), right = trb_area(m->nodes[pair + 1]);
  return area / (0.5 * (left + right) + 1e-50) * (area / (TRB_MIN(left, right) + 1e-50)) * area;
}
/* Makes keys of the worst `count` nodes of those that wait, worst first, and perhaps of others behind
 * them. */
static inline void paper_rank(paper_inserter *s, uint32_t count)
{
  uint32_t all = 0, some = 0, sum = 0, bin = 0;
  memset(s->bins, 0, PAPER_MEASURE_BINS * sizeof *s->bins);
  for (uint32_t i = 1; i < s->m.p->pair_end; i++) {
    double measure = paper_inefficiency(&s->m, 2 * i);
    uint64_t bits;
    if (s->had_turn[i]) continue;
    memcpy(&bits, &measure, sizeof bits);          /* never negative, so they sort as the measure does */
    s->keys[all] = ~bits >> 32 << 32 | i;
    s->bins[s->keys[all++] >> 48]++;
  }
  while (sum < count) sum += s->bins[bin++];
  for (uint32_t i = 0; i < all; i++) {
    if (s->keys[i] >> 48 < bin) s->keys[some++] = s->keys[i];
  }
  paper_sort(s->keys, some, 32);
}
static inline void paper_reinsert_batch(paper_inserter *s, uint32_t count)
{
  count = TRB_MIN(count, s->waiting);
  paper_rank(s, count);
  for (uint32_t i = 0; i < count; i++) s->had_turn[(uint32_t)s->keys[i]] = 1;
  for (uint32_t i = 0; i < count; i++) paper_reinsert(s, 2 * (uint32_t)s->keys[i]);
  s->waiting -= count;
}
static inline void paper_reinsert_round(paper_inserter *s)
{
  uint32_t pairs = s->m.p->pair_end - 1;
  memset(s->had_turn, 0, s->m.p->pair_end);
  for (s->waiting = pairs; s->waiting;) paper_reinsert_batch(s, pairs / 100 + 1);
  paper_link(&s->m);                   /* no rounding of areas next to huge ones may look like a gain */
}

static inline paper_inserter paper_start_insertion(paper_build *p)
{
  paper_inserter s;
  memset(&s, 0, sizeof s);
  s.m = paper_start_moves(p);
  s.leads = (paper_lead *)ex_allocate(p->pair_end, sizeof *s.leads);
  s.keys = (uint64_t *)ex_allocate(p->pair_end, sizeof *s.keys);
  s.bins = (uint32_t *)ex_allocate(PAPER_MEASURE_BINS, sizeof *s.bins);
  s.had_turn = (unsigned char *)ex_allocate(p->pair_end, 1);
  return s;
}
static inline void paper_end_insertion(paper_inserter *s)
{
  free(s->leads);
  free(s->keys);
  free(s->bins);
  free(s->had_turn);
  paper_end_moves(&s->m);
}
static inline void paper_bittner(paper_build *p)
{
  paper_inserter s = paper_start_insertion(p);
  double old_cost;
  do {
    old_cost = s.m.cost;
    paper_reinsert_round(&s);
  } while (s.m.cost < 0.999 * old_cost);
  paper_end_insertion(&s);
}

#endif
