/* Bad input, one kind at a time: the right error, a message, an empty tree, no leak; never a crash. */
#define TRBVH_IMPLEMENTATION
#include "../trbvh.h"
#include "test.h"
#include "scenes.h"

typedef struct input { trbvh_geometry g; trbvh_options o; trbvh_stats stats; counter memory; scene s; uint32_t *indices; float *boxes; } input;

/* A mesh of 100 indexed triangles on 300 vertices, fine as it is. */
static void input_make(input *in)
{
  uint32_t i;
  memset(in, 0, sizeof *in);
  make_random(&in->s, 100);
  in->indices = (uint32_t *)xmalloc(300 * sizeof(uint32_t));
  in->boxes = (float *)xmalloc(600 * sizeof(float));
  in->g = scene_geometry(&in->s);
  for (i = 0; i < 300; ++i) in->indices[i] = 299 - i;
  for (i = 0; i < 100; ++i) geometry_box(&in->g, i, in->boxes + 6 * i);
  in->g.indices = in->indices;
  in->o.allocator = counter_allocator(&in->memory);
  in->o.stats = &in->stats;
}
static void input_free(input *in) { scene_free(&in->s); free(in->indices); free(in->boxes); }

static int tree_is_empty(const trbvh *b)
{
  return !b->nodes && !b->prims && !b->triangles && !b->wide && !b->node_count && !b->ref_count && !b->prim_count
      && !b->block && !b->block_size;
}

/* The build must fail with this result, on a zeroed tree and on a built one; word: part of the message, or NULL. */
static void expect(input *in, trbvh_result want, const char *word)
{
  int rebuilt;
  for (rebuilt = 0; rebuilt < 2; ++rebuilt) {
    trbvh bvh;
    trbvh_result got;
    memset(&bvh, 0, sizeof bvh);
    if (rebuilt) {
      scene s;
      trbvh_geometry good;
      trbvh_options o = preset_options(1);
      memset(&s, 0, sizeof s);
      make_random(&s, 50);
      good = scene_geometry(&s);
      o.allocator = counter_allocator(&in->memory);
      CHECK(trbvh_build(&bvh, &good, &o) == TRBVH_OK);
      scene_free(&s);
    }
    memset(&in->stats, 0x33, sizeof in->stats);
    got = trbvh_build(&bvh, &in->g, &in->o);
    CHECK_MSG(got == want, "%s tree: got %d (%s), want %d", rebuilt ? "built" : "zeroed", (int)got,
        trbvh_result_text(got), (int)want);
    if (in->o.stats && got) {
      CHECK_MSG(memchr(in->stats.message, 0, sizeof in->stats.message) && in->stats.message[0]
          && in->stats.message[0] != 0x33, "no message");
      if (word && memchr(in->stats.message, 0, sizeof in->stats.message))
        CHECK_MSG(strstr(in->stats.message, word) != NULL, "the message \"%s\" does not say \"%s\"",
            in->stats.message, word);
      CHECK(in->stats.node_count == 0 && in->stats.leaf_count == 0 && in->stats.ref_count == 0
          && in->stats.on_device == 0);
    }
    if (got) {
      CHECK(tree_is_empty(&bvh));
      CHECK_MSG(in->memory.live == 0, "%u blocks leaked", in->memory.live);
    }
    trbvh_free(&bvh);
    CHECK_MSG(in->memory.live == 0 && in->memory.bad_frees == 0, "%u blocks live, %u bad frees", in->memory.live,
        in->memory.bad_frees);
  }
}

static void test_good_input_is_good(void)       /* or else nothing below means anything */
{
  input in;
  trbvh bvh;
  memset(&bvh, 0, sizeof bvh);
  input_make(&in);
  CHECK(trbvh_build(&bvh, &in.g, &in.o) == TRBVH_OK);
  trbvh_free(&bvh);
  in.g.indices = NULL; in.g.positions = NULL; in.g.position_count = 0; in.g.boxes = in.boxes;
  CHECK(trbvh_build(&bvh, &in.g, &in.o) == TRBVH_OK);
  trbvh_free(&bvh);
  CHECK(in.memory.live == 0);
  input_free(&in);
}

