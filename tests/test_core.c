/* The parts that decide a tree, each against its definition: the dynamic program against all topologies, the hierarchy
 * against the radix tree, the rounds against the rule that fixes them, the depth bound, the clipping. Sees the
 * library's inside. */
static unsigned packed_refs = 1u << 24;        /* up to how many references sort keys are packed */
#define TRB_PACKED_REFS packed_refs
#include <assert.h>
#define TRBVH_ASSERT(x) assert(x)
#define TRBVH_IMPLEMENTATION
#include "../trbvh.h"

#include "test.h"
#include "scenes.h"

static trb_costs costs_of(float ratio, uint32_t max_leaf) {
  trb_costs c;
  c.ratio = ratio;
  c.max_leaf = max_leaf;
  return c;
}

static trbvh_node random_box(rng *r, float size) {
  trbvh_node box;
  int k;
  memset(&box, 0, sizeof box);
  for (k = 0; k < 3; k++) {
    float small = size * rng_unit(r);
    box.min[k] = rng_unit(r);
    box.max[k] = box.min[k] + small * rng_unit(r);
  }
  return box;
}

/* Boxes on a coarse grid make equal costs, hence ties. */
static void snap(trbvh_node *box) {
  int k;
  for (k = 0; k < 3; k++) {
    box->min[k] = (float)(int)(box->min[k] * 10) * 0.1f;
    box->max[k] = (float)(int)(box->max[k] * 10) * 0.1f;
  }
}

// >>numbers
static void test_numbers(void) {
  rng r = {1};
  uint32_t i, k;
  for (i = 0; i < 32; i++) {
    CHECK(trb_log2(1u << i) == i);
    CHECK(trb_log2((1u << i) | ((1u << i) - 1)) == i);
  }
  for (i = 0; i < 100000; i++) {
    float x = rng_range(&r, 1, 2) * (float)ldexp(1, (int)rng_below(&r, 180) - 90);
    CHECK_MSG(fabs((double)trb_reciprocal(x) * x - 1) < 3e-7, "1 / %g is %g", x, trb_reciprocal(x));
    CHECK_MSG(fabs(trb_cube_root(x) / cbrt(x) - 1) < 1e-6, "cube root of %g is %g", x, trb_cube_root(x));
  }
  CHECK(trb_cube_root(0) == 0);
  CHECK(trb_finite(FLT_MAX) && trb_finite(0) && trb_finite(-1) && !trb_finite((float)INFINITY) && !trb_finite((float)NAN));
  for (i = 0; i < 1000; i++) {
    uint32_t cell = rng_u32(&r) >> 11;
    trb_u64 spread = 0;
    for (k = 0; k < 21; k++) spread |= (trb_u64)(cell >> k & 1) << (3 * k);
    CHECK(trb_spread(cell) == spread);
  }
}

static void test_node_words(void) {
  const trb_costs costs = costs_of(1 / 1.2f, 8);
  rng r = {2};
  uint32_t i, k;
  for (i = 0; i < 1000; i++) {
    trbvh_node n = trb_reference(random_box(&r, 0.1f), costs);
    double cost = (double)trb_area(n) * costs.ratio;
    for (k = 2; k < 20; k++) {
      trbvh_node other = trb_reference(random_box(&r, 0.1f), costs);
      trbvh_node parent = trb_parent(n, other, 6, costs);
      double area = trb_area(parent), split = area + cost + (double)trb_area(other) * costs.ratio;
      double leaf = area * costs.ratio * k;
      CHECK(trb_count(parent.count) == k && parent.first == 6);
      if (k <= 8) {
        cost = split < leaf ? split : leaf;
        CHECK_MSG(fabs(trb_cost(parent.count) - cost) <= 2e-5 * cost, "%g, not %g", trb_cost(parent.count), cost);
        if (fabs(split - leaf) > 1e-4 * leaf) CHECK(trb_is_leaf(parent.count) == (leaf < split));
      } else {
        CHECK(!trb_is_leaf(parent.count));
      }
      n = parent;
    }
  }
}

// >>the dynamic program against exhaustive search
typedef struct search { const trbvh_node *leaf; trb_costs costs; } search;

