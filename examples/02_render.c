/* 02_render.c - draws a mesh with every preset, and prints what each costs and what it brings.
 * Introduces: presets, statistics, progress, many rays on several threads, builds on an OpenCL device, and a
 * walk of your own over the nodes.
 *
 *   cc -O3 examples/02_render.c -o render -lm -pthread -ldl && ./render bunny.ply
 */
#define TRBVH_THREADS
#define TRBVH_IMPLEMENTATION
#include "../trbvh_cl.h"               /* trbvh.h alone does without --device */
#define EX_PROGRAM "02_render"
#include "common.h"

static const char usage[] =
  "usage: 02_render [MESH] [options]\n"
  "  MESH            an OBJ, PLY or STL file; without one, the built-in scene\n"
  "  --quality NAME  fast, medium, high or best alone, instead of the first three\n"
  "  --splits X      extra references for triangle splitting, as a share of the triangles: 0.3 = 30 %\n"
  "  --threads N     instead of one for each processor\n"
  "  --device [NAME] build on an OpenCL device: part of its or its platform's name; any, a GPU first\n"
  "  --size WxH      of the picture; 960x640\n"
  "  --out PREFIX    in front of render.png and heatmap.png\n";

typedef struct settings {
  const char *mesh, *prefix, *device;
  trbvh_quality quality;               /* DEFAULT = the presets to compare */
  float splits;
  uint32_t threads, width, height;
} settings;

enum { ROUNDS = 3 };
typedef struct preset {
  const char *name;
  trbvh_quality quality;
  trbvh bvh;
  trbvh_stats stats;
  double ms_first;                     /* of the first build on a device, which compiles kernels; else 0 */
  double ms[EX_KINDS][ROUNDS];
  size_t hits[EX_KINDS];
} preset;

// >>command line --------------------------------------------------------------------------------------------
enum { OPTION_QUALITY, OPTION_SPLITS, OPTION_THREADS, OPTION_DEVICE, OPTION_SIZE, OPTION_OUT, OPTIONS };
static const ex_option options_known[OPTIONS] = {
  {"--quality", EX_VALUE}, {"--splits", EX_VALUE}, {"--threads", EX_VALUE}, {"--device", EX_VALUE_OR_NONE},
  {"--size", EX_VALUE}, {"--out", EX_VALUE}
};

static void set_option(void *user, int option, const char *value)
{
  static const char *const qualities[] = {"", "fast", "medium", "high", "best"};
  settings *s = (settings *)user;
  const char *name = option < 0 ? "" : options_known[option].name;
  char *number_end;
  switch (option) {
  case OPTION_QUALITY:
    for (int i = 1; i < 5; i++) if (!strcmp(value, qualities[i])) s->quality = (trbvh_quality)i;
    if (!s->quality) ex_die("%s takes fast, medium, high or best, not '%s'", name, value);
    break;
  case OPTION_SPLITS:
    s->splits = strtof(value, &number_end);
    if (number_end == value || *number_end || !(s->splits >= 0 && s->splits <= 16)) {
      ex_die("%s takes 0..16, not '%s'", name, value);
    }
    if (s->splits == 0) s->splits = -1;   /* to the library, 0 is the preset's own value */
    break;
  case OPTION_THREADS: s->threads = ex_parse_count(value, name, 1024, NULL); break;
  case OPTION_DEVICE: s->device = value; break;
  case OPTION_SIZE: ex_parse_size(value, name, &s->width, &s->height); break;
  case OPTION_OUT: s->prefix = value; break;
  default:
    if (s->mesh) ex_die("one mesh at a time: '%s' or '%s'", s->mesh, value);
    s->mesh = value;
  }
}

// >>progress ------------------------------------------------------------------------------------------------
typedef struct progress_bar { const char *what; double start; int percent; } progress_bar;

static progress_bar progress_start(const char *what)
{
  progress_bar p = {what, ex_now_ms(), -1};
  return p;
}
static int progress_show(void *user, float done)   /* as trbvh_options.progress wants it; 0 = go on */
{
  progress_bar *p = (progress_bar *)user;
  int percent = (int)(done * 20) * 5;
  if (percent != p->percent && ex_now_ms() - p->start > 1000) {
    p->percent = percent;
    fprintf(stderr, "\r%s: %d %% ", p->what, percent);
  }
  return 0;
}
static void progress_end(const progress_bar *p)
{
  if (p->percent >= 0) fprintf(stderr, "\r%*s\r", (int)strlen(p->what) + 8, "");
}

