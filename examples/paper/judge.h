/* judge.h - how trees are judged: by the rays of the paper's framework (Aila and Laine 2009), and by the two metrics
 * that explain rays where SAH does not (Aila, Karras and Laine 2013, "On Quality Metrics of Bounding Volume
 * Hierarchies"). Rays, points and hits are the same for all trees of a scene.
 */
#ifndef PAPER_JUDGE_H
#define PAPER_JUDGE_H
#include "paper.h"

// >>cameras -------------------------------------------------------------------------------------------------
enum { PAPER_CAMERAS = 5 };

static inline float paper_halton(uint32_t i, uint32_t base)   /* 0 <= x < 1 */
{
  float x = 0, digit = 1;
  for (; i; i /= base) x += (digit /= (float)base) * (float)(i % base);
  return x < 1 ? x : 0;
}
static inline ex_vec paper_halton_point(uint32_t i, ex_vec low, ex_vec high)   /* not in the outer tenth */
{
  ex_vec u = ex_v(0.1f + 0.8f * paper_halton(i, 2), 0.1f + 0.8f * paper_halton(i, 3), 0.1f + 0.8f * paper_halton(i, 5));
  return ex_add(low, ex_mul(ex_sub(high, low), u));
}
/* Does this camera see a scene as a user would? Of 16 x 12 rays half hit, half of these the triangles' front, and half
 * at some distance. */
static inline int paper_sees(const ex_scene *scene, const trbvh *bvh, const ex_camera *camera)
{
  uint32_t hits = 0, fronts = 0, afar = 0;
  for (uint32_t i = 0; i < 192; i++) {
    trbvh_ray ray = ex_camera_ray(camera, ((float)(i % 16) + 0.5f) / 16, ((float)(i / 16) + 0.5f) / 12);
    trbvh_hit hit;
    ex_vec normal;
    if (!trbvh_intersect(bvh, &ray, &hit)) continue;
    ex_mesh_point(&scene->mesh, &hit, &normal);
    hits++;
    fronts += ex_dot(normal, ex_load(ray.dir)) < 0;
    afar += hit.t > 0.03f * scene->diagonal;
  }
  return hits >= 96 && 2 * fronts >= hits && 2 * afar >= hits;
}
/* By a fixed rule, whatever the scene: two from outside, and from inside the first three of a sequence (Halton's) that
 * see something; those that are not found look at all of it from other sides. */
static inline void paper_place_cameras(const ex_scene *scene, const trbvh *bvh, ex_camera cameras[PAPER_CAMERAS])
{
  static const float sides[PAPER_CAMERAS][3] = {   /* to the right, upwards, to the front */
    {0.62f, 0.42f, 0.75f}, {-0.75f, 0.3f, -0.62f}, {0.8f, 0.15f, -0.5f}, {-0.5f, 0.8f, 0.3f}, {-0.9f, 0.1f, 0.2f}
  };
  const float aspect = 4 / 3.0f;
  ex_vec low, high, up = scene->up, front = up.y > 0 ? ex_v(0, 0, 1) : ex_v(0, -1, 0);
  ex_mesh_bounds(&scene->mesh, &low, &high);
  ex_vec center = ex_mix(low, high, 0.5f);
  int placed = 2;
  for (int i = 0; i < PAPER_CAMERAS; i++) {
    ex_vec side = ex_mad(ex_mad(ex_v(sides[i][0], 0, 0), up, sides[i][1]), front, sides[i][2]);
    cameras[i] = ex_camera_look_at(ex_mad(center, side, 0.8f * scene->diagonal), center, up, 45, aspect);
  }
  for (uint32_t i = 1; i <= 128 && placed < PAPER_CAMERAS; i++) {
    ex_vec eye = paper_halton_point(i, low, high), target = paper_halton_point(i + 1000, low, high);
    ex_camera camera = ex_camera_look_at(eye, ex_mix(target, center, 0.3f), up, 60, aspect);
    if (paper_sees(scene, bvh, &camera)) cameras[placed++] = camera;
  }
}

