/* Sort keys: Morton codes and references' numbers (trbvh.h, >>sort). */
#include "shape.cl"

/* Of all references, where there are no gaps. */
TRB_KERNEL trb_k_keys(const __global trb_plan *plan, const __global trbvh_node *refs, __global ulong *keys) {
  const trb_grid grid = plan->grid;
  const trb_key_form form = plan->form;
  const uint count = trb_has_gaps(plan) ? 0 : plan->slots;
  uint i;
  TRB_FOR(i, count) keys[i] = trb_key(trb_box_code(refs[i], grid), i, form, 0);
}

/* The same where there are some. starts: how many references there are in the tiles before. */
TRB_KERNEL trb_k_gap_keys(const __global trb_plan *plan, const __global trbvh_node *refs, const __global uint *starts,
                          __global ulong *keys) {
  __local uint space[TRB_GROUP];
  const trb_grid grid = plan->grid;
  const trb_key_form form = plan->form;
  const uint first = TRB_GROUP_ID * TRB_TILE, end = min(plan->slots, first + TRB_TILE);
  uint i, start = starts[TRB_GROUP_ID], total;
  if (!trb_has_gaps(plan)) return;
  for (i = first; i < end; i += TRB_GROUP) {
    const uint mine = i + TRB_LOCAL_ID;
    const bool valid = mine < end && refs[mine].first != TRBVH_NONE;
    const uint before = trb_scan(valid, space, &total);
    if (valid) keys[start + before] = trb_key(trb_box_code(refs[mine], grid), mine, form, 0);
    start += total;
  }
}

/* The keys with the high half of the codes, in the order of those with the low half. */
TRB_KERNEL trb_k_high_keys(const __global trb_plan *plan, const __global trbvh_node *refs, __global ulong *keys) {
  const trb_grid grid = plan->grid;
  const trb_key_form form = plan->form;
  const uint count = plan->ref_count;
  uint i;
  TRB_FOR(i, count) {
    const uint ref = trb_key_ref(keys[i], form);
    keys[i] = trb_key(trb_box_code(refs[ref], grid), ref, form, 1);
  }
}
