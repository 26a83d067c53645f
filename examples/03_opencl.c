/* 03_opencl.c - the same builds and rays in C and on every OpenCL device, side by side: do all agree?
 * Introduces: devices, what they are called and how they are chosen; falling back; keeping compiled kernels.
 *
 *   cc -O3 examples/03_opencl.c -o opencl -lm -pthread -ldl && ./opencl bunny.ply
 */
#define TRBVH_THREADS
#define TRBVH_IMPLEMENTATION
#include "../trbvh_cl.h"
#define EX_PROGRAM "03_opencl"
#include "common.h"

static const char usage[] =
  "usage: 03_opencl [MESH] [options]\n"
  "  MESH         an OBJ, PLY or STL file; without one, the built-in scene\n"
  "  --threads N  of the second column, instead of one for each processor\n"
  "  --size WxH   of the picture whose rays are traced; 640x400\n"
  "  --cache DIR  keep compiled kernels as files there: the second run starts faster\n";

typedef struct settings { const char *mesh, *cache; uint32_t threads, width, height; } settings;
enum { OPTION_THREADS, OPTION_SIZE, OPTION_CACHE, OPTIONS };
static const ex_option options_known[OPTIONS] = {
  {"--threads", EX_VALUE}, {"--size", EX_VALUE}, {"--cache", EX_VALUE}
};

static void set_option(void *user, int option, const char *value)
{
  settings *s = (settings *)user;
  if (option == OPTION_THREADS) s->threads = ex_parse_count(value, "--threads", 1024, NULL);
  else if (option == OPTION_SIZE) ex_parse_size(value, "--size", &s->width, &s->height);
  else if (option == OPTION_CACHE) s->cache = value;
  else if (s->mesh) ex_die("one mesh at a time: '%s' or '%s'", s->mesh, value);
  else s->mesh = value;
}

// >>cache ---------------------------------------------------------------------------------------------------
/* What a driver has compiled can be kept. The library asks for it by a key, which is fit for a file's name,
 * and changes with device, driver and library, so that nothing outdated is found. What comes back damaged is
 * noticed, and compiled again. */
typedef struct cache { const char *folder; int loaded, saved; } cache;

static FILE *cache_file(const cache *c, const char *key, const char *mode)
{
  char path[1024];
  int length = snprintf(path, sizeof path, "%s/%s", c->folder, key);
  return length > 0 && length < (int)sizeof path ? fopen(path, mode) : NULL;
}
/* Called with too little room first, to learn the size. */
static size_t cache_load(void *user, const char *key, void *out, size_t capacity)
{
  cache *c = (cache *)user;
  FILE *file = cache_file(c, key, "rb");
  if (!file) return 0;                 /* not there */
  long end = fseek(file, 0, SEEK_END) ? 0 : ftell(file);
  size_t size = end > 0 ? (size_t)end : 0;
  if (size && size <= capacity) {
    rewind(file);
    if (fread(out, 1, size, file) == size) c->loaded++;
    else size = 0;
  }
  fclose(file);
  return size;
}
static void cache_save(void *user, const char *key, const void *bytes, size_t size)
{
  cache *c = (cache *)user;
  FILE *file = cache_file(c, key, "wb");
  if (!file) return;                   /* then it is compiled again the next time */
  int complete = fwrite(bytes, 1, size, file) == size;
  if (fclose(file) == 0 && complete) c->saved++;
}

// >>columns -------------------------------------------------------------------------------------------------
enum { COLUMNS = 8, RUNS = 5, WIDTH = 14 };
typedef struct column {
  char title[24];
  trbvh_device *device;                /* NULL = C */
  uint32_t threads;
  double ms_first, ms, sah, rate[EX_KINDS];   /* of one preset; rates in million rays/s, 0 = failed */
  int on_device, same_tree;
  size_t other_hits;
} column;

