/* ploc.h - PLOC (Meister and Bittner 2018, "Parallel Locally-Ordered Clustering for Bounding Volume
 * Hierarchy Construction").
 *
 * Clusters, at first the references, lie in Morton order. Each looks for its nearest neighbour, with which
 * its union has the least area, among `radius` clusters on either side; two that are each other's nearest
 * become one, which takes the place of the left one; the gaps are closed, and all begins again, until one
 * cluster is left.
 *
 * Nearest of all with equal areas is the one whose place differs least, by exclusive or. That orders pairs
 * the same way for both of their clusters, and no two pairs with one in common tie: so the least pair of all
 * is mutual, and each round merges something. And equal boxes merge two by two; were the first nearest,
 * only one pair of them would be each other's. Rounds may still be many, where boxes keep growing along the
 * curve.
 */
#ifndef PAPER_PLOC_H
#define PAPER_PLOC_H
#include "paper.h"

enum { PAPER_PLOC_RADIUS = 16 };       /* with HIPRT's 8, SAH is 1 % higher (13 meshes) */
typedef struct paper_ploc_settings { uint32_t radius; } paper_ploc_settings;   /* 1 or more */

/* nearest: the area of the union, 32 bits, then i ^ j. Each pair is looked at once, for both of its
 * clusters. */
static inline void paper_find_nearest(const trbvh_node *clusters, uint32_t count, uint32_t radius,
                                      uint64_t *nearest)
{
  for (uint32_t i = 0; i < count; i++) nearest[i] = UINT64_MAX;
  for (uint32_t i = 0; i < count; i++) {
    const trbvh_node here = clusters[i];
    uint32_t end = count - i > radius ? i + radius + 1 : count;
    uint64_t best = nearest[i];
    for (uint32_t j = i + 1; j < end; j++) {
      uint32_t area = trb_bits(trb_area(paper_union(here, &clusters[j]))) & 0x7FFFFFFF;   /* -0 is 0 */
      uint64_t key = (uint64_t)area << 32 | (i ^ j);
      best = TRB_MIN(key, best);
      nearest[j] = TRB_MIN(key, nearest[j]);
    }
    nearest[i] = best;
  }
}
/* Returns how many clusters remain. */
static inline uint32_t paper_merge_nearest(paper_build *p, trbvh_node *clusters, uint32_t count,
                                           const uint64_t *nearest)
{
  uint32_t left = 0;
  for (uint32_t i = 0; i < count; i++) {
    uint32_t j = i ^ (uint32_t)nearest[i];
    if (nearest[i] != nearest[j]) clusters[left++] = clusters[i];
    else if (i < j) clusters[left++] = paper_join(p, clusters[i], clusters[j]);
  }
  return left;
}
/* Rounds until at most `most` are left. nearest: room for count. */
static inline uint32_t paper_cluster(paper_build *p, trbvh_node *clusters, uint32_t count, uint32_t radius,
                                     uint32_t most, uint64_t *nearest)
{
  while (count > most) {
    paper_find_nearest(clusters, count, radius, nearest);
    count = paper_merge_nearest(p, clusters, count, nearest);
  }
  return count;
}
static inline void paper_ploc(paper_build *p)
{
  const paper_ploc_settings *settings = (const paper_ploc_settings *)p->parameters;
  uint64_t *codes = paper_sort_refs(p);
  uint64_t *nearest = codes;           /* only the order was of interest */
  paper_cluster(p, p->refs, p->ref_count, settings ? settings->radius : PAPER_PLOC_RADIUS, 1, nearest);
  p->nodes[0] = p->refs[0];
  free(codes);
}

#endif
