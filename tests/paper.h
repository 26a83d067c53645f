/* What the tests of the builders in examples/paper share. Include it after trbvh.h's implementation and test.h. */
#ifndef TESTS_PAPER_H
#define TESTS_PAPER_H
#include "../examples/paper/judge.h"   /* before scenes.h, whose `scene` its variables would hide */
#include "scenes.h"

typedef struct paper_tree { trbvh bvh; trbvh_stats stats; } paper_tree;

static inline paper_tree paper_test_make(const trbvh_geometry *g, paper_builder *builder, const void *parameters,
    float split_budget, int rounds)
{
  paper_tree t;
  trbvh_options o;
  memset(&t, 0, sizeof t);
  memset(&o, 0, sizeof o);
  o.split_budget = split_budget;
  o.treelet_rounds = rounds;
  o.stats = &t.stats;
  CHECK(paper_make(&t.bvh, g, &o, builder, parameters, NULL) == TRBVH_OK);
  return t;
}
/* By an own walk, and by trbvh_validate. */
static inline void paper_test_tree(const paper_tree *t, const trbvh_geometry *g, int split)
{
  walk_info info;
  char why[256] = "";
  int ok = walk_tree(&t->bvh, g, 8, split, &info, why, sizeof why);
  CHECK_MSG(ok, "%s", why);
  if (!ok) return;
  CHECK_MSG(trbvh_validate(&t->bvh, g, why, sizeof why) == TRBVH_OK, "%s", why);
  double sah = walk_sah(&info, 1.2, 1);
  if (info.root_area > 0) CHECK_MSG(fabs(t->stats.sah_cost - sah) <= 1e-6 * sah, "stats %g, walk %g", t->stats.sah_cost, sah);
}
/* Every scene of up to `most` triangles: a valid tree; the same again; with splits, no more references than allowed. */
static inline void paper_test_scenes(paper_builder *builder, const void *parameters, float split_budget, int rounds,
    uint32_t most)
{
  for (size_t i = 0; i < SCENE_COUNT; ++i) {
    scene s;
    if (QUICK_OR(scene_defs[i].quick, scene_defs[i].full) > most) continue;
    scene_make(&s, &scene_defs[i]);
    CONTEXT("scene %s", s.name);
    trbvh_geometry g = scene_geometry(&s);
    paper_tree a = paper_test_make(&g, builder, parameters, split_budget, rounds);
    paper_tree b = paper_test_make(&g, builder, parameters, split_budget, rounds);
    paper_test_tree(&a, &g, split_budget > 0);
    CHECK_MSG(same_tree(&a.bvh, &b.bvh), "not the same tree again");
    CHECK(a.bvh.ref_count <= (1.0 + split_budget) * s.count);
    trbvh_free(&a.bvh);
    trbvh_free(&b.bvh);
    scene_free(&s);
  }
  CONTEXT("%s", "");
}
/* A builder over this scene, made of `count` triangles, for tests that wrap one to look at what is there. */
static inline void look_at(const scene_def *def, uint32_t count, paper_builder *builder, const void *parameters)
{
  scene s;
  scene_def small = *def;
  small.full = small.quick = count;
  scene_make(&s, &small);
  CONTEXT("scene %s, %u", s.name, count);
  trbvh_geometry g = scene_geometry(&s);
  paper_tree t = paper_test_make(&g, builder, parameters, 0, 0);
  paper_test_tree(&t, &g, 0);
  trbvh_free(&t.bvh);
  scene_free(&s);
}
static inline void look_at_all(int flags, uint32_t count, paper_builder *builder, const void *parameters)
{
  for (size_t i = 0; i < SCENE_COUNT; ++i)
    if ((scene_defs[i].flags & flags) == flags && scene_defs[i].full >= count)
      look_at(&scene_defs[i], count, builder, parameters);
  CONTEXT("%s", "");
}
/* SAH of a builder's tree of the scene of this name. */
static inline double paper_test_sah(const char *name, paper_builder *builder, const void *parameters, float split_budget,
    int rounds)
{
  double sah = 0;
  for (size_t i = 0; i < SCENE_COUNT; ++i) {
    scene s;
    if (strcmp(scene_defs[i].name, name)) continue;
    scene_make(&s, &scene_defs[i]);
    trbvh_geometry g = scene_geometry(&s);
    paper_tree t = paper_test_make(&g, builder, parameters, split_budget, rounds);
    sah = t.stats.sah_cost;
    trbvh_free(&t.bvh);
    scene_free(&s);
  }
  CHECK_MSG(sah > 0, "no scene %s", name);
  return sah;
}

/* The least A N of both sides, summed up, of all splits by the sorted centres of boxes, by trying them. */
static inline double best_by_centers(const trbvh_node *refs, uint32_t count)
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
      double cost = half_area(&side[0]) * counts[0] + half_area(&side[1]) * counts[1];
      if (cost < best) best = cost;
    }
  return best;
}

#endif
