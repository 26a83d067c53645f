/* sweep.h - SweepSAH: the full sweep (MacDonald and Booth 1990), what the paper's first table is relative to.
 *
 * At each node all partitions by the centres of the boxes along the three axes are tried, and the one of least
 * A(left) N(left) + A(right) N(right) is taken, of equal ones the more balanced. References are sorted once, and the
 * orders partitioned with them (Wald and Havran 2006): O(n log n).
 */
#ifndef PAPER_SWEEP_H
#define PAPER_SWEEP_H
#include "paper.h"

typedef struct paper_sweeper {
  paper_build   *p;
  uint32_t      *order[3], *spare;     /* references by centre, ties by their number; room for one order */
  float         *right_area;           /* of what comes from here on */
  unsigned char *goes_right;           /* by reference */
} paper_sweeper;
typedef struct paper_cut { double cost, balance; int axis; uint32_t left; } paper_cut;   /* left: references there */

/* Sorts as the centre of a reference's box does, and of equal ones as their numbers do. */
static inline uint64_t paper_center_key(const paper_build *p, uint32_t ref, int axis)
{
  const trbvh_node *box = &p->refs[ref];
  return (uint64_t)paper_sortable(0.5f * box->min[axis] + 0.5f * box->max[axis]) << 32 | ref;
}
static inline void paper_sort_centers(paper_sweeper *s)
{
  uint32_t count = s->p->ref_count;
  uint64_t *keys = (uint64_t *)ex_allocate(count, sizeof *keys);
  for (int axis = 0; axis < 3; axis++) {
    for (uint32_t i = 0; i < count; i++) keys[i] = paper_center_key(s->p, i, axis);
    paper_sort(keys, count, 32);
    for (uint32_t i = 0; i < count; i++) s->order[axis][i] = (uint32_t)keys[i];
  }
  free(keys);
}
static inline paper_cut paper_best_cut(paper_sweeper *s, uint32_t begin, uint32_t end)
{
  paper_cut best = {DBL_MAX, DBL_MAX, 0, (end - begin) / 2};
  for (int axis = 0; axis < 3; axis++) {
    const uint32_t *order = s->order[axis];
    const trbvh_node *refs = s->p->refs;
    trbvh_node box = trb_no_box();
    for (uint32_t i = end; i-- > begin;) {
      box = paper_union(box, &refs[order[i]]);
      s->right_area[i] = trb_area(box);
    }
    box = trb_no_box();
    for (uint32_t i = begin + 1; i < end; i++) {
      box = paper_union(box, &refs[order[i - 1]]);
      double left = i - begin, right = end - i, cost = trb_area(box) * left + s->right_area[i] * right;
      double balance = left * left + right * right;
      if (cost < best.cost || (cost == best.cost && balance < best.balance)) {
        best = (paper_cut){cost, balance, axis, i - begin};
      }
    }
  }
  return best;
}
static inline void paper_partition(paper_sweeper *s, uint32_t begin, uint32_t end, paper_cut cut)
{
  for (uint32_t i = begin; i < end; i++) s->goes_right[s->order[cut.axis][i]] = i - begin >= cut.left;
  for (int axis = 0; axis < 3; axis++) {
    uint32_t *order = s->order[axis], left = begin, right = 0;
    if (axis == cut.axis) continue;
    for (uint32_t i = begin; i < end; i++) {
      uint32_t ref = order[i];
      if (s->goes_right[ref]) s->spare[right++] = ref;
      else order[left++] = ref;
    }
    memcpy(order + left, s->spare, right * sizeof *order);
  }
}
static inline void paper_sweep(paper_build *p)
{
  struct { uint32_t slot, begin, end; } stack[64], now = {0, 0, p->ref_count};
  uint32_t waiting = 0, count = p->ref_count;
  paper_sweeper s = {p, {0}, (uint32_t *)ex_allocate(count, sizeof(uint32_t)), (float *)ex_allocate(count, sizeof(float)),
                     (unsigned char *)ex_allocate(count, 1)};
  for (int axis = 0; axis < 3; axis++) s.order[axis] = (uint32_t *)ex_allocate(count, sizeof(uint32_t));
  paper_sort_centers(&s);
  for (;;) {
    if (now.end - now.begin == 1) {
      p->nodes[now.slot] = p->refs[s.order[0][now.begin]];
      if (waiting == 0) break;
      now = stack[--waiting];
      continue;
    }
    paper_cut cut = paper_best_cut(&s, now.begin, now.end);
    paper_partition(&s, now.begin, now.end, cut);
    uint32_t first = paper_new_pair(p), middle = now.begin + cut.left, end = now.end;
    paper_set_inner(p, now.slot, first);
    uint32_t left_waits = middle - now.begin > end - middle;   /* the larger half does, so that the stack stays low */
    stack[waiting].slot = first + !left_waits;
    stack[waiting].begin = left_waits ? now.begin : middle;
    stack[waiting++].end = left_waits ? middle : end;
    now.slot = first + left_waits;
    now.begin = left_waits ? middle : now.begin;
    now.end = left_waits ? end : middle;
  }
  paper_fit(p);
  for (int axis = 0; axis < 3; axis++) free(s.order[axis]);
  free(s.spare);
  free(s.right_area);
  free(s.goes_right);
}

#endif