static double subset_area(const search *s, uint32_t subset) {
  double low[3] = {1e30, 1e30, 1e30}, high[3] = {-1e30, -1e30, -1e30}, x, y, z;
  int i, k;
  for (i = 0; i < 7; i++)
    for (k = 0; k < 3 && subset >> i & 1; k++) {
      if (s->leaf[i].min[k] < low[k]) low[k] = s->leaf[i].min[k];
      if (s->leaf[i].max[k] > high[k]) high[k] = s->leaf[i].max[k];
    }
  x = high[0] - low[0];
  y = high[1] - low[1];
  z = high[2] - low[2];
  return x * y + y * z + z * x;
}

/* The naive recursion: every ordered partition, every time anew. */
static double cheapest(const search *s, uint32_t subset) {
  uint32_t p, n = 0, i;
  double best = 1e300, leaf, area;
  if ((subset & (subset - 1)) == 0) return trb_cost(s->leaf[trb_log2(subset)].count);
  for (p = (subset - 1) & subset; p; p = (p - 1) & subset) {
    double cost = cheapest(s, p) + cheapest(s, subset ^ p);
    if (cost < best) best = cost;
  }
  area = subset_area(s, subset);
  best += area;
  for (i = 0; i < 7; i++)
    if (subset >> i & 1) n += trb_count(s->leaf[i].count);
  leaf = s->costs.ratio * area * n;
  return n <= s->costs.max_leaf && leaf < best ? leaf : best;
}

static double sum_of_costs(const search *s, uint32_t subset) {
  double sum = 0;
  uint32_t i;
  for (i = 0; i < 7; i++)
    if (subset >> i & 1) sum += trb_cost(s->leaf[i].count);
  return sum;
}

/* Seven leaves: single references, small subtrees, large ones. */
static void random_leaves(rng *r, search *s, trbvh_node leaf[7], uint32_t largest, int snapped) {
  uint32_t i, k;
  for (i = 0; i < 7; i++) {
    trbvh_node box = random_box(r, 0.5f);
    if (snapped) snap(&box);
    leaf[i] = trb_reference(box, s->costs);
    for (k = rng_below(r, largest); k > 0; k--) leaf[i] = trb_parent(leaf[i], trb_reference(box, s->costs), 0, s->costs);
  }
  s->leaf = leaf;
}

static void run_program(const search *s, uint32_t lane, float *values, float *table) {
  uint32_t i, k;
  memset(values, 0, sizeof(float) * 7 * TRB_LEAF_VALUES * TRB_LANES);
  for (i = 0; i < 7; i++) {
    float *v = values + i * TRB_LEAF_VALUES * TRB_LANES + lane;
    for (k = 0; k < 3; k++) {
      v[k * TRB_LANES] = s->leaf[i].min[k];
      v[(3 + k) * TRB_LANES] = s->leaf[i].max[k];
    }
    v[6 * TRB_LANES] = (float)trb_count(s->leaf[i].count);
    v[7 * TRB_LANES] = trb_cost(s->leaf[i].count);
  }
  for (i = 0; i < TRB_LANES; i++) trb_treelet_costs(values + i, table + i, s->costs);
}

static void test_dynamic_program(void) {
  static const uint32_t largest[] = {1, 2, 4, 12, 100};
  float values[7 * TRB_LEAF_VALUES * TRB_LANES], table[TRB_SUBSETS * TRB_LANES];
  rng r = {3};
  uint32_t i, s, lane;
  for (i = 0; i < QUICK_OR(10, 60); i++) {
    trbvh_node leaf[7];
    search exhaustive;
    exhaustive.costs = costs_of(i % 3 ? 1 / 1.2f : 0.2f, i % 2 ? 8 : 16);
    random_leaves(&r, &exhaustive, leaf, largest[i % 5], i % 4 == 3);
    lane = rng_below(&r, TRB_LANES);
    run_program(&exhaustive, lane, values, table);
    for (s = 3; s < TRB_SUBSETS; s++) {
      double want, got = table[s * TRB_LANES + lane] + sum_of_costs(&exhaustive, s);
      if ((s & (s - 1)) == 0 || (s != 127 && rng_below(&r, 8))) continue;
      want = cheapest(&exhaustive, s);
      CHECK_MSG(fabs(got - want) <= 1e-5 * want, "treelet %u, subset %u: %.9g, not %.9g", i, s, got, want);
    }
  }
}

