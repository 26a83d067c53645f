/* embree.h - Embree, for programs that compare with it: its builders on their own, and its scenes. C99.
 *
 *   ex_embree_start, ex_embree_stop   a device, with a number of threads, for one mesh
 *   ex_embree_add, ex_embree_build    rtcBuildBVH: a binary tree over boxes
 *   ex_embree_scene, ex_embree_trace  what its users use: a scene with the mesh in it, and rays through that
 *
 * Empty but where EX_EMBREE is Embree's major version, 3 or 4; link with -lembree3 or -lembree4, -pthread.
 */
#ifndef EX_EMBREE_H
#define EX_EMBREE_H
#ifdef EX_EMBREE

#include "measure.h"
#if EX_EMBREE >= 4
  #include <embree4/rtcore.h>
#else
  #include <embree3/rtcore.h>
#endif

typedef struct ex_embree {
  RTCDevice device;
  const ex_mesh *mesh;
  RTCBVH bvhs[RTC_BUILD_QUALITY_HIGH + 1];   /* by quality; each build reuses the last one's memory */
  struct RTCBuildPrimitive *boxes, *work;   /* a copy, which builds reorder, with room for splits */
  void *memory;                        /* where these are */
  size_t count;                        /* of boxes */
  int too_large;                       /* for Embree, one of them */
  double ms;                           /* of the last build; less than 0: Embree found no tree */
} ex_embree;

static inline void ex_embree_start(ex_embree *e, const ex_mesh *mesh, uint32_t threads)
{
  char config[32];
  size_t triangles = mesh->triangle_count;
  memset(e, 0, sizeof *e);
  snprintf(config, sizeof config, "threads=%u", threads);
  e->device = rtcNewDevice(config);
  if (!e->device) ex_die("Embree: no device");
  for (int i = RTC_BUILD_QUALITY_LOW; i <= RTC_BUILD_QUALITY_HIGH; i++) e->bvhs[i] = rtcNewBVH(e->device);
  e->mesh = mesh;
  e->memory = ex_allocate(triangles + triangles * 13 / 10 + 1, sizeof *e->boxes);
  uintptr_t aligned = ((uintptr_t)e->memory + 31) & ~(uintptr_t)31;   /* as Embree loads them */
  e->boxes = (struct RTCBuildPrimitive *)aligned;
  e->work = e->boxes + triangles;
}
/* Before the next device starts, which would get this one's threads. */
static inline void ex_embree_stop(ex_embree *e)
{
  for (int i = RTC_BUILD_QUALITY_LOW; i <= RTC_BUILD_QUALITY_HIGH; i++) rtcReleaseBVH(e->bvhs[i]);
  rtcReleaseDevice(e->device);
  free(e->memory);
}

// >>builders ------------------------------------------------------------------------------------------------
static const float ex_cost_node = 1.2f, ex_cost_prim = 1.0f;   /* trbvh's */

/* As lean as nodes can be: 64 bytes. A child that is a leaf is its address plus 1. */
typedef struct ex_embree_node { ex_box boxes[2]; void *children[2]; } ex_embree_node;
typedef struct ex_embree_leaf { uint32_t count, prims[]; } ex_embree_leaf;

static inline size_t ex_embree_leaf_size(size_t count)
{
  return sizeof(ex_embree_leaf) + count * sizeof(uint32_t);
}
static inline const ex_embree_leaf *ex_embree_as_leaf(const void *child)   /* NULL for a node */
{
  return (uintptr_t)child & 1 ? (const ex_embree_leaf *)(const void *)((const char *)child - 1) : NULL;
}
static inline void *ex_embree_create_node(RTCThreadLocalAllocator allocator, unsigned count, void *user)
{
  (void)count, (void)user;
  return rtcThreadLocalAlloc(allocator, sizeof(ex_embree_node), 16);
}
static inline void ex_embree_set_children(void *node, void **children, unsigned count, void *user)
{
  (void)user;
  memcpy(((ex_embree_node *)node)->children, children, count * sizeof *children);
}
static inline void ex_embree_set_bounds(void *node, const struct RTCBounds **bounds, unsigned count,
                                        void *user)
{
  (void)user;
  for (unsigned i = 0; i < count; i++) {
    const struct RTCBounds *b = bounds[i];
    ex_box box = {{b->lower_x, b->lower_y, b->lower_z}, {b->upper_x, b->upper_y, b->upper_z}};
    ((ex_embree_node *)node)->boxes[i] = box;
  }
}
static inline void *ex_embree_create_leaf(RTCThreadLocalAllocator allocator,
                                          const struct RTCBuildPrimitive *prims, size_t count, void *user)
{
  ex_embree_leaf *leaf = (ex_embree_leaf *)rtcThreadLocalAlloc(allocator, ex_embree_leaf_size(count), 4);
  (void)user;
  leaf->count = (uint32_t)count;
  for (size_t i = 0; i < count; i++) leaf->prims[i] = prims[i].primID;
  return (char *)leaf + 1;
}

