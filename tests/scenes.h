/* What the tests share: procedural scenes, an allocator that counts, and a check of a tree that owes nothing to
 * trbvh_validate. Include trbvh.h first.
 *
 * The scenes must be the same floats on every machine, whatever the compiler does with a * b + c. So they are made
 * from integers, and every product of two fractions is a product of two floats taken in double: it is exact, hence a
 * fused multiply-add has nothing to change. No libm but sqrt, which IEEE rounds correctly. No two random numbers in one
 * expression, whose order would be the compiler's choice. */
#ifndef SCENES_H
#define SCENES_H

#include <float.h>
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

// >>random ----------------------------------------------------------------------------------------------------------
typedef struct rng { uint64_t state; } rng;

static inline uint32_t rng_u32(rng *r)                       /* splitmix64, the upper half */
{
  uint64_t z = (r->state += 0x9E3779B97F4A7C15u);
  z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9u;
  z = (z ^ (z >> 27)) * 0x94D049BB133111EBu;
  return (uint32_t)((z ^ (z >> 31)) >> 32);
}
static inline uint32_t rng_below(rng *r, uint32_t n) { return (uint32_t)(((uint64_t)rng_u32(r) * n) >> 32); }
static inline float rng_unit(rng *r) { return (float)(rng_u32(r) >> 8) / 16777216.0f; }               /* 0 <= x < 1 */
static inline float rng_range(rng *r, float lo, float hi)
{
  float width = hi - lo;
  return (float)((double)width * rng_unit(r) + lo);
}

// >>scenes ----------------------------------------------------------------------------------------------------------
typedef struct scene {
  const char *name;
  float      *positions;          /* x, y, z */
  uint32_t    vertex_count;
  uint32_t   *indices;            /* NULL = soup */
  uint32_t    count;              /* triangles */
} scene;

enum {
  SCENE_ORDINARY = 1,             /* what people trace rays at: hits against the reference, SAH order, golden hashes */
  SCENE_BIG      = 2,             /* many triangles: fewer variants, please */
  SCENE_EXTREME  = 4              /* sizes next to each other that differ by more than double can tell, or denormal ones */
};

static inline void *xmalloc(size_t size)
{
  void *p = malloc(size ? size : 1);
  if (!p) { printf("the test itself is out of memory\n"); exit(2); }
  return p;
}
static inline void scene_alloc(scene *s, uint32_t vertices, uint32_t triangles, int indexed)
{
  s->vertex_count = vertices;
  s->count = triangles;
  s->positions = (float *)xmalloc(sizeof(float) * 3 * vertices);
  s->indices = indexed ? (uint32_t *)xmalloc(sizeof(uint32_t) * 3 * triangles) : NULL;
}
static inline void scene_soup(scene *s, uint32_t triangles) { scene_alloc(s, 3 * triangles, triangles, 0); }
static inline void scene_free(scene *s) { free(s->positions); free(s->indices); memset(s, 0, sizeof *s); }
static inline trbvh_geometry scene_geometry(const scene *s)
{
  trbvh_geometry g;
  memset(&g, 0, sizeof g);
  g.positions = s->positions;
  g.position_count = s->vertex_count;
  g.indices = s->indices;
  g.count = s->count;
  return g;
}
static inline void put3(float *p, float x, float y, float z) { p[0] = x; p[1] = y; p[2] = z; }
static inline uint32_t put_triangle(scene *s, uint32_t at, uint32_t a, uint32_t b, uint32_t c)
{
  s->indices[3 * at] = a; s->indices[3 * at + 1] = b; s->indices[3 * at + 2] = c;
  return at + 1;
}
static inline uint32_t isqrt(uint32_t n)
{
  uint32_t r = 0;
  while ((uint64_t)(r + 1) * (r + 1) <= n) ++r;
  return r;
}
static inline float power_of_two(int e)                      /* exact, denormals too; what overflows is FLT_MAX */
{
  float x = 1.0f;
  if (e > 127) return FLT_MAX;
  for (; e > 0; --e) x *= 2.0f;
  for (; e < 0; ++e) x *= 0.5f;
  return x;
}

static inline void make_random(scene *s, uint32_t n)
{
  rng r = {1};
  uint32_t i, j, k;
  scene_soup(s, n);
  for (i = 0; i < n; ++i) {
    float c[3];
    for (k = 0; k < 3; ++k) c[k] = rng_range(&r, -1, 1);
    for (j = 0; j < 3; ++j)
      for (k = 0; k < 3; ++k) s->positions[9 * i + 3 * j + k] = c[k] + rng_range(&r, -0.0625f, 0.0625f);
  }
}

