/* Tests of the builders of examples/paper that go along the Morton curve, HLBVH, GridSAH, PLOC and H-PLOC, and of the
 * treelet recursion without dynamic programming. Part of test_paper.c. */
#ifndef TESTS_PAPER_CURVE_H
#define TESTS_PAPER_CURVE_H
#include "paper.h"
#include "../examples/paper/sweep.h"
#include "../examples/paper/hlbvh.h"
#include "../examples/paper/grid.h"
#include "../examples/paper/ploc.h"
#include "../examples/paper/hploc.h"
#include "../examples/paper/naive.h"

/* The same tree of every scene from both. */
static void same_from_both(uint32_t count, paper_builder *one, paper_builder *other, const void *parameters)
{
  for (size_t i = 0; i < SCENE_COUNT; ++i) {
    scene s;
    scene_def small = scene_defs[i];
    if (small.full < count) continue;
    small.full = small.quick = count;
    scene_make(&s, &small);
    CONTEXT("scene %s, %u", s.name, count);
    trbvh_geometry g = scene_geometry(&s);
    paper_tree a = paper_test_make(&g, one, parameters, 0, 0), b = paper_test_make(&g, other, parameters, 0, 0);
    CHECK(same_tree(&a.bvh, &b.bvh));
    trbvh_free(&a.bvh);
    trbvh_free(&b.bvh);
    scene_free(&s);
  }
  CONTEXT("%s", "");
}
/* Goes through the tree of p, parents first: the nodes, 2 ref_count - 1 of them. The caller frees them. */
static uint32_t *list_nodes(const paper_build *p)
{
  uint32_t *list = (uint32_t *)xmalloc(sizeof *list * 2 * p->ref_count), count = 0;
  list[count++] = 0;
  for (uint32_t i = 0; i < count; ++i) {
    const trbvh_node *n = &p->nodes[list[i]];
    if (paper_is_leaf(n)) continue;
    if (count + 2 > 2 * p->ref_count) break;
    list[count++] = n->first;
    list[count++] = n->first + 1;
  }
  CHECK_MSG(count == 2 * p->ref_count - 1, "%u nodes over %u references", count, p->ref_count);
  return list;
}

// >>scenes ----------------------------------------------------------------------------------------------------------
static void test_hlbvh_scenes(void) { paper_test_scenes(paper_hlbvh, NULL, 0, 0, 20000); }
static void test_grid_scenes(void) { paper_test_scenes(paper_grid, NULL, 0, 0, 20000); }
static void test_hploc_scenes(void) { paper_test_scenes(paper_hploc, NULL, 0, 0, 20000); }
static void test_ploc_scenes(void)
{
  paper_ploc_settings one = {1};
  paper_test_scenes(paper_ploc, NULL, 0, 0, 20000);
  paper_test_scenes(paper_ploc, &one, 0, 0, 3000);
}
/* Other codes: all 63 bits, as from 2^24 references on. */
static paper_builder *builder_of_long_codes;
static void long_codes(paper_build *p)
{
  p->lib.key_form.packed = 0;
  CHECK(paper_code_bits(p) == 63);
  builder_of_long_codes(p);
}
static void test_long_codes(void)
{
  static paper_builder *const builders[] = {paper_hlbvh, paper_grid, paper_ploc, paper_hploc};
  for (size_t i = 0; i < sizeof builders / sizeof *builders; ++i) {
    builder_of_long_codes = builders[i];
    look_at_all(0, 700, long_codes, NULL);
  }
}
/* HLBVH and GridSAH choose among planes where LBVH has but one: no ordinary scene is worse for it. PLOC's greed is, on
 * walls of equal squares (room), where LBVH's halves are better than pairs that do not know of each other; by up to 5 %,
 * and on average it is to be better, by 4 % at least. SweepSAH sees all that the two of planes do. */