// >>rays ----------------------------------------------------------------------------------------------------
/* Every second bit. */
static inline uint32_t paper_even_bits(uint32_t x)
{
  uint32_t even = 0;
  for (uint32_t i = 0; i < 16; i++) even |= (x >> 2 * i & 1) << i;
  return even;
}
/* A camera's, along a Morton curve over its pixels. */
static inline void paper_add_primary(ex_ray_set *set, const ex_camera *camera, uint32_t width, uint32_t height)
{
  for (uint32_t i = 0, found = 0; found < width * height; i++) {
    uint32_t x = paper_even_bits(i), y = paper_even_bits(i >> 1);
    if (x >= width || y >= height) continue;
    float across = ((float)x + 0.5f) / (float)width, down = ((float)y + 0.5f) / (float)height;
    set->rays[set->count++] = ex_camera_ray(camera, across, down);
    found++;
  }
}
/* From one hit: so many of each kind, by Halton's points, turned by a random number. */
static inline void paper_add_secondary(ex_ray_set sets[EX_KINDS], const ex_scene *scene, const trbvh_ray *ray,
                                       const trbvh_hit *hit, uint32_t samples, uint32_t seed)
{
  ex_vec normal, point = ex_surface(scene, ray, hit, &normal);
  for (int kind = EX_AMBIENT; kind <= EX_DIFFUSE; kind++) {
    float reach = kind == EX_AMBIENT ? scene->diagonal * 0.1f : 0, turn_a = ex_random(&seed), turn_b = ex_random(&seed);
    for (uint32_t i = 1; i <= samples; i++) {
      float a = turn_a + paper_halton(i, 2), b = turn_b + paper_halton(i, 3);
      ex_vec dir = ex_cosine_direction(normal, a < 1 ? a : a - 1, b < 1 ? b : b - 1);
      sets[kind].rays[sets[kind].count++] = ex_ray(point, dir, reach);
    }
  }
}
/* Rays that start near one another and point the same way come one after the other: by a Morton code of the six
 * numbers, five bits of each. */
static inline void paper_sort_rays(ex_ray_set *set, ex_vec low, ex_vec high)
{
  uint64_t *keys = (uint64_t *)ex_allocate(set->count, sizeof *keys);
  trbvh_ray *sorted = (trbvh_ray *)ex_allocate(set->count, sizeof *sorted);
  const float from[3] = {low.x, low.y, low.z}, to[3] = {high.x, high.y, high.z};
  for (size_t i = 0; i < set->count; i++) {
    const trbvh_ray *ray = &set->rays[i];
    uint64_t code = 0;
    for (int k = 0; k < 6; k++) {
      int axis = k % 3;
      float x = k < 3 ? (ray->origin[axis] - from[axis]) / (to[axis] - from[axis]) : 0.5f + 0.5f * ray->dir[axis];
      uint32_t cell = (uint32_t)(31.99f * ex_clamp(x, 0, 1));
      for (uint32_t bit = 0; bit < 5; bit++) code |= (uint64_t)(cell >> bit & 1) << (6 * bit + (uint32_t)k);
    }
    keys[i] = code << 34 | i;
  }
  paper_sort(keys, (uint32_t)set->count, 30);
  for (size_t i = 0; i < set->count; i++) sorted[i] = set->rays[keys[i] & 0x3FFFFFFFF];
  free(set->rays);
  set->rays = sorted;
  free(keys);
}
/* A scene's: primary ones from the cameras, and from each hit so many samples of ambient occlusion, as far as a tenth
 * of the diagonal, and as many diffuse ones without a limit. The caller frees the sets' rays. */
static inline void paper_make_rays(const ex_scene *scene, const trbvh *bvh, uint32_t width, uint32_t height,
                                   uint32_t samples, ex_ray_set sets[EX_KINDS])
{
  ex_camera cameras[PAPER_CAMERAS];
  size_t count = (size_t)width * height * PAPER_CAMERAS;
  trbvh_hit *hits = (trbvh_hit *)ex_allocate(count, sizeof *hits);
  ex_vec low, high;
  ex_mesh_bounds(&scene->mesh, &low, &high);
  paper_place_cameras(scene, bvh, cameras);
  for (int kind = 0; kind < EX_KINDS; kind++) {
    sets[kind].rays = (trbvh_ray *)ex_allocate(kind == EX_PRIMARY ? count : count * samples, sizeof(trbvh_ray));
    sets[kind].count = 0;
  }
  for (int i = 0; i < PAPER_CAMERAS; i++) paper_add_primary(&sets[EX_PRIMARY], &cameras[i], width, height);
  ex_check(trbvh_intersect_n(bvh, sets[EX_PRIMARY].rays, hits, count, NULL), "tracing rays", NULL);
  for (size_t i = 0; i < count; i++) {
    if (hits[i].prim == TRBVH_NONE) continue;
    paper_add_secondary(sets, scene, &sets[EX_PRIMARY].rays[i], &hits[i], samples, (uint32_t)i);
  }
  for (int kind = EX_AMBIENT; kind <= EX_DIFFUSE; kind++) paper_sort_rays(&sets[kind], low, high);
  free(hits);
}

