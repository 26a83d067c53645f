/* The OpenCL backend: the same trees as scalar C, bit for bit, from host memory and from the device's; rays; and
 * whatever may go wrong between the two: no device, calls that fail one by one, a lost device, little memory, kernels
 * that do not compile, damaged caches. On Linux, cl_stub.h stands between the library and the real OpenCL.
 * test_cl_gpu_shape.c and test_cl_wide_keys.c are this program with other kernels, test_cl_wide_keys.c in part. */
#define _POSIX_C_SOURCE 200112L                    /* setenv */
#ifdef TRB_PACKED_REFS
  #define WIDE_KEYS 1
#else
  #define WIDE_KEYS 0
#endif
#define TRB_CL_SMALL 16                            /* triangles: below that many, a device is not worth the trouble */
#ifndef TRBVH_THREADS
  #define TRBVH_THREADS
#endif
#define TRBVH_IMPLEMENTATION
#include "../trbvh_cl.h"
#include "test.h"
#include "scenes.h"
#ifdef __linux__
  #include "cl_stub.h"
#endif

#define CL_PRESETS 3                               /* BEST is HIGH */
static trbvh_device *device;                       /* open while nothing is broken on purpose */

// >>meshes ----------------------------------------------------------------------------------------------------------
typedef struct mesh { scene s; trbvh_geometry g; trbvh tree; } mesh;       /* tree: as scalar C builds it */

static mesh make_mesh(const char *name, uint32_t n)
{
  mesh m;
  unsigned i;
  for (i = 0; strcmp(scene_defs[i].name, name); ++i) {}
  memset(&m, 0, sizeof m);
  m.s.name = name;
  scene_defs[i].make(&m.s, n);
  m.g = scene_geometry(&m.s);
  return m;
}
static mesh make_built(const char *name, uint32_t n, trbvh_options o)
{
  mesh m = make_mesh(name, n);
  CHECK(trbvh_build(&m.tree, &m.g, &o) == TRBVH_OK);
  return m;
}
static void mesh_free(mesh *m) { scene_free(&m->s); trbvh_free(&m->tree); }

static int tree_is_empty(const trbvh *b)
{
  return !b->nodes && !b->prims && !b->triangles && !b->node_count && !b->ref_count && !b->block && !b->block_size;
}
static const char *difference(const trbvh *want, const trbvh *got)         /* NULL = none */
{
  static char text[160];
  uint32_t i;
  if (want->node_count != got->node_count || want->ref_count != got->ref_count || want->prim_count != got->prim_count) {
    snprintf(text, sizeof text, "%u nodes, %u references, %u primitives; scalar: %u, %u, %u", got->node_count,
        got->ref_count, got->prim_count, want->node_count, want->ref_count, want->prim_count);
    return text;
  }
  for (i = 0; i < want->node_count; ++i) {
    const trbvh_node *a = &want->nodes[i], *b = &got->nodes[i];
    if (!memcmp(a, b, sizeof *a)) continue;
    snprintf(text, sizeof text, "node %u of %u: %u + %u, %.9g .. %.9g; scalar: %u + %u, %.9g .. %.9g", i, want->node_count,
        b->first, b->count, (double)b->min[0], (double)b->max[0], a->first, a->count, (double)a->min[0], (double)a->max[0]);
    return text;
  }
  if (!want->triangles != !got->triangles) return want->triangles ? "triangles are missing" : "triangles are there";
  if (same_tree(want, got)) return NULL;
  return same_bits(want->prims, got->prims, sizeof(uint32_t) * want->ref_count) ? "triangles" : "prims";
}
static void check_balance(const counter *c)
{
  CHECK_MSG(c->live == 0 && c->bad_frees == 0, "%u blocks live, %u bad frees", c->live, c->bad_frees);
}

// >>identity --------------------------------------------------------------------------------------------------------
static void check_stats(const trbvh_stats *want, const trbvh_stats *got)
{
  CHECK_MSG(got->node_count == want->node_count && got->leaf_count == want->leaf_count && got->ref_count == want->ref_count,
      "%u nodes, %u leaves, %u references; scalar: %u, %u, %u", got->node_count, got->leaf_count, got->ref_count,
      want->node_count, want->leaf_count, want->ref_count);
  CHECK_MSG(got->max_depth == want->max_depth, "depth %u; scalar: %u", got->max_depth, want->max_depth);
  CHECK_MSG(got->skipped_count == want->skipped_count, "%u skipped; scalar: %u", got->skipped_count, want->skipped_count);
  CHECK_MSG(fabs(got->sah_cost - want->sah_cost) <= 1e-4 * fabs(want->sah_cost), "SAH %.9g; scalar: %.9g", got->sah_cost,
      want->sah_cost);
  CHECK(got->ms_total >= 0 && got->ms_split >= 0 && got->ms_morton >= 0 && got->ms_sort >= 0 && got->ms_hierarchy >= 0
      && got->ms_moves >= 0 && got->ms_treelets >= 0 && got->ms_collapse >= 0 && got->ms_finish >= 0 && got->ms_transfer >= 0);
}

/* The same build in scalar C and on the device, there over what is in tree: nothing but the time may differ. */
static void check_same_over(trbvh *tree, const trbvh_geometry *g, const trbvh_options *options)
{
  trbvh want = {0};
  trbvh_stats scalar, stats;
  trbvh_options o = *options;
  trbvh_result wanted, result;
  memset(&o.allocator, 0, sizeof o.allocator);
  memset(&stats, 0x55, sizeof stats);
  o.jobs.width = 2;
  o.stats = &scalar;
  wanted = trbvh_build(&want, g, &o);
  o = *options;
  o.stats = &stats;
  o.device = device;
  o.flags |= TRBVH_NO_FALLBACK;
  result = trbvh_build(tree, g, &o);
  CHECK_MSG(result == wanted, "%s: %s; scalar: %s", trbvh_result_text(result), stats.message, trbvh_result_text(wanted));
  if (result == TRBVH_OK && wanted == TRBVH_OK) {
    const char *differs = difference(&want, tree);
    CHECK_MSG(!differs, "%s", differs);
    CHECK_MSG(stats.on_device == 1 || want.node_count == 0, "built in scalar C: %s", stats.message);
    CHECK_MSG(!stats.message[0], "message after a success: %s", stats.message);
    CHECK_MSG(tree->flags == o.flags && (uintptr_t)tree->nodes % 64 == 0 && !tree->wide, "flags %u", tree->flags);
    CHECK_MSG(stats.bytes_result == scalar.bytes_result, "%zu bytes; scalar: %zu", stats.bytes_result, scalar.bytes_result);
    check_stats(&scalar, &stats);
  } else if (result == wanted) {
    CHECK(tree_is_empty(tree));
    CHECK_MSG(!strcmp(stats.message, scalar.message), "%s; scalar: %s", stats.message, scalar.message);
  }
  trbvh_free(&want);
}
static void check_same(const trbvh_geometry *g, trbvh_options o)
{
  trbvh tree = {0};
  counter c = {0};
  size_t scratch = 0, bound = trbvh_bytes_bound(g, &o, &scratch);
  o.allocator = counter_allocator(&c);
  check_same_over(&tree, g, &o);
  CHECK_MSG(c.peak_bytes <= bound + scratch, "peak %zu, bounds %zu and %zu", c.peak_bytes, bound, scratch);
  CHECK_MSG(c.live == (tree.block != NULL), "%u blocks live", c.live);
  trbvh_free(&tree);
  check_balance(&c);
}
static void check_presets(mesh m)
{
  int preset;
  for (preset = 0; preset < CL_PRESETS; ++preset) {
    CONTEXT("scene %s, %u triangles, preset %s", m.s.name, m.s.count, preset_names[preset]);
    check_same(&m.g, preset_options(preset));
  }
  mesh_free(&m);
}

static void test_every_scene(void)
{
  unsigned i;
  for (i = 0; i < SCENE_COUNT; ++i) {
    const scene_def *def = &scene_defs[i];
    check_presets(make_mesh(def->name, def->flags & SCENE_BIG ? def->quick : QUICK_OR(def->quick, def->full)));
  }
}

static void test_every_size(void)
{
  static const uint32_t sizes[] = {1, 2, 3, 4, 5, 6, 7, 8, 9, 13, 14, 15, 16, 17, 27, 28, 29, 31, 32, 33, 63, 64, 65,
      127, 128, 129, 255, 256, 257, 511, 512, 513, 1000, 1023, 1024, 1025, 2047, 2049, 4095, 4097, 16383, 16385, 100000};
  static const char *const names[] = {"random", "slivers", "grid", "deep_bushy", "identical"};
  unsigned i, at;
  for (i = 0; i < sizeof sizes / sizeof sizes[0]; ++i)
    for (at = 0; at < 5; ++at)
      if (sizes[i] <= QUICK_OR(130u, 1025u) || (at == i % 5 && sizes[i] <= QUICK_OR(20000u, 100000u)))
        check_presets(make_mesh(names[at], sizes[i]));
  if (!QUICK_OR(1, 0)) check_presets(make_mesh("terrain", 300000));
}