static void test_missing_arguments(void)
{
  input in;
  trbvh bvh;
  input_make(&in);
  CONTEXT("no tree");
  CHECK(trbvh_build(NULL, &in.g, &in.o) == TRBVH_INVALID_ARGUMENT);
  CHECK(in.stats.message[0] != 0);
  CHECK(trbvh_build(NULL, NULL, NULL) == TRBVH_INVALID_ARGUMENT);
  CONTEXT("no geometry");
  memset(&bvh, 0, sizeof bvh);
  CHECK(trbvh_build(&bvh, NULL, &in.o) == TRBVH_INVALID_ARGUMENT && in.stats.message[0] && tree_is_empty(&bvh));
  CHECK(trbvh_build(&bvh, NULL, NULL) == TRBVH_INVALID_ARGUMENT);
  CONTEXT("no positions");
  in.g.positions = NULL;
  expect(&in, TRBVH_INVALID_ARGUMENT, "position");
  CONTEXT("no positions, no indices");
  in.g.indices = NULL;
  expect(&in, TRBVH_INVALID_ARGUMENT, "position");
  CONTEXT("both");
  in.g.positions = in.s.positions;
  in.g.boxes = in.boxes;
  expect(&in, TRBVH_INVALID_ARGUMENT, "boxes");
  CONTEXT("boxes and indices");
  in.g.positions = NULL;
  in.g.indices = in.indices;
  expect(&in, TRBVH_INVALID_ARGUMENT, "boxes");
  input_free(&in);
}

static void test_counts_and_strides(void)
{
  static const size_t short_strides[] = {1, 2, 3, 4, 8, 11};
  static const size_t short_box_strides[] = {1, 12, 20, 23};
  static const uint32_t sizes[] = {1, 3, 5, 8, 255, 0xFFFFFFFFu};
  unsigned i;
  input in;
  input_make(&in);
  CONTEXT("indices without position_count");
  in.g.position_count = 0;
  expect(&in, TRBVH_INVALID_ARGUMENT, "position_count");
  CONTEXT("soup with too few vertices");
  in.g.indices = NULL;
  in.g.position_count = 299;
  expect(&in, TRBVH_INVALID_ARGUMENT, "299");
  in.g.position_count = 1;
  expect(&in, TRBVH_INVALID_ARGUMENT, "position");
  in.g.position_count = 300;
  expect(&in, TRBVH_OK, NULL);
  for (i = 0; i < sizeof short_strides / sizeof short_strides[0]; ++i) {
    CONTEXT("position_stride %u", (unsigned)short_strides[i]);
    in.g.position_stride = short_strides[i];
    expect(&in, TRBVH_INVALID_ARGUMENT, "stride");
  }
  in.g.position_stride = 12;
  in.g.indices = in.indices;
  for (i = 0; i < sizeof sizes / sizeof sizes[0]; ++i) {
    CONTEXT("index_size %u", sizes[i]);
    in.g.index_size = sizes[i];
    expect(&in, TRBVH_INVALID_ARGUMENT, "index_size");
  }
  memset(&in.g, 0, sizeof in.g);
  in.g.boxes = in.boxes;
  in.g.count = 100;
  for (i = 0; i < sizeof short_box_strides / sizeof short_box_strides[0]; ++i) {
    CONTEXT("box_stride %u", (unsigned)short_box_strides[i]);
    in.g.box_stride = short_box_strides[i];
    expect(&in, TRBVH_INVALID_ARGUMENT, "stride");
  }
  input_free(&in);
}