/* Octahedron |i| + |j| + |l| = k on the integer lattice, pushed out to the unit sphere: 8 k^2 triangles, watertight. */
static inline uint32_t sphere_vertex(scene *s, uint32_t *map, int k, int i, int j, int l)
{
  uint32_t *slot = &map[2 * ((j + k) * (2 * k + 1) + i + k) + (l < 0)];
  if (*slot == 0xFFFFFFFFu) {
    double x = i, y = j, z = l, length = sqrt(x * x + y * y + z * z);
    put3(s->positions + 3 * s->vertex_count, (float)(x / length), (float)(y / length), (float)(z / length));
    *slot = s->vertex_count++;
  }
  return *slot;
}
static inline void make_sphere(scene *s, uint32_t n)
{
  int k = (int)isqrt(n / 8), octant, a, b;
  uint32_t map_size, *map, at = 0;
  if (k < 1) k = 1;
  map_size = 2 * (uint32_t)(2 * k + 1) * (uint32_t)(2 * k + 1);
  map = (uint32_t *)xmalloc(sizeof(uint32_t) * map_size);
  memset(map, 0xFF, sizeof(uint32_t) * map_size);
  scene_alloc(s, (uint32_t)(4 * k * k + 2), (uint32_t)(8 * k * k), 1);
  s->vertex_count = 0;
  for (octant = 0; octant < 8; ++octant) {
    int x = octant & 1 ? -1 : 1, y = octant & 2 ? -1 : 1, z = octant & 4 ? -1 : 1, flip = x * y * z < 0;
    for (a = 0; a < k; ++a)
      for (b = 0; a + b < k; ++b) {
        uint32_t v0 = sphere_vertex(s, map, k, x * a, y * b, z * (k - a - b));
        uint32_t v1 = sphere_vertex(s, map, k, x * (a + 1), y * b, z * (k - a - b - 1));
        uint32_t v2 = sphere_vertex(s, map, k, x * a, y * (b + 1), z * (k - a - b - 1));
        at = put_triangle(s, at, v0, flip ? v2 : v1, flip ? v1 : v2);
        if (a + b + 1 < k) {
          uint32_t v3 = sphere_vertex(s, map, k, x * (a + 1), y * (b + 1), z * (k - a - b - 2));
          at = put_triangle(s, at, v1, flip ? v2 : v3, flip ? v3 : v2);
        }
      }
  }
  free(map);
}

/* The sphere with every vertex moved in or out: a closed mesh with faces in all directions, seen from its centre. */
static inline void make_rock(scene *s, uint32_t n)
{
  rng r = {2};
  uint32_t i;
  make_sphere(s, n);
  for (i = 0; i < 3 * s->vertex_count; i += 3) {
    float f = rng_range(&r, 0.75f, 1.25f);
    put3(s->positions + i, s->positions[i] * f, s->positions[i + 1] * f, s->positions[i + 2] * f);
  }
}

/* The surface of a box on an uneven lattice: walls in the axis planes, 12 k^2 triangles, watertight, seen from inside. */
static inline uint32_t room_vertex(scene *s, uint32_t *map, int k, const float *lattice, const int *p)
{
  uint32_t *slot = &map[(p[2] * (k + 1) + p[1]) * (k + 1) + p[0]];
  if (*slot == 0xFFFFFFFFu) {
    put3(s->positions + 3 * s->vertex_count, lattice[p[0]], lattice[k + 1 + p[1]], lattice[2 * (k + 1) + p[2]]);
    *slot = s->vertex_count++;
  }
  return *slot;
}
static inline void make_room(scene *s, uint32_t n)
{
  rng r = {3};
  int k = (int)isqrt(n / 12), axis, side, i, j, c;
  uint32_t map_size, *map, at = 0;
  float *lattice;
  if (k < 1) k = 1;
  map_size = (uint32_t)(k + 1) * (uint32_t)(k + 1) * (uint32_t)(k + 1);
  map = (uint32_t *)xmalloc(sizeof(uint32_t) * map_size);
  memset(map, 0xFF, sizeof(uint32_t) * map_size);
  lattice = (float *)xmalloc(sizeof(float) * 3 * (size_t)(k + 1));
  for (axis = 0; axis < 3; ++axis)
    for (i = 0; i <= k; ++i)
    {
      float shift = i && i < k ? rng_range(&r, -0.375f, 0.375f) : 0.0f;
      lattice[axis * (k + 1) + i] = ((float)i - (float)k / 2 + shift) / (float)(10 + axis);
    }
  scene_alloc(s, (uint32_t)(6 * k * k + 2), (uint32_t)(12 * k * k), 1);
  s->vertex_count = 0;
  for (axis = 0; axis < 3; ++axis)
    for (side = 0; side < 2; ++side)
      for (i = 0; i < k; ++i)
        for (j = 0; j < k; ++j) {
          uint32_t v[4];
          for (c = 0; c < 4; ++c) {
            int p[3];
            p[axis] = side ? k : 0;
            p[(axis + 1) % 3] = i + (c & 1);
            p[(axis + 2) % 3] = j + (c >> 1);
            v[c] = room_vertex(s, map, k, lattice, p);
          }
          at = put_triangle(s, at, v[0], v[1], v[2]);
          at = put_triangle(s, at, v[3], v[2], v[1]);
        }
  free(lattice);
  free(map);
}

/* Heights: a coarse integer lattice, blended in integers. */
static inline void make_terrain(scene *s, uint32_t n)
{
  uint32_t m = isqrt(n / 2), i, j, at = 0;
  if (m < 1) m = 1;
  scene_alloc(s, (m + 1) * (m + 1), 2 * m * m, 1);
  for (j = 0; j <= m; ++j)
    for (i = 0; i <= m; ++i) {
      uint32_t height = 0, corner;
      for (corner = 0; corner < 4; ++corner) {
        uint32_t ci = i / 16 + (corner & 1), cj = j / 16 + (corner >> 1);
        uint32_t wi = corner & 1 ? i % 16 : 16 - i % 16, wj = corner >> 1 ? j % 16 : 16 - j % 16;
        rng r = {ci * 1000u + cj};
        height += wi * wj * (rng_u32(&r) % 1024);
      }
      height += (i * i * 7 + j * j * 11 + i * j * 5) % 4096;
      put3(s->positions + 3 * (j * (m + 1) + i), (float)i / 16.0f, (float)height / 65536.0f, (float)j / 16.0f);
    }
  for (j = 0; j < m; ++j)
    for (i = 0; i < m; ++i) {
      uint32_t v = j * (m + 1) + i;
      at = put_triangle(s, at, v, v + 1, v + m + 1);
      at = put_triangle(s, at, v + m + 2, v + m + 1, v + 1);
    }
}

