/* Builds: every scene with every preset and in every form of input gives a tree that an independent walk accepts;
 * options mean what they say; building again reuses the block; trbvh_validate sees damage. */
#define TRBVH_IMPLEMENTATION
#include "../trbvh.h"
#include "test.h"
#include "scenes.h"

static uint32_t effective_max_leaf(const trbvh_options *o)
{
  return !o->max_leaf ? 8 : o->max_leaf > 16 ? 16 : o->max_leaf;
}
static double effective_cost(float cost, double preset) { return cost > 0 ? (double)cost : cost < 0 ? 0.0 : preset; }

/* Everything that must hold of a tree just built and of its stats. */
static void check_tree(const trbvh *bvh, const trbvh_geometry *g, const trbvh_options *o, int split, walk_info *info)
{
  char why[256] = "";
  const trbvh_stats *s = o->stats;
  double sah, ci = effective_cost(o->cost_node, 1.2), ct = effective_cost(o->cost_prim, 1.0);
  int ok = walk_tree(bvh, g, effective_max_leaf(o), split, info, why, sizeof why);
  CHECK_MSG(ok, "%s", why);
  if (!ok) return;
  strcpy(why, "untouched");
  CHECK_MSG(trbvh_validate(bvh, g, why, sizeof why) == TRBVH_OK, "%s", why);
  CHECK(trbvh_validate(bvh, NULL, NULL, 0) == TRBVH_OK);
  sah = walk_sah(info, ci, ct);
  if (info->root_area > 0) CHECK_MSG(fabs(trbvh_sah(bvh, o->cost_node, o->cost_prim) - sah) <= 1e-6 * sah,
      "trbvh_sah %.9g, equation 1 %.9g", trbvh_sah(bvh, o->cost_node, o->cost_prim), sah);
  CHECK_MSG(trbvh_sah(bvh, 0, 0) >= 0 && trbvh_sah(bvh, 0, 0) <= DBL_MAX, "trbvh_sah %g", trbvh_sah(bvh, 0, 0));
  if (s) {
    CHECK_MSG(s->node_count == bvh->node_count, "stats %u, tree %u", s->node_count, bvh->node_count);
    CHECK_MSG(s->leaf_count == info->leaves, "stats %u, walk %u", s->leaf_count, info->leaves);
    CHECK_MSG(s->ref_count == bvh->ref_count, "stats %u, tree %u", s->ref_count, bvh->ref_count);
    CHECK_MSG(s->max_depth == info->depth, "stats %u, walk %u", s->max_depth, info->depth);
    CHECK_MSG(s->skipped_count == info->skipped, "stats %u, walk %u", s->skipped_count, info->skipped);
    CHECK_MSG(info->root_area > 0 ? fabs(s->sah_cost - sah) <= 1e-6 * sah : s->sah_cost >= 0 && s->sah_cost <= DBL_MAX,
        "stats %.9g, walk %.9g", s->sah_cost, sah);
    CHECK(s->ms_total >= 0 && s->ms_split >= 0 && s->ms_morton >= 0 && s->ms_sort >= 0 && s->ms_hierarchy >= 0
        && s->ms_treelets >= 0 && s->ms_collapse >= 0 && s->ms_finish >= 0);
    CHECK(s->ms_transfer <= 0 && s->on_device == 0);
    CHECK_MSG(s->message[0] == 0, "message after a success: %s", s->message);
  }
}

static trbvh_result build_counted(trbvh *bvh, const trbvh_geometry *g, trbvh_options *o, counter *c, trbvh_stats *stats)
{
  memset(bvh, 0, sizeof *bvh);
  memset(c, 0, sizeof *c);
  memset(stats, 0x77, sizeof *stats);
  o->allocator = counter_allocator(c);
  o->stats = stats;
  return trbvh_build(bvh, g, o);
}

static void check_freed(trbvh *bvh, const counter *c)
{
  trbvh zero;
  memset(&zero, 0, sizeof zero);
  trbvh_free(bvh);
  CHECK(!bvh->nodes && !bvh->prims && !bvh->triangles && !bvh->wide && !bvh->block && !bvh->node_count
      && !bvh->ref_count && !bvh->prim_count);
  trbvh_free(bvh);
  CHECK_MSG(c->live == 0 && c->bad_frees == 0, "%u blocks live, %u bad frees", c->live, c->bad_frees);
}

static void test_every_scene_and_preset(void)
{
  unsigned i;
  int preset;
  for (i = 0; i < SCENE_COUNT; ++i) {
    scene s;
    trbvh_geometry g;
    scene_make(&s, &scene_defs[i]);
    g = scene_geometry(&s);
    for (preset = 0; preset < PRESET_COUNT; ++preset) {
      trbvh_options o = preset_options(preset);
      trbvh bvh;
      trbvh_stats stats;
      walk_info info;
      counter c;
      trbvh_result result;
      size_t scratch = 12345, bound;
      CONTEXT("scene %s, preset %s", s.name, preset_names[preset]);
      bound = trbvh_bytes_bound(&g, &o, &scratch);
      result = build_counted(&bvh, &g, &o, &c, &stats);
      CHECK_MSG(result == TRBVH_OK, "%s: %s", trbvh_result_text(result), stats.message);
      if (result) continue;
      check_tree(&bvh, &g, &o, preset >= 2, &info);
      CHECK_MSG(bvh.ref_count <= s.count + (uint32_t)((double)(preset == 2 ? 0.2f : preset == 3 ? 0.5f : 0) * s.count),
          "%u references of %u triangles", bvh.ref_count, s.count);
      CHECK(bvh.flags == 0 && bvh.prim_count == s.count);
      CHECK_MSG(c.allocs <= 2, "%u allocations", c.allocs);
      CHECK_MSG(c.live == (bvh.block != NULL), "%u blocks live", c.live);
      CHECK_MSG(c.live_bytes == bvh.block_size, "%zu bytes live, block_size %zu", c.live_bytes, bvh.block_size);
      CHECK_MSG(stats.bytes_result <= bound && bvh.block_size <= bound, "result %zu, block %zu, bound %zu",
          stats.bytes_result, bvh.block_size, bound);
      CHECK_MSG(stats.bytes_scratch <= scratch, "scratch %zu, bound %zu", stats.bytes_scratch, scratch);
      CHECK_MSG(c.peak_bytes <= bound + scratch, "peak %zu, bounds %zu and %zu", c.peak_bytes, bound, scratch);
      CHECK_MSG(c.largest <= (bound > scratch ? bound : scratch), "allocation of %zu, bounds %zu and %zu", c.largest,
          bound, scratch);
      CHECK_MSG(stats.bytes_result + stats.bytes_scratch >= c.peak_bytes, "stats %zu and %zu, peak %zu",
          stats.bytes_result, stats.bytes_scratch, c.peak_bytes);
      check_freed(&bvh, &c);
    }
    scene_free(&s);
  }
}

