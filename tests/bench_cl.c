/* Benchmark of the OpenCL backend, and a check of what it makes: gpu.sh builds and runs it.
 *
 *     bench_cl [--small] [--csv FILE] [mesh.ply ...]      the tables go to stdout, progress to stderr
 *     bench_cl --probe                                    only says which device it would be
 *
 * A build is timed with the mesh in device memory, by the wall clock up to a finish, in a queue without profiling: the
 * median of seven, after two that are not counted. Kernels' times are those of the fastest of three more, with
 * profiling. Neither has compilation nor transfers in it. The tree is then compared with the scalar one, bit for bit,
 * and traces rays that are in device memory too.
 * Exit status: 0 if all that was run is right; 2 for errors of use. */
#define _POSIX_C_SOURCE 200112L
#define _DARWIN_C_SOURCE
#ifndef TRBVH_THREADS
  #define TRBVH_THREADS
#endif
#define TRB_CL_PROFILE
#define TRBVH_IMPLEMENTATION
#include "../trbvh_cl.h"
#include "../examples/common.h"

#define PRESETS      3                 /* BEST is for trees that are made once */
#define WARM_UPS     2
#define RUNS         7
#define PROFILES     3
#define LAUNCHES_MAX 16384             /* of one build */
#define KERNELS_MAX  64                /* different ones */
#define RAYS_WIDE    (small_run ? 256u : 2048u)
#define RAYS_HIGH    (RAYS_WIDE / 2)
#define RAYS         ((size_t)RAYS_WIDE * RAYS_HIGH)
#define OTHER_MAX    0.01              /* share of rays with another triangle than in C, more is an error */
static const char *const presets[PRESETS] = {"FAST", "MEDIUM", "HIGH"}, *const words[] = {"left out", "PASS", "FAIL"};
static const double targets[PRESETS] = {5, 18, 0};       /* ms for ten million triangles on a GPU of the H200's class */

typedef struct kernel_time { const char *name; unsigned launches; double ms, bytes; } kernel_time;
typedef struct profile { kernel_time kernels[KERNELS_MAX]; unsigned count, launches; double ms; } profile;
typedef struct rays { trbvh_ray *rays; trb_cl_mem buffer; } rays;      /* RAYS of them */
typedef enum outcome { LEFT_OUT, RIGHT, WRONG } outcome;
typedef struct measurement {           /* of one preset; times and rates below 0: not known */
  char     scene[21], note[200];
  uint32_t triangles;
  int      preset;
  outcome  tree, trace;
  double   ms, moves_ms, scalar_ms, bytes, target, mrays[2], scalar_mrays[2], other[2];
  profile  profile;
} measurement;

static trb_cl *cl;
static trb_cl_queue profiling_queue, plain_queue;
static int small_run;

static void *need(size_t size)         /* zeros */
{
  void *p = calloc(size, 1);
  if (!p) { fprintf(stderr, "out of memory: %u MiB\n", (unsigned)(size >> 20)); exit(2); }
  return p;
}
static int same(const void *a, const void *b, size_t size) { return size == 0 || (a && b && !memcmp(a, b, size)); }
static int by_size(const void *a, const void *b)
{
  const double x = *(const double *)a, y = *(const double *)b;
  return (x > y) - (x < y);
}
static double median(double values[RUNS])
{
  qsort(values, RUNS, sizeof *values, by_size);
  return values[RUNS / 2];
}
static trbvh_options options_of(int preset, trbvh_stats *stats)
{
  trbvh_options o = {0};
  o.quality = (trbvh_quality)(TRBVH_QUALITY_FAST + preset);
  o.stats = stats;
  o.jobs.width = ex_processors();
  return o;
}

// >>events ----------------------------------------------------------------------------------------------------------
static struct { const char *kernel; trb_cl_event event; } launches[LAUNCHES_MAX];
static unsigned launch_count;
static int32_t (TRB_CL_CALL *event_info)(trb_cl_event, uint32_t, size_t, void *, size_t *);
static int32_t (TRB_CL_CALL *release_event)(trb_cl_event);

static void on_launch(void *user, const char *kernel, trb_cl_event event)
{
  (void)user;
  if (launch_count == LAUNCHES_MAX) { release_event(event); return; }
  launches[launch_count].kernel = kernel;
  launches[launch_count++].event = event;
}
/* A function that is not in the backend's table, found as those are. */
static trb_cl_function find_function(const char *name)
{
#ifdef _WIN32
  return trb_cl_symbol(trb_cl_library(), name);
#else
  trb_cl_function function = trb_cl_symbol(NULL, name);
  return function ? function : trb_cl_symbol(trb_cl_library(), name);
#endif
}
/* Takes the launches since the last call, which are complete. Some drivers give times that mean nothing: a nanosecond
 * each, or more in all than went by; all are -1 then. */