/* The topology that trb_partition reads from the table costs what the table says, and is the first of its equals. */
static double topology_cost(const search *s, const float *table, uint32_t subset) {
  uint32_t p, n = 0, i;
  double area, split, leaf;
  if ((subset & (subset - 1)) == 0) return trb_cost(s->leaf[trb_log2(subset)].count);
  p = trb_partition(table, subset);
  CHECK((p & subset) == p && p != subset && (p & subset & (0 - subset)));
  area = subset_area(s, subset);
  split = area + topology_cost(s, table, p) + topology_cost(s, table, subset ^ p);
  for (i = 0; i < 7; i++)
    if (subset >> i & 1) n += trb_count(s->leaf[i].count);
  leaf = s->costs.ratio * area * n;
  return n <= s->costs.max_leaf && leaf < split ? leaf : split;
}

static void test_partition(void) {
  float values[7 * TRB_LEAF_VALUES * TRB_LANES], table[TRB_SUBSETS * TRB_LANES];
  rng r = {4};
  uint32_t i, q;
  for (i = 0; i < 500; i++) {
    trbvh_node leaf[7];
    search s;
    double cost, want;
    uint32_t part;
    s.costs = costs_of(1 / 1.2f, 8);
    random_leaves(&r, &s, leaf, 6, i % 2);
    run_program(&s, 0, values, table);
    want = table[127 * TRB_LANES] + sum_of_costs(&s, 127);
    cost = topology_cost(&s, table, 127);
    CHECK_MSG(fabs(cost - want) <= 2e-5 * want, "%.9g, the table says %.9g", cost, want);
    part = trb_partition(table, 127);
    for (q = 1; q < 127 - part; q++) {                /* a smaller rest would have come first */
      float sum = (TRB_SINGLE(127 ^ q) ? 0 : table[(127 ^ q) * TRB_LANES]) + (TRB_SINGLE(q) ? 0 : table[q * TRB_LANES]);
      float best = (TRB_SINGLE(part) ? 0 : table[part * TRB_LANES]) + (TRB_SINGLE(127 ^ part) ? 0 : table[(127 ^ part) * TRB_LANES]);
      if (!(q & 1)) CHECK(sum > best);
    }
  }
}

// >>builds, stage by stage
static void begin_build(trb_build *b, const trbvh_geometry *g, const trbvh_options *o) {
  CHECK(trb_resolve(b, g, o) == TRBVH_OK);
  trb_runner_start(&b->runner, &b->options, 0);
  CHECK(trb_allocate_scratch(b) == TRBVH_OK);
}
static void end_build(trb_build *b) {
  trb_runner_stop(&b->runner);
  trb_free(&b->options.allocator, b->scratch, b->scratch_size);
}
static void build_hierarchy(trb_build *b, const trbvh_geometry *g, const trbvh_options *o) {
  begin_build(b, g, o);
  CHECK(trb_read(b) == TRBVH_OK);
  trb_close_gaps(b, b->refs);
  CHECK(!trb_make_keys(b, 0) && trb_sort_keys(b) == TRBVH_OK && trb_build_hierarchy(b) == TRBVH_OK);
}

static trbvh_geometry geometry_of_boxes(const trbvh_node *boxes, uint32_t count, float *memory) {
  trbvh_geometry g;
  uint32_t i;
  memset(&g, 0, sizeof g);
  for (i = 0; i < count; i++) {
    memcpy(memory + 6 * i, boxes[i].min, 12);
    memcpy(memory + 6 * i + 3, boxes[i].max, 12);
  }
  g.boxes = memory;
  g.count = count;
  return g;
}

enum { BOXES = QUICK_OR(20000, 60000) };
/* kind: 0 random, 1 few places with many duplicates each, 2 all the same, 3 crowded at one corner */
static void some_boxes(trbvh_node *boxes, uint32_t count, uint32_t kind) {
  rng r = {5};
  uint32_t i, k;
  for (i = 0; i < count; i++) {
    boxes[i] = random_box(&r, kind == 2 ? 0 : 0.01f);
    if (kind == 1) snap(&boxes[i]);
    if (kind == 2) for (k = 0; k < 3; k++) boxes[i].min[k] = boxes[i].max[k] = 0.5f;
    if (kind == 3) for (k = 0; k < 3; k++) boxes[i].min[k] = boxes[i].max[k] = (float)ldexp(boxes[i].min[k], -(int)(i % 30));
  }
}

