/* tables.c - the two tables of Karras and Aila (HPG 2013), made again: what trbvh and every builder that the paper
 * compares it with give and cost, on your meshes or on built-in scenes; with the metrics that explain it, the rate of
 * rays when the build is counted, and Embree's builders, where it is linked. Introduces: all of paper.h's builders.
 *
 *   cc -O2 examples/paper/tables.c -o tables -lm -pthread && ./tables --quick
 *   cc -O2 -DEX_EMBREE=3 examples/paper/tables.c -o tables -lembree3 -lm -pthread     (or 4, and -lembree4)
 *   ./tables --scenes meshes/ --out results/
 *
 * For each scene all trees are made first, then traced in turn, so that noise hits all alike; medians count. All give
 * the very same hits, which is checked. Needs POSIX, or MinGW.
 */
#define _DEFAULT_SOURCE                /* with -std=c99 too: large pages for the library */
#define TRBVH_THREADS
#define TRBVH_IMPLEMENTATION
#include "../../trbvh.h"
#define EX_PROGRAM "tables"
#include "../measure.h"
#include "bittner.h"
#include "early.h"
#include "embree.h"
#include "grid.h"
#include "hlbvh.h"
#include "hploc.h"
#include "judge.h"
#include "kensler.h"
#include "naive.h"
#include "ploc.h"
#include "plot.h"
#include "sbvh.h"
#include "sweep.h"

static const char usage[] =
  "usage: tables [MESH or FOLDER]... [options]\n"
  "  MESH            an OBJ, PLY or STL file; a FOLDER stands for all in it; without any, built-in scenes\n"
  "  --scenes PATH   the same as PATH\n"
  "  --builders LIST only these, and those that the tables are relative to: names with commas; see below\n"
  "  --threads N     after 1, instead of one for each processor\n"
  "  --reps N        repetitions, whose median counts; 5\n"
  "  --size WxH      rays of each of the five cameras; 128x96\n"
  "  --samples N     ambient occlusion rays, and as many diffuse ones, from each hit; 8\n"
  "  --triangles N   of a built-in scene; 100000\n"
  "  --csv FILE      every scene and builder there, with all columns\n"
  "  --out FOLDER    writes RESULTS.md there, with its diagrams\n"
  "  --notes FILE    Markdown to stand at the end of RESULTS.md\n"
  "  --quick         small built-in scenes, few rays: within a minute\n"
  "builders:";

// >>builders ------------------------------------------------------------------------------------------------
enum { FIRST_TABLE = 1, SECOND_TABLE = 2 };
enum { PERFORMANCE, SAH, BUILD, FIGURES };   /* in per cent of the table's first row */
#define MATCH_SBVH -2.0f                 /* as many references as it has */

typedef struct builder {
  const char *name, *key;
  int tables;
  paper_builder *make;                 /* NULL: trbvh_build */
  const void *parameters;
  int quality, rounds;
  float splits;                        /* references more, as a share of the triangles; 0: the preset's; below 0: none */
  double expected;                     /* ns a triangle, for the time that is left */
  double paper[2][FIGURES];            /* by table; 0: not known, or not in it */
} builder;

static const paper_moves_settings from_sweep = {.start = paper_sweep};
#ifdef EX_EMBREE
static ex_embree peer;                 /* started for the mesh at hand */
static const paper_embree_parameters embree_low = {&peer, RTC_BUILD_QUALITY_LOW};
static const paper_embree_parameters embree_medium = {&peer, RTC_BUILD_QUALITY_MEDIUM};
static const paper_embree_parameters embree_high = {&peer, RTC_BUILD_QUALITY_HIGH};
#endif
/* The rows of the tables, in their order, with the figures of the paper's tables 1 and 2. */
static const builder builders[] = {
  {"SweepSAH", "sweep", FIRST_TABLE, paper_sweep, NULL, 0, 0, -1, 700, {{100, 100, 100}, {0}}},
  {"SBVH", "sbvh", SECOND_TABLE, paper_sbvh, NULL, 0, 0, 2, 5000, {{0}, {100, 100, 100}}},
  {"TRBVH", "trbvh", FIRST_TABLE | SECOND_TABLE, NULL, NULL, TRBVH_QUALITY_FAST, 3, -1, 200,
   {{96.0, 94.4, 1.03}, {76.5, 111.5, 0.14}}},
  {"trbvh MEDIUM", "medium", FIRST_TABLE | SECOND_TABLE, NULL, NULL, TRBVH_QUALITY_MEDIUM, 0, -1, 250, {{0}, {0}}},
  {"BEST, no splits", "best-whole", FIRST_TABLE, NULL, NULL, TRBVH_QUALITY_BEST, 0, -1, 1000, {{0}, {0}}},
  {"LBVH", "lbvh", FIRST_TABLE, NULL, NULL, TRBVH_QUALITY_FAST, 0, -1, 60, {{69.4, 131.5, 0.28}, {0}}},
  {"HLBVH", "hlbvh", FIRST_TABLE, paper_hlbvh, NULL, 0, 0, -1, 250, {{67.4, 129.3, 0.57}, {0}}},
  {"GridSAH", "grid", FIRST_TABLE, paper_grid, NULL, 0, 0, -1, 400, {{68.1, 129.1, 0.70}, {0}}},
  {"Kensler, climbing", "climb", FIRST_TABLE, paper_kensler_climb, NULL, 0, 0, -1, 1500, {{0}, {0}}},
  {"Kensler, annealing", "anneal", FIRST_TABLE, paper_kensler_anneal, NULL, 0, 0, -1, 20000,
   {{91.5, 99.6, 552.26}, {0}}},       /* if it is this one; the time says so */
  {"Bittner", "bittner", FIRST_TABLE, paper_bittner, NULL, 0, 0, -1, 15000, {{103.3, 87.7, 1083.24}, {0}}},
  {"Bittner on SweepSAH", "bittner-sweep", FIRST_TABLE, paper_bittner, &from_sweep, 0, 0, -1, 15000, {{0}, {0}}},
  {"PLOC", "ploc", FIRST_TABLE, paper_ploc, NULL, 0, 0, -1, 500, {{0}, {0}}},
  {"H-PLOC", "hploc", FIRST_TABLE, paper_hploc, NULL, 0, 0, -1, 350, {{0}, {0}}},
#ifdef EX_EMBREE
  {"Embree LOW", "embree-low", FIRST_TABLE, paper_embree, &embree_low, 0, 0, -1, 200, {{0}, {0}}},
  {"Embree MEDIUM", "embree-medium", FIRST_TABLE, paper_embree, &embree_medium, 0, 0, -1, 600, {{0}, {0}}},
#endif
  {"trbvh HIGH", "high", SECOND_TABLE, NULL, NULL, TRBVH_QUALITY_HIGH, 0, 0, 1000, {{0}, {0}}},
  {"trbvh BEST", "best", SECOND_TABLE, NULL, NULL, TRBVH_QUALITY_BEST, 0, 0, 4000, {{0}, {0}}},
  {"TRBVH, 10 % splits", "trbvh-10", SECOND_TABLE, NULL, NULL, TRBVH_QUALITY_FAST, 3, 0.1f, 300,
   {{0}, {87.2, 108.8, 0.15}}},
  {"TRBVH, 30 %", "trbvh-30", SECOND_TABLE, NULL, NULL, TRBVH_QUALITY_FAST, 3, 0.3f, 350,
   {{0}, {91.0, 108.0, 0.17}}},
  {"TRBVH, 50 %", "trbvh-50", SECOND_TABLE, NULL, NULL, TRBVH_QUALITY_FAST, 3, 0.5f, 400,
   {{0}, {92.5, 108.3, 0.20}}},
  {"TRBVH, as SBVH", "trbvh-match", SECOND_TABLE, NULL, NULL, TRBVH_QUALITY_FAST, 3, MATCH_SBVH, 400,
   {{0}, {90.7, 107.4, 0.16}}},
  {"ESC, as SBVH", "esc", SECOND_TABLE, paper_esc, NULL, 0, 3, MATCH_SBVH, 1500, {{0}, {0}}},
  {"EVH, as SBVH", "evh", SECOND_TABLE, paper_evh, NULL, 0, 3, MATCH_SBVH, 1500, {{0}, {0}}},
#ifdef EX_EMBREE
  {"Embree HIGH", "embree-high", SECOND_TABLE, paper_embree, &embree_high, 0, 0, 0.3f, 4500, {{0}, {0}}},
#endif
};
enum { BUILDERS = sizeof builders / sizeof *builders, TURNS = 2, REPS_MAX = 99 };
#ifdef EX_EMBREE
static const char *const peer_names[] = {"Embree scene LOW", "Embree scene MEDIUM", "Embree scene HIGH"};
enum { PEERS = 3 };
#else
static const char *const peer_names[] = {""};
enum { PEERS = 0 };
#endif