static void collect(profile *p, double wall_ms)
{
  int known = 1;
  unsigned i, k;
  memset(p, 0, sizeof *p);
  p->launches = launch_count;
  for (i = 0; i < launch_count; ++i) {
    const char *name = launches[i].kernel + (strncmp(launches[i].kernel, "trb_k_", 6) ? 0 : 6);
    uint64_t start = 0, end = 0;
    known &= !event_info(launches[i].event, 0x1282, sizeof start, &start, NULL);
    known &= !event_info(launches[i].event, 0x1283, sizeof end, &end, NULL) && end >= start;
    release_event(launches[i].event);
    for (k = 0; k < p->count && strcmp(p->kernels[k].name, name); ++k) {}
    if (k == KERNELS_MAX) continue;
    if (k == p->count) p->kernels[p->count++].name = name;
    p->kernels[k].launches++;
    p->kernels[k].ms += 1e-6 * (double)(end - start);
    p->ms += 1e-6 * (double)(end - start);
  }
  launch_count = 0;
  if (!known || p->ms < 1e-4 * p->launches || p->ms > 1.5 * wall_ms)
    for (p->ms = -1, k = 0; k < p->count; ++k) p->kernels[k].ms = -1;
}

// >>bytes -----------------------------------------------------------------------------------------------------------
/* What a kernel must read and write at least, in bytes, in all its launches of a build (each: in every one of them):
 * for each primitive, reference, leaf of the result (which has as many inner nodes, less one) and treelet root; and how
 * many times the mesh. Every array counts once, in sectors of 32 bytes where a kernel reads a field of a node; what
 * neighbours read again is for the caches. Kernels that hardly move anything, or only where there are gaps between
 * references, or as far as searches lead them, are not in it, so that no count is above what really moves. */
typedef struct traffic { const char *kernel; double prim, ref, leaf, root, mesh; int each; } traffic;
static const traffic traffics[] = {
  /*                     prim  ref leaf root mesh each */
  {"read",                 32,   0,   0,   0, 1, 0},    /* boxes written */
  {"priorities",           36,   0,   0,   0, 1, 0},    /* boxes; priorities written */
  {"sum_splits",            4,   0,   0,   0, 0, 1},
  {"count_slots",          36,   0,   0,   0, 0, 0},
  {"split",                36,  32,   0,   0, 0, 0},    /* boxes, priorities; references written */
  {"keys",                  0,  40,   0,   0, 0, 1},    /* references; keys written */
  {"count_digits",          0,   8,   0,   0, 0, 1},
  {"sum_tiles",             0, 0.5,   0,   0, 0, 1},    /* 256 counters of 4 bytes for 2,048 keys ... */
  {"scan_tiles",            0,   1,   0,   0, 0, 1},
  {"scatter_keys",          0,16.5,   0,   0, 0, 1},    /* keys, counters; keys written */
  {"build_chunks",          0, 120,   0,   0, 0, 0},    /* keys, references, waits twice; 2 nodes written */
  {"build_blocks",          0, 104,   0,   0, 0, 0},    /* keys, references; 2 nodes written */
  {"list_level",            0,   0,   0, 104, 0, 0},    /* list, node, 2 children; list written */
  {"restructure_level",     0,   0,   0, 420, 0, 0},    /* list, node, 6 pairs; nothing written where nothing improves */
  {"restructure",           0,   0,   0, 420, 0, 0},
  {"list_inner",            0,   0, 112,   0, 0, 0},    /* list, reference, node, 2 children; list, reference written */
  {"count_inner",           0,   0, 148,   0, 0, 0},    /* list, node, 2 children, sums; sums written */
  {"count_tasks",           0,   0,  64,   0, 0, 0},    /* 2 nodes */
  {"emit_level",            0,  68, 172,   0, 0, 0},    /* as these, and leaves' subtrees; 2 nodes, places, primitives written */
  {"emit_tasks",            0,  68,  64,   0, 0, 0},    /* 2 nodes, leaves' subtrees; 2 nodes, primitives written */
  {"triangles",             0,  52,   0,   0, 1, 0}     /* primitives; triangles written */
};

/* How much that is, in all. Of n references, at least n / (gamma - 1), less one, are roots of a round's treelets: that
 * many subtrees of less than gamma are needed to hold them all. */