static inline void make_slivers(scene *s, uint32_t n)        /* long thin diagonals, one like the other */
{
  rng r = {4};
  uint32_t i, k;
  scene_soup(s, n);
  for (i = 0; i < n; ++i) {
    float *p = s->positions + 9 * i;
    float length = rng_range(&r, 0.25f, 1);
    for (k = 0; k < 3; ++k) {
      p[k] = rng_range(&r, -1, 1);
      p[3 + k] = p[k] + rng_range(&r, -0.0625f, 0.0625f);
      p[3 + k] += rng_u32(&r) & 1 ? length : -length;
      p[6 + k] = p[k] + rng_range(&r, -0.015625f, 0.015625f);
    }
  }
}

/* Rows of boxes, turned by the rational rotation of the quaternion (4, 1, 2, -2), norm 25. */
static inline void make_city(scene *s, uint32_t n)
{
  static const float turn[3][3] = {{9, 20, 12}, {-12, 15, -16}, {-20, 0, 15}};
  static const int faces[12][3] = {{0,1,2},{3,2,1},{4,6,5},{7,5,6},{0,4,1},{5,1,4},{2,3,6},{7,6,3},{0,2,4},{6,4,2},{1,5,3},{7,3,5}};
  rng r = {5};
  uint32_t boxes = n / 12 ? n / 12 : 1, across = isqrt(boxes) + 1, b, c, f, k, at = 0;
  scene_alloc(s, 8 * boxes, 12 * boxes, 1);
  for (b = 0; b < boxes; ++b) {
    float lo[3], hi[3];
    put3(lo, (float)(b % across), 0, (float)(b / across));
    hi[0] = lo[0] + rng_range(&r, 0.5f, 1);
    hi[1] = rng_range(&r, 0.5f, 8);
    hi[2] = lo[2] + rng_range(&r, 0.5f, 1);
    for (c = 0; c < 8; ++c) {
      float x = c & 1 ? hi[0] : lo[0], y = c & 2 ? hi[1] : lo[1], z = c & 4 ? hi[2] : lo[2];
      for (k = 0; k < 3; ++k)
        s->positions[3 * (8 * b + c) + k] = (float)(((double)turn[k][0] * x + (double)turn[k][1] * y + (double)turn[k][2] * z) / 25.0);
    }
    for (f = 0; f < 12; ++f)
      at = put_triangle(s, at, 8 * b + (uint32_t)faces[f][0], 8 * b + (uint32_t)faces[f][1],
          8 * b + (uint32_t)faces[f][2]);
  }
}

static inline void make_huge_and_tiny(scene *s, uint32_t n)
{
  rng r = {6};
  uint32_t i, j, k;
  scene_soup(s, n);
  for (i = 0; i < n; ++i) {
    float c[3], size = i == n / 2 ? 512.0f : 0.015625f;
    for (k = 0; k < 3; ++k) c[k] = rng_range(&r, -1, 1);
    for (j = 0; j < 3; ++j)
      for (k = 0; k < 3; ++k) s->positions[9 * i + 3 * j + k] = c[k] + rng_range(&r, -size, size);
  }
}

/* 64 heaps, each inside one Morton cell, on a regular grid. */
static inline void make_clusters(scene *s, uint32_t n)
{
  rng r = {7};
  uint32_t i, j, k;
  scene_soup(s, n);
  for (i = 0; i < n; ++i)
    for (j = 0; j < 3; ++j)
      for (k = 0; k < 3; ++k)
        s->positions[9 * i + 3 * j + k] = (float)((i >> (2 * k)) & 3) + 0.5f + (float)rng_below(&r, 8) / 4194304.0f;
}

static inline void make_collinear(scene *s, uint32_t n)      /* triangles with area, their centres on one diagonal */
{
  uint32_t i;
  scene_soup(s, n);
  for (i = 0; i < n; ++i) {
    float a = (float)i / 64.0f, *p = s->positions + 9 * i;
    put3(p, a, a, a - 0.5f); put3(p + 3, a + 0.5f, a - 0.5f, a); put3(p + 6, a - 0.5f, a + 0.5f, a + 0.5f);
  }
}
static inline void make_flat_axis(scene *s, uint32_t n, uint32_t axis)
{
  uint32_t i;
  make_random(s, n);
  for (i = axis; i < 9 * n; i += 3) s->positions[i] = 3.25f;
}
static inline void make_flat_x(scene *s, uint32_t n) { make_flat_axis(s, n, 0); }
static inline void make_flat_y(scene *s, uint32_t n) { make_flat_axis(s, n, 1); }
static inline void make_flat_z(scene *s, uint32_t n) { make_flat_axis(s, n, 2); }

static inline void make_copies(scene *s, uint32_t n, uint32_t kinds)    /* the first few triangles over and over */
{
  uint32_t i;
  make_random(s, n);
  for (i = kinds; i < n; ++i) memcpy(s->positions + 9 * i, s->positions + 9 * (i % kinds), 9 * sizeof(float));
}
static inline void make_identical(scene *s, uint32_t n) { make_copies(s, n, 1); }
static inline void make_duplicates(scene *s, uint32_t n) { make_copies(s, n, 5); }

