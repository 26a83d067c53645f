#define TRB_CL_SHAPE 2                             /* the kernels for GPUs, on whatever device there is */
#include "test_cl.c"
