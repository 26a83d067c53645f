/* The linear BVH over the sorted references (trbvh.h, >>hierarchy). */
#include "shape.cl"

static trb_curve trb_plan_curve(const __global trb_plan *plan, const __global ulong *keys, const __global trbvh_node *refs) {
  trb_curve curve;
  curve.keys = keys;
  curve.refs = refs;
  curve.grid = plan->grid;
  curve.form = plan->form;
  curve.count = plan->ref_count;
  return curve;
}

#ifdef TRB_CPU
TRB_KERNEL trb_k_build_blocks(const __global trb_plan *plan, const __global ulong *keys, const __global trbvh_node *refs,
                              __global trbvh_node *nodes, __global trb_range *ranges) {
  const trb_curve curve = trb_plan_curve(plan, keys, refs);
  const uint blocks = curve.count ? (curve.count - 1) / TRB_BLOCK + 1 : 0;
  uint i;
  TRB_FOR_JOBS(i, blocks)
    trb_build_block(&curve, i * TRB_BLOCK, min(curve.count, (i + 1) * TRB_BLOCK), plan->costs, 0, nodes, &ranges[i]);
}

TRB_KERNEL trb_k_build_top(const __global trb_plan *plan, __global trbvh_node *nodes, const __global trb_range *ranges) {
  const uint count = plan->ref_count;
  if (count) trb_build_top(nodes, ranges, (count - 1) / TRB_BLOCK + 1, plan->costs, 0);
}
#else
/* Split i is what splits sorted leaf i from leaf i + 1. The node that it makes covers the leaves around it up to the
 * next shallower splits; its children become pair i + 1. A finished subtree over leaves first..last hangs from the
 * deeper one of splits first - 1 and last, which therefore hears from below when it can be made (Apetrei 2014, "Fast
 * and Simple Agglomerative LBVH Construction", without its atomics).
 *
 * A work-group owns a chunk of the leaves and goes up in rounds, with a barrier in between: first what is ready is
 * found, then it is made. What reaches beyond the chunk is left to the next kernel, whose chunks are TRB_GPU_CHUNKS times
 * as large: of 1,024 leaves' splits, some ten remain. */

/* Hangs a finished subtree up where it belongs, and tells the split. */
static void trb_hang(const trb_curve *curve, __global trbvh_node *nodes, __global trb_wait *waits, trbvh_node node,
                     uint first, uint last) {
  const ulong left = trb_split_after(curve, first - 1), right = trb_split_after(curve, last);
  if (first == 0 && last == curve->count - 1) {
    nodes[0] = node;
  } else if (first > 0 && left <= right) {           /* the middle of the scene may be as shallow as its ends */
    nodes[2 * first + 1] = node;                     /* the right child of split first - 1 */
    waits[first - 1].last = last + 1;
  } else {
    nodes[2 * last + 2] = node;                      /* the left child of split last */
    waits[last].first = first + 1;
  }
}

static void trb_make_split(const trb_curve *curve, __global trbvh_node *nodes, __global trb_wait *waits, uint split,
                           trb_costs costs) {
  const uint pair = split + 1;
  const trbvh_node node = trb_parent(nodes[2 * pair], nodes[2 * pair + 1], 2 * pair, costs);
  trb_hang(curve, nodes, waits, node, waits[split].first - 1, waits[split].last - 1);
}

static bool trb_is_ready(const __global trb_wait *waits, uint split) {
  return waits[split].first != 0 && waits[split].last != 0;
}