static inline void make_series(scene *s, uint32_t n)         /* size and place 2^e, from the denormals to 2^124 */
{
  uint32_t i;
  scene_soup(s, n);
  for (i = 0; i < n; ++i) {
    float a = power_of_two(124 - (int)(i % 274)), *p = s->positions + 9 * i;
    put3(p, a, 0, 0); put3(p + 3, a * 2, a, a / 2); put3(p + 6, a, a / 2, a);
  }
}
/* All with the same centre, each twice the size of the last. */
static inline void make_nested(scene *s, uint32_t n)
{
  uint32_t i;
  scene_soup(s, n);
  for (i = 0; i < n; ++i) {
    float a = power_of_two(60 - (int)(i % 120)), *p = s->positions + 9 * i;
    put3(p, -a, -a, -a); put3(p + 3, a, a, -a); put3(p + 6, -a, a, a);
  }
}
static inline void make_scaled(scene *s, uint32_t n, float scale)
{
  uint32_t i;
  make_random(s, n);
  for (i = 0; i < 9 * n; ++i) s->positions[i] *= scale;
}
static inline void make_1e38(scene *s, uint32_t n) { make_scaled(s, n, 1e38f); }
static inline void make_1e25(scene *s, uint32_t n) { make_scaled(s, n, 1e25f); }
static inline void make_1e_25(scene *s, uint32_t n) { make_scaled(s, n, 1e-25f); }
static inline void make_denormal(scene *s, uint32_t n) { make_scaled(s, n, 1e-40f); }
static inline void make_float_max(scene *s, uint32_t n)      /* corners of the range: differences overflow */
{
  rng r = {8};
  uint32_t i;
  scene_soup(s, n);
  for (i = 0; i < 9 * n; ++i)
    s->positions[i] = rng_u32(&r) & 1 ? FLT_MAX : rng_u32(&r) & 1 ? -FLT_MAX : rng_range(&r, -1, 1);
}
static inline void make_all_exponents(scene *s, uint32_t n)  /* any finite bit pattern */
{
  rng r = {9};
  uint32_t i;
  scene_soup(s, n);
  for (i = 0; i < 9 * n; ++i) {
    uint32_t bits;
    do bits = rng_u32(&r); while ((bits & 0x7F800000u) == 0x7F800000u);
    memcpy(&s->positions[i], &bits, sizeof bits);
  }
}

static inline void make_degenerate(scene *s, uint32_t n)     /* points and lines only */
{
  uint32_t i;
  make_random(s, n);
  for (i = 0; i < n; ++i) {
    float *p = s->positions + 9 * i;
    memcpy(p + 6, p, 3 * sizeof(float));
    if (i & 1) memcpy(p + 3, p, 3 * sizeof(float));
  }
}
static inline void make_one_point(scene *s, uint32_t n)      /* n times the very same point: a root without any area */
{
  uint32_t i;
  scene_soup(s, n);
  for (i = 0; i < 3 * n; ++i) put3(s->positions + 3 * i, 1, 2, 3);
}
static inline float bad_float(uint32_t i)
{
  static const uint32_t bits[5] = {0x7FC00000u, 0x7F800000u, 0xFF800000u, 0xFFC00001u, 0x7F800001u};
  float x;
  memcpy(&x, &bits[i % 5], sizeof x);
  return x;
}
/* One triangle in three has a NaN or an infinity somewhere. */
static inline void make_not_finite(scene *s, uint32_t n)
{
  rng r = {10};
  uint32_t i;
  make_random(s, n);
  for (i = 0; i < n; i += 3) {
    float bad = bad_float(rng_u32(&r));
    memcpy(s->positions + 9 * i + rng_below(&r, 9), &bad, sizeof bad);
  }
}
static inline void make_all_nan(scene *s, uint32_t n)
{
  uint32_t i;
  make_random(s, n);
  for (i = 0; i < n; ++i) { float bad = bad_float(i); memcpy(s->positions + 9 * i + i % 9, &bad, sizeof bad); }
}
static inline void make_signed_zeros(scene *s, uint32_t n)   /* -0 and +0 are the same place */
{
  rng r = {11};
  uint32_t i;
  scene_soup(s, n);
  for (i = 0; i < 9 * n; ++i) s->positions[i] = rng_u32(&r) & 1 ? 0.0f : rng_u32(&r) & 1 ? -0.0f : rng_unit(&r);
}
/* Small integer coordinates: equal costs and ties everywhere. */
static inline void make_grid(scene *s, uint32_t n)
{
  rng r = {12};
  uint32_t i;
  scene_soup(s, n);
  for (i = 0; i < 9 * n; ++i) s->positions[i] = (float)(rng_below(&r, 4) + i / 9 % 8) * 0.1f;
}

/* A chain of Morton codes 2^62, 2^61 .. 1, 0, which a linear BVH turns into a branch of 63 inner nodes, and a heap of
 * equal triangles at the end of it, or (make_deep_bushy) at every step. */
static inline void deep_triangle(float *p, uint32_t level, int max_level)
{
  uint32_t axis = level % 3;
  float a = (int)level > max_level ? 0.0f : power_of_two(-(int)(level / 3) - 1), b = power_of_two(-40);
  memset(p, 0, 9 * sizeof(float));
  p[axis] = p[3 + axis] = p[6 + axis] = a;
  p[3 + (axis + 1) % 3] = b;
  p[6 + (axis + 2) % 3] = b;
}
static inline void make_deep(scene *s, uint32_t n)
{
  uint32_t i;
  scene_soup(s, n);
  for (i = 0; i < n; ++i) deep_triangle(s->positions + 9 * i, i, 65);
  if (n) { put3(s->positions, 1, 1, 1); put3(s->positions + 3, 1, 1, 1); put3(s->positions + 6, 1, 1, 1); }
}
static inline void make_deep_bushy(scene *s, uint32_t n)
{
  uint32_t i;
  scene_soup(s, n);
  for (i = 0; i < n; ++i) deep_triangle(s->positions + 9 * i, i % 67, 65);
  if (n) { put3(s->positions, 1, 1, 1); put3(s->positions + 3, 1, 1, 1); put3(s->positions + 6, 1, 1, 1); }
}

