/* common.h - what the examples, the tests and the benchmark share. C99 and C++11; link with -lm.
 *
 *   vectors, boxes, time, random numbers, cameras
 *   ex_mesh_read, ex_mesh_parse   OBJ, PLY and STL files, also damaged ones
 *   ex_mesh_demo                  the built-in scene
 *   ex_png_write                  pictures
 *   ex_arguments, ex_scene_load, ex_make_rays   for programs that measure; where they fail the program ends
 *
 * All other functions that can fail return 1 for success and 0 for failure.
 */
#ifndef EX_COMMON_H
#define EX_COMMON_H

#include "../trbvh.h"
#include <float.h>
#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#ifndef TIME_UTC                       /* C99 and nothing more: POSIX has another clock */
  #include <sys/time.h>
#endif
#ifndef _WIN32
  #include <unistd.h>
#endif

// >>vectors -------------------------------------------------------------------------------------------------
#define EX_PI 3.14159265358979f

typedef struct ex_vec { float x, y, z; } ex_vec;

static inline ex_vec ex_v(float x, float y, float z) { ex_vec v; v.x = x; v.y = y; v.z = z; return v; }
static inline ex_vec ex_load(const float *p) { return ex_v(p[0], p[1], p[2]); }
static inline ex_vec ex_scale(ex_vec a, float s) { return ex_v(a.x * s, a.y * s, a.z * s); }
static inline ex_vec ex_add(ex_vec a, ex_vec b) { return ex_v(a.x + b.x, a.y + b.y, a.z + b.z); }
static inline ex_vec ex_sub(ex_vec a, ex_vec b) { return ex_v(a.x - b.x, a.y - b.y, a.z - b.z); }
static inline ex_vec ex_mul(ex_vec a, ex_vec b) { return ex_v(a.x * b.x, a.y * b.y, a.z * b.z); }
static inline ex_vec ex_mad(ex_vec a, ex_vec b, float s) { return ex_add(a, ex_scale(b, s)); }   /* a + s b */
static inline ex_vec ex_mix(ex_vec a, ex_vec b, float s) { return ex_mad(a, ex_sub(b, a), s); }
static inline float ex_dot(ex_vec a, ex_vec b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
static inline float ex_length(ex_vec a) { return sqrtf(ex_dot(a, a)); }
static inline ex_vec ex_cross(ex_vec a, ex_vec b)
{
  return ex_v(a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x);
}
static inline ex_vec ex_normalize(ex_vec a)   /* of the zero vector: the zero vector */
{
  float length = ex_length(a);
  return length > 0 ? ex_scale(a, 1 / length) : a;
}
/* Two unit vectors that make a right-handed frame with the unit vector n (Duff et al., JCGT 2017). */
static inline void ex_frame(ex_vec n, ex_vec *s, ex_vec *t)
{
  float sign = n.z < 0 ? -1.0f : 1.0f, a = -1 / (sign + n.z), b = n.x * n.y * a;
  *s = ex_v(1 + sign * n.x * n.x * a, sign * b, -sign * n.x);
  *t = ex_v(b, sign + n.y * n.y * a, -n.y);
}
static inline float ex_clamp(float x, float low, float high)   /* low also for a NaN */
{
  return x > low ? (x < high ? x : high) : low;
}
static inline float ex_smooth(float from, float to, float x)   /* 0 before from, 1 behind to */
{
  x = ex_clamp((x - from) / (to - from), 0, 1);
  return x * x * (3 - 2 * x);
}

typedef struct ex_box { float low[3], high[3]; } ex_box;

static inline ex_box ex_no_box(void)
{
  ex_box box = {{FLT_MAX, FLT_MAX, FLT_MAX}, {-FLT_MAX, -FLT_MAX, -FLT_MAX}};
  return box;
}
static inline void ex_extend(ex_box *box, const float p[3])
{
  for (int i = 0; i < 3; i++) {
    if (p[i] < box->low[i]) box->low[i] = p[i];
    if (p[i] > box->high[i]) box->high[i] = p[i];
  }
}

// >>time and chance -----------------------------------------------------------------------------------------
static inline double ex_now_ms(void)   /* wall clock */
{
#ifdef TIME_UTC
  struct timespec now;
  timespec_get(&now, TIME_UTC);
  return (double)now.tv_sec * 1e3 + (double)now.tv_nsec * 1e-6;
#else
  struct timeval now;
  gettimeofday(&now, NULL);
  return (double)now.tv_sec * 1e3 + (double)now.tv_usec * 1e-3;
#endif
}
static inline uint32_t ex_processors(void)
{
#ifdef _WIN32
  const char *count = getenv("NUMBER_OF_PROCESSORS");
  long processors = count ? atol(count) : 1;
#else
  long processors = sysconf(_SC_NPROCESSORS_ONLN);
#endif
  return processors > 1 ? (uint32_t)processors : 1;
}

/* PCG-RXS-M-XS (O'Neill 2014): any state will do as a seed, also consecutive numbers. */
static inline uint32_t ex_random_bits(uint32_t *state)
{
  *state = *state * 747796405u + 2891336453u;
  uint32_t x = ((*state >> ((*state >> 28) + 4)) ^ *state) * 277803737u;
  return (x >> 22) ^ x;
}
static inline float ex_random(uint32_t *state)   /* 0 <= x < 1 */
{
  return (float)(ex_random_bits(state) >> 8) * (1.0f / 16777216);
}
static inline float ex_random_in(uint32_t *state, float low, float high)
{
  return low + (high - low) * ex_random(state);
}
/* A direction around the unit vector n with density cos / pi, from two numbers in [0, 1). */
static inline ex_vec ex_cosine_direction(ex_vec n, float a, float b)
{
  ex_vec s, t;
  ex_frame(n, &s, &t);
  float radius = sqrtf(a), angle = 2 * EX_PI * b;
  ex_vec flat = ex_mad(ex_scale(s, radius * cosf(angle)), t, radius * sinf(angle));
  return ex_mad(flat, n, sqrtf(1 - a));
}

// >>camera --------------------------------------------------------------------------------------------------
typedef struct ex_camera { ex_vec eye, forward, right, up; } ex_camera;   /* right, up: half a picture long */

static inline trbvh_ray ex_ray(ex_vec origin, ex_vec dir, float tmax)
{
  trbvh_ray ray = {{origin.x, origin.y, origin.z}, 0, {dir.x, dir.y, dir.z}, tmax};
  return ray;
}
/* fov: vertical, in degrees; aspect: width / height */
static inline ex_camera ex_camera_look_at(ex_vec eye, ex_vec target, ex_vec up, float fov, float aspect)
{
  ex_camera camera;
  float half = tanf(fov * (EX_PI / 360));
  camera.eye = eye;
  camera.forward = ex_normalize(ex_sub(target, eye));
  ex_vec right = ex_normalize(ex_cross(camera.forward, up));
  camera.right = ex_scale(right, half * aspect);
  camera.up = ex_scale(ex_cross(right, camera.forward), half);
  return camera;
}
/* x and y: 0..1 from the picture's upper left corner; the direction has length 1 */
static inline trbvh_ray ex_camera_ray(const ex_camera *camera, float x, float y)
{
  ex_vec dir = ex_mad(ex_mad(camera->forward, camera->right, 2 * x - 1), camera->up, 1 - 2 * y);
  return ex_ray(camera->eye, ex_normalize(dir), 0);
}

// >>mesh ----------------------------------------------------------------------------------------------------
typedef struct ex_paint { uint8_t r, g, b, mirror; } ex_paint;   /* mirror: 255 like water, 0 not at all */
typedef struct ex_mesh {
  float    *positions;                 /* x, y, z */
  uint32_t  position_count;
  uint32_t *indices;                   /* three a triangle, all below position_count */
  uint32_t  triangle_count;
  ex_paint *paint;                     /* one a triangle, or NULL: files bring none */
} ex_mesh;

static inline void ex_mesh_free(ex_mesh *mesh)
{
  free(mesh->positions);
  free(mesh->indices);
  free(mesh->paint);
  memset(mesh, 0, sizeof *mesh);
}
static inline trbvh_geometry ex_mesh_geometry(const ex_mesh *mesh)
{
  trbvh_geometry geometry;
  memset(&geometry, 0, sizeof geometry);
  geometry.positions = mesh->positions;
  geometry.position_count = mesh->position_count;
  geometry.indices = mesh->indices;
  geometry.count = mesh->triangle_count;
  return geometry;
}
static inline ex_vec ex_mesh_corner(const ex_mesh *mesh, size_t triangle, int corner)
{
  return ex_load(mesh->positions + 3 * (size_t)mesh->indices[3 * triangle + (size_t)corner]);
}
static inline ex_vec ex_mesh_point(const ex_mesh *mesh, const trbvh_hit *hit, ex_vec *normal)
{
  ex_vec a = ex_mesh_corner(mesh, hit->prim, 0);
  ex_vec ab = ex_sub(ex_mesh_corner(mesh, hit->prim, 1), a);
  ex_vec ac = ex_sub(ex_mesh_corner(mesh, hit->prim, 2), a);
  *normal = ex_normalize(ex_cross(ab, ac));
  return ex_mad(ex_mad(a, ab, hit->u), ac, hit->v);
}
/* Corner i of all the triangles' corners; 0 where it is not finite. */
static inline int ex_mesh_finite_corner(const ex_mesh *mesh, size_t i, ex_vec *p)
{
  *p = ex_mesh_corner(mesh, i / 3, (int)(i % 3));
  return fabsf(p->x) <= FLT_MAX && fabsf(p->y) <= FLT_MAX && fabsf(p->z) <= FLT_MAX;
}
/* Of the corners that are finite; 0 where there is none. */
static inline int ex_mesh_bounds(const ex_mesh *mesh, ex_vec *low, ex_vec *high)
{
  ex_vec p;
  *low = ex_v(FLT_MAX, FLT_MAX, FLT_MAX);
  *high = ex_scale(*low, -1);
  for (size_t i = 0; i < 3 * (size_t)mesh->triangle_count; i++) {
    if (!ex_mesh_finite_corner(mesh, i, &p)) continue;
    *low = ex_v(fminf(low->x, p.x), fminf(low->y, p.y), fminf(low->z, p.z));
    *high = ex_v(fmaxf(high->x, p.x), fmaxf(high->y, p.y), fmaxf(high->z, p.z));
  }
  return low->x <= high->x;
}
/* Files do not say which way is up. Mostly it is y, unless the mesh lies flat in x and y. */
static inline ex_vec ex_guess_up(ex_vec low, ex_vec high)
{
  ex_vec size = ex_sub(high, low);
  return size.z < 0.7f * fminf(size.x, size.y) ? ex_v(0, 0, 1) : ex_v(0, 1, 0);
}
/* From the front, the right and above, as near as the mesh stays in the picture. */
static inline ex_camera ex_camera_fit(const ex_mesh *mesh, ex_vec up, float aspect)
{
  ex_vec front = up.y > 0 ? ex_v(0, 0, 1) : ex_v(0, -1, 0), low, high, p;
  ex_vec toward = ex_normalize(ex_mad(ex_mad(ex_v(0.62f, 0, 0), front, 0.75f), up, 0.42f));
  ex_camera camera = ex_camera_look_at(toward, ex_v(0, 0, 0), up, 32, aspect);
  ex_mesh_bounds(mesh, &low, &high);
  ex_vec center = ex_mix(low, high, 0.5f);
  /* With x, y in half pictures and z as depth, a camera moved by a to the right and by d back sees a corner
   * where -(z + d) <= x - a <= z + d: d - a must be at least left, and d + a at least right; y likewise. */
  float left = -FLT_MAX, right = -FLT_MAX, bottom = -FLT_MAX, top = -FLT_MAX;
  for (size_t i = 0; i < 3 * (size_t)mesh->triangle_count; i++) {
    if (!ex_mesh_finite_corner(mesh, i, &p)) continue;
    p = ex_sub(p, center);
    float x = ex_dot(p, camera.right) / ex_dot(camera.right, camera.right), z = ex_dot(p, camera.forward);
    float y = ex_dot(p, camera.up) / ex_dot(camera.up, camera.up);
    left = fmaxf(left, -x - z);
    right = fmaxf(right, x - z);
    bottom = fmaxf(bottom, -y - z);
    top = fmaxf(top, y - z);
  }
  float back = fmaxf(left + right, bottom + top) / 2;
  camera.eye = ex_mad(ex_mad(center, camera.right, (right - left) / 2), camera.up, (top - bottom) / 2);
  camera.eye = ex_mad(camera.eye, camera.forward, -1.08f * back);
  return camera;
}

/* A mesh that grows. Running out of memory or of 32-bit indices sets failed, after which nothing is added:
 * callers look once, at the end. */
typedef struct ex_builder {
  ex_mesh mesh;
  size_t position_room, triangle_room, paint_room;   /* allocated, in vertices and triangles */
  uint32_t painted;                    /* triangles */
  int failed;
} ex_builder;

/* Makes room for one more than count items. Returns array, which may have moved, and updates *room. */
static inline void *ex_grow(ex_builder *b, void *array, size_t *room, uint32_t count, size_t item)
{
  if (count < *room) return array;
  size_t more = *room + *room / 2 + 256;
  void *grown = count < UINT32_MAX && more <= SIZE_MAX / item ? realloc(array, more * item) : NULL;
  if (!grown) {
    b->failed = 1;
    return array;
  }
  *room = more;
  return grown;
}
static inline uint32_t ex_add_vertex(ex_builder *b, ex_vec p)   /* returns its index */
{
  ex_mesh *mesh = &b->mesh;
  mesh->positions = (float *)ex_grow(b, mesh->positions, &b->position_room, mesh->position_count,
                                     3 * sizeof(float));
  if (b->failed) return 0;
  float *position = mesh->positions + 3 * (size_t)mesh->position_count;
  position[0] = p.x;
  position[1] = p.y;
  position[2] = p.z;
  return mesh->position_count++;
}
static inline void ex_add_triangle(ex_builder *b, uint32_t v0, uint32_t v1, uint32_t v2)
{
  ex_mesh *mesh = &b->mesh;
  mesh->indices = (uint32_t *)ex_grow(b, mesh->indices, &b->triangle_room, mesh->triangle_count,
                                      3 * sizeof(uint32_t));
  if (b->failed) return;
  uint32_t *index = mesh->indices + 3 * (size_t)mesh->triangle_count++;
  index[0] = v0;
  index[1] = v1;
  index[2] = v2;
}

// >>reading meshes ------------------------------------------------------------------------------------------
/* All readers work on bytes in memory and trust none of them: every read is checked against the end, every
 * count against the bytes that are left (a header cannot ask for memory that the file does not fill), every
 * index against the vertices, and numbers are doubles, checked before they become anything smaller. */
typedef struct ex_reader {
  const char *at, *end;
  unsigned line;                       /* 0 in binary files */
  ex_builder built;
  const char *name;
  char *error;
  size_t error_size;
} ex_reader;

static inline int ex_fail(ex_reader *r, const char *format, ...)
{
  int used = r->line ? snprintf(r->error, r->error_size, "%s:%u: ", r->name, r->line)
                     : snprintf(r->error, r->error_size, "%s: ", r->name);
  if (used < 0 || (size_t)used >= r->error_size) return 0;
  va_list arguments;
  va_start(arguments, format);
  vsnprintf(r->error + used, r->error_size - (size_t)used, format, arguments);
  va_end(arguments);
  return 0;
}

static inline int ex_at_newline(const ex_reader *r) { return *r->at == '\n' || *r->at == '\r'; }
static inline int ex_at_blank(const ex_reader *r) { return *r->at == ' ' || *r->at == '\t'; }
static inline void ex_skip_newline(ex_reader *r)   /* "\n", "\r\n" or "\r" */
{
  if (*r->at++ == '\r' && r->at < r->end && *r->at == '\n') r->at++;
  r->line++;
}
static inline void ex_skip_line(ex_reader *r)
{
  while (r->at < r->end && !ex_at_newline(r)) r->at++;
  if (r->at < r->end) ex_skip_newline(r);
}
static inline void ex_skip_blanks(ex_reader *r)   /* a backslash at its end continues a line */
{
  for (;;) {
    if (r->at < r->end && ex_at_blank(r)) r->at++;
    else if (r->end - r->at > 1 && *r->at == '\\' && (r->at[1] == '\n' || r->at[1] == '\r')) {
      r->at++;
      ex_skip_newline(r);
    } else return;
  }
}
static inline void ex_skip_space(ex_reader *r)   /* blanks and newlines */
{
  while (r->at < r->end && (ex_at_blank(r) || ex_at_newline(r))) {
    if (ex_at_blank(r)) r->at++;
    else ex_skip_newline(r);
  }
}
/* The next word of this line in lower case, cut to what fits; "" at the end of the line. */
static inline const char *ex_word(ex_reader *r, char word[32])
{
  size_t length = 0;
  while (r->at < r->end && ex_at_blank(r)) r->at++;
  for (; r->at < r->end && !ex_at_blank(r) && !ex_at_newline(r); r->at++) {
    if (length < 31) word[length++] = (char)(*r->at >= 'A' && *r->at <= 'Z' ? *r->at + 32 : *r->at);
  }
  word[length] = 0;
  return word;
}

static inline double ex_power_of_ten(double x, int64_t exponent)   /* x * 10^exponent */
{
  static const double ten[] = {1e0, 1e1, 1e2, 1e3, 1e4, 1e5, 1e6, 1e7, 1e8, 1e9, 1e10, 1e11, 1e12, 1e13, 1e14,
                               1e15, 1e16, 1e17, 1e18, 1e19, 1e20, 1e21, 1e22};   /* the exact ones */
  if (exponent > 400) exponent = 400;
  if (exponent < -400) exponent = -400;
  for (; exponent > 22; exponent -= 22) x *= 1e22;
  for (; exponent < -22; exponent += 22) x /= 1e22;
  return exponent < 0 ? x / ten[-exponent] : x * ten[exponent];
}
/* A decimal number, "nan" or "inf" at the cursor, whatever the locale. Numbers of up to 15 digits with an
 * exponent up to 22 are exact to the double, others within a few of its last places. */
static inline int ex_number(ex_reader *r, double *number)
{
  const char *p = r->at, *end = r->end;
  int negative = 0, fraction = 0, any = 0;
  if (p < end && (*p == '-' || *p == '+')) negative = *p++ == '-';
  if (p < end && ((*p | 32) == 'n' || (*p | 32) == 'i')) {
    char word[32];
    r->at = p;
    if (!strncmp(ex_word(r, word), "nan", 3)) *number = NAN;
    else if (!strncmp(word, "inf", 3)) *number = negative ? -INFINITY : INFINITY;
    else return 0;
    return 1;
  }
  uint64_t digits = 0;
  int64_t exponent = 0;
  for (; p < end; p++) {
    unsigned digit = (unsigned)(unsigned char)*p - '0';
    if (*p == '.' && !fraction) fraction = 1;
    else if (digit > 9) break;
    else {
      any = 1;
      if (digits < UINT64_C(1000000000000000000)) {
        digits = digits * 10 + digit;
        exponent -= fraction;
      } else exponent += !fraction;
    }
  }
  if (!any) return 0;
  if (end - p > 1 && (*p | 32) == 'e') {
    const char *q = p + 1;
    int down = *q == '-', shift = 0;
    if (*q == '-' || *q == '+') q++;
    for (; q < end && *q >= '0' && *q <= '9'; p = ++q) {
      if (shift < 100000000) shift = shift * 10 + (*q - '0');
    }
    exponent += down ? -shift : shift;
  }
  *number = ex_power_of_ten((double)digits, digits ? exponent : 0);
  if (negative) *number = -*number;
  r->at = p;
  return 1;
}
static inline float ex_to_float(double x)   /* in C, the conversion of what is out of range is undefined */
{
  return x > FLT_MAX ? INFINITY : x < -FLT_MAX ? -INFINITY : (float)x;
}
static inline ex_vec ex_to_vec(const double *p)
{
  return ex_v(ex_to_float(p[0]), ex_to_float(p[1]), ex_to_float(p[2]));
}

/* A polygon, corner by corner, as the fan of triangles around its first. */
typedef struct ex_fan { uint32_t first, last; size_t corners; } ex_fan;
static inline void ex_add_corner(ex_builder *b, ex_fan *fan, uint32_t vertex)
{
  if (fan->corners == 0) fan->first = vertex;
  if (fan->corners >= 2) ex_add_triangle(b, fan->first, fan->last, vertex);
  fan->last = vertex;
  fan->corners++;
}

/* OBJ: v and f; a face may stand before its vertices, so their number is checked at the end. */
static inline int ex_read_obj(ex_reader *r)
{
  double highest = 0;                  /* vertex used, counted from 1 */
  unsigned highest_line = 0;
  for (; r->at < r->end; ex_skip_line(r)) {
    ex_skip_blanks(r);
    if (r->end - r->at < 2 || (r->at[1] != ' ' && r->at[1] != '\t')) continue;
    double number[3];
    if (*r->at == 'v') {
      r->at++;
      for (int axis = 0; axis < 3; axis++) {
        ex_skip_blanks(r);
        if (!ex_number(r, &number[axis])) return ex_fail(r, "a vertex needs three numbers");
      }
      ex_add_vertex(&r->built, ex_to_vec(number));
    } else if (*r->at == 'f') {
      ex_fan fan = {0, 0, 0};
      for (r->at++;;) {
        ex_skip_blanks(r);
        if (r->at == r->end || ex_at_newline(r) || *r->at == '#') break;
        if (!ex_number(r, number)) return ex_fail(r, "a face needs vertex numbers");
        double vertex = number[0];
        if (vertex < 0) vertex += 1 + (double)r->built.mesh.position_count;   /* -1 is the latest one */
        if (!(vertex >= 1 && vertex < UINT32_MAX)) return ex_fail(r, "a face uses vertex %.0f", number[0]);
        if (vertex > highest) {
          highest = vertex;
          highest_line = r->line;
        }
        ex_add_corner(&r->built, &fan, (uint32_t)vertex - 1);
        while (r->at < r->end && !ex_at_blank(r) && !ex_at_newline(r) && *r->at != '\\') {
          r->at++;                     /* over /vt/vn */
        }
      }
    }
  }
  r->line = highest_line;
  if (highest > r->built.mesh.position_count && !r->built.failed) {
    return ex_fail(r, "a face uses vertex %.0f of %u", highest, r->built.mesh.position_count);
  }
  return 1;
}

/* PLY: a header that says which elements follow, and of which properties each entry of them is made. */
enum { EX_PLY_ASCII, EX_PLY_LITTLE, EX_PLY_BIG };
enum { EX_PLY_SKIP = -1, EX_PLY_X, EX_PLY_Y, EX_PLY_Z, EX_PLY_FACE };
typedef struct ex_ply_property { int type, count_type, role; } ex_ply_property;   /* count_type -1: no list */
typedef struct ex_ply_element {
  char name[32];
  double count;
  int first, last;                     /* properties */
} ex_ply_element;
typedef struct ex_ply {
  int format, element_count, property_count;
  double vertex_count;
  ex_ply_element elements[32];
  ex_ply_property properties[256];
} ex_ply;

enum { EX_PLY_FLOAT = 6 };             /* below: integers, signed and unsigned in turn; above: double */
static const unsigned ex_ply_bytes[] = {1, 1, 2, 2, 4, 4, 4, 8};
static inline int ex_ply_type(const char *name)   /* into ex_ply_bytes, or -1 */
{
  static const char *const names[] = {
    "char", "int8", "uchar", "uint8", "short", "int16", "ushort", "uint16",
    "int", "int32", "uint", "uint32", "float", "float32", "double", "float64"
  };
  for (int i = 0; i < 16; i++) if (!strcmp(name, names[i])) return i / 2;
  return -1;
}
static inline int ex_ply_role(const char *element, const char *property, int is_list)
{
  if (!strcmp(element, "vertex") && !is_list && property[0] >= 'x' && property[0] <= 'z' && !property[1]) {
    return EX_PLY_X + property[0] - 'x';
  }
  int is_face = !strcmp(element, "face") && is_list &&
                (!strcmp(property, "vertex_indices") || !strcmp(property, "vertex_index"));
  return is_face ? EX_PLY_FACE : EX_PLY_SKIP;
}
static inline int ex_ply_header(ex_reader *r, ex_ply *ply)
{
  char word[32];
  memset(ply, 0, sizeof *ply);
  ply->format = -1;
  for (; r->at < r->end; ex_skip_line(r)) {
    ex_ply_element *element = ply->elements + ply->element_count;
    ex_word(r, word);
    if (!strcmp(word, "format")) {
      ex_word(r, word);
      if (!strcmp(word, "ascii")) ply->format = EX_PLY_ASCII;
      if (!strcmp(word, "binary_little_endian")) ply->format = EX_PLY_LITTLE;
      if (!strcmp(word, "binary_big_endian")) ply->format = EX_PLY_BIG;
    } else if (!strcmp(word, "element")) {
      if (ply->element_count == 32) return ex_fail(r, "more than 32 elements");
      ex_word(r, element->name);
      ex_skip_blanks(r);
      if (!ex_number(r, &element->count) || !(element->count >= 0)) return ex_fail(r, "an element's count");
      if (!strcmp(element->name, "vertex")) ply->vertex_count += element->count;
      element->first = element->last = ply->property_count;
      ply->element_count++;
    } else if (!strcmp(word, "property")) {
      if (!ply->element_count) return ex_fail(r, "a property before the first element");
      if (ply->property_count == 256) return ex_fail(r, "more than 256 properties");
      ex_ply_property *property = ply->properties + ply->property_count++;
      int is_list = !strcmp(ex_word(r, word), "list");
      property->count_type = is_list ? ex_ply_type(ex_word(r, word)) : -1;
      if (is_list && property->count_type < 0) return ex_fail(r, "unknown type '%s'", word);
      property->type = ex_ply_type(is_list ? ex_word(r, word) : word);
      if (property->type < 0) return ex_fail(r, "unknown type '%s'", word);
      property->role = ex_ply_role(element[-1].name, ex_word(r, word), is_list);
      element[-1].last++;
    } else if (!strcmp(word, "end_header")) {
      if (ply->format < 0) return ex_fail(r, "the header names no format that is known");
      return 1;
    }
  }
  return ex_fail(r, "the header has no end");
}
/* One value of any type as a double, which holds all of them exactly. */
static inline int ex_ply_value(ex_reader *r, int format, int type, double *value)
{
  if (format == EX_PLY_ASCII) {
    ex_skip_space(r);
    return ex_number(r, value);
  }
  size_t size = ex_ply_bytes[type];
  if ((size_t)(r->end - r->at) < size) return 0;
  uint64_t bits = 0;
  for (size_t i = 0; i < size; i++) {
    bits = bits << 8 | (unsigned char)r->at[format == EX_PLY_BIG ? i : size - 1 - i];
  }
  r->at += size;
  if (type < EX_PLY_FLOAT) {
    int is_signed = type % 2 == 0;
    double range = (double)(UINT64_C(1) << 8 * size);
    *value = (double)bits - (is_signed && (double)bits >= range / 2 ? range : 0);
  } else if (type == EX_PLY_FLOAT) {
    uint32_t word = (uint32_t)bits;
    float single;
    memcpy(&single, &word, sizeof single);
    *value = single;
  } else memcpy(value, &bits, sizeof *value);
  return 1;
}
/* A list; where it is a face, its triangles are added. The count needs no bound: each value takes bytes. */
static inline int ex_ply_list(ex_reader *r, const ex_ply *ply, const ex_ply_property *property, double entry)
{
  double count, vertex;
  ex_fan fan = {0, 0, 0};
  int ok = ex_ply_value(r, ply->format, property->count_type, &count);
  for (double i = 0; ok && i < count; i++) {
    ok = ex_ply_value(r, ply->format, property->type, &vertex);
    if (!ok || property->role != EX_PLY_FACE) continue;
    if (!(vertex >= 0 && vertex < ply->vertex_count)) {
      return ex_fail(r, "face %.0f uses vertex %.0f of %.0f", entry, vertex, ply->vertex_count);
    }
    ex_add_corner(&r->built, &fan, (uint32_t)vertex);
  }
  return ok ? 1 : ex_fail(r, "a list is cut off, or holds what is no number");
}
static inline int ex_ply_elements(ex_reader *r, const ex_ply *ply, const ex_ply_element *element)
{
  unsigned bytes = 0, roles = 0;       /* an entry takes at least so many bytes */
  for (int i = element->first; i < element->last; i++) {
    const ex_ply_property *property = ply->properties + i;
    int is_list = property->count_type >= 0;
    bytes += ply->format == EX_PLY_ASCII ? 1 : ex_ply_bytes[is_list ? property->count_type : property->type];
    if (property->role >= 0) roles |= 1u << property->role;
  }
  if (element->count * bytes > (double)(r->end - r->at) || (!bytes && element->count > 0)) {
    return ex_fail(r, "%.0f entries of '%s' do not fit in the file", element->count, element->name);
  }
  int is_vertex = !strcmp(element->name, "vertex");
  if (is_vertex && roles != 7) return ex_fail(r, "the vertices lack x, y or z");
  double position[3] = {0, 0, 0}, skipped;
  for (double entry = 0; entry < element->count; entry++) {
    for (int i = element->first; i < element->last; i++) {
      const ex_ply_property *property = ply->properties + i;
      if (property->count_type >= 0) {
        if (!ex_ply_list(r, ply, property, entry)) return 0;
      } else {
        double *value = property->role >= 0 ? &position[property->role] : &skipped;
        if (!ex_ply_value(r, ply->format, property->type, value)) {
          return ex_fail(r, "'%s' %.0f is cut off or not a number", element->name, entry);
        }
      }
    }
    if (is_vertex) ex_add_vertex(&r->built, ex_to_vec(position));
  }
  return 1;
}
static inline int ex_read_ply(ex_reader *r)
{
  ex_ply ply;
  const char *line_end = r->at;        /* of the first line */
  while (line_end < r->end && *line_end != '\n' && *line_end != '\r') line_end++;
  int lone_cr = r->end - line_end > 1 && line_end[0] == '\r' && line_end[1] != '\n';
  if (!ex_ply_header(r, &ply)) return 0;
  if (!(ply.vertex_count < UINT32_MAX)) return ex_fail(r, "more vertices than 32 bits can number");
  if (lone_cr && r->at < r->end) r->at++;   /* a "\n" behind the last "\r" would be data */
  else ex_skip_line(r);
  if (ply.format != EX_PLY_ASCII) r->line = 0;
  for (int i = 0; i < ply.element_count; i++) if (!ex_ply_elements(r, &ply, ply.elements + i)) return 0;
  return 1;
}

/* STL, binary: 80 bytes, the number of triangles, and 50 bytes for each: normal, three corners, two bytes. */
static inline int ex_is_binary_stl(const ex_reader *r)
{
  size_t size = (size_t)(r->end - r->at);
  if (size < 84) return 0;
  const unsigned char *count = (const unsigned char *)r->at + 80;
  uint32_t triangles = 0;
  for (int i = 3; i >= 0; i--) triangles = triangles << 8 | count[i];
  return (size - 84) / 50 == triangles && (size - 84) % 50 == 0;
}
static inline void ex_add_soup_vertex(ex_builder *b, const double position[3])   /* three make a triangle */
{
  uint32_t last = ex_add_vertex(b, ex_to_vec(position));
  if (last % 3 == 2) ex_add_triangle(b, last - 2, last - 1, last);
}
static inline int ex_read_binary_stl(ex_reader *r)
{
  for (r->at += 84; r->at < r->end; r->at += 2) {
    r->at += 12;
    for (int corner = 0; corner < 3; corner++) {
      double position[3] = {0, 0, 0};
      for (int axis = 0; axis < 3; axis++) ex_ply_value(r, EX_PLY_LITTLE, EX_PLY_FLOAT, &position[axis]);
      ex_add_soup_vertex(&r->built, position);
    }
  }
  return 1;
}
static inline int ex_read_ascii_stl(ex_reader *r)
{
  char word[32];
  for (; r->at < r->end; ex_skip_line(r)) {
    ex_word(r, word);
    if (!strcmp(word, "vertex")) {
      double position[3];
      for (int axis = 0; axis < 3; axis++) {
        ex_skip_blanks(r);
        if (!ex_number(r, &position[axis])) return ex_fail(r, "a vertex needs three numbers");
      }
      ex_add_soup_vertex(&r->built, position);
    } else if (!strcmp(word, "endloop") && r->built.mesh.position_count % 3) {
      return ex_fail(r, "a facet without three vertices");
    }
  }
  return r->built.mesh.position_count % 3 ? ex_fail(r, "the file ends in a facet") : 1;
}

/* Reads a file's content. name, which stands in front of errors, decides with its ending where the content
 * leaves it open. out is only written on success; free it with ex_mesh_free. error gets one line. */
static inline int ex_mesh_parse(const void *bytes, size_t size, const char *name, ex_mesh *out,
                                char *error, size_t error_size)
{
  ex_reader r;
  char word[32];
  memset(&r, 0, sizeof r);
  r.at = (const char *)bytes;
  r.end = r.at + size;
  r.name = name;
  r.error = error;
  r.error_size = error_size;

  size_t length = strlen(name);
  int named_stl = length >= 4 && (!strcmp(name + length - 4, ".stl") || !strcmp(name + length - 4, ".STL"));
  int ok;
  if (ex_is_binary_stl(&r)) ok = ex_read_binary_stl(&r);
  else {
    r.line = 1;
    ex_skip_space(&r);
    const char *start = r.at;
    ex_word(&r, word);
    r.at = start;
    if (!strcmp(word, "ply")) ok = ex_read_ply(&r);
    else if (!strcmp(word, "solid")) ok = ex_read_ascii_stl(&r);
    else if (named_stl) ok = ex_fail(&r, "neither a text STL file nor a whole binary one");
    else ok = ex_read_obj(&r);
  }
  r.line = 0;
  if (ok && r.built.failed) ok = ex_fail(&r, "not enough memory");
  if (ok && !r.built.mesh.triangle_count) ok = ex_fail(&r, "no triangles: is this an OBJ, PLY or STL file?");
  if (ok) *out = r.built.mesh;
  else ex_mesh_free(&r.built.mesh);
  return ok;
}
static inline int ex_mesh_read(const char *path, ex_mesh *out, char *error, size_t error_size)
{
  FILE *file = fopen(path, "rb");
  if (!file) {
    snprintf(error, error_size, "%s: cannot be opened", path);
    return 0;
  }
  char *bytes = NULL;
  size_t size = 0, room = 0, got = 0;
  do {                                 /* not asked how long it is: it may be a pipe */
    size += got;
    if (size == room) {
      room = room * 2 + 65536;
      char *grown = (char *)realloc(bytes, room);
      if (!grown) break;
      bytes = grown;
    }
    got = fread(bytes + size, 1, room - size, file);
  } while (got);
  int ok = size < room && !ferror(file);
  fclose(file);
  if (ok) ok = ex_mesh_parse(bytes, size, path, out, error, error_size);
  else snprintf(error, error_size, "%s: cannot be read", path);
  free(bytes);
  return ok;
}

// >>demo scene ----------------------------------------------------------------------------------------------
/* A round temple on an island in a lake, trees, and a cable-stayed bridge: large even triangles, clusters of
 * small ones and long thin diagonal ones, since a tree that is good at one of these is not yet good. Metres,
 * y up, the water at 0. All is made of surfaces over a grid, lathed profiles, rods, boxes, and leaves. */
enum { EX_DEMO_DETAIL = 8 };           /* 372 120 triangles; 1 is the least: 29 460 */

static inline float ex_lattice(int x, int y, int z)   /* a random number -1..1 for each point */
{
  uint32_t state = (uint32_t)x * 73856093u ^ (uint32_t)y * 19349663u ^ (uint32_t)z * 83492791u;
  return ex_random_in(&state, -1, 1);
}
static inline float ex_noise(ex_vec p)   /* smooth, -1..1 */
{
  float fx = floorf(p.x), fy = floorf(p.y), fz = floorf(p.z), sum = 0;
  float tx = ex_smooth(0, 1, p.x - fx), ty = ex_smooth(0, 1, p.y - fy), tz = ex_smooth(0, 1, p.z - fz);
  for (int i = 0; i < 8; i++) {
    int dx = i & 1, dy = i >> 1 & 1, dz = i >> 2;
    sum += ex_lattice((int)fx + dx, (int)fy + dy, (int)fz + dz) * (dx ? tx : 1 - tx) * (dy ? ty : 1 - ty) *
           (dz ? tz : 1 - tz);
  }
  return sum;
}
static inline float ex_fractal_noise(ex_vec p)   /* four octaves */
{
  return ex_noise(p) + ex_noise(ex_scale(p, 2.03f)) * 0.5f + ex_noise(ex_scale(p, 4.1f)) * 0.25f +
         ex_noise(ex_scale(p, 8.3f)) * 0.125f;
}

/* Triangles are painted in order: the next one, or all that have been added since. Colours are 0..255. */
static inline int ex_unpainted(const ex_builder *b)
{
  return b->painted < b->mesh.triangle_count && !b->failed;
}
static inline void ex_paint_next(ex_builder *b, ex_vec color, uint8_t mirror)
{
  b->mesh.paint = (ex_paint *)ex_grow(b, b->mesh.paint, &b->paint_room, b->painted, sizeof(ex_paint));
  if (b->failed) return;
  ex_paint paint = {(uint8_t)color.x, (uint8_t)color.y, (uint8_t)color.z, mirror};
  b->mesh.paint[b->painted++] = paint;
}
static inline void ex_paint_rest(ex_builder *b, float red, float green, float blue, uint8_t mirror)
{
  while (ex_unpainted(b)) ex_paint_next(b, ex_v(red, green, blue), mirror);
}
static inline void ex_add_quad(ex_builder *b, uint32_t v0, uint32_t v1, uint32_t v2, uint32_t v3)
{
  ex_add_triangle(b, v0, v1, v2);
  ex_add_triangle(b, v0, v2, v3);
}
/* point(shape, u, v) for u and v from 0 to 1, nu by nv quads; closed: u = 1 is u = 0 again. */
static inline void ex_add_surface(ex_builder *b, ex_vec (*point)(const void *shape, float u, float v),
                                  const void *shape, unsigned nu, unsigned nv, int closed)
{
  uint32_t first = b->mesh.position_count, across = nu + !closed;
  for (uint32_t j = 0; j <= nv; j++) {
    float v = (float)j / (float)nv;
    for (uint32_t i = 0; i < across; i++) ex_add_vertex(b, point(shape, (float)i / (float)nu, v));
  }
  for (uint32_t j = 0; j < nv; j++) {
    for (uint32_t i = 0; i < nu; i++) {
      uint32_t here = first + j * across + i, right = first + j * across + (i + 1) % across;
      ex_add_quad(b, here, right, right + across, here + across);
    }
  }
}
static inline void ex_add_rod(ex_builder *b, ex_vec from, ex_vec to, float from_radius, float to_radius,
                              unsigned sides)
{
  uint32_t first = b->mesh.position_count;
  ex_vec s, t;
  ex_frame(ex_normalize(ex_sub(to, from)), &s, &t);
  for (uint32_t i = 0; i < sides; i++) {
    float angle = 2 * EX_PI * (float)i / (float)sides;
    ex_vec out = ex_mad(ex_scale(s, cosf(angle)), t, sinf(angle));
    ex_add_vertex(b, ex_mad(from, out, from_radius));
    ex_add_vertex(b, ex_mad(to, out, to_radius));
  }
  for (uint32_t i = 0; i < sides; i++) {
    uint32_t here = first + 2 * i, next = first + 2 * ((i + 1) % sides);
    ex_add_quad(b, here, next, next + 1, here + 1);
  }
}
static inline void ex_add_box(ex_builder *b, ex_vec center, ex_vec x, ex_vec y, ex_vec z)   /* half edges */
{
  uint32_t v = b->mesh.position_count;
  for (int i = 0; i < 8; i++) {
    ex_vec corner = ex_mad(ex_mad(center, x, i & 1 ? 1 : -1), y, i & 2 ? 1 : -1);
    ex_add_vertex(b, ex_mad(corner, z, i & 4 ? 1 : -1));
  }
  ex_add_quad(b, v, v + 2, v + 3, v + 1);
  ex_add_quad(b, v + 4, v + 5, v + 7, v + 6);
  ex_add_quad(b, v, v + 1, v + 5, v + 4);
  ex_add_quad(b, v + 2, v + 6, v + 7, v + 3);
  ex_add_quad(b, v, v + 4, v + 6, v + 2);
  ex_add_quad(b, v + 1, v + 3, v + 7, v + 5);
}
/* A profile turned around a vertical axis; x: radius, y: height, z: how deep flutes cut in, relative to x. */
typedef struct ex_lathe { ex_vec center; const ex_vec *profile; unsigned points; float flutes; } ex_lathe;
static inline ex_vec ex_lathe_point(const void *shape, float u, float v)
{
  const ex_lathe *lathe = (const ex_lathe *)shape;
  ex_vec p = lathe->profile[(unsigned)(v * (float)(lathe->points - 1) + 0.5f)];
  float angle = 2 * EX_PI * u, radius = p.x * (1 - p.z * fabsf(sinf(angle * lathe->flutes / 2)));
  return ex_add(lathe->center, ex_v(radius * cosf(angle), p.y, radius * sinf(angle)));
}
static inline void ex_add_lathe(ex_builder *b, ex_vec center, const ex_vec *profile, unsigned points,
                                unsigned sides, float flutes)
{
  ex_lathe lathe = {center, profile, points, flutes};
  ex_add_surface(b, ex_lathe_point, &lathe, sides, points - 1, 1);
}

static inline float ex_ground(float x, float z)   /* height of the island, the lake's bottom, and the hills */
{
  float radius = sqrtf(x * x + z * z), warp = ex_fractal_noise(ex_v(x * 0.05f, 0, z * 0.05f));
  float shore = radius + 4 * warp, behind = ex_smooth(40, -60, z);
  float island = 5.2f * (1 - ex_smooth(16, 28, shore)), land = 5.4f * ex_smooth(37, 52, shore);
  float hills = (2 + 17 * behind) * ex_smooth(46, 88, radius) * (0.8f + 0.7f * warp);
  return island + land + hills - 3.6f + 0.05f * ex_noise(ex_v(x, 0, z));
}
static inline float ex_denser_within(float u, float half_size)   /* finer towards the middle */
{
  float t = 2 * u - 1;
  return half_size * t * (0.45f + 0.55f * t * t);
}
static inline ex_vec ex_ground_point(const void *half_size, float u, float v)
{
  float half = *(const float *)half_size, x = ex_denser_within(u, half), z = ex_denser_within(v, half);
  return ex_v(x, ex_ground(x, z), z);
}
static inline ex_vec ex_water_point(const void *half_size, float u, float v)
{
  float half = *(const float *)half_size, x = ex_denser_within(u, half), z = ex_denser_within(v, half);
  return ex_v(x, 0.022f * ex_noise(ex_v(x * 0.9f, 0, z * 0.9f)), z);
}
static inline void ex_add_landscape(ex_builder *b, unsigned detail)
{
  float ground = 100, water = 56;
  ex_add_surface(b, ex_ground_point, &ground, 30 * detail, 30 * detail, 0);
  while (ex_unpainted(b)) {
    ex_vec p[3];
    for (int i = 0; i < 3; i++) p[i] = ex_mesh_corner(&b->mesh, b->painted, i);
    ex_vec normal = ex_normalize(ex_cross(ex_sub(p[1], p[0]), ex_sub(p[2], p[0])));
    ex_vec middle = ex_scale(ex_add(ex_add(p[0], p[1]), p[2]), 1.0f / 3);
    float tint = ex_fractal_noise(ex_scale(middle, 0.17f));
    float grass = ex_smooth(0.5f, 0.9f, middle.y + 0.3f * tint);
    ex_vec color = ex_mix(ex_v(186, 168, 128), ex_v(92 + 14 * tint, 106 + 8 * tint, 54), grass);
    ex_paint_next(b, ex_mix(ex_v(120, 112, 104), color, ex_smooth(0.78f, 0.9f, fabsf(normal.y))), 0);
  }
  ex_add_surface(b, ex_water_point, &water, 12 * detail, 12 * detail, 0);
  ex_paint_rest(b, 30, 74, 80, 255);
}

/* A torus knot, standing; its tube is ribbed. */
static inline ex_vec ex_knot_center(float angle)
{
  float radius = 2.4f + 1.0f * cosf(3 * angle);
  return ex_v(radius * cosf(2 * angle), radius * sinf(2 * angle), 1.0f * sinf(3 * angle));
}
static inline ex_vec ex_knot_point(const void *center, float u, float v)
{
  float angle = 2 * EX_PI * v, around = 2 * EX_PI * u, radius = 0.52f + 0.05f * cosf(5 * around + 24 * angle);
  ex_vec p = ex_knot_center(angle), core = ex_v(2.4f * cosf(2 * angle), 2.4f * sinf(2 * angle), 0);
  ex_vec along = ex_normalize(ex_sub(ex_knot_center(angle + 0.01f), p)), out = ex_normalize(ex_sub(p, core));
  ex_vec side = ex_normalize(ex_cross(along, out));
  p = ex_mad(ex_mad(p, out, radius * cosf(around)), side, radius * sinf(around));
  return ex_add(*(const ex_vec *)center, p);
}
static inline ex_vec ex_dome_point(int ring, int spoke)
{
  float height = EX_PI / 2 * (float)ring / 9, angle = EX_PI / 32 * (float)(2 * spoke + ring % 2);
  float radius = 9.9f * cosf(height);
  return ex_v(radius * cosf(angle), 12.1f + 6.5f * sinf(height), radius * sinf(angle));
}
static inline void ex_add_temple(ex_builder *b, unsigned detail)
{
  static const ex_vec steps[] = {
    {14, -2, 0}, {14, 0.4f, 0}, {13.4f, 0.4f, 0}, {13.4f, 0.8f, 0}, {12.8f, 0.8f, 0}, {12.8f, 1.2f, 0},
    {3.2f, 1.2f, 0}, {3.2f, 1.5f, 0}, {2.7f, 1.5f, 0}, {2.7f, 2.7f, 0}, {2.9f, 2.7f, 0}, {2.9f, 2.9f, 0},
    {0, 2.9f, 0}
  };
  static const ex_vec ring[] = {
    {9.2f, 9.2f, 0}, {10.9f, 9.2f, 0}, {10.9f, 9.8f, 0}, {11.0f, 9.8f, 0}, {11.0f, 10.3f, 0},
    {11.5f, 10.5f, 0}, {11.5f, 10.7f, 0}, {9.0f, 10.7f, 0}, {9.2f, 9.2f, 0}
  };
  static const ex_vec column[] = {
    {0.8f, 1.2f, 0}, {0.95f, 1.3f, 0}, {0.95f, 1.45f, 0}, {0.8f, 1.55f, 0}, {0.74f, 1.65f, 0},
    {0.72f, 1.7f, 0.12f}, {0.72f, 3.2f, 0.14f}, {0.7f, 4.7f, 0.14f}, {0.66f, 6.2f, 0.14f},
    {0.6f, 7.7f, 0.14f}, {0.57f, 8.4f, 0.12f}, {0.57f, 8.5f, 0}, {0.64f, 8.6f, 0}, {0.95f, 9.0f, 0},
    {0.95f, 9.2f, 0}
  };
  ex_vec center = ex_v(0, 1.4f, 0), knot = ex_v(0, 8.2f, 0);
  ex_add_lathe(b, center, steps, 13, 12 * detail, 0);
  ex_add_lathe(b, center, ring, 9, 12 * detail, 0);
  for (int i = 0; i < 12; i++) {
    float angle = EX_PI / 6 * ((float)i + 0.35f);
    ex_add_lathe(b, ex_v(10.2f * cosf(angle), center.y, 10.2f * sinf(angle)), column, 15, 10 * detail, 20);
  }
  for (int i = 0; i < 96; i++) {       /* dentils */
    float angle = EX_PI / 48 * (float)i, c = cosf(angle), s = sinf(angle);
    ex_add_box(b, ex_v(11.1f * c, 11.55f, 11.1f * s), ex_v(0.2f * c, 0, 0.2f * s), ex_v(0, 0.13f, 0),
               ex_v(-0.2f * s, 0, 0.2f * c));
  }
  ex_paint_rest(b, 208, 200, 184, 0);
  ex_add_surface(b, ex_knot_point, &knot, 5 * detail, 40 * detail, 1);
  ex_paint_rest(b, 214, 146, 58, 60);
  for (int level = 0; level < 8; level++) {   /* a dome of crossing struts */
    for (int spoke = 0; spoke < 32; spoke++) {
      ex_vec p = ex_dome_point(level, spoke);
      ex_add_rod(b, p, ex_dome_point(level, spoke + 1), 0.1f, 0.1f, 6);
      if (level == 7) continue;
      ex_add_rod(b, p, ex_dome_point(level + 1, spoke), 0.1f, 0.1f, 6);
      ex_add_rod(b, p, ex_dome_point(level + 1, spoke + 2 * (level % 2) - 1), 0.1f, 0.1f, 6);
    }
  }
  ex_paint_rest(b, 96, 132, 120, 0);
}

/* The bridge's deck: at 0..1 of its length from the island, metres to its side and above it. */
static inline ex_vec ex_deck_point(float at, float side, float above)
{
  ex_vec along = ex_v(0.98f, 0, 0.2f), across = ex_v(-0.2f, 0, 0.98f);
  return ex_mad(ex_mad(ex_v(0, 1.8f + 6 * at * (1 - at) + above, 0), along, 13 + 42 * at), across, side);
}
static inline void ex_add_bridge(ex_builder *b, unsigned detail)
{
  unsigned planks = 20 * detail;
  for (unsigned i = 0; i < planks; i++) {
    ex_vec middle = ex_deck_point(((float)i + 0.5f) / (float)planks, 0, 0);
    ex_vec next = ex_deck_point(((float)i + 1.4f) / (float)planks, 0, 0);
    ex_add_box(b, middle, ex_scale(ex_sub(next, middle), 0.5f), ex_v(0, 0.06f, 0),
               ex_scale(ex_sub(ex_deck_point(0, 1, 0), ex_deck_point(0, 0, 0)), 1.6f));
  }
  ex_paint_rest(b, 142, 98, 62, 0);
  for (float side = -1.45f; side < 2; side += 2.9f) {
    for (int post = 0; post < 28; post++) {
      ex_vec hand = ex_deck_point((float)post / 28, side, 1);
      ex_add_rod(b, ex_deck_point((float)post / 28, side, 0), hand, 0.04f, 0.04f, 6);
      ex_add_rod(b, hand, ex_deck_point((float)(post + 1) / 28, side, 1), 0.05f, 0.05f, 6);
    }
    for (float at = 0.27f; at < 1; at += 0.46f) {   /* pylons: legs that meet at the top, and cables */
      ex_add_rod(b, ex_deck_point(at, 1.4f * side, -7), ex_deck_point(at, 0, 13), 0.32f, 0.16f, 16);
      for (int cable = -5; cable <= 5; cable++) {
        ex_vec top = ex_deck_point(at, 0.03f * side, 10.4f + 0.5f * (float)abs(cable));
        if (cable) ex_add_rod(b, top, ex_deck_point(at + 0.042f * (float)cable, side, 0), 0.035f, 0.035f, 6);
      }
    }
  }
  ex_paint_rest(b, 226, 224, 220, 0);
}

/* A branch and its branches; the last ones end in leaves. */
static inline void ex_add_branch(ex_builder *b, uint32_t *seed, ex_vec from, ex_vec direction, float length,
                                 int order, unsigned leaves, ex_vec color)
{
  ex_vec to = ex_mad(from, direction, length), s, t;
  ex_add_rod(b, from, to, length * 0.07f, length * 0.045f, (unsigned)(order + 3));
  ex_paint_rest(b, 104, 82, 62, 0);
  for (unsigned i = 0; i < leaves && order == 0; i++) {
    float x = ex_random_in(seed, -1, 1), y = ex_random_in(seed, -0.6f, 1), z = ex_random_in(seed, -1, 1);
    ex_vec out = ex_v(x, y, z);
    ex_vec stem = ex_mad(to, out, length * 0.9f);
    float size = length * ex_random_in(seed, 0.17f, 0.32f);
    ex_frame(ex_normalize(ex_add(out, ex_v(0, 1, 0))), &s, &t);
    uint32_t v = ex_add_vertex(b, stem);
    ex_add_vertex(b, ex_mad(ex_mad(stem, s, size), t, size * 0.6f));
    ex_add_vertex(b, ex_mad(stem, s, size * 2));
    ex_add_vertex(b, ex_mad(ex_mad(stem, s, size), t, -size * 0.6f));
    ex_add_quad(b, v, v + 1, v + 2, v + 3);
  }
  ex_paint_rest(b, color.x, color.y, color.z, 0);
  float turn = ex_random_in(seed, 0, 2 * EX_PI);
  ex_frame(direction, &s, &t);
  for (int i = 0; i < 4 && order > 0; i++) {
    float angle = turn + EX_PI / 2 * (float)i + ex_random_in(seed, -0.4f, 0.4f), lean = i ? 0.85f : 0.25f;
    ex_vec out = ex_mad(ex_scale(s, cosf(angle)), t, sinf(angle));
    ex_vec next = ex_normalize(ex_add(ex_mad(direction, out, lean), ex_v(0, 0.12f, 0)));
    ex_vec start = ex_mad(from, direction, length * (i ? ex_random_in(seed, 0.6f, 1) : 1));
    ex_add_branch(b, seed, start, next, length * ex_random_in(seed, 0.6f, 0.8f), order - 1, leaves, color);
  }
}
static inline ex_vec ex_rock_point(const void *center, float u, float v)
{
  ex_vec c = *(const ex_vec *)center;
  float radius = sinf(EX_PI * v), angle = 2 * EX_PI * u;
  ex_vec p = ex_v(radius * cosf(angle), 0.7f * cosf(EX_PI * v), radius * sinf(angle));
  return ex_mad(c, p, 0.9f + 0.35f * ex_fractal_noise(ex_add(ex_scale(p, 1.3f), c)));
}
static inline void ex_add_nature(ex_builder *b, unsigned detail)
{
  uint32_t seed = 7;
  for (int trees = 0, rocks = 0; trees < 54 || rocks < 36;) {
    float x = ex_denser_within(ex_random(&seed), 76), z = ex_denser_within(ex_random(&seed), 76);
    ex_vec foot = ex_v(x, ex_ground(x, z) - 0.2f, z);
    int near_bridge = x > 0 && fabsf(0.98f * z - 0.2f * x) < 5;
    float radius = sqrtf(x * x + z * z);
    int on_island = radius < 30;
    if (z > (on_island ? 2 : 20)) continue;   /* these would stand in the picture's way */
    if (rocks < 36 && fabsf(foot.y) < 0.4f && !near_bridge) {
      ex_add_surface(b, ex_rock_point, &foot, 3 * detail, 2 * detail, 1);
      ex_paint_rest(b, 140, 132, 122, 0);
      rocks++;
    }
    if (trees < 54 && foot.y > (on_island ? 0.3f : 1.0f) && radius > 15.5f && !near_bridge) {
      float size = ex_random_in(&seed, 2.0f, 3.6f) * (on_island ? 0.45f : 1), hue = ex_random(&seed);
      ex_vec color = ex_mix(ex_v(62, 94, 40), hue > 0.85f ? ex_v(186, 108, 40) : ex_v(112, 128, 52), hue);
      ex_add_branch(b, &seed, foot, ex_v(0, 1, 0), size, detail > 3 ? 3 : 2, 2 * detail, color);
      trees++;
    }
  }
}
/* Returns 0 when there is not enough memory. */
static inline int ex_mesh_demo(ex_mesh *out, unsigned detail)
{
  ex_builder b;
  memset(&b, 0, sizeof b);
  ex_add_landscape(&b, detail);
  ex_add_temple(&b, detail);
  ex_add_bridge(&b, detail);
  ex_add_nature(&b, detail);
  if (b.failed) ex_mesh_free(&b.mesh);
  else *out = b.mesh;
  return !b.failed;
}
static inline ex_camera ex_demo_camera(float aspect)
{
  return ex_camera_look_at(ex_v(-26, 14, 56), ex_v(6.5f, 5, 0), ex_v(0, 1, 0), 36, aspect);
}

// >>png -----------------------------------------------------------------------------------------------------
/* Deflate (RFC 1951) with Huffman codes made for each block of tokens, and matches found along chains of
 * positions with the same hash. A token is a literal byte, or distance << 16 | length of a match (3..257: 258
 * has a code of its own, which is not worth a special case). */
enum { EX_LITERALS = 286, EX_DISTANCES = 30, EX_SYMBOLS = EX_LITERALS + EX_DISTANCES, EX_BLOCK = 1 << 15,
       EX_WINDOW = 1 << 15, EX_HASHES = 1 << 15, EX_CHAIN = 128 };

typedef struct ex_bits { uint8_t *data; size_t size; uint64_t pending; unsigned pending_count; } ex_bits;
static inline void ex_put(ex_bits *out, uint32_t value, unsigned count)   /* lowest bit first */
{
  out->pending |= (uint64_t)value << out->pending_count;
  for (out->pending_count += count; out->pending_count >= 8; out->pending_count -= 8, out->pending >>= 8) {
    out->data[out->size++] = (uint8_t)out->pending;
  }
}

/* Lengths of at most limit bits from the symbols' counts, and the canonical codes of these, lowest bit first.
 * Where the tree is too deep, rarer symbols are made less rare until it is not. */
static inline void ex_huffman(const uint32_t *counts, int symbols, int limit, uint8_t *lengths,
                              uint16_t *codes)
{
  for (int damp = 0, deepest = limit + 1; deepest > limit; damp++) {
    uint32_t weight[2 * EX_LITERALS];
    int parent[2 * EX_LITERALS], depth[2 * EX_LITERALS], nodes = symbols;
    for (int i = 0; i < symbols; i++) weight[i] = counts[i] ? (counts[i] >> damp) + 1 : 0;
    for (;; nodes++) {                 /* join the two lightest nodes; what has a parent weighs 0 */
      int a = -1, b = -1;
      for (int i = 0; i < nodes; i++) {
        if (!weight[i]) continue;
        if (a < 0 || weight[i] < weight[a]) {
          b = a;
          a = i;
        } else if (b < 0 || weight[i] < weight[b]) b = i;
      }
      if (b < 0) break;
      weight[nodes] = weight[a] + weight[b];
      weight[a] = weight[b] = 0;
      parent[a] = parent[b] = nodes;
    }
    deepest = 0;
    for (int i = nodes; i-- > 0;) {
      int used = i >= symbols || counts[i];
      depth[i] = i == nodes - 1 && i >= symbols ? 0 : used && nodes > symbols ? depth[parent[i]] + 1 : used;
      if (i < symbols) lengths[i] = (uint8_t)depth[i];
      if (depth[i] > deepest) deepest = depth[i];
    }
  }
  uint32_t code = 0;
  for (int length = 1; length <= limit; length++, code <<= 1) {
    for (int i = 0; i < symbols; i++) {
      if (lengths[i] != length) continue;
      uint32_t reversed = 0;
      for (int bit = 0; bit < length; bit++) reversed = reversed << 1 | (code >> bit & 1);
      codes[i] = (uint16_t)reversed;
      code++;
    }
  }
}

/* Lengths and distances are coded as a symbol for their 1 + k highest bits, followed by the other bits. */
static inline int ex_bucket(uint32_t x, unsigned k, unsigned *extra_bits)
{
  *extra_bits = 0;
  while (x >> *extra_bits >= 2u << k) ++*extra_bits;
  return (int)((x >> *extra_bits) + (*extra_bits << k));
}
static inline void ex_deflate_block(ex_bits *out, const uint32_t *tokens, size_t count, int is_last)
{
  uint32_t counts[EX_SYMBOLS] = {0};   /* of literals, end of block (256) and lengths; then of distances */
  uint32_t *distances = counts + EX_LITERALS;
  uint8_t lengths[EX_SYMBOLS];
  uint16_t codes[EX_SYMBOLS];
  unsigned extra;
  counts[256] = distances[0] = 1;
  for (size_t i = 0; i < count; i++) {
    uint32_t length = tokens[i] & 0xffff, distance = tokens[i] >> 16;
    counts[distance ? 257 + ex_bucket(length - 3, 2, &extra) : (int)length]++;
    if (distance) distances[ex_bucket(distance - 1, 1, &extra)]++;
  }
  ex_huffman(counts, EX_LITERALS, 15, lengths, codes);
  ex_huffman(distances, EX_DISTANCES, 15, lengths + EX_LITERALS, codes + EX_LITERALS);

  /* The lengths themselves: 16 = the last one 3..6 times more, 17 = 3..10 zeros, 18 = 11..138 zeros. */
  static const uint8_t order[19] = {16, 17, 18, 0, 8, 7, 9, 6, 10, 5, 11, 4, 12, 3, 13, 2, 14, 1, 15};
  uint8_t items[EX_SYMBOLS], repeats[EX_SYMBOLS], item_lengths[19];
  uint16_t item_codes[19];
  uint32_t item_counts[19] = {0};
  int item_count = 0;
  for (int i = 0, run; i < EX_SYMBOLS; i += run) {
    int length = lengths[i], most = length ? 7 : 138;
    for (run = 1; i + run < EX_SYMBOLS && lengths[i + run] == length && run < most;) run++;
    if (run < (length ? 4 : 3)) run = 1;
    if (length || run == 1) items[item_count++] = (uint8_t)length;
    if (run == 1) continue;
    items[item_count] = length ? 16 : run < 11 ? 17 : 18;
    repeats[item_count++] = (uint8_t)(run - (length ? 4 : run < 11 ? 3 : 11));
  }
  for (int i = 0; i < item_count; i++) item_counts[items[i]]++;
  ex_huffman(item_counts, 19, 7, item_lengths, item_codes);
  ex_put(out, (uint32_t)is_last | 2 << 1, 3);
  ex_put(out, (EX_LITERALS - 257) | (EX_DISTANCES - 1) << 5 | (19 - 4) << 10, 14);
  for (int i = 0; i < 19; i++) ex_put(out, item_lengths[order[i]], 3);
  for (int i = 0; i < item_count; i++) {
    ex_put(out, item_codes[items[i]], item_lengths[items[i]]);
    if (items[i] >= 16) ex_put(out, repeats[i], items[i] == 16 ? 2 : items[i] == 17 ? 3 : 7);
  }

  for (size_t i = 0; i <= count; i++) {
    uint32_t length = i < count ? tokens[i] & 0xffff : 256, distance = i < count ? tokens[i] >> 16 : 0;
    int symbol = distance ? 257 + ex_bucket(length - 3, 2, &extra) : (int)length;
    ex_put(out, codes[symbol], lengths[symbol]);
    if (!distance) continue;
    ex_put(out, (length - 3) & ((1u << extra) - 1), extra);
    symbol = EX_LITERALS + ex_bucket(distance - 1, 1, &extra);
    ex_put(out, codes[symbol], lengths[symbol]);
    ex_put(out, (distance - 1) & ((1u << extra) - 1), extra);
  }
}

typedef struct ex_matcher {
  const uint8_t *data;
  size_t size, known;                  /* positions before known are in the chains */
  size_t newest[EX_HASHES], older[EX_WINDOW];   /* position + 1; 0 = none */
} ex_matcher;
static inline uint32_t ex_match_hash(const uint8_t *p)
{
  return ((p[0] | (uint32_t)p[1] << 8 | (uint32_t)p[2] << 16) * 2654435761u) >> 17;
}
/* The longest match for the bytes at a position, among those before it, as a token; 0 = none of 3 bytes. */
static inline uint32_t ex_match(ex_matcher *m, size_t at)
{
  if (m->size - at < 3) return 0;
  for (; m->known < at; m->known++) {
    size_t *newest = &m->newest[ex_match_hash(m->data + m->known)];
    m->older[m->known % EX_WINDOW] = *newest;
    *newest = m->known + 1;
  }
  size_t most = m->size - at < 257 ? m->size - at : 257, best = 2, best_distance = 0;
  size_t candidate = m->newest[ex_match_hash(m->data + at)];
  for (int tries = 0; candidate && tries < EX_CHAIN && best < most; tries++) {
    size_t from = candidate - 1, length = 0;
    if (at - from >= EX_WINDOW) break;
    while (length < most && m->data[from + length] == m->data[at + length]) length++;
    if (length > best) {
      best = length;
      best_distance = at - from;
    }
    candidate = m->older[from % EX_WINDOW];
  }
  return (uint32_t)(best_distance << 16 | best) & (best_distance ? ~0u : 0);
}
/* Into out->data, which holds 2 * size + 1024 bytes. */
static inline int ex_deflate(ex_bits *out, const uint8_t *data, size_t size)
{
  ex_matcher *matcher = (ex_matcher *)calloc(1, sizeof *matcher);
  uint32_t *tokens = (uint32_t *)malloc(EX_BLOCK * sizeof *tokens);
  size_t count = 0;
  int ok = matcher && tokens;
  if (ok) {
    matcher->data = data;
    matcher->size = size;
    for (size_t at = 0; at < size;) {
      uint32_t match = ex_match(matcher, at);
      if (match && (ex_match(matcher, at + 1) & 0xffff) > (match & 0xffff)) match = 0;   /* better next */
      if (count == EX_BLOCK) {
        ex_deflate_block(out, tokens, count, 0);
        count = 0;
      }
      tokens[count++] = match ? match : data[at];
      at += match ? match & 0xffff : 1;
    }
    ex_deflate_block(out, tokens, count, 1);
    ex_put(out, 0, 7);                 /* the last byte's other bits */
  }
  free(matcher);
  free(tokens);
  return ok;
}

static inline void ex_png_chunk(FILE *file, const char *type, const uint8_t *data, size_t size)
{
  uint8_t head[8], tail[4];
  uint32_t crc = ~0u;
  memcpy(head + 4, type, 4);
  for (size_t i = 0; i < size + 4; i++) {
    crc ^= i < 4 ? head[4 + i] : data[i - 4];
    for (int bit = 0; bit < 8; bit++) crc = crc >> 1 ^ (crc & 1 ? 0xedb88320u : 0);
  }
  for (int i = 0; i < 4; i++) {
    head[i] = (uint8_t)(size >> (24 - 8 * i));
    tail[i] = (uint8_t)(~crc >> (24 - 8 * i));
  }
  fwrite(head, 1, 8, file);
  fwrite(data, 1, size, file);
  fwrite(tail, 1, 4, file);
}
/* One row, filtered in the one of PNG's five ways (0..4) whose bytes, taken as signed, sum up least. */
static inline void ex_png_filter(uint8_t *out, const uint8_t *row, const uint8_t *above, size_t size)
{
  uint64_t least = UINT64_MAX;
  for (int pass = 0, best = 0; pass < 6; pass++) {   /* the sixth writes the best again */
    int filter = pass < 5 ? pass : best;
    uint64_t sum = 0;
    out[0] = (uint8_t)filter;
    for (size_t i = 0; i < size; i++) {
      int left = i < 3 ? 0 : row[i - 3], up = above ? above[i] : 0;
      int corner = i < 3 || !above ? 0 : above[i - 3];
      int to_left = abs(up - corner), to_up = abs(left - corner), to_corner = abs(left + up - 2 * corner);
      int paeth = to_left <= to_up && to_left <= to_corner ? left : to_up <= to_corner ? up : corner;
      const int guesses[5] = {0, left, up, (left + up) / 2, paeth};
      out[1 + i] = (uint8_t)(row[i] - guesses[filter]);
      sum += (uint64_t)(out[1 + i] < 128 ? out[1 + i] : 256 - out[1 + i]);
    }
    if (sum < least) {
      least = sum;
      best = filter;
    }
  }
}
/* The number of colours, 0 for more than 256; and the rows as numbers of colours, which need no filter. */
static inline size_t ex_png_palette(const uint8_t *rgb, size_t width, size_t height, uint8_t palette[3 * 256],
                                    uint8_t *rows)
{
  size_t colors = 0, color = 0;
  for (size_t i = 0; i < width * height; i++, rgb += 3) {
    if (i % width == 0) *rows++ = 0;
    if (color == colors || memcmp(palette + 3 * color, rgb, 3)) {   /* mostly, it is the last pixel's */
      for (color = 0; color < colors && memcmp(palette + 3 * color, rgb, 3); color++) {}
      if (color == 256) return 0;
      if (color == colors) memcpy(palette + 3 * colors++, rgb, 3);
    }
    *rows++ = (uint8_t)color;
  }
  return colors;
}
/* rgb: width * height * 3 bytes, from the upper left corner row by row. */
static inline int ex_png_write(const char *path, const uint8_t *rgb, uint32_t width, uint32_t height)
{
  size_t row = 3 * (size_t)width, size = (row + 1) * height;
  uint8_t *rows = (uint8_t *)malloc(size), *packed = (uint8_t *)malloc(2 * size + 1024);
  FILE *file = rows && packed ? fopen(path, "wb") : NULL;
  int ok = 0;
  if (file) {
    uint8_t palette[3 * 256];
    size_t colors = ex_png_palette(rgb, width, height, palette, rows);
    if (colors) size = ((size_t)width + 1) * height;
    for (size_t y = 0; y < height && !colors; y++) {
      ex_png_filter(rows + y * (row + 1), rgb + y * row, y ? rgb + (y - 1) * row : NULL, row);
    }
    ex_bits out = {packed, 0, 0, 0};
    ex_put(&out, 0x9c78, 16);          /* the zlib header */
    ok = ex_deflate(&out, rows, size);
    uint32_t a = 1, b = 0;             /* Adler-32 */
    for (size_t i = 0; i < size; i++) {
      a = (a + rows[i]) % 65521;
      b = (b + a) % 65521;
    }
    uint8_t header[13] = {0, 0, 0, 0, 0, 0, 0, 0, 8, 2, 0, 0, 0};   /* 8 bits of each of RGB, */
    if (colors) header[9] = 3;                                     /* or of a colour's number */
    for (int i = 0; i < 4; i++) {
      header[i] = (uint8_t)(width >> (24 - 8 * i));
      header[4 + i] = (uint8_t)(height >> (24 - 8 * i));
      packed[out.size++] = (uint8_t)((b << 16 | a) >> (24 - 8 * i));
    }
    fwrite("\x89PNG\r\n\x1a\n", 1, 8, file);
    ex_png_chunk(file, "IHDR", header, 13);
    if (colors) ex_png_chunk(file, "PLTE", palette, 3 * colors);
    ex_png_chunk(file, "IDAT", packed, out.size);
    ex_png_chunk(file, "IEND", packed, 0);
    ok = ok && !ferror(file);
    if (fclose(file)) ok = 0;
  }
  free(rows);
  free(packed);
  return ok;
}

// >>programs ------------------------------------------------------------------------------------------------
#ifndef EX_PROGRAM                     /* the name in front of error messages */
  #define EX_PROGRAM "trbvh"
#endif

static inline void ex_die(const char *format, ...)
{
  va_list arguments;
  va_start(arguments, format);
  fputs(EX_PROGRAM ": ", stderr);
  vfprintf(stderr, format, arguments);
  fputs("\n", stderr);
  va_end(arguments);
  exit(1);
}
static inline void *ex_allocate(size_t count, size_t size)
{
  void *memory = calloc(count ? count : 1, size);
  if (!memory) ex_die("not enough memory");
  return memory;
}
static inline void ex_check(trbvh_result result, const char *what, const trbvh_stats *stats)
{
  const char *message = stats ? stats->message : "";
  if (result) ex_die("%s: %s%s%s", what, trbvh_result_text(result), *message ? ": " : "", message);
}

/* A whole number 1..most; *end is what follows it, and with NULL nothing may follow. */
static inline uint32_t ex_parse_count(const char *text, const char *option, uint32_t most, const char **end)
{
  char *stop;
  long count = strtol(text, &stop, 10);
  if (stop == text || (!end && *stop) || count < 1 || (unsigned long)count > most) {
    ex_die("%s takes 1..%u, not '%s'", option, most, text);
  }
  if (end) *end = stop;
  return (uint32_t)count;
}
static inline void ex_parse_size(const char *text, const char *option, uint32_t *width, uint32_t *height)
{
  const char *end;
  *width = ex_parse_count(text, option, 4096, &end);
  if (*end != 'x') ex_die("%s takes WxH, like 960x640, not '%s'", option, text);
  *height = ex_parse_count(end + 1, option, 4096, NULL);
}
typedef struct ex_option { const char *name; int value; } ex_option;
enum { EX_VALUE, EX_VALUE_OR_NONE, EX_NO_VALUE };   /* where there is none, set gets "" */
/* Calls set(user, option's number or -1 for an argument that is none, value) for each argument. */
static inline void ex_arguments(int argc, char **argv, const char *usage, const ex_option *options, int count,
                                void (*set)(void *user, int option, const char *value), void *user)
{
  for (int i = 1; i < argc; i++) {
    int option = 0, has_value = i + 1 < argc;
    if (!strcmp(argv[i], "--help")) {
      fputs(usage, stdout);
      exit(0);
    }
    if (argv[i][0] != '-') {
      set(user, -1, argv[i]);
      continue;
    }
    while (option < count && strcmp(argv[i], options[option].name)) option++;
    if (option == count) ex_die("unknown option '%s'; --help lists them", argv[i]);
    if (options[option].value == EX_NO_VALUE) has_value = 0;
    else if (options[option].value == EX_VALUE_OR_NONE) has_value = has_value && argv[i + 1][0] != '-';
    else if (!has_value) ex_die("%s needs a value", argv[i]);
    set(user, option, has_value ? argv[i + 1] : "");
    i += has_value;
  }
}

typedef struct ex_scene {
  ex_mesh mesh;
  ex_camera camera;
  ex_vec up, sun;
  float diagonal, offset;              /* of the bounding box; of ray origins from the surface they leave */
  float haze;                          /* distance at which most of a surface is lost in it; 0 = none */
} ex_scene;

/* aspect: width / height of pictures; 0 where no vertex is finite */
static inline int ex_scene_of(ex_scene *scene, ex_mesh mesh, float aspect)
{
  ex_vec low, high;
  if (!ex_mesh_bounds(&mesh, &low, &high)) return 0;
  ex_vec size = ex_sub(high, low), center = ex_mix(low, high, 0.5f);
  scene->mesh = mesh;
  scene->up = ex_guess_up(low, high);
  scene->diagonal = ex_length(size) > 0 ? ex_length(size) : 1;
  scene->offset = 1e-5f * (scene->diagonal + ex_length(center));
  scene->camera = ex_camera_fit(&mesh, scene->up, aspect);
  scene->haze = 0;
  return 1;
}
/* path: NULL = the built-in scene */
static inline ex_scene ex_scene_load(const char *path, float aspect)
{
  ex_scene scene;
  ex_mesh mesh;
  char error[512];
  if (path) {
    if (!ex_mesh_read(path, &mesh, error, sizeof error)) ex_die("%s", error);
  } else if (!ex_mesh_demo(&mesh, EX_DEMO_DETAIL)) ex_die("not enough memory");
  if (!ex_scene_of(&scene, mesh, aspect)) ex_die("%s: no vertex is finite", path);
  if (!path) {
    scene.camera = ex_demo_camera(aspect);
    scene.haze = 600;
  }
  const ex_camera *c = &scene.camera;   /* the sun comes over the viewer's left shoulder */
  ex_vec left = ex_scale(ex_normalize(c->right), -1), behind = ex_scale(c->forward, -1);
  scene.sun = ex_normalize(ex_mad(ex_mad(scene.up, left, 0.9f), behind, 0.35f));
  return scene;
}
/* Through pixel number i of a picture, at x, y within it: 0.5, 0.5 is its middle. */
static inline trbvh_ray ex_pixel_ray(const ex_scene *scene, size_t i, uint32_t width, uint32_t height,
                                     float x, float y)
{
  size_t column = i % width, row = i / width;
  return ex_camera_ray(&scene->camera, ((float)column + x) / (float)width, ((float)row + y) / (float)height);
}
/* Where a ray hit, a little off the surface on the side that it came from, and the normal on that side. */
static inline ex_vec ex_surface(const ex_scene *scene, const trbvh_ray *ray, const trbvh_hit *hit,
                                ex_vec *normal)
{
  ex_vec point = ex_mesh_point(&scene->mesh, hit, normal);
  if (ex_dot(*normal, ex_load(ray->dir)) > 0) *normal = ex_scale(*normal, -1);
  return ex_mad(point, *normal, scene->offset);
}

/* Rays to be timed. */
enum { EX_PRIMARY, EX_AMBIENT, EX_DIFFUSE, EX_KINDS };
static const char *const ex_kind_names[] = {"primary", "ambient occlusion", "diffuse"};
typedef struct ex_ray_set { trbvh_ray *rays; size_t count; } ex_ray_set;

/* A picture's rays, and from each of their hits one ray as far as ambient occlusion looks and one without a
 * limit. They are the same for all trees of a scene. The caller frees the three sets' rays. */
static inline void ex_make_rays(const ex_scene *scene, uint32_t width, uint32_t height, const trbvh *bvh,
                                const trbvh_options *options, ex_ray_set sets[EX_KINDS])
{
  size_t count = (size_t)width * height;
  trbvh_hit *hits = (trbvh_hit *)ex_allocate(count, sizeof *hits);
  for (int kind = 0; kind < EX_KINDS; kind++) {
    sets[kind].rays = (trbvh_ray *)ex_allocate(count, sizeof(trbvh_ray));
    sets[kind].count = 0;
  }
  sets[EX_PRIMARY].count = count;
  for (size_t i = 0; i < count; i++) {
    sets[EX_PRIMARY].rays[i] = ex_pixel_ray(scene, i, width, height, 0.5f, 0.5f);
  }
  ex_check(trbvh_intersect_n(bvh, sets[EX_PRIMARY].rays, hits, count, options), "tracing rays", NULL);
  for (size_t i = 0; i < count; i++) {
    if (hits[i].prim == TRBVH_NONE) continue;
    uint32_t seed = (uint32_t)i;
    ex_vec normal, point = ex_surface(scene, &sets[EX_PRIMARY].rays[i], &hits[i], &normal);
    for (int kind = EX_AMBIENT; kind <= EX_DIFFUSE; kind++) {
      float a = ex_random(&seed), b = ex_random(&seed);
      float reach = kind == EX_AMBIENT ? scene->diagonal * 0.1f : 0;
      sets[kind].rays[sets[kind].count++] = ex_ray(point, ex_cosine_direction(normal, a, b), reach);
    }
  }
  free(hits);
}
static inline double ex_median(double *x, int count)   /* sorts x; of an even count, the lower one */
{
  for (int i = 1; i < count; i++) {
    double value = x[i];
    int k = i;
    for (; k > 0 && x[k - 1] > value; k--) x[k] = x[k - 1];
    x[k] = value;
  }
  return x[(count - 1) / 2];
}

#endif /* EX_COMMON_H */
