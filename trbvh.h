/* trbvh.h - v0.1.0 - bounding volume hierarchies for ray tracing, as good as offline ones, built in real time
 * MIT or public domain, your choice: see the end of this file.
 *
 * Do this in ONE C or C++ file, and include the header alone wherever else you need it:
 *
 *     #define TRBVH_IMPLEMENTATION
 *     #include "trbvh.h"
 *
 * WHAT IT IS
 *   The builder of Karras and Aila, "Fast Parallel Construction of High-Quality Bounding Volume Hierarchies"
 *   (HPG 2013): a linear BVH along a Morton curve, made nearly as good as the best offline trees by treelet
 *   restructuring, with triangle splitting before it; and the ray queries on the result. C99, also C++11..20,
 *   no dependency, no libm.
 *
 * USAGE
 *     trbvh_geometry mesh = {0};                     // every struct works when zeroed
 *     mesh.positions = vertices;                     // float x, y, z; any stride, any alignment
 *     mesh.position_count = vertex_count;
 *     mesh.indices = indices;                        // or leave NULL for triangle soup
 *     mesh.count = triangle_count;
 *
 *     trbvh bvh = {0};
 *     trbvh_result result = trbvh_build(&bvh, &mesh, NULL);
 *     if (result) puts(trbvh_result_text(result));
 *
 *     trbvh_ray ray = {{0, 0, 5}, 0, {0, 0, -1}, 0};
 *     trbvh_hit hit;
 *     if (trbvh_intersect(&bvh, &ray, &hit)) ...     // hit.prim, hit.t, hit.u, hit.v
 *     trbvh_free(&bvh);
 *
 *   The mesh is not needed after the build, except by trbvh_validate.
 *
 * CHOOSING A PRESET (trbvh_options.quality)
 *   FAST    LBVH and collapse: rebuilt every frame, for some ten thousand rays or less a triangle
 *   MEDIUM  the default: and three rounds of treelet restructuring
 *   HIGH    and triangles split first, 30 % more references: for long, thin or diagonal triangles
 *   BEST    the same as HIGH in this version
 *
 * WHAT IS PROMISED
 *   Same input, same options: the same tree bit for bit, whatever the number of threads, the compiler, the
 *     optimization level, the machine (IEEE floats evaluated as float: not x87, not -ffast-math, with which
 *     trees stay valid).
 *   Closest hits do not depend on the tree: every preset reports the same triangle with the same t, u, v; among
 *     triangles hit at the very same t the lowest index wins.
 *   Rays do not slip between triangles that share an edge. No absolute epsilon anywhere: any unit will do.
 *   A tree is never deeper than TRBVH_MAX_DEPTH, for any input: a traversal stack of that many entries is enough.
 *   NaN and infinite coordinates, no triangles, identical triangles, indices out of range, a failing allocator:
 *     an error code or a valid tree, never a crash, never a leak.
 *
 * WHAT IT DOES NOT
 *   exit, abort, print, read files or the environment, keep globals, or start threads unasked.
 *
 * THREADS
 *   Set options.jobs to your engine's job system, or define TRBVH_THREADS before the implementation and set
 *   options.jobs.width: threads of the library's own then live as long as the call. Queries are const and may run
 *   from any thread at once; one tree must not be built from two threads at once.
 *
 * COMPILE-TIME MACROS, to be defined before the implementation is included
 *   TRBVH_IMPLEMENTATION   in one file: compile the library here
 *   TRBVH_STATIC           all functions static: private to the including file
 *   TRBVH_API              your own linkage or export mark for the public functions
 *   TRBVH_THREADS          allow threads of the library's own (POSIX: link with -pthread; Windows)
 *   TRBVH_MALLOC(size), TRBVH_FREE(pointer)   default allocator, instead of malloc and free
 *   TRBVH_ASSERT(x)        internal checks; off when not defined
 *
 * ERRORS
 *   Functions return a trbvh_result; options.stats->message says in words what was wrong ("triangle 7 uses vertex
 *   99, but there are 50"). Queries check nothing: hand them a tree that trbvh_build made.
 */
