/* bench.c - how fast each preset builds and how good its trees are; beside Embree's builders, where it is linked.
 * Introduces: building again into the same tree, times and bytes by stage, many small trees on threads of your own.
 *
 *   cc -O2 examples/bench.c -o bench -lm -pthread && ./bench meshes/
 *   cc -O2 -DEX_EMBREE=3 examples/bench.c -o bench -lembree3 -lm -pthread     (or 4, and -lembree4)
 *
 * Every repetition runs each builder once, so that noise hits all alike, and medians are printed. A build is timed as
 * an engine does it again for a mesh that has changed: into the same tree; "fresh" is into an empty one. Needs POSIX,
 * or MinGW.
 */
#define _DEFAULT_SOURCE                /* with -std=c99 too: large pages for the library */
#define TRBVH_THREADS
#define TRBVH_IMPLEMENTATION
#include "../trbvh.h"
#define EX_PROGRAM "bench"
#include "measure.h"
#include "embree.h"
#include <pthread.h>

static const char usage[] =
  "usage: bench [MESH or FOLDER]... [options]\n"
  "  MESH           an OBJ, PLY or STL file; a FOLDER stands for all in it; without any, four built-in scenes\n"
  "  --threads N    after 1, instead of one for each processor\n"
  "  --reps N       repetitions, whose median counts; 9\n"
  "  --csv FILE     write every row there, with all columns\n"
  "  --quick        3 repetitions, and a tenth of the triangles in what is built in\n"
  "  --adversarial  inputs that may be slow to build, instead of meshes\n"
  "  --small        meshes of 12 to 1000 triangles, and a batch of many, instead of meshes\n";

// >>rows ----------------------------------------------------------------------------------------------------
/* trbvh's presets; FAST once more, from boxes, which makes no triangles: the work of Embree's builders, which are last.
 * Those of one level are compared. */
typedef struct builder { const char *name; int level, quality; } builder;
static const builder builders[] = {
  {"trbvh FAST", 0, TRBVH_QUALITY_FAST},
  {"trbvh MEDIUM", 1, TRBVH_QUALITY_MEDIUM},
  {"trbvh HIGH", 2, TRBVH_QUALITY_HIGH},
  {"trbvh BEST", 3, TRBVH_QUALITY_BEST},
  {"FAST, boxes", 0, TRBVH_QUALITY_FAST},
#ifdef EX_EMBREE
  {"Embree LOW", 0, RTC_BUILD_QUALITY_LOW},
  {"Embree MEDIUM", 1, RTC_BUILD_QUALITY_MEDIUM},
  {"Embree HIGH", 2, RTC_BUILD_QUALITY_HIGH},
#endif
};
enum { PRESETS = 4, FROM_BOXES = PRESETS, OURS, BUILDERS = sizeof builders / sizeof *builders, REPS_MAX = 99 };

/* Columns of a row: times are ms, sizes bytes per triangle. "other" is outside of all stages: starting threads, say. */
enum { RATE, MS, FRESH, STAGE, OTHER = STAGE + 8, SAH, RESULT, SCRATCH, RATIO, SAH_RATIO, COLUMNS };
static const char *const titles[COLUMNS] = {
  "Mtri/s", "ms", "fresh", "split", "morton", "sort", "hierarchy", "treelets", "moves", "collapse", "finish", "other",
  "SAH", "result", "scratch", "/ Embree", "SAH / Embree"
};
static const char csv_header[] =
  "mesh,triangles,threads,builder,mtri_per_s,ms,fresh_ms,split_ms,morton_ms,sort_ms,hierarchy_ms,treelets_ms,moves_ms,"
  "collapse_ms,finish_ms,other_ms,sah,result_bytes_per_triangle,scratch_bytes_per_triangle,rate_to_embree,"
  "sah_to_embree,ns_per_triangle,fresh_ns,split_ns,morton_ns,sort_ns,hierarchy_ns,treelets_ns,moves_ns,collapse_ns,"
  "finish_ns,other_ns\n";

typedef struct row {
  char mesh[40];
  double triangles;
  uint32_t threads;
  const builder *builder;
  double values[COLUMNS];              /* below 0: not known */
} row;
typedef struct bench {
  const char *csv_path;
  FILE *csv;
  int reps, quick, adversarial, small;
  uint32_t threads[2];                 /* to measure with; the second is --threads */
  int turns;                           /* how many of these */
  ex_inputs inputs;
  row *rows;                           /* for each input, of these for each number of threads, of these the builders */
  ex_progress progress;                /* in sizes of inputs */
} bench;

