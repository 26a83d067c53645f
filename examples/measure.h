/* measure.h - what programs that measure share: which meshes, from files or made by formula, the time that is left,
 * threads, memory that is kept. Needs POSIX, or MinGW. Where something fails, the program ends.
 */
#ifndef EX_MEASURE_H
#define EX_MEASURE_H

#include "common.h"
#include <dirent.h>
#include <pthread.h>

// >>progress ------------------------------------------------------------------------------------------------
typedef struct ex_progress { double start, shown, done, total; } ex_progress;   /* ms; parts of the work, in any unit */

/* On a terminal a line that changes, else one for each `what`. part: of the work that comes next, done already */
static inline void ex_show_progress(ex_progress *p, const char *what, double part)
{
  double now = ex_now_ms(), done = (p->done + part) / p->total;
  int terminal = isatty(2);
  char left[32] = "";
  if (p->start <= 0) p->start = now;
  if (part > 0 && (!terminal || now - p->shown < 200)) return;
  p->shown = now;
  if (done > 0) {
    double seconds = (now - p->start) * (1 - done) / done / 1e3;
    int minutes = seconds > 100;
    snprintf(left, sizeof left, ", about %.0f %s left", minutes ? seconds / 60 : seconds, minutes ? "min" : "s");
  }
  fprintf(stderr, terminal ? "\r%.50s%s      " : "%s%s\n", what, left);
}
static inline void ex_clear_progress(void) { if (isatty(2)) fprintf(stderr, "\r%79s\r", ""); }

// >>work ----------------------------------------------------------------------------------------------------
/* As an engine that rebuilds: memory for the builds of this geometry, or smaller ones. */
static inline void ex_keep_scratch(trbvh_options *options, const trbvh_geometry *geometry)
{
  trbvh_bytes_bound(geometry, options, &options->scratch_size);
  options->scratch = ex_allocate(options->scratch_size, 1);
}

typedef void ex_work(const void *context, uint32_t number);
typedef struct ex_thread { ex_work *work; const void *context; uint32_t number; pthread_t thread; } ex_thread;
static inline void *ex_thread_main(void *argument)
{
  const ex_thread *t = (const ex_thread *)argument;
  t->work(t->context, t->number);
  return NULL;
}
/* work(context, number) for each number below threads, all at the same time; returns when all are done. */
static inline void ex_run_threads(uint32_t threads, ex_work *work, const void *context)
{
  ex_thread *all = (ex_thread *)ex_allocate(threads, sizeof *all);
  for (uint32_t i = 1; i < threads; i++) {
    all[i].work = work;
    all[i].context = context;
    all[i].number = i;
    if (pthread_create(&all[i].thread, NULL, ex_thread_main, &all[i])) ex_die("a thread cannot be started");
  }
  work(context, 0);                    /* number 0 is this thread's */
  for (uint32_t i = 1; i < threads; i++) pthread_join(all[i].thread, NULL);
  free(all);
}

// >>scenes --------------------------------------------------------------------------------------------------
/* Made by formula, so that a program measures something anywhere: first those of different character, then inputs that
 * may be slow to build. */
typedef enum ex_kind {
  EX_TERRAIN, EX_CITY, EX_CITY_TILTED, EX_ROOMS, EX_ROCK, EX_ISLAND, EX_FOREST, EX_HAIR, EX_MACHINE, EX_SOUP,
  EX_SLIVERS, EX_IDENTICAL, EX_SORTED, EX_REVERSED, EX_TWO_CENTERS, EX_OUTLIER, EX_GEOMETRIC, EX_SCENES
} ex_kind;
static const char *const ex_scene_names[EX_SCENES] = {
  "terrain", "city", "city, tilted", "rooms", "rock", "island", "forest", "hair", "machine", "soup", "slivers",
  "all identical", "sorted along x", "reversed along x", "flat with two centres", "one of them 1e6 away",
  "scaled by 2^-(i mod 120)"
};