static void test_curve_quality(void)
{
  paper_builder *const builders[] = {paper_hlbvh, paper_grid, paper_ploc, paper_hploc};
  double sums[4] = {0}, scenes = 0;
  for (size_t i = 0; i < SCENE_COUNT; ++i) {
    const char *name = scene_defs[i].name;
    if (!(scene_defs[i].flags & SCENE_ORDINARY)) continue;
    double lbvh = paper_test_sah(name, paper_lbvh, NULL, 0, 0), sweep = paper_test_sah(name, paper_sweep, NULL, 0, 0);
    ++scenes;
    for (int k = 0; k < 4; ++k) {
      double share = paper_test_sah(name, builders[k], NULL, 0, 0) / lbvh;
      CONTEXT("scene %s, builder %d", name, k);
      sums[k] += share;
      CHECK_MSG(share <= (k < 2 ? 1.001 : 1.05), "%g of LBVH", share);
      if (k < 2) CHECK_MSG(share * lbvh >= 0.99 * sweep, "%g of SweepSAH", share * lbvh / sweep);
    }
  }
  for (int k = 0; k < 4; ++k) CHECK_MSG(sums[k] <= 0.96 * scenes, "builder %d: %g of LBVH", k, sums[k] / scenes);
}

// >>hlbvh -----------------------------------------------------------------------------------------------------------
/* The topmost nodes within one cell of the grid are as many as the cells in use: each is all of a cluster. Below them,
 * the code's highest bit that changes parts the children. */
static void hlbvh_and_look(paper_build *p)
{
  paper_hlbvh(p);
  uint32_t *list = list_nodes(p), count = 2 * p->ref_count - 1, clusters = 0, cells = 0;
  uint64_t *low = (uint64_t *)xmalloc(sizeof *low * 2 * p->pair_end);
  uint64_t *high = (uint64_t *)xmalloc(sizeof *high * 2 * p->pair_end);
  unsigned char *used = (unsigned char *)xmalloc(1 << 15);
  memset(used, 0, 1 << 15);
  for (uint32_t i = count; i-- > 0;) {
    uint32_t n = list[i], l = p->nodes[n].first;
    if (paper_is_leaf(&p->nodes[n])) {
      low[n] = high[n] = trb_box_code(p->nodes[n], p->lib.grid) >> (63 - paper_code_bits(p));
      cells += !used[trb_box_code(p->nodes[n], p->lib.grid) >> 48];
      used[trb_box_code(p->nodes[n], p->lib.grid) >> 48] = 1;
    } else {
      low[n] = low[l] < low[l + 1] ? low[l] : low[l + 1];
      high[n] = high[l] > high[l + 1] ? high[l] : high[l + 1];
    }
  }
  uint32_t shift = paper_code_bits(p) - 15;
  for (uint32_t i = 0; i < count; ++i) {
    uint32_t n = list[i], l = p->nodes[n].first;
    int within = low[n] >> shift == high[n] >> shift, leaf = paper_is_leaf(&p->nodes[n]);
    if (i == 0 && within) ++clusters;
    for (uint32_t k = l; k < l + 2 && !within; ++k) clusters += low[k] >> shift == high[k] >> shift ? 1 : 0;
    if (!within || leaf || low[n] == high[n]) continue;
    uint64_t bit = low[n] ^ high[n];
    while (bit & (bit - 1)) bit &= bit - 1;
    CHECK((high[l] & bit) == 0 && (low[l + 1] & bit) != 0 && high[l] < low[l + 1]);
  }
  CHECK_MSG(clusters == cells, "%u clusters of %u cells", clusters, cells);
  free(used);
  free(low);
  free(high);
  free(list);
}
/* The least cost, by A N with N clusters, of all planes between 32 bins of the clusters' centres along an axis; looks at
 * all clusters for each. */