/* Of one builder and one scene. */
typedef struct result {
  int made;                            /* 0: not asked for, or it failed */
  trbvh_stats stats;                   /* with one thread */
  double ms[TURNS];                    /* 0: it uses no threads */
  double rates[TURNS][EX_KINDS];       /* million rays/s; 0: not measured */
  double epo;
  paper_visits visits;                 /* by diffuse rays */
  uint32_t references;                 /* that the builder made */
} result;
typedef struct scene_results {
  char name[40];
  double triangles;
  result rows[BUILDERS];
  result peers[PEERS + 1];             /* Embree's own scenes */
} scene_results;

typedef struct tables {
  const char *csv_path, *out, *notes;
  int reps, quick, turns;
  uint32_t threads[TURNS], triangles, width, height, samples;
  int wanted[BUILDERS];
  ex_inputs inputs;
  scene_results *scenes;
  ex_progress progress;                /* in ns of expected work */
} tables;

static int row_of(const char *key)     /* BUILDERS where there is none */
{
  int row = 0;
  while (row < BUILDERS && strcmp(builders[row].key, key)) row++;
  return row;
}
static int base_of(int table) { return row_of(table == FIRST_TABLE ? "sweep" : "sbvh"); }   /* what it is relative to */
static double rays_ns(const tables *t)   /* expected for all rays of one tree */
{
  double rays = (double)t->width * t->height * PAPER_CAMERAS * (1 + 2.0 * t->samples);
  return rays * 700 * (t->reps + 1) * (t->turns > 1 ? 1 + 1.0 / t->threads[1] : 1);
}
static double expected_ns(const tables *t, double triangles)
{
  double ns = 0;
  for (int i = 0; i < BUILDERS; i++) ns += t->wanted[i] ? triangles * builders[i].expected + rays_ns(t) : 0;
  return ns;
}

// >>building ------------------------------------------------------------------------------------------------
static trbvh_options options_of(const builder *of, const scene_results *s, trbvh_stats *stats)
{
  trbvh_options options = {.quality = (trbvh_quality)of->quality, .stats = stats};
  options.treelet_rounds = of->rounds;
  options.split_budget = of->splits;
  if (of->splits == MATCH_SBVH) {
    double more = s->rows[base_of(SECOND_TABLE)].references / s->triangles - 1;
    options.split_budget = more > 0 ? (float)more : -1;
  }
  return options;
}
/* Of trbvh's own: as an engine does that rebuilds, into the same tree with its memory kept. Median of repetitions. */
static double build_own(const tables *t, trbvh *tree, const trbvh_geometry *geometry, trbvh_options options,
                        uint32_t threads)
{
  double ms[REPS_MAX];
  options.jobs.width = threads;
  ex_keep_scratch(&options, geometry);
  for (int i = -1; i < t->reps; i++) {   /* the first one, which touches fresh memory, does not count */
    double start = ex_now_ms();
    ex_check(trbvh_build(tree, geometry, &options), "building", options.stats);
    if (i >= 0) ms[i] = ex_now_ms() - start;
  }
  free(options.scratch);
  return ex_median(ms, t->reps);
}
/* Of the others: again only where it is fast. */
static double build_other(const tables *t, const builder *of, trbvh *tree, const trbvh_geometry *geometry,
                          const trbvh_options *options, result *r)
{
  double ms[REPS_MAX], all = 0;
  int count = 0;
  do {
    double start = ex_now_ms();
    ex_check(paper_make(tree, geometry, options, of->make, of->parameters, &r->references), of->name, options->stats);
    all += ms[count++] = ex_now_ms() - start;
#ifdef EX_EMBREE
    if (of->make == paper_embree) ms[count - 1] = peer.ms;   /* its part of it; below 0 where it has no tree */
#endif
  } while (count < t->reps && all < 300);
  return ex_median(ms, count);
}
static void build(const tables *t, int row, trbvh *tree, const trbvh_geometry *geometry, scene_results *s)
{
  const builder *of = &builders[row];
  result *r = &s->rows[row];
  trbvh_options options = options_of(of, s, &r->stats);
  if (of->make) {
    r->ms[0] = build_other(t, of, tree, geometry, &options, r);
  } else {
    trbvh_stats stats;
    if (t->turns > 1) {
      options.stats = &stats;
      r->ms[1] = build_own(t, tree, geometry, options, t->threads[1]);
      options.stats = &r->stats;
    }
    r->ms[0] = build_own(t, tree, geometry, options, 1);
    r->references = r->stats.ref_count;
  }
  r->made = r->ms[0] > 0;
}