static double count_bytes(profile *p, const ex_mesh *mesh, const trbvh_cl_tree *tree, int rounds)
{
  const double mesh_bytes = 12.0 * mesh->triangle_count + 12.0 * TRB_MIN((double)mesh->position_count, 3.0 * mesh->triangle_count);
  const double refs = tree->ref_count, leaves = 0.5 * tree->node_count;
  double roots = 0, sum = 0;
  unsigned i, k;
  int round;
  for (round = 0; round < rounds; ++round) roots += TRB_MAX(refs / ((TRB_TREELET << round) - 1) - 1, 0);
  for (i = 0; i < p->count; ++i)
    for (k = 0; k < sizeof traffics / sizeof traffics[0]; ++k) {
      const traffic *t = &traffics[k];
      kernel_time *kernel = &p->kernels[i];
      if (strcmp(t->kernel, kernel->name)) continue;
      kernel->bytes = t->prim * mesh->triangle_count + t->ref * refs + t->leaf * leaves + t->root * roots + t->mesh * mesh_bytes;
      if (t->each) kernel->bytes *= kernel->launches;
      sum += kernel->bytes;
    }
  return sum;
}

// >>scene -----------------------------------------------------------------------------------------------------------
/* Hills, and on them rocks in heaps, finely divided each, and thin wires in all directions: six, three and one part in
 * ten of the triangles. */
#define ROCK_SPOKES 24u
#define ROCK_RINGS  16u
typedef struct rock { ex_vec center; float radius; } rock;
static float hill(float x, float z) { return 9 * ex_fractal_noise(ex_v(0.045f * x, 0.5f, 0.045f * z)); }
static ex_vec hill_point(const void *nothing, float u, float v)
{
  (void)nothing;
  return ex_v(100 * u - 50, hill(100 * u - 50, 100 * v - 50), 100 * v - 50);
}
static ex_vec rock_point(const void *shape, float u, float v)
{
  const rock *r = (const rock *)shape;
  const ex_vec out = ex_v(sinf(EX_PI * v) * cosf(2 * EX_PI * u), cosf(EX_PI * v), sinf(EX_PI * v) * sinf(2 * EX_PI * u));
  return ex_mad(r->center, out, r->radius * (1 + 0.3f * ex_noise(ex_mad(r->center, out, 2))));
}
static int make_scene(ex_mesh *mesh, uint32_t count)
{
  const uint32_t side = (uint32_t)sqrt(0.3 * count), rocks = (uint32_t)(0.3 * count) / (2 * ROCK_SPOKES * ROCK_RINGS);
  const float scale = (float)pow(200000.0 / count, 1.0 / 3);
  uint32_t seed = 7, i;
  ex_builder b = {0};
  ex_add_surface(&b, hill_point, NULL, side, side, 0);
  for (i = 0; i < rocks; ++i) {
    uint32_t heap = ex_random_bits(&seed) % 40 + 1000;
    float x = ex_random_in(&heap, -45, 45), z = ex_random_in(&heap, -45, 45);
    rock r;
    x += ex_random_in(&seed, -4, 4);
    z += ex_random_in(&seed, -4, 4);
    r.radius = scale * 0.2f / (0.04f + ex_random(&seed));
    r.center = ex_v(x, hill(x, z) + 0.5f * r.radius, z);
    ex_add_surface(&b, rock_point, &r, ROCK_SPOKES, ROCK_RINGS, 1);
  }
  while (b.mesh.triangle_count < count && !b.failed) {
    const float x = ex_random_in(&seed, -50, 50), y = ex_random_in(&seed, -5, 18), z = ex_random_in(&seed, -50, 50);
    const float length = scale * 0.4f / (0.04f + ex_random(&seed));
    const float dx = ex_random_in(&seed, -1, 1), dz = ex_random_in(&seed, -1, 1);
    const ex_vec from = ex_v(x, y, z), to = ex_mad(from, ex_normalize(ex_v(dx, 0.5f, dz)), length);
    const uint32_t first = ex_add_vertex(&b, from);
    ex_add_vertex(&b, to);
    ex_add_vertex(&b, ex_mad(to, ex_v(dz, 0, -dx), 0.02f * scale));
    ex_add_triangle(&b, first, first + 1, first + 2);
  }
  *mesh = b.mesh;
  if (b.failed) ex_mesh_free(mesh);
  return !b.failed;
}

