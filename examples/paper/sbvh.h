/* sbvh.h - SBVH: spatial splits (Stich, Friedrich and Dietrich 2009, "Spatial Splits in Bounding Volume
 * Hierarchies"), the best trees of the paper's second table, which is relative to them.
 *
 * At each node the full sweep finds the best object split. Where its two boxes overlap by alpha of the
 * scene's area or more, planes between bins along the three axes are tried as well:
 * triangles are chopped into the bins, and those on both sides of the best plane become two references
 * each, or stay whole on one side where that is cheaper (reference unsplitting). Parameters
 * and the order of unsplitting are those of the authors' public implementation: alpha 1e-5, 128 bins, no
 * spatial split below depth 48.
 *
 * Theirs has no limit of references; here there is room for ref_max. So that depth-first order starves no
 * part of the scene, a node has a budget of its own: its children share what its split has left of it in
 * proportion to their references, and what a subtree has left over goes to the next one. Planes that cut
 * more than the budget are not taken.
 */
#ifndef PAPER_SBVH_H
#define PAPER_SBVH_H
#include "sweep.h"

enum {
  PAPER_SPATIAL_BINS = 128, PAPER_STRIDE = 8, PAPER_SPATIAL_DEPTH = 48,
  PAPER_LEFT = 1, PAPER_RIGHT = 2, PAPER_BOTH = 3
};
typedef struct paper_sbvh_settings {
  float alpha;                         /* least overlap for a spatial split, as a share of the root's area */
  int   bins;                          /* an axis: up to PAPER_SPATIAL_BINS, a multiple of PAPER_STRIDE */
  int   unsplit;                       /* 0: every triangle on both sides of the plane is split */
} paper_sbvh_settings;

typedef struct paper_bins {            /* along an axis, or between two planes only */
  int        axis, count;
  float      per_unit, plane[PAPER_SPATIAL_BINS + 1];   /* bin i is from plane[i] to plane[i + 1] */
  trbvh_node bin[PAPER_SPATIAL_BINS];          /* box, `first`: references that begin here, `count`: that end here */
  trbvh_node left[PAPER_SPATIAL_BINS + 1], right[PAPER_SPATIAL_BINS + 1];   /* of plane i: box, `count`: references */
} paper_bins;

typedef struct paper_splitter {
  paper_build        *p;
  paper_sweeper       sweep;
  paper_sbvh_settings settings;
  float               least_overlap;
  unsigned char      *side;            /* by reference: PAPER_LEFT, ... */
  uint32_t           *cut;             /* references cut by the plane, then those that become two: ... */
  trbvh_node         *halves;          /* ... left and right */
  uint64_t           *keys[2];         /* of the halves' centres */
  paper_bins          axes[3], fine;
} paper_splitter;

typedef struct paper_spatial_plane { double cost; int axis; float position; } paper_spatial_plane;
typedef struct paper_sides { uint32_t left, right, cut; } paper_sides;   /* references; cut: on both sides */
typedef struct paper_task { uint32_t slot, begin, end, budget; int depth; } paper_task;

