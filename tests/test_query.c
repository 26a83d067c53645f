/* Ray queries against brute force in double, which uses the geometry and not the tree; no leaks between triangles that
 * share an edge; the same hits from every tree, at every scale; limits, zeros, NaNs. */
#define TRBVH_IMPLEMENTATION
#include "../trbvh.h"
#include "test.h"
#include "scenes.h"

// >>reference ---- every triangle, in double, with a bound on what float arithmetic may make of it --------------------
typedef struct reference {
  double t, u, v;
  double error_t, error_uv;       /* how far a careful float implementation may be off; t in lengths of dir */
  int    sure, out;               /* surely hit; surely not. Neither: it depends on rounding */
} reference;

static void reference_triangle(const float *v, const trbvh_ray *ray, reference *r)
{
  const double eps = FLT_EPSILON;
  double p[3][3], d[3], e[3][3], length = 0, big = 0, edge = 0, w[3], det, t, margin;
  double tmin = ray->tmin > 0 ? (double)ray->tmin : 0.0;
  double tmax = ray->tmax > 0 || ray->tmax < 0 ? (double)ray->tmax : DBL_MAX, along[3];
  int i, k;
  for (k = 0; k < 3; ++k) { d[k] = ray->dir[k]; length += d[k] * d[k]; }
  length = sqrt(length);
  for (k = 0; k < 3; ++k) d[k] /= length;
  for (i = 0; i < 3; ++i) {
    double sum = 0;
    along[i] = 0;
    for (k = 0; k < 3; ++k) {
      p[i][k] = (double)v[3 * i + k] - ray->origin[k];
      sum += p[i][k] * p[i][k];
      along[i] += p[i][k] * d[k];
    }
    sum = sqrt(sum);
    if (sum > big) big = sum;
  }
  for (i = 0; i < 3; ++i) {                      /* w[i]: twice the area, seen along d, of the triangle opposite corner i */
    const double *a = p[(i + 1) % 3], *b = p[(i + 2) % 3];
    double sum = 0;
    w[i] = d[0] * (a[1] * b[2] - a[2] * b[1]) + d[1] * (a[2] * b[0] - a[0] * b[2]) + d[2] * (a[0] * b[1] - a[1] * b[0]);
    for (k = 0; k < 3; ++k) { e[i][k] = b[k] - a[k]; sum += e[i][k] * e[i][k]; }
    if (sqrt(sum) > edge) edge = sqrt(sum);
  }
  det = w[0] + w[1] + w[2];
  memset(r, 0, sizeof *r);
  r->error_uv = r->error_t = DBL_MAX;
  if (!memcmp(v, v + 3, 12) || !memcmp(v, v + 6, 12) || !memcmp(v + 3, v + 6, 12)) {       /* no area */
    r->out = 1;
    return;
  }
  if (!(fabs(det) > 0)) {                        /* seen edge-on */
    r->out = fabs(w[0]) + fabs(w[1]) + fabs(w[2]) > 64 * eps * big * edge;
    return;
  }
  for (i = 0; i < 3; ++i) w[i] /= det;
  t = (w[0] * along[0] + w[1] * along[1] + w[2] * along[2]) / length;
  r->u = w[1];
  r->v = w[2];
  r->t = t;
  r->error_uv = 32 * eps * big * edge / fabs(det);
  r->error_t = (r->error_uv * edge + 16 * eps * big) / length;
  margin = w[0] < w[1] ? w[0] : w[1];
  if (w[2] < margin) margin = w[2];
  r->sure = r->error_uv < 0.25 && margin > r->error_uv && t > tmin + r->error_t && t < tmax - r->error_t;
  r->out = margin < -r->error_uv || t < tmin - r->error_t || t > tmax + r->error_t;
}

/* Compares one ray with brute force. Returns 1 when rounding decides which triangle is hit. */
static int check_ray(const float *corners, uint32_t count, const trbvh_ray *ray, int got, const trbvh_hit *hit,
    const char *what)
{
  double nearest = DBL_MAX, farthest_start = DBL_MAX;
  uint32_t i, sure_prim = TRBVH_NONE;
  int ambiguous = 0;
  reference r, own;
  memset(&own, 0, sizeof own);
  for (i = 0; i < count; ++i) {
    if (corners[9 * i] >= FLT_MAX) continue;                       /* skipped by the build */
    reference_triangle(corners + 9 * i, ray, &r);
    if (r.sure && r.t + r.error_t < nearest) { nearest = r.t + r.error_t; sure_prim = i; }
    if (!r.out && !r.sure && r.t - r.error_t < farthest_start) farthest_start = r.t - r.error_t;
    if (got && i == hit->prim) own = r;
  }
  ambiguous = farthest_start < nearest;
  if (!got) {
    CHECK_MSG(sure_prim == TRBVH_NONE, "%s: a miss, but triangle %u is hit at t <= %g", what, sure_prim, nearest);
    CHECK_MSG(hit->prim == TRBVH_NONE && hit->instance == TRBVH_NONE
        && fabs((double)hit->u) + fabs((double)hit->v) <= 0, "%s: a miss reported as prim %u, u %g, v %g", what,
        hit->prim, (double)hit->u, (double)hit->v);
    if (ray->tmax > 0 && ray->tmax <= FLT_MAX)
      CHECK_MSG(hit->t >= ray->tmax && hit->t <= ray->tmax, "%s: a miss reported at t %g, limit %g", what,
          (double)hit->t, (double)ray->tmax);
    else if (!(ray->tmax < 0))
      CHECK_MSG(hit->t >= FLT_MAX, "%s: a miss reported at t %g, no limit", what, (double)hit->t);
    return ambiguous;
  }
  CHECK_MSG(hit->prim < count, "%s: hit on %u of %u", what, hit->prim, count);
  if (hit->prim >= count) return ambiguous;
  CHECK_MSG(hit->instance == TRBVH_NONE, "%s: instance %u", what, hit->instance);
  CHECK_MSG(!own.out, "%s: hit on triangle %u, which the ray misses: t %g, u %g, v %g; in double %g, %g, %g", what,
      hit->prim, (double)hit->t, (double)hit->u, (double)hit->v, own.t, own.u, own.v);
  if (own.error_uv < 0.25) {
    CHECK_MSG(fabs(hit->t - own.t) <= own.error_t, "%s: t %.9g, in double %.9g +- %g", what, (double)hit->t, own.t,
        own.error_t);
    CHECK_MSG(fabs(hit->u - own.u) <= own.error_uv && fabs(hit->v - own.v) <= own.error_uv,
        "%s: u %g, v %g; in double %g, %g +- %g", what, (double)hit->u, (double)hit->v, own.u, own.v, own.error_uv);
    CHECK_MSG(hit->t - own.error_t <= nearest, "%s: hit at %g, but triangle %u is hit at t <= %g", what, (double)hit->t,
        sure_prim, nearest);
  }
  CHECK_MSG(hit->u >= -1e-6f && hit->v >= -1e-6f && hit->u + hit->v <= 1 + 1e-6f, "%s: u %g, v %g", what,
      (double)hit->u, (double)hit->v);
  CHECK_MSG((ray->tmin < 0 ? hit->t > 0 : hit->t > ray->tmin) && (!(ray->tmax > 0) || hit->t <= ray->tmax),
      "%s: t %.9g outside %.9g .. %.9g", what, (double)hit->t, (double)ray->tmin, (double)ray->tmax);
  return ambiguous;
}