static inline ex_vec ex_random_point(uint32_t *seed, float low, float high)
{
  float x = ex_random_in(seed, low, high), y = ex_random_in(seed, low, high), z = ex_random_in(seed, low, high);
  return ex_v(x, y, z);
}
static inline ex_vec ex_terrain_point(const void *nothing, float u, float v)
{
  (void)nothing;
  return ex_v(100 * u, 8 * ex_fractal_noise(ex_v(7 * u, 0.5f, 7 * v)), 100 * v);
}
/* Towers along straight streets, with four balconies each. */
static inline void ex_add_city(ex_builder *b, uint32_t count)
{
  uint32_t seed = 2, side = (uint32_t)sqrt(count / 60.0);
  for (uint32_t i = 0; i < side * side; i++) {
    float x = (float)(i % side), z = (float)(i / side), half = 0.2f / (0.05f + ex_random(&seed));
    ex_add_box(b, ex_v(x, half, z), ex_v(0.35f, 0, 0), ex_v(0, half, 0), ex_v(0, 0, 0.35f));
    for (int k = 1; k < 5; k++) {
      ex_vec middle = ex_v(x + 0.4f, 0.4f * half * (float)k, z);
      ex_add_box(b, middle, ex_v(0.05f, 0, 0), ex_v(0, 0.02f, 0), ex_v(0, 0, 0.2f));
    }
  }
}
/* Turns all of the mesh, by 40 degrees around an axis that is none of the three. */
static inline void ex_tilt(ex_mesh *mesh)
{
  ex_vec axis = ex_normalize(ex_v(1, 2, 3));
  float c = cosf(0.7f), s = sinf(0.7f);
  for (uint32_t i = 0; i < mesh->position_count; i++) {
    float *position = mesh->positions + 3 * (size_t)i;
    ex_vec p = ex_load(position), across = ex_cross(axis, p);
    p = ex_mad(ex_mad(ex_scale(p, c), across, s), axis, ex_dot(axis, p) * (1 - c));
    position[0] = p.x;
    position[1] = p.y;
    position[2] = p.z;
  }
}
static inline void ex_add_block(ex_builder *b, ex_vec center, float x, float y, float z)   /* half sides */
{
  ex_add_box(b, center, ex_v(x, 0, 0), ex_v(0, y, 0), ex_v(0, 0, z));
}
/* One storey of rooms with doors; in each a table, chairs, a lamp, and things on the table. */
static inline void ex_add_rooms(ex_builder *b, uint32_t count)
{
  static const ex_vec lamp[] = {{0.02f, 3, 0}, {0.02f, 2.2f, 0}, {0.3f, 1.9f, 0}, {0.28f, 1.9f, 0}, {0.01f, 2.15f, 0}};
  static const ex_vec cup[] = {{0, 0, 0}, {0.05f, 0, 0}, {0.07f, 0.05f, 0}, {0.05f, 0.12f, 0}, {0.04f, 0.12f, 0}};
  uint32_t seed = 4, side = (uint32_t)sqrt(count / 1500.0) + 1;
  float size = 6 * (float)side;
  ex_add_block(b, ex_v(size / 2, -0.1f, size / 2), size / 2, 0.1f, size / 2);
  ex_add_block(b, ex_v(size / 2, 3.1f, size / 2), size / 2, 0.1f, size / 2);
  for (uint32_t i = 0; i < side * side; i++) {
    ex_vec corner = ex_v(6 * (float)(i % side), 0, 6 * (float)(i / side)), center = ex_add(corner, ex_v(3, 0, 3));
    for (int wall = 0; wall < 2; wall++) {   /* each in two, and what is above the door */
      ex_vec along = wall ? ex_v(0, 0, 1) : ex_v(1, 0, 0), across = wall ? ex_v(0.05f, 0, 0) : ex_v(0, 0, 0.05f);
      ex_vec up = ex_v(0, 1.5f, 0), middle = ex_add(corner, up), lintel = ex_v(0, 0.5f, 0);
      ex_add_box(b, ex_mad(middle, along, 1), along, up, across);
      ex_add_box(b, ex_mad(middle, along, 4.5f), ex_scale(along, 1.5f), up, across);
      ex_add_box(b, ex_mad(ex_mad(middle, lintel, 2), along, 2.5f), ex_scale(along, 0.5f), lintel, across);
    }
    ex_add_block(b, ex_add(center, ex_v(0, 0.75f, 0)), 0.9f, 0.03f, 0.6f);
    for (int k = 0; k < 4; k++) {
      float x = k & 1 ? 1.0f : -1.0f, z = k & 2 ? 1.0f : -1.0f;
      ex_vec seat = ex_add(center, ex_v(0.5f * x, 0.45f, 0.9f * z));
      ex_add_rod(b, ex_add(center, ex_v(0.8f * x, 0, 0.5f * z)), ex_add(center, ex_v(0.8f * x, 0.72f, 0.5f * z)), 0.03f,
                 0.03f, 8);
      ex_add_block(b, seat, 0.2f, 0.02f, 0.2f);
      ex_add_block(b, ex_add(seat, ex_v(0, 0.3f, 0.19f * z)), 0.2f, 0.25f, 0.02f);
      for (int leg = 0; leg < 4; leg++) {
        ex_vec foot = ex_v(seat.x + (leg & 1 ? 0.17f : -0.17f), 0, seat.z + (leg & 2 ? 0.17f : -0.17f));
        ex_add_rod(b, foot, ex_add(foot, ex_v(0, 0.45f, 0)), 0.015f, 0.02f, 6);
      }
    }
    for (int k = 0; k < 6; k++) {
      float x = ex_random_in(&seed, -0.8f, 0.8f), z = ex_random_in(&seed, -0.5f, 0.5f);
      ex_add_lathe(b, ex_add(center, ex_v(x, 0.78f, z)), cup, 5, 12, 0);
    }
    ex_add_lathe(b, center, lamp, 5, 16, 0);
  }
}
/* Strands that bend, three-sided, out of a ball. */
static inline void ex_add_hair(ex_builder *b, uint32_t count)
{
  uint32_t seed = 5;
  enum { PARTS = 8, SIDES = 3 };
  for (uint32_t i = 0; i < count / (2 * PARTS * SIDES); i++) {
    ex_vec dir = ex_normalize(ex_random_point(&seed, -1, 1)), bend = ex_random_point(&seed, -0.4f, 0.4f);
    ex_vec from = dir;
    for (int k = 0; k < PARTS; k++) {
      ex_vec to = ex_mad(from, dir, 0.15f);
      ex_add_rod(b, from, to, 0.002f, 0.002f, SIDES);
      dir = ex_normalize(ex_add(ex_mad(dir, bend, 0.5f), ex_v(0, -0.12f, 0)));
      from = to;
    }
  }
}
/* A plate with screws, pipes and wheels of many sizes on it: large flat triangles beside tiny ones. */
static inline void ex_add_machine(ex_builder *b, uint32_t count)
{
  static const ex_vec screw[] = {
    {0, 1, 0}, {0.8f, 1, 0}, {1, 0.8f, 0}, {1, 0.4f, 0}, {0.5f, 0.4f, 0}, {0.5f, -1, 0}, {0, -1, 0}
  };
  uint32_t seed = 6;
  ex_add_block(b, ex_v(0, -0.5f, 0), 20, 0.5f, 14);
  while (b->mesh.triangle_count < count && !b->failed) {
    ex_vec profile[7], at = ex_v(ex_random_in(&seed, -19, 19), 0, ex_random_in(&seed, -13, 13));
    float size = 0.08f / (0.05f + ex_random(&seed));
    for (int i = 0; i < 7; i++) profile[i] = ex_scale(screw[i], size);
    ex_add_lathe(b, at, profile, 7, 24, 0);
    ex_vec next = ex_mad(at, ex_v(ex_random(&seed) < 0.5f, 0, 1), 6 * size);
    ex_add_rod(b, ex_add(at, ex_v(0, size, 0)), ex_add(next, ex_v(0, size, 0)), 0.3f * size, 0.3f * size, 20);
    ex_add_block(b, ex_add(at, ex_v(0, 0.1f * size, 0)), 1.6f * size, 0.1f * size, 1.2f * size);
  }
}
static inline void ex_add_forest(ex_builder *b, uint32_t count)
{
  uint32_t seed = 8;
  float size = 3 * sqrtf((float)count / 3000);
  while (b->mesh.triangle_count < count && !b->failed) {
    ex_vec foot = ex_v(ex_random_in(&seed, -size, size), 0, ex_random_in(&seed, -size, size));
    ex_add_branch(b, &seed, foot, ex_v(0, 1, 0), ex_random_in(&seed, 1, 2), 3, 10, ex_v(0, 0, 0));
  }
  uint32_t v = ex_add_vertex(b, ex_v(-size, 0, -size));
  ex_add_vertex(b, ex_v(-size, 0, size));
  ex_add_vertex(b, ex_v(size, 0, size));
  ex_add_vertex(b, ex_v(size, 0, -size));
  ex_add_quad(b, v, v + 1, v + 2, v + 3);
  free(b->mesh.paint);                 /* the branches' */
  b->mesh.paint = NULL;
}
/* Triangle i of n that share no corner. */
static inline void ex_loose_triangle(ex_kind kind, uint32_t i, uint32_t n, uint32_t *seed, ex_vec p[3])
{
  ex_vec center = ex_random_point(seed, 0, 1);
  float size = 0.5f / cbrtf((float)n), scale = kind == EX_GEOMETRIC ? ldexpf(1, -(int)(i % 120)) : 1;
  if (kind == EX_SORTED) center.x = (float)i / (float)n;
  if (kind == EX_REVERSED) center.x = (float)(n - i) / (float)n;
  if (kind == EX_OUTLIER && i == n - 1) center = ex_v(1e6f, 1e6f, 1e6f);
  for (int k = 0; k < 3; k++) p[k] = ex_scale(ex_add(center, ex_random_point(seed, -size, size)), scale);
  if (kind == EX_SLIVERS) {
    p[1] = ex_add(p[0], ex_random_point(seed, -0.4f, 0.4f));
    p[2] = ex_add(p[1], ex_random_point(seed, -0.001f, 0.001f));
  }
  if (kind == EX_IDENTICAL || kind == EX_TWO_CENTERS) {   /* of the boxes; they are exact, as these sums are */
    float x = kind == EX_IDENTICAL ? 0 : (float)(i & 1), s = kind == EX_IDENTICAL ? 1 : ex_random(seed) / 4;
    p[0] = ex_v(x - s, 0, -s);
    p[1] = ex_v(x + s, 0, -s);
    p[2] = ex_v(x, 0, s);
  }
}
static inline void ex_add_loose(ex_builder *b, ex_kind kind, uint32_t count)
{
  uint32_t seed = 1;
  ex_vec p[3];
  for (uint32_t i = 0; i < count; i++) {
    ex_loose_triangle(kind, i, count, &seed, p);
    for (int k = 0; k < 3; k++) ex_add_vertex(b, p[k]);
    ex_add_triangle(b, 3 * i, 3 * i + 1, 3 * i + 2);
  }
}
/* Of some `count` triangles. */
static inline ex_mesh ex_make_scene(ex_kind kind, uint32_t count)
{
  ex_builder b;
  unsigned side = (unsigned)sqrt(count / 2.0), detail = 1;
  ex_vec center = ex_v(0, 0, 0);
  memset(&b, 0, sizeof b);
  switch (kind) {
  case EX_TERRAIN: ex_add_surface(&b, ex_terrain_point, NULL, side, side, 0); break;
  case EX_CITY:
  case EX_CITY_TILTED: ex_add_city(&b, count); break;
  case EX_ROOMS: ex_add_rooms(&b, count); break;
  case EX_ROCK: ex_add_surface(&b, ex_rock_point, &center, side, side, 1); break;
  case EX_ISLAND:
    while (detail < EX_DEMO_DETAIL && detail * detail * 7100u < count) detail++;   /* about so many */
    if (!ex_mesh_demo(&b.mesh, detail)) b.failed = 1;
    break;
  case EX_FOREST: ex_add_forest(&b, count); break;
  case EX_HAIR: ex_add_hair(&b, count); break;
  case EX_MACHINE: ex_add_machine(&b, count); break;
  default: ex_add_loose(&b, kind, count);
  }
  if (kind == EX_CITY_TILTED && !b.failed) ex_tilt(&b.mesh);
  if (b.failed) ex_die("not enough memory");
  return b.mesh;
}