static int same_build(const trbvh *want, const trbvh_geometry *g, const trbvh_options *o)
{
  trbvh bvh;
  int same;
  trbvh_result result;
  memset(&bvh, 0, sizeof bvh);
  result = trbvh_build(&bvh, g, o);
  CHECK_MSG(result == TRBVH_OK, "%s", trbvh_result_text(result));
  same = result == TRBVH_OK && same_tree(want, &bvh);
  trbvh_free(&bvh);
  return same;
}

/* Vertices stride bytes apart, starting offset bytes past what malloc gives; garbage between them. */
static unsigned char *strided(const float *positions, uint32_t vertices, size_t stride, size_t offset)
{
  unsigned char *p = (unsigned char *)xmalloc(stride * vertices + offset + 12);
  uint32_t i;
  memset(p, 0xFF, stride * vertices + offset + 12);
  for (i = 0; i < vertices; ++i) memcpy(p + offset + stride * i, positions + 3 * i, 12);
  return p;
}

static void test_every_form_of_input(void)
{
  unsigned at;
  int preset;
  uint32_t i;
  for (at = 0; at < SCENE_COUNT; ++at) {
    scene s;
    trbvh_geometry soup, indexed, g;
    float *corners;
    unsigned char *odd, *odd_soup, *small, *wide;
    uint32_t *index;
    if (scene_defs[at].flags & SCENE_BIG) continue;
    scene_make(&s, &scene_defs[at]);
    corners = (float *)xmalloc(sizeof(float) * 9 * s.count);
    index = (uint32_t *)xmalloc(sizeof(uint32_t) * 3 * s.count);
    g = scene_geometry(&s);
    for (i = 0; i < s.count; ++i) geometry_triangle(&g, i, corners + 9 * i);
    for (i = 0; i < 3 * s.count; ++i) index[i] = s.indices ? s.indices[i] : i;
    memset(&soup, 0, sizeof soup);
    soup.positions = corners;
    soup.count = s.count;
    indexed = soup;
    indexed.positions = s.positions;
    indexed.position_count = s.vertex_count;
    indexed.indices = index;
    odd = strided(s.positions, s.vertex_count, 13, 1);
    odd_soup = strided(corners, 3 * s.count, 20, 3);
    small = (unsigned char *)xmalloc(6 * s.count + 1);
    wide = (unsigned char *)xmalloc(12 * s.count + 1);
    for (i = 0; i < 3 * s.count; ++i) {
      uint16_t half = (uint16_t)index[i];
      memcpy(small + 1 + 2 * i, &half, 2);
      memcpy(wide + 1 + 4 * i, &index[i], 4);
    }
    for (preset = 0; preset < PRESET_COUNT; ++preset) {
      trbvh_options o = preset_options(preset);
      trbvh bvh;
      memset(&bvh, 0, sizeof bvh);
      CONTEXT("scene %s, preset %s", s.name, preset_names[preset]);
      CHECK(trbvh_build(&bvh, &soup, &o) == TRBVH_OK);
      g = soup; g.position_count = 3 * s.count; g.position_stride = 12;
      CHECK_MSG(same_build(&bvh, &g, &o), "soup with its count and stride");
      g = indexed;
      CHECK_MSG(same_build(&bvh, &g, &o), "32-bit indices");
      g.indices = wide + 1; g.index_size = 4; g.positions = odd + 1; g.position_stride = 13;
      CHECK_MSG(same_build(&bvh, &g, &o), "unaligned 32-bit indices, stride 13");
      if (s.vertex_count <= 65536) {
        g.indices = small + 1; g.index_size = 2;
        CHECK_MSG(same_build(&bvh, &g, &o), "unaligned 16-bit indices, stride 13");
      }
      g = soup; g.positions = odd_soup + 3; g.position_stride = 20;
      CHECK_MSG(same_build(&bvh, &g, &o), "soup, unaligned, stride 20");
      trbvh_free(&bvh);
    }
    free(corners); free(index); free(odd); free(odd_soup); free(small); free(wide);
    scene_free(&s);
  }
}

static void test_boxes(void)
{
  unsigned at;
  int preset;
  uint32_t i;
  for (at = 0; at < SCENE_COUNT; ++at) {
    scene s;
    trbvh_geometry mesh, g;
    unsigned char *odd;
    float *boxes;
    if (scene_defs[at].flags & SCENE_BIG) continue;
    scene_make(&s, &scene_defs[at]);
    mesh = scene_geometry(&s);
    boxes = (float *)xmalloc(sizeof(float) * 6 * s.count);
    odd = (unsigned char *)xmalloc(31 * (size_t)s.count + 1);
    for (i = 0; i < s.count; ++i) {
      geometry_box(&mesh, i, boxes + 6 * i);
      if (i % 50 == 49) {                                          /* min > max, or flat */
        float *b = boxes + 6 * i + i / 50 % 3, x = b[0];
        b[0] = b[3];
        b[3] = x;
      }
      memcpy(odd + 1 + 31 * (size_t)i, boxes + 6 * i, 24);
    }
    memset(&g, 0, sizeof g);
    g.boxes = boxes;
    g.count = s.count;
    for (preset = 0; preset < PRESET_COUNT; ++preset) {
      trbvh_options o = preset_options(preset);
      trbvh bvh;
      trbvh_stats stats;
      walk_info info;
      counter c;
      trbvh_result result;
      trbvh_ray ray = {{0, 0, -5}, 0, {0.01f, 0.02f, 1}, 0};
      trbvh_hit hit;
      size_t scratch = 0, bound = trbvh_bytes_bound(&g, &o, &scratch);
      CONTEXT("boxes of scene %s, preset %s", s.name, preset_names[preset]);
      result = build_counted(&bvh, &g, &o, &c, &stats);
      CHECK_MSG(result == TRBVH_OK, "%s: %s", trbvh_result_text(result), stats.message);
      if (result) continue;
      check_tree(&bvh, &g, &o, 0, &info);
      CHECK_MSG(c.peak_bytes <= bound + scratch && c.largest <= (bound > scratch ? bound : scratch),
          "peak %zu, bounds %zu and %zu", c.peak_bytes, bound, scratch);
      CHECK(!trbvh_intersect(&bvh, &ray, &hit) && hit.prim == TRBVH_NONE && !trbvh_occluded(&bvh, &ray));
      hit.prim = 5;
      result = trbvh_intersect_n(&bvh, &ray, &hit, 1, NULL);
      CHECK_MSG(result == TRBVH_INVALID_ARGUMENT || (result == TRBVH_OK && hit.prim == TRBVH_NONE), "%s, prim %u",
          trbvh_result_text(result), hit.prim);
      g.boxes = odd + 1; g.box_stride = 31;
      CHECK_MSG(same_build(&bvh, &g, &o), "unaligned boxes, stride 31");
      g.boxes = boxes; g.box_stride = 0;
      check_freed(&bvh, &c);
    }
    free(boxes);
    free(odd);
    scene_free(&s);
  }
}