static double ns_per_triangle(const row *r, int column)
{
  return r->values[column] < 0 ? -1 : r->values[column] * 1e6 / r->triangles;
}
static row new_row(const char *mesh, double triangles, uint32_t threads, const builder *of, double ms)
{
  row r = {"", triangles, threads, of, {0}};
  snprintf(r.mesh, sizeof r.mesh, "%s", mesh);
  for (int i = 0; i < COLUMNS; i++) r.values[i] = -1;
  r.values[MS] = ms;
  r.values[RATE] = triangles / ms / 1e3;
  return r;
}
static void write_csv(const bench *b, const row *r)
{
  if (!b->csv) return;
  fprintf(b->csv, "\"%s\",%.0f,%u,%s", r->mesh, r->triangles, r->threads, r->builder->name);
  for (int i = 0; i < COLUMNS + SAH - MS; i++) {
    double value = i < COLUMNS ? r->values[i] : ns_per_triangle(r, i - COLUMNS + MS);
    if (value < 0) fputs(",", b->csv);
    else fprintf(b->csv, ",%.6g", value);
  }
  fputs("\n", b->csv);
  fflush(b->csv);
}

// >>trbvh ---------------------------------------------------------------------------------------------------
typedef struct run {                   /* of one builder */
  trbvh tree;                          /* trbvh's */
  trbvh_options options;
  trbvh_stats stats;
  void *root;                          /* Embree's */
  double sah, result, scratch;         /* bytes */
  double ms[SAH][REPS_MAX];            /* by column */
} run;

/* Those of the triangles; low > high, which is left out, for one that is not finite. */
static ex_box *boxes_of(const ex_mesh *mesh)
{
  ex_box *boxes = (ex_box *)ex_allocate(mesh->triangle_count, sizeof *boxes);
  for (size_t i = 0; i < mesh->triangle_count; i++) {
    int finite = 1;
    boxes[i] = ex_no_box();
    for (size_t k = 3 * i; k < 3 * i + 3; k++) {
      ex_vec p;
      finite &= ex_mesh_finite_corner(mesh, k, &p);
      ex_extend(&boxes[i], mesh->positions + 3 * (size_t)mesh->indices[k]);
    }
    if (!finite) boxes[i] = ex_no_box();
  }
  return boxes;
}

static trbvh_options options_of(int preset, uint32_t threads, trbvh_stats *stats)
{
  trbvh_options options = {.quality = (trbvh_quality)builders[preset].quality, .stats = stats};
  options.jobs.width = threads;
  return options;
}
static void build_trbvh(run *r, const trbvh_geometry *geometry, int preset, uint32_t threads, int rep)
{
  trbvh_options options = options_of(preset, threads, &r->stats);
  trbvh fresh = {0};
  double start = ex_now_ms();
  ex_check(trbvh_build(&fresh, geometry, &options), "building", &r->stats);
  r->ms[FRESH][rep] = ex_now_ms() - start;
  trbvh_free(&fresh);

  start = ex_now_ms();
  ex_check(trbvh_build(&r->tree, geometry, &r->options), "building", &r->stats);
  r->ms[MS][rep] = ex_now_ms() - start;
  const trbvh_stats *s = &r->stats;
  const double stages[OTHER - STAGE] = {s->ms_split, s->ms_morton, s->ms_sort, s->ms_hierarchy, s->ms_treelets,
                                        s->ms_moves, s->ms_collapse, s->ms_finish};
  double other = r->ms[MS][rep];
  for (int i = STAGE; i < OTHER; i++) other -= r->ms[i][rep] = stages[i - STAGE];
  r->ms[OTHER][rep] = other > 0 ? other : 0;
  r->sah = s->sah_cost;
  r->result = (double)s->bytes_result;
  r->scratch = (double)s->bytes_scratch;
}

// >>Embree --------------------------------------------------------------------------------------------------
#ifdef EX_EMBREE
typedef struct embree {
  ex_embree builders;
  pthread_mutex_t lock;                /* for these, which Embree has allocated: */
  double bytes, most_bytes;
} embree;

