/* trbvh.h - v0.1.0 - bounding volume hierarchies for ray tracing, nearly as good as offline ones, in real time
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
 *   FAST    LBVH and collapse: for trees that see fewer than some three rays a triangle, then are rebuilt
 *   MEDIUM  the default: and three rounds of treelet restructuring, between them the nodes that seem worst placed,
 *           4 % of all, move to better places
 *   HIGH    and triangles split first, 20 % more references at most. Splits that do not pay are taken back, and where they
 *           hardly pay altogether, MEDIUM's tree is made: rays are never slower
 *   BEST    the same with more of everything: five rounds, 8 % of the nodes, 50 % of splits at most; for trees made once
 *   The paper's own settings: FAST with treelet_rounds 3 and, with splits, split_budget 0.3.
 *   A tree that exists, made by a faster preset or refitted, gets better with trbvh_optimize.
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
 * OPENCL
 *   trbvh_cl.h builds and traces on a GPU, or on any other OpenCL device: the same tree.
 *
 * THREADS
 *   Set options.jobs to your engine's job system, or define TRBVH_THREADS before the implementation and set
 *   options.jobs.width: threads of the library's own then live as long as the call. Queries are const and may run
 *   from any thread at once; one tree must not be built from two threads at once.
 *
 * MEMORY
 *   A build takes 81 bytes a triangle of scratch memory (136 with HIGH's splits, 170 with BEST's). The tree takes some 36, at
 *   most 68, and 48 for its triangles. Who rebuilds often keeps the scratch memory (options.scratch, trbvh_bytes_bound)
 *   and builds into the same tree: then nothing is allocated, and no fresh page touched.
 *
 * COMPILE-TIME MACROS, to be defined before the implementation is included
 *   TRBVH_IMPLEMENTATION   in one file: compile the library here
 *   TRBVH_STATIC           all functions static: private to the including file
 *   TRBVH_API              your own linkage or export mark for the public functions
 *   TRBVH_THREADS          allow threads of the library's own (POSIX: link with -pthread; Windows)
 *   TRBVH_MALLOC(size), TRBVH_FREE(pointer)   default allocator, instead of malloc and free
 *   TRBVH_NO_SIMD          plain C only. Else vector code is chosen at run time on x86-64 (SSE, AVX2, AVX-512: no compiler
 *                          flags needed), and at compile time for NEON and WebAssembly; the tree is the same
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

/* 48 bytes, stored in leaf order: a leaf is one contiguous run. v0, v1 - v0, v2 - v0. reserved0: 1 where v0 + e1 or
 * v0 + e2 does not round to the mesh's v1 or v2, else 0; reserved1: 0. */
typedef struct trbvh_triangle {
  float v0[3]; trbvh_u32 prim;
  float e1[3]; trbvh_u32 reserved0;
  float e2[3]; trbvh_u32 reserved1;
} trbvh_triangle;

/* 32 bytes. Hits count where tmin < t <= tmax, t in lengths of dir, which need not be unit. tmax 0 = no limit, a
 * negative tmin counts as 0. A ray with a NaN or infinity, or without a direction, hits nothing. */
typedef struct trbvh_ray { float origin[3]; float tmin; float dir[3]; float tmax; } trbvh_ray;

/* 20 bytes. Point hit = (1 - u - v) v0 + u v1 + v v2; u, v >= 0, u + v <= 1 within rounding. On a miss prim is
 * TRBVH_NONE, t the ray's limit (FLT_MAX for none), u = v = 0. instance is TRBVH_NONE outside of instanced scenes. */
typedef struct trbvh_hit { float t, u, v; trbvh_u32 prim; trbvh_u32 instance; } trbvh_hit;

#ifndef TRBVH_OPENCL_C

#ifndef TRBVH_API                       /* TRBVH_STATIC, or your own export macro */
  #if defined(TRBVH_STATIC) && defined(__GNUC__)
    #define TRBVH_API static __attribute__((unused))
  #elif defined(TRBVH_STATIC)
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
  TRBVH_QUALITY_MEDIUM,        /* + treelet restructuring and reinsertion */
  TRBVH_QUALITY_HIGH,          /* + triangle splitting, 20 % */
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
  int32_t         treelet_rounds;        /* of restructuring, below */
  uint32_t        max_leaf;              /* primitives in a leaf at most; 0 = 8; above 16 counts as 16 */
  float           cost_node, cost_prim;  /* SAH constants Ci and Ct; 0 = 1.2 and 1.0 (the paper's) */
  trbvh_device   *device;                /* NULL = scalar */
  trbvh_jobs      jobs;
  trbvh_allocator allocator;             /* alloc and free both, or neither: TRBVH_MALLOC and TRBVH_FREE */
  int           (*progress)(void *user, float done);   /* 0..1; non-zero return cancels; called on the calling thread only */
  void           *progress_user;
  trbvh_stats    *stats;                 /* filled when not NULL, on failure too */
  void           *scratch;               /* memory of yours for one build at a time, so that none is allocated; NULL = allocate it */
  size_t          scratch_size;          /* bytes: what trbvh_bytes_bound says, or more */
  int32_t         treelet_gamma;         /* references in the smallest subtrees restructured; 0 = 7, the least */
  float           reinsert_share;        /* of references, candidates for a better place, before each round but the first;
                                            at most 0.25. Rounds then go from large subtrees to small ones: those of
                                            gamma * 4^(rounds - 1 - r) references or more in round r; none (negative):
                                            gamma * 2^r, which is the paper's */
  int32_t         unsplit_passes;        /* over all splits before each round, to take back those that do not pay; at most 16.
                                            With reinsertion there are no splits at all where they hardly pay altogether */
} trbvh_options;
struct trbvh_stats {
  double   ms_total, ms_split, ms_morton, ms_sort, ms_hierarchy, ms_treelets, ms_collapse, ms_finish, ms_transfer;   /* with treelets, leaves are chosen in ms_treelets */
  double   sah_cost;                     /* of the tree, with cost_node and cost_prim */
  uint32_t node_count, leaf_count, ref_count, max_depth, skipped_count;   /* skipped: primitives with NaN or infinite coordinates */
  size_t   bytes_result, bytes_scratch;
  int      on_device;                    /* 0 = the scalar code made this tree */
  char     message[256];                 /* why a device was not used, or what failed */
  double   ms_moves;                     /* reinsertion, between the rounds of ms_treelets */
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
 * most: the scratch memory, freed before it returns, and the tree's block, which a later build reuses where it fits;
 * with options.scratch, a build into such a tree allocates nothing. */
TRBVH_API trbvh_result trbvh_build   (trbvh *bvh, const trbvh_geometry *geometry, const trbvh_options *options);
/* Restructures a tree that exists, from a faster preset, say, or refitted, or from elsewhere: the rounds, and with them
 * the moves, of a preset without splits. Only nodes[] changes, in place: leaves keep their boxes and their parts of
 * prims[] and triangles[]. Of options: quality, treelet_rounds, treelet_gamma, reinsert_share; jobs, allocator and
 * scratch (what a build with as many leaves asks for, or some more: 97 bytes a leaf), progress, stats; the costs for
 * stats->sah_cost. On failure the tree is as it was; BAD_DATA where nodes[] is not a tree. */
TRBVH_API trbvh_result trbvh_optimize(trbvh *bvh, const trbvh_options *options);
TRBVH_API void         trbvh_free    (trbvh *bvh);                                           /* {0} is fine, twice is fine */
TRBVH_API size_t       trbvh_bytes_bound(const trbvh_geometry *geometry, const trbvh_options *options, size_t *scratch); /* most that a build will ask for, of the block (returned) and of scratch memory (may be NULL); 0, 0 where the arguments are invalid or too large */
TRBVH_API double       trbvh_sah     (const trbvh *bvh, float cost_node, float cost_prim);   /* paper's equation 1; 0, 0 = 1.2, 1.0 */
/* Structure, containment, every primitive reachable; geometry may be NULL. INVALID_ARGUMENT or BAD_DATA with the
 * reason in why (may be NULL), else OK. Allocates some bits a primitive with TRBVH_MALLOC; OUT_OF_MEMORY without. */
TRBVH_API trbvh_result trbvh_validate(const trbvh *bvh, const trbvh_geometry *geometry, char *why, size_t why_size);

// >>queries ---- const, no allocation, from any thread at once ------------------------------------------------------
/* Both miss on a tree without triangles (boxes, TRBVH_NO_TRIANGLES): walk nodes[] yourself there. */
TRBVH_API int trbvh_intersect(const trbvh *bvh, const trbvh_ray *ray, trbvh_hit *hit);      /* closest hit; 1 = hit */
TRBVH_API int trbvh_occluded (const trbvh *bvh, const trbvh_ray *ray);                      /* any hit; 1 = occluded */
/* Many rays at once, on options->device or options->jobs, with progress; options may be NULL. INVALID_ARGUMENT on a
 * tree without triangles that is not empty. Of options->stats, ms_total, on_device and message are filled. */
TRBVH_API trbvh_result trbvh_intersect_n(const trbvh *bvh, const trbvh_ray *rays, trbvh_hit *hits, size_t count, const trbvh_options *options);
TRBVH_API trbvh_result trbvh_occluded_n (const trbvh *bvh, const trbvh_ray *rays, uint8_t *occluded, size_t count, const trbvh_options *options);

#endif /* !TRBVH_OPENCL_C */
#endif /* TRBVH_H */

// ===================================================================================================================
//   IMPLEMENTATION: first the algorithm, in the paper's order, then the stages of a build and the queries, in C
// ===================================================================================================================
#if (defined(TRBVH_IMPLEMENTATION) || defined(TRBVH_OPENCL_C)) && !defined(TRBVH_IMPLEMENTED)
#define TRBVH_IMPLEMENTED

// >>config ---- what differs between the languages and compilers ----------------------------------------------------
/* Fused multiply-adds round once where C rounds twice: they change costs, and with them trees. Compilers fuse by
 * default where the machine can, so this is switched off for our own code, whatever the flags; in Visual C++, which
 * cannot restore it, to the end of the file. Not to be repaired from here: -ffast-math, clang's -ffp-contract=fast. */
#if defined(TRBVH_OPENCL_C)
  #pragma OPENCL FP_CONTRACT OFF
#elif defined(__clang__)
  #pragma STDC FP_CONTRACT OFF
#elif defined(__GNUC__)
  #pragma GCC push_options
  #pragma GCC optimize("fp-contract=off")
#elif defined(_MSC_VER)
  #pragma fp_contract(off)
#endif

#ifdef TRBVH_OPENCL_C
  #ifdef TRB_OUTLINE                     /* for oclgrind, which does not know what inlining leaves behind */
    #define TRB_CORE static inline __attribute__((unused))
  #else                                  /* rusticl miscompiles the collapse without */
    #define TRB_CORE static inline __attribute__((always_inline, unused))
  #endif
  #ifdef TRB_POCL                        /* a CPU, and clang for certain */
    #define TRB_PREFETCH(address) __builtin_prefetch((const void *)(size_t)(address))
  #endif
  #define TRB_SHARED static __attribute__((unused))
  #define TRB_GLOBAL __global
  typedef ulong trb_u64;
  #ifdef TRB_GPU                         /* where a treelet's working memory lies */
    #define TRB_WORK __local
  #else
    #define TRB_WORK
  #endif
  #define trb_bits(x)  as_uint(x)
  #define trb_float(x) as_float(x)
#else
  #include <float.h>
  #include <stdio.h>            /* snprintf, for messages */
  #include <stdlib.h>
  #include <string.h>
  #if defined(__GNUC__)
    #define TRB_CORE static inline __attribute__((always_inline))
  #elif defined(_MSC_VER)
    #define TRB_CORE static __forceinline
  #else
    #define TRB_CORE static inline
  #endif
  #define TRB_SHARED static
  #define TRB_GLOBAL
  #define TRB_WORK
  #if defined(__GNUC__)
    #define TRB_PREFETCH(address) __builtin_prefetch(address)
  #endif
  typedef uint64_t trb_u64;
  TRB_CORE trbvh_u32 trb_bits(float x) { trbvh_u32 u; memcpy(&u, &x, 4); return u; }
  TRB_CORE float trb_float(trbvh_u32 u) { float x; memcpy(&x, &u, 4); return x; }
#endif
#ifndef TRB_PREFETCH
  #define TRB_PREFETCH(address) ((void)(address))
#endif

/* Vector units. On x86-64 what the machine has is found out at run time, and functions are compiled for it. */
#if !defined(TRBVH_OPENCL_C) && !defined(TRBVH_NO_SIMD) && !defined(__TINYC__)
  #if (defined(__x86_64__) && defined(__GNUC__)) || (defined(_M_X64) && defined(_MSC_VER))
    #define TRB_X86
    #if defined(_MSC_VER)
      #include <intrin.h>
    #elif defined(__clang__)
      #include <immintrin.h>
    #else                                /* gcc 12 warns of its own header */
      #pragma GCC diagnostic push
      #pragma GCC diagnostic ignored "-Wuninitialized"
      #pragma GCC diagnostic ignored "-Wmaybe-uninitialized"
      #include <immintrin.h>
      #pragma GCC diagnostic pop
    #endif
    #if defined(_MSC_VER) && defined(__clang__)
                                         /* its headers hide longer vectors than the whole file is compiled for */
    #elif defined(__MINGW32__) && !defined(__clang__)
                                         /* gcc may place longer vectors on a stack that is not aligned for them */
    #else
      #define TRB_AVX
    #endif
    #ifdef __GNUC__
      #define TRB_TARGET(features) __attribute__((target(features)))
    #else                                /* Visual C++ compiles any instruction anywhere */
      #define TRB_TARGET(features)
    #endif

/* Bits in a vector: 128, 256 with AVX2, 512 with AVX-512F. */
static int trb_simd(void) {
    #if !defined(TRB_AVX)
  return 128;
    #elif defined(__GNUC__)
  __builtin_cpu_init();
  return __builtin_cpu_supports("avx512f") ? 512 : __builtin_cpu_supports("avx2") ? 256 : 128;
    #else                                /* Visual C++: what the processor has and the system saves */
  int info[4], avx2, avx512;
  __cpuid(info, 0);
  if (info[0] < 7) return 128;
  __cpuidex(info, 7, 0);
  avx2 = info[1] >> 5 & 1;
  avx512 = info[1] >> 16 & 1;
  __cpuid(info, 1);
  if (!(info[2] >> 27 & 1) || (_xgetbv(0) & 6) != 6) return 128;
  return avx512 && (_xgetbv(0) & 0xE6) == 0xE6 ? 512 : avx2 ? 256 : 128;
    #endif
}
  #elif defined(__ARM_NEON) && (defined(__aarch64__) || defined(_M_ARM64))
    #include <arm_neon.h>
    #define TRB_VECTOR4 float32x4_t
  #elif defined(__wasm_simd128__)
    #include <wasm_simd128.h>
    #define TRB_VECTOR4 v128_t
  #endif
#endif
#ifndef TRBVH_ASSERT
  #define TRBVH_ASSERT(x) ((void)0)
#endif
#ifndef TRB_REAL                         /* what triangle tests and sums of areas compute in */
  #ifdef TRBVH_OPENCL_C
    #define TRB_REAL float
    #define TRB_NOISE 9.5367432e-7f      /* 16 units of its rounding */
  #else
    #define TRB_REAL double
    #define TRB_NOISE 1.7763568e-15
  #endif
#endif
#if defined(__GNUC__) || defined(TRBVH_OPENCL_C)
  #define TRB_ALIGNED(type) type __attribute__((aligned(64)))
#elif defined(_MSC_VER)
  #define TRB_ALIGNED(type) __declspec(align(64)) type
#else
  #define TRB_ALIGNED(type) type
#endif
#if defined(__cplusplus) || defined(_MSC_VER)
  #define TRB_RESTRICT __restrict
#else
  #define TRB_RESTRICT restrict
#endif

// ===================================================================================================================
//   THE ALGORITHM, valid C99, C++ and OpenCL C 1.2, in the paper's order: all that decides a tree, and what a ray meets
// ===================================================================================================================
/* The OpenCL backend compiles this very text, so that both make the same tree bit for bit. Hence its rules: float,
 * int, uint; no libm, no division and no square root in what decides topology, min and max by comparison, ties
 * broken by structure. Big arrays are TRB_GLOBAL, small ones local; no recursion, no function pointers. */

// >>core ---- arithmetic, boxes and costs, Morton codes, the treelets' dynamic program, splitting --------------------

#define TRB_MIN(a, b) ((a) < (b) ? (a) : (b))     /* the second where one is NaN */
#define TRB_MAX(a, b) ((a) > (b) ? (a) : (b))

/* -0 becomes 0: boxes made of such numbers have the same bits in whatever order they are joined. */
#ifdef TRBVH_OPENCL_C                    /* whose compilers may take x + 0 for x: rusticl's does */
TRB_CORE float trb_no_sign(float x) { return trb_bits(x) == 0x80000000u ? 0.0f : x; }
#else
TRB_CORE float trb_no_sign(float x) { return x + 0.0f; }
#endif

TRB_CORE float trb_abs(float x) { return x < 0 ? -x : x; }
TRB_CORE int   trb_finite(float x) { return (trb_bits(x) & 0x7F800000u) != 0x7F800000u; }

TRB_CORE trbvh_u32 trb_log2(trbvh_u32 x) {        /* floor; x > 0 */
  trbvh_u32 n = 0;
  if (x >> 16) { n += 16; x >>= 16; }
  if (x >> 8)  { n += 8;  x >>= 8; }
  if (x >> 4)  { n += 4;  x >>= 4; }
  if (x >> 2)  { n += 2;  x >>= 2; }
  return n + (x >> 1);
}

/* 1 / x for normal x > 0, within 2 units in the last place: Newton's steps from a linear guess on the bits. */
TRB_CORE float trb_reciprocal(float x) {
  float r = trb_float(0x7EF311C3u - trb_bits(x));
  r = r * (2.0f - x * r);
  r = r * (2.0f - x * r);
  r = r * (2.0f - x * r);
  return r;
}

/* Cube root of x >= 0, within a few units in the last place: x r^2 with r = x^(-1/3) by Newton's steps. */
TRB_CORE float trb_cube_root(float x) {
  float r;
  int i;
  if (!(x > 1e-30f)) return 0;                       /* as good as 0; the bits of smaller ones tell nothing */
  r = trb_float(0x54A21D2Au - trb_bits(x) / 3);
  for (i = 0; i < 4; i++) r = r * (4.0f - x * r * r * r) * 0.333333343f;
  return x * r * r;
}

// ---- Boxes and costs ----
/* A build node is a trbvh_node: box, `first` the left child's index (a reference's primitive, where the count is 1),
 * and in `count` a word that holds the number of references and, for subtrees small enough to become a leaf, the
 * cost of the better of both forms (paper, equation 2), in units of Ci, as a float short of its five lowest bits:
 *
 *     larger than max_leaf:  0 | count, 31 bits
 *     small:                 1 | leaf is better | count - 1, 4 bits | cost, 26 bits
 *
 * Larger subtrees need no cost: it adds the same constant to every topology above them. */
#define TRB_MAX_LEAF 16u
#define TRB_SMALL    0x80000000u
#define TRB_LEAF     0x40000000u

/* What the surface area heuristic needs: Ct / Ci and the largest leaf. */
typedef struct trb_costs { float ratio; trbvh_u32 max_leaf; } trb_costs;

TRB_CORE trbvh_u32 trb_count(trbvh_u32 word)   { return word & TRB_SMALL ? ((word >> 26) & 15u) + 1 : word; }
TRB_CORE float     trb_cost(trbvh_u32 word)    { return trb_float((word & 0x3FFFFFFu) << 5 & (0u - (word >> 31))); }
TRB_CORE int       trb_is_single(trbvh_u32 word) { return (word & (TRB_SMALL | 15u << 26)) == TRB_SMALL; }   /* one reference */
TRB_CORE int       trb_is_leaf(trbvh_u32 word) { return (word & (TRB_SMALL | TRB_LEAF)) == (TRB_SMALL | TRB_LEAF); }

/* Half the surface area. Where it overflows, FLT_MAX: trees stay valid there, no more. */
TRB_CORE float trb_area(trbvh_node n) {
  float x = n.max[0] - n.min[0], y = n.max[1] - n.min[1], z = n.max[2] - n.min[2];
  float area = x * y + z * (x + y);
  return TRB_MIN(area, FLT_MAX);
}

TRB_CORE trbvh_u32 trb_small(trbvh_u32 count, float cost, int leaf) {
  return TRB_SMALL | (leaf ? TRB_LEAF : 0) | (count - 1) << 26 | (trb_bits(cost) & 0x7FFFFFFFu) >> 5;
}

/* The node of a single reference. */
TRB_CORE trbvh_node trb_reference(trbvh_node box, trb_costs costs) {
  box.count = trb_small(1, costs.ratio * trb_area(box), 1);
  return box;
}

/* The parent of l and r, which stand at first and first + 1: the paper's equation 2. */
TRB_CORE trbvh_node trb_parent(trbvh_node l, trbvh_node r, trbvh_u32 first, trb_costs costs) {
  trbvh_node n;
  trbvh_u32 count = trb_count(l.count) + trb_count(r.count);
  n.min[0] = TRB_MIN(l.min[0], r.min[0]); n.max[0] = TRB_MAX(l.max[0], r.max[0]);
  n.min[1] = TRB_MIN(l.min[1], r.min[1]); n.max[1] = TRB_MAX(l.max[1], r.max[1]);
  n.min[2] = TRB_MIN(l.min[2], r.min[2]); n.max[2] = TRB_MAX(l.max[2], r.max[2]);
  n.first = first;
  n.count = count;
  if (count <= costs.max_leaf) {
    float area = trb_area(n), split = area + (trb_cost(l.count) + trb_cost(r.count));
    float leaf = costs.ratio * area * (float)count;
    n.count = trb_small(count, TRB_MIN(leaf, split), leaf <= split);
  }
  return n;
}

// ---- Morton codes ----
/* A cubic grid of 2^21 cells a side over the scene: cubic, because cells as flat as the scene make flat nodes. */
#define TRB_GRID_BITS 21
typedef struct trb_grid { float origin[3]; float cells_per_unit, units_per_cell; } trb_grid;

TRB_CORE trbvh_u32 trb_cell(float x, float origin, float cells_per_unit) {
  const float last = 2097151.0f;
  float cell = (x - origin) * cells_per_unit;
  cell = TRB_MIN(cell, last);                        /* NaN, where extents overflow, too */
  return (trbvh_u32)(int)TRB_MAX(cell, 0.0f);        /* vector units turn floats into signed integers only */
}

TRB_CORE trb_u64 trb_spread(trbvh_u32 cell) {        /* 21 bits to every third */
  trb_u64 x = cell;                                  /* ............................fedcba */
  x = (x | x << 32) & 0x001F00000000FFFFu;
  x = (x | x << 16) & 0x001F0000FF0000FFu;
  x = (x | x << 8)  & 0x100F00F00F00F00Fu;
  x = (x | x << 4)  & 0x10C30C30C30C30C3u;
  return (x | x << 2) & 0x1249249249249249u;         /* ............f..e..d..c..b..a */
}

/* 63 bits: the Morton code of a point. */
TRB_CORE trb_u64 trb_morton(float x, float y, float z, trb_grid grid) {
  trbvh_u32 i = trb_cell(x, grid.origin[0], grid.cells_per_unit);
  trbvh_u32 j = trb_cell(y, grid.origin[1], grid.cells_per_unit);
  trbvh_u32 k = trb_cell(z, grid.origin[2], grid.cells_per_unit);
  return trb_spread(i) << 2 | trb_spread(j) << 1 | trb_spread(k);
}

TRB_CORE trb_u64 trb_box_code(trbvh_node box, trb_grid grid) {       /* of its centre */
  return trb_morton(0.5f * box.min[0] + 0.5f * box.max[0], 0.5f * box.min[1] + 0.5f * box.max[1],
                    0.5f * box.min[2] + 0.5f * box.max[2], grid);
}

// ---- Treelets: the dynamic program (paper, section 3.2) ----
/* The best binary tree over seven treelet leaves, for all 127 subsets of them, smaller ones first. With a(s) the half
 * area of the box around subset s and n(s) its references, in units of Ci and less the leaves' own costs u:
 *
 *     c(s) = min( a(s) + min over partitions {p, s - p} of c(p) + c(s - p),   Ct/Ci a(s) n(s) - u(s) )
 *
 * The second term, a leaf, where n(s) <= max_leaf. Single leaves cost nothing, so sums with them fall away.
 *
 * It is straight-line code, unrolled by the macros below, with one vector, TRB_LANE, a variable. The text stands once:
 * the including code says what a TRB_LANE is and how it is added, subtracted, multiplied, and which is less, and gets a
 * function from TRB_DEFINE_TREELET_COSTS. The table c goes out, and the least sum for each subset, for trb_partition to
 * find the topology that made them. */
#define TRB_TREELET 7
#define TRB_GPU_LANES 32u
#if defined(TRB_GPU)                     /* OpenCL C: a work-item takes one treelet, a work-group so many ... */
  #define TRB_LANES     TRB_GPU_LANES
  #define TRB_SUM_LANES 1u
#else                                    /* ... elsewhere, so many lie side by side */
  #define TRB_LANES     16u
  #define TRB_SUM_LANES TRB_LANES
#endif
/* Leaves' values: the box, then what adds up. */
#define TRB_LANE_JOIN(k, a, b) ((k) < 3 ? TRB_LANE_MIN(a, b) : (k) < 6 ? TRB_LANE_MAX(a, b) : TRB_LANE_ADD(a, b))
#define TRB_LEAF_VALUES 8                /* of a treelet leaf: min[3], max[3], references, cost */
#define TRB_SUBSETS     128              /* one bit a treelet leaf */

#define TRB_SINGLE(s)    (((s) & ((s) - 1)) == 0)
#define TRB_BOTH(p, q)   (TRB_SINGLE(p) ? c[q] : TRB_SINGLE(q) ? c[p] : TRB_LANE_ADD(c[p], c[q]))
/* Partitions: TRB_Qk tries all ways to deal k more leaves to p and q, both non-empty; TRB_Pk those of p alone. */
#define TRB_Q0(p, q)              best = TRB_LANE_MIN(TRB_BOTH(p, q), best);
#define TRB_Q1(p, q, a)           TRB_Q0((p) | (a), q)          TRB_Q0(p, (q) | (a))
#define TRB_Q2(p, q, a, b)        TRB_Q1((p) | (a), q, b)       TRB_Q1(p, (q) | (a), b)
#define TRB_Q3(p, q, a, b, d)     TRB_Q2((p) | (a), q, b, d)    TRB_Q2(p, (q) | (a), b, d)
#define TRB_Q4(p, q, a, b, d, e)  TRB_Q3((p) | (a), q, b, d, e) TRB_Q3(p, (q) | (a), b, d, e)
#define TRB_Q5(p, q, a, b, d, e, f) TRB_Q4((p) | (a), q, b, d, e, f) TRB_Q4(p, (q) | (a), b, d, e, f)
#define TRB_P1(p, a)                TRB_Q0(p, a)
#define TRB_P2(p, a, b)             TRB_Q1(p, a, b)             TRB_P1((p) | (a), b)
#define TRB_P3(p, a, b, d)          TRB_Q2(p, a, b, d)          TRB_P2((p) | (a), b, d)
#define TRB_P4(p, a, b, d, e)       TRB_Q3(p, a, b, d, e)       TRB_P3((p) | (a), b, d, e)
#define TRB_P5(p, a, b, d, e, f)    TRB_Q4(p, a, b, d, e, f)    TRB_P4((p) | (a), b, d, e, f)
#define TRB_P6(p, a, b, d, e, f, g) TRB_Q5(p, a, b, d, e, f, g) TRB_P5((p) | (a), b, d, e, f, g)
/* What stands in table and sums before: a subset's cost as a leaf, and its area. */
#define TRB_SUBSET(s, partitions) { \
  TRB_LANE best = most; \
  partitions \
  c[s] = TRB_LANE_MIN(TRB_LANE_LOAD(&table[(s) * TRB_LANES]), TRB_LANE_ADD(TRB_LANE_LOAD(&sums[(s) * TRB_SUM_LANES]), best)); \
  TRB_LANE_STORE(&table[(s) * TRB_LANES], c[s]); \
  TRB_LANE_STORE(&sums[(s) * TRB_SUM_LANES], best); }
#define TRB_S2(i, j) TRB_SUBSET((1 << i | 1 << j), TRB_P1(1 << i, 1 << j))
#define TRB_S3(i, j, k) TRB_SUBSET((1 << i | 1 << j | 1 << k), TRB_P2(1 << i, 1 << j, 1 << k))
#define TRB_S4(i, j, k, l) \
  TRB_SUBSET((1 << i | 1 << j | 1 << k | 1 << l), TRB_P3(1 << i, 1 << j, 1 << k, 1 << l))
#define TRB_S5(i, j, k, l, m) \
  TRB_SUBSET((1 << i | 1 << j | 1 << k | 1 << l | 1 << m), TRB_P4(1 << i, 1 << j, 1 << k, 1 << l, 1 << m))
#define TRB_S6(without) TRB_SUBSET((127 ^ 1 << without), TRB_P5(1 << TRB_SKIP(0, without), \
  1 << TRB_SKIP(1, without), 1 << TRB_SKIP(2, without), 1 << TRB_SKIP(3, without), 1 << TRB_SKIP(4, without), \
  1 << TRB_SKIP(5, without)))
#define TRB_SKIP(i, without) ((i) + ((i) >= (without)))

/* Boxes, references and costs first: of the subsets of leaves 0..2, `low`, and of leaves 3..6, `high`; any other subset
 * is the union of two of them. A larger one than max_leaf is no leaf: (n - limit) FLT_MAX, hugely negative otherwise,
 * then stands above all. */
