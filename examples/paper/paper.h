/* paper.h - what the builders in this folder share.
 *
 * Each of them is one function, in a file of its own, that makes a binary tree in the form in which trbvh.h builds: it
 * gets references, one box for each triangle, and leaves nodes. Everything before and after that is trbvh's own:
 * reading the mesh, the collapse into leaves, the layout, the triangles. So trees differ by their topology alone, and
 * trbvh_validate, trbvh_sah and the queries judge them all alike.
 *
 * Include it after trbvh.h's implementation: it uses functions that are the library's own business, which a program
 * that is not shipped with it should not.
 */
#ifndef PAPER_H
#define PAPER_H

#include "../common.h"

/* nodes[0] is the root, nodes[1] is not used; pair i of siblings is nodes[2 * i] and nodes[2 * i + 1]. A node holds its
 * box; `first`, of an inner node its left child, of a leaf the primitive; and in `count` what trb_parent and
 * trb_reference put there. All trees are built down to single references. */
typedef struct paper_build {
  trb_build   lib;                     /* trbvh's own state: geometry, options, costs, grid, stats */
  trbvh_node *refs;                    /* ref_max of them, ready to be leaves; builders may reorder and split them */
  trbvh_node *nodes;                   /* 2 * ref_max + 2 */
  uint32_t    ref_count, ref_max;      /* ref_max: with the budget for splits */
  uint32_t    pair_end;                /* the next pair that is free, from 1 */
  const void *parameters;              /* the builder's */
} paper_build;

/* Makes nodes from refs, of which there are two at least, and sets ref_count where it splits. */
typedef void paper_builder(paper_build *p);

static inline uint32_t paper_new_pair(paper_build *p) { return 2 * p->pair_end++; }

/* The box around a and b; what else is in it is a's. */
static inline trbvh_node paper_union(trbvh_node a, const trbvh_node *b)
{
  a.min[0] = TRB_MIN(b->min[0], a.min[0]); a.max[0] = TRB_MAX(b->max[0], a.max[0]);
  a.min[1] = TRB_MIN(b->min[1], a.min[1]); a.max[1] = TRB_MAX(b->max[1], a.max[1]);
  a.min[2] = TRB_MIN(b->min[2], a.min[2]); a.max[2] = TRB_MAX(b->max[2], a.max[2]);
  return a;
}
/* The parent of the pair at `first`, where it stands. */
static inline trbvh_node paper_parent(const paper_build *p, uint32_t first)
{
  return trb_parent(p->nodes[first], p->nodes[first + 1], first, p->lib.costs);
}
/* For builders from the top down, which know only `first` of an inner node and have set its count to 0: makes all of
 * them, children first. Pairs must have been taken parents first. */
static inline void paper_fit(paper_build *p)
{
  for (uint32_t i = 2 * p->pair_end; i-- > 0;) {
    if (i != 1 && p->nodes[i].count == 0) p->nodes[i] = paper_parent(p, p->nodes[i].first);
  }
}
static inline int paper_is_leaf(const trbvh_node *n) { return trb_is_single(n->count); }
static inline void paper_set_inner(paper_build *p, uint32_t slot, uint32_t first)   /* until paper_fit */
{
  p->nodes[slot].first = first;
  p->nodes[slot].count = 0;
}
/* For builders from the bottom up: makes l and r siblings, and returns their parent, which has no place yet. What
 * is left of all goes to nodes[0]. */
static inline trbvh_node paper_join(paper_build *p, trbvh_node l, trbvh_node r)
{
  uint32_t first = paper_new_pair(p);
  p->nodes[first] = l;
  p->nodes[first + 1] = r;
  return trb_parent(l, r, first, p->lib.costs);
}
/* A reference with another box. */
static inline trbvh_node paper_reference(const paper_build *p, trbvh_node box, uint32_t prim)
{
  box.first = prim;
  return trb_reference(box, p->lib.costs);
}

