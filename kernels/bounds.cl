/* References, one a primitive, and the grid over the scene. */
#include "shape.cl"

static void trb_merge(trb_partial *into, trb_partial p) {
  trb_include(&into->bounds, p.bounds.min, p.bounds.max);
  into->skipped += p.skipped;
  into->priority = TRB_MAX(p.priority, into->priority);
  if (p.bad < into->bad) { into->bad = p.bad; into->bad_vertex = p.bad_vertex; }
}

static trb_partial trb_nothing(void) {
  trb_partial p;
  p.bounds = trb_no_box();
  p.skipped = p.bad_vertex = 0;
  p.bad = TRBVH_NONE;
  p.priority = 0;
  return p;
}

/* The group's sum, to its first work-item. */
static trb_partial trb_merge_group(trb_partial mine, __local trb_partial *space) {
#ifndef TRB_CPU
  uint half_size;
  for (half_size = TRB_GROUP / 2; half_size; half_size /= 2) {
    TRB_SYNC();
    if (TRB_LOCAL_ID >= half_size && TRB_LOCAL_ID < 2 * half_size) space[TRB_LOCAL_ID - half_size] = mine;
    TRB_SYNC();
    if (TRB_LOCAL_ID < half_size) trb_merge(&mine, space[TRB_LOCAL_ID]);
  }
#endif
  return mine;
}

/* One work-group: what all of them found, to its first work-item. */
static trb_partial trb_merge_all(const __global trb_partial *partials, uint count, __local trb_partial *space) {
  trb_partial sum = trb_nothing();
  uint i;
  for (i = TRB_LOCAL_ID; i < count; i += TRB_GROUP) trb_merge(&sum, partials[i]);
  return trb_merge_group(sum, space);
}

/* Boxes of all primitives; those of invalid ones are gaps, marked by TRBVH_NONE. */
TRB_KERNEL trb_k_read(__global trb_plan *plan, const __global char *positions, const __global char *indices,
                      __global trbvh_node *refs, __global trb_partial *partials) {
  __local trb_partial space[TRB_GROUP];
  const trb_mesh mesh = trb_plan_mesh(plan, positions, indices);
  trb_partial sum = trb_nothing();
  uint i;
  TRB_FOR(i, mesh.count) {
    trbvh_node box;
    float v[3][3];
    uint vertex;
    int valid = trb_prim_box(&mesh, i, &box, v, &vertex);
    box.first = i;
    if (valid > 0) {
      trb_include(&sum.bounds, box.min, box.max);
    } else {
      box = trb_no_box();
      box.first = TRBVH_NONE;
      sum.skipped++;
      if (valid < 0 && i < sum.bad) { sum.bad = i; sum.bad_vertex = vertex; }
    }
    refs[i] = box;
  }
  sum = trb_merge_group(sum, space);
  if (TRB_LOCAL_ID == 0) partials[TRB_GROUP_ID] = sum;
}

/* One work-group: the scene's bounds from all of them. */
TRB_KERNEL trb_k_grid(__global trb_plan *plan, const __global trb_partial *partials, uint count) {
  __local trb_partial space[TRB_GROUP];
  const trb_partial sum = trb_merge_all(partials, count, space);
  if (TRB_LOCAL_ID != 0) return;
  plan->grid = trb_make_grid(sum.bounds);
  plan->skipped = sum.skipped;
  plan->bad = sum.bad;
  plan->bad_vertex = sum.bad_vertex;
  plan->slots = plan->prim_count;
  plan->ref_count = plan->prim_count - sum.skipped;
}

/* How many references each tile has, where there are gaps. */
TRB_KERNEL trb_k_count_refs(const __global trb_plan *plan, const __global trbvh_node *refs, __global uint *counts) {
  __local uint space[TRB_GROUP];
  const uint first = TRB_GROUP_ID * TRB_TILE, end = min(plan->slots, first + TRB_TILE);
  uint i, count = 0, total;
  if (!trb_has_gaps(plan)) return;
  for (i = first + TRB_LOCAL_ID; i < end; i += TRB_GROUP) count += refs[i].first != TRBVH_NONE;
  trb_scan(count, space, &total);
  if (TRB_LOCAL_ID == 0) counts[TRB_GROUP_ID] = total;
}

/* ---- Prefix sums ---- */
/* One work-group: each of count values becomes the sum of those before. */
TRB_KERNEL trb_k_scan(__global uint *values, uint count) {
  __local uint space[TRB_GROUP];
  uint i, start = 0, total;
  for (i = 0; i < count; i += TRB_GROUP) {
    const uint mine = i + TRB_LOCAL_ID, value = mine < count ? values[mine] : 0;
    const uint before = trb_scan(value, space, &total);
    if (mine < count) values[mine] = start + before;
    start += total;
  }
}
