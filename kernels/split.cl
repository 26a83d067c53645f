/* Triangle splitting (paper, section 4; trbvh.h, >>splits). */
#include "bounds.cl"

TRB_KERNEL trb_k_priorities(const __global trb_plan *plan, const __global char *positions, const __global char *indices,
                            const __global trbvh_node *refs, __global float *priorities,
                            __global trb_partial *partials) {
  __local trb_partial space[TRB_GROUP];
  const trb_mesh mesh = trb_plan_mesh(plan, positions, indices);
  const trb_grid grid = plan->grid;
  trb_partial sum = trb_nothing();
  uint i;
  TRB_FOR(i, mesh.count) {
    const trbvh_node box = refs[i];
    float v[3][3], priority = 0;
    uint vertex;
    if (box.first != TRBVH_NONE && trb_load_triangle(&mesh, i, v, &vertex))
      priority = trb_split_priority((const float (*)[3])v, box, grid);
    priorities[i] = priority;
    sum.priority = TRB_MAX(priority, sum.priority);
  }
  sum = trb_merge_group(sum, space);
  if (TRB_LOCAL_ID == 0) partials[TRB_GROUP_ID] = sum;
}

/* One work-group: begins the search for the scale. */
TRB_KERNEL trb_k_priority_unit(__global trb_plan *plan, const __global trb_partial *partials, uint count) {
  __local trb_partial space[TRB_GROUP];
  const trb_partial sum = trb_merge_all(partials, count, space);
  if (TRB_LOCAL_ID != 0) return;
  plan->priority_unit = trb_priority_unit(sum.priority);
  plan->scale_low = 0;
}

/* The search tries TRB_CANDIDATES scales at once, `step` numbers apart; three times, from far apart to neighbours. */
TRB_KERNEL trb_k_sum_splits(const __global trb_plan *plan, const __global float *priorities, __global ulong *sums, uint step) {
  __local ulong space[TRB_GROUP];
  const float unit = plan->priority_unit;
  const uint low = plan->scale_low;
  ulong scale[TRB_CANDIDATES], sum[TRB_CANDIDATES];
  uint i, k;
  for (k = 0; k < TRB_CANDIDATES; k++) {
    scale[k] = trb_scale(min(low + k * step, TRB_SCALES - 1));
    sum[k] = 0;
  }
  TRB_FOR(i, plan->prim_count) {
    const float priority = priorities[i];
    for (k = 0; k < TRB_CANDIDATES; k++) sum[k] += trb_splits(priority, unit, scale[k]);
  }
  for (k = 0; k < TRB_CANDIDATES; k++) {
    ulong total = trb_sum_group(sum[k], space);
    if (TRB_LOCAL_ID == 0) sums[TRB_GROUP_ID * TRB_CANDIDATES + k] = total;
  }
}

/* One work-group. */
TRB_KERNEL trb_k_choose_scale(__global trb_plan *plan, const __global ulong *sums, uint step, uint count) {
  __local ulong space[TRB_GROUP];
  uint i, k, low = plan->scale_low;
  for (k = 1; k < TRB_CANDIDATES; k++) {
    ulong sum = 0;
    for (i = TRB_LOCAL_ID; i < count; i += TRB_GROUP) sum += sums[i * TRB_CANDIDATES + k];
    sum = trb_sum_group(sum, space);
    if (sum <= plan->split_max && plan->scale_low + k * step < TRB_SCALES) low = plan->scale_low + k * step;
  }
  TRB_SYNC();
  if (TRB_LOCAL_ID != 0) return;
  plan->scale_low = low;
  plan->scale = trb_scale(low);
}

static uint trb_slots(const __global trb_plan *plan, const __global trbvh_node *refs, const __global float *priorities, uint i) {
  return refs[i].first == TRBVH_NONE ? 0 : (uint)trb_splits(priorities[i], plan->priority_unit, plan->scale) + 1;
}

TRB_KERNEL trb_k_count_slots(const __global trb_plan *plan, const __global trbvh_node *refs, const __global float *priorities,
                             __global uint *counts) {
  __local uint space[TRB_GROUP];
  const uint first = TRB_GROUP_ID * TRB_TILE, end = min(plan->prim_count, first + TRB_TILE);
  uint i, count = 0, total;
  for (i = first + TRB_LOCAL_ID; i < end; i += TRB_GROUP) count += trb_slots(plan, refs, priorities, i);
  trb_scan(count, space, &total);
  if (TRB_LOCAL_ID == 0) counts[TRB_GROUP_ID] = total;
}

/* Every reference has room for all its splits; what it does not use is a gap. found: how many there are, a group. */
TRB_KERNEL trb_k_split(const __global trb_plan *plan, const __global char *positions, const __global char *indices,
                       const __global trbvh_node *refs, const __global float *priorities, const __global uint *starts,
                       __global trbvh_node *out, __global uint *found) {
  __local uint space[TRB_GROUP];
  const trb_mesh mesh = trb_plan_mesh(plan, positions, indices);
  const trb_grid grid = plan->grid;
  const uint first = TRB_GROUP_ID * TRB_TILE, end = min(plan->prim_count, first + TRB_TILE);
  uint i, k, start = starts[TRB_GROUP_ID], total, sum = 0;
  for (i = first; i < end; i += TRB_GROUP) {
    const uint mine = i + TRB_LOCAL_ID, slots = mine < end ? trb_slots(plan, refs, priorities, mine) : 0;
    const uint at = start + trb_scan(slots, space, &total);
    uint count = slots ? trb_split_reference(&mesh, grid, refs[mine], slots - 1, out + at) : 0;
    for (k = count; k < slots; k++) out[at + k].first = TRBVH_NONE;
    sum += count;
    start += total;
  }
  trb_scan(sum, space, &total);
  if (TRB_LOCAL_ID == 0) {
    found[2 * TRB_GROUP_ID] = total;
    found[2 * TRB_GROUP_ID + 1] = start;             /* where the next group's slots begin */
  }
}

/* One work-group: references in all, of `count` groups. */
TRB_KERNEL trb_k_sum_refs(__global trb_plan *plan, const __global uint *found, uint count) {
  __local uint space[TRB_GROUP];
  uint i, sum = 0, total;
  for (i = TRB_LOCAL_ID; i < count; i += TRB_GROUP) sum += found[2 * i];
  trb_scan(sum, space, &total);
  if (TRB_LOCAL_ID != 0) return;
  plan->slots = found[2 * count - 1];
  plan->ref_count = total;
}
