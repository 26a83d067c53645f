/* Collapse and layout (trbvh.h, >>collapse): first counts, of which the host reads the sums; then, with buffers of the
 * right size, nodes and primitives. */
#include "shape.cl"

static void trb_emit_padding(__global trbvh_node *out) {
  uint k;
  for (k = 0; k < 3; k++) out[1].min[k] = out[1].max[k] = 0;
  out[1].first = out[1].count = 0;
}

/* One work-item. */
TRB_KERNEL trb_k_find_tasks(__global trb_plan *plan, __global trbvh_node *nodes, __global ulong *keys, __global ulong *sorted,
                            __global trb_task *tasks, __global trb_group *groups) {
  const trb_collapser c = trb_plan_collapser(plan, nodes, 0, keys, sorted);
  float sah = 0;
  if (TRB_LOCAL_ID != 0) return;
  plan->tasks = plan->ref_count && !plan->too_deep ? trb_find_tasks(&c, 0, tasks, &sah) : 0;
  plan->groups = trb_find_groups(tasks, plan->tasks, groups);
  plan->sah = sah;
  plan->root_area = trb_sah_term(nodes[0], 1);
}

#ifdef TRB_CPU
TRB_KERNEL trb_k_settle_groups(const __global trb_plan *plan, __global trbvh_node *nodes, const __global trbvh_node *refs,
                               __global ulong *keys, __global ulong *sorted, __global trb_task *tasks,
                               const __global trb_group *groups) {
  const trb_collapser c = trb_plan_collapser(plan, nodes, refs, keys, sorted);
  uint i;
  TRB_FOR_JOBS(i, plan->groups) trb_settle_group(&c, tasks, groups[i]);
}

TRB_KERNEL trb_k_sum_tasks(__global trb_plan *plan, const __global trb_task *tasks) {
  uint i, leaves = 0, prims = 0, max_depth = 0;
  float sah = plan->sah;
  for (i = 0; i < plan->tasks; i++) {
    leaves += tasks[i].leaves;
    prims += tasks[i].prims;
    sah += tasks[i].sah;
    max_depth = max(max_depth, tasks[i].max_depth);
  }
  plan->leaves = leaves;
  plan->prims = prims;
  plan->max_depth = max_depth;
  plan->sah = sah;
}

TRB_KERNEL trb_k_emit_top(const __global trb_plan *plan, __global trbvh_node *nodes, __global ulong *keys,
                          __global ulong *sorted, __global trb_task *tasks, __global trbvh_node *out, __global uint *prims) {
  const trb_collapser c = trb_plan_emitter(plan, nodes, 0, keys, sorted, out, prims);
  trb_emit_padding(out);
  trb_emit_top(&c, tasks, plan->tasks);
}

TRB_KERNEL trb_k_emit_tasks(const __global trb_plan *plan, __global trbvh_node *nodes, const __global trbvh_node *refs,
                            __global ulong *keys, __global ulong *sorted, const __global trb_task *tasks,
                            __global trbvh_node *out, __global uint *prims) {
  const trb_collapser c = trb_plan_emitter(plan, nodes, refs, keys, sorted, out, prims);
  uint i;
  TRB_FOR_JOBS(i, plan->tasks) trb_emit_task(&c, tasks[i]);
}
#else
/* Inner nodes are listed level by level; their sums go from the bottom up, their places from the top down. */
TRB_CORE uint trb_count_prims(const trb_collapser *c, trbvh_node leaf) {
  uint prims[TRB_MAX_LEAF];
  return c->refs ? trb_leaf_prims(c, leaf, prims) : trb_count(leaf.count);
}

/* Writes a leaf whose primitives begin at `first`; returns how many they are. */
TRB_CORE uint trb_emit_leaf(const trb_collapser *c, trbvh_node node, uint dst, uint first) {
  uint prims[TRB_MAX_LEAF], i;
  if (c->held) {
    trb_emit_old_leaf(c, node, node.first, dst);
    return 1;
  }
  node.count = trb_leaf_prims(c, node, prims);
  node.first = first;
  c->out[dst] = node;
  for (i = 0; i < node.count; i++) c->prims[first + i] = prims[i];
  return node.count;
}