static int same_hit(const trbvh_hit *a, const trbvh_hit *b) { return memcmp(a, b, sizeof *a) == 0; }

// >>rays ------------------------------------------------------------------------------------------------------------
typedef struct mesh { scene s; trbvh_geometry g; float *corners; float lo[3], hi[3]; } mesh;

static void mesh_prepare(mesh *m)
{
  uint32_t i, k;
  m->g = scene_geometry(&m->s);
  m->corners = (float *)xmalloc(sizeof(float) * 9 * (m->s.count + 1));
  put3(m->lo, FLT_MAX, FLT_MAX, FLT_MAX);
  put3(m->hi, -FLT_MAX, -FLT_MAX, -FLT_MAX);
  for (i = 0; i < m->s.count; ++i) geometry_triangle(&m->g, i, m->corners + 9 * i);
  for (i = 0; i < 9 * m->s.count; ++i) {
    k = i % 3;
    if (m->corners[i] < m->lo[k]) m->lo[k] = m->corners[i];
    if (m->corners[i] > m->hi[k]) m->hi[k] = m->corners[i];
  }
}
static void mesh_make(mesh *m, const char *name, uint32_t n)
{
  unsigned i;
  for (i = 0; strcmp(scene_defs[i].name, name); ++i) {}
  memset(m, 0, sizeof *m);
  m->s.name = name;
  scene_defs[i].make(&m->s, n);
  mesh_prepare(m);
}
static void mesh_free(mesh *m) { scene_free(&m->s); free(m->corners); }
static void mesh_place(float *p, const mesh *m, rng *r, float spread)       /* somewhere in the box, or around it */
{
  int k;
  for (k = 0; k < 3; ++k) {
    float half = (m->hi[k] - m->lo[k]) / 2 * spread, middle = (m->hi[k] + m->lo[k]) / 2;
    if (half <= 0 && spread > 1) half = spread;                    /* off the plane of a flat scene */
    p[k] = rng_range(r, middle - half, middle + half);
  }
}
static const float *random_corner(const mesh *m, rng *r) { return m->corners + 3 * rng_below(r, 3 * m->s.count); }
static void point_on_edge(float *p, const mesh *m, rng *r)
{
  const float *v = m->corners + 9 * rng_below(r, m->s.count), f = rng_unit(r);
  uint32_t a = rng_below(r, 3), b = (a + 1) % 3;
  int k;
  for (k = 0; k < 3; ++k) p[k] = v[3 * a + (uint32_t)k] + f * (v[3 * b + (uint32_t)k] - v[3 * a + (uint32_t)k]);
}
static void point_on_triangle(float *p, const mesh *m, rng *r)
{
  const float *v = m->corners + 9 * rng_below(r, m->s.count);
  float f = rng_unit(r), h = rng_unit(r) * (1 - f);
  int k;
  for (k = 0; k < 3; ++k) p[k] = v[k] + f * (v[3 + k] - v[k]) + h * (v[6 + k] - v[k]);
}

enum { RAYS_RANDOM, RAYS_AXIS, RAYS_AXIS_AT_VERTEX, RAYS_PLANE, RAYS_FAR, RAYS_AT_SURFACE, RAYS_FROM_SURFACE,
    RAYS_FROM_VERTEX, RAYS_GRAZING, RAYS_WINDOW, RAYS_SCALED_DIR, RAY_KINDS };
static const char *const ray_kinds[RAY_KINDS] = {"random", "axis-parallel", "axis-parallel through a vertex",
    "with one zero", "from far away", "at a surface point",
  "from a surface point", "from a vertex", "grazing", "in a window", "of any length"};