// >>measuring -----------------------------------------------------------------------------------------------
/* The fastest of three builds; where one takes long, one is enough. A device compiles kernels before. */
static void build(preset *p, const ex_mesh *mesh, const trbvh_options *base)
{
  trbvh_geometry geometry = ex_mesh_geometry(mesh);
  trbvh_options options = *base;
  char what[32];
  snprintf(what, sizeof what, "building %s", p->name);
  progress_bar bar = progress_start(what);
  trbvh_stats stats;
  options.quality = p->quality;
  options.stats = &stats;
  options.progress = progress_show;
  options.progress_user = &bar;
  if (options.device) {
    ex_check(trbvh_build(&p->bvh, &geometry, &options), what, &stats);
    p->ms_first = stats.ms_total;
  }
  for (int run = 0; run < 3 && (run == 0 || p->stats.ms_total < 1000); run++) {
    ex_check(trbvh_build(&p->bvh, &geometry, &options), what, &stats);
    if (run == 0 || stats.ms_total < p->stats.ms_total) p->stats = stats;
  }
  progress_end(&bar);
}
static void measure(preset *presets, int count, const ex_ray_set sets[EX_KINDS], const trbvh_options *options)
{
  size_t most = sets[EX_PRIMARY].count;
  trbvh_hit *hits = (trbvh_hit *)ex_allocate(most, sizeof *hits);
  uint8_t *occluded = (uint8_t *)ex_allocate(most, 1);
  progress_bar bar = progress_start("measuring rays");
  for (int turn = 0; turn < ROUNDS * EX_KINDS * count; turn++) {
    int round = turn / (EX_KINDS * count), kind = turn / count % EX_KINDS;
    preset *p = presets + turn % count;
    const ex_ray_set *set = sets + kind;
    double start = ex_now_ms();
    trbvh_result result = kind == EX_AMBIENT
      ? trbvh_occluded_n(&p->bvh, set->rays, occluded, set->count, options)
      : trbvh_intersect_n(&p->bvh, set->rays, hits, set->count, options);
    p->ms[kind][round] = ex_now_ms() - start;
    ex_check(result, "tracing rays", NULL);
    p->hits[kind] = 0;
    for (size_t i = 0; i < set->count; i++) {
      p->hits[kind] += kind == EX_AMBIENT ? occluded[i] : hits[i].prim != TRBVH_NONE;
    }
    if (round == 0 && p->hits[kind] != presets->hits[kind]) {
      fprintf(stderr, "warning: of the %s rays %zu hit with %s, but %zu with %s\n", ex_kind_names[kind],
              p->hits[kind], p->name, presets->hits[kind], presets->name);
    }
    progress_show(&bar, (float)turn / (float)(ROUNDS * EX_KINDS * count));
  }
  progress_end(&bar);
  free(hits);
  free(occluded);
}
static void print_table(const preset *presets, int count, const ex_ray_set sets[EX_KINDS], uint32_t triangles)
{
  static const char *const labels[] = {
    "build, ms", "  split", "  morton", "  sort", "  hierarchy", "  treelets", "  moves", "  collapse",
    "  finish", "  transfer", "first build, ms", "million triangles/s", "SAH cost", "nodes", "leaves", "references",
    "depth", "million rays/s: primary", "  ambient occlusion", "  diffuse"
  };
  enum { TRANSFER = 9, FIRST };        /* rows that only a device fills */
  static const char decimals[] = "11111111111220000222";
  int on_device = 0;
  printf("%-24s", "");
  for (int i = 0; i < count; i++) {
    printf("%12s", presets[i].name);
    on_device |= presets[i].stats.on_device;
  }
  for (size_t row = 0; row < sizeof labels / sizeof *labels; row++) {
    if ((row == TRANSFER || row == FIRST) && !on_device) continue;
    printf("\n%-24s", labels[row]);
    for (int i = 0; i < count; i++) {
      const trbvh_stats *s = &presets[i].stats;
      double rate[EX_KINDS];
      for (int kind = 0; kind < EX_KINDS; kind++) {
        double ms[ROUNDS];
        memcpy(ms, presets[i].ms[kind], sizeof ms);
        rate[kind] = (double)sets[kind].count / ex_median(ms, ROUNDS) / 1e3;
      }
      const double values[] = {
        s->ms_total, s->ms_split, s->ms_morton, s->ms_sort, s->ms_hierarchy, s->ms_treelets, s->ms_moves,
        s->ms_collapse, s->ms_finish, s->ms_transfer, presets[i].ms_first, triangles / s->ms_total / 1e3, s->sah_cost,
        s->node_count, s->leaf_count, s->ref_count, s->max_depth, rate[EX_PRIMARY], rate[EX_AMBIENT],
        rate[EX_DIFFUSE]
      };
      printf("%12.*f", decimals[row] - '0', values[row]);
    }
  }
  printf("\n%-24s", "built on");
  for (int i = 0; i < count; i++) printf("%12s", presets[i].stats.on_device ? "device" : "scalar");
  printf("\n");
  for (int i = 0; i < count; i++) {    /* why it was not the device */
    if (*presets[i].stats.message) printf("%s: %s\n", presets[i].name, presets[i].stats.message);
  }
}