/* One work-group. first_refs: where each listed node's references begin. */
TRB_KERNEL trb_k_first_inner(const __global trb_plan *plan, const __global trbvh_node *nodes, __global trb_level *levels,
                             __global uint *list, __global uint *first_refs) {
  uint i;
  for (i = TRB_LOCAL_ID; i < TRB_GPU_LEVELS; i += TRB_GROUP) levels[i].first = levels[i].count = 0;
  TRB_SYNC();
  if (TRB_LOCAL_ID != 0 || plan->ref_count == 0 || plan->too_deep) return;
  list[0] = first_refs[0] = 0;
  levels[0].count = !trb_is_leaf(nodes[0].count);
}

static void trb_list_inner(const trb_collapser *c, __global trb_level *levels, __global uint *list, __global uint *first_refs,
                           uint level, uint item, uint items, __local uint *space) {
  const uint first = levels[level].first, count = levels[level].count, next = first + count;
  uint i;
  for (i = item; i - TRB_LOCAL_ID < count; i += items) {
    uint found = 0, child[2] = {0, 0}, refs[2] = {0, 0}, side, at;
    if (i < count) {
      const uint first_ref = first_refs[first + i], pair = trb_bounded_node(c, list[first + i], level, first_ref).first;
      const uint left = trb_count(c->nodes[pair].count);
      for (side = 0; side < 2; side++)
        if (!trb_is_leaf(c->nodes[pair + side].count)) {
          child[found] = pair + side;
          refs[found++] = first_ref + (side ? left : 0);
        }
    }
    at = next + trb_reserve(&levels[level + 1].count, found, space);
    for (side = 0; side < found; side++) {
      list[at + side] = child[side];
      first_refs[at + side] = refs[side];
    }
  }
  if (item == 0) levels[level + 1].first = next;
}

TRB_KERNEL trb_k_list_inner(const __global trb_plan *plan, __global trbvh_node *nodes, __global ulong *keys,
                            __global ulong *sorted, __global trb_level *levels, __global uint *list,
                            __global uint *first_refs, uint level) {
  __local uint space[2];
  const trb_collapser c = trb_plan_collapser(plan, nodes, 0, keys, sorted);
  trb_list_inner(&c, levels, list, first_refs, level, (uint)get_global_id(0), (uint)get_global_size(0), space);
}

/* One work-group: all levels from this one on. */
TRB_KERNEL trb_k_list_rest(const __global trb_plan *plan, __global trbvh_node *nodes, __global ulong *keys,
                           __global ulong *sorted, __global trb_level *levels, __global uint *list,
                           __global uint *first_refs, uint level) {
  __local uint space[2];
  const trb_collapser c = trb_plan_collapser(plan, nodes, 0, keys, sorted);
  for (; level + 1 < TRB_GPU_LEVELS && levels[level].count; level++) {
    trb_list_inner(&c, levels, list, first_refs, level, TRB_LOCAL_ID, TRB_GROUP, space);
    TRB_SYNC();
  }
}

static void trb_count_inner(const trb_collapser *c, __global trb_place *places, uint index) {
  const trbvh_node node = c->nodes[index];
  trb_place sum;
  uint side;
  sum.inner = 1;
  sum.prims = sum.pair = sum.prim = 0;
  sum.sah = trb_sah_term(node, c->cost_node);
  for (side = 0; side < 2; side++) {
    const trbvh_node child = c->nodes[node.first + side];
    if (trb_is_leaf(child.count)) {
      const uint count = trb_count_prims(c, child);
      sum.prims += count;
      sum.sah += trb_leaf_term(c, child, count);
    } else {
      const trb_place below = places[child.first / 2];
      sum.inner += below.inner;
      sum.prims += below.prims;
      sum.sah += below.sah;
    }
  }
  places[node.first / 2] = sum;
}

TRB_KERNEL trb_k_count_inner(const __global trb_plan *plan, __global trbvh_node *nodes, const __global trbvh_node *refs,
                             const __global trb_level *levels, const __global uint *list, __global trb_place *places,
                             uint level) {
  const trb_collapser c = trb_plan_collapser(plan, nodes, refs, 0, 0);
  const uint first = levels[level].first, count = levels[level].count;
  uint i;
  TRB_FOR(i, count) trb_count_inner(&c, places, list[first + i]);
}