static void test_too_many(void)                  /* refused before anything is read */
{
  static const uint32_t counts[] = {0xFFFFFFFFu, 0x80000000u, 0x60000000u};
  unsigned i, preset;
  input in;
  input_make(&in);
  in.g.indices = NULL;
  in.memory.fail_at = ~0u;                       /* where it is not too large there is no memory, either */
  for (i = 0; i < sizeof counts / sizeof counts[0]; ++i)
    for (preset = 0; preset < PRESET_COUNT; ++preset) {
      trbvh bvh;
      trbvh_result got;
      size_t scratch = 1, bound;
      memset(&bvh, 0, sizeof bvh);
      CONTEXT("%u triangles, preset %s", counts[i], preset_names[preset]);
      in.o.quality = preset_options((int)preset).quality;
      in.g.count = counts[i];
      in.g.position_count = 0;
      bound = trbvh_bytes_bound(&in.g, &in.o, &scratch);
      got = trbvh_build(&bvh, &in.g, &in.o);
      CHECK_MSG(got == (bound ? TRBVH_OUT_OF_MEMORY : TRBVH_TOO_LARGE), "%s, bound %zu", trbvh_result_text(got), bound);
      CHECK(!bound == !scratch);
      CHECK(in.stats.message[0] && tree_is_empty(&bvh));
    }
  CONTEXT("3 * count does not fit 32 bits");
  in.g.count = 0xFFFFFFFFu;
  CHECK(trbvh_bytes_bound(&in.g, &in.o, NULL) == 0);
  CONTEXT("100 triangles, a budget of 1600 %%");
  in.memory.fail_at = 0;
  in.g.count = 100;
  in.o.quality = TRBVH_QUALITY_HIGH;
  in.o.split_budget = 16;
  expect(&in, TRBVH_OK, NULL);
  input_free(&in);
}

static void test_index_out_of_range(void)
{
  static const uint32_t at[] = {0, 1, 22, 149, 298, 299};
  static const uint32_t bad[] = {300, 301, 65535, 0x7FFFFFFFu, 0x80000000u, 0xFFFFFFFFu};
  unsigned i, j;
  int preset;
  input in;
  input_make(&in);
  for (preset = 0; preset < PRESET_COUNT; ++preset)
    for (i = 0; i < sizeof at / sizeof at[0]; ++i)
      for (j = 0; j < sizeof bad / sizeof bad[0]; ++j) {
        uint32_t saved = in.indices[at[i]];
        char number[32];
        CONTEXT("index %u is %u, preset %s", at[i], bad[j], preset_names[preset]);
        in.o.quality = preset_options(preset).quality;
        in.indices[at[i]] = bad[j];
        snprintf(number, sizeof number, "%u", bad[j]);
        expect(&in, TRBVH_BAD_GEOMETRY, number);
        snprintf(number, sizeof number, "triangle %u ", at[i] / 3);
        expect(&in, TRBVH_BAD_GEOMETRY, number);
        expect(&in, TRBVH_BAD_GEOMETRY, "300");
        in.indices[at[i]] = saved;
      }
  { /* 16 bits; and the first of several is named */
    uint16_t small[300];
    for (i = 0; i < 300; ++i) small[i] = (uint16_t)i;
    in.g.indices = small;
    in.g.index_size = 2;
    CONTEXT("16-bit index");
    expect(&in, TRBVH_OK, NULL);
    small[200] = 300;
    expect(&in, TRBVH_BAD_GEOMETRY, "triangle 66 ");
    small[100] = 65535;
    small[280] = 400;
    expect(&in, TRBVH_BAD_GEOMETRY, "triangle 33 ");
    expect(&in, TRBVH_BAD_GEOMETRY, "65535");
  }
  input_free(&in);
}