static const struct {
  int preset; float budget; int32_t rounds; uint32_t max_leaf; float node, prim, share; int32_t unsplit, gamma;
} variants[] = {
  {2, 1, 0, 0, 0, 0, 0, 0, 0}, {2, 16, 0, 0, 0, 0, 0, 0, 0}, {2, 0.001f, 0, 0, 0, 0, 0, 0, 0},
  {2, -1, 0, 0, 0, 0, 0, 0, 0}, {0, 0.3f, 0, 0, 0, 0, 0, 0, 0}, {1, 0, 1, 0, 0, 0, 0, 0, 0},
  {1, 0, 5, 0, 0, 0, 0, 0, 0}, {1, 0, 30, 0, 0, 0, 0, 0, 0}, {1, 0, -1, 0, 0, 0, 0, 0, 0},
  {2, 0.5f, 2, 0, 0, 0, 0, 0, 0}, {0, 0, 0, 1, 0, 0, 0, 0, 0}, {1, 0, 0, 1, 0, 0, 0, 0, 0},
  {2, 0, 0, 1, 0, 0, 0, 0, 0}, {1, 0, 0, 2, 0, 0, 0, 0, 0}, {1, 0, 0, 4, 0, 0, 0, 0, 0},
  {2, 0, 0, 16, 0, 0, 0, 0, 0}, {1, 0, 0, 1000, 0, 0, 0, 0, 0}, {1, 0, 0, 0, 0.1f, 0, 0, 0, 0},
  {1, 0, 0, 0, 10, 0, 0, 0, 0}, {1, 0, 0, 0, 0, 7.5f, 0, 0, 0}, {1, 0, 0, 0, -1, 0, 0, 0, 0},
  {1, 0, 0, 0, 0, -1, 0, 0, 0}, {1, 0, 0, 0, -1, -1, 0, 0, 0}, {2, 0, 0, 16, 100, 0.001f, 0, 0, 0},
  {0, 0, 3, 3, 1e30f, 1e-30f, 0, 0, 0}, {0, 0.3f, 0, 0, 0, 0, 0, 2, 0}, {1, 0, 0, 0, 0, 0, -1, 0, 0},
  {1, 0, 0, 0, 0, 0, 0.25f, 0, 0}, {1, 0, 5, 0, 0, 0, 0.25f, 0, 14}, {1, 0, 3, 0, 0, 0, -1, 0, 14},
  {2, 0, 0, 0, 0, 0, -1, 0, 0}, {2, 0, 0, 0, 0, 0, 0, -1, 0}, {2, 0, 0, 0, 0, 0, 0, 1, 0},
  {2, 16, 5, 0, 0, 0, 0.25f, 1, 14}, {2, 1, 1, 0, 0, 0, 0.25f, 0, 0}, {2, 1, -1, 0, 0, 0, 0.1f, 5, 0},
  {2, 0, 0, 0, 0, 0, -1, -1, 0}, {2, 1, 0, 16, 100, 0.001f, 0.25f, 3, 0}, {2, 1, 30, 1, 0.1f, 0, 0.01f, 0, 1000},
  {0, 0, 2, 0, 0, 0, 0.1f, 0, 0}, {3, 0, 0, 0, 0, 0, 0, 0, 0}
};
static void test_options(void)
{
  static const char *const names[] = {"random", "slivers", "huge_and_tiny", "grid", "not_finite", "city", "nested", "deep"};
  unsigned at, v;
  for (at = 0; at < sizeof names / sizeof names[0]; ++at) {
    mesh m = make_mesh(names[at], QUICK_OR(300, 2500));
    for (v = 0; v < sizeof variants / sizeof variants[0]; ++v) {
      trbvh_options o = preset_options(variants[v].preset);
      o.split_budget = variants[v].budget;
      o.treelet_rounds = variants[v].rounds;
      o.max_leaf = variants[v].max_leaf;
      o.cost_node = variants[v].node;
      o.cost_prim = variants[v].prim;
      o.reinsert_share = variants[v].share;
      o.unsplit_passes = variants[v].unsplit;
      o.treelet_gamma = variants[v].gamma;
      o.flags = v & 1 ? TRBVH_NO_TRIANGLES : 0;
      CONTEXT("scene %s, %s, budget %g, rounds %d from %d, max_leaf %u, costs %g %g, reinserted %g, unsplit %d", m.s.name,
          preset_names[variants[v].preset], (double)o.split_budget, (int)o.treelet_rounds, (int)o.treelet_gamma, o.max_leaf,
          (double)o.cost_node, (double)o.cost_prim, (double)o.reinsert_share, (int)o.unsplit_passes);
      check_same(&m.g, o);
    }
    mesh_free(&m);
  }
}

/* Elements stride bytes apart, starting offset bytes past what malloc gives; garbage between them. */
static unsigned char *strided(const void *from, uint32_t count, size_t bytes, size_t stride, size_t offset)
{
  unsigned char *p = (unsigned char *)xmalloc(stride * count + offset + bytes);
  uint32_t i;
  memset(p, 0xFF, stride * count + offset + bytes);
  for (i = 0; i < count; ++i) memcpy(p + offset + stride * i, bytes_at(from, bytes * i), bytes);
  return p;
}

static void test_every_form_of_input(void)
{
  static const char *const names[] = {"sphere", "city", "terrain", "slivers", "not_finite", "n1", "n9"};
  static const size_t strides[] = {12, 13, 16, 20, 31, 32, 100}, offsets[] = {0, 1, 0, 3, 4, 2, 8};
  unsigned at, i, k;
  for (at = 0; at < sizeof names / sizeof names[0]; ++at) {
    mesh m = make_mesh(names[at], at < 5 ? 1500 : 8 * at - 39);
    const uint32_t count = m.s.count;
    uint16_t *half = (uint16_t *)xmalloc(6 * count);
    uint32_t *index = (uint32_t *)xmalloc(12 * count), t;
    float *corners = (float *)xmalloc(36 * count), *boxes = (float *)xmalloc(24 * count);
    for (t = 0; t < 3 * count; ++t) half[t] = (uint16_t)(index[t] = m.s.indices ? m.s.indices[t] : t);
    for (t = 0; t < count; ++t) {
      geometry_triangle(&m.g, t, corners + 9 * t);
      geometry_box(&m.g, t, boxes + 6 * t);
      if (t % 50 == 49) boxes[6 * t + t / 50 % 6] = bad_float(t);
    }
    for (i = 0; i < sizeof strides / sizeof strides[0]; ++i) {
      const size_t stride = strides[i], offset = offsets[i];
      unsigned char *soup = strided(corners, 3 * count, 12, stride, offset), *box = strided(boxes, count, 24, stride + 12, offset);
      unsigned char *vertices = strided(m.s.positions, m.s.vertex_count, 12, stride, offset);
      unsigned char *wide = strided(index, 3 * count, 4, 4, offset), *small = strided(half, 3 * count, 2, 2, offset);
      static const char *const forms[] = {"soup", "32-bit indices", "16-bit indices", "boxes"};
      trbvh_geometry g[4];
      memset(g, 0, sizeof g);
      for (k = 0; k < 4; ++k) {
        g[k].count = count;
        g[k].positions = k == 3 ? NULL : (k ? vertices : soup) + offset;
        g[k].position_stride = k == 3 ? 0 : stride;
        g[k].position_count = k == 1 || k == 2 ? m.s.vertex_count : 0;
        g[k].indices = k == 1 ? wide + offset : k == 2 ? small + offset : NULL;
        g[k].index_size = k == 2 ? 2 : 0;
        g[k].boxes = k == 3 ? box + offset : NULL;
        g[k].box_stride = k == 3 ? stride + 12 : 0;
      }
      for (k = 0; k < 4 * CL_PRESETS; ++k) {
        trbvh_options o = preset_options((int)k / 4);
        o.flags = (i + k) % 3 == 2 ? TRBVH_NO_TRIANGLES : 0;
        CONTEXT("scene %s, preset %s, %s, stride %zu, offset %zu", m.s.name, preset_names[k / 4], forms[k % 4], stride, offset);
        check_same(&g[k % 4], o);
      }
      free(soup); free(box); free(vertices); free(wide); free(small);
    }
    free(half); free(index); free(corners); free(boxes);
    mesh_free(&m);
  }
}

static void test_building_again(void)
{
  static const struct { const char *name; uint32_t n; } rows[8] = {
    {"random", 3000}, {"sphere", 500}, {"slivers", 2900}, {"n1", 1}, {"grid", 40}, {"n0", 0}, {"city", 5000}, {"random", 700}};
  trbvh_device *devices[2];
  trbvh tree = {0};
  unsigned i;
  devices[0] = device;
  devices[1] = trbvh_cl_open(NULL, NULL);          /* two at once */
  for (i = 0; i < 8 * CL_PRESETS; ++i) {
    mesh m = make_mesh(rows[i % 8].name, rows[i % 8].n);
    trbvh_options o = preset_options((int)i / 8);
    void *block = tree.block;
    CONTEXT("build %u: scene %s, %u triangles", i, m.s.name, m.s.count);
    device = devices[i % 3 == 1];
    check_same_over(&tree, &m.g, &o);
    if (i % 8 == 1) CHECK_MSG(tree.block == block, "the block is not reused");
    mesh_free(&m);
  }
  device = devices[0];
  trbvh_cl_close(devices[1]);
  trbvh_free(&tree);
  CHECK(tree_is_empty(&tree));
}

static void test_bad_input(void)
{
  static const float read_only[4][9] = {{0, 0, 0, 1, 0, 0, 0, 1, 0}, {2, 0, 0, 3, 0, 1, 2, 1, 0}, {4, 0, 0, 5, 0, 2, 4, 1, 0}, {6, 0, 0, 7, 0, 3, 6, 1, 0}};
  static const uint32_t bad[] = {0, 1, 2, 1500, 2998, 4499};
  mesh m = make_mesh("sphere", 1500);
  trbvh_geometry g;
  unsigned i;
  for (i = 0; i < 6 * CL_PRESETS; ++i) {
    const uint32_t at = bad[i % 6] % (3 * m.s.count), keep = m.s.indices[at];
    CONTEXT("preset %s, index %u is out of range", preset_names[i / 6], at);
    m.s.indices[at] = i & 1 ? m.s.vertex_count : 0xFFFFFFFFu - i;
    check_same(&m.g, preset_options((int)i / 6));
    m.s.indices[at] = keep;
  }
  CONTEXT("bad arguments, then good ones");
  g = m.g; g.index_size = 3;     check_same(&g, preset_options(1));
  g = m.g; g.positions = NULL;   check_same(&g, preset_options(1));
  g = m.g; g.position_count = 0; check_same(&g, preset_options(1));
  g = m.g; g.count = 0;          check_same(&g, preset_options(1));
  CONTEXT("a mesh in memory that nobody may write to");
  memset(&g, 0, sizeof g);
  g.positions = read_only;
  g.count = 4;
  check_same(&g, preset_options(1));
  check_presets(m);
}

static void test_a_small_mesh_stays_on_the_host(void)
{
  mesh m = make_mesh("random", 8);
  trbvh_stats stats;
  trbvh_options o = preset_options(1);
  CONTEXT("8 triangles");
  o.device = device;
  o.stats = &stats;
  CHECK(trbvh_build(&m.tree, &m.g, &o) == TRBVH_OK && stats.on_device == 0);
  o.flags = TRBVH_NO_FALLBACK;
  CHECK(trbvh_build(&m.tree, &m.g, &o) == TRBVH_OK && stats.on_device == 1);
  mesh_free(&m);
}

// >>hooks -----------------------------------------------------------------------------------------------------------
typedef struct ticks { unsigned count, cancel_at, wrong; float last; } ticks;

static int on_tick(void *user, float done)
{
  ticks *t = (ticks *)user;
  if (!(done >= 0 && done <= 1) || (t->count && !(done >= t->last)) || (t->cancel_at && t->count >= t->cancel_at)) ++t->wrong;
  t->last = done;
  return ++t->count == t->cancel_at;
}