/* A builder that makes LBVH, and of its treelets the best topologies, in two ways. */
static double naive_us, dynamic_us;    /* a treelet */
static void time_treelets(paper_build *p)
{
  enum { TREELETS = 64 * TRB_LANES, NAIVE = 16 };
  paper_treelet *treelets = (paper_treelet *)ex_allocate(TREELETS, sizeof *treelets);
  float naive[NAIVE], dynamic[TREELETS];
  paper_lbvh(p);
  if (paper_sample_treelets(p, treelets, TREELETS) == TREELETS) {
    double start = ex_now_ms();
    for (int i = 0; i < NAIVE; i++) naive[i] = paper_treelet_naive(&treelets[i], p->lib.costs, NULL);
    naive_us = (ex_now_ms() - start) * 1e3 / NAIVE;
    for (int rep = 0; rep < 2; rep++) {   /* the first one warms up */
      start = ex_now_ms();
      for (uint32_t i = 0; i < TREELETS; i += TRB_LANES) paper_treelets_dp(&treelets[i], p->lib.costs, &dynamic[i]);
      dynamic_us = (ex_now_ms() - start) * 1e3 / TREELETS;
    }
    for (int i = 0; i < NAIVE; i++) {
      if (fabsf(naive[i] - dynamic[i]) <= 1e-4f * naive[i]) continue;
      ex_die("the dynamic program has found %g, the recursion %g", dynamic[i], naive[i]);
    }
  }
  free(treelets);
}

// >>tracing -------------------------------------------------------------------------------------------------
/* What the rays hit, by the first tree, and room for what they hit by another one. */
typedef struct answers { trbvh_hit *hits[EX_KINDS], *again; uint8_t *occluded, *occluded_again; } answers;

static double trace_ms(const trbvh *tree, int kind, const ex_ray_set *set, uint32_t threads, trbvh_hit *hits,
                       uint8_t *occluded)
{
  trbvh_options options = {.jobs = {.width = threads}};
  double start = ex_now_ms();
  trbvh_result done = kind == EX_AMBIENT ? trbvh_occluded_n(tree, set->rays, occluded, set->count, &options)
                                         : trbvh_intersect_n(tree, set->rays, hits, set->count, &options);
  double ms = ex_now_ms() - start;
  ex_check(done, "tracing rays", NULL);
  return ms;
}
static answers make_answers(const trbvh *tree, const ex_ray_set sets[EX_KINDS])
{
  answers a;
  size_t most = 0;
  for (int kind = 0; kind < EX_KINDS; kind++) {
    a.hits[kind] = (trbvh_hit *)ex_allocate(sets[kind].count, sizeof(trbvh_hit));
    if (sets[kind].count > most) most = sets[kind].count;
  }
  a.again = (trbvh_hit *)ex_allocate(most, sizeof(trbvh_hit));
  a.occluded = (uint8_t *)ex_allocate(most, 1);
  a.occluded_again = (uint8_t *)ex_allocate(most, 1);
  for (int kind = 0; kind < EX_KINDS; kind++) trace_ms(tree, kind, &sets[kind], 1, a.hits[kind], a.occluded);
  return a;
}
static void free_answers(answers *a)
{
  for (int kind = 0; kind < EX_KINDS; kind++) free(a->hits[kind]);
  free(a->again);
  free(a->occluded);
  free(a->occluded_again);
}
static void check_answers(const answers *a, int kind, size_t count, const char *who)
{
  if (kind == EX_AMBIENT ? memcmp(a->occluded, a->occluded_again, count)
                         : memcmp(a->hits[kind], a->again, count * sizeof(trbvh_hit))) {
    ex_die("%s: other hits than with the first tree", who);
  }
}
/* All trees with all kinds of rays; a first round, that does not count, warms up. */
static void trace(tables *t, const trbvh *trees, const ex_ray_set sets[EX_KINDS], answers *a, scene_results *s)
{
  static double ms[BUILDERS][EX_KINDS][REPS_MAX];
  for (int turn = 0; turn < t->turns; turn++) {
    for (int rep = -1; rep < t->reps; rep++) {
      for (int i = 0; i < BUILDERS * EX_KINDS; i++) {
        int row = i / EX_KINDS, kind = i % EX_KINDS;
        if (!s->rows[row].made || !sets[kind].count) continue;
        double once = trace_ms(&trees[row], kind, &sets[kind], t->threads[turn], a->again, a->occluded_again);
        check_answers(a, kind, sets[kind].count, builders[row].name);
        if (rep >= 0) ms[row][kind][rep] = once;
        t->progress.done += rays_ns(t) / (EX_KINDS * t->turns * (t->reps + 1));
      }
      ex_show_progress(&t->progress, s->name, 1);
    }
    for (int i = 0; i < BUILDERS * EX_KINDS; i++) {
      int row = i / EX_KINDS, kind = i % EX_KINDS;
      if (!s->rows[row].made || !sets[kind].count) continue;
      s->rows[row].rates[turn][kind] = (double)sets[kind].count / ex_median(ms[row][kind], t->reps) / 1e3;
    }
  }
}
#ifdef EX_EMBREE
/* What an Embree user gets: its own scene, nodes and traversal. */
static void measure_peers(const tables *t, const ex_mesh *mesh, const ex_ray_set sets[EX_KINDS], answers *a,
                          scene_results *s)
{
  static const enum RTCBuildQuality qualities[PEERS] = {
    RTC_BUILD_QUALITY_LOW, RTC_BUILD_QUALITY_MEDIUM, RTC_BUILD_QUALITY_HIGH
  };
  for (int i = 0; i < PEERS * t->turns; i++) {
    int turn = i / PEERS;
    uint32_t threads = t->threads[turn];
    result *r = &s->peers[i % PEERS];
    ex_embree_start(&peer, mesh, threads);
    RTCScene embree = ex_embree_scene(&peer, qualities[i % PEERS], &r->ms[turn]);
    r->made = 1;
    for (int kind = 0; kind < EX_KINDS; kind++) {
      const ex_ray_set *set = &sets[kind];
      double ms[REPS_MAX];
      for (int rep = -1; rep < t->reps && set->count; rep++) {
        trbvh_hit *hits = kind == EX_AMBIENT ? NULL : a->again;
        double once = ex_embree_trace(embree, set->rays, set->count, hits, a->occluded_again, threads);
        if (rep >= 0) ms[rep] = once;
      }
      if (set->count) r->rates[turn][kind] = (double)set->count / ex_median(ms, t->reps) / 1e3;
    }
    rtcReleaseScene(embree);
    ex_embree_stop(&peer);
  }
}
#endif