#define TRB_DEFINE_TREELET_COSTS(function) \
  function(const TRB_WORK float *TRB_RESTRICT leaves, TRB_WORK float *TRB_RESTRICT table, float *TRB_RESTRICT sums, \
           trb_costs costs) { \
  const TRB_LANE ratio = TRB_LANE_OF(costs.ratio), limit = TRB_LANE_OF((float)costs.max_leaf + 0.5f); \
  const TRB_LANE most = TRB_LANE_OF(FLT_MAX), least = TRB_LANE_OF(-FLT_MAX), zero = TRB_LANE_OF(0); \
  TRB_LANE low[8][TRB_LEAF_VALUES], high[16][TRB_LEAF_VALUES], c[TRB_SUBSETS]; \
  trbvh_u32 i, j, k; \
  for (k = 0; k < TRB_LEAF_VALUES; k++) low[0][k] = high[0][k] = k < 3 ? most : k < 6 ? least : zero; \
  for (i = 1; i < 8; i *= 2) \
    for (k = 0; k < TRB_LEAF_VALUES; k++) { \
      low[i][k] = TRB_LANE_LOAD(&leaves[((i >> 1) * TRB_LEAF_VALUES + k) * TRB_LANES]); \
      for (j = 1; j < i; j++) low[i + j][k] = TRB_LANE_JOIN(k, low[i][k], low[j][k]); \
    } \
  for (i = 1; i < 16; i *= 2) \
    for (k = 0; k < TRB_LEAF_VALUES; k++) { \
      high[i][k] = TRB_LANE_LOAD(&leaves[((i < 8 ? 3 + (i >> 1) : 6) * TRB_LEAF_VALUES + k) * TRB_LANES]); \
      for (j = 1; j < i; j++) high[i + j][k] = TRB_LANE_JOIN(k, high[i][k], high[j][k]); \
    } \
  for (i = 0; i < 16; i++) \
    for (j = 0; j < 8; j++) { \
      const trbvh_u32 s = 8 * i + j; \
      TRB_LANE x = TRB_LANE_SUB(TRB_LANE_MAX(low[j][3], high[i][3]), TRB_LANE_MIN(low[j][0], high[i][0])); \
      TRB_LANE y = TRB_LANE_SUB(TRB_LANE_MAX(low[j][4], high[i][4]), TRB_LANE_MIN(low[j][1], high[i][1])); \
      TRB_LANE z = TRB_LANE_SUB(TRB_LANE_MAX(low[j][5], high[i][5]), TRB_LANE_MIN(low[j][2], high[i][2])); \
      TRB_LANE n = TRB_LANE_ADD(low[j][6], high[i][6]), u = TRB_LANE_ADD(low[j][7], high[i][7]); \
      TRB_LANE area = TRB_LANE_ADD(TRB_LANE_MUL(x, y), TRB_LANE_MUL(z, TRB_LANE_ADD(x, y))); \
      TRB_LANE leaf = TRB_LANE_SUB(TRB_LANE_MUL(TRB_LANE_MUL(ratio, area), n), u); \
      leaf = TRB_LANE_MAX(leaf, TRB_LANE_MUL(TRB_LANE_SUB(n, limit), most)); \
      TRB_LANE_STORE(&table[s * TRB_LANES], leaf); \
      TRB_LANE_STORE(&sums[s * TRB_SUM_LANES], area); \
    } \
  for (i = 1; i < TRB_SUBSETS; i *= 2) { TRB_LANE_STORE(&table[i * TRB_LANES], zero); c[i] = zero; } \
  TRB_S2(0, 1) TRB_S2(0, 2) TRB_S2(1, 2) TRB_S2(0, 3) TRB_S2(1, 3) TRB_S2(2, 3) TRB_S2(0, 4) \
  TRB_S2(1, 4) TRB_S2(2, 4) TRB_S2(3, 4) TRB_S2(0, 5) TRB_S2(1, 5) TRB_S2(2, 5) TRB_S2(3, 5) \
  TRB_S2(4, 5) TRB_S2(0, 6) TRB_S2(1, 6) TRB_S2(2, 6) TRB_S2(3, 6) TRB_S2(4, 6) TRB_S2(5, 6) \
  TRB_S3(0, 1, 2) TRB_S3(0, 1, 3) TRB_S3(0, 2, 3) TRB_S3(1, 2, 3) TRB_S3(0, 1, 4) TRB_S3(0, 2, 4) TRB_S3(1, 2, 4) \
  TRB_S3(0, 3, 4) TRB_S3(1, 3, 4) TRB_S3(2, 3, 4) TRB_S3(0, 1, 5) TRB_S3(0, 2, 5) TRB_S3(1, 2, 5) TRB_S3(0, 3, 5) \
  TRB_S3(1, 3, 5) TRB_S3(2, 3, 5) TRB_S3(0, 4, 5) TRB_S3(1, 4, 5) TRB_S3(2, 4, 5) TRB_S3(3, 4, 5) TRB_S3(0, 1, 6) \
  TRB_S3(0, 2, 6) TRB_S3(1, 2, 6) TRB_S3(0, 3, 6) TRB_S3(1, 3, 6) TRB_S3(2, 3, 6) TRB_S3(0, 4, 6) TRB_S3(1, 4, 6) \
  TRB_S3(2, 4, 6) TRB_S3(3, 4, 6) TRB_S3(0, 5, 6) TRB_S3(1, 5, 6) TRB_S3(2, 5, 6) TRB_S3(3, 5, 6) TRB_S3(4, 5, 6) \
  TRB_S4(0, 1, 2, 3) TRB_S4(0, 1, 2, 4) TRB_S4(0, 1, 3, 4) TRB_S4(0, 2, 3, 4) TRB_S4(1, 2, 3, 4) \
  TRB_S4(0, 1, 2, 5) TRB_S4(0, 1, 3, 5) TRB_S4(0, 2, 3, 5) TRB_S4(1, 2, 3, 5) TRB_S4(0, 1, 4, 5) \
  TRB_S4(0, 2, 4, 5) TRB_S4(1, 2, 4, 5) TRB_S4(0, 3, 4, 5) TRB_S4(1, 3, 4, 5) TRB_S4(2, 3, 4, 5) \
  TRB_S4(0, 1, 2, 6) TRB_S4(0, 1, 3, 6) TRB_S4(0, 2, 3, 6) TRB_S4(1, 2, 3, 6) TRB_S4(0, 1, 4, 6) \
  TRB_S4(0, 2, 4, 6) TRB_S4(1, 2, 4, 6) TRB_S4(0, 3, 4, 6) TRB_S4(1, 3, 4, 6) TRB_S4(2, 3, 4, 6) \
  TRB_S4(0, 1, 5, 6) TRB_S4(0, 2, 5, 6) TRB_S4(1, 2, 5, 6) TRB_S4(0, 3, 5, 6) TRB_S4(1, 3, 5, 6) \
  TRB_S4(2, 3, 5, 6) TRB_S4(0, 4, 5, 6) TRB_S4(1, 4, 5, 6) TRB_S4(2, 4, 5, 6) TRB_S4(3, 4, 5, 6) \
  TRB_S5(0, 1, 2, 3, 4) TRB_S5(0, 1, 2, 3, 5) TRB_S5(0, 1, 2, 4, 5) TRB_S5(0, 1, 3, 4, 5) TRB_S5(0, 2, 3, 4, 5) \
  TRB_S5(1, 2, 3, 4, 5) TRB_S5(0, 1, 2, 3, 6) TRB_S5(0, 1, 2, 4, 6) TRB_S5(0, 1, 3, 4, 6) TRB_S5(0, 2, 3, 4, 6) \
  TRB_S5(1, 2, 3, 4, 6) TRB_S5(0, 1, 2, 5, 6) TRB_S5(0, 1, 3, 5, 6) TRB_S5(0, 2, 3, 5, 6) TRB_S5(1, 2, 3, 5, 6) \
  TRB_S5(0, 1, 4, 5, 6) TRB_S5(0, 2, 4, 5, 6) TRB_S5(1, 2, 4, 5, 6) TRB_S5(0, 3, 4, 5, 6) TRB_S5(1, 3, 4, 5, 6) \
  TRB_S5(2, 3, 4, 5, 6) \
  TRB_S6(6) TRB_S6(5) TRB_S6(4) TRB_S6(3) TRB_S6(2) TRB_S6(1) TRB_S6(0) \
  TRB_SUBSET(127, TRB_P6(1, 2, 4, 8, 16, 32, 64)) \
}

/* The part of subset s that holds its lowest leaf in the cheapest partition; among equals the first, counting up. */
TRB_CORE trbvh_u32 trb_partition(const TRB_WORK float *table, const float *sums, trbvh_u32 s) {
  const trbvh_u32 rest = s & (s - 1);
  const float best = sums[s * TRB_SUM_LANES];
  trbvh_u32 q = 0;
  do q = (q - rest) & rest;                          /* q: all non-empty subsets of the rest, counting up */
  while (q != rest && table[(s ^ q) * TRB_LANES] + table[q * TRB_LANES] != best);
  return s ^ q;
}

/* Which treelet leaf to expand next: the one with the largest key. Half area first (less the three lowest bits of its
 * float), then the lower slot; 0 for a single reference, which cannot be expanded. */
TRB_CORE trbvh_u32 trb_expand_key(trbvh_node n, trbvh_u32 slot) {
  trbvh_u32 key = (trb_bits(trb_area(n)) & ~7u) | (TRB_TREELET - slot);
  return trb_is_single(n.count) ? 0 : key;
}

/* Not to be rewritten for rounding errors: a new topology must save more than 2^-18 of the old one's cost. */
TRB_CORE int trb_improves(float cost, float old_cost) { return cost < old_cost - old_cost * 3.8147e-6f; }

// ---- Triangle splitting (paper, section 4) ----
/* How much a triangle wants to be split: cube root of 2^i (A - A_ideal), with A its box's surface area, A_ideal what
 * is left of it after infinitely many splits, and i the level of the most important spatial median plane that cuts
 * the box (-1 for the scene's middle, -2 for the quarters, ...). */
typedef struct trb_plane { int axis, level; float position; } trb_plane;
#define TRB_TINY 1e-30f                              /* nothing is cut any smaller, nor closer to a corner */

TRB_CORE trb_plane trb_median_plane(trbvh_node box, trb_grid grid) {
  trb_plane plane;
  float longest = 0;
  int k;
  plane.axis = 0; plane.level = -TRB_GRID_BITS - 1; plane.position = 0;
  for (k = 0; k < 3; k++) {
    trbvh_u32 low = trb_cell(box.min[k], grid.origin[k], grid.cells_per_unit);
    trbvh_u32 high = trb_cell(box.max[k], grid.origin[k], grid.cells_per_unit);
    if (low != high) {
      const int bit = (int)trb_log2(low ^ high), level = bit - TRB_GRID_BITS;
      const float side = box.max[k] - box.min[k];
      if (level > plane.level || (level == plane.level && side > longest)) {   /* of equal ones that across the longest side */
        plane.level = level;
        longest = side;
        plane.axis = k;
        plane.position = grid.origin[k] + (float)(high >> bit << bit) * grid.units_per_cell;
      }
    }
  }
  return plane;
}

TRB_CORE float trb_split_priority(const float v[3][3], trbvh_node box, trb_grid grid) {
  float ax = v[1][0] - v[0][0], ay = v[1][1] - v[0][1], az = v[1][2] - v[0][2];
  float bx = v[2][0] - v[0][0], by = v[2][1] - v[0][1], bz = v[2][2] - v[0][2];
  float ideal = trb_abs(ay * bz - az * by) + trb_abs(az * bx - ax * bz) + trb_abs(ax * by - ay * bx);
  float empty = 2.0f * trb_area(box) - ideal;        /* below 0 by rounding, or NaN where areas overflow: no split */
  float weight = trb_float((trbvh_u32)(127 + trb_median_plane(box, grid).level) << 23);
  return empty > 0 && empty < FLT_MAX ? trb_cube_root(weight * empty) : 0;
}

TRB_CORE float trb_longest_side(trbvh_node box) {
  float x = box.max[0] - box.min[0], y = box.max[1] - box.min[1], z = box.max[2] - box.min[2], xy = TRB_MAX(x, y);
  return TRB_MAX(xy, z);
}

TRB_CORE int trb_cuts(trbvh_node box, trb_plane plane) {
  const int k = plane.axis;
  return plane.position > box.min[k] && plane.position < box.max[k] && box.max[k] - box.min[k] > TRB_TINY;
}

/* Where to cut box in two: at the median plane, or the middle of its longest side where that plane only touches it.
 * 0 where there is nothing between the faces, or where arithmetic would leave the range of float. */
TRB_CORE int trb_choose_plane(trbvh_node box, trb_grid grid, trb_plane *plane) {
  const float longest = trb_longest_side(box);
  int k;
  *plane = trb_median_plane(box, grid);
  if (!(longest > TRB_TINY && longest < 1 / TRB_TINY)) return 0;
  if (plane->level > -TRB_GRID_BITS - 1 && trb_cuts(box, *plane)) return 1;
  for (k = 0; box.max[k] - box.min[k] < longest; k++) {}
  plane->axis = k;
  plane->position = 0.5f * box.min[k] + 0.5f * box.max[k];
  return trb_cuts(box, *plane);
}

/* The share of `splits` for the half whose longest side is `left`, rounded. */
TRB_CORE trbvh_u32 trb_share(trbvh_u32 splits, float left, float right) {
  float both = left + right;
  float share = both > TRB_TINY && both < 1 / TRB_TINY ? left * trb_reciprocal(both) : 0.5f;
  trbvh_u32 n = (trbvh_u32)((float)splits * share + 0.5f);
  return TRB_MIN(n, splits);
}

/* Cuts the polygon of n corners at position on axis k and keeps the side above (sign 1) or below (-1). */
#define TRB_POLYGON 10                               /* corners of a triangle cut six times: 9 */
TRB_CORE int trb_cut(float polygon[TRB_POLYGON][3], int n, int k, float position, float sign) {
  float kept[TRB_POLYGON][3];
  int i, j, count = 0;
  for (i = 0; i < n; i++) {
    int next = i + 1 < n ? i + 1 : 0;
    float a = (polygon[i][k] - position) * sign, b = (polygon[next][k] - position) * sign;
    if (a >= -TRB_TINY && count < TRB_POLYGON) {
      for (j = 0; j < 3; j++) kept[count][j] = polygon[i][j];
      count++;
    }
    if (((a > 0 && b < -TRB_TINY) || (a < -TRB_TINY && b > 0)) && count < TRB_POLYGON) {
      float t = trb_abs(a) * trb_reciprocal(trb_abs(a) + trb_abs(b));
      for (j = 0; j < 3; j++) kept[count][j] = polygon[i][j] + (polygon[next][j] - polygon[i][j]) * t;
      kept[count][k] = position;
      count++;
    }
  }
  for (i = 0; i < count; i++)
    for (j = 0; j < 3; j++) polygon[i][j] = kept[i][j];
  return count;
}

/* Shrinks the box to the part of the triangle inside it; 0, and the box as it was, where there is none.
 * Corners that lie on a cut are rounded. So that no ray slips between two fragments, the triangle is cut at a box
 * wider by 2^-20 of the coordinates, what is left is padded by 2^-21, and only then cut off at the box's own faces,
 * which it shares with its neighbour: together, the fragments then cover the triangle. */
TRB_CORE int trb_clip(const float v[3][3], trbvh_node *box) {
  float polygon[TRB_POLYGON][3], pad[3];
  trbvh_node bounds = *box;
  int i, j, k, n = 3;
  for (i = 0; i < 3; i++)
    for (j = 0; j < 3; j++) polygon[i][j] = v[i][j];
  for (k = 0; k < 3; k++) {
    float a = trb_abs(v[0][k]), b = trb_abs(v[1][k]), c = trb_abs(v[2][k]), ab = TRB_MAX(a, b);
    pad[k] = TRB_MAX(ab, c) * 9.5367432e-7f;
    n = trb_cut(polygon, n, k, box->min[k] - pad[k], 1);
    n = trb_cut(polygon, n, k, box->max[k] + pad[k], -1);
  }
  if (n == 0) return 0;
  for (k = 0; k < 3; k++) {
    float low = polygon[0][k], high = polygon[0][k];
    for (i = 1; i < n; i++) {
      low = TRB_MIN(low, polygon[i][k]);
      high = TRB_MAX(high, polygon[i][k]);
    }
    low -= 0.5f * pad[k];
    high += 0.5f * pad[k];
    bounds.min[k] = trb_no_sign(TRB_MAX(low, box->min[k]));
    bounds.max[k] = trb_no_sign(TRB_MIN(high, box->max[k]));
    if (!(bounds.min[k] <= bounds.max[k])) return 0;
  }
  *box = bounds;
  return 1;
}

// >>mesh ---- primitives read whatever their form -------------------------------------------------------------------
/* A geometry, with its defaults filled in. On an OpenCL device, indices are there where index_size is not 0. */
#ifdef TRBVH_OPENCL_C
  typedef struct trb_mesh {
    const __global char *positions, *indices, *boxes;
    ulong position_stride, box_stride;
    uint position_count, index_size, count;
  } trb_mesh;
#else
  typedef trbvh_geometry trb_mesh;
#endif
#define TRB_AHEAD 32u                    /* how far ahead random reads are asked for */

/* Host memory may have any alignment. */
TRB_CORE float trb_load_float(const TRB_GLOBAL char *p) {
#if defined(TRBVH_OPENCL_C)
  return *(const __global float *)p;
#elif defined(__GNUC__)                  /* gcc sends what memcpy copies through other registers */
  typedef float loose_float __attribute__((aligned(1), may_alias));
  return *(const loose_float *)p;
#else
  float x;
  memcpy(&x, p, 4);
  return x;
#endif
}

TRB_CORE void trb_load_position(float out[3], const TRB_GLOBAL char *p) {
  out[0] = trb_load_float(p);
  out[1] = trb_load_float(p + 4);
  out[2] = trb_load_float(p + 8);
}

TRB_CORE trbvh_u32 trb_index16(const trb_mesh *mesh, size_t i) {
#ifdef TRBVH_OPENCL_C
  return ((const __global ushort *)mesh->indices)[i];
#else
  uint16_t index;
  memcpy(&index, (const char *)mesh->indices + i * 2, 2);
  return index;
#endif
}

TRB_CORE trbvh_u32 trb_index32(const trb_mesh *mesh, size_t i) {
#ifdef TRBVH_OPENCL_C
  return ((const __global uint *)mesh->indices)[i];
#else
  uint32_t index;
  memcpy(&index, (const char *)mesh->indices + i * 4, 4);
  return index;
#endif
}

TRB_CORE trbvh_u32 trb_index(const trb_mesh *mesh, size_t i) {
  return mesh->index_size == 2 ? trb_index16(mesh, i) : trb_index32(mesh, i);
}

TRB_CORE const TRB_GLOBAL char *trb_position(const trb_mesh *mesh, size_t i) {
  return (const TRB_GLOBAL char *)mesh->positions + i * mesh->position_stride;
}

/* The corners of triangle i; 0 where one of its indices is out of range, which vertex then tells. */
TRB_SHARED int trb_load_triangle(const trb_mesh *mesh, trbvh_u32 i, float v[3][3], trbvh_u32 *vertex) {
  size_t k, corner = (size_t)i * 3;
  for (k = 0; k < 3; k++) {
    size_t position = corner + k;
    if (mesh->indices) {
      *vertex = trb_index(mesh, corner + k);
      if (*vertex >= mesh->position_count) return 0;
      position = *vertex;
    }
    trb_load_position(v[k], trb_position(mesh, position));
  }
  return 1;
}

/* Asks for a triangle's indices, well before, and for its positions, once they are there. TRB_CORE, always inlined:
 * gcc takes a function that only prefetches for one without effect, and drops its calls. */
TRB_CORE void trb_prefetch_indices(const trb_mesh *mesh, trbvh_u32 i) {
  if (mesh->indices) TRB_PREFETCH((const TRB_GLOBAL char *)mesh->indices + (size_t)i * 3 * mesh->index_size);
}

TRB_CORE void trb_prefetch_positions(const trb_mesh *mesh, trbvh_u32 i) {
  size_t k, corner = (size_t)i * 3;
  if (mesh->boxes) {
    TRB_PREFETCH((const TRB_GLOBAL char *)mesh->boxes + (size_t)i * mesh->box_stride);
    return;
  }
  for (k = 0; k < 3; k++)
    TRB_PREFETCH(trb_position(mesh, mesh->indices ? trb_index(mesh, corner + k) : corner + k));
}

TRB_SHARED trbvh_node trb_no_box(void) {
  trbvh_node n;
  int k;
  for (k = 0; k < 3; k++) { n.min[k] = FLT_MAX; n.max[k] = -FLT_MAX; }
  n.first = n.count = 0;
  return n;
}

TRB_SHARED void trb_include(trbvh_node *n, const float low[3], const float high[3]) {
  int k;
  for (k = 0; k < 3; k++) {
    n->min[k] = TRB_MIN(low[k], n->min[k]);
    n->max[k] = TRB_MAX(high[k], n->max[k]);
  }
}

/* 0 for a triangle with a NaN or infinity. */
TRB_SHARED int trb_triangle_box(const float v[3][3], trbvh_node *box) {
  int k, finite = 1;
  for (k = 0; k < 3; k++) {
    float low = TRB_MIN(v[0][k], v[1][k]), high = TRB_MAX(v[0][k], v[1][k]);
    box->min[k] = trb_no_sign(TRB_MIN(v[2][k], low));
    box->max[k] = trb_no_sign(TRB_MAX(v[2][k], high));
    finite &= trb_finite(v[0][k]) & trb_finite(v[1][k]) & trb_finite(v[2][k]);
  }
  box->first = box->count = 0;
  return finite;
}

TRB_SHARED int trb_valid_box(trbvh_node box) {
  int k, valid = 1;
  for (k = 0; k < 3; k++) valid &= trb_finite(box.min[k]) & trb_finite(box.max[k]) & (box.min[k] <= box.max[k]);
  return valid;
}

/* The box of primitive i: 1, or 0 where it is to be skipped, -1 where it has an index out of range. A triangle's
 * corners go to v. */
TRB_SHARED int trb_prim_box(const trb_mesh *mesh, trbvh_u32 i, trbvh_node *box, float v[3][3], trbvh_u32 *vertex) {
  const TRB_GLOBAL char *p;
  int k;
  if (!mesh->boxes) return trb_load_triangle(mesh, i, v, vertex) ? trb_triangle_box((const float (*)[3])v, box) : -1;
  p = (const TRB_GLOBAL char *)mesh->boxes + (size_t)i * mesh->box_stride;
  trb_load_position(box->min, p);
  trb_load_position(box->max, p + 12);
  for (k = 0; k < 3; k++) { box->min[k] = trb_no_sign(box->min[k]); box->max[k] = trb_no_sign(box->max[k]); }
  box->first = box->count = 0;
  return trb_valid_box(*box);
}

// ---- Primitives in rows ----
/* Boxes side by side, by coordinate: loops over them become vector code. Invalid ones are empty. */
#define TRB_ROW 64u
typedef struct trb_row {
  float     min[3][TRB_ROW], max[3][TRB_ROW];
  float     check[TRB_ROW];
  trbvh_u32 valid[TRB_ROW], prim[TRB_ROW];
} trb_row;

/* What a mesh is made of: boxes, or triangles with indices of so many bytes, 0 for none. */
#define TRB_BOXES 1u
TRB_CORE trbvh_u32 trb_mesh_form(const trb_mesh *mesh) {
  return mesh->boxes ? TRB_BOXES : mesh->indices ? mesh->index_size : 0;
}

TRB_CORE size_t trb_vertex(const trb_mesh *mesh, trbvh_u32 form, size_t corner) {
  return form == 4 ? trb_index32(mesh, corner) : form == 2 ? trb_index16(mesh, corner) : corner;
}

TRB_CORE void trb_prefetch_corners(const trb_mesh *mesh, trbvh_u32 form, size_t prim) {
  TRB_PREFETCH(trb_position(mesh, trb_vertex(mesh, form, 3 * prim)));
  TRB_PREFETCH(trb_position(mesh, trb_vertex(mesh, form, 3 * prim + 1)));
  TRB_PREFETCH(trb_position(mesh, trb_vertex(mesh, form, 3 * prim + 2)));
}

/* One box of a row; 0 where an index is out of range. check: not finite where a coordinate is not. */
TRB_CORE int trb_read_box(const trb_mesh *mesh, trbvh_u32 form, trb_row *row, trbvh_u32 i) {
  const size_t prim = row->prim[i];
  float a[3], b[3], c[3];
  if (form == TRB_BOXES) {
    const TRB_GLOBAL char *p = (const TRB_GLOBAL char *)mesh->boxes + prim * mesh->box_stride;
    trb_load_position(a, p);
    trb_load_position(b, p + 12);
    #define TRB_AXIS(k) row->min[k][i] = trb_no_sign(a[k]); row->max[k][i] = trb_no_sign(b[k]);
    TRB_AXIS(0) TRB_AXIS(1) TRB_AXIS(2)
    #undef TRB_AXIS
    row->check[i] = (a[0] + a[1] + a[2]) + (b[0] + b[1] + b[2]);
    if (!(a[0] <= b[0] && a[1] <= b[1] && a[2] <= b[2])) row->check[i] = trb_float(0x7F800000u);
  } else {
    const size_t v0 = trb_vertex(mesh, form, 3 * prim), v1 = trb_vertex(mesh, form, 3 * prim + 1);
    const size_t v2 = trb_vertex(mesh, form, 3 * prim + 2);
    if (form && (v0 >= mesh->position_count || v1 >= mesh->position_count || v2 >= mesh->position_count)) return 0;
    trb_load_position(a, trb_position(mesh, v0));
    trb_load_position(b, trb_position(mesh, v1));
    trb_load_position(c, trb_position(mesh, v2));
    #define TRB_AXIS(k) { \
      float low = TRB_MIN(a[k], b[k]), high = TRB_MAX(a[k], b[k]); \
      row->min[k][i] = trb_no_sign(TRB_MIN(c[k], low)); \
      row->max[k][i] = trb_no_sign(TRB_MAX(c[k], high)); }
    TRB_AXIS(0) TRB_AXIS(1) TRB_AXIS(2)
    #undef TRB_AXIS
    row->check[i] = (a[0] + a[1] + a[2]) + (b[0] + b[1] + b[2]) + (c[0] + c[1] + c[2]);
  }
  return 1;
}

TRB_CORE trbvh_u32 trb_read_form(const trb_mesh *mesh, trbvh_u32 form, trbvh_u32 count, trb_row *row) {
  trbvh_u32 i = 0;
  while (i < count && trb_read_box(mesh, form, row, i)) i++;
  return i;
}

/* The boxes of the primitives in row->prim; returns how many there are before one with an index out of range. */
TRB_SHARED trbvh_u32 trb_read_row(const trb_mesh *mesh, trbvh_u32 count, trb_row *row) {
  switch (trb_mesh_form(mesh)) {         /* a loop for each form */
    case 0: return trb_read_form(mesh, 0, count, row);
    case 2: return trb_read_form(mesh, 2, count, row);
    case 4: return trb_read_form(mesh, 4, count, row);
    default: return trb_read_form(mesh, TRB_BOXES, count, row);
  }
}

TRB_CORE void trb_prefetch_row(const trb_mesh *mesh, trbvh_u32 count, const trb_row *row) {
  const trbvh_u32 form = trb_mesh_form(mesh);
  trbvh_u32 i;
  if (form == 4) for (i = 0; i < count; i++) trb_prefetch_corners(mesh, 4, row->prim[i]);
  else if (form == 2) for (i = 0; i < count; i++) trb_prefetch_corners(mesh, 2, row->prim[i]);
  else for (i = 0; i < count; i++) trb_prefetch_positions(mesh, row->prim[i]);
}

/* Empties the invalid boxes of a row, which are few: where a coordinate is infinite or NaN, so is the sum of all. */
TRB_SHARED trbvh_u32 trb_check_row(const trb_mesh *mesh, trbvh_u32 count, trb_row *row) {
  trbvh_u32 i, k, suspect = 0, valid = count;
  for (i = count; i < TRB_ROW; i++) row->check[i] = 0;
  for (i = 0; i < TRB_ROW; i++) suspect |= !trb_finite(row->check[i]);
  for (i = 0; i < TRB_ROW; i++) row->valid[i] = 1;
  for (i = 0; suspect && i < count; i++) {
    trbvh_node box;
    trbvh_u32 vertex;
    float v[3][3];
    if (trb_finite(row->check[i]) || trb_prim_box(mesh, row->prim[i], &box, v, &vertex) > 0) continue;
    for (k = 0; k < 3; k++) { row->min[k][i] = FLT_MAX; row->max[k][i] = -FLT_MAX; }
    row->valid[i] = 0;
    valid--;
  }
  return valid;
}

TRB_CORE trbvh_node trb_row_box(const trb_row *row, trbvh_u32 i) {
  trbvh_node box;
  trbvh_u32 k;
  for (k = 0; k < 3; k++) { box.min[k] = row->min[k][i]; box.max[k] = row->max[k][i]; }
  box.first = row->prim[i];
  box.count = 0;
  return box;
}

/* The grid over a scene with these bounds. */
TRB_SHARED trb_grid trb_make_grid(trbvh_node bounds) {
  trb_grid grid;
  float extent = 0;
  int k;
  for (k = 0; k < 3; k++) {
    float side = bounds.max[k] - bounds.min[k];
    grid.origin[k] = bounds.min[k];
    extent = TRB_MAX(side, extent);
  }
  grid.units_per_cell = extent * (1.0f / 2097152.0f);
  grid.cells_per_unit = extent > 1e-30f && extent < FLT_MAX ? trb_reciprocal(grid.units_per_cell) : 0;
  return grid;
}

// >>splits ---- the paper's section 4: fewer, better used references than a spatial split builder's -----------------
/* Every triangle t gets s(t) = floor(D p(t)) splits, p its priority, with the largest scale D that keeps their sum
 * within the budget, found by bisection. Priorities are rounded to 24-bit integers first, so that all sums are exact
 * and their order does not matter. A triangle is cut at the most important median plane in its box; what is left of
 * its splits after this one goes to the halves by their longest sides; and so on down to no splits. */
#define TRB_SCALE_BITS  36
#define TRB_SCALES      2561u            /* scales to choose from, ascending, of seven significant bits each */
#define TRB_SPLIT_STACK 64u              /* fragments of one triangle that wait to be split */

TRB_CORE trb_u64 trb_scale(trbvh_u32 i) { return (trb_u64)(64 + (i & 63)) << (i >> 6) >> 6; }

/* The power of two that takes the largest of some values to so many bits. */
TRB_CORE float trb_unit(float largest, trbvh_u32 bits) {
  trbvh_u32 exponent = trb_bits(largest) >> 23;
  return trb_float((127u + 127u + bits - 1 - TRB_MAX(exponent, bits)) << 23);
}
TRB_CORE float trb_priority_unit(float largest) { return trb_unit(largest, 24); }

TRB_CORE trb_u64 trb_splits(float priority, float unit, trb_u64 scale) {
  return ((trb_u64)(trbvh_u32)(priority * unit) * scale) >> TRB_SCALE_BITS;
}

/* Cuts one reference into up to splits + 1, left before right; returns how many. */
TRB_SHARED trbvh_u32 trb_split_reference(const trb_mesh *mesh, trb_grid grid, trbvh_node ref, trbvh_u32 splits,
                                         TRB_GLOBAL trbvh_node *out) {
  struct { trbvh_node box; trbvh_u32 splits; } stack[TRB_SPLIT_STACK];
  trbvh_u32 top = 0, count = 0, vertex;
  float v[3][3];
  if (splits == 0 || !trb_load_triangle(mesh, ref.first, v, &vertex)) {
    out[0] = ref;
    return 1;
  }
  stack[top].box = ref;
  stack[top++].splits = splits;
  while (top) {
    trbvh_node left, right;
    trb_plane plane;
    int in_left, in_right;
    trbvh_u32 rest = stack[--top].splits;
    left = right = stack[top].box;
    if (rest == 0 || top + 2 > TRB_SPLIT_STACK || !trb_choose_plane(left, grid, &plane)) {
      out[count++] = left;
      continue;
    }
    left.max[plane.axis] = right.min[plane.axis] = plane.position;
    in_left = trb_clip((const float (*)[3])v, &left);
    in_right = trb_clip((const float (*)[3])v, &right);
    if (in_left && in_right) {
      trbvh_u32 share = trb_share(--rest, trb_longest_side(left), trb_longest_side(right));
      stack[top].box = right;
      stack[top++].splits = rest - share;
      stack[top].box = left;
      stack[top++].splits = share;
    } else if (in_left || in_right) {                /* the triangle only touches the plane: try again within */
      stack[top].box = in_left ? left : right;
      stack[top++].splits = rest - 1;
    } else {
      out[count++] = stack[top].box;
    }
  }
  return count;
}

