/* The builders of examples/paper: valid trees of every scene, the same again, as good as theirs must be, and what each is
 * known by; and what the tables judge trees by. */
#define TRB_PACKED_REFS 5000u          /* both kinds of sort keys, at sizes that a test can afford */
#define TRBVH_IMPLEMENTATION
#include "../trbvh.h"
#include "test.h"
#include "paper.h"
#include "paper_curve.h"
#include "paper_moves.h"
#include "paper_split.h"

// >>what builders share ---------------------------------------------------------------------------------------------
static void test_sort(void)            /* by the highest bits; equal ones stay as they are */
{
  rng r = {1};
  enum { COUNT = 5000 };
  static uint64_t keys[COUNT];
  for (uint32_t bits = 1; bits <= 64; bits += 7) {
    for (int i = 0; i < COUNT; ++i) keys[i] = (uint64_t)(rng_u32(&r) & (i % 3 ? ~0u : 0xFFu)) << 32 | rng_u32(&r);
    for (uint32_t i = 0; i < COUNT && bits <= 32; ++i) keys[i] = (keys[i] & ~(uint64_t)0xFFFFFFFF) | i;
    paper_sort(keys, COUNT, bits);
    for (int i = 1; i < COUNT; ++i) {
      uint64_t a = keys[i - 1] >> (64 - bits), b = keys[i] >> (64 - bits);
      CHECK_MSG(a <= b && (bits > 32 || a < b || (uint32_t)keys[i - 1] < (uint32_t)keys[i]), "%u bits, key %d", bits, i);
    }
  }
  float x[] = {-FLT_MAX, -1, -FLT_MIN, -0.0f, 0.0f, FLT_MIN, 1, FLT_MAX};
  for (size_t i = 1; i < sizeof x / sizeof *x; ++i) CHECK(paper_sortable(x[i - 1]) < paper_sortable(x[i]));
}
static void sort_and_look(paper_build *p)
{
  uint64_t *codes = paper_sort_refs(p);
  uint32_t bits = paper_code_bits(p);
  for (uint32_t i = 0; i < p->ref_count; ++i) {
    CHECK_MSG(codes[i] == trb_box_code(p->refs[i], p->lib.grid) >> (63 - bits), "%u has the code of another one", i);
    if (i) CHECK_MSG(codes[i - 1] < codes[i] || (codes[i - 1] == codes[i] && p->refs[i - 1].first < p->refs[i].first), "%u", i);
  }
  free(codes);
  paper_lbvh(p);
}
static void test_sort_refs(void)       /* with codes and numbers that fit into one key, and that do not */
{
  for (size_t i = 0; i < SCENE_COUNT; ++i) {
    scene s;
    if (scene_defs[i].flags & SCENE_BIG) continue;
    scene_make(&s, &scene_defs[i]);
    CONTEXT("scene %s", s.name);
    trbvh_geometry g = scene_geometry(&s);
    paper_tree t = paper_test_make(&g, sort_and_look, NULL, 0, 0);
    paper_test_tree(&t, &g, 0);
    trbvh_free(&t.bvh);
    scene_free(&s);
  }
}

// >>sweep -----------------------------------------------------------------------------------------------------------
static void sweep_and_look(paper_build *p)
{
  double best = best_by_centers(p->refs, p->ref_count);
  paper_sweep(p);
  uint32_t first = p->nodes[0].first;
  double cost = 0;
  for (uint32_t i = first; i < first + 2; ++i) cost += half_area(&p->nodes[i]) * trb_count(p->nodes[i].count);
  CHECK_MSG(cost <= best * (1 + 1e-6), "%g, but %g is possible", cost, best);   /* the sweep's areas are floats */
}
static void test_sweep_root(void) { look_at_all(SCENE_ORDINARY, 500, sweep_and_look, NULL); }   /* the best there is */
static void test_sweep_scenes(void) { paper_test_scenes(paper_sweep, NULL, 0, 0, 20000); }
static void test_lbvh_scenes(void) { paper_test_scenes(paper_lbvh, NULL, 0, 0, 20000); }
static void test_lbvh_is_the_library_s(void)
{
  scene s;
  scene_make(&s, &scene_defs[0]);
  trbvh_geometry g = scene_geometry(&s);
  paper_tree t = paper_test_make(&g, paper_lbvh, NULL, 0, 0), r = paper_test_make(&g, paper_lbvh, NULL, 0, 3);
  trbvh_options o;
  memset(&o, 0, sizeof o);
  o.reinsert_share = -1;
  for (int quality = TRBVH_QUALITY_FAST; quality <= TRBVH_QUALITY_MEDIUM; ++quality) {
    trbvh want = {0};
    o.quality = (trbvh_quality)quality;
    CHECK(trbvh_build(&want, &g, &o) == TRBVH_OK);
    CHECK(same_tree(&want, quality == TRBVH_QUALITY_FAST ? &t.bvh : &r.bvh));
    trbvh_free(&want);
  }
  trbvh_free(&t.bvh);
  trbvh_free(&r.bvh);
  scene_free(&s);
}