static void test_cancel_at_every_tick(void)
{
  mesh m = make_mesh("slivers", QUICK_OR(1000, 4000));
  int preset;
  unsigned n, count;
  for (preset = 0; preset < CL_PRESETS; ++preset)
    for (n = 0, count = 1; n <= count; n += 1 + count / 50) {      /* 0: to the end */
      trbvh_options o = preset_options(preset);
      trbvh tree = {0};
      trbvh_stats stats;
      ticks t = {0};
      counter c = {0};
      trbvh_result result;
      CONTEXT("preset %s, cancelled at tick %u of %u", preset_names[preset], n, count);
      t.cancel_at = n;
      o.device = device;
      o.flags = n & 1 ? TRBVH_NO_FALLBACK : 0;
      o.progress = on_tick;
      o.progress_user = &t;
      o.stats = &stats;
      o.allocator = counter_allocator(&c);
      result = trbvh_build(&tree, &m.g, &o);
      CHECK_MSG(result == (n ? TRBVH_CANCELLED : TRBVH_OK), "%s", trbvh_result_text(result));
      CHECK_MSG(!t.wrong, "%u ticks backwards, outside 0..1, or after the cancel", t.wrong);
      if (!n) count = t.count;
      if (n) CHECK_MSG(t.count == n && tree_is_empty(&tree) && stats.message[0], "%u ticks, %s", t.count, stats.message);
      else CHECK_MSG(count >= 3 && t.last > 0.5f && stats.on_device, "%u ticks, the last at %g", count, (double)t.last);
      trbvh_free(&tree);
      check_balance(&c);
    }
  for (n = 0, count = 1; n <= count; ++n) {
    trbvh_options o = preset_options(1);
    trbvh_hit hits[100];
    trbvh_ray many[100];
    trbvh_result result;
    ticks t = {0};
    CONTEXT("rays, cancelled at tick %u of %u", n, count);
    memset(many, 0, sizeof many);
    CHECK(trbvh_build(&m.tree, &m.g, &o) == TRBVH_OK);
    t.cancel_at = n;
    o.device = device;
    o.progress = on_tick;
    o.progress_user = &t;
    result = trbvh_intersect_n(&m.tree, many, hits, 100, &o);
    CHECK_MSG(result == (n ? TRBVH_CANCELLED : TRBVH_OK) && !t.wrong, "%s, %u wrong ticks", trbvh_result_text(result), t.wrong);
    if (!n) count = t.count;
  }
  check_presets(m);
}

static void test_host_memory_runs_out(void)
{
  mesh m = make_mesh("slivers", 2000);
  unsigned i, n;
  for (i = 0; i < 4 * CL_PRESETS; ++i) {
    trbvh_result result = TRBVH_RESULT_COUNT;
    for (n = 1; result && n < 12; ++n) {
      trbvh_options o = preset_options((int)i / 4);
      trbvh tree = {0};
      trbvh_stats stats;
      counter c = {0};
      trbvh_geometry few = m.g;
      CONTEXT("preset %s, rebuilt %u, fallback %u, allocation %u fails", preset_names[i / 4], i & 1, i >> 1 & 1, n);
      o.allocator = counter_allocator(&c);
      few.count = 5;
      if (i & 1) CHECK(trbvh_build(&tree, &few, &o) == TRBVH_OK);
      o.device = device;
      o.flags = i & 2 ? 0 : TRBVH_NO_FALLBACK;
      o.stats = &stats;
      c.calls = 0;
      c.fail_at = n;
      result = trbvh_build(&tree, &m.g, &o);
      CHECK_MSG(result == (c.calls < n ? TRBVH_OK : TRBVH_OUT_OF_MEMORY), "%s after %u allocations: %s",
          trbvh_result_text(result), c.calls, stats.message);
      if (result) CHECK(tree_is_empty(&tree) && stats.message[0]);
      trbvh_free(&tree);
      check_balance(&c);
    }
    CHECK_MSG(result == TRBVH_OK, "never succeeds");
  }
  check_presets(m);
}

// >>rays ------------------------------------------------------------------------------------------------------------
typedef struct rays { trbvh_ray *ray; trbvh_hit *want, *hit; uint8_t *any; uint32_t count; } rays;

static void rays_free(rays *r) { free(r->ray); free(r->want); free(r->hit); free(r->any); }
static void rays_clear(rays *r, uint32_t count)
{
  r->count = count;
  memset(r->hit, 0x77, sizeof(trbvh_hit) * (count + 1));
  memset(r->any, 0x77, count + 1);
}
static rays make_rays(const trbvh *tree, uint32_t count)                   /* want: what the host says of them */
{
  rays r;
  rng random = {4711};
  float lo[3] = {-1, -1, -1}, hi[3] = {1, 1, 1};
  uint32_t i;
  int k;
  if (tree->node_count) { memcpy(lo, tree->nodes[0].min, 12); memcpy(hi, tree->nodes[0].max, 12); }
  r.ray = (trbvh_ray *)xmalloc(sizeof(trbvh_ray) * count);
  r.want = (trbvh_hit *)xmalloc(sizeof(trbvh_hit) * count);
  r.hit = (trbvh_hit *)xmalloc(sizeof(trbvh_hit) * (count + 1));
  r.any = (uint8_t *)xmalloc(count + 1);
  rays_clear(&r, count);
  for (i = 0; i < count; ++i) {
    trbvh_ray *ray = &r.ray[i];
    memset(ray, 0, sizeof *ray);
    for (k = 0; k < 3; ++k) {
      const float middle = (lo[k] + hi[k]) / 2, half = (hi[k] - lo[k]) / 2 + 0.01f;
      const float target = rng_range(&random, middle - half, middle + half);
      ray->origin[k] = rng_range(&random, middle - 1.5f * half, middle + 1.5f * half);
      ray->dir[k] = target - ray->origin[k];
    }
    if (i % 8 == 1) ray->dir[i / 8 % 3] = 0;                         /* in an axis plane */
    if (i % 8 == 2) { ray->tmin = rng_range(&random, -0.5f, 1); ray->tmax = ray->tmin + rng_unit(&random); }
    if (i % 8 == 3) for (k = 0; k < 3; ++k) ray->dir[k] *= power_of_two((int)(i / 8 % 40) - 20);
    trbvh_intersect(tree, ray, &r.want[i]);
  }
  return r;
}

/* Floats on the device, doubles on the host: they may differ about rays that graze an edge, and about nothing else. In
 * scenes where triangles overlap in one plane, about which of those is hit, too. */
static int ties(const scene *s) { return !strcmp(s->name, "grid") || !strncmp(s->name, "flat", 4); }
static void check_rays(const rays *r, const scene *s, const char *what)
{
  uint32_t i, hits = 0, others = 0, far = 0, any = 0, bad = 0, few = r->count / 1000;
  for (i = 0; i < r->count; ++i) {
    const trbvh_hit *want = &r->want[i], *hit = &r->hit[i];
    const float limit = r->ray[i].tmax > 0 ? r->ray[i].tmax : FLT_MAX;
    int off;
    hits += want->prim != TRBVH_NONE;
    any += r->any[i] != (want->prim != TRBVH_NONE);
    off = fabs((double)hit->t - want->t) > 1e-4 * fabs((double)want->t);
    others += hit->prim != want->prim && (off || !ties(s));
    far += hit->prim == want->prim && off;
    if (hit->prim == TRBVH_NONE)
      bad += (r->ray[i].tmax >= 0 && memcmp(&hit->t, &limit, 4)) || fabs((double)hit->u) + fabs((double)hit->v) > 0 || hit->instance != TRBVH_NONE;
    else
      bad += hit->prim >= s->count || !(hit->t >= 0 && hit->t >= r->ray[i].tmin && hit->t <= limit) || hit->instance != TRBVH_NONE
          || !(hit->u >= -1e-5f && hit->v >= -1e-5f && hit->u + hit->v <= 1.00001f);
  }
  CHECK_MSG(!bad, "%s: %u hits or misses make no sense", what, bad);
  CHECK_MSG(others <= few, "%s: %u of %u rays hit something else than on the host; %u hits there", what, others, r->count, hits);
  CHECK_MSG(far <= few, "%s: t is more than 1e-4 off for %u of %u rays", what, far, r->count);
  CHECK_MSG(any <= few, "%s: %u of %u rays are not occluded as on the host", what, any, r->count);
  CHECK_MSG(r->hit[r->count].prim == 0x77777777u && r->any[r->count] == 0x77, "%s: written beyond the end", what);
}

static void test_rays(void)
{
  static const char *const names[] = {"random", "sphere", "rock", "room", "terrain", "slivers", "city", "huge_and_tiny",
      "grid", "not_finite", "flat_y", "n1", "n2", "n9"};
  trbvh_stats stats;
  unsigned at;
  for (at = 0; at < 2 * sizeof names / sizeof names[0]; ++at) {
    trbvh_options o = preset_options(at & 1 ? 2 : 0);
    mesh m = make_built(names[at / 2], at < 22 ? QUICK_OR(1000, 8000) : at / 2, o);
    rays r = make_rays(&m.tree, QUICK_OR(3000u, 30000u));
    CONTEXT("scene %s, preset %s", m.s.name, preset_names[at & 1 ? 2 : 0]);
    o.device = device;
    o.flags = TRBVH_NO_FALLBACK;
    o.stats = &stats;
    memset(&stats, 0x55, sizeof stats);
    CHECK(trbvh_intersect_n(&m.tree, r.ray, r.hit, r.count, &o) == TRBVH_OK && stats.on_device == 1 && !stats.message[0]);
    memset(&stats, 0x55, sizeof stats);
    CHECK(trbvh_occluded_n(&m.tree, r.ray, r.any, r.count, &o) == TRBVH_OK && stats.on_device == 1 && !stats.message[0]);
    check_rays(&r, &m.s, "batch");
    rays_free(&r);
    mesh_free(&m);
  }
}

static void test_rays_at_the_limits(void)
{
  static const uint32_t counts[] = {0, 1, 2, 3, 15, 16, 17, 63, 64, 65, 255, 256, 257, 999};
  const uint32_t all = 2000;
  trbvh_options o = preset_options(1);
  mesh m = make_built("rock", 1000, o);
  rays r = make_rays(&m.tree, all);
  trbvh empty = {0}, bare = m.tree;
  trbvh_stats stats;
  uint32_t i, n;
  o.device = device;
  o.flags = TRBVH_NO_FALLBACK;
  for (n = 0; n < sizeof counts / sizeof counts[0]; ++n) {
    CONTEXT("%u rays", counts[n]);
    rays_clear(&r, counts[n]);
    CHECK(trbvh_intersect_n(&m.tree, r.ray, r.hit, r.count, &o) == TRBVH_OK);
    CHECK(trbvh_occluded_n(&m.tree, r.ray, r.any, r.count, &o) == TRBVH_OK);
    check_rays(&r, &m.s, "batch");
  }
  CONTEXT("rays that hit nothing");
  for (i = 0; i < all; ++i) {
    float *numbers = (float *)&r.ray[i];
    switch (i % 4) {
      case 0: numbers[i / 4 % 3] = bad_float(i / 4); break;
      case 1: numbers[4 + i / 4 % 3] = bad_float(i / 4); break;
      case 2: memset(r.ray[i].dir, 0, sizeof r.ray[i].dir); break;
      default: r.ray[i].tmin = 2.5f; r.ray[i].tmax = i & 8 ? 2.5f : 1.0f;
    }
    trbvh_intersect(&m.tree, &r.ray[i], &r.want[i]);
  }
  CHECK(trbvh_intersect_n(&m.tree, r.ray, r.hit, all, &o) == TRBVH_OK);
  CHECK(trbvh_occluded_n(&m.tree, r.ray, r.any, all, &o) == TRBVH_OK);
  for (n = i = 0; i < all; ++i) n += r.any[i] || memcmp(&r.hit[i], &r.want[i], sizeof r.hit[i]);
  CHECK_MSG(!n, "%u of %u rays are not what they are on the host", n, all);
  CONTEXT("an empty tree");
  for (n = i = 0; i < all; ++i) trbvh_intersect(&empty, &r.ray[i], &r.want[i]);
  CHECK(trbvh_intersect_n(&empty, r.ray, r.hit, all, &o) == TRBVH_OK && !memcmp(r.hit, r.want, sizeof(trbvh_hit) * all));
  memset(r.any, 1, all);
  CHECK(trbvh_occluded_n(&empty, r.ray, r.any, all, &o) == TRBVH_OK && !memchr(r.any, 1, all));
  CONTEXT("a tree without triangles, and arguments");
  bare.triangles = NULL;
  o.stats = &stats;
  stats.message[0] = 0;
  CHECK(trbvh_intersect_n(&bare, r.ray, r.hit, 10, &o) == TRBVH_INVALID_ARGUMENT && stats.message[0]);
  CHECK(trbvh_occluded_n(&bare, r.ray, r.any, 10, &o) == TRBVH_INVALID_ARGUMENT);
  CHECK(trbvh_intersect_n(&m.tree, NULL, r.hit, 10, &o) == TRBVH_INVALID_ARGUMENT);
  CHECK(trbvh_intersect_n(&m.tree, r.ray, NULL, 10, &o) == TRBVH_INVALID_ARGUMENT);
  CHECK(trbvh_occluded_n(&m.tree, r.ray, NULL, 10, &o) == TRBVH_INVALID_ARGUMENT);
  CHECK(trbvh_intersect_n(&m.tree, NULL, NULL, 0, &o) == TRBVH_OK);
  rays_free(&r);
  mesh_free(&m);
}