// >>sort ---- references along the Morton curve: a stable radix sort of 64-bit keys ---------------------------------
/* Where up to TRB_PACKED_REFS references are possible, a key holds the leading bits of the Morton code above the
 * reference's index, so that keys differ and carry what they sort: 44 bits of code up to 2^19 references, 39 at 2^24.
 * Only the code's digits are sorted; indices are in order already. Above that, all 63 bits count: references are
 * sorted by the low 31 bits of their codes, then by the high 32, with the same keys of half code, half index. */
#ifndef TRB_PACKED_REFS                  /* lower in a test */
  #define TRB_PACKED_REFS (1u << 24)
#endif
#define TRB_CODE_BITS  44u               /* of the Morton code in a packed key, at most: four digits of the sort */
#define TRB_DIGIT_BITS 11u
#define TRB_DIGITS     (1u << TRB_DIGIT_BITS)
#define TRB_SMALL_SORT 4096u             /* so few keys are sorted by digits of 8 bits, as counters take time, too ... */
#define TRB_TINY_SORT  48u               /* ... and so few by insertion */
#define TRB_SORT_BLOCK 65536u            /* keys a job counts and scatters at most; fewer where that makes fewer than 8 jobs */
/* More packed keys than a cache holds: by the first digit first, into buckets; then each of these by itself. */
#ifndef TRB_LARGE_SORT                   /* lower in a test */
  #define TRB_LARGE_SORT 131072u         /* more than TRB_SMALL_SORT */
#endif
#define TRB_BUCKETS       32u            /* a job sorts */
#define TRB_BUCKET_PASSES 4u
#define TRB_BUCKET_BITS   9u             /* of a digit at most: TRB_CODE_BITS without the first digit, in that many passes */

/* What keys look like: bits of code, above shift bits of index. */
typedef struct trb_key_form { trbvh_u32 packed, bits, shift; } trb_key_form;

TRB_CORE trbvh_u32 trb_key_ref(trb_u64 key, trb_key_form form) {     /* form.shift may be 32 */
  return (trbvh_u32)(key & (((trb_u64)1 << form.shift) - 1));
}

/* The key of reference ref; of unpacked keys, that with the high half of its code, or the low one. */
TRB_CORE trb_u64 trb_key(trb_u64 code, trbvh_u32 ref, trb_key_form form, int high) {
  if (form.packed) code >>= 63 - form.bits;
  else code = high ? code >> 31 : code & 0x7FFFFFFFu;
  return code << form.shift | ref;
}

TRB_SHARED void trb_count_digits(const TRB_GLOBAL trb_u64 *keys, trbvh_u32 count, trbvh_u32 shift, trbvh_u32 digits,
                                 TRB_GLOBAL trbvh_u32 *histogram) {
  trbvh_u32 i;
  for (i = 0; i < digits; i++) histogram[i] = 0;
  for (i = 0; i < count; i++) histogram[(keys[i] >> shift) & (digits - 1)]++;
}

/* next: where the next key of each digit goes. */
TRB_SHARED void trb_scatter_keys(const TRB_GLOBAL trb_u64 *keys, trbvh_u32 count, trbvh_u32 shift, trbvh_u32 digits,
                                 TRB_GLOBAL trbvh_u32 *next, TRB_GLOBAL trb_u64 *sorted) {
  trbvh_u32 i;
  for (i = 0; i < count; i++) {
    trb_u64 key = keys[i];
    sorted[next[(key >> shift) & (digits - 1)]++] = key;
  }
}

/* Turns the blocks' histograms into the places of their first keys. */
TRB_SHARED void trb_place_digits(TRB_GLOBAL trbvh_u32 *histograms, trbvh_u32 blocks, trbvh_u32 digits) {
  trbvh_u32 digit, block, start = 0;
  for (digit = 0; digit < digits; digit++)
    for (block = 0; block < blocks; block++) {
      TRB_GLOBAL trbvh_u32 *count = histograms + (size_t)block * digits + digit;
      trbvh_u32 n = *count;
      *count = start;
      start += n;
    }
}

// >>hierarchy ---- the linear BVH (Karras 2012, "Maximizing Parallelism in the Construction of BVHs, Octrees...") ----
/* The binary radix tree over the sorted keys: every node splits its range where the highest bit changes. On a CPU one
 * pass over the leaves is fastest: neighbours differ by exclusive or, a smaller value splits deeper; subtrees wait on
 * a stack for a shallower split to their right, which makes them the left child of what follows them (the Cartesian
 * tree). Blocks of leaves are built alone; subtrees whose parents reach beyond their block stay open, and the same
 * pass over them makes the top of the tree. What splits leaf i from leaf i + 1 makes the pair of siblings number i + 1:
 * a cache line whose place is known before its nodes are, and subtrees that are contiguous in memory. */
#define TRB_BLOCK    16384u              /* primitives, references or leaves a job works on: their nodes fit a cache */
#define TRB_TOP      1024u               /* nodes of more references are the top of the tree */
#define TRB_NEAR     98304u              /* so few primitives are in a cache when they are read again */
#define TRB_OPEN_MAX 200u                /* subtrees of a block that its neighbours complete: 2 (63 + 32) + 1 at most */
#define TRB_NO_SPLIT (~(trb_u64)0)       /* shallower than any: the end of the scene */

/* Sorted references: those of refs, or, where that is NULL, the mesh's primitives. */
typedef struct trb_curve {
  const TRB_GLOBAL trb_u64    *keys;
  const TRB_GLOBAL trbvh_node *refs;
#ifndef TRBVH_OPENCL_C
  const trb_mesh              *mesh;
#endif
  trb_grid     grid;
  trb_key_form form;
  trbvh_u32    count;
} trb_curve;

/* The box of the reference that a key is for, with its primitive. */
TRB_CORE trbvh_node trb_curve_ref(const trb_curve *c, trb_u64 key) {
  const trbvh_u32 ref = trb_key_ref(key, c->form);
#ifndef TRBVH_OPENCL_C
  if (!c->refs) {
    trbvh_node box;
    trbvh_u32 vertex;
    float v[3][3];
    trb_prim_box(c->mesh, ref, &box, v, &vertex);
    box.first = ref;
    return box;
  }
#endif
  return c->refs[ref];
}

/* The boxes and numbers of sorted leaves first..first + count - 1, and asks for those that come after, up to `end`. */
TRB_SHARED void trb_read_leaves(const trb_curve *c, trbvh_u32 first, trbvh_u32 count, trbvh_u32 end, trb_row *row) {
  const trbvh_u32 next = first + count, soon = TRB_MIN(next + TRB_ROW, end);
  trbvh_u32 i, k;
#ifndef TRBVH_OPENCL_C
  if (!c->refs) {
    for (i = soon; i < end && i < soon + TRB_ROW; i++) trb_prefetch_indices(c->mesh, trb_key_ref(c->keys[i], c->form));
    for (i = next; i < soon; i++) row->prim[i - next] = trb_key_ref(c->keys[i], c->form);
    trb_prefetch_row(c->mesh, soon - next, row);
    for (i = 0; i < count; i++) row->prim[i] = trb_key_ref(c->keys[first + i], c->form);
    trb_read_row(c->mesh, count, row);
    return;
  }
#endif
  for (i = next; i < soon; i++) TRB_PREFETCH(&c->refs[trb_key_ref(c->keys[i], c->form)]);
  for (i = 0; i < count; i++) {
    const trbvh_node ref = c->refs[trb_key_ref(c->keys[first + i], c->form)];
    for (k = 0; k < 3; k++) { row->min[k][i] = ref.min[k]; row->max[k][i] = ref.max[k]; }
    row->prim[i] = trb_key_ref(c->keys[first + i], c->form);
  }
}

/* What splits sorted leaf i from leaf i + 1: larger is shallower. */
TRB_CORE trb_u64 trb_split_after(const trb_curve *c, trbvh_u32 i) {
  trb_u64 a, b, code;
  if (i >= c->count - 1) return TRB_NO_SPLIT;         /* also for 0 - 1 */
  a = c->keys[i];
  b = c->keys[i + 1];
  if (c->form.packed) return a ^ b;
  code = trb_box_code(trb_curve_ref(c, a), c->grid) ^ trb_box_code(trb_curve_ref(c, b), c->grid);
  return code ? code | (trb_u64)1 << 63 : (trbvh_u32)(a ^ b);
}

/* A subtree whose parent reaches beyond its block, what splits it from its right neighbour, and the pair that split
 * makes. Of a final tree also: where its last reference's primitive stands in the result, and its pairs, the root's
 * children being the last of them. */
typedef struct trb_open {
  trbvh_node node;
  trb_u64    split;
  trbvh_u32  pair, prim, first_pair, end_pair;
} trb_open;
typedef struct trb_range { trbvh_u32 open_count; trb_open open[TRB_OPEN_MAX]; } trb_range;

typedef struct trb_forest {
  TRB_GLOBAL trbvh_node *nodes;
  TRB_GLOBAL trb_range  *range;          /* where subtrees that stay open go */
  trb_costs  costs;
  trb_u64    left_split;                 /* between the bottom of the stack and what is left of it */
  trbvh_u32  height;
  trbvh_u32  end, pairs;                 /* where the block ends; in a block of a final tree, the next pair */
  struct { trb_u64 split; trbvh_u32 pair, prim, first_pair; } stack[TRB_OPEN_MAX];   /* subtrees that wait */
} trb_forest;

/* What trees are built for. Nodes of a final one, all that is known, become what they will be in the result at once:
 * of a subtree that is better as a leaf no pairs are kept, and the others are numbered in the order in which they are
 * made, within their block. The result has them in the opposite order (>>collapse). */
#define TRB_TO_RESTRUCTURE 0
#define TRB_FINAL_BLOCK    1
#define TRB_FINAL_TOP      2

/* The node where the i-th subtree of the stack waits: as a left child in its pair; or, where that is not known yet, at
 * the end of its block, where there is always room: each kept pair has joined two subtrees. */
TRB_CORE trbvh_u32 trb_waits_at(const trb_forest *f, trbvh_u32 i, int use) {
  return 2 * (use == TRB_FINAL_BLOCK ? f->end - i : f->stack[i].pair);
}

TRB_CORE void trb_leave_open(trb_forest *f, trbvh_u32 i, trbvh_u32 end_pair, int use) {
  TRB_GLOBAL trb_open *open = &f->range->open[f->range->open_count++];
  TRBVH_ASSERT(f->range->open_count <= TRB_OPEN_MAX);
  open->node = f->nodes[trb_waits_at(f, i, use)];
  open->split = f->stack[i].split;
  open->pair = f->stack[i].pair;
  open->prim = f->stack[i].prim;
  open->first_pair = f->stack[i].first_pair;
  open->end_pair = end_pair;
}

/* The next subtree from the left; split is between it and its right neighbour, and makes this pair. */
TRB_CORE void trb_push(trb_forest *f, trbvh_node node, trb_u64 split, trbvh_u32 pair, trbvh_u32 prim, int use) {
  trbvh_u32 first_pair = f->pairs;
  while (f->height && f->stack[f->height - 1].split <= split) {
    const trbvh_u32 top = --f->height, left_pair = f->stack[top].first_pair;
    if (top || f->left_split >= f->stack[top].split) {
      const trbvh_u32 at = use == TRB_FINAL_BLOCK ? f->pairs : f->stack[top].pair;
      const trbvh_node left = f->nodes[trb_waits_at(f, top, use)];
      if (use == TRB_FINAL_BLOCK) f->nodes[2 * at] = left;
      f->nodes[2 * at + 1] = node;
      node = trb_parent(left, node, 2 * at, f->costs);
      if (use != TRB_TO_RESTRUCTURE) {
        const int leaf = trb_is_leaf(node.count);
        first_pair = left_pair;
        node.first = leaf ? prim : node.first;
        f->pairs = leaf ? first_pair : f->pairs + 1;
      }
    } else {                             /* the parent of what waited begins left of the block */
      f->left_split = f->stack[top].split;
      trb_leave_open(f, top, first_pair, use);
    }
  }
  TRBVH_ASSERT(f->height < TRB_OPEN_MAX);
  f->stack[f->height].split = split;
  f->stack[f->height].pair = pair;
  f->stack[f->height].prim = prim;
  f->stack[f->height].first_pair = first_pair;
  f->nodes[trb_waits_at(f, f->height++, use)] = node;
}

TRB_CORE void trb_build_block_for(const trb_curve *curve, trbvh_u32 first, trbvh_u32 end, trb_costs costs,
                                  TRB_GLOBAL trbvh_node *nodes, TRB_GLOBAL trb_range *range, int use) {
  trbvh_u32 i, n;
  trb_row row;
  trb_forest f;
  f.nodes = nodes;
  f.range = range;
  f.costs = costs;
  f.left_split = trb_split_after(curve, first - 1);
  f.height = 0;
  f.end = end;
  f.pairs = first + 1;
  range->open_count = 0;
  for (; first < end; first += n) {
    n = TRB_MIN(end - first, TRB_ROW);
    trb_read_leaves(curve, first, n, curve->count > TRB_NEAR ? end : first + n, &row);
    for (i = 0; i < n; i++) {
      const trbvh_u32 after = first + i + 1, prim = curve->count - after;
      trbvh_node node = trb_reference(trb_row_box(&row, i), costs);
      if (use == TRB_FINAL_BLOCK) node.first = prim;
      trb_push(&f, node, trb_split_after(curve, first + i), after < curve->count ? after : 0, prim, use);
    }
  }
  for (i = 0; i < f.height; i++) trb_leave_open(&f, i, i + 1 < f.height ? f.stack[i + 1].first_pair : f.pairs, use);
  for (i = 0; use == TRB_FINAL_BLOCK && i < range->open_count; i++)      /* pairs that the block has kept free */
    if (range->open[i].pair) range->open[i].pair = end - (range->open_count - 1 - i);
}

/* The subtrees over sorted leaves first..end - 1. */
TRB_SHARED void trb_build_block(const trb_curve *curve, trbvh_u32 first, trbvh_u32 end, trb_costs costs, int final,
                                TRB_GLOBAL trbvh_node *nodes, TRB_GLOBAL trb_range *range) {
  if (final) trb_build_block_for(curve, first, end, costs, nodes, range, TRB_FINAL_BLOCK);
  else trb_build_block_for(curve, first, end, costs, nodes, range, TRB_TO_RESTRUCTURE);
}

/* The tree above the blocks; its root is nodes[0]. */
TRB_SHARED void trb_build_top(TRB_GLOBAL trbvh_node *nodes, const TRB_GLOBAL trb_range *ranges, trbvh_u32 blocks,
                              trb_costs costs, int final) {
  trbvh_u32 i, k;
  trb_forest f;
  f.nodes = nodes;
  f.range = 0;
  f.costs = costs;
  f.left_split = TRB_NO_SPLIT;
  f.height = f.end = f.pairs = 0;
  for (i = 0; i < blocks; i++)
    for (k = 0; k < ranges[i].open_count; k++) {
      const trb_open open = ranges[i].open[k];
      trb_push(&f, open.node, open.split, open.pair, open.prim, final ? TRB_FINAL_TOP : TRB_TO_RESTRUCTURE);
    }
  TRBVH_ASSERT(f.height == 1);
}

// >>lanes ---- the dynamic program over TRB_LANES treelets, on what vector units there are --------------------------
/* C: chosen at run time on x86-64, by what the compiler aims at elsewhere. All give the same bits: vectors are added,
 * multiplied and compared as floats are. */
#define TRB_LANE_LOAD(p)     (*(p))
#define TRB_LANE_STORE(p, x) (*(p) = (x))
#define TRB_LANE_OF(x)       (x)
#define TRB_LANE_ADD(a, b)   ((a) + (b))
#define TRB_LANE_SUB(a, b)   ((a) - (b))
#define TRB_LANE_MUL(a, b)   ((a) * (b))
#define TRB_LANE_MIN(a, b)   TRB_MIN(a, b)
#define TRB_LANE_MAX(a, b)   TRB_MAX(a, b)

#if defined(TRB_CPU)
  #undef  TRB_LANE_LOAD
  #undef  TRB_LANE_STORE
  #undef  TRB_LANE_OF
  #define TRB_LANE             float16
  #define TRB_LANE_LOAD(p)     (*(const float16 *)(p))
  #define TRB_LANE_STORE(p, x) (*(float16 *)(p) = (x))
  #define TRB_LANE_OF(x)       ((float16)(x))
  TRB_DEFINE_TREELET_COSTS(TRB_CORE void trb_treelet_costs_16)

TRB_CORE void trb_treelet_costs(const float *leaves, float *table, float *sums, trbvh_u32 lanes, trb_costs costs) {
  trb_treelet_costs_16(leaves, table, sums, costs);
}
#elif defined(TRBVH_OPENCL_C)
  #define TRB_LANE             float
  TRB_DEFINE_TREELET_COSTS(TRB_CORE void trb_treelet_costs_1)

#elif defined(TRB_X86) || defined(TRB_VECTOR4)
  #undef  TRB_LANE_LOAD
  #undef  TRB_LANE_STORE
  #undef  TRB_LANE_OF
  #undef  TRB_LANE_ADD
  #undef  TRB_LANE_SUB
  #undef  TRB_LANE_MUL
  #undef  TRB_LANE_MIN
  #undef  TRB_LANE_MAX
#endif

#if defined(TRB_X86)
  #define TRB_MM_PASTE(mm, op) mm##_##op##_ps
  #define TRB_MM_CALL(mm, op)  TRB_MM_PASTE(mm, op)
  #define TRB_LANE_LOAD(p)     TRB_MM_CALL(TRB_MM, load)(p)
  #define TRB_LANE_STORE(p, x) TRB_MM_CALL(TRB_MM, store)(p, x)
  #define TRB_LANE_OF(x)       TRB_MM_CALL(TRB_MM, set1)(x)
  #define TRB_LANE_ADD(a, b)   TRB_MM_CALL(TRB_MM, add)(a, b)
  #define TRB_LANE_SUB(a, b)   TRB_MM_CALL(TRB_MM, sub)(a, b)
  #define TRB_LANE_MUL(a, b)   TRB_MM_CALL(TRB_MM, mul)(a, b)
  #define TRB_LANE_MIN(a, b)   TRB_MM_CALL(TRB_MM, min)(a, b)         /* a < b ? a : b, as TRB_MIN */
  #define TRB_LANE_MAX(a, b)   TRB_MM_CALL(TRB_MM, max)(a, b)

  #define TRB_LANE __m128
  #define TRB_MM   _mm
  TRB_DEFINE_TREELET_COSTS(static void trb_treelet_costs_sse)
  #ifdef TRB_AVX
  #undef TRB_LANE
  #undef TRB_MM
  #define TRB_LANE __m256
  #define TRB_MM   _mm256
  TRB_DEFINE_TREELET_COSTS(TRB_TARGET("avx2") static void trb_treelet_costs_avx2)
  #undef TRB_LANE
  #undef TRB_MM
  #define TRB_LANE __m512
  #define TRB_MM   _mm512
  TRB_DEFINE_TREELET_COSTS(TRB_TARGET("avx512f") static void trb_treelet_costs_avx512)
  #endif

/* Vectors longer than the lanes that are in use would only be slower to start. */
static void trb_treelet_costs(const float *leaves, float *table, float *sums, trbvh_u32 lanes, trb_costs costs) {
  const int simd = trb_simd();
  trbvh_u32 lane;
#ifdef TRB_AVX
  if (simd == 512 && lanes > 8) trb_treelet_costs_avx512(leaves, table, sums, costs);
  else if (simd >= 256)
    for (lane = 0; lane < lanes; lane += 8) trb_treelet_costs_avx2(leaves + lane, table + lane, sums + lane, costs);
#endif
  for (lane = 0; lane < lanes && simd == 128; lane += 4)
    trb_treelet_costs_sse(leaves + lane, table + lane, sums + lane, costs);
}

#elif defined(TRB_VECTOR4)               /* NEON or WebAssembly */
  #define TRB_LANE             TRB_VECTOR4
  #if defined(__wasm_simd128__)
    #define TRB_LANE_LOAD(p)     wasm_v128_load(p)
    #define TRB_LANE_STORE(p, x) wasm_v128_store(p, x)
    #define TRB_LANE_OF(x)       wasm_f32x4_splat(x)
    #define TRB_LANE_ADD(a, b)   wasm_f32x4_add(a, b)
    #define TRB_LANE_SUB(a, b)   wasm_f32x4_sub(a, b)
    #define TRB_LANE_MUL(a, b)   wasm_f32x4_mul(a, b)
    #define TRB_LANE_MIN(a, b)   wasm_f32x4_pmin(b, a)
    #define TRB_LANE_MAX(a, b)   wasm_f32x4_pmax(b, a)
  #else
    #define TRB_LANE_LOAD(p)     vld1q_f32(p)
    #define TRB_LANE_STORE(p, x) vst1q_f32(p, x)
    #define TRB_LANE_OF(x)       vdupq_n_f32(x)
    #define TRB_LANE_ADD(a, b)   vaddq_f32(a, b)
    #define TRB_LANE_SUB(a, b)   vsubq_f32(a, b)
    #define TRB_LANE_MUL(a, b)   vmulq_f32(a, b)
    #define TRB_LANE_MIN(a, b)   trb_neon_min(a, b)
    #define TRB_LANE_MAX(a, b)   trb_neon_max(a, b)
    TRB_CORE float32x4_t trb_neon_min(float32x4_t a, float32x4_t b) { return vbslq_f32(vcltq_f32(a, b), a, b); }
    TRB_CORE float32x4_t trb_neon_max(float32x4_t a, float32x4_t b) { return vbslq_f32(vcgtq_f32(a, b), a, b); }
  #endif
  TRB_DEFINE_TREELET_COSTS(static void trb_treelet_costs_4)

static void trb_treelet_costs(const float *leaves, float *table, float *sums, trbvh_u32 lanes, trb_costs costs) {
  trbvh_u32 lane;
  for (lane = 0; lane < lanes; lane += 4) trb_treelet_costs_4(leaves + lane, table + lane, sums + lane, costs);
}

#elif !defined(TRBVH_OPENCL_C)
  #define TRB_LANE             float
  TRB_DEFINE_TREELET_COSTS(TRB_CORE void trb_treelet_costs_1)

static void trb_treelet_costs(const float *leaves, float *table, float *sums, trbvh_u32 lanes, trb_costs costs) {
  trbvh_u32 lane;
  for (lane = 0; lane < lanes; lane++) trb_treelet_costs_1(leaves + lane, table + lane, sums + lane, costs);
}
#endif

// >>treelets ---- restructuring by dynamic programming (paper, section 3) -------------------------------------------
/* In round r every node of 7 * 2^r references or more becomes the root of a treelet once, after both its children's
 * subtrees have been through round r. Its two children are the first treelet leaves; five times, the one of largest
 * area is replaced by its own children. If the best topology over the seven leaves beats the present one, the root,
 * which keeps its place, gets it; the six pairs of siblings are used again.
 *
 * First come all rounds over the top of the tree, the nodes of more than TRB_TOP references; then all rounds over what
 * is below, the subtrees of up to TRB_BLOCK references, one subtree after the other: so they are read from memory once,
 * not once a round, and are done then. The paper goes through the whole tree round by round; SAH is the same, 0.1 %
 * better on average of 22 meshes, and within 1.6 % on each. Nothing else is said about the order, and nothing depends
 * on it: numbers of nodes never break a tie.
 *
 * On a CPU, roots of one depth are independent, and taken TRB_LANES at a time through the dynamic program. */
typedef struct trb_treelets {
  float     leaves[TRB_TREELET * TRB_LEAF_VALUES * TRB_LANES];
  float     table[TRB_SUBSETS * TRB_LANES + 16]; /* padded: leaves and tables otherwise fall on the same cache sets */
#ifndef TRB_GPU                          /* there, private memory of each lane's */
  float     sums[TRB_SUBSETS * TRB_LANES + 16];
#endif
  trb_u64   slot[TRB_TREELET][TRB_LANES];        /* the treelet leaves: rank for expansion, node */
  trbvh_u32 pair[TRB_TREELET - 1][TRB_LANES];    /* where the children of the expanded nodes stand */
  float     cost[TRB_LANES];                     /* of the present topology */
} trb_treelets;

/* A treelet leaf, whose children are asked for in case it is expanded. */
TRB_CORE trb_u64 trb_slot(const TRB_GLOBAL trbvh_node *nodes, trbvh_u32 node, trbvh_u32 slot) {
  TRB_PREFETCH(&nodes[nodes[node].first]);
  return (trb_u64)trb_expand_key(nodes[node], slot) << 32 | node;
}

/* Replaces a treelet leaf by its children. Returns what that adds to the treelet's cost: a large node's area and the
 * costs of its small children; nothing below a small node, whose cost is known. */
TRB_CORE float trb_expand(const TRB_GLOBAL trbvh_node *nodes, TRB_WORK trb_treelets *t, trbvh_u32 lane, trbvh_u32 step,
                          trbvh_u32 slot, trbvh_u32 node) {
  const trbvh_u32 pair = nodes[node].first, large = (nodes[node].count >> 31) - 1;
  const float cost = trb_area(nodes[node]) + (trb_cost(nodes[pair].count) + trb_cost(nodes[pair + 1].count));
  t->pair[step][lane] = pair;
  t->slot[slot][lane] = trb_slot(nodes, pair, slot);
  t->slot[step + 1][lane] = trb_slot(nodes, pair + 1, step + 1);
  return trb_float(trb_bits(cost) & large);
}

TRB_CORE void trb_start_treelet(const TRB_GLOBAL trbvh_node *nodes, TRB_WORK trb_treelets *t, trbvh_u32 lane, trbvh_u32 root) {
  t->cost[lane] = trb_cost(nodes[root].count) + trb_expand(nodes, t, lane, 0, 0, root);
}

TRB_CORE void trb_expand_largest(const TRB_GLOBAL trbvh_node *nodes, TRB_WORK trb_treelets *t, trbvh_u32 lane,
                                 trbvh_u32 step) {
  trb_u64 best = t->slot[0][lane];
  trbvh_u32 i;
  for (i = 1; i <= step; i++) best = TRB_MAX(t->slot[i][lane], best);
  t->cost[lane] += trb_expand(nodes, t, lane, step, TRB_TREELET - ((trbvh_u32)(best >> 32) & 7u), (trbvh_u32)best);
}

/* Hands treelet leaf i to the dynamic program, which counts costs without the leaves' own. */
TRB_CORE void trb_enter_leaf(const TRB_GLOBAL trbvh_node *nodes, TRB_WORK trb_treelets *t, trbvh_u32 lane, trbvh_u32 i) {
  const TRB_GLOBAL trbvh_node *leaf = &nodes[(trbvh_u32)t->slot[i][lane]];
  TRB_WORK float *value = &t->leaves[i * TRB_LEAF_VALUES * TRB_LANES + lane];
  const float cost = trb_cost(leaf->count);
  value[0 * TRB_LANES] = leaf->min[0];
  value[1 * TRB_LANES] = leaf->min[1];
  value[2 * TRB_LANES] = leaf->min[2];
  value[3 * TRB_LANES] = leaf->max[0];
  value[4 * TRB_LANES] = leaf->max[1];
  value[5 * TRB_LANES] = leaf->max[2];
  value[6 * TRB_LANES] = (float)trb_count(leaf->count);
  value[7 * TRB_LANES] = cost;
  t->cost[lane] -= cost;
}

/* The six pairs a treelet may use, last one first: a sorting network. */
TRB_SHARED void trb_sort_pairs(const TRB_WORK trb_treelets *t, trbvh_u32 lane, trbvh_u32 pairs[TRB_TREELET - 1]) {
  trbvh_u32 a = t->pair[0][lane], b = t->pair[1][lane], c = t->pair[2][lane];
  trbvh_u32 d = t->pair[3][lane], e = t->pair[4][lane], f = t->pair[5][lane], less;
  #define TRB_ORDER(x, y) less = TRB_MIN(x, y); x = TRB_MAX(x, y); y = less;
  TRB_ORDER(a, f) TRB_ORDER(b, d) TRB_ORDER(c, e)
  TRB_ORDER(b, c) TRB_ORDER(d, e)
  TRB_ORDER(a, d) TRB_ORDER(c, f)
  TRB_ORDER(a, b) TRB_ORDER(c, d) TRB_ORDER(e, f)
  TRB_ORDER(b, c) TRB_ORDER(d, e)
  #undef TRB_ORDER
  pairs[0] = a; pairs[1] = b; pairs[2] = c; pairs[3] = d; pairs[4] = e; pairs[5] = f;
}

/* Gives the root of a treelet the best topology. The last pairs go to the nodes next to the root, right before left. */
TRB_SHARED void trb_rebuild_treelet(TRB_GLOBAL trbvh_node *nodes, const TRB_WORK trb_treelets *t, const float *sums,
                                    trbvh_u32 lane, trbvh_u32 root, trb_costs costs) {
  trbvh_node leaf[TRB_TREELET];
  trbvh_u32 pairs[TRB_TREELET - 1], node[TRB_TREELET - 1], i, side, waiting = 0;
  trbvh_u32 stack_node[TRB_TREELET], stack_subset[TRB_TREELET];
  for (i = 0; i < TRB_TREELET; i++) leaf[i] = nodes[(trbvh_u32)t->slot[i][lane]];
  trb_sort_pairs(t, lane, pairs);
  stack_node[waiting] = root;
  stack_subset[waiting++] = TRB_SUBSETS - 1;
  for (i = 0; waiting; i++) {                        /* inner nodes from the root down, their children at pairs[i] */
    trbvh_u32 subset = stack_subset[--waiting], part = trb_partition(t->table + lane, sums, subset);
    node[i] = stack_node[waiting];
    for (side = 0; side < 2; side++, part ^= subset) {
      if (TRB_SINGLE(part)) {
        nodes[pairs[i] + side] = leaf[trb_log2(part)];
      } else {
        stack_node[waiting] = pairs[i] + side;
        stack_subset[waiting++] = part;
      }
    }
  }
  while (i--) nodes[node[i]] = trb_parent(nodes[pairs[i]], nodes[pairs[i] + 1], pairs[i], costs);
}

/* After the dynamic program: the better topology, if there is one. */
TRB_CORE void trb_finish_treelet(TRB_GLOBAL trbvh_node *nodes, TRB_WORK trb_treelets *t, const float *sums, trbvh_u32 lane,
                                 trbvh_u32 root, trb_costs costs) {
  float best = t->table[(TRB_SUBSETS - 1) * TRB_LANES + lane];
  TRB_GLOBAL trbvh_node *node = &nodes[root];
  if (trb_improves(best, t->cost[lane])) trb_rebuild_treelet(nodes, t, sums, lane, root, costs);
  else if (trb_count(node->count) <= costs.max_leaf)           /* cheaper all the same, if a subtree below is */
    *node = trb_parent(nodes[node->first], nodes[node->first + 1], node->first, costs);
}

#if !defined(TRBVH_OPENCL_C) || defined(TRB_CPU)
/* Up to TRB_LANES roots, none above another. Steps outside, lanes inside, so that one lane's cache misses hide behind
 * the others' work. */
TRB_SHARED void trb_restructure(TRB_GLOBAL trbvh_node *nodes, TRB_WORK trb_treelets *t, const TRB_GLOBAL trbvh_u32 *roots,
                                trbvh_u32 lanes, trb_costs costs) {
  trbvh_u32 lane, i;
  for (lane = 0; lane < lanes; lane++) trb_start_treelet(nodes, t, lane, roots[lane]);
  for (i = 1; i < TRB_TREELET - 1; i++)
    for (lane = 0; lane < lanes; lane++) trb_expand_largest(nodes, t, lane, i);
  for (i = 0; i < TRB_TREELET; i++)
    for (lane = 0; lane < lanes; lane++) trb_enter_leaf(nodes, t, lane, i);
  trb_treelet_costs(t->leaves, t->table, t->sums, lanes, costs);
  for (lane = 0; lane < lanes; lane++) trb_finish_treelet(nodes, t, t->sums + lane, lane, roots[lane], costs);
}
#endif

