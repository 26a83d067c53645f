/* Moves (trbvh.h, >>moves): reinsertion, and splits taken back. The tree stands still while a batch is searched for, and
 * one kernel's writes are the next one's to read, so every kernel may take the moves in any order. Memory as in C: the
 * words of keys and sorted, for parents, moves, owners, scores. */
#include "shape.cl"

static trb_mover trb_plan_mover(const __global trb_plan *plan, __global trbvh_node *nodes, __global trbvh_node *refs,
                                __global ulong *keys, __global ulong *sorted) {
  return trb_start_moves(nodes, plan->split_max ? refs : 0, trb_split_words(keys, sorted, plan->ref_max), plan->costs);
}

/* A tree that was too deep to be made anew is not looked at again: its counts are wrong. */
static uint trb_move_count(const __global trb_plan *plan) { return plan->too_deep ? 0 : plan->moves; }

/* ---- Candidates ---- */
/* histograms: on a CPU one for each work-group, else one, which was zero. */
TRB_KERNEL trb_k_score(const __global trb_plan *plan, __global trbvh_node *nodes, __global ulong *keys,
                       __global ulong *sorted, __global uint *histograms) {
  const trb_mover m = trb_plan_mover(plan, nodes, 0, keys, sorted);
  const uint count = plan->ref_count;
  uint i;
#ifdef TRB_CPU
  __global uint *histogram = histograms + (size_t)TRB_GROUP_ID * TRB_SCORES;
  for (i = 0; i < TRB_SCORES; i++) histogram[i] = 0;
  TRB_FOR(i, count) {
    uint scores;
    if (i == 0) continue;                            /* the root's pair has no other node */
    scores = trb_score_pair(&m, i);
    histogram[scores >> 16]++;
    histogram[scores & 0xFFFFu]++;
  }
#else
  __local uint histogram[TRB_SCORES];
  for (i = TRB_LOCAL_ID; i < TRB_SCORES; i += TRB_GROUP) histogram[i] = 0;
  TRB_SYNC();
  TRB_FOR(i, count) {
    uint scores;
    if (i == 0) continue;
    scores = trb_score_pair(&m, i);
    if (scores >> 16) atomic_inc((volatile __local uint *)&histogram[scores >> 16]);         /* 0 is never asked for */
    if (scores & 0xFFFFu) atomic_inc((volatile __local uint *)&histogram[scores & 0xFFFFu]);
  }
  TRB_SYNC();
  for (i = TRB_LOCAL_ID; i < TRB_SCORES; i += TRB_GROUP)
    if (histogram[i]) atomic_add((volatile __global uint *)&histograms[i], histogram[i]);
#endif
  if (get_global_id(0) == 0 && count) m.parents[0] = m.parents[nodes[0].first / 2] = 0;
}

/* One work-item is enough. */
TRB_KERNEL trb_k_choose_score(__global trb_plan *plan, __global uint *histograms) {
  const uint wanted = (uint)(plan->reinsert_share * (float)plan->ref_count);
#ifdef TRB_CPU
  const uint blocks = plan->ref_count ? (plan->ref_count - 1) / TRB_BLOCK + 1 : 0;
  uint block, i;
  for (block = 1; block < blocks; block++)
    for (i = 0; i < TRB_SCORES; i++) histograms[i] += histograms[(size_t)block * TRB_SCORES + i];
#endif
  if (TRB_LOCAL_ID == 0) plan->lowest_score = trb_lowest_score(histograms, wanted);
}

/* How many candidates each tile of pairs has. */
TRB_KERNEL trb_k_count_candidates(const __global trb_plan *plan, __global trbvh_node *nodes, __global ulong *keys,
                                  __global ulong *sorted, __global uint *counts) {
  __local uint space[TRB_GROUP];
  const trb_mover m = trb_plan_mover(plan, nodes, 0, keys, sorted);
  const uint first = TRB_GROUP_ID * TRB_TILE, end = min(plan->ref_count, first + TRB_TILE), lowest = plan->lowest_score;
  uint i, count = 0, total;
  for (i = first + TRB_LOCAL_ID; i < end; i += TRB_GROUP)
    if (i) count += trb_count_candidates(&m, i, i + 1, lowest);
  trb_scan(count, space, &total);
  if (TRB_LOCAL_ID == 0) counts[TRB_GROUP_ID] = total;
}

