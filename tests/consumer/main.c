/* What a user's first program does, for the projects in this folder. Prints the version; exits non-zero when the one
 * ray does not hit the one triangle. */
#define TRBVH_IMPLEMENTATION
#ifdef WITH_CL
  #include <trbvh_cl.h>
#else
  #include <trbvh.h>
#endif
#include <stdio.h>

int main(void) {
  const float positions[] = {-1, -1, 0, 1, -1, 0, 0, 1, 0};
  trbvh_ray ray = {{0, 0, 5}, 0, {0, 0, -1}, 0};
  trbvh_geometry mesh = {0};
  trbvh_options options = {0};
  trbvh bvh = {0};
  trbvh_hit hit;
  int ok;
  mesh.positions = positions;
  mesh.count = 1;
#ifdef WITH_CL
  options.device = trbvh_cl_open(NULL, NULL);
#endif
  ok = trbvh_build(&bvh, &mesh, &options) == TRBVH_OK && trbvh_intersect(&bvh, &ray, &hit) && hit.prim == 0;
  trbvh_free(&bvh);
#ifdef WITH_CL
  trbvh_cl_close(options.device);
#endif
  printf("%u.%u.%u\n", trbvh_version() / 10000, trbvh_version() / 100 % 100, trbvh_version() % 100);
  return ok ? 0 : 1;
}