static void build_all(tables *t, const ex_mesh *mesh, trbvh trees[BUILDERS], scene_results *s)
{
  trbvh_geometry geometry = ex_mesh_geometry(mesh);
#ifdef EX_EMBREE
  ex_embree_start(&peer, mesh, 1);
#endif
  for (int i = -1, sbvh = base_of(SECOND_TABLE); i < BUILDERS; i++) {   /* SBVH first: others match its references */
    int row = i < 0 ? sbvh : i;
    if (i == sbvh || !t->wanted[row]) continue;
    build(t, row, &trees[row], &geometry, s);
    t->progress.done += s->triangles * builders[row].expected;
    ex_show_progress(&t->progress, s->name, 1);
  }
#ifdef EX_EMBREE
  ex_embree_stop(&peer);
#endif
}
/* first: the tree that says where rays go, and what they hit */
static void judge_all(tables *t, const ex_scene *scene, const trbvh *first, const trbvh trees[BUILDERS],
                      scene_results *s)
{
  ex_ray_set sets[EX_KINDS];
  const ex_ray_set *diffuse = &sets[EX_DIFFUSE];
  paper_make_rays(scene, first, t->width, t->height, t->samples, sets);
  for (int i = 0; i < EX_KINDS; i++) paper_thin_rays(&sets[i], first, 8e6);
  paper_points points = paper_make_points(&scene->mesh, t->quick ? 4096 : 32768);
  answers a = make_answers(first, sets);
  trace(t, trees, sets, &a, s);
  for (int i = 0; i < BUILDERS; i++) {
    size_t step = diffuse->count / 20000 + 1;
    if (!s->rows[i].made) continue;
    s->rows[i].epo = paper_epo(&trees[i], &points);
    s->rows[i].visits = paper_count_visits(&trees[i], diffuse->rays, a.hits[EX_DIFFUSE], diffuse->count, step);
  }
#ifdef EX_EMBREE
  measure_peers(t, &scene->mesh, sets, &a, s);
#endif
  for (int i = 0; i < EX_KINDS; i++) free(sets[i].rays);
  free(points.at);
  free_answers(&a);
}
static void measure_scene(tables *t, const ex_input *in, scene_results *s)
{
  trbvh trees[BUILDERS], first = {0};
  trbvh_options usual = {.allocator = {NULL, NULL, NULL}};
  ex_scene scene;
  memset(trees, 0, sizeof trees);
  ex_mesh mesh = ex_load_input(in, t->triangles);
  ex_scene_of(&scene, mesh, 1);
  trbvh_geometry geometry = ex_mesh_geometry(&mesh);
  const char *name = ex_short_name(in);
  snprintf(s->name, sizeof s->name, "%.*s", (int)strcspn(name, "."), name);
  s->triangles = mesh.triangle_count;
  double done = t->progress.done;
  ex_show_progress(&t->progress, s->name, 0);
  build_all(t, &mesh, trees, s);
  if (naive_us <= 0) ex_check(paper_make(&first, &geometry, &usual, time_treelets, NULL, NULL), "building", NULL);
  ex_check(trbvh_build(&first, &geometry, &usual), "building", NULL);
  judge_all(t, &scene, &first, trees, s);
  t->progress.done = done + expected_ns(t, s->triangles);
  for (int i = 0; i < BUILDERS; i++) trbvh_free(&trees[i]);
  trbvh_free(&first);
  ex_mesh_free(&mesh);
}

// >>figures -------------------------------------------------------------------------------------------------
static int in_table(const tables *t, int row, int table) { return t->wanted[row] && (builders[row].tables & table); }

/* One of these figures, of one builder and scene, beside what the table is relative to. */
typedef struct view { const result *of, *base; double triangles; } view;
typedef double measure(view v);

static double ratio(double a, double b) { return b > 0 ? 100 * a / b : 0; }
static double rates_ratio(view v, int turn, int kind)
{
  return ratio(v.of->rates[turn][kind], v.base->rates[turn][kind]);
}
static double performance(view v) { return rates_ratio(v, 0, EX_DIFFUSE); }
static double performance_n(view v) { return rates_ratio(v, 1, EX_DIFFUSE); }
static double primary(view v) { return rates_ratio(v, 0, EX_PRIMARY); }
static double ambient(view v) { return rates_ratio(v, 0, EX_AMBIENT); }
static double sah(view v) { return ratio(v.of->stats.sah_cost, v.base->stats.sah_cost); }
static double build_time(view v) { return ratio(v.of->ms[0], v.base->ms[0]); }
static double references(view v) { return ratio(v.of->stats.ref_count, v.triangles); }
static double epo(view v) { return ratio(v.of->epo, v.base->epo); }
static double lcv(view v) { return ratio(v.of->visits.lcv, v.base->visits.lcv); }
static double nodes(view v) { return ratio(v.of->visits.nodes, v.base->visits.nodes); }
static double triangles(view v) { return ratio(v.of->visits.triangles, v.base->visits.triangles); }
static double depth(view v) { return v.of->stats.max_depth; }
static double ns_per_triangle(view v) { return v.of->ms[0] * 1e6 / v.triangles; }
static double ns_per_triangle_n(view v) { return v.of->ms[1] * 1e6 / v.triangles; }
static double million_rays(view v) { return v.of->rates[0][EX_DIFFUSE]; }
static double million_rays_n(view v) { return v.of->rates[1][EX_DIFFUSE]; }

static double value_of(const scene_results *s, measure *of, int row, int table)   /* 0 where it is not known */
{
  view v = {&s->rows[row], &s->rows[base_of(table)], s->triangles};
  return s->rows[row].made ? of(v) : 0;
}
/* Over the scenes: 0 where the figure of one of them is not known. */
typedef struct average { double sum, logs; size_t count, known; } average;
static void add(average *a, double value)
{
  a->count++;
  if (!(value > 0)) return;
  a->known++;
  a->sum += value;
  a->logs += log(value);
}
static double arithmetic(average a) { return a.known == a.count ? a.sum / (double)a.count : 0; }
static double geometric(average a) { return a.known == a.count ? exp(a.logs / (double)a.count) : 0; }
static average average_of(const tables *t, measure *of, int row, int table)
{
  average a = {0, 0, 0, 0};
  for (size_t i = 0; i < t->inputs.count; i++) add(&a, value_of(&t->scenes[i], of, row, table));
  return a;
}

/* Million rays/s when `rays` of them are traced and the build is counted, with one thread: R / (build + R / p). */
static double effective(const result *r, double rays)
{
  double p = r->rates[0][EX_DIFFUSE];
  return p > 0 ? rays / (r->ms[0] * 1e3 + rays / p) : 0;
}
static double effective_mean(const tables *t, int row, double rays)
{
  average a = {0, 0, 0, 0};
  for (size_t i = 0; i < t->inputs.count; i++) add(&a, effective(&t->scenes[i].rows[row], rays));
  return geometric(a);
}
/* How many rays it takes until the slower build b has paid against a; infinity where it never does. */
static double break_even(const result *a, const result *b)
{
  double per_ray = 1 / a->rates[0][EX_DIFFUSE] - 1 / b->rates[0][EX_DIFFUSE];
  return per_ray > 0 ? (b->ms[0] - a->ms[0]) * 1e3 / per_ray : HUGE_VAL;
}