typedef struct scene_def {
  const char *name;
  void      (*make)(scene *s, uint32_t n);
  uint32_t    full, quick;        /* triangles, about */
  int         flags;
} scene_def;

static const scene_def scene_defs[] = {
  {"random",        make_random,        12000, 1500, SCENE_ORDINARY},
  {"sphere",        make_sphere,        12000, 1500, SCENE_ORDINARY},
  {"rock",          make_rock,           8000, 1000, SCENE_ORDINARY},
  {"room",          make_room,          10000, 1200, SCENE_ORDINARY},
  {"terrain",       make_terrain,       20000, 1500, SCENE_ORDINARY},
  {"slivers",       make_slivers,        8000, 1000, SCENE_ORDINARY},
  {"city",          make_city,          12000, 1200, SCENE_ORDINARY},
  {"huge_and_tiny", make_huge_and_tiny, 10000, 1000, SCENE_ORDINARY},
  {"clusters",      make_clusters,       8000, 1000, 0},
  {"collinear",     make_collinear,      4000,  500, 0},
  {"flat_x",        make_flat_x,         3000,  500, 0},
  {"flat_y",        make_flat_y,         3000,  500, 0},
  {"flat_z",        make_flat_z,         3000,  500, 0},
  {"identical",     make_identical,      3000,  500, 0},
  {"duplicates",    make_duplicates,  1u << 20, 1u << 14, SCENE_BIG},
  /* more than a job's share of primitives, of sort keys; and exactly that, or one more or less */
  {"large_random",  make_random,        70000, 70000, SCENE_BIG},
  {"large_slivers", make_slivers,       60000, 20000, SCENE_BIG},
  {"large_terrain", make_terrain,      150000, 40000, SCENE_BIG},
  {"large_city",    make_city,         100000, 30000, SCENE_BIG},
  {"large_deep",    make_deep,         100000, 35000, SCENE_BIG},
  {"large_bushy",   make_deep_bushy,   140000, 40000, SCENE_BIG},
  {"large_holes",   make_not_finite,    70000, 35000, SCENE_BIG},
  {"n16383", make_random, 16383, 16383, SCENE_BIG}, {"n16384", make_random, 16384, 16384, SCENE_BIG}, {"n16385", make_random, 16385, 16385, SCENE_BIG},
  {"n65536", make_random, 65536, 65536, SCENE_BIG}, {"n65537", make_random, 65537, 65537, SCENE_BIG},
  {"series",        make_series,         1000,  274, SCENE_EXTREME},
  {"nested",        make_nested,          960,  240, SCENE_EXTREME},
  {"1e38",          make_1e38,           3000,  500, 0},
  {"1e25",          make_1e25,           3000,  500, 0},
  {"1e-25",         make_1e_25,          3000,  500, 0},
  {"denormal",      make_denormal,       3000,  500, SCENE_EXTREME},
  {"float_max",     make_float_max,      2000,  300, SCENE_EXTREME},
  {"all_exponents", make_all_exponents,  3000,  300, SCENE_EXTREME},
  {"degenerate",    make_degenerate,     3000,  500, 0},
  {"one_point",     make_one_point,      2000,  200, 0},
  {"not_finite",    make_not_finite,     4000,  500, 0},
  {"all_nan",       make_all_nan,         500,  100, 0},
  {"signed_zeros",  make_signed_zeros,   2000,  300, 0},
  {"grid",          make_grid,           5000,  500, 0},
  {"deep",          make_deep,           9000, 1100, 0},
  {"deep_bushy",    make_deep_bushy,     9000, 1100, 0},
  {"n0", make_random, 0, 0, 0}, {"n1", make_random, 1, 1, 0}, {"n2", make_random, 2, 2, 0}, {"n3", make_random, 3, 3, 0},
  {"n4", make_random, 4, 4, 0}, {"n7", make_random, 7, 7, 0}, {"n8", make_random, 8, 8, 0}, {"n9", make_random, 9, 9, 0},
  {"n1_nan",        make_all_nan,           1,    1, 0},
  {"n17_identical", make_identical,        17,   17, 0}
};
#define SCENE_COUNT (sizeof scene_defs / sizeof scene_defs[0])

static inline void scene_make(scene *s, const scene_def *def)
{
  memset(s, 0, sizeof *s);
#ifdef TRBVH_TEST_QUICK
  def->make(s, def->quick);
#else
  def->make(s, def->full);
#endif
  s->name = def->name;
}

#define PRESET_COUNT 4
static const char *const preset_names[PRESET_COUNT] = {"FAST", "MEDIUM", "HIGH", "BEST"};
static inline trbvh_options preset_options(int preset)
{
  static const trbvh_quality qualities[PRESET_COUNT] = {TRBVH_QUALITY_FAST, TRBVH_QUALITY_MEDIUM, TRBVH_QUALITY_HIGH,
      TRBVH_QUALITY_BEST};
  trbvh_options o;
  memset(&o, 0, sizeof o);
  o.quality = qualities[preset];
  return o;
}
static inline int same_bits(const void *a, const void *b, size_t size) { return size == 0 || memcmp(a, b, size) == 0; }
static inline int same_tree(const trbvh *a, const trbvh *b)             /* triangles too, where both have them */
{
  return a->node_count == b->node_count && a->ref_count == b->ref_count && a->prim_count == b->prim_count
      && same_bits(a->nodes, b->nodes, sizeof(trbvh_node) * a->node_count)
      && same_bits(a->prims, b->prims, sizeof(uint32_t) * a->ref_count)
      && (!a->triangles || !b->triangles
          || same_bits(a->triangles, b->triangles, sizeof(trbvh_triangle) * a->ref_count));
}