// >>meshes --------------------------------------------------------------------------------------------------
typedef struct ex_input { const char *name; int scene; double size; } ex_input;   /* a file, scene -1, and its bytes */
typedef struct ex_inputs { ex_input *at; size_t count; } ex_inputs;

static inline void ex_add_input(ex_inputs *inputs, ex_input one)
{
  if ((inputs->count & (inputs->count - 1)) == 0) {   /* there is room for the next power of two */
    inputs->at = (ex_input *)realloc(inputs->at, (2 * inputs->count + 1) * sizeof *inputs->at);
    if (!inputs->at) ex_die("not enough memory");
  }
  inputs->at[inputs->count++] = one;
}
static inline void ex_add_file(ex_inputs *inputs, const char *path)
{
  ex_input one = {path, -1, 0};
  FILE *file = fopen(path, "rb");
  if (!file) ex_die("%s: cannot be opened", path);
  if (fseek(file, 0, SEEK_END) == 0) one.size = (double)ftell(file);
  fclose(file);
  ex_add_input(inputs, one);
}
static inline int ex_by_name(const void *a, const void *b)
{
  return strcmp(((const ex_input *)a)->name, ((const ex_input *)b)->name);
}
/* A mesh, or all of those in a folder. */
static inline void ex_add_path(ex_inputs *inputs, const char *path)
{
  size_t first = inputs->count;
  DIR *folder = opendir(path);
  if (!folder) {
    ex_add_file(inputs, path);
    return;
  }
  for (struct dirent *entry; (entry = readdir(folder)) != NULL;) {
    const char *dot = strrchr(entry->d_name, '.');
    if (!dot || strlen(dot) != 4 || !strstr(".obj.ply.stl.OBJ.PLY.STL", dot)) continue;
    size_t size = strlen(path) + strlen(entry->d_name) + 2;
    char *name = (char *)ex_allocate(size, 1);   /* until the end */
    snprintf(name, size, "%s/%s", path, entry->d_name);
    ex_add_file(inputs, name);
  }
  closedir(folder);
  if (inputs->count == first) ex_die("%s: no OBJ, PLY or STL file in it", path);
  qsort(inputs->at + first, inputs->count - first, sizeof *inputs->at, ex_by_name);
}
static inline void ex_add_scene(ex_inputs *inputs, ex_kind kind)
{
  ex_input one = {ex_scene_names[kind], (int)kind, 1};
  ex_add_input(inputs, one);
}
static inline const char *ex_short_name(const ex_input *in)   /* without folders */
{
  const char *slash = strrchr(in->name, '/');
  return slash ? slash + 1 : in->name;
}
/* From the bytes of a file, roughly. */
static inline double ex_expected_triangles(const ex_input *in, uint32_t triangles)
{
  return in->scene < 0 ? in->size / 19 : triangles;
}
/* A scene made by formula gets this many triangles. */
static inline ex_mesh ex_load_input(const ex_input *in, uint32_t triangles)
{
  ex_mesh mesh;
  ex_vec low, high;
  char error[512];
  if (in->scene >= 0) mesh = ex_make_scene((ex_kind)in->scene, triangles);
  else if (!ex_mesh_read(in->name, &mesh, error, sizeof error)) ex_die("%s", error);
  if (!ex_mesh_bounds(&mesh, &low, &high)) ex_die("%s: no vertex is finite", in->name);
  return mesh;
}

#endif