/* The overlap of two boxes; Embree's are three floats, one of something else, three floats. */
static inline void ex_embree_overlap(struct RTCBounds *out, const ex_box *a,
                                     const struct RTCBuildPrimitive *prim)
{
  const float *low = &prim->lower_x, *high = &prim->upper_x;
  float *out_low = &out->lower_x, *out_high = &out->upper_x;
  for (int i = 0; i < 3; i++) {
    out_low[i] = a->low[i] > low[i] ? a->low[i] : low[i];
    out_high[i] = a->high[i] < high[i] ? a->high[i] : high[i];
  }
}
/* As Embree splits triangles of its own: cuts the whole one, and then keeps to the box that is left of it. */
static inline void ex_embree_split(const struct RTCBuildPrimitive *prim, unsigned axis, float at,
                                   struct RTCBounds *left, struct RTCBounds *right, void *user)
{
  const ex_mesh *mesh = ((const ex_embree *)user)->mesh;
  const uint32_t *index = mesh->indices + 3 * (size_t)prim->primID;
  ex_box below = ex_no_box(), above = below;
  for (int i = 0; i < 3; i++) {
    const float *from = mesh->positions + 3 * (size_t)index[i];
    const float *to = mesh->positions + 3 * (size_t)index[(i + 1) % 3];
    if (from[axis] <= at) ex_extend(&below, from);
    if (from[axis] >= at) ex_extend(&above, from);
    if ((from[axis] < at) == (to[axis] < at)) continue;
    float cut[3], t = (at - from[axis]) / (to[axis] - from[axis]);
    for (int k = 0; k < 3; k++) cut[k] = from[k] + t * (to[k] - from[k]);
    cut[axis] = at;
    ex_extend(&below, cut);
    ex_extend(&above, cut);
  }
  ex_embree_overlap(left, &below, prim);
  ex_embree_overlap(right, &above, prim);
}

/* One more box, of triangle number prim of the mesh. Embree's scenes leave out what reaches beyond 1.844e18;
 * its builders may crash there. */
static inline void ex_embree_add(ex_embree *e, uint32_t prim, const float low[3], const float high[3])
{
  struct RTCBuildPrimitive box = {low[0], low[1], low[2], 0, high[0], high[1], high[2], prim};
  for (int k = 0; k < 3; k++) e->too_large |= low[k] < -1.844e18f || high[k] > 1.844e18f;
  e->boxes[e->count++] = box;
}
static inline void ex_embree_clear(ex_embree *e)   /* for other boxes */
{
  e->count = 0;
  e->too_large = 0;
}
/* For so many references: with HIGH, as many splits as trbvh's. */
static inline size_t ex_embree_room(const ex_embree *e, enum RTCBuildQuality quality)
{
  return quality == RTC_BUILD_QUALITY_HIGH ? e->count * 13 / 10 : e->count;
}
/* The root, until the next build of this quality: a node, or a leaf as in its parent. NULL where Embree finds
 * no tree within the depth that trbvh promises. */
static inline void *ex_embree_build(ex_embree *e, enum RTCBuildQuality quality, size_t room)
{
  struct RTCBuildArguments arguments = rtcDefaultBuildArguments();   /* two children, no blocks */
  int low = quality == RTC_BUILD_QUALITY_LOW;   /* whose leaves are of one size */
  memcpy(e->work, e->boxes, e->count * sizeof *e->work);
  arguments.buildQuality = quality;
  arguments.maxDepth = TRBVH_MAX_DEPTH;
  arguments.minLeafSize = low ? 4 : 1;
  arguments.maxLeafSize = low ? 4 : 8;
  arguments.traversalCost = ex_cost_node;
  arguments.intersectionCost = ex_cost_prim;
  arguments.bvh = e->bvhs[quality];
  arguments.primitives = e->work;
  arguments.primitiveCount = e->count;
  arguments.primitiveArrayCapacity = room;
  arguments.createNode = ex_embree_create_node;
  arguments.setNodeChildren = ex_embree_set_children;
  arguments.setNodeBounds = ex_embree_set_bounds;
  arguments.createLeaf = ex_embree_create_leaf;
  arguments.splitPrimitive = ex_embree_split;
  arguments.userPtr = e;
  double start = ex_now_ms();
  void *root = e->too_large ? NULL : rtcBuildBVH(&arguments);
  e->ms = root ? ex_now_ms() - start : -1;
  return root;
}

// >>scenes --------------------------------------------------------------------------------------------------
/* A scene of the mesh, with Embree's default flags, for rtcReleaseScene; *ms is what rtcCommitScene took. LOW
 * makes a tree for each geometry, of the geometry's quality. */