/* The presets are nothing but options. */
static void test_what_presets_mean(void)
{
  unsigned split = 0, whole = 0, at;
  for (at = 0; at < SCENE_COUNT; ++at) {
    scene s;
    trbvh_geometry g;
    trbvh_options o, fast = preset_options(0), medium = preset_options(1);
    trbvh_options high = preset_options(2), best = preset_options(3);
    trbvh tree_fast, tree_medium, tree_high, tree_paper;
    if (scene_defs[at].flags & SCENE_BIG) continue;
    scene_make(&s, &scene_defs[at]);
    g = scene_geometry(&s);
    CONTEXT("scene %s", s.name);
    memset(&tree_fast, 0, sizeof tree_fast);
    memset(&tree_medium, 0, sizeof tree_medium);
    memset(&tree_high, 0, sizeof tree_high);
    memset(&tree_paper, 0, sizeof tree_paper);
    CHECK(trbvh_build(&tree_fast, &g, &fast) == TRBVH_OK);
    CHECK(trbvh_build(&tree_medium, &g, &medium) == TRBVH_OK);
    CHECK(trbvh_build(&tree_high, &g, &high) == TRBVH_OK);
    CHECK_MSG(same_build(&tree_medium, &g, NULL), "no options = MEDIUM");
    memset(&o, 0, sizeof o);
    CHECK_MSG(same_build(&tree_medium, &g, &o), "zeroed options = MEDIUM");
    o = fast; o.treelet_rounds = 3; o.treelet_gamma = 7; o.reinsert_share = 0.04f;
    CHECK_MSG(same_build(&tree_medium, &g, &o), "FAST, three rounds and reinsertion = MEDIUM");
    o.split_budget = 0.2f; o.unsplit_passes = 1;
    CHECK_MSG(same_build(&tree_high, &g, &o), "and splits, and a pass to take them back = HIGH");
    o = medium; o.treelet_rounds = -1;
    CHECK_MSG(same_build(&tree_fast, &g, &o), "MEDIUM without rounds = FAST");
    o = medium; o.split_budget = 0.2f; o.unsplit_passes = 1;
    CHECK_MSG(same_build(&tree_high, &g, &o), "MEDIUM and splits = HIGH");
    o = high; o.split_budget = -1;
    CHECK_MSG(same_build(&tree_medium, &g, &o), "HIGH without splits = MEDIUM");
    o = best; o.treelet_rounds = 3; o.reinsert_share = 0.04f; o.split_budget = 0.2f; o.unsplit_passes = 1;
    CHECK_MSG(same_build(&tree_high, &g, &o), "BEST with HIGH's settings = HIGH");
    o = medium; o.reinsert_share = -1;
    CHECK(trbvh_build(&tree_paper, &g, &o) == TRBVH_OK);
    o = fast; o.treelet_rounds = 3;
    CHECK_MSG(same_build(&tree_paper, &g, &o), "MEDIUM without reinsertion = the paper's");
    o = high; o.max_leaf = 8; o.cost_node = 1.2f; o.cost_prim = 1.0f;
    CHECK_MSG(same_build(&tree_high, &g, &o), "defaults spelled out");
    if (s.count > 1000 && (scene_defs[at].flags & SCENE_ORDINARY)) {
      CHECK_MSG(!same_tree(&tree_fast, &tree_medium), "the rounds do something");
      if (same_tree(&tree_high, &tree_medium)) whole++;
      else if (tree_high.ref_count > tree_medium.ref_count) split++;
      CHECK_MSG(trbvh_sah(&tree_high, 0, 0) <= trbvh_sah(&tree_medium, 0, 0) * 1.005, "HIGH's SAH is worse than MEDIUM's");
    }
    trbvh_free(&tree_fast); trbvh_free(&tree_medium); trbvh_free(&tree_paper);
    trbvh_free(&tree_high);
    scene_free(&s);
  }
  CHECK_MSG(split && whole, "splits were kept in %u scenes, not in %u", split, whole);
}

static double sah_with(const trbvh_geometry *g, const trbvh_options *options, uint32_t *refs)
{
  trbvh bvh;
  trbvh_stats stats;
  walk_info info;
  trbvh_options o = *options;
  memset(&bvh, 0, sizeof bvh);
  memset(&stats, 0, sizeof stats);
  o.stats = &stats;
  CHECK(trbvh_build(&bvh, g, &o) == TRBVH_OK);
  check_tree(&bvh, g, &o, o.split_budget > 0 || o.quality >= TRBVH_QUALITY_HIGH, &info);
  if (refs) *refs = bvh.ref_count;
  trbvh_free(&bvh);
  return stats.sah_cost;
}

/* The paper's rounds only ever improve a tree. Moves do too, but not the rounds after them by as much each time. */
static void test_sah_order(void)
{
  unsigned at;
  for (at = 0; at < SCENE_COUNT; ++at) {
    static const int32_t rounds[] = {-1, 1, 3, 5};
    scene s;
    trbvh_geometry g;
    double paper[4], medium, five;
    trbvh_options o;
    unsigned i;
    if (!(scene_defs[at].flags & SCENE_ORDINARY)) continue;
    scene_make(&s, &scene_defs[at]);
    g = scene_geometry(&s);
    CONTEXT("scene %s", s.name);
    for (i = 0; i < 4; ++i) {
      o = preset_options(0);
      o.treelet_rounds = rounds[i];
      paper[i] = sah_with(&g, &o, NULL);
    }
    o = preset_options(1);
    medium = sah_with(&g, &o, NULL);
    o.treelet_rounds = 5;
    five = sah_with(&g, &o, NULL);
    CHECK_MSG(paper[0] * 1.0001 >= paper[1] && paper[1] * 1.0001 >= paper[2] && paper[2] * 1.0001 >= paper[3],
        "the paper's rounds, 0, 1, 3, 5: SAH %g, %g, %g, %g", paper[0], paper[1], paper[2], paper[3]);
    CHECK_MSG(paper[2] * 1.01 >= medium && medium * 1.01 >= five, "the paper's rounds, MEDIUM, 5 of them: SAH %g, %g, %g",
        paper[2], medium, five);
    if (strcmp(s.name, "huge_and_tiny"))
      CHECK_MSG(medium < paper[0] * 0.99, "treelets gain nothing: %g, %g", paper[0], medium);
    scene_free(&s);
  }
}