/* Sorts keys by their highest `bits` bits, and leaves equal ones as they are. */
static inline void paper_sort(uint64_t *keys, uint32_t count, uint32_t bits)
{
  enum { DIGITS = 2048 };
  uint64_t *other = (uint64_t *)ex_allocate(count, sizeof *other), *from = keys, *to = other;
  uint32_t *next = (uint32_t *)ex_allocate(DIGITS, sizeof *next);
  for (uint32_t shift = 64 - bits; shift < 64; shift += 11) {
    uint32_t sum = 0;
    memset(next, 0, DIGITS * sizeof *next);
    for (uint32_t i = 0; i < count; i++) next[from[i] >> shift & (DIGITS - 1)]++;
    for (uint32_t i = 0; i < DIGITS; i++) {
      uint32_t here = next[i];
      next[i] = sum;
      sum += here;
    }
    for (uint32_t i = 0; i < count; i++) to[next[from[i] >> shift & (DIGITS - 1)]++] = from[i];
    uint64_t *swap = from;
    from = to;
    to = swap;
  }
  if (from != keys) memcpy(keys, from, count * sizeof *keys);
  free(next);
  free(other);
}
/* A float's bits as an integer that sorts as the float does; -0 below +0. */
static inline uint32_t paper_sortable(float x)
{
  uint32_t bits = trb_bits(x);
  return bits >> 31 ? ~bits : bits | 0x80000000u;
}

static inline uint32_t paper_code_bits(const paper_build *p)
{
  return p->lib.key_form.packed ? p->lib.key_form.bits : 63;
}
/* Puts the references in the order of trbvh's Morton codes, and returns these, paper_code_bits long. The caller frees
 * them. Equal ones stay in the order of the references. */
static inline uint64_t *paper_sort_refs(paper_build *p)
{
  uint64_t *keys = (uint64_t *)ex_allocate(p->ref_count, sizeof *keys);
  trbvh_node *sorted = (trbvh_node *)ex_allocate(p->ref_count, sizeof *sorted);
  uint32_t count = p->ref_count, bits = paper_code_bits(p);
  uint64_t *codes = (uint64_t *)ex_allocate(count, sizeof *codes);
  uint32_t low = trb_log2(count) + 1;  /* bits of a reference's number */
  for (uint32_t i = 0; i < count; i++) codes[i] = trb_box_code(p->refs[i], p->lib.grid) >> (63 - bits);
  /* Two sorts where code and number do not fit into one key. */
  if (bits + low <= 64) {
    for (uint32_t i = 0; i < count; i++) keys[i] = codes[i] << (64 - bits) | i;
    paper_sort(keys, count, bits);
  } else {
    for (uint32_t i = 0; i < count; i++) keys[i] = (codes[i] & 0x7FFFFFFF) << 33 | i;
    paper_sort(keys, count, 31);
    for (uint32_t i = 0; i < count; i++) {
      uint32_t ref = (uint32_t)keys[i];
      keys[i] = codes[ref] >> 31 << 32 | ref;
    }
    paper_sort(keys, count, 32);
  }
  for (uint32_t i = 0; i < count; i++) {
    uint32_t ref = (uint32_t)(keys[i] & (((uint64_t)1 << low) - 1));
    sorted[i] = p->refs[ref];
    keys[i] = codes[ref];
  }
  memcpy(p->refs, sorted, count * sizeof *sorted);
  free(sorted);
  free(codes);
  return keys;
}

/* Goes through the binary radix tree over the sorted references (Karras 2012), children before parents. Each node
 * takes over what its children have left, refs[begin..end - 1]; `reduce` puts what that becomes at begin, and
 * returns its end. `split` is what parts the children, larger nearer to the root: the exclusive or of the codes on
 * either side with bit 63 set, or, of equal codes, that of the references' places. Returns the end of what the
 * root has left. */
typedef uint32_t paper_reducer(paper_build *p, uint32_t begin, uint32_t end, uint64_t split);
static inline uint64_t paper_split_after(const paper_build *p, const uint64_t *codes, uint32_t i)
{
  if (i + 1 == p->ref_count) return UINT64_MAX;
  uint64_t code = codes[i] ^ codes[i + 1];
  return code ? code | (uint64_t)1 << 63 : i ^ (i + 1);
}
static inline uint32_t paper_climb(paper_build *p, const uint64_t *codes, paper_reducer *reduce)
{
  struct { uint64_t split; uint32_t begin; } stack[96];   /* subtrees that wait for what is right of them */
  uint32_t waiting = 0, end = 0;
  for (uint32_t i = 0; i < p->ref_count; i++) {
    uint64_t split = paper_split_after(p, codes, i);
    uint32_t begin = end;
    p->refs[end++] = p->refs[i];
    while (waiting && stack[waiting - 1].split <= split) {
      begin = stack[--waiting].begin;
      end = reduce(p, begin, end, stack[waiting].split);
    }
    stack[waiting].split = split;
    stack[waiting++].begin = begin;
  }
  return end;
}

