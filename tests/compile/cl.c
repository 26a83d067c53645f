/* trbvh_cl.h as C and as C++, with OpenCL's own headers before it (CL_BEFORE), after it (CL_AFTER) or not at all. */
#ifdef CL_BEFORE
  #define CL_TARGET_OPENCL_VERSION 120
  #include <CL/cl.h>
#endif
#define TRBVH_IMPLEMENTATION
#include "../../trbvh_cl.h"
#include "../../trbvh_cl.h"   /* a second include changes nothing */
#ifdef CL_AFTER
  #define CL_TARGET_OPENCL_VERSION 120
  #include <CL/cl.h>
#endif

int main(void) {
  static const float positions[9] = {-1, -1, 0, 1, -1, 0, 0, 1, 0};
  trbvh_geometry mesh;
  trbvh_options options;
  trbvh_stats stats;
  trbvh bvh;
  trbvh_cl_tree tree;
  uint32_t lines = 0;
  int ok;
  memset(&mesh, 0, sizeof mesh);
  memset(&options, 0, sizeof options);
  memset(&bvh, 0, sizeof bvh);
  memset(&tree, 0, sizeof tree);
#if defined(CL_BEFORE) || defined(CL_AFTER)
  { cl_mem nodes = tree.nodes; tree.nodes = nodes; }         /* the same type */
#endif
  mesh.positions = positions;
  mesh.count = 1;
  options.device = trbvh_cl_open(NULL, &stats);              /* with or without one, the tree is made */
  options.stats = &stats;
  ok = (options.device || stats.message[0]) && trbvh_build(&bvh, &mesh, &options) == TRBVH_OK && bvh.prims[0] == 0 &&
       !stats.on_device && trbvh_cl_source(&lines) && lines > 100;
#ifdef TRBVH_NO_OPENCL
  ok = ok && !options.device && trbvh_cl_devices(NULL, 0) == 0;
#endif
  trbvh_cl_free(options.device, &tree);
  trbvh_cl_close(options.device);
  trbvh_free(&bvh);
  return ok ? 0 : 1;
}
