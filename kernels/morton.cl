/* Sort keys: Morton codes and references' numbers (trbvh.h, >>sort). */
#include "shape.cl"

/* high: the references stand in the order of the keys that are there, and get those of the other half of the code. */
TRB_KERNEL trb_k_keys(const __global trb_plan *plan, const __global trbvh_node *refs, __global ulong *keys, uint high) {
  const trb_grid grid = plan->grid;
  const trb_key_form form = plan->form;
  const uint count = plan->ref_count;
  uint i;
  TRB_FOR(i, count) {
    const uint ref = high ? trb_key_ref(keys[i], form) : i;
    keys[i] = trb_key(refs[ref], ref, grid, form, high);
  }
}