#ifdef __linux__
// >>device-resident trees -------------------------------------------------------------------------------------------
static void check_closed(trbvh_device *d)
{
  trbvh_cl_close(d);
  check_nothing_alive();
}
static int cl_tree_is_empty(const trbvh_cl_tree *t)
{
  return !t->nodes && !t->prims && !t->triangles && !t->node_count && !t->ref_count && !t->prim_count;
}
static void check_event(struct _cl_event *event)
{
  void *events[1];
  int status = 77;
  events[0] = event;
  CHECK_MSG(event, "no event");
  if (!event) return;
  CHECK(clWaitForEvents(1, events) == 0);
  CHECK(clGetEventInfo(event, CL_EVENT_STATUS, sizeof status, &status, NULL) == 0);
  CHECK_MSG(status == 0, "event status %d", status);
  clReleaseEvent(event);
}
/* What is in the device's tree, by the way of trbvh_cl_download and by reading the buffers. */
static void check_tree_on_device(const own *o, const trbvh_cl_tree *tree, const trbvh *want, const char *what)
{
  trbvh got = {0}, raw = *want;
  counter c = {0};
  trbvh_options options = {0};
  const char *differs;
  trbvh_result result;
  options.allocator = counter_allocator(&c);
  CHECK_MSG(tree->node_count == want->node_count && tree->ref_count == want->ref_count && tree->prim_count == want->prim_count,
      "%s: %u nodes, %u references, %u primitives", what, tree->node_count, tree->ref_count, tree->prim_count);
  result = trbvh_cl_download(o->device, tree, &got, &options);
  differs = result ? trbvh_result_text(result) : difference(want, &got);
  CHECK_MSG(!differs, "%s: %s", what, differs);
  CHECK_MSG(result || !got.nodes || ((uintptr_t)got.nodes % 64 == 0 && c.live == 1 && c.live_bytes == got.block_size),
      "%s: %u blocks live", what, c.live);
  trbvh_free(&got);
  check_balance(&c);
  if (differs || !want->node_count) return;
  raw.nodes = (const trbvh_node *)own_read(o, tree->nodes, sizeof(trbvh_node) * want->node_count);
  raw.prims = (const uint32_t *)own_read(o, tree->prims, sizeof(uint32_t) * want->ref_count);
  raw.triangles = tree->triangles ? (const trbvh_triangle *)own_read(o, tree->triangles, sizeof(trbvh_triangle) * want->ref_count) : NULL;
  differs = difference(want, &raw);
  CHECK_MSG(!differs, "%s, its buffers: %s", what, differs);
  free((void *)(uintptr_t)raw.nodes); free((void *)(uintptr_t)raw.prims); free((void *)(uintptr_t)raw.triangles);
}

static void test_trees_on_the_device(void)
{
  static const struct { const char *name; uint32_t n; } rows[] = {
    {"random", 3000}, {"sphere", 3000}, {"slivers", 2000}, {"city", 2500}, {"terrain", 3000}, {"not_finite", 2000},
    {"deep_bushy", 1000}, {"identical", 500}, {"all_nan", 20}, {"n0", 0}, {"n1", 1}, {"n2", 2}, {"n9", 9}};
  own o;
  unsigned at, i;
  own_open(&o);
  for (at = 0; at < sizeof rows / sizeof rows[0] && o.device; ++at)
    for (i = 0; i < FORMS * CL_PRESETS; ++i) {
      const int form = (int)i % FORMS, preset = (int)i / FORMS;
      int again;
      trbvh_options options = preset_options(preset);
      trbvh_stats scalar, stats;
      trbvh_cl_tree tree, twin, copy;
      trbvh_cl_geometry cl;
      struct _cl_event *event = NULL;
      trbvh_result result;
      mesh m;
      CONTEXT("scene %s, preset %s, form %d", rows[at].name, preset_names[preset], form);
      if (form == FORM_WIDE) { options.flags = TRBVH_NO_TRIANGLES; options.max_leaf = 3; }
      options.stats = &scalar;
      m = make_built(rows[at].name, rows[at].n, options);
      cl = own_geometry(&o, &m.s, form);
      memset(&tree, 0, sizeof tree);
      memset(&twin, 0, sizeof twin);
      memset(&copy, 0, sizeof copy);
      memset(&stats, 0x55, sizeof stats);
      options.stats = &stats;
      stub_quiet();
      result = trbvh_cl_build(o.device, &tree, &cl, &options, form == FORM_TIGHT ? NULL : &event);
      CHECK_MSG(result == TRBVH_OK, "%s: %s", trbvh_result_text(result), stats.message);
      if (form != FORM_TIGHT && m.tree.node_count) check_event(event);
      else if (event) clReleaseEvent(event);
      check_stats(&scalar, &stats);
      CHECK(stats.on_device == 1 || m.tree.node_count == 0);
      options.stats = NULL;                        /* for which stages are timed, and waited for */
      for (again = 0; again < 2; ++again) {        /* the second time over a tree that is there */
        stub_quiet();
        result = trbvh_cl_build(o.device, &twin, &cl, &options, NULL);
        CHECK_MSG(result == TRBVH_OK, "twin %d: %s", again, trbvh_result_text(result));
        CHECK_MSG(stub.waits <= (preset < 2 ? 1u : 3u), "waited %u times for the device", stub.waits);   /* do splits pay? */
      }
      check_tree_on_device(&o, &tree, &m.tree, "built on the device");
      trbvh_cl_free(o.device, &tree);
      CHECK(cl_tree_is_empty(&tree));
      trbvh_cl_free(o.device, &tree);
      check_tree_on_device(&o, &twin, &m.tree, "the second one");
      result = trbvh_cl_upload(o.device, &copy, &m.tree);
      CHECK_MSG(result == TRBVH_OK, "upload: %s", trbvh_result_text(result));
      check_tree_on_device(&o, &copy, &m.tree, "uploaded");
      trbvh_cl_free(o.device, &twin);
      trbvh_cl_free(o.device, &copy);
      own_geometry_free(&cl);
      mesh_free(&m);
    }
  own_close(&o);
}

static void test_refit(void)
{
  static const struct { const char *name; uint32_t n; } rows[] = {
    {"random", 4000}, {"sphere", 4000}, {"slivers", 2000}, {"city", 3000}, {"grid", 1000}, {"identical", 500}, {"deep", 2000},
    {"deep_bushy", 2000}, {"n0", 0}, {"n1", 1}, {"n2", 2}, {"n3", 3}};
  own o;
  unsigned at;
  own_open(&o);
  for (at = 0; at < CL_PRESETS * sizeof rows / sizeof rows[0] && o.device; ++at) {
    const int preset = (int)at % CL_PRESETS;
    const unsigned row = at / CL_PRESETS;
    mesh m = make_built(rows[row].name, rows[row].n, preset_options(preset));
    trbvh_cl_geometry cl = own_geometry(&o, &m.s, (int)row % FORMS), moved;
    trbvh_cl_tree tree;
    trbvh got = {0};
    struct _cl_event *event = NULL;
    trbvh_options options = preset_options(preset);
    walk_info info;
    char why[256] = "";
    rng random = {at};
    rays r;
    uint32_t i, others = 0;
    memset(&tree, 0, sizeof tree);
    CONTEXT("scene %s, preset %s, the same positions", m.s.name, preset_names[preset]);
    CHECK(trbvh_cl_build(o.device, &tree, &cl, &options, NULL) == TRBVH_OK);
    CHECK(trbvh_cl_refit(o.device, &tree, &cl, &event) == TRBVH_OK);
    if (m.s.count) check_event(event);
    else if (event) clReleaseEvent(event);
    if (preset < 2) check_tree_on_device(&o, &tree, &m.tree, "refit");
    CHECK(trbvh_cl_download(o.device, &tree, &got, NULL) == TRBVH_OK);
    CHECK_MSG(trbvh_validate(&got, &m.g, why, sizeof why) == TRBVH_OK, "%s", why);
    CONTEXT("scene %s, preset %s, moved", m.s.name, preset_names[preset]);
    for (i = 0; i < 3 * m.s.vertex_count; ++i) m.s.positions[i] += rng_range(&random, -0.25f, 0.25f) + (float)(i % 3);
    moved = own_geometry(&o, &m.s, (int)(row + 1) % FORMS);
    stub_quiet();
    CHECK(trbvh_cl_refit(o.device, &tree, &moved, NULL) == TRBVH_OK);
    CHECK_MSG(stub.waits == 0, "waited %u times for the device", stub.waits);
    trbvh_free(&got);
    CHECK(trbvh_cl_download(o.device, &tree, &got, NULL) == TRBVH_OK);
    CHECK_MSG(trbvh_validate(&got, &m.g, why, sizeof why) == TRBVH_OK, "%s", why);
    if (preset < 2) CHECK_MSG(walk_tree(&got, &m.g, 8, 0, &info, why, sizeof why), "%s", why);
    CHECK(trbvh_build(&m.tree, &m.g, NULL) == TRBVH_OK);
    r = make_rays(&m.tree, 2000);
    for (i = 0; i < r.count; ++i) {
      trbvh_intersect(&got, &r.ray[i], &r.hit[i]);
      others += memcmp(&r.hit[i], &r.want[i], sizeof r.hit[i]) != 0;
    }
    CHECK_MSG(!others, "%u of %u rays hit something else than in a tree built anew", others, r.count);
    moved.count ^= 1;
    CHECK(trbvh_cl_refit(o.device, &tree, &moved, NULL) == TRBVH_INVALID_ARGUMENT);
    rays_free(&r);
    trbvh_cl_free(o.device, &tree);
    own_geometry_free(&cl); own_geometry_free(&moved);
    trbvh_free(&got);
    mesh_free(&m);
  }
  own_close(&o);
}

