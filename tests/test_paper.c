/* The builders of examples/paper: valid trees of every scene, the same again, of the quality that theirs must have. */
#define TRBVH_IMPLEMENTATION
#include "../trbvh.h"
#include "test.h"
#include "paper.h"
#include "../examples/paper/sweep.h"

// >>sweep -----------------------------------------------------------------------------------------------------------
/* The least cost of any tree that splits by sorted centres, by trying them all. */
static double exhaustive(const trbvh_node *refs, uint32_t count)   /* of the best split at the root, A N summed up */
{
  double best = DBL_MAX;
  for (int axis = 0; axis < 3; ++axis)
    for (uint32_t pivot = 0; pivot < count; ++pivot) {
      trbvh_node side[2] = {trb_no_box(), trb_no_box()};
      uint32_t counts[2] = {0, 0};
      for (uint32_t i = 0; i < count; ++i) {
        float a = 0.5f * refs[i].min[axis] + 0.5f * refs[i].max[axis];
        float b = 0.5f * refs[pivot].min[axis] + 0.5f * refs[pivot].max[axis];
        int right = a > b || (a >= b && i >= pivot);
        side[right] = paper_union(side[right], &refs[i]);
        ++counts[right];
      }
      if (!counts[0] || !counts[1]) continue;
      double cost = (double)trb_area(side[0]) * counts[0] + (double)trb_area(side[1]) * counts[1];
      if (cost < best) best = cost;
    }
  return best;
}
static void sweep_and_look(paper_build *p)
{
  double best = exhaustive(p->refs, p->ref_count);
  paper_sweep(p);
  uint32_t first = p->nodes[0].first;
  double cost = 0;
  for (uint32_t i = first; i < first + 2; ++i) cost += (double)trb_area(p->nodes[i]) * trb_count(p->nodes[i].count);
  CHECK_MSG(cost <= best, "%g, but %g is possible", cost, best);
}
static void test_sweep_root(void)   /* the best split there is */
{
  for (size_t i = 0; i < SCENE_COUNT; ++i) {
    scene s;
    if (!(scene_defs[i].flags & SCENE_ORDINARY)) continue;
    scene_def small = scene_defs[i];
    small.full = small.quick = 500;
    scene_make(&s, &small);
    CONTEXT("scene %s", s.name);
    trbvh_geometry g = scene_geometry(&s);
    paper_tree t = paper_test_make(&g, sweep_and_look, NULL, 0, 0);
    trbvh_free(&t.bvh);
    scene_free(&s);
  }
}
static void test_sweep_scenes(void) { paper_test_scenes(paper_sweep, NULL, 0, 0, 20000); }
static void test_lbvh_scenes(void) { paper_test_scenes(paper_lbvh, NULL, 0, 0, 20000); }
static void test_lbvh_is_the_library_s(void)
{
  scene s;
  scene_make(&s, &scene_defs[0]);
  trbvh_geometry g = scene_geometry(&s);
  paper_tree t = paper_test_make(&g, paper_lbvh, NULL, 0, 0), r = paper_test_make(&g, paper_lbvh, NULL, 0, 3);
  trbvh_options o;
  memset(&o, 0, sizeof o);
  for (int quality = TRBVH_QUALITY_FAST; quality <= TRBVH_QUALITY_MEDIUM; ++quality) {
    trbvh want = {0};
    o.quality = (trbvh_quality)quality;
    CHECK(trbvh_build(&want, &g, &o) == TRBVH_OK);
    CHECK(same_tree(&want, quality == TRBVH_QUALITY_FAST ? &t.bvh : &r.bvh));
    trbvh_free(&want);
  }
  trbvh_free(&t.bvh);
  trbvh_free(&r.bvh);
  scene_free(&s);
}

int main(int argc, char **argv)
{
  test_start(argc, argv);
  RUN(test_sweep_root);
  RUN(test_sweep_scenes);
  RUN(test_lbvh_scenes);
  RUN(test_lbvh_is_the_library_s);
  return test_finish();
}
