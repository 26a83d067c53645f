/* The usual two files: the implementation in this one, the header alone in two_b.c; a tree made here is used there. */
#define TRBVH_IMPLEMENTATION
#include "../../trbvh.h"
#include "../../trbvh.h"   /* a second include changes nothing */

int shoot(const trbvh *bvh);

int main(void) {
  static const float positions[9] = {-1, -1, 0, 1, -1, 0, 0, 1, 0};
  trbvh_geometry mesh = {0};
  trbvh bvh = {0};
  int ok;
  mesh.positions = positions;
  mesh.count = 1;
  if (trbvh_build(&bvh, &mesh, NULL) != TRBVH_OK) return 1;
  ok = shoot(&bvh);
  trbvh_free(&bvh);
  return ok ? 0 : 1;
}
