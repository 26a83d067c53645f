/* Allocator, progress and job hooks: memory that runs out at every possible moment, a cancel at every tick, and job
 * systems that run the jobs in any order and on any thread; the tree and the hits must not show it. */
#ifndef TRBVH_THREADS
  #define TRBVH_THREADS
#endif
#ifndef TRB_PACKED_REFS
  #define TRB_PACKED_REFS 5000u     /* both kinds of sort keys, at sizes that a test can afford */
#endif
#define TRBVH_IMPLEMENTATION
#include "../trbvh.h"
#include "test.h"
#include "scenes.h"
#ifndef _WIN32
  #include <pthread.h>
#endif

static const char *const hook_scenes[] = {"random", "sphere", "slivers", "not_finite", "deep", "n0", "n1", "n9",
    "large_random", "large_slivers", "large_bushy", "large_holes"};
#define HOOK_SCENES 8u                                               /* small */
#define HOOK_LARGE  (sizeof hook_scenes / sizeof hook_scenes[0])     /* with those of several jobs */

static void hook_scene(scene *s, unsigned at, uint32_t n)
{
  unsigned i;
  for (i = 0; strcmp(scene_defs[i].name, hook_scenes[at]); ++i) {}
  memset(s, 0, sizeof *s);
  s->name = hook_scenes[at];
  scene_defs[i].make(s, n < scene_defs[i].full ? n : scene_defs[i].full);
}
static int tree_is_empty(const trbvh *b)
{
  return !b->nodes && !b->prims && !b->triangles && !b->node_count && !b->ref_count && !b->prim_count && !b->block
      && !b->block_size;
}

// >>memory ----------------------------------------------------------------------------------------------------------
static void test_every_allocation_may_fail(void)
{
  unsigned at, rebuilt;
  int preset, width;
  for (at = 0; at < HOOK_SCENES; ++at)
    for (preset = 0; preset < PRESET_COUNT; ++preset)
      for (rebuilt = 0; rebuilt < 3; ++rebuilt)        /* 0: into {0}; 1: over a tree too small; 2: over one that fits */
        for (width = 0; width <= 4; width += 4) {
          scene s;
          trbvh_geometry g;
          unsigned n = 0;
          trbvh_result result;
          hook_scene(&s, at, 3000);
          g = scene_geometry(&s);
          do {
            trbvh_options o = preset_options(preset);
            counter c;
            trbvh bvh;
            trbvh_stats stats;
            memset(&bvh, 0, sizeof bvh);
            memset(&c, 0, sizeof c);
            memset(&stats, 0x55, sizeof stats);
            o.allocator = counter_allocator(&c);
            CONTEXT("scene %s, preset %s, rebuilt %u, width %d, allocation %u fails", s.name, preset_names[preset],
                rebuilt, width, n + 1);
            if (rebuilt) {
              trbvh_geometry before = g;
              if (rebuilt == 1 && before.count > 5) before.count = 5;
              CHECK(trbvh_build(&bvh, &before, &o) == TRBVH_OK);
            }
            o.stats = &stats;
            o.jobs.width = (uint32_t)width;
            c.calls = 0;
            c.fail_at = ++n;
            result = trbvh_build(&bvh, &g, &o);
            if (result == TRBVH_OK) {
              walk_info info;
              char why[128] = "";
              CHECK_MSG(c.calls < n, "the build went on without the memory");
              CHECK_MSG(c.calls <= 2, "%u allocations", c.calls);
              CHECK_MSG(rebuilt < 2 || c.calls <= 1, "%u allocations where the block could be reused", c.calls);
              CHECK_MSG(walk_tree(&bvh, &g, 8, preset >= 2, &info, why, sizeof why), "%s", why);
              trbvh_free(&bvh);
            } else {
              CHECK_MSG(result == TRBVH_OUT_OF_MEMORY, "%s", trbvh_result_text(result));
              CHECK(stats.message[0] && stats.message[0] != 0x55 && memchr(stats.message, 0, sizeof stats.message));
              CHECK(tree_is_empty(&bvh));
            }
            CHECK_MSG(c.live == 0 && c.bad_frees == 0, "%u blocks live, %u bad frees", c.live, c.bad_frees);
            trbvh_free(&bvh);
          } while (result && n < 10);
          CHECK_MSG(result == TRBVH_OK, "never succeeds");
          scene_free(&s);
        }
}