/* trbvh's own linear BVH over the references, a builder like the others: what builders that split use, and those that
 * improve a tree. Leaves the references as they are. */
static inline void paper_lbvh(paper_build *p)
{
  trb_build *b = &p->lib;
  trbvh_node *own_refs = b->refs;
  uint32_t per_block = trb_blocks(p->ref_count, b->block_count), start = 0;
  b->refs = p->refs;
  b->ref_count = p->ref_count;
  b->guessed = 0;
  for (uint32_t i = 0; i < b->block_count; i++) {
    trb_block *block = &b->blocks[i];
    block->start = start;
    block->slots = block->refs = p->ref_count - start < per_block ? p->ref_count - start : per_block;
    start += block->slots;
  }
  trb_make_keys(b);
  trb_sort_keys(b);
  trb_build_hierarchy(b);
  for (uint32_t i = 0; i < 2 * p->ref_count; i++)    /* the library's leaves hold references, ours primitives */
    if (i != 1 && trb_is_single(p->nodes[i].count)) p->nodes[i].first = p->refs[p->nodes[i].first].first;
  b->refs = own_refs;
  p->pair_end = p->ref_count;
}

static inline void paper_read_refs(paper_build *p)
{
  const trb_build *b = &p->lib;
  for (uint32_t i = 0; i < b->input.count; i++) {
    float v[3][3];
    uint32_t vertex;
    trbvh_node box;
    if (trb_prim_box(&b->input, i, &box, v, &vertex) == 1) p->refs[p->ref_count++] = paper_reference(p, box, i);
  }
}

/* Builds with one of these builders, as trbvh_build does with its own. Of the options, split_budget is the room for
 * splits, as a share of the triangles; treelet_rounds, 0 for none, are run on what the builder made. references, which
 * may be NULL: how many it made, before leaves merge those of one triangle. */
static inline trbvh_result paper_make(trbvh *bvh, const trbvh_geometry *geometry, const trbvh_options *options,
                                      paper_builder *builder, const void *parameters, uint32_t *references)
{
  paper_build p;
  trbvh_options o = *options;
  double start = ex_now_ms();
  memset(&p, 0, sizeof p);
  o.quality = TRBVH_QUALITY_FAST;      /* nothing that is not asked for */
  trbvh_result result = trb_resolve(&p.lib, geometry, &o);
  trb_build *b = &p.lib;
  b->final = 0;
  trb_runner_start(&b->runner, &b->options, 1);
  if (!result && b->input.count) result = trb_allocate_scratch(b);
  trb_start_attempt(b, b->split_max > 0);
  if (!result && b->input.count) result = trb_read(b);
  if (!result && b->ref_count) {
    p.ref_max = b->ref_max;
    p.refs = (trbvh_node *)ex_allocate(p.ref_max, sizeof *p.refs);
    p.nodes = b->nodes;
    p.pair_end = 1;
    p.parameters = parameters;
    paper_read_refs(&p);
    if (p.ref_count == 1) p.nodes[0] = p.refs[0];
    else builder(&p);
    for (uint32_t i = 0; b->refs && i < b->input.count; i++) b->refs[i].first = i;     /* leaves hold primitives here */
    b->ref_count = p.ref_count;
    b->stats.ms_hierarchy = ex_now_ms() - start;
    trb_start_phase(b, 0);
    result = trb_restructure_and_settle(b);
    b->stats.ms_treelets = ex_now_ms() - start - b->stats.ms_hierarchy;
    if (!result) result = trb_emit(b, bvh);
    if (!result) result = trb_finish(b);
    free(p.refs);
  }
  trb_free_scratch(b);
  trb_runner_stop(&b->runner);
  if (result) trbvh_free(bvh);
  else trb_hand_over(b, bvh, b->input.count);
  b->stats.ms_total = ex_now_ms() - start;
  if (options->stats) *options->stats = b->stats;
  if (references) *references = b->ref_count;
  return result;
}

#endif