/* The nodes that trbvh_optimize makes, whatever the tree, and whatever it is to become. */
static void test_optimize(void)
{
  static const struct { const char *name; uint32_t n; } rows[] = {
    {"random", 3000}, {"sphere", 3000}, {"slivers", 2000}, {"city", 2500}, {"identical", 500}, {"deep_bushy", 1000},
    {"n0", 0}, {"n1", 1}, {"n2", 2}, {"n9", 9}};
  own o;
  unsigned at;
  own_open(&o);
  for (at = 0; at < 3 * sizeof rows / sizeof rows[0] && o.device; ++at) {
    const unsigned row = at / 3;
    unsigned quality;
    mesh m = make_built(rows[row].name, rows[row].n, preset_options((int)at % 3));
    for (quality = 0; quality < 5; ++quality) {
      trbvh want = {0};
      trbvh_cl_tree tree;
      trbvh_options options = preset_options((int)at % 3);
      trbvh_stats scalar, stats;
      struct _cl_event *event = NULL;
      memset(&tree, 0, sizeof tree);
      memset(&stats, 0x55, sizeof stats);
      CONTEXT("scene %s, built %s, quality %u", m.s.name, preset_names[at % 3], quality);
      CHECK(trbvh_build(&want, &m.g, &options) == TRBVH_OK);
      CHECK(trbvh_cl_upload(o.device, &tree, &want) == TRBVH_OK);
      memset(&options, 0, sizeof options);
      options.quality = (trbvh_quality)quality;
      options.stats = &scalar;
      CHECK(trbvh_optimize(&want, &options) == TRBVH_OK);
      options.stats = quality & 1 ? &stats : NULL;
      stub_quiet();
      CHECK_MSG(trbvh_cl_optimize(o.device, &tree, &options, &event) == TRBVH_OK, "%s", trbvh_cl_message(o.device));
      if (!options.stats) CHECK_MSG(stub.waits <= 1, "waited %u times for the device", stub.waits);
      else check_stats(&scalar, &stats);
      if (want.node_count) check_event(event);
      else if (event) clReleaseEvent(event);
      check_tree_on_device(&o, &tree, &want, "optimized");
      trbvh_cl_free(o.device, &tree);
      trbvh_free(&want);
    }
    mesh_free(&m);
  }
  own_close(&o);
}

static void read_rays(const own *o, rays *r, struct _cl_mem *hit, struct _cl_mem *any)
{
  free(r->hit); free(r->any);
  r->hit = (trbvh_hit *)own_read(o, hit, sizeof(trbvh_hit) * (r->count + 1));
  r->any = (uint8_t *)own_read(o, any, r->count + 1);
}
static void test_rays_on_the_device(void)
{
  static const struct { const char *name; uint32_t n; } rows[] = {{"rock", 3000}, {"slivers", 3000}, {"n1", 1}, {"n0", 0}};
  own o;
  unsigned at;
  own_open(&o);
  for (at = 0; at < 8 && o.device; ++at) {
    trbvh_options options = preset_options(2);
    mesh m = make_built(rows[at / 2].name, rows[at / 2].n, options);
    trbvh_cl_geometry cl = own_geometry(&o, &m.s, FORM_TIGHT);
    trbvh_cl_tree tree;
    rays r = make_rays(&m.tree, 5001);
    struct _cl_mem *ray = own_buffer(&o, r.ray, sizeof(trbvh_ray) * r.count);
    struct _cl_mem *hit = own_buffer(&o, r.hit, sizeof(trbvh_hit) * (r.count + 1)), *any = own_buffer(&o, r.any, r.count + 1);
    struct _cl_event *event = NULL;
    trbvh_hit *batch = (trbvh_hit *)xmalloc(sizeof(trbvh_hit) * r.count);
    CONTEXT("scene %s, %s", m.s.name, at & 1 ? "uploaded" : "built on the device");
    memset(&tree, 0, sizeof tree);
    if (at & 1) CHECK(trbvh_cl_upload(o.device, &tree, &m.tree) == TRBVH_OK);
    else CHECK(trbvh_cl_build(o.device, &tree, &cl, &options, NULL) == TRBVH_OK);
    stub_quiet();
    CHECK(trbvh_cl_intersect(o.device, &tree, ray, hit, r.count, &event) == TRBVH_OK);
    CHECK_MSG(stub.waits == 0, "waited %u times for the device", stub.waits);
    check_event(event);
    event = NULL;
    CHECK(trbvh_cl_occluded(o.device, &tree, ray, any, r.count, &event) == TRBVH_OK);
    check_event(event);
    read_rays(&o, &r, hit, any);
    check_rays(&r, &m.s, "device-resident");
    options.device = o.device;
    options.flags = TRBVH_NO_FALLBACK;
    CHECK(trbvh_intersect_n(&m.tree, r.ray, batch, r.count, &options) == TRBVH_OK);
    CHECK_MSG(same_bits(batch, r.hit, sizeof(trbvh_hit) * r.count), "the batch query gives other hits");
    CHECK(trbvh_cl_intersect(o.device, &tree, ray, hit, 0, NULL) == TRBVH_OK);
    CHECK(trbvh_cl_occluded(o.device, &tree, ray, any, 0, NULL) == TRBVH_OK);
    trbvh_cl_free(o.device, &tree);
    own_release(ray); own_release(hit); own_release(any);
    own_geometry_free(&cl);
    free(batch);
    rays_free(&r);
    mesh_free(&m);
  }
  own_close(&o);
}

static void test_arguments_on_the_device(void)
{
  static const uint32_t bad = 0x7FFFFFFFu;
  own o;
  mesh m = make_mesh("sphere", 1500);
  trbvh_cl_geometry good, g;
  trbvh_cl_tree tree;
  trbvh_options options = preset_options(1);
  trbvh_stats stats;
  struct _cl_mem *buffer;
  trbvh_cl_desc desc = {0};
  ticks t = {0};
  int i, error = 0;
  CONTEXT("arguments");
  own_open(&o);
  if (!o.device) { own_close(&o); mesh_free(&m); return; }
  good = own_geometry(&o, &m.s, FORM_OFFSETS);
  buffer = own_buffer(&o, NULL, 1 << 16);
  options.stats = &stats;
  for (i = 0; i < 17; ++i) {
    trbvh_result result;
    memset(&tree, 0, sizeof tree);
    memset(&stats, 0, sizeof stats);
    g = good;
    switch (i) {
      case 0: g.position_offset += 2; break;
      case 1: g.position_stride += 1; break;
      case 2: g.position_stride = 8; break;
      case 3: g.index_offset += 1; break;
      case 4: g.index_offset += 2; break;
      case 5: g.index_size = 3; break;
      case 6: g.positions = NULL; break;
      case 7: g.position_count = 0; break;
      case 8: g.index_size = 2; g.index_offset = 1; break;
      case 9: g.position_count = 1u << 30; break;                  /* more than there is in the buffers */
      case 10: g.count = 1u << 28; break;
      case 11: g.position_offset = ~(size_t)0 - 3; break;
      case 12: g.position_stride = (size_t)1 << 62; g.position_count = 5; break;
      case 13: g.index_offset = ~(size_t)0 - 3; break;
      default: break;
    }
    CONTEXT("bad argument %d", i);
    result = trbvh_cl_build(i == 14 ? NULL : o.device, i == 15 ? NULL : &tree, i == 16 ? NULL : &g, &options, NULL);
    CHECK_MSG(result == TRBVH_INVALID_ARGUMENT || (i == 14 && result == TRBVH_NO_DEVICE), "%s", trbvh_result_text(result));
    CHECK(stats.message[0] && cl_tree_is_empty(&tree));
    CHECK(i == 14 || !strcmp(trbvh_cl_message(o.device), stats.message));
  }
  CHECK(trbvh_cl_message(NULL)[0] && trbvh_cl_name(NULL));
  CONTEXT("cancelled");
  t.cancel_at = 3;
  options.progress = on_tick;
  options.progress_user = &t;
  CHECK(trbvh_cl_build(o.device, &tree, &good, &options, NULL) == TRBVH_CANCELLED && cl_tree_is_empty(&tree) && !t.wrong);
  options.progress = NULL;
  CONTEXT("a queue that is out of order");
  desc.queue = (struct _cl_command_queue *)real_cl.clCreateCommandQueue(o.context, o.id, 1, &error);
  if (desc.queue) {
    CHECK(!trbvh_cl_open(&desc, &stats) && stats.message[0]);
    real_cl.clReleaseCommandQueue(desc.queue);
  }
  CONTEXT("an index out of range");
  CHECK(real_cl.clEnqueueWriteBuffer(o.queue, good.indices, 1, good.index_offset + 4 * 1000, 4, &bad, 0, NULL, NULL) == 0);
  CHECK(trbvh_cl_build(o.device, &tree, &good, &options, NULL) == TRBVH_BAD_GEOMETRY && cl_tree_is_empty(&tree));
  CHECK_MSG(strstr(stats.message, "333") && strstr(stats.message, "2147483647"), "%s", stats.message);
  CONTEXT("a tree without triangles");
  options.flags = TRBVH_NO_TRIANGLES;
  CHECK(trbvh_build(&m.tree, &m.g, &options) == TRBVH_OK);
  CHECK(trbvh_cl_upload(o.device, &tree, &m.tree) == TRBVH_OK && !tree.triangles);
  CHECK(trbvh_cl_intersect(o.device, &tree, buffer, buffer, 1, NULL) == TRBVH_INVALID_ARGUMENT);
  CHECK(trbvh_cl_occluded(o.device, &tree, buffer, buffer, 1, NULL) == TRBVH_INVALID_ARGUMENT);
  CONTEXT("nothing at all");
  CHECK(trbvh_cl_intersect(o.device, NULL, buffer, buffer, 1, NULL) == TRBVH_INVALID_ARGUMENT);
  CHECK(trbvh_cl_intersect(o.device, &tree, NULL, buffer, 1, NULL) == TRBVH_INVALID_ARGUMENT);
  CHECK(trbvh_cl_download(o.device, &tree, NULL, NULL) == TRBVH_INVALID_ARGUMENT);
  CHECK(trbvh_cl_optimize(o.device, NULL, &options, NULL) == TRBVH_INVALID_ARGUMENT && stats.message[0]);
  CHECK(trbvh_cl_optimize(NULL, &tree, &options, NULL) == TRBVH_NO_DEVICE && stats.message[0]);
  CONTEXT("optimizing that is cancelled");
  for (t.cancel_at = 1;; ++t.cancel_at) {
    trbvh_result result;
    options.progress = on_tick;
    t.count = 0;
    CHECK(trbvh_build(&m.tree, &m.g, NULL) == TRBVH_OK && trbvh_cl_upload(o.device, &tree, &m.tree) == TRBVH_OK);
    result = trbvh_cl_optimize(o.device, &tree, &options, NULL);
    CHECK(result == (t.count < t.cancel_at ? TRBVH_OK : TRBVH_CANCELLED));
    if (result) check_tree_on_device(&o, &tree, &m.tree, "cancelled");
    if (!result) break;
  }
  CHECK_MSG(t.cancel_at > 5, "%u ticks", t.cancel_at);
  options.progress = NULL;
  trbvh_cl_free(o.device, &tree);
  CHECK(trbvh_cl_upload(o.device, &tree, NULL) == TRBVH_INVALID_ARGUMENT);
  trbvh_cl_free(o.device, NULL);
  trbvh_cl_close(NULL);
  own_geometry_free(&good);
  own_release(buffer);
  mesh_free(&m);
  own_close(&o);
}