// >>the hierarchy against the radix tree's definition
typedef struct radix { const trb_build *b; trb_u64 *code; uint32_t *order; } radix;
static const radix *radix_now;
static int by_code(const void *a, const void *b) {
  uint32_t i = *(const uint32_t *)a, k = *(const uint32_t *)b;
  trb_u64 x = radix_now->code[i], y = radix_now->code[k];
  return x != y ? (x < y ? -1 : 1) : (i < k ? -1 : i > k);
}

static trb_u64 highest_bit(trb_u64 x) {
  trb_u64 bit = (trb_u64)1 << 63;
  while (!(x & bit)) bit >>= 1;
  return bit;
}

/* A node over order[first .. last] splits where the highest bit changes between them; indices stand below codes. */
static int check_radix(const radix *x, uint32_t node, uint32_t first, uint32_t last) {
  const trbvh_node *n = &x->b->nodes[node];
  const uint32_t *order = x->order;
  const trb_u64 codes = x->code[order[first]] ^ x->code[order[last]];
  uint32_t middle = first;
  if (trb_count(n->count) != last - first + 1) return 0;
  if (first == last) return n->first == order[first];
  if (codes) while (!((x->code[order[first]] ^ x->code[order[middle + 1]]) & highest_bit(codes))) middle++;
  else while (!((order[first] ^ order[middle + 1]) & highest_bit(order[first] ^ order[last]))) middle++;
  return check_radix(x, n->first, first, middle) && check_radix(x, n->first + 1, middle + 1, last);
}

static void test_hierarchy(void) {
  static const uint32_t counts[] = {1, 2, 3, 7, 1000, BOXES};
  trbvh_node *boxes = (trbvh_node *)xmalloc(BOXES * sizeof *boxes);
  float *memory = (float *)xmalloc(BOXES * 24);
  uint32_t kind, i, c, packed;
  radix x;
  x.code = (trb_u64 *)xmalloc(BOXES * 8);
  x.order = (uint32_t *)xmalloc(BOXES * 4);
  for (packed = 0; packed < 2; packed++)
    for (kind = 0; kind < 4; kind++)
      for (c = 0; c < 6; c++) {
        trb_build b;
        trbvh_geometry g;
        CONTEXT("%u boxes of kind %u, packed %u", counts[c], kind, packed);
        packed_refs = packed ? 1u << 24 : 0;
        some_boxes(boxes, counts[c], kind);
        g = geometry_of_boxes(boxes, counts[c], memory);
        build_hierarchy(&b, &g, NULL);
        for (i = 0; i < counts[c]; i++) {
          x.code[i] = trb_morton(boxes[i], b.grid) >> (packed ? 63 - b.key_form.bits : 0);
          x.order[i] = i;
        }
        x.b = &b;
        radix_now = &x;
        qsort(x.order, counts[c], sizeof *x.order, by_code);
        CHECK(check_radix(&x, 0, 0, counts[c] - 1));
        end_build(&b);
      }
  packed_refs = 1u << 24;
  free(x.code);
  free(x.order);
  free(boxes);
  free(memory);
}

// >>the rounds against the rule
/* Round of this gamma, said as the rule says it: a root once, after both its children's subtrees. */
static void naive_round(trbvh_node *nodes, uint32_t root, uint32_t gamma, trb_costs costs, trb_treelets *t) {
  if (trb_count(nodes[root].count) < gamma) return;
  naive_round(nodes, nodes[root].first, gamma, costs, t);
  naive_round(nodes, nodes[root].first + 1, gamma, costs, t);
  trb_restructure(nodes, t, &root, 1, costs);
}

static int same_subtree(const trbvh_node *a, uint32_t i, const trbvh_node *b, uint32_t k) {
  if (memcmp(a[i].min, b[k].min, 12) || memcmp(a[i].max, b[k].max, 12) || a[i].count != b[k].count) return 0;
  if (trb_count(a[i].count) == 1) return a[i].first == b[k].first;
  return same_subtree(a, a[i].first, b, b[k].first) && same_subtree(a, a[i].first + 1, b, b[k].first + 1);
}