// >>end-point overlap ---------------------------------------------------------------------------------------
/* EPO = sum over nodes n of C(n) A(surfaces in box(n) that are not in subtree(n)) / A(all surfaces), with C = Ci for
 * inner nodes and Ct N for leaves: what it costs to end a ray anywhere on the surface, beside the way to it. As an
 * integral over the surface it is the mean over points of it of the C(n) of the boxes around the point whose subtrees
 * do not have the point's triangle, which these points, spread evenly, estimate. */
typedef struct paper_point { float at[3]; uint32_t prim; } paper_point;
typedef struct paper_points { paper_point *at; size_t count; } paper_points;

static inline double paper_triangle_area(const ex_mesh *mesh, size_t i)
{
  ex_vec a = ex_mesh_corner(mesh, i, 0), n;
  n = ex_cross(ex_sub(ex_mesh_corner(mesh, i, 1), a), ex_sub(ex_mesh_corner(mesh, i, 2), a));
  double area = 0.5 * sqrt((double)n.x * n.x + (double)n.y * n.y + (double)n.z * n.z);
  return area <= FLT_MAX ? area : 0;   /* also a NaN */
}
/* Stratified by area in the order of the triangles; the caller frees them. */
static inline paper_points paper_make_points(const ex_mesh *mesh, size_t count)
{
  paper_points points = {(paper_point *)ex_allocate(count, sizeof(paper_point)), 0};
  double all = 0, passed = 0;
  uint32_t seed = 1;
  for (size_t i = 0; i < mesh->triangle_count; i++) all += paper_triangle_area(mesh, i);
  for (size_t i = 0; i < mesh->triangle_count && all > 0; i++) {
    passed += paper_triangle_area(mesh, i);
    while (points.count < count && ((double)points.count + 0.5) / (double)count * all < passed) {
      float u = ex_random(&seed), v = ex_random(&seed);
      ex_vec a = ex_mesh_corner(mesh, i, 0);
      if (u + v > 1) {
        u = 1 - u;
        v = 1 - v;
      }
      ex_vec p = ex_mad(ex_mad(a, ex_sub(ex_mesh_corner(mesh, i, 1), a), u), ex_sub(ex_mesh_corner(mesh, i, 2), a), v);
      points.at[points.count++] = (paper_point){{p.x, p.y, p.z}, (uint32_t)i};
    }
  }
  return points;
}

/* Where a tree has which primitive: a subtree's primitives are a range of prims[]. */
typedef struct paper_places {
  uint32_t *begin, *end;               /* by node */
  uint32_t *first, *entries;           /* where prims[] has a primitive: entries[first[prim]] to first[prim + 1] */
} paper_places;
static inline paper_places paper_find_places(const trbvh *bvh)
{
  paper_places s;
  s.begin = (uint32_t *)ex_allocate(2 * (size_t)bvh->node_count, sizeof(uint32_t));
  s.end = s.begin + bvh->node_count;
  s.first = (uint32_t *)ex_allocate((size_t)bvh->prim_count + bvh->ref_count + 2, sizeof(uint32_t));
  s.entries = s.first + bvh->prim_count + 2;
  for (uint32_t i = bvh->node_count; i-- > 0;) {   /* children first */
    const trbvh_node *n = &bvh->nodes[i];
    uint32_t l = n->first, r = n->first + 1;
    if (i == 1) continue;
    s.begin[i] = n->count ? n->first : s.begin[l] < s.begin[r] ? s.begin[l] : s.begin[r];
    s.end[i] = n->count ? n->first + n->count : s.end[l] > s.end[r] ? s.end[l] : s.end[r];
  }
  for (uint32_t i = 0; i < bvh->ref_count; i++) s.first[bvh->prims[i] + 2]++;
  for (uint32_t i = 0; i < bvh->prim_count; i++) s.first[i + 2] += s.first[i + 1];
  for (uint32_t i = 0; i < bvh->ref_count; i++) s.entries[s.first[bvh->prims[i] + 1]++] = i;
  return s;
}
static inline int paper_has(const paper_places *s, uint32_t node, uint32_t prim)
{
  for (uint32_t i = s->first[prim]; i < s->first[prim + 1]; i++) {
    if (s->entries[i] >= s->begin[node] && s->entries[i] < s->end[node]) return 1;
  }
  return 0;
}
static inline int paper_contains(const trbvh_node *n, const float p[3])
{
  return n->min[0] <= p[0] && p[0] <= n->max[0] && n->min[1] <= p[1] && p[1] <= n->max[1] &&
         n->min[2] <= p[2] && p[2] <= n->max[2];
}
static inline double paper_overlap_at(const trbvh *bvh, const paper_places *s, const paper_point *point)
{
  uint32_t stack[TRBVH_MAX_DEPTH + 1], waiting = 0;
  double cost = 0;
  stack[waiting++] = 0;
  while (waiting) {
    uint32_t i = stack[--waiting];
    const trbvh_node *n = &bvh->nodes[i];
    if (!paper_contains(n, point->at)) continue;
    if (!paper_has(s, i, point->prim)) cost += n->count ? n->count : 1.2;
    if (n->count) continue;
    stack[waiting++] = n->first;
    stack[waiting++] = n->first + 1;
  }
  return cost;
}
static inline double paper_epo(const trbvh *bvh, const paper_points *points)
{
  paper_places s = paper_find_places(bvh);
  double sum = 0;
  for (size_t i = 0; i < points->count; i++) sum += paper_overlap_at(bvh, &s, &points->at[i]);
  free(s.begin);
  free(s.first);
  return points->count ? sum / (double)points->count : 0;
}