/* In the order of their places in the tree, as there may not be room for all. */
TRB_KERNEL trb_k_list_candidates(__global trb_plan *plan, __global trbvh_node *nodes, __global ulong *keys,
                                 __global ulong *sorted, const __global uint *starts) {
  __local uint space[TRB_GROUP];
  const trb_mover m = trb_plan_mover(plan, nodes, 0, keys, sorted);
  const uint first = TRB_GROUP_ID * TRB_TILE, end = min(plan->ref_count, first + TRB_TILE), lowest = plan->lowest_score;
  const uint most = TRB_MOVES_MAX(plan->ref_count);
  uint i, start = starts[TRB_GROUP_ID], total;
  for (i = first; i < end; i += TRB_GROUP) {
    const uint pair = i + TRB_LOCAL_ID;
    const uint count = pair && pair < end ? trb_count_candidates(&m, pair, pair + 1, lowest) : 0;
    const uint at = start + trb_scan(count, space, &total);
    if (count) trb_list_candidates(&m, pair, pair + 1, lowest, at, most);
    start += total;
  }
  if (TRB_LOCAL_ID == 0 && TRB_GROUP_ID == (uint)get_num_groups(0) - 1) plan->moves = min(start, most);
}

/* ---- What a tree costs ---- */
/* One sum for each work-group. */
TRB_KERNEL trb_k_sum_costs(const __global trb_plan *plan, const __global trbvh_node *nodes, __global ulong *sums) {
  __local ulong space[TRB_GROUP];
  const trb_costs costs = plan->costs;
  const float unit = plan->ref_count ? trb_cost_unit(nodes[0], costs) : 0;
  const uint count = plan->ref_count;
  ulong sum = 0;
  uint i;
  TRB_FOR(i, count)
    if (i) sum += trb_pair_cost(nodes, i, unit, costs);        /* the root's pair has no other node */
  sum = trb_sum_group(sum, space);
  if (TRB_LOCAL_ID == 0) sums[TRB_GROUP_ID] = sum;
}

/* One work-group. */
TRB_KERNEL trb_k_add_costs(__global trb_plan *plan, const __global ulong *sums, uint count) {
  __local ulong space[TRB_GROUP];
  ulong sum = 0;
  uint i;
  for (i = TRB_LOCAL_ID; i < count; i += TRB_GROUP) sum += sums[i];
  sum = trb_sum_group(sum, space);
  if (TRB_LOCAL_ID == 0) plan->cost = sum;
}

/* ---- The best move of each candidate ---- */
TRB_KERNEL trb_k_search(const __global trb_plan *plan, __global trbvh_node *nodes, __global ulong *keys,
                        __global ulong *sorted, uint batch) {
  const trb_mover m = trb_plan_mover(plan, nodes, 0, keys, sorted);
  const uint count = trb_move_count(plan);
  const float least = trb_least_gain(plan->lowest_score);
#ifdef TRB_CPU
  uint job, i;
  TRB_FOR_JOBS(job, (count + TRB_SEARCHES - 1) / TRB_SEARCHES) {
    const uint end = min(count, (job + 1) * TRB_SEARCHES);
    for (i = job * TRB_SEARCHES; i < end; i++) {
      trb_search(&m, i, batch, least);
    }
  }
#else
  uint four, i;                                      /* of four neighbours one is due: neighbouring work-items' together */
  TRB_FOR(four, (count + TRB_MOVE_BATCHES - 1) / TRB_MOVE_BATCHES)
    for (i = four * TRB_MOVE_BATCHES; i < count && i < (four + 1) * TRB_MOVE_BATCHES; i++) trb_search(&m, i, batch, least);
#endif
}