// >>rays ------------------------------------------------------------------------------------------------------------
static void send_rays(rays *r)
{
  r->buffer = trb_cl_buffer(cl, TRB_CL_MEM_READ_ONLY, RAYS * sizeof(trbvh_ray), NULL);
  trb_cl_write(cl, r->buffer, r->rays, RAYS * sizeof(trbvh_ray));
}
static void make_primary(rays *r, const ex_mesh *mesh, ex_vec low, ex_vec high)
{
  ex_camera camera = ex_camera_fit(mesh, ex_guess_up(low, high), 2);
  size_t i;
  camera.eye = ex_mix(camera.eye, ex_mix(low, high, 0.5f), 0.4f);    /* so near that most rays hit */
  r->rays = (trbvh_ray *)need(RAYS * sizeof(trbvh_ray));
  for (i = 0; i < RAYS; ++i) {
    const float x = (float)(i % RAYS_WIDE) + 0.5f, y = (float)(i / RAYS_WIDE) + 0.5f;
    r->rays[i] = ex_camera_ray(&camera, x / (float)RAYS_WIDE, y / (float)RAYS_HIGH);
  }
  send_rays(r);
}
/* From where the primary rays arrive, or else from anywhere on the mesh, in random directions off the surface, `off`
 * above it. */
static void make_diffuse(rays *r, const ex_mesh *mesh, const rays *primary, const trbvh_hit *hits, float off)
{
  uint32_t seed = 1;
  size_t i;
  r->rays = (trbvh_ray *)need(RAYS * sizeof(trbvh_ray));
  for (i = 0; i < RAYS; ++i) {
    const float a = ex_random(&seed), b = ex_random(&seed);
    trbvh_hit at = hits[i];
    ex_vec normal, p;
    if (at.prim == TRBVH_NONE) { at.prim = ex_random_bits(&seed) % mesh->triangle_count; at.u = at.v = 0.25f; }
    p = ex_mesh_point(mesh, &at, &normal);
    if (!(ex_length(normal) > 0)) normal = ex_v(0, 1, 0);
    if (ex_dot(normal, ex_load(primary->rays[i].dir)) > 0) normal = ex_scale(normal, -1);
    r->rays[i] = ex_ray(ex_mad(p, normal, off), ex_cosine_direction(normal, a, b), 0);
  }
  send_rays(r);
}

/* A failure of the device; too little memory is none, and only leaves the case out. */
static outcome device_failed(measurement *m, const char *doing, trbvh_result result, const char *message)
{
  snprintf(m->note, sizeof m->note, "%s%.180s", doing, message[0] ? message : trbvh_result_text(result));
  return result == TRBVH_OUT_OF_DEVICE_MEMORY ? LEFT_OUT : WRONG;
}
/* Traces one kind of rays on both sides. want gets the scalar code's hits. */
static outcome trace(measurement *m, int kind, const rays *r, const trbvh *scalar, const trbvh_cl_tree *tree, trbvh_hit *want)
{
  const trbvh_options o = options_of(0, NULL);
  trb_cl_mem buffer = trb_cl_buffer(cl, TRB_CL_MEM_READ_WRITE, RAYS * sizeof(trbvh_hit), NULL);
  trbvh_hit *hits = (trbvh_hit *)need(RAYS * sizeof(trbvh_hit));
  trbvh_result result = trb_cl_result(cl, NULL);
  double times[RUNS], start;
  size_t i, other = 0;
  int run;
  for (run = -1; run < RUNS && !result; ++run) {
    start = trb_ms();
    result = trbvh_cl_intersect(&cl->hooks, tree, r->buffer, buffer, RAYS, NULL);
    trb_cl_finish(cl);
    if (run >= 0) times[run] = trb_ms() - start;
  }
  trb_cl_read(cl, buffer, hits, RAYS * sizeof(trbvh_hit));
  trb_cl_release(cl, &buffer);
  if (!result) result = trb_cl_result(cl, NULL);
  start = trb_ms();
  trbvh_intersect_n(scalar, r->rays, want, RAYS, &o);
  m->scalar_mrays[kind] = 1e-3 * (double)RAYS / (trb_ms() - start);
  for (i = 0; i < RAYS && !result; ++i) other += want[i].prim != hits[i].prim;
  free(hits);
  if (result) return device_failed(m, "rays: ", result, cl->message);
  m->mrays[kind] = 1e-3 * (double)RAYS / median(times);
  m->other[kind] = (double)other / (double)RAYS;
  return m->other[kind] <= OTHER_MAX ? RIGHT : WRONG;
}