// >>report --------------------------------------------------------------------------------------------------
/* Markdown, for the terminal as well: cells have a width. */
static void print_cell(FILE *out, int width, int decimals, double value)   /* blank where it is not known */
{
  if (!(value > 0)) fprintf(out, " %*s |", width, "");
  else fprintf(out, " %*.*f |", width, value >= 1000 ? 0 : decimals, value);
}
static void print_rule(FILE *out, int first, int count, int width)
{
  fprintf(out, "\n|%.*s|", first + 2, "----------------------------------------");
  for (int i = 0; i < count; i++) fprintf(out, "%.*s:|", width + 1, "----------------------------------------");
  fputs("\n", out);
}
enum { NAME = 19 };                      /* width of a builder's name */

static void print_machine(FILE *out, const tables *t)
{
  char line[256], cpu[256] = "unknown processor";
  FILE *info = fopen("/proc/cpuinfo", "r");
  while (info && fgets(line, sizeof line, info)) {
    char *value = strstr(line, ": ");
    if (strncmp(line, "model name", 10) || !value) continue;
    snprintf(cpu, sizeof cpu, "%.*s", (int)strcspn(value + 2, "\n"), value + 2);
    break;
  }
  if (info) fclose(info);
#ifdef __VERSION__
  const char *compiler = __VERSION__;
#else
  const char *compiler = "unknown compiler";
#endif
  fprintf(out, "\n%s, %u threads; compiler %s; %u scenes; %ux%u rays from each of %d cameras, %u + %u from each hit; "
          "medians of %d.\n", cpu, (unsigned)t->threads[t->turns - 1], compiler, (unsigned)t->inputs.count,
          (unsigned)t->width, (unsigned)t->height, PAPER_CAMERAS, (unsigned)t->samples, (unsigned)t->samples, t->reps);
}
/* Averages over the scenes, as the paper's; and geometric means, which a few extreme scenes cannot rule. */
static void print_table(FILE *out, const tables *t, int table)
{
  static measure *const figures[FIGURES] = {performance, sah, build_time};
  fprintf(out, "\n### Relative to %s\n\n| %-*s | performance: average | geometric | paper | SAH: average | geometric "
          "| paper | build: average | geometric | paper | references |", builders[base_of(table)].name, NAME, "%");
  print_rule(out, NAME, 3 * FIGURES + 1, 6);
  for (int row = 0; row < BUILDERS; row++) {
    if (!in_table(t, row, table)) continue;
    fprintf(out, "| %-*s |", NAME, builders[row].name);
    for (int i = 0; i < FIGURES; i++) {
      int decimals = i == BUILD ? 2 : 1;
      average a = average_of(t, figures[i], row, table);
      print_cell(out, 6, decimals, arithmetic(a));
      print_cell(out, 6, decimals, geometric(a));
      print_cell(out, 6, decimals, builders[row].paper[table - 1][i]);
    }
    print_cell(out, 6, 1, arithmetic(average_of(t, references, row, table)));
    fputs("\n", out);
  }
}
typedef struct column { const char *title; measure *of; int decimals, geometric; } column;
static void print_columns(FILE *out, const tables *t, int table, const column *columns, int count)
{
  fprintf(out, "\n| %-*s |", NAME, "");
  for (int i = 0; i < count; i++) fprintf(out, " %s |", columns[i].title);
  print_rule(out, NAME, count, 6);
  for (int row = 0; row < BUILDERS; row++) {
    if (!in_table(t, row, table)) continue;
    fprintf(out, "| %-*s |", NAME, builders[row].name);
    for (int i = 0; i < count; i++) {
      average a = average_of(t, columns[i].of, row, table);
      print_cell(out, 6, columns[i].decimals, columns[i].geometric ? geometric(a) : arithmetic(a));
    }
    fputs("\n", out);
  }
}
static void print_metrics(FILE *out, const tables *t, int table)
{
  static const column shares[] = {
    {"primary", primary, 1, 1}, {"ambient occlusion", ambient, 1, 1}, {"diffuse", performance, 1, 1},
    {"diffuse, all threads", performance_n, 1, 1}, {"SAH", sah, 1, 1}, {"EPO", epo, 1, 1}, {"LCV", lcv, 1, 1},
    {"nodes/ray", nodes, 1, 1}, {"triangles/ray", triangles, 1, 1}
  };
  static const column values[] = {
    {"depth", depth, 1, 0}, {"build, ns/triangle", ns_per_triangle, 1, 1}, {"all threads", ns_per_triangle_n, 1, 1},
    {"diffuse, million rays/s", million_rays, 2, 1}, {"all threads", million_rays_n, 2, 1}
  };
  const char *base = builders[base_of(table)].name;
  fprintf(out, "\nRays and what explains them, %% of %s, geometric means; nodes and triangles up to diffuse rays' "
          "hits:\n", base);
  print_columns(out, t, table, shares, sizeof shares / sizeof *shares);
  fputs("\nMean depth; times and rates as geometric means:\n", out);
  print_columns(out, t, table, values, sizeof values / sizeof *values);
}
static void print_scenes(FILE *out, const tables *t, int table, const char *title, measure *of, int decimals)
{
  int count = 0;
  fprintf(out, "\n%s, %% of %s:\n\n| %-24s |", title, builders[base_of(table)].name, "scene");
  for (int row = 0; row < BUILDERS; row++) {
    if (!in_table(t, row, table)) continue;
    fprintf(out, " %s |", builders[row].name);
    count++;
  }
  print_rule(out, 24, count, 6);
  for (size_t i = 0; i < t->inputs.count; i++) {
    fprintf(out, "| %-24s |", t->scenes[i].name);
    for (int row = 0; row < BUILDERS; row++) {
      if (in_table(t, row, table)) print_cell(out, 6, decimals, value_of(&t->scenes[i], of, row, table));
    }
    fputs("\n", out);
  }
}

