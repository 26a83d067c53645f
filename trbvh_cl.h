/* trbvh_cl.h - trbvh.h on OpenCL devices: the same pipeline, chosen at run time, the same tree bit for bit
 * MIT or public domain, your choice: see the end of trbvh.h.
 *
 * Do this in ONE C or C++ file; it includes trbvh.h, whose implementation must be in the same file:
 *
 *     #define TRBVH_IMPLEMENTATION
 *     #include "trbvh_cl.h"
 *
 * USAGE: three lines more than with trbvh.h alone
 *     trbvh_options options = {0};
 *     options.device = trbvh_cl_open(NULL, NULL);     // NULL where there is no OpenCL: trbvh_build then runs in C
 *     trbvh_result result = trbvh_build(&bvh, &mesh, &options);
 *     trbvh_cl_close(options.device);
 *
 *   Everything else stays as it is: bvh is the same tree in host memory, and trbvh_intersect_n and trbvh_occluded_n run
 *   on options.device too (where the tree goes with them, every time: for many calls see trbvh_cl_upload and
 *   trbvh_cl_intersect). stats.on_device tells which code did the work, stats.message why it was not the device's.
 *   For geometry and trees that stay in device memory there are the functions below that begin with trbvh_cl.
 *
 * WHAT IT NEEDS
 *   To compile: nothing, neither OpenCL's headers nor its library. (With an old glibc: -ldl.)
 *   To run: an OpenCL 1.2 device. libOpenCL is opened by name; one that the process has loaded already is used first.
 *   Without it, or without a device, trbvh_cl_open returns NULL and says why.
 *   Kernels are compiled when they are first needed, once a device; that takes a second or two. Keep the device open,
 *   and keep what was compiled between runs: trbvh_cl_desc.cache_load and cache_save.
 *
 * WHAT IS PROMISED
 *   The tree of trbvh_build is that of the C code bit for bit, on any device whose float arithmetic is IEEE's.
 *   When a device fails midway (memory, compiler, launch, device lost), the C code makes the tree, and stats.message
 *   says what happened; with TRBVH_NO_FALLBACK it is an error. So is a mesh too small to be worth a launch (below
 *   TRB_CL_SMALL triangles): built in C, unless TRBVH_NO_FALLBACK is set.
 *   Rays on a device test triangles in float, the C code in double: hits may differ in the last bits, and at edges.
 *
 * THREADS
 *   One device must not be used from two threads at once. After fork(), a child must not use a device of its parent.
 *
 * COMPILE-TIME MACROS, to be defined before the implementation is included
 *   TRBVH_NO_OPENCL   leave the backend out: trbvh_cl_open always returns NULL. For consoles, WebAssembly, static glibc
 */
#ifndef TRBVH_CL_H
#define TRBVH_CL_H
#include "trbvh.h"

/* The tags behind cl_command_queue, cl_mem, cl_event: the real types fit, whether CL/cl.h is included before, after or
 * never. */
struct _cl_command_queue;
struct _cl_mem;
struct _cl_event;

// >>devices ---------------------------------------------------------------------------------------------------------
typedef struct trbvh_cl_desc {
  struct _cl_command_queue *queue;   /* yours (its context and device are used), or NULL to open one. In order; an out-of-order one is an error */
  const char *name;                  /* part of a device or platform name; NULL = the environment's TRBVH_CL_DEVICE, else the first GPU, else the first CPU */
  /* optional cache for compiled programs; key is a file-name-safe text of less than 128 characters. load returns the size (0 = not there) and fills out when capacity is enough; what is damaged or outdated is not used */
  size_t (*cache_load)(void *user, const char *key, void *out, size_t capacity);
  void   (*cache_save)(void *user, const char *key, const void *bytes, size_t size);
  void   *user;
} trbvh_cl_desc;
typedef struct trbvh_cl_info {
  char     name[128], platform[128], version[128];   /* version: of the driver */
  int      is_gpu;
  uint64_t memory_bytes;
  uint32_t compute_units;
} trbvh_cl_info;
TRBVH_API uint32_t      trbvh_cl_devices(trbvh_cl_info *out, uint32_t capacity);           /* how many there are; 0 where OpenCL is absent */
TRBVH_API trbvh_device *trbvh_cl_open   (const trbvh_cl_desc *desc, trbvh_stats *stats);   /* NULL = none (stats->message says why): passing NULL on builds in scalar C. Both may be NULL */
TRBVH_API void          trbvh_cl_close  (trbvh_device *device);                            /* waits for it; NULL is fine. Trees of it are freed before */
TRBVH_API const char   *trbvh_cl_name   (const trbvh_device *device);                      /* never NULL */
TRBVH_API const char   *trbvh_cl_message(const trbvh_device *device);                      /* why the last trbvh_cl function with this device failed, where it did; never NULL */
TRBVH_API void          trbvh_cl_trim   (trbvh_device *device);                            /* frees the scratch memory, some 120 to 144 bytes a reference, that a device keeps from build to build; waits */

// >>resident ---- buffers in, tree out, nothing copied to the host ---------------------------------------------------
/* A mesh in device memory, as trbvh_geometry's. Offsets, strides in bytes: multiples of 4, of index_size for indices.
 * position_count is needed with indices, else 0 = 3 * count. */
typedef struct trbvh_cl_geometry {
  struct _cl_mem *positions, *indices;               /* indices NULL: triangle soup */
  size_t   position_offset, position_stride, index_offset;
  uint32_t position_count, index_size, count;
} trbvh_cl_geometry;
/* A tree in device memory: nodes, prims and triangles as in trbvh. {0} is an empty one. */
typedef struct trbvh_cl_tree {
  struct _cl_mem *nodes, *prims, *triangles;         /* triangles NULL with TRBVH_NO_TRIANGLES */
  uint32_t node_count, ref_count, prim_count;
} trbvh_cl_tree;

/* All enqueue their work on the device's queue and return; done, where not NULL, gets an event that is complete when the
 * result is there, and is yours to release. On failure done is NULL, the tree of build and upload {0}, and
 * trbvh_cl_message and options->stats tell why.
 * Options: flags, quality and its settings, progress, stats. Whatever fails, there is no scalar build behind these.
 *
 * build waits once, for some 200 bytes of counts, to make the result's buffers in the right size; with HIGH and BEST twice
 * more, to learn whether splits pay; with options->stats or options->progress after every stage; and on a CPU where its
 * scratch memory grows. tree is {0}, or a tree of the same
 * device, whose buffers are freed.
 * refit: the mesh has moved, its topology has not. Boxes of a tree without splits become what build makes them; in one
 * with splits a leaf gets its whole triangles' boxes. The indices are not checked again.
 * optimize: trbvh_optimize, and the same nodes, which get a new buffer. The tree must be a valid one. On failure it is as
 * it was. Waits as build does. */
TRBVH_API trbvh_result trbvh_cl_build    (trbvh_device *device, trbvh_cl_tree *tree, const trbvh_cl_geometry *geometry, const trbvh_options *options, struct _cl_event **done);
TRBVH_API trbvh_result trbvh_cl_refit    (trbvh_device *device, trbvh_cl_tree *tree, const trbvh_cl_geometry *geometry, struct _cl_event **done);
TRBVH_API trbvh_result trbvh_cl_optimize (trbvh_device *device, trbvh_cl_tree *tree, const trbvh_options *options, struct _cl_event **done);
TRBVH_API trbvh_result trbvh_cl_intersect(trbvh_device *device, const trbvh_cl_tree *tree, struct _cl_mem *rays, struct _cl_mem *hits, size_t count, struct _cl_event **done);        /* trbvh_ray[], trbvh_hit[] */
TRBVH_API trbvh_result trbvh_cl_occluded (trbvh_device *device, const trbvh_cl_tree *tree, struct _cl_mem *rays, struct _cl_mem *occluded, size_t count, struct _cl_event **done);    /* one byte a ray: 1 = occluded */
TRBVH_API trbvh_result trbvh_cl_upload   (trbvh_device *device, trbvh_cl_tree *tree, const trbvh *bvh);                                         /* waits */
TRBVH_API trbvh_result trbvh_cl_download (trbvh_device *device, const trbvh_cl_tree *tree, trbvh *bvh, const trbvh_options *options);           /* waits; of options, allocator and stats */
TRBVH_API void         trbvh_cl_free     (trbvh_device *device, trbvh_cl_tree *tree);                                                           /* {0} is fine, twice is fine */
/* Types and traversal in OpenCL C, to put before kernels of your own: clCreateProgramWithSource(context, lines, source,
 * NULL, &error) and one more. It has trbvh_node, trbvh_triangle, trbvh_ray, trbvh_hit as above, trbvh_intersect and
 * trbvh_occluded (kernels/query.cl). */
TRBVH_API const char *const *trbvh_cl_source(uint32_t *lines);
#endif /* TRBVH_CL_H */

// ===================================================================================================================
//   IMPLEMENTATION
// ===================================================================================================================
#if defined(TRBVH_IMPLEMENTATION) && !defined(TRBVH_CL_IMPLEMENTED)
#define TRBVH_CL_IMPLEMENTED
#if defined(__EMSCRIPTEN__) && !defined(TRBVH_NO_OPENCL)
  #define TRBVH_NO_OPENCL
#endif

// >>kernels begin ---- made by kernels/embed.c from trbvh.h and kernels/*.cl: do not edit ---------------------------
static const char *const trb_cl_text[] = {
  "#line 87 \"trbvh.h\"\n",
  "#define TRBVH_VERSION_MAJOR 0\n",
  "#define TRBVH_VERSION_MINOR 1\n",
  "#define TRBVH_VERSION_PATCH 0\n",
  "#define TRBVH_VERSION (TRBVH_VERSION_MAJOR * 10000 + TRBVH_VERSION_MINOR * 100 + TRBVH_VERSION_PATCH)\n",
  "\n",
  "\n",
  "\n",
  "  #define TRBVH_OPENCL_C 1\n",
  "  typedef uint trbvh_u32;\n",
  "#line 101 \"trbvh.h\"\n",
  "#define TRBVH_NONE      0xFFFFFFFFu\n",
  "#define TRBVH_MAX_DEPTH 64\n",
  "\n",
  "\n",
  "\n",
  "typedef struct trbvh_node {\n",
  "  float min[3]; trbvh_u32 first;\n",
  "  float max[3]; trbvh_u32 count;\n",
  "} trbvh_node;\n",
  "\n",
  "\n",
  "\n",
  "typedef struct trbvh_triangle {\n",
  "  float v0[3]; trbvh_u32 prim;\n",
  "  float e1[3]; trbvh_u32 reserved0;\n",
  "  float e2[3]; trbvh_u32 reserved1;\n",
  "} trbvh_triangle;\n",
  "\n",
  "\n",
  "\n",
  "typedef struct trbvh_ray { float origin[3]; float tmin; float dir[3]; float tmax; } trbvh_ray;\n",
  "\n",
  "\n",
  "\n",
  "typedef struct trbvh_hit { float t, u, v; trbvh_u32 prim; trbvh_u32 instance; } trbvh_hit;\n",
  "#line 286 \"trbvh.h\"\n",
  "  #pragma OPENCL FP_CONTRACT OFF\n",
  "#line 297 \"trbvh.h\"\n",
  "  #ifdef TRB_OUTLINE\n",
  "    #define TRB_CORE static inline __attribute__((unused))\n",
  "  #else\n",
  "    #define TRB_CORE static inline __attribute__((always_inline, unused))\n",
  "  #endif\n",
  "  #ifdef TRB_POCL\n",
  "    #define TRB_PREFETCH(address) __builtin_prefetch((const void *)(size_t)(address))\n",
  "  #endif\n",
  "  #define TRB_SHARED static __attribute__((unused))\n",
  "  #define TRB_GLOBAL __global\n",
  "  typedef ulong trb_u64;\n",
  "  #ifdef TRB_GPU\n",
  "    #define TRB_WORK __local\n",
  "  #else\n",
  "    #define TRB_WORK\n",
  "  #endif\n",
  "  #define trb_bits(x)  as_uint(x)\n",
  "  #define trb_float(x) as_float(x)\n",
  "#line 337 \"trbvh.h\"\n",
  "#ifndef TRB_PREFETCH\n",
  "  #define TRB_PREFETCH(address) ((void)(address))\n",
  "#endif\n",
  "#line 396 \"trbvh.h\"\n",
  "#ifndef TRBVH_ASSERT\n",
  "  #define TRBVH_ASSERT(x) ((void)0)\n",
  "#endif\n",
  "#ifndef TRB_REAL\n",
  "\n",
  "    #define TRB_REAL float\n",
  "    #define TRB_NOISE 9.5367432e-7f\n",
  "#line 407 \"trbvh.h\"\n",
  "#endif\n",
  "\n",
  "  #define TRB_ALIGNED(type) type __attribute__((aligned(64)))\n",
  "#line 415 \"trbvh.h\"\n",
  "#if defined(__cplusplus) || defined(_MSC_VER)\n",
  "  #define TRB_RESTRICT __restrict\n",
  "#else\n",
  "  #define TRB_RESTRICT restrict\n",
  "#endif\n",
  "#line 430 \"trbvh.h\"\n",
  "#define TRB_MIN(a, b) ((a) < (b) ? (a) : (b))\n",
  "#define TRB_MAX(a, b) ((a) > (b) ? (a) : (b))\n",
  "\n",
  "\n",
  "\n",
  "TRB_CORE float trb_no_sign(float x) { return trb_bits(x) == 0x80000000u ? 0.0f : x; }\n",
  "#line 440 \"trbvh.h\"\n",
  "TRB_CORE float trb_abs(float x) { return x < 0 ? -x : x; }\n",
  "TRB_CORE int   trb_finite(float x) { return (trb_bits(x) & 0x7F800000u) != 0x7F800000u; }\n",
  "\n",
  "TRB_CORE trbvh_u32 trb_log2(trbvh_u32 x) {\n",
  "  trbvh_u32 n = 0;\n",
  "  if (x >> 16) { n += 16; x >>= 16; }\n",
  "  if (x >> 8)  { n += 8;  x >>= 8; }\n",
  "  if (x >> 4)  { n += 4;  x >>= 4; }\n",
  "  if (x >> 2)  { n += 2;  x >>= 2; }\n",
  "  return n + (x >> 1);\n",
  "}\n",
  "\n",
  "\n",
  "TRB_CORE float trb_reciprocal(float x) {\n",
  "  float r = trb_float(0x7EF311C3u - trb_bits(x));\n",
  "  r = r * (2.0f - x * r);\n",
  "  r = r * (2.0f - x * r);\n",
  "  r = r * (2.0f - x * r);\n",
  "  return r;\n",
  "}\n",
  "\n",
  "\n",
  "TRB_CORE float trb_cube_root(float x) {\n",
  "  float r;\n",
  "  int i;\n",
  "  if (!(x > 1e-30f)) return 0;\n",
  "  r = trb_float(0x54A21D2Au - trb_bits(x) / 3);\n",
  "  for (i = 0; i < 4; i++) r = r * (4.0f - x * r * r * r) * 0.333333343f;\n",
  "  return x * r * r;\n",
  "}\n",
  "#line 480 \"trbvh.h\"\n",
  "#define TRB_MAX_LEAF 16u\n",
  "#define TRB_SMALL    0x80000000u\n",
  "#define TRB_LEAF     0x40000000u\n",
  "\n",
  "\n",
  "typedef struct trb_costs { float ratio; trbvh_u32 max_leaf; } trb_costs;\n",
  "\n",
  "TRB_CORE trbvh_u32 trb_count(trbvh_u32 word)   { return word & TRB_SMALL ? ((word >> 26) & 15u) + 1 : word; }\n",
  "TRB_CORE float     trb_cost(trbvh_u32 word)    { return trb_float((word & 0x3FFFFFFu) << 5 & (0u - (word >> 31))); }\n",
  "TRB_CORE int       trb_is_single(trbvh_u32 word) { return (word & (TRB_SMALL | 15u << 26)) == TRB_SMALL; }\n",
  "TRB_CORE int       trb_is_leaf(trbvh_u32 word) { return (word & (TRB_SMALL | TRB_LEAF)) == (TRB_SMALL | TRB_LEAF); }\n",
  "\n",
  "\n",
  "TRB_CORE float trb_area(trbvh_node n) {\n",
  "  float x = n.max[0] - n.min[0], y = n.max[1] - n.min[1], z = n.max[2] - n.min[2];\n",
  "  float area = x * y + z * (x + y);\n",
  "  return TRB_MIN(area, FLT_MAX);\n",
  "}\n",
  "\n",
  "TRB_CORE trbvh_u32 trb_small(trbvh_u32 count, float cost, int leaf) {\n",
  "  return TRB_SMALL | (leaf ? TRB_LEAF : 0) | (count - 1) << 26 | (trb_bits(cost) & 0x7FFFFFFFu) >> 5;\n",
  "}\n",
  "\n",
  "\n",
  "TRB_CORE trbvh_node trb_reference(trbvh_node box, trb_costs costs) {\n",
  "  box.count = trb_small(1, costs.ratio * trb_area(box), 1);\n",
  "  return box;\n",
  "}\n",
  "\n",
  "\n",
  "TRB_CORE trbvh_node trb_parent(trbvh_node l, trbvh_node r, trbvh_u32 first, trb_costs costs) {\n",
  "  trbvh_node n;\n",
  "  trbvh_u32 count = trb_count(l.count) + trb_count(r.count);\n",
  "  n.min[0] = TRB_MIN(l.min[0], r.min[0]); n.max[0] = TRB_MAX(l.max[0], r.max[0]);\n",
  "  n.min[1] = TRB_MIN(l.min[1], r.min[1]); n.max[1] = TRB_MAX(l.max[1], r.max[1]);\n",
  "  n.min[2] = TRB_MIN(l.min[2], r.min[2]); n.max[2] = TRB_MAX(l.max[2], r.max[2]);\n",
  "  n.first = first;\n",
  "  n.count = count;\n",
  "  if (count <= costs.max_leaf) {\n",
  "    float area = trb_area(n), split = area + (trb_cost(l.count) + trb_cost(r.count));\n",
  "    float leaf = costs.ratio * area * (float)count;\n",
  "    n.count = trb_small(count, TRB_MIN(leaf, split), leaf <= split);\n",
  "  }\n",
  "  return n;\n",
  "}\n",
  "\n",
  "\n",
  "\n",
  "#define TRB_GRID_BITS 21\n",
  "typedef struct trb_grid { float origin[3]; float cells_per_unit, units_per_cell; } trb_grid;\n",
  "\n",
  "TRB_CORE trbvh_u32 trb_cell(float x, float origin, float cells_per_unit) {\n",
  "  const float last = 2097151.0f;\n",
  "  float cell = (x - origin) * cells_per_unit;\n",
  "  cell = TRB_MIN(cell, last);\n",
  "  return (trbvh_u32)(int)TRB_MAX(cell, 0.0f);\n",
  "}\n",
  "\n",
  "TRB_CORE trb_u64 trb_spread(trbvh_u32 cell) {\n",
  "  trb_u64 x = cell;\n",
  "  x = (x | x << 32) & 0x001F00000000FFFFu;\n",
  "  x = (x | x << 16) & 0x001F0000FF0000FFu;\n",
  "  x = (x | x << 8)  & 0x100F00F00F00F00Fu;\n",
  "  x = (x | x << 4)  & 0x10C30C30C30C30C3u;\n",
  "  return (x | x << 2) & 0x1249249249249249u;\n",
  "}\n",
  "\n",
  "\n",
  "TRB_CORE trb_u64 trb_morton(float x, float y, float z, trb_grid grid) {\n",
  "  trbvh_u32 i = trb_cell(x, grid.origin[0], grid.cells_per_unit);\n",
  "  trbvh_u32 j = trb_cell(y, grid.origin[1], grid.cells_per_unit);\n",
  "  trbvh_u32 k = trb_cell(z, grid.origin[2], grid.cells_per_unit);\n",
  "  return trb_spread(i) << 2 | trb_spread(j) << 1 | trb_spread(k);\n",
  "}\n",
  "\n",
  "TRB_CORE trb_u64 trb_box_code(trbvh_node box, trb_grid grid) {\n",
  "  return trb_morton(0.5f * box.min[0] + 0.5f * box.max[0], 0.5f * box.min[1] + 0.5f * box.max[1],\n",
  "                    0.5f * box.min[2] + 0.5f * box.max[2], grid);\n",
  "}\n",
  "#line 572 \"trbvh.h\"\n",
  "#define TRB_TREELET 7\n",
  "#define TRB_GPU_LANES 32u\n",
  "#if defined(TRB_GPU)\n",
  "  #define TRB_LANES     TRB_GPU_LANES\n",
  "  #define TRB_SUM_LANES 1u\n",
  "#else\n",
  "  #define TRB_LANES     16u\n",
  "  #define TRB_SUM_LANES TRB_LANES\n",
  "#endif\n",
  "\n",
  "#define TRB_LANE_JOIN(k, a, b) ((k) < 3 ? TRB_LANE_MIN(a, b) : (k) < 6 ? TRB_LANE_MAX(a, b) : TRB_LANE_ADD(a, b))\n",
  "#define TRB_LEAF_VALUES 8\n",
  "#define TRB_SUBSETS     128\n",
  "\n",
  "#define TRB_SINGLE(s)    (((s) & ((s) - 1)) == 0)\n",
  "#define TRB_BOTH(p, q)   (TRB_SINGLE(p) ? c[q] : TRB_SINGLE(q) ? c[p] : TRB_LANE_ADD(c[p], c[q]))\n",
  "\n",
  "#define TRB_Q0(p, q)              best = TRB_LANE_MIN(TRB_BOTH(p, q), best);\n",
  "#define TRB_Q1(p, q, a)           TRB_Q0((p) | (a), q)          TRB_Q0(p, (q) | (a))\n",
  "#define TRB_Q2(p, q, a, b)        TRB_Q1((p) | (a), q, b)       TRB_Q1(p, (q) | (a), b)\n",
  "#define TRB_Q3(p, q, a, b, d)     TRB_Q2((p) | (a), q, b, d)    TRB_Q2(p, (q) | (a), b, d)\n",
  "#define TRB_Q4(p, q, a, b, d, e)  TRB_Q3((p) | (a), q, b, d, e) TRB_Q3(p, (q) | (a), b, d, e)\n",
  "#define TRB_Q5(p, q, a, b, d, e, f) TRB_Q4((p) | (a), q, b, d, e, f) TRB_Q4(p, (q) | (a), b, d, e, f)\n",
  "#define TRB_P1(p, a)                TRB_Q0(p, a)\n",
  "#define TRB_P2(p, a, b)             TRB_Q1(p, a, b)             TRB_P1((p) | (a), b)\n",
  "#define TRB_P3(p, a, b, d)          TRB_Q2(p, a, b, d)          TRB_P2((p) | (a), b, d)\n",
  "#define TRB_P4(p, a, b, d, e)       TRB_Q3(p, a, b, d, e)       TRB_P3((p) | (a), b, d, e)\n",
  "#define TRB_P5(p, a, b, d, e, f)    TRB_Q4(p, a, b, d, e, f)    TRB_P4((p) | (a), b, d, e, f)\n",
  "#define TRB_P6(p, a, b, d, e, f, g) TRB_Q5(p, a, b, d, e, f, g) TRB_P5((p) | (a), b, d, e, f, g)\n",
  "\n",
  "#define TRB_SUBSET(s, partitions) { \\\n",
  "  TRB_LANE best = most; \\\n",
  "  partitions \\\n",
  "  c[s] = TRB_LANE_MIN(TRB_LANE_LOAD(&table[(s) * TRB_LANES]), TRB_LANE_ADD(TRB_LANE_LOAD(&sums[(s) * TRB_SUM_LANES]), best)); \\\n",
  "  TRB_LANE_STORE(&table[(s) * TRB_LANES], c[s]); \\\n",
  "  TRB_LANE_STORE(&sums[(s) * TRB_SUM_LANES], best); }\n",
  "#define TRB_S2(i, j) TRB_SUBSET((1 << i | 1 << j), TRB_P1(1 << i, 1 << j))\n",
  "#define TRB_S3(i, j, k) TRB_SUBSET((1 << i | 1 << j | 1 << k), TRB_P2(1 << i, 1 << j, 1 << k))\n",
  "#define TRB_S4(i, j, k, l) \\\n",
  "  TRB_SUBSET((1 << i | 1 << j | 1 << k | 1 << l), TRB_P3(1 << i, 1 << j, 1 << k, 1 << l))\n",
  "#define TRB_S5(i, j, k, l, m) \\\n",
  "  TRB_SUBSET((1 << i | 1 << j | 1 << k | 1 << l | 1 << m), TRB_P4(1 << i, 1 << j, 1 << k, 1 << l, 1 << m))\n",
  "#define TRB_S6(without) TRB_SUBSET((127 ^ 1 << without), TRB_P5(1 << TRB_SKIP(0, without), \\\n",
  "  1 << TRB_SKIP(1, without), 1 << TRB_SKIP(2, without), 1 << TRB_SKIP(3, without), 1 << TRB_SKIP(4, without), \\\n",
  "  1 << TRB_SKIP(5, without)))\n",
  "#define TRB_SKIP(i, without) ((i) + ((i) >= (without)))\n",
  "#line 622 \"trbvh.h\"\n",
  "#define TRB_DEFINE_TREELET_COSTS(function) \\\n",
  "  function(const TRB_WORK float *TRB_RESTRICT leaves, TRB_WORK float *TRB_RESTRICT table, float *TRB_RESTRICT sums, \\\n",
  "           trb_costs costs) { \\\n",
  "  const TRB_LANE ratio = TRB_LANE_OF(costs.ratio), limit = TRB_LANE_OF((float)costs.max_leaf + 0.5f); \\\n",
  "  const TRB_LANE most = TRB_LANE_OF(FLT_MAX), least = TRB_LANE_OF(-FLT_MAX), zero = TRB_LANE_OF(0); \\\n",
  "  TRB_LANE low[8][TRB_LEAF_VALUES], high[16][TRB_LEAF_VALUES], c[TRB_SUBSETS]; \\\n",
  "  trbvh_u32 i, j, k; \\\n",
  "  for (k = 0; k < TRB_LEAF_VALUES; k++) low[0][k] = high[0][k] = k < 3 ? most : k < 6 ? least : zero; \\\n",
  "  for (i = 1; i < 8; i *= 2) \\\n",
  "    for (k = 0; k < TRB_LEAF_VALUES; k++) { \\\n",
  "      low[i][k] = TRB_LANE_LOAD(&leaves[((i >> 1) * TRB_LEAF_VALUES + k) * TRB_LANES]); \\\n",
  "      for (j = 1; j < i; j++) low[i + j][k] = TRB_LANE_JOIN(k, low[i][k], low[j][k]); \\\n",
  "    } \\\n",
  "  for (i = 1; i < 16; i *= 2) \\\n",
  "    for (k = 0; k < TRB_LEAF_VALUES; k++) { \\\n",
  "      high[i][k] = TRB_LANE_LOAD(&leaves[((i < 8 ? 3 + (i >> 1) : 6) * TRB_LEAF_VALUES + k) * TRB_LANES]); \\\n",
  "      for (j = 1; j < i; j++) high[i + j][k] = TRB_LANE_JOIN(k, high[i][k], high[j][k]); \\\n",
  "    } \\\n",
  "  for (i = 0; i < 16; i++) \\\n",
  "    for (j = 0; j < 8; j++) { \\\n",
  "      const trbvh_u32 s = 8 * i + j; \\\n",
  "      TRB_LANE x = TRB_LANE_SUB(TRB_LANE_MAX(low[j][3], high[i][3]), TRB_LANE_MIN(low[j][0], high[i][0])); \\\n",
  "      TRB_LANE y = TRB_LANE_SUB(TRB_LANE_MAX(low[j][4], high[i][4]), TRB_LANE_MIN(low[j][1], high[i][1])); \\\n",
  "      TRB_LANE z = TRB_LANE_SUB(TRB_LANE_MAX(low[j][5], high[i][5]), TRB_LANE_MIN(low[j][2], high[i][2])); \\\n",
  "      TRB_LANE n = TRB_LANE_ADD(low[j][6], high[i][6]), u = TRB_LANE_ADD(low[j][7], high[i][7]); \\\n",
  "      TRB_LANE area = TRB_LANE_ADD(TRB_LANE_MUL(x, y), TRB_LANE_MUL(z, TRB_LANE_ADD(x, y))); \\\n",
  "      TRB_LANE leaf = TRB_LANE_SUB(TRB_LANE_MUL(TRB_LANE_MUL(ratio, area), n), u); \\\n",
  "      leaf = TRB_LANE_MAX(leaf, TRB_LANE_MUL(TRB_LANE_SUB(n, limit), most)); \\\n",
  "      TRB_LANE_STORE(&table[s * TRB_LANES], leaf); \\\n",
  "      TRB_LANE_STORE(&sums[s * TRB_SUM_LANES], area); \\\n",
  "    } \\\n",
  "  for (i = 1; i < TRB_SUBSETS; i *= 2) { TRB_LANE_STORE(&table[i * TRB_LANES], zero); c[i] = zero; } \\\n",
  "  TRB_S2(0, 1) TRB_S2(0, 2) TRB_S2(1, 2) TRB_S2(0, 3) TRB_S2(1, 3) TRB_S2(2, 3) TRB_S2(0, 4) \\\n",
  "  TRB_S2(1, 4) TRB_S2(2, 4) TRB_S2(3, 4) TRB_S2(0, 5) TRB_S2(1, 5) TRB_S2(2, 5) TRB_S2(3, 5) \\\n",
  "  TRB_S2(4, 5) TRB_S2(0, 6) TRB_S2(1, 6) TRB_S2(2, 6) TRB_S2(3, 6) TRB_S2(4, 6) TRB_S2(5, 6) \\\n",
  "  TRB_S3(0, 1, 2) TRB_S3(0, 1, 3) TRB_S3(0, 2, 3) TRB_S3(1, 2, 3) TRB_S3(0, 1, 4) TRB_S3(0, 2, 4) TRB_S3(1, 2, 4) \\\n",
  "  TRB_S3(0, 3, 4) TRB_S3(1, 3, 4) TRB_S3(2, 3, 4) TRB_S3(0, 1, 5) TRB_S3(0, 2, 5) TRB_S3(1, 2, 5) TRB_S3(0, 3, 5) \\\n",
  "  TRB_S3(1, 3, 5) TRB_S3(2, 3, 5) TRB_S3(0, 4, 5) TRB_S3(1, 4, 5) TRB_S3(2, 4, 5) TRB_S3(3, 4, 5) TRB_S3(0, 1, 6) \\\n",
  "  TRB_S3(0, 2, 6) TRB_S3(1, 2, 6) TRB_S3(0, 3, 6) TRB_S3(1, 3, 6) TRB_S3(2, 3, 6) TRB_S3(0, 4, 6) TRB_S3(1, 4, 6) \\\n",
  "  TRB_S3(2, 4, 6) TRB_S3(3, 4, 6) TRB_S3(0, 5, 6) TRB_S3(1, 5, 6) TRB_S3(2, 5, 6) TRB_S3(3, 5, 6) TRB_S3(4, 5, 6) \\\n",
  "  TRB_S4(0, 1, 2, 3) TRB_S4(0, 1, 2, 4) TRB_S4(0, 1, 3, 4) TRB_S4(0, 2, 3, 4) TRB_S4(1, 2, 3, 4) \\\n",
  "  TRB_S4(0, 1, 2, 5) TRB_S4(0, 1, 3, 5) TRB_S4(0, 2, 3, 5) TRB_S4(1, 2, 3, 5) TRB_S4(0, 1, 4, 5) \\\n",
  "  TRB_S4(0, 2, 4, 5) TRB_S4(1, 2, 4, 5) TRB_S4(0, 3, 4, 5) TRB_S4(1, 3, 4, 5) TRB_S4(2, 3, 4, 5) \\\n",
  "  TRB_S4(0, 1, 2, 6) TRB_S4(0, 1, 3, 6) TRB_S4(0, 2, 3, 6) TRB_S4(1, 2, 3, 6) TRB_S4(0, 1, 4, 6) \\\n",
  "  TRB_S4(0, 2, 4, 6) TRB_S4(1, 2, 4, 6) TRB_S4(0, 3, 4, 6) TRB_S4(1, 3, 4, 6) TRB_S4(2, 3, 4, 6) \\\n",
  "  TRB_S4(0, 1, 5, 6) TRB_S4(0, 2, 5, 6) TRB_S4(1, 2, 5, 6) TRB_S4(0, 3, 5, 6) TRB_S4(1, 3, 5, 6) \\\n",
  "  TRB_S4(2, 3, 5, 6) TRB_S4(0, 4, 5, 6) TRB_S4(1, 4, 5, 6) TRB_S4(2, 4, 5, 6) TRB_S4(3, 4, 5, 6) \\\n",
  "  TRB_S5(0, 1, 2, 3, 4) TRB_S5(0, 1, 2, 3, 5) TRB_S5(0, 1, 2, 4, 5) TRB_S5(0, 1, 3, 4, 5) TRB_S5(0, 2, 3, 4, 5) \\\n",
  "  TRB_S5(1, 2, 3, 4, 5) TRB_S5(0, 1, 2, 3, 6) TRB_S5(0, 1, 2, 4, 6) TRB_S5(0, 1, 3, 4, 6) TRB_S5(0, 2, 3, 4, 6) \\\n",
  "  TRB_S5(1, 2, 3, 4, 6) TRB_S5(0, 1, 2, 5, 6) TRB_S5(0, 1, 3, 5, 6) TRB_S5(0, 2, 3, 5, 6) TRB_S5(1, 2, 3, 5, 6) \\\n",
  "  TRB_S5(0, 1, 4, 5, 6) TRB_S5(0, 2, 4, 5, 6) TRB_S5(1, 2, 4, 5, 6) TRB_S5(0, 3, 4, 5, 6) TRB_S5(1, 3, 4, 5, 6) \\\n",
  "  TRB_S5(2, 3, 4, 5, 6) \\\n",
  "  TRB_S6(6) TRB_S6(5) TRB_S6(4) TRB_S6(3) TRB_S6(2) TRB_S6(1) TRB_S6(0) \\\n",
  "  TRB_SUBSET(127, TRB_P6(1, 2, 4, 8, 16, 32, 64)) \\\n",
  "}\n",
  "\n",
  "\n",
  "TRB_CORE trbvh_u32 trb_partition(const TRB_WORK float *table, const float *sums, trbvh_u32 s) {\n",
  "  const trbvh_u32 rest = s & (s - 1);\n",
  "  const float best = sums[s * TRB_SUM_LANES];\n",
  "  trbvh_u32 q = 0;\n",
  "  do q = (q - rest) & rest;\n",
  "  while (q != rest && table[(s ^ q) * TRB_LANES] + table[q * TRB_LANES] != best);\n",
  "  return s ^ q;\n",
  "}\n",
  "\n",
  "\n",
  "\n",
  "TRB_CORE trbvh_u32 trb_expand_key(trbvh_node n, trbvh_u32 slot) {\n",
  "  trbvh_u32 key = (trb_bits(trb_area(n)) & ~7u) | (TRB_TREELET - slot);\n",
  "  return trb_is_single(n.count) ? 0 : key;\n",
  "}\n",
  "\n",
  "\n",
  "TRB_CORE int trb_improves(float cost, float old_cost) { return cost < old_cost - old_cost * 3.8147e-6f; }\n",
  "#line 702 \"trbvh.h\"\n",
  "typedef struct trb_plane { int axis, level; float position; } trb_plane;\n",
  "#define TRB_TINY 1e-30f\n",
  "\n",
  "TRB_CORE trb_plane trb_median_plane(trbvh_node box, trb_grid grid) {\n",
  "  trb_plane plane;\n",
  "  float longest = 0;\n",
  "  int k;\n",
  "  plane.axis = 0; plane.level = -TRB_GRID_BITS - 1; plane.position = 0;\n",
  "  for (k = 0; k < 3; k++) {\n",
  "    trbvh_u32 low = trb_cell(box.min[k], grid.origin[k], grid.cells_per_unit);\n",
  "    trbvh_u32 high = trb_cell(box.max[k], grid.origin[k], grid.cells_per_unit);\n",
  "    if (low != high) {\n",
  "      const int bit = (int)trb_log2(low ^ high), level = bit - TRB_GRID_BITS;\n",
  "      const float side = box.max[k] - box.min[k];\n",
  "      if (level > plane.level || (level == plane.level && side > longest)) {\n",
  "        plane.level = level;\n",
  "        longest = side;\n",
  "        plane.axis = k;\n",
  "        plane.position = grid.origin[k] + (float)(high >> bit << bit) * grid.units_per_cell;\n",
  "      }\n",
  "    }\n",
  "  }\n",
  "  return plane;\n",
  "}\n",
  "\n",
  "TRB_CORE float trb_split_priority(const float v[3][3], trbvh_node box, trb_grid grid) {\n",
  "  float ax = v[1][0] - v[0][0], ay = v[1][1] - v[0][1], az = v[1][2] - v[0][2];\n",
  "  float bx = v[2][0] - v[0][0], by = v[2][1] - v[0][1], bz = v[2][2] - v[0][2];\n",
  "  float ideal = trb_abs(ay * bz - az * by) + trb_abs(az * bx - ax * bz) + trb_abs(ax * by - ay * bx);\n",
  "  float empty = 2.0f * trb_area(box) - ideal;\n",
  "  float weight = trb_float((trbvh_u32)(127 + trb_median_plane(box, grid).level) << 23);\n",
  "  return empty > 0 && empty < FLT_MAX ? trb_cube_root(weight * empty) : 0;\n",
  "}\n",
  "\n",
  "TRB_CORE float trb_longest_side(trbvh_node box) {\n",
  "  float x = box.max[0] - box.min[0], y = box.max[1] - box.min[1], z = box.max[2] - box.min[2], xy = TRB_MAX(x, y);\n",
  "  return TRB_MAX(xy, z);\n",
  "}\n",
  "\n",
  "TRB_CORE int trb_cuts(trbvh_node box, trb_plane plane) {\n",
  "  const int k = plane.axis;\n",
  "  return plane.position > box.min[k] && plane.position < box.max[k] && box.max[k] - box.min[k] > TRB_TINY;\n",
  "}\n",
  "\n",
  "\n",
  "\n",
  "TRB_CORE int trb_choose_plane(trbvh_node box, trb_grid grid, trb_plane *plane) {\n",
  "  const float longest = trb_longest_side(box);\n",
  "  int k;\n",
  "  *plane = trb_median_plane(box, grid);\n",
  "  if (!(longest > TRB_TINY && longest < 1 / TRB_TINY)) return 0;\n",
  "  if (plane->level > -TRB_GRID_BITS - 1 && trb_cuts(box, *plane)) return 1;\n",
  "  for (k = 0; box.max[k] - box.min[k] < longest; k++) {}\n",
  "  plane->axis = k;\n",
  "  plane->position = 0.5f * box.min[k] + 0.5f * box.max[k];\n",
  "  return trb_cuts(box, *plane);\n",
  "}\n",
  "\n",
  "\n",
  "TRB_CORE trbvh_u32 trb_share(trbvh_u32 splits, float left, float right) {\n",
  "  float both = left + right;\n",
  "  float share = both > TRB_TINY && both < 1 / TRB_TINY ? left * trb_reciprocal(both) : 0.5f;\n",
  "  trbvh_u32 n = (trbvh_u32)((float)splits * share + 0.5f);\n",
  "  return TRB_MIN(n, splits);\n",
  "}\n",
  "\n",
  "\n",
  "#define TRB_POLYGON 10\n",
  "TRB_CORE int trb_cut(float polygon[TRB_POLYGON][3], int n, int k, float position, float sign) {\n",
  "  float kept[TRB_POLYGON][3];\n",
  "  int i, j, count = 0;\n",
  "  for (i = 0; i < n; i++) {\n",
  "    int next = i + 1 < n ? i + 1 : 0;\n",
  "    float a = (polygon[i][k] - position) * sign, b = (polygon[next][k] - position) * sign;\n",
  "    if (a >= -TRB_TINY && count < TRB_POLYGON) {\n",
  "      for (j = 0; j < 3; j++) kept[count][j] = polygon[i][j];\n",
  "      count++;\n",
  "    }\n",
  "    if (((a > 0 && b < -TRB_TINY) || (a < -TRB_TINY && b > 0)) && count < TRB_POLYGON) {\n",
  "      float t = trb_abs(a) * trb_reciprocal(trb_abs(a) + trb_abs(b));\n",
  "      for (j = 0; j < 3; j++) kept[count][j] = polygon[i][j] + (polygon[next][j] - polygon[i][j]) * t;\n",
  "      kept[count][k] = position;\n",
  "      count++;\n",
  "    }\n",
  "  }\n",
  "  for (i = 0; i < count; i++)\n",
  "    for (j = 0; j < 3; j++) polygon[i][j] = kept[i][j];\n",
  "  return count;\n",
  "}\n",
  "#line 796 \"trbvh.h\"\n",
  "TRB_CORE int trb_clip(const float v[3][3], trbvh_node *box) {\n",
  "  float polygon[TRB_POLYGON][3], pad[3];\n",
  "  trbvh_node bounds = *box;\n",
  "  int i, j, k, n = 3;\n",
  "  for (i = 0; i < 3; i++)\n",
  "    for (j = 0; j < 3; j++) polygon[i][j] = v[i][j];\n",
  "  for (k = 0; k < 3; k++) {\n",
  "    float a = trb_abs(v[0][k]), b = trb_abs(v[1][k]), c = trb_abs(v[2][k]), ab = TRB_MAX(a, b);\n",
  "    pad[k] = TRB_MAX(ab, c) * 9.5367432e-7f;\n",
  "    n = trb_cut(polygon, n, k, box->min[k] - pad[k], 1);\n",
  "    n = trb_cut(polygon, n, k, box->max[k] + pad[k], -1);\n",
  "  }\n",
  "  if (n == 0) return 0;\n",
  "  for (k = 0; k < 3; k++) {\n",
  "    float low = polygon[0][k], high = polygon[0][k];\n",
  "    for (i = 1; i < n; i++) {\n",
  "      low = TRB_MIN(low, polygon[i][k]);\n",
  "      high = TRB_MAX(high, polygon[i][k]);\n",
  "    }\n",
  "    low -= 0.5f * pad[k];\n",
  "    high += 0.5f * pad[k];\n",
  "    bounds.min[k] = trb_no_sign(TRB_MAX(low, box->min[k]));\n",
  "    bounds.max[k] = trb_no_sign(TRB_MIN(high, box->max[k]));\n",
  "    if (!(bounds.min[k] <= bounds.max[k])) return 0;\n",
  "  }\n",
  "  *box = bounds;\n",
  "  return 1;\n",
  "}\n",
  "#line 828 \"trbvh.h\"\n",
  "  typedef struct trb_mesh {\n",
  "    const __global char *positions, *indices, *boxes;\n",
  "    ulong position_stride, box_stride;\n",
  "    uint position_count, index_size, count;\n",
  "  } trb_mesh;\n",
  "\n",
  "\n",
  "\n",
  "#define TRB_AHEAD 32u\n",
  "\n",
  "\n",
  "TRB_CORE float trb_load_float(const TRB_GLOBAL char *p) {\n",
  "\n",
  "  return *(const __global float *)p;\n",
  "#line 850 \"trbvh.h\"\n",
  "}\n",
  "\n",
  "TRB_CORE void trb_load_position(float out[3], const TRB_GLOBAL char *p) {\n",
  "  out[0] = trb_load_float(p);\n",
  "  out[1] = trb_load_float(p + 4);\n",
  "  out[2] = trb_load_float(p + 8);\n",
  "}\n",
  "\n",
  "TRB_CORE trbvh_u32 trb_index16(const trb_mesh *mesh, size_t i) {\n",
  "\n",
  "  return ((const __global ushort *)mesh->indices)[i];\n",
  "#line 866 \"trbvh.h\"\n",
  "}\n",
  "\n",
  "TRB_CORE trbvh_u32 trb_index32(const trb_mesh *mesh, size_t i) {\n",
  "\n",
  "  return ((const __global uint *)mesh->indices)[i];\n",
  "#line 876 \"trbvh.h\"\n",
  "}\n",
  "\n",
  "TRB_CORE trbvh_u32 trb_index(const trb_mesh *mesh, size_t i) {\n",
  "  return mesh->index_size == 2 ? trb_index16(mesh, i) : trb_index32(mesh, i);\n",
  "}\n",
  "\n",
  "TRB_CORE const TRB_GLOBAL char *trb_position(const trb_mesh *mesh, size_t i) {\n",
  "  return (const TRB_GLOBAL char *)mesh->positions + i * mesh->position_stride;\n",
  "}\n",
  "\n",
  "\n",
  "TRB_SHARED int trb_load_triangle(const trb_mesh *mesh, trbvh_u32 i, float v[3][3], trbvh_u32 *vertex) {\n",
  "  size_t k, corner = (size_t)i * 3;\n",
  "  for (k = 0; k < 3; k++) {\n",
  "    size_t position = corner + k;\n",
  "    if (mesh->indices) {\n",
  "      *vertex = trb_index(mesh, corner + k);\n",
  "      if (*vertex >= mesh->position_count) return 0;\n",
  "      position = *vertex;\n",
  "    }\n",
  "    trb_load_position(v[k], trb_position(mesh, position));\n",
  "  }\n",
  "  return 1;\n",
  "}\n",
  "\n",
  "\n",
  "\n",
  "TRB_CORE void trb_prefetch_indices(const trb_mesh *mesh, trbvh_u32 i) {\n",
  "  if (mesh->indices) TRB_PREFETCH((const TRB_GLOBAL char *)mesh->indices + (size_t)i * 3 * mesh->index_size);\n",
  "}\n",
  "\n",
  "TRB_CORE void trb_prefetch_positions(const trb_mesh *mesh, trbvh_u32 i) {\n",
  "  size_t k, corner = (size_t)i * 3;\n",
  "  if (mesh->boxes) {\n",
  "    TRB_PREFETCH((const TRB_GLOBAL char *)mesh->boxes + (size_t)i * mesh->box_stride);\n",
  "    return;\n",
  "  }\n",
  "  for (k = 0; k < 3; k++)\n",
  "    TRB_PREFETCH(trb_position(mesh, mesh->indices ? trb_index(mesh, corner + k) : corner + k));\n",
  "}\n",
  "\n",
  "TRB_SHARED trbvh_node trb_no_box(void) {\n",
  "  trbvh_node n;\n",
  "  int k;\n",
  "  for (k = 0; k < 3; k++) { n.min[k] = FLT_MAX; n.max[k] = -FLT_MAX; }\n",
  "  n.first = n.count = 0;\n",
  "  return n;\n",
  "}\n",
  "\n",
  "TRB_SHARED void trb_include(trbvh_node *n, const float low[3], const float high[3]) {\n",
  "  int k;\n",
  "  for (k = 0; k < 3; k++) {\n",
  "    n->min[k] = TRB_MIN(low[k], n->min[k]);\n",
  "    n->max[k] = TRB_MAX(high[k], n->max[k]);\n",
  "  }\n",
  "}\n",
  "\n",
  "\n",
  "TRB_SHARED int trb_triangle_box(const float v[3][3], trbvh_node *box) {\n",
  "  int k, finite = 1;\n",
  "  for (k = 0; k < 3; k++) {\n",
  "    float low = TRB_MIN(v[0][k], v[1][k]), high = TRB_MAX(v[0][k], v[1][k]);\n",
  "    box->min[k] = trb_no_sign(TRB_MIN(v[2][k], low));\n",
  "    box->max[k] = trb_no_sign(TRB_MAX(v[2][k], high));\n",
  "    finite &= trb_finite(v[0][k]) & trb_finite(v[1][k]) & trb_finite(v[2][k]);\n",
  "  }\n",
  "  box->first = box->count = 0;\n",
  "  return finite;\n",
  "}\n",
  "\n",
  "TRB_SHARED int trb_valid_box(trbvh_node box) {\n",
  "  int k, valid = 1;\n",
  "  for (k = 0; k < 3; k++) valid &= trb_finite(box.min[k]) & trb_finite(box.max[k]) & (box.min[k] <= box.max[k]);\n",
  "  return valid;\n",
  "}\n",
  "\n",
  "\n",
  "\n",
  "TRB_SHARED int trb_prim_box(const trb_mesh *mesh, trbvh_u32 i, trbvh_node *box, float v[3][3], trbvh_u32 *vertex) {\n",
  "  const TRB_GLOBAL char *p;\n",
  "  int k;\n",
  "  if (!mesh->boxes) return trb_load_triangle(mesh, i, v, vertex) ? trb_triangle_box((const float (*)[3])v, box) : -1;\n",
  "  p = (const TRB_GLOBAL char *)mesh->boxes + (size_t)i * mesh->box_stride;\n",
  "  trb_load_position(box->min, p);\n",
  "  trb_load_position(box->max, p + 12);\n",
  "  for (k = 0; k < 3; k++) { box->min[k] = trb_no_sign(box->min[k]); box->max[k] = trb_no_sign(box->max[k]); }\n",
  "  box->first = box->count = 0;\n",
  "  return trb_valid_box(*box);\n",
  "}\n",
  "\n",
  "\n",
  "\n",
  "#define TRB_ROW 64u\n",
  "typedef struct trb_row {\n",
  "  float     min[3][TRB_ROW], max[3][TRB_ROW];\n",
  "  float     check[TRB_ROW];\n",
  "  trbvh_u32 valid[TRB_ROW], prim[TRB_ROW];\n",
  "} trb_row;\n",
  "\n",
  "\n",
  "#define TRB_BOXES 1u\n",
  "TRB_CORE trbvh_u32 trb_mesh_form(const trb_mesh *mesh) {\n",
  "  return mesh->boxes ? TRB_BOXES : mesh->indices ? mesh->index_size : 0;\n",
  "}\n",
  "\n",
  "TRB_CORE size_t trb_vertex(const trb_mesh *mesh, trbvh_u32 form, size_t corner) {\n",
  "  return form == 4 ? trb_index32(mesh, corner) : form == 2 ? trb_index16(mesh, corner) : corner;\n",
  "}\n",
  "\n",
  "TRB_CORE void trb_prefetch_corners(const trb_mesh *mesh, trbvh_u32 form, size_t prim) {\n",
  "  TRB_PREFETCH(trb_position(mesh, trb_vertex(mesh, form, 3 * prim)));\n",
  "  TRB_PREFETCH(trb_position(mesh, trb_vertex(mesh, form, 3 * prim + 1)));\n",
  "  TRB_PREFETCH(trb_position(mesh, trb_vertex(mesh, form, 3 * prim + 2)));\n",
  "}\n",
  "\n",
  "\n",
  "TRB_CORE int trb_read_box(const trb_mesh *mesh, trbvh_u32 form, trb_row *row, trbvh_u32 i) {\n",
  "  const size_t prim = row->prim[i];\n",
  "  float a[3], b[3], c[3];\n",
  "  if (form == TRB_BOXES) {\n",
  "    const TRB_GLOBAL char *p = (const TRB_GLOBAL char *)mesh->boxes + prim * mesh->box_stride;\n",
  "    trb_load_position(a, p);\n",
  "    trb_load_position(b, p + 12);\n",
  "    #define TRB_AXIS(k) row->min[k][i] = trb_no_sign(a[k]); row->max[k][i] = trb_no_sign(b[k]);\n",
  "    TRB_AXIS(0) TRB_AXIS(1) TRB_AXIS(2)\n",
  "    #undef TRB_AXIS\n",
  "    row->check[i] = (a[0] + a[1] + a[2]) + (b[0] + b[1] + b[2]);\n",
  "    if (!(a[0] <= b[0] && a[1] <= b[1] && a[2] <= b[2])) row->check[i] = trb_float(0x7F800000u);\n",
  "  } else {\n",
  "    const size_t v0 = trb_vertex(mesh, form, 3 * prim), v1 = trb_vertex(mesh, form, 3 * prim + 1);\n",
  "    const size_t v2 = trb_vertex(mesh, form, 3 * prim + 2);\n",
  "    if (form && (v0 >= mesh->position_count || v1 >= mesh->position_count || v2 >= mesh->position_count)) return 0;\n",
  "    trb_load_position(a, trb_position(mesh, v0));\n",
  "    trb_load_position(b, trb_position(mesh, v1));\n",
  "    trb_load_position(c, trb_position(mesh, v2));\n",
  "    #define TRB_AXIS(k) { \\\n",
  "      float low = TRB_MIN(a[k], b[k]), high = TRB_MAX(a[k], b[k]); \\\n",
  "      row->min[k][i] = trb_no_sign(TRB_MIN(c[k], low)); \\\n",
  "      row->max[k][i] = trb_no_sign(TRB_MAX(c[k], high)); }\n",
  "    TRB_AXIS(0) TRB_AXIS(1) TRB_AXIS(2)\n",
  "    #undef TRB_AXIS\n",
  "    row->check[i] = (a[0] + a[1] + a[2]) + (b[0] + b[1] + b[2]) + (c[0] + c[1] + c[2]);\n",
  "  }\n",
  "  return 1;\n",
  "}\n",
  "\n",
  "TRB_CORE trbvh_u32 trb_read_form(const trb_mesh *mesh, trbvh_u32 form, trbvh_u32 count, trb_row *row) {\n",
  "  trbvh_u32 i = 0;\n",
  "  while (i < count && trb_read_box(mesh, form, row, i)) i++;\n",
  "  return i;\n",
  "}\n",
  "\n",
  "\n",
  "TRB_SHARED trbvh_u32 trb_read_row(const trb_mesh *mesh, trbvh_u32 count, trb_row *row) {\n",
  "  switch (trb_mesh_form(mesh)) {\n",
  "    case 0: return trb_read_form(mesh, 0, count, row);\n",
  "    case 2: return trb_read_form(mesh, 2, count, row);\n",
  "    case 4: return trb_read_form(mesh, 4, count, row);\n",
  "    default: return trb_read_form(mesh, TRB_BOXES, count, row);\n",
  "  }\n",
  "}\n",
  "\n",
  "TRB_CORE void trb_prefetch_row(const trb_mesh *mesh, trbvh_u32 count, const trb_row *row) {\n",
  "  const trbvh_u32 form = trb_mesh_form(mesh);\n",
  "  trbvh_u32 i;\n",
  "  if (form == 4) for (i = 0; i < count; i++) trb_prefetch_corners(mesh, 4, row->prim[i]);\n",
  "  else if (form == 2) for (i = 0; i < count; i++) trb_prefetch_corners(mesh, 2, row->prim[i]);\n",
  "  else for (i = 0; i < count; i++) trb_prefetch_positions(mesh, row->prim[i]);\n",
  "}\n",
  "\n",
  "\n",
  "TRB_SHARED trbvh_u32 trb_check_row(const trb_mesh *mesh, trbvh_u32 count, trb_row *row) {\n",
  "  trbvh_u32 i, k, suspect = 0, valid = count;\n",
  "  for (i = count; i < TRB_ROW; i++) row->check[i] = 0;\n",
  "  for (i = 0; i < TRB_ROW; i++) suspect |= !trb_finite(row->check[i]);\n",
  "  for (i = 0; i < TRB_ROW; i++) row->valid[i] = 1;\n",
  "  for (i = 0; suspect && i < count; i++) {\n",
  "    trbvh_node box;\n",
  "    trbvh_u32 vertex;\n",
  "    float v[3][3];\n",
  "    if (trb_finite(row->check[i]) || trb_prim_box(mesh, row->prim[i], &box, v, &vertex) > 0) continue;\n",
  "    for (k = 0; k < 3; k++) { row->min[k][i] = FLT_MAX; row->max[k][i] = -FLT_MAX; }\n",
  "    row->valid[i] = 0;\n",
  "    valid--;\n",
  "  }\n",
  "  return valid;\n",
  "}\n",
  "\n",
  "TRB_CORE trbvh_node trb_row_box(const trb_row *row, trbvh_u32 i) {\n",
  "  trbvh_node box;\n",
  "  trbvh_u32 k;\n",
  "  for (k = 0; k < 3; k++) { box.min[k] = row->min[k][i]; box.max[k] = row->max[k][i]; }\n",
  "  box.first = row->prim[i];\n",
  "  box.count = 0;\n",
  "  return box;\n",
  "}\n",
  "\n",
  "\n",
  "TRB_SHARED trb_grid trb_make_grid(trbvh_node bounds) {\n",
  "  trb_grid grid;\n",
  "  float extent = 0;\n",
  "  int k;\n",
  "  for (k = 0; k < 3; k++) {\n",
  "    float side = bounds.max[k] - bounds.min[k];\n",
  "    grid.origin[k] = bounds.min[k];\n",
  "    extent = TRB_MAX(side, extent);\n",
  "  }\n",
  "  grid.units_per_cell = extent * (1.0f / 2097152.0f);\n",
  "  grid.cells_per_unit = extent > 1e-30f && extent < FLT_MAX ? trb_reciprocal(grid.units_per_cell) : 0;\n",
  "  return grid;\n",
  "}\n",
  "#line 1093 \"trbvh.h\"\n",
  "#define TRB_SCALE_BITS  36\n",
  "#define TRB_SCALES      2561u\n",
  "#define TRB_SPLIT_STACK 64u\n",
  "\n",
  "TRB_CORE trb_u64 trb_scale(trbvh_u32 i) { return (trb_u64)(64 + (i & 63)) << (i >> 6) >> 6; }\n",
  "\n",
  "\n",
  "TRB_CORE float trb_unit(float largest, trbvh_u32 bits) {\n",
  "  trbvh_u32 exponent = trb_bits(largest) >> 23;\n",
  "  return trb_float((127u + 127u + bits - 1 - TRB_MAX(exponent, bits)) << 23);\n",
  "}\n",
  "TRB_CORE float trb_priority_unit(float largest) { return trb_unit(largest, 24); }\n",
  "\n",
  "TRB_CORE trb_u64 trb_splits(float priority, float unit, trb_u64 scale) {\n",
  "  return ((trb_u64)(trbvh_u32)(priority * unit) * scale) >> TRB_SCALE_BITS;\n",
  "}\n",
  "\n",
  "\n",
  "TRB_SHARED trbvh_u32 trb_split_reference(const trb_mesh *mesh, trb_grid grid, trbvh_node ref, trbvh_u32 splits,\n",
  "                                         TRB_GLOBAL trbvh_node *out) {\n",
  "  struct { trbvh_node box; trbvh_u32 splits; } stack[TRB_SPLIT_STACK];\n",
  "  trbvh_u32 top = 0, count = 0, vertex;\n",
  "  float v[3][3];\n",
  "  if (splits == 0 || !trb_load_triangle(mesh, ref.first, v, &vertex)) {\n",
  "    out[0] = ref;\n",
  "    return 1;\n",
  "  }\n",
  "  stack[top].box = ref;\n",
  "  stack[top++].splits = splits;\n",
  "  while (top) {\n",
  "    trbvh_node left, right;\n",
  "    trb_plane plane;\n",
  "    int in_left, in_right;\n",
  "    trbvh_u32 rest = stack[--top].splits;\n",
  "    left = right = stack[top].box;\n",
  "    if (rest == 0 || top + 2 > TRB_SPLIT_STACK || !trb_choose_plane(left, grid, &plane)) {\n",
  "      out[count++] = left;\n",
  "      continue;\n",
  "    }\n",
  "    left.max[plane.axis] = right.min[plane.axis] = plane.position;\n",
  "    in_left = trb_clip((const float (*)[3])v, &left);\n",
  "    in_right = trb_clip((const float (*)[3])v, &right);\n",
  "    if (in_left && in_right) {\n",
  "      trbvh_u32 share = trb_share(--rest, trb_longest_side(left), trb_longest_side(right));\n",
  "      stack[top].box = right;\n",
  "      stack[top++].splits = rest - share;\n",
  "      stack[top].box = left;\n",
  "      stack[top++].splits = share;\n",
  "    } else if (in_left || in_right) {\n",
  "      stack[top].box = in_left ? left : right;\n",
  "      stack[top++].splits = rest - 1;\n",
  "    } else {\n",
  "      out[count++] = stack[top].box;\n",
  "    }\n",
  "  }\n",
  "  return count;\n",
  "}\n",
  "#line 1156 \"trbvh.h\"\n",
  "#ifndef TRB_PACKED_REFS\n",
  "  #define TRB_PACKED_REFS (1u << 24)\n",
  "#endif\n",
  "#define TRB_CODE_BITS  44u\n",
  "#define TRB_DIGIT_BITS 11u\n",
  "#define TRB_DIGITS     (1u << TRB_DIGIT_BITS)\n",
  "#define TRB_SMALL_SORT 4096u\n",
  "#define TRB_TINY_SORT  48u\n",
  "#define TRB_SORT_BLOCK 65536u\n",
  "\n",
  "#ifndef TRB_LARGE_SORT\n",
  "  #define TRB_LARGE_SORT 131072u\n",
  "#endif\n",
  "#define TRB_BUCKETS       32u\n",
  "#define TRB_BUCKET_PASSES 4u\n",
  "#define TRB_BUCKET_BITS   9u\n",
  "\n",
  "\n",
  "typedef struct trb_key_form { trbvh_u32 packed, bits, shift; } trb_key_form;\n",
  "\n",
  "TRB_CORE trbvh_u32 trb_key_ref(trb_u64 key, trb_key_form form) {\n",
  "  return (trbvh_u32)(key & (((trb_u64)1 << form.shift) - 1));\n",
  "}\n",
  "\n",
  "\n",
  "TRB_CORE trb_u64 trb_key(trb_u64 code, trbvh_u32 ref, trb_key_form form, int high) {\n",
  "  if (form.packed) code >>= 63 - form.bits;\n",
  "  else code = high ? code >> 31 : code & 0x7FFFFFFFu;\n",
  "  return code << form.shift | ref;\n",
  "}\n",
  "\n",
  "TRB_SHARED void trb_count_digits(const TRB_GLOBAL trb_u64 *keys, trbvh_u32 count, trbvh_u32 shift, trbvh_u32 digits,\n",
  "                                 TRB_GLOBAL trbvh_u32 *histogram) {\n",
  "  trbvh_u32 i;\n",
  "  for (i = 0; i < digits; i++) histogram[i] = 0;\n",
  "  for (i = 0; i < count; i++) histogram[(keys[i] >> shift) & (digits - 1)]++;\n",
  "}\n",
  "\n",
  "\n",
  "TRB_SHARED void trb_scatter_keys(const TRB_GLOBAL trb_u64 *keys, trbvh_u32 count, trbvh_u32 shift, trbvh_u32 digits,\n",
  "                                 TRB_GLOBAL trbvh_u32 *next, TRB_GLOBAL trb_u64 *sorted) {\n",
  "  trbvh_u32 i;\n",
  "  for (i = 0; i < count; i++) {\n",
  "    trb_u64 key = keys[i];\n",
  "    sorted[next[(key >> shift) & (digits - 1)]++] = key;\n",
  "  }\n",
  "}\n",
  "\n",
  "\n",
  "TRB_SHARED void trb_place_digits(TRB_GLOBAL trbvh_u32 *histograms, trbvh_u32 blocks, trbvh_u32 digits) {\n",
  "  trbvh_u32 digit, block, start = 0;\n",
  "  for (digit = 0; digit < digits; digit++)\n",
  "    for (block = 0; block < blocks; block++) {\n",
  "      TRB_GLOBAL trbvh_u32 *count = histograms + (size_t)block * digits + digit;\n",
  "      trbvh_u32 n = *count;\n",
  "      *count = start;\n",
  "      start += n;\n",
  "    }\n",
  "}\n",
  "#line 1223 \"trbvh.h\"\n",
  "#define TRB_BLOCK    16384u\n",
  "#define TRB_TOP      1024u\n",
  "#define TRB_NEAR     98304u\n",
  "#define TRB_OPEN_MAX 200u\n",
  "#define TRB_NO_SPLIT (~(trb_u64)0)\n",
  "\n",
  "\n",
  "typedef struct trb_curve {\n",
  "  const TRB_GLOBAL trb_u64    *keys;\n",
  "  const TRB_GLOBAL trbvh_node *refs;\n",
  "\n",
  "\n",
  "\n",
  "  trb_grid     grid;\n",
  "  trb_key_form form;\n",
  "  trbvh_u32    count;\n",
  "} trb_curve;\n",
  "\n",
  "\n",
  "TRB_CORE trbvh_node trb_curve_ref(const trb_curve *c, trb_u64 key) {\n",
  "  const trbvh_u32 ref = trb_key_ref(key, c->form);\n",
  "#line 1254 \"trbvh.h\"\n",
  "  return c->refs[ref];\n",
  "}\n",
  "\n",
  "\n",
  "TRB_SHARED void trb_read_leaves(const trb_curve *c, trbvh_u32 first, trbvh_u32 count, trbvh_u32 end, trb_row *row) {\n",
  "  const trbvh_u32 next = first + count, soon = TRB_MIN(next + TRB_ROW, end);\n",
  "  trbvh_u32 i, k;\n",
  "#line 1271 \"trbvh.h\"\n",
  "  for (i = next; i < soon; i++) TRB_PREFETCH(&c->refs[trb_key_ref(c->keys[i], c->form)]);\n",
  "  for (i = 0; i < count; i++) {\n",
  "    const trbvh_node ref = c->refs[trb_key_ref(c->keys[first + i], c->form)];\n",
  "    for (k = 0; k < 3; k++) { row->min[k][i] = ref.min[k]; row->max[k][i] = ref.max[k]; }\n",
  "    row->prim[i] = trb_key_ref(c->keys[first + i], c->form);\n",
  "  }\n",
  "}\n",
  "\n",
  "\n",
  "TRB_CORE trb_u64 trb_split_after(const trb_curve *c, trbvh_u32 i) {\n",
  "  trb_u64 a, b, code;\n",
  "  if (i >= c->count - 1) return TRB_NO_SPLIT;\n",
  "  a = c->keys[i];\n",
  "  b = c->keys[i + 1];\n",
  "  if (c->form.packed) return a ^ b;\n",
  "  code = trb_box_code(trb_curve_ref(c, a), c->grid) ^ trb_box_code(trb_curve_ref(c, b), c->grid);\n",
  "  return code ? code | (trb_u64)1 << 63 : (trbvh_u32)(a ^ b);\n",
  "}\n",
  "#line 1293 \"trbvh.h\"\n",
  "typedef struct trb_open {\n",
  "  trbvh_node node;\n",
  "  trb_u64    split;\n",
  "  trbvh_u32  pair, prim, first_pair, end_pair;\n",
  "} trb_open;\n",
  "typedef struct trb_range { trbvh_u32 open_count; trb_open open[TRB_OPEN_MAX]; } trb_range;\n",
  "\n",
  "typedef struct trb_forest {\n",
  "  TRB_GLOBAL trbvh_node *nodes;\n",
  "  TRB_GLOBAL trb_range  *range;\n",
  "  trb_costs  costs;\n",
  "  trb_u64    left_split;\n",
  "  trbvh_u32  height;\n",
  "  trbvh_u32  end, pairs;\n",
  "  struct { trb_u64 split; trbvh_u32 pair, prim, first_pair; } stack[TRB_OPEN_MAX];\n",
  "} trb_forest;\n",
  "#line 1313 \"trbvh.h\"\n",
  "#define TRB_TO_RESTRUCTURE 0\n",
  "#define TRB_FINAL_BLOCK    1\n",
  "#define TRB_FINAL_TOP      2\n",
  "\n",
  "\n",
  "\n",
  "TRB_CORE trbvh_u32 trb_waits_at(const trb_forest *f, trbvh_u32 i, int use) {\n",
  "  return 2 * (use == TRB_FINAL_BLOCK ? f->end - i : f->stack[i].pair);\n",
  "}\n",
  "\n",
  "TRB_CORE void trb_leave_open(trb_forest *f, trbvh_u32 i, trbvh_u32 end_pair, int use) {\n",
  "  TRB_GLOBAL trb_open *open = &f->range->open[f->range->open_count++];\n",
  "  TRBVH_ASSERT(f->range->open_count <= TRB_OPEN_MAX);\n",
  "  open->node = f->nodes[trb_waits_at(f, i, use)];\n",
  "  open->split = f->stack[i].split;\n",
  "  open->pair = f->stack[i].pair;\n",
  "  open->prim = f->stack[i].prim;\n",
  "  open->first_pair = f->stack[i].first_pair;\n",
  "  open->end_pair = end_pair;\n",
  "}\n",
  "\n",
  "\n",
  "TRB_CORE void trb_push(trb_forest *f, trbvh_node node, trb_u64 split, trbvh_u32 pair, trbvh_u32 prim, int use) {\n",
  "  trbvh_u32 first_pair = f->pairs;\n",
  "  while (f->height && f->stack[f->height - 1].split <= split) {\n",
  "    const trbvh_u32 top = --f->height, left_pair = f->stack[top].first_pair;\n",
  "    if (top || f->left_split >= f->stack[top].split) {\n",
  "      const trbvh_u32 at = use == TRB_FINAL_BLOCK ? f->pairs : f->stack[top].pair;\n",
  "      const trbvh_node left = f->nodes[trb_waits_at(f, top, use)];\n",
  "      if (use == TRB_FINAL_BLOCK) f->nodes[2 * at] = left;\n",
  "      f->nodes[2 * at + 1] = node;\n",
  "      node = trb_parent(left, node, 2 * at, f->costs);\n",
  "      if (use != TRB_TO_RESTRUCTURE) {\n",
  "        const int leaf = trb_is_leaf(node.count);\n",
  "        first_pair = left_pair;\n",
  "        node.first = leaf ? prim : node.first;\n",
  "        f->pairs = leaf ? first_pair : f->pairs + 1;\n",
  "      }\n",
  "    } else {\n",
  "      f->left_split = f->stack[top].split;\n",
  "      trb_leave_open(f, top, first_pair, use);\n",
  "    }\n",
  "  }\n",
  "  TRBVH_ASSERT(f->height < TRB_OPEN_MAX);\n",
  "  f->stack[f->height].split = split;\n",
  "  f->stack[f->height].pair = pair;\n",
  "  f->stack[f->height].prim = prim;\n",
  "  f->stack[f->height].first_pair = first_pair;\n",
  "  f->nodes[trb_waits_at(f, f->height++, use)] = node;\n",
  "}\n",
  "\n",
  "TRB_CORE void trb_build_block_for(const trb_curve *curve, trbvh_u32 first, trbvh_u32 end, trb_costs costs,\n",
  "                                  TRB_GLOBAL trbvh_node *nodes, TRB_GLOBAL trb_range *range, int use) {\n",
  "  trbvh_u32 i, n;\n",
  "  trb_row row;\n",
  "  trb_forest f;\n",
  "  f.nodes = nodes;\n",
  "  f.range = range;\n",
  "  f.costs = costs;\n",
  "  f.left_split = trb_split_after(curve, first - 1);\n",
  "  f.height = 0;\n",
  "  f.end = end;\n",
  "  f.pairs = first + 1;\n",
  "  range->open_count = 0;\n",
  "  for (; first < end; first += n) {\n",
  "    n = TRB_MIN(end - first, TRB_ROW);\n",
  "    trb_read_leaves(curve, first, n, curve->count > TRB_NEAR ? end : first + n, &row);\n",
  "    for (i = 0; i < n; i++) {\n",
  "      const trbvh_u32 after = first + i + 1, prim = curve->count - after;\n",
  "      trbvh_node node = trb_reference(trb_row_box(&row, i), costs);\n",
  "      if (use == TRB_FINAL_BLOCK) node.first = prim;\n",
  "      trb_push(&f, node, trb_split_after(curve, first + i), after < curve->count ? after : 0, prim, use);\n",
  "    }\n",
  "  }\n",
  "  for (i = 0; i < f.height; i++) trb_leave_open(&f, i, i + 1 < f.height ? f.stack[i + 1].first_pair : f.pairs, use);\n",
  "  for (i = 0; use == TRB_FINAL_BLOCK && i < range->open_count; i++)\n",
  "    if (range->open[i].pair) range->open[i].pair = end - (range->open_count - 1 - i);\n",
  "}\n",
  "\n",
  "\n",
  "TRB_SHARED void trb_build_block(const trb_curve *curve, trbvh_u32 first, trbvh_u32 end, trb_costs costs, int final,\n",
  "                                TRB_GLOBAL trbvh_node *nodes, TRB_GLOBAL trb_range *range) {\n",
  "  if (final) trb_build_block_for(curve, first, end, costs, nodes, range, TRB_FINAL_BLOCK);\n",
  "  else trb_build_block_for(curve, first, end, costs, nodes, range, TRB_TO_RESTRUCTURE);\n",
  "}\n",
  "\n",
  "\n",
  "TRB_SHARED void trb_build_top(TRB_GLOBAL trbvh_node *nodes, const TRB_GLOBAL trb_range *ranges, trbvh_u32 blocks,\n",
  "                              trb_costs costs, int final) {\n",
  "  trbvh_u32 i, k;\n",
  "  trb_forest f;\n",
  "  f.nodes = nodes;\n",
  "  f.range = 0;\n",
  "  f.costs = costs;\n",
  "  f.left_split = TRB_NO_SPLIT;\n",
  "  f.height = f.end = f.pairs = 0;\n",
  "  for (i = 0; i < blocks; i++)\n",
  "    for (k = 0; k < ranges[i].open_count; k++) {\n",
  "      const trb_open open = ranges[i].open[k];\n",
  "      trb_push(&f, open.node, open.split, open.pair, open.prim, final ? TRB_FINAL_TOP : TRB_TO_RESTRUCTURE);\n",
  "    }\n",
  "  TRBVH_ASSERT(f.height == 1);\n",
  "}\n",
  "#line 1420 \"trbvh.h\"\n",
  "#define TRB_LANE_LOAD(p)     (*(p))\n",
  "#define TRB_LANE_STORE(p, x) (*(p) = (x))\n",
  "#define TRB_LANE_OF(x)       (x)\n",
  "#define TRB_LANE_ADD(a, b)   ((a) + (b))\n",
  "#define TRB_LANE_SUB(a, b)   ((a) - (b))\n",
  "#define TRB_LANE_MUL(a, b)   ((a) * (b))\n",
  "#define TRB_LANE_MIN(a, b)   TRB_MIN(a, b)\n",
  "#define TRB_LANE_MAX(a, b)   TRB_MAX(a, b)\n",
  "\n",
  "#if defined(TRB_CPU)\n",
  "  #undef  TRB_LANE_LOAD\n",
  "  #undef  TRB_LANE_STORE\n",
  "  #undef  TRB_LANE_OF\n",
  "  #define TRB_LANE             float16\n",
  "  #define TRB_LANE_LOAD(p)     (*(const float16 *)(p))\n",
  "  #define TRB_LANE_STORE(p, x) (*(float16 *)(p) = (x))\n",
  "  #define TRB_LANE_OF(x)       ((float16)(x))\n",
  "  TRB_DEFINE_TREELET_COSTS(TRB_CORE void trb_treelet_costs_16)\n",
  "\n",
  "TRB_CORE void trb_treelet_costs(const float *leaves, float *table, float *sums, trbvh_u32 lanes, trb_costs costs) {\n",
  "  trb_treelet_costs_16(leaves, table, sums, costs);\n",
  "}\n",
  "#elif defined(TRBVH_OPENCL_C)\n",
  "  #define TRB_LANE             float\n",
  "  TRB_DEFINE_TREELET_COSTS(TRB_CORE void trb_treelet_costs_1)\n",
  "\n",
  "#elif defined(TRB_X86) || defined(TRB_VECTOR4)\n",
  "  #undef  TRB_LANE_LOAD\n",
  "  #undef  TRB_LANE_STORE\n",
  "  #undef  TRB_LANE_OF\n",
  "  #undef  TRB_LANE_ADD\n",
  "  #undef  TRB_LANE_SUB\n",
  "  #undef  TRB_LANE_MUL\n",
  "  #undef  TRB_LANE_MIN\n",
  "  #undef  TRB_LANE_MAX\n",
  "#endif\n",
  "\n",
  "#if defined(TRB_X86)\n",
  "  #define TRB_MM_PASTE(mm, op) mm##_##op##_ps\n",
  "  #define TRB_MM_CALL(mm, op)  TRB_MM_PASTE(mm, op)\n",
  "  #define TRB_LANE_LOAD(p)     TRB_MM_CALL(TRB_MM, load)(p)\n",
  "  #define TRB_LANE_STORE(p, x) TRB_MM_CALL(TRB_MM, store)(p, x)\n",
  "  #define TRB_LANE_OF(x)       TRB_MM_CALL(TRB_MM, set1)(x)\n",
  "  #define TRB_LANE_ADD(a, b)   TRB_MM_CALL(TRB_MM, add)(a, b)\n",
  "  #define TRB_LANE_SUB(a, b)   TRB_MM_CALL(TRB_MM, sub)(a, b)\n",
  "  #define TRB_LANE_MUL(a, b)   TRB_MM_CALL(TRB_MM, mul)(a, b)\n",
  "  #define TRB_LANE_MIN(a, b)   TRB_MM_CALL(TRB_MM, min)(a, b)\n",
  "  #define TRB_LANE_MAX(a, b)   TRB_MM_CALL(TRB_MM, max)(a, b)\n",
  "\n",
  "  #define TRB_LANE __m128\n",
  "  #define TRB_MM   _mm\n",
  "  TRB_DEFINE_TREELET_COSTS(static void trb_treelet_costs_sse)\n",
  "  #ifdef TRB_AVX\n",
  "  #undef TRB_LANE\n",
  "  #undef TRB_MM\n",
  "  #define TRB_LANE __m256\n",
  "  #define TRB_MM   _mm256\n",
  "  TRB_DEFINE_TREELET_COSTS(TRB_TARGET(\"avx2\") static void trb_treelet_costs_avx2)\n",
  "  #undef TRB_LANE\n",
  "  #undef TRB_MM\n",
  "  #define TRB_LANE __m512\n",
  "  #define TRB_MM   _mm512\n",
  "  TRB_DEFINE_TREELET_COSTS(TRB_TARGET(\"avx512f\") static void trb_treelet_costs_avx512)\n",
  "  #endif\n",
  "\n",
  "\n",
  "static void trb_treelet_costs(const float *leaves, float *table, float *sums, trbvh_u32 lanes, trb_costs costs) {\n",
  "  const int simd = trb_simd();\n",
  "  trbvh_u32 lane;\n",
  "#ifdef TRB_AVX\n",
  "  if (simd == 512 && lanes > 8) trb_treelet_costs_avx512(leaves, table, sums, costs);\n",
  "  else if (simd >= 256)\n",
  "    for (lane = 0; lane < lanes; lane += 8) trb_treelet_costs_avx2(leaves + lane, table + lane, sums + lane, costs);\n",
  "#endif\n",
  "  for (lane = 0; lane < lanes && simd == 128; lane += 4)\n",
  "    trb_treelet_costs_sse(leaves + lane, table + lane, sums + lane, costs);\n",
  "}\n",
  "\n",
  "#elif defined(TRB_VECTOR4)\n",
  "  #define TRB_LANE             TRB_VECTOR4\n",
  "  #if defined(__wasm_simd128__)\n",
  "    #define TRB_LANE_LOAD(p)     wasm_v128_load(p)\n",
  "    #define TRB_LANE_STORE(p, x) wasm_v128_store(p, x)\n",
  "    #define TRB_LANE_OF(x)       wasm_f32x4_splat(x)\n",
  "    #define TRB_LANE_ADD(a, b)   wasm_f32x4_add(a, b)\n",
  "    #define TRB_LANE_SUB(a, b)   wasm_f32x4_sub(a, b)\n",
  "    #define TRB_LANE_MUL(a, b)   wasm_f32x4_mul(a, b)\n",
  "    #define TRB_LANE_MIN(a, b)   wasm_f32x4_pmin(b, a)\n",
  "    #define TRB_LANE_MAX(a, b)   wasm_f32x4_pmax(b, a)\n",
  "  #else\n",
  "    #define TRB_LANE_LOAD(p)     vld1q_f32(p)\n",
  "    #define TRB_LANE_STORE(p, x) vst1q_f32(p, x)\n",
  "    #define TRB_LANE_OF(x)       vdupq_n_f32(x)\n",
  "    #define TRB_LANE_ADD(a, b)   vaddq_f32(a, b)\n",
  "    #define TRB_LANE_SUB(a, b)   vsubq_f32(a, b)\n",
  "    #define TRB_LANE_MUL(a, b)   vmulq_f32(a, b)\n",
  "    #define TRB_LANE_MIN(a, b)   trb_neon_min(a, b)\n",
  "    #define TRB_LANE_MAX(a, b)   trb_neon_max(a, b)\n",
  "    TRB_CORE float32x4_t trb_neon_min(float32x4_t a, float32x4_t b) { return vbslq_f32(vcltq_f32(a, b), a, b); }\n",
  "    TRB_CORE float32x4_t trb_neon_max(float32x4_t a, float32x4_t b) { return vbslq_f32(vcgtq_f32(a, b), a, b); }\n",
  "  #endif\n",
  "  TRB_DEFINE_TREELET_COSTS(static void trb_treelet_costs_4)\n",
  "\n",
  "static void trb_treelet_costs(const float *leaves, float *table, float *sums, trbvh_u32 lanes, trb_costs costs) {\n",
  "  trbvh_u32 lane;\n",
  "  for (lane = 0; lane < lanes; lane += 4) trb_treelet_costs_4(leaves + lane, table + lane, sums + lane, costs);\n",
  "}\n",
  "\n",
  "#elif !defined(TRBVH_OPENCL_C)\n",
  "  #define TRB_LANE             float\n",
  "  TRB_DEFINE_TREELET_COSTS(TRB_CORE void trb_treelet_costs_1)\n",
  "\n",
  "static void trb_treelet_costs(const float *leaves, float *table, float *sums, trbvh_u32 lanes, trb_costs costs) {\n",
  "  trbvh_u32 lane;\n",
  "  for (lane = 0; lane < lanes; lane++) trb_treelet_costs_1(leaves + lane, table + lane, sums + lane, costs);\n",
  "}\n",
  "#endif\n",
  "#line 1551 \"trbvh.h\"\n",
  "typedef struct trb_treelets {\n",
  "  float     leaves[TRB_TREELET * TRB_LEAF_VALUES * TRB_LANES];\n",
  "  float     table[TRB_SUBSETS * TRB_LANES + 16];\n",
  "#ifndef TRB_GPU\n",
  "  float     sums[TRB_SUBSETS * TRB_LANES + 16];\n",
  "#endif\n",
  "  trb_u64   slot[TRB_TREELET][TRB_LANES];\n",
  "  trbvh_u32 pair[TRB_TREELET - 1][TRB_LANES];\n",
  "  float     cost[TRB_LANES];\n",
  "} trb_treelets;\n",
  "\n",
  "\n",
  "TRB_CORE trb_u64 trb_slot(const TRB_GLOBAL trbvh_node *nodes, trbvh_u32 node, trbvh_u32 slot) {\n",
  "  TRB_PREFETCH(&nodes[nodes[node].first]);\n",
  "  return (trb_u64)trb_expand_key(nodes[node], slot) << 32 | node;\n",
  "}\n",
  "\n",
  "\n",
  "\n",
  "TRB_CORE float trb_expand(const TRB_GLOBAL trbvh_node *nodes, TRB_WORK trb_treelets *t, trbvh_u32 lane, trbvh_u32 step,\n",
  "                          trbvh_u32 slot, trbvh_u32 node) {\n",
  "  const trbvh_u32 pair = nodes[node].first, large = (nodes[node].count >> 31) - 1;\n",
  "  const float cost = trb_area(nodes[node]) + (trb_cost(nodes[pair].count) + trb_cost(nodes[pair + 1].count));\n",
  "  t->pair[step][lane] = pair;\n",
  "  t->slot[slot][lane] = trb_slot(nodes, pair, slot);\n",
  "  t->slot[step + 1][lane] = trb_slot(nodes, pair + 1, step + 1);\n",
  "  return trb_float(trb_bits(cost) & large);\n",
  "}\n",
  "\n",
  "TRB_CORE void trb_start_treelet(const TRB_GLOBAL trbvh_node *nodes, TRB_WORK trb_treelets *t, trbvh_u32 lane, trbvh_u32 root) {\n",
  "  t->cost[lane] = trb_cost(nodes[root].count) + trb_expand(nodes, t, lane, 0, 0, root);\n",
  "}\n",
  "\n",
  "TRB_CORE void trb_expand_largest(const TRB_GLOBAL trbvh_node *nodes, TRB_WORK trb_treelets *t, trbvh_u32 lane,\n",
  "                                 trbvh_u32 step) {\n",
  "  trb_u64 best = t->slot[0][lane];\n",
  "  trbvh_u32 i;\n",
  "  for (i = 1; i <= step; i++) best = TRB_MAX(t->slot[i][lane], best);\n",
  "  t->cost[lane] += trb_expand(nodes, t, lane, step, TRB_TREELET - ((trbvh_u32)(best >> 32) & 7u), (trbvh_u32)best);\n",
  "}\n",
  "\n",
  "\n",
  "TRB_CORE void trb_enter_leaf(const TRB_GLOBAL trbvh_node *nodes, TRB_WORK trb_treelets *t, trbvh_u32 lane, trbvh_u32 i) {\n",
  "  const TRB_GLOBAL trbvh_node *leaf = &nodes[(trbvh_u32)t->slot[i][lane]];\n",
  "  TRB_WORK float *value = &t->leaves[i * TRB_LEAF_VALUES * TRB_LANES + lane];\n",
  "  const float cost = trb_cost(leaf->count);\n",
  "  value[0 * TRB_LANES] = leaf->min[0];\n",
  "  value[1 * TRB_LANES] = leaf->min[1];\n",
  "  value[2 * TRB_LANES] = leaf->min[2];\n",
  "  value[3 * TRB_LANES] = leaf->max[0];\n",
  "  value[4 * TRB_LANES] = leaf->max[1];\n",
  "  value[5 * TRB_LANES] = leaf->max[2];\n",
  "  value[6 * TRB_LANES] = (float)trb_count(leaf->count);\n",
  "  value[7 * TRB_LANES] = cost;\n",
  "  t->cost[lane] -= cost;\n",
  "}\n",
  "\n",
  "\n",
  "TRB_SHARED void trb_sort_pairs(const TRB_WORK trb_treelets *t, trbvh_u32 lane, trbvh_u32 pairs[TRB_TREELET - 1]) {\n",
  "  trbvh_u32 a = t->pair[0][lane], b = t->pair[1][lane], c = t->pair[2][lane];\n",
  "  trbvh_u32 d = t->pair[3][lane], e = t->pair[4][lane], f = t->pair[5][lane], less;\n",
  "  #define TRB_ORDER(x, y) less = TRB_MIN(x, y); x = TRB_MAX(x, y); y = less;\n",
  "  TRB_ORDER(a, f) TRB_ORDER(b, d) TRB_ORDER(c, e)\n",
  "  TRB_ORDER(b, c) TRB_ORDER(d, e)\n",
  "  TRB_ORDER(a, d) TRB_ORDER(c, f)\n",
  "  TRB_ORDER(a, b) TRB_ORDER(c, d) TRB_ORDER(e, f)\n",
  "  TRB_ORDER(b, c) TRB_ORDER(d, e)\n",
  "  #undef TRB_ORDER\n",
  "  pairs[0] = a; pairs[1] = b; pairs[2] = c; pairs[3] = d; pairs[4] = e; pairs[5] = f;\n",
  "}\n",
  "\n",
  "\n",
  "TRB_SHARED void trb_rebuild_treelet(TRB_GLOBAL trbvh_node *nodes, const TRB_WORK trb_treelets *t, const float *sums,\n",
  "                                    trbvh_u32 lane, trbvh_u32 root, trb_costs costs) {\n",
  "  trbvh_node leaf[TRB_TREELET];\n",
  "  trbvh_u32 pairs[TRB_TREELET - 1], node[TRB_TREELET - 1], i, side, waiting = 0;\n",
  "  trbvh_u32 stack_node[TRB_TREELET], stack_subset[TRB_TREELET];\n",
  "  for (i = 0; i < TRB_TREELET; i++) leaf[i] = nodes[(trbvh_u32)t->slot[i][lane]];\n",
  "  trb_sort_pairs(t, lane, pairs);\n",
  "  stack_node[waiting] = root;\n",
  "  stack_subset[waiting++] = TRB_SUBSETS - 1;\n",
  "  for (i = 0; waiting; i++) {\n",
  "    trbvh_u32 subset = stack_subset[--waiting], part = trb_partition(t->table + lane, sums, subset);\n",
  "    node[i] = stack_node[waiting];\n",
  "    for (side = 0; side < 2; side++, part ^= subset) {\n",
  "      if (TRB_SINGLE(part)) {\n",
  "        nodes[pairs[i] + side] = leaf[trb_log2(part)];\n",
  "      } else {\n",
  "        stack_node[waiting] = pairs[i] + side;\n",
  "        stack_subset[waiting++] = part;\n",
  "      }\n",
  "    }\n",
  "  }\n",
  "  while (i--) nodes[node[i]] = trb_parent(nodes[pairs[i]], nodes[pairs[i] + 1], pairs[i], costs);\n",
  "}\n",
  "\n",
  "\n",
  "TRB_CORE void trb_finish_treelet(TRB_GLOBAL trbvh_node *nodes, TRB_WORK trb_treelets *t, const float *sums, trbvh_u32 lane,\n",
  "                                 trbvh_u32 root, trb_costs costs) {\n",
  "  float best = t->table[(TRB_SUBSETS - 1) * TRB_LANES + lane];\n",
  "  TRB_GLOBAL trbvh_node *node = &nodes[root];\n",
  "  if (trb_improves(best, t->cost[lane])) trb_rebuild_treelet(nodes, t, sums, lane, root, costs);\n",
  "  else if (trb_count(node->count) <= costs.max_leaf)\n",
  "    *node = trb_parent(nodes[node->first], nodes[node->first + 1], node->first, costs);\n",
  "}\n",
  "\n",
  "#if !defined(TRBVH_OPENCL_C) || defined(TRB_CPU)\n",
  "\n",
  "\n",
  "TRB_SHARED void trb_restructure(TRB_GLOBAL trbvh_node *nodes, TRB_WORK trb_treelets *t, const TRB_GLOBAL trbvh_u32 *roots,\n",
  "                                trbvh_u32 lanes, trb_costs costs) {\n",
  "  trbvh_u32 lane, i;\n",
  "  for (lane = 0; lane < lanes; lane++) trb_start_treelet(nodes, t, lane, roots[lane]);\n",
  "  for (i = 1; i < TRB_TREELET - 1; i++)\n",
  "    for (lane = 0; lane < lanes; lane++) trb_expand_largest(nodes, t, lane, i);\n",
  "  for (i = 0; i < TRB_TREELET; i++)\n",
  "    for (lane = 0; lane < lanes; lane++) trb_enter_leaf(nodes, t, lane, i);\n",
  "  trb_treelet_costs(t->leaves, t->table, t->sums, lanes, costs);\n",
  "  for (lane = 0; lane < lanes; lane++) trb_finish_treelet(nodes, t, t->sums + lane, lane, roots[lane], costs);\n",
  "}\n",
  "#endif\n",
  "\n",
  "\n",
  "typedef struct trb_words { TRB_GLOBAL trbvh_u32 *plane[4]; } trb_words;\n",
  "\n",
  "\n",
  "TRB_CORE trb_words trb_split_words(TRB_GLOBAL trb_u64 *low, TRB_GLOBAL trb_u64 *high, size_t count) {\n",
  "  trb_words w;\n",
  "  w.plane[0] = (TRB_GLOBAL trbvh_u32 *)low;\n",
  "  w.plane[1] = w.plane[0] + count;\n",
  "  w.plane[2] = (TRB_GLOBAL trbvh_u32 *)high;\n",
  "  w.plane[3] = w.plane[2] + count;\n",
  "  return w;\n",
  "}\n",
  "\n",
  "#if !defined(TRBVH_OPENCL_C) || defined(TRB_CPU)\n",
  "\n",
  "\n",
  "\n",
  "TRB_SHARED void trb_restructure_below(TRB_GLOBAL trbvh_node *nodes, trb_words words, trbvh_u32 first, trbvh_u32 seeds,\n",
  "                                      trbvh_u32 smallest, trb_costs costs) {\n",
  "  TRB_GLOBAL trbvh_u32 *list = words.plane[0] + first, *level = words.plane[1] + first;\n",
  "  trbvh_u32 levels = 0, count = seeds, end = 0, i, k;\n",
  "  TRB_ALIGNED(trb_treelets) t;\n",
  "  if (seeds == 0) return;\n",
  "  for (i = 0; i < TRB_TREELET * TRB_LEAF_VALUES * TRB_LANES; i++) t.leaves[i] = 0;\n",
  "  for (i = 0; end < count; end = i) {\n",
  "    level[levels++] = end = i;\n",
  "    for (k = count; i < k; i++) {\n",
  "      const trbvh_u32 pair = nodes[list[i]].first;\n",
  "      TRB_PREFETCH(&nodes[nodes[pair].first]);\n",
  "      TRB_PREFETCH(&nodes[nodes[pair + 1].first]);\n",
  "      list[count] = pair;\n",
  "      count += trb_count(nodes[pair].count) >= smallest;\n",
  "      list[count] = pair + 1;\n",
  "      count += trb_count(nodes[pair + 1].count) >= smallest;\n",
  "    }\n",
  "  }\n",
  "  while (levels--) {\n",
  "    for (i = level[levels]; i < count; i += k) {\n",
  "      k = TRB_MIN(TRB_LANES, count - i);\n",
  "      trb_restructure(nodes, &t, list + i, k, costs);\n",
  "    }\n",
  "    count = level[levels];\n",
  "  }\n",
  "}\n",
  "\n",
  "\n",
  "TRB_SHARED void trb_restructure_top(TRB_GLOBAL trbvh_node *nodes, trb_words words, trbvh_u32 rounds, trb_costs costs) {\n",
  "  for (; rounds && trb_count(nodes[0].count) > TRB_TOP; rounds--) {\n",
  "    words.plane[0][0] = 0;\n",
  "    trb_restructure_below(nodes, words, 0, 1, TRB_TOP + 1, costs);\n",
  "  }\n",
  "}\n",
  "#endif\n",
  "#line 1735 \"trbvh.h\"\n",
  "typedef struct trb_move {\n",
  "  trbvh_u32 node, target;\n",
  "  trbvh_u32 above;\n",
  "  float     gain;\n",
  "} trb_move;\n",
  "\n",
  "TRB_CORE trb_move trb_no_move(void) {\n",
  "  trb_move none;\n",
  "  none.node = none.target = none.above = 0;\n",
  "  none.gain = 0;\n",
  "  return none;\n",
  "}\n",
  "\n",
  "typedef struct trb_mover {\n",
  "  TRB_GLOBAL trbvh_node *nodes;\n",
  "  TRB_GLOBAL trbvh_node *refs;\n",
  "  TRB_GLOBAL trbvh_u32  *parents;\n",
  "  TRB_GLOBAL trbvh_u32  *scores;\n",
  "  TRB_GLOBAL trb_move   *moves;\n",
  "  TRB_GLOBAL trbvh_u32  *owners;\n",
  "  TRB_GLOBAL trbvh_u32  *list;\n",
  "  trb_costs  costs;\n",
  "} trb_mover;\n",
  "#define TRB_MOVES_MAX(refs) ((refs) / 4)\n",
  "\n",
  "\n",
  "TRB_CORE trb_mover trb_start_moves(TRB_GLOBAL trbvh_node *nodes, TRB_GLOBAL trbvh_node *refs, trb_words words, trb_costs costs) {\n",
  "  trb_mover m;\n",
  "  m.nodes = nodes;\n",
  "  m.refs = refs;\n",
  "  m.parents = words.plane[0];\n",
  "  m.moves = (TRB_GLOBAL trb_move *)words.plane[1];\n",
  "  m.owners = words.plane[2];\n",
  "  m.scores = m.list = words.plane[3];\n",
  "  m.costs = costs;\n",
  "  return m;\n",
  "}\n",
  "\n",
  "\n",
  "TRB_CORE int trb_is_free(trbvh_node n)  { return n.count == 0; }\n",
  "TRB_CORE int trb_is_inner(trbvh_node n) { return !trb_is_free(n) && !trb_is_single(n.count); }\n",
  "\n",
  "\n",
  "TRB_CORE void trb_put(const trb_mover *m, trbvh_u32 slot, trbvh_node node) {\n",
  "  m->nodes[slot] = node;\n",
  "  if (!trb_is_single(node.count)) m->parents[node.first / 2] = slot;\n",
  "  else if (m->refs) m->refs[node.first].count = slot;\n",
  "}\n",
  "\n",
  "\n",
  "TRB_CORE trbvh_node trb_join(trbvh_node a, trbvh_node b) {\n",
  "  a.min[0] = TRB_MIN(a.min[0], b.min[0]); a.max[0] = TRB_MAX(a.max[0], b.max[0]);\n",
  "  a.min[1] = TRB_MIN(a.min[1], b.min[1]); a.max[1] = TRB_MAX(a.max[1], b.max[1]);\n",
  "  a.min[2] = TRB_MIN(a.min[2], b.min[2]); a.max[2] = TRB_MAX(a.max[2], b.max[2]);\n",
  "  return a;\n",
  "}\n",
  "\n",
  "\n",
  "TRB_CORE void trb_remake(TRB_GLOBAL trbvh_node *nodes, trbvh_u32 node, trb_costs costs) {\n",
  "  const trbvh_u32 pair = nodes[node].first;\n",
  "  nodes[node] = trb_parent(nodes[pair], nodes[pair + 1], pair, costs);\n",
  "}\n",
  "\n",
  "\n",
  "TRB_CORE void trb_touched_pairs(const trb_mover *m, trb_move move, trbvh_u32 pairs[3]) {\n",
  "  pairs[0] = move.node / 2;\n",
  "  pairs[1] = m->parents[move.node / 2] / 2;\n",
  "  pairs[2] = move.target / 2;\n",
  "}\n",
  "\n",
  "\n",
  "TRB_CORE int trb_owns(const trb_mover *m, trbvh_u32 i) {\n",
  "  trbvh_u32 pairs[3];\n",
  "  trb_touched_pairs(m, m->moves[i], pairs);\n",
  "  return m->owners[pairs[0]] == i && m->owners[pairs[1]] == i && m->owners[pairs[2]] == i;\n",
  "}\n",
  "\n",
  "TRB_CORE int trb_precedes(const trb_mover *m, trbvh_u32 i, trbvh_u32 k) {\n",
  "  return m->moves[i].gain > m->moves[k].gain || (m->moves[i].gain == m->moves[k].gain && i < k);\n",
  "}\n",
  "\n",
  "\n",
  "\n",
  "#define TRB_STAYS 0x80000000u\n",
  "\n",
  "TRB_CORE int trb_follows(const trb_mover *m, trbvh_u32 i) {\n",
  "  trbvh_u32 node = m->moves[i].target;\n",
  "  for (; node != m->moves[i].above && node; node = m->parents[node / 2]) {\n",
  "    const trbvh_u32 other = m->owners[node / 2];\n",
  "    if (other != TRBVH_NONE && other != i && m->moves[other].gain > 0 && (m->moves[other].node & ~TRB_STAYS) == node &&\n",
  "        trb_precedes(m, other, i)) return 1;\n",
  "  }\n",
  "  return 0;\n",
  "}\n",
  "\n",
  "#if !defined(TRBVH_OPENCL_C) || defined(TRB_CPU)\n",
  "TRB_CORE void trb_claim(const trb_mover *m, trbvh_u32 i) {\n",
  "  trbvh_u32 pairs[3], k;\n",
  "  trb_touched_pairs(m, m->moves[i], pairs);\n",
  "  for (k = 0; k < 3; k++) {\n",
  "    const trbvh_u32 owner = m->owners[pairs[k]];\n",
  "    if (owner == TRBVH_NONE || trb_precedes(m, i, owner)) m->owners[pairs[k]] = i;\n",
  "  }\n",
  "}\n",
  "\n",
  "\n",
  "TRB_SHARED void trb_choose_moves(const trb_mover *m, trbvh_u32 count) {\n",
  "  trbvh_u32 pairs[3], i, k;\n",
  "  for (i = 0; i < count; i++)\n",
  "    if (m->moves[i].gain > 0) trb_claim(m, i);\n",
  "  for (i = 0; i < count; i++)\n",
  "    if (m->moves[i].gain > 0 && !trb_owns(m, i)) m->moves[i].gain = -m->moves[i].gain;\n",
  "  for (i = 0; i < count; i++)\n",
  "    if (m->moves[i].gain > 0 && trb_follows(m, i)) m->moves[i].node |= TRB_STAYS;\n",
  "  for (i = 0; i < count; i++) {\n",
  "    TRB_GLOBAL trb_move *move = &m->moves[i];\n",
  "    if (move->gain == 0) continue;\n",
  "    if (move->node & TRB_STAYS) {\n",
  "      move->node &= ~TRB_STAYS;\n",
  "      move->gain = -move->gain;\n",
  "    }\n",
  "    trb_touched_pairs(m, *move, pairs);\n",
  "    for (k = 0; k < 3; k++) m->owners[pairs[k]] = TRBVH_NONE;\n",
  "  }\n",
  "}\n",
  "\n",
  "\n",
  "TRB_CORE trbvh_u32 trb_list_above(const trb_mover *m, trbvh_u32 slot, trbvh_u32 count) {\n",
  "  while (slot) {\n",
  "    TRB_GLOBAL trbvh_u32 *listed;\n",
  "    slot = m->parents[slot / 2];\n",
  "    listed = &m->owners[m->nodes[slot].first / 2];\n",
  "    if (*listed != TRBVH_NONE) break;\n",
  "    *listed = 0;\n",
  "    m->list[count++] = slot;\n",
  "  }\n",
  "  return count;\n",
  "}\n",
  "\n",
  "TRB_CORE void trb_remake_listed(const trb_mover *m, trbvh_u32 begin, trbvh_u32 end) {\n",
  "  for (; begin < end; begin++) {\n",
  "    const trbvh_u32 node = m->list[begin];\n",
  "    m->owners[m->nodes[node].first / 2] = TRBVH_NONE;\n",
  "    trb_remake(m->nodes, node, m->costs);\n",
  "  }\n",
  "}\n",
  "\n",
  "\n",
  "TRB_SHARED void trb_remake_moved(const trb_mover *m, trbvh_u32 count) {\n",
  "  trbvh_u32 listed = 0, i;\n",
  "  for (i = 0; i < count; i++) {\n",
  "    TRB_GLOBAL trb_move *move = &m->moves[i];\n",
  "    const trb_move moved = *move;\n",
  "    if (!(moved.gain > 0)) continue;\n",
  "    move->target = listed;\n",
  "    move->above = listed = trb_list_above(m, moved.target, listed);\n",
  "    listed = trb_list_above(m, moved.above, listed);\n",
  "  }\n",
  "  while (i--) {\n",
  "    TRB_GLOBAL trb_move *move = &m->moves[i];\n",
  "    if (!(move->gain > 0)) continue;\n",
  "    trb_remake_listed(m, move->above, listed);\n",
  "    trb_remake_listed(m, move->target, move->above);\n",
  "    listed = move->target;\n",
  "    move->gain = 0;\n",
  "  }\n",
  "}\n",
  "#endif\n",
  "#line 1911 \"trbvh.h\"\n",
  "#define TRB_MOVE_BATCHES 4u\n",
  "#define TRB_SCORES       2048u\n",
  "#define TRB_SCORE_SHIFT  20\n",
  "#define TRB_SEARCH_STEPS 64u\n",
  "#define TRB_SEARCHES     256u\n",
  "#define TRB_MOVES        1024u\n",
  "\n",
  "TRB_CORE trbvh_u32 trb_score(float above, float area, float both) {\n",
  "  const float tame = TRB_MIN(both, 1 / TRB_TINY), ratio = above * trb_reciprocal(TRB_MAX(tame, TRB_TINY));\n",
  "  const float score = (above - area) * ratio;\n",
  "  return score > 0 ? trb_bits(TRB_MIN(score, FLT_MAX)) >> TRB_SCORE_SHIFT : 0;\n",
  "}\n",
  "\n",
  "\n",
  "\n",
  "TRB_CORE trbvh_u32 trb_score_pair(const trb_mover *m, trbvh_u32 pair) {\n",
  "  const trbvh_node left = m->nodes[2 * pair], right = m->nodes[2 * pair + 1];\n",
  "  const trbvh_node parent = trb_parent(left, right, 0, m->costs);\n",
  "  trbvh_u32 scores = 0;\n",
  "  if (!trb_is_free(left) && !trb_is_leaf(parent.count)) {\n",
  "    const float above = trb_area(parent), l = trb_area(left), r = trb_area(right);\n",
  "    scores = trb_score(above, l, l + r) << 16 | trb_score(above, r, l + r);\n",
  "  }\n",
  "  if (trb_is_inner(left)) m->parents[left.first / 2] = 2 * pair;\n",
  "  if (trb_is_inner(right)) m->parents[right.first / 2] = 2 * pair + 1;\n",
  "  m->scores[pair] = scores;\n",
  "  return scores;\n",
  "}\n",
  "\n",
  "\n",
  "TRB_CORE trbvh_u32 trb_lowest_score(const TRB_GLOBAL trbvh_u32 *histogram, trbvh_u32 wanted) {\n",
  "  trbvh_u32 lowest = TRB_SCORES, found = 0;\n",
  "  while (lowest > 1 && found < wanted) found += histogram[--lowest];\n",
  "  return lowest;\n",
  "}\n",
  "\n",
  "\n",
  "TRB_CORE float trb_least_gain(trbvh_u32 lowest) { return trb_float(lowest << TRB_SCORE_SHIFT) * 0.0625f; }\n",
  "#line 1954 \"trbvh.h\"\n",
  "TRB_SHARED trb_move trb_find_place(const trb_mover *m, trbvh_u32 node, float least) {\n",
  "  const trbvh_node n = m->nodes[node];\n",
  "  const float area = trb_area(n);\n",
  "  const trbvh_u32 parent = m->parents[node / 2];\n",
  "  trbvh_u32 pivot = parent, other = node ^ 1u, steps = TRB_SEARCH_STEPS, waiting, side, k;\n",
  "  struct { float rest; trbvh_u32 pair; } stack[TRB_SEARCH_STEPS + 1];\n",
  "  trbvh_node without = m->nodes[other];\n",
  "  float saved = trb_area(m->nodes[parent]);\n",
  "  int shrinks = 1;\n",
  "  trb_move best;\n",
  "  best.node = node;\n",
  "  best.target = best.above = 0;\n",
  "  best.gain = least;\n",
  "  while (shrinks || saved - area > best.gain) {\n",
  "    const trbvh_node there = m->nodes[other];\n",
  "    const float joint = trb_area(trb_join(there, n)), rest = saved - joint + trb_area(there);\n",
  "    waiting = 0;\n",
  "    if (pivot != parent && saved - joint > best.gain) {\n",
  "      best.gain = saved - joint;\n",
  "      best.target = other;\n",
  "      best.above = pivot;\n",
  "    }\n",
  "    if (!trb_is_leaf(there.count) && rest - area > best.gain) {\n",
  "      stack[waiting].rest = rest;\n",
  "      stack[waiting++].pair = there.first;\n",
  "    }\n",
  "    while (waiting && steps) {\n",
  "      const float above = stack[--waiting].rest;\n",
  "      const trbvh_u32 pair = stack[waiting].pair;\n",
  "      float below[2];\n",
  "      if (!(above - area > best.gain)) continue;\n",
  "      steps--;\n",
  "      for (side = 0; side < 2; side++) {\n",
  "        const trbvh_node child = m->nodes[pair + side];\n",
  "        const float both = trb_area(trb_join(child, n));\n",
  "        below[side] = trb_is_leaf(child.count) ? 0 : above - both + trb_area(child);\n",
  "        if (above - both > best.gain) {\n",
  "          best.gain = above - both;\n",
  "          best.target = pair + side;\n",
  "          best.above = pivot;\n",
  "        }\n",
  "      }\n",
  "      for (side = below[1] > below[0], k = 0; k < 2; k++) {\n",
  "        side ^= 1u;\n",
  "        if (below[side] - area > best.gain) {\n",
  "          stack[waiting].rest = below[side];\n",
  "          stack[waiting++].pair = m->nodes[pair + side].first;\n",
  "        }\n",
  "      }\n",
  "    }\n",
  "    if (pivot != parent) {\n",
  "      const float whole = trb_area(m->nodes[pivot]);\n",
  "      if (shrinks) {\n",
  "        without = trb_join(without, there);\n",
  "        saved += whole - trb_area(without);\n",
  "        shrinks = trb_area(without) < whole;\n",
  "      }\n",
  "      if (pivot && saved - whole > best.gain) {\n",
  "        best.gain = saved - whole;\n",
  "        best.target = pivot;\n",
  "        best.above = m->parents[pivot / 2];\n",
  "      }\n",
  "    }\n",
  "    if (pivot == 0) break;\n",
  "    other = pivot ^ 1u;\n",
  "    pivot = m->parents[pivot / 2];\n",
  "  }\n",
  "  if (!best.target) best.gain = 0;\n",
  "  return best;\n",
  "}\n",
  "\n",
  "\n",
  "TRB_CORE void trb_search(const trb_mover *m, trbvh_u32 i, trbvh_u32 batch, float least) {\n",
  "  TRB_GLOBAL trb_move *move = &m->moves[i];\n",
  "  const trbvh_u32 node = move->node;\n",
  "  const int due = i % TRB_MOVE_BATCHES == batch || move->gain < 0;\n",
  "  move->gain = 0;\n",
  "  if (due && m->parents[node / 2]) *move = trb_find_place(m, node, least);\n",
  "}\n",
  "\n",
  "\n",
  "TRB_CORE void trb_reinsert(const trb_mover *m, TRB_GLOBAL trb_move *move) {\n",
  "  const trbvh_u32 slot = move->target, pair = move->node & ~1u, parent = m->parents[pair / 2];\n",
  "  const trbvh_node node = m->nodes[move->node], sibling = m->nodes[move->node ^ 1u], target = m->nodes[slot];\n",
  "  trb_put(m, parent, sibling);\n",
  "  trb_put(m, pair, node);\n",
  "  trb_put(m, pair + 1, target);\n",
  "  trb_put(m, slot, trb_parent(node, target, pair, m->costs));\n",
  "  move->target = pair;\n",
  "  move->above = parent;\n",
  "}\n",
  "\n",
  "\n",
  "TRB_SHARED trbvh_u32 trb_count_candidates(const trb_mover *m, trbvh_u32 first, trbvh_u32 end, trbvh_u32 lowest) {\n",
  "  trbvh_u32 count = 0;\n",
  "  for (; first < end; first++) {\n",
  "    count += m->scores[first] >> 16 >= lowest;\n",
  "    count += (m->scores[first] & 0xFFFFu) >= lowest;\n",
  "  }\n",
  "  return count;\n",
  "}\n",
  "\n",
  "TRB_SHARED void trb_list_candidates(const trb_mover *m, trbvh_u32 first, trbvh_u32 end, trbvh_u32 lowest, trbvh_u32 at,\n",
  "                                    trbvh_u32 most) {\n",
  "  trbvh_u32 side;\n",
  "  for (; first < end; first++)\n",
  "    for (side = 0; side < 2; side++)\n",
  "      if ((m->scores[first] >> (side ? 0 : 16) & 0xFFFFu) >= lowest && at < most) {\n",
  "        m->moves[at].node = 2 * first + side;\n",
  "        m->moves[at++].gain = 0;\n",
  "      }\n",
  "}\n",
  "#line 2075 \"trbvh.h\"\n",
  "#define TRB_UNSPLIT_BIAS 2.0f\n",
  "\n",
  "\n",
  "typedef struct trb_climb {\n",
  "  trbvh_u32  slot, below;\n",
  "  trbvh_u32  height;\n",
  "  trbvh_node without;\n",
  "  float      saved, grown;\n",
  "} trb_climb;\n",
  "\n",
  "TRB_CORE trb_climb trb_start_climb(trbvh_u32 slot, trbvh_node leaf) {\n",
  "  trb_climb c;\n",
  "  c.slot = c.below = slot;\n",
  "  c.height = 0;\n",
  "  c.without = leaf;\n",
  "  c.saved = c.grown = 0;\n",
  "  return c;\n",
  "}\n",
  "\n",
  "\n",
  "TRB_CORE void trb_climb_on(const trb_mover *m, trb_climb *c, trbvh_node leaf) {\n",
  "  const trbvh_node n = m->nodes[c->slot];\n",
  "  const float area = trb_area(n), weight = c->height == 0 ? m->costs.ratio : 1;\n",
  "  c->grown += weight * (trb_area(trb_join(n, leaf)) - area);\n",
  "  if (c->height == 0) {\n",
  "    c->saved = weight * area;\n",
  "  } else if (c->height == 1) {\n",
  "    c->saved += area;\n",
  "    c->without = m->nodes[c->below ^ 1u];\n",
  "  } else {\n",
  "    c->without = trb_join(c->without, m->nodes[c->below ^ 1u]);\n",
  "    c->saved += area - trb_area(c->without);\n",
  "  }\n",
  "  c->height++;\n",
  "  c->below = c->slot;\n",
  "  c->slot = m->parents[c->slot / 2];\n",
  "}\n",
  "\n",
  "\n",
  "TRB_SHARED trb_move trb_find_merge(const trb_mover *m, trbvh_u32 left, trbvh_u32 right) {\n",
  "  const trbvh_u32 left_slot = m->refs[left].count, right_slot = m->refs[right].count;\n",
  "  const trbvh_node left_leaf = m->nodes[left_slot], right_leaf = m->nodes[right_slot];\n",
  "  trb_climb l = trb_start_climb(left_slot, left_leaf), r = trb_start_climb(right_slot, right_leaf);\n",
  "  float keep_left, keep_right;\n",
  "  trb_move merge;\n",
  "  while (l.slot != r.slot) {\n",
  "    if (trb_count(m->nodes[l.slot].count) <= trb_count(m->nodes[r.slot].count)) trb_climb_on(m, &l, right_leaf);\n",
  "    else trb_climb_on(m, &r, left_leaf);\n",
  "  }\n",
  "  if (l.height == 1) l.saved += trb_area(m->nodes[l.slot]);\n",
  "  if (r.height == 1) r.saved += trb_area(m->nodes[r.slot]);\n",
  "  keep_left = TRB_UNSPLIT_BIAS * r.saved - l.grown;\n",
  "  keep_right = TRB_UNSPLIT_BIAS * l.saved - r.grown;\n",
  "  merge.node = keep_left >= keep_right ? right_slot : left_slot;\n",
  "  merge.target = keep_left >= keep_right ? left_slot : right_slot;\n",
  "  merge.above = merge.target;\n",
  "  merge.gain = TRB_MAX(keep_left, keep_right);\n",
  "  merge.gain = TRB_MAX(merge.gain, 0.0f);\n",
  "  return merge;\n",
  "}\n",
  "\n",
  "\n",
  "TRB_CORE void trb_find_ref(const trb_mover *m, trbvh_u32 slot) {\n",
  "  const trbvh_node n = m->nodes[slot];\n",
  "  if (slot == 1 || trb_is_free(n)) return;\n",
  "  if (trb_is_single(n.count)) m->refs[n.first].count = slot;\n",
  "  else m->parents[n.first / 2] = slot;\n",
  "}\n",
  "\n",
  "\n",
  "TRB_CORE trb_move trb_search_merge(const trb_mover *m, trbvh_u32 i, trbvh_u32 slots) {\n",
  "  const trbvh_u32 prim = m->refs[i].first;\n",
  "  trbvh_u32 next = i + 1;\n",
  "  if (prim == TRBVH_NONE || m->refs[i].count == TRBVH_NONE) return trb_no_move();\n",
  "  while (next < slots && m->refs[next].first == prim && m->refs[next].count == TRBVH_NONE) next++;\n",
  "  return next < slots && m->refs[next].first == prim ? trb_find_merge(m, i, next) : trb_no_move();\n",
  "}\n",
  "\n",
  "\n",
  "\n",
  "TRB_CORE void trb_merge_refs(const trb_mover *m, TRB_GLOBAL trb_move *move) {\n",
  "  const trbvh_u32 pair = move->node & ~1u, parent = m->parents[pair / 2];\n",
  "  const trbvh_node gone = m->nodes[move->node];\n",
  "  trbvh_node grown = trb_join(m->nodes[move->target], gone);\n",
  "  grown = trb_reference(grown, m->costs);\n",
  "  m->nodes[move->target] = grown;\n",
  "  trb_put(m, parent, m->nodes[move->node ^ 1u]);\n",
  "  m->refs[gone.first].count = TRBVH_NONE;\n",
  "  m->nodes[pair].count = m->nodes[pair + 1].count = 0;\n",
  "  if (move->target == (move->node ^ 1u)) move->target = parent;\n",
  "  move->above = parent;\n",
  "}\n",
  "\n",
  "\n",
  "TRB_CORE void trb_make_move(const trb_mover *m, trbvh_u32 i, trbvh_u32 merges) {\n",
  "  TRB_GLOBAL trb_move *move = &m->moves[i];\n",
  "  if (!(move->gain > 0)) return;\n",
  "  if (merges) trb_merge_refs(m, move);\n",
  "  else trb_reinsert(m, move);\n",
  "}\n",
  "#line 2181 \"trbvh.h\"\n",
  "#define TRB_SPLITS_PAY 0.98\n",
  "\n",
  "\n",
  "TRB_CORE float trb_cost_unit(trbvh_node root, trb_costs costs) {\n",
  "  return trb_unit(trb_area(root) * TRB_MAX(1.0f, 0.5f * costs.ratio * TRB_MAX_LEAF), 31);\n",
  "}\n",
  "\n",
  "TRB_CORE trbvh_u32 trb_round_cost(float cost) { return (trbvh_u32)TRB_MIN(cost, 2147483520.0f); }\n",
  "\n",
  "TRB_CORE trbvh_u32 trb_leaf_cost(trbvh_node n, float unit, trb_costs costs) {\n",
  "  return trb_is_leaf(n.count) ? trb_round_cost(unit * trb_area(n) * (0.5f * costs.ratio * (float)trb_count(n.count))) : 0;\n",
  "}\n",
  "\n",
  "\n",
  "TRB_CORE trb_u64 trb_pair_cost(const TRB_GLOBAL trbvh_node *nodes, trbvh_u32 pair, float unit, trb_costs costs) {\n",
  "  const trbvh_node left = nodes[2 * pair], right = nodes[2 * pair + 1];\n",
  "  const trbvh_node parent = trb_parent(left, right, 0, costs);\n",
  "  if (trb_is_free(left) || trb_is_leaf(parent.count)) return 0;\n",
  "  return (trb_u64)trb_round_cost(unit * trb_area(parent)) + trb_leaf_cost(left, unit, costs) + trb_leaf_cost(right, unit, costs);\n",
  "}\n",
  "\n",
  "\n",
  "\n",
  "typedef struct trb_held { trbvh_u32 first, count; } trb_held;\n",
  "#line 2219 \"trbvh.h\"\n",
  "typedef struct trb_collapser {\n",
  "  TRB_GLOBAL trbvh_node *nodes;\n",
  "  trb_words words;\n",
  "  trb_costs costs;\n",
  "  float     cost_node, cost_prim;\n",
  "  const TRB_GLOBAL trbvh_node *refs;\n",
  "  const TRB_GLOBAL trb_u64 *keys;\n",
  "  trb_key_form form;\n",
  "  trbvh_u32    ref_count;\n",
  "  const TRB_GLOBAL trb_held *held;\n",
  "  TRB_GLOBAL trbvh_node *out;\n",
  "  TRB_GLOBAL trbvh_u32  *prims;\n",
  "} trb_collapser;\n",
  "\n",
  "\n",
  "\n",
  "TRB_SHARED void trb_balance(const trb_collapser *c, trbvh_u32 node, trbvh_u32 first_ref) {\n",
  "  TRB_GLOBAL trbvh_u32 *at = c->words.plane[1] + first_ref, *pair = c->words.plane[2] + first_ref;\n",
  "  TRB_GLOBAL trbvh_u32 *root = c->words.plane[3] + first_ref, *stack = root;\n",
  "  trbvh_u32 slot[TRBVH_MAX_DEPTH], first[TRBVH_MAX_DEPTH], count[TRBVH_MAX_DEPTH];\n",
  "  trbvh_u32 refs = 0, pairs = 0, waiting = 0, i, side;\n",
  "  stack[waiting++] = node;\n",
  "  while (waiting) {\n",
  "    trbvh_u32 next = stack[--waiting], below = c->nodes[next].first;\n",
  "    if (trb_is_single(c->nodes[next].count)) {\n",
  "      c->nodes[next].count = refs;\n",
  "      at[refs++] = next;\n",
  "    } else {\n",
  "      c->nodes[next].count = TRBVH_NONE;\n",
  "      pair[pairs++] = below;\n",
  "      stack[waiting++] = below + 1;\n",
  "      stack[waiting++] = below;\n",
  "    }\n",
  "  }\n",
  "  TRBVH_ASSERT(pairs + 1 == refs);\n",
  "  slot[0] = node;\n",
  "  first[0] = 0;\n",
  "  count[0] = refs;\n",
  "  for (i = 0, waiting = 1; waiting; i++) {\n",
  "    trbvh_u32 begin = first[--waiting], all = count[waiting];\n",
  "    root[i] = slot[waiting];\n",
  "    for (side = 0; side < 2; side++) {\n",
  "      trbvh_u32 left = all / 2, part = side ? all - left : left, ref = begin + (side ? left : 0), to = pair[i] + side;\n",
  "      if (part == 1) {\n",
  "        trbvh_node there = c->nodes[to];\n",
  "        c->nodes[to] = trb_reference(c->nodes[at[ref]], c->costs);\n",
  "        if (to != at[ref]) {\n",
  "          c->nodes[at[ref]] = there;\n",
  "          if (there.count != TRBVH_NONE) at[there.count] = at[ref];\n",
  "        }\n",
  "      } else {\n",
  "        slot[waiting] = to;\n",
  "        first[waiting] = ref;\n",
  "        count[waiting++] = part;\n",
  "      }\n",
  "    }\n",
  "  }\n",
  "  while (i--) c->nodes[root[i]] = trb_parent(c->nodes[pair[i]], c->nodes[pair[i] + 1], pair[i], c->costs);\n",
  "}\n",
  "\n",
  "TRB_CORE int trb_too_deep(trbvh_u32 depth, trbvh_u32 word) {\n",
  "  trbvh_u32 count = trb_count(word);\n",
  "  return count > 1 && depth + trb_log2(count - 1) + 1 > TRBVH_MAX_DEPTH;\n",
  "}\n",
  "\n",
  "\n",
  "\n",
  "TRB_CORE trbvh_node trb_bounded_node(const trb_collapser *c, trbvh_u32 i, trbvh_u32 depth, trbvh_u32 first_ref) {\n",
  "  trbvh_node node = c->nodes[i];\n",
  "  if (depth >= TRBVH_MAX_DEPTH / 2 && !trb_is_leaf(node.count) &&\n",
  "      (trb_too_deep(depth + 1, c->nodes[node.first].count) || trb_too_deep(depth + 1, c->nodes[node.first + 1].count))) {\n",
  "    trb_balance(c, i, first_ref);\n",
  "    node = c->nodes[i];\n",
  "  }\n",
  "  return node;\n",
  "}\n",
  "\n",
  "\n",
  "TRB_CORE trbvh_u32 trb_leaf_prims(const trb_collapser *c, trbvh_node leaf, trbvh_u32 prims[TRB_MAX_LEAF]) {\n",
  "  trbvh_u32 stack[TRB_MAX_LEAF], waiting = 0, count = 0, i;\n",
  "  for (;;) {\n",
  "    if (!trb_is_single(leaf.count)) {\n",
  "      stack[waiting++] = leaf.first;\n",
  "      leaf = c->nodes[leaf.first + 1];\n",
  "      continue;\n",
  "    }\n",
  "    if (c->refs) leaf.first = c->refs[leaf.first].first;\n",
  "    for (i = 0; c->refs && i < count && prims[i] != leaf.first; i++) {}\n",
  "    if (!c->refs || i == count) prims[count++] = leaf.first;\n",
  "    if (waiting == 0) return count;\n",
  "    leaf = c->nodes[stack[--waiting]];\n",
  "  }\n",
  "}\n",
  "\n",
  "\n",
  "TRB_CORE TRB_REAL trb_sah_term(trbvh_node node, TRB_REAL weight) { return weight * trb_area(node); }\n",
  "TRB_CORE TRB_REAL trb_leaf_term(const trb_collapser *c, trbvh_node leaf, trbvh_u32 prims) {\n",
  "  return trb_sah_term(leaf, (TRB_REAL)c->cost_prim * (c->held ? c->held[leaf.first].count : prims));\n",
  "}\n",
  "\n",
  "\n",
  "TRB_CORE void trb_emit_inner(const trb_collapser *c, trbvh_node node, trbvh_u32 dst, trbvh_u32 pair) {\n",
  "  node.first = 2 * pair;\n",
  "  node.count = 0;\n",
  "  c->out[dst] = node;\n",
  "}\n",
  "\n",
  "\n",
  "\n",
  "TRB_CORE trbvh_node trb_unsettle(trbvh_node node, trbvh_u32 number, TRB_GLOBAL trb_held *held, trb_costs costs) {\n",
  "  trbvh_u32 k;\n",
  "  held->first = node.first;\n",
  "  held->count = node.count;\n",
  "  if (node.count == 0) return node;\n",
  "  for (k = 0; k < 3; k++) { node.min[k] = trb_no_sign(node.min[k]); node.max[k] = trb_no_sign(node.max[k]); }\n",
  "  node.first = number;\n",
  "  return trb_reference(node, costs);\n",
  "}\n",
  "\n",
  "\n",
  "TRB_CORE void trb_emit_old_leaf(const trb_collapser *c, trbvh_node leaf, trbvh_u32 number, trbvh_u32 dst) {\n",
  "  leaf.first = c->held[number].first;\n",
  "  leaf.count = c->held[number].count;\n",
  "  c->out[dst] = leaf;\n",
  "}\n",
  "\n",
  "\n",
  "\n",
  "typedef struct trb_task {\n",
  "  trbvh_u32 node, depth, first_ref;\n",
  "  trbvh_u32 end_pair;\n",
  "  trbvh_u32 leaves, prims, max_depth;\n",
  "  trbvh_u32 dst, pair, first_prim;\n",
  "  TRB_REAL  sah;\n",
  "} trb_task;\n",
  "#define TRB_TASKS_MAX(refs) (2 * TRBVH_MAX_DEPTH * ((refs) / TRB_BLOCK) + 1)\n",
  "\n",
  "\n",
  "typedef struct trb_group { trbvh_u32 first_task, tasks; } trb_group;\n",
  "#define TRB_GROUPS_MAX(refs) (4 * ((refs) / TRB_BLOCK) + 4)\n",
  "\n",
  "\n",
  "\n",
  "TRB_CORE trbvh_u32 trb_find_tasks(const trb_collapser *c, const TRB_GLOBAL trb_range *range, TRB_GLOBAL trb_task *tasks,\n",
  "                                  TRB_REAL *sah) {\n",
  "  trbvh_u32 stack[TRBVH_MAX_DEPTH + 1], depths[TRBVH_MAX_DEPTH + 1], waiting = 0, refs = 0, node = 0, depth = 0, count = 0;\n",
  "  trbvh_u32 next = 0;\n",
  "  *sah = 0;\n",
  "  for (;;) {\n",
  "    const trbvh_node n = trb_bounded_node(c, node, depth, refs);\n",
  "    const trbvh_u32 n_refs = trb_count(n.count);\n",
  "    const int leaf = trb_is_leaf(n.count);\n",
  "    if (range ? !leaf && n_refs > trb_count(range->open[next].node.count) : n_refs > TRB_BLOCK) {\n",
  "      *sah += trb_sah_term(n, c->cost_node);\n",
  "      stack[waiting] = n.first + 1;\n",
  "      depths[waiting++] = ++depth;\n",
  "      node = n.first;\n",
  "    } else {\n",
  "      TRB_GLOBAL trb_task *task = &tasks[count++];\n",
  "      trbvh_u32 passed = 0;\n",
  "      task->node = node;\n",
  "      task->depth = depth;\n",
  "      task->first_ref = refs;\n",
  "      if (range) {\n",
  "        task->prims = n_refs;\n",
  "        task->leaves = leaf ? 1 : range->open[next].end_pair - range->open[next].first_pair + 1;\n",
  "        task->end_pair = range->open[next].end_pair;\n",
  "      }\n",
  "      while (range && passed < n_refs) {\n",
  "        passed += trb_count(range->open[next].node.count);\n",
  "        if (++next == range->open_count) {\n",
  "          next = 0;\n",
  "          range++;\n",
  "        }\n",
  "      }\n",
  "      refs += n_refs;\n",
  "      if (waiting == 0) return count;\n",
  "      node = stack[--waiting];\n",
  "      depth = depths[waiting];\n",
  "    }\n",
  "  }\n",
  "}\n",
  "\n",
  "\n",
  "TRB_CORE trbvh_u32 trb_find_groups(const TRB_GLOBAL trb_task *tasks, trbvh_u32 count, TRB_GLOBAL trb_group *groups) {\n",
  "  trbvh_u32 groups_found = 0, first_ref = 0, i;\n",
  "  for (i = 0; i < count; i++) {\n",
  "    if (i == 0 || tasks[i].first_ref - first_ref >= TRB_BLOCK / 4) {\n",
  "      groups[groups_found].first_task = i;\n",
  "      groups[groups_found++].tasks = 0;\n",
  "      first_ref = tasks[i].first_ref;\n",
  "    }\n",
  "    groups[groups_found - 1].tasks++;\n",
  "  }\n",
  "  return groups_found;\n",
  "}\n",
  "\n",
  "#if !defined(TRBVH_OPENCL_C) || defined(TRB_CPU)\n",
  "\n",
  "TRB_SHARED void trb_restructure_group(const trb_collapser *c, const TRB_GLOBAL trb_task *tasks, trb_group group,\n",
  "                                      trbvh_u32 gamma, trbvh_u32 rounds) {\n",
  "  const trbvh_u32 first_ref = tasks[group.first_task].first_ref;\n",
  "  trbvh_u32 i, seeds;\n",
  "  for (; rounds && gamma <= TRB_BLOCK; rounds--, gamma *= 2) {\n",
  "    for (i = 0, seeds = 0; i < group.tasks; i++) {\n",
  "      trbvh_u32 node = tasks[group.first_task + i].node;\n",
  "      if (trb_count(c->nodes[node].count) >= gamma) c->words.plane[0][first_ref + seeds++] = node;\n",
  "    }\n",
  "    trb_restructure_below(c->nodes, c->words, first_ref, seeds, gamma, c->costs);\n",
  "  }\n",
  "}\n",
  "\n",
  "\n",
  "typedef struct trb_visit { trbvh_u32 node, depth; } trb_visit;\n",
  "\n",
  "\n",
  "\n",
  "TRB_CORE void trb_prefetch_pairs(const trb_collapser *c, trbvh_u32 ref, trbvh_u32 count) {\n",
  "  for (; count-- && ref > 2 * TRB_AHEAD; ref--) TRB_PREFETCH(&c->nodes[2 * (ref - 2 * TRB_AHEAD)]);\n",
  "}\n",
  "#line 2443 \"trbvh.h\"\n",
  "TRB_SHARED void trb_settle_task(const trb_collapser *c, TRB_GLOBAL trb_task *task) {\n",
  "  TRB_GLOBAL trbvh_u32 *order = c->words.plane[0] + task->first_ref, *prims = c->words.plane[1] + task->first_ref;\n",
  "  trbvh_u32 waiting = 0, pairs = 0, refs = task->first_ref, prim = 0, max_depth = 0, i;\n",
  "  trbvh_u32 leaf_prims[TRB_MAX_LEAF];\n",
  "  const trbvh_u32 last_ref = task->first_ref + trb_count(c->nodes[task->node].count);\n",
  "  TRB_REAL sah = 0;\n",
  "  trb_visit stack[TRBVH_MAX_DEPTH + 1], v;\n",
  "  v.node = task->node;\n",
  "  v.depth = task->depth;\n",
  "  for (;;) {\n",
  "    const trbvh_node node = trb_bounded_node(c, v.node, v.depth, refs);\n",
  "    TRB_GLOBAL trbvh_node *settled = &c->nodes[v.node];\n",
  "    if (trb_is_leaf(node.count)) {\n",
  "      const trbvh_u32 count = trb_leaf_prims(c, node, leaf_prims);\n",
  "      for (i = 0; i < count; i++) prims[prim + i] = leaf_prims[i];\n",
  "      trb_prefetch_pairs(c, last_ref - (refs - task->first_ref), trb_count(node.count));\n",
  "      settled->first = prim;\n",
  "      settled->count = count;\n",
  "      prim += count;\n",
  "      refs += trb_count(node.count);\n",
  "      sah += trb_leaf_term(c, node, count);\n",
  "      max_depth = TRB_MAX(v.depth, max_depth);\n",
  "      if (waiting == 0) break;\n",
  "      v = stack[--waiting];\n",
  "    } else {\n",
  "      settled->first = pairs;\n",
  "      settled->count = 0;\n",
  "      order[pairs++] = node.first;\n",
  "      sah += trb_sah_term(node, c->cost_node);\n",
  "      v.depth++;\n",
  "      v.node = node.first;\n",
  "      stack[waiting++] = v;\n",
  "      v.node++;\n",
  "    }\n",
  "  }\n",
  "  task->leaves = pairs + 1;\n",
  "  task->prims = prim;\n",
  "  task->max_depth = max_depth;\n",
  "  task->sah = sah;\n",
  "}\n",
  "\n",
  "TRB_SHARED void trb_settle_group(const trb_collapser *c, TRB_GLOBAL trb_task *tasks, trb_group group) {\n",
  "  trbvh_u32 i;\n",
  "  for (i = 0; i < group.tasks; i++) trb_settle_task(c, &tasks[group.first_task + i]);\n",
  "}\n",
  "\n",
  "\n",
  "TRB_SHARED void trb_emit_top(const trb_collapser *c, TRB_GLOBAL trb_task *tasks, trbvh_u32 count) {\n",
  "  trbvh_u32 stack[TRBVH_MAX_DEPTH + 1], dsts[TRBVH_MAX_DEPTH + 1], waiting = 0, pair = 1, prim = 0, node = 0, dst = 0;\n",
  "  for (;;) {\n",
  "    if (node != tasks[count - 1].node) {\n",
  "      const trbvh_node n = c->nodes[node];\n",
  "      trb_emit_inner(c, n, dst, pair);\n",
  "      stack[waiting] = n.first;\n",
  "      dsts[waiting++] = 2 * pair;\n",
  "      node = n.first + 1;\n",
  "      dst = 2 * pair++ + 1;\n",
  "    } else {\n",
  "      TRB_GLOBAL trb_task *task = &tasks[--count];\n",
  "      task->dst = dst;\n",
  "      task->pair = pair;\n",
  "      task->first_prim = prim;\n",
  "      pair += task->leaves - 1;\n",
  "      prim += task->prims;\n",
  "      if (waiting == 0) return;\n",
  "      node = stack[--waiting];\n",
  "      dst = dsts[waiting];\n",
  "    }\n",
  "  }\n",
  "}\n",
  "\n",
  "\n",
  "TRB_CORE void trb_emit_settled(const trb_collapser *c, const trb_task *task, trbvh_u32 src, trbvh_u32 dst) {\n",
  "  trbvh_node node = c->nodes[src];\n",
  "  if (c->held && node.count) {\n",
  "    trb_emit_old_leaf(c, node, c->words.plane[1][task->first_ref + node.first], dst);\n",
  "    return;\n",
  "  }\n",
  "  node.first = node.count ? task->first_prim + node.first : 2 * (task->pair + node.first);\n",
  "  c->out[dst] = node;\n",
  "}\n",
  "\n",
  "TRB_SHARED void trb_emit_task(const trb_collapser *c, trb_task task) {\n",
  "  const TRB_GLOBAL trbvh_u32 *order = c->words.plane[0] + task.first_ref, *prims = c->words.plane[1] + task.first_ref;\n",
  "  const trbvh_u32 pairs = task.leaves - 1;\n",
  "  trbvh_u32 i;\n",
  "  trb_emit_settled(c, &task, task.node, task.dst);\n",
  "  for (i = 0; i < pairs; i++) {\n",
  "    if (i + TRB_AHEAD < pairs) TRB_PREFETCH(&c->nodes[order[i + TRB_AHEAD]]);\n",
  "    trb_emit_settled(c, &task, order[i], 2 * (task.pair + i));\n",
  "    trb_emit_settled(c, &task, order[i] + 1, 2 * (task.pair + i) + 1);\n",
  "  }\n",
  "  for (i = 0; i < task.prims && !c->held; i++) c->prims[task.first_prim + i] = prims[i];\n",
  "}\n",
  "\n",
  "\n",
  "TRB_CORE trbvh_node trb_final_node(const trb_task *task, trbvh_node node) {\n",
  "  const int leaf = trb_is_leaf(node.count);\n",
  "  node.first = leaf ? node.first : 2 * (task->pair + task->end_pair - 1 - node.first / 2);\n",
  "  node.count = leaf ? trb_count(node.count) : 0;\n",
  "  return node;\n",
  "}\n",
  "\n",
  "TRB_SHARED void trb_emit_final_task(const trb_collapser *c, TRB_GLOBAL trb_task *task) {\n",
  "  TRB_GLOBAL trbvh_u32 *depths = c->words.plane[2];\n",
  "  const trb_task t = *task;\n",
  "  trbvh_u32 max_depth = t.depth, i, side;\n",
  "  const trbvh_node root = c->nodes[t.node];\n",
  "  TRB_REAL sah = trb_sah_term(root, t.leaves > 1 ? c->cost_node : c->cost_prim * (float)t.prims);\n",
  "  c->out[t.dst] = trb_final_node(&t, root);\n",
  "  if (t.leaves > 1) depths[t.end_pair - 1] = t.depth + 1;\n",
  "  for (i = 0; i < t.leaves - 1; i++) {\n",
  "    const trbvh_u32 pair = t.end_pair - 1 - i, depth = depths[pair];\n",
  "    max_depth = TRB_MAX(depth, max_depth);\n",
  "    for (side = 0; side < 2; side++) {\n",
  "      const trbvh_node node = c->nodes[2 * pair + side];\n",
  "      const int leaf = trb_is_leaf(node.count);\n",
  "      sah += trb_sah_term(node, leaf ? c->cost_prim * (float)trb_count(node.count) : c->cost_node);\n",
  "      depths[leaf ? pair : node.first / 2] = depth + 1;\n",
  "      c->out[2 * (t.pair + i) + side] = trb_final_node(&t, node);\n",
  "    }\n",
  "  }\n",
  "  task->sah = sah;\n",
  "  task->max_depth = max_depth;\n",
  "  for (i = t.first_prim; i < t.first_prim + t.prims; i++)\n",
  "    c->prims[i] = trb_key_ref(c->keys[c->ref_count - 1 - i], c->form);\n",
  "}\n",
  "#endif\n",
  "\n",
  "\n",
  "TRB_CORE void trb_make_triangle(const trb_mesh *mesh, trbvh_u32 form, trbvh_u32 prim, TRB_GLOBAL trbvh_triangle *out) {\n",
  "  const size_t corner = (size_t)prim * 3;\n",
  "  float a[3], b[3], c[3];\n",
  "  trbvh_u32 inexact = 0;\n",
  "  trb_load_position(a, trb_position(mesh, trb_vertex(mesh, form, corner)));\n",
  "  trb_load_position(b, trb_position(mesh, trb_vertex(mesh, form, corner + 1)));\n",
  "  trb_load_position(c, trb_position(mesh, trb_vertex(mesh, form, corner + 2)));\n",
  "  #define TRB_AXIS(k) { \\\n",
  "    float e1 = b[k] - a[k], e2 = c[k] - a[k]; \\\n",
  "    out->v0[k] = a[k]; \\\n",
  "    out->e1[k] = e1; \\\n",
  "    out->e2[k] = e2; \\\n",
  "    inexact |= (a[k] + e1 != b[k]) | (a[k] + e2 != c[k]); }\n",
  "  TRB_AXIS(0) TRB_AXIS(1) TRB_AXIS(2)\n",
  "  #undef TRB_AXIS\n",
  "  out->prim = prim;\n",
  "  out->reserved0 = inexact;\n",
  "  out->reserved1 = 0;\n",
  "}\n",
  "\n",
  "TRB_CORE void trb_make_form(const trb_mesh *mesh, trbvh_u32 form, const TRB_GLOBAL trbvh_u32 *prims, trbvh_u32 first,\n",
  "                            trbvh_u32 end, TRB_GLOBAL trbvh_triangle *out) {\n",
  "  trbvh_u32 i;\n",
  "  for (i = first; i < end; i++) {\n",
  "    if (i + 3 * TRB_AHEAD < end) {\n",
  "      trb_prefetch_indices(mesh, prims[i + 3 * TRB_AHEAD]);\n",
  "      trb_prefetch_corners(mesh, form, prims[i + TRB_AHEAD]);\n",
  "    }\n",
  "    trb_make_triangle(mesh, form, prims[i], &out[i]);\n",
  "  }\n",
  "}\n",
  "\n",
  "\n",
  "TRB_SHARED void trb_make_triangles(const trb_mesh *mesh, const TRB_GLOBAL trbvh_u32 *prims, trbvh_u32 first, trbvh_u32 end,\n",
  "                                   TRB_GLOBAL trbvh_triangle *out) {\n",
  "  switch (trb_mesh_form(mesh)) {\n",
  "    case 0: trb_make_form(mesh, 0, prims, first, end, out); break;\n",
  "    case 2: trb_make_form(mesh, 2, prims, first, end, out); break;\n",
  "    default: trb_make_form(mesh, 4, prims, first, end, out); break;\n",
  "  }\n",
  "}\n",
  "#line 2625 \"trbvh.h\"\n",
  "#define TRB_UNIT 5.9604645e-8f\n",
  "#define TRB_ABS(x) ((x) < 0 ? -(x) : (x))\n",
  "typedef struct trb_ray {\n",
  "  float    origin[3], inverse[3], tmin, tmax;\n",
  "  float    t_unit;\n",
  "  float    near_origin[3], far_origin[3];\n",
  "  TRB_REAL shear[3];\n",
  "  int      near_corner[3], far_corner[3], axis[3];\n",
  "} trb_ray;\n",
  "\n",
  "\n",
  "\n",
  "TRB_CORE int trb_prepare_ray(trb_ray *r, const trbvh_ray *ray, const TRB_GLOBAL float *scene) {\n",
  "  float x = trb_abs(ray->dir[0]), y = trb_abs(ray->dir[1]), z = trb_abs(ray->dir[2]), extent = 0, dir[3];\n",
  "  int k, finite = 1;\n",
  "  r->t_unit = x + y + z < 8.6736174e-19f ? 1.1529215e18f : 1.0f;\n",
  "  for (k = 0; k < 3; k++) {\n",
  "    float low = trb_abs(scene[k] - ray->origin[k]), high = trb_abs(scene[k + 4] - ray->origin[k]);\n",
  "    low = TRB_MAX(low, high);\n",
  "    extent = TRB_MAX(low, extent);\n",
  "    dir[k] = ray->dir[k] * r->t_unit;\n",
  "  }\n",
  "  for (k = 0; k < 3; k++) {\n",
  "    int negative = (int)(trb_bits(dir[k]) >> 31);\n",
  "    float pad = (negative ? -64.0f : 64.0f) * TRB_UNIT * extent;\n",
  "    finite &= trb_finite(ray->origin[k]) & trb_finite(dir[k]);\n",
  "    r->origin[k] = ray->origin[k];\n",
  "    r->near_origin[k] = ray->origin[k] + pad;\n",
  "    r->far_origin[k] = ray->origin[k] - pad;\n",
  "    r->inverse[k] = dir[k] != 0 ? 1.0f / dir[k] : trb_float(negative ? 0xFF800000u : 0x7F800000u);\n",
  "    r->near_corner[k] = negative ? k + 4 : k;\n",
  "    r->far_corner[k] = negative ? k : k + 4;\n",
  "  }\n",
  "  r->axis[2] = x >= y ? (x >= z ? 0 : 2) : (y >= z ? 1 : 2);\n",
  "  r->axis[0] = r->axis[2] == 2 ? 0 : r->axis[2] + 1;\n",
  "  r->axis[1] = r->axis[0] == 2 ? 0 : r->axis[0] + 1;\n",
  "  r->shear[2] = 1 / (TRB_REAL)dir[r->axis[2]];\n",
  "  r->shear[0] = dir[r->axis[0]] * r->shear[2];\n",
  "  r->shear[1] = dir[r->axis[1]] * r->shear[2];\n",
  "  r->tmin = TRB_MAX(ray->tmin, 0.0f) / r->t_unit;\n",
  "  r->tmax = (ray->tmax == 0 ? FLT_MAX : TRB_MIN(ray->tmax, FLT_MAX)) / r->t_unit;\n",
  "  return finite && x + y + z > 0 && ray->tmin == ray->tmin && ray->tmax == ray->tmax && r->tmin < r->tmax;\n",
  "}\n",
  "\n",
  "\n",
  "\n",
  "TRB_CORE float trb_hit_box(const TRB_GLOBAL float *box, const trb_ray *r, float limit) {\n",
  "  float near0 = (box[r->near_corner[0]] - r->near_origin[0]) * r->inverse[0];\n",
  "  float near1 = (box[r->near_corner[1]] - r->near_origin[1]) * r->inverse[1];\n",
  "  float near2 = (box[r->near_corner[2]] - r->near_origin[2]) * r->inverse[2];\n",
  "  float far0 = (box[r->far_corner[0]] - r->far_origin[0]) * r->inverse[0];\n",
  "  float far1 = (box[r->far_corner[1]] - r->far_origin[1]) * r->inverse[1];\n",
  "  float far2 = (box[r->far_corner[2]] - r->far_origin[2]) * r->inverse[2];\n",
  "  float enter = r->tmin, leave = limit;\n",
  "  enter = TRB_MAX(near0, enter); leave = TRB_MIN(far0, leave);\n",
  "  enter = TRB_MAX(near1, enter); leave = TRB_MIN(far1, leave);\n",
  "  enter = TRB_MAX(near2, enter); leave = TRB_MIN(far2, leave);\n",
  "  return enter <= leave ? enter : -1.0f;\n",
  "}\n",
  "\n",
  "\n",
  "typedef struct trb_corner { TRB_REAL x, y, z; } trb_corner;\n",
  "\n",
  "TRB_CORE trb_corner trb_see(float x, float y, float z, const trb_ray *r) {\n",
  "  trb_corner c;\n",
  "  c.z = (TRB_REAL)z - r->origin[r->axis[2]];\n",
  "  c.x = (TRB_REAL)x - r->origin[r->axis[0]] - r->shear[0] * c.z;\n",
  "  c.y = (TRB_REAL)y - r->origin[r->axis[1]] - r->shear[1] * c.z;\n",
  "  return c;\n",
  "}\n",
  "\n",
  "\n",
  "TRB_CORE TRB_REAL trb_along(trb_corner a, trb_corner b) {\n",
  "  TRB_REAL x = a.x - b.x, y = a.y - b.y, along = (a.x * x + a.y * y) / (x * x + y * y);\n",
  "  along = TRB_MIN(along, 1);\n",
  "  return TRB_MAX(along, 0);\n",
  "}\n",
  "#line 2709 \"trbvh.h\"\n",
  "TRB_CORE int trb_hit_triangle(const TRB_GLOBAL trbvh_triangle *t, const trb_ray *r, float tmax, trbvh_hit *hit) {\n",
  "  const int x = r->axis[0], y = r->axis[1], z = r->axis[2];\n",
  "  const trb_corner a = trb_see(t->v0[x], t->v0[y], t->v0[z], r);\n",
  "  const trb_corner b = trb_see(t->v0[x] + t->e1[x], t->v0[y] + t->e1[y], t->v0[z] + t->e1[z], r);\n",
  "  const trb_corner c = trb_see(t->v0[x] + t->e2[x], t->v0[y] + t->e2[y], t->v0[z] + t->e2[z], r);\n",
  "  TRB_REAL u = c.x * b.y - c.y * b.x, v = a.x * c.y - a.y * c.x, w = b.x * a.y - b.y * a.x, area = u + v + w;\n",
  "  float distance;\n",
  "  if (area < 0) { u = -u; v = -v; w = -w; area = -area; }\n",
  "  if (!(area > 0)) return 0;\n",
  "  if (!(u >= 0 && v >= 0 && w >= 0)) {\n",
  "    float off = 0;\n",
  "    int k;\n",
  "    if (!t->reserved0) return 0;\n",
  "    if (u <= v && u <= w) { u = 0; w = trb_along(b, c); v = 1 - w; }\n",
  "    else if (v <= w)      { v = 0; u = trb_along(c, a); w = 1 - u; }\n",
  "    else                  { w = 0; v = trb_along(a, b); u = 1 - v; }\n",
  "    area = 1;\n",
  "    for (k = 0; k < 3; k++) {\n",
  "      off = TRB_MAX(trb_abs(t->e1[k]), off);\n",
  "      off = TRB_MAX(trb_abs(t->e2[k]), off);\n",
  "    }\n",
  "    off *= 4 * TRB_UNIT;\n",
  "    if (!(TRB_ABS(u * a.x + v * b.x + w * c.x) <= off && TRB_ABS(u * a.y + v * b.y + w * c.y) <= off)) return 0;\n",
  "  } else {\n",
  "    TRB_REAL width = TRB_ABS(a.x) + TRB_ABS(b.x) + TRB_ABS(c.x), height = TRB_ABS(a.y) + TRB_ABS(b.y) + TRB_ABS(c.y);\n",
  "    if (!(area > TRB_NOISE * width * height)) return 0;\n",
  "  }\n",
  "  distance = (float)((u * a.z + v * b.z + w * c.z) / area * r->shear[2]);\n",
  "  if (!(distance > r->tmin && distance <= tmax)) return 0;\n",
  "  hit->t = distance;\n",
  "  hit->u = (float)(v / area);\n",
  "  hit->v = (float)(w / area);\n",
  "  return 1;\n",
  "}\n",
  "\n",
  "TRB_CORE void trb_miss(const trb_ray *r, trbvh_hit *hit) {\n",
  "  hit->t = r->tmax * r->t_unit;\n",
  "  hit->u = hit->v = 0;\n",
  "  hit->prim = hit->instance = TRBVH_NONE;\n",
  "}\n",
  "#line 2753 \"trbvh.h\"\n",
  "TRB_CORE int trb_trace(const TRB_GLOBAL trbvh_node *nodes, const TRB_GLOBAL trbvh_triangle *triangles,\n",
  "                       const trb_ray *r, int any, trbvh_hit *hit) {\n",
  "  trbvh_u32 stack_node[TRBVH_MAX_DEPTH], height = 0, node = 0, i;\n",
  "  float     stack_near[TRBVH_MAX_DEPTH];\n",
  "  trb_miss(r, hit);\n",
  "  if (trb_hit_box((const TRB_GLOBAL float *)&nodes[0], r, r->tmax) < 0) return 0;\n",
  "  hit->t = r->tmax;\n",
  "  for (;;) {\n",
  "    const trbvh_u32 first = nodes[node].first, count = nodes[node].count;\n",
  "    if (count == 0) {\n",
  "      float left = trb_hit_box((const TRB_GLOBAL float *)&nodes[first], r, hit->t);\n",
  "      float right = trb_hit_box((const TRB_GLOBAL float *)&nodes[first + 1], r, hit->t);\n",
  "      if (left >= 0 && right >= 0) {\n",
  "        trbvh_u32 swap = right < left;\n",
  "        stack_node[height] = first + 1 - swap;\n",
  "        stack_near[height++] = swap ? left : right;\n",
  "        node = first + swap;\n",
  "        continue;\n",
  "      }\n",
  "      if (left >= 0 || right >= 0) {\n",
  "        node = left >= 0 ? first : first + 1;\n",
  "        continue;\n",
  "      }\n",
  "    }\n",
  "    for (i = first; i < first + count; i++) {\n",
  "      trbvh_hit found;\n",
  "      if (!trb_hit_triangle(&triangles[i], r, hit->t, &found)) continue;\n",
  "      if (any) return 1;\n",
  "      if (found.t < hit->t || triangles[i].prim < hit->prim) {\n",
  "        hit->t = found.t;\n",
  "        hit->u = found.u;\n",
  "        hit->v = found.v;\n",
  "        hit->prim = triangles[i].prim;\n",
  "      }\n",
  "    }\n",
  "    do {\n",
  "      if (height == 0) {\n",
  "        hit->t *= r->t_unit;\n",
  "        return hit->prim != TRBVH_NONE;\n",
  "      }\n",
  "      node = stack_node[--height];\n",
  "    } while (stack_near[height] > hit->t);\n",
  "  }\n",
  "}\n",
  "\n",
  "\n",
  "#define TRB_GPU_GROUP   256u\n",
  "#define TRB_GPU_TILE    2048u\n",
  "#define TRB_GPU_CHUNK   1024u\n",
  "#define TRB_GPU_CHUNKS  16u\n",
  "#define TRB_GPU_LEVELS  1024u\n",
  "#define TRB_ROOTS_MAX   (1u << 20)\n",
  "#define TRB_CPU_RAYS    64u\n",
  "#define TRB_JOB_STEP    64u\n",
  "#define TRB_CANDIDATES  16u\n",
  "\n",
  "\n",
  "typedef struct trb_plan {\n",
  "  trb_u64      position_offset, position_stride, index_offset;\n",
  "  trb_u64      scale;\n",
  "  trb_u64      cost;\n",
  "  trb_costs    costs;\n",
  "  trb_key_form form;\n",
  "  float        cost_node, cost_prim;\n",
  "  trbvh_u32    prim_count, position_count, index_size, boxes, split_max, ref_max, optimizes;\n",
  "  float        reinsert_share;\n",
  "\n",
  "  trb_grid     grid;\n",
  "  float        priority_unit;\n",
  "  float        sah, root_area;\n",
  "  trbvh_u32    scale_low, slots, ref_count;\n",
  "  trbvh_u32    skipped, bad, bad_vertex;\n",
  "  trbvh_u32    lowest_score, moves;\n",
  "  trbvh_u32    too_deep;\n",
  "  trbvh_u32    groups, tasks, leaves, prims, max_depth;\n",
  "} trb_plan;\n",
  "\n",
  "\n",
  "typedef struct trb_partial {\n",
  "  trbvh_node bounds;\n",
  "  trbvh_u32  skipped, bad, bad_vertex;\n",
  "  float      priority;\n",
  "} trb_partial;\n",
  "\n",
  "\n",
  "\n",
  "typedef struct trb_wait { trbvh_u32 first, last; } trb_wait;\n",
  "\n",
  "\n",
  "typedef struct trb_level { trbvh_u32 first, count; } trb_level;\n",
  "\n",
  "\n",
  "\n",
  "typedef struct trb_place {\n",
  "  trbvh_u32 inner, prims;\n",
  "  float     sah;\n",
  "  trbvh_u32 pair, prim;\n",
  "} trb_place;\n",
  "#line 6 \"kernels/query.cl\"\n",
  "static inline __attribute__((unused)) int trbvh_intersect(const __global trbvh_node *nodes,\n",
  "                                                          const __global trbvh_triangle *triangles, trbvh_ray ray,\n",
  "                                                          trbvh_hit *hit) {\n",
  "  trb_ray r;\n",
  "  if (trb_prepare_ray(&r, &ray, (const __global float *)nodes)) return trb_trace(nodes, triangles, &r, 0, hit);\n",
  "  trb_miss(&r, hit);\n",
  "  return 0;\n",
  "}\n",
  "\n",
  "\n",
  "static inline __attribute__((unused)) int trbvh_occluded(const __global trbvh_node *nodes,\n",
  "                                                         const __global trbvh_triangle *triangles, trbvh_ray ray) {\n",
  "  trb_ray r;\n",
  "  trbvh_hit hit;\n",
  "  return trb_prepare_ray(&r, &ray, (const __global float *)nodes) && trb_trace(nodes, triangles, &r, 1, &hit);\n",
  "}\n",
  "#ifdef TRB_WITH_SHAPE\n",
  "#line 9 \"kernels/shape.cl\"\n",
  "#ifdef TRB_CPU\n",
  "  #define TRB_GROUP 1u\n",
  "  #define TRB_TILE  TRB_BLOCK\n",
  "  #define TRB_SYNC() ((void)0)\n",
  "#else\n",
  "  #define TRB_GROUP TRB_GPU_GROUP\n",
  "  #define TRB_TILE  TRB_GPU_TILE\n",
  "  #define TRB_SYNC() barrier(CLK_LOCAL_MEM_FENCE | CLK_GLOBAL_MEM_FENCE)\n",
  "#endif\n",
  "#define TRB_KERNEL    __kernel __attribute__((reqd_work_group_size(TRB_GROUP, 1, 1))) void\n",
  "#define TRB_GROUP_ID  ((uint)get_group_id(0))\n",
  "#define TRB_LOCAL_ID  ((uint)get_local_id(0))\n",
  "\n",
  "\n",
  "#ifdef TRB_CPU\n",
  "  #define TRB_FOR(i, n) for (i = TRB_GROUP_ID * TRB_BLOCK; i < (n) && i < (TRB_GROUP_ID + 1) * TRB_BLOCK; i++)\n",
  "#else\n",
  "  #define TRB_FOR(i, n) for (i = (uint)get_global_id(0); i < (n); i += (uint)get_global_size(0))\n",
  "#endif\n",
  "#ifdef TRB_CPU\n",
  "\n",
  "\n",
  "#define TRB_FOR_JOBS(i, n) \\\n",
  "  for (i = TRB_GROUP_ID / TRB_JOB_STEP; TRB_GROUP_ID % TRB_JOB_STEP == 0 && i < (n); \\\n",
  "       i += (uint)get_num_groups(0) / TRB_JOB_STEP)\n",
  "#endif\n",
  "\n",
  "\n",
  "static uint trb_scan(uint value, __local uint *space, uint *total) {\n",
  "#ifdef TRB_CPU\n",
  "  *total = value;\n",
  "  return 0;\n",
  "#else\n",
  "  const uint id = TRB_LOCAL_ID;\n",
  "  uint sum = value, step;\n",
  "  TRB_SYNC();\n",
  "  space[id] = value;\n",
  "  for (step = 1; step < TRB_GROUP; step *= 2) {\n",
  "    uint before;\n",
  "    TRB_SYNC();\n",
  "    before = id >= step ? space[id - step] : 0;\n",
  "    TRB_SYNC();\n",
  "    sum += before;\n",
  "    space[id] = sum;\n",
  "  }\n",
  "  TRB_SYNC();\n",
  "  *total = space[TRB_GROUP - 1];\n",
  "  return sum - value;\n",
  "#endif\n",
  "}\n",
  "\n",
  "\n",
  "static ulong trb_sum_group(ulong mine, __local ulong *space) {\n",
  "#ifndef TRB_CPU\n",
  "  uint half_size;\n",
  "  for (half_size = TRB_GROUP / 2; half_size; half_size /= 2) {\n",
  "    TRB_SYNC();\n",
  "    if (TRB_LOCAL_ID >= half_size && TRB_LOCAL_ID < 2 * half_size) space[TRB_LOCAL_ID - half_size] = mine;\n",
  "    TRB_SYNC();\n",
  "    if (TRB_LOCAL_ID < half_size) mine += space[TRB_LOCAL_ID];\n",
  "  }\n",
  "#endif\n",
  "  return mine;\n",
  "}\n",
  "\n",
  "\n",
  "static trb_mesh trb_plan_mesh(const __global trb_plan *plan, const __global char *positions, const __global char *indices) {\n",
  "  trb_mesh mesh;\n",
  "  mesh.positions = plan->boxes ? 0 : positions + plan->position_offset;\n",
  "  mesh.boxes = plan->boxes ? positions + plan->position_offset : 0;\n",
  "  mesh.indices = plan->index_size ? indices + plan->index_offset : 0;\n",
  "  mesh.position_stride = mesh.box_stride = plan->position_stride;\n",
  "  mesh.position_count = plan->position_count;\n",
  "  mesh.index_size = plan->index_size;\n",
  "  mesh.count = plan->prim_count;\n",
  "  return mesh;\n",
  "}\n",
  "\n",
  "\n",
  "static bool trb_has_gaps(const __global trb_plan *plan) { return plan->ref_count != plan->slots; }\n",
  "\n",
  "\n",
  "\n",
  "static trb_collapser trb_plan_collapser(const __global trb_plan *plan, __global trbvh_node *nodes,\n",
  "                                        const __global trbvh_node *refs, __global ulong *keys, __global ulong *sorted) {\n",
  "  trb_collapser c;\n",
  "  c.nodes = nodes;\n",
  "  c.words = trb_split_words(keys, sorted, plan->ref_max);\n",
  "  c.costs = plan->costs;\n",
  "  c.cost_node = plan->cost_node;\n",
  "  c.cost_prim = plan->cost_prim;\n",
  "  c.refs = plan->split_max ? refs : 0;\n",
  "  c.held = plan->optimizes ? (const __global trb_held *)refs : 0;\n",
  "  c.out = 0;\n",
  "  c.prims = 0;\n",
  "  return c;\n",
  "}\n",
  "\n",
  "\n",
  "static trb_collapser trb_plan_emitter(const __global trb_plan *plan, __global trbvh_node *nodes,\n",
  "                                      const __global trbvh_node *refs, __global ulong *keys, __global ulong *sorted,\n",
  "                                      __global trbvh_node *out, __global uint *prims) {\n",
  "  trb_collapser c = trb_plan_collapser(plan, nodes, refs, keys, sorted);\n",
  "  c.out = out;\n",
  "  c.prims = prims;\n",
  "  return c;\n",
  "}\n",
  "#line 122 \"kernels/shape.cl\"\n",
  "static uint trb_reserve(volatile __global uint *end, uint count, __local uint *space) {\n",
  "#ifdef TRB_CPU\n",
  "  return count ? atomic_add(end, count) : 0;\n",
  "#else\n",
  "  uint at;\n",
  "  TRB_SYNC();\n",
  "  if (TRB_LOCAL_ID == 0) space[0] = 0;\n",
  "  TRB_SYNC();\n",
  "  at = count ? atomic_add((volatile __local uint *)&space[0], count) : 0;\n",
  "  TRB_SYNC();\n",
  "  if (TRB_LOCAL_ID == 0) space[1] = atomic_add(end, space[0]);\n",
  "  TRB_SYNC();\n",
  "  return at + space[1];\n",
  "#endif\n",
  "}\n",
  "#endif\n",
  "#ifdef TRB_WITH_BOUNDS\n",
  "#line 4 \"kernels/bounds.cl\"\n",
  "static void trb_merge(trb_partial *into, trb_partial p) {\n",
  "  trb_include(&into->bounds, p.bounds.min, p.bounds.max);\n",
  "  into->skipped += p.skipped;\n",
  "  into->priority = TRB_MAX(p.priority, into->priority);\n",
  "  if (p.bad < into->bad) { into->bad = p.bad; into->bad_vertex = p.bad_vertex; }\n",
  "}\n",
  "\n",
  "static trb_partial trb_nothing(void) {\n",
  "  trb_partial p;\n",
  "  p.bounds = trb_no_box();\n",
  "  p.skipped = p.bad_vertex = 0;\n",
  "  p.bad = TRBVH_NONE;\n",
  "  p.priority = 0;\n",
  "  return p;\n",
  "}\n",
  "\n",
  "\n",
  "static trb_partial trb_merge_group(trb_partial mine, __local trb_partial *space) {\n",
  "#ifndef TRB_CPU\n",
  "  uint half_size;\n",
  "  for (half_size = TRB_GROUP / 2; half_size; half_size /= 2) {\n",
  "    TRB_SYNC();\n",
  "    if (TRB_LOCAL_ID >= half_size && TRB_LOCAL_ID < 2 * half_size) space[TRB_LOCAL_ID - half_size] = mine;\n",
  "    TRB_SYNC();\n",
  "    if (TRB_LOCAL_ID < half_size) trb_merge(&mine, space[TRB_LOCAL_ID]);\n",
  "  }\n",
  "#endif\n",
  "  return mine;\n",
  "}\n",
  "\n",
  "\n",
  "static trb_partial trb_merge_all(const __global trb_partial *partials, uint count, __local trb_partial *space) {\n",
  "  trb_partial sum = trb_nothing();\n",
  "  uint i;\n",
  "  for (i = TRB_LOCAL_ID; i < count; i += TRB_GROUP) trb_merge(&sum, partials[i]);\n",
  "  return trb_merge_group(sum, space);\n",
  "}\n",
  "\n",
  "\n",
  "TRB_KERNEL trb_k_read(__global trb_plan *plan, const __global char *positions, const __global char *indices,\n",
  "                      __global trbvh_node *refs, __global trb_partial *partials) {\n",
  "  __local trb_partial space[TRB_GROUP];\n",
  "  const trb_mesh mesh = trb_plan_mesh(plan, positions, indices);\n",
  "  trb_partial sum = trb_nothing();\n",
  "  uint i;\n",
  "  TRB_FOR(i, mesh.count) {\n",
  "    trbvh_node box;\n",
  "    float v[3][3];\n",
  "    uint vertex;\n",
  "    int valid = trb_prim_box(&mesh, i, &box, v, &vertex);\n",
  "    box.first = i;\n",
  "    if (valid > 0) {\n",
  "      trb_include(&sum.bounds, box.min, box.max);\n",
  "    } else {\n",
  "      box = trb_no_box();\n",
  "      box.first = TRBVH_NONE;\n",
  "      sum.skipped++;\n",
  "      if (valid < 0 && i < sum.bad) { sum.bad = i; sum.bad_vertex = vertex; }\n",
  "    }\n",
  "    refs[i] = box;\n",
  "  }\n",
  "  sum = trb_merge_group(sum, space);\n",
  "  if (TRB_LOCAL_ID == 0) partials[TRB_GROUP_ID] = sum;\n",
  "}\n",
  "\n",
  "\n",
  "TRB_KERNEL trb_k_grid(__global trb_plan *plan, const __global trb_partial *partials, uint count) {\n",
  "  __local trb_partial space[TRB_GROUP];\n",
  "  const trb_partial sum = trb_merge_all(partials, count, space);\n",
  "  if (TRB_LOCAL_ID != 0) return;\n",
  "  plan->grid = trb_make_grid(sum.bounds);\n",
  "  plan->skipped = sum.skipped;\n",
  "  plan->bad = sum.bad;\n",
  "  plan->bad_vertex = sum.bad_vertex;\n",
  "  plan->slots = plan->prim_count;\n",
  "  plan->ref_count = plan->prim_count - sum.skipped;\n",
  "}\n",
  "\n",
  "\n",
  "TRB_KERNEL trb_k_count_refs(const __global trb_plan *plan, const __global trbvh_node *refs, __global uint *counts) {\n",
  "  __local uint space[TRB_GROUP];\n",
  "  const uint first = TRB_GROUP_ID * TRB_TILE, end = min(plan->slots, first + TRB_TILE);\n",
  "  uint i, count = 0, total;\n",
  "  if (!trb_has_gaps(plan)) return;\n",
  "  for (i = first + TRB_LOCAL_ID; i < end; i += TRB_GROUP) count += refs[i].first != TRBVH_NONE;\n",
  "  trb_scan(count, space, &total);\n",
  "  if (TRB_LOCAL_ID == 0) counts[TRB_GROUP_ID] = total;\n",
  "}\n",
  "\n",
  "\n",
  "\n",
  "TRB_KERNEL trb_k_scan(__global uint *values, uint count) {\n",
  "  __local uint space[TRB_GROUP];\n",
  "  uint i, start = 0, total;\n",
  "  for (i = 0; i < count; i += TRB_GROUP) {\n",
  "    const uint mine = i + TRB_LOCAL_ID, value = mine < count ? values[mine] : 0;\n",
  "    const uint before = trb_scan(value, space, &total);\n",
  "    if (mine < count) values[mine] = start + before;\n",
  "    start += total;\n",
  "  }\n",
  "}\n",
  "#endif\n",
  "#ifdef TRB_WITH_SPLIT\n",
  "#line 4 \"kernels/split.cl\"\n",
  "TRB_KERNEL trb_k_priorities(const __global trb_plan *plan, const __global char *positions, const __global char *indices,\n",
  "                            const __global trbvh_node *refs, __global float *priorities,\n",
  "                            __global trb_partial *partials) {\n",
  "  __local trb_partial space[TRB_GROUP];\n",
  "  const trb_mesh mesh = trb_plan_mesh(plan, positions, indices);\n",
  "  const trb_grid grid = plan->grid;\n",
  "  trb_partial sum = trb_nothing();\n",
  "  uint i;\n",
  "  TRB_FOR(i, mesh.count) {\n",
  "    const trbvh_node box = refs[i];\n",
  "    float v[3][3], priority = 0;\n",
  "    uint vertex;\n",
  "    if (box.first != TRBVH_NONE && trb_load_triangle(&mesh, i, v, &vertex))\n",
  "      priority = trb_split_priority((const float (*)[3])v, box, grid);\n",
  "    priorities[i] = priority;\n",
  "    sum.priority = TRB_MAX(priority, sum.priority);\n",
  "  }\n",
  "  sum = trb_merge_group(sum, space);\n",
  "  if (TRB_LOCAL_ID == 0) partials[TRB_GROUP_ID] = sum;\n",
  "}\n",
  "\n",
  "\n",
  "TRB_KERNEL trb_k_priority_unit(__global trb_plan *plan, const __global trb_partial *partials, uint count) {\n",
  "  __local trb_partial space[TRB_GROUP];\n",
  "  const trb_partial sum = trb_merge_all(partials, count, space);\n",
  "  if (TRB_LOCAL_ID != 0) return;\n",
  "  plan->priority_unit = trb_priority_unit(sum.priority);\n",
  "  plan->scale_low = 0;\n",
  "}\n",
  "\n",
  "\n",
  "TRB_KERNEL trb_k_sum_splits(const __global trb_plan *plan, const __global float *priorities, __global ulong *sums, uint step) {\n",
  "  __local ulong space[TRB_GROUP];\n",
  "  const float unit = plan->priority_unit;\n",
  "  const uint low = plan->scale_low;\n",
  "  ulong scale[TRB_CANDIDATES], sum[TRB_CANDIDATES];\n",
  "  uint i, k;\n",
  "  for (k = 0; k < TRB_CANDIDATES; k++) {\n",
  "    scale[k] = trb_scale(min(low + k * step, TRB_SCALES - 1));\n",
  "    sum[k] = 0;\n",
  "  }\n",
  "  TRB_FOR(i, plan->prim_count) {\n",
  "    const float priority = priorities[i];\n",
  "    for (k = 0; k < TRB_CANDIDATES; k++) sum[k] += trb_splits(priority, unit, scale[k]);\n",
  "  }\n",
  "  for (k = 0; k < TRB_CANDIDATES; k++) {\n",
  "    ulong total = trb_sum_group(sum[k], space);\n",
  "    if (TRB_LOCAL_ID == 0) sums[TRB_GROUP_ID * TRB_CANDIDATES + k] = total;\n",
  "  }\n",
  "}\n",
  "\n",
  "\n",
  "TRB_KERNEL trb_k_choose_scale(__global trb_plan *plan, const __global ulong *sums, uint step, uint count) {\n",
  "  __local ulong space[TRB_GROUP];\n",
  "  uint i, k, low = plan->scale_low;\n",
  "  for (k = 1; k < TRB_CANDIDATES; k++) {\n",
  "    ulong sum = 0;\n",
  "    for (i = TRB_LOCAL_ID; i < count; i += TRB_GROUP) sum += sums[i * TRB_CANDIDATES + k];\n",
  "    sum = trb_sum_group(sum, space);\n",
  "    if (sum <= plan->split_max && plan->scale_low + k * step < TRB_SCALES) low = plan->scale_low + k * step;\n",
  "  }\n",
  "  TRB_SYNC();\n",
  "  if (TRB_LOCAL_ID != 0) return;\n",
  "  plan->scale_low = low;\n",
  "  plan->scale = trb_scale(low);\n",
  "}\n",
  "\n",
  "static uint trb_slots(const __global trb_plan *plan, const __global trbvh_node *refs, const __global float *priorities, uint i) {\n",
  "  return refs[i].first == TRBVH_NONE ? 0 : (uint)trb_splits(priorities[i], plan->priority_unit, plan->scale) + 1;\n",
  "}\n",
  "\n",
  "TRB_KERNEL trb_k_count_slots(const __global trb_plan *plan, const __global trbvh_node *refs, const __global float *priorities,\n",
  "                             __global uint *counts) {\n",
  "  __local uint space[TRB_GROUP];\n",
  "  const uint first = TRB_GROUP_ID * TRB_TILE, end = min(plan->prim_count, first + TRB_TILE);\n",
  "  uint i, count = 0, total;\n",
  "  for (i = first + TRB_LOCAL_ID; i < end; i += TRB_GROUP) count += trb_slots(plan, refs, priorities, i);\n",
  "  trb_scan(count, space, &total);\n",
  "  if (TRB_LOCAL_ID == 0) counts[TRB_GROUP_ID] = total;\n",
  "}\n",
  "\n",
  "\n",
  "TRB_KERNEL trb_k_split(const __global trb_plan *plan, const __global char *positions, const __global char *indices,\n",
  "                       const __global trbvh_node *refs, const __global float *priorities, const __global uint *starts,\n",
  "                       __global trbvh_node *out, __global uint *found) {\n",
  "  __local uint space[TRB_GROUP];\n",
  "  const trb_mesh mesh = trb_plan_mesh(plan, positions, indices);\n",
  "  const trb_grid grid = plan->grid;\n",
  "  const uint first = TRB_GROUP_ID * TRB_TILE, end = min(plan->prim_count, first + TRB_TILE);\n",
  "  uint i, k, start = starts[TRB_GROUP_ID], total, sum = 0;\n",
  "  for (i = first; i < end; i += TRB_GROUP) {\n",
  "    const uint mine = i + TRB_LOCAL_ID, slots = mine < end ? trb_slots(plan, refs, priorities, mine) : 0;\n",
  "    const uint at = start + trb_scan(slots, space, &total);\n",
  "    uint count = slots ? trb_split_reference(&mesh, grid, refs[mine], slots - 1, out + at) : 0;\n",
  "    for (k = count; k < slots; k++) out[at + k].first = TRBVH_NONE;\n",
  "    sum += count;\n",
  "    start += total;\n",
  "  }\n",
  "  trb_scan(sum, space, &total);\n",
  "  if (TRB_LOCAL_ID == 0) {\n",
  "    found[2 * TRB_GROUP_ID] = total;\n",
  "    found[2 * TRB_GROUP_ID + 1] = start;\n",
  "  }\n",
  "}\n",
  "\n",
  "\n",
  "TRB_KERNEL trb_k_sum_refs(__global trb_plan *plan, const __global uint *found, uint count) {\n",
  "  __local uint space[TRB_GROUP];\n",
  "  uint i, sum = 0, total;\n",
  "  for (i = TRB_LOCAL_ID; i < count; i += TRB_GROUP) sum += found[2 * i];\n",
  "  trb_scan(sum, space, &total);\n",
  "  if (TRB_LOCAL_ID != 0) return;\n",
  "  plan->slots = found[2 * count - 1];\n",
  "  plan->ref_count = total;\n",
  "}\n",
  "#endif\n",
  "#ifdef TRB_WITH_MORTON\n",
  "#line 5 \"kernels/morton.cl\"\n",
  "TRB_KERNEL trb_k_keys(const __global trb_plan *plan, const __global trbvh_node *refs, __global ulong *keys) {\n",
  "  const trb_grid grid = plan->grid;\n",
  "  const trb_key_form form = plan->form;\n",
  "  const uint count = trb_has_gaps(plan) ? 0 : plan->slots;\n",
  "  uint i;\n",
  "  TRB_FOR(i, count) keys[i] = trb_key(trb_box_code(refs[i], grid), i, form, 0);\n",
  "}\n",
  "\n",
  "\n",
  "TRB_KERNEL trb_k_gap_keys(const __global trb_plan *plan, const __global trbvh_node *refs, const __global uint *starts,\n",
  "                          __global ulong *keys) {\n",
  "  __local uint space[TRB_GROUP];\n",
  "  const trb_grid grid = plan->grid;\n",
  "  const trb_key_form form = plan->form;\n",
  "  const uint first = TRB_GROUP_ID * TRB_TILE, end = min(plan->slots, first + TRB_TILE);\n",
  "  uint i, start = starts[TRB_GROUP_ID], total;\n",
  "  if (!trb_has_gaps(plan)) return;\n",
  "  for (i = first; i < end; i += TRB_GROUP) {\n",
  "    const uint mine = i + TRB_LOCAL_ID;\n",
  "    const bool valid = mine < end && refs[mine].first != TRBVH_NONE;\n",
  "    const uint before = trb_scan(valid, space, &total);\n",
  "    if (valid) keys[start + before] = trb_key(trb_box_code(refs[mine], grid), mine, form, 0);\n",
  "    start += total;\n",
  "  }\n",
  "}\n",
  "\n",
  "\n",
  "TRB_KERNEL trb_k_high_keys(const __global trb_plan *plan, const __global trbvh_node *refs, __global ulong *keys) {\n",
  "  const trb_grid grid = plan->grid;\n",
  "  const trb_key_form form = plan->form;\n",
  "  const uint count = plan->ref_count;\n",
  "  uint i;\n",
  "  TRB_FOR(i, count) {\n",
  "    const uint ref = trb_key_ref(keys[i], form);\n",
  "    keys[i] = trb_key(trb_box_code(refs[ref], grid), ref, form, 1);\n",
  "  }\n",
  "}\n",
  "#endif\n",
  "#ifdef TRB_WITH_SORT\n",
  "#line 5 \"kernels/sort.cl\"\n",
  "#ifdef TRB_CPU\n",
  "\n",
  "TRB_KERNEL trb_k_count_digits(const __global trb_plan *plan, const __global ulong *keys, __global uint *histograms, uint shift) {\n",
  "  const uint first = TRB_GROUP_ID * TRB_SORT_BLOCK;\n",
  "  const uint count = first < plan->ref_count ? min(plan->ref_count - first, TRB_SORT_BLOCK) : 0;\n",
  "  trb_count_digits(keys + first, count, shift, TRB_DIGITS, histograms + (size_t)TRB_GROUP_ID * TRB_DIGITS);\n",
  "}\n",
  "\n",
  "TRB_KERNEL trb_k_place_digits(__global uint *histograms, uint blocks) { trb_place_digits(histograms, blocks, TRB_DIGITS); }\n",
  "\n",
  "TRB_KERNEL trb_k_scatter_keys(const __global trb_plan *plan, const __global ulong *keys, __global uint *histograms,\n",
  "                              __global ulong *sorted, uint shift) {\n",
  "  const uint first = TRB_GROUP_ID * TRB_SORT_BLOCK;\n",
  "  const uint count = first < plan->ref_count ? min(plan->ref_count - first, TRB_SORT_BLOCK) : 0;\n",
  "  trb_scatter_keys(keys + first, count, shift, TRB_DIGITS, histograms + (size_t)TRB_GROUP_ID * TRB_DIGITS, sorted);\n",
  "}\n",
  "#else\n",
  "\n",
  "\n",
  "\n",
  "#define TRB_ITEMS (TRB_TILE / TRB_GROUP)\n",
  "#define TRB_DIGIT(key, shift) ((uint)((key) >> (shift)) & 255u)\n",
  "\n",
  "TRB_KERNEL trb_k_count_digits(const __global trb_plan *plan, const __global ulong *keys, __global uint *histograms, uint shift) {\n",
  "  __local uint counts[256];\n",
  "  const uint first = TRB_GROUP_ID * TRB_TILE, end = min(plan->ref_count, first + TRB_TILE);\n",
  "  uint i;\n",
  "  counts[TRB_LOCAL_ID] = 0;\n",
  "  barrier(CLK_LOCAL_MEM_FENCE);\n",
  "  for (i = first + TRB_LOCAL_ID; i < end; i += TRB_GROUP) atomic_inc((volatile __local uint *)&counts[TRB_DIGIT(keys[i], shift)]);\n",
  "  barrier(CLK_LOCAL_MEM_FENCE);\n",
  "  histograms[TRB_LOCAL_ID * (uint)get_num_groups(0) + TRB_GROUP_ID] = counts[TRB_LOCAL_ID];\n",
  "}\n",
  "\n",
  "\n",
  "TRB_KERNEL trb_k_sum_tiles(const __global uint *values, __global uint *sums, uint count) {\n",
  "  __local uint space[TRB_GROUP];\n",
  "  const uint first = TRB_GROUP_ID * TRB_TILE, end = min(count, first + TRB_TILE);\n",
  "  uint i, sum = 0, total;\n",
  "  for (i = first + TRB_LOCAL_ID; i < end; i += TRB_GROUP) sum += values[i];\n",
  "  trb_scan(sum, space, &total);\n",
  "  if (TRB_LOCAL_ID == 0) sums[TRB_GROUP_ID] = total;\n",
  "}\n",
  "\n",
  "TRB_KERNEL trb_k_scan_tiles(__global uint *values, const __global uint *starts, uint count) {\n",
  "  __local uint space[TRB_GROUP];\n",
  "  const uint first = TRB_GROUP_ID * TRB_TILE, end = min(count, first + TRB_TILE);\n",
  "  uint i, start = starts[TRB_GROUP_ID], total;\n",
  "  for (i = first; i < end; i += TRB_GROUP) {\n",
  "    const uint mine = i + TRB_LOCAL_ID, value = mine < end ? values[mine] : 0;\n",
  "    const uint before = trb_scan(value, space, &total);\n",
  "    if (mine < end) values[mine] = start + before;\n",
  "    start += total;\n",
  "  }\n",
  "}\n",
  "\n",
  "TRB_KERNEL trb_k_scatter_keys(const __global trb_plan *plan, const __global ulong *keys, const __global uint *starts,\n",
  "                              __global ulong *sorted, uint shift) {\n",
  "  __local ulong tile[TRB_TILE];\n",
  "  __local ushort counts[16 * TRB_GROUP];\n",
  "  __local uint space[TRB_GROUP], digit_first[256];\n",
  "  const uint id = TRB_LOCAL_ID, first = TRB_GROUP_ID * TRB_TILE;\n",
  "  const uint count = first < plan->ref_count ? min(plan->ref_count - first, TRB_TILE) : 0;\n",
  "  ulong mine[TRB_ITEMS];\n",
  "  uint i, k, total, half_digit;\n",
  "  for (i = id; i < TRB_TILE; i += TRB_GROUP) tile[i] = i < count ? keys[first + i] : ~(ulong)0;\n",
  "  for (half_digit = 0; half_digit < 8; half_digit += 4) {\n",
  "    uint sum = 0;\n",
  "    barrier(CLK_LOCAL_MEM_FENCE);\n",
  "    for (k = 0; k < 16; k++) counts[k * TRB_GROUP + id] = 0;\n",
  "    for (k = 0; k < TRB_ITEMS; k++) {\n",
  "      mine[k] = tile[id * TRB_ITEMS + k];\n",
  "      counts[(TRB_DIGIT(mine[k], shift) >> half_digit & 15) * TRB_GROUP + id]++;\n",
  "    }\n",
  "    barrier(CLK_LOCAL_MEM_FENCE);\n",
  "    for (k = 0; k < 16; k++) sum += counts[id * 16 + k];\n",
  "    sum = trb_scan(sum, space, &total);\n",
  "    for (k = 0; k < 16; k++) {\n",
  "      uint n = counts[id * 16 + k];\n",
  "      counts[id * 16 + k] = (ushort)sum;\n",
  "      sum += n;\n",
  "    }\n",
  "    barrier(CLK_LOCAL_MEM_FENCE);\n",
  "    for (k = 0; k < TRB_ITEMS; k++) tile[counts[(TRB_DIGIT(mine[k], shift) >> half_digit & 15) * TRB_GROUP + id]++] = mine[k];\n",
  "  }\n",
  "  barrier(CLK_LOCAL_MEM_FENCE);\n",
  "  for (i = id; i < TRB_TILE; i += TRB_GROUP)\n",
  "    if (i == 0 || TRB_DIGIT(tile[i], shift) != TRB_DIGIT(tile[i - 1], shift)) digit_first[TRB_DIGIT(tile[i], shift)] = i;\n",
  "  barrier(CLK_LOCAL_MEM_FENCE);\n",
  "  for (i = id; i < count; i += TRB_GROUP) {\n",
  "    const uint digit = TRB_DIGIT(tile[i], shift);\n",
  "    sorted[starts[digit * (uint)get_num_groups(0) + TRB_GROUP_ID] + i - digit_first[digit]] = tile[i];\n",
  "  }\n",
  "}\n",
  "#endif\n",
  "#endif\n",
  "#ifdef TRB_WITH_HIERARCHY\n",
  "#line 4 \"kernels/hierarchy.cl\"\n",
  "static trb_curve trb_plan_curve(const __global trb_plan *plan, const __global ulong *keys, const __global trbvh_node *refs) {\n",
  "  trb_curve curve;\n",
  "  curve.keys = keys;\n",
  "  curve.refs = refs;\n",
  "  curve.grid = plan->grid;\n",
  "  curve.form = plan->form;\n",
  "  curve.count = plan->ref_count;\n",
  "  return curve;\n",
  "}\n",
  "\n",
  "#ifdef TRB_CPU\n",
  "TRB_KERNEL trb_k_build_blocks(const __global trb_plan *plan, const __global ulong *keys, const __global trbvh_node *refs,\n",
  "                              __global trbvh_node *nodes, __global trb_range *ranges) {\n",
  "  const trb_curve curve = trb_plan_curve(plan, keys, refs);\n",
  "  const uint blocks = curve.count ? (curve.count - 1) / TRB_BLOCK + 1 : 0;\n",
  "  uint i;\n",
  "  TRB_FOR_JOBS(i, blocks)\n",
  "    trb_build_block(&curve, i * TRB_BLOCK, min(curve.count, (i + 1) * TRB_BLOCK), plan->costs, 0, nodes, &ranges[i]);\n",
  "}\n",
  "\n",
  "TRB_KERNEL trb_k_build_top(const __global trb_plan *plan, __global trbvh_node *nodes, const __global trb_range *ranges) {\n",
  "  const uint count = plan->ref_count;\n",
  "  if (count) trb_build_top(nodes, ranges, (count - 1) / TRB_BLOCK + 1, plan->costs, 0);\n",
  "}\n",
  "#else\n",
  "#line 39 \"kernels/hierarchy.cl\"\n",
  "static void trb_hang(const trb_curve *curve, __global trbvh_node *nodes, __global trb_wait *waits, trbvh_node node,\n",
  "                     uint first, uint last) {\n",
  "  const ulong left = trb_split_after(curve, first - 1), right = trb_split_after(curve, last);\n",
  "  if (first == 0 && last == curve->count - 1) {\n",
  "    nodes[0] = node;\n",
  "  } else if (first > 0 && left <= right) {\n",
  "    nodes[2 * first + 1] = node;\n",
  "    waits[first - 1].last = last + 1;\n",
  "  } else {\n",
  "    nodes[2 * last + 2] = node;\n",
  "    waits[last].first = first + 1;\n",
  "  }\n",
  "}\n",
  "\n",
  "static void trb_make_split(const trb_curve *curve, __global trbvh_node *nodes, __global trb_wait *waits, uint split,\n",
  "                           trb_costs costs) {\n",
  "  const uint pair = split + 1;\n",
  "  const trbvh_node node = trb_parent(nodes[2 * pair], nodes[2 * pair + 1], 2 * pair, costs);\n",
  "  trb_hang(curve, nodes, waits, node, waits[split].first - 1, waits[split].last - 1);\n",
  "}\n",
  "\n",
  "static bool trb_is_ready(const __global trb_wait *waits, uint split) {\n",
  "  return waits[split].first != 0 && waits[split].last != 0;\n",
  "}\n",
  "\n",
  "\n",
  "TRB_KERNEL trb_k_build_chunks(const __global trb_plan *plan, const __global ulong *keys, const __global trbvh_node *refs,\n",
  "                              __global trbvh_node *nodes, __global trb_wait *waits, __global uint *waiting,\n",
  "                              __global uint *counts) {\n",
  "  __local uint space[TRB_GROUP], ready_count;\n",
  "  const trb_curve curve = trb_plan_curve(plan, keys, refs);\n",
  "  const trb_costs costs = plan->costs;\n",
  "  const uint id = TRB_LOCAL_ID, first = TRB_GROUP_ID * TRB_GPU_CHUNK, end = min(curve.count, first + TRB_GPU_CHUNK);\n",
  "  uint i, k, done = 0, kept = 0, total;\n",
  "  for (i = first + id; i < end; i += TRB_GROUP) {\n",
  "    const uint number = trb_key_ref(keys[i], curve.form);\n",
  "    trbvh_node ref = refs[number];\n",
  "    ref.first = number;\n",
  "    trb_hang(&curve, nodes, waits, trb_reference(ref, costs), i, i);\n",
  "  }\n",
  "  for (;;) {\n",
  "    uint ready = 0;\n",
  "    TRB_SYNC();\n",
  "    if (id == 0) ready_count = 0;\n",
  "    TRB_SYNC();\n",
  "    for (i = first + id, k = 1; i + 1 < end; i += TRB_GROUP, k *= 2)\n",
  "      if (!(done & k) && trb_is_ready(waits, i)) ready |= k;\n",
  "    if (ready) atomic_inc((volatile __local uint *)&ready_count);\n",
  "    TRB_SYNC();\n",
  "    if (ready_count == 0) break;\n",
  "    for (i = first + id, k = 1; i + 1 < end; i += TRB_GROUP, k *= 2)\n",
  "      if (ready & k) trb_make_split(&curve, nodes, waits, i, costs);\n",
  "    done |= ready;\n",
  "  }\n",
  "  for (i = first + id, k = 1; i < end; i += TRB_GROUP, k *= 2) kept += !(done & k);\n",
  "  kept = trb_scan(kept, space, &total);\n",
  "  for (i = first + id, k = 1; i < end; i += TRB_GROUP, k *= 2)\n",
  "    if (!(done & k)) waiting[first + kept++] = i;\n",
  "  if (id == 0) counts[TRB_GROUP_ID] = total;\n",
  "}\n",
  "\n",
  "\n",
  "TRB_KERNEL trb_k_join_chunks(const __global trb_plan *plan, const __global ulong *keys, const __global trbvh_node *refs,\n",
  "                             __global trbvh_node *nodes, __global trb_wait *waits, const __global uint *waiting,\n",
  "                             const __global uint *counts, __global uint *still_waiting, __global uint *still_counts,\n",
  "                             uint size) {\n",
  "  __local uint space[TRB_GROUP], ready_count;\n",
  "  const trb_curve curve = trb_plan_curve(plan, keys, refs);\n",
  "  const trb_costs costs = plan->costs;\n",
  "  const uint id = TRB_LOCAL_ID, chunk = TRB_GROUP_ID * TRB_GPU_CHUNKS, chunks = curve.count ? (curve.count - 1) / size + 1 : 0;\n",
  "  const ulong reach = (ulong)(chunk + TRB_GPU_CHUNKS) * size;\n",
  "  const uint first = chunk * size, end = reach < curve.count ? (uint)reach : curve.count;\n",
  "  __global uint *list = still_waiting + first;\n",
  "  uint i, k, count = 0, kept = 0, total;\n",
  "  for (k = chunk; k < chunk + TRB_GPU_CHUNKS && k < chunks; k++) {\n",
  "    for (i = id; i < counts[k]; i += TRB_GROUP) list[count + i] = waiting[(size_t)k * size + i];\n",
  "    count += counts[k];\n",
  "  }\n",
  "\n",
  "  for (;;) {\n",
  "    uint ready = 0;\n",
  "    TRB_SYNC();\n",
  "    if (id == 0) ready_count = 0;\n",
  "    TRB_SYNC();\n",
  "    for (i = id; i < count; i += TRB_GROUP)\n",
  "      if (list[i] < end - 1 && trb_is_ready(waits, list[i])) {\n",
  "        list[i] |= 0x80000000u;\n",
  "        ready = 1;\n",
  "      }\n",
  "    if (ready) atomic_inc((volatile __local uint *)&ready_count);\n",
  "    TRB_SYNC();\n",
  "    if (ready_count == 0) break;\n",
  "    for (i = id; i < count; i += TRB_GROUP)\n",
  "      if (list[i] >= 0x80000000u && list[i] != TRBVH_NONE) {\n",
  "        trb_make_split(&curve, nodes, waits, list[i] & 0x7FFFFFFFu, costs);\n",
  "        list[i] = TRBVH_NONE;\n",
  "      }\n",
  "  }\n",
  "  for (i = 0; i < count; i += TRB_GROUP) {\n",
  "    const uint split = i + id < count ? list[i + id] : TRBVH_NONE;\n",
  "    const uint before = trb_scan(split != TRBVH_NONE, space, &total);\n",
  "    TRB_SYNC();\n",
  "    if (split != TRBVH_NONE) list[kept + before] = split;\n",
  "    kept += total;\n",
  "  }\n",
  "  if (id == 0) still_counts[TRB_GROUP_ID] = kept;\n",
  "}\n",
  "#endif\n",
  "#endif\n",
  "#ifdef TRB_WITH_TREELETS\n",
  "#line 5 \"kernels/treelets.cl\"\n",
  "#ifdef TRB_CPU\n",
  "TRB_KERNEL trb_k_restructure_top(const __global trb_plan *plan, __global trbvh_node *nodes, __global ulong *keys,\n",
  "                                 __global ulong *sorted, uint rounds) {\n",
  "  if (plan->ref_count) trb_restructure_top(nodes, trb_split_words(keys, sorted, plan->ref_max), rounds, plan->costs);\n",
  "}\n",
  "\n",
  "\n",
  "TRB_KERNEL trb_k_restructure_groups(const __global trb_plan *plan, __global trbvh_node *nodes,\n",
  "                                    const __global trbvh_node *refs, __global ulong *keys, __global ulong *sorted,\n",
  "                                    __global trb_task *tasks, const __global trb_group *groups, uint gamma, uint rounds,\n",
  "                                    uint last) {\n",
  "  const trb_collapser c = trb_plan_collapser(plan, nodes, refs, keys, sorted);\n",
  "  uint i;\n",
  "  TRB_FOR_JOBS(i, plan->groups) {\n",
  "    trb_restructure_group(&c, tasks, groups[i], gamma, rounds);\n",
  "    if (last) trb_settle_group(&c, tasks, groups[i]);\n",
  "  }\n",
  "}\n",
  "#else\n",
  "\n",
  "\n",
  "TRB_KERNEL trb_k_first_level(const __global trb_plan *plan, const __global trbvh_node *nodes, __global trb_level *levels,\n",
  "                             __global uint *list, uint gamma) {\n",
  "  uint i;\n",
  "  for (i = TRB_LOCAL_ID; i < TRB_GPU_LEVELS; i += TRB_GROUP) levels[i].first = levels[i].count = 0;\n",
  "  TRB_SYNC();\n",
  "  if (TRB_LOCAL_ID != 0 || plan->ref_count == 0 || plan->too_deep) return;\n",
  "  list[0] = 0;\n",
  "  levels[0].count = trb_count(nodes[0].count) >= gamma;\n",
  "}\n",
  "\n",
  "static void trb_list_level(const __global trbvh_node *nodes, __global trb_level *levels, __global uint *list, uint level,\n",
  "                           uint gamma, uint item, uint items, __local uint *space) {\n",
  "  const uint first = levels[level].first, count = levels[level].count, next = first + count;\n",
  "  uint i;\n",
  "  for (i = item; i - TRB_LOCAL_ID < count; i += items) {\n",
  "    uint found = 0, child[2] = {0, 0}, side, at;\n",
  "    if (i < count) {\n",
  "      const uint pair = nodes[list[first + i]].first;\n",
  "      for (side = 0; side < 2; side++)\n",
  "        if (trb_count(nodes[pair + side].count) >= gamma) child[found++] = pair + side;\n",
  "    }\n",
  "    at = next + trb_reserve(&levels[level + 1].count, found, space);\n",
  "    for (side = 0; side < found; side++) list[at + side] = child[side];\n",
  "  }\n",
  "  if (item == 0) levels[level + 1].first = next;\n",
  "}\n",
  "\n",
  "TRB_KERNEL trb_k_list_level(const __global trbvh_node *nodes, __global trb_level *levels, __global uint *list, uint gamma,\n",
  "                            uint level) {\n",
  "  __local uint space[2];\n",
  "  trb_list_level(nodes, levels, list, level, gamma, (uint)get_global_id(0), (uint)get_global_size(0), space);\n",
  "}\n",
  "\n",
  "\n",
  "TRB_KERNEL trb_k_list_levels(__global trb_plan *plan, const __global trbvh_node *nodes, __global trb_level *levels,\n",
  "                             __global uint *list, uint gamma, uint level) {\n",
  "  __local uint space[2];\n",
  "  for (; level + 1 < TRB_GPU_LEVELS && levels[level].count; level++) {\n",
  "    trb_list_level(nodes, levels, list, level, gamma, TRB_LOCAL_ID, TRB_GROUP, space);\n",
  "    TRB_SYNC();\n",
  "  }\n",
  "  if (TRB_LOCAL_ID == 0 && levels[TRB_GPU_LEVELS - 1].count) plan->too_deep = 1;\n",
  "}\n",
  "\n",
  "\n",
  "static void trb_restructure_lane(__global trbvh_node *nodes, __local trb_treelets *t, uint root, uint largest, trb_costs costs) {\n",
  "  const uint lane = TRB_LOCAL_ID;\n",
  "  float sums[TRB_SUBSETS];\n",
  "  uint i;\n",
  "  if (trb_count(nodes[root].count) > largest) return;\n",
  "  trb_start_treelet(nodes, t, lane, root);\n",
  "  for (i = 1; i < TRB_TREELET - 1; i++) trb_expand_largest(nodes, t, lane, i);\n",
  "  for (i = 0; i < TRB_TREELET; i++) trb_enter_leaf(nodes, t, lane, i);\n",
  "  trb_treelet_costs_1(t->leaves + lane, t->table + lane, sums, costs);\n",
  "  trb_finish_treelet(nodes, t, sums, lane, root, costs);\n",
  "}\n",
  "\n",
  "#define TRB_TREELET_KERNEL __kernel __attribute__((reqd_work_group_size(TRB_LANES, 1, 1))) void\n",
  "\n",
  "\n",
  "TRB_TREELET_KERNEL trb_k_restructure_level(const __global trb_plan *plan, __global trbvh_node *nodes,\n",
  "                                           const __global trb_level *levels, const __global uint *list,\n",
  "                                           __local trb_treelets *t, uint largest, uint level, uint begin) {\n",
  "  const uint i = begin + (uint)get_global_id(0);\n",
  "  if (i < levels[level].count) trb_restructure_lane(nodes, t, list[levels[level].first + i], largest, plan->costs);\n",
  "}\n",
  "\n",
  "\n",
  "TRB_TREELET_KERNEL trb_k_restructure_levels(const __global trb_plan *plan, __global trbvh_node *nodes,\n",
  "                                            const __global trb_level *levels, const __global uint *list,\n",
  "                                            __local trb_treelets *t, uint largest, uint level) {\n",
  "  uint lowest = level, i;\n",
  "  while (lowest + 1 < TRB_GPU_LEVELS && levels[lowest + 1].count) lowest++;\n",
  "  for (lowest++; lowest-- > level;) {\n",
  "    for (i = TRB_LOCAL_ID; i < levels[lowest].count; i += TRB_LANES)\n",
  "      trb_restructure_lane(nodes, t, list[levels[lowest].first + i], largest, plan->costs);\n",
  "    TRB_SYNC();\n",
  "  }\n",
  "}\n",
  "#endif\n",
  "#endif\n",
  "#ifdef TRB_WITH_MOVES\n",
  "#line 6 \"kernels/moves.cl\"\n",
  "static trb_mover trb_plan_mover(const __global trb_plan *plan, __global trbvh_node *nodes, __global trbvh_node *refs,\n",
  "                                __global ulong *keys, __global ulong *sorted) {\n",
  "  return trb_start_moves(nodes, plan->split_max ? refs : 0, trb_split_words(keys, sorted, plan->ref_max), plan->costs);\n",
  "}\n",
  "\n",
  "\n",
  "static uint trb_move_count(const __global trb_plan *plan) { return plan->too_deep ? 0 : plan->moves; }\n",
  "\n",
  "\n",
  "\n",
  "TRB_KERNEL trb_k_score(const __global trb_plan *plan, __global trbvh_node *nodes, __global ulong *keys,\n",
  "                       __global ulong *sorted, __global uint *histograms) {\n",
  "  const trb_mover m = trb_plan_mover(plan, nodes, 0, keys, sorted);\n",
  "  const uint count = plan->ref_count;\n",
  "  uint i;\n",
  "#ifdef TRB_CPU\n",
  "  __global uint *histogram = histograms + (size_t)TRB_GROUP_ID * TRB_SCORES;\n",
  "  for (i = 0; i < TRB_SCORES; i++) histogram[i] = 0;\n",
  "  TRB_FOR(i, count) {\n",
  "    uint scores;\n",
  "    if (i == 0) continue;\n",
  "    scores = trb_score_pair(&m, i);\n",
  "    histogram[scores >> 16]++;\n",
  "    histogram[scores & 0xFFFFu]++;\n",
  "  }\n",
  "#else\n",
  "  __local uint histogram[TRB_SCORES];\n",
  "  for (i = TRB_LOCAL_ID; i < TRB_SCORES; i += TRB_GROUP) histogram[i] = 0;\n",
  "  TRB_SYNC();\n",
  "  TRB_FOR(i, count) {\n",
  "    uint scores;\n",
  "    if (i == 0) continue;\n",
  "    scores = trb_score_pair(&m, i);\n",
  "    if (scores >> 16) atomic_inc((volatile __local uint *)&histogram[scores >> 16]);\n",
  "    if (scores & 0xFFFFu) atomic_inc((volatile __local uint *)&histogram[scores & 0xFFFFu]);\n",
  "  }\n",
  "  TRB_SYNC();\n",
  "  for (i = TRB_LOCAL_ID; i < TRB_SCORES; i += TRB_GROUP)\n",
  "    if (histogram[i]) atomic_add((volatile __global uint *)&histograms[i], histogram[i]);\n",
  "#endif\n",
  "  if (get_global_id(0) == 0 && count) m.parents[0] = m.parents[nodes[0].first / 2] = 0;\n",
  "}\n",
  "\n",
  "\n",
  "TRB_KERNEL trb_k_choose_score(__global trb_plan *plan, __global uint *histograms) {\n",
  "  const uint wanted = (uint)(plan->reinsert_share * (float)plan->ref_count);\n",
  "#ifdef TRB_CPU\n",
  "  const uint blocks = plan->ref_count ? (plan->ref_count - 1) / TRB_BLOCK + 1 : 0;\n",
  "  uint block, i;\n",
  "  for (block = 1; block < blocks; block++)\n",
  "    for (i = 0; i < TRB_SCORES; i++) histograms[i] += histograms[(size_t)block * TRB_SCORES + i];\n",
  "#endif\n",
  "  if (TRB_LOCAL_ID == 0) plan->lowest_score = trb_lowest_score(histograms, wanted);\n",
  "}\n",
  "\n",
  "\n",
  "TRB_KERNEL trb_k_count_candidates(const __global trb_plan *plan, __global trbvh_node *nodes, __global ulong *keys,\n",
  "                                  __global ulong *sorted, __global uint *counts) {\n",
  "  __local uint space[TRB_GROUP];\n",
  "  const trb_mover m = trb_plan_mover(plan, nodes, 0, keys, sorted);\n",
  "  const uint first = TRB_GROUP_ID * TRB_TILE, end = min(plan->ref_count, first + TRB_TILE), lowest = plan->lowest_score;\n",
  "  uint i, count = 0, total;\n",
  "  for (i = first + TRB_LOCAL_ID; i < end; i += TRB_GROUP)\n",
  "    if (i) count += trb_count_candidates(&m, i, i + 1, lowest);\n",
  "  trb_scan(count, space, &total);\n",
  "  if (TRB_LOCAL_ID == 0) counts[TRB_GROUP_ID] = total;\n",
  "}\n",
  "\n",
  "\n",
  "TRB_KERNEL trb_k_list_candidates(__global trb_plan *plan, __global trbvh_node *nodes, __global ulong *keys,\n",
  "                                 __global ulong *sorted, const __global uint *starts) {\n",
  "  __local uint space[TRB_GROUP];\n",
  "  const trb_mover m = trb_plan_mover(plan, nodes, 0, keys, sorted);\n",
  "  const uint first = TRB_GROUP_ID * TRB_TILE, end = min(plan->ref_count, first + TRB_TILE), lowest = plan->lowest_score;\n",
  "  const uint most = TRB_MOVES_MAX(plan->ref_count);\n",
  "  uint i, start = starts[TRB_GROUP_ID], total;\n",
  "  for (i = first; i < end; i += TRB_GROUP) {\n",
  "    const uint pair = i + TRB_LOCAL_ID;\n",
  "    const uint count = pair && pair < end ? trb_count_candidates(&m, pair, pair + 1, lowest) : 0;\n",
  "    const uint at = start + trb_scan(count, space, &total);\n",
  "    if (count) trb_list_candidates(&m, pair, pair + 1, lowest, at, most);\n",
  "    start += total;\n",
  "  }\n",
  "  if (TRB_LOCAL_ID == 0 && TRB_GROUP_ID == (uint)get_num_groups(0) - 1) plan->moves = min(start, most);\n",
  "}\n",
  "\n",
  "\n",
  "\n",
  "TRB_KERNEL trb_k_sum_costs(const __global trb_plan *plan, const __global trbvh_node *nodes, __global ulong *sums) {\n",
  "  __local ulong space[TRB_GROUP];\n",
  "  const trb_costs costs = plan->costs;\n",
  "  const float unit = plan->ref_count ? trb_cost_unit(nodes[0], costs) : 0;\n",
  "  const uint count = plan->ref_count;\n",
  "  ulong sum = 0;\n",
  "  uint i;\n",
  "  TRB_FOR(i, count)\n",
  "    if (i) sum += trb_pair_cost(nodes, i, unit, costs);\n",
  "  sum = trb_sum_group(sum, space);\n",
  "  if (TRB_LOCAL_ID == 0) sums[TRB_GROUP_ID] = sum;\n",
  "}\n",
  "\n",
  "\n",
  "TRB_KERNEL trb_k_add_costs(__global trb_plan *plan, const __global ulong *sums, uint count) {\n",
  "  __local ulong space[TRB_GROUP];\n",
  "  ulong sum = 0;\n",
  "  uint i;\n",
  "  for (i = TRB_LOCAL_ID; i < count; i += TRB_GROUP) sum += sums[i];\n",
  "  sum = trb_sum_group(sum, space);\n",
  "  if (TRB_LOCAL_ID == 0) plan->cost = sum;\n",
  "}\n",
  "\n",
  "\n",
  "TRB_KERNEL trb_k_search(const __global trb_plan *plan, __global trbvh_node *nodes, __global ulong *keys,\n",
  "                        __global ulong *sorted, uint batch) {\n",
  "  const trb_mover m = trb_plan_mover(plan, nodes, 0, keys, sorted);\n",
  "  const uint count = trb_move_count(plan);\n",
  "  const float least = trb_least_gain(plan->lowest_score);\n",
  "#ifdef TRB_CPU\n",
  "  uint job, i;\n",
  "  TRB_FOR_JOBS(job, (count + TRB_SEARCHES - 1) / TRB_SEARCHES) {\n",
  "    const uint end = min(count, (job + 1) * TRB_SEARCHES);\n",
  "    for (i = job * TRB_SEARCHES; i < end; i++) {\n",
  "      trb_search(&m, i, batch, least);\n",
  "    }\n",
  "  }\n",
  "#else\n",
  "  uint four, i;\n",
  "  TRB_FOR(four, (count + TRB_MOVE_BATCHES - 1) / TRB_MOVE_BATCHES)\n",
  "    for (i = four * TRB_MOVE_BATCHES; i < count && i < (four + 1) * TRB_MOVE_BATCHES; i++) trb_search(&m, i, batch, least);\n",
  "#endif\n",
  "}\n",
  "\n",
  "\n",
  "TRB_KERNEL trb_k_forget_refs(__global trb_plan *plan, __global trbvh_node *refs) {\n",
  "  const uint slots = plan->slots;\n",
  "  uint i;\n",
  "  TRB_FOR(i, slots) refs[i].count = TRBVH_NONE;\n",
  "  if (get_global_id(0) == 0) plan->moves = TRB_MOVES_MAX(slots);\n",
  "}\n",
  "\n",
  "TRB_KERNEL trb_k_find_refs(const __global trb_plan *plan, __global trbvh_node *nodes, __global trbvh_node *refs,\n",
  "                           __global ulong *keys, __global ulong *sorted) {\n",
  "  const trb_mover m = trb_plan_mover(plan, nodes, refs, keys, sorted);\n",
  "  const uint count = plan->too_deep ? 0 : plan->ref_count;\n",
  "  uint i;\n",
  "  TRB_FOR(i, count) {\n",
  "    trb_find_ref(&m, 2 * i);\n",
  "    trb_find_ref(&m, 2 * i + 1);\n",
  "  }\n",
  "}\n",
  "\n",
  "TRB_KERNEL trb_k_search_merges(const __global trb_plan *plan, __global trbvh_node *nodes, __global trbvh_node *refs,\n",
  "                               __global ulong *keys, __global ulong *sorted, uint batch) {\n",
  "  const trb_mover m = trb_plan_mover(plan, nodes, refs, keys, sorted);\n",
  "  const uint count = trb_move_count(plan), slots = plan->slots;\n",
  "  uint i;\n",
  "#ifdef TRB_CPU\n",
  "  uint job;\n",
  "  TRB_FOR_JOBS(job, (count + TRB_SEARCHES - 1) / TRB_SEARCHES)\n",
  "    for (i = job * TRB_SEARCHES; i < count && i < (job + 1) * TRB_SEARCHES; i++)\n",
  "      m.moves[i] = trb_search_merge(&m, i * TRB_MOVE_BATCHES + batch, slots);\n",
  "#else\n",
  "  TRB_FOR(i, count) m.moves[i] = trb_search_merge(&m, i * TRB_MOVE_BATCHES + batch, slots);\n",
  "#endif\n",
  "}\n",
  "\n",
  "\n",
  "#ifdef TRB_CPU\n",
  "\n",
  "TRB_KERNEL trb_k_move(const __global trb_plan *plan, __global trbvh_node *nodes, __global trbvh_node *refs,\n",
  "                      __global ulong *keys, __global ulong *sorted, uint merges) {\n",
  "  const trb_mover m = trb_plan_mover(plan, nodes, refs, keys, sorted);\n",
  "  const uint count = trb_move_count(plan);\n",
  "  uint i;\n",
  "  trb_choose_moves(&m, count);\n",
  "  for (i = 0; i < count; i++) trb_make_move(&m, i, merges);\n",
  "  trb_remake_moved(&m, count);\n",
  "}\n",
  "#else\n",
  "\n",
  "\n",
  "TRB_KERNEL trb_k_claim_gains(const __global trb_plan *plan, __global trbvh_node *nodes, __global ulong *keys,\n",
  "                             __global ulong *sorted, __global uint *gains) {\n",
  "  const trb_mover m = trb_plan_mover(plan, nodes, 0, keys, sorted);\n",
  "  const uint count = trb_move_count(plan);\n",
  "  uint i, k, pairs[3];\n",
  "  TRB_FOR(i, count) {\n",
  "    const trb_move move = m.moves[i];\n",
  "    if (!(move.gain > 0)) continue;\n",
  "    trb_touched_pairs(&m, move, pairs);\n",
  "    for (k = 0; k < 3; k++) atomic_max((volatile __global uint *)&gains[pairs[k]], as_uint(move.gain));\n",
  "  }\n",
  "}\n",
  "\n",
  "TRB_KERNEL trb_k_claim_pairs(const __global trb_plan *plan, __global trbvh_node *nodes, __global ulong *keys,\n",
  "                             __global ulong *sorted, const __global uint *gains) {\n",
  "  const trb_mover m = trb_plan_mover(plan, nodes, 0, keys, sorted);\n",
  "  const uint count = trb_move_count(plan);\n",
  "  uint i, k, pairs[3];\n",
  "  TRB_FOR(i, count) {\n",
  "    const trb_move move = m.moves[i];\n",
  "    if (!(move.gain > 0)) continue;\n",
  "    trb_touched_pairs(&m, move, pairs);\n",
  "    for (k = 0; k < 3; k++)\n",
  "      if (gains[pairs[k]] == as_uint(move.gain)) atomic_min((volatile __global uint *)&m.owners[pairs[k]], i);\n",
  "  }\n",
  "}\n",
  "\n",
  "TRB_KERNEL trb_k_stand_back(const __global trb_plan *plan, __global trbvh_node *nodes, __global ulong *keys,\n",
  "                            __global ulong *sorted) {\n",
  "  const trb_mover m = trb_plan_mover(plan, nodes, 0, keys, sorted);\n",
  "  const uint count = trb_move_count(plan);\n",
  "  uint i;\n",
  "  TRB_FOR(i, count)\n",
  "    if (m.moves[i].gain > 0 && !trb_owns(&m, i)) m.moves[i].gain = -m.moves[i].gain;\n",
  "}\n",
  "\n",
  "\n",
  "TRB_KERNEL trb_k_follow(const __global trb_plan *plan, __global trbvh_node *nodes, __global ulong *keys,\n",
  "                        __global ulong *sorted) {\n",
  "  const trb_mover m = trb_plan_mover(plan, nodes, 0, keys, sorted);\n",
  "  const uint count = trb_move_count(plan);\n",
  "  uint i;\n",
  "  TRB_FOR(i, count)\n",
  "    if (m.moves[i].gain > 0 && trb_follows(&m, i)) m.moves[i].node |= TRB_STAYS;\n",
  "}\n",
  "\n",
  "TRB_KERNEL trb_k_release(const __global trb_plan *plan, __global trbvh_node *nodes, __global ulong *keys,\n",
  "                         __global ulong *sorted, __global uint *gains) {\n",
  "  const trb_mover m = trb_plan_mover(plan, nodes, 0, keys, sorted);\n",
  "  const uint count = trb_move_count(plan);\n",
  "  uint i, k, pairs[3];\n",
  "  TRB_FOR(i, count) {\n",
  "    trb_move move = m.moves[i];\n",
  "    if (move.gain == 0) continue;\n",
  "    if (move.node & TRB_STAYS) {\n",
  "      move.node &= ~TRB_STAYS;\n",
  "      move.gain = -move.gain;\n",
  "      m.moves[i] = move;\n",
  "    }\n",
  "    trb_touched_pairs(&m, move, pairs);\n",
  "    for (k = 0; k < 3; k++) {\n",
  "      m.owners[pairs[k]] = TRBVH_NONE;\n",
  "      gains[pairs[k]] = 0;\n",
  "    }\n",
  "  }\n",
  "}\n",
  "\n",
  "\n",
  "TRB_KERNEL trb_k_move(const __global trb_plan *plan, __global trbvh_node *nodes, __global trbvh_node *refs,\n",
  "                      __global ulong *keys, __global ulong *sorted, uint merges) {\n",
  "  const trb_mover m = trb_plan_mover(plan, nodes, refs, keys, sorted);\n",
  "  const uint count = trb_move_count(plan);\n",
  "  uint i;\n",
  "  TRB_FOR(i, count) trb_make_move(&m, i, merges);\n",
  "}\n",
  "\n",
  "\n",
  "TRB_KERNEL trb_k_remake_level(const __global trb_plan *plan, __global trbvh_node *nodes, const __global trb_level *levels,\n",
  "                              const __global uint *list, uint level) {\n",
  "  const trb_costs costs = plan->costs;\n",
  "  const uint first = levels[level].first, count = levels[level].count;\n",
  "  uint i;\n",
  "  TRB_FOR(i, count) trb_remake(nodes, list[first + i], costs);\n",
  "}\n",
  "\n",
  "\n",
  "TRB_KERNEL trb_k_remake_levels(const __global trb_plan *plan, __global trbvh_node *nodes, const __global trb_level *levels,\n",
  "                               const __global uint *list, uint level) {\n",
  "  const trb_costs costs = plan->costs;\n",
  "  uint lowest = level, i;\n",
  "  while (lowest + 1 < TRB_GPU_LEVELS && levels[lowest + 1].count) lowest++;\n",
  "  for (lowest++; lowest-- > level;) {\n",
  "    for (i = TRB_LOCAL_ID; i < levels[lowest].count; i += TRB_GROUP)\n",
  "      trb_remake(nodes, list[levels[lowest].first + i], costs);\n",
  "    TRB_SYNC();\n",
  "  }\n",
  "}\n",
  "#endif\n",
  "#endif\n",
  "#ifdef TRB_WITH_COLLAPSE\n",
  "#line 5 \"kernels/collapse.cl\"\n",
  "static void trb_emit_padding(__global trbvh_node *out) {\n",
  "  uint k;\n",
  "  for (k = 0; k < 3; k++) out[1].min[k] = out[1].max[k] = 0;\n",
  "  out[1].first = out[1].count = 0;\n",
  "}\n",
  "\n",
  "\n",
  "TRB_KERNEL trb_k_find_tasks(__global trb_plan *plan, __global trbvh_node *nodes, __global ulong *keys, __global ulong *sorted,\n",
  "                            __global trb_task *tasks, __global trb_group *groups) {\n",
  "  const trb_collapser c = trb_plan_collapser(plan, nodes, 0, keys, sorted);\n",
  "  float sah = 0;\n",
  "  if (TRB_LOCAL_ID != 0) return;\n",
  "  plan->tasks = plan->ref_count && !plan->too_deep ? trb_find_tasks(&c, 0, tasks, &sah) : 0;\n",
  "  plan->groups = trb_find_groups(tasks, plan->tasks, groups);\n",
  "  plan->sah = sah;\n",
  "  plan->root_area = trb_sah_term(nodes[0], 1);\n",
  "}\n",
  "\n",
  "#ifdef TRB_CPU\n",
  "TRB_KERNEL trb_k_settle_groups(const __global trb_plan *plan, __global trbvh_node *nodes, const __global trbvh_node *refs,\n",
  "                               __global ulong *keys, __global ulong *sorted, __global trb_task *tasks,\n",
  "                               const __global trb_group *groups) {\n",
  "  const trb_collapser c = trb_plan_collapser(plan, nodes, refs, keys, sorted);\n",
  "  uint i;\n",
  "  TRB_FOR_JOBS(i, plan->groups) trb_settle_group(&c, tasks, groups[i]);\n",
  "}\n",
  "\n",
  "TRB_KERNEL trb_k_sum_tasks(__global trb_plan *plan, const __global trb_task *tasks) {\n",
  "  uint i, leaves = 0, prims = 0, max_depth = 0;\n",
  "  float sah = plan->sah;\n",
  "  for (i = 0; i < plan->tasks; i++) {\n",
  "    leaves += tasks[i].leaves;\n",
  "    prims += tasks[i].prims;\n",
  "    sah += tasks[i].sah;\n",
  "    max_depth = max(max_depth, tasks[i].max_depth);\n",
  "  }\n",
  "  plan->leaves = leaves;\n",
  "  plan->prims = prims;\n",
  "  plan->max_depth = max_depth;\n",
  "  plan->sah = sah;\n",
  "}\n",
  "\n",
  "TRB_KERNEL trb_k_emit_top(const __global trb_plan *plan, __global trbvh_node *nodes, __global ulong *keys,\n",
  "                          __global ulong *sorted, __global trb_task *tasks, __global trbvh_node *out, __global uint *prims) {\n",
  "  const trb_collapser c = trb_plan_emitter(plan, nodes, 0, keys, sorted, out, prims);\n",
  "  trb_emit_padding(out);\n",
  "  trb_emit_top(&c, tasks, plan->tasks);\n",
  "}\n",
  "\n",
  "TRB_KERNEL trb_k_emit_tasks(const __global trb_plan *plan, __global trbvh_node *nodes, const __global trbvh_node *refs,\n",
  "                            __global ulong *keys, __global ulong *sorted, const __global trb_task *tasks,\n",
  "                            __global trbvh_node *out, __global uint *prims) {\n",
  "  const trb_collapser c = trb_plan_emitter(plan, nodes, refs, keys, sorted, out, prims);\n",
  "  uint i;\n",
  "  TRB_FOR_JOBS(i, plan->tasks) trb_emit_task(&c, tasks[i]);\n",
  "}\n",
  "#else\n",
  "\n",
  "TRB_CORE uint trb_count_prims(const trb_collapser *c, trbvh_node leaf) {\n",
  "  uint prims[TRB_MAX_LEAF];\n",
  "  return c->refs ? trb_leaf_prims(c, leaf, prims) : trb_count(leaf.count);\n",
  "}\n",
  "\n",
  "\n",
  "TRB_CORE uint trb_emit_leaf(const trb_collapser *c, trbvh_node node, uint dst, uint first) {\n",
  "  uint prims[TRB_MAX_LEAF], i;\n",
  "  if (c->held) {\n",
  "    trb_emit_old_leaf(c, node, node.first, dst);\n",
  "    return 1;\n",
  "  }\n",
  "  node.count = trb_leaf_prims(c, node, prims);\n",
  "  node.first = first;\n",
  "  c->out[dst] = node;\n",
  "  for (i = 0; i < node.count; i++) c->prims[first + i] = prims[i];\n",
  "  return node.count;\n",
  "}\n",
  "\n",
  "\n",
  "TRB_KERNEL trb_k_first_inner(const __global trb_plan *plan, const __global trbvh_node *nodes, __global trb_level *levels,\n",
  "                             __global uint *list, __global uint *first_refs) {\n",
  "  uint i;\n",
  "  for (i = TRB_LOCAL_ID; i < TRB_GPU_LEVELS; i += TRB_GROUP) levels[i].first = levels[i].count = 0;\n",
  "  TRB_SYNC();\n",
  "  if (TRB_LOCAL_ID != 0 || plan->ref_count == 0 || plan->too_deep) return;\n",
  "  list[0] = first_refs[0] = 0;\n",
  "  levels[0].count = !trb_is_leaf(nodes[0].count);\n",
  "}\n",
  "\n",
  "static void trb_list_inner(const trb_collapser *c, __global trb_level *levels, __global uint *list, __global uint *first_refs,\n",
  "                           uint level, uint item, uint items, __local uint *space) {\n",
  "  const uint first = levels[level].first, count = levels[level].count, next = first + count;\n",
  "  uint i;\n",
  "  for (i = item; i - TRB_LOCAL_ID < count; i += items) {\n",
  "    uint found = 0, child[2] = {0, 0}, refs[2] = {0, 0}, side, at;\n",
  "    if (i < count) {\n",
  "      const uint first_ref = first_refs[first + i], pair = trb_bounded_node(c, list[first + i], level, first_ref).first;\n",
  "      const uint left = trb_count(c->nodes[pair].count);\n",
  "      for (side = 0; side < 2; side++)\n",
  "        if (!trb_is_leaf(c->nodes[pair + side].count)) {\n",
  "          child[found] = pair + side;\n",
  "          refs[found++] = first_ref + (side ? left : 0);\n",
  "        }\n",
  "    }\n",
  "    at = next + trb_reserve(&levels[level + 1].count, found, space);\n",
  "    for (side = 0; side < found; side++) {\n",
  "      list[at + side] = child[side];\n",
  "      first_refs[at + side] = refs[side];\n",
  "    }\n",
  "  }\n",
  "  if (item == 0) levels[level + 1].first = next;\n",
  "}\n",
  "\n",
  "TRB_KERNEL trb_k_list_inner(const __global trb_plan *plan, __global trbvh_node *nodes, __global ulong *keys,\n",
  "                            __global ulong *sorted, __global trb_level *levels, __global uint *list,\n",
  "                            __global uint *first_refs, uint level) {\n",
  "  __local uint space[2];\n",
  "  const trb_collapser c = trb_plan_collapser(plan, nodes, 0, keys, sorted);\n",
  "  trb_list_inner(&c, levels, list, first_refs, level, (uint)get_global_id(0), (uint)get_global_size(0), space);\n",
  "}\n",
  "\n",
  "\n",
  "TRB_KERNEL trb_k_list_rest(const __global trb_plan *plan, __global trbvh_node *nodes, __global ulong *keys,\n",
  "                           __global ulong *sorted, __global trb_level *levels, __global uint *list,\n",
  "                           __global uint *first_refs, uint level) {\n",
  "  __local uint space[2];\n",
  "  const trb_collapser c = trb_plan_collapser(plan, nodes, 0, keys, sorted);\n",
  "  for (; level + 1 < TRB_GPU_LEVELS && levels[level].count; level++) {\n",
  "    trb_list_inner(&c, levels, list, first_refs, level, TRB_LOCAL_ID, TRB_GROUP, space);\n",
  "    TRB_SYNC();\n",
  "  }\n",
  "}\n",
  "\n",
  "static void trb_count_inner(const trb_collapser *c, __global trb_place *places, uint index) {\n",
  "  const trbvh_node node = c->nodes[index];\n",
  "  trb_place sum;\n",
  "  uint side;\n",
  "  sum.inner = 1;\n",
  "  sum.prims = sum.pair = sum.prim = 0;\n",
  "  sum.sah = trb_sah_term(node, c->cost_node);\n",
  "  for (side = 0; side < 2; side++) {\n",
  "    const trbvh_node child = c->nodes[node.first + side];\n",
  "    if (trb_is_leaf(child.count)) {\n",
  "      const uint count = trb_count_prims(c, child);\n",
  "      sum.prims += count;\n",
  "      sum.sah += trb_leaf_term(c, child, count);\n",
  "    } else {\n",
  "      const trb_place below = places[child.first / 2];\n",
  "      sum.inner += below.inner;\n",
  "      sum.prims += below.prims;\n",
  "      sum.sah += below.sah;\n",
  "    }\n",
  "  }\n",
  "  places[node.first / 2] = sum;\n",
  "}\n",
  "\n",
  "TRB_KERNEL trb_k_count_inner(const __global trb_plan *plan, __global trbvh_node *nodes, const __global trbvh_node *refs,\n",
  "                             const __global trb_level *levels, const __global uint *list, __global trb_place *places,\n",
  "                             uint level) {\n",
  "  const trb_collapser c = trb_plan_collapser(plan, nodes, refs, 0, 0);\n",
  "  const uint first = levels[level].first, count = levels[level].count;\n",
  "  uint i;\n",
  "  TRB_FOR(i, count) trb_count_inner(&c, places, list[first + i]);\n",
  "}\n",
  "\n",
  "\n",
  "TRB_KERNEL trb_k_count_rest(const __global trb_plan *plan, __global trbvh_node *nodes, const __global trbvh_node *refs,\n",
  "                            const __global trb_level *levels, const __global uint *list, __global trb_place *places,\n",
  "                            uint level) {\n",
  "  const trb_collapser c = trb_plan_collapser(plan, nodes, refs, 0, 0);\n",
  "  uint lowest = level, i;\n",
  "  while (lowest + 1 < TRB_GPU_LEVELS && levels[lowest + 1].count) lowest++;\n",
  "  for (lowest++; lowest-- > level;) {\n",
  "    for (i = TRB_LOCAL_ID; i < levels[lowest].count; i += TRB_GROUP)\n",
  "      trb_count_inner(&c, places, list[levels[lowest].first + i]);\n",
  "    TRB_SYNC();\n",
  "  }\n",
  "}\n",
  "\n",
  "\n",
  "TRB_KERNEL trb_k_sum_inner(__global trb_plan *plan, __global trbvh_node *nodes, const __global trbvh_node *refs,\n",
  "                           const __global trb_level *levels, __global trb_place *places) {\n",
  "  const trb_collapser c = trb_plan_collapser(plan, nodes, refs, 0, 0);\n",
  "  uint depth = 0;\n",
  "  if (TRB_LOCAL_ID != 0) return;\n",
  "  plan->leaves = plan->prims = plan->max_depth = 0;\n",
  "  if (plan->ref_count == 0 || plan->too_deep) return;\n",
  "  plan->root_area = trb_sah_term(nodes[0], 1);\n",
  "  if (trb_is_leaf(nodes[0].count)) {\n",
  "    plan->leaves = 1;\n",
  "    plan->prims = trb_count_prims(&c, nodes[0]);\n",
  "    plan->sah = trb_leaf_term(&c, nodes[0], plan->prims);\n",
  "  } else {\n",
  "    __global trb_place *root = &places[nodes[0].first / 2];\n",
  "    while (levels[depth].count) depth++;\n",
  "    plan->leaves = root->inner + 1;\n",
  "    plan->prims = root->prims;\n",
  "    plan->sah = root->sah;\n",
  "    plan->max_depth = depth;\n",
  "    root->pair = 1;\n",
  "    root->prim = 0;\n",
  "  }\n",
  "}\n",
  "\n",
  "\n",
  "static void trb_place_children(const trb_collapser *c, __global trb_place *places, uint index) {\n",
  "  const trbvh_node node = c->nodes[index];\n",
  "  const trb_place place = places[node.first / 2];\n",
  "  uint pair = place.pair + 1, prim = place.prim, side;\n",
  "  for (side = 2; side-- > 0;) {\n",
  "    const trbvh_node child = c->nodes[node.first + side];\n",
  "    const uint dst = 2 * place.pair + side;\n",
  "    if (trb_is_leaf(child.count)) {\n",
  "      prim += trb_emit_leaf(c, child, dst, prim);\n",
  "    } else {\n",
  "      __global trb_place *below = &places[child.first / 2];\n",
  "      trb_emit_inner(c, child, dst, pair);\n",
  "      below->pair = pair;\n",
  "      below->prim = prim;\n",
  "      pair += below->inner;\n",
  "      prim += below->prims;\n",
  "    }\n",
  "  }\n",
  "}\n",
  "\n",
  "TRB_KERNEL trb_k_emit_root(const __global trb_plan *plan, __global trbvh_node *nodes, const __global trbvh_node *refs,\n",
  "                           __global trbvh_node *out, __global uint *prims) {\n",
  "  const trb_collapser c = trb_plan_emitter(plan, nodes, refs, 0, 0, out, prims);\n",
  "  if (TRB_LOCAL_ID != 0) return;\n",
  "  trb_emit_padding(out);\n",
  "  if (trb_is_leaf(nodes[0].count)) trb_emit_leaf(&c, nodes[0], 0, 0);\n",
  "  else trb_emit_inner(&c, nodes[0], 0, 1);\n",
  "}\n",
  "\n",
  "TRB_KERNEL trb_k_emit_level(const __global trb_plan *plan, __global trbvh_node *nodes, const __global trbvh_node *refs,\n",
  "                            const __global trb_level *levels, const __global uint *list, __global trb_place *places,\n",
  "                            __global trbvh_node *out, __global uint *prims, uint level) {\n",
  "  const trb_collapser c = trb_plan_emitter(plan, nodes, refs, 0, 0, out, prims);\n",
  "  const uint first = levels[level].first, count = levels[level].count;\n",
  "  uint i;\n",
  "  TRB_FOR(i, count) trb_place_children(&c, places, list[first + i]);\n",
  "}\n",
  "#endif\n",
  "#endif\n",
  "#ifdef TRB_WITH_OUTPUT\n",
  "#line 4 \"kernels/output.cl\"\n",
  "TRB_KERNEL trb_k_triangles(const __global trb_plan *plan, const __global char *positions, const __global char *indices,\n",
  "                           const __global uint *prims, __global trbvh_triangle *triangles, uint count) {\n",
  "  const trb_mesh mesh = trb_plan_mesh(plan, positions, indices);\n",
  "#ifdef TRB_CPU\n",
  "  const uint first = TRB_GROUP_ID * TRB_BLOCK;\n",
  "  trb_make_triangles(&mesh, prims, first, min(count, first + TRB_BLOCK), triangles);\n",
  "#else\n",
  "  uint i;\n",
  "  TRB_FOR(i, count) trb_make_triangle(&mesh, trb_mesh_form(&mesh), prims[i], &triangles[i]);\n",
  "#endif\n",
  "}\n",
  "#endif\n",
  "#ifdef TRB_WITH_REFIT\n",
  "#line 6 \"kernels/refit.cl\"\n",
  "TRB_KERNEL trb_k_first_refit(const __global trbvh_node *nodes, __global trb_level *levels, __global uint *list) {\n",
  "  uint i;\n",
  "  for (i = TRB_LOCAL_ID; i < TRB_GPU_LEVELS; i += TRB_GROUP) levels[i].first = levels[i].count = 0;\n",
  "  TRB_SYNC();\n",
  "  if (TRB_LOCAL_ID != 0) return;\n",
  "  list[0] = 0;\n",
  "  levels[0].count = nodes[0].count == 0;\n",
  "}\n",
  "\n",
  "\n",
  "TRB_KERNEL trb_k_list_refit(const __global trbvh_node *nodes, __global trb_level *levels, __global uint *list, uint level) {\n",
  "  __local uint space[2];\n",
  "  const uint first = levels[level].first, count = levels[level].count, next = first + count;\n",
  "  const uint items = (uint)get_global_size(0);\n",
  "  uint i;\n",
  "  for (i = (uint)get_global_id(0); i - TRB_LOCAL_ID < count; i += items) {\n",
  "    uint found = 0, child[2] = {0, 0}, side, at;\n",
  "    if (i < count) {\n",
  "      const uint pair = nodes[list[first + i]].first;\n",
  "      for (side = 0; side < 2; side++)\n",
  "        if (nodes[pair + side].count == 0) child[found++] = pair + side;\n",
  "    }\n",
  "    at = next + trb_reserve(&levels[level + 1].count, found, space);\n",
  "    for (side = 0; side < found; side++) list[at + side] = child[side];\n",
  "  }\n",
  "  if (get_global_id(0) == 0) levels[level + 1].first = next;\n",
  "}\n",
  "\n",
  "\n",
  "TRB_KERNEL trb_k_refit_leaves(const __global trb_plan *plan, const __global char *positions, const __global char *indices,\n",
  "                              const __global uint *prims, __global trbvh_node *nodes, uint count) {\n",
  "  const trb_mesh mesh = trb_plan_mesh(plan, positions, indices);\n",
  "  uint i, k;\n",
  "  TRB_FOR(i, count) {\n",
  "    trbvh_node leaf = nodes[i], sum = trb_no_box();\n",
  "    if (leaf.count == 0) continue;\n",
  "    for (k = leaf.first; k < leaf.first + leaf.count; k++) {\n",
  "      trbvh_node box;\n",
  "      float v[3][3];\n",
  "      uint vertex;\n",
  "      if (trb_prim_box(&mesh, prims[k], &box, v, &vertex) > 0) trb_include(&sum, box.min, box.max);\n",
  "    }\n",
  "    for (k = 0; k < 3; k++) {\n",
  "      nodes[i].min[k] = sum.min[k];\n",
  "      nodes[i].max[k] = sum.max[k];\n",
  "    }\n",
  "  }\n",
  "}\n",
  "\n",
  "TRB_KERNEL trb_k_refit_level(__global trbvh_node *nodes, const __global trb_level *levels, const __global uint *list,\n",
  "                             uint level) {\n",
  "  const uint first = levels[level].first, count = levels[level].count;\n",
  "  uint i, k;\n",
  "  for (i = (uint)get_global_id(0); i < count; i += (uint)get_global_size(0)) {\n",
  "    const uint node = list[first + i];\n",
  "    const trbvh_node left = nodes[nodes[node].first], right = nodes[nodes[node].first + 1];\n",
  "    for (k = 0; k < 3; k++) {\n",
  "      nodes[node].min[k] = TRB_MIN(left.min[k], right.min[k]);\n",
  "      nodes[node].max[k] = TRB_MAX(left.max[k], right.max[k]);\n",
  "    }\n",
  "  }\n",
  "}\n",
  "\n",
  "\n",
  "TRB_KERNEL trb_k_unsettle(const __global trb_plan *plan, const __global trbvh_node *old, __global trbvh_node *nodes,\n",
  "                          __global trb_held *held, uint count) {\n",
  "  const trb_costs costs = plan->costs;\n",
  "  uint i;\n",
  "  TRB_FOR(i, count) nodes[i] = trb_unsettle(old[i], i, &held[i], costs);\n",
  "}\n",
  "\n",
  "TRB_KERNEL trb_k_unsettle_level(const __global trb_plan *plan, __global trbvh_node *nodes, const __global trb_level *levels,\n",
  "                                const __global uint *list, uint level) {\n",
  "  const uint first = levels[level].first, count = levels[level].count;\n",
  "  const trb_costs costs = plan->costs;\n",
  "  uint i;\n",
  "  for (i = (uint)get_global_id(0); i < count; i += (uint)get_global_size(0)) trb_remake(nodes, list[first + i], costs);\n",
  "}\n",
  "#endif\n",
  "#ifdef TRB_WITH_TRACE\n",
  "#line 5 \"kernels/trace.cl\"\n",
  "#ifdef TRB_CPU\n",
  "  #define TRB_RAYS TRB_CPU_RAYS\n",
  "#else\n",
  "  #define TRB_RAYS 1u\n",
  "#endif\n",
  "#define TRB_FOR_RAYS(i, begin, end) \\\n",
  "  for (i = (begin) + (ulong)get_global_id(0) * TRB_RAYS, end = min((ulong)(end), i + TRB_RAYS); i < end; i++)\n",
  "\n",
  "TRB_KERNEL trb_k_intersect(const __global trbvh_node *nodes, const __global trbvh_triangle *triangles,\n",
  "                           const __global trbvh_ray *rays, __global trbvh_hit *hits, uint empty, ulong begin, ulong end) {\n",
  "  ulong i;\n",
  "  TRB_FOR_RAYS(i, begin, end) {\n",
  "    const trbvh_ray ray = rays[i];\n",
  "    trbvh_hit hit;\n",
  "    if (empty) {\n",
  "      const __global trbvh_ray *scene = &rays[i];\n",
  "      trb_ray r;\n",
  "      trb_prepare_ray(&r, &ray, (const __global float *)scene);\n",
  "      trb_miss(&r, &hit);\n",
  "    } else {\n",
  "      trbvh_intersect(nodes, triangles, ray, &hit);\n",
  "    }\n",
  "    hits[i] = hit;\n",
  "  }\n",
  "}\n",
  "\n",
  "TRB_KERNEL trb_k_occluded(const __global trbvh_node *nodes, const __global trbvh_triangle *triangles,\n",
  "                          const __global trbvh_ray *rays, __global uchar *occluded, uint empty, ulong begin, ulong end) {\n",
  "  ulong i;\n",
  "  TRB_FOR_RAYS(i, begin, end) occluded[i] = empty ? 0 : (uchar)trbvh_occluded(nodes, triangles, rays[i]);\n",
  "}\n",
  "#endif\n",
};
#define TRB_CL_CORE_LINES 2341u   /* entries of trb_cl_text for user kernels: types, core, traversal */
#define TRB_CL_LINES      3724u   /* all entries */
#define TRB_CL_HASH       "2b0ef3c8d99c7df1"   /* FNV-1a 64 of all strings: part of the program cache's key */
// >>kernels end -----------------------------------------------------------------------------------------------------

TRBVH_API const char *const *trbvh_cl_source(uint32_t *lines) {
  if (lines) *lines = TRB_CL_CORE_LINES;
  return trb_cl_text;
}

static void trb_cl_say(trbvh_stats *stats, const char *format, const char *a, int b, const char *c) {
  if (stats) snprintf(stats->message, sizeof stats->message, format, a, b, c);
}

#ifdef TRBVH_NO_OPENCL
TRBVH_API uint32_t trbvh_cl_devices(trbvh_cl_info *out, uint32_t capacity) { (void)out; (void)capacity; return 0; }
TRBVH_API trbvh_device *trbvh_cl_open(const trbvh_cl_desc *desc, trbvh_stats *stats) {
  (void)desc;
  trb_cl_say(stats, "compiled %s OpenCL", "without", 0, "");
  return NULL;
}
TRBVH_API void trbvh_cl_close(trbvh_device *device) { (void)device; }
TRBVH_API const char *trbvh_cl_name(const trbvh_device *device) { (void)device; return ""; }
TRBVH_API const char *trbvh_cl_message(const trbvh_device *device) { (void)device; return ""; }
TRBVH_API void trbvh_cl_trim(trbvh_device *device) { (void)device; }
TRBVH_API trbvh_result trbvh_cl_build(trbvh_device *device, trbvh_cl_tree *tree, const trbvh_cl_geometry *geometry,
                                      const trbvh_options *options, struct _cl_event **done) {
  (void)device; (void)tree; (void)geometry; (void)options; (void)done;
  return TRBVH_NO_DEVICE;
}
TRBVH_API trbvh_result trbvh_cl_refit(trbvh_device *device, trbvh_cl_tree *tree, const trbvh_cl_geometry *geometry,
                                      struct _cl_event **done) {
  (void)device; (void)tree; (void)geometry; (void)done;
  return TRBVH_NO_DEVICE;
}
TRBVH_API trbvh_result trbvh_cl_optimize(trbvh_device *device, trbvh_cl_tree *tree, const trbvh_options *options,
                                         struct _cl_event **done) {
  (void)device; (void)tree; (void)options; (void)done;
  return TRBVH_NO_DEVICE;
}
TRBVH_API trbvh_result trbvh_cl_intersect(trbvh_device *device, const trbvh_cl_tree *tree, struct _cl_mem *rays,
                                          struct _cl_mem *hits, size_t count, struct _cl_event **done) {
  (void)device; (void)tree; (void)rays; (void)hits; (void)count; (void)done;
  return TRBVH_NO_DEVICE;
}
TRBVH_API trbvh_result trbvh_cl_occluded(trbvh_device *device, const trbvh_cl_tree *tree, struct _cl_mem *rays,
                                         struct _cl_mem *occluded, size_t count, struct _cl_event **done) {
  (void)device; (void)tree; (void)rays; (void)occluded; (void)count; (void)done;
  return TRBVH_NO_DEVICE;
}
TRBVH_API trbvh_result trbvh_cl_upload(trbvh_device *device, trbvh_cl_tree *tree, const trbvh *bvh) {
  (void)device; (void)tree; (void)bvh;
  return TRBVH_NO_DEVICE;
}
TRBVH_API trbvh_result trbvh_cl_download(trbvh_device *device, const trbvh_cl_tree *tree, trbvh *bvh,
                                         const trbvh_options *options) {
  (void)device; (void)tree; (void)bvh; (void)options;
  return TRBVH_NO_DEVICE;
}
TRBVH_API void trbvh_cl_free(trbvh_device *device, trbvh_cl_tree *tree) { (void)device; (void)tree; }
#else

// >>opencl ---- our own declarations of what is used of OpenCL 1.2, and the library, opened at run time --------------
#if defined(_WIN32)
  #ifndef WIN32_LEAN_AND_MEAN
    #define WIN32_LEAN_AND_MEAN
  #endif
  #include <windows.h>
  #define TRB_CL_CALL __stdcall
#else
  #include <dlfcn.h>
  #define TRB_CL_CALL
#endif

typedef struct _cl_platform_id   *trb_cl_platform;
typedef struct _cl_device_id     *trb_cl_device_id;
typedef struct _cl_context       *trb_cl_context;
typedef struct _cl_command_queue *trb_cl_queue;
typedef struct _cl_mem           *trb_cl_mem;
typedef struct _cl_program       *trb_cl_program;
typedef struct _cl_kernel        *trb_cl_kernel;
typedef struct _cl_event         *trb_cl_event;

enum {                                   /* names and values of CL/cl.h */
  TRB_CL_MEM_OBJECT_ALLOCATION_FAILURE = -4, TRB_CL_OUT_OF_HOST_MEMORY = -6, TRB_CL_BUILD_PROGRAM_FAILURE = -11,
  TRB_CL_INVALID_BUFFER_SIZE = -61,
  TRB_CL_DEVICE_TYPE_CPU = 2, TRB_CL_DEVICE_TYPE_GPU = 4,
  TRB_CL_PLATFORM_NAME = 0x0902,
  TRB_CL_DEVICE_TYPE = 0x1000, TRB_CL_DEVICE_MAX_COMPUTE_UNITS = 0x1002, TRB_CL_DEVICE_MAX_WORK_GROUP_SIZE = 0x1004,
  TRB_CL_DEVICE_GLOBAL_MEM_SIZE = 0x101F, TRB_CL_DEVICE_LOCAL_MEM_SIZE = 0x1023, TRB_CL_DEVICE_ENDIAN_LITTLE = 0x1026,
  TRB_CL_DEVICE_AVAILABLE = 0x1027, TRB_CL_DEVICE_COMPILER_AVAILABLE = 0x1028, TRB_CL_DEVICE_NAME = 0x102B,
  TRB_CL_DRIVER_VERSION = 0x102D, TRB_CL_DEVICE_VERSION = 0x102F, TRB_CL_DEVICE_PLATFORM = 0x1031,
  TRB_CL_QUEUE_CONTEXT = 0x1090, TRB_CL_QUEUE_DEVICE = 0x1091, TRB_CL_QUEUE_PROPERTIES = 0x1093,
  TRB_CL_QUEUE_OUT_OF_ORDER = 1, TRB_CL_QUEUE_PROFILING = 2,
  TRB_CL_MEM_READ_WRITE = 1, TRB_CL_MEM_READ_ONLY = 4, TRB_CL_MEM_USE_HOST_PTR = 8, TRB_CL_MEM_COPY_HOST_PTR = 32,
  TRB_CL_MEM_SIZE = 0x1102, TRB_CL_MAP_READ = 1,
  TRB_CL_PROGRAM_BINARY_SIZES = 0x1165, TRB_CL_PROGRAM_BINARIES = 0x1166, TRB_CL_PROGRAM_BUILD_LOG = 0x1183
};

#define TRB_CL_FUNCTIONS(X) \
  X(int32_t, GetPlatformIDs, (uint32_t, trb_cl_platform *, uint32_t *)) \
  X(int32_t, GetPlatformInfo, (trb_cl_platform, uint32_t, size_t, void *, size_t *)) \
  X(int32_t, GetDeviceIDs, (trb_cl_platform, uint64_t, uint32_t, trb_cl_device_id *, uint32_t *)) \
  X(int32_t, GetDeviceInfo, (trb_cl_device_id, uint32_t, size_t, void *, size_t *)) \
  X(trb_cl_context, CreateContext, (const intptr_t *, uint32_t, const trb_cl_device_id *, \
    void (TRB_CL_CALL *)(const char *, const void *, size_t, void *), void *, int32_t *)) \
  X(int32_t, RetainContext, (trb_cl_context)) \
  X(int32_t, ReleaseContext, (trb_cl_context)) \
  X(trb_cl_queue, CreateCommandQueue, (trb_cl_context, trb_cl_device_id, uint64_t, int32_t *)) \
  X(int32_t, RetainCommandQueue, (trb_cl_queue)) \
  X(int32_t, ReleaseCommandQueue, (trb_cl_queue)) \
  X(int32_t, GetCommandQueueInfo, (trb_cl_queue, uint32_t, size_t, void *, size_t *)) \
  X(trb_cl_mem, CreateBuffer, (trb_cl_context, uint64_t, size_t, void *, int32_t *)) \
  X(int32_t, ReleaseMemObject, (trb_cl_mem)) \
  X(int32_t, GetMemObjectInfo, (trb_cl_mem, uint32_t, size_t, void *, size_t *)) \
  X(trb_cl_program, CreateProgramWithSource, (trb_cl_context, uint32_t, const char **, const size_t *, int32_t *)) \
  X(trb_cl_program, CreateProgramWithBinary, (trb_cl_context, uint32_t, const trb_cl_device_id *, const size_t *, \
    const unsigned char **, int32_t *, int32_t *)) \
  X(int32_t, BuildProgram, (trb_cl_program, uint32_t, const trb_cl_device_id *, const char *, \
    void (TRB_CL_CALL *)(trb_cl_program, void *), void *)) \
  X(int32_t, GetProgramInfo, (trb_cl_program, uint32_t, size_t, void *, size_t *)) \
  X(int32_t, GetProgramBuildInfo, (trb_cl_program, trb_cl_device_id, uint32_t, size_t, void *, size_t *)) \
  X(int32_t, ReleaseProgram, (trb_cl_program)) \
  X(trb_cl_kernel, CreateKernel, (trb_cl_program, const char *, int32_t *)) \
  X(int32_t, ReleaseKernel, (trb_cl_kernel)) \
  X(int32_t, SetKernelArg, (trb_cl_kernel, uint32_t, size_t, const void *)) \
  X(int32_t, EnqueueNDRangeKernel, (trb_cl_queue, trb_cl_kernel, uint32_t, const size_t *, const size_t *, \
    const size_t *, uint32_t, const trb_cl_event *, trb_cl_event *)) \
  X(int32_t, EnqueueReadBuffer, (trb_cl_queue, trb_cl_mem, uint32_t, size_t, size_t, void *, uint32_t, \
    const trb_cl_event *, trb_cl_event *)) \
  X(int32_t, EnqueueWriteBuffer, (trb_cl_queue, trb_cl_mem, uint32_t, size_t, size_t, const void *, uint32_t, \
    const trb_cl_event *, trb_cl_event *)) \
  X(int32_t, EnqueueFillBuffer, (trb_cl_queue, trb_cl_mem, const void *, size_t, size_t, size_t, uint32_t, \
    const trb_cl_event *, trb_cl_event *)) \
  X(void *, EnqueueMapBuffer, (trb_cl_queue, trb_cl_mem, uint32_t, uint64_t, size_t, size_t, uint32_t, \
    const trb_cl_event *, trb_cl_event *, int32_t *)) \
  X(int32_t, EnqueueUnmapMemObject, (trb_cl_queue, trb_cl_mem, void *, uint32_t, const trb_cl_event *, trb_cl_event *)) \
  X(int32_t, EnqueueMarkerWithWaitList, (trb_cl_queue, uint32_t, const trb_cl_event *, trb_cl_event *)) \
  X(int32_t, ReleaseEvent, (trb_cl_event)) \
  X(int32_t, Flush, (trb_cl_queue)) \
  X(int32_t, Finish, (trb_cl_queue))

typedef struct trb_cl_api {
  #define TRB_X(type, name, arguments) type (TRB_CL_CALL *name) arguments;
  TRB_CL_FUNCTIONS(TRB_X)
  #undef TRB_X
} trb_cl_api;

typedef void (*trb_cl_function)(void);

/* The library stays loaded: drivers do not like to be unloaded. */
static void *trb_cl_library(void) {
  static const char *const names[] = {
  #if defined(_WIN32)
    "OpenCL.dll"
  #elif defined(__APPLE__)
    "/System/Library/Frameworks/OpenCL.framework/OpenCL"
  #else
    "libOpenCL.so.1", "libOpenCL.so"
  #endif
  };
  void *library = NULL;
  size_t i;
  for (i = 0; i < sizeof names / sizeof names[0] && !library; i++) {
  #if defined(_WIN32)
    library = (void *)LoadLibraryA(names[i]);
  #else
    library = dlopen(names[i], RTLD_NOW | RTLD_LOCAL);
  #endif
  }
  return library;
}

static trb_cl_function trb_cl_symbol(void *library, const char *name) {
  trb_cl_function function = 0;
#if defined(_WIN32)
  function = (trb_cl_function)GetProcAddress((HMODULE)library, name);
#else
  void *symbol = dlsym(library, name);
  memcpy(&function, &symbol, sizeof function);       /* ISO C has no cast for that */
#endif
  return function;
}

/* 0 where there is no OpenCL, or one before 1.2. */
static int trb_cl_load(trb_cl_api *api, trbvh_stats *stats) {
  void *library = NULL;
#if !defined(_WIN32)
  #ifdef RTLD_DEFAULT
    void *const process = RTLD_DEFAULT;
  #else                                  /* POSIX reserves it, not all systems show it to C99 */
    void *const process = NULL;
  #endif
  if (dlsym(process, "clGetPlatformIDs")) library = process;
  else
#endif
  {
    library = trb_cl_library();
    if (!library) {
      trb_cl_say(stats, "there is no %s here", "OpenCL library", 0, "");
      return 0;
    }
  }
  #define TRB_X(type, name, arguments) { \
    trb_cl_function function = trb_cl_symbol(library, "cl" #name); \
    if (!function) { trb_cl_say(stats, "the OpenCL library has no %s", "cl" #name, 0, ""); return 0; } \
    memcpy(&api->name, &function, sizeof function); }
  TRB_CL_FUNCTIONS(TRB_X)
  #undef TRB_X
  return 1;
}

// >>kernels ---- the programs, and every kernel's arguments ----------------------------------------------------------
#define TRB_CL_PROGRAMS(X) \
  X(BUILD,    "-DTRB_WITH_BOUNDS -DTRB_WITH_MORTON -DTRB_WITH_SORT -DTRB_WITH_HIERARCHY -DTRB_WITH_COLLAPSE -DTRB_WITH_OUTPUT") \
  X(SPLIT,    "-DTRB_WITH_BOUNDS -DTRB_WITH_SPLIT") \
  X(TREELETS, "-DTRB_WITH_TREELETS") \
  X(MOVES,    "-DTRB_WITH_MOVES") \
  X(REFIT,    "-DTRB_WITH_REFIT -DTRB_WITH_OUTPUT") \
  X(TRACE,    "-DTRB_WITH_TRACE")

/* b: a buffer, u: uint, l: ulong, t: local memory for treelets, not passed; a star: work-groups of TRB_GPU_LANES. */
#define TRB_CL_KERNELS(X) \
  X(BUILD, read, "bbbbb")             X(BUILD, grid, "bbu")               X(BUILD, count_refs, "bbb") \
  X(BUILD, scan, "bu") \
  X(SPLIT, priorities, "bbbbbb")      X(SPLIT, priority_unit, "bbu")      X(SPLIT, sum_splits, "bbbu") \
  X(SPLIT, choose_scale, "bbuu")      X(SPLIT, count_slots, "bbbb")       X(SPLIT, split, "bbbbbbbb") \
  X(SPLIT, sum_refs, "bbu")           X(BUILD, keys, "bbb")              X(BUILD, gap_keys, "bbbb") \
  X(BUILD, high_keys, "bbb") \
  X(BUILD, count_digits, "bbbu")      X(BUILD, place_digits, "bu")        X(BUILD, scatter_keys, "bbbbu") \
  X(BUILD, sum_tiles, "bbu")          X(BUILD, scan_tiles, "bbu") \
  X(BUILD, build_blocks, "bbbbb")     X(BUILD, build_top, "bbb") \
  X(BUILD, build_chunks, "bbbbbbb")   X(BUILD, join_chunks, "bbbbbbbbbu") \
  X(TREELETS, restructure_top, "bbbbu")                                   X(TREELETS, restructure_groups, "bbbbbbbuuu") \
  X(TREELETS, first_level, "bbbbu")   X(TREELETS, list_level, "bbbuu")    X(TREELETS, list_levels, "bbbbuu") \
  X(TREELETS, restructure_level, "*bbbbtuuu")                             X(TREELETS, restructure_levels, "*bbbbtuu") \
  X(MOVES, score, "bbbbb")            X(MOVES, choose_score, "bb") \
  X(MOVES, count_candidates, "bbbbb") X(MOVES, list_candidates, "bbbbb")  X(MOVES, search, "bbbbu") \
  X(MOVES, forget_refs, "bb")         X(MOVES, find_refs, "bbbbb")        X(MOVES, search_merges, "bbbbbu") \
  X(MOVES, claim_gains, "bbbbb")      X(MOVES, claim_pairs, "bbbbb")      X(MOVES, stand_back, "bbbb") \
  X(MOVES, follow, "bbbb")            X(MOVES, release, "bbbbb")          X(MOVES, move, "bbbbbu") \
  X(MOVES, remake_level, "bbbbu")     X(MOVES, remake_levels, "bbbbu")    X(MOVES, sum_costs, "bbb") \
  X(MOVES, add_costs, "bbu") \
  X(BUILD, find_tasks, "bbbbbb")      X(BUILD, settle_groups, "bbbbbbb")  X(BUILD, sum_tasks, "bb") \
  X(BUILD, emit_top, "bbbbbbb")       X(BUILD, emit_tasks, "bbbbbbbb") \
  X(BUILD, first_inner, "bbbbb")      X(BUILD, list_inner, "bbbbbbbu")    X(BUILD, list_rest, "bbbbbbbu") \
  X(BUILD, count_inner, "bbbbbbu")    X(BUILD, count_rest, "bbbbbbu")     X(BUILD, sum_inner, "bbbbb") \
  X(BUILD, emit_root, "bbbbb")        X(BUILD, emit_level, "bbbbbbbbu") \
  X(BUILD, triangles, "bbbbbu")       X(REFIT, triangles, "bbbbbu") \
  X(REFIT, first_refit, "bbb")        X(REFIT, list_refit, "bbbu") \
  X(REFIT, refit_leaves, "bbbbbu")    X(REFIT, refit_level, "bbbu") \
  X(REFIT, unsettle, "bbbbu")         X(REFIT, unsettle_level, "bbbbu") \
  X(TRACE, intersect, "bbbbull")      X(TRACE, occluded, "bbbbull")

enum {
  #define TRB_X(name, options) TRB_CL_PROGRAM_##name,
  TRB_CL_PROGRAMS(TRB_X)
  #undef TRB_X
  TRB_CL_PROGRAM_COUNT
};
enum {
  #define TRB_X(program, name, arguments) TRB_CL_##program##_##name,
  TRB_CL_KERNELS(TRB_X)
  #undef TRB_X
  TRB_CL_KERNEL_COUNT
};

#define TRB_CL_WIDE       40u            /* levels of a tree that get a launch each on a GPU, unless it is a small one */
#define TRB_CL_GROUPS_MAX 2048u          /* in a launch whose work-items take one element after the other */
#ifndef TRB_CL_SMALL                     /* fewer triangles are built in C */
  #define TRB_CL_SMALL 20000u
#endif
#ifndef TRB_CL_SHAPE                     /* 0: by the device's type. For tests: 1 that for CPUs, 2 that for GPUs */
  #define TRB_CL_SHAPE 0
#endif

// >>device ----------------------------------------------------------------------------------------------------------
/* Scratch memory: see >>stages. */
#define TRB_CL_SCRATCH(X) \
  X(nodes) X(refs) X(keys) X(sorted) X(counts) X(partials) X(ranges) X(groups) X(tasks) X(lists) X(marks) \
  X(places) X(levels)
enum {
  #define TRB_X(name) TRB_CL_SCRATCH_##name,
  TRB_CL_SCRATCH(TRB_X)
  #undef TRB_X
  TRB_CL_SCRATCH_COUNT
};
typedef struct trb_cl_part { trb_cl_mem buffer; void *host; size_t size; } trb_cl_part;

typedef struct trb_cl {
  trbvh_device     hooks;                /* first: what trbvh.h knows of it */
  trb_cl_api       api;
  trbvh_cl_desc    desc;
  trbvh_cl_info    info;
  trb_cl_device_id id;
  trb_cl_context   context;
  trb_cl_queue     queue;
  int              cpu, pocl;            /* the shape of its kernels; PoCL's own compiler */
  trb_cl_program   programs[TRB_CL_PROGRAM_COUNT];
  char             broken[TRB_CL_PROGRAM_COUNT][256];        /* why a program does not compile: it is not tried again */
  trb_cl_kernel    kernels[TRB_CL_KERNEL_COUNT];
  trb_cl_part      scratch[TRB_CL_SCRATCH_COUNT];    /* kept from build to build */
  /* the first call that failed since the last trb_cl_begin; nothing is enqueued after it */
  int32_t          error;
  char             message[256];
#ifdef TRB_CL_PROFILE                    /* for a benchmark: is told of every launch */
  void           (*on_launch)(void *user, const char *kernel, trb_cl_event event);
  void            *on_launch_user;
#endif
} trb_cl;

/* Remembers the first failure. */
static int trb_cl_check(trb_cl *cl, int32_t error, const char *call) {
  if (error && !cl->error) {
    cl->error = error;
    snprintf(cl->message, sizeof cl->message, "%s failed on %.80s: error %d", call, cl->info.name, (int)error);
  }
  return cl->error == 0;
}

/* The same for a call that makes an object. */
static int trb_cl_made(trb_cl *cl, const void *object, int32_t error, const char *call) {
  return trb_cl_check(cl, object || error ? error : TRB_CL_OUT_OF_HOST_MEMORY, call);
}

static void trb_cl_begin(trb_cl *cl) { cl->error = 0; cl->message[0] = 0; }

/* What the failure is to the user. */
static trbvh_result trb_cl_result(const trb_cl *cl, trbvh_stats *stats) {
  if (!cl->error) return TRBVH_OK;
  trb_cl_say(stats, "%s", cl->message, 0, "");
  return cl->error == TRB_CL_MEM_OBJECT_ALLOCATION_FAILURE || cl->error == TRB_CL_INVALID_BUFFER_SIZE
       ? TRBVH_OUT_OF_DEVICE_MEMORY : TRBVH_DEVICE_ERROR;
}

/* Where it is not the device that is to blame. */
static trbvh_result trb_cl_refuse(trb_cl *cl, const char *why) {
  snprintf(cl->message, sizeof cl->message, "%s", why);
  return TRBVH_INVALID_ARGUMENT;
}

static trb_u64 trb_cl_hash(trb_u64 hash, const void *bytes, size_t size) {           /* FNV-1a */
  const unsigned char *p = (const unsigned char *)bytes;
  while (size--) hash = (hash ^ *p++) * 0x100000001B3u;
  return hash;
}
#define TRB_CL_HASH_START 0xCBF29CE484222325u

/* OpenCL does not cut texts off: the call fails where there is too little room. */
static void trb_cl_device_text(const trb_cl_api *api, trb_cl_device_id id, uint32_t what, char *out, size_t size) {
  char text[1024] = "";
  if (api->GetDeviceInfo(id, what, sizeof text - 1, text, NULL)) text[0] = 0;
  snprintf(out, size, "%.*s", (int)(size - 1), text);
}

/* A number; 0 where it is not known. Sizes of these differ: bool, uint, ulong, size_t. */
static uint64_t trb_cl_device_number(const trb_cl_api *api, trb_cl_device_id id, uint32_t what) {
  uint64_t wide = 0;
  uint32_t narrow;
  size_t used = 0;
  if (api->GetDeviceInfo(id, what, sizeof wide, &wide, &used)) return 0;
  if (used == 8) return wide;
  memcpy(&narrow, &wide, sizeof narrow);
  return used == 4 ? narrow : 0;
}

static void trb_cl_describe(const trb_cl_api *api, trb_cl_platform platform, trb_cl_device_id id, trbvh_cl_info *info) {
  char text[1024] = "";
  memset(info, 0, sizeof *info);
  trb_cl_device_text(api, id, TRB_CL_DEVICE_NAME, info->name, sizeof info->name);
  trb_cl_device_text(api, id, TRB_CL_DRIVER_VERSION, info->version, sizeof info->version);
  if (api->GetPlatformInfo(platform, TRB_CL_PLATFORM_NAME, sizeof text - 1, text, NULL)) text[0] = 0;
  snprintf(info->platform, sizeof info->platform, "%.*s", (int)sizeof info->platform - 1, text);
  info->is_gpu = (trb_cl_device_number(api, id, TRB_CL_DEVICE_TYPE) & TRB_CL_DEVICE_TYPE_GPU) != 0;
  info->memory_bytes = trb_cl_device_number(api, id, TRB_CL_DEVICE_GLOBAL_MEM_SIZE);
  info->compute_units = (uint32_t)trb_cl_device_number(api, id, TRB_CL_DEVICE_MAX_COMPUTE_UNITS);
}

/* OpenCL 1.2, a compiler, our byte order, and what the kernels ask for. */
static int trb_cl_usable(const trb_cl_api *api, trb_cl_device_id id) {
  const uint32_t one = 1;
  char version[64];
  unsigned char little;
  memcpy(&little, &one, 1);
  trb_cl_device_text(api, id, TRB_CL_DEVICE_VERSION, version, sizeof version);       /* "OpenCL 1.2 ..." */
  if (strncmp(version, "OpenCL ", 7) || version[7] < '1' || (version[7] == '1' && version[9] < '2')) return 0;
  if (!(trb_cl_device_number(api, id, TRB_CL_DEVICE_TYPE) & TRB_CL_DEVICE_TYPE_CPU) &&
      (trb_cl_device_number(api, id, TRB_CL_DEVICE_MAX_WORK_GROUP_SIZE) < TRB_GPU_GROUP ||
       trb_cl_device_number(api, id, TRB_CL_DEVICE_LOCAL_MEM_SIZE) < 32768)) return 0;
  return trb_cl_device_number(api, id, TRB_CL_DEVICE_AVAILABLE) &&
         trb_cl_device_number(api, id, TRB_CL_DEVICE_COMPILER_AVAILABLE) &&
         (trb_cl_device_number(api, id, TRB_CL_DEVICE_ENDIAN_LITTLE) != 0) == (little != 0);
}

#define TRB_CL_FOUND_MAX 32u             /* platforms, and devices of each, that are looked at */
typedef struct trb_cl_found { trb_cl_platform platform; trb_cl_device_id id; } trb_cl_found;

/* All usable devices; how many. */
static uint32_t trb_cl_find(const trb_cl_api *api, trb_cl_found *found, uint32_t capacity) {
  trb_cl_platform platforms[TRB_CL_FOUND_MAX];
  trb_cl_device_id ids[TRB_CL_FOUND_MAX];
  uint32_t platform_count = 0, device_count, count = 0, i, k;
  if (api->GetPlatformIDs(TRB_CL_FOUND_MAX, platforms, &platform_count)) return 0;
  for (i = 0; i < platform_count && i < TRB_CL_FOUND_MAX; i++) {
    device_count = 0;
    if (api->GetDeviceIDs(platforms[i], 0xFFFFFFFFu, TRB_CL_FOUND_MAX, ids, &device_count)) continue;
    for (k = 0; k < device_count && k < TRB_CL_FOUND_MAX && count < capacity; k++)
      if (trb_cl_usable(api, ids[k])) {
        found[count].platform = platforms[i];
        found[count++].id = ids[k];
      }
  }
  return count;
}

TRBVH_API uint32_t trbvh_cl_devices(trbvh_cl_info *out, uint32_t capacity) {
  trb_cl_found found[TRB_CL_FOUND_MAX];
  trb_cl_api api;
  uint32_t count, i;
  if (!trb_cl_load(&api, NULL)) return 0;
  count = trb_cl_find(&api, found, TRB_CL_FOUND_MAX);
  for (i = 0; i < count && i < capacity && out; i++) trb_cl_describe(&api, found[i].platform, found[i].id, &out[i]);
  return count;
}

static int trb_cl_contains(const char *text, const char *part) {     /* whatever the case */
  size_t i, k;
  for (i = 0; text[i]; i++) {
    for (k = 0; part[k] && text[i + k] && (text[i + k] | 32) == (part[k] | 32); k++) {}
    if (!part[k]) return 1;
  }
  return part[0] == 0;
}

/* Which of the devices: of this name, or the first with it in its name; or the first GPU, or the first CPU, or the first. */
static const trb_cl_found *trb_cl_choose(const trb_cl_api *api, const trb_cl_found *found, uint32_t count, const char *name) {
  const trb_cl_found *best = NULL;
  uint32_t i;
  int best_rank = 0;
  for (i = 0; i < count; i++) {
    trbvh_cl_info info;
    int rank = 1;
    trb_cl_describe(api, found[i].platform, found[i].id, &info);
    if (name && !trb_cl_contains(info.name, name) && !trb_cl_contains(info.platform, name)) continue;
    if (name ? !strcmp(name, info.name) : info.is_gpu) rank = 3;
    else if (!name && trb_cl_device_number(api, found[i].id, TRB_CL_DEVICE_TYPE) & TRB_CL_DEVICE_TYPE_CPU) rank = 2;
    if (rank > best_rank) { best = &found[i]; best_rank = rank; }
  }
  return best;
}

/* The context and queue: the user's, kept for as long as the device is open, or new ones. */
static int trb_cl_open_queue(trb_cl *cl, trbvh_stats *stats) {
  int32_t error = 0;
  uint64_t properties = 0;
  trb_cl_found found[TRB_CL_FOUND_MAX];
  const trb_cl_found *chosen;
  const char *name;
  uint32_t count;
  if (cl->desc.queue) {
    trb_cl_context context = NULL;
    trb_cl_platform platform = NULL;
    if (cl->api.GetCommandQueueInfo(cl->desc.queue, TRB_CL_QUEUE_CONTEXT, sizeof context, &context, NULL) ||
        cl->api.GetCommandQueueInfo(cl->desc.queue, TRB_CL_QUEUE_DEVICE, sizeof cl->id, &cl->id, NULL) ||
        cl->api.GetCommandQueueInfo(cl->desc.queue, TRB_CL_QUEUE_PROPERTIES, sizeof properties, &properties, NULL)) {
      trb_cl_say(stats, "%s", "desc->queue is not a command queue", 0, "");
      return 0;
    }
    if (properties & TRB_CL_QUEUE_OUT_OF_ORDER || !trb_cl_usable(&cl->api, cl->id)) {
      trb_cl_say(stats, "%s", properties & TRB_CL_QUEUE_OUT_OF_ORDER ? "desc->queue is out of order" :
                 "the device of desc->queue lacks OpenCL 1.2 or a compiler", 0, "");
      return 0;
    }
    if (cl->api.GetDeviceInfo(cl->id, TRB_CL_DEVICE_PLATFORM, sizeof platform, &platform, NULL)) return 0;
    trb_cl_describe(&cl->api, platform, cl->id, &cl->info);
    if (cl->api.RetainContext(context)) return 0;
    cl->context = context;
    if (cl->api.RetainCommandQueue(cl->desc.queue)) return 0;
    cl->queue = cl->desc.queue;
    return 1;
  }
  name = cl->desc.name ? cl->desc.name : getenv("TRBVH_CL_DEVICE");
  if (name && !name[0]) name = NULL;
  count = trb_cl_find(&cl->api, found, TRB_CL_FOUND_MAX);
  chosen = trb_cl_choose(&cl->api, found, count, name);
  if (!chosen) {
    trb_cl_say(stats, name ? "no OpenCL device is called %.100s" : "%sthere is no usable OpenCL device", name ? name : "", 0, "");
    return 0;
  }
  cl->id = chosen->id;
  trb_cl_describe(&cl->api, chosen->platform, cl->id, &cl->info);
  cl->context = cl->api.CreateContext(NULL, 1, &cl->id, NULL, NULL, &error);
  if (!trb_cl_made(cl, cl->context, error, "clCreateContext")) return 0;
#ifdef TRB_CL_PROFILE
  properties = TRB_CL_QUEUE_PROFILING;
#endif
  cl->queue = cl->api.CreateCommandQueue(cl->context, cl->id, properties, &error);
  return trb_cl_made(cl, cl->queue, error, "clCreateCommandQueue");
}

static trbvh_result trb_cl_build_tree(trbvh_device *device, trb_build *b, trbvh *bvh);
static trbvh_result trb_cl_trace_batch(trbvh_device *device, trb_build *b, const trb_batch *batch);

/* Is the shape for CPUs the right one? Not for Mesa's, which calls itself a CPU, but runs kernels as a GPU's driver does:
 * several work-items in a vector, and no loop of more than 65,535 steps. */
static int trb_cl_is_cpu(const trb_cl *cl) {
  const uint64_t type = trb_cl_device_number(&cl->api, cl->id, TRB_CL_DEVICE_TYPE);
  return type & TRB_CL_DEVICE_TYPE_CPU && !(type & TRB_CL_DEVICE_TYPE_GPU) && !strstr(cl->info.name, "llvmpipe");
}

TRBVH_API trbvh_device *trbvh_cl_open(const trbvh_cl_desc *desc, trbvh_stats *stats) {
  trb_cl_api api;
  trb_cl *cl;
  if (stats) memset(stats, 0, sizeof *stats);
  if (!trb_cl_load(&api, stats)) return NULL;
  cl = (trb_cl *)TRBVH_MALLOC(sizeof *cl);
  if (!cl) { trb_cl_say(stats, "%s", "no memory for the device", 0, ""); return NULL; }
  memset(cl, 0, sizeof *cl);
  cl->hooks.build = trb_cl_build_tree;
  cl->hooks.trace = trb_cl_trace_batch;
  cl->api = api;
  if (desc) cl->desc = *desc;
  if (!trb_cl_open_queue(cl, stats)) {
    if (cl->error) trb_cl_say(stats, "%s", cl->message, 0, "");
    else if (stats && !stats->message[0]) trb_cl_say(stats, "%s", "the device could not be opened", 0, "");
    trbvh_cl_close(&cl->hooks);
    return NULL;
  }
  cl->cpu = TRB_CL_SHAPE ? TRB_CL_SHAPE == 1 : trb_cl_is_cpu(cl);
  cl->pocl = cl->cpu && strstr(cl->info.platform, "Portable Computing Language") != NULL;
  return &cl->hooks;
}

TRBVH_API void trbvh_cl_close(trbvh_device *device) {
  trb_cl *cl = (trb_cl *)device;
  uint32_t i;
  if (!cl) return;
  trbvh_cl_trim(device);
  for (i = 0; i < TRB_CL_KERNEL_COUNT; i++) if (cl->kernels[i]) cl->api.ReleaseKernel(cl->kernels[i]);
  for (i = 0; i < TRB_CL_PROGRAM_COUNT; i++) if (cl->programs[i]) cl->api.ReleaseProgram(cl->programs[i]);
  if (cl->queue) cl->api.ReleaseCommandQueue(cl->queue);
  if (cl->context) cl->api.ReleaseContext(cl->context);
  TRBVH_FREE(cl);
}

TRBVH_API const char *trbvh_cl_name(const trbvh_device *device) {
  return device ? ((const trb_cl *)device)->info.name : "";
}

TRBVH_API const char *trbvh_cl_message(const trbvh_device *device) {
  return device ? ((const trb_cl *)device)->message : "no device";
}

// >>programs ---- compiled when first needed, from the user's cache or from source -----------------------------------
static void trb_cl_cache_key(const trb_cl *cl, const char *options, char key[128]) {
  trb_u64 hash = trb_cl_hash(TRB_CL_HASH_START, options, strlen(options));
  hash = trb_cl_hash(hash, &cl->info, offsetof(trbvh_cl_info, is_gpu));              /* name, platform, driver */
  snprintf(key, 128, "trbvh-%s-%08x%08x", TRB_CL_HASH, (unsigned)(hash >> 32), (unsigned)hash);
}

/* Cached bytes are a hash of what follows, and the program's binary: some drivers do not survive a damaged one. */
static trb_cl_program trb_cl_load_program(trb_cl *cl, const char *key, const char *options) {
  trb_cl_program program = NULL;
  unsigned char *bytes = NULL;
  const unsigned char *binary;
  size_t size = cl->desc.cache_load ? cl->desc.cache_load(cl->desc.user, key, NULL, 0) : 0, binary_size;
  trb_u64 hash;
  int32_t status = 0, error = 0;
  if (size <= sizeof hash || size > 1u << 30) return NULL;
  bytes = (unsigned char *)TRBVH_MALLOC(size);
  if (!bytes) return NULL;
  if (cl->desc.cache_load(cl->desc.user, key, bytes, size) == size) {
    memcpy(&hash, bytes, sizeof hash);
    binary = bytes + sizeof hash;
    binary_size = size - sizeof hash;
    if (hash == trb_cl_hash(TRB_CL_HASH_START, binary, binary_size)) {
      program = cl->api.CreateProgramWithBinary(cl->context, 1, &cl->id, &binary_size, &binary, &status, &error);
      if (program && (error || status || cl->api.BuildProgram(program, 1, &cl->id, options, NULL, NULL))) {
        cl->api.ReleaseProgram(program);
        program = NULL;
      }
    }
  }
  TRBVH_FREE(bytes);
  return program;
}

static void trb_cl_save_program(trb_cl *cl, trb_cl_program program, const char *key) {
  size_t size = 0;
  unsigned char *bytes, *binary;
  trb_u64 hash;
  if (!cl->desc.cache_save ||
      cl->api.GetProgramInfo(program, TRB_CL_PROGRAM_BINARY_SIZES, sizeof size, &size, NULL) || !size) return;
  bytes = (unsigned char *)TRBVH_MALLOC(size + sizeof hash);
  if (!bytes) return;
  binary = bytes + sizeof hash;
  if (!cl->api.GetProgramInfo(program, TRB_CL_PROGRAM_BINARIES, sizeof binary, &binary, NULL)) {
    hash = trb_cl_hash(TRB_CL_HASH_START, binary, size);
    memcpy(bytes, &hash, sizeof hash);
    cl->desc.cache_save(cl->desc.user, key, bytes, size + sizeof hash);
  }
  TRBVH_FREE(bytes);
}

static trb_cl_program trb_cl_compile_program(trb_cl *cl, const char *options, char broken[256]) {
  int32_t error = 0;
  const char **text = (const char **)(uintptr_t)trb_cl_text;         /* OpenCL's declaration lacks a const */
  trb_cl_program program = cl->api.CreateProgramWithSource(cl->context, TRB_CL_LINES, text, NULL, &error);
  if (!trb_cl_made(cl, program, error, "clCreateProgramWithSource")) return NULL;
  error = cl->api.BuildProgram(program, 1, &cl->id, options, NULL, NULL);
  if (error) {
    char log[160] = "";
    size_t used = 0, size = 0;
    char *whole;
    if (!cl->api.GetProgramBuildInfo(program, cl->id, TRB_CL_PROGRAM_BUILD_LOG, 0, NULL, &size) && size &&
        (whole = (char *)TRBVH_MALLOC(size + 1)) != NULL) {
      if (!cl->api.GetProgramBuildInfo(program, cl->id, TRB_CL_PROGRAM_BUILD_LOG, size, whole, &used)) {
        whole[TRB_MIN(used, size)] = 0;
        snprintf(log, sizeof log, "%s", whole);
      }
      TRBVH_FREE(whole);
    }
    cl->error = error;
    snprintf(cl->message, sizeof cl->message, "clBuildProgram failed: error %d: %s", (int)error, log);
    if (error == TRB_CL_BUILD_PROGRAM_FAILURE) memcpy(broken, cl->message, sizeof cl->message);
    cl->api.ReleaseProgram(program);
    return NULL;
  }
  return program;
}

static trb_cl_program trb_cl_program_of(trb_cl *cl, int index) {
  static const char *const parts[] = {
    #define TRB_X(name, options) options,
    TRB_CL_PROGRAMS(TRB_X)
    #undef TRB_X
  };
  char options[256], key[128];
  if (cl->programs[index] || cl->error) return cl->programs[index];
  if (cl->broken[index][0]) {
    cl->error = TRB_CL_BUILD_PROGRAM_FAILURE;
    memcpy(cl->message, cl->broken[index], sizeof cl->message);
    return NULL;
  }
  snprintf(options, sizeof options, "-cl-std=CL1.2 -DTRB_WITH_SHAPE %s %s %s", parts[index],
           cl->cpu ? "-DTRB_CPU" : "-DTRB_GPU", cl->pocl ? "-DTRB_POCL" : "");
  trb_cl_cache_key(cl, options, key);
  cl->programs[index] = trb_cl_load_program(cl, key, options);
  if (!cl->programs[index]) {
    cl->programs[index] = trb_cl_compile_program(cl, options, cl->broken[index]);
    if (cl->programs[index]) trb_cl_save_program(cl, cl->programs[index], key);
  }
  return cl->programs[index];
}

#include <stdarg.h>
/* Runs a kernel in so many work-groups; nothing after an error, nor for none. */
static void trb_cl_launch(trb_cl *cl, int index, size_t groups, ...) {
  static const struct { const char *name, *arguments; int program; } table[] = {
    #define TRB_X(program, name, arguments) {"trb_k_" #name, arguments, TRB_CL_PROGRAM_##program},
    TRB_CL_KERNELS(TRB_X)
    #undef TRB_X
  };
  const char *spec = table[index].arguments;
  size_t local = cl->cpu ? 1 : *spec == '*' ? TRB_GPU_LANES : TRB_GPU_GROUP, global;
  trb_cl_event *wanted = NULL;
#ifdef TRB_CL_PROFILE
  trb_cl_event event = NULL;
#endif
  uint32_t i = 0;
  int32_t error = 0;
  va_list list;
  if (cl->error || groups == 0) return;
  if (!cl->kernels[index]) {
    trb_cl_program program = trb_cl_program_of(cl, table[index].program);
    if (!program) return;
    cl->kernels[index] = cl->api.CreateKernel(program, table[index].name, &error);
    if (!trb_cl_made(cl, cl->kernels[index], error, "clCreateKernel")) return;
  }
  va_start(list, groups);
  for (spec += *spec == '*'; *spec && !error; spec++, i++) {
    if (*spec == 't') {                              /* our own trb_treelets has other lanes, and sums */
      const size_t padding = 16 * sizeof(float), sums = sizeof(((trb_treelets *)0)->sums);
      const size_t lane = (sizeof(trb_treelets) - sums - padding) / TRB_LANES;
      error = cl->api.SetKernelArg(cl->kernels[index], i, lane * TRB_GPU_LANES + padding, NULL);
    } else if (*spec == 'b') {
      trb_cl_mem buffer = va_arg(list, trb_cl_mem);
      error = cl->api.SetKernelArg(cl->kernels[index], i, sizeof buffer, &buffer);
    } else if (*spec == 'u') {
      uint32_t value = va_arg(list, uint32_t);
      error = cl->api.SetKernelArg(cl->kernels[index], i, sizeof value, &value);
    } else {
      uint64_t value = va_arg(list, uint64_t);
      error = cl->api.SetKernelArg(cl->kernels[index], i, sizeof value, &value);
    }
  }
  va_end(list);
  if (!trb_cl_check(cl, error, "clSetKernelArg")) return;
  global = groups * local;
#ifdef TRB_CL_PROFILE
  if (cl->on_launch) wanted = &event;
#endif
  error = cl->api.EnqueueNDRangeKernel(cl->queue, cl->kernels[index], 1, NULL, &global, &local, 0, NULL, wanted);
  trb_cl_check(cl, error, table[index].name);
#ifdef TRB_CL_PROFILE
  if (event) cl->on_launch(cl->on_launch_user, table[index].name, event);
#endif
}

// >>buffers ---------------------------------------------------------------------------------------------------------
static trb_cl_mem trb_cl_buffer(trb_cl *cl, uint64_t flags, size_t size, const void *host) {
  int32_t error = 0;
  trb_cl_mem buffer = NULL;
  if (cl->error) return NULL;
  buffer = cl->api.CreateBuffer(cl->context, flags, TRB_MAX(size, 64u), (void *)(uintptr_t)host, &error);
  if (!buffer && !error) error = TRB_CL_MEM_OBJECT_ALLOCATION_FAILURE;
  if (error && !cl->error) {
    cl->error = error;
    snprintf(cl->message, sizeof cl->message, "clCreateBuffer failed on %.80s for %u MiB: error %d", cl->info.name,
             (unsigned)(size >> 20), (int)error);
  }
  return buffer;
}

static void trb_cl_release(trb_cl *cl, trb_cl_mem *buffer) {
  if (*buffer) cl->api.ReleaseMemObject(*buffer);
  *buffer = NULL;
}

static void trb_cl_drop(trb_cl *cl, trb_cl_part *part) {
  if (part->host) cl->api.Finish(cl->queue);         /* the device may be at work in it */
  trb_cl_release(cl, &part->buffer);
  if (part->host) TRBVH_FREE(part->host);
  memset(part, 0, sizeof *part);
}

TRBVH_API void trbvh_cl_trim(trbvh_device *device) {
  trb_cl *cl = (trb_cl *)device;
  uint32_t i;
  if (!cl) return;
  if (cl->queue) cl->api.Finish(cl->queue);
  for (i = 0; i < TRB_CL_SCRATCH_COUNT; i++) trb_cl_drop(cl, &cl->scratch[i]);
}

/* One part of the scratch memory, of this size or more. On a CPU it comes from where the C code's comes from, for the
 * sake of large pages. */
static trb_cl_mem trb_cl_scratch(trb_cl *cl, int index, size_t size) {
  trb_cl_part *part = &cl->scratch[index];
  if (cl->error || (part->buffer && part->size >= size)) return part->buffer;
  trb_cl_drop(cl, part);
  if (cl->cpu) {
    part->host = TRBVH_MALLOC(size + TRB_LINE);
    if (!part->host) {
      trb_cl_check(cl, TRB_CL_MEM_OBJECT_ALLOCATION_FAILURE, "the allocation of scratch memory");
      return NULL;
    }
    part->buffer = trb_cl_buffer(cl, TRB_CL_MEM_READ_WRITE | TRB_CL_MEM_USE_HOST_PTR, size, trb_align(part->host));
  } else {
    part->buffer = trb_cl_buffer(cl, TRB_CL_MEM_READ_WRITE, size, NULL);
  }
  part->size = size;
  return part->buffer;
}

static void trb_cl_read(trb_cl *cl, trb_cl_mem buffer, void *out, size_t size) {      /* waits */
  if (!cl->error && size)
    trb_cl_check(cl, cl->api.EnqueueReadBuffer(cl->queue, buffer, 1, 0, size, out, 0, NULL, NULL), "clEnqueueReadBuffer");
}

static void trb_cl_write(trb_cl *cl, trb_cl_mem buffer, const void *in, size_t size) { /* waits until in may change */
  if (!cl->error && size)
    trb_cl_check(cl, cl->api.EnqueueWriteBuffer(cl->queue, buffer, 1, 0, size, in, 0, NULL, NULL), "clEnqueueWriteBuffer");
}

static void trb_cl_fill(trb_cl *cl, trb_cl_mem buffer, uint32_t word, size_t size) {
  if (!cl->error && size)
    trb_cl_check(cl, cl->api.EnqueueFillBuffer(cl->queue, buffer, &word, sizeof word, 0, size, 0, NULL, NULL),
                 "clEnqueueFillBuffer");
}

static void trb_cl_flush(trb_cl *cl) { if (!cl->error) trb_cl_check(cl, cl->api.Flush(cl->queue), "clFlush"); }
static void trb_cl_finish(trb_cl *cl) { if (!cl->error) trb_cl_check(cl, cl->api.Finish(cl->queue), "clFinish"); }

/* The event that tells of all that was enqueued so far. */
static void trb_cl_mark(trb_cl *cl, trb_cl_event *done) {
  if (done && !cl->error)
    trb_cl_check(cl, cl->api.EnqueueMarkerWithWaitList(cl->queue, 0, NULL, done), "clEnqueueMarkerWithWaitList");
  trb_cl_flush(cl);
  if (done && cl->error) {
    if (*done) cl->api.ReleaseEvent(*done);
    *done = NULL;
  }
}

/* Memory that host and device share on a CPU, without a copy; elsewhere a buffer of its own. */
static trb_cl_mem trb_cl_share(trb_cl *cl, void *host, size_t size) {
  return cl->cpu && size >= 64 ? trb_cl_buffer(cl, TRB_CL_MEM_READ_WRITE | TRB_CL_MEM_USE_HOST_PTR, size, host)
                               : trb_cl_buffer(cl, TRB_CL_MEM_READ_WRITE, size, NULL);
}

/* Makes what a kernel wrote to such a buffer visible to the host. */
static void trb_cl_fetch(trb_cl *cl, trb_cl_mem buffer, void *host, size_t size) {
  int32_t error = 0;
  void *mapped;
  if (!cl->cpu || size < 64) { trb_cl_read(cl, buffer, host, size); return; }
  if (cl->error) return;
  mapped = cl->api.EnqueueMapBuffer(cl->queue, buffer, 1, TRB_CL_MAP_READ, 0, size, 0, NULL, NULL, &error);
  if (trb_cl_made(cl, mapped, error, "clEnqueueMapBuffer"))
    trb_cl_check(cl, cl->api.EnqueueUnmapMemObject(cl->queue, buffer, mapped, 0, NULL, NULL), "clEnqueueUnmapMemObject");
  trb_cl_finish(cl);
}

/* Input that the device reads. */
static trb_cl_mem trb_cl_input(trb_cl *cl, const void *host, size_t size) {
  const uint64_t how = cl->cpu && size >= 64 ? TRB_CL_MEM_USE_HOST_PTR : TRB_CL_MEM_COPY_HOST_PTR;
  trb_cl_mem buffer = NULL;
  if (size >= 64) return trb_cl_buffer(cl, TRB_CL_MEM_READ_ONLY | how, size, host);
  buffer = trb_cl_buffer(cl, TRB_CL_MEM_READ_ONLY, size, NULL);
  trb_cl_write(cl, buffer, host, size);
  return buffer;
}

// >>stages ---- a build: buffers, and the kernels of every stage in the order of trbvh.h ------------------------------
/* Buffers are shared by what comes one after the other; R is b->ref_max:
 *
 *     nodes  64 R   references before splitting; build nodes
 *     refs   32 R   references, with gaps; or what the leaves hold of a tree that is optimized
 *     keys    8 R   priorities; keys; words for treelets (CPU) and the collapse
 *     sorted  8 R   what splitting found; keys; GPU: what splits wait for; more such words
 *     counts        of tiles; of digits; of waiting splits
 *     GPU: lists 4 R and marks 4 R: waiting splits; nodes by level, where their references begin; places 24 R
 *     CPU: ranges, groups, tasks
 *
 * Each is a buffer of its own: of the 144 bytes and the some 80 of the result, 64 are in the largest, which is little
 * more than the quarter of the memory that CL_DEVICE_MAX_MEM_ALLOC_SIZE is at least. The device keeps them for the next
 * build. */
typedef struct trb_cl_work {
  trb_cl     *cl;
  trb_build  *b;
  trb_plan    plan;                      /* the host's copy */
  trb_cl_mem  positions, indices;        /* boxes stand in positions' place */
  int         owns_mesh;                 /* they are the build's, not the user's */
  void       *packed;                    /* positions with another alignment than the device can read */
  size_t      packed_size;
  trb_cl_mem  state;                     /* the device's plan */
  trb_cl_mem  nodes, refs, keys, sorted, counts, partials, ranges, groups, tasks, lists, marks, places, levels;
  trb_cl_mem  out_nodes, out_prims, out_triangles;
  uint32_t    tiles, blocks, spread;     /* work-groups for ref_max elements: tiles, blocks of C, elements in any order */
  uint32_t    wide;                      /* levels that get a launch each; one work-group takes all others */
} trb_cl_work;

static uint32_t trb_cl_spread(const trb_cl *cl, uint32_t n) {
  return cl->cpu ? trb_blocks(n, TRB_BLOCK) : TRB_MIN(trb_blocks(n, TRB_GPU_GROUP), TRB_CL_GROUPS_MAX);
}

/* The words counts holds: tiles' counts, the sort's, twice those of hierarchy chunks; and of scores. */
static size_t trb_cl_count_words(const trb_cl_work *w) {
  const size_t tiles = w->tiles;
  return w->cl->cpu ? (size_t)trb_blocks(w->b->ref_max, TRB_SORT_BLOCK) * TRB_DIGITS + 2 * tiles
                    : 256 * tiles + 2 * trb_blocks(w->b->ref_max, TRB_GPU_CHUNK) + TRB_SCORES;
}

static void trb_cl_make_buffers(trb_cl_work *w) {
  const size_t n = w->b->ref_max;
  trb_cl *cl = w->cl;
  w->blocks = trb_blocks(w->b->ref_max, TRB_BLOCK);
  w->tiles = trb_blocks(w->b->ref_max, cl->cpu ? TRB_BLOCK : TRB_GPU_TILE);
  w->spread = trb_cl_spread(cl, w->b->ref_max);
  w->wide = w->b->ref_max > 2 * TRB_GPU_GROUP ? TRB_CL_WIDE : 0;
  #define TRB_X(member, bytes) \
    w->member = trb_cl_scratch(cl, TRB_CL_SCRATCH_##member, bytes); \
    w->b->stats.bytes_scratch += bytes;
  TRB_X(nodes,    n * 2 * sizeof(trbvh_node))
  TRB_X(refs,     n * sizeof(trbvh_node))
  TRB_X(keys,     n * 8)
  TRB_X(sorted,   n * 8)
  TRB_X(counts,   trb_cl_count_words(w) * 4)
  TRB_X(tasks,    TRB_TASKS_MAX(n) * sizeof(trb_task))
  TRB_X(groups,   TRB_GROUPS_MAX(n) * sizeof(trb_group))
  TRB_X(partials, (size_t)w->spread * TRB_MAX(sizeof(trb_partial), TRB_CANDIDATES * 8))
  if (cl->cpu) {
    TRB_X(ranges, (size_t)w->blocks * sizeof(trb_range))
  } else {
    TRB_X(lists,  n * 4)
    TRB_X(marks,  n * 4)
    TRB_X(places, n * sizeof(trb_place))
    TRB_X(levels, TRB_GPU_LEVELS * sizeof(trb_level))
  }
  #undef TRB_X
  if (cl->error) trbvh_cl_trim(&cl->hooks);          /* somebody else may need it more */
}

/* May come before the commands that use it are done: OpenCL keeps buffers until then. */
static void trb_cl_free_input(trb_cl_work *w) {
  trb_cl_release(w->cl, &w->state);
  if (w->owns_mesh) {
    trb_cl_release(w->cl, &w->positions);
    trb_cl_release(w->cl, &w->indices);
  }
  trb_free(&w->b->options.allocator, w->packed, w->packed_size);
}

static void trb_cl_free_output(trb_cl_work *w) {
  trb_cl_release(w->cl, &w->out_nodes);
  trb_cl_release(w->cl, &w->out_prims);
  trb_cl_release(w->cl, &w->out_triangles);
}

/* What the kernels need to know; positions' layout on the device is in the plan already. A new buffer each time, as
 * writing to an old one would have to wait for those who use it. */
static void trb_cl_send_plan(trb_cl_work *w) {
  const trb_build *b = w->b;
  trb_plan *p = &w->plan;
  p->costs = b->costs;
  p->form = b->key_form;
  p->cost_node = b->options.cost_node;
  p->cost_prim = b->options.cost_prim;
  p->prim_count = b->input.count;
  p->boxes = b->input.boxes != NULL;
  p->split_max = b->splitting ? b->split_max : 0;
  p->ref_max = b->ref_max;
  p->optimizes = (uint32_t)b->optimizes;
  p->reinsert_share = b->options.reinsert_share;
  p->index_size = b->input.indices ? b->input.index_size : 0;
  p->position_count = b->input.position_count;
  trb_cl_release(w->cl, &w->state);
  w->state = trb_cl_buffer(w->cl, TRB_CL_MEM_READ_WRITE | TRB_CL_MEM_COPY_HOST_PTR, sizeof *p, p);
}

/* ---- References ---- */
static void trb_cl_read_mesh(trb_cl_work *w) {
  trb_cl *cl = w->cl;
  const uint32_t groups = trb_cl_spread(cl, w->b->input.count);
  trb_cl_launch(cl, TRB_CL_BUILD_read, groups, w->state, w->positions, w->indices, w->b->splitting ? w->nodes : w->refs,
                w->partials);
  trb_cl_launch(cl, TRB_CL_BUILD_grid, 1, w->state, w->partials, groups);
}

static void trb_cl_split(trb_cl_work *w) {
  trb_cl *cl = w->cl;
  const uint32_t groups = trb_cl_spread(cl, w->b->input.count);
  const uint32_t tiles = trb_blocks(w->b->input.count, cl->cpu ? TRB_BLOCK : TRB_GPU_TILE);
  uint32_t step;
  trb_cl_launch(cl, TRB_CL_SPLIT_priorities, groups, w->state, w->positions, w->indices, w->nodes, w->keys, w->partials);
  trb_cl_launch(cl, TRB_CL_SPLIT_priority_unit, 1, w->state, w->partials, groups);
  for (step = TRB_CANDIDATES * TRB_CANDIDATES; step; step /= TRB_CANDIDATES) {       /* TRB_SCALES: less than 16^3 */
    trb_cl_launch(cl, TRB_CL_SPLIT_sum_splits, groups, w->state, w->keys, w->partials, step);
    trb_cl_launch(cl, TRB_CL_SPLIT_choose_scale, 1, w->state, w->partials, step, groups);
  }
  trb_cl_launch(cl, TRB_CL_SPLIT_count_slots, tiles, w->state, w->nodes, w->keys, w->counts);
  trb_cl_launch(cl, TRB_CL_BUILD_scan, 1, w->counts, tiles);
  trb_cl_launch(cl, TRB_CL_SPLIT_split, tiles, w->state, w->positions, w->indices, w->nodes, w->keys, w->counts, w->refs,
                w->sorted);
  trb_cl_launch(cl, TRB_CL_SPLIT_sum_refs, 1, w->state, w->sorted, tiles);
}

/* ---- Keys and their sort ---- */
static void trb_cl_sort(trb_cl_work *w, uint32_t shift, uint32_t bits) {
  trb_cl *cl = w->cl;
  const uint32_t end = shift + bits, digit_bits = cl->cpu ? TRB_DIGIT_BITS : 8;
  const uint32_t blocks = cl->cpu ? trb_blocks(w->b->ref_max, TRB_SORT_BLOCK) : w->tiles;
  const uint32_t counters = 256 * blocks, counter_tiles = trb_blocks(counters, TRB_GPU_TILE);
  for (; shift < end; shift += digit_bits) {
    trb_cl_mem swap = w->keys;
    trb_cl_launch(cl, TRB_CL_BUILD_count_digits, blocks, w->state, w->keys, w->counts, shift);
    if (cl->cpu) {
      trb_cl_launch(cl, TRB_CL_BUILD_place_digits, 1, w->counts, blocks);
    } else {
      trb_cl_launch(cl, TRB_CL_BUILD_sum_tiles, counter_tiles, w->counts, w->marks, counters);
      trb_cl_launch(cl, TRB_CL_BUILD_scan, 1, w->marks, counter_tiles);
      trb_cl_launch(cl, TRB_CL_BUILD_scan_tiles, counter_tiles, w->counts, w->marks, counters);
    }
    trb_cl_launch(cl, TRB_CL_BUILD_scatter_keys, blocks, w->state, w->keys, w->counts, w->sorted, shift);
    w->keys = w->sorted;
    w->sorted = swap;
  }
}

/* References may have gaps, keys have none. */
static void trb_cl_make_keys(trb_cl_work *w) {
  trb_cl *cl = w->cl;
  trb_cl_launch(cl, TRB_CL_BUILD_count_refs, w->tiles, w->state, w->refs, w->counts);
  trb_cl_launch(cl, TRB_CL_BUILD_scan, 1, w->counts, w->tiles);
  trb_cl_launch(cl, TRB_CL_BUILD_keys, w->spread, w->state, w->refs, w->keys);
  trb_cl_launch(cl, TRB_CL_BUILD_gap_keys, w->tiles, w->state, w->refs, w->counts, w->keys);
}

static void trb_cl_sort_keys(trb_cl_work *w) {
  const trb_key_form form = w->b->key_form;
  trb_cl_sort(w, form.shift, form.bits);
  if (form.packed) return;
  trb_cl_launch(w->cl, TRB_CL_BUILD_high_keys, w->spread, w->state, w->refs, w->keys);
  trb_cl_sort(w, 32, 32);
}

/* ---- Hierarchy ---- */
static void trb_cl_build_hierarchy(trb_cl_work *w) {
  trb_cl *cl = w->cl;
  uint32_t size = TRB_GPU_CHUNK, chunks = trb_blocks(w->b->ref_max, size);
  trb_cl_mem from = w->lists, to = w->marks, counts = w->counts, next_counts = w->places, swap;
  if (cl->cpu) {
    trb_cl_launch(cl, TRB_CL_BUILD_build_blocks, w->blocks * TRB_JOB_STEP, w->state, w->keys, w->refs, w->nodes, w->ranges);
    trb_cl_launch(cl, TRB_CL_BUILD_build_top, 1, w->state, w->nodes, w->ranges);
    return;
  }
  trb_cl_fill(cl, w->sorted, 0, (size_t)w->b->ref_max * sizeof(trb_wait));
  trb_cl_launch(cl, TRB_CL_BUILD_build_chunks, chunks, w->state, w->keys, w->refs, w->nodes, w->sorted, from, counts);
  while (chunks > 1) {
    chunks = trb_blocks(chunks, TRB_GPU_CHUNKS);
    trb_cl_launch(cl, TRB_CL_BUILD_join_chunks, chunks, w->state, w->keys, w->refs, w->nodes, w->sorted, from, counts, to,
                  next_counts, size);
    size *= TRB_GPU_CHUNKS;
    swap = from; from = to; to = swap;
    swap = counts; counts = next_counts; next_counts = swap;
  }
}

/* ---- Lists by level ---- */
/* Work-groups for one level on a GPU: of n nodes, and no more than two to this power. */
static uint32_t trb_cl_level_groups(uint32_t level, uint32_t n, uint32_t group) {
  n = level < 31 ? TRB_MIN(n, 1u << level) : n;
  return trb_blocks(n, group);
}

/* On a GPU: lists the nodes of gamma references or more by level. */
static void trb_cl_list_levels(trb_cl_work *w, uint32_t gamma) {
  const uint32_t roots = w->b->ref_max / gamma;      /* of one level, at most */
  trb_cl *cl = w->cl;
  uint32_t level;
  trb_cl_launch(cl, TRB_CL_TREELETS_first_level, 1, w->state, w->nodes, w->levels, w->lists, gamma);
  for (level = 0; level < w->wide; level++) {
    uint32_t groups = TRB_MIN(trb_cl_level_groups(level, roots, TRB_GPU_GROUP), TRB_CL_GROUPS_MAX);
    trb_cl_launch(cl, TRB_CL_TREELETS_list_level, groups, w->nodes, w->levels, w->lists, gamma, level);
  }
  trb_cl_launch(cl, TRB_CL_TREELETS_list_levels, 1, w->state, w->nodes, w->levels, w->lists, gamma, w->wide);
}

/* One round on a GPU, over the nodes of gamma to `largest` references. */
static void trb_cl_round(trb_cl_work *w, uint32_t gamma, uint32_t largest) {
  const uint32_t roots = w->b->ref_max / gamma;      /* of one level, at most */
  trb_cl *cl = w->cl;
  uint32_t level, begin;
  trb_cl_list_levels(w, gamma);
  trb_cl_launch(cl, TRB_CL_TREELETS_restructure_levels, 1, w->state, w->nodes, w->levels, w->lists, largest, w->wide);
  for (level = w->wide; level-- > 0;)
    for (begin = 0; begin < roots && (level >= 31 || begin >> level == 0); begin += TRB_ROOTS_MAX) {
      uint32_t groups = trb_cl_level_groups(level, TRB_MIN(roots - begin, TRB_ROOTS_MAX), TRB_GPU_LANES);
      trb_cl_launch(cl, TRB_CL_TREELETS_restructure_level, groups, w->state, w->nodes, w->levels, w->lists, largest, level,
                    begin);
    }
}

/* ---- Moves ---- */
/* What a batch has found, on a GPU: conflicts, moves, and all nodes made anew. In marks are the largest gains. */
static void trb_cl_move_gpu(trb_cl_work *w, uint32_t groups, uint32_t merges) {
  const uint32_t inner = w->b->ref_max / 2;          /* of one level, at most */
  trb_cl *cl = w->cl;
  uint32_t level;
  trb_cl_launch(cl, TRB_CL_MOVES_claim_gains, groups, w->state, w->nodes, w->keys, w->sorted, w->marks);
  trb_cl_launch(cl, TRB_CL_MOVES_claim_pairs, groups, w->state, w->nodes, w->keys, w->sorted, w->marks);
  trb_cl_launch(cl, TRB_CL_MOVES_stand_back, groups, w->state, w->nodes, w->keys, w->sorted);
  if (!merges) trb_cl_launch(cl, TRB_CL_MOVES_follow, groups, w->state, w->nodes, w->keys, w->sorted);
  trb_cl_launch(cl, TRB_CL_MOVES_release, groups, w->state, w->nodes, w->keys, w->sorted, w->marks);
  trb_cl_launch(cl, TRB_CL_MOVES_move, groups, w->state, w->nodes, w->refs, w->keys, w->sorted, merges);
  trb_cl_list_levels(w, 2);
  trb_cl_launch(cl, TRB_CL_MOVES_remake_levels, 1, w->state, w->nodes, w->levels, w->lists, w->wide);
  for (level = w->wide; level-- > 0;)
    trb_cl_launch(cl, TRB_CL_MOVES_remake_level, TRB_MIN(trb_cl_level_groups(level, inner, TRB_GPU_GROUP), TRB_CL_GROUPS_MAX),
                  w->state, w->nodes, w->levels, w->lists, level);
}

static void trb_cl_move(trb_cl_work *w, uint32_t merges) {
  const uint32_t most = TRB_MOVES_MAX(w->b->ref_max);
  if (!w->cl->cpu) trb_cl_move_gpu(w, trb_cl_spread(w->cl, most), merges);
  else trb_cl_launch(w->cl, TRB_CL_MOVES_move, 1, w->state, w->nodes, w->refs, w->keys, w->sorted, merges);
}

/* No pair has an owner. */
static void trb_cl_start_moves(trb_cl_work *w) {
  trb_cl_fill(w->cl, w->sorted, TRBVH_NONE, (size_t)w->b->ref_max * 4);
  if (!w->cl->cpu) trb_cl_fill(w->cl, w->marks, 0, (size_t)w->b->ref_max * 4);
}

/* Work-groups that look at one of `most` moves in `each`. On a CPU they are heavy jobs: enough of them to be dealt out
 * evenly, as there are seldom as many moves as there may be. */
static uint32_t trb_cl_search_groups(const trb_cl_work *w, uint32_t most, uint32_t each) {
  return w->cl->cpu ? TRB_MIN(trb_blocks(most, TRB_SEARCHES), 256u) * TRB_JOB_STEP : trb_cl_spread(w->cl, trb_blocks(most, each));
}

static trbvh_result trb_cl_reinsert(trb_cl_work *w) {
  const uint32_t n = w->b->ref_max, groups = trb_cl_search_groups(w, TRB_MOVES_MAX(n), TRB_MOVE_BATCHES);
  trb_cl *cl = w->cl;
  trb_cl_mem histograms = cl->cpu ? w->ranges : w->counts, tiles = cl->cpu ? w->counts : w->places;
  uint32_t batch;
  if ((uint32_t)(w->b->options.reinsert_share * (float)n) == 0) return TRBVH_OK;
  if (!cl->cpu) trb_cl_fill(cl, histograms, 0, TRB_SCORES * 4);
  trb_cl_launch(cl, TRB_CL_MOVES_score, w->spread, w->state, w->nodes, w->keys, w->sorted, histograms);
  trb_cl_launch(cl, TRB_CL_MOVES_choose_score, 1, w->state, histograms);
  trb_cl_launch(cl, TRB_CL_MOVES_count_candidates, w->tiles, w->state, w->nodes, w->keys, w->sorted, tiles);
  trb_cl_launch(cl, TRB_CL_BUILD_scan, 1, tiles, w->tiles);
  trb_cl_launch(cl, TRB_CL_MOVES_list_candidates, w->tiles, w->state, w->nodes, w->keys, w->sorted, tiles);
  trb_cl_start_moves(w);
  for (batch = 0; batch <= TRB_MOVE_BATCHES; batch++) {
    trb_cl_launch(cl, TRB_CL_MOVES_search, groups, w->state, w->nodes, w->keys, w->sorted, batch);
    trb_cl_move(w, 0);
    if (trb_stage(&w->b->runner, 0)) return TRBVH_CANCELLED;
  }
  return TRBVH_OK;
}

static trbvh_result trb_cl_unsplit(trb_cl_work *w) {
  const uint32_t groups = trb_cl_search_groups(w, TRB_MOVES_MAX(w->b->ref_max), 1);
  trb_cl *cl = w->cl;
  uint32_t pass, batch;
  trb_cl_launch(cl, TRB_CL_MOVES_forget_refs, w->spread, w->state, w->refs);
  trb_cl_launch(cl, TRB_CL_MOVES_find_refs, w->spread, w->state, w->nodes, w->refs, w->keys, w->sorted);
  trb_cl_start_moves(w);
  for (pass = 0; pass < w->b->phase.unsplits; pass++)
    for (batch = 0; batch < TRB_MOVE_BATCHES; batch++) {
      trb_cl_launch(cl, TRB_CL_MOVES_search_merges, groups, w->state, w->nodes, w->refs, w->keys, w->sorted, batch);
      trb_cl_move(w, 1);
      if (trb_stage(&w->b->runner, 0)) return TRBVH_CANCELLED;
    }
  return TRBVH_OK;
}

/* What comes before the rounds of a phase, as in C. */
static trbvh_result trb_cl_make_moves(trb_cl_work *w, uint32_t phase) {
  const uint32_t unsplits = w->b->phase.unsplits;
  trbvh_result result = unsplits ? trb_cl_unsplit(w) : TRBVH_OK;
  return !result && (unsplits || phase) ? trb_cl_reinsert(w) : result;
}

static trbvh_result trb_cl_too_deep(trb_cl_work *w) {
  return trb_fail(w->b, TRBVH_DEVICE_ERROR, "the tree is too deep for this device", 0, 0, 0);
}

/* What trb_sum_costs finds; waits. */
static trbvh_result trb_cl_sum_costs(trb_cl_work *w, double *cost) {
  trb_plan found;
  memset(&found, 0, sizeof found);
  trb_cl_launch(w->cl, TRB_CL_MOVES_sum_costs, w->spread, w->state, w->nodes, w->partials);
  trb_cl_launch(w->cl, TRB_CL_MOVES_add_costs, 1, w->state, w->partials, w->spread);
  trb_cl_read(w->cl, w->state, &found, sizeof found);
  *cost = (double)found.cost;
  return found.too_deep ? trb_cl_too_deep(w) : TRBVH_OK;
}

/* ---- Treelets ---- */
static void trb_cl_find_tasks(trb_cl_work *w) {
  trb_cl_launch(w->cl, TRB_CL_BUILD_find_tasks, 1, w->state, w->nodes, w->keys, w->sorted, w->tasks, w->groups);
}

/* The rounds of a phase, in the order of C: all over the top of the tree, then all over what is below it. */
static trbvh_result trb_cl_restructure(trb_cl_work *w) {
  const uint32_t rounds = w->b->phase.rounds;
  trb_cl *cl = w->cl;
  uint32_t round, gamma;
  if (cl->cpu) {
    trb_cl_launch(cl, TRB_CL_TREELETS_restructure_top, 1, w->state, w->nodes, w->keys, w->sorted, rounds);
    trb_cl_find_tasks(w);
    trb_cl_launch(cl, TRB_CL_TREELETS_restructure_groups, TRB_GROUPS_MAX(w->b->ref_max) * TRB_JOB_STEP, w->state, w->nodes, w->refs,
                  w->keys, w->sorted, w->tasks, w->groups, w->b->phase.gamma, rounds, w->b->phase.last);
    return TRBVH_OK;
  }
  for (round = 0; round < rounds && w->b->ref_max > TRB_TOP; round++) {
    trb_cl_round(w, TRB_TOP + 1, TRBVH_NONE);
    if (trb_stage(&w->b->runner, 0.05f)) return TRBVH_CANCELLED;
  }
  if (w->b->ref_max > TRB_BLOCK) trb_cl_find_tasks(w);         /* for the depth bound above them */
  for (round = 0, gamma = w->b->phase.gamma; round < rounds && gamma <= TRB_MIN(TRB_BLOCK, w->b->ref_max); round++, gamma *= 2) {
    trb_cl_round(w, gamma, TRB_BLOCK);
    if (trb_stage(&w->b->runner, 0.05f)) return TRBVH_CANCELLED;
  }
  return TRBVH_OK;
}

/* ---- Collapse ---- */
static void trb_cl_count_tree(trb_cl_work *w) {
  trb_cl *cl = w->cl;
  const uint32_t inner = w->b->ref_max / 2;          /* of one level, at most */
  uint32_t level;
  if (cl->cpu) {
    if (!w->b->options.treelet_rounds) {
      trb_cl_find_tasks(w);
      trb_cl_launch(cl, TRB_CL_BUILD_settle_groups, TRB_GROUPS_MAX(w->b->ref_max) * TRB_JOB_STEP, w->state, w->nodes, w->refs,
                    w->keys, w->sorted, w->tasks, w->groups);
    }
    trb_cl_launch(cl, TRB_CL_BUILD_sum_tasks, 1, w->state, w->tasks);
    return;
  }
  trb_cl_launch(cl, TRB_CL_BUILD_first_inner, 1, w->state, w->nodes, w->levels, w->lists, w->marks);
  for (level = 0; level < w->wide; level++)
    trb_cl_launch(cl, TRB_CL_BUILD_list_inner, TRB_MIN(trb_cl_level_groups(level, inner, TRB_GPU_GROUP), TRB_CL_GROUPS_MAX),
                  w->state, w->nodes, w->keys, w->sorted, w->levels, w->lists, w->marks, level);
  trb_cl_launch(cl, TRB_CL_BUILD_list_rest, 1, w->state, w->nodes, w->keys, w->sorted, w->levels, w->lists, w->marks,
                w->wide);
  trb_cl_launch(cl, TRB_CL_BUILD_count_rest, 1, w->state, w->nodes, w->refs, w->levels, w->lists, w->places, w->wide);
  for (level = w->wide; level-- > 0;)
    trb_cl_launch(cl, TRB_CL_BUILD_count_inner, TRB_MIN(trb_cl_level_groups(level, inner, TRB_GPU_GROUP), TRB_CL_GROUPS_MAX),
                  w->state, w->nodes, w->refs, w->levels, w->lists, w->places, level);
  trb_cl_launch(cl, TRB_CL_BUILD_sum_inner, 1, w->state, w->nodes, w->refs, w->levels, w->places);
}

/* Into the buffers for the result. */
static void trb_cl_emit_tree(trb_cl_work *w) {
  trb_cl *cl = w->cl;
  uint32_t level;
  if (cl->cpu) {
    trb_cl_launch(cl, TRB_CL_BUILD_emit_top, 1, w->state, w->nodes, w->keys, w->sorted, w->tasks, w->out_nodes, w->out_prims);
    trb_cl_launch(cl, TRB_CL_BUILD_emit_tasks, w->plan.tasks * TRB_JOB_STEP, w->state, w->nodes, w->refs, w->keys, w->sorted, w->tasks,
                  w->out_nodes, w->out_prims);
    return;
  }
  trb_cl_launch(cl, TRB_CL_BUILD_emit_root, 1, w->state, w->nodes, w->refs, w->out_nodes, w->out_prims);
  for (level = 0; level < w->plan.max_depth; level++)
    trb_cl_launch(cl, TRB_CL_BUILD_emit_level,
                  TRB_MIN(trb_cl_level_groups(level, w->b->ref_max / 2, TRB_GPU_GROUP), TRB_CL_GROUPS_MAX),
                  w->state, w->nodes, w->refs, w->levels, w->lists, w->places, w->out_nodes, w->out_prims, level);
}

static void trb_cl_make_triangles(trb_cl_work *w) {
  if (w->out_triangles)
    trb_cl_launch(w->cl, TRB_CL_BUILD_triangles, trb_cl_spread(w->cl, w->plan.prims), w->state, w->positions, w->indices,
                  w->out_prims, w->out_triangles, w->plan.prims);
}

/* ---- All of it ---- */
/* Ends a stage: its time, where somebody wants to know it and so waits; and the progress report. */
static trbvh_result trb_cl_end_stage(trb_cl_work *w, float share, double *ms, double *start) {
  const int waits = w->b->options.stats || w->b->options.progress;
  if (waits) trb_cl_finish(w->cl);
  else trb_cl_flush(w->cl);
  *ms += trb_ms() - *start;
  *start = trb_ms();
  if (w->cl->error) return trb_cl_result(w->cl, &w->b->stats);
  return trb_stage(&w->b->runner, share) ? TRBVH_CANCELLED : TRBVH_OK;
}
#define TRB_CL_STAGE(share, ms, call) \
  if (!result) { \
    call; \
    if (!result) result = trb_cl_end_stage(w, share, &w->b->stats.ms, &start); \
  }

static trbvh_result trb_cl_run_phase(trb_cl_work *w, uint32_t phase) {
  const float share = 0.1f * w->b->effort / (float)trb_phases(w->b);
  trbvh_result result = TRBVH_OK;
  double start = trb_ms();
  trb_start_phase(w->b, phase);
  TRB_CL_STAGE(0, ms_moves, result = trb_cl_make_moves(w, phase))
  if (w->b->phase.rounds) { TRB_CL_STAGE(share, ms_treelets, result = trb_cl_restructure(w)) }
  return result;
}

/* As in C. */
static trbvh_result trb_cl_attempt(void *worker, int splitting, double *cost) {
  trb_cl_work *w = (trb_cl_work *)worker;
  const float effort = w->b->effort;
  trbvh_result result;
  uint32_t phase;
  double start = trb_ms();
  trb_start_attempt(w->b, splitting);
  trb_cl_send_plan(w);
  result = trb_cl_end_stage(w, 0.05f * effort, &w->b->stats.ms_transfer, &start);
  TRB_CL_STAGE(0.05f * effort, ms_morton, trb_cl_read_mesh(w))
  if (splitting) { TRB_CL_STAGE(0.1f, ms_split, trb_cl_split(w)) }
  TRB_CL_STAGE(0.05f * effort, ms_morton, trb_cl_make_keys(w))
  TRB_CL_STAGE(0.1f * effort, ms_sort, trb_cl_sort_keys(w))
  TRB_CL_STAGE(0.1f * effort, ms_hierarchy, trb_cl_build_hierarchy(w))
  for (phase = 0; !result && phase + 1 < trb_phases(w->b); phase++) result = trb_cl_run_phase(w, phase);
  start = trb_ms();
  if (cost) { TRB_CL_STAGE(0, ms_split, result = trb_cl_sum_costs(w, cost)) }
  return result;
}

/* The last phase, and the size of the result: then w->plan has the counts. */
static trbvh_result trb_cl_run_last(trb_cl_work *w) {
  const trb_build *b = w->b;
  const trb_plan *p = &w->plan;
  trbvh_result result = trb_cl_run_phase(w, trb_phases(b) - 1);
  double start = trb_ms();
  TRB_CL_STAGE(0.1f, ms_collapse, (trb_cl_count_tree(w), trb_cl_read(w->cl, w->state, &w->plan, sizeof w->plan)))
  if (result) return result;
  if (p->too_deep) return trb_cl_too_deep(w);
  if (p->skipped > b->input.count || p->prims < b->input.count - p->skipped || p->prims > p->ref_count ||
      p->ref_count > b->ref_max || p->leaves > p->prims || (p->prims == 0) != (p->leaves == 0) ||
      p->max_depth > TRBVH_MAX_DEPTH)
    return trb_fail(w->b, TRBVH_DEVICE_ERROR, "the device miscalculates: %u references, %u leaves, depth %u", p->ref_count,
                    p->leaves, p->max_depth);
  if (p->bad != TRBVH_NONE)
    return trb_fail(w->b, TRBVH_BAD_GEOMETRY, "triangle %u uses vertex %u, but there are %u", p->bad, p->bad_vertex,
                    b->input.position_count);
  w->b->stats.skipped_count = p->skipped;
  w->b->stats.max_depth = p->max_depth;
  w->b->stats.sah_cost = p->root_area > 0 ? (double)p->sah / (double)p->root_area : 0;
  return TRBVH_OK;
}

static trbvh_result trb_cl_run_to_counts(trb_cl_work *w) {
  trbvh_result result;
  trb_cl_make_buffers(w);
  result = trb_attempt_both(w->b, trb_cl_attempt, w);
  return result ? result : trb_cl_run_last(w);
}

static trbvh_result trb_cl_run_to_end(trb_cl_work *w) {
  trbvh_result result = TRBVH_OK;
  double start = trb_ms();
  TRB_CL_STAGE(0.1f, ms_collapse, trb_cl_emit_tree(w))
  TRB_CL_STAGE(0.1f, ms_finish, trb_cl_make_triangles(w))
  return result;
}

// >>host ---- trbvh_build and the batch queries on a device -----------------------------------------------------------
/* The mesh as the device can read it: floats must be aligned there. */
static trbvh_result trb_cl_send_mesh(trb_cl_work *w) {
  const trbvh_geometry *g = &w->b->input;
  const char *data = (const char *)(g->boxes ? g->boxes : g->positions);
  const size_t element = g->boxes ? 24 : 12, stride = g->boxes ? g->box_stride : g->position_stride;
  const size_t count = g->boxes ? g->count : g->indices ? g->position_count : (size_t)g->count * 3;
  size_t i;
  w->owns_mesh = 1;
  w->plan.position_stride = stride;
  if ((uintptr_t)data % 4 || stride % 4) {
    w->packed_size = count * element;
    w->packed = trb_alloc(&w->b->options.allocator, w->packed_size);
    if (!w->packed)
      return trb_fail(w->b, TRBVH_OUT_OF_MEMORY, "no memory to pack the positions: %u MiB", (unsigned)(w->packed_size >> 20), 0, 0);
    for (i = 0; i < count; i++) memcpy((char *)w->packed + i * element, data + i * stride, element);
    data = (const char *)w->packed;
    w->plan.position_stride = element;
  }
  w->positions = trb_cl_input(w->cl, data, (count - 1) * (size_t)w->plan.position_stride + element);
  if (g->indices) {
    const size_t size = (size_t)g->count * 3 * g->index_size;
    if ((uintptr_t)g->indices % g->index_size == 0) {
      w->indices = trb_cl_input(w->cl, g->indices, size);
    } else {
      w->indices = trb_cl_buffer(w->cl, TRB_CL_MEM_READ_ONLY, size, NULL);
      trb_cl_write(w->cl, w->indices, g->indices, size);
    }
  }
  return trb_cl_result(w->cl, &w->b->stats);
}

/* The tree, in the block that trb_make_room has made. */
static trbvh_result trb_cl_write_block(trb_cl_work *w) {
  trbvh *tree = &w->b->tree;
  trb_cl *cl = w->cl;
  trbvh_result result;
  double start;
  const size_t nodes_size = (size_t)tree->node_count * sizeof(trbvh_node), prims_size = (size_t)tree->ref_count * 4;
  const size_t triangles_size = tree->triangles ? (size_t)tree->ref_count * sizeof(trbvh_triangle) : 0;
  void *nodes = (void *)(uintptr_t)tree->nodes, *prims = (void *)(uintptr_t)tree->prims;
  void *triangles = (void *)(uintptr_t)tree->triangles;
  w->out_nodes = trb_cl_share(cl, nodes, nodes_size);
  w->out_prims = trb_cl_share(cl, prims, prims_size);
  if (triangles) w->out_triangles = trb_cl_share(cl, triangles, triangles_size);
  result = trb_cl_run_to_end(w);
  if (result) return result;
  start = trb_ms();
  trb_cl_fetch(cl, w->out_nodes, nodes, nodes_size);
  trb_cl_fetch(cl, w->out_prims, prims, prims_size);
  if (triangles) trb_cl_fetch(cl, w->out_triangles, triangles, triangles_size);
  w->b->stats.ms_transfer += trb_ms() - start;
  return trb_cl_result(cl, &w->b->stats);
}

static trbvh_result trb_cl_build_tree(trbvh_device *device, trb_build *b, trbvh *bvh) {
  trb_cl *cl = (trb_cl *)device;
  trb_cl_work work, *w = &work;
  trbvh_result result;
  double start = trb_ms();
  if (b->input.count < TRB_CL_SMALL && !(b->options.flags & TRBVH_NO_FALLBACK))
    return trb_fail(b, TRBVH_NO_DEVICE, "built in C: %u primitives are too few to be worth a launch", b->input.count, 0, 0);
  memset(w, 0, sizeof *w);
  w->cl = cl;
  w->b = b;
  trb_cl_begin(cl);
  result = trb_cl_send_mesh(w);
  b->stats.ms_transfer += trb_ms() - start;
  if (!result) result = trb_cl_run_to_counts(w);
  if (!result && w->plan.leaves) {
    result = trb_make_room(b, bvh, w->plan.leaves, w->plan.prims);
    if (!result) result = trb_cl_write_block(w);
    if (!result && !(trb_fits_areas(w->plan.root_area) && w->plan.sah < FLT_MAX)) b->stats.sah_cost = trb_exact_sah(b);
  }
  if (result) cl->api.Finish(cl->queue);             /* before memory that it shares goes */
  trb_cl_free_output(w);
  trb_cl_free_input(w);
  return result;
}

/* Rays of one launch: see TRB_ROOTS_MAX. */
#define TRB_CL_RAYS_MAX ((uint64_t)1 << 20)

static void trb_cl_trace(trb_cl *cl, int kernel, const trbvh_cl_tree *tree, trb_cl_mem rays, trb_cl_mem out, uint64_t count) {
  uint64_t begin, end;
  for (begin = 0; begin < count; begin = end) {
    end = TRB_MIN(count, begin + TRB_CL_RAYS_MAX);
    trb_cl_launch(cl, kernel, trb_blocks((uint32_t)(end - begin), cl->cpu ? TRB_CPU_RAYS : TRB_GPU_GROUP), tree->nodes,
                  tree->triangles, rays, out, (uint32_t)(tree->node_count == 0), begin, end);
    trb_cl_flush(cl);
  }
}

static trbvh_result trb_cl_trace_batch(trbvh_device *device, trb_build *b, const trb_batch *batch) {
  trb_cl *cl = (trb_cl *)device;
  const trbvh *bvh = batch->bvh;
  const size_t out_size = batch->count * (batch->hits ? sizeof(trbvh_hit) : 1);
  void *out = batch->hits ? (void *)batch->hits : (void *)batch->occluded;
  trbvh_cl_tree tree;
  trb_cl_mem rays, result;
  if (batch->count < TRB_CL_SMALL && !(b->options.flags & TRBVH_NO_FALLBACK))
    return trb_fail(b, TRBVH_NO_DEVICE, "traced in C: %u rays are too few to be worth a launch", (unsigned)batch->count, 0, 0);
  trb_cl_begin(cl);
  memset(&tree, 0, sizeof tree);
  tree.node_count = bvh->node_count;
  if (tree.node_count) {
    tree.nodes = trb_cl_input(cl, bvh->nodes, (size_t)bvh->node_count * sizeof(trbvh_node));
    tree.triangles = trb_cl_input(cl, bvh->triangles, (size_t)bvh->ref_count * sizeof(trbvh_triangle));
  }
  rays = trb_cl_input(cl, batch->rays, batch->count * sizeof(trbvh_ray));
  result = trb_cl_share(cl, out, out_size);
  trb_stage(&b->runner, 1);
  trb_cl_trace(cl, batch->hits ? TRB_CL_TRACE_intersect : TRB_CL_TRACE_occluded, &tree, rays, result, batch->count);
  trb_cl_fetch(cl, result, out, out_size);
  if (cl->error) cl->api.Finish(cl->queue);
  trb_cl_release(cl, &tree.nodes);
  trb_cl_release(cl, &tree.triangles);
  trb_cl_release(cl, &rays);
  trb_cl_release(cl, &result);
  if (cl->error) return trb_cl_result(cl, &b->stats);
  return trb_stage(&b->runner, 0) ? TRBVH_CANCELLED : TRBVH_OK;
}

// >>resident --------------------------------------------------------------------------------------------------------
static size_t trb_cl_size(trb_cl *cl, trb_cl_mem buffer) {
  size_t size = 0;
  trb_cl_check(cl, cl->api.GetMemObjectInfo(buffer, TRB_CL_MEM_SIZE, sizeof size, &size, NULL), "clGetMemObjectInfo");
  return size;
}

/* Does a buffer hold count elements, from offset on? */
static int trb_cl_holds(trb_cl *cl, trb_cl_mem buffer, size_t offset, size_t count, size_t stride, size_t element) {
  const size_t size = trb_cl_size(cl, buffer);
  return cl->error || (size >= element && offset <= size - element && count - 1 <= (size - element - offset) / stride);
}

/* Fills in what a build needs to know of a mesh in device memory. */
static trbvh_result trb_cl_take_mesh(trb_cl_work *w, const trbvh_cl_geometry *geometry) {
  const trbvh_geometry *g = &w->b->input;
  const size_t vertices = g->indices ? g->position_count : (size_t)g->count * 3;
  if (geometry->position_offset % 4 || g->position_stride % 4)
    return trb_fail(w->b, TRBVH_INVALID_ARGUMENT, "position_offset and position_stride must be multiples of 4", 0, 0, 0);
  if (g->indices && geometry->index_offset % g->index_size)
    return trb_fail(w->b, TRBVH_INVALID_ARGUMENT, "index_offset must be a multiple of index_size", 0, 0, 0);
  if (!trb_cl_holds(w->cl, geometry->positions, geometry->position_offset, vertices, g->position_stride, 12))
    return trb_fail(w->b, TRBVH_INVALID_ARGUMENT, "the buffer of positions is too small", 0, 0, 0);
  if (g->indices && !trb_cl_holds(w->cl, geometry->indices, geometry->index_offset, (size_t)g->count * 3, g->index_size,
                                  g->index_size))
    return trb_fail(w->b, TRBVH_INVALID_ARGUMENT, "the buffer of indices is too small", 0, 0, 0);
  w->positions = geometry->positions;
  w->indices = geometry->indices;
  w->plan.position_offset = geometry->position_offset;
  w->plan.position_stride = g->position_stride;
  w->plan.index_offset = geometry->index_offset;
  return trb_cl_result(w->cl, &w->b->stats);
}

/* The same checks as for a mesh in host memory, whose pointers the buffers stand for. */
static trbvh_result trb_cl_resolve(trb_cl_work *w, trbvh_device *device, const trbvh_cl_geometry *geometry,
                                   const trbvh_options *options) {
  trbvh_geometry g;
  trbvh_result result;
  memset(&g, 0, sizeof g);
  if (geometry) {
    g.positions = geometry->positions;
    g.position_stride = geometry->position_stride;
    g.position_count = geometry->position_count;
    g.indices = geometry->indices;
    g.index_size = geometry->index_size;
    g.count = geometry->count;
  }
  memset(&w->plan, 0, sizeof w->plan);
  result = trb_resolve(w->b, geometry ? &g : NULL, options);
  if (!device) return trb_fail(w->b, TRBVH_NO_DEVICE, "device is NULL", 0, 0, 0);
  trb_cl_begin(w->cl);
  if (!result && g.count) result = trb_cl_take_mesh(w, geometry);
  return result;
}

static void trb_cl_run_resident(trb_cl_work *w, trbvh_cl_tree *tree, trbvh_result *result) {
  trb_cl *cl = w->cl;
  *result = trb_cl_run_to_counts(w);
  if (*result || !w->plan.leaves) return;
  w->out_nodes = trb_cl_buffer(cl, TRB_CL_MEM_READ_WRITE, (size_t)w->plan.leaves * 2 * sizeof(trbvh_node), NULL);
  w->out_prims = trb_cl_buffer(cl, TRB_CL_MEM_READ_WRITE, (size_t)w->plan.prims * 4, NULL);
  if (!(w->b->options.flags & TRBVH_NO_TRIANGLES))
    w->out_triangles = trb_cl_buffer(cl, TRB_CL_MEM_READ_WRITE, (size_t)w->plan.prims * sizeof(trbvh_triangle), NULL);
  *result = trb_cl_run_to_end(w);
  if (*result) return;
  tree->nodes = w->out_nodes;
  tree->prims = w->out_prims;
  tree->triangles = w->out_triangles;
  w->out_nodes = w->out_prims = w->out_triangles = NULL;
  tree->node_count = 2 * w->plan.leaves;
  tree->ref_count = w->plan.prims;
  w->b->stats.node_count = tree->node_count;
  w->b->stats.leaf_count = w->plan.leaves;
  w->b->stats.ref_count = tree->ref_count;
  w->b->stats.bytes_result = (size_t)w->plan.leaves * 2 * sizeof(trbvh_node) +
                             (size_t)w->plan.prims * (4 + (tree->triangles ? sizeof(trbvh_triangle) : 0));
}

/* What trbvh_cl_build and trbvh_cl_optimize end with. */
static trbvh_result trb_cl_report(trb_cl_work *w, trbvh_result result, double start, const trbvh_options *options) {
  w->b->stats.on_device = result == TRBVH_OK;
  result = trb_report(w->b, result, start, options);
  if (result && w->cl) trb_cl_refuse(w->cl, w->b->stats.message);
  return result;
}

TRBVH_API trbvh_result trbvh_cl_build(trbvh_device *device, trbvh_cl_tree *tree, const trbvh_cl_geometry *geometry,
                                      const trbvh_options *options, struct _cl_event **done) {
  trb_build b;
  trb_cl_work work, *w = &work;
  double start = trb_ms();
  trbvh_result result;
  memset(w, 0, sizeof *w);
  w->cl = (trb_cl *)device;
  w->b = &b;
  if (done) *done = NULL;
  result = trb_cl_resolve(w, device, geometry, options);
  if (!tree) result = trb_fail(&b, TRBVH_INVALID_ARGUMENT, "tree is NULL", 0, 0, 0);
  if (tree && device) trbvh_cl_free(device, tree);
  if (!result && b.input.count) {
    trb_runner_start(&b.runner, &b.options, 0);
    trb_cl_run_resident(w, tree, &result);
    trb_runner_stop(&b.runner);
    trb_cl_free_output(w);
    trb_cl_free_input(w);
  }
  if (!result) {
    tree->prim_count = b.input.count;
    trb_cl_mark(w->cl, done);
    result = trb_cl_result(w->cl, &b.stats);
    if (result) trbvh_cl_free(device, tree);
  }
  return trb_cl_report(w, result, start, options);
}

static uint32_t trb_cl_tree_groups(const trbvh_cl_tree *tree, uint32_t level) {
  return TRB_MIN(trb_cl_level_groups(level, tree->node_count / 2, TRB_GPU_GROUP), TRB_CL_GROUPS_MAX);
}

/* Lists the inner nodes of a tree by level. */
static void trb_cl_list_tree(trb_cl_work *w, const trbvh_cl_tree *tree) {
  uint32_t level;
  w->lists = trb_cl_scratch(w->cl, TRB_CL_SCRATCH_lists, (size_t)tree->node_count / 2 * 4);
  w->levels = trb_cl_scratch(w->cl, TRB_CL_SCRATCH_levels, TRB_GPU_LEVELS * sizeof(trb_level));
  trb_cl_launch(w->cl, TRB_CL_REFIT_first_refit, 1, tree->nodes, w->levels, w->lists);
  for (level = 0; level < TRBVH_MAX_DEPTH; level++)
    trb_cl_launch(w->cl, TRB_CL_REFIT_list_refit, trb_cl_tree_groups(tree, level), tree->nodes, w->levels, w->lists, level);
}

TRBVH_API trbvh_result trbvh_cl_refit(trbvh_device *device, trbvh_cl_tree *tree, const trbvh_cl_geometry *geometry,
                                      struct _cl_event **done) {
  trb_build b;
  trb_cl_work work, *w = &work;
  trb_cl *cl = (trb_cl *)device;
  trbvh_result result;
  uint32_t level;
  memset(w, 0, sizeof *w);
  w->cl = cl;
  w->b = &b;
  if (done) *done = NULL;
  result = trb_cl_resolve(w, device, geometry, NULL);
  if (result && cl && !cl->error) trb_cl_refuse(cl, b.stats.message);
  if (result) return result;
  if (!tree || tree->prim_count != b.input.count)
    return trb_cl_refuse(cl, tree ? "the tree has another number of triangles than the geometry" : "tree is NULL");
  if (tree->node_count) {
    trb_cl_send_plan(w);
    if (tree->triangles)
      trb_cl_launch(cl, TRB_CL_REFIT_triangles, trb_cl_spread(cl, tree->ref_count), w->state, w->positions, w->indices,
                    tree->prims, tree->triangles, tree->ref_count);
    trb_cl_launch(cl, TRB_CL_REFIT_refit_leaves, trb_cl_spread(cl, tree->node_count), w->state, w->positions, w->indices,
                  tree->prims, tree->nodes, tree->node_count);
    trb_cl_list_tree(w, tree);
    for (level = TRBVH_MAX_DEPTH; level-- > 0;)
      trb_cl_launch(cl, TRB_CL_REFIT_refit_level, trb_cl_tree_groups(tree, level), tree->nodes, w->levels, w->lists, level);
    trb_cl_free_input(w);
  }
  trb_cl_mark(cl, done);
  return trb_cl_result(cl, NULL);
}

static trbvh_result trb_cl_open_tree(trb_cl_work *w, const trbvh_cl_tree *tree) {
  trbvh_result result = TRBVH_OK;
  uint32_t level = TRBVH_MAX_DEPTH;
  double start = trb_ms();
  trb_start_attempt(w->b, 0);
  w->b->effort = 1;
  w->plan.ref_count = w->plan.slots = w->b->input.count;
  w->plan.bad = TRBVH_NONE;
  trb_cl_send_plan(w);
  trb_cl_launch(w->cl, TRB_CL_REFIT_unsettle, trb_cl_spread(w->cl, tree->node_count), w->state, tree->nodes, w->nodes, w->refs,
                tree->node_count);
  trb_cl_list_tree(w, tree);
  while (level-- > 0)
    trb_cl_launch(w->cl, TRB_CL_REFIT_unsettle_level, trb_cl_tree_groups(tree, level), w->state, w->nodes, w->levels, w->lists,
                  level);
  TRB_CL_STAGE(0.1f, ms_hierarchy, (void)0)
  return result;
}

static trbvh_result trb_cl_run_optimize(trb_cl_work *w, trbvh_cl_tree *tree) {
  trbvh_result result;
  uint32_t phase;
  double start;
  trb_cl_make_buffers(w);
  result = trb_cl_open_tree(w, tree);
  for (phase = 0; !result && phase + 1 < trb_phases(w->b); phase++) result = trb_cl_run_phase(w, phase);
  if (!result) result = trb_cl_run_last(w);
  if (!result && w->plan.leaves != tree->node_count / 2)
    result = trb_fail(w->b, TRBVH_DEVICE_ERROR, "the device miscalculates: %u leaves of %u", w->plan.leaves, tree->node_count / 2, 0);
  if (result) return result;
  w->out_nodes = trb_cl_buffer(w->cl, TRB_CL_MEM_READ_WRITE, (size_t)tree->node_count * sizeof(trbvh_node), NULL);
  start = trb_ms();
  TRB_CL_STAGE(0, ms_collapse, trb_cl_emit_tree(w))
  return result;
}

TRBVH_API trbvh_result trbvh_cl_optimize(trbvh_device *device, trbvh_cl_tree *tree, const trbvh_options *options,
                                         struct _cl_event **done) {
  trb_build b;
  trb_cl_work work, *w = &work;
  double start = trb_ms();
  trbvh_result result;
  memset(w, 0, sizeof *w);
  w->cl = (trb_cl *)device;
  w->b = &b;
  if (done) *done = NULL;
  result = trb_resolve_optimize(&b, tree ? tree->nodes : NULL, tree ? tree->node_count : 0, options);
  if (!device) result = trb_fail(&b, TRBVH_NO_DEVICE, "device is NULL", 0, 0, 0);
  else if (!tree) result = trb_fail(&b, TRBVH_INVALID_ARGUMENT, "tree is NULL", 0, 0, 0);
  if (device) trb_cl_begin(w->cl);
  if (!result && b.input.count) {
    trb_runner_start(&b.runner, &b.options, 0);
    result = trb_cl_run_optimize(w, tree);
    trb_runner_stop(&b.runner);
  }
  if (!result) {
    trb_cl_mark(w->cl, done);
    result = trb_cl_result(w->cl, &b.stats);
  }
  if (!result && w->out_nodes) {
    trb_cl_release(w->cl, &tree->nodes);
    tree->nodes = w->out_nodes;
    w->out_nodes = NULL;
  }
  if (device) {
    trb_cl_free_output(w);
    trb_cl_free_input(w);
  }
  if (!result) {
    b.stats.node_count = tree->node_count;
    b.stats.leaf_count = tree->node_count / 2;
    b.stats.ref_count = tree->ref_count;
  }
  return trb_cl_report(w, result, start, options);
}

static trbvh_result trb_cl_query(trbvh_device *device, int kernel, const trbvh_cl_tree *tree, trb_cl_mem rays, trb_cl_mem out,
                                 size_t count, trb_cl_event *done) {
  trb_cl *cl = (trb_cl *)device;
  if (done) *done = NULL;
  if (!cl) return TRBVH_NO_DEVICE;
  if (!tree || (count && (!rays || !out))) return trb_cl_refuse(cl, "tree, rays or results are NULL");
  if (tree->node_count && !tree->triangles) return trb_cl_refuse(cl, "the tree has no triangles");
  trb_cl_begin(cl);
  trb_cl_trace(cl, kernel, tree, rays, out, count);
  trb_cl_mark(cl, done);
  return trb_cl_result(cl, NULL);
}

TRBVH_API trbvh_result trbvh_cl_intersect(trbvh_device *device, const trbvh_cl_tree *tree, struct _cl_mem *rays,
                                          struct _cl_mem *hits, size_t count, struct _cl_event **done) {
  return trb_cl_query(device, TRB_CL_TRACE_intersect, tree, rays, hits, count, done);
}

TRBVH_API trbvh_result trbvh_cl_occluded(trbvh_device *device, const trbvh_cl_tree *tree, struct _cl_mem *rays,
                                         struct _cl_mem *occluded, size_t count, struct _cl_event **done) {
  return trb_cl_query(device, TRB_CL_TRACE_occluded, tree, rays, occluded, count, done);
}

TRBVH_API trbvh_result trbvh_cl_upload(trbvh_device *device, trbvh_cl_tree *tree, const trbvh *bvh) {
  trb_cl *cl = (trb_cl *)device;
  if (!cl) return TRBVH_NO_DEVICE;
  if (!tree || !bvh) return trb_cl_refuse(cl, "tree or bvh is NULL");
  trbvh_cl_free(device, tree);
  trb_cl_begin(cl);
  if (bvh->node_count) {
    tree->nodes = trb_cl_buffer(cl, TRB_CL_MEM_READ_WRITE, (size_t)bvh->node_count * sizeof(trbvh_node), NULL);
    tree->prims = trb_cl_buffer(cl, TRB_CL_MEM_READ_WRITE, (size_t)bvh->ref_count * 4, NULL);
    trb_cl_write(cl, tree->nodes, bvh->nodes, (size_t)bvh->node_count * sizeof(trbvh_node));
    trb_cl_write(cl, tree->prims, bvh->prims, (size_t)bvh->ref_count * 4);
  }
  if (bvh->triangles) {
    tree->triangles = trb_cl_buffer(cl, TRB_CL_MEM_READ_WRITE, (size_t)bvh->ref_count * sizeof(trbvh_triangle), NULL);
    trb_cl_write(cl, tree->triangles, bvh->triangles, (size_t)bvh->ref_count * sizeof(trbvh_triangle));
  }
  tree->node_count = bvh->node_count;
  tree->ref_count = bvh->ref_count;
  tree->prim_count = bvh->prim_count;
  if (cl->error) trbvh_cl_free(device, tree);
  return trb_cl_result(cl, NULL);
}

TRBVH_API trbvh_result trbvh_cl_download(trbvh_device *device, const trbvh_cl_tree *tree, trbvh *bvh,
                                         const trbvh_options *options) {
  trb_cl *cl = (trb_cl *)device;
  trb_build b;
  trbvh_geometry none;
  trbvh_result result;
  memset(&none, 0, sizeof none);
  result = trb_resolve(&b, &none, options);
  if (!cl) result = trb_fail(&b, TRBVH_NO_DEVICE, "device is NULL", 0, 0, 0);
  else if (!tree || !bvh) result = trb_fail(&b, TRBVH_INVALID_ARGUMENT, "tree or bvh is NULL", 0, 0, 0);
  if (!result) {
    trb_cl_begin(cl);
    if (!tree->triangles) b.options.flags |= TRBVH_NO_TRIANGLES;
    if (tree->node_count) result = trb_make_room(&b, bvh, tree->node_count / 2, tree->ref_count);
    if (!result && tree->node_count) {
      trb_cl_read(cl, tree->nodes, (void *)(uintptr_t)b.tree.nodes, (size_t)tree->node_count * sizeof(trbvh_node));
      trb_cl_read(cl, tree->prims, (void *)(uintptr_t)b.tree.prims, (size_t)tree->ref_count * 4);
      if (tree->triangles)
        trb_cl_read(cl, tree->triangles, (void *)(uintptr_t)b.tree.triangles, (size_t)tree->ref_count * sizeof(trbvh_triangle));
      result = trb_cl_result(cl, &b.stats);
    }
  }
  if (!result) trb_hand_over(&b, bvh, tree->prim_count);
  else if (bvh) trbvh_free(bvh);
  if (result && cl) trb_cl_refuse(cl, b.stats.message);
  if (options && options->stats) *options->stats = b.stats;
  return result;
}

TRBVH_API void trbvh_cl_free(trbvh_device *device, trbvh_cl_tree *tree) {
  trb_cl *cl = (trb_cl *)device;
  if (!cl || !tree) return;
  trb_cl_release(cl, &tree->nodes);
  trb_cl_release(cl, &tree->prims);
  trb_cl_release(cl, &tree->triangles);
  memset(tree, 0, sizeof *tree);
}
#endif /* !TRBVH_NO_OPENCL */
#endif /* TRBVH_IMPLEMENTATION */