static void test_options(void)
{
  static const uint32_t leaves[] = {1, 2, 3, 4, 8, 15, 16, 17, 100, 0xFFFFFFFFu};
  static const int32_t rounds[] = {-1, -2147483647 - 1, 1, 2, 5, 40, 2147483647};
  static const float costs[] = {-1, 0.001f, 1, 4, 1000};
  static const float budgets[] = {-1, 1e-6f, 0.01f, 0.1f, 0.5f, 1, 3, 16};
  static const char *const names[] = {"random", "slivers", "room", "duplicates", "city", "deep", "n7", "n9"};
  unsigned at, n, i;
  int preset;
  for (n = 0; n < sizeof names / sizeof names[0]; ++n)
    for (at = 0; at < SCENE_COUNT; ++at) {
      scene s;
      trbvh_geometry g;
      uint32_t refs = 0, last = 0;
      if (strcmp(scene_defs[at].name, names[n])) continue;
      memset(&s, 0, sizeof s);
      s.name = names[n];
      scene_defs[at].make(&s, scene_defs[at].full > 3000 ? 3000 : scene_defs[at].full);
      g = scene_geometry(&s);
      for (preset = 0; preset < 3; ++preset)
        for (i = 0; i < sizeof leaves / sizeof leaves[0]; ++i) {
          trbvh_options o = preset_options(preset);
          o.max_leaf = leaves[i];
          CONTEXT("scene %s, preset %s, max_leaf %u", s.name, preset_names[preset], leaves[i]);
          sah_with(&g, &o, NULL);
        }
      for (i = 0; i < sizeof rounds / sizeof rounds[0]; ++i) {
        trbvh_options o = preset_options((int)i % 3);
        o.treelet_rounds = rounds[i];
        CONTEXT("scene %s, treelet_rounds %d", s.name, (int)rounds[i]);
        sah_with(&g, &o, NULL);
      }
      for (i = 0; i < 25; ++i) {
        trbvh_options o = preset_options((int)i % 3);
        o.cost_node = costs[i / 5];
        o.cost_prim = costs[i % 5];
        CONTEXT("scene %s, costs %g %g", s.name, (double)o.cost_node, (double)o.cost_prim);
        sah_with(&g, &o, NULL);
      }
      for (i = 0; i < sizeof budgets / sizeof budgets[0]; ++i) {
        trbvh_options o = preset_options(1);
        o.split_budget = budgets[i];
        CONTEXT("scene %s, split_budget %g", s.name, (double)budgets[i]);
        sah_with(&g, &o, &refs);
        CHECK_MSG(refs <= s.count + (budgets[i] > 0 ? (double)budgets[i] * s.count : 0.0),
            "%u references of %u triangles", refs, s.count);
        if (!strcmp(s.name, "slivers") && budgets[i] <= 1 && budgets[i] * (float)s.count > 1) {
          CHECK_MSG(refs > last && (double)refs > s.count + 0.5 * (double)budgets[i] * s.count,
              "%u references, budget hardly used; last %u", refs, last);
          last = refs;
        }
      }
      scene_free(&s);
    }
}

/* More of what a leaf costs, smaller leaves; and the other way round. */
static void test_costs_matter(void)
{
  scene s;
  trbvh_geometry g;
  trbvh_options o;
  trbvh a, b;
  memset(&s, 0, sizeof s);
  memset(&a, 0, sizeof a);
  memset(&b, 0, sizeof b);
  make_terrain(&s, 3000);
  g = scene_geometry(&s);
  o = preset_options(1);
  o.cost_node = 100;
  CHECK(trbvh_build(&a, &g, &o) == TRBVH_OK);
  o.cost_node = 0.01f;
  CHECK(trbvh_build(&b, &g, &o) == TRBVH_OK);
  CHECK_MSG(b.node_count > a.node_count, "%u nodes where nodes are cheap, %u where they are dear", b.node_count,
      a.node_count);
  o.max_leaf = 1;
  CHECK(trbvh_build(&b, &g, &o) == TRBVH_OK);
  CHECK_MSG(b.node_count == 2 * s.count, "%u nodes for %u triangles of their own", b.node_count, s.count);
  trbvh_free(&a);
  trbvh_free(&b);
  scene_free(&s);
}

static void test_depth_is_bounded(void)
{
  static const char *const names[] = {"deep", "deep_bushy", "series", "nested", "duplicates", "one_point", "clusters",
      "all_exponents", "identical"};
  unsigned at, n;
  int preset, rounds;
  for (n = 0; n < sizeof names / sizeof names[0]; ++n)
    for (at = 0; at < SCENE_COUNT; ++at) {
      scene s;
      trbvh_geometry g;
      if (strcmp(scene_defs[at].name, names[n])) continue;
      memset(&s, 0, sizeof s);
      s.name = names[n];
      scene_defs[at].make(&s, QUICK_OR(5000, 40000));
      g = scene_geometry(&s);
      for (preset = 0; preset < 3; preset += 2)
        for (rounds = -1; rounds <= 7; rounds += 4) {
          trbvh_options o = preset_options(preset);
          o.max_leaf = 1;
          o.treelet_rounds = rounds;
          o.cost_node = 0.01f;
          if (preset) o.split_budget = 1;
          CONTEXT("scene %s, preset %s, %d rounds, a leaf each", s.name, preset_names[preset], rounds);
          sah_with(&g, &o, NULL);          /* walks the tree, depth included */
        }
      scene_free(&s);
    }
}