// >>failures --------------------------------------------------------------------------------------------------------
static const struct { int code, lost; const char *name; } faults[] = {
  {CL_NO_MEMORY, 0, "no memory"}, {CL_NO_RESOURCES, 0, "no resources"}, {CL_NO_HOST_MEMORY, 0, "no host memory"},
  {CL_BUILD_FAILED, 0, "build failure"}, {CL_NO_RESOURCES, 1, "device lost"}
};
#define FAULTS (sizeof faults / sizeof faults[0])

static int is_device_error(trbvh_result r) { return r == TRBVH_OUT_OF_DEVICE_MEMORY || r == TRBVH_DEVICE_ERROR || r == TRBVH_NO_DEVICE; }
static void arm(unsigned preset, unsigned fault, unsigned n)       /* the n-th call fails from now on */
{
  stub_reset(n, faults[fault].code, faults[fault].lost);
  CONTEXT("%s, %s at call %u", preset_names[preset], faults[fault].name, n);
}
static void disarm(void)                                           /* and the next check is about what follows */
{
  const size_t used = strlen(test_now.context);
  snprintf(test_now.context + used, sizeof test_now.context - used, " (%s), then again", stub.failed ? stub.failed : "none");
  stub_quiet();
}
/* A build on a device of which any call may fail: as if nothing were amiss, or in scalar C and with a reason. */
static void check_build(trbvh_device *d, const mesh *m, trbvh_options o, uint32_t flags, int may_fail)
{
  trbvh tree = {0};
  trbvh_stats stats;
  trbvh_result result;
  counter c = {0};
  memset(&stats, 0x55, sizeof stats);
  o.device = d;
  o.flags = flags;
  o.stats = &stats;
  o.allocator = counter_allocator(&c);
  result = trbvh_build(&tree, &m->g, &o);
  CHECK_MSG(!stub.pending, "the device still works on memory of ours");
  if (result == TRBVH_OK) {
    const char *differs = difference(&m->tree, &tree);
    CHECK_MSG(!differs, "%s", differs);
    if (stats.on_device == 0) CHECK_MSG(stats.message[0] && !flags, "scalar: %s", stats.message);
    else CHECK_MSG(stats.on_device == 1 && !stats.message[0], "on_device %d, %s", stats.on_device, stats.message);
  } else {
    CHECK_MSG(may_fail && flags && is_device_error(result), "%s: %s", trbvh_result_text(result), stats.message);
    CHECK(stats.message[0] && memchr(stats.message, 0, sizeof stats.message) && tree_is_empty(&tree));
  }
  trbvh_free(&tree);
  check_balance(&c);
}

/* Opening, the first build, which compiles what it needs or finds it in a cache, the second one, closing. Coarse steps:
 * the next test is finer. */
static void test_failing_calls_from_opening_on(void)
{
  mesh m[CL_PRESETS];
  memory_cache cache;
  trbvh_cl_desc desc = {0};
  unsigned fault, preset, opening = 0;
  memset(&cache, 0, sizeof cache);
  desc.cache_load = cache_load;
  desc.cache_save = cache_save;
  desc.user = &cache;
  for (preset = 0; preset < CL_PRESETS; ++preset) m[preset] = make_built("slivers", 300, preset_options((int)preset));
  for (fault = 0; fault <= FAULTS; ++fault) {
    const trbvh_cl_desc *d_desc = fault ? &desc : NULL;
    const unsigned what = fault % FAULTS;
    unsigned n, step = 1, last = 0;
    for (n = fault && !faults[what].lost ? opening + 1 : 1; !last; n += step) {
      trbvh_options o;
      trbvh_stats stats;
      trbvh_device *d;
      memset(&stats, 0, sizeof stats);
      preset = fault && n > opening && TRB_CL_SHAPE == 0 ? 2 : 0;    /* the others compile for long */
      o = preset_options((int)preset);
      arm(preset, what, n);
      d = trbvh_cl_open(d_desc, &stats);
      CHECK_MSG(d || (stub.failed && stats.message[0]), "no device: %s", stats.message);
      if (d) {
        if (!stub.failed) opening = stub.calls;
        check_build(d, &m[preset], o, n & 1 ? 0 : TRBVH_NO_FALLBACK, 1);
        last = !stub.failed;
        disarm();
        check_build(d, &m[preset], o, last ? TRBVH_NO_FALLBACK : 0, 0);
        if (n > opening && opening) step = 1 + stub.calls / QUICK_OR(8, 25);      /* so many calls has a build that succeeds */
      }
      check_closed(d);
    }
  }
  stub_quiet();
  cache_free(&cache);
  for (preset = 0; preset < CL_PRESETS; ++preset) mesh_free(&m[preset]);
}

/* One device: a call of a build fails, each for some faults, and another build follows. */
static void test_failing_calls_of_builds(void)
{
  unsigned i;
  for (i = 0; i < CL_PRESETS * FAULTS; ++i) {
    const unsigned preset = i / FAULTS, fault = i % FAULTS;
    const trbvh_options o = preset_options((int)preset);
    mesh m = make_built("slivers", 300, o);
    trbvh_device *d = trbvh_cl_open(NULL, NULL);
    unsigned n, last = 0, step;
    CHECK(d);
    check_build(d, &m, o, 0, 0);
    stub_quiet();
    check_build(d, &m, o, 0, 0);
    step = 1 + stub.calls / (fault == preset ? QUICK_OR(40, 300) : QUICK_OR(8, 40));
    for (n = 1; !last && d; n += step) {
      arm(preset, fault, n);
      check_build(d, &m, o, n & 2 ? 0 : TRBVH_NO_FALLBACK, 1);
      last = !stub.failed;
      disarm();
      check_build(d, &m, o, 0, 0);
    }
    check_closed(d);
    mesh_free(&m);
  }
}

typedef struct work {
  own o;
  mesh m;
  trbvh_cl_geometry input;
  trbvh_cl_tree tree, made;                        /* tree is there; what is made is compared with it and freed */
  trbvh got;
  rays r;
  struct _cl_mem *ray, *hit, *any;
  trbvh_options options;
  struct _cl_event *event;
} work;
static trbvh_result do_build(work *w) { return trbvh_cl_build(w->o.device, &w->made, &w->input, &w->options, &w->event); }
static trbvh_result do_upload(work *w) { return trbvh_cl_upload(w->o.device, &w->made, &w->m.tree); }
static trbvh_result do_download(work *w) { return trbvh_cl_download(w->o.device, &w->tree, &w->got, NULL); }
static trbvh_result do_refit(work *w) { return trbvh_cl_refit(w->o.device, &w->tree, &w->input, &w->event); }
static trbvh_result do_intersect(work *w) { return trbvh_cl_intersect(w->o.device, &w->tree, w->ray, w->hit, w->r.count, &w->event); }
static trbvh_result do_occluded(work *w) { return trbvh_cl_occluded(w->o.device, &w->tree, w->ray, w->any, w->r.count, &w->event); }
static trbvh_result do_intersect_n(work *w) { return trbvh_intersect_n(&w->m.tree, w->r.ray, w->r.hit, w->r.count, &w->options); }
static trbvh_result do_occluded_n(work *w) { return trbvh_occluded_n(&w->m.tree, w->r.ray, w->r.any, w->r.count, &w->options); }
enum { HAS_STATS = 1, MAY_FALL_BACK = 2 };
static const struct { const char *name; trbvh_result (*run)(work *w); int flags; } works[] = {
  {"build", do_build, HAS_STATS}, {"upload", do_upload, 0}, {"download", do_download, 0}, {"refit", do_refit, 0},
  {"intersect", do_intersect, 0}, {"occluded", do_occluded, 0},
  {"intersect_n", do_intersect_n, HAS_STATS | MAY_FALL_BACK}, {"occluded_n", do_occluded_n, HAS_STATS | MAY_FALL_BACK}
};

static void test_failing_calls_on_the_device(void)
{
  work w;
  unsigned i, n;
  memset(&w, 0, sizeof w);
  CONTEXT("preparing");
  own_open(&w.o);
  if (!w.o.device) { own_close(&w.o); return; }
  w.options = preset_options(1);
  w.m = make_built("slivers", 400, w.options);
  w.input = own_geometry(&w.o, &w.m.s, FORM_OFFSETS);
  CHECK(trbvh_cl_upload(w.o.device, &w.tree, &w.m.tree) == TRBVH_OK);
  w.r = make_rays(&w.m.tree, 500);
  w.ray = own_buffer(&w.o, w.r.ray, sizeof(trbvh_ray) * w.r.count);
  w.hit = own_buffer(&w.o, w.r.hit, sizeof(trbvh_hit) * (w.r.count + 1));
  w.any = own_buffer(&w.o, w.r.any, w.r.count + 1);
  w.options.device = w.o.device;
  for (i = 0; i < FAULTS * sizeof works / sizeof works[0]; ++i) {
    const unsigned at = i / FAULTS, fault = i % FAULTS;
    int last = 0;
    for (n = 0; !last; n += 1 + n / QUICK_OR(4, 16)) {             /* 0: none, to compile what is needed */
      const long buffers = stub.live[STUB_BUFFER];
      trbvh_result result;
      trbvh_stats stats;
      memset(&stats, 0x55, sizeof stats);
      w.options.stats = &stats;
      w.options.flags = n & 1 ? TRBVH_NO_FALLBACK : 0;
      w.event = NULL;
      arm(1, fault, n);
      CONTEXT("%s, %s at call %u", works[at].name, faults[fault].name, n);
      result = works[at].run(&w);
      last = n && !stub.failed;
      if (works[at].flags & MAY_FALL_BACK) CHECK_MSG(!stub.pending, "the device still works on memory of ours");
      if (result) {
        CHECK_MSG(stub.failed && is_device_error(result), "%s", trbvh_result_text(result));
        CHECK(cl_tree_is_empty(&w.made) && tree_is_empty(&w.got) && !w.event);
        CHECK_MSG(stub.live[STUB_BUFFER] <= buffers, "%ld buffers, %ld before", stub.live[STUB_BUFFER], buffers);
        if (works[at].flags & HAS_STATS) CHECK_MSG(stats.message[0] && stats.message[0] != 0x55, "no message");
        CHECK_MSG(trbvh_cl_message(w.o.device)[0], "the device has no message");
        if (works[at].flags & MAY_FALL_BACK) CHECK_MSG(n & 1, "no fallback: %s", stats.message);
      } else if (works[at].flags & HAS_STATS) {
        CHECK_MSG(stats.on_device == !stats.message[0], "on_device %d: %s", stats.on_device, stats.message);
      }
      stub_quiet();
      if (w.event) check_event(w.event);
      if (!result && w.made.nodes) check_tree_on_device(&w.o, &w.made, &w.m.tree, "made");
      if (!result && w.got.nodes) CHECK(same_tree(&w.got, &w.m.tree));
      trbvh_cl_free(w.o.device, &w.made);
      trbvh_free(&w.got);
      if (works[at].flags & MAY_FALL_BACK && at == 7 && !result) check_rays(&w.r, &w.m.s, "batch");
    }
  }
  CONTEXT("after all that");
  read_rays(&w.o, &w.r, w.hit, w.any);
  check_rays(&w.r, &w.m.s, "device-resident");
  CHECK(trbvh_cl_refit(w.o.device, &w.tree, &w.input, NULL) == TRBVH_OK);
  check_tree_on_device(&w.o, &w.tree, &w.m.tree, "refit");
  trbvh_cl_free(w.o.device, &w.tree);
  own_geometry_free(&w.input);
  own_release(w.ray); own_release(w.hit); own_release(w.any);
  rays_free(&w.r);
  mesh_free(&w.m);
  own_close(&w.o);
}

