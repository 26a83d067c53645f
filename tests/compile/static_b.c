/* See static_a.c. */
#define TRBVH_STATIC
#define TRBVH_IMPLEMENTATION
#include "../../trbvh.h"
#include "one_triangle.h"

int other_file(void);

int other_file(void) { return one_triangle(); }