static void test_no_triangles_flag(void)
{
  scene s;
  trbvh_geometry g;
  int preset;
  memset(&s, 0, sizeof s);
  make_random(&s, 2000);
  g = scene_geometry(&s);
  for (preset = 0; preset < PRESET_COUNT; ++preset) {
    trbvh_options o = preset_options(preset);
    trbvh with, without;
    trbvh_stats stats;
    walk_info info;
    trbvh_ray ray = {{0, 0, -5}, 0, {0, 0, 0}, 0};
    trbvh_hit hit;
    int k;
    size_t bound_with = trbvh_bytes_bound(&g, &o, NULL), bound;
    memset(&with, 0, sizeof with);
    memset(&without, 0, sizeof without);
    memset(&stats, 0, sizeof stats);
    CONTEXT("preset %s", preset_names[preset]);
    for (k = 0; k < 3; ++k) ray.dir[k] = (s.positions[k] + s.positions[3 + k] + s.positions[6 + k]) / 3 - ray.origin[k];
    CHECK(trbvh_build(&with, &g, &o) == TRBVH_OK);
    o.flags = TRBVH_NO_TRIANGLES;
    o.stats = &stats;
    bound = trbvh_bytes_bound(&g, &o, NULL);
    CHECK_MSG(bound < bound_with, "bounds %zu, %zu", bound, bound_with);
    CHECK(trbvh_build(&without, &g, &o) == TRBVH_OK);
    CHECK(!without.triangles && without.flags == TRBVH_NO_TRIANGLES && same_tree(&with, &without));
    CHECK_MSG(without.block_size <= bound && without.block_size < with.block_size, "blocks %zu, %zu",
        without.block_size, with.block_size);
    check_tree(&without, &g, &o, preset >= 2, &info);
    CHECK(trbvh_intersect(&with, &ray, &hit));
    CHECK(!trbvh_intersect(&without, &ray, &hit) && hit.prim == TRBVH_NONE && !trbvh_occluded(&without, &ray));
    trbvh_free(&with);
    trbvh_free(&without);
  }

  {
    trbvh_options o = preset_options(1);
    trbvh bvh;
    memset(&bvh, 0, sizeof bvh);
    o.flags = TRBVH_NO_FALLBACK;                                    /* no device asked for: nothing to fall back from */
    CHECK(trbvh_build(&bvh, &g, &o) == TRBVH_OK && bvh.flags == TRBVH_NO_FALLBACK);
    trbvh_free(&bvh);
  }
  scene_free(&s);
}

static void test_rebuild(void)
{
  static const struct { int scene_size; int preset; int reuse; } steps[] = {
    {3000, 1, 0}, {3000, 1, 1}, {2000, 1, 1}, {3000, 0, 0}, {0, 1, 0}, {100, 2, 0}, {6000, 2, 0}, {3000, 2, 1},
    {1, 0, 1}, {6000, 2, 1}
  };
  unsigned i;
  counter c, other;
  trbvh bvh;
  memset(&bvh, 0, sizeof bvh);
  memset(&c, 0, sizeof c);
  for (i = 0; i < sizeof steps / sizeof steps[0]; ++i) {
    scene s;
    trbvh_geometry g;
    trbvh_options o = preset_options(steps[i].preset);
    walk_info info;
    trbvh_stats stats;
    unsigned before = c.allocs;
    void *block = bvh.block;
    memset(&s, 0, sizeof s);
    make_random(&s, (uint32_t)steps[i].scene_size);
    g = scene_geometry(&s);
    o.allocator = counter_allocator(&c);
    o.stats = &stats;
    CONTEXT("step %u: %d triangles", i, steps[i].scene_size);
    CHECK(trbvh_build(&bvh, &g, &o) == TRBVH_OK);
    check_tree(&bvh, &g, &o, steps[i].preset >= 2, &info);
    CHECK_MSG(c.allocs - before <= (steps[i].reuse ? 1u : 2u), "%u allocations", c.allocs - before);
    if (steps[i].reuse) CHECK_MSG(block && bvh.block == block, "the block was not reused");
    CHECK_MSG(c.live == (bvh.block != NULL) && c.live_bytes == bvh.block_size && !c.bad_frees,
        "%u live, %zu bytes, block_size %zu", c.live, c.live_bytes, bvh.block_size);
    memset(&o.allocator, 0, sizeof o.allocator);
    CHECK_MSG(same_build(&bvh, &g, &o), "a tree built again differs from a new one");
    scene_free(&s);
  }
  { /* another allocator: memory goes back to the one that it came from */
    scene s;
    trbvh_geometry g;
    trbvh_options o = preset_options(1);
    memset(&s, 0, sizeof s);
    memset(&other, 0, sizeof other);
    make_random(&s, 20000);
    g = scene_geometry(&s);
    CONTEXT("another allocator");
    o.allocator = counter_allocator(&other);
    CHECK(trbvh_build(&bvh, &g, &o) == TRBVH_OK);
    CHECK_MSG(c.live == 0 && c.bad_frees == 0 && other.live == 1 && other.bad_frees == 0,
        "%u and %u live, %u and %u bad frees", c.live, other.live, c.bad_frees, other.bad_frees);
    memset(&o.allocator, 0, sizeof o.allocator);
    g.count = 10;
    CHECK(trbvh_build(&bvh, &g, &o) == TRBVH_OK);                   /* small: may or may not stay where it is */
    CHECK(same_build(&bvh, &g, &o));
    trbvh_free(&bvh);
    CHECK_MSG(other.live == 0 && other.bad_frees == 0, "%u live, %u bad frees", other.live, other.bad_frees);
    scene_free(&s);
  }
}

static void test_empty(void)
{
  trbvh_geometry g;
  trbvh bvh;
  trbvh_ray ray = {{0, 0, -5}, 0, {0, 0, 1}, 0};
  trbvh_hit hit;
  uint8_t occluded = 7;
  char why[64] = "";
  int preset, form;
  float place[3] = {0, 0, 0};
  uint32_t no_index = 0;
  for (preset = 0; preset < PRESET_COUNT; ++preset)
    for (form = 0; form < 4; ++form) {
      trbvh_options o = preset_options(preset);
      trbvh_stats stats;
      trbvh_result result;
      memset(&g, 0, sizeof g);
      memset(&bvh, 0, sizeof bvh);
      memset(&hit, 0x55, sizeof hit);
      if (form & 1) { g.positions = place; g.position_count = 1; }
      if (form == 3) g.indices = &no_index;
      if (form == 2) g.boxes = place;
      o.stats = &stats;
      CONTEXT("preset %s, form %d", preset_names[preset], form);
      result = trbvh_build(&bvh, &g, &o);
      CHECK_MSG(result == TRBVH_OK, "%s", trbvh_result_text(result));
      CHECK(!bvh.nodes && !bvh.node_count && !bvh.ref_count && !bvh.prim_count);
      CHECK(!stats.node_count && !stats.leaf_count && !stats.ref_count && !stats.max_depth && !stats.skipped_count
          && fabs(stats.sah_cost) <= 0);
      CHECK(!trbvh_intersect(&bvh, &ray, &hit) && hit.prim == TRBVH_NONE && hit.instance == TRBVH_NONE
          && hit.t >= FLT_MAX && fabs((double)hit.u) + fabs((double)hit.v) <= 0);
      CHECK(!trbvh_occluded(&bvh, &ray));
      CHECK(trbvh_intersect_n(&bvh, &ray, &hit, 1, NULL) == TRBVH_OK && hit.prim == TRBVH_NONE);
      CHECK(trbvh_occluded_n(&bvh, &ray, &occluded, 1, &o) == TRBVH_OK && occluded == 0);
      CHECK_MSG(trbvh_validate(&bvh, &g, why, sizeof why) == TRBVH_OK, "%s", why);
      CHECK(fabs(trbvh_sah(&bvh, 0, 0)) <= 0);
      trbvh_free(&bvh);
    }
  memset(&bvh, 0, sizeof bvh);
  trbvh_free(&bvh);
  trbvh_free(&bvh);
  trbvh_free(NULL);
  CHECK(!trbvh_intersect(&bvh, &ray, &hit));
}