/* Begins the search for splits to be taken back: no reference is known to be anywhere. */
TRB_KERNEL trb_k_forget_refs(__global trb_plan *plan, __global trbvh_node *refs) {
  const uint slots = plan->slots;
  uint i;
  TRB_FOR(i, slots) refs[i].count = TRBVH_NONE;
  if (get_global_id(0) == 0) plan->moves = TRB_MOVES_MAX(slots);
}

TRB_KERNEL trb_k_find_refs(const __global trb_plan *plan, __global trbvh_node *nodes, __global trbvh_node *refs,
                           __global ulong *keys, __global ulong *sorted) {
  const trb_mover m = trb_plan_mover(plan, nodes, refs, keys, sorted);
  const uint count = plan->too_deep ? 0 : plan->ref_count;
  uint i;
  TRB_FOR(i, count) {
    trb_find_ref(&m, 2 * i);
    trb_find_ref(&m, 2 * i + 1);
  }
}

TRB_KERNEL trb_k_search_merges(const __global trb_plan *plan, __global trbvh_node *nodes, __global trbvh_node *refs,
                               __global ulong *keys, __global ulong *sorted, uint batch) {
  const trb_mover m = trb_plan_mover(plan, nodes, refs, keys, sorted);
  const uint count = trb_move_count(plan), slots = plan->slots;
  uint i;
#ifdef TRB_CPU
  uint job;
  TRB_FOR_JOBS(job, (count + TRB_SEARCHES - 1) / TRB_SEARCHES)
    for (i = job * TRB_SEARCHES; i < count && i < (job + 1) * TRB_SEARCHES; i++)
      m.moves[i] = trb_search_merge(&m, i * TRB_MOVE_BATCHES + batch, slots);
#else
  TRB_FOR(i, count) m.moves[i] = trb_search_merge(&m, i * TRB_MOVE_BATCHES + batch, slots);
#endif
}

/* ---- Conflicts, and the moves ---- */
#ifdef TRB_CPU
/* One work-item. merges: splits are taken back. */
TRB_KERNEL trb_k_move(const __global trb_plan *plan, __global trbvh_node *nodes, __global trbvh_node *refs,
                      __global ulong *keys, __global ulong *sorted, uint merges) {
  const trb_mover m = trb_plan_mover(plan, nodes, refs, keys, sorted);
  const uint count = trb_move_count(plan);
  uint i;
  trb_choose_moves(&m, count);
  for (i = 0; i < count; i++) trb_make_move(&m, i, merges);
  trb_remake_moved(&m, count);
}
#else
/* A pair's owner is found in two passes, for want of 64-bit atomics: the largest gain, which as bits is in the same
 * order; the first of the moves that have it. gains: by pair, 0 outside of a batch. */
TRB_KERNEL trb_k_claim_gains(const __global trb_plan *plan, __global trbvh_node *nodes, __global ulong *keys,
                             __global ulong *sorted, __global uint *gains) {
  const trb_mover m = trb_plan_mover(plan, nodes, 0, keys, sorted);
  const uint count = trb_move_count(plan);
  uint i, k, pairs[3];
  TRB_FOR(i, count) {
    const trb_move move = m.moves[i];
    if (!(move.gain > 0)) continue;
    trb_touched_pairs(&m, move, pairs);
    for (k = 0; k < 3; k++) atomic_max((volatile __global uint *)&gains[pairs[k]], as_uint(move.gain));
  }
}

