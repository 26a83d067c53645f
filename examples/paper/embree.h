/* embree.h - Embree's builders (Wald, Woop, Benthin, Johnson and Ernst 2014), by its rtcBuildBVH.
 *
 * The tree is taken over as Embree made it, with its boxes and its leaves: nodes say that they are leaves
 * where Embree's are, and nowhere else, so that the collapse has no choice. It merges what HIGH leaves twice
 * in a leaf, and keeps to trbvh's bound on depth, as for all builders. Empty where EX_EMBREE is not defined.
 */
#ifndef PAPER_EMBREE_H
#define PAPER_EMBREE_H
#include "../embree.h"
#include "paper.h"
#ifdef EX_EMBREE

/* embree: started for the geometry's mesh. After a build embree->ms is the time of rtcBuildBVH alone, as the
 * rest here is not Embree's. Where it is less than 0, Embree has found no tree, and this one is LBVH's. */
typedef struct paper_embree_parameters {
  ex_embree           *embree;
  enum RTCBuildQuality quality;        /* LOW, MEDIUM or, which splits within options.split_budget, HIGH */
} paper_embree_parameters;

/* Embree does not tell how it has cut a triangle; that much of its box is in the leaf. */
static inline trbvh_node paper_embree_reference(const paper_build *p, uint32_t prim, const trbvh_node *leaf)
{
  float v[3][3];
  uint32_t vertex;
  trbvh_node box = trb_no_box();
  trb_prim_box(&p->lib.input, prim, &box, v, &vertex);
  for (int k = 0; k < 3; k++) {
    box.min[k] = TRB_MAX(box.min[k], leaf->min[k]);
    box.max[k] = TRB_MIN(box.max[k], leaf->max[k]);
  }
  return paper_reference(p, box, prim);
}
/* Makes the node, which has its box, a leaf: below it is a list of its references. */
static inline void paper_embree_leaf(paper_build *p, const ex_embree_leaf *leaf, trbvh_node *node)
{
  uint32_t last = leaf->count - 1, first = 2 * p->pair_end;
  trbvh_node rest = paper_embree_reference(p, leaf->prims[last], node);
  p->pair_end += last;
  for (uint32_t i = last; i-- > 0;) {
    p->nodes[first + 2 * i] = paper_embree_reference(p, leaf->prims[i], node);
    p->nodes[first + 2 * i + 1] = rest;
    rest = paper_parent(p, first + 2 * i);
  }
  node->first = rest.first;
  node->count = trb_small(leaf->count, p->lib.costs.ratio * trb_area(*node) * (float)leaf->count, 1);
}
/* Tells the inner nodes, whose count is 0 so far, their references and costs; children come first. */
static inline void paper_embree_count(paper_build *p)
{
  for (uint32_t i = 2 * p->pair_end; i-- > 0;) {
    trbvh_node *node = &p->nodes[i];
    if (i == 1 || node->count) continue;
    const trbvh_node *l = &p->nodes[node->first], *r = l + 1;
    uint32_t count = trb_count(l->count) + trb_count(r->count);
    float cost = trb_area(*node) + (trb_cost(l->count) + trb_cost(r->count));
    node->count = count <= p->lib.costs.max_leaf ? trb_small(count, cost, 0) : count;
  }
}
static inline void paper_embree_convert(paper_build *p, const void *root)
{
  struct { const void *at; uint32_t slot; } stack[TRBVH_MAX_DEPTH], now = {root, 0};
  uint32_t waiting = 0;
  p->nodes[0] = trb_no_box();
  for (uint32_t i = 0; i < p->ref_count; i++) p->nodes[0] = paper_union(p->nodes[0], &p->refs[i]);
  p->ref_count = 0;
  for (;;) {
    const ex_embree_leaf *leaf = ex_embree_as_leaf(now.at);
    if (leaf) {
      paper_embree_leaf(p, leaf, &p->nodes[now.slot]);
      p->ref_count += leaf->count;
      if (waiting == 0) break;
      now = stack[--waiting];
      continue;
    }
    const ex_embree_node *node = (const ex_embree_node *)now.at;
    uint32_t first = paper_new_pair(p);
    paper_set_inner(p, now.slot, first);
    for (uint32_t side = 0; side < 2; side++) {
      p->nodes[first + side] = trb_no_box();
      trb_include(&p->nodes[first + side], node->boxes[side].low, node->boxes[side].high);
    }
    stack[waiting].at = node->children[1];
    stack[waiting++].slot = first + 1;
    now.at = node->children[0];
    now.slot = first;
  }
  paper_embree_count(p);
}
static inline void paper_embree(paper_build *p)
{
  const paper_embree_parameters *parameters = (const paper_embree_parameters *)p->parameters;
  ex_embree *e = parameters->embree;
  ex_embree_clear(e);
  for (uint32_t i = 0; i < p->ref_count; i++) {
    const trbvh_node *ref = &p->refs[i];
    ex_embree_add(e, ref->first, ref->min, ref->max);
  }
  size_t room = ex_embree_room(e, parameters->quality);
  const void *root = ex_embree_build(e, parameters->quality, room < p->ref_max ? room : p->ref_max);
  if (root) paper_embree_convert(p, root);
  else paper_lbvh(p);
}

#endif /* EX_EMBREE */
#endif