static void test_bad_options(void)
{
  unsigned i;
  static const int qualities[] = {-1, 5, 6, 1000, 2147483647};
  static const uint32_t flags[] = {4, 8, 0x80000000u, 0xFFFFFFFFu};
  trbvh_result want;
  input in;
  input_make(&in);
  for (i = 0; i < sizeof qualities / sizeof qualities[0]; ++i) {
    CONTEXT("quality %d", qualities[i]);
    memcpy(&in.o.quality, &qualities[i], sizeof in.o.quality);       /* no cast to an enumeration it does not fit */
    expect(&in, TRBVH_INVALID_ARGUMENT, "quality");
  }
  in.o.quality = TRBVH_QUALITY_DEFAULT;
  for (i = 0; i < sizeof flags / sizeof flags[0]; ++i) {
    CONTEXT("flags %u", flags[i]);
    in.o.flags = flags[i];
    expect(&in, TRBVH_INVALID_ARGUMENT, "flag");
  }
  in.o.flags = 0;
  for (i = 0; i < 5; ++i) {
    float bad = bad_float(i);
    CONTEXT("%g as an option", (double)bad);
    want = i == 2 ? TRBVH_OK : TRBVH_INVALID_ARGUMENT;              /* minus infinity is negative: none */
    in.o.split_budget = bad;
    expect(&in, want, "split_budget");
    in.o.split_budget = 0;
    in.o.cost_node = bad;
    expect(&in, want, "cost_node");
    in.o.cost_node = 0;
    in.o.cost_prim = bad;
    expect(&in, want, "cost_prim");
    in.o.cost_prim = 0;
  }
  CONTEXT("split_budget above 16");
  in.o.split_budget = 16.5f;
  expect(&in, TRBVH_INVALID_ARGUMENT, "split_budget");
  in.o.split_budget = 0;
  CONTEXT("negative = none");
  in.o.split_budget = -2; in.o.treelet_rounds = -7; in.o.cost_node = -1; in.o.cost_prim = -3; in.o.quality = TRBVH_QUALITY_HIGH;
  expect(&in, TRBVH_OK, NULL);
  input_free(&in);

  input_make(&in);
  CONTEXT("alloc without free");
  in.o.allocator.free = NULL;
  expect(&in, TRBVH_INVALID_ARGUMENT, "allocator");
  CONTEXT("free without alloc");
  in.o.allocator.alloc = NULL;
  in.o.allocator.free = counter_free;
  expect(&in, TRBVH_INVALID_ARGUMENT, "allocator");
  input_free(&in);
}

/* The same bad arguments again: 0 bytes, and the scratch size written. */
static void test_bytes_bound_of_bad_input(void)
{
  int kind;
  for (kind = 0; kind < 10; ++kind) {
    input in;
    size_t scratch = 77, bound;
    input_make(&in);
    switch (kind) {
      case 0: break;
      case 1: in.g.positions = NULL; break;
      case 2: in.g.boxes = in.boxes; break;
      case 3: in.g.position_count = 0; break;
      case 4: in.g.index_size = 3; break;
      case 5: in.g.position_stride = 11; break;
      case 6: in.o.split_budget = bad_float(0); break;
      case 7: in.o.flags = 64; break;
      case 8: in.o.cost_node = bad_float(1); break;
      default: in.o.allocator.free = NULL; break;
    }
    CONTEXT("kind %d", kind);
    bound = trbvh_bytes_bound(&in.g, &in.o, &scratch);
    if (kind == 0) CHECK_MSG(bound > 0 && scratch > 0, "%zu, %zu", bound, scratch);
    else CHECK_MSG(bound == 0 && scratch == 0, "%zu, %zu", bound, scratch);
    CHECK(trbvh_bytes_bound(&in.g, &in.o, NULL) == bound);
    input_free(&in);
  }
}

static void test_not_finite_in_each_coordinate(void)
{
  unsigned at, kind;
  int preset;
  for (preset = 0; preset < PRESET_COUNT; ++preset)
    for (at = 0; at < 9; ++at)
      for (kind = 0; kind < 5; ++kind) {
        input in;
        trbvh bvh;
        walk_info info;
        char why[128] = "";
        float bad = bad_float(kind);
        memset(&bvh, 0, sizeof bvh);
        input_make(&in);
        in.g.indices = NULL;
        in.o.quality = preset_options(preset).quality;
        memcpy(in.s.positions + 9 * 40 + at, &bad, sizeof bad);
        CONTEXT("coordinate %u is %g, preset %s", at, (double)bad, preset_names[preset]);
        CHECK(trbvh_build(&bvh, &in.g, &in.o) == TRBVH_OK);
        CHECK(in.stats.skipped_count == 1);
        CHECK_MSG(walk_tree(&bvh, &in.g, 8, preset >= 2, &info, why, sizeof why) && info.skipped == 1, "%s", why);
        CHECK_MSG(trbvh_validate(&bvh, &in.g, why, sizeof why) == TRBVH_OK, "%s", why);
        trbvh_free(&bvh);
        CHECK(in.memory.live == 0);
        input_free(&in);
      }
}

