/* The header alone: see two_a.c. */
#include "../../trbvh.h"

int shoot(const trbvh *bvh);

int shoot(const trbvh *bvh) {
  trbvh_ray ray = {{0, 0, 5}, 0, {0, 0, -1}, 0};
  trbvh_hit hit;
  return trbvh_version() == TRBVH_VERSION && trbvh_intersect(bvh, &ray, &hit) && hit.prim == 0;
}