static void test_bytes_bound(void)
{
  trbvh_geometry g;
  trbvh_options o = preset_options(1);
  float place[9] = {0};
  uint32_t n;
  size_t last = 0, last_scratch = 0, scratch = 99;
  memset(&g, 0, sizeof g);
  g.positions = place;
  for (n = 1; n < 100000000u; n = n * 3 + 1) {
    size_t bound;
    g.count = n;
    bound = trbvh_bytes_bound(&g, &o, &scratch);
    CHECK_MSG(bound > last && scratch >= last_scratch, "%u triangles: %zu, %zu; fewer: %zu, %zu", n, bound, scratch,
        last, last_scratch);
    CHECK_MSG(bound == trbvh_bytes_bound(&g, NULL, NULL), "%u triangles", n);
    CHECK_MSG(bound / n <= 64 + 4 + 48 + 1024 / n, "%zu bytes for %u triangles", bound, n);
    last = bound;
    last_scratch = scratch;
  }
  scratch = 99;
  CHECK(trbvh_bytes_bound(NULL, &o, &scratch) == 0 && scratch == 0);
  g.count = 1;
  g.position_stride = 3;
  scratch = 99;
  CHECK(trbvh_bytes_bound(&g, &o, &scratch) == 0 && scratch == 0);
}

/* What bytes_bound promises is enough, and not much more than enough; what a build takes is little. */
static void test_memory(void)
{
  static const struct { const char *name; void (*make)(scene *s, uint32_t n); uint32_t full, tree; } meshes[] = {
    {"random", make_random, 100000, 40}, {"sphere", make_sphere, 120000, 41}, {"rock", make_rock, 110000, 40},
    {"room", make_room, 130000, 40}, {"terrain", make_terrain, 200000, 40}, {"slivers", make_slivers, 100000, 40},
    {"city", make_city, 120000, 40}, {"clusters", make_clusters, 100000, 40},
    {"not_finite", make_not_finite, 100000, 40}, {"duplicates", make_duplicates, 100000, 40},
    {"small", make_random, 900, 68},
    {"huge_and_tiny", make_huge_and_tiny, 100000, 68}               /* a leaf each pays there */
  };
  unsigned at, flags;
  int preset;
  for (at = 0; at < sizeof meshes / sizeof meshes[0]; ++at) {
    scene s;
    trbvh_geometry g;
    memset(&s, 0, sizeof s);
    meshes[at].make(&s, QUICK_OR(meshes[at].full / 6, meshes[at].full));
    g = scene_geometry(&s);
    for (preset = -1; preset < PRESET_COUNT; ++preset)               /* -1: default options */
      for (flags = 0; flags <= TRBVH_NO_TRIANGLES; flags += TRBVH_NO_TRIANGLES) {
        trbvh_options o = preset_options(preset < 0 ? 0 : preset);
        trbvh bvh;
        trbvh_stats stats;
        counter c;
        size_t scratch = 0, bound, used;
        if (preset < 0) memset(&o, 0, sizeof o);
        o.flags = flags;
        CONTEXT("%s, %u triangles, preset %s, flags %u", meshes[at].name, s.count,
            preset < 0 ? "none" : preset_names[preset], flags);
        bound = trbvh_bytes_bound(&g, &o, &scratch);
        CHECK(build_counted(&bvh, &g, &o, &c, &stats) == TRBVH_OK);
        CHECK_MSG(c.allocs == 2 && c.sizes[0] <= scratch && c.sizes[1] <= bound,
            "%u allocations, %zu and %zu, bounds %zu and %zu", c.allocs, c.sizes[0], c.sizes[1], scratch, bound);
        CHECK_MSG(c.sizes[0] == stats.bytes_scratch && c.sizes[1] == stats.bytes_result,
            "%zu and %zu, stats %zu and %zu", c.sizes[0], c.sizes[1], stats.bytes_scratch, stats.bytes_result);
        used = stats.bytes_result + stats.bytes_scratch;
        CHECK_MSG(c.peak_bytes <= bound + scratch && c.peak_bytes <= used, "peak %zu, bounds %zu and %zu, stats %zu",
            c.peak_bytes, bound, scratch, used);
        if (preset < 0 && !flags)
          CHECK_MSG((double)(bound + scratch) <= 1.5 * (double)used, "bounds %zu and %zu, %zu used", bound, scratch,
              used);
        if (abs(preset) == 1 && flags && s.count > 99000) {          /* MEDIUM; no splits, no triangles */
          const double all = (double)c.peak_bytes / s.count, tree = (double)stats.bytes_result / s.count;
          CHECK_MSG(all <= 80 + meshes[at].tree + (meshes[at].tree > 40), "%.1f bytes a triangle", all);
          CHECK_MSG(tree <= meshes[at].tree, "a tree of %.1f bytes a triangle", tree);
          CHECK_MSG((double)stats.bytes_scratch <= 82.0 * s.count, "%zu bytes of scratch memory", stats.bytes_scratch);
        }
        check_freed(&bvh, &c);
      }
    scene_free(&s);
  }
}

// >>damage ----------------------------------------------------------------------------------------------------------
typedef struct tree_copy { trbvh bvh; trbvh_node *nodes; uint32_t *prims; trbvh_triangle *triangles; void *memory; } tree_copy;