/* Scratch memory: four words a reference, free once the hierarchy is built. */
typedef struct trb_words { TRB_GLOBAL trbvh_u32 *plane[4]; } trb_words;

/* Made of two arrays of 64-bit values, with room for `count` each. */
TRB_CORE trb_words trb_split_words(TRB_GLOBAL trb_u64 *low, TRB_GLOBAL trb_u64 *high, size_t count) {
  trb_words w;
  w.plane[0] = (TRB_GLOBAL trbvh_u32 *)low;
  w.plane[1] = w.plane[0] + count;
  w.plane[2] = (TRB_GLOBAL trbvh_u32 *)high;
  w.plane[3] = w.plane[2] + count;
  return w;
}

#if !defined(TRBVH_OPENCL_C) || defined(TRB_CPU)
/* All nodes of at least `smallest` references below the seeds: listed level by level, and restructured from the last
 * level up. The words of these references are used, from number `first` on, with the seeds at the start of the first
 * plane. */
TRB_SHARED void trb_restructure_below(TRB_GLOBAL trbvh_node *nodes, trb_words words, trbvh_u32 first, trbvh_u32 seeds,
                                      trbvh_u32 smallest, trb_costs costs) {
  TRB_GLOBAL trbvh_u32 *list = words.plane[0] + first, *level = words.plane[1] + first;
  trbvh_u32 levels = 0, count = seeds, end = 0, i, k;
  TRB_ALIGNED(trb_treelets) t;
  if (seeds == 0) return;                            /* there may be no words at all */
  for (i = 0; i < TRB_TREELET * TRB_LEAF_VALUES * TRB_LANES; i++) t.leaves[i] = 0;
  for (i = 0; end < count; end = i) {
    level[levels++] = end = i;
    for (k = count; i < k; i++) {
      const trbvh_u32 pair = nodes[list[i]].first;
      TRB_PREFETCH(&nodes[nodes[pair].first]);
      TRB_PREFETCH(&nodes[nodes[pair + 1].first]);
      list[count] = pair;
      count += trb_count(nodes[pair].count) >= smallest;
      list[count] = pair + 1;
      count += trb_count(nodes[pair + 1].count) >= smallest;
    }
  }
  while (levels--) {
    for (i = level[levels]; i < count; i += k) {
      k = TRB_MIN(TRB_LANES, count - i);
      trb_restructure(nodes, &t, list + i, k, costs);
    }
    count = level[levels];
  }
}

/* What comes first: the top of the tree. */
TRB_SHARED void trb_restructure_top(TRB_GLOBAL trbvh_node *nodes, trb_words words, trbvh_u32 rounds, trb_costs costs) {
  for (; rounds && trb_count(nodes[0].count) > TRB_TOP; rounds--) {
    words.plane[0][0] = 0;
    trb_restructure_below(nodes, words, 0, 1, TRB_TOP + 1, costs);
  }
}
#endif

// >>moves ---- beyond the paper: subtrees move to better places, by exact differences of area -----------------------
/* A batch of moves is searched for in a tree that stands still, each by itself; of those that touch the same pairs of
 * siblings the one that gains most stays, among equal ones the first; what is left happens at once, and the boxes above
 * are made anew. So nothing depends on the order in which anything is done. A move touches three pairs: that of the
 * node which goes away, that of its parent, whose place its sibling takes, and that of its target.
 *
 * Every node above a move counts its references. Nodes that are better as leaves stay whole: what is below one of them
 * does not go away, and is nobody's target. */
typedef struct trb_move {
  trbvh_u32 node, target;                /* what goes away; what it is to be the sibling of, or to be merged with */
  trbvh_u32 above;                       /* above both when the move was found */
  float     gain;                        /* in half areas; 0: no move; negative: it was one, but had to stand back */
} trb_move;

TRB_CORE trb_move trb_no_move(void) {
  trb_move none;
  none.node = none.target = none.above = 0;
  none.gain = 0;
  return none;
}

typedef struct trb_mover {
  TRB_GLOBAL trbvh_node *nodes;
  TRB_GLOBAL trbvh_node *refs;           /* where triangles are split: each one's count tells where it is; else NULL */
  TRB_GLOBAL trbvh_u32  *parents;        /* by pair: the node above it */
  TRB_GLOBAL trbvh_u32  *scores;         /* by pair: of both its nodes, while candidates are looked for */
  TRB_GLOBAL trb_move   *moves;          /* candidates; at most TRB_MOVES_MAX */
  TRB_GLOBAL trbvh_u32  *owners;         /* by pair: the move that may touch it, TRBVH_NONE outside of a batch ... */
  TRB_GLOBAL trbvh_u32  *list;           /* ... and nodes whose boxes are to be made anew */
  trb_costs  costs;
} trb_mover;
#define TRB_MOVES_MAX(refs) ((refs) / 4)

/* The scratch memory's four planes, free between the stages, and used so: parents, moves, owners, scores and list. */
TRB_CORE trb_mover trb_start_moves(TRB_GLOBAL trbvh_node *nodes, TRB_GLOBAL trbvh_node *refs, trb_words words, trb_costs costs) {
  trb_mover m;
  m.nodes = nodes;
  m.refs = refs;
  m.parents = words.plane[0];
  m.moves = (TRB_GLOBAL trb_move *)words.plane[1];
  m.owners = words.plane[2];
  m.scores = m.list = words.plane[3];
  m.costs = costs;
  return m;
}

/* Pairs that a merge has freed count nothing. */
TRB_CORE int trb_is_free(trbvh_node n)  { return n.count == 0; }
TRB_CORE int trb_is_inner(trbvh_node n) { return !trb_is_free(n) && !trb_is_single(n.count); }

/* Puts a node into a slot, and tells those who know where it is. */
TRB_CORE void trb_put(const trb_mover *m, trbvh_u32 slot, trbvh_node node) {
  m->nodes[slot] = node;
  if (!trb_is_single(node.count)) m->parents[node.first / 2] = slot;
  else if (m->refs) m->refs[node.first].count = slot;
}

/* The box around two. */
TRB_CORE trbvh_node trb_join(trbvh_node a, trbvh_node b) {
  a.min[0] = TRB_MIN(a.min[0], b.min[0]); a.max[0] = TRB_MAX(a.max[0], b.max[0]);
  a.min[1] = TRB_MIN(a.min[1], b.min[1]); a.max[1] = TRB_MAX(a.max[1], b.max[1]);
  a.min[2] = TRB_MIN(a.min[2], b.min[2]); a.max[2] = TRB_MAX(a.max[2], b.max[2]);
  return a;
}

/* Makes an inner node anew from its children. */
TRB_CORE void trb_remake(TRB_GLOBAL trbvh_node *nodes, trbvh_u32 node, trb_costs costs) {
  const trbvh_u32 pair = nodes[node].first;
  nodes[node] = trb_parent(nodes[pair], nodes[pair + 1], pair, costs);
}

// ---- Conflicts ----
TRB_CORE void trb_touched_pairs(const trb_mover *m, trb_move move, trbvh_u32 pairs[3]) {
  pairs[0] = move.node / 2;
  pairs[1] = m->parents[move.node / 2] / 2;
  pairs[2] = move.target / 2;
}

/* Does move i own all that it touches? */
TRB_CORE int trb_owns(const trb_mover *m, trbvh_u32 i) {
  trbvh_u32 pairs[3];
  trb_touched_pairs(m, m->moves[i], pairs);
  return m->owners[pairs[0]] == i && m->owners[pairs[1]] == i && m->owners[pairs[2]] == i;
}

TRB_CORE int trb_precedes(const trb_mover *m, trbvh_u32 i, trbvh_u32 k) {
  return m->moves[i].gain > m->moves[k].gain || (m->moves[i].gain == m->moves[k].gain && i < k);
}

/* Two moves could each take the other one's target along, and cut both off from the tree. One that would go into a
 * subtree which itself goes elsewhere, by a move that precedes it, does not. */
#define TRB_STAYS 0x80000000u            /* in a move's node: it owns all that it touches, but is not to happen */

TRB_CORE int trb_follows(const trb_mover *m, trbvh_u32 i) {
  trbvh_u32 node = m->moves[i].target;
  for (; node != m->moves[i].above && node; node = m->parents[node / 2]) {
    const trbvh_u32 other = m->owners[node / 2];
    if (other != TRBVH_NONE && other != i && m->moves[other].gain > 0 && (m->moves[other].node & ~TRB_STAYS) == node &&
        trb_precedes(m, other, i)) return 1;
  }
  return 0;
}

#if !defined(TRBVH_OPENCL_C) || defined(TRB_CPU)
TRB_CORE void trb_claim(const trb_mover *m, trbvh_u32 i) {
  trbvh_u32 pairs[3], k;
  trb_touched_pairs(m, m->moves[i], pairs);
  for (k = 0; k < 3; k++) {
    const trbvh_u32 owner = m->owners[pairs[k]];
    if (owner == TRBVH_NONE || trb_precedes(m, i, owner)) m->owners[pairs[k]] = i;
  }
}

/* Leaves the moves of a batch that are to happen with their gain, all others with none or a negative one. */
TRB_SHARED void trb_choose_moves(const trb_mover *m, trbvh_u32 count) {
  trbvh_u32 pairs[3], i, k;
  for (i = 0; i < count; i++)
    if (m->moves[i].gain > 0) trb_claim(m, i);
  for (i = 0; i < count; i++)
    if (m->moves[i].gain > 0 && !trb_owns(m, i)) m->moves[i].gain = -m->moves[i].gain;
  for (i = 0; i < count; i++)
    if (m->moves[i].gain > 0 && trb_follows(m, i)) m->moves[i].node |= TRB_STAYS;
  for (i = 0; i < count; i++) {
    TRB_GLOBAL trb_move *move = &m->moves[i];
    if (move->gain == 0) continue;
    if (move->node & TRB_STAYS) {
      move->node &= ~TRB_STAYS;
      move->gain = -move->gain;
    }
    trb_touched_pairs(m, *move, pairs);
    for (k = 0; k < 3; k++) m->owners[pairs[k]] = TRBVH_NONE;
  }
}

/* Lists the nodes above a slot, from below, up to one that is listed already. */
TRB_CORE trbvh_u32 trb_list_above(const trb_mover *m, trbvh_u32 slot, trbvh_u32 count) {
  while (slot) {
    TRB_GLOBAL trbvh_u32 *listed;
    slot = m->parents[slot / 2];
    listed = &m->owners[m->nodes[slot].first / 2];
    if (*listed != TRBVH_NONE) break;
    *listed = 0;
    m->list[count++] = slot;
  }
  return count;
}

TRB_CORE void trb_remake_listed(const trb_mover *m, trbvh_u32 begin, trbvh_u32 end) {
  for (; begin < end; begin++) {
    const trbvh_u32 node = m->list[begin];
    m->owners[m->nodes[node].first / 2] = TRBVH_NONE;
    trb_remake(m->nodes, node, m->costs);
  }
}

/* Makes all boxes above what has moved anew, each once: a later move's list ends below a node of an earlier one's. */
TRB_SHARED void trb_remake_moved(const trb_mover *m, trbvh_u32 count) {
  trbvh_u32 listed = 0, i;
  for (i = 0; i < count; i++) {
    TRB_GLOBAL trb_move *move = &m->moves[i];
    const trb_move moved = *move;
    if (!(moved.gain > 0)) continue;
    move->target = listed;               /* where its lists begin */
    move->above = listed = trb_list_above(m, moved.target, listed);
    listed = trb_list_above(m, moved.above, listed);
  }
  while (i--) {
    TRB_GLOBAL trb_move *move = &m->moves[i];
    if (!(move->gain > 0)) continue;
    trb_remake_listed(m, move->above, listed);
    trb_remake_listed(m, move->target, move->above);
    listed = move->target;
    move->gain = 0;
  }
}
#endif

// >>reinsertion ---- (Bittner, Hapala and Havran 2013; Meister and Bittner 2018) ------------------------------------
/* Treelets change what is near; a subtree that would be better off far away is taken out and put back where the sum of
 * all areas grows least. Of the candidates, a given share of all references, every fourth one is searched for at a time,
 * together with those that had to stand back the time before.
 *
 * Candidates are the nodes of the highest score, which is how much smaller than its parent a node is, more where parent
 * and children differ more. Scores are counted by buckets; the highest that hold the share, whole, are taken. */
#define TRB_MOVE_BATCHES 4u
#define TRB_SCORES       2048u           /* buckets, by exponent and three bits more: two scores to a word */
#define TRB_SCORE_SHIFT  20
#define TRB_SEARCH_STEPS 64u             /* pairs looked at in one search, at most; and so many wait */
#define TRB_SEARCHES     256u            /* candidates that a job looks at ... */
#define TRB_MOVES        1024u           /* ... and that it moves */

TRB_CORE trbvh_u32 trb_score(float above, float area, float both) {
  const float tame = TRB_MIN(both, 1 / TRB_TINY), ratio = above * trb_reciprocal(TRB_MAX(tame, TRB_TINY));
  const float score = (above - area) * ratio;
  return score > 0 ? trb_bits(TRB_MIN(score, FLT_MAX)) >> TRB_SCORE_SHIFT : 0;       /* not where areas overflow to NaN */
}

/* Tells the children of a pair's nodes where those are, and scores the pair, whose parent's box is the one around both;
 * returns both scores. The root's children are scored like others, and never move. */
TRB_CORE trbvh_u32 trb_score_pair(const trb_mover *m, trbvh_u32 pair) {
  const trbvh_node left = m->nodes[2 * pair], right = m->nodes[2 * pair + 1];
  const trbvh_node parent = trb_parent(left, right, 0, m->costs);
  trbvh_u32 scores = 0;
  if (!trb_is_free(left) && !trb_is_leaf(parent.count)) {
    const float above = trb_area(parent), l = trb_area(left), r = trb_area(right);
    scores = trb_score(above, l, l + r) << 16 | trb_score(above, r, l + r);
  }
  if (trb_is_inner(left)) m->parents[left.first / 2] = 2 * pair;
  if (trb_is_inner(right)) m->parents[right.first / 2] = 2 * pair + 1;
  m->scores[pair] = scores;
  return scores;
}

/* The lowest bucket to take candidates from, for at least `wanted` of them, where there are so many. */
TRB_CORE trbvh_u32 trb_lowest_score(const TRB_GLOBAL trbvh_u32 *histogram, trbvh_u32 wanted) {
  trbvh_u32 lowest = TRB_SCORES, found = 0;
  while (lowest > 1 && found < wanted) found += histogram[--lowest];
  return lowest;
}

/* What a move has to gain, at least. */
TRB_CORE float trb_least_gain(trbvh_u32 lowest) { return trb_float(lowest << TRB_SCORE_SHIFT) * 0.0625f; }

/* The best other place for a node. Up from its parent; at every node on the way, `saved` is what the areas of those
 * below it shrink by when the node goes away, its parent's vanishing. From there down into the other child's subtree,
 * where a node's box grows if something comes in: `rest` is what is left of the gain above a pair, less the area of the
 * parent that the node will get, which is no smaller than its own. */
TRB_SHARED trb_move trb_find_place(const trb_mover *m, trbvh_u32 node, float least) {
  const trbvh_node n = m->nodes[node];
  const float area = trb_area(n);
  const trbvh_u32 parent = m->parents[node / 2];
  trbvh_u32 pivot = parent, other = node ^ 1u, steps = TRB_SEARCH_STEPS, waiting, side, k;
  struct { float rest; trbvh_u32 pair; } stack[TRB_SEARCH_STEPS + 1];
  trbvh_node without = m->nodes[other];              /* the pivot without the node */
  float saved = trb_area(m->nodes[parent]);
  int shrinks = 1;
  trb_move best;
  best.node = node;
  best.target = best.above = 0;
  best.gain = least;
  while (shrinks || saved - area > best.gain) {
    const trbvh_node there = m->nodes[other];
    const float joint = trb_area(trb_join(there, n)), rest = saved - joint + trb_area(there);
    waiting = 0;
    if (pivot != parent && saved - joint > best.gain) {
      best.gain = saved - joint;
      best.target = other;
      best.above = pivot;
    }
    if (!trb_is_leaf(there.count) && rest - area > best.gain) {
      stack[waiting].rest = rest;
      stack[waiting++].pair = there.first;
    }
    while (waiting && steps) {
      const float above = stack[--waiting].rest;
      const trbvh_u32 pair = stack[waiting].pair;
      float below[2];
      if (!(above - area > best.gain)) continue;
      steps--;
      for (side = 0; side < 2; side++) {
        const trbvh_node child = m->nodes[pair + side];
        const float both = trb_area(trb_join(child, n));
        below[side] = trb_is_leaf(child.count) ? 0 : above - both + trb_area(child);
        if (above - both > best.gain) {
          best.gain = above - both;
          best.target = pair + side;
          best.above = pivot;
        }
      }
      for (side = below[1] > below[0], k = 0; k < 2; k++) {    /* the better one is looked at first */
        side ^= 1u;
        if (below[side] - area > best.gain) {
          stack[waiting].rest = below[side];
          stack[waiting++].pair = m->nodes[pair + side].first;
        }
      }
    }
    if (pivot != parent) {
      const float whole = trb_area(m->nodes[pivot]);
      if (shrinks) {
        without = trb_join(without, there);
        saved += whole - trb_area(without);
        shrinks = trb_area(without) < whole;
      }
      if (pivot && saved - whole > best.gain) {
        best.gain = saved - whole;
        best.target = pivot;
        best.above = m->parents[pivot / 2];
      }
    }
    if (pivot == 0) break;
    other = pivot ^ 1u;
    pivot = m->parents[pivot / 2];
  }
  if (!best.target) best.gain = 0;
  return best;
}

/* Candidate i in a batch. The root's children have no other place. */
TRB_CORE void trb_search(const trb_mover *m, trbvh_u32 i, trbvh_u32 batch, float least) {
  TRB_GLOBAL trb_move *move = &m->moves[i];
  const trbvh_u32 node = move->node;
  const int due = i % TRB_MOVE_BATCHES == batch || move->gain < 0;
  move->gain = 0;
  if (due && m->parents[node / 2]) *move = trb_find_place(m, node, least);
}

/* Takes a node out and puts it next to its target. Afterwards the move tells below which nodes something has changed. */
TRB_CORE void trb_reinsert(const trb_mover *m, TRB_GLOBAL trb_move *move) {
  const trbvh_u32 slot = move->target, pair = move->node & ~1u, parent = m->parents[pair / 2];
  const trbvh_node node = m->nodes[move->node], sibling = m->nodes[move->node ^ 1u], target = m->nodes[slot];
  trb_put(m, parent, sibling);
  trb_put(m, pair, node);
  trb_put(m, pair + 1, target);
  trb_put(m, slot, trb_parent(node, target, pair, m->costs));
  move->target = pair;
  move->above = parent;
}

/* Candidates among the pairs first..end - 1: how many there are; and into the list, from number `at` on. */
TRB_SHARED trbvh_u32 trb_count_candidates(const trb_mover *m, trbvh_u32 first, trbvh_u32 end, trbvh_u32 lowest) {
  trbvh_u32 count = 0;
  for (; first < end; first++) {
    count += m->scores[first] >> 16 >= lowest;
    count += (m->scores[first] & 0xFFFFu) >= lowest;
  }
  return count;
}

TRB_SHARED void trb_list_candidates(const trb_mover *m, trbvh_u32 first, trbvh_u32 end, trbvh_u32 lowest, trbvh_u32 at,
                                    trbvh_u32 most) {
  trbvh_u32 side;
  for (; first < end; first++)
    for (side = 0; side < 2; side++)
      if ((m->scores[first] >> (side ? 0 : 16) & 0xFFFFu) >= lowest && at < most) {
        m->moves[at].node = 2 * first + side;
        m->moves[at++].gain = 0;
      }
}

// >>unsplit ---- splits that do not pay are taken back ----------------------------------------------------------------
/* Splits are spent before there is a tree, on what they may gain. Once there is one, every two neighbouring references
 * of a triangle are looked at: one goes away, and the other one's box grows around it, where that makes the expected
 * cost less. Pieces that could all go together may each seem worth keeping: what is saved counts TRB_UNSPLIT_BIAS times.
 * Grown leaves then want to be reinserted.
 *
 * While a tree with splits is worked on, its leaves hold references, those of a triangle in a row among refs, in the
 * order of its splits; the primitive takes their place in the end. */
#define TRB_UNSPLIT_BIAS 2.0f

/* One of the two sides of a merge, on its way up from a leaf to the lowest node above both. */
typedef struct trb_climb {
  trbvh_u32  slot, below;                /* a node above the leaf, its child on the way */
  trbvh_u32  height;
  trbvh_node without;                    /* that node without the leaf */
  float      saved, grown;               /* what costs shrink by when the leaf goes away; what they grow by when the other one comes in */
} trb_climb;

TRB_CORE trb_climb trb_start_climb(trbvh_u32 slot, trbvh_node leaf) {
  trb_climb c;
  c.slot = c.below = slot;
  c.height = 0;
  c.without = leaf;
  c.saved = c.grown = 0;
  return c;
}

/* Accounts for a node that turns out not to be above both, and leaves it. */
TRB_CORE void trb_climb_on(const trb_mover *m, trb_climb *c, trbvh_node leaf) {
  const trbvh_node n = m->nodes[c->slot];
  const float area = trb_area(n), weight = c->height == 0 ? m->costs.ratio : 1;
  c->grown += weight * (trb_area(trb_join(n, leaf)) - area);
  if (c->height == 0) {
    c->saved = weight * area;
  } else if (c->height == 1) {           /* the parent vanishes with it */
    c->saved += area;
    c->without = m->nodes[c->below ^ 1u];
  } else {
    c->without = trb_join(c->without, m->nodes[c->below ^ 1u]);
    c->saved += area - trb_area(c->without);
  }
  c->height++;
  c->below = c->slot;
  c->slot = m->parents[c->slot / 2];
}

/* The better way to merge two references of a triangle. The smaller of two nodes cannot be above the other one. */
TRB_SHARED trb_move trb_find_merge(const trb_mover *m, trbvh_u32 left, trbvh_u32 right) {
  const trbvh_u32 left_slot = m->refs[left].count, right_slot = m->refs[right].count;
  const trbvh_node left_leaf = m->nodes[left_slot], right_leaf = m->nodes[right_slot];
  trb_climb l = trb_start_climb(left_slot, left_leaf), r = trb_start_climb(right_slot, right_leaf);
  float keep_left, keep_right;
  trb_move merge;
  while (l.slot != r.slot) {
    if (trb_count(m->nodes[l.slot].count) <= trb_count(m->nodes[r.slot].count)) trb_climb_on(m, &l, right_leaf);
    else trb_climb_on(m, &r, left_leaf);
  }
  if (l.height == 1) l.saved += trb_area(m->nodes[l.slot]);
  if (r.height == 1) r.saved += trb_area(m->nodes[r.slot]);
  keep_left = TRB_UNSPLIT_BIAS * r.saved - l.grown;
  keep_right = TRB_UNSPLIT_BIAS * l.saved - r.grown;
  merge.node = keep_left >= keep_right ? right_slot : left_slot;
  merge.target = keep_left >= keep_right ? left_slot : right_slot;
  merge.above = merge.target;            /* no subtree moves, so that nothing can be cut off */
  merge.gain = TRB_MAX(keep_left, keep_right);
  merge.gain = TRB_MAX(merge.gain, 0.0f);
  return merge;
}

/* Where a reference is: tells refs, and marks those that are nowhere. */
TRB_CORE void trb_find_ref(const trb_mover *m, trbvh_u32 slot) {
  const trbvh_node n = m->nodes[slot];
  if (slot == 1 || trb_is_free(n)) return;
  if (trb_is_single(n.count)) m->refs[n.first].count = slot;
  else m->parents[n.first / 2] = slot;
}

/* The merge of reference i and the next one of its triangle that is still there; of every fourth one in a batch. */
TRB_CORE trb_move trb_search_merge(const trb_mover *m, trbvh_u32 i, trbvh_u32 slots) {
  const trbvh_u32 prim = m->refs[i].first;
  trbvh_u32 next = i + 1;
  if (prim == TRBVH_NONE || m->refs[i].count == TRBVH_NONE) return trb_no_move();
  while (next < slots && m->refs[next].first == prim && m->refs[next].count == TRBVH_NONE) next++;
  return next < slots && m->refs[next].first == prim ? trb_find_merge(m, i, next) : trb_no_move();
}

/* Takes a leaf away, its sibling getting their parent's place, and grows another one. Afterwards the move tells below
 * which nodes something has changed. */
TRB_CORE void trb_merge_refs(const trb_mover *m, TRB_GLOBAL trb_move *move) {
  const trbvh_u32 pair = move->node & ~1u, parent = m->parents[pair / 2];
  const trbvh_node gone = m->nodes[move->node];
  trbvh_node grown = trb_join(m->nodes[move->target], gone);
  grown = trb_reference(grown, m->costs);
  m->nodes[move->target] = grown;
  trb_put(m, parent, m->nodes[move->node ^ 1u]);
  m->refs[gone.first].count = TRBVH_NONE;
  m->nodes[pair].count = m->nodes[pair + 1].count = 0;
  if (move->target == (move->node ^ 1u)) move->target = parent;
  move->above = parent;
}

/* A move of either kind, if it is to happen. */
TRB_CORE void trb_make_move(const trb_mover *m, trbvh_u32 i, trbvh_u32 merges) {
  TRB_GLOBAL trb_move *move = &m->moves[i];
  if (!(move->gain > 0)) return;
  if (merges) trb_merge_refs(m, move);
  else trb_reinsert(m, move);
}

// ---- Do splits pay at all? ----
/* Where nearly all that they save is tests of triangles, they cost time: nodes are more, and further apart in memory. So
 * a tree with splits is kept only where it is better by TRB_SPLITS_PAY than the one without, both before their last
 * round, in equation 1's sum with triangles that count half. Its terms are rounded to integers, so that their order does
 * not matter. */
#define TRB_SPLITS_PAY 0.98

/* The power of two that takes the largest term, a root that may be a leaf, to 31 bits. */
TRB_CORE float trb_cost_unit(trbvh_node root, trb_costs costs) {
  return trb_unit(trb_area(root) * TRB_MAX(1.0f, 0.5f * costs.ratio * TRB_MAX_LEAF), 31);
}

TRB_CORE trbvh_u32 trb_round_cost(float cost) { return (trbvh_u32)TRB_MIN(cost, 2147483520.0f); }   /* areas may be infinite, or NaN */

TRB_CORE trbvh_u32 trb_leaf_cost(trbvh_node n, float unit, trb_costs costs) {
  return trb_is_leaf(n.count) ? trb_round_cost(unit * trb_area(n) * (0.5f * costs.ratio * (float)trb_count(n.count))) : 0;
}

/* The part of a pair's parent in it, and of the pair's leaves; none below a leaf. */
TRB_CORE trb_u64 trb_pair_cost(const TRB_GLOBAL trbvh_node *nodes, trbvh_u32 pair, float unit, trb_costs costs) {
  const trbvh_node left = nodes[2 * pair], right = nodes[2 * pair + 1];
  const trbvh_node parent = trb_parent(left, right, 0, costs);
  if (trb_is_free(left) || trb_is_leaf(parent.count)) return 0;
  return (trb_u64)trb_round_cost(unit * trb_area(parent)) + trb_leaf_cost(left, unit, costs) + trb_leaf_cost(right, unit, costs);
}

// >>collapse ---- subtrees that are cheaper as leaves become leaves, and the tree moves into its final layout --------
/* The part of prims[] and triangles[] that a leaf holds. */
typedef struct trb_held { trbvh_u32 first, count; } trb_held;

/* Every small node knows already whether it is better as a leaf (equation 2, trb_parent); the topmost such nodes
 * become leaves. The result has parents before children and right before left: a pair of siblings, all that is below
 * the right one, all that is below the left one; and so have their primitives.
 *
 * Subtrees of up to TRB_BLOCK references are tasks. A task's subtree is settled as soon as it has been through its
 * rounds, while it is in a cache: a walk from the root down turns nodes into what they will be in the result, and lists
 * them in its order. When all are settled, the result is allocated, prefix sums tell every task its place, and the
 * listed nodes are copied there, without a look at what is in them. A final tree (>>hierarchy) has nothing to settle:
 * its pairs have been made in the opposite order, and its primitives are in the opposite order of the keys.
 *
 * The depth bound: a node at depth d with n references can always be made a balanced subtree that ends at depth
 * d + ceil(log2 n). Where a child could no longer be made so within TRBVH_MAX_DEPTH, its parent still can, and is. As
 * this holds at the root, it holds everywhere. */
typedef struct trb_collapser {
  TRB_GLOBAL trbvh_node *nodes;
  trb_words words;
  trb_costs costs;
  float     cost_node, cost_prim;
  const TRB_GLOBAL trbvh_node *refs;     /* where triangles are split: what leaves refer to, several maybe to one primitive */
  const TRB_GLOBAL trb_u64 *keys;        /* sorted, of a final tree: ref_count, of this form */
  trb_key_form form;
  trbvh_u32    ref_count;
  const TRB_GLOBAL trb_held *held;       /* of a tree that is optimized: what its leaves hold; else NULL */
  TRB_GLOBAL trbvh_node *out;            /* the result, once it is allocated */
  TRB_GLOBAL trbvh_u32  *prims;
} trb_collapser;

/* Makes the subtree of a node, the first of whose references is the first_ref-th of the tree, a balanced one. In place:
 * a reference that stands where another one has to go changes places with it, and is known by its number, in count. */
TRB_SHARED void trb_balance(const trb_collapser *c, trbvh_u32 node, trbvh_u32 first_ref) {
  TRB_GLOBAL trbvh_u32 *at = c->words.plane[1] + first_ref, *pair = c->words.plane[2] + first_ref;
  TRB_GLOBAL trbvh_u32 *root = c->words.plane[3] + first_ref, *stack = root;
  trbvh_u32 slot[TRBVH_MAX_DEPTH], first[TRBVH_MAX_DEPTH], count[TRBVH_MAX_DEPTH];
  trbvh_u32 refs = 0, pairs = 0, waiting = 0, i, side;
  stack[waiting++] = node;
  while (waiting) {                                  /* takes it apart */
    trbvh_u32 next = stack[--waiting], below = c->nodes[next].first;
    if (trb_is_single(c->nodes[next].count)) {
      c->nodes[next].count = refs;
      at[refs++] = next;
    } else {
      c->nodes[next].count = TRBVH_NONE;
      pair[pairs++] = below;
      stack[waiting++] = below + 1;
      stack[waiting++] = below;
    }
  }
  TRBVH_ASSERT(pairs + 1 == refs);
  slot[0] = node;
  first[0] = 0;
  count[0] = refs;
  for (i = 0, waiting = 1; waiting; i++) {           /* halves it, parents before children */
    trbvh_u32 begin = first[--waiting], all = count[waiting];
    root[i] = slot[waiting];
    for (side = 0; side < 2; side++) {
      trbvh_u32 left = all / 2, part = side ? all - left : left, ref = begin + (side ? left : 0), to = pair[i] + side;
      if (part == 1) {
        trbvh_node there = c->nodes[to];
        c->nodes[to] = trb_reference(c->nodes[at[ref]], c->costs);
        if (to != at[ref]) {
          c->nodes[at[ref]] = there;
          if (there.count != TRBVH_NONE) at[there.count] = at[ref];
        }
      } else {
        slot[waiting] = to;
        first[waiting] = ref;
        count[waiting++] = part;
      }
    }
  }
  while (i--) c->nodes[root[i]] = trb_parent(c->nodes[pair[i]], c->nodes[pair[i] + 1], pair[i], c->costs);
}

