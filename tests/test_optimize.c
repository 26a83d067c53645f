/* trbvh_optimize: the topology gets better and nothing else changes; any tree will do, and what is none is refused;
 * where it fails, the tree is as it was. */
#define TRBVH_IMPLEMENTATION
#include "../trbvh.h"
#include "test.h"
#include "scenes.h"

// >>helpers
/* A tree's bytes, to see what has changed. */
typedef struct snapshot { trbvh bvh; void *block; } snapshot;

static snapshot take(const trbvh *bvh)
{
  snapshot s;
  s.bvh = *bvh;
  s.block = xmalloc(bvh->block_size + 1);
  if (bvh->block) memcpy(s.block, bvh->block, bvh->block_size);
  return s;
}
static int unchanged(const snapshot *s, const trbvh *bvh)
{
  return same_bits(&s->bvh, bvh, sizeof *bvh) && same_bits(s->block, bvh->block, bvh->block_size);
}
static void restore(const snapshot *s, trbvh *bvh)
{
  *bvh = s->bvh;
  if (bvh->block) memcpy(bvh->block, s->block, bvh->block_size);
}
static const void *in_snapshot(const snapshot *s, const void *p)
{
  return (const char *)s->block + ((const char *)p - (const char *)s->bvh.block);
}

static int by_first(const void *a, const void *b)
{
  const trbvh_node *x = (const trbvh_node *)a, *y = (const trbvh_node *)b;
  return x->first < y->first ? -1 : x->first > y->first;
}
static trbvh_node *sorted_leaves(const trbvh_node *nodes, uint32_t node_count)
{
  trbvh_node *leaves = (trbvh_node *)xmalloc(node_count * sizeof *leaves);
  uint32_t i, k, count = 0;
  for (i = 0; i < node_count; ++i) {
    if (!nodes[i].count) continue;
    leaves[count] = nodes[i];
    for (k = 0; k < 3; ++k) {                  /* -0 becomes +0 */
      leaves[count].min[k] += 0.0f;
      leaves[count].max[k] += 0.0f;
    }
    ++count;
  }
  CHECK_MSG(count == node_count / 2, "%u leaves of %u nodes", count, node_count);
  qsort(leaves, count, sizeof *leaves, by_first);
  return leaves;
}

/* All but the inner nodes is what it was. */
static void check_kept(const snapshot *before, const trbvh *bvh)
{
  const trbvh *old = &before->bvh;
  trbvh_node *a, *b;
  CHECK(same_bits(old, bvh, sizeof *bvh));
  if (!bvh->node_count) return;
  CHECK(same_bits(in_snapshot(before, old->prims), bvh->prims, old->ref_count * sizeof *old->prims));
  if (bvh->triangles)
    CHECK(same_bits(in_snapshot(before, old->triangles), bvh->triangles, old->ref_count * sizeof *old->triangles));
  a = sorted_leaves((const trbvh_node *)in_snapshot(before, old->nodes), old->node_count);
  b = sorted_leaves(bvh->nodes, bvh->node_count);
  CHECK_MSG(same_bits(a, b, bvh->node_count / 2 * sizeof *a), "other leaves");
  free(a); free(b);
}

static void check_valid(const trbvh *bvh, const trbvh_geometry *g, int split)
{
  walk_info info;
  char why[256] = "";
  CHECK_MSG(walk_tree(bvh, g, 16, split, &info, why, sizeof why), "%s", why);
  CHECK_MSG(trbvh_validate(bvh, g, why, sizeof why) == TRBVH_OK, "%s", why);
}

static trbvh build(const trbvh_geometry *g, trbvh_options o)
{
  trbvh bvh;
  memset(&bvh, 0, sizeof bvh);
  o.stats = NULL;
  CHECK(trbvh_build(&bvh, g, &o) == TRBVH_OK);
  return bvh;
}

/* Rays through the scene hit what they hit before. */
static void check_hits(const trbvh *a, const trbvh *b)
{
  rng r = {7};
  uint32_t i, k;
  for (i = 0; i < 200 && a->node_count; ++i) {
    trbvh_ray ray;
    trbvh_hit x, y;
    memset(&ray, 0, sizeof ray);
    for (k = 0; k < 3; ++k) {
      const float low = a->nodes[0].min[k], high = a->nodes[0].max[k];
      ray.origin[k] = rng_range(&r, low, high);
      ray.dir[k] = rng_range(&r, -1, 1);
    }
    CHECK(trbvh_intersect(a, &ray, &x) == trbvh_intersect(b, &ray, &y) && same_bits(&x, &y, sizeof x));
  }
}

