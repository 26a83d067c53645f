#define TRB_PACKED_REFS 1000u                      /* sort keys without room for an index, at sizes a test can afford */
#include "test_cl.c"