static void test_not_finite_boxes(void)
{
  unsigned at, kind;
  for (at = 0; at < 6; ++at)
    for (kind = 0; kind < 6; ++kind) {
      input in;
      trbvh bvh;
      walk_info info;
      char why[128] = "";
      float bad = kind < 5 ? bad_float(kind) : at < 3 ? 10.0f : -10.0f;      /* the last: min > max */
      memset(&bvh, 0, sizeof bvh);
      input_make(&in);
      memset(&in.g, 0, sizeof in.g);
      in.g.boxes = in.boxes;
      in.g.count = 100;
      memcpy(in.boxes + 6 * 99 + at, &bad, sizeof bad);
      CONTEXT("coordinate %u is %g", at, (double)bad);
      CHECK(trbvh_build(&bvh, &in.g, &in.o) == TRBVH_OK);
      CHECK(in.stats.skipped_count == 1);
      CHECK_MSG(walk_tree(&bvh, &in.g, 8, 0, &info, why, sizeof why) && info.skipped == 1, "%s", why);
      trbvh_free(&bvh);
      CHECK(in.memory.live == 0);
      input_free(&in);
    }
}

/* A vertex that no triangle uses may be anything. */
static void test_unused_vertices_do_not_matter(void)
{
  input in;
  trbvh a, b;
  float bad = bad_float(1);
  memset(&a, 0, sizeof a);
  memset(&b, 0, sizeof b);
  input_make(&in);
  in.g.count = 90;                                   /* of vertices 30 .. 299 */
  CHECK(trbvh_build(&a, &in.g, &in.o) == TRBVH_OK);
  memcpy(in.s.positions, &bad, sizeof bad);
  in.s.positions[4] = 1e30f;
  CHECK(trbvh_build(&b, &in.g, &in.o) == TRBVH_OK);
  CHECK(same_tree(&a, &b));
  trbvh_free(&a);
  trbvh_free(&b);
  input_free(&in);
}

static void test_result_texts(void)
{
  static const int odd[] = {-1, -2147483647 - 1, TRBVH_RESULT_COUNT, TRBVH_RESULT_COUNT + 1, 1000000, 2147483647};
  int i, j;
  for (i = 0; i < TRBVH_RESULT_COUNT; ++i) {
    const char *text = trbvh_result_text((trbvh_result)i);
    CHECK_MSG(text && text[0], "result %d", i);
    for (j = 0; text && j < i; ++j)
      CHECK_MSG(strcmp(text, trbvh_result_text((trbvh_result)j)), "results %d and %d: %s", i, j, text);
  }
  for (i = 0; i < (int)(sizeof odd / sizeof odd[0]); ++i) {
    trbvh_result r;
    memcpy(&r, &odd[i], sizeof r);
    CHECK_MSG(trbvh_result_text(r) && trbvh_result_text(r)[0], "result %d", odd[i]);
  }
  CHECK(TRBVH_OK == 0 && strcmp(trbvh_result_text(TRBVH_OK), "success") == 0);
}

/* A backend that always fails, in the way that is asked for. */
static trbvh_result device_fails;
static trbvh_result fail_to_build(trbvh_device *device, trb_build *b, trbvh *bvh)
{
  (void)device;
  (void)bvh;
  b->stats.max_depth = 99;                     /* nothing of this may be left */
  return trb_fail(b, device_fails, "the device is gone", 0, 0, 0);
}
static trbvh_result fail_to_trace(trbvh_device *device, trb_build *b, const trb_batch *batch)
{
  (void)device;
  (void)batch;
  return trb_fail(b, device_fails, "the device is gone", 0, 0, 0);
}

/* C does the work of a device that fails, and the message says why; where there may be no fallback, and for errors that
 * are not the device's, it is an error. */
