/* kensler.h - tree rotations (Kensler 2008, "Tree Rotations for Improving Bounding Volume Hierarchies").
 *
 * A rotation swaps two subtrees below a node: a child and a child of its sibling, or grandchildren that are
 * cousins. It changes the areas of the node's children alone. Both of the article's algorithms are here: hill
 * climbing, and simulated annealing, which gets out of some local minima. Which one the paper's table has,
 * and from what tree, is not known to us; it says 91.5 % of SweepSAH's performance, 99.6 % of its SAH cost,
 * 552 % of its time.
 */
#ifndef PAPER_KENSLER_H
#define PAPER_KENSLER_H
#include "moves.h"

enum { PAPER_ROTATIONS = 6 };
typedef struct paper_rotation { uint32_t a, b; double gain; } paper_rotation;   /* a = 0: none */

/* One of the six rotations below the inner node at slot. */
static inline paper_rotation paper_rotation_below(const paper_mover *m, uint32_t slot, uint32_t which)
{
  const trbvh_node *n = m->nodes;
  uint32_t left = n[slot].first, right = left + 1;
  paper_rotation r = {0, 0, 0};
  if (which < 4) {                     /* a child and one of its sibling's children */
    uint32_t child = left + which / 2, sibling = child ^ 1;
    if (paper_is_leaf(&n[sibling])) return r;
    r.a = child;
    r.b = n[sibling].first + which % 2;
    r.gain = (double)trb_area(n[sibling]) - trb_area(paper_union(n[child], &n[r.b ^ 1]));
  } else {                             /* a child of left's and one of right's; the other pairs do the same */
    if (paper_is_leaf(&n[left]) || paper_is_leaf(&n[right])) return r;
    r.a = n[left].first;
    r.b = n[right].first + which % 2;
    double old_areas = (double)trb_area(n[left]) + trb_area(n[right]);
    r.gain = old_areas - trb_area(paper_union(n[r.a], &n[r.b ^ 1]))
           - trb_area(paper_union(n[r.b], &n[r.a ^ 1]));
  }
  return r;
}
static inline void paper_rotate(paper_mover *m, uint32_t slot, paper_rotation r)
{
  trbvh_node a = m->nodes[r.a], b = m->nodes[r.b];
  paper_put(m, r.a, b);
  paper_put(m, r.b, a);
  for (uint32_t i = m->nodes[slot].first, end = i + 2; i < end; i++) {
    if (!paper_is_leaf(&m->nodes[i])) paper_fit_box(m, i);
  }
  m->cost -= r.gain;
}

/* Bottom-up over all nodes, at each the best rotation, again and again until none helps. A gain must be
 * more than a hundred-thousandth of the node's area, which is above all rounding: no sum of areas comes
 * twice, so this ends. */
static inline void paper_climb_hill(paper_mover *m)
{
  for (int better = 1; better;) {
    uint32_t slot = 0;
    better = 0;
    do {
      slot = paper_next_inner(m, slot);
      paper_rotation best = {0, 0, 1e-5 * trb_area(m->nodes[slot])};
      for (uint32_t i = 0; i < PAPER_ROTATIONS; i++) {
        paper_rotation r = paper_rotation_below(m, slot, i);
        if (r.gain > best.gain) best = r;
      }
      if (!best.a) continue;
      paper_rotate(m, slot, best);
      better = 1;
    } while (slot);
  }
}
static inline void paper_kensler_climb(paper_build *p)
{
  paper_mover m = paper_start_moves(p);
  paper_climb_hill(&m);
  paper_end_moves(&m);
}

/* Bottom-up over all nodes, at each a rotation by chance: taken if it helps, otherwise with probability
 * exp(-dC / T). dC is the rise of the node's own SAH cost, so relative to its area. */
static inline void paper_anneal_sweep(paper_mover *m, double temperature, uint32_t *seed)
{
  uint32_t slot = 0;
  do {
    slot = paper_next_inner(m, slot);
    uint32_t which = (uint32_t)((uint64_t)ex_random_bits(seed) * PAPER_ROTATIONS >> 32);
    paper_rotation r = paper_rotation_below(m, slot, which);
    double scale = temperature * trb_area(m->nodes[slot]);
    if (!r.a) continue;
    if (r.gain >= 0 || (r.gain > -20 * scale && ex_random(seed) < exp(r.gain / scale))) {
      paper_rotate(m, slot, r);
    }
  } while (slot);
}
/* The schedule is ours, not the article's, which we do not have: hill climbing; 200 sweeps while T falls
 * from 0.05 to 0.003 by the same factor each; hill climbing again. The better one of both hills is kept: T
 * is so low in the end that the last tree is also the best since. */
static inline void paper_kensler_anneal(paper_build *p)
{
  paper_mover m = paper_start_moves(p);
  size_t size = 2 * (size_t)p->pair_end * sizeof *p->nodes;
  trbvh_node *climbed = (trbvh_node *)ex_allocate(size, 1);
  uint32_t seed = 1;
  paper_climb_hill(&m);
  memcpy(climbed, p->nodes, size);
  double climbed_cost = m.cost;
  for (double t = 0.05; t > 0.003; t *= 0.986) paper_anneal_sweep(&m, t, &seed);
  paper_climb_hill(&m);
  if (m.cost > climbed_cost) {
    memcpy(p->nodes, climbed, size);
    paper_link(&m);
  }
  free(climbed);
  paper_end_moves(&m);
}

#endif