// >>tests
static void test_every_scene(void)
{
  unsigned at, preset, quality;
  for (at = 0; at < SCENE_COUNT; ++at)
    for (preset = 0; preset < 3; ++preset) {
      scene s;
      trbvh_geometry g;
      trbvh bvh, plain;
      snapshot before;
      if (scene_defs[at].flags & SCENE_BIG) continue;
      scene_make(&s, &scene_defs[at]);
      g = scene_geometry(&s);
      bvh = build(&g, preset_options((int)preset));
      plain = build(&g, preset_options((int)preset));
      before = take(&bvh);
      for (quality = 0; quality < 5; ++quality) {
        trbvh_options o;
        trbvh_stats stats;
        double sah = trbvh_sah(&plain, 0, 0);
        CONTEXT("scene %s, built %s, quality %u", s.name, preset_names[preset], quality);
        restore(&before, &bvh);
        memset(&o, 0, sizeof o);
        memset(&stats, 0x55, sizeof stats);
        o.quality = (trbvh_quality)quality;
        o.stats = &stats;
        CHECK_MSG(trbvh_optimize(&bvh, &o) == TRBVH_OK, "%s", stats.message);
        check_kept(&before, &bvh);
        check_valid(&bvh, &g, preset >= 2);
        check_hits(&plain, &bvh);
        CHECK(stats.message[0] == 0 && stats.node_count == bvh.node_count && stats.leaf_count == bvh.node_count / 2);
        CHECK(stats.ref_count == bvh.ref_count && !(stats.ms_total < 0) && stats.on_device == 0);
        CHECK(!(fabs(stats.sah_cost - trbvh_sah(&bvh, 0, 0)) > 1e-6 * sah));
        if (scene_defs[at].flags & SCENE_ORDINARY)
          CHECK_MSG(stats.sah_cost <= sah * (quality == TRBVH_QUALITY_FAST ? 1.000001 : 1.001), "SAH %g, was %g", stats.sah_cost, sah);
      }
      trbvh_free(&bvh); trbvh_free(&plain);
      free(before.block);
      scene_free(&s);
    }
}

/* What FAST made comes near to what MEDIUM would have made: with leaves that stay, of a small mesh. */
static void test_it_pays(void)
{
  double product = 1;
  unsigned at, count = 0;
  for (at = 0; at < SCENE_COUNT; ++at) {
    scene s;
    trbvh_geometry g;
    trbvh fast, medium;
    double before, after, best;
    if (!(scene_defs[at].flags & SCENE_ORDINARY)) continue;
    scene_make(&s, &scene_defs[at]);
    g = scene_geometry(&s);
    CONTEXT("scene %s", s.name);
    fast = build(&g, preset_options(0));
    medium = build(&g, preset_options(1));
    before = trbvh_sah(&fast, 0, 0);
    best = trbvh_sah(&medium, 0, 0);
    CHECK(trbvh_optimize(&fast, NULL) == TRBVH_OK);
    after = trbvh_sah(&fast, 0, 0);
    CHECK_MSG(after < before && after <= best * 1.1, "SAH %g, optimized %g, MEDIUM %g", before, after, best);
    product *= after / best;
    ++count;
    trbvh_free(&fast); trbvh_free(&medium);
    scene_free(&s);
  }
  CHECK_MSG(count > 3 && pow(product, 1.0 / count) < 1.06, "of %u scenes, %g times MEDIUM's SAH", count, pow(product, 1.0 / count));
}