#ifndef TRBVH_H
#define TRBVH_H

#define TRBVH_VERSION_MAJOR 0
#define TRBVH_VERSION_MINOR 1
#define TRBVH_VERSION_PATCH 0
#define TRBVH_VERSION (TRBVH_VERSION_MAJOR * 10000 + TRBVH_VERSION_MINOR * 100 + TRBVH_VERSION_PATCH)

// >>types ---- shared by C, C++ and OpenCL C: their layout is part of the contract ----------------------------------
#if defined(__OPENCL_C_VERSION__) || defined(__OPENCL_VERSION__)   /* plain `clang -x cl` defines only the first */
  #define TRBVH_OPENCL_C 1
  typedef uint trbvh_u32;
#else
  #include <stddef.h>
  #include <stdint.h>
  typedef uint32_t trbvh_u32;
#endif
#define TRBVH_NONE      0xFFFFFFFFu
#define TRBVH_MAX_DEPTH 64                /* edges from the root to the deepest leaf, at most */

/* 32 bytes. Root is nodes[0], nodes[1] is padding, siblings are adjacent (first, first + 1) and share a 64-byte line.
 * The layout that tinybvh and the usual tutorials use, so existing traversal code and shaders can read it. */
typedef struct trbvh_node {
  float min[3]; trbvh_u32 first;       /* inner: left child, an even index; leaf: first entry of prims[] and triangles[] */
  float max[3]; trbvh_u32 count;       /* 0 = inner node, else the number of primitives in this leaf */
} trbvh_node;

/* 48 bytes, stored in leaf order: a leaf is one contiguous run. v0, v1 - v0, v2 - v0. */
typedef struct trbvh_triangle {
  float v0[3]; trbvh_u32 prim;
  float e1[3]; trbvh_u32 reserved0;
  float e2[3]; trbvh_u32 reserved1;
} trbvh_triangle;

/* 32 bytes. Hits count where tmin < t <= tmax, t in lengths of dir, which need not be unit. tmax 0 = no limit, a
 * negative tmin counts as 0. A ray with a NaN, or without a direction, hits nothing. */
typedef struct trbvh_ray { float origin[3]; float tmin; float dir[3]; float tmax; } trbvh_ray;

/* 20 bytes. Point hit = (1 - u - v) v0 + u v1 + v v2; u, v >= 0, u + v <= 1 within rounding. On a miss prim is
 * TRBVH_NONE, t the ray's limit (FLT_MAX for none), u = v = 0. instance is TRBVH_NONE outside of instanced scenes. */
typedef struct trbvh_hit { float t, u, v; trbvh_u32 prim; trbvh_u32 instance; } trbvh_hit;

#ifndef TRBVH_OPENCL_C

#ifndef TRBVH_API                       /* TRBVH_STATIC, or your own export macro */
  #ifdef TRBVH_STATIC
    #define TRBVH_API static
  #elif defined(__cplusplus)
    #define TRBVH_API extern "C"
  #else
    #define TRBVH_API extern
  #endif
#endif

// >>results ---- one list makes the enum and the texts --------------------------------------------------------------
#define TRBVH_RESULTS(X) \
  X(OK,                   "success") \
  X(INVALID_ARGUMENT,     "an argument is missing or out of range") \
  X(BAD_GEOMETRY,         "an index is out of range") \
  X(TOO_LARGE,            "more primitives or references than fit") \
  X(OUT_OF_MEMORY,        "host allocation failed") \
  X(OUT_OF_DEVICE_MEMORY, "device allocation failed") \
  X(CANCELLED,            "the progress callback asked to stop") \
  X(NO_DEVICE,            "no usable OpenCL device") \
  X(DEVICE_ERROR,         "an OpenCL call failed") \
  X(BAD_DATA,             "saved data is damaged or from another format version")