// ---- bins ----
static inline void paper_start_bins(paper_bins *b, int axis, float low, float high, int count)
{
  float size = high - low;
  b->axis = axis;
  b->count = count;
  b->per_unit = (float)count / size;
  for (int i = 0; i < count; i++) {
    float offset = size * ((float)i / (float)count), plane = low + offset;
    b->plane[i] = TRB_MIN(plane, high);
    b->bin[i] = trb_no_box();
  }
  b->plane[count] = high;
  b->left[0] = b->right[count] = trb_no_box();
}
/* The bin of x, by the planes: what lies on one is to the right of it. */
static inline int paper_bin_of(const paper_bins *b, float x)
{
  int i = (int)((x - b->plane[0]) * b->per_unit);
  i = TRB_MAX(i, 0);
  i = TRB_MIN(i, b->count - 1);
  while (i > 0 && x < b->plane[i]) i--;
  while (i + 1 < b->count && x >= b->plane[i + 1]) i++;
  return i;
}
/* What of the triangle is in the box. */
static inline int paper_polygon(const paper_build *p, const trbvh_node *box, float polygon[TRB_POLYGON][3])
{
  float v[3][3];
  uint32_t vertex;
  int corners = 3;
  trbvh_node whole;
  trb_load_triangle(&p->lib.input, box->first, v, &vertex);
  trb_triangle_box((const float (*)[3])v, &whole);
  memcpy(polygon, v, sizeof v);
  for (int k = 0; k < 3; k++) {
    if (whole.min[k] < box->min[k]) corners = trb_cut(polygon, corners, k, box->min[k], 1);
    if (whole.max[k] > box->max[k]) corners = trb_cut(polygon, corners, k, box->max[k], -1);
  }
  if (corners) return corners;
  memcpy(polygon[0], box->min, sizeof box->min);     /* lost to rounding: its box's diagonal, then */
  memcpy(polygon[1], box->max, sizeof box->max);
  return 2;
}
/* Adds an edge to bins i..end, from plane to plane, but for its extent along their axis. */
static inline void paper_chop_edge(paper_bins *b, const float *from, const float *to, int i, int end)
{
  const int k = b->axis, u = (k + 1) % 3, v = (k + 2) % 3;
  float at_u = from[u], at_v = from[v], size_u = to[u] - at_u, size_v = to[v] - at_v;
  float scale = i < end ? 1 / (to[k] - from[k]) : 0;
  for (;; i++) {
    trbvh_node *bin = &b->bin[i];
    float next_u = to[u], next_v = to[v];
    if (i < end) {
      float t = (b->plane[i + 1] - from[k]) * scale, along_u = size_u * t, along_v = size_v * t;
      next_u = from[u] + along_u;
      next_v = from[v] + along_v;
    }
    float low_u = TRB_MIN(at_u, next_u), high_u = TRB_MAX(at_u, next_u);
    float low_v = TRB_MIN(at_v, next_v), high_v = TRB_MAX(at_v, next_v);
    bin->min[u] = TRB_MIN(low_u, bin->min[u]);
    bin->max[u] = TRB_MAX(high_u, bin->max[u]);
    bin->min[v] = TRB_MIN(low_v, bin->min[v]);
    bin->max[v] = TRB_MAX(high_v, bin->max[v]);
    if (i == end) break;
    at_u = next_u;
    at_v = next_v;
  }
}
static inline void paper_chop(paper_bins *b, int first, int last, const trbvh_node *ref,
                              const float polygon[TRB_POLYGON][3], int corners)
{
  const int k = b->axis;
  int bins[TRB_POLYGON];
  for (int i = 0; i < corners; i++) bins[i] = paper_bin_of(b, polygon[i][k]);
  for (int i = 0; i < corners; i++) {
    int next = i + 1 < corners ? i + 1 : 0, forward = polygon[i][k] <= polygon[next][k];
    int from = forward ? i : next, to = forward ? next : i;
    paper_chop_edge(b, polygon[from], polygon[to], bins[from], bins[to]);
  }
  for (int i = first; i <= last; i++) {
    float low = TRB_MAX(b->plane[i], ref->min[k]), high = TRB_MIN(b->plane[i + 1], ref->max[k]);
    b->bin[i].min[k] = TRB_MIN(low, b->bin[i].min[k]);
    b->bin[i].max[k] = TRB_MAX(high, b->bin[i].max[k]);
  }
}
static inline void paper_add_to_bins(const paper_build *p, paper_bins *b, const trbvh_node *ref,
                                     float polygon[TRB_POLYGON][3], int *corners)
{
  const int k = b->axis;
  int first = paper_bin_of(b, ref->min[k]), last = paper_bin_of(b, ref->max[k]);
  while (last > first && ref->max[k] <= b->plane[last]) last--;   /* it ends on a plane: not cut by it */
  b->bin[first].first++;
  b->bin[last].count++;
  if (first == last) {
    b->bin[first] = paper_union(b->bin[first], ref);
    return;
  }
  if (*corners == 0) *corners = paper_polygon(p, ref, polygon);
  paper_chop(b, first, last, ref, (const float (*)[3])polygon, *corners);
}
/* Everything left and right of each plane, from what is left and right of all of them. */
static inline void paper_sum_bins(paper_bins *b)
{
  for (int i = 0; i < b->count; i++) {
    b->left[i + 1] = paper_union(b->left[i], &b->bin[i]);
    b->left[i + 1].count += b->bin[i].first;
  }
  for (int i = b->count; i-- > 0;) {
    b->right[i] = paper_union(b->right[i + 1], &b->bin[i]);
    b->right[i].count += b->bin[i].count;
  }
}
static inline double paper_cost_of(const trbvh_node *left, const trbvh_node *right)
{
  return (double)trb_area(*left) * left->count + (double)trb_area(*right) * right->count;
}
/* The best plane between bins that cuts no more than the budget, where it is better. */
static inline void paper_sweep_bins(paper_bins *b, const paper_task *t, paper_spatial_plane *best)
{
  paper_sum_bins(b);
  for (int i = 1; i < b->count; i++) {
    const trbvh_node *left = &b->left[i], *right = &b->right[i];
    uint32_t count = left->count + right->count;
    if (b->plane[i] <= b->plane[0] || b->plane[i] >= b->plane[b->count]) continue;   /* by rounding */
    if (left->count == 0 || right->count == 0 || count - (t->end - t->begin) > t->budget) continue;
    double cost = paper_cost_of(left, right);
    if (cost < best->cost) *best = (paper_spatial_plane){cost, b->axis, b->plane[i]};
  }
}
/* The planes within coarse bin i. */
static inline void paper_refine(paper_splitter *s, const paper_task *t, const paper_bins *coarse, int i,
                                paper_spatial_plane *best)
{
  paper_bins *b = &s->fine;
  const int k = coarse->axis;
  float low = coarse->plane[i], high = coarse->plane[i + 1];
  if (!(high - low > TRB_TINY)) return;
  paper_start_bins(b, k, low, high, PAPER_STRIDE);
  b->left[0] = coarse->left[i];
  b->right[PAPER_STRIDE] = coarse->right[i + 1];
  for (uint32_t j = t->begin; j < t->end; j++) {
    trbvh_node ref = s->p->refs[s->sweep.order[0][j]];
    float polygon[TRB_POLYGON][3];
    int corners = 0, from_left = ref.min[k] < low, to_right = ref.max[k] > high;
    if (ref.min[k] >= high || (from_left && ref.max[k] <= low)) continue;
    ref.min[k] = TRB_MAX(ref.min[k], low);
    ref.max[k] = TRB_MIN(ref.max[k], high);
    paper_add_to_bins(s->p, b, &ref, polygon, &corners);
    if (from_left) b->left[0].count--;
    if (to_right) b->right[PAPER_STRIDE].count--;
  }
  paper_sweep_bins(b, t, best);
}
/* The best plane that is better than `bound`. Most references of small nodes reach through many bins. So
 * they are put into eight times wider ones first, and what is left and right of one of these tells whether
 * a plane within it can be better: nearly always, none can. */