static bool count_bytes(void *user, ssize_t bytes, bool post)
{
  embree *e = (embree *)user;
  (void)post;
  pthread_mutex_lock(&e->lock);
  e->bytes += (double)bytes;
  if (e->bytes > e->most_bytes) e->most_bytes = e->bytes;
  pthread_mutex_unlock(&e->lock);
  return true;
}
static void start_embree(embree *e, const ex_mesh *mesh, const ex_box *boxes, uint32_t threads)
{
  pthread_mutex_init(&e->lock, NULL);
  e->bytes = e->most_bytes = 0;
  ex_embree_start(&e->builders, mesh, threads);
  rtcSetDeviceMemoryMonitorFunction(e->builders.device, count_bytes, e);
  for (uint32_t i = 0; i < mesh->triangle_count; i++) {
    if (boxes[i].low[0] <= boxes[i].high[0]) ex_embree_add(&e->builders, i, boxes[i].low, boxes[i].high);
  }
}
static void end_embree(embree *e)
{
  ex_embree_stop(&e->builders);
  pthread_mutex_destroy(&e->lock);
}
/* Where Embree finds no tree, all numbers are unknown. */
static void build_embree(embree *e, run *r, int number, int rep)
{
  enum RTCBuildQuality quality = (enum RTCBuildQuality)builders[number].quality;
  size_t room = ex_embree_room(&e->builders, quality);
  double bytes = e->most_bytes = e->bytes;
  r->root = ex_embree_build(&e->builders, quality, room);
  r->ms[MS][rep] = e->builders.ms;
  if (e->most_bytes > bytes) {         /* in the first build; the array, too, is memory that it works in */
    r->scratch = e->most_bytes - bytes + (double)(room * sizeof *e->builders.work);
  }
}
static double half_area(const ex_box *box)
{
  const float *low = box->low, *high = box->high;
  double x = (double)high[0] - low[0], y = (double)high[1] - low[1], z = (double)high[2] - low[2];
  return x * y + y * z + z * x;
}
/* Adds a subtree's part of the paper's equation 1, times the root's area, and its bytes. */
static void add_subtree(const void *at, double area, double *cost, double *bytes)
{
  const ex_embree_leaf *leaf = ex_embree_as_leaf(at);
  if (leaf) {
    *cost += ex_cost_prim * area * leaf->count;
    *bytes += (double)ex_embree_leaf_size(leaf->count);
    return;
  }
  const ex_embree_node *node = (const ex_embree_node *)at;
  *cost += ex_cost_node * area;
  *bytes += sizeof *node;
  for (int i = 0; i < 2; i++) add_subtree(node->children[i], half_area(&node->boxes[i]), cost, bytes);
}
static void judge_embree(const embree *e, run *r)
{
  ex_vec low, high;
  ex_mesh_bounds(e->builders.mesh, &low, &high);
  ex_box all = {{low.x, low.y, low.z}, {high.x, high.y, high.z}};
  double area = half_area(&all);
  if (r->root) add_subtree(r->root, area, &r->sah, &r->result);
  r->sah = !r->root ? -1 : area > 0 ? r->sah / area : 0;
  r->scratch = r->root ? r->scratch - r->result : -1;   /* the result is among what was allocated */
}
#endif