// >>picture -------------------------------------------------------------------------------------------------
enum { SAMPLES = 4, SKY_RAYS = 4, LIGHT_RAYS = SKY_RAYS + 1 };   /* a pixel (2 x 2); a sample; and the sun */

static ex_vec sky(const ex_scene *scene, ex_vec dir)
{
  float height = ex_dot(dir, scene->up);
  ex_vec horizon = ex_v(0.62f, 0.74f, 0.90f), zenith = ex_v(0.10f, 0.27f, 0.66f);
  if (height < 0) return ex_mix(horizon, ex_v(0.10f, 0.12f, 0.15f), ex_smooth(0, 0.2f, -height));
  return ex_mix(horizon, zenith, sqrtf(height));
}
/* What a surface gets from a sky that nothing hides. One value for a normal: open ground is free of noise. */
static ex_vec skylight(const ex_scene *scene, ex_vec normal)
{
  float upward = 0.5f + 0.5f * ex_dot(normal, scene->up);
  return ex_mix(ex_v(0.20f, 0.18f, 0.16f), ex_v(0.36f, 0.46f, 0.64f), upward);
}
static float linear(uint8_t value) { return powf((float)value / 255, 2.2f); }
static uint8_t display(float light)   /* a film's response (Narkowicz 2015), then gamma */
{
  float film = light * (2.51f * light + 0.03f) / (light * (2.43f * light + 0.59f) + 0.14f);
  return (uint8_t)(255 * powf(ex_clamp(film, 0, 1), 1 / 2.2f) + 0.5f);
}

/* Rays, what they hit, and the light that comes along them. */
typedef struct layer {
  size_t count;
  trbvh_ray *rays;
  trbvh_hit *hits;
  ex_vec *normals, *light;
  uint32_t *ids;                       /* SAMPLES * pixel + sample: seeds of noise that is always the same */
} layer;
typedef struct tracer {
  const ex_scene *scene;
  const trbvh *bvh;
  const trbvh_options *options;
  layer seen, mirrored;                /* a band of the picture, and what its mirrors show */
  trbvh_ray *light_rays;
  uint8_t *occluded;
} tracer;