static void test_builds_in_a_row_are_balanced(void)
{
  int preset, i;
  for (preset = 0; preset < PRESET_COUNT; ++preset) {
    trbvh_options o = preset_options(preset);
    counter c;
    trbvh bvh;
    memset(&bvh, 0, sizeof bvh);
    memset(&c, 0, sizeof c);
    o.allocator = counter_allocator(&c);
    CONTEXT("preset %s", preset_names[preset]);
    for (i = 0; i < 6; ++i) {
      scene s;
      trbvh_geometry g;
      hook_scene(&s, 0, 200u + 300u * (uint32_t)(i % 3));
      g = scene_geometry(&s);
      CHECK(trbvh_build(&bvh, &g, &o) == TRBVH_OK);
      CHECK_MSG(c.live == 1 && c.live_bytes == bvh.block_size && c.bad_frees == 0, "%u live, %zu bytes, block_size %zu",
          c.live, c.live_bytes, bvh.block_size);
      CHECK(bvh.allocator.alloc == counter_alloc && bvh.allocator.user == &c);
      scene_free(&s);
    }
    trbvh_free(&bvh);
    CHECK(c.live == 0 && c.bad_frees == 0);
  }
}

// >>progress --------------------------------------------------------------------------------------------------------
typedef struct ticks {
  unsigned count, cancel_at, backwards, outside, foreign, after_cancel;
  float    last;
#ifndef _WIN32
  pthread_t thread;
#endif
} ticks;

static void ticks_start(ticks *t, unsigned cancel_at)
{
  memset(t, 0, sizeof *t);
  t->cancel_at = cancel_at;
#ifndef _WIN32
  t->thread = pthread_self();
#endif
}
static int on_tick(void *user, float done)
{
  ticks *t = (ticks *)user;
  if (t->cancel_at && t->count >= t->cancel_at) ++t->after_cancel;
  if (!(done >= 0 && done <= 1)) ++t->outside;
  if (t->count && !(done >= t->last)) ++t->backwards;
#ifndef _WIN32
  if (!pthread_equal(t->thread, pthread_self())) ++t->foreign;
#endif
  t->last = done;
  return ++t->count == t->cancel_at ? (t->count & 1 ? 1 : -5) : 0;
}

static void test_cancel_at_every_tick(void)
{
  unsigned at, rebuilt;
  int preset, width;
  for (at = 0; at < HOOK_SCENES; ++at)
    for (preset = 0; preset < PRESET_COUNT; ++preset)
      for (width = 0; width <= 4; width += 4) {
        scene s;
        trbvh_geometry g;
        trbvh_options o = preset_options(preset);
        trbvh whole;
        ticks all;
        unsigned n, step;
        memset(&whole, 0, sizeof whole);
        hook_scene(&s, at, QUICK_OR(1000, 4000));
        g = scene_geometry(&s);
        CONTEXT("scene %s, preset %s, width %d", s.name, preset_names[preset], width);
        o.progress = on_tick;
        o.progress_user = &all;
        o.jobs.width = (uint32_t)width;
        ticks_start(&all, 0);
        CHECK(trbvh_build(&whole, &g, &o) == TRBVH_OK);
        CHECK_MSG(!all.backwards && !all.outside && !all.foreign,
            "%u ticks backwards, %u outside 0..1, %u on other threads", all.backwards, all.outside, all.foreign);
        if (s.count > 100) CHECK_MSG(all.count >= 3, "%u ticks", all.count);
        if (s.count > 100) CHECK_MSG(all.last > 0.5f, "the last tick says %g", (double)all.last);
        step = 1 + all.count / 60;
        for (n = 1; n <= all.count; n += step)
          for (rebuilt = 0; rebuilt < 2; ++rebuilt) {
            trbvh bvh;
            trbvh_stats stats;
            ticks t;
            counter c;
            trbvh_result result;
            memset(&bvh, 0, sizeof bvh);
            memset(&c, 0, sizeof c);
            memset(&stats, 0x55, sizeof stats);
            ticks_start(&t, rebuilt ? 0 : n);
            o.progress_user = &t;
            o.allocator = counter_allocator(&c);
            o.stats = &stats;
            CONTEXT("scene %s, preset %s, width %d, rebuilt %u, cancelled at tick %u of %u", s.name,
                preset_names[preset], width, rebuilt, n, all.count);
            if (rebuilt) {
              CHECK(trbvh_build(&bvh, &g, &o) == TRBVH_OK);
              CHECK_MSG(t.count == all.count, "%u ticks, %u the first time", t.count, all.count);
              ticks_start(&t, n);
            }
            result = trbvh_build(&bvh, &g, &o);
            CHECK_MSG(result == TRBVH_CANCELLED, "%s", trbvh_result_text(result));
            CHECK(tree_is_empty(&bvh));
            CHECK_MSG(t.count == n && !t.after_cancel, "%u ticks, %u after the cancel", t.count, t.after_cancel);
            CHECK(stats.message[0] && stats.message[0] != 0x55);
            CHECK_MSG(c.live == 0 && c.bad_frees == 0, "%u blocks live, %u bad frees", c.live, c.bad_frees);
            trbvh_free(&bvh);
          }
        memset(&o.allocator, 0, sizeof o.allocator);
        o.progress = NULL;
        o.stats = NULL;
        {
          trbvh bvh;
          memset(&bvh, 0, sizeof bvh);
          CHECK(trbvh_build(&bvh, &g, &o) == TRBVH_OK);
          CHECK_MSG(same_tree(&bvh, &whole), "a tree with progress differs from one without");
          trbvh_free(&bvh);
        }
        trbvh_free(&whole);
        scene_free(&s);
      }
}