// >>allocator ---- counts, fails on demand, fills with garbage, checks what free is told ------------------------------
typedef struct counter {
  unsigned allocs, live, bad_frees;   /* calls that returned memory; not freed yet; wrong size, pointer or overrun */
  unsigned calls, fail_at;            /* all calls; the one that fails, from 1; 0 = none; ~0u = all of them */
  size_t   live_bytes, peak_bytes, largest, sizes[4];   /* sizes of the first allocations */
} counter;
typedef struct counter_head { uint64_t magic; uint64_t size; } counter_head;   /* 16 bytes: aligned as malloc aligns, no better */

static inline void *counter_alloc(void *user, size_t size)
{
  counter *c = (counter *)user;
  counter_head *head;
  unsigned char *p;
  if (++c->calls == c->fail_at || c->fail_at == ~0u) return NULL;
  head = (counter_head *)malloc(sizeof *head + size + 16);
  if (!head) return NULL;
  head->magic = 0x600DB10C600DB10Cu;
  head->size = size;
  p = (unsigned char *)(head + 1);
  memset(p, 0xA5, size);
  memset(p + size, 0x5A, 16);
  if (c->allocs < 4) c->sizes[c->allocs] = size;
  ++c->allocs; ++c->live;
  c->live_bytes += size;
  if (c->live_bytes > c->peak_bytes) c->peak_bytes = c->live_bytes;
  if (size > c->largest) c->largest = size;
  return p;
}
static inline void counter_free(void *user, void *ptr, size_t size)
{
  counter *c = (counter *)user;
  counter_head *head = (counter_head *)ptr - 1;
  unsigned char *p = (unsigned char *)ptr;
  int i;
  if (!ptr) { ++c->bad_frees; return; }
  if (head->magic != 0x600DB10C600DB10Cu || head->size != size) { ++c->bad_frees; return; }
  for (i = 0; i < 16; ++i) if (p[size + (size_t)i] != 0x5A) { ++c->bad_frees; break; }
  head->magic = 0;
  memset(p, 0xEE, size);
  --c->live;
  c->live_bytes -= size;
  free(head);
}
static inline trbvh_allocator counter_allocator(counter *c)
{
  trbvh_allocator a;
  a.alloc = counter_alloc;
  a.free = counter_free;
  a.user = c;
  return a;
}

// >>walk ---- an own check of a tree against its geometry -------------------------------------------------------------
typedef struct walk_info {
  uint32_t nodes, leaves, refs, depth, skipped;
  double   root_area, inner_area, leaf_area;     /* half areas; of inner nodes; of leaves times their primitives */
} walk_info;

static inline const void *bytes_at(const void *p, size_t offset) { return (const unsigned char *)p + offset; }

static inline void geometry_triangle(const trbvh_geometry *g, uint32_t i, float v[9])
{
  uint32_t c, index;
  size_t stride = g->position_stride ? g->position_stride : 12;
  for (c = 0; c < 3; ++c) {
    index = 3 * i + c;
    if (g->indices && g->index_size == 2) {
      uint16_t small;
      memcpy(&small, bytes_at(g->indices, 2 * (3 * (size_t)i + c)), 2);
      index = small;
    } else if (g->indices) memcpy(&index, bytes_at(g->indices, 4 * (3 * (size_t)i + c)), 4);
    memcpy(v + 3 * c, bytes_at(g->positions, stride * index), 12);
  }
}
static inline void geometry_box(const trbvh_geometry *g, uint32_t i, float box[6])     /* min[3], max[3] */
{
  if (g->boxes) memcpy(box, bytes_at(g->boxes, (g->box_stride ? g->box_stride : 24) * i), 24);
  else {
    float v[9];
    int k, c;
    geometry_triangle(g, i, v);
    memcpy(box, v, 12);
    memcpy(box + 3, v, 12);
    for (c = 3; c < 9; c += 3)
      for (k = 0; k < 3; ++k) {
        if (v[c + k] < box[k]) box[k] = v[c + k];
        if (v[c + k] > box[3 + k]) box[3 + k] = v[c + k];
      }
  }
}
static inline int is_finite(float x)
{
  uint32_t bits;
  memcpy(&bits, &x, 4);
  return (bits & 0x7F800000u) != 0x7F800000u;
}
static inline int geometry_skips(const trbvh_geometry *g, uint32_t i)
{
  float v[9];
  int k;
  if (g->boxes) {
    geometry_box(g, i, v);
    for (k = 0; k < 6; ++k) if (!is_finite(v[k])) return 1;
    return v[0] > v[3] || v[1] > v[4] || v[2] > v[5];
  }
  geometry_triangle(g, i, v);
  for (k = 0; k < 9; ++k) if (!is_finite(v[k])) return 1;
  return 0;
}
static inline double half_area(const trbvh_node *n)
{
  double x = (double)n->max[0] - n->min[0], y = (double)n->max[1] - n->min[1], z = (double)n->max[2] - n->min[2];
  return x * y + y * z + z * x;
}
static inline int node_has(const trbvh_node *n, const double *p, double slack)
{
  int k;
  for (k = 0; k < 3; ++k) if (!(p[k] >= n->min[k] - slack && p[k] <= n->max[k] + slack)) return 0;
  return 1;
}
static inline int some_leaf_has(const trbvh *bvh, const uint32_t *leaves, uint32_t count, const double *p, double slack)
{
  uint32_t i;
  for (i = 0; i < count; ++i) if (node_has(&bvh->nodes[leaves[i]], p, slack)) return 1;
  return 0;
}
/* Is every point of the triangle in one of these leaves? Corners exactly; points of the inside, and the places where an
 * edge passes through a face of a leaf box, within a few units in the last place. */
