#define TRBVH_NO_SIMD                              /* the same trees in plain C as with vectors */
#include "test_golden.c"