// >>judge -----------------------------------------------------------------------------------------------------------
/* The area of the part of triangle v that lies in n's box: cut, plane after plane, in double. */
static double area_inside(const float *v, const trbvh_node *n)
{
  double p[16][3], q[16][3], area = 0;
  int count = 3;
  for (int i = 0; i < 9; ++i) p[i / 3][i % 3] = v[i];
  for (int plane = 0; plane < 6; ++plane) {
    int k = plane % 3, kept = 0;
    double sign = plane < 3 ? 1 : -1, at = plane < 3 ? n->min[k] : n->max[k];
    for (int i = 0; i < count; ++i) {
      const double *a = p[i], *b = p[(i + 1) % count];
      double da = sign * (a[k] - at), db = sign * (b[k] - at);
      if (da >= 0) memcpy(q[kept++], a, sizeof q[0]);
      if ((da > 0 && db < 0) || (da < 0 && db > 0)) {
        for (int e = 0; e < 3; ++e) q[kept][e] = a[e] + (b[e] - a[e]) * (da / (da - db));
        q[kept++][k] = at;
      }
    }
    memcpy(p, q, sizeof p);
    count = kept;
  }
  for (int i = 1; i + 1 < count; ++i) {
    double a[3], b[3];
    for (int e = 0; e < 3; ++e) { a[e] = p[i][e] - p[0][e]; b[e] = p[i + 1][e] - p[0][e]; }
    double x = a[1] * b[2] - a[2] * b[1], y = a[2] * b[0] - a[0] * b[2], z = a[0] * b[1] - a[1] * b[0];
    area += 0.5 * sqrt(x * x + y * y + z * z);
  }
  return area;
}
/* Is the primitive in a leaf below this node? */
static int below(const trbvh *bvh, uint32_t node, uint32_t prim)
{
  const trbvh_node *n = &bvh->nodes[node];
  if (!n->count) return below(bvh, n->first, prim) || below(bvh, n->first + 1, prim);
  for (uint32_t i = n->first; i < n->first + n->count; ++i) if (bvh->prims[i] == prim) return 1;
  return 0;
}
static double exact_epo(const trbvh *bvh, const trbvh_geometry *g)
{
  double sum = 0, all = 0;
  for (uint32_t i = 0; i < g->count; ++i) {
    float v[9];
    geometry_triangle(g, i, v);
    all += area_inside(v, &bvh->nodes[0]);
    for (uint32_t n = 0; n < bvh->node_count; ++n) {
      double inside = n == 1 ? 0 : area_inside(v, &bvh->nodes[n]);
      if (inside > 0 && !below(bvh, n, i)) sum += inside * (bvh->nodes[n].count ? bvh->nodes[n].count : 1.2);
    }
  }
  return sum / all;
}
static ex_mesh mesh_of(const scene *s)  /* with the scene's own arrays, but for the indices */
{
  ex_mesh mesh;
  memset(&mesh, 0, sizeof mesh);
  mesh.positions = s->positions;
  mesh.position_count = s->vertex_count;
  mesh.triangle_count = s->count;
  mesh.indices = (uint32_t *)xmalloc(3 * sizeof(uint32_t) * s->count);
  for (uint32_t i = 0; i < 3 * s->count; ++i) mesh.indices[i] = s->indices ? s->indices[i] : i;
  return mesh;
}
/* The estimates of EPO against clipping all triangles at all boxes, without splits and with them; and counted visits
 * against looking at every node. */