static inline int covered(const trbvh *bvh, const uint32_t *leaves, uint32_t count, const float *v)
{
  double big = 0, p[3];
  int i, j, k, e;
  uint32_t l;
  for (k = 0; k < 9; ++k) if (fabs((double)v[k]) > big) big = fabs((double)v[k]);
  for (i = 0; i < 3; ++i) {
    for (k = 0; k < 3; ++k) p[k] = v[3 * i + k];
    if (!some_leaf_has(bvh, leaves, count, p, 0)) return 0;
  }
  for (i = 0; i <= 12; ++i)
    for (j = 0; i + j <= 12; ++j) {
      for (k = 0; k < 3; ++k) p[k] = (v[k] * (double)(12 - i - j) + v[3 + k] * (double)i + v[6 + k] * (double)j) / 12;
      if (!some_leaf_has(bvh, leaves, count, p, 4 * FLT_EPSILON * big)) return 0;
    }
  for (l = 0; l < count && l < 32; ++l)
    for (k = 0; k < 6; ++k)
      for (e = 0; e < 3; ++e) {
        double a = v[3 * e + k % 3], b = v[3 * ((e + 1) % 3) + k % 3];
        double plane = k < 3 ? bvh->nodes[leaves[l]].min[k] : bvh->nodes[leaves[l]].max[k - 3], t;
        if ((a < plane) == (b < plane) || a == b) continue;
        t = (plane - a) / (b - a);
        for (j = 0; j < 3; ++j) p[j] = v[3 * e + j] + t * ((double)v[3 * ((e + 1) % 3) + j] - v[3 * e + j]);
        if (!some_leaf_has(bvh, leaves, count, p, 4 * FLT_EPSILON * big)) return 0;
      }
  return 1;
}

#define WALK_FAIL(...) do { snprintf(why, why_size, __VA_ARGS__); goto done; } while (0)