TRB_CORE int trb_too_deep(trbvh_u32 depth, trbvh_u32 word) {
  trbvh_u32 count = trb_count(word);
  return count > 1 && depth + trb_log2(count - 1) + 1 > TRBVH_MAX_DEPTH;
}

/* Node i, at this depth, once its children can stay within the bound. No tree of 2^31 references needs looking at
 * above half of it. */
TRB_CORE trbvh_node trb_bounded_node(const trb_collapser *c, trbvh_u32 i, trbvh_u32 depth, trbvh_u32 first_ref) {
  trbvh_node node = c->nodes[i];
  if (depth >= TRBVH_MAX_DEPTH / 2 && !trb_is_leaf(node.count) &&
      (trb_too_deep(depth + 1, c->nodes[node.first].count) || trb_too_deep(depth + 1, c->nodes[node.first + 1].count))) {
    trb_balance(c, i, first_ref);
    node = c->nodes[i];
  }
  return node;
}

/* The primitives of a leaf, each once; returns how many. */
TRB_CORE trbvh_u32 trb_leaf_prims(const trb_collapser *c, trbvh_node leaf, trbvh_u32 prims[TRB_MAX_LEAF]) {
  trbvh_u32 stack[TRB_MAX_LEAF], waiting = 0, count = 0, i;
  for (;;) {
    if (!trb_is_single(leaf.count)) {
      stack[waiting++] = leaf.first;
      leaf = c->nodes[leaf.first + 1];
      continue;
    }
    if (c->refs) leaf.first = c->refs[leaf.first].first;
    for (i = 0; c->refs && i < count && prims[i] != leaf.first; i++) {}
    if (!c->refs || i == count) prims[count++] = leaf.first;
    if (waiting == 0) return count;
    leaf = c->nodes[stack[--waiting]];
  }
}

/* A node's part in equation 1's sum, with half areas. */
TRB_CORE TRB_REAL trb_sah_term(trbvh_node node, TRB_REAL weight) { return weight * trb_area(node); }
TRB_CORE TRB_REAL trb_leaf_term(const trb_collapser *c, trbvh_node leaf, trbvh_u32 prims) {
  return trb_sah_term(leaf, (TRB_REAL)c->cost_prim * (c->held ? c->held[leaf.first].count : prims));
}

/* Writes an inner node whose children will be pair number `pair`. */
TRB_CORE void trb_emit_inner(const trb_collapser *c, trbvh_node node, trbvh_u32 dst, trbvh_u32 pair) {
  node.first = 2 * pair;
  node.count = 0;
  c->out[dst] = node;
}

/* A node of a tree that is to be optimized. What a leaf holds goes aside, and the leaf becomes a reference, known by its
 * number; an inner node is still to be made from its children. */
TRB_CORE trbvh_node trb_unsettle(trbvh_node node, trbvh_u32 number, TRB_GLOBAL trb_held *held, trb_costs costs) {
  trbvh_u32 k;
  held->first = node.first;
  held->count = node.count;
  if (node.count == 0) return node;
  for (k = 0; k < 3; k++) { node.min[k] = trb_no_sign(node.min[k]); node.max[k] = trb_no_sign(node.max[k]); }    /* anybody's */
  node.first = number;
  return trb_reference(node, costs);
}

/* Such a leaf afterwards: it keeps what it holds. */
TRB_CORE void trb_emit_old_leaf(const trb_collapser *c, trbvh_node leaf, trbvh_u32 number, trbvh_u32 dst) {
  leaf.first = c->held[number].first;
  leaf.count = c->held[number].count;
  c->out[dst] = leaf;
}

/* A subtree of TRB_BLOCK references at most: what is known of it, what it came to, and its place in the result. A block
 * of a final tree leaves no more than 2 * 63 + 1 open, one for each bit of the keys at either end. */
typedef struct trb_task {
  trbvh_u32 node, depth, first_ref;
  trbvh_u32 end_pair;                    /* of a final tree's pairs */
  trbvh_u32 leaves, prims, max_depth;
  trbvh_u32 dst, pair, first_prim;
  TRB_REAL  sah;
} trb_task;
#define TRB_TASKS_MAX(refs) (2 * TRBVH_MAX_DEPTH * ((refs) / TRB_BLOCK) + 1)

/* Neighbouring tasks that one job does: a quarter of TRB_BLOCK references or more but for the last one. */
typedef struct trb_group { trbvh_u32 first_task, tasks; } trb_group;
#define TRB_GROUPS_MAX(refs) (4 * ((refs) / TRB_BLOCK) + 4)

/* Finds the tasks, returns how many, and sums up equation 1 above them. Those of a final tree are what its blocks left
 * open, in these ranges; else there are none. */
TRB_CORE trbvh_u32 trb_find_tasks(const trb_collapser *c, const TRB_GLOBAL trb_range *range, TRB_GLOBAL trb_task *tasks,
                                  TRB_REAL *sah) {
  trbvh_u32 stack[TRBVH_MAX_DEPTH + 1], depths[TRBVH_MAX_DEPTH + 1], waiting = 0, refs = 0, node = 0, depth = 0, count = 0;
  trbvh_u32 next = 0;                                /* of the range's subtrees */
  *sah = 0;
  for (;;) {
    const trbvh_node n = trb_bounded_node(c, node, depth, refs);
    const trbvh_u32 n_refs = trb_count(n.count);
    const int leaf = trb_is_leaf(n.count);
    if (range ? !leaf && n_refs > trb_count(range->open[next].node.count) : n_refs > TRB_BLOCK) {
      *sah += trb_sah_term(n, c->cost_node);
      stack[waiting] = n.first + 1;
      depths[waiting++] = ++depth;
      node = n.first;
    } else {
      TRB_GLOBAL trb_task *task = &tasks[count++];
      trbvh_u32 passed = 0;
      task->node = node;
      task->depth = depth;
      task->first_ref = refs;
      if (range) {
        task->prims = n_refs;
        task->leaves = leaf ? 1 : range->open[next].end_pair - range->open[next].first_pair + 1;
        task->end_pair = range->open[next].end_pair;
      }
      while (range && passed < n_refs) {             /* a leaf may be made of several */
        passed += trb_count(range->open[next].node.count);
        if (++next == range->open_count) {
          next = 0;
          range++;
        }
      }
      refs += n_refs;
      if (waiting == 0) return count;
      node = stack[--waiting];
      depth = depths[waiting];
    }
  }
}

/* Deals them out; returns the number of groups. */
TRB_CORE trbvh_u32 trb_find_groups(const TRB_GLOBAL trb_task *tasks, trbvh_u32 count, TRB_GLOBAL trb_group *groups) {
  trbvh_u32 groups_found = 0, first_ref = 0, i;
  for (i = 0; i < count; i++) {
    if (i == 0 || tasks[i].first_ref - first_ref >= TRB_BLOCK / 4) {
      groups[groups_found].first_task = i;
      groups[groups_found++].tasks = 0;
      first_ref = tasks[i].first_ref;
    }
    groups[groups_found - 1].tasks++;
  }
  return groups_found;
}

#if !defined(TRBVH_OPENCL_C) || defined(TRB_CPU)
/* Restructures the subtrees of a group: so many rounds, gamma being doubled from one to the next. */
TRB_SHARED void trb_restructure_group(const trb_collapser *c, const TRB_GLOBAL trb_task *tasks, trb_group group,
                                      trbvh_u32 gamma, trbvh_u32 rounds) {
  const trbvh_u32 first_ref = tasks[group.first_task].first_ref;
  trbvh_u32 i, seeds;
  for (; rounds && gamma <= TRB_BLOCK; rounds--, gamma *= 2) {
    for (i = 0, seeds = 0; i < group.tasks; i++) {
      trbvh_u32 node = tasks[group.first_task + i].node;
      if (trb_count(c->nodes[node].count) >= gamma) c->words.plane[0][first_ref + seeds++] = node;
    }
    trb_restructure_below(c->nodes, c->words, first_ref, seeds, gamma, c->costs);
  }
}

/* A node that waits for the walk. */
typedef struct trb_visit { trbvh_u32 node, depth; } trb_visit;

/* The walk runs through memory backwards, as far as treelets have not moved things: asks for the pairs that it will come
 * to 2 TRB_AHEAD references before this one. */
TRB_CORE void trb_prefetch_pairs(const trb_collapser *c, trbvh_u32 ref, trbvh_u32 count) {
  for (; count-- && ref > 2 * TRB_AHEAD; ref--) TRB_PREFETCH(&c->nodes[2 * (ref - 2 * TRB_AHEAD)]);
}

/* Walks through one task's subtree and turns its nodes into what they will be in the result, but for where that lies:
 * inner nodes count pairs, leaves primitives from the task's start. Pairs go to the result in the order of the first
 * plane, primitives in that of the second one. */
TRB_SHARED void trb_settle_task(const trb_collapser *c, TRB_GLOBAL trb_task *task) {
  TRB_GLOBAL trbvh_u32 *order = c->words.plane[0] + task->first_ref, *prims = c->words.plane[1] + task->first_ref;
  trbvh_u32 waiting = 0, pairs = 0, refs = task->first_ref, prim = 0, max_depth = 0, i;
  trbvh_u32 leaf_prims[TRB_MAX_LEAF];
  const trbvh_u32 last_ref = task->first_ref + trb_count(c->nodes[task->node].count);
  TRB_REAL sah = 0;
  trb_visit stack[TRBVH_MAX_DEPTH + 1], v;
  v.node = task->node;
  v.depth = task->depth;
  for (;;) {
    const trbvh_node node = trb_bounded_node(c, v.node, v.depth, refs);
    TRB_GLOBAL trbvh_node *settled = &c->nodes[v.node];
    if (trb_is_leaf(node.count)) {
      const trbvh_u32 count = trb_leaf_prims(c, node, leaf_prims);
      for (i = 0; i < count; i++) prims[prim + i] = leaf_prims[i];
      trb_prefetch_pairs(c, last_ref - (refs - task->first_ref), trb_count(node.count));
      settled->first = prim;
      settled->count = count;
      prim += count;
      refs += trb_count(node.count);
      sah += trb_leaf_term(c, node, count);
      max_depth = TRB_MAX(v.depth, max_depth);
      if (waiting == 0) break;
      v = stack[--waiting];
    } else {
      settled->first = pairs;
      settled->count = 0;
      order[pairs++] = node.first;
      sah += trb_sah_term(node, c->cost_node);
      v.depth++;
      v.node = node.first;
      stack[waiting++] = v;
      v.node++;
    }
  }
  task->leaves = pairs + 1;
  task->prims = prim;
  task->max_depth = max_depth;
  task->sah = sah;
}

TRB_SHARED void trb_settle_group(const trb_collapser *c, TRB_GLOBAL trb_task *tasks, trb_group group) {
  trbvh_u32 i;
  for (i = 0; i < group.tasks; i++) trb_settle_task(c, &tasks[group.first_task + i]);
}

/* Writes the nodes above the tasks, and tells them their places. */
TRB_SHARED void trb_emit_top(const trb_collapser *c, TRB_GLOBAL trb_task *tasks, trbvh_u32 count) {
  trbvh_u32 stack[TRBVH_MAX_DEPTH + 1], dsts[TRBVH_MAX_DEPTH + 1], waiting = 0, pair = 1, prim = 0, node = 0, dst = 0;
  for (;;) {
    if (node != tasks[count - 1].node) {
      const trbvh_node n = c->nodes[node];
      trb_emit_inner(c, n, dst, pair);
      stack[waiting] = n.first;
      dsts[waiting++] = 2 * pair;
      node = n.first + 1;
      dst = 2 * pair++ + 1;
    } else {
      TRB_GLOBAL trb_task *task = &tasks[--count];
      task->dst = dst;
      task->pair = pair;
      task->first_prim = prim;
      pair += task->leaves - 1;
      prim += task->prims;
      if (waiting == 0) return;
      node = stack[--waiting];
      dst = dsts[waiting];
    }
  }
}

/* Writes one of a task's nodes. */
TRB_CORE void trb_emit_settled(const trb_collapser *c, const trb_task *task, trbvh_u32 src, trbvh_u32 dst) {
  trbvh_node node = c->nodes[src];
  if (c->held && node.count) {
    trb_emit_old_leaf(c, node, c->words.plane[1][task->first_ref + node.first], dst);
    return;
  }
  node.first = node.count ? task->first_prim + node.first : 2 * (task->pair + node.first);
  c->out[dst] = node;
}

TRB_SHARED void trb_emit_task(const trb_collapser *c, trb_task task) {
  const TRB_GLOBAL trbvh_u32 *order = c->words.plane[0] + task.first_ref, *prims = c->words.plane[1] + task.first_ref;
  const trbvh_u32 pairs = task.leaves - 1;
  trbvh_u32 i;
  trb_emit_settled(c, &task, task.node, task.dst);
  for (i = 0; i < pairs; i++) {
    if (i + TRB_AHEAD < pairs) TRB_PREFETCH(&c->nodes[order[i + TRB_AHEAD]]);
    trb_emit_settled(c, &task, order[i], 2 * (task.pair + i));
    trb_emit_settled(c, &task, order[i] + 1, 2 * (task.pair + i) + 1);
  }
  for (i = 0; i < task.prims && !c->held; i++) c->prims[task.first_prim + i] = prims[i];
}

/* The same in a final tree, where pairs stand in the opposite order, by the numbers that they have there. */
TRB_CORE trbvh_node trb_final_node(const trb_task *task, trbvh_node node) {
  const int leaf = trb_is_leaf(node.count);
  node.first = leaf ? node.first : 2 * (task->pair + task->end_pair - 1 - node.first / 2);
  node.count = leaf ? trb_count(node.count) : 0;
  return node;
}

TRB_SHARED void trb_emit_final_task(const trb_collapser *c, TRB_GLOBAL trb_task *task) {
  TRB_GLOBAL trbvh_u32 *depths = c->words.plane[2];  /* of pairs */
  const trb_task t = *task;
  trbvh_u32 max_depth = t.depth, i, side;
  const trbvh_node root = c->nodes[t.node];
  TRB_REAL sah = trb_sah_term(root, t.leaves > 1 ? c->cost_node : c->cost_prim * (float)t.prims);
  c->out[t.dst] = trb_final_node(&t, root);
  if (t.leaves > 1) depths[t.end_pair - 1] = t.depth + 1;
  for (i = 0; i < t.leaves - 1; i++) {
    const trbvh_u32 pair = t.end_pair - 1 - i, depth = depths[pair];
    max_depth = TRB_MAX(depth, max_depth);
    for (side = 0; side < 2; side++) {
      const trbvh_node node = c->nodes[2 * pair + side];
      const int leaf = trb_is_leaf(node.count);
      sah += trb_sah_term(node, leaf ? c->cost_prim * (float)trb_count(node.count) : c->cost_node);
      depths[leaf ? pair : node.first / 2] = depth + 1;                  /* a leaf's goes nowhere */
      c->out[2 * (t.pair + i) + side] = trb_final_node(&t, node);
    }
  }
  task->sah = sah;
  task->max_depth = max_depth;
  for (i = t.first_prim; i < t.first_prim + t.prims; i++)
    c->prims[i] = trb_key_ref(c->keys[c->ref_count - 1 - i], c->form);
}
#endif

// >>finish ---- triangles in leaf order -----------------------------------------------------------------------------
TRB_CORE void trb_make_triangle(const trb_mesh *mesh, trbvh_u32 form, trbvh_u32 prim, TRB_GLOBAL trbvh_triangle *out) {
  const size_t corner = (size_t)prim * 3;
  float a[3], b[3], c[3];
  trbvh_u32 inexact = 0;
  trb_load_position(a, trb_position(mesh, trb_vertex(mesh, form, corner)));
  trb_load_position(b, trb_position(mesh, trb_vertex(mesh, form, corner + 1)));
  trb_load_position(c, trb_position(mesh, trb_vertex(mesh, form, corner + 2)));
  #define TRB_AXIS(k) { \
    float e1 = b[k] - a[k], e2 = c[k] - a[k]; \
    out->v0[k] = a[k]; \
    out->e1[k] = e1; \
    out->e2[k] = e2; \
    inexact |= (a[k] + e1 != b[k]) | (a[k] + e2 != c[k]); }
  TRB_AXIS(0) TRB_AXIS(1) TRB_AXIS(2)
  #undef TRB_AXIS
  out->prim = prim;
  out->reserved0 = inexact;
  out->reserved1 = 0;
}

TRB_CORE void trb_make_form(const trb_mesh *mesh, trbvh_u32 form, const TRB_GLOBAL trbvh_u32 *prims, trbvh_u32 first,
                            trbvh_u32 end, TRB_GLOBAL trbvh_triangle *out) {
  trbvh_u32 i;
  for (i = first; i < end; i++) {
    if (i + 3 * TRB_AHEAD < end) {
      trb_prefetch_indices(mesh, prims[i + 3 * TRB_AHEAD]);
      trb_prefetch_corners(mesh, form, prims[i + TRB_AHEAD]);
    }
    trb_make_triangle(mesh, form, prims[i], &out[i]);
  }
}

/* Triangles first..end - 1. */
TRB_SHARED void trb_make_triangles(const trb_mesh *mesh, const TRB_GLOBAL trbvh_u32 *prims, trbvh_u32 first, trbvh_u32 end,
                                   TRB_GLOBAL trbvh_triangle *out) {
  switch (trb_mesh_form(mesh)) {         /* a loop for each form */
    case 0: trb_make_form(mesh, 0, prims, first, end, out); break;
    case 2: trb_make_form(mesh, 2, prims, first, end, out); break;
    default: trb_make_form(mesh, 4, prims, first, end, out); break;
  }
}

// >>rays --------------------------------------------------------------------------------------------------------------
/* A ray made ready for many tests. For boxes (Kay and Kajiya): which corner is nearer on each axis, and 1 / dir, with
 * infinities for zeros. For triangles (Woop, Benthin and Wald, "Watertight Ray/Triangle Intersection", JCGT 2013): the
 * axis along which the ray is longest, now called z, and the shear that makes it the z axis.
 *
 * Hits do not depend on the tree, because boxes are tested conservatively: no hit, nor its distance, is further
 * outside of the boxes above it than 64 units of rounding (TRB_UNIT, 2^-24) of the scene's extent as seen from the
 * origin. So boxes are tested from origins moved by that much, forth for near corners, back for far ones, at no cost.
 * Triangles are tested in double where there is one: with float, those seen from the side, or from afar, would be hit
 * or missed by chance. */
#define TRB_UNIT 5.9604645e-8f
#define TRB_ABS(x) ((x) < 0 ? -(x) : (x))
typedef struct trb_ray {
  float    origin[3], inverse[3], tmin, tmax;
  float    t_unit;                       /* 1, or 2^60 for directions below 2^-60, which are lengthened by that */
  float    near_origin[3], far_origin[3];
  TRB_REAL shear[3];
  int      near_corner[3], far_corner[3], axis[3];
} trb_ray;

/* Boxes are read as eight floats: min at 0, max at 4. 0 for a ray that can hit nothing: one with a NaN or infinity, or
 * without a direction. */
TRB_CORE int trb_prepare_ray(trb_ray *r, const trbvh_ray *ray, const TRB_GLOBAL float *scene) {
  float x = trb_abs(ray->dir[0]), y = trb_abs(ray->dir[1]), z = trb_abs(ray->dir[2]), extent = 0, dir[3];
  int k, finite = 1;
  r->t_unit = x + y + z < 8.6736174e-19f ? 1.1529215e18f : 1.0f;
  for (k = 0; k < 3; k++) {
    float low = trb_abs(scene[k] - ray->origin[k]), high = trb_abs(scene[k + 4] - ray->origin[k]);
    low = TRB_MAX(low, high);
    extent = TRB_MAX(low, extent);
    dir[k] = ray->dir[k] * r->t_unit;
  }
  for (k = 0; k < 3; k++) {
    int negative = (int)(trb_bits(dir[k]) >> 31);
    float pad = (negative ? -64.0f : 64.0f) * TRB_UNIT * extent;
    finite &= trb_finite(ray->origin[k]) & trb_finite(dir[k]);
    r->origin[k] = ray->origin[k];
    r->near_origin[k] = ray->origin[k] + pad;
    r->far_origin[k] = ray->origin[k] - pad;
    r->inverse[k] = dir[k] != 0 ? 1.0f / dir[k] : trb_float(negative ? 0xFF800000u : 0x7F800000u);
    r->near_corner[k] = negative ? k + 4 : k;
    r->far_corner[k] = negative ? k : k + 4;
  }
  r->axis[2] = x >= y ? (x >= z ? 0 : 2) : (y >= z ? 1 : 2);
  r->axis[0] = r->axis[2] == 2 ? 0 : r->axis[2] + 1;
  r->axis[1] = r->axis[0] == 2 ? 0 : r->axis[0] + 1;
  r->shear[2] = 1 / (TRB_REAL)dir[r->axis[2]];
  r->shear[0] = dir[r->axis[0]] * r->shear[2];
  r->shear[1] = dir[r->axis[1]] * r->shear[2];
  r->tmin = TRB_MAX(ray->tmin, 0.0f) / r->t_unit;
  r->tmax = (ray->tmax == 0 ? FLT_MAX : TRB_MIN(ray->tmax, FLT_MAX)) / r->t_unit;
  return finite && x + y + z > 0 && ray->tmin == ray->tmin && ray->tmax == ray->tmax && r->tmin < r->tmax;
}

/* Where the ray enters the box, if it meets it between tmin and limit; else a negative number. A ray inside a face's
 * plane may give 0 * infinity, NaN, which neither comparison takes: such a ray is inside that slab. */
TRB_CORE float trb_hit_box(const TRB_GLOBAL float *box, const trb_ray *r, float limit) {
  float near0 = (box[r->near_corner[0]] - r->near_origin[0]) * r->inverse[0];
  float near1 = (box[r->near_corner[1]] - r->near_origin[1]) * r->inverse[1];
  float near2 = (box[r->near_corner[2]] - r->near_origin[2]) * r->inverse[2];
  float far0 = (box[r->far_corner[0]] - r->far_origin[0]) * r->inverse[0];
  float far1 = (box[r->far_corner[1]] - r->far_origin[1]) * r->inverse[1];
  float far2 = (box[r->far_corner[2]] - r->far_origin[2]) * r->inverse[2];
  float enter = r->tmin, leave = limit;
  enter = TRB_MAX(near0, enter); leave = TRB_MIN(far0, leave);
  enter = TRB_MAX(near1, enter); leave = TRB_MIN(far1, leave);
  enter = TRB_MAX(near2, enter); leave = TRB_MIN(far2, leave);
  return enter <= leave ? enter : -1.0f;
}

/* Corner v0 + e of a triangle, seen from the ray: x and y across it, z along it. */
typedef struct trb_corner { TRB_REAL x, y, z; } trb_corner;

TRB_CORE trb_corner trb_see(float x, float y, float z, const trb_ray *r) {
  trb_corner c;
  c.z = (TRB_REAL)z - r->origin[r->axis[2]];
  c.x = (TRB_REAL)x - r->origin[r->axis[0]] - r->shear[0] * c.z;
  c.y = (TRB_REAL)y - r->origin[r->axis[1]] - r->shear[1] * c.z;
  return c;
}

/* How far from a to b the ray passes, 0..1. */
TRB_CORE TRB_REAL trb_along(trb_corner a, trb_corner b) {
  TRB_REAL x = a.x - b.x, y = a.y - b.y, along = (a.x * x + a.y * y) / (x * x + y * y);
  along = TRB_MIN(along, 1);
  return TRB_MAX(along, 0);
}

/* Does the ray hit the triangle at tmin < t <= tmax? t, u, v go to hit, the rest of which stays.
 * u, v, w are the edge functions opposite to v0, v1, v2: twice the area of edge and ray, seen along the ray. Two
 * triangles that share an edge compute the same value for it, with the sign that their side has, as long as they get
 * its ends from the same numbers. Where v0 + e1 or v0 + e2 rounds to another number than the corner that the mesh
 * has, which reserved0 tells, corners may be off by two roundings of the edges. A miss by no more than twice that is a
 * hit then, of the nearest point of the edge that was missed, so that no ray slips through. */
TRB_CORE int trb_hit_triangle(const TRB_GLOBAL trbvh_triangle *t, const trb_ray *r, float tmax, trbvh_hit *hit) {
  const int x = r->axis[0], y = r->axis[1], z = r->axis[2];
  const trb_corner a = trb_see(t->v0[x], t->v0[y], t->v0[z], r);
  const trb_corner b = trb_see(t->v0[x] + t->e1[x], t->v0[y] + t->e1[y], t->v0[z] + t->e1[z], r);
  const trb_corner c = trb_see(t->v0[x] + t->e2[x], t->v0[y] + t->e2[y], t->v0[z] + t->e2[z], r);
  TRB_REAL u = c.x * b.y - c.y * b.x, v = a.x * c.y - a.y * c.x, w = b.x * a.y - b.y * a.x, area = u + v + w;
  float distance;
  if (area < 0) { u = -u; v = -v; w = -w; area = -area; }
  if (!(area > 0)) return 0;
  if (!(u >= 0 && v >= 0 && w >= 0)) {
    float off = 0;
    int k;
    if (!t->reserved0) return 0;
    if (u <= v && u <= w) { u = 0; w = trb_along(b, c); v = 1 - w; }
    else if (v <= w)      { v = 0; u = trb_along(c, a); w = 1 - u; }
    else                  { w = 0; v = trb_along(a, b); u = 1 - v; }
    area = 1;
    for (k = 0; k < 3; k++) {
      off = TRB_MAX(trb_abs(t->e1[k]), off);
      off = TRB_MAX(trb_abs(t->e2[k]), off);
    }
    off *= 4 * TRB_UNIT;
    if (!(TRB_ABS(u * a.x + v * b.x + w * c.x) <= off && TRB_ABS(u * a.y + v * b.y + w * c.y) <= off)) return 0;
  } else {
    TRB_REAL width = TRB_ABS(a.x) + TRB_ABS(b.x) + TRB_ABS(c.x), height = TRB_ABS(a.y) + TRB_ABS(b.y) + TRB_ABS(c.y);
    if (!(area > TRB_NOISE * width * height)) return 0;   /* so thin or so far that u, v, w are nothing but errors */
  }
  distance = (float)((u * a.z + v * b.z + w * c.z) / area * r->shear[2]);
  if (!(distance > r->tmin && distance <= tmax)) return 0;
  hit->t = distance;
  hit->u = (float)(v / area);                        /* the weight of v1 */
  hit->v = (float)(w / area);                        /* the weight of v2 */
  return 1;
}

TRB_CORE void trb_miss(const trb_ray *r, trbvh_hit *hit) {
  hit->t = r->tmax * r->t_unit;
  hit->u = hit->v = 0;
  hit->prim = hit->instance = TRBVH_NONE;
}

/* Closest hit, or with `any` the first one found: front to back, the farther child waiting on the stack with the
 * distance of its box. One entry a level, so TRBVH_MAX_DEPTH of them are enough. Among equal distances the lower
 * primitive wins: the answer is the same for every tree over these triangles. hit: t is the limit on a miss. */
TRB_CORE int trb_trace(const TRB_GLOBAL trbvh_node *nodes, const TRB_GLOBAL trbvh_triangle *triangles,
                       const trb_ray *r, int any, trbvh_hit *hit) {
  trbvh_u32 stack_node[TRBVH_MAX_DEPTH], height = 0, node = 0, i;
  float     stack_near[TRBVH_MAX_DEPTH];
  trb_miss(r, hit);
  if (trb_hit_box((const TRB_GLOBAL float *)&nodes[0], r, r->tmax) < 0) return 0;
  hit->t = r->tmax;
  for (;;) {
    const trbvh_u32 first = nodes[node].first, count = nodes[node].count;
    if (count == 0) {
      float left = trb_hit_box((const TRB_GLOBAL float *)&nodes[first], r, hit->t);
      float right = trb_hit_box((const TRB_GLOBAL float *)&nodes[first + 1], r, hit->t);
      if (left >= 0 && right >= 0) {
        trbvh_u32 swap = right < left;
        stack_node[height] = first + 1 - swap;
        stack_near[height++] = swap ? left : right;
        node = first + swap;
        continue;
      }
      if (left >= 0 || right >= 0) {
        node = left >= 0 ? first : first + 1;
        continue;
      }
    }
    for (i = first; i < first + count; i++) {
      trbvh_hit found;
      if (!trb_hit_triangle(&triangles[i], r, hit->t, &found)) continue;
      if (any) return 1;
      if (found.t < hit->t || triangles[i].prim < hit->prim) {
        hit->t = found.t;
        hit->u = found.u;
        hit->v = found.v;
        hit->prim = triangles[i].prim;
      }
    }
    do {
      if (height == 0) {
        hit->t *= r->t_unit;
        return hit->prim != TRBVH_NONE;
      }
      node = stack_node[--height];
    } while (stack_near[height] > hit->t);
  }
}

// >>plan ---- a build on a device: what its host and its kernels both know (trbvh_cl.h) -------------------------------
#define TRB_GPU_GROUP   256u             /* work-items of a group on a GPU ... */
#define TRB_GPU_TILE    2048u            /* ... and elements in a row that it takes, where order matters */
#define TRB_GPU_CHUNK   1024u            /* leaves over which one group builds the hierarchy ... */
#define TRB_GPU_CHUNKS  16u              /* ... and so many chunks that the next one joins */
#define TRB_GPU_LEVELS  1024u            /* they are listed one by one on a GPU; deeper trees, which moves could make, are left to C */
#define TRB_ROOTS_MAX   (1u << 20)       /* treelets of one launch: none lasts longer than a watchdog's patience */
#define TRB_CPU_RAYS    64u              /* that a work-item of a CPU traces */
#define TRB_JOB_STEP    64u              /* every so many-th work-group of a CPU gets a heavy job */
#define TRB_CANDIDATES  16u              /* scales tried at once */

/* One lies in the device's memory while a build runs there. */
typedef struct trb_plan {
  trb_u64      position_offset, position_stride, index_offset;   /* bytes; boxes stand in positions' place */
  trb_u64      scale;                    /* of the splits; scale_low is its number, or a lower bound */
  trb_u64      cost;                     /* what the tree costs, before its last phase */
  trb_costs    costs;
  trb_key_form form;
  float        cost_node, cost_prim;
  trbvh_u32    prim_count, position_count, index_size, boxes, split_max, ref_max, optimizes;
  float        reinsert_share;
  /* found out */
  trb_grid     grid;
  float        priority_unit;
  float        sah, root_area;           /* equation 1's sum, with half areas, not yet divided by the root's */
  trbvh_u32    scale_low, slots, ref_count;                      /* slots: references and gaps between them */
  trbvh_u32    skipped, bad, bad_vertex; /* primitives; the first with an index out of range (TRBVH_NONE: none), and it */
  trbvh_u32    lowest_score, moves;      /* that are looked at */
  trbvh_u32    too_deep;                 /* not 0: the tree has more levels than TRB_GPU_LEVELS */
  trbvh_u32    groups, tasks, leaves, prims, max_depth;
} trb_plan;