static void test_metrics(void)
{
  static const char *const names[] = {"random", "room", "city", "slivers"};
  for (size_t k = 0; k < 8; ++k) {
    scene s;
    scene_def def = scene_defs[0];
    for (size_t i = 0; i < SCENE_COUNT; ++i) if (!strcmp(scene_defs[i].name, names[k / 2])) def = scene_defs[i];
    def.full = def.quick = 600;
    scene_make(&s, &def);
    CONTEXT("scene %s, %s", s.name, k % 2 ? "splits" : "no splits");
    trbvh_geometry g = scene_geometry(&s);
    trbvh bvh = {0};
    trbvh_options o;
    memset(&o, 0, sizeof o);
    o.quality = k % 2 ? TRBVH_QUALITY_HIGH : TRBVH_QUALITY_FAST;
    CHECK(trbvh_build(&bvh, &g, &o) == TRBVH_OK);
    ex_mesh mesh = mesh_of(&s);
    paper_points points = paper_make_points(&mesh, 300000);
    CHECK(points.count == 300000);
    double exact = exact_epo(&bvh, &g), estimate = paper_epo(&bvh, &points);
    CHECK_MSG(fabs(estimate - exact) <= 0.03 * exact + 0.01, "EPO %g, estimated %g", exact, estimate);
    free(points.at);

    ex_scene view;
    ex_ray_set sets[EX_KINDS];
    CHECK(ex_scene_of(&view, mesh, 1));
    paper_make_rays(&view, &bvh, 8, 6, 2, sets);
    size_t count = sets[EX_PRIMARY].count;
    trbvh_hit *hits = (trbvh_hit *)xmalloc(count * sizeof *hits);
    CHECK(trbvh_intersect_n(&bvh, sets[EX_PRIMARY].rays, hits, count, NULL) == TRBVH_OK);
    paper_visits v = paper_count_visits(&bvh, sets[EX_PRIMARY].rays, hits, count, 1);
    double met = 0, triangles = 0, leaves = 0, squares = 0;
    for (size_t i = 0; i < count; ++i) {
      trb_ray ray;
      uint32_t found = 0;
      CHECK(trb_prepare_ray(&ray, &sets[EX_PRIMARY].rays[i], (const float *)bvh.nodes));
      for (uint32_t n = 0; n < bvh.node_count; ++n) {
        if (n == 1 || trb_hit_box((const float *)&bvh.nodes[n], &ray, hits[i].t) < 0) continue;
        ++met;
        found += bvh.nodes[n].count > 0;
        triangles += bvh.nodes[n].count;
      }
      leaves += found;
      squares += (double)found * found;
    }
    double n = (double)count, variance = squares / n - leaves / n * leaves / n;
    CHECK_MSG(fabs(v.nodes - met / n) < 1e-9 * v.nodes, "%g nodes a ray, %g", v.nodes, met / n);
    CHECK_MSG(fabs(v.triangles - triangles / n) < 1e-9 * v.triangles, "%g triangles a ray, %g", v.triangles, triangles / n);
    CHECK_MSG(fabs(v.lcv * v.lcv - variance) < 1e-6 * (1 + variance), "LCV %g, %g", v.lcv, sqrt(variance));
    paper_thin_rays(&sets[EX_PRIMARY], &bvh, (v.nodes + v.triangles) * 50);
    CHECK_MSG(sets[EX_PRIMARY].count >= 40 && sets[EX_PRIMARY].count <= 60, "%u rays", (unsigned)sets[EX_PRIMARY].count);
    free(hits);
    for (int kind = 0; kind < EX_KINDS; ++kind) free(sets[kind].rays);
    free(mesh.indices);
    trbvh_free(&bvh);
    scene_free(&s);
  }
}
/* Whatever tree they are made with: the same ones; from all hits; unit directions away from the surface. */
static void test_rays(void)
{
  scene s;
  scene_make(&s, &scene_defs[3]);
  trbvh_geometry g = scene_geometry(&s);
  ex_mesh mesh = mesh_of(&s);
  ex_scene view;
  CHECK(ex_scene_of(&view, mesh, 1));
  ex_ray_set sets[2][EX_KINDS];
  trbvh_options o;
  memset(&o, 0, sizeof o);
  size_t hits = 0;
  for (int tree = 0; tree < 2; ++tree) {
    trbvh bvh = {0};
    o.quality = tree ? TRBVH_QUALITY_HIGH : TRBVH_QUALITY_FAST;
    CHECK(trbvh_build(&bvh, &g, &o) == TRBVH_OK);
    paper_make_rays(&view, &bvh, 20, 15, 3, sets[tree]);
    for (size_t i = 0; i < sets[0][EX_PRIMARY].count && !tree; ++i) {
      trbvh_hit hit;
      hits += (size_t)trbvh_intersect(&bvh, &sets[0][EX_PRIMARY].rays[i], &hit);
    }
    trbvh_free(&bvh);
  }
  CHECK(sets[0][EX_PRIMARY].count == 20 * 15 * PAPER_CAMERAS && hits > sets[0][EX_PRIMARY].count / 4);
  for (int kind = 0; kind < EX_KINDS; ++kind) {
    size_t count = sets[0][kind].count;
    if (kind != EX_PRIMARY) CHECK_MSG(count == 3 * hits, "%u rays from %u hits", (unsigned)count, (unsigned)hits);
    CHECK(count == sets[1][kind].count && !memcmp(sets[0][kind].rays, sets[1][kind].rays, count * sizeof(trbvh_ray)));
    for (size_t i = 0; i < count; ++i) {
      const trbvh_ray *ray = &sets[0][kind].rays[i];
      CHECK(fabsf(ex_length(ex_load(ray->dir)) - 1) < 1e-5f);
      CHECK(kind == EX_AMBIENT ? fabsf(ray->tmax - 0.1f * view.diagonal) < 1e-3f * ray->tmax : ray->tmax <= 0);
    }
    for (int tree = 0; tree < 2; ++tree) free(sets[tree][kind].rays);
  }
  free(mesh.indices);
  scene_free(&s);
  CHECK(fabsf(paper_halton(5, 2) - 0.625f) < 1e-6f && fabsf(paper_halton(5, 3) - 7 / 9.0f) < 1e-6f);
}

int main(int argc, char **argv)
{
  test_start(argc, argv);
  RUN(test_sort);
  RUN(test_sort_refs);
  RUN(test_sweep_root);
  RUN(test_sweep_scenes);
  RUN(test_lbvh_scenes);
  RUN(test_lbvh_is_the_library_s);
  run_curve_tests();
  run_moves_tests();
  run_split_tests();
  RUN(test_metrics);
  RUN(test_rays);
  return test_finish();
}
