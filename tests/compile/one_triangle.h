/* Builds one triangle and shoots one ray at it, for every program in this folder: 1 = hit as expected.
 * Include it after trbvh.h. */
static int one_triangle(void) {
  static const float positions[9] = {-1, -1, 0, 1, -1, 0, 0, 1, 0};
  trbvh_ray ray = {{0, 0, 5}, 0, {0, 0, -1}, 0};
  trbvh_geometry mesh = {0};
  trbvh bvh = {0};
  trbvh_hit hit;
  int ok;
  mesh.positions = positions;
  mesh.count = 1;
  if (trbvh_build(&bvh, &mesh, NULL) != TRBVH_OK) return 0;
  ok = trbvh_intersect(&bvh, &ray, &hit) && hit.prim == 0 && hit.t > 4.999f && hit.t < 5.001f;
  trbvh_free(&bvh);
  return ok;
}