/* A mesh that has moved: boxes made anew over the same topology, as a refit does. */
static void twist(scene *s)
{
  uint32_t i;
  for (i = 0; i < s->vertex_count; ++i) {
    float *p = s->positions + 3 * i, a = 0.3f * p[1], x = p[0];
    p[0] = x * cosf(a) - p[2] * sinf(a);
    p[2] = x * sinf(a) + p[2] * cosf(a);
    p[1] += 0.7f * sinf(p[0]);
  }
}
static void refit(trbvh *bvh, const trbvh_geometry *g)
{
  trbvh_node *nodes = (trbvh_node *)(uintptr_t)bvh->nodes;
  trbvh moved;
  trbvh_options o;
  uint32_t i, k, n, *at;
  memset(&o, 0, sizeof o);
  o.quality = TRBVH_QUALITY_FAST;
  moved = build(g, o);                         /* for its triangles */
  at = (uint32_t *)xmalloc(g->count * sizeof *at);
  for (i = 0; i < moved.ref_count; ++i) at[moved.prims[i]] = i;
  for (i = 0; i < bvh->ref_count; ++i) ((trbvh_triangle *)(uintptr_t)bvh->triangles)[i] = moved.triangles[at[bvh->prims[i]]];
  for (n = bvh->node_count; n-- > 0;) {        /* parents come before children */
    float low[3] = {FLT_MAX, FLT_MAX, FLT_MAX}, high[3] = {-FLT_MAX, -FLT_MAX, -FLT_MAX};
    if (n == 1) continue;
    for (i = 0; i < (nodes[n].count ? nodes[n].count : 2); ++i) {
      float box[6];
      const trbvh_node *child = &nodes[nodes[n].first + i];
      if (nodes[n].count) geometry_box(g, bvh->prims[nodes[n].first + i], box);
      else { memcpy(box, child->min, 12); memcpy(box + 3, child->max, 12); }
      for (k = 0; k < 3; ++k) {
        if (box[k] < low[k]) low[k] = box[k];
        if (box[3 + k] > high[k]) high[k] = box[3 + k];
      }
    }
    memcpy(nodes[n].min, low, 12);
    memcpy(nodes[n].max, high, 12);
  }
  trbvh_free(&moved);
  free(at);
}

static void test_after_a_refit(void)
{
  static const char *const names[] = {"sphere", "rock", "room", "terrain", "random"};
  unsigned at, i;
  for (at = 0; at < 5; ++at)
    for (i = 0; i < SCENE_COUNT; ++i) {
      scene s;
      trbvh_geometry g;
      trbvh bvh, plain;
      snapshot before;
      double refitted;
      if (strcmp(scene_defs[i].name, names[at])) continue;
      scene_make(&s, &scene_defs[i]);
      g = scene_geometry(&s);
      CONTEXT("scene %s", s.name);
      bvh = build(&g, preset_options(1));
      twist(&s);
      plain = build(&g, preset_options(1));
      refit(&bvh, &g);
      check_valid(&bvh, &g, 0);
      refitted = trbvh_sah(&bvh, 0, 0);
      before = take(&bvh);
      CHECK(trbvh_optimize(&bvh, NULL) == TRBVH_OK);
      check_kept(&before, &bvh);
      check_valid(&bvh, &g, 0);
      check_hits(&plain, &bvh);
      CHECK_MSG(trbvh_sah(&bvh, 0, 0) < refitted, "SAH %g, refitted %g", trbvh_sah(&bvh, 0, 0), refitted);
      trbvh_free(&bvh); trbvh_free(&plain);
      free(before.block);
      scene_free(&s);
    }
}

/* Trees without triangles, and any number of threads: the same result. */
static void reversed_for(void *user, uint32_t count, trbvh_job *job, void *context)
{
  ++*(unsigned *)user;
  while (count) job(context, --count);
}
static void test_boxes_and_jobs(void)
{
  const uint32_t count = QUICK_OR(30000, 60000);
  float *boxes = (float *)xmalloc(count * 24);
  unsigned calls = 0, quality;
  uint32_t i;
  rng r = {5};
  trbvh_geometry g;
  memset(&g, 0, sizeof g);
  g.boxes = boxes;
  g.count = count;
  for (i = 0; i < 6 * count; ++i) boxes[i] = i % 6 < 3 ? rng_range(&r, 0, 100) : boxes[i - 3] + rng_range(&r, 0, 2);
  for (quality = 1; quality < 5; ++quality) {
    trbvh_options o;
    trbvh one = build(&g, preset_options(0)), other = build(&g, preset_options(0));
    snapshot before = take(&one);
    CONTEXT("quality %u", quality);
    memset(&o, 0, sizeof o);
    o.quality = (trbvh_quality)quality;
    CHECK(trbvh_optimize(&one, &o) == TRBVH_OK);
    check_kept(&before, &one);
    check_valid(&one, &g, 0);
    o.jobs.parallel_for = reversed_for;
    o.jobs.user = &calls;
    o.jobs.width = 3;
    CHECK(trbvh_optimize(&other, &o) == TRBVH_OK && calls > 0);
    CHECK_MSG(same_bits(one.nodes, other.nodes, one.node_count * sizeof *one.nodes), "another tree, with jobs");
    trbvh_free(&one); trbvh_free(&other);
    free(before.block);
  }
  free(boxes);
}