enum { STAGES = 8 };
static void print_stages(FILE *out, const tables *t)
{
  fprintf(out, "\n### Stages of trbvh's own builds, ns/triangle, one thread, average\n\n"
          "| %-*s | split | morton | sort | hierarchy | treelets | moves | collapse | finish |", NAME, "");
  print_rule(out, NAME, STAGES, 6);
  for (int row = 0; row < BUILDERS; row++) {
    double sums[STAGES] = {0};
    if (!t->wanted[row] || builders[row].make) continue;
    for (size_t i = 0; i < t->inputs.count; i++) {
      const scene_results *s = &t->scenes[i];
      const trbvh_stats *of = &s->rows[row].stats;
      const double ms[STAGES] = {of->ms_split, of->ms_morton, of->ms_sort, of->ms_hierarchy, of->ms_treelets,
                                 of->ms_moves, of->ms_collapse, of->ms_finish};
      for (int k = 0; k < STAGES; k++) sums[k] += ms[k] * 1e6 / s->triangles / (double)t->inputs.count;
    }
    fprintf(out, "| %-*s |", NAME, builders[row].name);
    for (int k = 0; k < STAGES; k++) print_cell(out, 6, 1, sums[k]);
    fputs("\n", out);
  }
  if (naive_us > 0) {
    fprintf(out, "\nThe best topology of a treelet of seven leaves: %.0f us by the naive recursion (1,149,877 calls), "
            "%.3f us by the dynamic program: %.0f times as fast.\n", naive_us, dynamic_us, naive_us / dynamic_us);
  }
}
static int by_value(const void *a, const void *b)
{
  double x = *(const double *)a, y = *(const double *)b;
  return (x > y) - (x < y);
}
static void print_rays(FILE *out, double rays)
{
  if (rays <= 0) fputs(" at once |", out);
  else if (rays > 1e15) fputs(" never |", out);
  else fprintf(out, " %.3g million |", rays / 1e6);
}
static void print_break_even(FILE *out, const tables *t)
{
  static const char *const pairs[][2] = {
    {"lbvh", "trbvh"}, {"trbvh", "medium"}, {"medium", "high"}, {"high", "best"}, {"medium", "sweep"},
    {"medium", "bittner"}, {"high", "sbvh"}
  };
  double *at = (double *)ex_allocate(t->inputs.count, sizeof *at);
  fputs("\n### From how many rays on a slower build pays, one thread\n\n| | median of the scenes | first | last |\n"
        "|---|--:|--:|--:|\n", out);
  for (size_t k = 0; k < sizeof pairs / sizeof *pairs; k++) {
    int rows[2] = {row_of(pairs[k][0]), row_of(pairs[k][1])};
    size_t count = 0;
    for (size_t i = 0; i < t->inputs.count; i++) {
      const result *a = &t->scenes[i].rows[rows[0]], *b = &t->scenes[i].rows[rows[1]];
      if (a->rates[0][EX_DIFFUSE] > 0 && b->rates[0][EX_DIFFUSE] > 0) at[count++] = break_even(a, b);
    }
    if (!count) continue;
    qsort(at, count, sizeof *at, by_value);
    fprintf(out, "| %s instead of %s |", builders[rows[1]].name, builders[rows[0]].name);
    print_rays(out, at[(count - 1) / 2]);
    print_rays(out, at[0]);
    print_rays(out, at[count - 1]);
    fputs("\n", out);
  }
  free(at);
  fputs("\nThe best of all, by the geometric mean of rays per second with the build counted:", out);
  for (int step = 0, before = -1; step <= 200; step++) {   /* from 1e5 to 1e9 */
    double rays = pow(10, 5 + step / 50.0), most = 0;
    int best = -1;
    for (int row = 0; row < BUILDERS; row++) {
      double rate = t->wanted[row] ? effective_mean(t, row, rays) : 0;
      if (rate <= most) continue;
      most = rate;
      best = row;
    }
    if (best == before) continue;
    if (before < 0) fprintf(out, " %s", builders[best].name);
    else fprintf(out, ", from %.3g million rays on %s", rays / 1e6, builders[best].name);
    before = best;
  }
  fputs(".\n", out);
}
static void print_effective(FILE *out, const tables *t)
{
  fprintf(out, "\n### Million diffuse rays per second with the build counted, one thread, geometric means\n\n"
          "| %-*s | of 1e5 rays | 1e6 | 1e7 | 1e8 | 1e9 |", NAME, "");
  print_rule(out, NAME, 5, 6);
  for (int row = 0; row < BUILDERS; row++) {
    if (!t->wanted[row]) continue;
    fprintf(out, "| %-*s |", NAME, builders[row].name);
    for (double rays = 1e5; rays < 2e9; rays *= 10) print_cell(out, 6, 3, effective_mean(t, row, rays));
    fputs("\n", out);
  }
}
static void print_peers(FILE *out, const tables *t)
{
  if (!PEERS) return;
  fprintf(out, "\n### Embree as its users get it: scenes of its own, rtcIntersect1 and rtcOccluded1\n\n"
          "Geometric means, beside trbvh's. Million rays/s of primary, ambient occlusion and diffuse rays, with one "
          "thread and with all.\n\n| %-*s | build, ns/triangle | primary | ambient occlusion | diffuse "
          "| all threads: build | primary | ambient occlusion | diffuse |", NAME, "");
  print_rule(out, NAME, 8, 6);
  const int own[] = {row_of("lbvh"), row_of("trbvh")};
  for (int i = -2; i < PEERS; i++) {
    int row = own[i < 0 ? i + 2 : 0];
    if (i < 0 && !t->wanted[row]) continue;
    fprintf(out, "| %-*s |", NAME, i < 0 ? builders[row].name : peer_names[i]);
    for (int k = 0; k < TURNS * (1 + EX_KINDS); k++) {
      int turn = k / (1 + EX_KINDS), kind = k % (1 + EX_KINDS) - 1;
      average a = {0, 0, 0, 0};
      for (size_t m = 0; m < t->inputs.count; m++) {
        const scene_results *s = &t->scenes[m];
        const result *r = i < 0 ? &s->rows[row] : &s->peers[i];
        add(&a, kind < 0 ? r->ms[turn] * 1e6 / s->triangles : r->rates[turn][kind]);
      }
      print_cell(out, 6, kind < 0 ? 0 : 2, geometric(a));
    }
    fputs("\n", out);
  }
}
static void print_report(FILE *out, const tables *t, int with_scenes)
{
  print_machine(out, t);
  for (int table = FIRST_TABLE; table <= SECOND_TABLE; table++) {
    if (!t->wanted[base_of(table)]) continue;
    fprintf(out, "\n## Table %d\n", table);
    print_table(out, t, table);
    print_metrics(out, t, table);
    if (!with_scenes) continue;
    print_scenes(out, t, table, "Performance (diffuse rays)", performance, 1);
    print_scenes(out, t, table, "SAH", sah, 1);
    print_scenes(out, t, table, "Build time", build_time, 2);
    print_scenes(out, t, table, "EPO", epo, 1);
  }
  fputs("\n## Builds\n", out);
  print_stages(out, t);
  print_effective(out, t);
  print_break_even(out, t);
  print_peers(out, t);
}

// >>files ---------------------------------------------------------------------------------------------------
static FILE *create(const char *folder, const char *name)
{
  char path[1024];
  snprintf(path, sizeof path, "%s%s%s", folder, *folder ? "/" : "", name);
  FILE *file = fopen(path, "w");
  if (!file) ex_die("%s: cannot be written", path);
  return file;
}
static void close_file(FILE *file, const char *name) { if (fclose(file)) ex_die("%s: cannot be written", name); }