static void copy_tree(tree_copy *copy, const trbvh *from)
{
  size_t nodes = sizeof(trbvh_node) * (from->node_count + 4), refs = from->ref_count + 4;
  copy->memory = xmalloc(nodes + 64);
  copy->nodes = (trbvh_node *)(void *)((unsigned char *)copy->memory + (64 - (uintptr_t)copy->memory % 64));
  copy->prims = (uint32_t *)xmalloc(sizeof(uint32_t) * refs);
  copy->triangles = (trbvh_triangle *)xmalloc(sizeof(trbvh_triangle) * refs);
  memset(copy->nodes, 0, nodes);
  memset(copy->prims, 0, sizeof(uint32_t) * refs);
  memset(copy->triangles, 0, sizeof(trbvh_triangle) * refs);
  memcpy(copy->nodes, from->nodes, sizeof(trbvh_node) * from->node_count);
  memcpy(copy->prims, from->prims, sizeof(uint32_t) * from->ref_count);
  memcpy(copy->triangles, from->triangles, sizeof(trbvh_triangle) * from->ref_count);
  copy->bvh = *from;
  copy->bvh.nodes = copy->nodes;
  copy->bvh.prims = copy->prims;
  copy->bvh.triangles = copy->triangles;
  copy->bvh.block = NULL;
  copy->bvh.block_size = 0;
}
static void free_copy(tree_copy *copy) { free(copy->memory); free(copy->prims); free(copy->triangles); }

static uint32_t find_node(const trbvh *bvh, uint32_t from, int leaf)
{
  while (from < bvh->node_count && (from == 1 || (bvh->nodes[from].count != 0) != leaf)) ++from;
  if (from >= bvh->node_count) { printf("no such node in the test's tree\n"); exit(2); }
  return from;
}

/* Each kind of damage; from NEEDS_GEOMETRY on, only the geometry tells. One list for the enumeration and the names. */
#define DAMAGES(X) \
  X(CHILD_ODD) X(CHILD_BEYOND) X(CHILD_IS_ROOT) X(CHILD_CYCLE) X(CHILD_SHARED) X(CHILD_HUGE) X(CYCLE_ALIKE) \
  X(SHARED_ALIKE) X(LEAF_FIRST) X(LEAF_FIRST_HUGE) X(LEAF_COUNT) X(LEAF_COUNT_HUGE) X(LEAF_LONGER) X(LEAF_SHORTER) \
  X(LEAF_TO_INNER) X(INNER_TO_LEAF) X(BOX_OUTSIDE_PARENT) X(BOX_NAN) X(BOX_INVERTED) X(ROOT_BOX_SHRUNK) \
  X(PRIM_BEYOND) X(PRIM_HUGE) X(PADDING) X(NODE_COUNT_MORE) X(NODE_COUNT_LESS) X(NODE_COUNT_ZERO) X(NODE_COUNT_ODD) \
  X(REF_COUNT_MORE) X(REF_COUNT_LESS) X(NODES_NULL) X(PRIMS_NULL) X(NODES_ALIGNMENT) X(TRIANGLE_PRIM) \
  X(NEEDS_GEOMETRY) \
  X(LEAF_BOX_SHRUNK) X(PRIM_LOST) X(PRIMS_SWAPPED) X(TRIANGLE_V0) X(TRIANGLE_E1) X(TRIANGLE_E2) X(PRIM_COUNT) \
  X(GEOMETRY_MOVED) X(GEOMETRY_COUNT)
#define X(name) name,
enum { DAMAGES(X) DAMAGE_COUNT };
#undef X
#define X(name) #name,
static const char *const damage_names[] = { DAMAGES(X) "" };
#undef X

static void damage(int kind, tree_copy *t, trbvh_geometry *g, float *positions)
{
  trbvh *b = &t->bvh;
  trbvh_node *n = t->nodes;
  uint32_t inner = find_node(b, 2, 0), inner2 = find_node(b, inner + 1, 0);
  uint32_t leaf = find_node(b, 2, 1), leaf2 = find_node(b, leaf + 1, 1);
  uint32_t last = b->ref_count - 1;
  switch (kind) {
    case CHILD_ODD:          n[inner].first += 1; break;
    case CHILD_BEYOND:       n[inner].first = b->node_count; break;
    case CHILD_IS_ROOT:      n[inner].first = 0; break;
    case CHILD_CYCLE:        n[inner].first = inner & ~1u; break;
    case CHILD_SHARED:       n[inner].first = n[inner2].first; break;
    case CHILD_HUGE:         n[inner].first = 0xFFFFFFFEu; break;
    case CYCLE_ALIKE: case SHARED_ALIKE:                   /* all boxes alike: nothing but the links is wrong */
      for (last = 2; last < b->node_count; ++last) {
        memcpy(n[last].min, n[0].min, 12);
        memcpy(n[last].max, n[0].max, 12);
      }
      n[inner].first = kind == CYCLE_ALIKE ? inner & ~1u : n[inner2].first;
      break;
    case LEAF_FIRST:         n[leaf].first = b->ref_count; break;
    case LEAF_FIRST_HUGE:    n[leaf].first = 0xFFFFFFFFu; break;
    case LEAF_COUNT:         n[leaf].count = b->ref_count + 1; break;
    case LEAF_COUNT_HUGE:    n[leaf].count = 0xFFFFFFFFu; break;
    case LEAF_LONGER:
      while (n[leaf].first + n[leaf].count > last) leaf = find_node(b, leaf + 1, 1);
      n[leaf].count += 1;
      break;
    case LEAF_SHORTER:       while (n[leaf].count < 2) leaf = find_node(b, leaf + 1, 1); n[leaf].count -= 1; break;
    case LEAF_TO_INNER:      n[leaf].count = 0; n[leaf].first = n[inner2].first; break;
    case INNER_TO_LEAF:      n[inner].count = 1; n[inner].first = 0; break;
    case BOX_OUTSIDE_PARENT: n[leaf2].max[1] = n[0].max[1] + 1; break;
    case BOX_NAN:            n[leaf2].min[2] = bad_float(0); break;
    case BOX_INVERTED:       n[leaf].min[0] = n[leaf].max[0] + 0.5f; break;
    case ROOT_BOX_SHRUNK:    n[0].max[0] = n[0].max[0] * 0.5f; break;
    case PRIM_BEYOND:        t->prims[last / 2] = t->triangles[last / 2].prim = b->prim_count; break;
    case PRIM_HUGE:          t->prims[last / 2] = t->triangles[last / 2].prim = 0xFFFFFFFFu; break;
    case PADDING:            n[1].count = 1; break;
    case NODE_COUNT_MORE:    b->node_count += 2; break;
    case NODE_COUNT_LESS:    b->node_count -= 2; break;
    case NODE_COUNT_ZERO:    b->node_count = 0; break;
    case NODE_COUNT_ODD:     b->node_count += 1; break;
    case REF_COUNT_MORE:     b->ref_count += 1; break;
    case REF_COUNT_LESS:     b->ref_count -= 1; break;
    case NODES_NULL:         b->nodes = NULL; break;
    case PRIMS_NULL:         b->prims = NULL; break;
    case NODES_ALIGNMENT:    memmove(n + 1, n, sizeof *n * b->node_count); b->nodes = n + 1; break;
    case TRIANGLE_PRIM:      t->triangles[last].prim ^= 1; break;
    case LEAF_BOX_SHRUNK:    n[leaf].max[0] = n[leaf].min[0]; break;
    case PRIM_LOST:          t->prims[0] = t->prims[last]; t->triangles[0] = t->triangles[last]; break;
    case PRIMS_SWAPPED: {    /* their data too: only the boxes tell */
      trbvh_triangle moved = t->triangles[0];
      t->triangles[0] = t->triangles[last]; t->triangles[last] = moved;
      t->prims[0] = t->triangles[0].prim; t->prims[last] = moved.prim;
      break;
    }
    case TRIANGLE_V0:        t->triangles[7].v0[1] += 0.001f; break;
    case TRIANGLE_E1:        t->triangles[8].e1[2] = -t->triangles[8].e1[2]; break;
    case TRIANGLE_E2:        t->triangles[9].e2[0] += 0.001f; break;
    case PRIM_COUNT:         b->prim_count += 1; break;
    case GEOMETRY_MOVED:     positions[9 * 5] += 3; break;
    case GEOMETRY_COUNT:     g->count -= 1; break;
    default: break;
  }
}