// >>jobs ------------------------------------------------------------------------------------------------------------
typedef struct job_log { unsigned calls, nested; uint64_t jobs; uint32_t most, seed; int running; } job_log;

static void jobs_begin(job_log *log, uint32_t count)
{
  if (log->running) ++log->nested;
  log->running = 1;
  ++log->calls;
  log->jobs += count;
  if (count > log->most) log->most = count;
}
static void serial_for(void *user, uint32_t count, trbvh_job *job, void *context)
{
  uint32_t i;
  jobs_begin((job_log *)user, count);
  for (i = 0; i < count; ++i) job(context, i);
  ((job_log *)user)->running = 0;
}
static void reversed_for(void *user, uint32_t count, trbvh_job *job, void *context)
{
  jobs_begin((job_log *)user, count);
  while (count) job(context, --count);
  ((job_log *)user)->running = 0;
}
static void random_for(void *user, uint32_t count, trbvh_job *job, void *context)
{
  job_log *log = (job_log *)user;
  uint32_t *order = (uint32_t *)xmalloc(sizeof(uint32_t) * count), i;
  rng r = {++log->seed};
  jobs_begin(log, count);
  for (i = 0; i < count; ++i) {
    uint32_t j = rng_below(&r, i + 1);
    order[i] = order[j];
    order[j] = i;
  }
  for (i = 0; i < count; ++i) job(context, order[i]);
  free(order);
  log->running = 0;
}
#ifndef _WIN32
typedef struct pool { pthread_mutex_t lock; uint32_t next, count; trbvh_job *job; void *context; } pool;

static void *pool_work(void *argument)
{
  pool *p = (pool *)argument;
  for (;;) {
    uint32_t i;
    pthread_mutex_lock(&p->lock);
    i = p->next < p->count ? p->next++ : p->count;
    pthread_mutex_unlock(&p->lock);
    if (i == p->count) return NULL;
    p->job(p->context, i);
  }
}
static void pthread_for(void *user, uint32_t count, trbvh_job *job, void *context)
{
  pthread_t threads[3];
  pool p;
  int i, started = 0;
  jobs_begin((job_log *)user, count);
  memset(&p, 0, sizeof p);
  pthread_mutex_init(&p.lock, NULL);
  p.count = count;
  p.job = job;
  p.context = context;
  for (i = 0; i < 3; ++i) started += pthread_create(&threads[started], NULL, pool_work, &p) == 0;
  pool_work(&p);
  for (i = 0; i < started; ++i) pthread_join(threads[i], NULL);
  pthread_mutex_destroy(&p.lock);
  ((job_log *)user)->running = 0;
}
static void foreign_for(void *user, uint32_t count, trbvh_job *job, void *context)   /* never on the calling thread */
{
  pthread_t thread;
  pool p;
  jobs_begin((job_log *)user, count);
  memset(&p, 0, sizeof p);
  pthread_mutex_init(&p.lock, NULL);
  p.count = count;
  p.job = job;
  p.context = context;
  if (pthread_create(&thread, NULL, pool_work, &p) == 0) pthread_join(thread, NULL);
  else pool_work(&p);
  pthread_mutex_destroy(&p.lock);
  ((job_log *)user)->running = 0;
}
#endif

