/* The same tree bit for bit on every machine, with every compiler, at every optimization level, with any number of
 * threads: hashes of nodes[] and prims[] against the table in golden.h.
 *
 * A mismatch means that the tree changed. Where that was meant, make the table anew and say so in the change:
 *     cc -std=c99 -O2 tests/test_golden.c -o test_golden -lm -pthread && ./test_golden --print > tests/golden.h
 * Where it was not: some float operation is now evaluated otherwise (order, contraction, excess precision). */
#ifndef TRBVH_THREADS
  #define TRBVH_THREADS
#endif
#define TRBVH_IMPLEMENTATION
#include "../trbvh.h"
#include "test.h"
#include "scenes.h"

typedef struct golden { const char *scene; uint32_t triangles; uint64_t input, trees[PRESET_COUNT]; } golden;
#include "golden.h"
#define GOLDEN_COUNT (sizeof golden_table / sizeof golden_table[0])
#define GOLDEN_COMMAND "cc -std=c99 -O2 tests/test_golden.c -o test_golden -lm -pthread && ./test_golden --print > tests/golden.h"

static const struct { const char *scene; uint32_t triangles; } cases[] = {
  {"random", 4000}, {"sphere", 4000}, {"rock", 4000}, {"room", 4000}, {"terrain", 4000}, {"slivers", 4000}, {"city", 4000}, {"huge_and_tiny", 4000},
  {"clusters", 4000}, {"grid", 4000}, {"deep_bushy", 4000}, {"nested", 960}, {"all_exponents", 3000}, {"denormal", 3000}, {"degenerate", 3000},
  {"signed_zeros", 2000}, {"not_finite", 4000}, {"n9", 9},
  {"random", 70000}, {"slivers", 20000}, {"terrain", 40000}, {"city", 17000}, {"duplicates", 20000}, {"deep_bushy", 40000}   /* several jobs */
};
#define CASE_COUNT (sizeof cases / sizeof cases[0])

static uint64_t hash_word(uint64_t hash, uint32_t word)          /* FNV-1a, bytes in the same order on every machine */
{
  int i;
  for (i = 0; i < 32; i += 8) hash = (hash ^ ((word >> i) & 255)) * 0x100000001B3u;
  return hash;
}
static uint64_t hash_floats(uint64_t hash, const float *f, size_t count)
{
  size_t i;
  for (i = 0; i < count; ++i) {
    uint32_t bits;
    memcpy(&bits, &f[i], 4);
    hash = hash_word(hash, bits);
  }
  return hash;
}
static uint64_t hash_tree(const trbvh *bvh)
{
  uint64_t hash = 0xCBF29CE484222325u;
  uint32_t i;
  for (i = 0; i < bvh->node_count; ++i) {
    const trbvh_node *n = &bvh->nodes[i];
    hash = hash_floats(hash, n->min, 3);
    hash = hash_word(hash, n->first);
    hash = hash_floats(hash, n->max, 3);
    hash = hash_word(hash, n->count);
  }
  for (i = 0; i < bvh->ref_count; ++i) hash = hash_word(hash, bvh->prims[i]);
  return hash;
}
static uint64_t hash_scene(const scene *s)
{
  uint64_t hash = hash_floats(0xCBF29CE484222325u, s->positions, 3 * (size_t)s->vertex_count);
  uint32_t i;
  for (i = 0; s->indices && i < 3 * s->count; ++i) hash = hash_word(hash, s->indices[i]);
  return hash;
}

static void golden_scene(scene *s, unsigned at)          /* of one size, quick or not */
{
  unsigned i;
  for (i = 0; strcmp(scene_defs[i].name, cases[at].scene); ++i) {}
  memset(s, 0, sizeof *s);
  scene_defs[i].make(s, cases[at].triangles);
  s->name = cases[at].scene;
}
static uint64_t build_and_hash(const scene *s, const trbvh_options *o)
{
  trbvh_geometry g = scene_geometry(s);
  trbvh bvh;
  trbvh_result result;
  uint64_t hash;
  memset(&bvh, 0, sizeof bvh);
  result = trbvh_build(&bvh, &g, o);
  CHECK_MSG(result == TRBVH_OK, "%s", trbvh_result_text(result));
  hash = hash_tree(&bvh);
  trbvh_free(&bvh);
  return hash;
}

/* What builds without jobs make of a case: the reference of every test here, built once. */
static uint64_t plain_hash(unsigned at, int preset, const scene *s)
{
  static struct { int known; uint64_t hash; } plain[CASE_COUNT][PRESET_COUNT];
  const trbvh_options o = preset_options(preset);
  if (!plain[at][preset].known) {
    plain[at][preset].hash = build_and_hash(s, &o);
    plain[at][preset].known = 1;
  }
  return plain[at][preset].hash;
}