// >>builds ----------------------------------------------------------------------------------------------------------
static int build_scalar(measurement *m, const ex_mesh *mesh, trbvh *tree)     /* the better of two */
{
  trbvh_geometry g = ex_mesh_geometry(mesh);
  trbvh_stats stats;
  trbvh_options o = options_of(m->preset, &stats);
  int run;
  for (run = 0; run < 2; ++run) {
    if (trbvh_build(tree, &g, &o)) {
      snprintf(m->note, sizeof m->note, "in C: %.190s", stats.message);
      return 0;
    }
    if (run == 0 || stats.ms_total < m->scalar_ms) m->scalar_ms = stats.ms_total;
  }
  return 1;
}
/* Warm-ups, timed builds, profiled ones. Only warm-ups have stats, which say what goes wrong, and how long moves take:
 * with them, a build waits between its stages. */
static outcome build_on_device(measurement *m, const ex_mesh *mesh, const trbvh_cl_geometry *g, trbvh_cl_tree *tree)
{
  double times[RUNS];
  profile p;
  trbvh_result result = TRBVH_OK;
  trbvh_stats stats = {0};
  int run;
  for (run = -WARM_UPS; run < RUNS + PROFILES && !result; ++run) {
    const trbvh_options o = options_of(m->preset, run < 0 ? &stats : NULL);
    const int profiled = run >= RUNS && event_info && release_event;
    double ms = trb_ms();
    cl->queue = profiled ? profiling_queue : plain_queue;
    cl->on_launch = profiled ? on_launch : NULL;
    result = trbvh_cl_build(&cl->hooks, tree, g, &o, NULL);
    trb_cl_finish(cl);
    if (!result) result = trb_cl_result(cl, &stats);
    ms = trb_ms() - ms;
    if (run >= RUNS) collect(&p, ms);
    else if (run >= 0) times[run] = ms;
    if (run == RUNS || (run > RUNS && p.ms < m->profile.ms)) m->profile = p;
  }
  cl->queue = plain_queue;
  cl->on_launch = NULL;
  if (result) return device_failed(m, "", result, stats.message[0] ? stats.message : cl->message);
  m->ms = median(times);
  m->moves_ms = stats.ms_moves;
  m->bytes = count_bytes(&m->profile, mesh, tree, m->preset == 0 ? 0 : 3);
  return RIGHT;
}
static outcome compare(measurement *m, const trbvh *want, const trbvh_cl_tree *tree)
{
  const char *wrong = NULL;
  trbvh got = {0};
  if (trbvh_cl_download(&cl->hooks, tree, &got, NULL)) wrong = "the download fails";
  else if (got.node_count != want->node_count) wrong = "another number of nodes";
  else if (got.ref_count != want->ref_count || got.prim_count != want->prim_count) wrong = "another number of references";
  else if (!same(got.nodes, want->nodes, sizeof(trbvh_node) * got.node_count)) wrong = "other nodes";
  else if (!same(got.prims, want->prims, sizeof(uint32_t) * got.ref_count)) wrong = "other primitives";
  else if (!same(got.triangles, want->triangles, sizeof(trbvh_triangle) * got.ref_count)) wrong = "other triangles";
  trbvh_free(&got);
  if (wrong) snprintf(m->note, sizeof m->note, "not the tree of the C code: %s", wrong);
  return wrong ? WRONG : RIGHT;
}