typedef void parallel_for(void *user, uint32_t count, trbvh_job *job, void *context);
static const struct { const char *name; parallel_for *run; } systems[] = {
  {"threads of the library", NULL}, {"serial", serial_for}, {"reversed", reversed_for}, {"random order", random_for},
#ifndef _WIN32
  {"pthreads", pthread_for}, {"another thread", foreign_for}
#endif
};
#define SYSTEM_COUNT (sizeof systems / sizeof systems[0])
static const uint32_t widths[] = {1, 2, 3, 4, 5, 7, 8, 13, 16, 64, 1000};

static void test_jobs_do_not_change_the_tree(void)
{
  unsigned at, system, w;
  int preset, used = 0;
  for (at = 0; at < HOOK_LARGE; ++at)
    for (preset = 0; preset < PRESET_COUNT - 1; ++preset) {
      scene s;
      trbvh_geometry g;
      trbvh_options o = preset_options(preset);
      trbvh want;
      trbvh_stats first;
      memset(&want, 0, sizeof want);
      hook_scene(&s, at, at < HOOK_SCENES ? QUICK_OR(2500, 6000) : QUICK_OR(36000, 80000));
      g = scene_geometry(&s);
      o.stats = &first;
      CHECK(trbvh_build(&want, &g, &o) == TRBVH_OK);
      for (system = 0; system < SYSTEM_COUNT; ++system)
        for (w = 0; w < sizeof widths / sizeof widths[0]; ++w) {
          trbvh bvh;
          job_log log;
          ticks t;
          counter c;
          trbvh_stats stats;
          size_t bound, scratch = 0;
          trbvh_result result;
          if (at >= HOOK_SCENES && w % 3 != 1) continue;
          if (QUICK_OR((at + (unsigned)preset + system + w) % 2, 0)) continue;   /* the next scene or preset has it */
          memset(&bvh, 0, sizeof bvh);
          memset(&log, 0, sizeof log);
          memset(&c, 0, sizeof c);
          ticks_start(&t, 0);
          o.jobs.parallel_for = systems[system].run;
          o.jobs.user = &log;
          o.jobs.width = widths[w];
          o.progress = on_tick;
          o.progress_user = &t;
          o.allocator = counter_allocator(&c);
          o.stats = &stats;
          CONTEXT("scene %s, preset %s, %s, width %u", s.name, preset_names[preset], systems[system].name, widths[w]);
          bound = trbvh_bytes_bound(&g, &o, &scratch);
          result = trbvh_build(&bvh, &g, &o);
          CHECK_MSG(result == TRBVH_OK, "%s", trbvh_result_text(result));
          CHECK_MSG(same_tree(&bvh, &want), "another tree than without jobs");
          CHECK_MSG(c.peak_bytes <= bound + scratch && c.allocs <= 2, "peak %zu, bounds %zu and %zu, %u allocations",
              c.peak_bytes, bound, scratch, c.allocs);
          CHECK_MSG(fabs(stats.sah_cost - first.sah_cost) <= 0 && stats.max_depth == first.max_depth
              && stats.leaf_count == first.leaf_count, "stats differ");
          CHECK_MSG(!log.nested && !log.running, "%u nested calls of parallel_for", log.nested);
          CHECK_MSG(!t.backwards && !t.outside && !t.foreign,
              "%u ticks backwards, %u outside 0..1, %u on other threads", t.backwards, t.outside, t.foreign);
          if (systems[system].run && log.most > 1) used = 1;
          trbvh_free(&bvh);
          CHECK_MSG(c.live == 0 && c.bad_frees == 0, "%u live, %u bad frees", c.live, c.bad_frees);
        }
      trbvh_free(&want);
      scene_free(&s);
    }
  CONTEXT("all of them");
  CHECK_MSG(used, "parallel_for never got more than one job");
}