static double best_of_bins(const paper_build *p)
{
  trbvh_node *clusters = (trbvh_node *)xmalloc(sizeof *clusters << 15);
  double best = DBL_MAX;
  for (uint32_t i = 0; i < 1 << 15; ++i) clusters[i] = trb_no_box();
  for (uint32_t i = 0; i < p->ref_count; ++i) {
    trbvh_node *cluster = &clusters[trb_box_code(p->refs[i], p->lib.grid) >> 48];
    *cluster = paper_union(*cluster, &p->refs[i]);
  }
  for (int k = 0; k < 3; ++k)
    for (int plane = 1; plane < 32; ++plane) {
      trbvh_node side[2] = {trb_no_box(), trb_no_box()}, centers = trb_no_box();
      double counts[2] = {0, 0};
      for (int pass = 0; pass < 2; ++pass)
        for (uint32_t i = 0; i < 1 << 15; ++i) {
          if (clusters[i].min[0] > clusters[i].max[0]) continue;
          float center = 0.5f * clusters[i].min[k] + 0.5f * clusters[i].max[k], width = centers.max[k] - centers.min[k];
          if (pass == 0) {
            centers.min[k] = TRB_MIN(center, centers.min[k]);
            centers.max[k] = TRB_MAX(center, centers.max[k]);
          } else {
            int right = (center - centers.min[k]) * (32 / width) >= (float)plane;
            side[right] = paper_union(side[right], &clusters[i]);
            ++counts[right];
          }
        }
      double cost = trb_area(side[0]) * counts[0] + trb_area(side[1]) * counts[1];
      if (counts[0] > 0 && counts[1] > 0 && cost < best) best = cost;
    }
  free(clusters);
  return best;
}
static uint32_t clusters_below(const paper_build *p, uint32_t node)
{
  unsigned char *used = (unsigned char *)xmalloc(1 << 15);
  uint32_t *stack = (uint32_t *)xmalloc(sizeof *stack * 2 * p->ref_count), waiting = 0, count = 0;
  memset(used, 0, 1 << 15);
  stack[waiting++] = node;
  while (waiting) {
    const trbvh_node *n = &p->nodes[stack[--waiting]];
    if (!paper_is_leaf(n)) {
      stack[waiting++] = n->first;
      stack[waiting++] = n->first + 1;
    } else if (!used[trb_box_code(*n, p->lib.grid) >> 48]) {
      used[trb_box_code(*n, p->lib.grid) >> 48] = 1;
      ++count;
    }
  }
  free(stack);
  free(used);
  return count;
}
static void hlbvh_and_look_at_root(paper_build *p)
{
  double best = best_of_bins(p), cost = 0;
  paper_hlbvh(p);
  for (uint32_t i = p->nodes[0].first; i < p->nodes[0].first + 2; ++i)
    cost += (double)trb_area(p->nodes[i]) * clusters_below(p, i);
  CHECK_MSG(cost <= best * (1 + 1e-12) && cost >= best * (1 - 1e-12), "%g, but %g is best", cost, best);
}
static void test_hlbvh_clusters(void)
{
  look_at_all(0, 3000, hlbvh_and_look, NULL);
  look_at_all(SCENE_ORDINARY, 8000, hlbvh_and_look, NULL);
  look_at_all(SCENE_ORDINARY, 2000, hlbvh_and_look_at_root, NULL);
}
/* All of a scene in one cell of a grid that is larger than it: then it is one cluster, and that is a linear BVH. */
static void widen_grid(paper_build *p)
{
  const float cells = 2097152.0f;
  p->lib.grid.cells_per_unit *= 1.0f / 64;
  p->lib.grid.units_per_cell *= 64;
  for (int k = 0; k < 3; ++k) p->lib.grid.origin[k] -= p->lib.grid.units_per_cell * cells / 128;
}
static void one_cluster(paper_build *p)
{
  widen_grid(p);
  paper_hlbvh(p);
}
static void one_lbvh(paper_build *p)
{
  widen_grid(p);
  free(paper_sort_refs(p));            /* equal codes, which the library tells apart by references' numbers */
  paper_lbvh(p);
}
static void test_hlbvh_one_cluster(void) { same_from_both(1000, one_cluster, one_lbvh, NULL); }