static layer allocate_layer(size_t count)
{
  layer l = {0, NULL, NULL, NULL, NULL, NULL};
  l.rays = (trbvh_ray *)ex_allocate(count, sizeof *l.rays);
  l.hits = (trbvh_hit *)ex_allocate(count, sizeof *l.hits);
  l.normals = (ex_vec *)ex_allocate(count, sizeof *l.normals);
  l.light = (ex_vec *)ex_allocate(count, sizeof *l.light);
  l.ids = (uint32_t *)ex_allocate(count, sizeof *l.ids);
  return l;
}
static void free_layer(layer *l)
{
  free(l->rays);
  free(l->hits);
  free(l->normals);
  free(l->light);
  free(l->ids);
}
static void add_ray(layer *l, trbvh_ray ray, uint32_t id)
{
  l->rays[l->count] = ray;
  l->ids[l->count++] = id;
}
/* One ray to the sun and some into the sky, cosine-distributed: a pixel's samples share the hemisphere. */
static void aim_light_rays(const tracer *t, const layer *l, size_t i, ex_vec point, trbvh_ray *out)
{
  uint32_t seed = l->ids[i];
  ex_vec normal = l->normals[i], s, u;
  ex_frame(t->scene->sun, &s, &u);
  float x = ex_random_in(&seed, -0.012f, 0.012f), y = ex_random_in(&seed, -0.012f, 0.012f);
  *out++ = ex_ray(point, ex_mad(ex_mad(t->scene->sun, s, x), u, y), 0);
  for (uint32_t k = 0; k < SKY_RAYS; k++) {
    float a = ((float)(l->ids[i] % SAMPLES) + ex_random(&seed)) / SAMPLES;
    float b = ((float)k + ex_random(&seed)) / SKY_RAYS;
    *out++ = ex_ray(point, ex_cosine_direction(normal, a, b), t->scene->diagonal * 0.15f);
  }
}
static void shade(tracer *t, layer *l)
{
  const ex_scene *scene = t->scene;
  ex_check(trbvh_intersect_n(t->bvh, l->rays, l->hits, l->count, t->options), "tracing rays", NULL);
  size_t count = 0;
  for (size_t i = 0; i < l->count; i++) {
    if (l->hits[i].prim == TRBVH_NONE) continue;
    ex_vec point = ex_surface(scene, &l->rays[i], &l->hits[i], &l->normals[i]);
    aim_light_rays(t, l, i, point, t->light_rays + count);
    count += LIGHT_RAYS;
  }
  ex_check(trbvh_occluded_n(t->bvh, t->light_rays, t->occluded, count, t->options), "tracing rays", NULL);
  count = 0;
  for (size_t i = 0; i < l->count; i++) {
    ex_vec dir = ex_load(l->rays[i].dir);
    l->light[i] = sky(scene, dir);
    if (l->hits[i].prim == TRBVH_NONE) continue;
    static const ex_paint clay = {186, 180, 172, 0};
    ex_paint paint = scene->mesh.paint ? scene->mesh.paint[l->hits[i].prim] : clay;
    float sun = t->occluded[count] ? 0 : fmaxf(0, ex_dot(l->normals[i], scene->sun));
    int open = SKY_RAYS;
    for (int k = 1; k <= SKY_RAYS; k++) open -= t->occluded[count + (size_t)k];
    count += LIGHT_RAYS;
    ex_vec light = ex_scale(skylight(scene, l->normals[i]), (float)open / SKY_RAYS);
    light = ex_mad(light, ex_v(1.9f, 1.62f, 1.25f), sun);
    light = ex_mul(light, ex_v(linear(paint.r), linear(paint.g), linear(paint.b)));
    float clear = scene->haze > 0 ? expf(-l->hits[i].t / scene->haze) : 1;
    l->light[i] = ex_mix(l->light[i], light, clear);
  }
}
/* Mixes in what mirrors show, by Schlick's approximation of how much of it. */
static void reflect(tracer *t)
{
  layer *seen = &t->seen, *mirrored = &t->mirrored;
  const ex_paint *paint = t->scene->mesh.paint;
  mirrored->count = 0;
  for (size_t i = 0; i < seen->count && paint; i++) {
    if (seen->hits[i].prim == TRBVH_NONE || !paint[seen->hits[i].prim].mirror) continue;
    ex_vec dir = ex_load(seen->rays[i].dir), normal;
    ex_vec point = ex_surface(t->scene, &seen->rays[i], &seen->hits[i], &normal);
    dir = ex_mad(dir, normal, -2 * ex_dot(dir, normal));
    add_ray(mirrored, ex_ray(point, dir, 0), seen->ids[i]);
  }
  shade(t, mirrored);
  for (size_t j = 0; j < mirrored->count; j++) {
    size_t i = mirrored->ids[j] - seen->ids[0];   /* those seen have consecutive numbers */
    float cosine = ex_dot(seen->normals[i], ex_load(mirrored->rays[j].dir));
    float share = (float)paint[seen->hits[i].prim].mirror / 255 * (0.1f + 0.9f * powf(1 - cosine, 5));
    seen->light[i] = ex_mix(seen->light[i], mirrored->light[j], share);
  }
}
static void render(const ex_scene *scene, const settings *s, const trbvh *bvh, const trbvh_options *options,
                   uint8_t *rgb)
{
  uint32_t rows = 65536 / (SAMPLES * s->width) + 1;
  size_t most = (size_t)SAMPLES * s->width * rows;
  tracer t = {scene, bvh, options, allocate_layer(most), allocate_layer(most), NULL, NULL};
  t.light_rays = (trbvh_ray *)ex_allocate(most * LIGHT_RAYS, sizeof *t.light_rays);
  t.occluded = (uint8_t *)ex_allocate(most * LIGHT_RAYS, 1);
  progress_bar bar = progress_start("drawing");
  for (uint32_t y = 0; y < s->height; y += rows) {
    uint32_t first = y * s->width, end = (y + rows < s->height ? y + rows : s->height) * s->width;
    t.seen.count = 0;
    for (uint32_t id = first * SAMPLES; id < end * SAMPLES; id++) {
      float x_in = 0.25f + 0.5f * (float)(id & 1), y_in = 0.25f + 0.5f * (float)(id >> 1 & 1);
      add_ray(&t.seen, ex_pixel_ray(scene, id / SAMPLES, s->width, s->height, x_in, y_in), id);
    }
    shade(&t, &t.seen);
    reflect(&t);
    for (uint32_t pixel = first; pixel < end; pixel++) {
      ex_vec sum = ex_v(0, 0, 0);
      const ex_vec *light = t.seen.light + (size_t)(pixel - first) * SAMPLES;
      for (int i = 0; i < SAMPLES; i++) sum = ex_mad(sum, light[i], 1.0f / SAMPLES);
      rgb[3 * (size_t)pixel] = display(sum.x);
      rgb[3 * (size_t)pixel + 1] = display(sum.y);
      rgb[3 * (size_t)pixel + 2] = display(sum.z);
    }
    progress_show(&bar, (float)y / (float)s->height);
  }
  progress_end(&bar);
  free_layer(&t.seen);
  free_layer(&t.mirrored);
  free(t.light_rays);
  free(t.occluded);
}