/* What a work-group found among the primitives. */
typedef struct trb_partial {
  trbvh_node bounds;
  trbvh_u32  skipped, bad, bad_vertex;
  float      priority;
} trb_partial;

/* What a split has heard of its children while the hierarchy is built: 1 + the first leaf of the left one, 1 + the last
 * leaf of the right one, or 0. */
typedef struct trb_wait { trbvh_u32 first, last; } trb_wait;

/* Nodes of one depth, in a list of all. */
typedef struct trb_level { trbvh_u32 first, count; } trb_level;

/* Of an inner node, by the number of its children's pair: inner nodes, primitives and equation 1 from it downwards; then
 * the pair its children get in the result, and the first primitive below it. */
typedef struct trb_place {
  trbvh_u32 inner, prims;
  float     sah;
  trbvh_u32 pair, prim;
} trb_place;

#ifndef TRBVH_OPENCL_C
// ===================================================================================================================
//   IN C: memory, jobs, the stages of a build, queries
// ===================================================================================================================
TRBVH_API unsigned trbvh_version(void) { return TRBVH_VERSION; }

TRBVH_API const char *trbvh_result_text(trbvh_result result) {
  switch (result) {
    #define TRBVH_X(name, text) case TRBVH_##name: return text;
    TRBVH_RESULTS(TRBVH_X)
    #undef TRBVH_X
    case TRBVH_RESULT_COUNT: break;
  }
  return "not a trbvh_result";
}

// >>memory ----------------------------------------------------------------------------------------------------------
#ifndef TRBVH_MALLOC
  #define TRBVH_MALLOC(size) trb_malloc(size)
  #define TRBVH_FREE(pointer) free(pointer)
  #if defined(__linux__)
    #include <sys/mman.h>
  #endif

/* malloc, with large pages for large blocks where the system hands them out on request: touching fresh memory in
 * small ones takes half of a FAST build's time. */
static void *trb_malloc(size_t size) {
  char *p = (char *)malloc(size);
  #ifdef MADV_HUGEPAGE                   /* not under -std=c99 */
  if (p && size >= 1u << 22) {
    size_t skip = (4096 - ((uintptr_t)p & 4095)) & 4095;
    madvise(p + skip, (size - skip) & ~(size_t)4095, MADV_HUGEPAGE);
  }
  #endif
  return p;
}
#endif
#define TRB_LINE 64u                     /* bytes in a cache line: what the block's parts are aligned to */

static void *trb_alloc(const trbvh_allocator *a, size_t size) {
  return a->alloc ? a->alloc(a->user, size) : TRBVH_MALLOC(size);
}

static void trb_free(const trbvh_allocator *a, void *p, size_t size) {
  if (!p) return;
  if (a->free) a->free(a->user, p, size);
  else TRBVH_FREE(p);
}

static char *trb_align(void *p) {
  return (char *)p + ((TRB_LINE - ((uintptr_t)p & (TRB_LINE - 1))) & (TRB_LINE - 1));
}

TRBVH_API void trbvh_free(trbvh *bvh) {
  if (!bvh) return;
  trb_free(&bvh->allocator, bvh->block, bvh->block_size);
  memset(bvh, 0, sizeof *bvh);
}

// >>jobs ---- parallel_for: the engine's, the library's own threads, or a loop --------------------------------------
/* Every stage is cut into jobs of a fixed size whose results do not depend on their order, so the tree does not
 * depend on who runs them. */
#ifdef TRBVH_THREADS
  #if defined(_WIN32)
    #ifndef WIN32_LEAN_AND_MEAN
      #define WIN32_LEAN_AND_MEAN
    #endif
    #include <windows.h>
    typedef HANDLE trb_thread;
    typedef CRITICAL_SECTION trb_mutex;
    typedef CONDITION_VARIABLE trb_signal;
    #define TRB_THREAD_MAIN              DWORD WINAPI
    #define trb_mutex_init(m)            InitializeCriticalSection(m)
    #define trb_mutex_free(m)            DeleteCriticalSection(m)
    #define trb_lock(m)                  EnterCriticalSection(m)
    #define trb_unlock(m)                LeaveCriticalSection(m)
    #define trb_signal_init(s)           InitializeConditionVariable(s)
    #define trb_signal_free(s)           ((void)(s))
    #define trb_wait(s, m)               SleepConditionVariableCS(s, m, INFINITE)
    #define trb_wake_all(s)              WakeAllConditionVariable(s)
    #define trb_thread_start(t, f, p)    ((*(t) = CreateThread(NULL, 0, f, p, 0, NULL)) != NULL)
    #define trb_thread_join(t)           (WaitForSingleObject(t, INFINITE), CloseHandle(t))
    #define trb_yield()                  SwitchToThread()
  #else
    #include <pthread.h>
    #include <sched.h>
    typedef pthread_t trb_thread;
    typedef pthread_mutex_t trb_mutex;
    typedef pthread_cond_t trb_signal;
    #define TRB_THREAD_MAIN              void *
    #define trb_mutex_init(m)            pthread_mutex_init(m, NULL)
    #define trb_mutex_free(m)            pthread_mutex_destroy(m)
    #define trb_lock(m)                  pthread_mutex_lock(m)
    #define trb_unlock(m)                pthread_mutex_unlock(m)
    #define trb_signal_init(s)           pthread_cond_init(s, NULL)
    #define trb_signal_free(s)           pthread_cond_destroy(s)
    #define trb_wait(s, m)               pthread_cond_wait(s, m)
    #define trb_wake_all(s)              pthread_cond_broadcast(s)
    #define trb_thread_start(t, f, p)    (pthread_create(t, NULL, f, p) == 0)
    #define trb_thread_join(t)           pthread_join(t, NULL)
    #define trb_yield()                  sched_yield()
  #endif
  #define TRB_THREADS_MAX 64u
  #define TRB_YIELDS      1000u          /* less than 1 ms: waking a thread may take as long as a stage of moves */

/* Threads that live as long as one call of the library. Jobs are coarse, so that a mutex hands them out. */
typedef struct trb_pool {
  trb_mutex  mutex;
  trb_signal work, idle;                 /* there are jobs, or it is time to quit; all jobs are done */
  trbvh_job *job;
  void      *context;
  uint32_t   next, count, running, threads;
  int        quit;
  trb_thread thread[TRB_THREADS_MAX];
} trb_pool;

static void trb_pool_work(trb_pool *pool) {          /* entered and left with the mutex held */
  while (pool->next < pool->count) {
    trbvh_job *job = pool->job;
    void *context = pool->context;
    uint32_t index = pool->next++;
    pool->running++;
    trb_unlock(&pool->mutex);
    job(context, index);
    trb_lock(&pool->mutex);
    pool->running--;
  }
  if (pool->running == 0) trb_wake_all(&pool->idle);
}

static void trb_pool_yield(trb_pool *pool) {
  trb_unlock(&pool->mutex);
  trb_yield();
  trb_lock(&pool->mutex);
}

static TRB_THREAD_MAIN trb_pool_thread(void *p) {
  trb_pool *pool = (trb_pool *)p;
  uint32_t yields;
  trb_lock(&pool->mutex);
  while (!pool->quit) {
    trb_pool_work(pool);
    for (yields = 0; yields < TRB_YIELDS && !pool->quit && pool->next == pool->count; yields++) trb_pool_yield(pool);
    if (!pool->quit && pool->next == pool->count) trb_wait(&pool->work, &pool->mutex);
  }
  trb_unlock(&pool->mutex);
  return 0;
}

static void trb_pool_run(trb_pool *pool, uint32_t count, trbvh_job *job, void *context) {
  uint32_t yields;
  trb_lock(&pool->mutex);
  pool->job = job;
  pool->context = context;
  pool->next = 0;
  pool->count = count;
  trb_wake_all(&pool->work);
  trb_pool_work(pool);
  for (yields = 0; yields < TRB_YIELDS && pool->running; yields++) trb_pool_yield(pool);
  while (pool->running) trb_wait(&pool->idle, &pool->mutex);
  trb_unlock(&pool->mutex);
}

static void trb_pool_start(trb_pool *pool, uint32_t width) {   /* fewer threads than asked for are fine */
  memset(pool, 0, sizeof *pool);
  trb_mutex_init(&pool->mutex);
  trb_signal_init(&pool->work);
  trb_signal_init(&pool->idle);
  while (pool->threads < TRB_THREADS_MAX - 1 && pool->threads + 1 < width &&
         trb_thread_start(&pool->thread[pool->threads], trb_pool_thread, pool))
    pool->threads++;
}

static void trb_pool_stop(trb_pool *pool) {
  uint32_t i;
  trb_lock(&pool->mutex);
  pool->quit = 1;
  trb_wake_all(&pool->work);
  trb_unlock(&pool->mutex);
  for (i = 0; i < pool->threads; i++) trb_thread_join(pool->thread[i]);
  trb_signal_free(&pool->work);
  trb_signal_free(&pool->idle);
  trb_mutex_free(&pool->mutex);
}
#endif

/* Runs jobs, reports progress between them, and stops when the callback says so. */
typedef struct trb_runner {
  const trbvh_options *options;
  float share, done;                     /* of the whole call: the present stage's, what all before it came to */
  int   cancelled;
#ifdef TRBVH_THREADS
  trb_pool pool;
#endif
} trb_runner;

static void trb_runner_start(trb_runner *runner, const trbvh_options *options, int threads) {
  runner->options = options;
  runner->share = runner->done = 0;
  runner->cancelled = 0;
#ifdef TRBVH_THREADS
  trb_pool_start(&runner->pool, threads && !options->jobs.parallel_for ? options->jobs.width : 1);
#else
  (void)threads;
#endif
}

static void trb_runner_stop(trb_runner *runner) {
#ifdef TRBVH_THREADS
  trb_pool_stop(&runner->pool);
#else
  (void)runner;
#endif
}

static int trb_progress(trb_runner *runner, float part) {
  const trbvh_options *o = runner->options;
  float done = runner->done + runner->share * part;
  if (o->progress && !runner->cancelled && o->progress(o->progress_user, TRB_MIN(done, 1.0f))) runner->cancelled = 1;
  return runner->cancelled;
}

/* The next stage takes `share` of the call's time. */
static int trb_stage(trb_runner *runner, float share) {
  runner->done += runner->share;
  runner->share = share;
  return trb_progress(runner, 0);
}

typedef struct trb_wave { trbvh_job *job; void *context; uint32_t first; } trb_wave;
static void trb_wave_job(void *context, uint32_t index) {
  trb_wave *wave = (trb_wave *)context;
  wave->job(wave->context, wave->first + index);
}

/* Non-zero where the call was cancelled, with some jobs not run. */
static int trb_run(trb_runner *runner, uint32_t count, trbvh_job *job, void *context) {
  const trbvh_jobs *jobs = &runner->options->jobs;
  uint32_t width = jobs->width > 1 ? TRB_MIN(jobs->width, 4096u) : 1, n;
  trb_wave wave;
  wave.job = job;
  wave.context = context;
  for (wave.first = 0; wave.first < count && !runner->cancelled; wave.first += n) {
    n = TRB_MIN(count - wave.first, runner->options->progress ? 16 * width : count);
    if (jobs->parallel_for && n > 1) jobs->parallel_for(jobs->user, n, trb_wave_job, &wave);
#ifdef TRBVH_THREADS
    else if (runner->pool.threads && n > 1) trb_pool_run(&runner->pool, n, trb_wave_job, &wave);
#endif
    else {
      uint32_t i;
      for (i = 0; i < n; i++) trb_wave_job(&wave, i);
    }
    if (wave.first + n < count) trb_progress(runner, (float)(wave.first + n) / (float)count);
  }
  return runner->cancelled;
}

#include <time.h>
#if !defined(TIME_UTC) && !defined(_WIN32)
  #include <sys/time.h>
#endif
static double trb_ms(void) {
#if defined(TIME_UTC)
  struct timespec t;
  timespec_get(&t, TIME_UTC);
  return 1e3 * (double)t.tv_sec + 1e-6 * (double)t.tv_nsec;
#elif defined(_WIN32)
  return 1e3 * (double)clock() / CLOCKS_PER_SEC;     /* wall-clock time there */
#else
  struct timeval t;
  gettimeofday(&t, NULL);
  return 1e3 * (double)t.tv_sec + 1e-3 * (double)t.tv_usec;
#endif
}

// >>input ---- arguments made explicit and checked, references made -----------------------------
#define TRB_REFS_MAX   0x7FFFFFFFu       /* node indices are twice that */
#define TRB_ROUNDS_MAX 28                /* of treelets: the last one's gamma is more than any tree has references */
#define TRB_UNSPLITS_MAX 16              /* passes; later ones find nothing */
#define TRB_NODE_BYTES sizeof(trbvh_node)

#define TRB_READ_BLOCK 4096u             /* primitives a job reads, or makes triangles of */

/* What one block of primitives came to. */
typedef struct trb_block {
  trbvh_node bounds;                     /* of the references; min > max where there are none */
  uint32_t   start, slots;               /* slots of its references, some of which may be gaps ... */
  uint32_t   refs, key_start;            /* ... how many are none; where their keys go */
  uint32_t   skipped, bad, bad_vertex;   /* primitives; the first with an index out of range (TRBVH_NONE: none), and it */
  float      priority;                   /* the largest */
  trb_u64    splits;                     /* a sum, for the search for the scale */
} trb_block;

typedef struct trb_build {
  trbvh_geometry        input;           /* with the defaults filled in */
  trbvh_options         options;         /* likewise */
  trbvh_stats           stats;
  trb_runner            runner;
  trb_costs             costs;
  trb_grid              grid;
  uint32_t              ref_max, ref_count, split_max;
  int                   splitting;       /* is this attempt's tree one with splits? */
  float                 effort;          /* of all that grows trees, this attempt */
  int                   final;           /* the hierarchy's topology is the result's */
  int                   optimizes;       /* there is a tree already */
  int                   guessed;         /* trb_read has made the keys */
  /* scratch memory; what stands on one line shares it, one after the other */
  void                 *scratch;
  size_t                scratch_size;
  trbvh_node           *split_refs;      /* ref_max, where there may be splits */
  trbvh_node           *refs;            /* they, in an attempt with splits; else NULL */
  trb_u64              *keys, *sorted;   /* ref_max each */                      float *priorities;
  trbvh_node           *nodes;           /* 2 * ref_max + 2 */                   trbvh_node *unsplit;   /* like refs */
  trb_block            *blocks;
  trb_range            *ranges;          /* for each TRB_BLOCK of ref_max */     uint32_t *histograms;  /* the sort's, smaller */
                                                                                 trb_u64 *sums;
                                                                                 uint32_t *more, *found;   /* bits; moves of each job */
  trb_group            *groups;
  trb_task             *tasks;
  trb_held             *held;             /* by node, of a tree that is optimized */
  uint32_t              block_count, task_count, group_count;
  double                sah;             /* equation 1's sum above the tasks */
  struct { uint32_t last, unsplits, gamma, rounds; } phase;
  uint32_t              slot_count;      /* of refs, gaps among them */
  uint32_t              lowest_score, move_count, batch, merges;
  float                 moves_share;     /* of the call's time: one batch of moves */
  /* parameters of the jobs at work */
  float                 priority_unit;
  trb_u64               scale;
  trb_key_form          key_form;
  uint32_t              digit_shift, digits;
  trbvh                 tree;            /* the result, as it is made */
} trb_build;

/* What a backend offers; it keeps more behind this. Both report as trb_fail does; a build that fails leaves the tree's
 * block as it is. */
typedef struct trb_batch trb_batch;
struct trbvh_device {
  trbvh_result (*build)(trbvh_device *device, trb_build *b, trbvh *bvh);
  trbvh_result (*trace)(trbvh_device *device, trb_build *b, const trb_batch *batch);
};

static trbvh_result trb_fail(trb_build *b, trbvh_result result, const char *format, unsigned a, unsigned c, unsigned d) {
  snprintf(b->stats.message, sizeof b->stats.message, format, a, c, d);
  return result;
}

/* The geometry with its defaults filled in. */
static trbvh_result trb_resolve_geometry(trb_build *b, const trbvh_geometry *geometry) {
  trbvh_geometry *g = &b->input;
  if (!geometry) return trb_fail(b, TRBVH_INVALID_ARGUMENT, "geometry is NULL", 0, 0, 0);
  *g = *geometry;
  if (g->count == 0) return TRBVH_OK;
  if (g->count > TRB_REFS_MAX)
    return trb_fail(b, TRBVH_TOO_LARGE, "%u primitives, more than %u", g->count, TRB_REFS_MAX, 0);
  if (!g->positions == !g->boxes)
    return trb_fail(b, TRBVH_INVALID_ARGUMENT, "geometry needs either positions or boxes", 0, 0, 0);
  if (g->boxes) {
    if (g->indices) return trb_fail(b, TRBVH_INVALID_ARGUMENT, "boxes have no indices", 0, 0, 0);
    if (g->box_stride == 0) g->box_stride = 24;
    if (g->box_stride < 24)
      return trb_fail(b, TRBVH_INVALID_ARGUMENT, "box_stride is %u, a box has 24 bytes", (unsigned)g->box_stride, 0, 0);
    return TRBVH_OK;
  }
  if (g->position_stride == 0) g->position_stride = 12;
  if (g->position_stride < 12)
    return trb_fail(b, TRBVH_INVALID_ARGUMENT, "position_stride is %u, a position has 12 bytes",
                    (unsigned)g->position_stride, 0, 0);
  if (g->indices) {
    if (g->index_size == 0) g->index_size = 4;
    if (g->index_size != 2 && g->index_size != 4)
      return trb_fail(b, TRBVH_INVALID_ARGUMENT, "index_size is %u, neither 2 nor 4", g->index_size, 0, 0);
    if (g->position_count == 0)
      return trb_fail(b, TRBVH_INVALID_ARGUMENT, "indices need position_count, to be checked against", 0, 0, 0);
  } else if (g->position_count && g->position_count / 3 < g->count) {
    return trb_fail(b, TRBVH_INVALID_ARGUMENT, "%u triangles without indices need three positions each, but there are %u",
                    g->count, g->position_count, 0);
  }
  return TRBVH_OK;
}

/* The options with the preset's values filled in: afterwards nothing is zero to mean a default. */
static trbvh_result trb_resolve_options(trb_build *b, const trbvh_options *options) {
  trbvh_options *o = &b->options;
  int fast, high, best;
  memset(o, 0, sizeof *o);
  if (options) *o = *options;
  if ((unsigned)o->quality > TRBVH_QUALITY_BEST)
    return trb_fail(b, TRBVH_INVALID_ARGUMENT, "quality is %u, the best is %u", (unsigned)o->quality, TRBVH_QUALITY_BEST, 0);
  if (o->flags & ~(uint32_t)(TRBVH_NO_FALLBACK | TRBVH_NO_TRIANGLES))
    return trb_fail(b, TRBVH_INVALID_ARGUMENT, "flags 0x%x are unknown to this version", o->flags, 0, 0);
  if (!o->allocator.alloc != !o->allocator.free)
    return trb_fail(b, TRBVH_INVALID_ARGUMENT, "an allocator needs both alloc and free", 0, 0, 0);
  if (!(o->split_budget <= 16))
    return trb_fail(b, TRBVH_INVALID_ARGUMENT, "split_budget is above 16, or NaN", 0, 0, 0);
  if (!(o->reinsert_share <= 0.25f))
    return trb_fail(b, TRBVH_INVALID_ARGUMENT, "reinsert_share is above 0.25, or NaN", 0, 0, 0);
  if (!(o->cost_node <= 1e6f && o->cost_prim <= 1e6f))
    return trb_fail(b, TRBVH_INVALID_ARGUMENT, "cost_node or cost_prim is above 1000000, or NaN", 0, 0, 0);
  fast = o->quality == TRBVH_QUALITY_FAST;
  high = o->quality >= TRBVH_QUALITY_HIGH;
  best = o->quality == TRBVH_QUALITY_BEST;
  if (o->split_budget == 0 && high) o->split_budget = best ? 0.5f : 0.2f;
  if (o->split_budget < 0 || b->input.boxes) o->split_budget = 0;
  if (o->treelet_rounds == 0 && !fast) o->treelet_rounds = best ? 5 : 3;
  if (o->treelet_rounds < 0) o->treelet_rounds = 0;
  if (o->treelet_rounds > TRB_ROUNDS_MAX) o->treelet_rounds = TRB_ROUNDS_MAX;
  if (o->treelet_gamma < TRB_TREELET) o->treelet_gamma = TRB_TREELET;
  if (o->reinsert_share == 0 && !fast) o->reinsert_share = best ? 0.08f : 0.04f;
  if (o->reinsert_share < 0) o->reinsert_share = 0;
  if (o->unsplit_passes == 0 && high) o->unsplit_passes = 1;
  if (o->unsplit_passes < 0) o->unsplit_passes = 0;
  if (o->unsplit_passes > TRB_UNSPLITS_MAX) o->unsplit_passes = TRB_UNSPLITS_MAX;
  if (o->max_leaf == 0) o->max_leaf = 8;
  if (o->max_leaf > TRB_MAX_LEAF) o->max_leaf = TRB_MAX_LEAF;
  if (o->cost_node == 0) o->cost_node = 1.2f;
  if (o->cost_prim == 0) o->cost_prim = 1;
  if (o->cost_node < 0) o->cost_node = 0;
  if (o->cost_prim < 0) o->cost_prim = 0;
  b->costs.max_leaf = o->max_leaf;
  b->costs.ratio = o->cost_prim / TRB_MAX(o->cost_node, 1e-6f);    /* one division, for all backends */
  return TRBVH_OK;
}

/* Keys of ref_max references at most. */
static trb_key_form trb_choose_keys(uint32_t ref_max) {
  trb_key_form form = {0, 31, 32};
  if (ref_max <= TRB_PACKED_REFS) {
    form.packed = 1;
    form.shift = ref_max > 1 ? trb_log2(ref_max - 1) + 1 : 1;
    form.bits = TRB_MIN(63 - form.shift, TRB_CODE_BITS);
  }
  return form;
}

/* How many references there may be. */
static trbvh_result trb_resolve_size(trb_build *b) {
  trb_u64 extra = (trb_u64)((double)b->options.split_budget * b->input.count);
  trb_u64 refs = b->input.count + extra;
  if (refs > TRB_REFS_MAX || refs > (SIZE_MAX - 65536) / 160)
    return trb_fail(b, TRBVH_TOO_LARGE, "%u primitives make more references than fit", b->input.count, 0, 0);
  b->split_max = (uint32_t)extra;
  b->ref_max = (uint32_t)refs;
  /* Neither restructured, nor looked through for a primitive's second reference, nor too deep: packed keys differ in
   * fewer bits than TRBVH_MAX_DEPTH. */
  b->final = b->options.treelet_rounds == 0 && b->split_max == 0 && trb_choose_keys(b->ref_max).packed;
  return TRBVH_OK;
}

static trbvh_result trb_resolve(trb_build *b, const trbvh_geometry *geometry, const trbvh_options *options) {
  trbvh_result result;
  memset(b, 0, sizeof *b);
  result = trb_resolve_geometry(b, geometry);
  if (!result) result = trb_resolve_options(b, options);
  if (!result) result = trb_resolve_size(b);
  return result;
}

static uint32_t trb_blocks(uint32_t count, uint32_t size) { return count / size + (count % size != 0); }

/* The scratch memory's parts, one after another; NULL as base to learn the size. */
static size_t trb_lay_out(trb_build *b, char *base) {
  const size_t n = b->ref_max, blocks = trb_blocks(b->ref_max, TRB_BLOCK);
  size_t size = 0;
  #define TRB_PART(member, type, bytes) \
    b->member = base ? (type *)(void *)(base + size) : NULL; \
    size = (size + (bytes) + TRB_LINE - 1) & ~(size_t)(TRB_LINE - 1);
  TRB_PART(split_refs, trbvh_node, b->split_max ? n * TRB_NODE_BYTES : 0)
  TRB_PART(keys,       trb_u64,    n * 8)
  TRB_PART(sorted,     trb_u64,    n * 8)
  TRB_PART(nodes,      trbvh_node, (n * 2 + 2) * TRB_NODE_BYTES)
  TRB_PART(blocks,     trb_block,  trb_blocks(b->input.count, TRB_READ_BLOCK) * sizeof(trb_block))
  TRB_PART(ranges,     trb_range,  blocks * sizeof(trb_range))
  TRB_PART(groups,     trb_group,  TRB_GROUPS_MAX(n) * sizeof(trb_group))
  TRB_PART(tasks,      trb_task,   TRB_TASKS_MAX(n) * sizeof(trb_task))
  TRB_PART(held,       trb_held,   b->optimizes ? n * 2 * sizeof(trb_held) : 0)
  #undef TRB_PART
  b->priorities = (float *)(void *)b->keys;
  b->unsplit = b->nodes;
  b->histograms = (uint32_t *)(void *)b->ranges;
  b->sums = (trb_u64 *)(void *)b->ranges;
  b->more = b->histograms;
  b->found = b->histograms + blocks * (TRB_BLOCK / 32);
  return size + TRB_LINE;
}

static void trb_start_attempt(trb_build *b, int splitting) {
  b->splitting = splitting;
  b->refs = splitting ? b->split_refs : NULL;
  b->key_form = trb_choose_keys(splitting ? b->ref_max : b->input.count);
  b->ref_count = b->stats.skipped_count = 0;
}

static size_t trb_result_size(const trb_build *b, size_t leaves, size_t prims) {
  int triangles = !b->input.boxes && !(b->options.flags & TRBVH_NO_TRIANGLES);
  return leaves * 2 * TRB_NODE_BYTES + prims * (sizeof(uint32_t) + (triangles ? sizeof(trbvh_triangle) : 0)) + TRB_LINE;
}

TRBVH_API size_t trbvh_bytes_bound(const trbvh_geometry *geometry, const trbvh_options *options, size_t *scratch) {
  trb_build b;
  int fits = trb_resolve(&b, geometry, options) == TRBVH_OK && b.input.count > 0;
  if (scratch) *scratch = fits ? trb_lay_out(&b, NULL) : 0;
  return fits ? trb_result_size(&b, b.ref_max, b.ref_max) : 0;
}

/* Keys of a whole row, filled or not. */
TRB_CORE void trb_make_row_keys(const trb_row *row, uint32_t first, trb_grid grid, trb_key_form form, trb_u64 key[TRB_ROW]) {
  uint32_t i;
  for (i = 0; i < TRB_ROW; i++) {
    float x = 0.5f * row->min[0][i] + 0.5f * row->max[0][i], y = 0.5f * row->min[1][i] + 0.5f * row->max[1][i];
    float z = 0.5f * row->min[2][i] + 0.5f * row->max[2][i];
    key[i] = trb_key(trb_morton(x, y, z, grid), first + i, form, 0);
  }
}

#ifdef TRB_AVX
  #define TRB_ROW_KEYS(name, target) \
    TRB_TARGET(target) static void name(const trb_row *row, uint32_t first, trb_grid grid, trb_key_form form, \
                                        trb_u64 key[TRB_ROW]) { \
      trb_make_row_keys(row, first, grid, form, key); \
    }
  TRB_ROW_KEYS(trb_row_keys_avx2, "avx2")
  TRB_ROW_KEYS(trb_row_keys_avx512, "avx512f")
#endif

static void trb_row_keys(const trb_row *row, uint32_t first, trb_grid grid, trb_key_form form, trb_u64 key[TRB_ROW]) {
#ifdef TRB_AVX
  const int bits = trb_simd();
  if (bits >= 512) trb_row_keys_avx512(row, first, grid, form, key);
  else if (bits >= 256) trb_row_keys_avx2(row, first, grid, form, key);
  else
#endif
  trb_make_row_keys(row, first, grid, form, key);
}

/* The bounds of some positions, used or not. */
static void trb_guess_job(void *context, uint32_t index) {
  trb_build *b = (trb_build *)context;
  const uint32_t part = trb_blocks(b->input.position_count, b->block_count);
  uint32_t i = TRB_MIN(b->input.position_count, index * part), end = TRB_MIN(b->input.position_count - i, part) + i;
  const char *p = trb_position(&b->input, i);
  const size_t stride = b->input.position_stride;
  float low[3] = {FLT_MAX, FLT_MAX, FLT_MAX}, high[3] = {-FLT_MAX, -FLT_MAX, -FLT_MAX}, v[3];
  for (; i < end; i++, p += stride) {
    trb_load_position(v, p);
    #define TRB_AXIS(k) low[k] = TRB_MIN(v[k], low[k]); high[k] = TRB_MAX(v[k], high[k]);
    TRB_AXIS(0) TRB_AXIS(1) TRB_AXIS(2)
    #undef TRB_AXIS
  }
  b->blocks[index].bounds = trb_no_box();
  trb_include(&b->blocks[index].bounds, low, high);
}

/* A block's bounds, and where they are to be kept its references, with gaps for invalid primitives; or keys, in case the
 * guess is right. */
static void trb_read_job(void *context, uint32_t index) {
  trb_build *b = (trb_build *)context;
  uint32_t first = index * TRB_READ_BLOCK, end = TRB_MIN(b->input.count, first + TRB_READ_BLOCK), i, k, n, good, vertex;
  trb_u64 key[TRB_ROW];
  trb_block block;
  trb_row row, all;
  float v[3][3];
  memset(&block, 0, sizeof block);
  block.start = first;
  block.slots = end - first;
  block.bad = TRBVH_NONE;
  for (k = 0; k < 3; k++)
    for (i = 0; i < TRB_ROW; i++) {
      all.min[k][i] = row.min[k][i] = FLT_MAX;
      all.max[k][i] = row.max[k][i] = -FLT_MAX;
    }
  for (; first < end && block.bad == TRBVH_NONE; first += n) {
    n = TRB_MIN(end - first, TRB_ROW);
    for (i = 0; i < n; i++) row.prim[i] = first + i;
    good = trb_read_row(&b->input, n, &row);
    block.refs += trb_check_row(&b->input, good, &row);
    for (k = 0; k < 3; k++)                          /* whole rows, whose ends are empty or have been here before */
      for (i = 0; i < TRB_ROW; i++) {
        all.min[k][i] = TRB_MIN(row.min[k][i], all.min[k][i]);
        all.max[k][i] = TRB_MAX(row.max[k][i], all.max[k][i]);
      }
    if (b->guessed) {
      trb_row_keys(&row, first, b->grid, b->key_form, key);
      memcpy(b->keys + first, key, n * sizeof *key);
    }
    for (i = 0; b->splitting && i < good; i++) {
      b->unsplit[first + i] = trb_row_box(&row, i);
      if (!row.valid[i]) b->unsplit[first + i].first = TRBVH_NONE;
    }
    if (good < n) {
      block.bad = first + good;
      if (!trb_load_triangle(&b->input, block.bad, v, &vertex)) block.bad_vertex = vertex;
    }
  }
  block.skipped = block.slots - block.refs;
  block.bounds = trb_no_box();
  for (i = 0; i < TRB_ROW; i++)
    for (k = 0; k < 3; k++) {
      block.bounds.min[k] = TRB_MIN(all.min[k][i], block.bounds.min[k]);
      block.bounds.max[k] = TRB_MAX(all.max[k][i], block.bounds.max[k]);
    }
  b->blocks[index] = block;
}