typedef enum trbvh_result {
  #define TRBVH_X(name, text) TRBVH_##name,
  TRBVH_RESULTS(TRBVH_X)
  #undef TRBVH_X
  TRBVH_RESULT_COUNT
} trbvh_result;
TRBVH_API const char *trbvh_result_text(trbvh_result result);   /* never NULL, for any value */
TRBVH_API unsigned    trbvh_version(void);                      /* TRBVH_VERSION of the compiled implementation */

// >>input ---- one struct for triangle soup, indexed triangles, or boxes (custom primitives) ------------------------
/* Triangles with a NaN or infinite coordinate, and boxes with one or with min > max, are skipped: they are in no leaf
 * and stats.skipped_count counts them. Degenerate triangles are kept. */
typedef struct trbvh_geometry {
  const void *positions;        /* float x, y, z at the start of each vertex ... */
  size_t      position_stride;  /* ... bytes apart; 0 = 12 */
  uint32_t    position_count;   /* vertices; needed with indices (range check), else 0 = 3 * count */
  const void *indices;          /* 3 a triangle, or NULL for triangle soup */
  uint32_t    index_size;       /* 2 or 4 bytes; 0 = 4 */
  const void *boxes;            /* instead of positions: float min[3], max[3] for each primitive */
  size_t      box_stride;       /* bytes; 0 = 24 */
  uint32_t    count;            /* triangles or boxes; 0 is fine: an empty tree, which every ray misses */
} trbvh_geometry;

// >>options ---- zero = the preset's value, negative = none ---------------------------------------------------------
typedef struct trbvh_device trbvh_device;          /* opaque; NULL = scalar C. trbvh_cl.h opens one */
typedef struct trbvh_allocator {
  void *(*alloc)(void *user, size_t size);         /* any alignment that malloc gives; NULL where there is no memory */
  void  (*free)(void *user, void *ptr, size_t size);
  void  *user;
} trbvh_allocator;
typedef void trbvh_job(void *context, uint32_t index);
typedef struct trbvh_jobs {                        /* an engine's job system */
  /* run job(context, i) once for every i < count, in any order, on any thread; return when all are done */
  void   (*parallel_for)(void *user, uint32_t count, trbvh_job *job, void *context);
  void    *user;
  uint32_t width;                                  /* how many run at once; 0 = 1. With no parallel_for: threads of the library's own, where TRBVH_THREADS is defined */
} trbvh_jobs;
typedef enum trbvh_quality {
  TRBVH_QUALITY_DEFAULT = 0,   /* = MEDIUM */
  TRBVH_QUALITY_FAST,          /* LBVH + collapse: rebuilt every frame */
  TRBVH_QUALITY_MEDIUM,        /* + treelet restructuring */
  TRBVH_QUALITY_HIGH,          /* + triangle splitting, 30 % */
  TRBVH_QUALITY_BEST           /* offline: everything known that makes rays faster */
} trbvh_quality;
enum {
  TRBVH_NO_FALLBACK  = 1,      /* a device that fails is an error, not a scalar build */
  TRBVH_NO_TRIANGLES = 2       /* leave trbvh.triangles out: for your own intersection code */
};
typedef struct trbvh_stats trbvh_stats;
typedef struct trbvh_options {
  uint32_t        flags;                 /* TRBVH_NO_... */
  trbvh_quality   quality;
  float           split_budget;          /* extra references as a share of the triangles: 0.3 = 30 %; at most 16. Ignored for boxes */
  int32_t         treelet_rounds;        /* round r restructures every node of 7 * 2^r references or more */
  uint32_t        max_leaf;              /* primitives in a leaf at most; 0 = 8; above 16 counts as 16 */
  float           cost_node, cost_prim;  /* SAH constants Ci and Ct; 0 = 1.2 and 1.0 (the paper's) */
  trbvh_device   *device;                /* NULL = scalar */
  trbvh_jobs      jobs;
  trbvh_allocator allocator;             /* alloc and free both, or neither: TRBVH_MALLOC and TRBVH_FREE */
  int           (*progress)(void *user, float done);   /* 0..1; non-zero return cancels; called on the calling thread only */
  void           *progress_user;
  trbvh_stats    *stats;                 /* filled when not NULL, on failure too */
} trbvh_options;
struct trbvh_stats {
  double   ms_total, ms_split, ms_morton, ms_sort, ms_hierarchy, ms_treelets, ms_collapse, ms_finish, ms_transfer;
  double   sah_cost;                     /* of the tree, with cost_node and cost_prim */
  uint32_t node_count, leaf_count, ref_count, max_depth, skipped_count;   /* skipped: primitives with NaN or infinite coordinates */
  size_t   bytes_result, bytes_scratch;
  int      on_device;                    /* 0 = the scalar code made this tree */
  char     message[256];                 /* why a device was not used, or what failed */
};