static void write_csv(const tables *t)
{
  FILE *csv = create("", t->csv_path);
  fputs("scene,triangles,builder,references,leaves,depth,sah,epo,lcv,nodes_per_ray,triangles_per_ray,build_ms,"
        "build_ms_threads,split_ms,morton_ms,sort_ms,hierarchy_ms,treelets_ms,moves_ms,collapse_ms,finish_ms,"
        "primary_mrays,ambient_mrays,diffuse_mrays,primary_mrays_threads,ambient_mrays_threads,diffuse_mrays_threads", csv);
  for (int k = 5; k <= 9; k++) fprintf(csv, ",effective_mrays_1e%d", k);
  fputs("\n", csv);
  for (size_t i = 0; i < t->inputs.count; i++) {
    for (int row = 0; row < BUILDERS + PEERS; row++) {
      const scene_results *s = &t->scenes[i];
      const result *r = row < BUILDERS ? &s->rows[row] : &s->peers[row - BUILDERS];
      const trbvh_stats *of = &r->stats;
      const double values[] = {
        s->triangles, of->ref_count, of->leaf_count, of->max_depth, of->sah_cost, r->epo, r->visits.lcv,
        r->visits.nodes, r->visits.triangles, r->ms[0], r->ms[1], of->ms_split, of->ms_morton, of->ms_sort,
        of->ms_hierarchy, of->ms_treelets, of->ms_moves, of->ms_collapse, of->ms_finish, r->rates[0][0],
        r->rates[0][1], r->rates[0][2], r->rates[1][0], r->rates[1][1], r->rates[1][2], effective(r, 1e5),
        effective(r, 1e6), effective(r, 1e7), effective(r, 1e8), effective(r, 1e9)
      };
      if (!r->made) continue;
      const char *name = row < BUILDERS ? builders[row].name : peer_names[row - BUILDERS];
      fprintf(csv, "\"%s\",%.0f,\"%s\"", s->name, values[0], name);
      for (size_t k = 1; k < sizeof values / sizeof *values; k++) {
        if (values[k] > 0) fprintf(csv, ",%.6g", values[k]);
        else fputs(",", csv);
      }
      fputs("\n", csv);
    }
  }
  close_file(csv, t->csv_path);
}

/* SAH or performance, in per cent of SweepSAH, over build time. */
static void plot_builders(const tables *t, const char *name, measure *of, const char *title, int more)
{
  paper_plot p = {.left = 60, .top = 40, .width = 680, .height = 380};
  paper_label points[BUILDERS];
  int count = 0;
  double slowest = 0, fastest = DBL_MAX, least = DBL_MAX, most = 0;
  for (int row = 0; row < BUILDERS; row++) {
    double x = t->wanted[row] ? geometric(average_of(t, ns_per_triangle, row, FIRST_TABLE)) : 0;
    double y = x > 0 ? geometric(average_of(t, of, row, FIRST_TABLE)) : 0;
    if (!(y > 0)) continue;
    points[count++] = (paper_label){x, y, builders[row].name, NULL, 0};
    fastest = fmin(fastest, x);
    slowest = fmax(slowest, x);
    least = fmin(least, y);
    most = fmax(most, y);
  }
  p.x = (paper_axis){fastest * 0.7, slowest * 1.5, 1, "build, ns/triangle, one thread (geometric means)"};
  p.y = (paper_axis){least - 5, most + 5, 0, title};
  paper_open_plot(&p, name, 780, 470);
  paper_frame(&p);
  paper_plot_points(&p, points, count, more);
  paper_close_plot(&p);
}
/* The builders that diagrams with many lines or bars show. */
static int shown_rows(const tables *t, int rows[BUILDERS])
{
  static const char *const keys[] = {"lbvh", "trbvh", "medium", "bittner", "sweep", "high", "sbvh"};
  int count = 0;
  for (size_t k = 0; k < sizeof keys / sizeof *keys; k++) {
    int row = row_of(keys[k]);
    if (t->wanted[row]) rows[count++] = row;
  }
  return count;
}
static void plot_scenes(const tables *t, const char *name)
{
  int rows[BUILDERS], count = shown_rows(t, rows);
  double bar = 7, group = bar * count + 8, most = 100;
  paper_plot p = {.left = 190, .top = 70, .width = 560, .height = group * (double)t->inputs.count};
  for (size_t i = 0; i < t->inputs.count; i++) {
    for (int k = 0; k < count; k++) most = fmax(most, value_of(&t->scenes[i], performance, rows[k], FIRST_TABLE));
  }
  p.x = (paper_axis){0, most > 300 ? 300 : most * 1.02, 0, "diffuse rays/s, % of SweepSAH"};
  p.y = (paper_axis){0, 1, 0, ""};
  paper_open_plot(&p, name, 820, p.height + 120);
  for (double x = 0; x <= p.x.high; x += 50) paper_tick(&p, 0, x);
  for (int k = 0; k < count; k++) {
    double x = 30 + 105 * k, y = 30;
    fprintf(p.file, "<rect x=\"%.0f\" y=\"%.0f\" width=\"10\" height=\"10\" fill=\"%s\"/>\n", x, y - 9, paper_color(k));
    paper_text(&p, x + 14, y, "start", "#000000", builders[rows[k]].name);
  }
  for (size_t i = 0; i < t->inputs.count; i++) {
    double top = p.top + group * (double)i;
    paper_text(&p, p.left - 8, top + group / 2, "end", "#000000", t->scenes[i].name);
    for (int k = 0; k < count; k++) {
      double value = value_of(&t->scenes[i], performance, rows[k], FIRST_TABLE), x = fmin(value, p.x.high);
      fprintf(p.file, "<rect x=\"%.0f\" y=\"%.1f\" width=\"%.1f\" height=\"%.1f\" fill=\"%s\"/>\n", p.left,
              top + 4 + bar * k, p.width * x / p.x.high, bar - 1, paper_color(k));
      if (value <= x) continue;
      char text[32];
      snprintf(text, sizeof text, "%.0f", value);
      paper_text(&p, p.left + p.width + (k % 2 ? 4 : 32), top + 12 + bar * k, "start", "#000000", text);
    }
  }
  paper_text(&p, p.left + p.width / 2, p.top + p.height + 36, "middle", "#000000", p.x.title);
  paper_close_plot(&p);
}
static void plot_effective(const tables *t, const char *name)
{
  int rows[BUILDERS], count = shown_rows(t, rows);
  paper_plot p = {.left = 60, .top = 40, .width = 560, .height = 380};
  paper_label labels[BUILDERS];
  double most = 0;
  for (int k = 0; k < count; k++) most = fmax(most, effective_mean(t, rows[k], 1e9));
  p.x = (paper_axis){1e5, 1e9, 1, "diffuse rays for one build"};
  p.y = (paper_axis){0, most * 1.05, 0, "million rays/s with the build counted, one thread (geometric means)"};
  paper_open_plot(&p, name, 780, 470);
  paper_frame(&p);
  for (int k = 0; k < count; k++) {
    fprintf(p.file, "<polyline fill=\"none\" stroke-width=\"2\" stroke=\"%s\" points=\"", paper_color(k));
    for (double x = 5; x <= 9.001; x += 0.05) {
      fprintf(p.file, "%.1f,%.1f ", paper_x(&p, pow(10, x)), paper_y(&p, effective_mean(t, rows[k], pow(10, x))));
    }
    fputs("\"/>\n", p.file);
    double end = paper_y(&p, effective_mean(t, rows[k], 1e9));
    labels[k] = (paper_label){p.left + p.width + 8, end, builders[rows[k]].name, paper_color(k), 0};
  }
  paper_spread(labels, count, 14);
  for (int k = 0; k < count; k++) {
    paper_text(&p, labels[k].x, labels[k].y + 4, "start", labels[k].color, labels[k].text);
  }
  paper_close_plot(&p);
}
static void copy_notes(FILE *out, const char *path)
{
  FILE *notes = fopen(path, "r");
  if (!notes) ex_die("%s: cannot be opened", path);
  fputs("\n", out);
  for (int c; (c = fgetc(notes)) != EOF;) fputc(c, out);
  fclose(notes);
}
static void write_results(const tables *t)
{
  static const char *const plots[][2] = {
    {"sah.svg", "SAH and build time of each builder; the front joins those that no other one beats in both"},
    {"performance.svg", "Diffuse rays and build time, likewise"},
    {"effective.svg", "Rays per second with the build counted"},
    {"scenes.svg", "Performance by scene"}
  };
  char path[4][1024];
  FILE *out = create(t->out, "RESULTS.md");
  for (int i = 0; i < 4; i++) snprintf(path[i], sizeof path[i], "%s/%s", t->out, plots[i][0]);
  plot_builders(t, path[0], sah, "SAH, % of SweepSAH", 0);
  plot_builders(t, path[1], performance, "diffuse rays/s, % of SweepSAH", 1);
  plot_effective(t, path[2]);
  plot_scenes(t, path[3]);
  fputs("# The paper's tables, made again\n\nMade by [tables.c](tables.c). Performance is diffuse rays per second with "
        "one thread; collapse into leaves, layout and traversal are the same for all trees. \"Paper\" columns: Karras "
        "and Aila 2013, on a GPU, 20 scenes of theirs.\n", out);
  print_report(out, t, 1);
  fputs("\n## Diagrams\n", out);
  for (int i = 0; i < 4; i++) fprintf(out, "\n![%s](%s)\n", plots[i][1], plots[i][0]);
  if (t->notes) copy_notes(out, t->notes);
  close_file(out, "RESULTS.md");
}