static void test_rounds(void) {
  trbvh_node *boxes = (trbvh_node *)xmalloc(BOXES * sizeof *boxes), *nodes = (trbvh_node *)xmalloc(2 * BOXES * sizeof *nodes);
  float *memory = (float *)xmalloc(BOXES * 24);
  trb_treelets *t = (trb_treelets *)xmalloc(sizeof *t);
  uint32_t kind, gamma;
  memset(t, 0, sizeof *t);
  for (kind = 0; kind < 4; kind++) {
    trb_build b;
    trbvh_geometry g;
    some_boxes(boxes, BOXES, kind);
    g = geometry_of_boxes(boxes, BOXES, memory);
    build_hierarchy(&b, &g, NULL);
    memcpy(nodes, b.nodes, 2 * BOXES * sizeof *nodes);
    for (gamma = 7; gamma <= 28; gamma *= 2) {
      CONTEXT("kind %u, gamma %u", kind, gamma);
      naive_round(nodes, 0, gamma, b.costs, t);
      CHECK(!trb_round(&b, gamma));
      CHECK(same_subtree(b.nodes, 0, nodes, 0));
    }
    end_build(&b);
  }
  free(boxes);
  free(nodes);
  free(memory);
  free(t);
}

// >>the depth bound
/* A tree that no build makes: each node a reference and all the rest. It must come out within the bound, whole. */
static void test_depth_bound(void) {
  static const uint32_t counts[] = {50, 66, 67, 100, 1000, BOXES};
  trbvh_node *boxes = (trbvh_node *)xmalloc(BOXES * sizeof *boxes);
  float *memory = (float *)xmalloc(BOXES * 24);
  uint32_t c, i, left, hollow;
  for (hollow = 0; hollow < 2; hollow++)
    for (c = 0; c < 6; c++)
      for (left = 0; left < 2; left++) {
        const uint32_t n = counts[c];
        trbvh_options o;
        trbvh_geometry g;
        trb_build b;
        trbvh bvh;
        char why[256];
        CONTEXT("a chain of %u, left %u", n, left);
        memset(&bvh, 0, sizeof bvh);
        memset(&o, 0, sizeof o);
        o.max_leaf = hollow ? 1 : 8;
        some_boxes(boxes, n, 0);
        g = geometry_of_boxes(boxes, n, memory);
        build_hierarchy(&b, &g, &o);
        for (i = n - 1; i > 0; i--) {                 /* pair i holds reference i - 1 and what follows */
          trbvh_node rest = i == n - 1 ? trb_reference(b.refs[n - 1], b.costs)
                                       : trb_parent(b.nodes[2 * i + 2], b.nodes[2 * i + 3], 2 * i + 2, b.costs);
          b.nodes[2 * i + left] = trb_reference(b.refs[i - 1], b.costs);
          b.nodes[2 * i + 1 - left] = rest;
        }
        b.nodes[0] = trb_parent(b.nodes[2], b.nodes[3], 2, b.costs);
        CHECK(trb_collapse(&b, &bvh) == TRBVH_OK && trb_finish(&b) == TRBVH_OK);
        bvh.nodes = b.tree.nodes;
        bvh.prims = b.tree.prims;
        bvh.node_count = b.tree.node_count;
        bvh.ref_count = b.tree.ref_count;
        bvh.prim_count = n;
        CHECK_MSG(trbvh_validate(&bvh, &g, why, sizeof why) == TRBVH_OK, "%s", why);
        CHECK(bvh.ref_count == n);
        CHECK_MSG(b.stats.max_depth <= TRBVH_MAX_DEPTH, "depth %u", b.stats.max_depth);
        if (n == 50 && hollow) CHECK_MSG(b.stats.max_depth == 49, "depth %u: nothing was to be mended", b.stats.max_depth);
        end_build(&b);
        trbvh_free(&bvh);
      }
  free(boxes);
  free(memory);
}

// >>splitting
static void random_triangle(rng *r, float v[3][3], uint32_t kind) {
  int i, k;
  for (i = 0; i < 3; i++)
    for (k = 0; k < 3; k++) v[i][k] = rng_range(r, -1, 1);
  if (kind == 1) for (k = 0; k < 3; k++) v[2][k] = v[1][k] + 1e-4f * rng_range(r, -1, 1);        /* a sliver */
  if (kind == 2) for (i = 0; i < 3; i++) v[i][rng_below(r, 3)] = 0.25f;                             /* partly flat */
  if (kind == 3) for (i = 0; i < 3; i++) for (k = 0; k < 3; k++) v[i][k] = 100 + 1e-3f * v[i][k];  /* far and small */
}