/* A chain, which no build makes: every node has a leaf and the rest. Children come before parents. */
static void test_from_elsewhere(void)
{
  static const uint32_t lengths[] = {2, 3, 64, 65, 66, 1000, 5000};
  unsigned kind;
  for (kind = 0; kind < 2 * sizeof lengths / sizeof *lengths; ++kind) {
    const uint32_t n = lengths[kind / 2];
    char *memory = (char *)xmalloc(2 * n * sizeof(trbvh_node) + 64);
    trbvh_node *aligned = (trbvh_node *)(void *)(memory + 64 - (uintptr_t)memory % 64);
    uint32_t *prims = (uint32_t *)xmalloc(n * 4), i, k;
    float *boxes = (float *)xmalloc(n * 24);
    trbvh bvh;
    trbvh_geometry g;
    trbvh_options o;
    trbvh_stats stats;
    rng r = {n};
    walk_info info;
    char why[256] = "";
    CONTEXT("a chain of %u leaves, %u", n, kind % 2);
    memset(&bvh, 0, sizeof bvh);
    memset(&g, 0, sizeof g);
    memset(&o, 0, sizeof o);
    o.stats = &stats;
    if (kind % 2) o.reinsert_share = -1;
    for (i = 0; i < n; ++i) {
      prims[i] = n - 1 - i;
      for (k = 0; k < 3; ++k) {
        boxes[6 * i + k] = rng_range(&r, -1, 1);
        boxes[6 * i + 3 + k] = boxes[6 * i + k] + 0.01f;
      }
    }
    memset(&aligned[1], 0, sizeof *aligned);
    for (i = 0; i < n; ++i) {                        /* leaf i is to the left in pair n - 1 - i, but the last one to the right */
      const uint32_t last = i == n - 1, pair = last ? 1 : n - 1 - i;
      trbvh_node *leaf = &aligned[2 * pair + last];
      leaf->first = n - 1 - i;
      leaf->count = 1;
      memcpy(leaf->min, boxes + 6 * i, 12);
      memcpy(leaf->max, boxes + 6 * i + 3, 12);
    }
    for (i = 1; i < n; ++i) {
      trbvh_node *node = i == n - 1 ? aligned : &aligned[2 * i + 3];
      const trbvh_node *l = &aligned[2 * i], *right = &aligned[2 * i + 1];
      node->first = 2 * i;
      node->count = 0;
      for (k = 0; k < 3; ++k) {
        node->min[k] = l->min[k] < right->min[k] ? l->min[k] : right->min[k];
        node->max[k] = l->max[k] > right->max[k] ? l->max[k] : right->max[k];
      }
    }
    bvh.nodes = aligned;
    bvh.prims = prims;
    bvh.node_count = 2 * n;
    bvh.ref_count = bvh.prim_count = n;
    g.boxes = boxes;
    g.count = n;
    CHECK_MSG(trbvh_optimize(&bvh, &o) == TRBVH_OK, "%s", stats.message);
    CHECK_MSG(walk_tree(&bvh, &g, 1, 0, &info, why, sizeof why), "%s", why);
    CHECK_MSG(stats.max_depth == info.depth, "depth %u, stats say %u", info.depth, stats.max_depth);
    if (n > 64) CHECK_MSG(info.depth < n / 2, "depth %u", info.depth);
    free(memory); free(prims); free(boxes);
  }
}

/* Nodes that are no tree are refused, and stay. What is none in a way that cannot be seen does no harm. */
static void test_damage(void)
{
  rng r = {11};
  unsigned round, refused = 0, taken = 0;
  scene s;
  trbvh_geometry g;
  trbvh bvh;
  snapshot good;
  memset(&s, 0, sizeof s);
  make_sphere(&s, 600);
  g = scene_geometry(&s);
  bvh = build(&g, preset_options(1));
  good = take(&bvh);
  for (round = 0; round < QUICK_OR(300u, 3000u); ++round) {
    trbvh_node *nodes = (trbvh_node *)(uintptr_t)bvh.nodes;
    trbvh_options o;
    trbvh_stats stats;
    trbvh_result result;
    snapshot before;
    uint32_t hits = 1 + rng_below(&r, 3);
    CONTEXT("round %u", round);
    restore(&good, &bvh);
    while (hits--) {
      const uint32_t word = rng_below(&r, 8), value = rng_below(&r, 3) ? rng_below(&r, bvh.node_count + 8) : rng_u32(&r);
      memcpy((char *)&nodes[rng_below(&r, bvh.node_count)] + 4 * word, &value, 4);
    }
    if (round % 50 == 7) bvh.node_count -= 1 + rng_below(&r, 3);
    before = take(&bvh);
    memset(&o, 0, sizeof o);
    o.stats = &stats;
    result = trbvh_optimize(&bvh, &o);
    CHECK_MSG(result == TRBVH_OK || result == TRBVH_BAD_DATA, "%s", trbvh_result_text(result));
    if (result) CHECK_MSG(unchanged(&before, &bvh) && stats.message[0], "refused, but changed");
    refused += result != TRBVH_OK;
    taken += result == TRBVH_OK;
    free(before.block);
    bvh = good.bvh;
  }
  CHECK_MSG(refused > 20 && taken > 20, "%u refused, %u taken", refused, taken);
  trbvh_free(&bvh);
  free(good.block);
  scene_free(&s);
}

