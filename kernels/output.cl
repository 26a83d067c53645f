/* Triangles in leaf order (trbvh.h, >>finish). */
#include "shape.cl"

TRB_KERNEL trb_k_triangles(const __global trb_plan *plan, const __global char *positions, const __global char *indices,
                           const __global uint *prims, __global trbvh_triangle *triangles, uint count) {
  const trb_mesh mesh = trb_plan_mesh(plan, positions, indices);
#ifdef TRB_CPU
  const uint first = TRB_GROUP_ID * TRB_BLOCK;
  trb_make_triangles(&mesh, prims, first, min(count, first + TRB_BLOCK), triangles);
#else
  uint i;
  TRB_FOR(i, count) trb_make_triangle(&mesh, trb_mesh_form(&mesh), prims[i], &triangles[i]);
#endif
}
