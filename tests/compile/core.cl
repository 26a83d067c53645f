/* The core of trbvh.h as OpenCL C 1.2: the types that host and device share, and nothing of the host's. */
#include "../../trbvh.h"

#ifndef TRBVH_OPENCL_C
  #error "trbvh.h does not see that this is OpenCL C"
#endif
typedef char node_is_32_bytes[sizeof(trbvh_node) == 32 ? 1 : -1];
typedef char triangle_is_48_bytes[sizeof(trbvh_triangle) == 48 ? 1 : -1];
typedef char ray_is_32_bytes[sizeof(trbvh_ray) == 32 ? 1 : -1];
typedef char hit_is_20_bytes[sizeof(trbvh_hit) == 20 ? 1 : -1];

__kernel void count_leaves(__global const trbvh_node *nodes, trbvh_u32 node_count, __global trbvh_u32 *leaves) {
  const trbvh_u32 i = (trbvh_u32)get_global_id(0);
  if (i < node_count && i != 1u && nodes[i].count > 0u) atomic_inc(leaves);
}