// >>heat map ------------------------------------------------------------------------------------------------
/* Where a ray enters a box, or FLT_MAX where it misses it or enters it behind limit. A ray in the plane of a
 * side makes 0 * infinity, a NaN, which fmaxf and fminf ignore; the factor: for rounding (Ize, JCGT 2013). */
static float enter(const trbvh_node *node, const trbvh_ray *ray, const float inverse[3], float limit)
{
  float from = 0, to = limit;
  for (int axis = 0; axis < 3; axis++) {
    int back = inverse[axis] < 0;
    from = fmaxf(from, ((back ? node->max : node->min)[axis] - ray->origin[axis]) * inverse[axis]);
    to = fminf(to, ((back ? node->min : node->max)[axis] - ray->origin[axis]) * inverse[axis] * 1.0000004f);
  }
  return from <= to ? from : FLT_MAX;
}
/* Moeller and Trumbore, Fast Minimum Storage Ray/Triangle Intersection, 1997: the distance, or FLT_MAX */
static float strike(const trbvh_triangle *triangle, const trbvh_ray *ray)
{
  ex_vec e1 = ex_load(triangle->e1), e2 = ex_load(triangle->e2), dir = ex_load(ray->dir);
  ex_vec s = ex_sub(ex_load(ray->origin), ex_load(triangle->v0)), p = ex_cross(dir, e2), q = ex_cross(s, e1);
  float inverse = 1 / ex_dot(p, e1), u = ex_dot(p, s) * inverse, v = ex_dot(q, dir) * inverse;
  float t = ex_dot(q, e2) * inverse;
  return u >= 0 && v >= 0 && u + v <= 1 && t > 0 ? t : FLT_MAX;
}
/* A walk over the nodes for the closest hit, nearest child first; returns how many nodes it visits. */
static uint32_t count_visits(const trbvh *bvh, const trbvh_ray *ray)
{
  uint32_t stack[TRBVH_MAX_DEPTH], depth = 0, visits = 0, at = 0;
  float entries[TRBVH_MAX_DEPTH], inverse[3], nearest = FLT_MAX;
  for (int axis = 0; axis < 3; axis++) inverse[axis] = 1 / ray->dir[axis];
  if (!bvh->nodes || enter(bvh->nodes, ray, inverse, nearest) == FLT_MAX) return 0;
  for (;;) {
    const trbvh_node *node = bvh->nodes + at;
    visits++;
    for (uint32_t i = 0; i < node->count; i++) {
      nearest = fminf(nearest, strike(bvh->triangles + node->first + i, ray));
    }
    if (!node->count) {
      uint32_t near_child = node->first, far_child = near_child + 1;
      float near_entry = enter(bvh->nodes + near_child, ray, inverse, nearest);
      float far_entry = enter(bvh->nodes + far_child, ray, inverse, nearest);
      if (far_entry < near_entry) {
        float entry = near_entry;
        near_entry = far_entry;
        far_entry = entry;
        near_child = far_child;
        far_child = node->first;
      }
      if (far_entry < FLT_MAX) {
        entries[depth] = far_entry;
        stack[depth++] = far_child;
      }
      if (near_entry < FLT_MAX) {
        at = near_child;
        continue;
      }
    }
    do {
      if (!depth) return visits;
      at = stack[--depth];
    } while (entries[depth] > nearest);   /* a triangle has been hit before that box since it was put off */
  }
}

