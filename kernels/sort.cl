/* A stable radix sort of the keys by one digit: count each digit in every block, sum up, and move. The host calls it
 * for the digits of the Morton code, lowest first. */
#include "shape.cl"

#ifdef TRB_CPU
/* A work-item counts and moves a block of TRB_SORT_BLOCK keys, digits of TRB_DIGIT_BITS: as in C. */
TRB_KERNEL trb_k_count_digits(const __global trb_plan *plan, const __global ulong *keys, __global uint *histograms, uint shift) {
  const uint first = TRB_GROUP_ID * TRB_SORT_BLOCK;
  const uint count = first < plan->ref_count ? min(plan->ref_count - first, TRB_SORT_BLOCK) : 0;
  trb_count_digits(keys + first, count, shift, TRB_DIGITS, histograms + (size_t)TRB_GROUP_ID * TRB_DIGITS);
}

TRB_KERNEL trb_k_place_digits(__global uint *histograms, uint blocks) { trb_place_digits(histograms, blocks, TRB_DIGITS); }

TRB_KERNEL trb_k_scatter_keys(const __global trb_plan *plan, const __global ulong *keys, __global uint *histograms,
                              __global ulong *sorted, uint shift) {
  const uint first = TRB_GROUP_ID * TRB_SORT_BLOCK;
  const uint count = first < plan->ref_count ? min(plan->ref_count - first, TRB_SORT_BLOCK) : 0;
  trb_scatter_keys(keys + first, count, shift, TRB_DIGITS, histograms + (size_t)TRB_GROUP_ID * TRB_DIGITS, sorted);
}
#else
/* A work-group takes tiles of TRB_TILE keys, digits of eight bits. It counts with local atomics, whose order does not
 * matter. To move, it first sorts its tile by the digit, four bits at a time: that is stable, and neighbours then go
 * to neighbouring places. histograms: digit by digit, all tiles of each. */
#define TRB_ITEMS (TRB_TILE / TRB_GROUP)             /* keys of one work-item, in a row */
#define TRB_DIGIT(key, shift) ((uint)((key) >> (shift)) & 255u)

TRB_KERNEL trb_k_count_digits(const __global trb_plan *plan, const __global ulong *keys, __global uint *histograms, uint shift) {
  __local uint counts[256];
  const uint first = TRB_GROUP_ID * TRB_TILE, end = min(plan->ref_count, first + TRB_TILE);
  uint i;
  counts[TRB_LOCAL_ID] = 0;
  barrier(CLK_LOCAL_MEM_FENCE);
  for (i = first + TRB_LOCAL_ID; i < end; i += TRB_GROUP) atomic_inc((volatile __local uint *)&counts[TRB_DIGIT(keys[i], shift)]);
  barrier(CLK_LOCAL_MEM_FENCE);
  histograms[TRB_LOCAL_ID * (uint)get_num_groups(0) + TRB_GROUP_ID] = counts[TRB_LOCAL_ID];
}

/* Prefix sums over count values: of each tile; trb_k_scan over those; within each tile. */
TRB_KERNEL trb_k_sum_tiles(const __global uint *values, __global uint *sums, uint count) {
  __local uint space[TRB_GROUP];
  const uint first = TRB_GROUP_ID * TRB_TILE, end = min(count, first + TRB_TILE);
  uint i, sum = 0, total;
  for (i = first + TRB_LOCAL_ID; i < end; i += TRB_GROUP) sum += values[i];
  trb_scan(sum, space, &total);
  if (TRB_LOCAL_ID == 0) sums[TRB_GROUP_ID] = total;
}

TRB_KERNEL trb_k_scan_tiles(__global uint *values, const __global uint *starts, uint count) {
  __local uint space[TRB_GROUP];
  const uint first = TRB_GROUP_ID * TRB_TILE, end = min(count, first + TRB_TILE);
  uint i, start = starts[TRB_GROUP_ID], total;
  for (i = first; i < end; i += TRB_GROUP) {
    const uint mine = i + TRB_LOCAL_ID, value = mine < end ? values[mine] : 0;
    const uint before = trb_scan(value, space, &total);
    if (mine < end) values[mine] = start + before;
    start += total;
  }
}

TRB_KERNEL trb_k_scatter_keys(const __global trb_plan *plan, const __global ulong *keys, const __global uint *starts,
                              __global ulong *sorted, uint shift) {
  __local ulong tile[TRB_TILE];
  __local ushort counts[16 * TRB_GROUP];
  __local uint space[TRB_GROUP], digit_first[256];
  const uint id = TRB_LOCAL_ID, first = TRB_GROUP_ID * TRB_TILE;
  const uint count = first < plan->ref_count ? min(plan->ref_count - first, TRB_TILE) : 0;
  ulong mine[TRB_ITEMS];
  uint i, k, total, half_digit;
  for (i = id; i < TRB_TILE; i += TRB_GROUP) tile[i] = i < count ? keys[first + i] : ~(ulong)0;   /* these stay behind */
  for (half_digit = 0; half_digit < 8; half_digit += 4) {
    uint sum = 0;
    barrier(CLK_LOCAL_MEM_FENCE);
    for (k = 0; k < 16; k++) counts[k * TRB_GROUP + id] = 0;
    for (k = 0; k < TRB_ITEMS; k++) {
      mine[k] = tile[id * TRB_ITEMS + k];
      counts[(TRB_DIGIT(mine[k], shift) >> half_digit & 15) * TRB_GROUP + id]++;
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    for (k = 0; k < 16; k++) sum += counts[id * 16 + k];
    sum = trb_scan(sum, space, &total);
    for (k = 0; k < 16; k++) {
      uint n = counts[id * 16 + k];
      counts[id * 16 + k] = (ushort)sum;
      sum += n;
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    for (k = 0; k < TRB_ITEMS; k++) tile[counts[(TRB_DIGIT(mine[k], shift) >> half_digit & 15) * TRB_GROUP + id]++] = mine[k];
  }
  barrier(CLK_LOCAL_MEM_FENCE);
  for (i = id; i < TRB_TILE; i += TRB_GROUP)
    if (i == 0 || TRB_DIGIT(tile[i], shift) != TRB_DIGIT(tile[i - 1], shift)) digit_first[TRB_DIGIT(tile[i], shift)] = i;
  barrier(CLK_LOCAL_MEM_FENCE);
  for (i = id; i < count; i += TRB_GROUP) {
    const uint digit = TRB_DIGIT(tile[i], shift);
    sorted[starts[digit * (uint)get_num_groups(0) + TRB_GROUP_ID] + i - digit_first[digit]] = tile[i];
  }
}
#endif