/* Opens every device. They are opened by name, so of two with the same name only the first. */
static int open_columns(column *columns, const settings *s, cache *store)
{
  trbvh_cl_info infos[COLUMNS];
  uint32_t found = trbvh_cl_devices(infos, COLUMNS);
  int count = 0;
  snprintf(columns[count].title, sizeof columns->title, "C, 1 thread");
  columns[count++].threads = 1;
  if (s->threads > 1) {
    snprintf(columns[count].title, sizeof columns->title, "C, %u threads", s->threads);
    columns[count++].threads = s->threads;
  }
  if (!found) {
    trbvh_stats stats;
    trbvh_cl_close(trbvh_cl_open(NULL, &stats));
    printf("no OpenCL, only C runs: %s\n", stats.message);
  }
  for (uint32_t i = 0; i < found && i < COLUMNS; i++) {
    const trbvh_cl_info *info = infos + i;
    trbvh_cl_desc desc = {.name = info->name};
    trbvh_stats stats = {0};
    int known = 0;
    printf("device %u: %s\n          %s, driver %s; %s, %.1f GiB, %u compute units\n", i + 1, info->name,
           info->platform, info->version, info->is_gpu ? "GPU" : "CPU",
           (double)info->memory_bytes / (1 << 30), info->compute_units);
    for (uint32_t k = 0; k < i; k++) known |= !strcmp(infos[k].name, info->name);
    if (known || count == COLUMNS) {
      printf("          left out: %s\n", known ? "one of that name runs already" : "there are too many");
      continue;
    }
    if (store->folder) {
      desc.cache_load = cache_load;
      desc.cache_save = cache_save;
      desc.user = store;
    }
    column *c = columns + count;
    c->device = trbvh_cl_open(&desc, &stats);
    c->threads = s->threads;           /* for what falls back to C */
    snprintf(c->title, sizeof c->title, "device %u", i + 1);
    if (c->device) count++;
    else printf("          left out: %s\n", stats.message);
  }
  return count;
}

// >>measuring -----------------------------------------------------------------------------------------------
static int trees_equal(const trbvh *a, const trbvh *b)
{
  return a->node_count == b->node_count && a->ref_count == b->ref_count &&
         (!a->node_count ||
          (!memcmp(a->nodes, b->nodes, a->node_count * sizeof *a->nodes) &&
           !memcmp(a->prims, b->prims, a->ref_count * sizeof *a->prims) &&
           !memcmp(a->triangles, b->triangles, a->ref_count * sizeof *a->triangles)));
}
/* The median of some builds; the first one is told apart, since on a device it compiles kernels. */
static void measure_builds(column *c, trbvh *bvh, const trbvh_geometry *geometry, trbvh_quality quality)
{
  trbvh_stats stats;
  trbvh_options options = {.quality = quality, .device = c->device, .stats = &stats};
  double ms[RUNS], sum = 0;
  int runs = 0;
  options.jobs.width = c->threads;
  ex_check(trbvh_build(bvh, geometry, &options), c->title, &stats);
  c->ms_first = stats.ms_total;
  while (runs < RUNS && (runs == 0 || sum < 1000)) {
    ex_check(trbvh_build(bvh, geometry, &options), c->title, &stats);
    sum += ms[runs++] = stats.ms_total;
  }
  c->ms = ex_median(ms, runs);
  c->sah = stats.sah_cost;
  c->on_device = stats.on_device;
  if (*stats.message) printf("%s: %s\n", c->title, stats.message);   /* why C had to build for a device */
}
/* The median of some batches of rays. Each sends a device the tree and the rays, and fetches the hits, all of
 * which 04_own_kernel.c leaves there. */