static void test_cancel_with_jobs(void)
{
  unsigned system, n;
  scene s;
  trbvh_geometry g;
  hook_scene(&s, 9, QUICK_OR(20000, 60000));
  g = scene_geometry(&s);
  for (system = 0; system < SYSTEM_COUNT; ++system)
    for (n = 1; n < 60; ++n) {
      trbvh bvh;
      job_log log;
      ticks t;
      counter c;
      trbvh_options o = preset_options(2);
      trbvh_result result;
      memset(&bvh, 0, sizeof bvh);
      memset(&log, 0, sizeof log);
      memset(&c, 0, sizeof c);
      ticks_start(&t, n);
      o.jobs.parallel_for = systems[system].run;
      o.jobs.user = &log;
      o.jobs.width = 4;
      o.progress = on_tick;
      o.progress_user = &t;
      o.allocator = counter_allocator(&c);
      CONTEXT("%s, cancelled at tick %u", systems[system].name, n);
      result = trbvh_build(&bvh, &g, &o);
      CHECK_MSG(result == (t.count >= n ? TRBVH_CANCELLED : TRBVH_OK), "%s after %u ticks", trbvh_result_text(result),
          t.count);
      CHECK((result == TRBVH_OK) != tree_is_empty(&bvh));
      trbvh_free(&bvh);
      CHECK_MSG(c.live == 0 && c.bad_frees == 0 && !t.after_cancel, "%u live, %u bad frees, %u ticks after the cancel",
          c.live, c.bad_frees, t.after_cancel);
      if (t.count < n) break;
    }
  scene_free(&s);
}

// >>scratch memory of the user's -------------------------------------------------------------------------------------
/* Memory of a size, `offset` bytes past a cache line, between guards; all of it filled. */
enum { GUARD = 256 };
typedef struct arena { unsigned char *memory, *start; size_t size; } arena;

static void arena_start(arena *a, size_t size, unsigned offset, int fill)
{
  a->memory = (unsigned char *)xmalloc(size + 2 * GUARD + 64 + offset);
  a->start = a->memory + GUARD;
  a->start += (64 - (uintptr_t)a->start % 64) % 64 + offset;
  a->size = size;
  memset(a->start - GUARD, 0x5A, size + 2 * GUARD);
  memset(a->start, fill, size);
}
static void arena_check(const arena *a)
{
  unsigned i, before = 0, after = 0;
  for (i = 0; i < GUARD; ++i) {
    before += a->start[(int)i - GUARD] != 0x5A;
    after += a->start[a->size + i] != 0x5A;
  }
  CHECK_MSG(!before && !after, "%u bytes written before the scratch memory, %u after", before, after);
}

static void test_scratch_of_the_user(void)
{
  static const unsigned offsets[] = {0, 1, 4, 8, 31, 63};
  unsigned at, i;
  int preset;
  for (at = 0; at < HOOK_LARGE; ++at)
    for (preset = 0; preset < QUICK_OR(PRESET_COUNT - 1, PRESET_COUNT); ++preset) {   /* BEST is HIGH */
      scene s;
      trbvh_geometry g;
      trbvh_options o = preset_options(preset);
      trbvh want, bvh;
      trbvh_stats stats;
      counter c;
      size_t scratch = 0;
      hook_scene(&s, at, at < HOOK_SCENES ? 3000 : QUICK_OR(20000, 40000));
      g = scene_geometry(&s);
      memset(&want, 0, sizeof want);
      memset(&bvh, 0, sizeof bvh);
      memset(&c, 0, sizeof c);
      CONTEXT("scene %s, preset %s", s.name, preset_names[preset]);
      CHECK(trbvh_build(&want, &g, &o) == TRBVH_OK);
      trbvh_bytes_bound(&g, &o, &scratch);
      o.allocator = counter_allocator(&c);
      o.stats = &stats;
      for (i = 0; i < sizeof offsets / sizeof offsets[0]; ++i) {
        arena a;
        void *block;
        if (at >= HOOK_SCENES && i % 3 != 1) continue;
        CONTEXT("scene %s, preset %s, scratch memory %u bytes past a line", s.name, preset_names[preset], offsets[i]);
        arena_start(&a, scratch, offsets[i], i % 2 ? 0xAA : 0xFF);
        o.scratch = a.start;
        o.scratch_size = scratch;
        o.jobs.width = i % 3 + 1;
        c.calls = c.allocs = 0;
        c.peak_bytes = c.live_bytes;
        CHECK(trbvh_build(&bvh, &g, &o) == TRBVH_OK && same_tree(&bvh, &want));
        CHECK_MSG(c.calls == (bvh.block != NULL), "%u allocations", c.calls);
        CHECK_MSG(c.peak_bytes == bvh.block_size, "%zu bytes allocated, block_size %zu", c.peak_bytes, bvh.block_size);
        CHECK_MSG(stats.bytes_scratch <= scratch && !stats.bytes_scratch == !scratch, "scratch %zu, bound %zu",
            stats.bytes_scratch, scratch);
        arena_check(&a);
        block = bvh.block;                             /* again, with what the first build left there */
        CHECK(trbvh_build(&bvh, &g, &o) == TRBVH_OK && same_tree(&bvh, &want));
        CHECK_MSG(c.calls == (bvh.block != NULL) && bvh.block == block, "%u allocations for two builds", c.calls);
        arena_check(&a);
        if (scratch) {
          o.scratch_size = scratch - 1;                /* over a tree */
          CHECK(trbvh_build(&bvh, &g, &o) == TRBVH_INVALID_ARGUMENT && tree_is_empty(&bvh));
          CHECK(memchr(stats.message, 0, sizeof stats.message) && strstr(stats.message, "scratch"));
          CHECK_MSG(c.live == 0 && c.bad_frees == 0, "%u live, %u bad frees", c.live, c.bad_frees);
          c.calls = 0;                                 /* into {0}, and with no memory at all */
          CHECK(trbvh_build(&bvh, &g, &o) == TRBVH_INVALID_ARGUMENT && tree_is_empty(&bvh) && c.calls == 0);
          o.scratch_size = 0;
          CHECK(trbvh_build(&bvh, &g, &o) == TRBVH_INVALID_ARGUMENT && tree_is_empty(&bvh) && c.calls == 0);
          arena_check(&a);
        }
        o.scratch = NULL;                              /* no pointer: allocated, whatever the size says */
        CHECK(trbvh_build(&bvh, &g, &o) == TRBVH_OK && same_tree(&bvh, &want));
        trbvh_free(&bvh);
        free(a.memory);
        CHECK_MSG(c.live == 0 && c.bad_frees == 0, "%u live, %u bad frees", c.live, c.bad_frees);
      }
      trbvh_free(&want);
      scene_free(&s);
    }
}