static inline paper_spatial_plane paper_best_plane(paper_splitter *s, const paper_task *t, const trbvh_node *box,
                                           double bound)
{
  paper_spatial_plane best = {bound, 0, 0};
  int count = s->settings.bins / PAPER_STRIDE, axes = 0;
  for (int k = 0; k < 3; k++) {
    float size = box->max[k] - box->min[k];
    if (!(size > TRB_TINY && trb_longest_side(*box) < 1 / TRB_TINY)) continue;
    paper_start_bins(&s->axes[axes++], k, box->min[k], box->max[k], count);
  }
  for (uint32_t i = t->begin; i < t->end; i++) {
    const trbvh_node *ref = &s->p->refs[s->sweep.order[0][i]];
    float polygon[TRB_POLYGON][3];
    int corners = 0;
    for (int a = 0; a < axes; a++) paper_add_to_bins(s->p, &s->axes[a], ref, polygon, &corners);
  }
  for (int a = 0; a < axes; a++) paper_sweep_bins(&s->axes[a], t, &best);
  for (int a = 0; a < axes; a++) {
    for (int i = 0; i < count; i++) {
      const paper_bins *b = &s->axes[a];
      if (paper_cost_of(&b->left[i], &b->right[i + 1]) < best.cost) paper_refine(s, t, b, i, &best);
    }
  }
  return best;
}

