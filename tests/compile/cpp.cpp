// The implementation as C++11 and later.
#define TRBVH_IMPLEMENTATION
#include "../../trbvh.h"

int main() {
  static const float positions[9] = {-1, -1, 0, 1, -1, 0, 0, 1, 0};
  trbvh_geometry mesh = {};
  mesh.positions = positions;
  mesh.count = 1;
#ifdef __GNUC__
  #pragma GCC diagnostic ignored "-Wmissing-field-initializers"
#endif
  trbvh_options options = {0};   // the C way of zeroing must compile, too
  options.quality = TRBVH_QUALITY_HIGH;

  trbvh bvh = {};
  if (trbvh_build(&bvh, &mesh, &options) != TRBVH_OK) return 1;
  const trbvh_ray ray = {{0, 0, 5}, 0, {0, 0, -1}, 0};
  trbvh_hit hit;
  const bool ok = trbvh_intersect(&bvh, &ray, &hit) && hit.prim == 0 && trbvh_version() == TRBVH_VERSION;
  trbvh_free(&bvh);
  return ok ? 0 : 1;
}