/* A tree that could not be optimized is as it was. */
static void test_failing_calls_of_optimize(void)
{
  own o;
  mesh m = make_built("slivers", 400, preset_options(0));
  unsigned fault, n;
  own_open(&o);
  for (fault = 0; fault < FAULTS && o.device; ++fault) {
    int last = 0;
    for (n = 0; !last; n += 1 + n / QUICK_OR(2, 8)) {
      trbvh_cl_tree tree;
      trbvh_options options = preset_options(1);
      trbvh_stats stats;
      struct _cl_event *event = NULL;
      trbvh_result result;
      long buffers;
      memset(&tree, 0, sizeof tree);
      memset(&stats, 0x55, sizeof stats);
      options.stats = &stats;
      stub_quiet();
      CONTEXT("%s at call %u", faults[fault].name, n);
      CHECK(trbvh_cl_upload(o.device, &tree, &m.tree) == TRBVH_OK);
      buffers = stub.live[STUB_BUFFER];
      arm(1, fault, n);
      CONTEXT("%s at call %u", faults[fault].name, n);
      result = trbvh_cl_optimize(o.device, &tree, &options, &event);
      last = n && !stub.failed;
      if (result) {
        CHECK_MSG(stub.failed && is_device_error(result) && !event, "%s", trbvh_result_text(result));
        CHECK(stats.message[0] && stats.message[0] != 0x55 && trbvh_cl_message(o.device)[0]);
        CHECK_MSG(stub.live[STUB_BUFFER] <= buffers || n == 0, "%ld buffers, %ld before", stub.live[STUB_BUFFER], buffers);
      }
      stub_quiet();
      if (event) check_event(event);
      if (result) check_tree_on_device(&o, &tree, &m.tree, "after a failure");
      trbvh_cl_free(o.device, &tree);
    }
  }
  mesh_free(&m);
  own_close(&o);
}

static void test_little_memory(void)
{
  static const uint64_t sizes[] = {1, 1000, 16384, 1 << 17, 1 << 20, 1 << 22};
  const trbvh_options high = preset_options(2);
  mesh m = make_built("slivers", 6000, high);
  unsigned i;
  for (i = 0; i < sizeof sizes / sizeof sizes[0]; ++i) {
    trbvh_device *d;
    trbvh_stats stats;
    memset(&stats, 0, sizeof stats);
    CONTEXT("%u bytes on the device", (unsigned)sizes[i]);
    stub.little_memory = sizes[i];
    d = trbvh_cl_open(NULL, &stats);
    CHECK_MSG(d || stats.message[0], "no message");
    if (d) {
      trbvh tree = {0};
      trbvh_options o = high;
      trbvh_result result;
      check_build(d, &m, high, 0, 0);
      o.device = d;
      o.stats = &stats;
      o.flags = TRBVH_NO_FALLBACK;
      result = trbvh_build(&tree, &m.g, &o);
      CHECK_MSG(result == TRBVH_OUT_OF_DEVICE_MEMORY || (!result && i > 2), "%s: %s", trbvh_result_text(result), stats.message);
      trbvh_free(&tree);
    }
    stub.little_memory = 0;
    check_closed(d);
  }
  mesh_free(&m);
}

static void test_kernels_that_do_not_compile(void)
{
  trbvh_stats stats;
  trbvh_options o = preset_options(1);
  mesh m = make_built("random", 500, o);
  trbvh_device *d;
  CONTEXT("the compiler refuses");
  memset(&stats, 0, sizeof stats);
  stub.refuse_build = 1;
  d = trbvh_cl_open(NULL, &stats);
  if (d) {
    trbvh tree = {0};
    check_build(d, &m, o, 0, 0);
    o.device = d;
    o.flags = TRBVH_NO_FALLBACK;
    o.stats = &stats;
    CHECK(is_device_error(trbvh_build(&tree, &m.g, &o)));
  }
  CHECK_MSG(strstr(stats.message, "does not like"), "the message has nothing of the log: %s", stats.message);
  stub.refuse_build = 0;
  CONTEXT("the compiler does not refuse any more");
  if (d) check_build(d, &m, preset_options(1), 0, 0);
  check_closed(d);
  mesh_free(&m);
}

static void build_with_cache(const trbvh_cl_desc *desc, const mesh *m, int preset)
{
  trbvh_stats stats;
  trbvh_device *d = trbvh_cl_open(desc, &stats);
  CHECK_MSG(d, "%s", stats.message);
  if (d) check_build(d, m, preset_options(preset), TRBVH_NO_FALLBACK, 0);
  check_closed(d);
}
static void test_cache(void)
{
  enum { PLACES = QUICK_OR(8, 16), DAMAGES = PLACES + 12 };
  mesh fast = make_built("random", 300, preset_options(0)), high = make_built("random", 300, preset_options(2));
  trbvh_cl_desc desc = {0};
  memory_cache cache;
  unsigned i;
  memset(&cache, 0, sizeof cache);
  desc.cache_load = cache_load;
  desc.cache_save = cache_save;
  desc.user = &cache;
  CONTEXT("the first time");
  build_with_cache(&desc, &fast, 0);
  CHECK_MSG(cache.loads && cache.saves && cache.count, "%u loads, %u saves", cache.loads, cache.saves);
  for (i = 0; i < cache.count * DAMAGES; ++i) {
    const unsigned entry = i / DAMAGES, damage = i % DAMAGES;
    const size_t size = cache.size[entry];
    unsigned char *good = (unsigned char *)cache.bytes[entry], *bad = (unsigned char *)xmalloc(2 * size);
    rng random = {i};
    size_t k;
    memcpy(bad, good, size);
    memcpy(bad + size, good, size);
    CONTEXT("program %u, %zu bytes, damage %u", entry, size, damage);
    if (damage < PLACES) bad[damage < 5 ? 4 * damage : (size - 1) * (damage - 4) / (PLACES - 5)] ^= (unsigned char)(1u << damage % 8);
    else switch (damage - PLACES) {
      case 0: cache.size[entry] = 0; break;
      case 1: cache.size[entry] = 1; break;
      case 2: cache.size[entry] = 15; break;
      case 3: cache.size[entry] = size / 2; break;
      case 4: cache.size[entry] = size - 1; break;
      case 5: cache.size[entry] = size + 1; break;
      case 6: cache.size[entry] = 2 * size; break;
      case 7: memset(bad, 0, size); break;
      case 8: for (k = 0; k < size; ++k) bad[k] = (unsigned char)rng_u32(&random);
        break;
      default: cache.odd = (int)(damage - PLACES) - 8; break;
    }
    cache.bytes[entry] = bad;
    cache.saves = 0;
    build_with_cache(&desc, &fast, 0);
    CHECK_MSG(cache.saves || cache.odd, "the damage is not repaired");
    cache.odd = 0;
    free(cache.bytes[entry]);
    cache.bytes[entry] = good;
    cache.size[entry] = size;
  }
  CONTEXT("what else a better tree needs");
  cache.saves = 0;
  build_with_cache(&desc, &high, 2);
  CHECK_MSG(cache.saves, "nothing is saved");
  CONTEXT("the second time");
  cache.loads = cache.saves = 0;
  stub_quiet();
  build_with_cache(&desc, &high, 2);
  CHECK_MSG(cache.loads && !cache.saves, "%u loads, %u saves", cache.loads, cache.saves);
  CHECK_MSG(stub.by_name[STUB_clCreateProgramWithBinary] && !stub.by_name[STUB_clCreateProgramWithSource], "compiled again");
  CONTEXT("half of the functions");
  desc.cache_save = NULL;
  build_with_cache(&desc, &fast, 0);
  desc.cache_save = cache_save;
  desc.cache_load = NULL;
  build_with_cache(&desc, &fast, 0);
  cache_free(&cache);
  mesh_free(&fast); mesh_free(&high);
}

// >>devices ---------------------------------------------------------------------------------------------------------
static int is_text(const char *p, size_t size) { return p[0] && memchr(p, 0, size); }

static void test_devices(void)
{
  trbvh_cl_info info[17];
  const uint32_t count = trbvh_cl_devices(NULL, 0);
  uint32_t i;
  CONTEXT("devices");
  memset(info, 0x55, sizeof info);
  CHECK_MSG(count >= 1 && count <= count_devices(), "%u devices, OpenCL tells of %u", count, count_devices());
  CHECK(trbvh_cl_devices(info, 16) == count);
  for (i = 0; i < count && i < 16; ++i) {
    CHECK_MSG(is_text(info[i].name, 128) && is_text(info[i].platform, 128) && is_text(info[i].version, 128), "device %u", i);
    CHECK_MSG(info[i].memory_bytes >= 1u << 20 && info[i].compute_units >= 1, "%u units", info[i].compute_units);
    CHECK(info[i].is_gpu == 0 || info[i].is_gpu == 1);
  }
  CHECK_MSG(info[i].is_gpu == 0x55555555, "written beyond the last device");
  memset(info, 0x55, sizeof info);
  CHECK(trbvh_cl_devices(info, count - 1) == count && info[count - 1].is_gpu == 0x55555555);
  for (i = 1; i < 200; ++i) {
    arm(0, 2 + 2 * (i & 1), i);
    CHECK(trbvh_cl_devices(info, 16) <= count);
    if (!stub.failed) break;
  }
  CHECK_MSG(i > 3 && i < 200, "%u calls", i);
  stub_quiet();
  check_nothing_alive();
}

