/* What all kernels share: their two shapes, and the few things that work-items do together.
 *
 * On a CPU (TRB_CPU), a work-group is one work-item, which takes TRB_BLOCK elements in a row: a loop over memory that
 * the caches like, and no barriers. On a GPU it is TRB_GROUP work-items side by side. Most kernels read the same for
 * both; those that cannot have two versions. Nothing here needs more than OpenCL C 1.2: work-groups never wait for
 * each other, and what one kernel writes is read by the next one. */
#include "trbvh.h"

#ifdef TRB_CPU
  #define TRB_GROUP 1u
  #define TRB_TILE  TRB_BLOCK                        /* elements in a row that a work-group takes, where order matters */
  #define TRB_SYNC() ((void)0)
#else                                                /* TRB_GPU */
  #define TRB_GROUP TRB_GPU_GROUP
  #define TRB_TILE  TRB_GPU_TILE
  #define TRB_SYNC() barrier(CLK_LOCAL_MEM_FENCE | CLK_GLOBAL_MEM_FENCE)
#endif
#define TRB_KERNEL    __kernel __attribute__((reqd_work_group_size(TRB_GROUP, 1, 1))) void
#define TRB_GROUP_ID  ((uint)get_group_id(0))
#define TRB_LOCAL_ID  ((uint)get_local_id(0))

/* for (i = ...) over all elements below n that are this work-item's, in any order. */
#ifdef TRB_CPU
  #define TRB_FOR(i, n) for (i = TRB_GROUP_ID * TRB_BLOCK; i < (n) && i < (TRB_GROUP_ID + 1) * TRB_BLOCK; i++)
#else
  #define TRB_FOR(i, n) for (i = (uint)get_global_id(0); i < (n); i += (uint)get_global_size(0))
#endif
#ifdef TRB_CPU
/* Heavy jobs, one every TRB_JOB_STEP work-groups, those between being empty: CPU runtimes hand out work-groups in long
 * rows, at first half of them to one of two threads, and few heavy ones would be dealt out unevenly. */
#define TRB_FOR_JOBS(i, n) \
  for (i = TRB_GROUP_ID / TRB_JOB_STEP; TRB_GROUP_ID % TRB_JOB_STEP == 0 && i < (n); \
       i += (uint)get_num_groups(0) / TRB_JOB_STEP)
#endif

/* Sum over the work-items before this one; total: over all. All of the group call it. */
static uint trb_scan(uint value, __local uint *space, uint *total) {
#ifdef TRB_CPU
  *total = value;
  return 0;
#else
  const uint id = TRB_LOCAL_ID;
  uint sum = value, step;
  TRB_SYNC();
  space[id] = value;
  for (step = 1; step < TRB_GROUP; step *= 2) {
    uint before;
    TRB_SYNC();
    before = id >= step ? space[id - step] : 0;
    TRB_SYNC();
    sum += before;
    space[id] = sum;
  }
  TRB_SYNC();
  *total = space[TRB_GROUP - 1];
  return sum - value;
#endif
}

/* The sum over a group; its first work-item gets it. */
static ulong trb_sum_group(ulong mine, __local ulong *space) {
#ifndef TRB_CPU
  uint half_size;
  for (half_size = TRB_GROUP / 2; half_size; half_size /= 2) {
    TRB_SYNC();
    if (TRB_LOCAL_ID >= half_size && TRB_LOCAL_ID < 2 * half_size) space[TRB_LOCAL_ID - half_size] = mine;
    TRB_SYNC();
    if (TRB_LOCAL_ID < half_size) mine += space[TRB_LOCAL_ID];
  }
#endif
  return mine;
}

/* The mesh that a plan tells of. */
static trb_mesh trb_plan_mesh(const __global trb_plan *plan, const __global char *positions, const __global char *indices) {
  trb_mesh mesh;
  mesh.positions = plan->boxes ? 0 : positions + plan->position_offset;
  mesh.boxes = plan->boxes ? positions + plan->position_offset : 0;
  mesh.indices = plan->index_size ? indices + plan->index_offset : 0;
  mesh.position_stride = mesh.box_stride = plan->position_stride;
  mesh.position_count = plan->position_count;
  mesh.index_size = plan->index_size;
  mesh.count = plan->prim_count;
  return mesh;
}

/* Slots of references are gaps where a primitive is invalid, or has used fewer splits than it had. */
static bool trb_has_gaps(const __global trb_plan *plan) { return plan->ref_count != plan->slots; }

/* What the collapse needs to know; keys and sorted are scratch memory by then, for those who need some, as refs is for
 * those who look into leaves. Of a tree that is optimized that is what they hold. */
static trb_collapser trb_plan_collapser(const __global trb_plan *plan, __global trbvh_node *nodes,
                                        const __global trbvh_node *refs, __global ulong *keys, __global ulong *sorted) {
  trb_collapser c;
  c.nodes = nodes;
  c.words = trb_split_words(keys, sorted, plan->ref_max);
  c.costs = plan->costs;
  c.cost_node = plan->cost_node;
  c.cost_prim = plan->cost_prim;
  c.refs = plan->split_max ? refs : 0;
  c.held = plan->optimizes ? (const __global trb_held *)refs : 0;
  c.out = 0;
  c.prims = 0;
  return c;
}

/* The same once the result is allocated. */
static trb_collapser trb_plan_emitter(const __global trb_plan *plan, __global trbvh_node *nodes,
                                      const __global trbvh_node *refs, __global ulong *keys, __global ulong *sorted,
                                      __global trbvh_node *out, __global uint *prims) {
  trb_collapser c = trb_plan_collapser(plan, nodes, refs, keys, sorted);
  c.out = out;
  c.prims = prims;
  return c;
}

/* ---- Lists of nodes by level: the root's is 0 ----
 * They are how a tree is worked on without waiting: every kernel takes one level, whose nodes are independent. The
 * lists stand one after the other; their order within a level is chance, and nothing depends on it. Below the wide
 * levels, which get a launch each, trees are narrow: one work-group takes all that are left. */
/* Makes room for `count` more at *end; returns where. All of the group call it; space: two words. */
static uint trb_reserve(volatile __global uint *end, uint count, __local uint *space) {
#ifdef TRB_CPU
  return count ? atomic_add(end, count) : 0;
#else
  uint at;
  TRB_SYNC();
  if (TRB_LOCAL_ID == 0) space[0] = 0;
  TRB_SYNC();
  at = count ? atomic_add((volatile __local uint *)&space[0], count) : 0;
  TRB_SYNC();
  if (TRB_LOCAL_ID == 0) space[1] = atomic_add(end, space[0]);
  TRB_SYNC();
  return at + space[1];
#endif
}