// >>grid ------------------------------------------------------------------------------------------------------------
/* Of a reference's cell, as many bits as the code has. */
static uint32_t code_cell(const paper_build *p, const trbvh_node *ref, int axis)
{
  uint32_t lost = 21 - (paper_code_bits(p) + 2 - (uint32_t)axis) / 3;
  return trb_cell(paper_center(ref, axis), p->lib.grid.origin[axis], p->lib.grid.cells_per_unit) >> lost << lost;
}
/* The least cost of all planes of the first grid over the scene, by looking at all references for each. */
static double best_of_grid(const paper_build *p)
{
  double best = DBL_MAX;
  uint32_t differ = 0;
  for (uint32_t i = 1; i < p->ref_count; ++i)
    for (int k = 0; k < 3; ++k) differ |= code_cell(p, &p->refs[0], k) ^ code_cell(p, &p->refs[i], k);
  uint32_t shift = trb_log2(differ) + 1 - 3;           /* three bits of each axis */
  for (int k = 0; k < 3; ++k)
    for (uint32_t plane = 1; plane < 8; ++plane) {
      trbvh_node side[2] = {trb_no_box(), trb_no_box()};
      double counts[2] = {0, 0};
      for (uint32_t i = 0; i < p->ref_count; ++i) {
        int right = (code_cell(p, &p->refs[i], k) >> shift & 7) >= plane;
        side[right] = paper_union(side[right], &p->refs[i]);
        ++counts[right];
      }
      if (counts[0] <= 0 || counts[1] <= 0) continue;
      double cost = trb_area(side[0]) * counts[0] + trb_area(side[1]) * counts[1];
      if (cost < best) best = cost;
    }
  return best;
}
static void grid_and_look_at_root(paper_build *p)
{
  double best = best_of_grid(p), cost = 0;
  paper_grid(p);
  for (uint32_t i = p->nodes[0].first; i < p->nodes[0].first + 2; ++i)
    cost += (double)trb_area(p->nodes[i]) * trb_count(p->nodes[i].count);
  CHECK_MSG(cost <= best * (1 + 1e-12) && cost >= best * (1 - 1e-12), "%g, but %g is best", cost, best);
}
/* Every node is parted by a plane of a grid, one side of which has all the left child's centres and the other all the
 * right one's; but where no plane parts them, as codes are equal. */
static void grid_and_look(paper_build *p)
{
  typedef struct { uint32_t low[3], high[3]; } cells;
  paper_grid(p);
  uint32_t *list = list_nodes(p);
  cells *at = (cells *)xmalloc(sizeof *at * 2 * p->pair_end);
  for (uint32_t i = 2 * p->ref_count - 1; i-- > 0;) {
    uint32_t n = list[i], l = p->nodes[n].first;
    int apart = 0, equal = 1;
    if (paper_is_leaf(&p->nodes[n])) {
      for (int k = 0; k < 3; ++k) at[n].low[k] = at[n].high[k] = code_cell(p, &p->nodes[n], k);
      continue;
    }
    for (int k = 0; k < 3; ++k) {
      at[n].low[k] = TRB_MIN(at[l].low[k], at[l + 1].low[k]);
      at[n].high[k] = TRB_MAX(at[l].high[k], at[l + 1].high[k]);
      apart |= at[l].high[k] < at[l + 1].low[k];
      equal &= at[n].low[k] == at[n].high[k];
    }
    CHECK_MSG(apart != equal, "node %u of %u", n, trb_count(p->nodes[n].count));
  }
  free(at);
  free(list);
}
static void test_grid_planes(void)
{
  look_at_all(0, 2, grid_and_look, NULL);
  look_at_all(0, 700, grid_and_look, NULL);
  look_at_all(SCENE_ORDINARY, 8000, grid_and_look, NULL);
  look_at_all(SCENE_ORDINARY, 500, grid_and_look_at_root, NULL);
}

