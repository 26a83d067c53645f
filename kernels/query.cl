/* For kernels of your own: put what trbvh_cl_source() returns before them, and trace rays as the C functions of the same
 * names do. nodes and triangles are those of a trbvh_cl_tree that is not empty; triangles are tested in float. */
#include "trbvh.h"

/* The closest hit; 1 = hit. On a miss hit->prim is TRBVH_NONE and hit->t the ray's limit. */
static inline __attribute__((unused)) int trbvh_intersect(const __global trbvh_node *nodes,
                                                          const __global trbvh_triangle *triangles, trbvh_ray ray,
                                                          trbvh_hit *hit) {
  trb_ray r;
  if (trb_prepare_ray(&r, &ray, (const __global float *)nodes)) return trb_trace(nodes, triangles, &r, 0, hit);
  trb_miss(&r, hit);
  return 0;
}

/* Any hit; 1 = occluded. */
static inline __attribute__((unused)) int trbvh_occluded(const __global trbvh_node *nodes,
                                                         const __global trbvh_triangle *triangles, trbvh_ray ray) {
  trb_ray r;
  trbvh_hit hit;
  return trb_prepare_ray(&r, &ray, (const __global float *)nodes) && trb_trace(nodes, triangles, &r, 1, &hit);
}
