/* The macros a program may define: its own allocator, assertion and linkage. */
#include <stdio.h>
#include <stdlib.h>

static int allocated, freed;
static void *own_malloc(size_t size) { allocated++; return malloc(size); }
static void own_free(void *pointer) { if (pointer) freed++; free(pointer); }
static void own_assert(int ok) {
  if (ok) return;
  fputs("an assertion failed\n", stderr);
  exit(1);
}

#define TRBVH_MALLOC(size) own_malloc(size)
#define TRBVH_FREE(pointer) own_free(pointer)
#define TRBVH_ASSERT(x) own_assert(!!(x))
#if defined(__GNUC__) || defined(__clang__)
  #define TRBVH_API extern __attribute__((visibility("hidden")))
#else
  #define TRBVH_API extern
#endif
#define TRBVH_IMPLEMENTATION
#include "../../trbvh.h"
#include "one_triangle.h"

int main(void) { return one_triangle() && allocated > 0 && allocated == freed ? 0 : 1; }