// >>cases -----------------------------------------------------------------------------------------------------------
static void run_preset(measurement *m, const ex_mesh *mesh, const trbvh_cl_geometry *g, const rays *primary,
    rays *diffuse, float off)
{
  trbvh scalar = {0};
  trbvh_cl_tree tree = {0};
  trbvh_hit *hits = NULL;
  if (build_scalar(m, mesh, &scalar)) m->tree = build_on_device(m, mesh, g, &tree);
  if (m->tree == RIGHT) m->tree = compare(m, &scalar, &tree);
  if (m->tree == RIGHT && tree.node_count) {
    hits = (trbvh_hit *)need(RAYS * sizeof *hits);
    m->trace = trace(m, 0, primary, &scalar, &tree, hits);
    if (!diffuse->rays) make_diffuse(diffuse, mesh, primary, hits, off);
    if (m->trace == RIGHT) m->trace = trace(m, 1, diffuse, &scalar, &tree, hits);
    free(hits);
  }
  trbvh_cl_free(&cl->hooks, &tree);
  trbvh_free(&scalar);
}
/* All presets over the mesh of a file, or over one of so many triangles; returns how many measurements that made. */
static int run_mesh(measurement *m, const char *path, uint32_t count, int has_target)
{
  const char *name = !path ? "hills" : strrchr(path, '/') ? strrchr(path, '/') + 1 : path;
  char error[256] = "hills: not enough memory";
  const double room = (double)cl->info.memory_bytes;
  rays primary = {NULL, NULL}, diffuse = {NULL, NULL};
  trbvh_cl_geometry g = {0};
  trbvh_stats stats;
  trbvh_result ready;
  ex_vec low, high;
  ex_mesh mesh = {0};
  int preset;
  if (path ? !ex_mesh_read(path, &mesh, error, sizeof error) : !make_scene(&mesh, count)) {
    fprintf(stderr, "%s\n", error);
    return 0;
  }
  g.position_count = mesh.position_count;
  g.index_size = 4;
  g.count = mesh.triangle_count;
  trb_cl_begin(cl);
  g.positions = trb_cl_buffer(cl, TRB_CL_MEM_READ_ONLY, 12 * (size_t)mesh.position_count, NULL);
  g.indices = trb_cl_buffer(cl, TRB_CL_MEM_READ_ONLY, 12 * (size_t)mesh.triangle_count, NULL);
  trb_cl_write(cl, g.positions, mesh.positions, 12 * (size_t)mesh.position_count);
  trb_cl_write(cl, g.indices, mesh.indices, 12 * (size_t)mesh.triangle_count);
  ex_mesh_bounds(&mesh, &low, &high);
  make_primary(&primary, &mesh, low, high);
  ready = trb_cl_result(cl, &stats);
  for (preset = 0; preset < PRESETS; ++preset, ++m) {
    /* the mesh; scratch memory of 152 bytes and some 80 of a result for each reference */
    const double wanted = 12.0 * mesh.position_count + (12 + (preset == 2 ? 1.3 : 1) * (152 + 80)) * mesh.triangle_count;
    m->ms = m->moves_ms = m->scalar_ms = m->profile.ms = -1;
    m->mrays[0] = m->mrays[1] = m->scalar_mrays[0] = m->scalar_mrays[1] = m->other[0] = m->other[1] = -1;
    snprintf(m->scene, sizeof m->scene, "%.20s", name);
    m->triangles = mesh.triangle_count;
    m->preset = preset;
    m->target = has_target ? targets[preset] : 0;
    fprintf(stderr, "%s, %u triangles, %s: ", m->scene, m->triangles, presets[preset]);
    if (ready) m->tree = device_failed(m, "mesh and rays: ", ready, stats.message);
    else if (room > 0 && wanted > room)
      snprintf(m->note, sizeof m->note, "needs some %.1f GB on the device, which has %.1f", 1e-9 * wanted, 1e-9 * room);
    else run_preset(m, &mesh, &g, &primary, &diffuse, 1e-5f * ex_length(ex_sub(high, low)));
    if (m->ms > 0) fprintf(stderr, "%.2f ms, ", m->ms);
    fprintf(stderr, "%s%s%s\n", words[m->tree == RIGHT ? m->trace : m->tree], m->note[0] ? ": " : "", m->note);
  }
  trb_cl_release(cl, &primary.buffer);
  trb_cl_release(cl, &diffuse.buffer);
  trb_cl_release(cl, &g.positions);
  trb_cl_release(cl, &g.indices);
  free(primary.rays); free(diffuse.rays);
  ex_mesh_free(&mesh);
  return PRESETS;
}

// >>tables ----------------------------------------------------------------------------------------------------------
static const char *number(double value, int digits)      /* "-" for what is not known; the last eight results are valid */
{
  static char texts[8][32];
  static unsigned at;
  char *text = texts[at++ % 8];
  snprintf(text, 32, value >= 0 ? "%.*f" : "-", digits, value);
  return text;
}
static const char *rate(double value) { return number(value, value < 10); }
static double divide(double a, double b) { return a > 0 && b > 0 ? a / b : -1; }
static double gb_per_s(const measurement *m) { return divide(1e-6 * m->bytes, m->profile.ms > 0 ? m->profile.ms : m->ms); }