static void make_ray(trbvh_ray *ray, int kind, const mesh *m, rng *r)
{
  float target[3];
  int k, axis = (int)rng_below(r, 3);
  memset(ray, 0, sizeof *ray);
  mesh_place(ray->origin, m, r, 1.5f);
  mesh_place(target, m, r, 1);
  switch (kind) {
    case RAYS_AXIS: case RAYS_AXIS_AT_VERTEX:
      if (kind == RAYS_AXIS_AT_VERTEX) {
        float keep = ray->origin[axis];
        memcpy(ray->origin, random_corner(m, r), sizeof ray->origin);
        ray->origin[axis] = keep;
      }
      for (k = 0; k < 3; ++k) ray->dir[k] = rng_u32(r) & 1 ? 0.0f : -0.0f;
      ray->dir[axis] = rng_range(r, 0.5f, 2);
      if (rng_u32(r) & 1) ray->dir[axis] = -ray->dir[axis];
      return;
    case RAYS_FAR:
      for (k = 0; k < 3; ++k) ray->origin[k] = ray->origin[k] * 20 + 3;
      break;
    case RAYS_AT_SURFACE: point_on_triangle(target, m, r); break;
    case RAYS_FROM_SURFACE: point_on_triangle(ray->origin, m, r); break;
    case RAYS_FROM_VERTEX: memcpy(ray->origin, random_corner(m, r), sizeof ray->origin); break;
    case RAYS_GRAZING: {                          /* along a triangle, a hair above it or in it */
      const float *v = m->corners + 9 * rng_below(r, m->s.count);
      float hair = rng_range(r, -0.0001f, 0.0001f);
      for (k = 0; k < 3; ++k) {
        target[k] = (v[k] + v[3 + k] + v[6 + k]) / 3;
        ray->origin[k] = target[k] + 3 * (v[k] - v[3 + k]) + (rng_u32(r) & 1 ? hair : 0.0f);
      }
      break;
    }
    default: break;
  }
  for (k = 0; k < 3; ++k) ray->dir[k] = target[k] - ray->origin[k];
  if (kind == RAYS_PLANE) ray->dir[axis] = rng_u32(r) & 1 ? 0.0f : -0.0f;
  if (kind == RAYS_WINDOW) {
    ray->tmin = rng_range(r, -0.25f, 1);
    ray->tmax = rng_u32(r) & 3 ? ray->tmin + rng_unit(r) : rng_u32(r) & 1 ? bad_float(1) : 0.0f;
  }
  if (kind == RAYS_SCALED_DIR) {
    float f = 1 + rng_unit(r);
    f *= power_of_two((int)rng_below(r, 81) - 40);
    for (k = 0; k < 3; ++k) ray->dir[k] *= f;
  }
}
static const char *ray_text(const trbvh_ray *r)
{
  static char text[160];
  snprintf(text, sizeof text, "(%.9g %.9g %.9g) %.9g, (%.9g %.9g %.9g) %.9g", (double)r->origin[0], (double)r->origin[1],
      (double)r->origin[2], (double)r->tmin, (double)r->dir[0], (double)r->dir[1], (double)r->dir[2], (double)r->tmax);
  return text;
}
static int has_direction(const trbvh_ray *ray)
{
  return fabs((double)ray->dir[0]) + fabs((double)ray->dir[1]) + fabs((double)ray->dir[2]) > 0;
}

static const char *const ordinary[] = {"random", "sphere", "rock", "room", "terrain", "slivers", "city",
    "huge_and_tiny", "grid", "flat_y", "not_finite", "identical", "collinear"};
#define ORDINARY_COUNT (sizeof ordinary / sizeof ordinary[0])

static uint32_t finite_count(mesh *m)             /* brute force must not see what the build skips: mark those */
{
  uint32_t i, k, skipped = 0;
  for (i = 0; i < m->s.count; ++i)
    if (geometry_skips(&m->g, i)) {
      ++skipped;
      for (k = 0; k < 9; ++k) m->corners[9 * i + k] = FLT_MAX;
    }
  return skipped;
}

static void test_against_brute_force(void)
{
  unsigned at, n;
  int kind, preset;
  for (at = 0; at < ORDINARY_COUNT; ++at) {
    mesh m;
    trbvh bvh[3];
    rng r = {1000 + at};
    uint32_t skipped;
    mesh_make(&m, ordinary[at], QUICK_OR(400, 2500));
    skipped = finite_count(&m);
    if (skipped) { put3(m.lo, -1, -1, -1); put3(m.hi, 1, 1, 1); }
    memset(bvh, 0, sizeof bvh);
    for (preset = 0; preset < 3; ++preset) {
      trbvh_options o = preset_options(preset);
      CHECK(trbvh_build(&bvh[preset], &m.g, &o) == TRBVH_OK);
    }
    for (kind = 0; kind < RAY_KINDS; ++kind) {
      unsigned rays = QUICK_OR(60, 600), ambiguous = 0, hits = 0;
      for (n = 0; n < rays; ++n) {
        trbvh_ray ray;
        trbvh_hit hit, other;
        int got;
        make_ray(&ray, kind, &m, &r);
        if (!has_direction(&ray)) continue;
        CONTEXT("scene %s, ray %u %s: %s", ordinary[at], n, ray_kinds[kind], ray_text(&ray));
        if (!is_finite(ray.origin[0] + ray.origin[1] + ray.origin[2] + ray.dir[0] + ray.dir[1] + ray.dir[2])) continue;
        memset(&hit, 0x55, sizeof hit);
        got = trbvh_intersect(&bvh[1], &ray, &hit);
        CHECK_MSG(got == 0 || got == 1, "returned %d", got);
        ambiguous += (unsigned)check_ray(m.corners, m.s.count, &ray, got, &hit, "intersect");
        hits += (unsigned)got;
        for (preset = 0; preset < 3; ++preset) {
          memset(&other, 0x66, sizeof other);
          CHECK_MSG(trbvh_intersect(&bvh[preset], &ray, &other) == got && same_hit(&hit, &other),
              "preset %s hits %u at %.9g (%g, %g), MEDIUM %u at %.9g (%g, %g)", preset_names[preset],
              other.prim, (double)other.t, (double)other.u, (double)other.v,
              hit.prim, (double)hit.t, (double)hit.u, (double)hit.v);
          CHECK_MSG(trbvh_occluded(&bvh[preset], &ray) == got, "preset %s: occluded is not %d", preset_names[preset],
              got);
        }
      }
      CONTEXT("scene %s, %s rays", ordinary[at], ray_kinds[kind]);
      if (kind == RAYS_RANDOM)
        CHECK_MSG(ambiguous * 50 <= rays, "%u of %u rays are decided by rounding: the reference is too weak", ambiguous, rays);
      if (kind == RAYS_WINDOW)
        CHECK_MSG(ambiguous * 20 <= rays, "%u of %u rays are decided by rounding: the reference is too weak", ambiguous, rays);
      if (kind == RAYS_AT_SURFACE && strcmp(ordinary[at], "not_finite"))
        CHECK_MSG(hits * 10 >= rays * 9, "%u of %u rays at the surface hit it", hits, rays);
    }
    for (preset = 0; preset < 3; ++preset) trbvh_free(&bvh[preset]);
    mesh_free(&m);
  }
}

/* One leaf has no tree to depend on. So leaves of one triangle each, in the box of the whole scene, must together give
 * bit for bit what any tree gives: the nearest, and the lowest index among equals. Where sizes differ by more than
 * double can tell, hits are noise, but still hits of some triangle in the ray's window. */
