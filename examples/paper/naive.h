/* naive.h - the best tree over a treelet's seven leaves, by its definition (Karras and Aila 2013, the talk's
 * slides).
 *
 *     c(S) = min( Ci A(S) + min over P in S of c(P) + c(S - P),   Ct A(S) N(S) )
 *
 * asked for anew wherever it occurs, with every P, takes 1,149,877 calls: why the paper needs dynamic
 * programming. Beside it is the library's own, of which the result is the same, and which takes as many
 * treelets at once as there are lanes.
 */
#ifndef PAPER_NAIVE_H
#define PAPER_NAIVE_H
#include "paper.h"

typedef struct paper_treelet { trbvh_node leaves[TRB_TREELET]; } paper_treelet;

typedef struct paper_recursion {
  float    area[TRB_SUBSETS], leaf[TRB_SUBSETS];   /* leaf: as one, or FLT_MAX */
  uint64_t calls;
} paper_recursion;

/* In units of Ci, as all of the library's costs. */
static inline float paper_naive_cost(paper_recursion *r, uint32_t subset)
{
  float best = FLT_MAX;
  r->calls++;
  if (TRB_SINGLE(subset)) return r->leaf[subset];
  for (uint32_t part = (subset - 1) & subset; part; part = (part - 1) & subset) {
    float cost = paper_naive_cost(r, part) + paper_naive_cost(r, subset ^ part);
    best = TRB_MIN(cost, best);
  }
  best += r->area[subset];
  return TRB_MIN(best, r->leaf[subset]);
}
/* The cost of the best tree; calls, where it is not NULL: how many it took. */
static inline float paper_treelet_naive(const paper_treelet *treelet, trb_costs costs, uint64_t *calls)
{
  paper_recursion r;
  r.calls = 0;
  for (uint32_t subset = 1; subset < TRB_SUBSETS; subset++) {
    trbvh_node box = trb_no_box();
    uint32_t count = 0;
    for (uint32_t i = 0; i < TRB_TREELET; i++) {
      if (!(subset >> i & 1)) continue;
      box = paper_union(box, &treelet->leaves[i]);
      count += trb_count(treelet->leaves[i].count);
      r.leaf[subset] = trb_cost(treelet->leaves[i].count);
    }
    r.area[subset] = trb_area(box);
    if (!TRB_SINGLE(subset)) {
      r.leaf[subset] = count <= costs.max_leaf ? costs.ratio * r.area[subset] * (float)count : FLT_MAX;
    }
  }
  float cost = paper_naive_cost(&r, TRB_SUBSETS - 1);
  if (calls) *calls = r.calls;
  return cost;
}
/* The same for TRB_LANES treelets. */
static inline void paper_treelets_dp(const paper_treelet *treelets, trb_costs costs, float *best)
{
  TRB_ALIGNED(trb_treelets) t;
  float own[TRB_LANES];                /* what the library's program leaves out */
  for (uint32_t lane = 0; lane < TRB_LANES; lane++) {
    own[lane] = 0;
    for (uint32_t i = 0; i < TRB_TREELET; i++) {
      const trbvh_node *leaf = &treelets[lane].leaves[i];
      float *value = &t.leaves[i * TRB_LEAF_VALUES * TRB_LANES + lane];
      for (uint32_t k = 0; k < 3; k++) {
        value[k * TRB_LANES] = leaf->min[k];
        value[(3 + k) * TRB_LANES] = leaf->max[k];
      }
      value[6 * TRB_LANES] = (float)trb_count(leaf->count);
      value[7 * TRB_LANES] = trb_cost(leaf->count);
      own[lane] += trb_cost(leaf->count);
    }
  }
  trb_treelet_costs(t.leaves, t.table, t.sums, TRB_LANES, costs);
  for (uint32_t lane = 0; lane < TRB_LANES; lane++) {
    best[lane] = t.table[(TRB_SUBSETS - 1) * TRB_LANES + lane] + own[lane];
  }
}

/* Treelets as the library forms them, of up to `most` nodes all over the tree in p (paper_lbvh's, say): how
 * many. */
static inline uint32_t paper_sample_treelets(const paper_build *p, paper_treelet *treelets, uint32_t most)
{
  TRB_ALIGNED(trb_treelets) t;
  uint32_t roots = 0, seen = 0, taken = 0;
  for (int pass = 0; pass < 2; pass++) {
    for (uint32_t i = 0; i < 2 * p->pair_end; i++) {
      if (i == 1 || trb_count(p->nodes[i].count) < TRB_TREELET) continue;
      if (pass == 0) {
        roots++;
      } else if ((uint64_t)seen++ * most / roots >= taken && taken < most) {
        trb_start_treelet(p->nodes, &t, 0, i);
        for (uint32_t step = 1; step < TRB_TREELET - 1; step++) trb_expand_largest(p->nodes, &t, 0, step);
        for (uint32_t k = 0; k < TRB_TREELET; k++) {
          treelets[taken].leaves[k] = p->nodes[(uint32_t)t.slot[k][0]];
        }
        taken++;
      }
    }
  }
  return taken;
}

#endif