// >>measuring -----------------------------------------------------------------------------------------------
/* All builders with one mesh and one number of threads. */
static void measure(bench *b, const ex_input *in, const ex_mesh *mesh, int turn, row rows[BUILDERS])
{
  trbvh_geometry geometries[OURS];
  ex_box *boxes = boxes_of(mesh);
  run *runs = (run *)ex_allocate(BUILDERS, sizeof *runs);
  uint32_t threads = b->threads[turn];
  const char *name = ex_short_name(in);
  for (int i = 0; i < OURS; i++) {
    geometries[i] = ex_mesh_geometry(mesh);
    if (i == FROM_BOXES) geometries[i] = (trbvh_geometry){.boxes = boxes->low, .count = mesh->triangle_count};
    runs[i].options = options_of(i, threads, &runs[i].stats);
    ex_keep_scratch(&runs[i].options, &geometries[i]);
  }
#ifdef EX_EMBREE
  embree e;
  start_embree(&e, mesh, boxes, threads);
#endif
  for (int round = 0; round <= b->reps; round++) {   /* the first, which allocates, does not count */
    int rep = round ? round - 1 : 0;
    ex_show_progress(&b->progress, name, in->size * (turn + round / (b->reps + 1.0)) / b->turns);
    for (int i = 0; i < OURS; i++) build_trbvh(&runs[i], &geometries[i], i, threads, rep);
#ifdef EX_EMBREE
    for (int i = OURS; i < BUILDERS; i++) build_embree(&e, &runs[i], i, rep);
#endif
  }
#ifdef EX_EMBREE
  for (int i = OURS; i < BUILDERS; i++) judge_embree(&e, &runs[i]);
  end_embree(&e);
#endif
  for (int i = 0; i < BUILDERS; i++) {
    run *r = &runs[i];
    rows[i] = new_row(name, mesh->triangle_count, threads, &builders[i], ex_median(r->ms[MS], b->reps));
    double *values = rows[i].values;
    for (int k = FRESH; k < SAH && i < OURS; k++) values[k] = ex_median(r->ms[k], b->reps);
    values[SAH] = r->sah;
    values[RESULT] = r->sah < 0 ? -1 : r->result / rows[i].triangles;
    values[SCRATCH] = r->scratch / rows[i].triangles;
    trbvh_free(&r->tree);
    free(r->options.scratch);
  }
  for (int i = 0; i < OURS; i++) {
    for (int k = OURS; k < BUILDERS; k++) {
      if (builders[i].level != builders[k].level) continue;
      rows[i].values[RATIO] = rows[i].values[RATE] / rows[k].values[RATE];
      if (rows[k].values[SAH] > 0) rows[i].values[SAH_RATIO] = rows[i].values[SAH] / rows[k].values[SAH];
    }
  }
  for (int i = 0; i < BUILDERS; i++) write_csv(b, &rows[i]);
  free(boxes);
  free(runs);
}

// >>tables --------------------------------------------------------------------------------------------------
static int width_of(int column)
{
  int width = (int)strlen(titles[column]) + 2;
  return width > 8 ? width : 8;
}
static void print_titles(int from, int end) { for (; from < end; from++) printf("%*s", width_of(from), titles[from]); }
static void print_number(int width, int decimals, double value)   /* blank where it is not known */
{
  if (value < 0) printf("%*s", width, "");
  else printf("%*.*f", width, value < 1000 ? decimals : 0, value);
}
static void print_rows(const row rows[BUILDERS])
{
  int end = BUILDERS > OURS ? SAH_RATIO : RATIO;
  printf("\n%s: %.0f triangles; threads: %u; times in ms, result and scratch memory in bytes/triangle\n%-15s",
         rows->mesh, rows->triangles, rows->threads, "");
  print_titles(0, end);
  for (int i = 0; i < BUILDERS; i++) {
    printf("\n  %-13s", builders[i].name);
    for (int k = 0; k < end; k++) print_number(width_of(k), k == RESULT || k == SCRATCH ? 1 : 2, rows[i].values[k]);
    if (i >= OURS) continue;
    printf("\n%15s%*s", "ns/triangle", width_of(RATE), "");
    for (int k = MS; k < SAH; k++) print_number(width_of(k), 1, ns_per_triangle(&rows[i], k));
  }
  puts("");
  fflush(stdout);
}

static const row *row_of(const bench *b, size_t i, int turn, int number)
{
  return b->rows + (i * (size_t)b->turns + (size_t)turn) * BUILDERS + number;
}
static double geometric_mean(const bench *b, int turn, int number, int column)
{
  double sum = 0;
  for (size_t i = 0; i < b->inputs.count; i++) {
    double value = row_of(b, i, turn, number)->values[column];
    if (!(value > 0)) return -1;
    sum += log(value);
  }
  return exp(sum / (double)b->inputs.count);
}
static void print_means(const bench *b)
{
  static const int columns[] = {RATE, SAH, RATIO, SAH_RATIO};
  int shown = BUILDERS > OURS ? 4 : 2;
  printf("\n%-15s", "geometric means");
  for (int turn = 0; turn < b->turns; turn++) {
    printf("  |%4u thread%s", b->threads[turn], turn ? "s" : " ");
    for (int k = 0; k < shown; k++) print_titles(columns[k], columns[k] + 1);
  }
  for (int i = 0; i < BUILDERS; i++) {
    printf("\n  %-13s", builders[i].name);
    for (int turn = 0; turn < b->turns; turn++) {
      printf("  |%12s", "");
      for (int k = 0; k < shown; k++) print_number(width_of(columns[k]), 2, geometric_mean(b, turn, i, columns[k]));
    }
  }
  puts("");
}