/* Builds that fail leave it alone: it is the user's to free. */
static void test_scratch_and_failures(void)
{
  scene s;
  trbvh_geometry g;
  trbvh_options o = preset_options(2);
  trbvh bvh;
  counter c;
  ticks t;
  arena a;
  unsigned n;
  size_t scratch = 0;
  memset(&bvh, 0, sizeof bvh);
  memset(&c, 0, sizeof c);
  hook_scene(&s, 2, 3000);
  g = scene_geometry(&s);
  o.allocator = counter_allocator(&c);
  trbvh_bytes_bound(&g, &o, &scratch);
  arena_start(&a, scratch, 16, 0xAA);
  o.scratch = a.start;
  o.scratch_size = scratch;
  CONTEXT("no memory for the tree");
  c.fail_at = 1;
  CHECK(trbvh_build(&bvh, &g, &o) == TRBVH_OUT_OF_MEMORY && tree_is_empty(&bvh) && c.live == 0 && c.bad_frees == 0);
  c.fail_at = 0;
  o.progress = on_tick;
  o.progress_user = &t;
  for (n = 1; n < 1000; ++n) {
    trbvh_result result;
    CONTEXT("cancelled at tick %u", n);
    ticks_start(&t, n);
    result = trbvh_build(&bvh, &g, &o);
    CHECK(result == (t.count >= n ? TRBVH_CANCELLED : TRBVH_OK));
    if (result == TRBVH_OK) break;
    CHECK(tree_is_empty(&bvh) && c.live == 0 && c.bad_frees == 0);
    arena_check(&a);
  }
  CHECK(n > 5 && n < 1000);
  trbvh_free(&bvh);
  CHECK(c.live == 0 && c.bad_frees == 0);
  free(a.memory);
  scene_free(&s);
}

/* A mesh of many groups: most of it in a room, copies of one place, some far away, every fifth not finite. */
static void make_mixed(scene *s, uint32_t n)
{
  uint32_t i, k;
  make_random(s, n);
  for (i = 0; i < n; ++i) {
    float *p = s->positions + 9 * i, bad = bad_float(i);
    if (i % 1000 == 500) for (k = 0; k < 9; ++k) p[k] *= 300.0f;
    if (i % 11 == 3 && i > 40) memcpy(p, s->positions + 9 * (i % 40), 9 * sizeof(float));
    if (i % 5 == 2 || i / 16384 == 3) memcpy(p + i % 9, &bad, sizeof bad);
  }
}

