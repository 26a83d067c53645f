/* Treelet restructuring (trbvh.h, >>treelets): every node of gamma references or more is the root of a treelet once a
 * round, after those below it; first the top of the tree, then what is below. */
#include "shape.cl"

#ifdef TRB_CPU
TRB_KERNEL trb_k_restructure_top(const __global trb_plan *plan, __global trbvh_node *nodes, __global ulong *keys,
                                 __global ulong *sorted, uint rounds) {
  if (plan->ref_count) trb_restructure_top(nodes, trb_split_words(keys, sorted, plan->ref_max), rounds, plan->costs);
}

/* And settles them after the last rounds, while they are in the caches. */
TRB_KERNEL trb_k_restructure_groups(const __global trb_plan *plan, __global trbvh_node *nodes,
                                    const __global trbvh_node *refs, __global ulong *keys, __global ulong *sorted,
                                    __global trb_task *tasks, const __global trb_group *groups, uint gamma, uint rounds,
                                    uint last) {
  const trb_collapser c = trb_plan_collapser(plan, nodes, refs, keys, sorted);
  uint i;
  TRB_FOR_JOBS(i, plan->groups) {
    trb_restructure_group(&c, tasks, groups[i], gamma, rounds);
    if (last) trb_settle_group(&c, tasks, groups[i]);
  }
}
#else
/* Nodes of one depth are independent: the roots are listed level by level from the top down, and restructured from the
 * bottom up. One work-item. */
TRB_KERNEL trb_k_first_level(const __global trb_plan *plan, const __global trbvh_node *nodes, __global trb_level *levels,
                             __global uint *list, uint gamma) {
  uint i;
  for (i = TRB_LOCAL_ID; i < TRB_GPU_LEVELS; i += TRB_GROUP) levels[i].first = levels[i].count = 0;
  TRB_SYNC();
  if (TRB_LOCAL_ID != 0 || plan->ref_count == 0 || plan->too_deep) return;
  list[0] = 0;
  levels[0].count = trb_count(nodes[0].count) >= gamma;
}

static void trb_list_level(const __global trbvh_node *nodes, __global trb_level *levels, __global uint *list, uint level,
                           uint gamma, uint item, uint items, __local uint *space) {
  const uint first = levels[level].first, count = levels[level].count, next = first + count;
  uint i;
  for (i = item; i - TRB_LOCAL_ID < count; i += items) {
    uint found = 0, child[2] = {0, 0}, side, at;
    if (i < count) {
      const uint pair = nodes[list[first + i]].first;
      for (side = 0; side < 2; side++)
        if (trb_count(nodes[pair + side].count) >= gamma) child[found++] = pair + side;
    }
    at = next + trb_reserve(&levels[level + 1].count, found, space);
    for (side = 0; side < found; side++) list[at + side] = child[side];
  }
  if (item == 0) levels[level + 1].first = next;
}

TRB_KERNEL trb_k_list_level(const __global trbvh_node *nodes, __global trb_level *levels, __global uint *list, uint gamma,
                            uint level) {
  __local uint space[2];
  trb_list_level(nodes, levels, list, level, gamma, (uint)get_global_id(0), (uint)get_global_size(0), space);
}

/* One work-group: all levels from this one on. A tree with more than there is room for is given up. */
TRB_KERNEL trb_k_list_levels(__global trb_plan *plan, const __global trbvh_node *nodes, __global trb_level *levels,
                             __global uint *list, uint gamma, uint level) {
  __local uint space[2];
  for (; level + 1 < TRB_GPU_LEVELS && levels[level].count; level++) {
    trb_list_level(nodes, levels, list, level, gamma, TRB_LOCAL_ID, TRB_GROUP, space);
    TRB_SYNC();
  }
  if (TRB_LOCAL_ID == 0 && levels[TRB_GPU_LEVELS - 1].count) plan->too_deep = 1;
}

/* Not those of more than `largest` references. */
static void trb_restructure_lane(__global trbvh_node *nodes, __local trb_treelets *t, uint root, uint largest, trb_costs costs) {
  const uint lane = TRB_LOCAL_ID;
  float sums[TRB_SUBSETS];
  uint i;
  if (trb_count(nodes[root].count) > largest) return;
  trb_start_treelet(nodes, t, lane, root);
  for (i = 1; i < TRB_TREELET - 1; i++) trb_expand_largest(nodes, t, lane, i);
  for (i = 0; i < TRB_TREELET; i++) trb_enter_leaf(nodes, t, lane, i);
  trb_treelet_costs_1(t->leaves + lane, t->table + lane, sums, costs);
  trb_finish_treelet(nodes, t, sums, lane, root, costs);
}

#define TRB_TREELET_KERNEL __kernel __attribute__((reqd_work_group_size(TRB_LANES, 1, 1))) void

/* Up to TRB_ROOTS_MAX of the level's roots, from number `begin` on. */
TRB_TREELET_KERNEL trb_k_restructure_level(const __global trb_plan *plan, __global trbvh_node *nodes,
                                           const __global trb_level *levels, const __global uint *list,
                                           __local trb_treelets *t, uint largest, uint level, uint begin) {
  const uint i = begin + (uint)get_global_id(0);
  if (i < levels[level].count) trb_restructure_lane(nodes, t, list[levels[level].first + i], largest, plan->costs);
}

/* One work-group: all levels from the lowest one up to this. */
TRB_TREELET_KERNEL trb_k_restructure_levels(const __global trb_plan *plan, __global trbvh_node *nodes,
                                            const __global trb_level *levels, const __global uint *list,
                                            __local trb_treelets *t, uint largest, uint level) {
  uint lowest = level, i;
  while (lowest + 1 < TRB_GPU_LEVELS && levels[lowest + 1].count) lowest++;
  for (lowest++; lowest-- > level;) {
    for (i = TRB_LOCAL_ID; i < levels[lowest].count; i += TRB_LANES)
      trb_restructure_lane(nodes, t, list[levels[lowest].first + i], largest, plan->costs);
    TRB_SYNC();
  }
}
#endif