/* 1 = fine. split: primitives may stand in several leaves. The geometry is required. */
static inline int walk_tree(const trbvh *bvh, const trbvh_geometry *g, uint32_t max_leaf, int split, walk_info *info,
    char *why, size_t why_size)
{
  uint32_t n = bvh->node_count, refs = bvh->ref_count, i, j, stack_size = 0, reached = 0;
  uint32_t *stack = (uint32_t *)xmalloc(sizeof(uint32_t) * 2 * ((size_t)n + 1));         /* node, depth */
  uint32_t *leaf_of = (uint32_t *)xmalloc(sizeof(uint32_t) * ((size_t)refs + 1));        /* entry of prims[] -> leaf */
  uint32_t *first_ref = (uint32_t *)xmalloc(sizeof(uint32_t) * ((size_t)g->count + 2));  /* primitive -> its leaves in ... */
  uint32_t *leaves = (uint32_t *)xmalloc(sizeof(uint32_t) * ((size_t)refs + 1));         /* ... this list */
  unsigned char *seen = (unsigned char *)xmalloc((size_t)n + 1);
  int ok = 0, k;
  trbvh_node zero;
  memset(&zero, 0, sizeof zero);
  memset(info, 0, sizeof *info);
  memset(seen, 0, (size_t)n + 1);
  memset(leaf_of, 0xFF, sizeof(uint32_t) * ((size_t)refs + 1));
  memset(first_ref, 0, sizeof(uint32_t) * ((size_t)g->count + 2));
  for (i = 0; i < g->count; ++i) info->skipped += (uint32_t)geometry_skips(g, i);
  if (max_leaf == 0) max_leaf = 8;
  if (max_leaf > 16) max_leaf = 16;

  if (bvh->prim_count != g->count) WALK_FAIL("prim_count %u, geometry has %u", bvh->prim_count, g->count);
  if (g->count == info->skipped) {
    if (bvh->nodes || n || refs || bvh->triangles)
      WALK_FAIL("a tree without primitives has %u nodes, %u references", n, refs);
    ok = 1;
    goto done;
  }
  if (!bvh->nodes || !bvh->prims) WALK_FAIL("no nodes or no prims");
  if ((uintptr_t)bvh->nodes % 64) WALK_FAIL("nodes are not 64-byte aligned");
  if (bvh->wide) WALK_FAIL("wide is set");
  if (n < 2 || n % 2) WALK_FAIL("node_count %u", n);
  if (memcmp(&bvh->nodes[1], &zero, sizeof zero)) WALK_FAIL("nodes[1] is not zeros");
  if (!g->boxes && !(bvh->flags & TRBVH_NO_TRIANGLES) && !bvh->triangles) WALK_FAIL("no triangles");
  if ((g->boxes || (bvh->flags & TRBVH_NO_TRIANGLES)) && bvh->triangles)
    WALK_FAIL("triangles where there should be none");

  info->root_area = half_area(&bvh->nodes[0]);
  stack[0] = 0; stack[1] = 0; stack_size = 1;
  while (stack_size) {
    uint32_t at = stack[2 * --stack_size], depth = stack[2 * stack_size + 1];
    const trbvh_node *node = &bvh->nodes[at];
    if (seen[at]) WALK_FAIL("node %u is reached twice", at);
    seen[at] = 1;
    ++reached;
    if (depth > info->depth) info->depth = depth;
    for (k = 0; k < 3; ++k)
      if (!(node->min[k] <= node->max[k]) || !is_finite(node->min[k]) || !is_finite(node->max[k]))
        WALK_FAIL("node %u has a bad box", at);
    if (node->count == 0) {
      const trbvh_node *c = bvh->nodes + node->first;
      if (node->first % 2 || node->first < 2 || node->first >= n)
        WALK_FAIL("node %u: first child %u of %u", at, node->first, n);
      for (k = 0; k < 3; ++k) {
        float lo = c[0].min[k] < c[1].min[k] ? c[0].min[k] : c[1].min[k];
        float hi = c[0].max[k] > c[1].max[k] ? c[0].max[k] : c[1].max[k];
        if (!(node->min[k] <= lo && node->max[k] >= hi)) WALK_FAIL("node %u does not contain its children", at);
        if (node->min[k] != lo || node->max[k] != hi) WALK_FAIL("node %u is larger than its children", at);
      }
      info->inner_area += half_area(node);
      for (j = 0; j < 2; ++j) { stack[2 * stack_size] = node->first + j; stack[2 * stack_size++ + 1] = depth + 1; }
      if (stack_size >= n) WALK_FAIL("more nodes than there are");
    } else {
      ++info->leaves;
      info->leaf_area += half_area(node) * node->count;
      if (node->count > max_leaf) WALK_FAIL("leaf %u has %u primitives, %u are allowed", at, node->count, max_leaf);
      if (node->first >= refs || node->count > refs - node->first)
        WALK_FAIL("leaf %u: run %u + %u of %u", at, node->first, node->count, refs);
      for (i = node->first; i < node->first + node->count; ++i) {
        if (leaf_of[i] != 0xFFFFFFFFu) WALK_FAIL("entry %u is in leaves %u and %u", i, leaf_of[i], at);
        leaf_of[i] = at;
        if (bvh->prims[i] >= g->count) WALK_FAIL("entry %u is primitive %u of %u", i, bvh->prims[i], g->count);
        if (geometry_skips(g, bvh->prims[i])) WALK_FAIL("primitive %u should have been skipped", bvh->prims[i]);
        for (j = node->first; j < i; ++j)
          if (bvh->prims[i] == bvh->prims[j]) WALK_FAIL("primitive %u twice in leaf %u", bvh->prims[i], at);
      }
    }
  }
  info->nodes = reached + 1;
  info->refs = refs;
  if (info->nodes != n) WALK_FAIL("%u nodes reached and one of padding, node_count %u", reached, n);
  if (n != 2 * info->leaves) WALK_FAIL("%u nodes but %u leaves", n, info->leaves);
  if (info->depth > TRBVH_MAX_DEPTH) WALK_FAIL("depth %u", info->depth);

  for (i = 0; i < refs; ++i) {
    if (leaf_of[i] == 0xFFFFFFFFu) WALK_FAIL("entry %u is in no leaf", i);
    ++first_ref[bvh->prims[i] + 2];
  }
  for (i = 2; i < g->count + 2; ++i) first_ref[i] += first_ref[i - 1];
  for (i = 0; i < refs; ++i) leaves[first_ref[bvh->prims[i] + 1]++] = leaf_of[i];
  for (i = 0; i < g->count; ++i) {
    uint32_t times = first_ref[i + 1] - first_ref[i];
    const uint32_t *in = leaves + first_ref[i];
    if (geometry_skips(g, i)) continue;
    if (times == 0) WALK_FAIL("primitive %u is in no leaf", i);
    if (times > 1 && !split) WALK_FAIL("primitive %u is in %u leaves", i, times);
    if (times == 1 || g->boxes) {
      const trbvh_node *leaf = &bvh->nodes[in[0]];
      float box[6];
      geometry_box(g, i, box);
      for (k = 0; k < 3; ++k)
        if (!(leaf->min[k] <= box[k] && leaf->max[k] >= box[3 + k]))
          WALK_FAIL("leaf %u does not contain primitive %u", in[0], i);
    } else {
      float v[9];
      geometry_triangle(g, i, v);
      if (!covered(bvh, in, times, v)) WALK_FAIL("triangle %u is not covered by its %u leaves", i, times);
    }
  }
  for (i = 0; i < n; ++i) {                  /* no leaf is larger than the primitives in it */
    const trbvh_node *leaf = &bvh->nodes[i];
    float box[6], all[6] = {FLT_MAX, FLT_MAX, FLT_MAX, -FLT_MAX, -FLT_MAX, -FLT_MAX};
    for (j = leaf->first; j < leaf->first + leaf->count; ++j) {
      geometry_box(g, bvh->prims[j], box);
      for (k = 0; k < 3; ++k) {
        if (box[k] < all[k]) all[k] = box[k];
        if (box[3 + k] > all[3 + k]) all[3 + k] = box[3 + k];
      }
    }
    for (k = 0; leaf->count && k < 3; ++k)
      if (leaf->min[k] < all[k] || leaf->max[k] > all[3 + k]) WALK_FAIL("leaf %u is larger than its primitives", i);
  }
  for (i = 0; bvh->triangles && i < refs; ++i) {
    const trbvh_triangle *t = &bvh->triangles[i];
    float v[9], e[6];
    geometry_triangle(g, bvh->prims[i], v);
    for (k = 0; k < 6; ++k) {
      volatile float edge = v[3 + k] - v[k % 3];                    /* volatile: rounded to float, whatever the flags */
      e[k] = edge;
    }
    if (memcmp(t->v0, v, 12) || memcmp(t->e1, e, 12) || memcmp(t->e2, e + 3, 12) || t->prim != bvh->prims[i])
      WALK_FAIL("triangles[%u] is not primitive %u", i, bvh->prims[i]);
  }
  ok = 1;
done:
  free(stack); free(leaf_of); free(first_ref); free(leaves); free(seen);
  return ok;
}

/* Equation 1 of the paper from what walk_tree summed up. */
static inline double walk_sah(const walk_info *w, double cost_node, double cost_prim)
{
  return w->root_area > 0 ? (cost_node * w->inner_area + cost_prim * w->leaf_area) / w->root_area : 0;
}

#endif