// ---- splitting ----
/* Both halves of a reference; 0 where one is empty. */
static inline int paper_halve(const paper_build *p, const trbvh_node *ref, const paper_spatial_plane *plane,
                              trbvh_node halves[2], int *side)
{
  float v[3][3];
  uint32_t vertex;
  trb_load_triangle(&p->lib.input, ref->first, v, &vertex);
  halves[0] = halves[1] = *ref;
  halves[0].max[plane->axis] = halves[1].min[plane->axis] = plane->position;
  int left = trb_clip((const float (*)[3])v, &halves[0]), right = trb_clip((const float (*)[3])v, &halves[1]);
  *side = left && right ? PAPER_BOTH : right ? PAPER_RIGHT : PAPER_LEFT;
  return *side == PAPER_BOTH;
}
/* Where a reference that the plane cuts is cheapest, when there are so many in the boxes left and right. */
static inline int paper_unsplit(const trbvh_node *ref, const trbvh_node halves[2], const trbvh_node *left,
                                const trbvh_node *right, const paper_sides *n)
{
  double area_left = trb_area(*left), area_right = trb_area(*right);
  double both = trb_area(paper_union(*left, &halves[0])) * (n->left + 1.0)
              + trb_area(paper_union(*right, &halves[1])) * (n->right + 1.0);
  double to_left = trb_area(paper_union(*left, ref)) * (n->left + 1.0) + area_right * n->right;
  double to_right = area_left * n->left + trb_area(paper_union(*right, ref)) * (n->right + 1.0);
  if (both <= to_left && both <= to_right) return PAPER_BOTH;
  return to_left <= to_right ? PAPER_LEFT : PAPER_RIGHT;
}
/* Which references go where; changes none of them yet. */
static inline paper_sides paper_choose_sides(paper_splitter *s, const paper_task *t, const paper_spatial_plane *plane)
{
  const uint32_t *order = s->sweep.order[plane->axis];
  paper_sides n = {0, 0, 0};
  uint32_t straddling = 0;
  trbvh_node left = trb_no_box(), right = trb_no_box();
  for (uint32_t i = t->begin; i < t->end; i++) {
    const trbvh_node *ref = &s->p->refs[order[i]];
    if (ref->min[plane->axis] >= plane->position) {
      s->side[order[i]] = PAPER_RIGHT;
      right = paper_union(right, ref);
      n.right++;
    } else if (ref->max[plane->axis] <= plane->position) {
      s->side[order[i]] = PAPER_LEFT;
      left = paper_union(left, ref);
      n.left++;
    } else {
      s->cut[straddling++] = order[i];
    }
  }
  for (uint32_t i = 0; i < straddling; i++) {
    const trbvh_node *ref = &s->p->refs[s->cut[i]];
    trbvh_node *halves = &s->halves[2 * n.cut];
    int side;
    if (paper_halve(s->p, ref, plane, halves, &side) && s->settings.unsplit) {
      side = paper_unsplit(ref, halves, &left, &right, &n);
    }
    s->side[s->cut[i]] = (unsigned char)side;
    if (side & PAPER_LEFT) left = paper_union(left, side == PAPER_BOTH ? &halves[0] : ref);
    if (side & PAPER_RIGHT) right = paper_union(right, side == PAPER_BOTH ? &halves[1] : ref);
    n.left += (uint32_t)side & PAPER_LEFT;
    n.right += (uint32_t)side >> 1;
    if (side == PAPER_BOTH) s->cut[n.cut++] = s->cut[i];
  }
  return n;
}
/* Left halves take their reference's place, right halves are new. */
static inline void paper_split_refs(paper_splitter *s, const paper_sides *n)
{
  paper_build *p = s->p;
  for (uint32_t i = 0; i < n->cut; i++) {
    uint32_t prim = p->refs[s->cut[i]].first;
    p->refs[s->cut[i]] = paper_reference(p, s->halves[2 * i], prim);
    p->refs[p->ref_count + i] = paper_reference(p, s->halves[2 * i + 1], prim);
  }
  p->ref_count += n->cut;
}
static inline void paper_sort_keys(uint64_t *keys, uint32_t count)
{
  if (count > 128) {
    paper_sort(keys, count, 64);
    return;
  }
  for (uint32_t i = 1; i < count; i++) {
    uint64_t key = keys[i];
    uint32_t k = i;
    for (; k > 0 && keys[k - 1] > key; k--) keys[k] = keys[k - 1];
    keys[k] = key;
  }
}
/* Both sides in the order of their centres, from at[0] and at[1] on: what has not changed still is in
 * order, and the halves, the left ones from cut[], the right ones from first_new on, are merged in. */