static void test_hits_do_not_depend_on_the_tree(void)
{
  unsigned at, n;
  uint32_t i;
  int preset, kind;
  for (at = 0; at < SCENE_COUNT; ++at) {
    const uint32_t count = scene_defs[at].full < QUICK_OR(60, 250) ? scene_defs[at].full : QUICK_OR(60, 250);
    mesh m;
    float lo[3], hi[3];
    trbvh *single, bvh[PRESET_COUNT + 1];
    rng r = {2000 + at};
    mesh_make(&m, scene_defs[at].name, count);
    put3(lo, FLT_MAX, FLT_MAX, FLT_MAX);
    put3(hi, -FLT_MAX, -FLT_MAX, -FLT_MAX);
    for (i = 0; i < 9 * m.s.count; ++i) {
      if (geometry_skips(&m.g, i / 9)) continue;
      if (m.corners[i] < lo[i % 3]) lo[i % 3] = m.corners[i];
      if (m.corners[i] > hi[i % 3]) hi[i % 3] = m.corners[i];
    }
    single = (trbvh *)xmalloc(sizeof(trbvh) * (m.s.count + 1));
    for (i = 0; i < m.s.count; ++i) {
      trbvh_geometry g;
      trbvh_options one = preset_options(0);
      float three[27];                                /* the triangle, and the scene's extreme corners as points */
      for (n = 0; n < 9; ++n) { three[n] = m.corners[9 * i + n]; three[9 + n] = lo[n % 3]; three[18 + n] = hi[n % 3]; }
      memset(&g, 0, sizeof g);
      memset(&single[i], 0, sizeof single[i]);
      g.positions = three;
      g.count = 3;
      one.cost_node = 1e6f;                           /* one leaf, please */
      CHECK(trbvh_build(&single[i], &g, &one) == TRBVH_OK);
      CHECK_MSG(single[i].node_count == 2, "%u nodes", single[i].node_count);
    }
    memset(bvh, 0, sizeof bvh);
    for (preset = 0; preset <= PRESET_COUNT; ++preset) {
      trbvh_options o = preset_options(preset < PRESET_COUNT ? preset : 2);
      if (preset == PRESET_COUNT) { o.max_leaf = 1; o.split_budget = 4; }
      CHECK(trbvh_build(&bvh[preset], &m.g, &o) == TRBVH_OK);
    }
    for (kind = 0; kind < RAY_KINDS && m.s.count; ++kind)
      for (n = 0; n < QUICK_OR(20, 150); ++n) {
        trbvh_ray ray;
        trbvh_hit want, hit;
        float limit = 0;
        make_ray(&ray, kind, &m, &r);
        memset(&want, 0, sizeof want);
        want.prim = TRBVH_NONE;
        for (i = 0; i < m.s.count; ++i)
          if (trbvh_intersect(&single[i], &ray, &hit)) {
            CHECK_MSG(hit.prim == 0, "a point is hit");
            if (want.prim == TRBVH_NONE || hit.t < want.t) { want = hit; want.prim = i; }
          } else limit = hit.t;
        if (want.prim == TRBVH_NONE) { want.t = limit; want.instance = TRBVH_NONE; }
        CONTEXT("scene %s, ray %u %s: %s", m.s.name, n, ray_kinds[kind], ray_text(&ray));
        for (preset = 0; preset <= PRESET_COUNT; ++preset) {
          int got = trbvh_intersect(&bvh[preset], &ray, &hit);
          if (scene_defs[at].flags & SCENE_EXTREME) {
            int fits = hit.prim < m.s.count && hit.t > ray.tmin && !(ray.tmax > 0 && hit.t > ray.tmax);
            CHECK_MSG(got ? fits : hit.prim == TRBVH_NONE, "tree %d hits %u at %.9g", preset, hit.prim, (double)hit.t);
            CHECK(trbvh_occluded(&bvh[preset], &ray) == got);
            continue;
          }
          CHECK_MSG(same_hit(&hit, &want) && got == (want.prim != TRBVH_NONE),
              "tree %d hits %u at %.9g (%g, %g), the triangle alone: %u at %.9g (%g, %g)", preset,
              hit.prim, (double)hit.t, (double)hit.u, (double)hit.v,
              want.prim, (double)want.t, (double)want.u, (double)want.v);
          CHECK_MSG(trbvh_occluded(&bvh[preset], &ray) == (want.prim != TRBVH_NONE), "tree %d: occluded", preset);
        }
      }
    for (i = 0; i < m.s.count; ++i) trbvh_free(&single[i]);
    for (preset = 0; preset <= PRESET_COUNT; ++preset) trbvh_free(&bvh[preset]);
    free(single);
    mesh_free(&m);
  }
}

// >>watertight ------------------------------------------------------------------------------------------------------
static void mesh_transform(mesh *m, float scale, float x, float y, float z)   /* still closed: corners stay shared */
{
  uint32_t i;
  free(m->corners);
  for (i = 0; i < m->s.vertex_count; ++i) {
    float *p = m->s.positions + 3 * i;
    put3(p, p[0] * scale + x, p[1] * scale + y, p[2] * scale + z);
  }
  mesh_prepare(m);
}

