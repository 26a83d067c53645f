/* hlbvh.h - HLBVH (Pantaleoni and Luebke 2010; Garanzha, Pantaleoni and McAllister 2011, "Simpler and Faster
 * HLBVH with Work Queues").
 *
 * References whose Morton codes begin with the same 15 bits, those of one cell of 32 x 32 x 32, are a
 * cluster, and a linear BVH. Above the clusters stands a tree by the surface area heuristic: at each node,
 * clusters are binned by the centres of their boxes along the three axes, and it is split between two bins
 * so that A(left) N(left) + A(right) N(right) is least; clusters that are all in one bin are halved by their
 * order.
 *
 * N counts clusters, as where others have built it (pbrt's HLBVH does), and not their references, with which
 * SAH is 1.6 % higher (13 meshes).
 */
#ifndef PAPER_HLBVH_H
#define PAPER_HLBVH_H
#include "paper.h"

enum { PAPER_CLUSTER_BITS = 15, PAPER_SAH_BINS = 32 };   /* hippie's, by the author of PLOC, for HLBVH */

/* What the tree at the top is built over: a cluster or (grid.h) a cell. */
typedef struct paper_cell {
  trbvh_node    node;
  uint32_t      count;                 /* what the heuristic counts */
  uint32_t      slot;                  /* where the node has been put */
  unsigned char bin[3];
} paper_cell;
typedef struct paper_bin { trbvh_node box; uint32_t count; float right_area; } paper_bin;   /* from here on */
typedef struct paper_bin_plane { double cost, balance; int axis; uint32_t bin; } paper_bin_plane;   /* left of bin */

static inline void paper_bin_plane_of_axis(const paper_cell *cells, uint32_t count, int axis, paper_bin_plane *best)
{
  paper_bin bins[PAPER_SAH_BINS];
  uint32_t low = PAPER_SAH_BINS, high = 0, right = 0;
  for (uint32_t i = 0; i < count; i++) {
    low = TRB_MIN(cells[i].bin[axis], low);
    high = TRB_MAX(cells[i].bin[axis], high);
  }
  for (uint32_t i = low; i <= high; i++) bins[i].count = 0;
  for (uint32_t i = 0; i < count; i++) {
    paper_bin *bin = &bins[cells[i].bin[axis]];
    bin->box = bin->count ? paper_union(bin->box, &cells[i].node) : cells[i].node;
    bin->count += cells[i].count;
  }
  trbvh_node box = trb_no_box();
  for (uint32_t i = high; i > low; i--) {
    if (bins[i].count == 0) continue;
    box = paper_union(box, &bins[i].box);
    bins[i].right_area = trb_area(box);
    right += bins[i].count;
  }
  box = bins[low].box;
  uint32_t left = bins[low].count;
  for (uint32_t i = low + 1; i <= high; i++) {
    if (bins[i].count == 0) continue;  /* the next plane parts nothing else */
    double nl = left, nr = right, balance = nl * nl + nr * nr;
    double cost = trb_area(box) * nl + bins[i].right_area * nr;
    if (cost < best->cost || (cost == best->cost && balance < best->balance)) {
      *best = (paper_bin_plane){cost, balance, axis, i};
    }
    box = paper_union(box, &bins[i].box);
    left += bins[i].count;
    right -= bins[i].count;
  }
}
/* Parts the cells, in their order on either side, and returns how many are on the left. */
static inline uint32_t paper_part_cells(paper_cell *cells, uint32_t count, paper_cell *spare)
{
  paper_bin_plane best = {DBL_MAX, DBL_MAX, -1, 0};
  uint32_t left = 0, right = 0;
  for (int axis = 0; axis < 3 && count > 2; axis++) paper_bin_plane_of_axis(cells, count, axis, &best);
  if (best.axis < 0) return count / 2;
  for (uint32_t i = 0; i < count; i++) {
    if (cells[i].bin[best.axis] >= best.bin) spare[right++] = cells[i];
    else cells[left++] = cells[i];
  }
  memcpy(cells + left, spare, right * sizeof *cells);
  return left;
}
/* The tree over cells, at the node `slot`; spare: room for count. paper_fit has to follow. With `place`, it
 * gives the cells of each node their bins, which else stand. */
typedef void paper_placer(paper_cell *cells, uint32_t count);
static inline void paper_build_cells(paper_build *p, paper_cell *cells, uint32_t count, paper_cell *spare,
                                     uint32_t slot, paper_placer *place)
{
  struct { paper_cell *cells; uint32_t count, slot; } stack[64], now = {cells, count, slot};
  uint32_t waiting = 0;
  for (;;) {
    if (now.count == 1) {
      p->nodes[now.slot] = now.cells->node;
      now.cells->slot = now.slot;
      if (waiting == 0) return;
      now = stack[--waiting];
      continue;
    }
    if (place) place(now.cells, now.count);
    uint32_t first = paper_new_pair(p);
    uint32_t left = paper_part_cells(now.cells, now.count, spare), right = now.count - left;
    paper_set_inner(p, now.slot, first);
    uint32_t left_waits = left > right;   /* the larger part does, so that the stack stays low */
    stack[waiting].cells = now.cells + (left_waits ? 0 : left);
    stack[waiting].count = left_waits ? left : right;
    stack[waiting++].slot = first + !left_waits;
    now.cells += left_waits ? left : 0;
    now.count = left_waits ? right : left;
    now.slot = first + left_waits;
  }
}

static inline float paper_center(const trbvh_node *box, int axis)
{
  return 0.5f * box->min[axis] + 0.5f * box->max[axis];
}
static inline void paper_bin_centers(paper_cell *cells, uint32_t count)
{
  for (int axis = 0; axis < 3; axis++) {
    float low = FLT_MAX, high = -FLT_MAX, last = PAPER_SAH_BINS - 1;
    for (uint32_t i = 0; i < count; i++) {
      float center = paper_center(&cells[i].node, axis);
      low = TRB_MIN(center, low);
      high = TRB_MAX(center, high);
    }
    float bins_per_unit = PAPER_SAH_BINS / (high - low);
    for (uint32_t i = 0; i < count; i++) {
      float bin = (paper_center(&cells[i].node, axis) - low) * bins_per_unit;
      cells[i].bin[axis] = (unsigned char)TRB_MIN(bin, last);   /* NaN, where extents vanish, too */
    }
  }
}
/* A node of the radix tree: within a cluster that of its two children, above it nothing. */
static inline uint32_t paper_join_within(paper_build *p, uint32_t begin, uint32_t end, uint64_t split)
{
  uint64_t cluster = (uint64_t)1 << 63 | (uint64_t)1 << (paper_code_bits(p) - PAPER_CLUSTER_BITS);
  if (split >= cluster) return end;
  p->refs[begin] = paper_join(p, p->refs[begin], p->refs[begin + 1]);
  return begin + 1;
}
static inline void paper_hlbvh(paper_build *p)
{
  uint64_t *codes = paper_sort_refs(p);
  uint32_t count = paper_climb(p, codes, paper_join_within);
  paper_cell *cells = (paper_cell *)ex_allocate(count, sizeof *cells);
  paper_cell *spare = (paper_cell *)ex_allocate(count, sizeof *spare);
  for (uint32_t i = 0; i < count; i++) {
    cells[i].node = p->refs[i];
    cells[i].count = 1;
  }
  paper_build_cells(p, cells, count, spare, 0, paper_bin_centers);
  paper_fit(p);
  free(spare);
  free(cells);
  free(codes);
}

#endif