static trbvh_node trb_sum_bounds(const trb_build *b) {
  trbvh_node bounds = trb_no_box();
  uint32_t i;
  for (i = 0; i < b->block_count; i++) trb_include(&bounds, b->blocks[i].bounds.min, b->blocks[i].bounds.max);
  return bounds;
}

/* The scene's bounds. Fails for an index out of range.
 *
 * Codes need the bounds first, and so a second look at all triangles. Most meshes use all of their positions, which are
 * looked through sooner: codes are made with their bounds at once, and kept where those turn out to be the triangles'. */
static trbvh_result trb_read(trb_build *b) {
  trbvh_node guess = trb_no_box(), bounds;
  uint32_t i;
  int k, equal = 1;
  b->block_count = trb_blocks(b->input.count, TRB_READ_BLOCK);
  b->guessed = b->input.indices && b->input.position_count <= b->input.count && !b->splitting;
  if (b->guessed) {
    if (trb_run(&b->runner, b->block_count, trb_guess_job, b)) return TRBVH_CANCELLED;
    guess = trb_sum_bounds(b);
    b->grid = trb_make_grid(guess);
  }
  if (trb_run(&b->runner, b->block_count, trb_read_job, b)) return TRBVH_CANCELLED;
  for (i = 0; i < b->block_count; i++) {
    trb_block *block = &b->blocks[i];
    if (block->bad != TRBVH_NONE)
      return trb_fail(b, TRBVH_BAD_GEOMETRY, "triangle %u uses vertex %u, but there are %u", block->bad,
                      block->bad_vertex, b->input.position_count);
    b->stats.skipped_count += block->skipped;
    b->ref_count += block->refs;
  }
  bounds = trb_sum_bounds(b);
  for (k = 0; k < 3; k++) equal &= bounds.min[k] == guess.min[k] && bounds.max[k] == guess.max[k];
  b->guessed = b->guessed && equal && b->ref_count == b->input.count;
  b->grid = trb_make_grid(bounds);
  return TRBVH_OK;
}

// >>stages ---- the algorithm's parts, as jobs, in its order ----------------------------------------------------------
// ---- Splits ----
static void trb_priority_job(void *context, uint32_t index) {
  trb_build *b = (trb_build *)context;
  trb_block *block = &b->blocks[index];
  uint32_t i, vertex;
  float v[3][3];
  block->priority = 0;
  for (i = block->start; i < block->start + block->slots; i++) {
    b->priorities[i] = 0;
    if (b->unsplit[i].first == TRBVH_NONE || !trb_load_triangle(&b->input, i, v, &vertex)) continue;
    b->priorities[i] = trb_split_priority((const float (*)[3])v, b->unsplit[i], b->grid);
    block->priority = TRB_MAX(b->priorities[i], block->priority);
  }
}

static void trb_sum_splits_job(void *context, uint32_t index) {
  trb_build *b = (trb_build *)context;
  trb_block *block = &b->blocks[index];
  uint32_t i;
  block->splits = 0;
  for (i = block->start; i < block->start + block->slots; i++)
    block->splits += trb_splits(b->priorities[i], b->priority_unit, b->scale);
}

static trb_u64 trb_sum_splits(trb_build *b, trb_u64 scale) {
  trb_u64 sum = 0;
  uint32_t i;
  b->scale = scale;
  trb_run(&b->runner, b->block_count, trb_sum_splits_job, b);
  for (i = 0; i < b->block_count; i++) sum += b->blocks[i].splits;
  return sum;
}

/* The largest scale within the budget. The first guess, the paper's D_min = S_max / sum p, is a little low, as every
 * triangle's splits are rounded down: from there in steps that double, then by bisection. */
static trb_u64 trb_find_scale(trb_build *b) {
  const trb_u64 sum = trb_sum_splits(b, (trb_u64)1 << TRB_SCALE_BITS);
  const double guess = sum ? (double)b->split_max / (double)sum * 68719476736.0 : 0;
  uint32_t low = 0, high, step = 1;
  while (low < TRB_SCALES - 1 && (double)trb_scale(low + 1) <= guess) low++;
  if (trb_sum_splits(b, trb_scale(low)) > b->split_max) low = 0;       /* the guess is a rounded number */
  for (high = low + step; high < TRB_SCALES && trb_sum_splits(b, trb_scale(high)) <= b->split_max; step *= 2) {
    low = high;
    high = low + step;
  }
  high = TRB_MIN(high, TRB_SCALES);
  while (high - low > 1 && !b->runner.cancelled) {
    uint32_t middle = low + (high - low) / 2;
    if (trb_sum_splits(b, trb_scale(middle)) <= b->split_max) low = middle;
    else high = middle;
  }
  return trb_scale(low);
}

/* Every primitive has slots for all its splits; those it does not need are gaps. */
static void trb_split_job(void *context, uint32_t index) {
  trb_build *b = (trb_build *)context;
  trb_block *block = &b->blocks[index];
  uint32_t first = index * TRB_READ_BLOCK, end = TRB_MIN(b->input.count, first + TRB_READ_BLOCK), slot = block->start, i;
  block->refs = 0;
  for (i = first; i < end; i++) {
    uint32_t splits = (uint32_t)trb_splits(b->priorities[i], b->priority_unit, b->scale), count;
    if (b->unsplit[i].first == TRBVH_NONE) continue;
    count = trb_split_reference(&b->input, b->grid, b->unsplit[i], splits, b->refs + slot);
    block->refs += count;
    for (; count <= splits; count++) b->refs[slot + count].first = TRBVH_NONE;
    slot += splits + 1;
  }
}

static trbvh_result trb_split(trb_build *b) {
  uint32_t i, start = 0;
  float largest = 0;
  if (trb_run(&b->runner, b->block_count, trb_priority_job, b)) return TRBVH_CANCELLED;
  for (i = 0; i < b->block_count; i++) largest = TRB_MAX(b->blocks[i].priority, largest);
  b->priority_unit = trb_priority_unit(largest);
  trb_sum_splits(b, trb_find_scale(b));
  if (b->runner.cancelled) return TRBVH_CANCELLED;
  for (i = 0; i < b->block_count; i++) {
    trb_block *block = &b->blocks[i];
    block->start = start;
    block->slots = block->refs + (uint32_t)block->splits;
    start += block->slots;
  }
  b->slot_count = start;
  if (trb_run(&b->runner, b->block_count, trb_split_job, b)) return TRBVH_CANCELLED;
  for (i = 0, b->ref_count = 0; i < b->block_count; i++) b->ref_count += b->blocks[i].refs;
  return TRBVH_OK;
}

// ---- Keys and their sort ----
static trb_curve trb_sorted_curve(const trb_build *b) {
  trb_curve curve;
  curve.keys = b->keys;
  curve.refs = b->refs;
  curve.mesh = &b->input;
  curve.grid = b->grid;
  curve.form = b->key_form;
  curve.count = b->ref_count;
  return curve;
}

/* Boxes from references, as trb_read_row makes them. */
static void trb_gather_row(const trbvh_node *refs, uint32_t count, trb_row *row) {
  uint32_t i, k;
  for (i = 0; i < count; i++) {
    for (k = 0; k < 3; k++) { row->min[k][i] = refs[i].min[k]; row->max[k][i] = refs[i].max[k]; }
    row->valid[i] = refs[i].first != TRBVH_NONE;
  }
}

/* Keys of a block's references, without the gaps. */
static void trb_key_job(void *context, uint32_t index) {
  trb_build *b = (trb_build *)context;
  const trb_block block = b->blocks[index];
  trb_u64 *out = b->keys + block.key_start, key[TRB_ROW];
  uint32_t first = block.start, end = first + block.slots, i, n;
  trb_row row;
  memset(&row, 0, sizeof row);
  for (; first < end; first += n) {
    n = TRB_MIN(end - first, TRB_ROW);
    for (i = 0; i < n; i++) row.prim[i] = first + i;
    if (b->refs) trb_gather_row(b->refs + first, n, &row);
    else trb_check_row(&b->input, trb_read_row(&b->input, n, &row), &row);
    trb_row_keys(&row, first, b->grid, b->key_form, key);
    for (i = 0; i < n; i++)
      if (row.valid[i]) *out++ = key[i];
  }
}

static int trb_make_keys(trb_build *b) {
  uint32_t i, start = 0;
  if (b->guessed) return 0;
  for (i = 0; i < b->block_count; i++) {
    b->blocks[i].key_start = start;
    start += b->blocks[i].refs;
  }
  return trb_run(&b->runner, b->block_count, trb_key_job, b);
}

/* Of unpacked keys in the order of the low half of the code, those with the high half. */
static void trb_high_key_job(void *context, uint32_t index) {
  trb_build *b = (trb_build *)context;
  const trb_curve curve = trb_sorted_curve(b);
  uint32_t i = index * TRB_BLOCK, end = TRB_MIN(b->ref_count, i + TRB_BLOCK);
  for (; i < end; i++) {
    trb_u64 code = trb_box_code(trb_curve_ref(&curve, b->keys[i]), b->grid);
    b->keys[i] = trb_key(code, trb_key_ref(b->keys[i], b->key_form), b->key_form, 1);
  }
}

static int trb_make_high_keys(trb_build *b) {
  return trb_run(&b->runner, trb_blocks(b->ref_count, TRB_BLOCK), trb_high_key_job, b);
}

/* What a job counts and scatters. */
typedef struct trb_sort_part { uint32_t first, count, *histogram; } trb_sort_part;

/* Jobs of one size, as many as divide well among threads, but no more than blocks of TRB_BLOCK. */
static uint32_t trb_sort_jobs(const trb_build *b) {
  const uint32_t jobs = (trb_blocks(b->ref_count, TRB_SORT_BLOCK) + 7) & ~7u, most = trb_blocks(b->ref_count, TRB_BLOCK);
  return TRB_MIN(jobs, most);
}

static trb_sort_part trb_find_sort_part(const trb_build *b, uint32_t index) {
  const uint32_t size = trb_blocks(b->ref_count, trb_sort_jobs(b));
  trb_sort_part part;
  part.first = TRB_MIN(index * size, b->ref_count);
  part.count = TRB_MIN(b->ref_count - part.first, size);
  part.histogram = b->histograms + (size_t)index * b->digits;
  return part;
}

static void trb_histogram_job(void *context, uint32_t index) {
  trb_build *b = (trb_build *)context;
  const trb_sort_part part = trb_find_sort_part(b, index);
  trb_count_digits(b->keys + part.first, part.count, b->digit_shift, b->digits, part.histogram);
}

static void trb_scatter_job(void *context, uint32_t index) {
  trb_build *b = (trb_build *)context;
  const trb_sort_part part = trb_find_sort_part(b, index);
  trb_scatter_keys(b->keys + part.first, part.count, b->digit_shift, b->digits, part.histogram, b->sorted);
}

static void trb_sort_by_insertion(trb_u64 *keys, uint32_t count, uint32_t shift) {
  uint32_t i, k;
  for (i = 1; i < count; i++) {
    const trb_u64 key = keys[i];
    for (k = i; k > 0 && keys[k - 1] >> shift > key >> shift; k--) keys[k] = keys[k - 1];
    keys[k] = key;
  }
}

/* By bits [shift, shift + bits) of the keys, which are in order of those below. */
static int trb_sort(trb_build *b, uint32_t shift, uint32_t bits) {
  const uint32_t jobs = trb_sort_jobs(b);
  const uint32_t digit_bits = b->ref_count > TRB_SMALL_SORT ? TRB_DIGIT_BITS : 8;
  if (b->ref_count <= TRB_TINY_SORT) {
    trb_sort_by_insertion(b->keys, b->ref_count, shift);
    return 0;
  }
  b->digits = 1u << digit_bits;
  for (b->digit_shift = shift; b->digit_shift < shift + bits; b->digit_shift += digit_bits) {
    trb_u64 *swap = b->keys;
    if (trb_run(&b->runner, jobs, trb_histogram_job, b)) return 1;
    trb_place_digits(b->histograms, jobs, b->digits);
    if (trb_run(&b->runner, jobs, trb_scatter_job, b)) return 1;
    b->keys = b->sorted;
    b->sorted = swap;
  }
  return 0;
}

/* Where the keys with each first digit end, once trb_sort has sorted by that. */
static const uint32_t *trb_bucket_ends(const trb_build *b) {
  return b->histograms + (size_t)(trb_sort_jobs(b) - 1) * b->digits;
}

/* Sorts a bucket's keys by the bits below their first digit, in a cache, with an even number of passes. */
static void trb_sort_bucket(const trb_build *b, uint32_t first, uint32_t count) {
  const uint32_t bits = trb_blocks(b->key_form.bits - TRB_DIGIT_BITS, TRB_BUCKET_PASSES);
  trb_u64 *from = b->keys + first, *to = b->sorted + first, *swap;
  uint32_t next[1u << TRB_BUCKET_BITS], shift = b->key_form.shift, pass;
  if (count <= TRB_TINY_SORT) {
    trb_sort_by_insertion(from, count, shift);
    return;
  }
  for (pass = 0; pass < TRB_BUCKET_PASSES; pass++, shift += bits) {
    trb_count_digits(from, count, shift, 1u << bits, next);
    trb_place_digits(next, 1, 1u << bits);
    trb_scatter_keys(from, count, shift, 1u << bits, next, to);
    swap = from; from = to; to = swap;
  }
}

static void trb_bucket_job(void *context, uint32_t index) {
  const trb_build *b = (const trb_build *)context;
  const uint32_t *end = trb_bucket_ends(b);
  uint32_t digit = index * TRB_BUCKETS, first = digit ? end[digit - 1] : 0, i;
  for (i = 0; i < TRB_BUCKETS; i++, first = end[digit++]) trb_sort_bucket(b, first, end[digit] - first);
}

/* The same order as from the last digit on, unless one bucket holds so much that its job would be waited for. */
static int trb_sort_many(trb_build *b) {
  const uint32_t *end;
  uint32_t digit, first, largest = 0;
  if (trb_sort(b, b->key_form.shift + b->key_form.bits - TRB_DIGIT_BITS, TRB_DIGIT_BITS)) return 1;
  end = trb_bucket_ends(b);
  for (digit = first = 0; digit < TRB_DIGITS; first = end[digit++]) largest = TRB_MAX(end[digit] - first, largest);
  if (largest > b->ref_count / 4) return trb_sort(b, b->key_form.shift, b->key_form.bits);
  return trb_run(&b->runner, TRB_DIGITS / TRB_BUCKETS, trb_bucket_job, b);
}

static trbvh_result trb_sort_keys(trb_build *b) {
  int cancelled;
  if (b->key_form.packed && b->ref_count > TRB_LARGE_SORT) cancelled = trb_sort_many(b);
  else cancelled = trb_sort(b, b->key_form.shift, b->key_form.bits);
  if (!b->key_form.packed) cancelled = cancelled || trb_make_high_keys(b) || trb_sort(b, 32, 32);
  return cancelled ? TRBVH_CANCELLED : TRBVH_OK;
}

// ---- Hierarchy ----
static void trb_hierarchy_job(void *context, uint32_t index) {
  trb_build *b = (trb_build *)context;
  const uint32_t first = index * TRB_BLOCK, end = TRB_MIN(b->ref_count, first + TRB_BLOCK);
  const trb_curve curve = trb_sorted_curve(b);
  trb_build_block(&curve, first, end, b->costs, b->final, b->nodes, &b->ranges[index]);
}

static trbvh_result trb_build_hierarchy(trb_build *b) {
  const uint32_t blocks = trb_blocks(b->ref_count, TRB_BLOCK);
  if (trb_run(&b->runner, blocks, trb_hierarchy_job, b)) return TRBVH_CANCELLED;
  trb_build_top(b->nodes, b->ranges, blocks, b->costs, b->final);
  return TRBVH_OK;
}

// ---- Moves ----
static trb_mover trb_build_mover(const trb_build *b) {
  return trb_start_moves(b->nodes, b->refs, trb_split_words(b->keys, b->sorted, b->ref_max), b->costs);
}

/* Runs jobs as one of the moves' many small stages. */
static int trb_run_moves(trb_build *b, uint32_t count, trbvh_job *job) {
  return trb_stage(&b->runner, b->moves_share) || trb_run(&b->runner, count, job, b);
}

/* Blocks of pairs, which are numbered from 0, the root's, to the number of references. */
static uint32_t trb_pair_blocks(const trb_build *b) { return trb_blocks(b->ref_count, TRB_BLOCK); }

static void trb_score_job(void *context, uint32_t index) {
  trb_build *b = (trb_build *)context;
  const trb_mover m = trb_build_mover(b);
  uint32_t pair = TRB_MAX(1, index * TRB_BLOCK), end = TRB_MIN(b->ref_count, (index + 1) * TRB_BLOCK);
  uint32_t *histogram = b->histograms + (size_t)index * TRB_SCORES;
  memset(histogram, 0, TRB_SCORES * sizeof *histogram);
  for (; pair < end; pair++) {
    const uint32_t scores = trb_score_pair(&m, pair);
    histogram[scores >> 16]++;
    histogram[scores & 0xFFFFu]++;
  }
}

static void trb_count_candidates_job(void *context, uint32_t index) {
  trb_build *b = (trb_build *)context;
  const trb_mover m = trb_build_mover(b);
  const uint32_t first = TRB_MAX(1, index * TRB_BLOCK), end = TRB_MIN(b->ref_count, (index + 1) * TRB_BLOCK);
  b->histograms[index] = trb_count_candidates(&m, first, end, b->lowest_score);
}

static void trb_list_candidates_job(void *context, uint32_t index) {
  trb_build *b = (trb_build *)context;
  const trb_mover m = trb_build_mover(b);
  const uint32_t first = TRB_MAX(1, index * TRB_BLOCK), end = TRB_MIN(b->ref_count, (index + 1) * TRB_BLOCK);
  trb_list_candidates(&m, first, end, b->lowest_score, b->histograms[index], TRB_MOVES_MAX(b->ref_count));
}

/* Lists the candidates for reinsertion: the wanted number, or a few more. */
static int trb_find_candidates(trb_build *b, uint32_t wanted) {
  const uint32_t blocks = trb_pair_blocks(b);
  uint32_t *histogram = b->histograms, *parents = trb_build_mover(b).parents, block, i, count;
  parents[0] = parents[b->nodes[0].first / 2] = 0;
  if (trb_run_moves(b, blocks, trb_score_job)) return 1;
  for (block = 1; block < blocks; block++)
    for (i = 0; i < TRB_SCORES; i++) histogram[i] += histogram[(size_t)block * TRB_SCORES + i];
  b->lowest_score = trb_lowest_score(histogram, wanted);
  if (trb_run_moves(b, blocks, trb_count_candidates_job)) return 1;
  for (block = b->move_count = 0; block < blocks; block++) {
    count = histogram[block];
    histogram[block] = b->move_count;
    b->move_count += count;
  }
  b->move_count = TRB_MIN(b->move_count, TRB_MOVES_MAX(b->ref_count));
  return trb_run_moves(b, blocks, trb_list_candidates_job);
}

static void trb_search_job(void *context, uint32_t index) {
  trb_build *b = (trb_build *)context;
  const trb_mover m = trb_build_mover(b);
  uint32_t i = index * TRB_SEARCHES, end = TRB_MIN(b->move_count, i + TRB_SEARCHES);
  for (; i < end; i++) trb_search(&m, i, b->batch, trb_least_gain(b->lowest_score));
}

static void trb_move_job(void *context, uint32_t index) {
  const trb_build *b = (const trb_build *)context;
  const trb_mover m = trb_build_mover(b);
  uint32_t i = index * TRB_MOVES, end = TRB_MIN(b->move_count, i + TRB_MOVES);
  for (; i < end; i++) trb_make_move(&m, i, b->merges);
}

/* What a batch has found: merges, or reinsertions. */
static int trb_make_moves(trb_build *b, uint32_t merges) {
  const trb_mover m = trb_build_mover(b);
  b->merges = merges;
  trb_choose_moves(&m, b->move_count);
  if (trb_run(&b->runner, trb_blocks(b->move_count, TRB_MOVES), trb_move_job, b)) return 1;
  trb_remake_moved(&m, b->move_count);
  return 0;
}

/* The last batch is for those that had to stand back in the one before. */
static int trb_reinsert_candidates(trb_build *b) {
  const uint32_t wanted = (uint32_t)(b->options.reinsert_share * (float)b->ref_count);
  if (wanted == 0) return 0;
  if (trb_find_candidates(b, wanted)) return 1;
  memset(trb_build_mover(b).owners, 0xFF, (size_t)b->ref_count * sizeof(uint32_t));
  for (b->batch = 0; b->batch <= TRB_MOVE_BATCHES; b->batch++)
    if (trb_run_moves(b, trb_blocks(b->move_count, TRB_SEARCHES), trb_search_job) || trb_make_moves(b, 0)) return 1;
  return 0;
}

/* Few triangles are split: a bit for every slot tells whether the next one holds another reference of the same. */
static void trb_forget_refs_job(void *context, uint32_t index) {
  const trb_build *b = (const trb_build *)context;
  uint32_t i = index * TRB_BLOCK, end = TRB_MIN(b->slot_count, i + TRB_BLOCK), bits = 0;
  for (; i < end; i++) {
    const uint32_t prim = b->refs[i].first;
    const uint32_t more = i + 1 < b->slot_count && prim != TRBVH_NONE && b->refs[i + 1].first == prim;
    bits |= more << (i & 31);
    if ((i & 31) == 31 || i + 1 == end) {
      b->more[i / 32] = bits;
      bits = 0;
    }
    b->refs[i].count = TRBVH_NONE;
  }
}

static void trb_find_refs_job(void *context, uint32_t index) {
  const trb_build *b = (const trb_build *)context;
  const trb_mover m = trb_build_mover(b);
  uint32_t i = 2 * index * TRB_BLOCK, end = 2 * TRB_MIN(b->ref_count, (index + 1) * TRB_BLOCK);
  for (; i < end; i++) trb_find_ref(&m, i);
}

static void trb_search_merges_job(void *context, uint32_t index) {
  const trb_build *b = (const trb_build *)context;
  const trb_mover m = trb_build_mover(b);
  const uint32_t each = TRB_SEARCHES * TRB_MOVE_BATCHES, most = TRB_MOVES_MAX(b->slot_count) * TRB_MOVE_BATCHES;
  uint32_t i = index * each, end = TRB_MIN(most, i + each), bits, found = 0;
  for (; i < end; i += 32)
    for (bits = b->more[i / 32] & 0x11111111u << b->batch; bits; bits &= bits - 1) {
      const uint32_t ref = i + trb_log2(bits & (0 - bits));
      const trb_move move = ref < most ? trb_search_merge(&m, ref, b->slot_count) : trb_no_move();
      if (move.gain > 0) m.moves[index * TRB_SEARCHES + found++] = move;
    }
  b->found[index] = found;
}

static int trb_search_merges(trb_build *b) {
  const trb_mover m = trb_build_mover(b);
  const uint32_t jobs = trb_blocks(b->slot_count, TRB_SEARCHES * TRB_MOVE_BATCHES);
  uint32_t i;
  if (trb_run_moves(b, jobs, trb_search_merges_job)) return 1;
  for (i = b->move_count = 0; i < jobs; i++) {
    memmove(m.moves + b->move_count, m.moves + i * TRB_SEARCHES, b->found[i] * sizeof *m.moves);
    b->move_count += b->found[i];
  }
  return 0;
}

static int trb_unsplit(trb_build *b, uint32_t passes) {
  uint32_t pass;
  if (!b->refs || trb_run_moves(b, trb_blocks(b->slot_count, TRB_BLOCK), trb_forget_refs_job) ||
      trb_run_moves(b, trb_pair_blocks(b), trb_find_refs_job)) return b->runner.cancelled;
  memset(trb_build_mover(b).owners, 0xFF, (size_t)b->ref_count * sizeof(uint32_t));
  for (pass = 0; pass < passes; pass++)
    for (b->batch = 0; b->batch < TRB_MOVE_BATCHES; b->batch++)
      if (trb_search_merges(b) || trb_make_moves(b, 1)) return 1;
  return 0;
}

static void trb_cost_job(void *context, uint32_t index) {
  const trb_build *b = (const trb_build *)context;
  const float unit = trb_cost_unit(b->nodes[0], b->costs);
  uint32_t pair = TRB_MAX(1, index * TRB_BLOCK), end = TRB_MIN(b->ref_count, (index + 1) * TRB_BLOCK);
  b->sums[index] = 0;
  for (; pair < end; pair++) b->sums[index] += trb_pair_cost(b->nodes, pair, unit, b->costs);
}

static int trb_sum_costs(trb_build *b, double *cost) {
  trb_u64 sum = 0;
  uint32_t i;
  if (trb_run(&b->runner, trb_pair_blocks(b), trb_cost_job, b)) return 1;
  for (i = 0; i < trb_pair_blocks(b); i++) sum += b->sums[i];
  *cost = (double)sum;
  return 0;
}

// ---- Treelets, and which nodes become leaves ----
static trb_collapser trb_start_collapse(const trb_build *b) {
  trb_collapser c;
  c.nodes = b->nodes;
  c.words = trb_split_words(b->keys, b->sorted, b->ref_max);
  c.costs = b->costs;
  c.cost_node = b->options.cost_node;
  c.cost_prim = b->options.cost_prim;
  c.refs = b->refs;
  c.keys = b->keys;
  c.form = b->key_form;
  c.ref_count = b->ref_count;
  c.held = b->optimizes ? b->held : NULL;
  c.out = (trbvh_node *)(uintptr_t)b->tree.nodes;
  c.prims = (uint32_t *)(uintptr_t)b->tree.prims;
  return c;
}

static void trb_group_job(void *context, uint32_t index) {
  const trb_build *b = (const trb_build *)context;
  const trb_collapser c = trb_start_collapse(b);
  trb_restructure_group(&c, b->tasks, b->groups[index], b->phase.gamma, b->phase.rounds);
  if (b->phase.last) trb_settle_group(&c, b->tasks, b->groups[index]);
}

/* The rounds of a phase; and settles the tree, after the last one. */
static trbvh_result trb_restructure_and_settle(trb_build *b) {
  const trb_collapser c = trb_start_collapse(b);
  trb_restructure_top(b->nodes, c.words, b->phase.rounds, b->costs);
  b->task_count = trb_find_tasks(&c, b->final ? b->ranges : NULL, b->tasks, &b->sah);
  b->group_count = trb_find_groups(b->tasks, b->task_count, b->groups);
  if (b->final) return TRBVH_OK;
  return trb_run(&b->runner, b->group_count, trb_group_job, b) ? TRBVH_CANCELLED : TRBVH_OK;
}

// ---- The result ----
static void trb_emit_job(void *context, uint32_t index) {
  const trb_build *b = (const trb_build *)context;
  const trb_collapser c = trb_start_collapse(b);
  const trb_group group = b->groups[index];
  uint32_t i;
  for (i = group.first_task; i < group.first_task + group.tasks; i++) {
    if (b->final) trb_emit_final_task(&c, &b->tasks[i]);
    else trb_emit_task(&c, b->tasks[i]);
  }
}

/* Memory for the result: the old block where it is large enough, else a new one. */
static trbvh_result trb_make_room(trb_build *b, trbvh *bvh, uint32_t leaves, uint32_t prims) {
  const size_t size = trb_result_size(b, leaves, prims);
  char *base;
  if (bvh->block_size < size) {
    trbvh_free(bvh);
    bvh->allocator = b->options.allocator;
    bvh->block = trb_alloc(&bvh->allocator, size);
    if (!bvh->block)
      return trb_fail(b, TRBVH_OUT_OF_MEMORY, "no memory for the tree: %u MiB", (unsigned)(size >> 20), 0, 0);
    bvh->block_size = size;
  }
  base = trb_align(bvh->block);
  b->tree.nodes = (trbvh_node *)(void *)base;
  base += (size_t)leaves * 2 * TRB_NODE_BYTES;
  b->tree.triangles = NULL;
  if (!b->input.boxes && !(b->options.flags & TRBVH_NO_TRIANGLES)) {
    b->tree.triangles = (trbvh_triangle *)(void *)base;
    base += (size_t)prims * sizeof(trbvh_triangle);
  }
  b->tree.prims = (uint32_t *)(void *)base;
  b->tree.node_count = 2 * leaves;
  b->tree.ref_count = prims;
  b->stats.bytes_result = size;
  b->stats.leaf_count = leaves;
  b->stats.node_count = b->tree.node_count;
  b->stats.ref_count = prims;
  return TRBVH_OK;
}

/* Are areas of boxes in one of this area within float's range? Else equation 1 needs double. */
static int trb_fits_areas(float root) { return root > 1e-30f && root < FLT_MAX; }

static double trb_exact_sah(const trb_build *b) {
  const float node = b->options.cost_node, prim = b->options.cost_prim;
  return trbvh_sah(&b->tree, node > 0 ? node : -1, prim > 0 ? prim : -1);
}

/* Into the tree's nodes and, unless they stay, its prims. */
static trbvh_result trb_emit_nodes(trb_build *b) {
  const trb_collapser c = trb_start_collapse(b);
  const float root = trb_area(b->nodes[0]);
  double sah = b->sah;
  uint32_t i;
  memset(&c.out[1], 0, TRB_NODE_BYTES);
  trb_emit_top(&c, b->tasks, b->task_count);
  if (trb_run(&b->runner, b->group_count, trb_emit_job, b)) return TRBVH_CANCELLED;
  for (i = 0; i < b->task_count; i++) {
    sah += b->tasks[i].sah;
    b->stats.max_depth = TRB_MAX(b->tasks[i].max_depth, b->stats.max_depth);
  }
  b->stats.sah_cost = trb_fits_areas(root) ? sah / root : trb_exact_sah(b);
  return TRBVH_OK;
}

static trbvh_result trb_emit(trb_build *b, trbvh *bvh) {
  uint32_t leaves = 0, prims = 0, i;
  trbvh_result result;
  for (i = 0; i < b->task_count; i++) {
    leaves += b->tasks[i].leaves;
    prims += b->tasks[i].prims;
  }
  result = trb_make_room(b, bvh, leaves, prims);
  return result ? result : trb_emit_nodes(b);
}

// ---- Triangles ----
static void trb_triangle_job(void *context, uint32_t index) {
  const trb_build *b = (const trb_build *)context;
  const uint32_t first = index * TRB_READ_BLOCK, end = TRB_MIN(b->tree.ref_count, first + TRB_READ_BLOCK);
  trb_make_triangles(&b->input, b->tree.prims, first, end, (trbvh_triangle *)(uintptr_t)b->tree.triangles);
}

static trbvh_result trb_finish(trb_build *b) {
  uint32_t jobs = b->tree.triangles ? trb_blocks(b->tree.ref_count, TRB_READ_BLOCK) : 0;
  return trb_run(&b->runner, jobs, trb_triangle_job, b) ? TRBVH_CANCELLED : TRBVH_OK;
}