// >>main ----------------------------------------------------------------------------------------------------
enum {
  OPTION_SCENES, OPTION_BUILDERS, OPTION_THREADS, OPTION_REPS, OPTION_SIZE, OPTION_SAMPLES, OPTION_TRIANGLES,
  OPTION_CSV, OPTION_OUT, OPTION_NOTES, OPTION_QUICK, OPTIONS
};
static const ex_option options_known[OPTIONS] = {
  {"--scenes", EX_VALUE}, {"--builders", EX_VALUE}, {"--threads", EX_VALUE}, {"--reps", EX_VALUE}, {"--size", EX_VALUE},
  {"--samples", EX_VALUE}, {"--triangles", EX_VALUE}, {"--csv", EX_VALUE}, {"--out", EX_VALUE}, {"--notes", EX_VALUE},
  {"--quick", EX_NO_VALUE}
};
/* The builders of a list, and those that their tables are relative to. */
static void choose_builders(tables *t, const char *list)
{
  memset(t->wanted, 0, sizeof t->wanted);
  while (*list) {
    size_t length = strcspn(list, ",");
    char key[32];
    snprintf(key, sizeof key, "%.*s", (int)length, list);
    int row = row_of(key);
    if (row == BUILDERS) ex_die("no builder is named '%s'; --help lists them", key);
    t->wanted[row] = 1;
    for (int table = FIRST_TABLE; table <= SECOND_TABLE; table++) {
      if (builders[row].tables & table) t->wanted[base_of(table)] = 1;
    }
    list += length + (list[length] == ',');
  }
}
static void set_option(void *user, int option, const char *value)
{
  tables *t = (tables *)user;
  switch (option) {
  case OPTION_BUILDERS: choose_builders(t, value); break;
  case OPTION_THREADS: t->threads[1] = ex_parse_count(value, "--threads", 1024, NULL); break;
  case OPTION_REPS: t->reps = (int)ex_parse_count(value, "--reps", REPS_MAX, NULL); break;
  case OPTION_SIZE: ex_parse_size(value, "--size", &t->width, &t->height); break;
  case OPTION_SAMPLES: t->samples = ex_parse_count(value, "--samples", 64, NULL); break;
  case OPTION_TRIANGLES: t->triangles = ex_parse_count(value, "--triangles", 10000000, NULL); break;
  case OPTION_CSV: t->csv_path = value; break;
  case OPTION_OUT: t->out = value; break;
  case OPTION_NOTES: t->notes = value; break;
  case OPTION_QUICK: t->quick = 1; break;
  default: ex_add_path(&t->inputs, value);
  }
}
static void set_defaults(tables *t)
{
  if (!t->reps) t->reps = t->quick ? 1 : 5;
  if (!t->width) t->width = t->quick ? 48 : 128;
  if (!t->height) t->height = t->quick ? 36 : 96;
  if (!t->samples) t->samples = t->quick ? 2 : 8;
  if (!t->triangles) t->triangles = t->quick ? 12000 : 100000;
  int built_in = !t->inputs.count;
  for (int kind = EX_TERRAIN; kind <= EX_SLIVERS && built_in; kind++) ex_add_scene(&t->inputs, (ex_kind)kind);
  t->turns = t->threads[1] > 1 ? 2 : 1;
}
int main(int argc, char **argv)
{
  tables t = {.threads = {1, ex_processors()}};
  char help[2048];
  size_t used = (size_t)snprintf(help, sizeof help, "%s", usage);
  for (int i = 0; i < BUILDERS; i++) {
    const char *before = i == 0 ? "\n  " : i % 8 ? ", " : ",\n  ";
    used += (size_t)snprintf(help + used, sizeof help - used, "%s%s", before, builders[i].key);
    t.wanted[i] = 1;
  }
  snprintf(help + used, sizeof help - used, "\n");
  ex_arguments(argc, argv, help, options_known, OPTIONS, set_option, &t);
  set_defaults(&t);
  for (size_t i = 0; i < t.inputs.count; i++) {
    t.progress.total += expected_ns(&t, ex_expected_triangles(&t.inputs.at[i], t.triangles));
  }
  t.scenes = (scene_results *)ex_allocate(t.inputs.count, sizeof *t.scenes);
  for (size_t i = 0; i < t.inputs.count; i++) measure_scene(&t, &t.inputs.at[i], &t.scenes[i]);
  ex_clear_progress();
  print_report(stdout, &t, !t.quick);
  if (t.csv_path) write_csv(&t);
  if (t.out) write_results(&t);
  free(t.scenes);
  free(t.inputs.at);
  return 0;
}
