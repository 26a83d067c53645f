/* Many rays. A launch takes those from number `begin` on; empty: the tree has no nodes, and every ray misses. */
#include "shape.cl"
#include "query.cl"

#ifdef TRB_CPU
  #define TRB_RAYS TRB_CPU_RAYS                      /* a work-item's, in a row */
#else
  #define TRB_RAYS 1u
#endif
#define TRB_FOR_RAYS(i, begin, end) \
  for (i = (begin) + (ulong)get_global_id(0) * TRB_RAYS, end = min((ulong)(end), i + TRB_RAYS); i < end; i++)

TRB_KERNEL trb_k_intersect(const __global trbvh_node *nodes, const __global trbvh_triangle *triangles,
                           const __global trbvh_ray *rays, __global trbvh_hit *hits, uint empty, ulong begin, ulong end) {
  ulong i;
  TRB_FOR_RAYS(i, begin, end) {
    const trbvh_ray ray = rays[i];
    trbvh_hit hit;
    if (empty) {
      const __global trbvh_ray *scene = &rays[i];    /* anything: the ray is only made ready to miss */
      trb_ray r;
      trb_prepare_ray(&r, &ray, (const __global float *)scene);
      trb_miss(&r, &hit);
    } else {
      trbvh_intersect(nodes, triangles, ray, &hit);
    }
    hits[i] = hit;
  }
}

TRB_KERNEL trb_k_occluded(const __global trbvh_node *nodes, const __global trbvh_triangle *triangles,
                          const __global trbvh_ray *rays, __global uchar *occluded, uint empty, ulong begin, ulong end) {
  ulong i;
  TRB_FOR_RAYS(i, begin, end) occluded[i] = empty ? 0 : (uchar)trbvh_occluded(nodes, triangles, rays[i]);
}