static void print_builds(const measurement *m, int count)
{
  printf("\n%-20s %10s  %-6s %10s %9s %10s %8s %7s %10s %7s  %-10s %s\n", "builds", "triangles", "preset", "device ms",
      "moves ms", "kernels ms", "Mtri/s", "GB/s", "C ms", "faster", "target ms", "identity");
  for (; count--; ++m) {
    char target[24] = "";
    if (m->target > 0) snprintf(target, sizeof target, "%.0f %s", m->target, m->ms <= 0 ? "" : m->ms <= m->target ? "met" : "missed");
    printf("%-20s %10u  %-6s %10s %9s %10s %8s %7s %10s %7s  %-10s %s\n", m->scene, m->triangles, presets[m->preset],
        number(m->ms, 2), number(m->moves_ms, 2), number(m->profile.ms, 2), number(divide(1e-3 * m->triangles, m->ms), 1), rate(gb_per_s(m)), number(m->scalar_ms, 1),
        number(divide(m->scalar_ms, m->ms), 1), target, words[m->tree]);
    if (m->note[0]) printf("    %.110s\n", m->note);
  }
}
static void print_rays(const measurement *m, int count)
{
  printf("\n%-38s | %-33s | %s\n", "rays, million a second", "primary: device     C  other prim", "diffuse: device     C  other prim");
  for (; count--; ++m)
    printf("%-20s %10u  %-6s| %15s %5s %9s %% | %15s %5s %9s %%  %s\n", m->scene, m->triangles, presets[m->preset],
        number(m->mrays[0], 1), number(m->scalar_mrays[0], 1), number(100 * m->other[0], 4), number(m->mrays[1], 1),
        number(m->scalar_mrays[1], 1), number(100 * m->other[1], 4), words[m->trace]);
}
/* The kernels of one scene's presets, in the order in which they first run. */
static void print_kernels(const measurement *m)
{
  const char *names[KERNELS_MAX * PRESETS + 1];
  unsigned count = 0, i, n;
  int k;
  for (k = PRESETS; k-- > 0;)                            /* HIGH has all that the others have */
    for (i = 0; i < m[k].profile.count; ++i) {
      for (n = 0; n < count && strcmp(names[n], m[k].profile.kernels[i].name); ++n) {}
      if (n == count) names[count++] = m[k].profile.kernels[i].name;
    }
  if (count == 0) return;
  printf("\n%-20s %10u", m->scene, m->triangles);
  for (k = 0; k < PRESETS; ++k) printf(" | %-6s      ms    GB/s", presets[k]);
  for (n = 0; n <= count; ++n) {
    printf("\n  %-29s", n < count ? names[n] : "all kernels");
    for (k = 0; k < PRESETS; ++k) {
      const profile *p = &m[k].profile;
      kernel_time line = {"", p->launches, p->ms, m[k].bytes};
      for (i = 0; n < count && i < p->count && strcmp(names[n], p->kernels[i].name); ++i) {}
      if (n < count && i < p->count) line = p->kernels[i];
      if (n < count && i == p->count) printf(" | %22s", "");
      else printf(" | %5ux %7s %7s", line.launches, number(line.ms, 3), rate(divide(1e-6 * line.bytes, line.ms)));
    }
  }
  printf("\n");
}
static void print_line(FILE *file, const measurement *m, const char *what, unsigned launched, double value, double bytes)
{
  if (value >= 0)
    fprintf(file, "\"%s\",\"%s\",%s,\"%s\",%u,%s,%s,%u,%.6g,%.0f\n", cl->info.name, cl->info.version, cl->cpu ? "cpu" : "gpu",
        m->scene, m->triangles, presets[m->preset], what, launched, value, bytes);
}
static int write_csv(const char *path, const measurement *m, int count)          /* appends */
{
  FILE *file = fopen(path, "a");
  unsigned i;
  if (!file) { fprintf(stderr, "%s: cannot be written\n", path); return 0; }
  fseek(file, 0, SEEK_END);
  if (ftell(file) == 0) fprintf(file, "device,driver,kernels,scene,triangles,preset,what,launches,value,bytes\n");
  for (; count--; ++m) {
    const struct { const char *what; double value; } values[] = {
      {"moves_ms", m->moves_ms}, {"scalar_ms", m->scalar_ms}, {"identical", m->tree == LEFT_OUT ? -1 : m->tree == RIGHT},
      {"primary_mrays_per_s", m->mrays[0]}, {"scalar_primary_mrays_per_s", m->scalar_mrays[0]}, {"primary_other_prim", m->other[0]},
      {"diffuse_mrays_per_s", m->mrays[1]}, {"scalar_diffuse_mrays_per_s", m->scalar_mrays[1]}, {"diffuse_other_prim", m->other[1]}
    };
    const kernel_time *kernel = m->profile.kernels;
    print_line(file, m, "build_ms", m->profile.launches, m->ms, m->bytes);
    print_line(file, m, "kernels_ms", m->profile.launches, m->profile.ms, m->bytes);
    for (i = 0; i < m->profile.count; ++i, ++kernel) print_line(file, m, kernel->name, kernel->launches, kernel->ms, kernel->bytes);
    for (i = 0; i < sizeof values / sizeof values[0]; ++i) print_line(file, m, values[i].what, 0, values[i].value, 0);
  }
  return fclose(file) == 0;
}

