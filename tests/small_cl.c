/* Small meshes on an OpenCL device: trees, refitting and rays, for a device that takes its time. See oclgrind.sh.
 * Not one of the usual test programs: test_cl.c tests the same, and more. */
#include "test.h"
#define TRBVH_IMPLEMENTATION
#include "../trbvh_cl.h"
#include "scenes.h"

#define RAYS 64u

static trbvh_device *device;

static void trace(const trbvh *bvh) {
  static trbvh_ray rays[RAYS];
  static trbvh_hit in_c[RAYS], on_device[RAYS];
  trbvh_options options;
  rng r = {3};
  uint32_t i, k, other = 0;
  for (i = 0; i < RAYS; i++) {
    rays[i].tmin = rays[i].tmax = 0;
    for (k = 0; k < 3; k++) {
      rays[i].origin[k] = rng_range(&r, -2, 2);
      rays[i].dir[k] = rng_range(&r, -0.5f, 0.5f);
      rays[i].dir[k] -= rays[i].origin[k];
    }
  }
  memset(&options, 0, sizeof options);
  CHECK(trbvh_intersect_n(bvh, rays, in_c, RAYS, &options) == TRBVH_OK);
  options.device = device;
  options.flags = TRBVH_NO_FALLBACK;
  CHECK(trbvh_intersect_n(bvh, rays, on_device, RAYS, &options) == TRBVH_OK);
  for (i = 0; i < RAYS; i++) other += in_c[i].prim != on_device[i].prim;
  CHECK_MSG(other <= 1, "%u rays hit another triangle", other);
}

static void refit(const trbvh *bvh, const trbvh_geometry *geometry) {
  trb_cl *cl = (trb_cl *)device;
  trbvh_cl_tree tree;
  trbvh_cl_geometry mesh;
  trbvh back;
  memset(&tree, 0, sizeof tree);
  memset(&mesh, 0, sizeof mesh);
  memset(&back, 0, sizeof back);
  trb_cl_begin(cl);
  mesh.positions = trb_cl_input(cl, geometry->positions, (size_t)geometry->position_count * 12);
  if (geometry->indices) mesh.indices = trb_cl_input(cl, geometry->indices, (size_t)geometry->count * 12);
  mesh.position_count = geometry->position_count;
  mesh.count = geometry->count;
  CHECK(trbvh_cl_upload(device, &tree, bvh) == TRBVH_OK);
  CHECK(trbvh_cl_refit(device, &tree, &mesh, NULL) == TRBVH_OK);
  CHECK(trbvh_cl_download(device, &tree, &back, NULL) == TRBVH_OK && same_tree(bvh, &back));
  trbvh_free(&back);
  trbvh_cl_free(device, &tree);
  trb_cl_release(cl, &mesh.positions);
  trb_cl_release(cl, &mesh.indices);
}

static void optimize(trbvh *bvh) {
  trbvh_cl_tree tree;
  trbvh back;
  memset(&tree, 0, sizeof tree);
  memset(&back, 0, sizeof back);
  CHECK(trbvh_cl_upload(device, &tree, bvh) == TRBVH_OK);
  CHECK(trbvh_cl_optimize(device, &tree, NULL, NULL) == TRBVH_OK && trbvh_optimize(bvh, NULL) == TRBVH_OK);
  CHECK(trbvh_cl_download(device, &tree, &back, NULL) == TRBVH_OK && same_tree(bvh, &back));
  trbvh_free(&back);
  trbvh_cl_free(device, &tree);
}

static void build(void (*make)(scene *, uint32_t), uint32_t count, trbvh_quality quality) {
  scene s;
  trbvh_geometry geometry;
  trbvh_options options;
  trbvh_stats stats;
  trbvh in_c, on_device;
  trbvh_result result;
  memset(&s, 0, sizeof s);
  memset(&options, 0, sizeof options);
  memset(&in_c, 0, sizeof in_c);
  memset(&on_device, 0, sizeof on_device);
  make(&s, count);
  CONTEXT("%u triangles, preset %d", s.count, (int)quality);
  geometry = scene_geometry(&s);
  options.quality = quality;
  options.stats = &stats;
  CHECK(trbvh_build(&in_c, &geometry, &options) == TRBVH_OK);
  options.device = device;
  options.flags = TRBVH_NO_FALLBACK;
  result = trbvh_build(&on_device, &geometry, &options);
  CHECK_MSG(result == TRBVH_OK, "%s", stats.message);
  if (!result) {
    CHECK(stats.on_device && same_tree(&in_c, &on_device));
    if (quality == TRBVH_QUALITY_FAST) refit(&in_c, &geometry);
    trace(&in_c);
    if (quality == TRBVH_QUALITY_HIGH) optimize(&in_c);
  }
  trbvh_free(&in_c);
  trbvh_free(&on_device);
  scene_free(&s);
}

static void test_fast(void) {
  build(make_random, 1, TRBVH_QUALITY_FAST);
  build(make_random, 2, TRBVH_QUALITY_FAST);
  build(make_sphere, 2500, TRBVH_QUALITY_FAST);      /* more than two chunks of a GPU */
  build(make_identical, 1100, TRBVH_QUALITY_FAST);
}
static void test_medium(void) {
  build(make_random, 520, TRBVH_QUALITY_MEDIUM);     /* more than one work-group of a GPU lists by itself */
  build(make_nested, 240, TRBVH_QUALITY_MEDIUM);     /* the deep one */
}
static void test_high(void) {
  build(make_slivers, 200, TRBVH_QUALITY_HIGH);
}

int main(int argc, char **argv) {
  trbvh_stats stats;
  test_start(argc, argv);
  device = trbvh_cl_open(NULL, &stats);
  if (!device) { printf("%s\n0 passed, 1 failed\n", stats.message); return 1; }
  RUN(test_fast);
  RUN(test_medium);
  RUN(test_high);
  trbvh_cl_close(device);
  return test_finish();
}