// >>visits --------------------------------------------------------------------------------------------------
/* Per ray, of every step-th, up to its hit: nodes whose boxes it meets, triangles in the leaves among them; and leaf
 * count variability, the standard deviation of the number of these leaves, which tells how badly rays fit each other on
 * SIMD units. */
typedef struct paper_visits { double nodes, triangles, lcv; } paper_visits;

static inline paper_visits paper_count_visits(const trbvh *bvh, const trbvh_ray *rays, const trbvh_hit *hits,
                                              size_t count, size_t step)
{
  paper_visits v = {0, 0, 0};
  double leaves = 0, squares = 0, traced = 0;
  for (size_t i = 0; i < count; i += step) {
    uint32_t stack[TRBVH_MAX_DEPTH + 1], waiting = 0, met = 0;
    trb_ray ray;
    if (!trb_prepare_ray(&ray, &rays[i], (const float *)bvh->nodes)) continue;
    stack[waiting++] = 0;
    while (waiting) {
      const trbvh_node *n = &bvh->nodes[stack[--waiting]];
      if (trb_hit_box((const float *)n, &ray, hits[i].t / ray.t_unit) < 0) continue;
      v.nodes++;
      if (n->count) {
        met++;
        v.triangles += n->count;
        continue;
      }
      stack[waiting++] = n->first;
      stack[waiting++] = n->first + 1;
    }
    traced++;
    leaves += met;
    squares += (double)met * met;
  }
  if (traced > 0) {
    double mean = leaves / traced, variance = squares / traced - mean * mean;
    v.nodes /= traced;
    v.triangles /= traced;
    v.lcv = variance > 0 ? sqrt(variance) : 0;
  }
  return v;
}

/* Keeps every so-manyth ray of a set, so that all together meet no more than some `most` nodes and triangles of this
 * tree: else a scene that is no good for boxes would take longer than all others. By a look at a thousand of them. */
static inline void paper_thin_rays(ex_ray_set *set, const trbvh *bvh, double most)
{
  enum { SAMPLES = 1000 };
  trbvh_ray *rays = (trbvh_ray *)ex_allocate(SAMPLES, sizeof *rays);
  trbvh_hit *hits = (trbvh_hit *)ex_allocate(SAMPLES, sizeof *hits);
  for (size_t i = 0; i < SAMPLES && set->count; i++) {
    rays[i] = set->rays[i * set->count / SAMPLES];
    trbvh_intersect(bvh, &rays[i], &hits[i]);
  }
  paper_visits v = paper_count_visits(bvh, rays, hits, set->count ? SAMPLES : 0, 1);
  size_t step = (size_t)((v.nodes + v.triangles) * (double)set->count / most) + 1, kept = 0;
  for (size_t i = 0; i < set->count; i += step) set->rays[kept++] = set->rays[i];
  set->count = kept;
  free(rays);
  free(hits);
}

#endif