static double mean_ns(const bench *b, int turn, int number, int column)
{
  double sum = 0;
  for (size_t i = 0; i < b->inputs.count; i++) sum += ns_per_triangle(row_of(b, i, turn, number), column);
  return sum / (double)b->inputs.count;
}
/* Amdahl's law: of the time t1 of one thread a share s stays serial, and n threads take t(n) = t1 (s + (1 - s) / n).
 * The share is the one with which t(measured) = tm: more than 1 where more threads take longer. */
static double time_with(double n, double t1, double tm, double measured)
{
  double s = t1 > 0 ? (tm / t1 - 1 / measured) / (1 - 1 / measured) : 0;
  if (s < 0) s = 0;
  return t1 * (s + (1 - s) / n);
}
static void print_speed_up(const bench *b)
{
  printf("\nspeed-up of %u threads over one, by mean ns/triangle, and what Amdahl's law for each stage estimates\n"
         "%-15s%8s", b->threads[1], "", "all");
  print_titles(STAGE, SAH);
  printf("%12s%12s", "8 threads", "16 threads");
  for (int i = 0; i < PRESETS; i++) {
    double sum = 0, with_8 = 0, with_16 = 0;
    printf("\n  %-13s", builders[i].name);
    print_number(8, 2, mean_ns(b, 0, i, MS) / mean_ns(b, 1, i, MS));
    for (int k = STAGE; k < SAH; k++) {
      double t1 = mean_ns(b, 0, i, k), tm = mean_ns(b, 1, i, k);
      print_number(width_of(k), 2, t1 > 0.05 && tm > 0 ? t1 / tm : -1);   /* less is the clock's */
      sum += t1;
      with_8 += time_with(8, t1, tm, b->threads[1]);
      with_16 += time_with(16, t1, tm, b->threads[1]);
    }
    print_number(12, 2, sum / with_8);
    print_number(12, 2, sum / with_16);
  }
  puts("");
}
static void print_adversaries(const bench *b)
{
  for (int turn = 0; turn < b->turns; turn++) {
    printf("\nns/triangle, and times the first line's; triangles: %.0f; threads: %u\n%-26s", b->rows->triangles,
           b->threads[turn], "");
    for (int i = 0; i < BUILDERS; i++) printf("%20s", builders[i].name);
    for (size_t m = 0; m < b->inputs.count; m++) {
      printf("\n  %-24s", b->inputs.at[m].name);
      for (int i = 0; i < BUILDERS; i++) {
        double ns = ns_per_triangle(row_of(b, m, turn, i), MS);
        if (ns < 0) printf("%20s", "failed");
        else printf("%13.1f%7.2f", ns, ns / ns_per_triangle(row_of(b, 0, turn, i), MS));
      }
    }
    puts("");
  }
}
static void add_built_in(bench *b)
{
  static const ex_kind scenes[] = {EX_TERRAIN, EX_CITY, EX_SOUP, EX_SLIVERS};
  static const ex_kind adversaries[] = {   /* the first is what the others are compared with */
    EX_SOUP, EX_IDENTICAL, EX_SORTED, EX_REVERSED, EX_TWO_CENTERS, EX_OUTLIER, EX_SLIVERS, EX_GEOMETRIC
  };
  if (b->adversarial) {
    for (size_t i = 0; i < sizeof adversaries / sizeof *adversaries; i++) ex_add_scene(&b->inputs, adversaries[i]);
  } else {
    for (size_t i = 0; i < sizeof scenes / sizeof *scenes; i++) ex_add_scene(&b->inputs, scenes[i]);
  }
}
static void bench_meshes(bench *b)
{
  if (!b->inputs.count) add_built_in(b);
  for (size_t i = 0; i < b->inputs.count; i++) b->progress.total += b->inputs.at[i].size;
  b->rows = (row *)ex_allocate(b->inputs.count * (size_t)b->turns * BUILDERS, sizeof *b->rows);
  row *rows = b->rows;
  for (size_t i = 0; i < b->inputs.count; i++) {
    ex_mesh mesh = ex_load_input(&b->inputs.at[i], b->quick ? 20000 : 200000);
    for (int turn = 0; turn < b->turns; turn++, rows += BUILDERS) {
      measure(b, &b->inputs.at[i], &mesh, turn, rows);
      ex_clear_progress();
      if (!b->adversarial) print_rows(rows);
    }
    b->progress.done += b->inputs.at[i].size;
    ex_mesh_free(&mesh);
  }
  if (b->adversarial) print_adversaries(b);
  else print_means(b);
  if (!b->adversarial && b->turns > 1) print_speed_up(b);
  free(b->rows);
}