static void check_open(const char *name, const char *expect)       /* NULL: no device */
{
  trbvh_cl_desc desc = {0};
  trbvh_stats stats;
  trbvh_device *d;
  memset(&stats, 0, sizeof stats);
  desc.name = name;
  d = trbvh_cl_open(&desc, &stats);
  if (expect) CHECK_MSG(d && strstr(trbvh_cl_name(d), expect), "name %s: %s", name ? name : "NULL", d ? trbvh_cl_name(d) : stats.message);
  else CHECK_MSG(!d && stats.message[0], "name %s: %s", name ? name : "NULL", d ? trbvh_cl_name(d) : "no message");
  check_closed(d);
  d = trbvh_cl_open(&desc, NULL);
  CHECK(!d == !expect);
  check_closed(d);
}
static void test_names(void)
{
  static const char nothing[] = "no device has this name";
  trbvh_cl_info info[16];
  const uint32_t count = trbvh_cl_devices(info, 16);
  uint32_t i;
  for (i = 0; i < count && i < 16; ++i) {
    char part[128];
    unsigned k;
    CONTEXT("the name of device %u", i);
    snprintf(part, sizeof part, "%s", info[i].name + 1);
    if (strlen(part) > 4) part[strlen(part) - 1] = 0;
    check_open(info[i].name, info[i].name);
    check_open(part, part);
    for (k = 0; part[k]; ++k) part[k] = (char)(part[k] >= 'a' && part[k] <= 'z' ? part[k] - 32 : part[k]);
    check_open(part, "");
    check_open(info[i].platform, "");
    CONTEXT("the name of device %u is in the environment", i);
    setenv("TRBVH_CL_DEVICE", info[i].name, 1);
    check_open(NULL, info[i].name);
    check_open(nothing, NULL);
    setenv("TRBVH_CL_DEVICE", nothing, 1);
    check_open(NULL, NULL);
    check_open(info[i].name, info[i].name);
    setenv("TRBVH_CL_DEVICE", "", 1);
    check_open(NULL, "");
    unsetenv("TRBVH_CL_DEVICE");
  }
  CONTEXT("no name, a wrong name");
  check_open(NULL, "");
  check_open(nothing, NULL);
}

static void test_called_a_gpu(void)                /* the kernels for GPUs by the device's type, not by a macro */
{
  trbvh_cl_info info;
  mesh m = make_mesh("slivers", 3000);
  CONTEXT("a device called a GPU");
  stub.fake_gpu = 1;
  CHECK(trbvh_cl_devices(&info, 1) && info.is_gpu == 1);
  stub.group = 0;
  device = trbvh_cl_open(NULL, NULL);
  CHECK(device);
  if (device) check_same(&m.g, preset_options(0));
  CHECK_MSG(stub.group > 1, "work-groups of %zu", stub.group);
  check_closed(device);
  device = NULL;
  stub.fake_gpu = 0;
  mesh_free(&m);
}

// >>kernels of a user's own -----------------------------------------------------------------------------------------
static const char user_kernel[] =
  "__kernel void user(const __global trbvh_node *nodes, const __global trbvh_triangle *triangles,\n"
  "                   const __global trbvh_ray *rays, __global trbvh_hit *hits, __global uchar *occluded) {\n"
  "  const size_t i = get_global_id(0);\n"
  "  trbvh_hit hit;\n"
  "  const int found = trbvh_intersect(nodes, triangles, rays[i], &hit);\n"
  "  hits[i] = hit;\n"
  "  occluded[i] = trbvh_occluded(nodes, triangles, rays[i]);\n"
  "  if (found != (hit.prim != TRBVH_NONE)) occluded[i] = 2;\n"
  "}\n";

static void test_user_kernel(void)
{
  const trbvh_options high = preset_options(2);
  mesh m = make_built("city", 3000, high);
  rays r = make_rays(&m.tree, 4096);
  uint32_t lines = 0, i;
  const char *const *source = trbvh_cl_source(&lines);
  const char **strings = (const char **)xmalloc(sizeof(char *) * (lines + 1));
  static char log[1 << 16];
  const size_t local = 1;
  trbvh_cl_tree tree;
  trbvh_hit *hits;
  own o;
  int error = 0;
  CONTEXT("a kernel of the test's own");
  memset(&tree, 0, sizeof tree);
  for (i = 0; i < lines; ++i) strings[i] = source[i];
  strings[lines] = user_kernel;
  own_open(&o);
  if (o.device && trbvh_cl_upload(o.device, &tree, &m.tree) == TRBVH_OK) {
    struct _cl_mem *hit = own_buffer(&o, r.hit, sizeof(trbvh_hit) * (r.count + 1)), *any = own_buffer(&o, r.any, r.count + 1);
    struct _cl_mem *buffers[5];
    void *program = real_cl.clCreateProgramWithSource(o.context, lines + 1, strings, NULL, &error), *kernel;
    const size_t count = r.count;
    buffers[0] = tree.nodes; buffers[1] = tree.triangles; buffers[3] = hit; buffers[4] = any;
    buffers[2] = own_buffer(&o, r.ray, sizeof(trbvh_ray) * r.count);
    error = real_cl.clBuildProgram(program, 1, &o.id, "-cl-std=CL1.2", NULL, NULL);
    if (error) real_cl.clGetProgramBuildInfo(program, o.id, CL_BUILD_LOG, sizeof log - 1, log, NULL);
    CHECK_MSG(!error, "error %d: %s", error, log);
    kernel = real_cl.clCreateKernel(program, "user", &error);
    for (i = 0; i < 5 && kernel; ++i) CHECK(real_cl.clSetKernelArg(kernel, i, sizeof buffers[i], &buffers[i]) == 0);
    CHECK(kernel && real_cl.clEnqueueNDRangeKernel(o.queue, kernel, 1, NULL, &count, &local, 0, NULL, NULL) == 0);
    read_rays(&o, &r, hit, any);
    check_rays(&r, &m.s, "its own");
    CHECK(trbvh_cl_intersect(o.device, &tree, buffers[2], hit, r.count, NULL) == TRBVH_OK);
    hits = (trbvh_hit *)own_read(&o, hit, sizeof(trbvh_hit) * r.count);
    CHECK_MSG(same_bits(hits, r.hit, sizeof(trbvh_hit) * r.count), "other hits than trbvh_cl_intersect's");
    free(hits);
    if (kernel) real_cl.clReleaseKernel(kernel);
    real_cl.clReleaseProgram(program);
    own_release(buffers[2]); own_release(hit); own_release(any);
    trbvh_cl_free(o.device, &tree);
  }
  own_close(&o);
  free((void *)(uintptr_t)strings);
  rays_free(&r);
  mesh_free(&m);
}
#endif

// >>without a device ------------------------------------------------------------------------------------------------
static void check_no_device(const char *what)
{
  trbvh_stats stats;
  trbvh_cl_info info;
  trbvh_cl_desc desc = {0};
  CONTEXT("%s", what);
  desc.name = "any";
  memset(&stats, 0, sizeof stats);
  CHECK(trbvh_cl_devices(NULL, 0) == 0 && trbvh_cl_devices(&info, 1) == 0);
  CHECK_MSG(!trbvh_cl_open(NULL, &stats) && stats.message[0] && memchr(stats.message, 0, sizeof stats.message), "no message");
  memset(&stats, 0, sizeof stats);
  CHECK_MSG(!trbvh_cl_open(&desc, &stats) && stats.message[0], "no message");
  CHECK(!trbvh_cl_open(&desc, NULL));
}
static void test_without_a_device(void)
{
  mesh m = make_mesh("slivers", 1000);
  trbvh_options o = preset_options(2);
  trbvh_stats stats;
  char why[128] = "";
  uint32_t lines = 0, i;
  const char *const *source = trbvh_cl_source(&lines);
#ifdef __linux__
  stub.no_platforms = 1;
  check_no_device("no platforms");
  stub.no_platforms = 0;
  stub.no_devices = 1;
  check_no_device("platforms without devices");
  stub.no_devices = 0;
#endif
  if (trbvh_cl_devices(NULL, 0) == 0) check_no_device("as it is");
  CONTEXT("scalar C");
  o.stats = &stats;
  CHECK(trbvh_build(&m.tree, &m.g, &o) == TRBVH_OK && !stats.on_device && !stats.message[0]);
  CHECK_MSG(trbvh_validate(&m.tree, &m.g, why, sizeof why) == TRBVH_OK, "%s", why);
  CONTEXT("source");
  CHECK(source && lines > 100);
  for (i = 0; i < lines; ++i) CHECK_MSG(source[i] && strlen(source[i]) < 4096, "line %u", i);
  mesh_free(&m);
}

#ifdef __linux__
static void test_nothing_is_left(void)
{
  check_nothing_alive();
  CHECK_MSG(!stub.misused, "misuse, %u times, first %s", stub.misused, stub.misuse);
}
#endif

int main(int argc, char **argv)
{
  trbvh_stats stats;
  int found;
  test_start(argc, argv);
  memset(&stats, 0, sizeof stats);
  device = trbvh_cl_open(NULL, &stats);
  found = device != NULL;
#ifdef __linux__
  if (found && !stub.calls) { printf("the stand-in for OpenCL is not used: link with -rdynamic\n"); return 1; }
  if (!found && count_devices()) { printf("there is a device, but it is not opened: %s\n", stats.message); return 1; }
#endif
  if (!found) printf("left out: all that needs an OpenCL device (%s)\n", stats.message);
  RUN(test_without_a_device);
  if (found) {
    RUN(test_every_scene);
    RUN(test_every_size);
    RUN(test_options);
  }
  if (found && !WIDE_KEYS) {
    RUN(test_every_form_of_input);
    RUN(test_building_again);
    RUN(test_bad_input);
    RUN(test_a_small_mesh_stays_on_the_host);
    RUN(test_cancel_at_every_tick);
    RUN(test_host_memory_runs_out);
    RUN(test_rays);
    RUN(test_rays_at_the_limits);
  }
  trbvh_cl_close(device);
  device = NULL;
#ifdef __linux__
  RUN(test_nothing_is_left);
  if (found && !WIDE_KEYS) {
    RUN(test_trees_on_the_device);
    RUN(test_refit);
    RUN(test_optimize);
    RUN(test_rays_on_the_device);
    RUN(test_arguments_on_the_device);
    RUN(test_failing_calls_from_opening_on);
    RUN(test_failing_calls_of_builds);
    RUN(test_failing_calls_on_the_device);
    RUN(test_failing_calls_of_optimize);
    RUN(test_little_memory);
    if (TRB_CL_SHAPE == 0) {                       /* nothing of this depends on which kernels there are */
      RUN(test_user_kernel);
      RUN(test_kernels_that_do_not_compile);
      RUN(test_cache);
      RUN(test_devices);
      RUN(test_names);
      RUN(test_called_a_gpu);
    }
    RUN(test_nothing_is_left);
  }
#endif
  return test_finish();
}