static void test_device_that_fails(void)
{
  static const trbvh_result results[] = {TRBVH_NO_DEVICE, TRBVH_DEVICE_ERROR, TRBVH_OUT_OF_DEVICE_MEMORY, TRBVH_CANCELLED,
      TRBVH_OUT_OF_MEMORY, TRBVH_BAD_GEOMETRY};
  const trbvh_ray ray = {{0, 0, -5}, 0, {0, 0, 1}, 0};
  trbvh_hit hit;
  input in;
  trbvh_device device;
  trbvh bvh;
  unsigned i, strict;
  memset(&bvh, 0, sizeof bvh);
  input_make(&in);
  device.build = fail_to_build;
  device.trace = fail_to_trace;
  in.o.device = &device;
  for (i = 0; i < sizeof results / sizeof results[0]; ++i)
    for (strict = 0; strict < 2; ++strict) {
      const int falls_back = i < 3 && !strict;
      trbvh_result result;
      CONTEXT("%s, strict %u", trbvh_result_text(results[i]), strict);
      device_fails = results[i];
      in.o.flags = strict ? TRBVH_NO_FALLBACK : 0;
      result = trbvh_build(&bvh, &in.g, &in.o);
      CHECK(result == (falls_back ? TRBVH_OK : results[i]) && tree_is_empty(&bvh) == !falls_back);
      CHECK(in.stats.on_device == 0 && (in.stats.max_depth != 99 || !falls_back));
      CHECK(!strcmp(in.stats.message, "the device is gone"));
      CHECK(falls_back || in.memory.live == 0);
      if (!falls_back) continue;
      result = trbvh_intersect_n(&bvh, &ray, &hit, 1, &in.o);
      CHECK(result == TRBVH_OK && in.stats.on_device == 0 && !strcmp(in.stats.message, "the device is gone"));
      in.o.flags = TRBVH_NO_FALLBACK;
      CHECK(trbvh_intersect_n(&bvh, &ray, &hit, 1, &in.o) == results[i]);
    }
  trbvh_free(&bvh);
  input_free(&in);
}

static void test_query_arguments(void)
{
  input in;
  trbvh bvh;
  trbvh_ray ray = {{0, 0, -5}, 0, {0, 0, 1}, 0};
  trbvh_hit hit;
  uint8_t occluded;
  memset(&bvh, 0, sizeof bvh);
  input_make(&in);
  CHECK(trbvh_build(&bvh, &in.g, &in.o) == TRBVH_OK);
  CHECK(trbvh_intersect_n(NULL, &ray, &hit, 1, NULL) == TRBVH_INVALID_ARGUMENT);
  CHECK(trbvh_intersect_n(&bvh, NULL, &hit, 1, NULL) == TRBVH_INVALID_ARGUMENT);
  CHECK(trbvh_intersect_n(&bvh, &ray, NULL, 1, NULL) == TRBVH_INVALID_ARGUMENT);
  CHECK(trbvh_occluded_n(NULL, &ray, &occluded, 1, NULL) == TRBVH_INVALID_ARGUMENT);
  CHECK(trbvh_occluded_n(&bvh, NULL, &occluded, 1, NULL) == TRBVH_INVALID_ARGUMENT);
  CHECK(trbvh_occluded_n(&bvh, &ray, NULL, 1, NULL) == TRBVH_INVALID_ARGUMENT);
  CHECK(trbvh_intersect_n(&bvh, NULL, NULL, 0, NULL) == TRBVH_OK);
  CHECK(trbvh_occluded_n(&bvh, NULL, NULL, 0, NULL) == TRBVH_OK);
  trbvh_free(&bvh);
  input_free(&in);
}

int main(int argc, char **argv)
{
  test_start(argc, argv);
  RUN(test_good_input_is_good);
  RUN(test_missing_arguments);
  RUN(test_counts_and_strides);
  RUN(test_too_many);
  RUN(test_index_out_of_range);
  RUN(test_bad_options);
  RUN(test_bytes_bound_of_bad_input);
  RUN(test_not_finite_in_each_coordinate);
  RUN(test_not_finite_boxes);
  RUN(test_unused_vertices_do_not_matter);
  RUN(test_result_texts);
  RUN(test_device_that_fails);
  RUN(test_query_arguments);
  return test_finish();
}