// >>small meshes --------------------------------------------------------------------------------------------
/* Of one build, which is repeated until some time has gone by. */
static double small_ms(trbvh *tree, const trbvh_geometry *geometry, const trbvh_options *options, double at_least)
{
  double start = ex_now_ms(), ms;
  uint32_t builds = 0;
  do {
    ex_check(trbvh_build(tree, geometry, options), "building", NULL);
    ms = ex_now_ms() - start;
    builds++;
  } while (ms < at_least);
  return ms / builds;
}
/* What does not grow with the mesh shows as the time that is more than the largest one's for as many triangles. */
static void bench_small(bench *b)
{
  enum { SIZES = 6 };
  static const unsigned sides[SIZES][2] = {{3, 2}, {5, 5}, {10, 5}, {15, 10}, {25, 20}, {100, 50}};
  static double ms[SIZES][PRESETS][REPS_MAX];
  ex_builder rocks[SIZES];
  trbvh tree = {0};
  ex_vec center = ex_v(0, 0, 0);
  memset(rocks, 0, sizeof rocks);
  for (int n = 0; n < SIZES; n++) ex_add_surface(&rocks[n], ex_rock_point, &center, sides[n][0], sides[n][1], 1);
  for (int rep = 0; rep < b->reps; rep++) {
    ex_show_progress(&b->progress, "small meshes", (double)rep / b->reps);
    for (int i = 0; i < SIZES * PRESETS; i++) {
      trbvh_options options = options_of(i % PRESETS, 1, NULL);
      trbvh_geometry geometry = ex_mesh_geometry(&rocks[i / PRESETS].mesh);
      ex_keep_scratch(&options, &geometry);
      ms[i / PRESETS][i % PRESETS][rep] = small_ms(&tree, &geometry, &options, b->quick ? 10 : 50);
      free(options.scratch);
    }
  }
  ex_clear_progress();
  trbvh_free(&tree);
  printf("\nsmall meshes, one thread; fixed: us/build - triangles * ns/tri of the last line\n  triangles");
  for (int i = 0; i < PRESETS; i++) printf("  | %-12s us/build  ns/tri   fixed", builders[i].name);
  for (int n = 0; n < SIZES; n++) {
    double count = rocks[n].mesh.triangle_count, share = count / rocks[SIZES - 1].mesh.triangle_count;
    printf("\n  %9.0f", count);
    for (int i = 0; i < PRESETS; i++) {
      row r = new_row("rock", count, 1, &builders[i], ex_median(ms[n][i], b->reps));
      double us = 1e3 * r.values[MS], fixed = us - share * 1e3 * ex_median(ms[SIZES - 1][i], b->reps);
      printf("  | %21.2f%8.1f%8.2f", us, 1e3 * us / count, fixed);
      write_csv(b, &r);
    }
  }
  puts("");
  for (int n = 0; n < SIZES; n++) ex_mesh_free(&rocks[n].mesh);
  b->progress.done = 1;
}

/* Many meshes in the same arrays: mesh i is the triangles from first[i] to first[i + 1]. */
typedef struct batch { const ex_mesh *mesh; const uint32_t *first; uint32_t count, threads; int preset; } batch;