/* Keeps the splits below end - 1 that are still waiting, and end - 1 itself, which the neighbour has a part in. */
TRB_KERNEL trb_k_build_chunks(const __global trb_plan *plan, const __global ulong *keys, const __global trbvh_node *refs,
                              __global trbvh_node *nodes, __global trb_wait *waits, __global uint *waiting,
                              __global uint *counts) {
  __local uint space[TRB_GROUP], ready_count;
  const trb_curve curve = trb_plan_curve(plan, keys, refs);
  const trb_costs costs = plan->costs;
  const uint id = TRB_LOCAL_ID, first = TRB_GROUP_ID * TRB_GPU_CHUNK, end = min(curve.count, first + TRB_GPU_CHUNK);
  uint i, k, done = 0, kept = 0, total;
  for (i = first + id; i < end; i += TRB_GROUP) {
    const uint number = trb_key_ref(keys[i], curve.form);
    trbvh_node ref = refs[number];
    ref.first = number;                              /* the primitive takes its place in the end */
    trb_hang(&curve, nodes, waits, trb_reference(ref, costs), i, i);
  }
  for (;;) {
    uint ready = 0;
    TRB_SYNC();
    if (id == 0) ready_count = 0;
    TRB_SYNC();
    for (i = first + id, k = 1; i + 1 < end; i += TRB_GROUP, k *= 2)
      if (!(done & k) && trb_is_ready(waits, i)) ready |= k;
    if (ready) atomic_inc((volatile __local uint *)&ready_count);
    TRB_SYNC();
    if (ready_count == 0) break;
    for (i = first + id, k = 1; i + 1 < end; i += TRB_GROUP, k *= 2)
      if (ready & k) trb_make_split(&curve, nodes, waits, i, costs);
    done |= ready;
  }
  for (i = first + id, k = 1; i < end; i += TRB_GROUP, k *= 2) kept += !(done & k);
  kept = trb_scan(kept, space, &total);
  for (i = first + id, k = 1; i < end; i += TRB_GROUP, k *= 2)
    if (!(done & k)) waiting[first + kept++] = i;
  if (id == 0) counts[TRB_GROUP_ID] = total;
}

/* The same for TRB_GPU_CHUNKS chunks of `size` leaves each, whose waiting splits are known. */
TRB_KERNEL trb_k_join_chunks(const __global trb_plan *plan, const __global ulong *keys, const __global trbvh_node *refs,
                             __global trbvh_node *nodes, __global trb_wait *waits, const __global uint *waiting,
                             const __global uint *counts, __global uint *still_waiting, __global uint *still_counts,
                             uint size) {
  __local uint space[TRB_GROUP], ready_count;
  const trb_curve curve = trb_plan_curve(plan, keys, refs);
  const trb_costs costs = plan->costs;
  const uint id = TRB_LOCAL_ID, chunk = TRB_GROUP_ID * TRB_GPU_CHUNKS, chunks = curve.count ? (curve.count - 1) / size + 1 : 0;
  const ulong reach = (ulong)(chunk + TRB_GPU_CHUNKS) * size;
  const uint first = chunk * size, end = reach < curve.count ? (uint)reach : curve.count;
  __global uint *list = still_waiting + first;
  uint i, k, count = 0, kept = 0, total;
  for (k = chunk; k < chunk + TRB_GPU_CHUNKS && k < chunks; k++) {
    for (i = id; i < counts[k]; i += TRB_GROUP) list[count + i] = waiting[(size_t)k * size + i];
    count += counts[k];
  }
  /* Whoever is ready is known by a mark, 2^31, in the list, which only its work-item reads. */
  for (;;) {
    uint ready = 0;
    TRB_SYNC();
    if (id == 0) ready_count = 0;
    TRB_SYNC();
    for (i = id; i < count; i += TRB_GROUP)
      if (list[i] < end - 1 && trb_is_ready(waits, list[i])) {
        list[i] |= 0x80000000u;
        ready = 1;
      }
    if (ready) atomic_inc((volatile __local uint *)&ready_count);
    TRB_SYNC();
    if (ready_count == 0) break;
    for (i = id; i < count; i += TRB_GROUP)
      if (list[i] >= 0x80000000u && list[i] != TRBVH_NONE) {
        trb_make_split(&curve, nodes, waits, list[i] & 0x7FFFFFFFu, costs);
        list[i] = TRBVH_NONE;
      }
  }
  for (i = 0; i < count; i += TRB_GROUP) {
    const uint split = i + id < count ? list[i + id] : TRBVH_NONE;
    const uint before = trb_scan(split != TRBVH_NONE, space, &total);
    TRB_SYNC();
    if (split != TRBVH_NONE) list[kept + before] = split;
    kept += total;
  }
  if (id == 0) still_counts[TRB_GROUP_ID] = kept;
}
#endif