/* Fragments of a triangle: none empty or inverted, all inside its box, and no point of it outside of all of them. */
static void test_fragments(void) {
  enum { SPLITS = 40 };
  rng r = {6};
  uint32_t round, i, point;
  for (round = 0; round < QUICK_OR(200, 2000); round++) {
    trbvh_node out[SPLITS + 1], box;
    float v[3][3];
    trb_build b;
    trbvh_geometry g;
    uint32_t count;
    int k;
    memset(&g, 0, sizeof g);
    random_triangle(&r, v, round % 4);
    g.positions = v;
    g.count = 1;
    CHECK(trb_resolve(&b, &g, NULL) == TRBVH_OK);
    for (k = 0; k < 3; k++) b.grid.origin[k] = round % 4 == 3 ? 99 : -1.5f;
    b.grid.cells_per_unit = 2097152.0f / 3;
    b.grid.units_per_cell = 3 / 2097152.0f;
    trb_triangle_box((const float (*)[3])v, &box);
    box.first = 0;
    count = trb_split_reference(&b.input, b.grid, box, SPLITS, out);
    CHECK(count >= 1 && count <= SPLITS + 1);
    if (round % 4 == 0) CHECK_MSG(count == SPLITS + 1, "%u fragments", count);
    for (i = 0; i < count; i++) {
      CHECK(trb_valid_box(out[i]) && trb_inside(&out[i], &box));
      CHECK(out[i].first == 0);
    }
    for (point = 0; point < 300; point++) {
      double a = rng_unit(&r), c = rng_unit(&r), p[3];
      int found = 0;
      if (a + c > 1) { a = 1 - a; c = 1 - c; }
      if (point % 3 == 0) c = 0;                      /* on an edge */
      for (k = 0; k < 3; k++) p[k] = (1 - a - c) * v[0][k] + a * v[1][k] + c * v[2][k];
      for (i = 0; i < count && !found; i++) {
        found = 1;
        for (k = 0; k < 3; k++) found &= p[k] >= out[i].min[k] && p[k] <= out[i].max[k];
      }
      CHECK_MSG(found, "round %u: point %.9g %.9g %.9g is in none of %u fragments", round, p[0], p[1], p[2], count);
    }
  }
}

/* The scale spends the budget, no more, and nearly all of it. */
static void test_split_budget(void) {
  static const float budgets[] = {0.1f, 0.3f, 1, 4};
  enum { COUNT = 5000 };
  float *soup = (float *)xmalloc(COUNT * 36);
  rng r = {7};
  uint32_t i, k;
  for (i = 0; i < COUNT; i++) {
    float v[3][3];
    random_triangle(&r, v, i % 2);
    memcpy(soup + 9 * i, v, 36);
  }
  for (k = 0; k < 4; k++) {
    trbvh_geometry g;
    trbvh_options o;
    trb_build b;
    trb_u64 sum = 0;
    CONTEXT("budget %g", (double)budgets[k]);
    memset(&g, 0, sizeof g);
    memset(&o, 0, sizeof o);
    g.positions = soup;
    g.count = COUNT;
    o.split_budget = budgets[k];
    begin_build(&b, &g, &o);
    CHECK(trb_read(&b) == TRBVH_OK && trb_split(&b) == TRBVH_OK);
    for (i = 0; i < b.block_count; i++) sum += b.blocks[i].splits;
    CHECK_MSG(sum <= b.split_max && sum > b.split_max * 9 / 10, "%u splits of %u", (unsigned)sum, b.split_max);
    trb_close_gaps(&b, b.refs);
    CHECK(b.ref_count <= b.ref_max && b.ref_count > COUNT + b.split_max * 8 / 10);
    end_build(&b);
  }
  free(soup);
}

int main(int argc, char **argv) {
  test_start(argc, argv);
  RUN(test_numbers);
  RUN(test_node_words);
  RUN(test_dynamic_program);
  RUN(test_partition);
  RUN(test_hierarchy);
  RUN(test_rounds);
  RUN(test_depth_bound);
  RUN(test_fragments);
  RUN(test_split_budget);
  return test_finish();
}