TRB_KERNEL trb_k_claim_pairs(const __global trb_plan *plan, __global trbvh_node *nodes, __global ulong *keys,
                             __global ulong *sorted, const __global uint *gains) {
  const trb_mover m = trb_plan_mover(plan, nodes, 0, keys, sorted);
  const uint count = trb_move_count(plan);
  uint i, k, pairs[3];
  TRB_FOR(i, count) {
    const trb_move move = m.moves[i];
    if (!(move.gain > 0)) continue;
    trb_touched_pairs(&m, move, pairs);
    for (k = 0; k < 3; k++)
      if (gains[pairs[k]] == as_uint(move.gain)) atomic_min((volatile __global uint *)&m.owners[pairs[k]], i);
  }
}

TRB_KERNEL trb_k_stand_back(const __global trb_plan *plan, __global trbvh_node *nodes, __global ulong *keys,
                            __global ulong *sorted) {
  const trb_mover m = trb_plan_mover(plan, nodes, 0, keys, sorted);
  const uint count = trb_move_count(plan);
  uint i;
  TRB_FOR(i, count)
    if (m.moves[i].gain > 0 && !trb_owns(&m, i)) m.moves[i].gain = -m.moves[i].gain;
}

/* Marks those that stay; they count like others meanwhile. Not called for merges, which move no subtree. */
TRB_KERNEL trb_k_follow(const __global trb_plan *plan, __global trbvh_node *nodes, __global ulong *keys,
                        __global ulong *sorted) {
  const trb_mover m = trb_plan_mover(plan, nodes, 0, keys, sorted);
  const uint count = trb_move_count(plan);
  uint i;
  TRB_FOR(i, count)
    if (m.moves[i].gain > 0 && trb_follows(&m, i)) m.moves[i].node |= TRB_STAYS;
}

TRB_KERNEL trb_k_release(const __global trb_plan *plan, __global trbvh_node *nodes, __global ulong *keys,
                         __global ulong *sorted, __global uint *gains) {
  const trb_mover m = trb_plan_mover(plan, nodes, 0, keys, sorted);
  const uint count = trb_move_count(plan);
  uint i, k, pairs[3];
  TRB_FOR(i, count) {
    trb_move move = m.moves[i];
    if (move.gain == 0) continue;
    if (move.node & TRB_STAYS) {
      move.node &= ~TRB_STAYS;
      move.gain = -move.gain;
      m.moves[i] = move;
    }
    trb_touched_pairs(&m, move, pairs);
    for (k = 0; k < 3; k++) {
      m.owners[pairs[k]] = TRBVH_NONE;
      gains[pairs[k]] = 0;
    }
  }
}

/* No two touch the same pair. merges: splits are taken back. */
TRB_KERNEL trb_k_move(const __global trb_plan *plan, __global trbvh_node *nodes, __global trbvh_node *refs,
                      __global ulong *keys, __global ulong *sorted, uint merges) {
  const trb_mover m = trb_plan_mover(plan, nodes, refs, keys, sorted);
  const uint count = trb_move_count(plan);
  uint i;
  TRB_FOR(i, count) trb_make_move(&m, i, merges);
}

/* All inner nodes, listed by level: what is the same again gets the same bits. */
TRB_KERNEL trb_k_remake_level(const __global trb_plan *plan, __global trbvh_node *nodes, const __global trb_level *levels,
                              const __global uint *list, uint level) {
  const trb_costs costs = plan->costs;
  const uint first = levels[level].first, count = levels[level].count;
  uint i;
  TRB_FOR(i, count) trb_remake(nodes, list[first + i], costs);
}

/* One work-group: all levels from the lowest one up to `level`. */
TRB_KERNEL trb_k_remake_levels(const __global trb_plan *plan, __global trbvh_node *nodes, const __global trb_level *levels,
                               const __global uint *list, uint level) {
  const trb_costs costs = plan->costs;
  uint lowest = level, i;
  while (lowest + 1 < TRB_GPU_LEVELS && levels[lowest + 1].count) lowest++;
  for (lowest++; lowest-- > level;) {
    for (i = TRB_LOCAL_ID; i < levels[lowest].count; i += TRB_GROUP)
      trb_remake(nodes, list[levels[lowest].first + i], costs);
    TRB_SYNC();
  }
}
#endif