/* A closed mesh seen from inside: every ray hits, above all those at vertices and edges. */
static void test_watertight_from_inside(void)
{
  static const struct { const char *scene; uint32_t n; float scale, x, y, z; } cases[] = {
    {"sphere", 8, 1, 0, 0, 0}, {"sphere", 200, 1, 0, 0, 0}, {"sphere", 8000, 1, 0, 0, 0}, {"sphere", 3200, 0.001f, 0, 0, 0},
    {"sphere", 800, 1, 0.3f, 0.7f, -0.1f}, {"sphere", 800, 1, 100, -37.3f, 5.1f}, {"sphere", 200, 1e12f, 1e11f, 0, 3e10f},
    {"rock", 200, 1, 0, 0, 0}, {"rock", 3200, 1, 0, 0, 0}, {"rock", 3200, 3.7f, 11, 0.01f, -2},
    {"room", 12, 1, 0, 0, 0}, {"room", 1200, 1, 0, 0, 0}, {"room", 4800, 7.7f, 0.123f, 45.6f, -7}
  };
  unsigned c, i, from;
  for (c = 0; c < sizeof cases / sizeof cases[0]; ++c) {
    mesh m;
    trbvh bvh[2];
    unsigned leaks[2] = {0, 0}, dark = 0, rays = 0;
    trbvh_options high = preset_options(2), medium = preset_options(1);
    rng r = {3000 + c};
    mesh_make(&m, cases[c].scene, cases[c].n);
    mesh_transform(&m, cases[c].scale, cases[c].x, cases[c].y, cases[c].z);
    memset(bvh, 0, sizeof bvh);
    CHECK(trbvh_build(&bvh[0], &m.g, &medium) == TRBVH_OK);
    CHECK(trbvh_build(&bvh[1], &m.g, &high) == TRBVH_OK);
    for (from = 0; from < 8; ++from) {
      float origin[3];
      mesh_place(origin, &m, &r, from ? 0.35f : 0.0f);            /* the centre first */
      if (from == 7) put3(origin, cases[c].x, cases[c].y, cases[c].z);
      for (i = 0; i < QUICK_OR(500, 12000); ++i) {
        trbvh_ray ray;
        trbvh_hit hit;
        float target[3];
        int k, b;
        memset(&ray, 0, sizeof ray);
        memcpy(ray.origin, origin, sizeof origin);
        if (i % 3 == 0) memcpy(target, random_corner(&m, &r), sizeof target);
        else if (i % 3 == 1) point_on_edge(target, &m, &r);
        else {
          const float *v = m.corners + 9 * rng_below(&r, m.s.count);
          for (k = 0; k < 3; ++k) target[k] = (v[k] + v[3 + k]) / 2;     /* often exactly on the edge */
        }
        for (k = 0; k < 3; ++k) ray.dir[k] = target[k] - origin[k];
        ++rays;
        for (b = 0; b < 2; ++b)
          if (!trbvh_intersect(&bvh[b], &ray, &hit)) {
            if (!leaks[b]++) {
              CONTEXT("case %u: %s of %u, centre (%g %g %g), preset %s, ray %s", c, cases[c].scene, m.s.count,
                  (double)cases[c].x, (double)cases[c].y, (double)cases[c].z, b ? "HIGH" : "MEDIUM", ray_text(&ray));
              CHECK_MSG(0, "a ray slips through");
            }
          }
        dark += !trbvh_occluded(&bvh[0], &ray);
      }
    }
    CONTEXT("case %u: %s of %u, centre (%g %g %g)", c, cases[c].scene, m.s.count, (double)cases[c].x,
        (double)cases[c].y, (double)cases[c].z);
    CHECK_MSG(leaks[0] == 0 && leaks[1] == 0 && dark == 0,
        "%u rays: %u slip through with MEDIUM, %u with HIGH, %u through occluded", rays, leaks[0], leaks[1], dark);
    trbvh_free(&bvh[0]);
    trbvh_free(&bvh[1]);
    mesh_free(&m);
  }
}

/* Seen from outside, near and far, at vertices and edges well inside of the outline: a hit, and on the near side. */
static void test_watertight_from_outside(void)
{
  static const float distances[] = {1.5f, 3, 30, 1000, 100000};
  static const float centres[][3] = {{0, 0, 0}, {0.3f, -0.9f, 0.05f}, {21, -3.3f, 700.1f}};
  unsigned c, d, i;
  for (c = 0; c < sizeof centres / sizeof centres[0]; ++c)
    for (d = 0; d < sizeof distances / sizeof distances[0]; ++d) {
      mesh m;
      trbvh bvh[2];
      unsigned leaks = 0, back = 0, rays = 0;
      trbvh_options high = preset_options(2), medium = preset_options(1);
      rng r = {4000 + d + 10 * c};
      mesh_make(&m, "sphere", 1800);
      mesh_transform(&m, 1, centres[c][0], centres[c][1], centres[c][2]);
      memset(bvh, 0, sizeof bvh);
      CHECK(trbvh_build(&bvh[0], &m.g, &medium) == TRBVH_OK);
      CHECK(trbvh_build(&bvh[1], &m.g, &high) == TRBVH_OK);
      for (i = 0; i < QUICK_OR(1000, 20000); ++i) {
        trbvh_ray ray;
        trbvh_hit hit;
        float target[3];
        double facing = 0, length = 0, out, aside;
        int k, b;
        memset(&ray, 0, sizeof ray);
        if (i % 2) point_on_edge(target, &m, &r);
        else memcpy(target, random_corner(&m, &r), sizeof target);
        for (k = 0; k < 3; ++k) {
          out = (double)target[k] - (double)centres[c][k];                /* the normal, about */
          aside = (double)rng_range(&r, -0.3f, 0.3f) * (distances[d] - 1);
          ray.origin[k] = (float)((double)centres[c][k] + out * distances[d] + aside);
          ray.dir[k] = target[k] - ray.origin[k];
          facing -= out * ray.dir[k];
          length += (double)ray.dir[k] * ray.dir[k];
        }
        if (facing < 0.5 * sqrt(length)) continue;
        ++rays;
        for (b = 0; b < 2; ++b)
          if (!trbvh_intersect(&bvh[b], &ray, &hit)) ++leaks;
          else if (hit.t * sqrt(length) > sqrt(length) + 0.5) ++back;      /* slipped in, and hit the far side */
      }
      CONTEXT("sphere at (%g %g %g) from distance %g", (double)centres[c][0], (double)centres[c][1],
          (double)centres[c][2], (double)distances[d]);
      CHECK_MSG(leaks == 0 && back == 0 && rays > 500, "%u rays: %u miss, %u hit the far side", rays, leaks, back);
      trbvh_free(&bvh[0]);
      trbvh_free(&bvh[1]);
      mesh_free(&m);
    }
}