static void measure_rays(column *c, const trbvh *bvh, const ex_ray_set *sets, trbvh_hit *hits[EX_KINDS])
{
  trbvh_stats stats = {0};
  trbvh_options options = {.flags = TRBVH_NO_FALLBACK, .device = c->device, .stats = &stats};
  uint8_t *occluded = (uint8_t *)ex_allocate(sets[EX_AMBIENT].count, 1);
  options.jobs.width = c->threads;
  for (int kind = 0; kind < EX_KINDS; kind++) {
    const ex_ray_set *set = sets + kind;
    double ms[RUNS], sum = 0;
    trbvh_result result = TRBVH_OK;
    int runs = 0;
    for (int i = c->device ? -1 : 0; i < RUNS && !result && (runs == 0 || sum < 400); i++) {
      double start = ex_now_ms();      /* run -1 compiles */
      result = kind == EX_AMBIENT ? trbvh_occluded_n(bvh, set->rays, occluded, set->count, &options)
                                  : trbvh_intersect_n(bvh, set->rays, hits[kind], set->count, &options);
      if (i >= 0) sum += ms[runs++] = ex_now_ms() - start;
    }
    c->rate[kind] = result ? 0 : (double)set->count / ex_median(ms, runs) / 1e3;
    if (result) printf("%s, rays: %s: %s\n", c->title, trbvh_result_text(result), stats.message);
  }
  free(occluded);
}
/* Of all columns, against the first one. */
static void measure_preset(column *columns, int count, const ex_scene *scene, const settings *s,
                           trbvh_quality quality)
{
  trbvh_geometry geometry = ex_mesh_geometry(&scene->mesh);
  trbvh trees[2] = {{0}, {0}};
  ex_ray_set sets[EX_KINDS];
  trbvh_hit *hits[2][EX_KINDS];
  for (int i = 0; i < count; i++) {
    column *c = columns + i;
    int which = i > 0;
    measure_builds(c, &trees[which], &geometry, quality);
    if (i == 0) {
      ex_make_rays(scene, s->width, s->height, &trees[0], NULL, sets);
      for (int k = 0; k < 2 * EX_KINDS; k++) {
        size_t rays = sets[k % EX_KINDS].count;
        hits[k / EX_KINDS][k % EX_KINDS] = (trbvh_hit *)ex_allocate(rays, sizeof(trbvh_hit));
      }
    }
    measure_rays(c, &trees[which], sets, hits[which]);
    c->same_tree = trees_equal(&trees[which], &trees[0]);
    c->other_hits = 0;
    for (int kind = 0; kind < EX_KINDS; kind++) {
      for (size_t k = 0; k < sets[kind].count && kind != EX_AMBIENT && c->rate[kind] > 0; k++) {
        c->other_hits += hits[0][kind][k].prim != hits[which][kind][k].prim;
      }
    }
  }
  for (int kind = 0; kind < EX_KINDS; kind++) {
    free(sets[kind].rays);
    free(hits[0][kind]);
    free(hits[1][kind]);
  }
  trbvh_free(&trees[0]);
  trbvh_free(&trees[1]);
}
static void print_preset(const column *columns, int count, const char *name, uint32_t triangles)
{
  static const char *const labels[] = {
    "  build, ms", "  million triangles/s", "  SAH cost", "  million rays/s: primary",
    "    ambient occlusion", "    diffuse", "  rays with other hits", "  first build, ms"
  };
  static const char decimals[] = "12222201";
  printf("%-26s", name);
  for (int i = 0; i < count; i++) printf("%*s", WIDTH, columns[i].title);
  for (size_t row = 0; row < sizeof labels / sizeof *labels; row++) {
    printf("\n%-26s", labels[row]);
    for (int i = 0; i < count; i++) {
      const column *c = columns + i;
      const double values[] = {
        c->ms, triangles / c->ms / 1e3, c->sah, c->rate[EX_PRIMARY], c->rate[EX_AMBIENT], c->rate[EX_DIFFUSE],
        (double)c->other_hits, c->ms_first
      };
      printf("%*.*f", WIDTH, decimals[row] - '0', values[row]);
    }
  }
  printf("\n%-26s", "  built by");
  for (int i = 0; i < count; i++) printf("%*s", WIDTH, columns[i].on_device ? "device" : "C");
  printf("\n%-26s", "  tree, bit for bit");
  for (int i = 0; i < count; i++) printf("%*s", WIDTH, columns[i].same_tree ? "the same" : "ANOTHER");
  printf("\n");
}

int main(int argc, char **argv)
{
  static const char *const names[] = {"fast", "medium", "high"};
  settings s = {NULL, NULL, ex_processors(), 640, 400};
  ex_arguments(argc, argv, usage, options_known, OPTIONS, set_option, &s);
  ex_scene scene = ex_scene_load(s.mesh, (float)s.width / (float)s.height);
  column columns[COLUMNS];
  cache store = {s.cache, 0, 0};
  int same = 1;
  memset(columns, 0, sizeof columns);
  int count = open_columns(columns, &s, &store);
  printf("%s: %u triangles\n", s.mesh ? s.mesh : "built-in scene", scene.mesh.triangle_count);
  for (int i = 0; i < 3; i++) {
    measure_preset(columns, count, &scene, &s, (trbvh_quality)(TRBVH_QUALITY_FAST + i));
    print_preset(columns, count, names[i], scene.mesh.triangle_count);
    for (int k = 0; k < count; k++) same &= columns[k].same_tree;
  }
  printf("first build: devices compile their kernels in it; other hits: devices test triangles in float\n");
  printf("%s\n", same ? "all trees are equal, bit for bit" : "trees DIFFER: please report it");
  if (s.cache) printf("%s: %d programs loaded, %d saved\n", s.cache, store.loaded, store.saved);
  for (int i = 0; i < count; i++) trbvh_cl_close(columns[i].device);
  ex_mesh_free(&scene.mesh);
  return !same;
}