static void test_validate_sees_damage(void)
{
  scene s;
  trbvh_geometry whole;
  trbvh bvh;
  int kind, preset;
  memset(&s, 0, sizeof s);
  make_random(&s, 400);
  whole = scene_geometry(&s);
  for (preset = 1; preset < 3; ++preset)
    for (kind = -1; kind < DAMAGE_COUNT; ++kind) {
      trbvh_options o = preset_options(preset);
      trbvh_geometry g = whole;
      trbvh_result with, without;
      tree_copy copy;
      float saved = s.positions[9 * 5];
      char why[128] = "", small[8] = "0123456";
      if (kind == NEEDS_GEOMETRY) continue;
      if (kind == PRIM_LOST && preset >= 2) continue;                /* a split triangle may have more entries */
      memset(&bvh, 0, sizeof bvh);
      CHECK(trbvh_build(&bvh, &whole, &o) == TRBVH_OK);
      copy_tree(&copy, &bvh);
      if (kind >= 0) damage(kind, &copy, &g, s.positions);
      CONTEXT("preset %s, damage %s", preset_names[preset], kind < 0 ? "none" : damage_names[kind]);
      with = trbvh_validate(&copy.bvh, &g, why, sizeof why);
      without = trbvh_validate(&copy.bvh, NULL, small, 5);
      if (kind < 0) CHECK_MSG(with == TRBVH_OK && without == TRBVH_OK, "%s", why);
      else {
        CHECK_MSG(with == TRBVH_BAD_DATA || with == TRBVH_INVALID_ARGUMENT, "%s", trbvh_result_text(with));
        CHECK_MSG(why[0] && memchr(why, 0, sizeof why), "no reason given");
        CHECK(trbvh_validate(&copy.bvh, &g, NULL, 0) == with && trbvh_validate(&copy.bvh, &g, why, 0) == with);
        if (kind < NEEDS_GEOMETRY) CHECK_MSG(without != TRBVH_OK && memchr(small, 0, 5) && small[0],
            "without geometry: %s, \"%.5s\"", trbvh_result_text(without), small);
        CHECK_MSG(small[5] == '5', "wrote past the end of why");
      }
      s.positions[9 * 5] = saved;
      free_copy(&copy);
      trbvh_free(&bvh);
    }
  CHECK(trbvh_validate(NULL, NULL, NULL, 0) == TRBVH_INVALID_ARGUMENT);
  scene_free(&s);
}

static void test_validate_sees_depth(void)       /* a chain: fine at 64 edges, not at 65 */
{
  uint32_t depth;
  for (depth = TRBVH_MAX_DEPTH - 1; depth <= TRBVH_MAX_DEPTH + 2; ++depth) {
    uint32_t i;
    tree_copy t;
    trbvh chain;
    char why[128] = "";
    trbvh_node nodes[160];
    uint32_t prims[80];
    trbvh_triangle triangles[80];
    memset(&chain, 0, sizeof chain);
    memset(nodes, 0, sizeof nodes);
    memset(triangles, 0, sizeof triangles);
    for (i = 0; i <= depth; ++i) {
      trbvh_node *leaf = &nodes[i < depth ? 2 * i + 2 : 2 * depth + 1], *inner = &nodes[i ? 2 * i + 1 : 0];
      if (i < depth) { inner->first = 2 * i + 2; inner->count = 0; }
      leaf->first = i;
      leaf->count = 1;
      prims[i] = triangles[i].prim = i;
    }
    chain.nodes = nodes;
    chain.prims = prims;
    chain.triangles = triangles;
    chain.node_count = 2 * depth + 2;
    chain.ref_count = chain.prim_count = depth + 1;
    copy_tree(&t, &chain);
    CONTEXT("depth %u", depth);
    if (depth <= TRBVH_MAX_DEPTH) CHECK_MSG(trbvh_validate(&t.bvh, NULL, why, sizeof why) == TRBVH_OK, "%s", why);
    else CHECK(trbvh_validate(&t.bvh, NULL, why, sizeof why) == TRBVH_BAD_DATA && why[0]);
    free_copy(&t);
  }
}

static void test_version_and_texts(void)
{
  CHECK(trbvh_version() == TRBVH_VERSION);
  CHECK(sizeof(trbvh_node) == 32 && sizeof(trbvh_triangle) == 48 && sizeof(trbvh_ray) == 32 && sizeof(trbvh_hit) == 20);
}

int main(int argc, char **argv)
{
  test_start(argc, argv);
  RUN(test_every_scene_and_preset);
  RUN(test_every_form_of_input);
  RUN(test_boxes);
  RUN(test_what_presets_mean);
  RUN(test_sah_order);
  RUN(test_options);
  RUN(test_costs_matter);
  RUN(test_depth_is_bounded);
  RUN(test_no_triangles_flag);
  RUN(test_rebuild);
  RUN(test_empty);
  RUN(test_bytes_bound);
  RUN(test_memory);
  RUN(test_validate_sees_damage);
  RUN(test_validate_sees_depth);
  RUN(test_version_and_texts);
  return test_finish();
}