// >>main ------------------------------------------------------------------------------------------------------------
/* What a benchmark needs besides an open device; all kernels, compiled. */
static void prepare(void)
{
  const double start = trb_ms();
  trb_cl_function function = find_function("clGetEventProfilingInfo");
  int32_t error = 0;
  int i;
  memcpy(&event_info, &function, sizeof event_info);
  function = find_function("clReleaseEvent");
  memcpy(&release_event, &function, sizeof release_event);
  profiling_queue = cl->queue;
  plain_queue = cl->api.CreateCommandQueue(cl->context, cl->id, 0, &error);
  if (!plain_queue) plain_queue = profiling_queue;
  cl->queue = plain_queue;
  for (i = 0; i < TRB_CL_PROGRAM_COUNT; ++i) trb_cl_program_of(cl, i);
  fprintf(stderr, "%s, kernels for %s: %s in %.1f s\n", cl->info.name, cl->cpu ? "CPUs" : "GPUs",
      cl->error ? cl->message : "compiled, or found in the driver's cache,", 1e-3 * (trb_ms() - start));
}
/* 0 where all that was measured is right, and something was. */
static int run_all(char **files, int file_count, const char *csv)
{
  measurement *m = (measurement *)need(sizeof *m * PRESETS * ((size_t)file_count + 2));
  int i, count = 0, right = 0, wrong = 0;
  count += run_mesh(m + count, NULL, small_run ? 20000 : 1000000, 0);
  count += run_mesh(m + count, NULL, small_run ? 200000 : 10000000, !small_run);
  for (i = 0; i < file_count; ++i) {
    const int measured = run_mesh(m + count, files[i], 0, 0);
    wrong += measured == 0;
    count += measured;
  }
  printf("%s (%s), driver %s\n%u compute units, %.1f GB; kernels for %s; beside it scalar C with %u threads\n", cl->info.name,
      cl->info.platform, cl->info.version, cl->info.compute_units, 1e-9 * (double)cl->info.memory_bytes,
      cl->cpu ? "CPUs" : "GPUs", ex_processors());
  print_builds(m, count);
  print_rays(m, count);
  for (i = 0; i < count; i += PRESETS) print_kernels(m + i);
  printf("\ndevice ms: median of %d builds in device memory, wall clock; kernels ms: sum by profiling events, - where there are\n"
      "none. GB/s: bytes that a kernel must move at least, by its time; - where they hardly count. C ms: the better of two\n"
      "builds. Rays: %u of each kind, in device memory; other prim: hit another triangle than in C, at most %.0f %%.\n", RUNS,
      (unsigned)RAYS, 100 * OTHER_MAX);
  if (csv) wrong += !write_csv(csv, m, count);
  for (i = 0; i < count; ++i) {
    right += m[i].tree == RIGHT;
    wrong += m[i].tree == WRONG || m[i].trace == WRONG;
  }
  free(m);
  return wrong || !right;
}
int main(int argc, char **argv)
{
  trbvh_stats stats = {0};
  const char *csv = NULL;
  int i, probe = 0, files = 0, failed = 0;
  for (i = 1; i < argc; ++i)
    if (!strcmp(argv[i], "--small")) small_run = 1;
    else if (!strcmp(argv[i], "--probe")) probe = 1;
    else if (!strcmp(argv[i], "--csv") && i + 1 < argc) csv = argv[++i];
    else if (argv[i][0] == '-') { fprintf(stderr, "usage: bench_cl [--small] [--csv FILE] [mesh.ply ...]\n"); return 2; }
    else argv[1 + files++] = argv[i];
  cl = (trb_cl *)trbvh_cl_open(NULL, &stats);
  if (!cl) { printf("no OpenCL device: %s\n", stats.message); return 1; }
  if (probe) printf("%s %s\n", cl->cpu ? "cpu" : "gpu", cl->info.name);
  else {
    prepare();
    failed = run_all(argv + 1, files, csv);
    cl->queue = profiling_queue;
    if (plain_queue != profiling_queue) cl->api.ReleaseCommandQueue(plain_queue);
  }
  trbvh_cl_close(&cl->hooks);
  return failed;
}