static inline void paper_divide(paper_splitter *s, const paper_task *t, const paper_sides *n,
                                uint32_t first_new, const uint32_t at[2])
{
  for (int axis = 0; axis < 3; axis++) {
    uint32_t *order = s->sweep.order[axis], *out[2], next[2] = {0, 0};
    for (int k = 0; k < 2; k++) {
      out[k] = s->sweep.spare + at[k];
      for (uint32_t i = 0; i < n->cut; i++) {
        uint32_t ref = k ? first_new + i : s->cut[i];
        s->keys[k][i] = paper_center_key(s->p, ref, axis);
      }
      paper_sort_keys(s->keys[k], n->cut);
    }
    for (uint32_t i = t->begin; i < t->end; i++) {
      uint32_t ref = order[i];
      int k = s->side[ref] >> 1;
      if (s->side[ref] == PAPER_BOTH) continue;
      if (next[k] < n->cut) {
        uint64_t key = paper_center_key(s->p, ref, axis);
        while (next[k] < n->cut && s->keys[k][next[k]] < key) *out[k]++ = (uint32_t)s->keys[k][next[k]++];
      }
      *out[k]++ = ref;
    }
    for (int k = 0; k < 2; k++) {
      while (next[k] < n->cut) *out[k]++ = (uint32_t)s->keys[k][next[k]++];
    }
    memcpy(order + t->begin, s->sweep.spare, (n->left + n->right) * sizeof *order);
  }
}

// ---- the tree ----
static inline trbvh_node paper_box_of(const paper_splitter *s, int axis, uint32_t begin, uint32_t end)
{
  trbvh_node box = trb_no_box();
  for (uint32_t i = begin; i < end; i++) box = paper_union(box, &s->p->refs[s->sweep.order[axis][i]]);
  return box;
}
static inline float paper_overlap(const trbvh_node *a, const trbvh_node *b)
{
  trbvh_node both = *a;
  for (int k = 0; k < 3; k++) {
    both.min[k] = TRB_MAX(a->min[k], b->min[k]);
    both.max[k] = TRB_MIN(a->max[k], b->max[k]);
    if (both.min[k] > both.max[k]) return 0;
  }
  return trb_area(both);
}
/* A spatial split where there is a better one than the object split; else no references on either side.
 * Where a leaf is better than both, the authors' builder ends. Here it goes on, for the collapse to
 * decide, but splits no more. */