static void build_share(const void *context, uint32_t number)   /* of the meshes, every threads-th */
{
  const batch *of = (const batch *)context;
  trbvh_options options = options_of(of->preset, 1, NULL);
  trbvh_geometry geometry = ex_mesh_geometry(of->mesh);
  trbvh tree = {0};
  geometry.count = 200;                 /* triangles of the largest mesh */
  ex_keep_scratch(&options, &geometry);
  for (uint32_t i = number; i < of->count; i += of->threads) {
    geometry.indices = of->mesh->indices + 3 * (size_t)of->first[i];
    geometry.count = of->first[i + 1] - of->first[i];
    ex_check(trbvh_build(&tree, &geometry, &options), "building", NULL);
  }
  trbvh_free(&tree);
  free(options.scratch);
}
static double batch_ms(const batch *of)
{
  double start = ex_now_ms();
  ex_run_threads(of->threads, build_share, of);
  return ex_now_ms() - start;
}
static void bench_batch(bench *b)
{
  static double ms[2][PRESETS][REPS_MAX];
  uint32_t count = b->quick ? 10000 : 100000, seed = 1, *first = (uint32_t *)ex_allocate(count + 1, sizeof *first);
  ex_builder built;
  memset(&built, 0, sizeof built);
  for (uint32_t i = 0; i < count; i++) {
    unsigned across = 5 + ex_random_bits(&seed) % 6, down = 5 + ex_random_bits(&seed) % 6;
    ex_vec center = ex_random_point(&seed, -100, 100);
    ex_add_surface(&built, ex_rock_point, &center, across, down, 1);
    first[i + 1] = built.mesh.triangle_count;
  }
  if (built.failed) ex_die("not enough memory");
  for (int rep = 0; rep < b->reps; rep++) {
    ex_show_progress(&b->progress, "a batch of small meshes", (double)rep / b->reps);
    for (int i = 0; i < b->turns * PRESETS; i++) {
      batch of = {&built.mesh, first, count, b->threads[i / PRESETS], i % PRESETS};
      ms[i / PRESETS][i % PRESETS][rep] = batch_ms(&of);
    }
  }
  ex_clear_progress();
  printf("\n%u meshes of 50 to 200 triangles, together %u; each is built by one thread, into a tree of the thread's\n"
         "    threads", count, built.mesh.triangle_count);
  for (int i = 0; i < PRESETS; i++) printf("  | %-12s       ms  Mtri/s  speed-up", builders[i].name);
  for (int turn = 0; turn < b->turns; turn++) {
    printf("\n  %9u", b->threads[turn]);
    for (int i = 0; i < PRESETS; i++) {
      double median = ex_median(ms[turn][i], b->reps);
      row r = new_row("batch", built.mesh.triangle_count, b->threads[turn], &builders[i], median);
      printf("  | %21.1f%8.2f%10.2f", median, r.values[RATE], ex_median(ms[0][i], b->reps) / median);
      write_csv(b, &r);
    }
  }
  puts("");
  free(first);
  ex_mesh_free(&built.mesh);
}

// >>main ----------------------------------------------------------------------------------------------------
enum { OPTION_THREADS, OPTION_REPS, OPTION_CSV, OPTION_QUICK, OPTION_ADVERSARIAL, OPTION_SMALL, OPTIONS };
static const ex_option options_known[OPTIONS] = {
  {"--threads", EX_VALUE}, {"--reps", EX_VALUE}, {"--csv", EX_VALUE}, {"--quick", EX_NO_VALUE},
  {"--adversarial", EX_NO_VALUE}, {"--small", EX_NO_VALUE}
};
static void set_option(void *user, int option, const char *value)
{
  bench *b = (bench *)user;
  switch (option) {
  case OPTION_THREADS: b->threads[1] = ex_parse_count(value, "--threads", 1024, NULL); break;
  case OPTION_REPS: b->reps = (int)ex_parse_count(value, "--reps", REPS_MAX, NULL); break;
  case OPTION_CSV: b->csv_path = value; break;
  case OPTION_QUICK: b->quick = 1; break;
  case OPTION_ADVERSARIAL: b->adversarial = 1; break;
  case OPTION_SMALL: b->small = 1; break;
  default: ex_add_path(&b->inputs, value);
  }
}
int main(int argc, char **argv)
{
  bench b = {.threads = {1, ex_processors()}};
  ex_arguments(argc, argv, usage, options_known, OPTIONS, set_option, &b);
  if (b.adversarial + b.small + (b.inputs.count > 0) > 1) ex_die("meshes, --adversarial or --small, one at a time");
  if (!b.reps) b.reps = b.quick ? 3 : 9;
  b.turns = b.threads[1] > 1 ? 2 : 1;
  if (b.csv_path) {
    b.csv = fopen(b.csv_path, "w");
    if (!b.csv) ex_die("%s: cannot be written", b.csv_path);
    fputs(csv_header, b.csv);
  }
  if (b.small) {
    b.progress.total = 2;
    bench_small(&b);
    bench_batch(&b);
  } else bench_meshes(&b);
  if (b.csv && fclose(b.csv)) ex_die("%s: cannot be written", b.csv_path);
  free(b.inputs.at);
  return 0;
}