// >>tree ---- plain data in one block, 64-byte aligned; building again into it reuses the block ---------------------
typedef struct trbvh_wide trbvh_wide;
typedef struct trbvh {
  const trbvh_node     *nodes;           /* node_count entries, nodes[1] (zeros) among them; NULL for an empty tree */
  const uint32_t       *prims;           /* leaf order -> primitive; one primitive may stand in several leaves when it was split */
  const trbvh_triangle *triangles;       /* NULL for boxes or TRBVH_NO_TRIANGLES */
  const trbvh_wide     *wide;            /* NULL in this version */
  uint32_t              node_count, ref_count, prim_count, flags;   /* entries of nodes[], of prims[]; geometry->count; options->flags */
  void                 *block; size_t block_size;
  trbvh_allocator       allocator;
} trbvh;
/* bvh is {0} or built before; options may be NULL; on failure bvh is left empty and nothing leaks. Two allocations at
 * most: the scratch memory, freed before it returns, and the tree's block, which a later build reuses where it fits. */
TRBVH_API trbvh_result trbvh_build   (trbvh *bvh, const trbvh_geometry *geometry, const trbvh_options *options);
TRBVH_API void         trbvh_free    (trbvh *bvh);                                           /* {0} is fine, twice is fine */
TRBVH_API size_t       trbvh_bytes_bound(const trbvh_geometry *geometry, const trbvh_options *options, size_t *scratch); /* most that a build will ask for, of the block (returned) and of scratch memory (may be NULL); 0, 0 where the arguments are invalid or too large */
TRBVH_API double       trbvh_sah     (const trbvh *bvh, float cost_node, float cost_prim);   /* paper's equation 1; 0, 0 = 1.2, 1.0 */
/* Structure, containment, every primitive reachable; geometry may be NULL. INVALID_ARGUMENT or BAD_DATA with the
 * reason in why (may be NULL), else OK. Allocates one bit a primitive with malloc when geometry is given. */
TRBVH_API trbvh_result trbvh_validate(const trbvh *bvh, const trbvh_geometry *geometry, char *why, size_t why_size);

// >>queries ---- const, no allocation, from any thread at once ------------------------------------------------------
/* Both miss on a tree without triangles (boxes, TRBVH_NO_TRIANGLES): walk nodes[] yourself there. */
TRBVH_API int trbvh_intersect(const trbvh *bvh, const trbvh_ray *ray, trbvh_hit *hit);      /* closest hit; 1 = hit */
TRBVH_API int trbvh_occluded (const trbvh *bvh, const trbvh_ray *ray);                      /* any hit; 1 = occluded */
TRBVH_API trbvh_result trbvh_intersect_n(const trbvh *bvh, const trbvh_ray *rays, trbvh_hit *hits, size_t count, const trbvh_options *options);  /* on options->device or options->jobs */
TRBVH_API trbvh_result trbvh_occluded_n (const trbvh *bvh, const trbvh_ray *rays, uint8_t *occluded, size_t count, const trbvh_options *options);

#endif /* !TRBVH_OPENCL_C */
#endif /* TRBVH_H */
