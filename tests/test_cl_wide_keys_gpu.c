#define TRB_PACKED_REFS 1000u                      /* sort keys without room for an index, at sizes a test can afford */
#define TRB_CL_SHAPE 2
#include "test_cl.c"