static inline paper_sides paper_try_spatial(paper_splitter *s, paper_task *t, const paper_cut *cut)
{
  const paper_sides none = {0, 0, 0};
  const trb_costs costs = s->p->lib.costs;
  uint32_t count = t->end - t->begin;
  if (t->budget == 0 || t->depth >= PAPER_SPATIAL_DEPTH) return none;
  trbvh_node left = paper_box_of(s, cut->axis, t->begin, t->begin + cut->left);
  trbvh_node right = paper_box_of(s, cut->axis, t->begin + cut->left, t->end);
  trbvh_node box = paper_union(left, &right);
  if (paper_overlap(&left, &right) < s->least_overlap) return none;
  double area = trb_area(box), leaf = area * count - area / costs.ratio;   /* worth a split that costs less */
  int may_end = count <= costs.max_leaf && leaf <= cut->cost;
  double bound = may_end ? leaf : cut->cost;
  paper_spatial_plane plane = paper_best_plane(s, t, &box, bound);
  if (plane.cost < bound) return paper_choose_sides(s, t, &plane);
  if (may_end) t->depth = PAPER_SPATIAL_DEPTH;
  return none;
}
static inline paper_sides paper_split_node(paper_splitter *s, paper_task *t)
{
  paper_cut cut = paper_best_cut(&s->sweep, t->begin, t->end);
  paper_sides n = paper_try_spatial(s, t, &cut);
  if (n.left && n.right) {
    paper_split_refs(s, &n);
    return n;
  }
  for (uint32_t i = t->begin; i < t->end; i++) {
    s->side[s->sweep.order[cut.axis][i]] = i - t->begin < cut.left ? PAPER_LEFT : PAPER_RIGHT;
  }
  return (paper_sides){cut.left, t->end - t->begin - cut.left, 0};
}
static inline void paper_sbvh_build(paper_splitter *s)
{
  /* The smaller side is first: each entry has half of the one below it at most, or is one of the spatial
   * splits. */
  paper_task stack[32 + PAPER_SPATIAL_DEPTH];
  paper_task now = {0, 0, s->p->ref_count, s->p->ref_max - s->p->ref_count, 0};
  uint32_t waiting = 0;
  for (;;) {
    if (now.end - now.begin == 1) {
      uint32_t left_over = now.budget;
      s->p->nodes[now.slot] = s->p->refs[s->sweep.order[0][now.begin]];
      if (waiting == 0) return;
      now = stack[--waiting];
      now.budget += left_over;
      continue;
    }
    uint32_t first_new = s->p->ref_count, first = paper_new_pair(s->p);
    paper_sides n = paper_split_node(s, &now);
    uint32_t left_waits = n.left > n.right, waits = left_waits ? n.left : n.right;
    uint32_t goes_on = n.left + n.right - waits, budget = now.budget - n.cut;
    uint32_t share = (uint32_t)((uint64_t)budget * waits / (waits + goes_on));
    uint32_t at[2] = {left_waits ? 0 : waits, left_waits ? waits : 0};   /* what goes on can grow behind it */
    paper_divide(s, &now, &n, first_new, at);
    paper_set_inner(s->p, now.slot, first);
    stack[waiting++] = (paper_task){first + !left_waits, now.begin, now.begin + waits, share, now.depth + 1};
    now.slot = first + left_waits;
    now.begin += waits;
    now.end = now.begin + goes_on;
    now.budget = budget - share;
    now.depth++;
  }
}
static inline paper_splitter *paper_start_sbvh(paper_build *p)
{
  static const paper_sbvh_settings usual = {1e-5f, PAPER_SPATIAL_BINS, 1};
  uint32_t room = p->ref_max;
  paper_splitter *s = (paper_splitter *)ex_allocate(1, sizeof *s);
  s->p = s->sweep.p = p;
  s->settings = p->parameters ? *(const paper_sbvh_settings *)p->parameters : usual;
  for (int axis = 0; axis < 3; axis++) s->sweep.order[axis] = (uint32_t *)ex_allocate(room, sizeof(uint32_t));
  s->sweep.spare = (uint32_t *)ex_allocate(room, sizeof(uint32_t));
  s->sweep.right_area = (float *)ex_allocate(room, sizeof(float));
  s->side = (unsigned char *)ex_allocate(room, 1);
  s->cut = (uint32_t *)ex_allocate(room, sizeof(uint32_t));
  s->halves = (trbvh_node *)ex_allocate((size_t)room + 1, sizeof *s->halves);
  for (int k = 0; k < 2; k++) s->keys[k] = (uint64_t *)ex_allocate(room, sizeof(uint64_t));
  paper_sort_centers(&s->sweep);
  s->least_overlap = s->settings.alpha * trb_area(paper_box_of(s, 0, 0, p->ref_count));
  return s;
}
static inline void paper_end_sbvh(paper_splitter *s)
{
  for (int axis = 0; axis < 3; axis++) free(s->sweep.order[axis]);
  for (int k = 0; k < 2; k++) free(s->keys[k]);
  free(s->sweep.spare);
  free(s->sweep.right_area);
  free(s->side);
  free(s->cut);
  free(s->halves);
  free(s);
}
static inline void paper_sbvh(paper_build *p)
{
  paper_splitter *s = paper_start_sbvh(p);
  paper_sbvh_build(s);
  paper_fit(p);
  paper_end_sbvh(s);
}

#endif