// >>ploc ------------------------------------------------------------------------------------------------------------
/* Locally-ordered clustering by its definition: every cluster asks all others in reach anew. A set of primitives is known
 * by the sum of their random numbers. */
typedef struct set { trbvh_node box; uint64_t members; } set;
typedef struct history { uint64_t made[400]; uint32_t count; } history;   /* sets that merges have made */

static set set_of(const trbvh_node *ref)
{
  rng r = {ref->first};
  uint64_t high = rng_u32(&r);
  set s = {*ref, high << 32 | rng_u32(&r)};
  return s;
}
static uint32_t nearest_of(const set *sets, uint32_t count, uint32_t i, uint32_t radius)
{
  uint32_t best = count;
  float best_area = 0;
  for (uint32_t j = 0; j < count; ++j) {
    if (j == i || (i < j ? j - i : i - j) > radius) continue;
    float area = trb_area(paper_union(sets[i].box, &sets[j].box));
    if (best == count || area < best_area || (area == best_area && (i ^ j) < (i ^ best))) {
      best = j;
      best_area = area;
    }
  }
  return best;
}
static uint32_t cluster_by_definition(set *sets, uint32_t count, uint32_t radius, uint32_t most, history *h)
{
  static set next[400];
  while (count > most) {
    uint32_t left = 0;
    for (uint32_t i = 0; i < count; ++i) {
      uint32_t j = nearest_of(sets, count, i, radius), mutual = nearest_of(sets, count, j, radius) == i;
      if (mutual && j < i) continue;
      next[left] = sets[i];
      if (mutual) {
        next[left].box = paper_union(sets[i].box, &sets[j].box);
        h->made[h->count++] = next[left].members += sets[j].members;
      }
      ++left;
    }
    CHECK(left < count);
    if (left == count) break;
    memcpy(sets, next, sizeof *sets * left);
    count = left;
  }
  return count;
}
/* The sorted references begin..end - 1, parted from the top down where the highest bit changes: what is left of them. */
static uint32_t hploc_by_definition(const trbvh_node *refs, const uint64_t *codes, uint32_t begin, uint32_t end,
    set *left, history *h)
{
  uint32_t middle = begin + 1, count;
  if (end - begin == 1) {
    left[0] = set_of(&refs[begin]);
    return 1;
  }
  uint64_t differ = codes[begin] ^ codes[end - 1], places = begin ^ (end - 1);
  if (differ) {
    while (differ & (differ - 1)) differ &= differ - 1;
    while (!(codes[middle] & differ)) ++middle;
  } else {
    while (places & (places - 1)) places &= places - 1;
    while (!(middle & places)) ++middle;
  }
  count = hploc_by_definition(refs, codes, begin, middle, left, h);
  count += hploc_by_definition(refs, codes, middle, end, left + count, h);
  return count > 16 ? cluster_by_definition(left, count, 8, 16, h) : count;
}
static int compare_sums(const void *a, const void *b)
{
  const uint64_t x = *(const uint64_t *)a, y = *(const uint64_t *)b;
  return x < y ? -1 : x > y;
}
static void compare_with(const paper_build *p, history *want)   /* the sets that p's inner nodes are */
{
  static history found;
  static uint64_t members[802];
  uint32_t *list = list_nodes(p);
  found.count = 0;
  for (uint32_t i = 2 * p->ref_count - 1; i-- > 0;) {
    const trbvh_node *n = &p->nodes[list[i]];
    if (paper_is_leaf(n)) members[list[i]] = set_of(n).members;
    else members[list[i]] = found.made[found.count++] = members[n->first] + members[n->first + 1];
  }
  CHECK_MSG(found.count == want->count, "%u merges, not %u", found.count, want->count);
  qsort(found.made, found.count, sizeof *found.made, compare_sums);
  qsort(want->made, want->count, sizeof *want->made, compare_sums);
  CHECK(!memcmp(found.made, want->made, sizeof *want->made * want->count));
  free(list);
}
static void ploc_and_compare(paper_build *p)
{
  static set sets[400];
  static history want;
  free(paper_sort_refs(p));
  want.count = 0;
  for (uint32_t i = 0; i < p->ref_count; ++i) sets[i] = set_of(&p->refs[i]);
  cluster_by_definition(sets, p->ref_count, ((const paper_ploc_settings *)p->parameters)->radius, 1, &want);
  paper_ploc(p);
  compare_with(p, &want);
}
static void hploc_and_compare(paper_build *p)
{
  static set sets[400];
  static history want;
  uint64_t *codes = paper_sort_refs(p);
  want.count = 0;
  uint32_t left = hploc_by_definition(p->refs, codes, 0, p->ref_count, sets, &want);
  cluster_by_definition(sets, left, 8, 1, &want);
  free(codes);
  paper_hploc(p);
  compare_with(p, &want);
}
static void test_ploc_by_definition(void)
{
  static const uint32_t radii[] = {1, 2, 5, 16, UINT32_MAX}, counts[] = {2, 3, 5, 8, 27, 60};
  for (size_t r = 0; r < sizeof radii / sizeof *radii; ++r)
    for (size_t c = 0; c < sizeof counts / sizeof *counts; ++c) {
      paper_ploc_settings settings = {radii[r]};
      look_at_all(0, counts[c], ploc_and_compare, &settings);
    }
}
static void test_hploc_by_definition(void)
{
  static const uint32_t counts[] = {2, 15, 17, 33, 100, 400};
  for (size_t c = 0; c < sizeof counts / sizeof *counts; ++c) look_at_all(0, counts[c], hploc_and_compare, NULL);
}
static void test_hploc_of_few(void)    /* half a warp is not merged before the root: PLOC */
{
  paper_ploc_settings settings = {8};
  for (uint32_t count = 2; count <= 16; ++count) same_from_both(count, paper_hploc, paper_ploc, &settings);
}
/* Equal boxes: two by two, a balanced tree. */
static void ploc_of_equals(paper_build *p)
{
  uint32_t half = p->ref_count / 2;
  paper_ploc(p);
  for (uint32_t i = 0; i < 2; ++i) CHECK(trb_count(p->nodes[p->nodes[0].first + i].count) == half);
}
static void test_ploc_of_equals(void)
{
  for (size_t i = 0; i < SCENE_COUNT; ++i)
    if (!strcmp(scene_defs[i].name, "identical")) look_at(&scene_defs[i], 2048, ploc_of_equals, NULL);
}

