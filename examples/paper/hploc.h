/* hploc.h - H-PLOC (Benthin, Meister, Barczak, Mehalwal, Tsakok, Kensler 2024, "H-PLOC: Hierarchical
 * Parallel Locally-Ordered Clustering for Bounding Volume Hierarchy Construction").
 *
 * PLOC in one pass, guided by the radix tree of the Morton codes: each of its nodes takes over its
 * children's clusters, and where they are more than half a warp of 32, rounds of PLOC leave at most that
 * half for its parent; at the root, one. So there are never more than 32 clusters to look at, and they are
 * in registers or a cache.
 */
#ifndef PAPER_HPLOC_H
#define PAPER_HPLOC_H
#include "ploc.h"

enum { PAPER_WARP = 32, PAPER_HPLOC_RADIUS = 8 };   /* both the paper's */

static inline uint32_t paper_cluster_warp(paper_build *p, uint32_t begin, uint32_t end, uint64_t split)
{
  uint64_t nearest[PAPER_WARP];
  (void)split;
  return begin + paper_cluster(p, p->refs + begin, end - begin, PAPER_HPLOC_RADIUS, PAPER_WARP / 2, nearest);
}
static inline void paper_hploc(paper_build *p)
{
  uint64_t *codes = paper_sort_refs(p), nearest[PAPER_WARP];
  uint32_t left = paper_climb(p, codes, paper_cluster_warp);
  paper_cluster(p, p->refs, left, PAPER_HPLOC_RADIUS, 1, nearest);
  p->nodes[0] = p->refs[0];
  free(codes);
}

#endif