static int print_table(void)
{
  unsigned i;
  int preset;
  printf("/* Made by a program, for test_golden.c, which says when and how to make it anew:\n *     %s\n",
      GOLDEN_COMMAND);
  printf(" * FNV-1a of the scene, and of nodes[] and prims[] of the tree that each preset makes. */\n");
  printf("static const golden golden_table[] = {\n");
  for (i = 0; i < CASE_COUNT; ++i) {
    scene s;
    golden_scene(&s, i);
    printf("  {\"%s\", %u, 0x%016llXu,\n    {", s.name, cases[i].triangles, (unsigned long long)hash_scene(&s));
    for (preset = 0; preset < PRESET_COUNT; ++preset) {
      trbvh_options o = preset_options(preset);
      printf("%s0x%016llXu", preset ? ", " : "", (unsigned long long)build_and_hash(&s, &o));
    }
    printf("}},\n");
    scene_free(&s);
  }
  printf("  {\"\", 0, 0, {0, 0, 0, 0}}\n};\n");
  return test_now.failures ? 1 : 0;
}

static const golden *find_golden(unsigned at)
{
  unsigned i;
  for (i = 0; i < GOLDEN_COUNT; ++i)
    if (!strcmp(golden_table[i].scene, cases[at].scene) && golden_table[i].triangles == cases[at].triangles)
      return &golden_table[i];
  return NULL;
}

static void test_golden_hashes(void)
{
  unsigned i, found = 0;
  int preset;
#ifdef __FAST_MATH__
  printf("left out: golden hashes, which -ffast-math does not keep\n");
  return;
#endif
  for (i = 0; i < CASE_COUNT; ++i) {
    scene s;
    const golden *want = find_golden(i);
    uint64_t input;
    golden_scene(&s, i);
    CONTEXT("make the table anew, if it was meant: %s", GOLDEN_COMMAND);
    CHECK_MSG(want != NULL, "scene %s of %u is not in golden.h", s.name, cases[i].triangles);
    if (want) {
      ++found;
      input = hash_scene(&s);
      CHECK_MSG(input == want->input, "scene %s of %u itself differs here: expected %016llX, got %016llX", s.name,
          cases[i].triangles, (unsigned long long)want->input, (unsigned long long)input);
      for (preset = 0; preset < PRESET_COUNT; ++preset) {
        uint64_t got = plain_hash(i, preset, &s);
        CHECK_MSG(got == want->trees[preset], "scene %s of %u, preset %s: expected %016llX, got %016llX", s.name,
            cases[i].triangles, preset_names[preset], (unsigned long long)want->trees[preset], (unsigned long long)got);
      }
    }
    scene_free(&s);
  }
  CONTEXT("golden.h");
  CHECK_MSG(found + 1 == GOLDEN_COUNT, "%u scenes of the table's %u", found, (unsigned)GOLDEN_COUNT - 1);
}

static void test_golden_built_twice(void)
{
  unsigned i;
  int preset;
  for (i = 0; i < CASE_COUNT; ++i) {
    scene s, again;
    trbvh_geometry g;
    trbvh bvh;
    golden_scene(&s, i);
    golden_scene(&again, i);
    CONTEXT("scene %s of %u", s.name, cases[i].triangles);
    CHECK_MSG(hash_scene(&s) == hash_scene(&again), "the scene itself differs");
    memset(&bvh, 0, sizeof bvh);
    g = scene_geometry(&again);
    for (preset = 0; preset < PRESET_COUNT; ++preset) {
      trbvh_options o = preset_options(preset);
      uint64_t first = plain_hash(i, preset, &s);
      CHECK_MSG(first == build_and_hash(&again, &o), "preset %s", preset_names[preset]);
      CHECK(trbvh_build(&bvh, &g, &o) == TRBVH_OK);                 /* over what the last preset left */
      CHECK_MSG(first == hash_tree(&bvh), "preset %s, built over another tree", preset_names[preset]);
    }
    trbvh_free(&bvh);
    scene_free(&s);
    scene_free(&again);
  }
}

static void reversed_for(void *user, uint32_t count, trbvh_job *job, void *context)
{
  (void)user;
  while (count) job(context, --count);
}

static void test_golden_threads(void)
{
  static const uint32_t widths[] = {1, 2, 3, 8, 16};
  unsigned i, w;
  int preset, own;
  for (i = 0; i < CASE_COUNT; ++i) {
    scene s;
    golden_scene(&s, i);
    for (preset = 0; preset < PRESET_COUNT; ++preset) {
      trbvh_options o = preset_options(preset);
      uint64_t want = plain_hash(i, preset, &s);
      for (own = 0; own < 2; ++own)
        for (w = 0; w < sizeof widths / sizeof widths[0]; ++w) {
          uint64_t got;
          if (cases[i].triangles > QUICK_OR(10000, 100000) && w != 2) continue;
          if (QUICK_OR((i + (unsigned)preset + (unsigned)own + w) % 2, 0)) continue;   /* the next scene or preset has it */
          o.jobs.parallel_for = own ? NULL : reversed_for;
          o.jobs.width = widths[w];
          got = build_and_hash(&s, &o);
          CONTEXT("scene %s of %u, preset %s, width %u, %s", s.name, cases[i].triangles, preset_names[preset],
              widths[w], own ? "threads of the library" : "parallel_for");
          CHECK_MSG(got == want, "expected %016llX, got %016llX", (unsigned long long)want, (unsigned long long)got);
        }
    }
    scene_free(&s);
  }
}

int main(int argc, char **argv)
{
  test_start(argc, argv);
  if (argc > 1 && !strcmp(argv[1], "--print")) return print_table();
  RUN(test_golden_hashes);
  RUN(test_golden_built_twice);
  RUN(test_golden_threads);
  return test_finish();
}