static void test_jobs_on_many_groups(void)
{
  static const uint32_t some[] = {1, 2, 3, 8, 16};
  scene s;
  trbvh_geometry g;
  unsigned system, w;
  int preset;
  memset(&s, 0, sizeof s);
  make_mixed(&s, QUICK_OR(90000, 150000));
  g = scene_geometry(&s);
  for (preset = 0; preset < PRESET_COUNT - 1; ++preset) {
    trbvh_options o = preset_options(preset);
    trbvh want;
    walk_info info;
    char why[128] = "";
    unsigned group_jobs = 0;
    memset(&want, 0, sizeof want);
    CONTEXT("preset %s", preset_names[preset]);
    CHECK(trbvh_build(&want, &g, &o) == TRBVH_OK);
    CHECK_MSG(walk_tree(&want, &g, 8, preset >= 2, &info, why, sizeof why) && info.skipped > s.count / 5, "%s", why);
    for (system = 0; system < SYSTEM_COUNT; ++system)
      for (w = 0; w < sizeof some / sizeof some[0]; ++w) {
        trbvh bvh;
        job_log log;
        memset(&bvh, 0, sizeof bvh);
        memset(&log, 0, sizeof log);
        if (QUICK_OR((system + w + (unsigned)preset) % 3 != 0, system > 2 && w % 2 == 0)) continue;   /* each, one preset */
        o.jobs.parallel_for = systems[system].run;
        o.jobs.user = &log;
        o.jobs.width = some[w];
        CONTEXT("preset %s, %s, width %u", preset_names[preset], systems[system].name, some[w]);
        CHECK(trbvh_build(&bvh, &g, &o) == TRBVH_OK);
        CHECK_MSG(same_tree(&bvh, &want), "another tree than without jobs");
        if (log.most > group_jobs) group_jobs = log.most;
        trbvh_free(&bvh);
      }
    CHECK_MSG(group_jobs > 5, "%u jobs at once at most", group_jobs);
    trbvh_free(&want);
  }
  scene_free(&s);
}

/* One triangle a million times the scene's size away: one child of the root is the rest, too large for one job; the
 * other is a job of a single reference. */
static void test_single_outlier(void)
{
  static const uint32_t places[] = {0, 24999, 49999};
  unsigned p, far, w, system, lonely;
  int preset;
  for (p = 0; p < QUICK_OR(1, 3); ++p)
    for (far = 0; far < 2; ++far) {
      scene s;
      trbvh_geometry g;
      uint32_t k;
      memset(&s, 0, sizeof s);
      make_random(&s, 50000);
      for (k = 0; k < 9; ++k) s.positions[9 * places[p] + k] += far ? 2e6f : -2e6f;
      g = scene_geometry(&s);
      for (preset = 0; preset < QUICK_OR(PRESET_COUNT - 1, PRESET_COUNT); ++preset) {   /* BEST is HIGH */
        trbvh_options o = preset_options(preset);
        trbvh want;
        walk_info info;
        char why[128] = "";
        memset(&want, 0, sizeof want);
        CONTEXT("outlier %u, far %u, preset %s", places[p], far, preset_names[preset]);
        CHECK(trbvh_build(&want, &g, &o) == TRBVH_OK);
        if (!QUICK_OR(p, 0)) CHECK_MSG(walk_tree(&want, &g, 8, preset >= 2, &info, why, sizeof why), "%s", why);
        for (lonely = 0, k = 0; want.nodes && k < 2; ++k) {
          const trbvh_node *child = &want.nodes[want.nodes[0].first + k];
          lonely += child->count == 1 && want.prims[child->first] == places[p];
        }
        CHECK_MSG(lonely == 1, "the outlier is no child of the root");
        for (system = 0; system < 3; ++system)
          for (w = 2; w <= 4; w += 2) {
            trbvh bvh;
            job_log log;
            if (QUICK_OR((far + (unsigned)preset + system + w / 2) % 2, 0)) continue;
            memset(&bvh, 0, sizeof bvh);
            memset(&log, 0, sizeof log);
            o.jobs.parallel_for = systems[system].run;
            o.jobs.user = &log;
            o.jobs.width = w;
            CONTEXT("outlier %u, far %u, preset %s, %s, width %u", places[p], far, preset_names[preset],
                systems[system].name, w);
            CHECK(trbvh_build(&bvh, &g, &o) == TRBVH_OK && same_tree(&bvh, &want));
            trbvh_free(&bvh);
          }
        trbvh_free(&want);
      }
      scene_free(&s);
    }
}

