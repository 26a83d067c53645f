/* What a user's first program does, for the projects in this folder. Prints the version; exits non-zero when the one
 * ray does not hit the one triangle. */
#define TRBVH_IMPLEMENTATION
#include <trbvh.h>
#include <stdio.h>

int main(void) {
  const float positions[] = {-1, -1, 0, 1, -1, 0, 0, 1, 0};
  trbvh_ray ray = {{0, 0, 5}, 0, {0, 0, -1}, 0};
  trbvh_geometry mesh = {0};
  trbvh bvh = {0};
  trbvh_hit hit;
  int ok;
  mesh.positions = positions;
  mesh.count = 1;
  ok = trbvh_build(&bvh, &mesh, NULL) == TRBVH_OK && trbvh_intersect(&bvh, &ray, &hit) && hit.prim == 0;
  trbvh_free(&bvh);
  printf("%u.%u.%u\n", trbvh_version() / 10000, trbvh_version() / 100 % 100, trbvh_version() % 100);
  return ok ? 0 : 1;
}