// >>scale -----------------------------------------------------------------------------------------------------------
/* Powers of two change nothing but exponents: the same tree, the same hits; t scaled with the mesh, unless dir is. */
static void test_power_of_two_scales(void)
{
  static const char *const names[] = {"random", "slivers", "room"};
  static const int exponents[] = {-40, -21, -3, 1, 18, 40};
  unsigned at, e, n;
  int preset;
  for (at = 0; at < sizeof names / sizeof names[0]; ++at)
    for (e = 0; e < sizeof exponents / sizeof exponents[0]; ++e)
      for (preset = 0; preset < 3; ++preset) {
        mesh m, big;
        trbvh a, b;
        trbvh_options o = preset_options(preset);
        float f = power_of_two(exponents[e]);
        rng r = {5000 + at};
        unsigned hits = 0, wrong = 0;
        uint32_t i;
        mesh_make(&m, names[at], QUICK_OR(300, 2000));
        mesh_make(&big, names[at], QUICK_OR(300, 2000));
        for (i = 0; i < 3 * big.s.vertex_count; ++i) big.s.positions[i] *= f;
        memset(&a, 0, sizeof a);
        memset(&b, 0, sizeof b);
        CHECK(trbvh_build(&a, &m.g, &o) == TRBVH_OK);
        CHECK(trbvh_build(&b, &big.g, &o) == TRBVH_OK);
        CONTEXT("scene %s times 2^%d, preset %s", names[at], exponents[e], preset_names[preset]);
        if (preset < 2 || exponents[e] % 3 == 0)     /* split priorities are cube roots: exact for every third power */
          CHECK_MSG(a.node_count == b.node_count && a.ref_count == b.ref_count
              && same_bits(a.prims, b.prims, sizeof(uint32_t) * a.ref_count), "the trees differ");
        for (n = 0; n < QUICK_OR(200, 3000); ++n) {
          trbvh_ray ray, with, without;                /* with: dir scaled too, so that t stays */
          trbvh_hit hit, hit_with, hit_without;
          int k;
          make_ray(&ray, (int)(n % 10), &m, &r);
          with = without = ray;
          for (k = 0; k < 3; ++k) {
            with.origin[k] *= f;
            without.origin[k] *= f;
            with.dir[k] *= f;
          }
          without.tmin *= f;
          without.tmax *= f;
          hits += (unsigned)trbvh_intersect(&a, &ray, &hit);
          trbvh_intersect(&b, &with, &hit_with);
          trbvh_intersect(&b, &without, &hit_without);
          if (hit.prim != TRBVH_NONE) hit.t *= f; else hit.t = hit_without.t;
          if (!same_hit(&hit, &hit_without)) ++wrong;
          if (hit.prim != TRBVH_NONE) hit.t /= f; else hit.t = hit_with.t;
          if (!same_hit(&hit, &hit_with)) ++wrong;
        }
        CHECK_MSG(wrong == 0, "%u hits differ", wrong);
        CHECK_MSG(hits > n / 10, "%u hits of %u rays", hits, n);
        trbvh_free(&a);
        trbvh_free(&b);
        mesh_free(&m);
        mesh_free(&big);
      }
}

/* Any unit will do: brute force agrees at other scales as well. */
static void test_other_scales(void)
{
  static const float scales[] = {0.1f, 10000, 1e-15f, 1e15f, 1e-30f, 1e30f};
  static const char *const names[] = {"random", "sphere", "city"};
  unsigned at, i, n;
  for (at = 0; at < sizeof names / sizeof names[0]; ++at)
    for (i = 0; i < sizeof scales / sizeof scales[0]; ++i) {
      mesh m, big;
      trbvh bvh;
      rng r = {6000 + i};
      unsigned ambiguous = 0, hits = 0, rays = QUICK_OR(100, 800);
      uint32_t k;
      mesh_make(&m, names[at], QUICK_OR(300, 1500));
      mesh_make(&big, names[at], QUICK_OR(300, 1500));
      for (k = 0; k < 3 * big.s.vertex_count; ++k) big.s.positions[k] *= scales[i];
      for (k = 0; k < 9 * big.s.count; ++k) big.corners[k] *= scales[i];
      memset(&bvh, 0, sizeof bvh);
      CHECK(trbvh_build(&bvh, &big.g, NULL) == TRBVH_OK);
      for (n = 0; n < rays; ++n) {
        trbvh_ray ray;
        trbvh_hit hit;
        int got;
        make_ray(&ray, n % 2 ? RAYS_AT_SURFACE : RAYS_RANDOM, &m, &r);
        for (k = 0; k < 3; ++k) {
          ray.origin[k] *= scales[i];
          if (n % 4 < 2) ray.dir[k] *= scales[i];
        }
        CONTEXT("scene %s times %g, ray %s", names[at], (double)scales[i], ray_text(&ray));
        got = trbvh_intersect(&bvh, &ray, &hit);
        hits += (unsigned)got;
        ambiguous += (unsigned)check_ray(big.corners, big.s.count, &ray, got, &hit, "intersect");
        CHECK(trbvh_occluded(&bvh, &ray) == got);
      }
      CONTEXT("scene %s times %g", names[at], (double)scales[i]);
      CHECK_MSG(hits * 10 > rays * 4 && ambiguous * 50 <= rays, "%u hits, %u ambiguous of %u", hits, ambiguous, rays);
      trbvh_free(&bvh);
      mesh_free(&m);
      mesh_free(&big);
    }
}

// >>limits ----------------------------------------------------------------------------------------------------------
static float step(float x, int up)               /* the next float, of a positive one */
{
  uint32_t bits;
  memcpy(&bits, &x, 4);
  bits = up ? bits + 1 : bits - 1;
  memcpy(&x, &bits, 4);
  return x;
}