typedef struct ticks { unsigned count, cancel_at; } ticks;
static int on_tick(void *user, float done)
{
  ticks *t = (ticks *)user;
  CHECK(done >= 0 && done <= 1);
  return ++t->count == t->cancel_at;
}

/* Every allocation that fails and every tick that cancels leaves the tree as it was. */
static void test_failures(void)
{
  static char scratch[64];
  scene s;
  trbvh_geometry g;
  trbvh bvh, empty, whole;
  trbvh_options o;
  trbvh_stats stats;
  snapshot before;
  counter c;
  ticks t;
  unsigned i, last = 0;
  memset(&s, 0, sizeof s);
  make_sphere(&s, QUICK_OR(3000, 20000));
  g = scene_geometry(&s);
  bvh = build(&g, preset_options(0));
  whole = build(&g, preset_options(0));
  CHECK(trbvh_optimize(&whole, NULL) == TRBVH_OK);
  before = take(&bvh);
  memset(&o, 0, sizeof o);
  memset(&c, 0, sizeof c);
  o.stats = &stats;
  o.allocator = counter_allocator(&c);
  c.fail_at = 1;
  CHECK(trbvh_optimize(&bvh, &o) == TRBVH_OUT_OF_MEMORY && stats.message[0] && c.live == 0 && unchanged(&before, &bvh));
  o.scratch = scratch;
  o.scratch_size = sizeof scratch;
  CHECK(trbvh_optimize(&bvh, &o) == TRBVH_INVALID_ARGUMENT && stats.message[0] && unchanged(&before, &bvh));
  o.scratch = NULL;
  o.scratch_size = 0;
  o.progress = on_tick;
  o.progress_user = &t;
  for (i = 1; !last; ++i) {
    trbvh_result result;
    memset(&c, 0, sizeof c);
    t.count = 0;
    t.cancel_at = i;
    result = trbvh_optimize(&bvh, &o);
    last = t.count < i;
    CONTEXT("cancelled at tick %u", i);
    CHECK(result == (last ? TRBVH_OK : TRBVH_CANCELLED) && c.live == 0 && c.bad_frees == 0);
    CHECK_MSG(last ? same_tree(&bvh, &whole) : unchanged(&before, &bvh), "neither all nor nothing");
  }
  CHECK_MSG(i > 10, "%u ticks", i);
  restore(&before, &bvh);
  o.progress = NULL;
  o.scratch_size = (size_t)bvh.node_count / 2 * 100 + 65536;
  o.scratch = xmalloc(o.scratch_size);
  memset(&c, 0, sizeof c);
  CHECK_MSG(trbvh_optimize(&bvh, &o) == TRBVH_OK && c.calls == 0 && same_tree(&bvh, &whole), "%s", stats.message);
  free(o.scratch);
  o.scratch = NULL;
  memset(&empty, 0, sizeof empty);
  CHECK(trbvh_optimize(&empty, &o) == TRBVH_OK && !empty.nodes);
  CHECK(trbvh_optimize(NULL, &o) == TRBVH_INVALID_ARGUMENT && stats.message[0]);
  o.quality = (trbvh_quality)9;
  CHECK(trbvh_optimize(&bvh, &o) == TRBVH_INVALID_ARGUMENT && stats.message[0] && same_tree(&bvh, &whole));
  trbvh_free(&bvh); trbvh_free(&whole);
  free(before.block);
  scene_free(&s);
}

int main(int argc, char **argv)
{
  test_start(argc, argv);
  RUN(test_every_scene);
  RUN(test_it_pays);
  RUN(test_after_a_refit);
  RUN(test_boxes_and_jobs);
  RUN(test_from_elsewhere);
  RUN(test_damage);
  RUN(test_failures);
  return test_finish();
}
