/* Boxes of a tree whose primitives have moved: the same topology, level by level from the bottom up. And the beginning of
 * trbvh_cl_optimize: the build nodes of a tree that exists, likewise. */
#include "shape.cl"

/* One work-group. */
TRB_KERNEL trb_k_first_refit(const __global trbvh_node *nodes, __global trb_level *levels, __global uint *list) {
  uint i;
  for (i = TRB_LOCAL_ID; i < TRB_GPU_LEVELS; i += TRB_GROUP) levels[i].first = levels[i].count = 0;
  TRB_SYNC();
  if (TRB_LOCAL_ID != 0) return;
  list[0] = 0;
  levels[0].count = nodes[0].count == 0;
}

/* One work-group or many: the inner nodes among the children of a level's. */
TRB_KERNEL trb_k_list_refit(const __global trbvh_node *nodes, __global trb_level *levels, __global uint *list, uint level) {
  __local uint space[2];
  const uint first = levels[level].first, count = levels[level].count, next = first + count;
  const uint items = (uint)get_global_size(0);
  uint i;
  for (i = (uint)get_global_id(0); i - TRB_LOCAL_ID < count; i += items) {
    uint found = 0, child[2] = {0, 0}, side, at;
    if (i < count) {
      const uint pair = nodes[list[first + i]].first;
      for (side = 0; side < 2; side++)
        if (nodes[pair + side].count == 0) child[found++] = pair + side;
    }
    at = next + trb_reserve(&levels[level + 1].count, found, space);
    for (side = 0; side < found; side++) list[at + side] = child[side];
  }
  if (get_global_id(0) == 0) levels[level + 1].first = next;
}

/* Leaves: the boxes of their primitives. Of split ones the whole: the fragments' boxes are not known any more. */
TRB_KERNEL trb_k_refit_leaves(const __global trb_plan *plan, const __global char *positions, const __global char *indices,
                              const __global uint *prims, __global trbvh_node *nodes, uint count) {
  const trb_mesh mesh = trb_plan_mesh(plan, positions, indices);
  uint i, k;
  TRB_FOR(i, count) {
    trbvh_node leaf = nodes[i], sum = trb_no_box();
    if (leaf.count == 0) continue;
    for (k = leaf.first; k < leaf.first + leaf.count; k++) {
      trbvh_node box;
      float v[3][3];
      uint vertex;
      if (trb_prim_box(&mesh, prims[k], &box, v, &vertex) > 0) trb_include(&sum, box.min, box.max);
    }
    for (k = 0; k < 3; k++) {
      nodes[i].min[k] = sum.min[k];
      nodes[i].max[k] = sum.max[k];
    }
  }
}

TRB_KERNEL trb_k_refit_level(__global trbvh_node *nodes, const __global trb_level *levels, const __global uint *list,
                             uint level) {
  const uint first = levels[level].first, count = levels[level].count;
  uint i, k;
  for (i = (uint)get_global_id(0); i < count; i += (uint)get_global_size(0)) {
    const uint node = list[first + i];
    const trbvh_node left = nodes[nodes[node].first], right = nodes[nodes[node].first + 1];
    for (k = 0; k < 3; k++) {
      nodes[node].min[k] = TRB_MIN(left.min[k], right.min[k]);
      nodes[node].max[k] = TRB_MAX(left.max[k], right.max[k]);
    }
  }
}

/* ---- A tree that is optimized ---- */
TRB_KERNEL trb_k_unsettle(const __global trb_plan *plan, const __global trbvh_node *old, __global trbvh_node *nodes,
                          __global trb_held *held, uint count) {
  const trb_costs costs = plan->costs;
  uint i;
  TRB_FOR(i, count) nodes[i] = trb_unsettle(old[i], i, &held[i], costs);
}

TRB_KERNEL trb_k_unsettle_level(const __global trb_plan *plan, __global trbvh_node *nodes, const __global trb_level *levels,
                                const __global uint *list, uint level) {
  const uint first = levels[level].first, count = levels[level].count;
  const trb_costs costs = plan->costs;
  uint i;
  for (i = (uint)get_global_id(0); i < count; i += (uint)get_global_size(0)) trb_remake(nodes, list[first + i], costs);
}
