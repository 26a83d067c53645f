/* cc examples/01_hello.c -o hello && ./hello
 * Introduces: geometry, build, one ray, its hit. Also compiles as C++. */
#define TRBVH_IMPLEMENTATION
#include "../trbvh.h"
#include <stdio.h>

static const float octahedron[] = {1,0,0, -1,0,0, 0,1,0, 0,-1,0, 0,0,1, 0,0,-1};
static const uint32_t faces[] = {0,2,4, 2,1,4, 1,3,4, 3,0,4, 2,0,5, 1,2,5, 3,1,5, 0,3,5};

int main(void)
{
  trbvh_geometry mesh = {0};
  mesh.positions = octahedron;
  mesh.position_count = 6;
  mesh.indices = faces;
  mesh.count = 8;

  trbvh bvh = {0};
  trbvh_result result = trbvh_build(&bvh, &mesh, NULL);
  if (result) printf("build: %s\n", trbvh_result_text(result));

  trbvh_ray ray = {{0.2f, 0.3f, 5}, 0, {0, 0, -1}, 0};   /* origin, tmin, direction, tmax (0 = no limit) */
  trbvh_hit hit;
  if (!trbvh_intersect(&bvh, &ray, &hit)) printf("nothing hit\n");
  else printf("triangle %u at t = %g, u = %g, v = %g\n", hit.prim, hit.t, hit.u, hit.v);
  trbvh_free(&bvh);
  return result != TRBVH_OK;
}