static inline RTCScene ex_embree_scene(const ex_embree *e, enum RTCBuildQuality quality, double *ms)
{
  const ex_mesh *mesh = e->mesh;
  RTCScene scene = rtcNewScene(e->device);
  RTCGeometry geometry = rtcNewGeometry(e->device, RTC_GEOMETRY_TYPE_TRIANGLE);
  size_t vertex = 3 * sizeof *mesh->positions, triangle = 3 * sizeof *mesh->indices;
  /* Copies: Embree reads beyond the last vertex. */
  void *positions = rtcSetNewGeometryBuffer(geometry, RTC_BUFFER_TYPE_VERTEX, 0, RTC_FORMAT_FLOAT3, vertex,
                                            mesh->position_count);
  void *indices = rtcSetNewGeometryBuffer(geometry, RTC_BUFFER_TYPE_INDEX, 0, RTC_FORMAT_UINT3, triangle,
                                          mesh->triangle_count);
  if (!positions || !indices) ex_die("Embree: not enough memory");
  memcpy(positions, mesh->positions, vertex * mesh->position_count);
  memcpy(indices, mesh->indices, triangle * mesh->triangle_count);
  rtcSetGeometryBuildQuality(geometry, quality);
  rtcSetSceneBuildQuality(scene, quality);
  rtcCommitGeometry(geometry);
  rtcAttachGeometry(scene, geometry);
  rtcReleaseGeometry(geometry);        /* it is the scene's */
  double start = ex_now_ms();
  rtcCommitScene(scene);
  *ms = ex_now_ms() - start;
  return scene;
}

typedef struct ex_embree_batch {
  RTCScene scene;
  const trbvh_ray *rays;
  size_t count;
  trbvh_hit *hits;
  uint8_t *occluded;
  uint32_t threads;
} ex_embree_batch;

static inline struct RTCRay ex_embree_ray(const trbvh_ray *from)
{
  struct RTCRay ray;
  memset(&ray, 0, sizeof ray);
  ray.org_x = from->origin[0];
  ray.org_y = from->origin[1];
  ray.org_z = from->origin[2];
  ray.dir_x = from->dir[0];
  ray.dir_y = from->dir[1];
  ray.dir_z = from->dir[2];
  ray.tnear = from->tmin > 0 ? from->tmin : 0;
  ray.tfar = from->tmax == 0 ? INFINITY : from->tmax;
  ray.mask = 0xFFFFFFFF;
  return ray;
}
static inline trbvh_hit ex_embree_closest(RTCScene scene, const trbvh_ray *from)
{
  struct RTCRayHit r = {.ray = ex_embree_ray(from), .hit.geomID = RTC_INVALID_GEOMETRY_ID};
#if EX_EMBREE >= 4
  rtcIntersect1(scene, &r, NULL);
#else
  struct RTCIntersectContext context;
  rtcInitIntersectContext(&context);
  rtcIntersect1(scene, &context, &r);
#endif
  if (r.hit.geomID != RTC_INVALID_GEOMETRY_ID) {
    return (trbvh_hit){r.ray.tfar, r.hit.u, r.hit.v, r.hit.primID, TRBVH_NONE};
  }
  return (trbvh_hit){from->tmax == 0 ? FLT_MAX : from->tmax, 0, 0, TRBVH_NONE, TRBVH_NONE};
}
static inline int ex_embree_occluded(RTCScene scene, const trbvh_ray *from)
{
  struct RTCRay ray = ex_embree_ray(from);
#if EX_EMBREE >= 4
  rtcOccluded1(scene, &ray, NULL);
#else
  struct RTCIntersectContext context;
  rtcInitIntersectContext(&context);
  rtcOccluded1(scene, &context, &ray);
#endif
  return ray.tfar < 0;                 /* -infinity */
}
static inline void ex_embree_trace_share(const void *context, uint32_t number)   /* every threads-th 1024 rays */
{
  enum { BLOCK = 1024 };
  const ex_embree_batch *of = (const ex_embree_batch *)context;
  size_t step = (size_t)of->threads * BLOCK;
  for (size_t first = (size_t)number * BLOCK; first < of->count; first += step) {
    for (size_t i = first; i < first + BLOCK && i < of->count; i++) {
      if (of->hits) of->hits[i] = ex_embree_closest(of->scene, &of->rays[i]);
      else of->occluded[i] = (uint8_t)ex_embree_occluded(of->scene, &of->rays[i]);
    }
  }
}
/* Closest hits, or with NULL for hits, 1 in occluded where there is any; on so many threads. Returns ms. */
static inline double ex_embree_trace(RTCScene scene, const trbvh_ray *rays, size_t count, trbvh_hit *hits,
                                     uint8_t *occluded, uint32_t threads)
{
  const ex_embree_batch batch = {scene, rays, count, hits, occluded, threads};
  double start = ex_now_ms();
  ex_run_threads(threads, ex_embree_trace_share, &batch);
  return ex_now_ms() - start;
}

#endif /* EX_EMBREE */
#endif