typedef struct picture { uint8_t *rgb; uint32_t width, height; } picture;

static void set_pixel(picture *image, uint32_t x, uint32_t y, ex_vec color)   /* 0..255 */
{
  if (x >= image->width || y >= image->height) return;
  uint8_t *p = image->rgb + 3 * ((size_t)y * image->width + x);
  p[0] = (uint8_t)color.x;
  p[1] = (uint8_t)color.y;
  p[2] = (uint8_t)color.z;
}
/* The colours of matplotlib's inferno: equal steps look equal, and brighter is always more. In 120 steps, so
 * that the picture gets a palette, which makes its file small. */
static ex_vec ramp(float x)
{
  static const ex_vec stops[] = {
    {0, 0, 4}, {22, 11, 57}, {66, 10, 104}, {106, 23, 110}, {147, 38, 103}, {188, 55, 84}, {221, 81, 58},
    {243, 120, 25}, {252, 165, 10}, {246, 215, 70}, {252, 255, 164}
  };
  float at = floorf(ex_clamp(x, 0, 1) * 120 + 0.5f) / 12;
  int stop = at < 9 ? (int)at : 9;
  return ex_mix(stops[stop], stops[stop + 1], at - (float)stop);
}
/* 3 x 5 letters, digits and points, each dot 2 x 2 pixels; the five octal digits are the rows from above. */
static void draw_text(picture *image, uint32_t x, uint32_t y, const char *text)
{
  static const uint16_t digits[] = {
    075557, 026227, 071747, 071717, 055711, 074717, 074757, 071122, 075757, 075717
  };
  static const uint16_t letters[] = {
    025755, 065656, 034443, 065556, 074647, 074644, 034553, 055755, 072227, 011152, 055655, 044447, 057755,
    065555, 025552, 065644, 025563, 065655, 034216, 072222, 055557, 055522, 055775, 055255, 055222, 071247
  };
  for (; *text; text++, x += 8) {
    char c = *text;
    unsigned glyph = c == '.' ? 2 : 0;
    if (c >= '0' && c <= '9') glyph = digits[c - '0'];
    if (c >= 'a' && c <= 'z') glyph = letters[c - 'a'];
    for (uint32_t i = 0; i < 60; i++) {
      uint32_t column = i % 6, row = i / 6, dot = row / 2 * 3 + column / 2;
      if (glyph >> (14 - dot) & 1) set_pixel(image, x + column, y + row, ex_v(235, 235, 235));
    }
  }
}
/* One panel of half the picture's size for each preset, brighter where rays visit more nodes, all to the same
 * scale, with the mean below it. The caller frees its pixels. */