// >>build -----------------------------------------------------------------------------------------------------------
static trbvh_result trb_allocate_scratch(trb_build *b) {
  const trbvh_options *o = &b->options;
  b->stats.bytes_scratch = trb_lay_out(b, NULL);
  if (o->scratch) {
    if (o->scratch_size < b->stats.bytes_scratch)
      return trb_fail(b, TRBVH_INVALID_ARGUMENT, "scratch_size is %u KiB, but %u KiB are needed",
                      (unsigned)(o->scratch_size >> 10), (unsigned)((b->stats.bytes_scratch + 1023) >> 10), 0);
    trb_lay_out(b, trb_align(o->scratch));
    return TRBVH_OK;
  }
  b->scratch_size = b->stats.bytes_scratch;
  b->scratch = trb_alloc(&o->allocator, b->scratch_size);
  if (!b->scratch)
    return trb_fail(b, TRBVH_OUT_OF_MEMORY, "no scratch memory: %u MiB", (unsigned)(b->scratch_size >> 20), 0, 0);
  trb_lay_out(b, trb_align(b->scratch));
  return TRBVH_OK;
}

static void trb_free_scratch(trb_build *b) {
  trb_free(&b->options.allocator, b->scratch, b->scratch_size);
  b->scratch = NULL;
}

static double trb_clock(const trb_build *b) { return b->options.stats ? trb_ms() : 0; }   /* not for free, for a small mesh */

/* Runs one stage, whose share of the time is an estimate for the progress report, and adds up its milliseconds. */
#define TRB_STAGE(share, ms, call) \
  if (!result) { \
    double start = trb_clock(b); \
    result = trb_stage(&b->runner, share) ? TRBVH_CANCELLED : (call); \
    b->stats.ms += trb_clock(b) - start; \
  }

/* Rounds of treelets are one phase; with moves between them, each one is. */
static uint32_t trb_phases(const trb_build *b) {
  const uint32_t rounds = (uint32_t)b->options.treelet_rounds;
  return b->options.reinsert_share > 0 && rounds ? rounds : 1;
}

static void trb_start_phase(trb_build *b, uint32_t phase) {
  const uint32_t phases = trb_phases(b), gamma = (uint32_t)b->options.treelet_gamma;
  const uint32_t shift = TRB_MIN(2 * (phases - 1 - phase), 31u);
  b->phase.last = phase + 1 == phases;
  b->phase.rounds = phases > 1 ? 1 : (uint32_t)b->options.treelet_rounds;
  b->phase.gamma = gamma > TRB_REFS_MAX >> shift ? TRB_REFS_MAX : gamma << shift;
  b->phase.unsplits = b->splitting ? (uint32_t)b->options.unsplit_passes : 0;
}

/* Makes a tree from the mesh, up to its last phase; tells what it costs, if that is not NULL. */
typedef trbvh_result trb_attempt(void *worker, int splitting, double *cost);

/* Are splits to be kept only if they pay? Not where all of them are, as in the paper. */
static int trb_compares(const trb_build *b) {
  return b->split_max && b->options.unsplit_passes && trb_phases(b) > 1;
}

/* The tree with or without splits, whichever is better. The one without is made again where that is it: which takes less
 * memory, and no longer on the whole, than making it last. */
static trbvh_result trb_attempt_both(trb_build *b, trb_attempt *attempt, void *worker) {
  double without, with;
  trbvh_result result;
  b->effort = 1;
  if (!trb_compares(b)) return attempt(worker, b->split_max > 0, NULL);
  b->effort = 1 / 3.0f;
  result = attempt(worker, 0, &without);
  if (!result) result = attempt(worker, 1, &with);
  return !result && with > TRB_SPLITS_PAY * without ? attempt(worker, 0, NULL) : result;
}

static trbvh_result trb_run_phase(trb_build *b, uint32_t phase) {
  const float share = 0.65f / (float)trb_phases(b), part = phase + 1 == trb_phases(b) ? share : share * b->effort;
  trbvh_result result = TRBVH_OK;
  trb_start_phase(b, phase);
  b->moves_share = part * 0.25f / (float)((b->phase.unsplits + 1) * TRB_MOVE_BATCHES + 6);
  if (b->phase.unsplits) { TRB_STAGE(0, ms_moves, trb_unsplit(b, b->phase.unsplits) ? TRBVH_CANCELLED : TRBVH_OK) }
  if (b->phase.unsplits || phase) { TRB_STAGE(0, ms_moves, trb_reinsert_candidates(b) ? TRBVH_CANCELLED : TRBVH_OK) }
  if (b->phase.rounds) { TRB_STAGE(phase ? part * 0.75f : part, ms_treelets, trb_restructure_and_settle(b)) }
  else { TRB_STAGE(0, ms_collapse, trb_restructure_and_settle(b)) }
  return result;
}

/* What comes before and after treelets, in parts of the time. */
static float trb_other_share(const trb_build *b) {
  return 1 - (b->options.treelet_rounds ? 0.65f : 0) - (b->split_max ? 0.15f : 0);
}

static trbvh_result trb_attempt_in_c(void *worker, int splitting, double *cost) {
  trb_build *b = (trb_build *)worker;
  const float rest = trb_other_share(b) * b->effort;
  trbvh_result result = TRBVH_OK;
  uint32_t phase;
  trb_start_attempt(b, splitting);
  TRB_STAGE(rest * 0.15f, ms_morton, trb_read(b))
  if (splitting) { TRB_STAGE(0.15f, ms_split, trb_split(b)) }
  if (cost) *cost = 0;
  if (result || b->ref_count == 0) return result;
  TRB_STAGE(rest * 0.05f, ms_morton, trb_make_keys(b) ? TRBVH_CANCELLED : TRBVH_OK)
  TRB_STAGE(rest * 0.20f, ms_sort, trb_sort_keys(b))
  TRB_STAGE(rest * 0.25f, ms_hierarchy, trb_build_hierarchy(b))
  for (phase = 0; !result && phase + 1 < trb_phases(b); phase++) result = trb_run_phase(b, phase);
  if (cost) { TRB_STAGE(0, ms_split, trb_sum_costs(b, cost) ? TRBVH_CANCELLED : TRBVH_OK) }
  return result;
}

static trbvh_result trb_run_stages(trb_build *b, trbvh *bvh) {
  const float rest = trb_other_share(b);
  trbvh_result result = trb_allocate_scratch(b);
  if (!result) result = trb_attempt_both(b, trb_attempt_in_c, b);
  if (result || b->ref_count == 0) return result;
  result = trb_run_phase(b, trb_phases(b) - 1);
  TRB_STAGE(rest * 0.20f, ms_collapse, trb_emit(b, bvh))
  trb_free_scratch(b);                               /* before the triangles are touched: less memory at a time */
  TRB_STAGE(rest * 0.15f, ms_finish, trb_finish(b))
  if (!result && trb_stage(&b->runner, 0)) result = TRBVH_CANCELLED;
  return result;
}

/* Was it the device that failed, so that the C code can do the work? */
static int trb_falls_back(const trb_build *b, trbvh_result result) {
  return !(b->options.flags & TRBVH_NO_FALLBACK) &&
         (result == TRBVH_OUT_OF_DEVICE_MEMORY || result == TRBVH_NO_DEVICE || result == TRBVH_DEVICE_ERROR);
}

static trbvh_result trb_build_on_device(trb_build *b, trbvh *bvh) {
  trbvh_device *device = b->options.device;
  trbvh_result result;
  trb_runner_start(&b->runner, &b->options, 0);
  result = device->build(device, b, bvh);
  trb_runner_stop(&b->runner);
  b->stats.on_device = result == TRBVH_OK;
  return result;
}

static trbvh_result trb_build_in_c(trb_build *b, trbvh *bvh) {
  trbvh_result result;
  trbvh_stats stats;                                 /* what a device did is forgotten, except why it stopped */
  memset(&stats, 0, sizeof stats);
  memcpy(stats.message, b->stats.message, sizeof stats.message);
  b->stats = stats;
  memset(&b->tree, 0, sizeof b->tree);
  trb_runner_start(&b->runner, &b->options, b->input.count > TRB_BLOCK);
  result = trb_run_stages(b, bvh);
  trb_runner_stop(&b->runner);
  trb_free_scratch(b);
  return result;
}

/* The tree, which stands in bvh's block, to the user. */
static void trb_hand_over(const trb_build *b, trbvh *bvh, uint32_t prim_count) {
  bvh->nodes = b->tree.nodes;
  bvh->prims = b->tree.prims;
  bvh->triangles = b->tree.triangles;
  bvh->wide = NULL;
  bvh->node_count = b->tree.node_count;
  bvh->ref_count = b->tree.ref_count;
  bvh->prim_count = prim_count;
  bvh->flags = b->options.flags;
}

/* What calls with options end with: a message for every failure, and the user's stats. */
static trbvh_result trb_report(trb_build *b, trbvh_result result, double start, const trbvh_options *options) {
  if (result && !b->stats.message[0]) trb_fail(b, result, trbvh_result_text(result), 0, 0, 0);
  if (options && options->stats) {
    b->stats.ms_total = trb_ms() - start;
    *options->stats = b->stats;
  }
  return result;
}

TRBVH_API trbvh_result trbvh_build(trbvh *bvh, const trbvh_geometry *geometry, const trbvh_options *options) {
  trb_build b;
  double start = options && options->stats ? trb_ms() : 0;
  trbvh_result result = trb_resolve(&b, geometry, options);
  if (!bvh) result = trb_fail(&b, TRBVH_INVALID_ARGUMENT, "bvh is NULL", 0, 0, 0);
  if (!result && b.input.count) {
    if (b.options.device) result = trb_build_on_device(&b, bvh);
    if (!b.options.device || trb_falls_back(&b, result)) result = trb_build_in_c(&b, bvh);
  }
  if (result && bvh) {
    trbvh_free(bvh);
  } else if (bvh) {
    trb_hand_over(&b, bvh, b.input.count);
  }
  return trb_report(&b, result, start, options);
}

// >>optimize ---- a tree that exists, whose leaves are the references ------------------------------------------------
/* As a build of the leaves' boxes, which stand among the nodes, none of them to share a leaf with another. */
static trbvh_result trb_resolve_optimize(trb_build *b, const void *nodes, uint32_t node_count, const trbvh_options *options) {
  trbvh_geometry leaves;
  trbvh_options o;
  trbvh_result result;
  memset(&o, 0, sizeof o);
  if (options) o = *options;
  o.max_leaf = 1;
  memset(&leaves, 0, sizeof leaves);
  leaves.boxes = nodes;
  leaves.count = nodes ? node_count / 2 : 0;
  result = trb_resolve(b, &leaves, &o);
  b->optimizes = 1;
  b->final = 0;
  return result;
}

static trbvh_result trb_open_node(trb_build *b, const trbvh *bvh, uint32_t i) {
  trbvh_node n = bvh->nodes[i];
  if (n.count > bvh->ref_count || (n.count && n.first > bvh->ref_count - n.count))
    return trb_fail(b, TRBVH_BAD_DATA, "leaf %u reaches beyond the %u primitives", i, bvh->ref_count, 0);
  b->nodes[i] = trb_unsettle(n, i, &b->held[i], b->costs);
  return TRBVH_OK;
}

/* Inner nodes are listed from the root down, whatever their order, and made from their children in the opposite order. */
static trbvh_result trb_open_tree(trb_build *b, const trbvh *bvh) {
  const trb_mover m = trb_build_mover(b);
  uint32_t *list = m.list, *seen = m.owners, count = 0, pairs = bvh->node_count / 2, i, side;
  trbvh_result result = trb_open_node(b, bvh, 0);
  b->ref_count = pairs;
  memset(seen, 0, (size_t)pairs * sizeof *seen);
  if (bvh->nodes[0].count == 0) list[count++] = 0;
  for (i = 0; i < count && !result; i++) {
    const uint32_t pair = bvh->nodes[list[i]].first;
    if (pair % 2 || pair == 0 || pair / 2 >= pairs || count == pairs || seen[pair / 2]++)
      return trb_fail(b, TRBVH_BAD_DATA, "node %u: its children at %u are another node's, or none", list[i], pair, 0);
    for (side = 0; side < 2 && !result; side++) {
      result = trb_open_node(b, bvh, pair + side);
      if (bvh->nodes[pair + side].count == 0 && count < pairs) list[count++] = pair + side;
    }
  }
  if (!result && count + 1 != pairs)
    return trb_fail(b, TRBVH_BAD_DATA, "%u pairs of nodes, but %u are children", pairs - 1, count, 0);
  while (count-- && !result) trb_remake(b->nodes, list[count], b->costs);
  return result;
}

static trbvh_result trb_optimize(trb_build *b, trbvh *bvh) {
  trbvh_result result = trb_allocate_scratch(b);
  uint32_t phase;
  trb_start_attempt(b, 0);
  b->effort = 1;
  TRB_STAGE(0.2f, ms_hierarchy, trb_open_tree(b, bvh))
  for (phase = 0; !result && phase < trb_phases(b); phase++) result = trb_run_phase(b, phase);
  if (!result && trb_stage(&b->runner, 0)) result = TRBVH_CANCELLED;
  b->options.progress = NULL;            /* not to be cancelled any more: the tree changes */
  b->tree = *bvh;
  TRB_STAGE(0, ms_collapse, trb_emit_nodes(b))
  return result;
}

TRBVH_API trbvh_result trbvh_optimize(trbvh *bvh, const trbvh_options *options) {
  trb_build b;
  const double start = trb_ms();
  trbvh_result result = trb_resolve_optimize(&b, bvh ? bvh->nodes : NULL, bvh ? bvh->node_count : 0, options);
  if (!bvh) result = trb_fail(&b, TRBVH_INVALID_ARGUMENT, "bvh is NULL", 0, 0, 0);
  if (!result && b.input.count) {
    trb_runner_start(&b.runner, &b.options, b.input.count > TRB_BLOCK);
    result = trb_optimize(&b, bvh);
    trb_runner_stop(&b.runner);
    trb_free_scratch(&b);
  }
  if (!result) {
    b.stats.node_count = bvh->node_count;
    b.stats.leaf_count = bvh->node_count / 2;
    b.stats.ref_count = bvh->ref_count;
  }
  return trb_report(&b, result, start, options);
}

// >>query -----------------------------------------------------------------------------------------------------------
static int trb_query(const trbvh *bvh, const trbvh_ray *ray, int any, trbvh_hit *hit) {
  static const trbvh_node nothing = {{0, 0, 0}, 0, {0, 0, 0}, 0};
  const trbvh_node *nodes = bvh->node_count ? bvh->nodes : &nothing;
  trb_ray r;
  if (trb_prepare_ray(&r, ray, (const float *)nodes) && bvh->triangles)
    return any ? trb_trace(nodes, bvh->triangles, &r, 1, hit) : trb_trace(nodes, bvh->triangles, &r, 0, hit);
  trb_miss(&r, hit);
  return 0;
}

TRBVH_API int trbvh_intersect(const trbvh *bvh, const trbvh_ray *ray, trbvh_hit *hit) {
  return trb_query(bvh, ray, 0, hit);
}

TRBVH_API int trbvh_occluded(const trbvh *bvh, const trbvh_ray *ray) {
  trbvh_hit hit;
  return trb_query(bvh, ray, 1, &hit);
}

#define TRB_RAY_BLOCK 1024u              /* rays a job traces */
struct trb_batch {
  const trbvh     *bvh;
  const trbvh_ray *rays;
  trbvh_hit       *hits;
  uint8_t         *occluded;
  size_t           count;
};

static void trb_batch_job(void *context, uint32_t index) {
  const trb_batch *batch = (const trb_batch *)context;
  size_t i = (size_t)index * TRB_RAY_BLOCK, end = TRB_MIN(batch->count, i + TRB_RAY_BLOCK);
  for (; i < end; i++)
    if (batch->hits) trbvh_intersect(batch->bvh, &batch->rays[i], &batch->hits[i]);
    else batch->occluded[i] = (uint8_t)trbvh_occluded(batch->bvh, &batch->rays[i]);
}

static trbvh_result trb_run_batch(trb_batch batch, const trbvh_options *options) {
  trb_build b;
  trbvh_result result;
  double start = trb_ms();
  memset(&b, 0, sizeof b);
  result = trb_resolve_options(&b, options);
  if (!result && batch.count && (!batch.bvh || !batch.rays || (!batch.hits && !batch.occluded)))
    result = trb_fail(&b, TRBVH_INVALID_ARGUMENT, "bvh, rays or results are NULL", 0, 0, 0);
  if (!result && batch.count && batch.bvh->node_count && !batch.bvh->triangles)
    result = trb_fail(&b, TRBVH_INVALID_ARGUMENT, "the tree has no triangles", 0, 0, 0);
  if (!result && batch.count / TRB_RAY_BLOCK >= UINT32_MAX)
    result = trb_fail(&b, TRBVH_TOO_LARGE, "too many rays for one call", 0, 0, 0);
  if (!result && batch.count && b.options.device) {
    trb_runner_start(&b.runner, &b.options, 0);
    result = b.options.device->trace(b.options.device, &b, &batch);
    trb_runner_stop(&b.runner);
    b.stats.on_device = result == TRBVH_OK;
  }
  if (batch.count && (b.options.device ? trb_falls_back(&b, result) : !result)) {
    uint32_t jobs = (uint32_t)((batch.count + TRB_RAY_BLOCK - 1) / TRB_RAY_BLOCK);
    result = TRBVH_OK;
    trb_runner_start(&b.runner, &b.options, jobs > 1);
    trb_stage(&b.runner, 1);
    if (trb_run(&b.runner, jobs, trb_batch_job, &batch) || trb_stage(&b.runner, 0)) result = TRBVH_CANCELLED;
    trb_runner_stop(&b.runner);
  }
  return trb_report(&b, result, start, options);
}

TRBVH_API trbvh_result trbvh_intersect_n(const trbvh *bvh, const trbvh_ray *rays, trbvh_hit *hits, size_t count,
                                         const trbvh_options *options) {
  const trb_batch batch = {bvh, rays, hits, NULL, count};
  return trb_run_batch(batch, options);
}

TRBVH_API trbvh_result trbvh_occluded_n(const trbvh *bvh, const trbvh_ray *rays, uint8_t *occluded, size_t count,
                                        const trbvh_options *options) {
  const trb_batch batch = {bvh, rays, NULL, occluded, count};
  return trb_run_batch(batch, options);
}

// >>validate --------------------------------------------------------------------------------------------------------
static double trb_exact_area(trbvh_node n) {         /* half of it */
  double x = (double)n.max[0] - n.min[0], y = (double)n.max[1] - n.min[1], z = (double)n.max[2] - n.min[2];
  return x * y + z * (x + y);
}

TRBVH_API double trbvh_sah(const trbvh *bvh, float cost_node, float cost_prim) {
  double node_weight = cost_node == 0 ? 1.2 : TRB_MAX(cost_node, 0);
  double prim_weight = cost_prim == 0 ? 1.0 : TRB_MAX(cost_prim, 0);
  double sum = 0, root;
  uint32_t i;
  if (!bvh || !bvh->node_count) return 0;
  root = trb_exact_area(bvh->nodes[0]);
  for (i = 0; i < bvh->node_count; i += i ? 1 : 2) {
    const trbvh_node *n = &bvh->nodes[i];
    sum += trb_exact_area(*n) * (n->count ? prim_weight * n->count : node_weight);
  }
  return root > 0 ? sum / root : 0;
}

/* One bit for each pair of siblings, each entry of prims[], each primitive, and three for its corners. */
typedef struct trb_check {
  const trbvh    *bvh;
  trbvh_geometry  geometry;
  unsigned char  *pair_seen, *entry_seen, *prim_seen, *corner_seen;
  char           *why;
  size_t          why_size;
} trb_check;

static int trb_mark(unsigned char *bits, size_t i) {           /* 1 when seen before */
  int seen = bits[i >> 3] >> (i & 7) & 1;
  bits[i >> 3] = (unsigned char)(bits[i >> 3] | 1 << (i & 7));
  return seen;
}

static trbvh_result trb_damage(const trb_check *c, const char *format, unsigned a, unsigned b) {
  if (c->why && c->why_size) snprintf(c->why, c->why_size, format, a, b);
  return TRBVH_BAD_DATA;
}

static int trb_inside(const trbvh_node *inner, const trbvh_node *outer) {
  int k, inside = 1;
  for (k = 0; k < 3; k++) inside &= inner->min[k] >= outer->min[k] && inner->max[k] <= outer->max[k];
  return inside;
}

/* Entry i of a leaf against the mesh. Where triangles were split, a leaf holds a part of each: boxes must overlap, and
 * each corner be in one of the triangle's leaves. */
static trbvh_result trb_check_entry(const trb_check *c, const trbvh_node *leaf, uint32_t i, int split) {
  const trbvh *bvh = c->bvh;
  uint32_t prim = bvh->prims[i], vertex;
  trbvh_node box;
  float v[3][3];
  int k, overlap = 1;
  if (trb_prim_box(&c->geometry, prim, &box, v, &vertex) != 1)
    return trb_damage(c, "prims[%u] is primitive %u, which is invalid", i, prim);
  if (trb_mark(c->prim_seen, prim) && !split) return trb_damage(c, "primitive %u is in two leaves", prim, 0);
  for (k = 0; k < 3; k++) overlap &= box.min[k] <= leaf->max[k] && box.max[k] >= leaf->min[k];
  if (!overlap || (!split && !trb_inside(&box, leaf)))
    return trb_damage(c, "primitive %u is outside of its leaf, entry %u", prim, i);
  for (k = 0; k < 3 && split; k++) {
    trbvh_node corner = trb_no_box();
    trb_include(&corner, v[k], v[k]);
    if (trb_inside(&corner, leaf)) trb_mark(c->corner_seen, (size_t)prim * 3 + (size_t)k);
  }
  if (bvh->triangles && !c->geometry.boxes) {
    const trbvh_triangle *t = &bvh->triangles[i];
    for (k = 0; k < 3; k++)
      if (t->v0[k] != v[0][k] || t->e1[k] != v[1][k] - v[0][k] || t->e2[k] != v[2][k] - v[0][k])
        return trb_damage(c, "triangles[%u] is not triangle %u of the mesh", i, prim);
  }
  return TRBVH_OK;
}

static trbvh_result trb_check_leaf(const trb_check *c, uint32_t index, int split) {
  const trbvh *bvh = c->bvh;
  const trbvh_node *leaf = &bvh->nodes[index];
  uint32_t i, k;
  trbvh_result result = TRBVH_OK;
  if (leaf->count > bvh->ref_count || leaf->first > bvh->ref_count - leaf->count)
    return trb_damage(c, "leaf %u reaches beyond the %u primitives", index, bvh->ref_count);
  for (i = leaf->first; i < leaf->first + leaf->count && !result; i++) {
    if (trb_mark(c->entry_seen, i)) return trb_damage(c, "prims[%u] is in two leaves", i, 0);
    if (bvh->prims[i] >= bvh->prim_count) return trb_damage(c, "prims[%u] is %u, out of range", i, bvh->prims[i]);
    if (bvh->triangles && bvh->triangles[i].prim != bvh->prims[i])
      return trb_damage(c, "triangles[%u].prim is not prims[%u]", i, i);
    for (k = leaf->first; k < i; k++)
      if (bvh->prims[k] == bvh->prims[i]) return trb_damage(c, "leaf %u holds primitive %u twice", index, bvh->prims[i]);
    if (c->prim_seen) result = trb_check_entry(c, leaf, i, split);
  }
  return result;
}

static trbvh_result trb_check_tree(const trb_check *c, int split) {
  const trbvh_node *nodes = c->bvh->nodes;
  uint32_t stack[TRBVH_MAX_DEPTH], depths[TRBVH_MAX_DEPTH], height = 0, node = 0, depth = 0, visited = 0, entries = 0, k;
  for (;;) {
    const uint32_t first = nodes[node].first, count = nodes[node].count;
    visited++;
    for (k = 0; k < 3; k++)
      if (!(nodes[node].min[k] <= nodes[node].max[k])) return trb_damage(c, "node %u has an inverted box", node, 0);
    if (count == 0) {
      if (first < 2 || first % 2 || first >= c->bvh->node_count || c->bvh->node_count - first < 2)
        return trb_damage(c, "node %u has no children at %u", node, first);
      if (trb_mark(c->pair_seen, first / 2)) return trb_damage(c, "node %u is reached twice", first, 0);
      if (!trb_inside(&nodes[first], &nodes[node]) || !trb_inside(&nodes[first + 1], &nodes[node]))
        return trb_damage(c, "a child of node %u, at %u, is outside of it", node, first);
      if (depth == TRBVH_MAX_DEPTH) return trb_damage(c, "node %u lies deeper than %u", first, TRBVH_MAX_DEPTH);
      stack[height] = first + 1;
      depths[height++] = ++depth;
      node = first;
    } else {
      trbvh_result result = trb_check_leaf(c, node, split);
      if (result) return result;
      entries += count;
      if (height == 0) break;
      node = stack[--height];
      depth = depths[height];
    }
  }
  if (visited + 1 != c->bvh->node_count)
    return trb_damage(c, "%u nodes can be reached, %u are there", visited + 1, c->bvh->node_count);
  if (entries != c->bvh->ref_count) return trb_damage(c, "%u entries of prims[%u] are in leaves", entries, c->bvh->ref_count);
  return TRBVH_OK;
}

TRBVH_API trbvh_result trbvh_validate(const trbvh *bvh, const trbvh_geometry *geometry, char *why, size_t why_size) {
  static const trbvh_node padding = {{0, 0, 0}, 0, {0, 0, 0}, 0};
  trb_build b;
  trb_check c;
  trbvh_result result = TRBVH_OK;
  size_t pairs, entries, prims;
  unsigned char *bits;
  uint32_t i, k, valid = 0, vertex;
  int split;
  memset(&b, 0, sizeof b);
  memset(&c, 0, sizeof c);
  c.bvh = bvh;
  c.why = why;
  c.why_size = why_size;
  if (why && why_size) why[0] = 0;
  if (!bvh) { trb_damage(&c, "bvh is NULL", 0, 0); return TRBVH_INVALID_ARGUMENT; }
  if (geometry) {
    result = trb_resolve_geometry(&b, geometry);
    if (!result && geometry->count != bvh->prim_count)
      result = trb_fail(&b, TRBVH_INVALID_ARGUMENT, "the tree is over %u primitives, the geometry has %u",
                        bvh->prim_count, geometry->count, 0);
    if (result) { trb_damage(&c, b.stats.message, 0, 0); return result; }
  }
  if (bvh->node_count % 2 || (bvh->node_count == 0) != (bvh->ref_count == 0))
    return trb_damage(&c, "%u nodes over %u entries of prims[]", bvh->node_count, bvh->ref_count);
  if (bvh->node_count && (!bvh->nodes || !bvh->prims || (uintptr_t)bvh->nodes % TRB_LINE))
    return trb_damage(&c, "nodes or prims is NULL, or nodes[] does not begin a cache line", 0, 0);
  if (bvh->node_count && memcmp(&bvh->nodes[1], &padding, sizeof padding))
    return trb_damage(&c, "nodes[1], which is padding, is not zero", 0, 0);
  pairs = bvh->node_count / 16 + 1;
  entries = bvh->ref_count / 8 + 1;
  prims = geometry ? (size_t)bvh->prim_count / 8 + 1 : 0;
  bits = (unsigned char *)TRBVH_MALLOC(pairs + entries + 4 * prims);
  if (!bits) { trb_damage(&c, "no memory for the check", 0, 0); return TRBVH_OUT_OF_MEMORY; }
  memset(bits, 0, pairs + entries + 4 * prims);
  c.geometry = b.input;
  c.pair_seen = bits;
  c.entry_seen = bits + pairs;
  c.prim_seen = geometry ? bits + pairs + entries : NULL;
  c.corner_seen = bits + pairs + entries + prims;
  for (i = 0; geometry && i < bvh->prim_count; i++) {
    trbvh_node box;
    float v[3][3];
    valid += trb_prim_box(&c.geometry, i, &box, v, &vertex) == 1;
  }
  split = geometry && !geometry->boxes && bvh->ref_count != valid;
  if (bvh->node_count) result = trb_check_tree(&c, split);
  for (i = 0; geometry && i < bvh->prim_count && !result; i++) {
    trbvh_node box;
    float v[3][3];
    if (trb_prim_box(&c.geometry, i, &box, v, &vertex) != 1) continue;
    if (!trb_mark(c.prim_seen, i)) result = trb_damage(&c, "primitive %u is in no leaf", i, 0);
    for (k = 0; k < 3 && split && !result; k++)
      if (!trb_mark(c.corner_seen, (size_t)i * 3 + k))
        result = trb_damage(&c, "corner %u of triangle %u is in none of its leaves", k, i);
  }
  TRBVH_FREE(bits);
  return result;
}

#endif /* !TRBVH_OPENCL_C */

// >>end ---- the user's own code keeps its own floating-point rules and names ----------------------------------------
#if defined(__clang__) && !defined(TRBVH_OPENCL_C)
  #pragma STDC FP_CONTRACT DEFAULT
#elif defined(__GNUC__) && !defined(TRBVH_OPENCL_C)
  #pragma GCC pop_options
#endif
#endif /* TRBVH_IMPLEMENTATION */

/*
trbvh is available under either of two licences: choose whichever you prefer.

------------------------------------------------------------------------------
ALTERNATIVE A - MIT License
Copyright (c) 2026 The trbvh authors

Permission is hereby granted, free of charge, to any person obtaining a copy of
this software and associated documentation files (the "Software"), to deal in
the Software without restriction, including without limitation the rights to
use, copy, modify, merge, publish, distribute, sublicense, and/or sell copies
of the Software, and to permit persons to whom the Software is furnished to do
so, subject to the following conditions:

The above copyright notice and this permission notice shall be included in all
copies or substantial portions of the Software.

THE SOFTWARE IS PROVIDED "AS IS", WITHOUT WARRANTY OF ANY KIND, EXPRESS OR
IMPLIED, INCLUDING BUT NOT LIMITED TO THE WARRANTIES OF MERCHANTABILITY,
FITNESS FOR A PARTICULAR PURPOSE AND NONINFRINGEMENT. IN NO EVENT SHALL THE
AUTHORS OR COPYRIGHT HOLDERS BE LIABLE FOR ANY CLAIM, DAMAGES OR OTHER
LIABILITY, WHETHER IN AN ACTION OF CONTRACT, TORT OR OTHERWISE, ARISING FROM,
OUT OF OR IN CONNECTION WITH THE SOFTWARE OR THE USE OR OTHER DEALINGS IN THE
SOFTWARE.

------------------------------------------------------------------------------
ALTERNATIVE B - Public Domain (www.unlicense.org)
This is free and unencumbered software released into the public domain.

Anyone is free to copy, modify, publish, use, compile, sell, or distribute this
software, either in source code form or as a compiled binary, for any purpose,
commercial or non-commercial, and by any means.

In jurisdictions that recognize copyright laws, the author or authors of this
software dedicate any and all copyright interest in the software to the public
domain. We make this dedication for the benefit of the public at large and to
the detriment of our heirs and successors. We intend this dedication to be an
overt act of relinquishment in perpetuity of all present and future rights to
this software under copyright law.

THE SOFTWARE IS PROVIDED "AS IS", WITHOUT WARRANTY OF ANY KIND, EXPRESS OR
IMPLIED, INCLUDING BUT NOT LIMITED TO THE WARRANTIES OF MERCHANTABILITY,
FITNESS FOR A PARTICULAR PURPOSE AND NONINFRINGEMENT. IN NO EVENT SHALL THE
AUTHORS BE LIABLE FOR ANY CLAIM, DAMAGES OR OTHER LIABILITY, WHETHER IN AN
ACTION OF CONTRACT, TORT OR OTHERWISE, ARISING FROM, OUT OF OR IN CONNECTION
WITH THE SOFTWARE OR THE USE OR OTHER DEALINGS IN THE SOFTWARE.
*/