/* tmin < t <= tmax, to the last bit. Going on from hit to hit finds every triangle that brute force finds. */
static void test_window_is_exact(void)
{
  static const char *const names[] = {"random", "slivers", "sphere"};
  unsigned at, n;
  for (at = 0; at < sizeof names / sizeof names[0]; ++at) {
    mesh m;
    trbvh bvh;
    rng r = {7000 + at};
    unsigned long total = 0, sure = 0, maybe = 0;
    mesh_make(&m, names[at], QUICK_OR(300, 2000));
    memset(&bvh, 0, sizeof bvh);
    CHECK(trbvh_build(&bvh, &m.g, NULL) == TRBVH_OK);
    for (n = 0; n < QUICK_OR(50, 600); ++n) {
      trbvh_ray ray, cut;
      trbvh_hit hit, again;
      unsigned found = 0, must = 0, may = 0;
      uint32_t i;
      make_ray(&ray, RAYS_RANDOM, &m, &r);
      CONTEXT("scene %s, ray %s", names[at], ray_text(&ray));
      for (i = 0; i < m.s.count; ++i) {
        reference ref;
        reference_triangle(m.corners + 9 * i, &ray, &ref);
        must += (unsigned)ref.sure;
        may += !ref.out;
      }
      cut = ray;
      while (trbvh_intersect(&bvh, &cut, &hit) && found <= may) {
        ++found;
        CHECK_MSG(hit.t > cut.tmin, "t %.9g, tmin %.9g", (double)hit.t, (double)cut.tmin);
        cut.tmax = hit.t;
        CHECK_MSG(trbvh_intersect(&bvh, &cut, &again) && same_hit(&hit, &again), "tmax = t: %u at %.9g, was %u at %.9g",
            again.prim, (double)again.t, hit.prim, (double)hit.t);
        CHECK(trbvh_occluded(&bvh, &cut));
        cut.tmax = step(hit.t, 0);
        CHECK_MSG(!trbvh_intersect(&bvh, &cut, &again) && again.t >= cut.tmax && again.t <= cut.tmax,
            "tmax below t: %u at %.9g, nearest was %.9g", again.prim, (double)again.t, (double)hit.t);
        CHECK(!trbvh_occluded(&bvh, &cut));
        cut.tmax = 0;
        cut.tmin = step(hit.t, 0);
        CHECK_MSG(trbvh_intersect(&bvh, &cut, &again) && same_hit(&hit, &again),
            "tmin below t: %u at %.9g, was %u at %.9g", again.prim, (double)again.t, hit.prim, (double)hit.t);
        cut.tmin = hit.t;
      }
      CHECK_MSG(found <= may && found + 3 >= must, "%u hits along the ray, %u at least, %u at most", found, must, may);
      total += found; sure += must; maybe += may;
    }
    CONTEXT("scene %s", names[at]);
    CHECK_MSG(total > 0 && total <= maybe && total * 1000 >= sure * 990, "%lu hits, %lu surely, %lu at most", total,
        sure, maybe);
    trbvh_free(&bvh);
    mesh_free(&m);
  }
}

static void test_meaning_of_tmin_and_tmax(void)
{
  static const float corners[18] = {-1, -1, 2,  1, -1, 2,  0, 2, 2,   -1, -1, 4,  1, -1, 4,  0, 2, 4};
  static const struct { float tmin, tmax, scale; int hit; float t; unsigned prim; } cases[] = {
    {0, 0, 1, 1, 2, 0}, {0, 1, 1, 0, 1, 0}, {0, 2, 1, 1, 2, 0}, {2, 0, 1, 1, 4, 1}, {1.9f, 0, 1, 1, 2, 0},
    {2, 3, 1, 0, 3, 0}, {2, 4, 1, 1, 4, 1}, {4, 0, 1, 0, FLT_MAX, 0},
    {-5, 0, 1, 1, 2, 0}, {-5, 1.5f, 1, 0, 1.5f, 0}, {0, FLT_MAX, 1, 1, 2, 0}, {0, 0, 0.5f, 1, 4, 0},
    {0, 3.9f, 0.5f, 0, 3.9f, 0}, {0, 0, 4, 1, 0.5f, 0}, {0.5f, 0.9f, 4, 0, 0.9f, 0}, {0.5f, 1, 4, 1, 1, 1},
    {3, 2, 1, 0, 2, 0}, {0, 0, -1, 0, FLT_MAX, 0}, {-9, 0, -1, 0, FLT_MAX, 0}, {-0.0f, -0.0f, 1, 1, 2, 0}
  };
  trbvh_geometry g;
  trbvh bvh;
  unsigned i;
  memset(&g, 0, sizeof g);
  memset(&bvh, 0, sizeof bvh);
  g.positions = corners;
  g.count = 2;
  CHECK(trbvh_build(&bvh, &g, NULL) == TRBVH_OK);
  for (i = 0; i < sizeof cases / sizeof cases[0]; ++i) {
    trbvh_ray ray = {{0, 0, 0}, 0, {0, 0, 1}, 0};
    trbvh_hit hit;
    ray.tmin = cases[i].tmin;
    ray.tmax = cases[i].tmax;
    ray.dir[2] *= cases[i].scale;
    CONTEXT("case %u", i);
    CHECK_MSG(trbvh_intersect(&bvh, &ray, &hit) == cases[i].hit, "prim %u, t %g", hit.prim, (double)hit.t);
    CHECK_MSG(hit.t >= cases[i].t && hit.t <= cases[i].t, "t %g, want %g", (double)hit.t, (double)cases[i].t);
    CHECK_MSG(hit.prim == (cases[i].hit ? cases[i].prim : TRBVH_NONE) && hit.instance == TRBVH_NONE, "prim %u, want %u",
        hit.prim, cases[i].prim);
    CHECK(trbvh_occluded(&bvh, &ray) == cases[i].hit);
  }
  { /* u and v belong to the second and third corner */
    trbvh_ray ray = {{0.25f, 0.5f, 0}, 0, {0, 0, 1}, 0};
    trbvh_hit hit;
    CHECK(trbvh_intersect(&bvh, &ray, &hit));
    CHECK_MSG(fabs(hit.u - 0.375) < 1e-6 && fabs(hit.v - 0.5) < 1e-6, "u %g, v %g", (double)hit.u, (double)hit.v);
    ray.tmax = bad_float(1);                                      /* infinite */
    CHECK(trbvh_intersect(&bvh, &ray, &hit) && hit.prim == 0 && trbvh_occluded(&bvh, &ray));
    ray.dir[2] = -1;
    CHECK(!trbvh_intersect(&bvh, &ray, &hit) && hit.prim == TRBVH_NONE && hit.t >= FLT_MAX);
  }
  trbvh_free(&bvh);
}