// >>treelets --------------------------------------------------------------------------------------------------------
/* Both programs find the same cost, but for rounding: a sum of at most 13 terms, in another order. */
static void compare_treelets(const paper_treelet *treelets, trb_costs costs)
{
  float dp[TRB_LANES];
  paper_treelets_dp(treelets, costs, dp);
  for (uint32_t lane = 0; lane < TRB_LANES; ++lane) {
    uint64_t calls = 0;
    float naive = paper_treelet_naive(&treelets[lane], costs, &calls);
    CHECK_MSG(calls == 1149877, "%lu calls", (unsigned long)calls);
    CHECK_MSG(fabs((double)naive - dp[lane]) <= 1e-6 * naive, "naive %.9g, dynamic program %.9g", naive, dp[lane]);
  }
}
static void treelets_and_look(paper_build *p)
{
  paper_treelet treelets[TRB_LANES];
  paper_lbvh(p);
  CHECK(paper_sample_treelets(p, treelets, TRB_LANES) == TRB_LANES);
  for (uint32_t lane = 0; lane < TRB_LANES; ++lane)
    for (uint32_t i = 0; i < TRB_TREELET; ++i)
      for (uint32_t k = 0; k < i; ++k) {
        const trbvh_node *leaves = treelets[lane].leaves;
        CHECK(memcmp(&leaves[i], &leaves[k], sizeof *leaves));
      }
  compare_treelets(treelets, p->lib.costs);
}
static void test_treelets_of_scenes(void)
{
  for (size_t i = 0; i < SCENE_COUNT; ++i)
    if (scene_defs[i].flags & SCENE_ORDINARY) look_at(&scene_defs[i], 1000, treelets_and_look, NULL);
  CONTEXT("%s", "");
}
/* By trying all ways to join two of these subtrees, then two of what there is now, and so on. */
typedef struct subtree { trbvh_node box; double cost; uint32_t count; } subtree;
static double best_of_all_trees(const subtree *trees, uint32_t count, trb_costs costs)
{
  double best = DBL_MAX;
  if (count == 1) return trees[0].cost;
  for (uint32_t i = 0; i < count; ++i)
    for (uint32_t j = 0; j < i; ++j) {
      subtree next[TRB_TREELET], *parent = next;
      uint32_t kept = 1;
      for (uint32_t k = 0; k < count; ++k) if (k != i && k != j) next[kept++] = trees[k];
      parent->box = paper_union(trees[i].box, &trees[j].box);
      parent->count = trees[i].count + trees[j].count;
      parent->cost = trb_area(parent->box) + trees[i].cost + trees[j].cost;
      double leaf = (double)costs.ratio * trb_area(parent->box) * parent->count;
      if (parent->count <= costs.max_leaf && leaf < parent->cost) parent->cost = leaf;
      double cost = best_of_all_trees(next, kept, costs);
      if (cost < best) best = cost;
    }
  return best;
}
static void test_random_treelets(void)   /* of triangles, small subtrees and large ones, in all mixtures */
{
  rng r = {5};
  trb_costs costs = {1 / 1.2f, 8};
  for (uint32_t round = 0; round < QUICK_OR(3, 6); ++round) {
    paper_treelet treelets[TRB_LANES];
    for (uint32_t lane = 0; lane < TRB_LANES; ++lane)
      for (uint32_t i = 0; i < TRB_TREELET; ++i) {
        trbvh_node *leaf = &treelets[lane].leaves[i];
        uint32_t kind = rng_below(&r, round % 3 + 1);
        *leaf = trb_no_box();
        for (int k = 0; k < 3; ++k) {
          leaf->min[k] = rng_range(&r, -1, 1);
          leaf->max[k] = leaf->min[k] + rng_range(&r, 0, 0.5f);
        }
        *leaf = trb_reference(*leaf, costs);
        if (kind == 1) leaf->count = trb_small(2 + rng_below(&r, 7), 2 * trb_area(*leaf), 0);
        if (kind == 2) leaf->count = 9 + rng_below(&r, 100);
      }
    compare_treelets(treelets, costs);
    subtree trees[TRB_TREELET];
    for (uint32_t i = 0; i < TRB_TREELET; ++i) {
      const trbvh_node leaf = treelets[0].leaves[i];
      trees[i] = (subtree){leaf, trb_cost(leaf.count), trb_count(leaf.count)};
    }
    double best = best_of_all_trees(trees, TRB_TREELET, costs), naive = paper_treelet_naive(&treelets[0], costs, NULL);
    CHECK_MSG(fabs(naive - best) <= 1e-6 * best, "%.9g, but %.9g by trees", naive, best);
  }
}

static void run_curve_tests(void)
{
  RUN(test_hlbvh_scenes);
  RUN(test_grid_scenes);
  RUN(test_ploc_scenes);
  RUN(test_hploc_scenes);
  RUN(test_long_codes);
  RUN(test_curve_quality);
  RUN(test_hlbvh_clusters);
  RUN(test_hlbvh_one_cluster);
  RUN(test_grid_planes);
  RUN(test_ploc_by_definition);
  RUN(test_ploc_of_equals);
  RUN(test_hploc_by_definition);
  RUN(test_hploc_of_few);
  RUN(test_treelets_of_scenes);
  RUN(test_random_treelets);
}

#endif