static picture heat_map(const ex_scene *scene, const settings *s, const preset *presets, int count)
{
  enum { MARGIN = 8, LEGEND = 40 };
  uint32_t width = s->width / 2 + 1, height = s->height / 2 + 1, panels = (uint32_t)count;
  size_t pixels = (size_t)width * height;
  uint32_t *visits = (uint32_t *)ex_allocate(pixels * panels, sizeof *visits);
  uint32_t histogram[4096] = {0}, scale = 0;
  progress_bar bar = progress_start("counting visits");
  for (size_t i = 0; i < pixels * panels; i++) {
    trbvh_ray ray = ex_pixel_ray(scene, i % pixels, width, height, 0.5f, 0.5f);
    visits[i] = count_visits(&presets[i / pixels].bvh, &ray);
    histogram[visits[i] < 4095 ? visits[i] : 4095]++;
    if (i % width == 0) progress_show(&bar, (float)i / (float)(pixels * panels));
  }
  progress_end(&bar);
  double below = 0, most_pixels = 0.995 * (double)(pixels * panels);
  while (below < most_pixels) below += histogram[scale++];
  scale = (scale + 9) / 10 * 10;       /* a round number that 99.5 % of the pixels stay below */

  picture image = {NULL, panels * (width + MARGIN) - MARGIN, height + LEGEND};
  image.rgb = (uint8_t *)ex_allocate((size_t)image.width * image.height, 3);
  for (uint32_t panel = 0; panel < panels; panel++) {
    uint32_t left = panel * (width + MARGIN);
    double sum = 0;
    char label[64];
    for (uint32_t i = 0; i < pixels; i++) {
      uint32_t count_here = visits[panel * pixels + i];
      sum += count_here;
      set_pixel(&image, left + i % width, i / width, ramp((float)count_here / (float)scale));
    }
    snprintf(label, sizeof label, "%s  %.1f nodes per ray", presets[panel].name, sum / (double)pixels);
    draw_text(&image, left + 4, height + 8, label);
  }
  char most[16];
  snprintf(most, sizeof most, "%u", scale);
  uint32_t from = 20, behind = 12 + 8 * (uint32_t)strlen(most);
  draw_text(&image, 4, height + 26, "0");
  draw_text(&image, image.width - behind + 8, height + 26, most);
  for (uint32_t x = from; x + behind < image.width; x++) {
    ex_vec color = ramp((float)(x - from) / (float)(image.width - behind - from));
    for (uint32_t y = 26; y < 36; y++) set_pixel(&image, x, height + y, color);
  }
  free(visits);
  return image;
}

static void write_picture(const settings *s, const char *name, const picture *image)
{
  char path[1024];
  if (snprintf(path, sizeof path, "%s%s", s->prefix, name) >= (int)sizeof path) ex_die("--out is too long");
  if (!ex_png_write(path, image->rgb, image->width, image->height)) ex_die("%s: cannot be written", path);
  printf("wrote %s\n", path);
}

int main(int argc, char **argv)
{
  settings s = {NULL, "", NULL, TRBVH_QUALITY_DEFAULT, 0, ex_processors(), 960, 640};
  ex_arguments(argc, argv, usage, options_known, OPTIONS, set_option, &s);
  preset presets[] = {{.name = "fast", .quality = TRBVH_QUALITY_FAST},
                      {.name = "medium", .quality = TRBVH_QUALITY_MEDIUM},
                      {.name = "high", .quality = TRBVH_QUALITY_HIGH},
                      {.name = "best", .quality = TRBVH_QUALITY_BEST}};
  int count = 3;                       /* best is the same as high in this version */
  if (s.quality) {
    presets[0] = presets[s.quality - TRBVH_QUALITY_FAST];
    count = 1;
  }

  ex_scene scene = ex_scene_load(s.mesh, (float)s.width / (float)s.height);
  trbvh_options options = {.split_budget = s.splits}, device_options;
  options.jobs.width = s.threads;
  printf("%s: %u triangles; threads: %u\n", s.mesh ? s.mesh : "built-in scene", scene.mesh.triangle_count,
         s.threads);
  device_options = options;            /* for builds only: rays and pictures are the C code's */
  if (s.device) {
    trbvh_cl_desc desc = {.name = *s.device ? s.device : NULL};
    trbvh_stats stats;
    trbvh_device *device = device_options.device = trbvh_cl_open(&desc, &stats);
    if (device) printf("builds on %s, rays in C on the processor\n", trbvh_cl_name(device));
    else printf("no device, C does it all: %s\n", stats.message);
  }
  for (int i = 0; i < count; i++) build(&presets[i], &scene.mesh, &device_options);
  trbvh_cl_close(device_options.device);

  ex_ray_set sets[EX_KINDS];
  ex_make_rays(&scene, s.width, s.height, &presets[0].bvh, &options, sets);
  measure(presets, count, sets, &options);
  print_table(presets, count, sets, scene.mesh.triangle_count);

  picture drawing = {(uint8_t *)ex_allocate((size_t)s.width * s.height, 3), s.width, s.height};
  render(&scene, &s, &presets[count - 1].bvh, &options, drawing.rgb);
  write_picture(&s, "render.png", &drawing);
  picture map = heat_map(&scene, &s, presets, count);
  write_picture(&s, "heatmap.png", &map);

  for (int kind = 0; kind < EX_KINDS; kind++) free(sets[kind].rays);
  for (int i = 0; i < count; i++) trbvh_free(&presets[i].bvh);
  ex_mesh_free(&scene.mesh);
  free(drawing.rgb);
  free(map.rgb);
  return 0;
}