/* Thin triangles are hit where they are and nowhere else: diagonal ones, 2^-e thick, in numbers that float holds. */
static void test_thin_triangles(void)
{
  int e, k, axis;
  for (e = 2; e <= 22; ++e)
    for (axis = 0; axis < 3; ++axis) {
      const float thick = power_of_two(-e);
      float corners[9];
      const float flat[9] = {-1, -1, 2,  1, 1, 2,  0, thick, 2};
      trbvh_geometry g;
      trbvh bvh;
      memset(&g, 0, sizeof g);
      memset(&bvh, 0, sizeof bvh);
      for (k = 0; k < 9; ++k) corners[k / 3 * 3 + (k % 3 + axis) % 3] = flat[k];
      g.positions = corners;
      g.count = 1;
      CHECK(trbvh_build(&bvh, &g, NULL) == TRBVH_OK);
      for (k = -3; k <= 5; ++k) {
        trbvh_ray ray;
        trbvh_hit hit;
        int inside = k >= 0 && k <= 4;               /* edges and corners belong to it */
        memset(&ray, 0, sizeof ray);
        ray.origin[(1 + axis) % 3] = (float)k * thick / 4;
        ray.dir[(2 + axis) % 3] = 1;
        CONTEXT("2^-%d thick, axis %d, at %d / 4 of it", e, axis, k);
        CHECK_MSG(trbvh_intersect(&bvh, &ray, &hit) == inside, "prim %u, u %g, v %g", hit.prim, (double)hit.u,
            (double)hit.v);
        if (inside)
          CHECK_MSG(fabs(hit.v - k / 4.0) < 1e-6 && hit.t >= 2 && hit.t <= 2, "t %.9g, v %g", (double)hit.t, (double)hit.v);
      }
      trbvh_free(&bvh);
    }
}

static void test_rays_that_hit_nothing(void)
{
  mesh m;
  trbvh bvh[3];
  unsigned i, at, bad;
  int preset;
  rng r = {8000};
  memset(bvh, 0, sizeof bvh);
  mesh_make(&m, "sphere", 800);
  for (preset = 0; preset < 3; ++preset) {
    trbvh_options o = preset_options(preset);
    CHECK(trbvh_build(&bvh[preset], &m.g, &o) == TRBVH_OK);
  }
  for (preset = 0; preset < 3; ++preset)
    for (i = 0; i < 50; ++i) {
      trbvh_ray ray, broken;
      trbvh_hit hit;
      int k;
      make_ray(&ray, RAYS_RANDOM, &m, &r);
      put3(ray.origin, 0, 0, 0);
      CHECK(trbvh_intersect(&bvh[preset], &ray, &hit) && trbvh_occluded(&bvh[preset], &ray));
      for (at = 0; at < 8; ++at)
        for (bad = 0; bad < 5; ++bad) {
          float value = bad_float(bad);
          int nan = bad == 0 || bad >= 3;
          broken = ray;
          memcpy((unsigned char *)&broken + 4 * at, &value, 4);
          memset(&hit, 0x55, sizeof hit);
          CONTEXT("ray component %u is %g", at, (double)value);
          if (nan) {
            CHECK_MSG(!trbvh_intersect(&bvh[preset], &broken, &hit) && hit.prim == TRBVH_NONE, "prim %u", hit.prim);
            CHECK(!trbvh_occluded(&bvh[preset], &broken));
          } else {                                                 /* infinite: no crash, and no nonsense */
            int got = trbvh_intersect(&bvh[preset], &broken, &hit);
            CHECK_MSG(got ? hit.prim < m.s.count && hit.t > 0 : hit.prim == TRBVH_NONE, "prim %u, t %g", hit.prim,
                (double)hit.t);
            CHECK(trbvh_occluded(&bvh[preset], &broken) == got);
          }
        }
      broken = ray;
      for (k = 0; k < 3; ++k) broken.dir[k] = i >> k & 1 ? 0.0f : -0.0f;
      CONTEXT("no direction");
      CHECK(!trbvh_intersect(&bvh[preset], &broken, &hit) && hit.prim == TRBVH_NONE
          && !trbvh_occluded(&bvh[preset], &broken));
      memcpy(broken.origin, random_corner(&m, &r), sizeof broken.origin);
      CHECK(!trbvh_intersect(&bvh[preset], &broken, &hit) && hit.prim == TRBVH_NONE
          && !trbvh_occluded(&bvh[preset], &broken));
    }
  for (preset = 0; preset < 3; ++preset) trbvh_free(&bvh[preset]);
  mesh_free(&m);
}

static void test_lowest_index_wins(void)         /* among identical triangles, whatever their order in memory */
{
  mesh m;
  int preset;
  unsigned n;
  rng r = {9000};
  mesh_make(&m, "random", 512);
  for (n = 256; n < 512; ++n) memcpy(m.s.positions + 9 * n, m.s.positions + 9 * (n - 256), 9 * sizeof(float));
  for (preset = 0; preset < PRESET_COUNT; ++preset) {
    trbvh_options o = preset_options(preset);
    trbvh bvh;
    unsigned hits = 0, high = 0;
    memset(&bvh, 0, sizeof bvh);
    CHECK(trbvh_build(&bvh, &m.g, &o) == TRBVH_OK);
    for (n = 0; n < QUICK_OR(300, 3000); ++n) {
      trbvh_ray ray;
      trbvh_hit hit;
      make_ray(&ray, RAYS_AT_SURFACE, &m, &r);
      if (trbvh_intersect(&bvh, &ray, &hit)) { ++hits; high += hit.prim >= 256; }
    }
    CONTEXT("preset %s", preset_names[preset]);
    CHECK_MSG(hits > n / 3 && high == 0, "%u hits, %u of them on the copy with the higher index", hits, high);
    trbvh_free(&bvh);
  }
  mesh_free(&m);
}

int main(int argc, char **argv)
{
  test_start(argc, argv);
  RUN(test_meaning_of_tmin_and_tmax);
  RUN(test_against_brute_force);
  RUN(test_hits_do_not_depend_on_the_tree);
  RUN(test_watertight_from_inside);
  RUN(test_watertight_from_outside);
  RUN(test_power_of_two_scales);
  RUN(test_other_scales);
  RUN(test_window_is_exact);
  RUN(test_thin_triangles);
  RUN(test_rays_that_hit_nothing);
  RUN(test_lowest_index_wins);
  return test_finish();
}