/* One work-group: all levels from the lowest one up to this. */
TRB_KERNEL trb_k_count_rest(const __global trb_plan *plan, __global trbvh_node *nodes, const __global trbvh_node *refs,
                            const __global trb_level *levels, const __global uint *list, __global trb_place *places,
                            uint level) {
  const trb_collapser c = trb_plan_collapser(plan, nodes, refs, 0, 0);
  uint lowest = level, i;
  while (lowest + 1 < TRB_GPU_LEVELS && levels[lowest + 1].count) lowest++;
  for (lowest++; lowest-- > level;) {
    for (i = TRB_LOCAL_ID; i < levels[lowest].count; i += TRB_GROUP)
      trb_count_inner(&c, places, list[levels[lowest].first + i]);
    TRB_SYNC();
  }
}

/* One work-item is enough. */
TRB_KERNEL trb_k_sum_inner(__global trb_plan *plan, __global trbvh_node *nodes, const __global trbvh_node *refs,
                           const __global trb_level *levels, __global trb_place *places) {
  const trb_collapser c = trb_plan_collapser(plan, nodes, refs, 0, 0);
  uint depth = 0;
  if (TRB_LOCAL_ID != 0) return;
  plan->leaves = plan->prims = plan->max_depth = 0;
  if (plan->ref_count == 0 || plan->too_deep) return;
  plan->root_area = trb_sah_term(nodes[0], 1);
  if (trb_is_leaf(nodes[0].count)) {
    plan->leaves = 1;
    plan->prims = trb_count_prims(&c, nodes[0]);
    plan->sah = trb_leaf_term(&c, nodes[0], plan->prims);
  } else {
    __global trb_place *root = &places[nodes[0].first / 2];
    while (levels[depth].count) depth++;
    plan->leaves = root->inner + 1;
    plan->prims = root->prims;
    plan->sah = root->sah;
    plan->max_depth = depth;
    root->pair = 1;
    root->prim = 0;
  }
}

/* Where an inner node's children go: what is below them follows, right before left. */
static void trb_place_children(const trb_collapser *c, __global trb_place *places, uint index) {
  const trbvh_node node = c->nodes[index];
  const trb_place place = places[node.first / 2];
  uint pair = place.pair + 1, prim = place.prim, side;
  for (side = 2; side-- > 0;) {
    const trbvh_node child = c->nodes[node.first + side];
    const uint dst = 2 * place.pair + side;
    if (trb_is_leaf(child.count)) {
      prim += trb_emit_leaf(c, child, dst, prim);
    } else {
      __global trb_place *below = &places[child.first / 2];
      trb_emit_inner(c, child, dst, pair);
      below->pair = pair;
      below->prim = prim;
      pair += below->inner;
      prim += below->prims;
    }
  }
}

TRB_KERNEL trb_k_emit_root(const __global trb_plan *plan, __global trbvh_node *nodes, const __global trbvh_node *refs,
                           __global trbvh_node *out, __global uint *prims) {
  const trb_collapser c = trb_plan_emitter(plan, nodes, refs, 0, 0, out, prims);
  if (TRB_LOCAL_ID != 0) return;
  trb_emit_padding(out);
  if (trb_is_leaf(nodes[0].count)) trb_emit_leaf(&c, nodes[0], 0, 0);
  else trb_emit_inner(&c, nodes[0], 0, 1);
}

TRB_KERNEL trb_k_emit_level(const __global trb_plan *plan, __global trbvh_node *nodes, const __global trbvh_node *refs,
                            const __global trb_level *levels, const __global uint *list, __global trb_place *places,
                            __global trbvh_node *out, __global uint *prims, uint level) {
  const trb_collapser c = trb_plan_emitter(plan, nodes, refs, 0, 0, out, prims);
  const uint first = levels[level].first, count = levels[level].count;
  uint i;
  TRB_FOR(i, count) trb_place_children(&c, places, list[first + i]);
}
#endif