static void test_queries_on_jobs(void)
{
  static const uint32_t counts[] = {0, 1, 2, 63, 64, 65, 1000, 5003};
  unsigned i, system, w, n, wrong;
  scene s;
  trbvh_geometry g;
  trbvh bvh;
  rng r = {77};
  trbvh_ray *rays = (trbvh_ray *)xmalloc(sizeof(trbvh_ray) * 5003);
  trbvh_hit *want = (trbvh_hit *)xmalloc(sizeof(trbvh_hit) * 5003);
  trbvh_hit *hits = (trbvh_hit *)xmalloc(sizeof(trbvh_hit) * 5004);
  uint8_t *any = (uint8_t *)xmalloc(5004);
  unsigned hit_count = 0;
  int k;
  memset(&bvh, 0, sizeof bvh);
  hook_scene(&s, 0, 3000);
  g = scene_geometry(&s);
  CHECK(trbvh_build(&bvh, &g, NULL) == TRBVH_OK);
  for (i = 0; i < 5003; ++i) {
    memset(&rays[i], 0, sizeof rays[i]);
    for (k = 0; k < 3; ++k) {
      rays[i].origin[k] = rng_range(&r, -2, 2);
      rays[i].dir[k] = rng_range(&r, -0.5f, 0.5f) - rays[i].origin[k];
    }
    if (i % 3 == 0) rays[i].tmax = rng_unit(&r);
    memset(&want[i], 0, sizeof want[i]);
    hit_count += (unsigned)trbvh_intersect(&bvh, &rays[i], &want[i]);
  }
  CHECK_MSG(hit_count > 500 && hit_count < 4503, "%u hits: the test needs hits and misses", hit_count);
  for (system = 0; system < SYSTEM_COUNT; ++system)
    for (w = 0; w < sizeof widths / sizeof widths[0]; ++w)
      for (n = 0; n < sizeof counts / sizeof counts[0]; ++n) {
        trbvh_options o = preset_options(1);
        job_log log;
        memset(&log, 0, sizeof log);
        memset(hits, 0x77, sizeof(trbvh_hit) * 5004);
        memset(any, 0x77, 5004);
        o.jobs.parallel_for = systems[system].run;
        o.jobs.user = &log;
        o.jobs.width = widths[w];
        CONTEXT("%s, width %u, %u rays", systems[system].name, widths[w], counts[n]);
        CHECK(trbvh_intersect_n(&bvh, rays, hits, counts[n], &o) == TRBVH_OK);
        CHECK_MSG(same_bits(hits, want, sizeof(trbvh_hit) * counts[n]), "hits differ from those of single calls");
        CHECK(hits[counts[n]].prim == 0x77777777u);
        CHECK(trbvh_occluded_n(&bvh, rays, any, counts[n], &o) == TRBVH_OK);
        for (wrong = 0, i = 0; i < counts[n]; ++i) wrong += any[i] != (want[i].prim != TRBVH_NONE);
        CHECK_MSG(wrong == 0, "%u of occluded are wrong", wrong);
        CHECK(any[counts[n]] == 0x77);
        CHECK_MSG(!log.nested, "%u nested calls of parallel_for", log.nested);
        if (systems[system].run && widths[w] > 1 && counts[n] == 5003)
          CHECK_MSG(log.most > 1, "5003 rays as %u jobs", log.most);
      }
  CONTEXT("no options");
  memset(hits, 0x77, sizeof(trbvh_hit) * 5004);
  CHECK(trbvh_intersect_n(&bvh, rays, hits, 5003, NULL) == TRBVH_OK && same_bits(hits, want, sizeof(trbvh_hit) * 5003));
  trbvh_free(&bvh);
  scene_free(&s);
  free(rays); free(want); free(hits); free(any);
}

int main(int argc, char **argv)
{
  test_start(argc, argv);
  RUN(test_every_allocation_may_fail);
  RUN(test_builds_in_a_row_are_balanced);
  RUN(test_cancel_at_every_tick);
  RUN(test_jobs_do_not_change_the_tree);
  RUN(test_cancel_with_jobs);
  RUN(test_scratch_of_the_user);
  RUN(test_scratch_and_failures);
  RUN(test_jobs_on_many_groups);
  RUN(test_single_outlier);
  RUN(test_queries_on_jobs);
  return test_finish();
}
