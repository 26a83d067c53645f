/* The parts that decide a tree, each against its definition: the dynamic program against all topologies, the hierarchy
 * against the radix tree, the rounds against the rule that fixes them, the depth bound, the clipping. Sees the
 * library's inside. */
static unsigned packed_refs = 1u << 24;        /* up to how many references sort keys are packed */
static unsigned large_sort = 131072;           /* from how many on they are sorted by buckets */
#define TRB_PACKED_REFS packed_refs
#define TRB_LARGE_SORT large_sort
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

/* What the dynamic program reads and writes, as a build has it. */
typedef struct program { trb_costs costs; TRB_ALIGNED(trb_treelets) t; } program;

static void enter_leaves(const search *s, uint32_t lane, program *p) {
  uint32_t i, k;
  for (i = 0; i < 7; i++) {
    float *v = p->t.leaves + i * TRB_LEAF_VALUES * TRB_LANES + lane;
    for (k = 0; k < 3; k++) {
      v[k * TRB_LANES] = s->leaf[i].min[k];
      v[(3 + k) * TRB_LANES] = s->leaf[i].max[k];
    }
    v[6 * TRB_LANES] = (float)trb_count(s->leaf[i].count);
    v[7 * TRB_LANES] = trb_cost(s->leaf[i].count);
  }
}

/* In one lane; the others hold zeros. */
static void run_program(const search *s, uint32_t lane, program *p) {
  memset(&p->t, 0, sizeof p->t);
  p->costs = s->costs;
  enter_leaves(s, lane, p);
  trb_treelet_costs(p->t.leaves, p->t.table, p->t.sums, TRB_LANES, s->costs);
}

static void test_dynamic_program(void) {
  static const uint32_t largest[] = {1, 2, 4, 12, 100};
  static program now;
  rng r = {3};
  uint32_t i, s, lane;
  for (i = 0; i < QUICK_OR(10, 60); i++) {
    trbvh_node leaf[7];
    search exhaustive;
    exhaustive.costs = costs_of(i % 3 ? 1 / 1.2f : 0.2f, i % 2 ? 8 : 16);
    random_leaves(&r, &exhaustive, leaf, largest[i % 5], i % 4 == 3);
    lane = rng_below(&r, TRB_LANES);
    run_program(&exhaustive, lane, &now);
    for (s = 3; s < TRB_SUBSETS; s++) {
      double want, got = now.t.table[s * TRB_LANES + lane] + sum_of_costs(&exhaustive, s);
      if ((s & (s - 1)) == 0 || (s != 127 && rng_below(&r, 8))) continue;
      want = cheapest(&exhaustive, s);
      CHECK_MSG(fabs(got - want) <= 1e-5 * want, "treelet %u, subset %u: %.9g, not %.9g", i, s, got, want);
    }
  }
}

/* The same in floats, in the order that the library adds in, subset by subset; volatile: no fused operations. */
static float sum_low_first(const float *v, uint32_t subset) {       /* the highest, plus what is below it */
  volatile float sum = 0;
  uint32_t i;
  for (i = 0; i < 7; i++)
    if (subset >> i & 1) sum = v[i * TRB_LEAF_VALUES * TRB_LANES] + sum;
  return sum;
}

static void plain_program(const float *leaves, trb_costs costs, float *table, float *sums) {
  uint32_t s, p, i, k;
  for (s = 1; s < TRB_SUBSETS; s++) {
    volatile float side[3], xy, z, area, n, u, leaf, over, split, best = FLT_MAX;
    for (k = 0; k < 3; k++) {
      float low = FLT_MAX, high = -FLT_MAX;
      for (i = 0; i < 7; i++)
        if (s >> i & 1) {
          const float *v = leaves + (i * TRB_LEAF_VALUES + k) * TRB_LANES;
          if (v[0] < low) low = v[0];
          if (v[3 * TRB_LANES] > high) high = v[3 * TRB_LANES];
        }
      side[k] = high - low;
    }
    xy = side[0] * side[1];
    z = side[0] + side[1];
    z = side[2] * z;
    area = xy + z;
    sums[s] = area;
    table[s] = 0;
    if ((s & (s - 1)) == 0) continue;
    n = sum_low_first(leaves + 6 * TRB_LANES, s);
    u = sum_low_first(leaves + 7 * TRB_LANES, s & 7) + sum_low_first(leaves + 7 * TRB_LANES, s & 120);
    leaf = costs.ratio * area;
    leaf = leaf * n;
    leaf = leaf - u;
    over = n - ((float)costs.max_leaf + 0.5f);
    over = over * FLT_MAX;
    if (!(leaf > over)) leaf = over;
    for (p = (s - 1) & s; p; p = (p - 1) & s) {
      volatile float sum = table[p] + table[s ^ p];
      if (sum < best) best = sum;
    }
    split = area + best;
    sums[s] = best;
    table[s] = leaf < split ? leaf : split;
  }
}

enum { SET_PLAIN, SET_CHOSEN, SET_SSE, SET_AVX2, SET_AVX512, SETS };
static const char *const set_names[SETS] = {"plain floats", "trb_treelet_costs", "SSE", "AVX2", "AVX-512"};

/* 0 where this machine, or this compiler, has no such vectors. */
static int run_set(int set, program *p) {
  uint32_t lane = 0;
  memset(p->t.table, 0xEE, sizeof p->t.table);
  memset(p->t.sums, 0xEE, sizeof p->t.sums);
  if (set == SET_CHOSEN) {
    trb_treelet_costs(p->t.leaves, p->t.table, p->t.sums, TRB_LANES, p->costs);
    return 1;
  }
#ifdef TRB_X86
  if (set == SET_AVX512) {
    if (trb_simd() < 512) return 0;
    trb_treelet_costs_avx512(p->t.leaves, p->t.table, p->t.sums, p->costs);
    return 1;
  }
  if (set == SET_AVX2 && trb_simd() < 256) return 0;
  for (; set == SET_AVX2 && lane < TRB_LANES; lane += 8)
    trb_treelet_costs_avx2(p->t.leaves + lane, p->t.table + lane, p->t.sums + lane, p->costs);
  for (; set == SET_SSE && lane < TRB_LANES; lane += 4)
    trb_treelet_costs_sse(p->t.leaves + lane, p->t.table + lane, p->t.sums + lane, p->costs);
#endif
  return lane != 0;
}

/* All instruction sets, all lanes, all bits; treelets of any size, ties, points, and areas that overflow. */
static void test_instruction_sets(void) {
  static program now, first;
  float table[TRB_SUBSETS], sums[TRB_SUBSETS];
  rng r = {8};
  uint32_t i, k, s, lane, lanes;
  int set, ran[SETS] = {0};
  for (i = 0; i < QUICK_OR(100, 1000); i++) {
    memset(&now, 0, sizeof now);
    now.costs = costs_of(i % 3 ? 1 / 1.2f : 0.2f, i % 2 ? 8 : 1 + rng_below(&r, 16));
    for (lane = 0; lane < TRB_LANES; lane++) {
      trbvh_node leaf[7];
      search one;
      one.costs = now.costs;
      random_leaves(&r, &one, leaf, 1 + rng_below(&r, lane % 2 ? 3 : 40), lane % 4 == 3);
      for (k = 0; k < 7 * 3; k++) {
        if (lane == 5) leaf[k / 3].max[k % 3] = leaf[k / 3].min[k % 3];
        if (lane == 6) { leaf[k / 3].min[k % 3] *= -3e38f; leaf[k / 3].max[k % 3] *= 3e38f; }
        if (lane == 7 && i % 2) leaf[k / 3].min[k % 3] = leaf[k / 3].max[k % 3] = 0.5f;
      }
      enter_leaves(&one, lane, &now);
    }
    first = now;
    run_set(SET_CHOSEN, &first);
    for (lane = 0; lane < TRB_LANES; lane++) {
      plain_program(now.t.leaves + lane, now.costs, table, sums);
      for (s = 1; s < TRB_SUBSETS; s++) {
        float c = first.t.table[s * TRB_LANES + lane], best = first.t.sums[s * TRB_LANES + lane];
        CHECK_MSG(trb_bits(c) == trb_bits(table[s]), "treelets %u, lane %u, subset %u: cost %.9g, plain floats %.9g", i,
                  lane, s, c, table[s]);
        CHECK_MSG(trb_bits(best) == trb_bits(sums[s]), "treelets %u, lane %u, subset %u: sum %.9g, plain floats %.9g",
                  i, lane, s, best, sums[s]);
      }
    }
    for (set = SET_SSE; set < SETS; set++) {
      if (!run_set(set, &now)) continue;
      ran[set] = 1;
      CHECK_MSG(!memcmp(now.t.table, first.t.table, 4 * TRB_SUBSETS * TRB_LANES), "%s: another table", set_names[set]);
      CHECK_MSG(!memcmp(now.t.sums, first.t.sums, 4 * TRB_SUBSETS * TRB_LANES), "%s: other sums", set_names[set]);
    }
    lanes = 1 + i % TRB_LANES;                        /* with fewer lanes, those do not change */
    memset(now.t.table, 0xEE, sizeof now.t.table);
    memset(now.t.sums, 0xEE, sizeof now.t.sums);
    trb_treelet_costs(now.t.leaves, now.t.table, now.t.sums, lanes, now.costs);
    for (s = 0; s < TRB_SUBSETS; s++) {
      CHECK(!memcmp(now.t.table + s * TRB_LANES, first.t.table + s * TRB_LANES, 4 * lanes));
      CHECK(!memcmp(now.t.sums + s * TRB_LANES, first.t.sums + s * TRB_LANES, 4 * lanes));
    }
  }
#ifdef TRB_X86
  CHECK(ran[SET_SSE] && ran[SET_AVX2] == (trb_simd() >= 256) && ran[SET_AVX512] == (trb_simd() >= 512));
#endif
}

/* The topology that trb_partition reads from the table costs what the table says, and is the first of its equals. */
static double topology_cost(const search *s, const program *now, uint32_t subset) {
  uint32_t p, n = 0, i;
  double area, split, leaf;
  if ((subset & (subset - 1)) == 0) return trb_cost(s->leaf[trb_log2(subset)].count);
  p = trb_partition(now->t.table, now->t.sums, subset);
  CHECK((p & subset) == p && p != subset && (p & subset & (0 - subset)));
  area = subset_area(s, subset);
  split = area + topology_cost(s, now, p) + topology_cost(s, now, subset ^ p);
  for (i = 0; i < 7; i++)
    if (subset >> i & 1) n += trb_count(s->leaf[i].count);
  leaf = s->costs.ratio * area * n;
  return n <= s->costs.max_leaf && leaf < split ? leaf : split;
}

static void test_partition(void) {
  static program now;
  rng r = {4};
  uint32_t i, q, subset;
  for (i = 0; i < 500; i++) {
    trbvh_node leaf[7];
    search s;
    double cost, want;
    s.costs = costs_of(1 / 1.2f, 8);
    random_leaves(&r, &s, leaf, 6, i % 2);
    run_program(&s, 0, &now);
    want = now.t.table[127 * TRB_LANES] + sum_of_costs(&s, 127);
    cost = topology_cost(&s, &now, 127);
    CHECK_MSG(fabs(cost - want) <= 2e-5 * want, "%.9g, the table says %.9g", cost, want);
    for (subset = 3; subset < TRB_SUBSETS; subset++) {
      const uint32_t lowest = subset & (0 - subset), part = trb_partition(now.t.table, now.t.sums, subset);
      float best = now.t.table[part * TRB_LANES] + now.t.table[(subset ^ part) * TRB_LANES];
      if (subset == lowest) continue;
      CHECK_MSG((part & lowest) && (part & subset) == part && part != subset, "subset %u: part %u", subset, part);
      CHECK_MSG(trb_bits(best) == trb_bits(now.t.sums[subset * TRB_LANES]), "subset %u: another sum", subset);
      for (q = 1; q < subset; q++) {                  /* of equal sums, the rest that is the smaller number */
        float sum = now.t.table[(subset ^ q) * TRB_LANES] + now.t.table[q * TRB_LANES];
        if ((q & subset) != q || (q & lowest)) continue;
        CHECK_MSG(q < (subset ^ part) ? sum > best : sum >= best, "subset %u: rest %u, not %u", subset, q,
                  subset ^ part);
      }
    }
  }
}

// >>builds, stage by stage
static void begin_build(trb_build *b, const trbvh_geometry *g, const trbvh_options *o) {
  CHECK(trb_resolve(b, g, o) == TRBVH_OK);
  trb_runner_start(&b->runner, &b->options, 0);
  CHECK(trb_allocate_scratch(b) == TRBVH_OK);
  trb_start_attempt(b, b->split_max > 0);
}
static void end_build(trb_build *b) {
  trb_runner_stop(&b->runner);
  trb_free(&b->options.allocator, b->scratch, b->scratch_size);
}
static void make_keys(trb_build *b, const trbvh_geometry *g, const trbvh_options *o) {
  begin_build(b, g, o);
  CHECK(trb_read(b) == TRBVH_OK);
  if (b->split_max) CHECK(trb_split(b) == TRBVH_OK);
  CHECK(!trb_make_keys(b));
}
static void build_hierarchy(trb_build *b, const trbvh_geometry *g, const trbvh_options *o) {
  make_keys(b, g, o);
  b->final = 0;                                     /* all nodes are to be seen, also below leaves */
  CHECK(trb_sort_keys(b) == TRBVH_OK && trb_build_hierarchy(b) == TRBVH_OK);
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
/* kind: 0 random, 1 few places with many duplicates each, 2 all the same, 3 crowded at one corner, 4 less so */
static void some_boxes(trbvh_node *boxes, uint32_t count, uint32_t kind) {
  rng r = {5};
  uint32_t i, k;
  for (i = 0; i < count; i++) {
    boxes[i] = random_box(&r, kind == 2 ? 0 : 0.01f);
    if (kind == 1) snap(&boxes[i]);
    if (kind == 2) for (k = 0; k < 3; k++) boxes[i].min[k] = boxes[i].max[k] = 0.5f;
    if (kind < 3) continue;
    for (k = 0; k < 3; k++)
      boxes[i].min[k] = boxes[i].max[k] = (float)ldexp(boxes[i].min[k], -(int)(i % (kind == 3 ? 30 : 8)));
  }
}

/* Every some-th one becomes invalid: 1 none, 2 every other one; 3 all but the first, 4 all but the last, 5 all of the
 * second block. */
enum { HOLES = 6 };
static int is_hole(uint32_t i, uint32_t count, uint32_t holes) {
  if (holes == 0) return 0;
  if (holes == 1) return i % 7 == 3;
  if (holes == 2) return i % 2;
  if (holes == 3) return i != 0;
  if (holes == 4) return i != count - 1;
  return i / TRB_BLOCK == 1;
}
static void make_holes(trbvh_node *boxes, uint32_t count, uint32_t holes) {
  uint32_t i;
  for (i = 0; i < count; i++)
    if (is_hole(i, count, holes)) boxes[i].max[i % 3] = i % 5 ? bad_float(i) : boxes[i].min[i % 3] - 1;
}

/* Slivers, many of which are split, and others which are not; invalid ones between them. */
static void some_triangles(float *soup, uint32_t count, uint32_t holes) {
  rng r = {9};
  uint32_t i, j, k;
  for (i = 0; i < count; i++) {
    float size = i % 3 ? 0.01f : 0.5f, place[3];
    for (k = 0; k < 3; k++) place[k] = rng_unit(&r);
    for (j = 0; j < 3; j++)
      for (k = 0; k < 3; k++) soup[9 * i + 3 * j + k] = place[k] + rng_range(&r, -size, size);
    if (is_hole(i, count, holes)) soup[9 * i + i % 9] = bad_float(i);
  }
}
static trbvh_geometry geometry_of_soup(const float *soup, uint32_t count) {
  trbvh_geometry g;
  memset(&g, 0, sizeof g);
  g.positions = soup;
  g.count = count;
  return g;
}

// >>the hierarchy against the radix tree's definition
/* Slots: what stands in them, its code, and those in use, sorted. */
typedef struct radix {
  const trb_build  *b;
  const trbvh_node *refs;
  trb_u64          *code;
  uint32_t         *order, count;
} radix;
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

/* A node over order[first .. last] splits where the highest bit changes between them; indices stand below codes. The
 * split between order[i] and order[i + 1] has pair i + 1. */
static int check_radix(const radix *x, uint32_t node, uint32_t first, uint32_t last) {
  const trbvh_node *n = &x->b->nodes[node];
  const uint32_t *order = x->order;
  const trb_u64 codes = x->code[order[first]] ^ x->code[order[last]];
  uint32_t middle = first;
  if (trb_count(n->count) != last - first + 1) return 0;
  if (first == last) {
    const trbvh_node *ref = &x->refs[order[first]];
    return n->first == (x->b->refs ? order[first] : ref->first) && !memcmp(n->min, ref->min, 12) && !memcmp(n->max, ref->max, 12);
  }
  if (codes) while (!((x->code[order[first]] ^ x->code[order[middle + 1]]) & highest_bit(codes))) middle++;
  else while (!((order[first] ^ order[middle + 1]) & highest_bit(order[first] ^ order[last]))) middle++;
  if (n->first != 2 * (middle + 1)) return 0;
  return check_radix(x, n->first, first, middle) && check_radix(x, n->first + 1, middle + 1, last);
}

/* x->refs: all slots, gaps with first == TRBVH_NONE. */
static void find_order(radix *x, const trb_build *b, uint32_t slots) {
  uint32_t i;
  x->b = b;
  x->count = 0;
  for (i = 0; i < slots; i++) {
    if (x->refs[i].first == TRBVH_NONE) continue;
    x->code[i] = trb_box_code(x->refs[i], b->grid) >> (b->key_form.packed ? 63 - b->key_form.bits : 0);
    x->order[x->count++] = i;
  }
}
static void sort_order(radix *x) {
  radix_now = x;
  qsort(x->order, x->count, sizeof *x->order, by_code);
}
static void radix_start(radix *x, uint32_t slots) {
  memset(x, 0, sizeof *x);
  x->code = (trb_u64 *)xmalloc(slots * 8);
  x->order = (uint32_t *)xmalloc(slots * 4);
}
static void radix_stop(radix *x) { free(x->code); free(x->order); }

/* Primitives as they are read: slot i holds primitive i, or nothing where it is invalid. */
static void prims_as_slots(trbvh_node *boxes, uint32_t count) {
  uint32_t i;
  for (i = 0; i < count; i++) {
    boxes[i].first = trb_valid_box(boxes[i]) ? i : TRBVH_NONE;
    boxes[i].count = 0;
  }
}

static void test_hierarchy(void) {
  static const uint32_t counts[] = {1, 2, 3, 7, 40, 1000, BOXES};
  trbvh_node *boxes = (trbvh_node *)xmalloc(BOXES * sizeof *boxes);
  float *memory = (float *)xmalloc(BOXES * 24);
  uint32_t kind, c, form;                          /* of keys: long ones, packed ones, these sorted by buckets */
  radix x;
  radix_start(&x, BOXES);
  for (form = 0; form < 3; form++)
    for (kind = 0; kind < 4 + HOLES; kind++)
      for (c = 0; c < sizeof counts / sizeof counts[0]; c++) {
        trb_build b;
        trbvh_geometry g;
        CONTEXT("%u boxes of kind %u, form %u", counts[c], kind, form);
        packed_refs = form ? 1u << 24 : 0;
        large_sort = form == 2 ? 5000 : 131072;
        some_boxes(boxes, counts[c], kind < 4 ? kind : 0);
        if (kind >= 4) make_holes(boxes, counts[c], kind - 4);
        g = geometry_of_boxes(boxes, counts[c], memory);
        make_keys(&b, &g, NULL);
        CHECK(b.refs == NULL && b.split_max == 0);
        prims_as_slots(boxes, counts[c]);
        x.refs = boxes;
        find_order(&x, &b, counts[c]);
        CHECK_MSG(b.ref_count == x.count && b.stats.skipped_count == counts[c] - x.count, "%u references, %u skipped",
                  b.ref_count, b.stats.skipped_count);
        sort_order(&x);
        if (b.ref_count) {
          CHECK(trb_sort_keys(&b) == TRBVH_OK && trb_build_hierarchy(&b) == TRBVH_OK);
          CHECK(check_radix(&x, 0, 0, x.count - 1));
        }
        end_build(&b);
      }
  packed_refs = 1u << 24;
  large_sort = 131072;
  radix_stop(&x);
  free(boxes);
  free(memory);
}

// >>slots and keys
/* With splits, every valid primitive has one slot more than it has splits, after those of the ones before it; what it
 * does not need are gaps. The hierarchy is that over what is left. */
static void test_slots_of_splits(void) {
  static const uint32_t counts[] = {1, 2, 30, 1000, BOXES};
  float *soup = (float *)xmalloc(BOXES * 36);
  uint32_t packed, holes, c, i, k;
  radix x;
  radix_start(&x, 2 * BOXES);
  for (packed = 0; packed < 2; packed++)
    for (holes = 0; holes < HOLES; holes++)
      for (c = 0; c < sizeof counts / sizeof counts[0]; c++) {
        const uint32_t count = counts[c];
        trbvh_geometry g;
        trbvh_options o;
        trb_build b;
        uint32_t slot = 0, used = 0, most = 0;
        float *priorities;
        CONTEXT("%u triangles, holes %u, packed %u", count, holes, packed);
        memset(&o, 0, sizeof o);
        o.split_budget = 1;
        packed_refs = packed ? 1u << 24 : 0;
        some_triangles(soup, count, holes);
        g = geometry_of_soup(soup, count);
        begin_build(&b, &g, &o);
        CHECK(trb_read(&b) == TRBVH_OK && b.refs && b.ref_max == 2 * count);
        memset(b.refs, 0xCC, b.ref_max * sizeof *b.refs);
        CHECK(trb_split(&b) == TRBVH_OK);
        priorities = (float *)xmalloc(count * 4);
        memcpy(priorities, b.priorities, count * 4);
        for (i = 0; i < count; i++) {
          uint32_t splits = (uint32_t)trb_splits(priorities[i], b.priority_unit, b.scale), n = 0;
          if (is_hole(i, count, holes)) continue;
          most = TRB_MAX(splits, most);
          for (k = 0; k <= splits; k++, slot++) {
            const uint32_t prim = b.refs[slot].first;
            CHECK_MSG(prim == (n == k ? i : TRBVH_NONE) || prim == TRBVH_NONE, "slot %u: %u", slot, prim);
            n += prim == i;
            CHECK(prim != i || trb_valid_box(b.refs[slot]));
          }
          CHECK_MSG(n > 0, "triangle %u is nowhere", i);
          used += n;
        }
        free(priorities);
        CHECK_MSG(slot <= b.ref_max && used == b.ref_count, "%u slots, %u used, ref_count %u", slot, used, b.ref_count);
        if (count > 1000 && holes != 3 && holes != 4) CHECK(most > 1);
        x.refs = b.refs;
        find_order(&x, &b, slot);
        CHECK(!trb_make_keys(&b));
        CHECK(x.count == b.ref_count);
        for (i = 0; i < b.ref_count; i++)               /* no gaps among the keys */
          CHECK(b.keys[i] == ((packed ? x.code[x.order[i]] : x.code[x.order[i]] & 0x7FFFFFFFu) << b.key_form.shift |
                              x.order[i]));
        sort_order(&x);
        if (b.ref_count) {
          CHECK(trb_sort_keys(&b) == TRBVH_OK && trb_build_hierarchy(&b) == TRBVH_OK);
          CHECK(check_radix(&x, 0, 0, x.count - 1));
        }
        end_build(&b);
      }
  packed_refs = 1u << 24;
  radix_stop(&x);
  free(soup);
}

/* Keys before the sort: in the order of the primitives, without the invalid ones, their codes those of single boxes. */
static void test_keys(void) {
  trbvh_node *boxes = (trbvh_node *)xmalloc(BOXES * sizeof *boxes);
  float *memory = (float *)xmalloc(BOXES * 24);
  uint32_t packed, holes, count, i;
  radix x;
  radix_start(&x, BOXES);
  for (packed = 0; packed < 2; packed++)
    for (holes = 0; holes < HOLES; holes++)
      for (count = 1; count <= BOXES; count = count < 70 ? count + 1 : count * 7) {
        trb_build b;
        trbvh_geometry g;
        CONTEXT("%u boxes, holes %u, packed %u", count, holes, packed);
        packed_refs = packed ? 1u << 24 : 0;
        some_boxes(boxes, count, 3 * (count % 2));
        make_holes(boxes, count, holes);
        g = geometry_of_boxes(boxes, count, memory);
        make_keys(&b, &g, NULL);
        prims_as_slots(boxes, count);
        x.refs = boxes;
        find_order(&x, &b, count);
        CHECK(x.count == b.ref_count);
        for (i = 0; i < x.count; i++) {
          const trb_u64 code = x.code[x.order[i]];
          CHECK_MSG(b.keys[i] == ((packed ? code : code & 0x7FFFFFFFu) << b.key_form.shift | x.order[i]),
                    "key %u is not that of box %u", i, x.order[i]);
        }
        end_build(&b);
      }
  packed_refs = 1u << 24;
  radix_stop(&x);
  free(boxes);
  free(memory);
}

// >>leaf order
/* Leaves from left to right. */
static uint32_t walk_leaves(const trbvh *bvh, uint32_t *prims) {
  uint32_t stack[TRBVH_MAX_DEPTH + 1], waiting = 0, node = 0, found = 0, i;
  for (;;) {
    const trbvh_node *n = &bvh->nodes[node];
    if (n->count == 0) {
      stack[waiting++] = n->first + 1;
      node = n->first;
      continue;
    }
    for (i = 0; i < n->count; i++) prims[found++] = bvh->prims[n->first + i];
    if (waiting == 0) return found;
    node = stack[--waiting];
  }
}

/* Around the sizes at which the sort changes its way. FAST, a leaf each: leaves stand by Morton code, then index. */
static void test_leaf_order(void) {
  enum { MOST = 4100 };
  uint32_t *prims = (uint32_t *)xmalloc(MOST * 4);
  trbvh_node *boxes = (trbvh_node *)xmalloc(MOST * sizeof *boxes);
  uint32_t packed, count, kind, i;
  int preset;
  radix x;
  radix_start(&x, MOST);
  for (packed = 0; packed < 2; packed++)
    for (kind = 0; kind < 4; kind++)
      for (count = 0; count <= MOST; count = count == 70 ? 4090 : count + 1)
        for (preset = 0; preset < 3; preset++) {
          trbvh_options o = preset_options(preset);
          trbvh_geometry g;
          walk_info info;
          scene s;
          trbvh bvh;
          trb_build b;
          char why[128] = "";
          if (count > 70 && preset && QUICK_OR(1, kind == 1)) continue;
          packed_refs = packed ? 1u << 24 : 0;
          CONTEXT("%u triangles of kind %u, packed %u, preset %s", count, kind, packed, preset_names[preset]);
          memset(&s, 0, sizeof s);
          memset(&bvh, 0, sizeof bvh);
          if (kind == 0) make_random(&s, count);
          else if (kind == 1) make_not_finite(&s, count);
          else if (kind == 2) make_grid(&s, count);
          else make_random(&s, count);
          for (i = 9; kind == 3 && i < 9 * count; i++) s.positions[i] *= 1 / 8192.0f;   /* only low halves differ */
          g = scene_geometry(&s);
          o.max_leaf = 1;
          CHECK(trbvh_build(&bvh, &g, &o) == TRBVH_OK);
          CHECK_MSG(walk_tree(&bvh, &g, 1, preset >= 2, &info, why, sizeof why), "%s", why);
          if (preset == 0 && bvh.nodes) {
            CHECK(trb_resolve(&b, &g, &o) == TRBVH_OK);
            trb_start_attempt(&b, 0);
            b.grid = trb_make_grid(bvh.nodes[0]);
            for (i = 0; i < count; i++) {
              float v[3][3];
              uint32_t vertex;
              CHECK((trb_prim_box(&b.input, i, &boxes[i], v, &vertex) > 0) == !geometry_skips(&g, i));
              boxes[i].first = geometry_skips(&g, i) ? TRBVH_NONE : i;
            }
            x.refs = boxes;
            find_order(&x, &b, count);
            sort_order(&x);
            CHECK(bvh.ref_count == x.count && bvh.node_count == 2 * x.count);
            CHECK(walk_leaves(&bvh, prims) == x.count && !memcmp(prims, x.order, 4 * x.count));
          }
          trbvh_free(&bvh);
          scene_free(&s);
        }
  packed_refs = 1u << 24;
  radix_stop(&x);
  free(prims);
  free(boxes);
}

// >>treelets
/* What the topology between a node and these leaves costs, their own costs included. */
static double present_cost(const trb_build *b, uint32_t node, const uint32_t leaf[7]) {
  const trbvh_node *n = &b->nodes[node];
  double split, as_leaf;
  uint32_t i;
  for (i = 0; i < 7; i++)
    if (leaf[i] == node) return trb_cost(n->count);
  split = half_area(n) + present_cost(b, n->first, leaf) + present_cost(b, n->first + 1, leaf);
  as_leaf = half_area(n) * b->costs.ratio * trb_count(n->count);
  return trb_count(n->count) <= b->costs.max_leaf && as_leaf < split ? as_leaf : split;
}

/* Which nodes a treelet has, and what its present topology costs, less its leaves' own costs. */
static void test_treelet_of_a_root(void) {
  static trb_treelets t;
  trbvh_node *boxes = (trbvh_node *)xmalloc(BOXES * sizeof *boxes);
  float *memory = (float *)xmalloc(BOXES * 24);
  uint32_t kind, root, i, k, small = 0;
  for (kind = 0; kind < 4; kind++) {
    trb_build b;
    trbvh_geometry g;
    trbvh_options o;
    memset(&o, 0, sizeof o);
    o.max_leaf = kind == 1 ? 16 : 8;
    some_boxes(boxes, BOXES, kind);
    g = geometry_of_boxes(boxes, BOXES, memory);
    build_hierarchy(&b, &g, &o);
    for (root = 0; root < 2 * BOXES; root = root ? root + 1 : 2) {
      uint32_t leaf[7], lane = root % TRB_LANES, largest;
      double want, got, all = 0;
      if (trb_count(b.nodes[root].count) < 7) continue;
      CONTEXT("kind %u, root %u of %u references", kind, root, trb_count(b.nodes[root].count));
      leaf[0] = b.nodes[root].first;
      leaf[1] = leaf[0] + 1;
      for (i = 2; i < 7; i++) {                       /* the largest; of those alike up to three bits, the first */
        uint32_t best = 0, any = 0;
        for (largest = k = 0; k < i; k++) {
          uint32_t bits = trb_bits(trb_area(b.nodes[leaf[k]])) >> 3;
          if (trb_count(b.nodes[leaf[k]].count) == 1 || (any && bits <= best)) continue;
          any = 1;
          best = bits;
          largest = k;
        }
        leaf[i] = b.nodes[leaf[largest]].first + 1;
        leaf[largest] = b.nodes[leaf[largest]].first;
      }
      trb_start_treelet(b.nodes, &t, lane, root);
      for (i = 1; i < 6; i++) trb_expand_largest(b.nodes, &t, lane, i);
      for (i = 0; i < 7; i++) trb_enter_leaf(b.nodes, &t, lane, i);
      for (i = 0; i < 7; i++) CHECK_MSG((uint32_t)t.slot[i][lane] == leaf[i], "leaf %u is another node", i);
      want = present_cost(&b, root, leaf);
      for (i = 0; i < 7; i++) all += trb_cost(b.nodes[leaf[i]].count);
      got = t.cost[lane] + all;
      CHECK_MSG(fabs(got - want) <= 3e-5 * want, "cost %.9g, not %.9g", got, want);
      small += trb_count(b.nodes[root].count) <= o.max_leaf;
    }
    end_build(&b);
  }
  CHECK_MSG(small > 100, "%u small roots", small);
  free(boxes);
  free(memory);
}

// >>the rounds against the rule
/* One round, said as the rule says it: a root once, after both its children's subtrees. */
static void naive_round(trbvh_node *nodes, uint32_t root, uint32_t smallest, trb_costs costs, trb_treelets *t) {
  if (trb_count(nodes[root].count) < smallest) return;
  naive_round(nodes, nodes[root].first, smallest, costs, t);
  naive_round(nodes, nodes[root].first + 1, smallest, costs, t);
  trb_restructure(nodes, t, &root, 1, costs);
}

/* All rounds: those of the top, nodes of more than 1,024 references, come first; then those of each subtree of at most
 * 16,384, all of them for one before the next. */
static void naive_subtrees(trbvh_node *nodes, uint32_t node, int rounds, trb_costs costs, trb_treelets *t) {
  int r;
  if (trb_count(nodes[node].count) > 16384) {
    naive_subtrees(nodes, nodes[node].first, rounds, costs, t);
    naive_subtrees(nodes, nodes[node].first + 1, rounds, costs, t);
    return;
  }
  for (r = 0; r < rounds && r < 12; r++) naive_round(nodes, node, 7u << r, costs, t);
}
static void naive_rounds(trbvh_node *nodes, int rounds, trb_costs costs, trb_treelets *t) {
  int r;
  for (r = 0; r < rounds; r++) naive_round(nodes, 0, 1025, costs, t);
  naive_subtrees(nodes, 0, rounds, costs, t);
}

/* What a small node says that it costs is what its children make of it. */
static int costs_are_right(const trbvh_node *nodes, uint32_t node, trb_costs costs) {
  const trbvh_node *n = &nodes[node];
  trbvh_node want;
  if (trb_count(n->count) == 1) return 1;
  want = trb_parent(nodes[n->first], nodes[n->first + 1], n->first, costs);
  return !memcmp(&want, n, sizeof want) && costs_are_right(nodes, n->first, costs) &&
         costs_are_right(nodes, n->first + 1, costs);
}

/* References below a node, sorted, each once. */
static uint32_t prims_below(const trbvh_node *nodes, uint32_t node, uint32_t *prims, uint32_t count) {
  uint32_t i, at;
  if (trb_count(nodes[node].count) > 1)
    return prims_below(nodes, nodes[node].first + 1, prims, prims_below(nodes, nodes[node].first, prims, count));
  for (at = 0; at < count && prims[at] < nodes[node].first; at++) {}
  if (at < count && prims[at] == nodes[node].first) return count;
  for (i = count; i > at; i--) prims[i] = prims[i - 1];
  prims[at] = nodes[node].first;
  return count + 1;
}

/* The result is these nodes, topmost ones that are better as leaves made leaves. */
static int same_result(const trbvh_node *nodes, uint32_t i, const trbvh *bvh, uint32_t k) {
  const trbvh_node *a = &nodes[i], *b = &bvh->nodes[k];
  if (memcmp(a->min, b->min, 12) || memcmp(a->max, b->max, 12)) return 0;
  if (trb_is_leaf(a->count)) {
    uint32_t want[TRB_MAX_LEAF + 1], got[TRB_MAX_LEAF + 1], count, n, at;
    trbvh_node single;
    count = prims_below(nodes, i, want, 0);
    if (b->count != count) return 0;
    memset(&single, 0, sizeof single);
    single.count = 1;
    for (n = at = 0; n < count; n++) {
      single.first = bvh->prims[b->first + n];
      at = prims_below(&single, 0, got, at);
    }
    return at == count && !memcmp(want, got, 4 * count);
  }
  return b->count == 0 && same_result(nodes, a->first, bvh, b->first) &&
         same_result(nodes, a->first + 1, bvh, b->first + 1);
}

/* All rounds of a build, before anything is made of the nodes. */
static void all_rounds(trb_build *b) {
  const trb_collapser c = trb_start_collapse(b);
  const uint32_t rounds = (uint32_t)b->options.treelet_rounds;
  uint32_t groups, i;
  trb_restructure_top(b->nodes, c.words, rounds, b->costs);
  b->task_count = trb_find_tasks(&c, NULL, b->tasks, &b->sah);
  groups = trb_find_groups(b->tasks, b->task_count, b->groups);
  CHECK(groups <= TRB_GROUPS_MAX(b->ref_count) && b->task_count <= TRB_TASKS_MAX(b->ref_count));
  for (i = groups; i > 0; i--) trb_restructure_group(&c, b->tasks, b->groups[i - 1], TRB_TREELET, rounds);
}

/* Leaves of a tree with splits know references; the result has their primitives. */
static void name_prims(const trb_build *b, trbvh_node *nodes) {
  uint32_t i;
  for (i = 0; b->refs && i < 2 * b->ref_count; i++)
    if (i != 1 && trb_is_single(nodes[i].count)) nodes[i].first = b->refs[nodes[i].first].first;
}

static int same_subtree(const trbvh_node *a, uint32_t i, const trbvh_node *b, uint32_t k) {
  if (memcmp(a[i].min, b[k].min, 12) || memcmp(a[i].max, b[k].max, 12) || a[i].count != b[k].count) return 0;
  if (trb_count(a[i].count) == 1) return a[i].first == b[k].first;
  return same_subtree(a, a[i].first, b, b[k].first) && same_subtree(a, a[i].first + 1, b, b[k].first + 1);
}

static void test_rounds(void) {
  static const int rounds[] = {-1, 1, 3, 6, 11};
  static TRB_ALIGNED(trb_treelets) t;
  trbvh_node *boxes = (trbvh_node *)xmalloc(BOXES * sizeof *boxes);
  trbvh_node *nodes = (trbvh_node *)xmalloc(4 * BOXES * sizeof *nodes);
  float *memory = (float *)xmalloc(BOXES * 36);
  uint32_t kind, i, count;
  for (kind = 0; kind < 4 + 2 * HOLES; kind++)
    for (i = 0; i < sizeof rounds / sizeof rounds[0]; i++) {
      trbvh bvh;
      trb_build b;
      trbvh_geometry g;
      trbvh_options o;
      if (kind >= 4 && rounds[i] != 3 && rounds[i] > 0) continue;
      count = kind == 2 ? 1000 + i : BOXES;
      CONTEXT("kind %u, %d rounds", kind, rounds[i]);
      memset(&bvh, 0, sizeof bvh);
      memset(&o, 0, sizeof o);
      o.treelet_rounds = rounds[i];
      o.treelet_gamma = TRB_TREELET;
      o.reinsert_share = -1;
      if (kind < 4 + HOLES) {
        some_boxes(boxes, count, kind < 4 ? kind + (kind == 3) : 0);    /* not so deep that the bound changes trees */
        if (kind >= 4) make_holes(boxes, count, kind - 4);
        g = geometry_of_boxes(boxes, count, memory);
      } else {
        some_triangles(memory, count, kind - 4 - HOLES);
        g = geometry_of_soup(memory, count);
        o.split_budget = 0.5f;
      }
      build_hierarchy(&b, &g, &o);
      memcpy(nodes, b.nodes, 2 * b.ref_max * sizeof *nodes);
      naive_rounds(nodes, b.options.treelet_rounds, b.costs, &t);
      CHECK(costs_are_right(nodes, 0, b.costs));
      all_rounds(&b);
      CHECK(same_subtree(b.nodes, 0, nodes, 0));
      name_prims(&b, nodes);
      end_build(&b);
      CHECK(trbvh_build(&bvh, &g, &o) == TRBVH_OK);
      CHECK(same_result(nodes, 0, &bvh, 0));
      trbvh_free(&bvh);
    }
  free(boxes);
  free(nodes);
  free(memory);
}

// >>the guessed grid
/* Bounds of all positions are the triangles' or they are not: the tree is that of the same triangles without indices. */
static void test_guessed_grid(void) {
  enum { SIDE = 130, COUNT = 2 * (SIDE - 1) * (SIDE - 1), POSITIONS = SIDE * SIDE + 1 };     /* the last is not used */
  const size_t bytes = (size_t)POSITIONS * 20;
  char *positions = (char *)xmalloc(bytes);
  uint32_t *indices = (uint32_t *)xmalloc((size_t)COUNT * 3 * sizeof *indices), kind, i, at = 0;
  float *soup = (float *)xmalloc((size_t)COUNT * 36), bad = 0;
  memset(positions, 0, bytes);
  for (i = 0; i < COUNT / 2; i++) {
    const uint32_t v = i / (SIDE - 1) * SIDE + i % (SIDE - 1);
    indices[at++] = v;        indices[at++] = v + 1;    indices[at++] = v + SIDE;
    indices[at++] = v + SIDE; indices[at++] = v + 1;    indices[at++] = v + SIDE + 1;
  }
  for (kind = 0; kind < 6; kind++) {
    trb_build b;
    trbvh_geometry g, plain;
    trbvh indexed, want;
    rng r = {11};
    CONTEXT("kind %u", kind);
    memset(&indexed, 0, sizeof indexed);
    memset(&want, 0, sizeof want);
    memset(&g, 0, sizeof g);
    for (i = 0; i < POSITIONS; i++) {
      const float p[3] = {(float)(i % SIDE), rng_range(&r, -3, 3), (float)(i / SIDE) * (i == POSITIONS - 1 ? 0.5f : 1)};
      memcpy(positions + 20 * (size_t)i, p, 12);
    }
    if (kind == 1) bad = -3.1f;
    if (kind == 2) bad = 1e30f;
    if (kind == 3) bad = trb_float(0x7FC00000u);
    if (kind == 4) bad = trb_float(0xFF800000u);
    if (kind > 0 && kind < 5) memcpy(positions + 20 * (size_t)(POSITIONS - 1) + 4, &bad, 4);
    if (kind == 5) memcpy(positions + 20 * 700, &bad, 4);                /* infinite, and used */
    for (i = 0; i < COUNT * 3; i++) memcpy(soup + 3 * i, positions + 20 * (size_t)indices[i], 12);
    g.positions = (const float *)(const void *)positions;
    g.position_stride = 20;
    g.position_count = POSITIONS;
    g.indices = indices;
    g.count = COUNT;
    begin_build(&b, &g, NULL);
    CHECK(trb_read(&b) == TRBVH_OK);
    CHECK_MSG(b.guessed == (kind == 0 || kind == 3), "%d", b.guessed);   /* a NaN is not seen */
    end_build(&b);
    plain = geometry_of_soup(soup, COUNT);
    CHECK(trbvh_build(&indexed, &g, NULL) == TRBVH_OK && trbvh_build(&want, &plain, NULL) == TRBVH_OK);
    CHECK(indexed.node_count == want.node_count && indexed.ref_count == want.ref_count);
    CHECK(indexed.node_count == want.node_count &&
          !memcmp(indexed.nodes, want.nodes, want.node_count * sizeof *want.nodes));
    CHECK(indexed.ref_count == want.ref_count && !memcmp(indexed.prims, want.prims, 4 * (size_t)want.ref_count));
    trbvh_free(&indexed);
    trbvh_free(&want);
  }
  free(positions);
  free(indices);
  free(soup);
}

// >>final trees
/* A tree that is final as it is made, and the same one settled afterwards. */
static void test_final_trees(void) {
  static const uint32_t counts[] = {1, 2, 3, 9, 64, 1000, TRB_BLOCK - 1, TRB_BLOCK, TRB_BLOCK + 1, 2 * TRB_BLOCK + 3,
                                    QUICK_OR(3, 9) * TRB_BLOCK + 77};
  static const uint32_t leaves[] = {1, 3, 8, 16};
  const uint32_t most = counts[sizeof counts / sizeof counts[0] - 1];
  trbvh_node *boxes = (trbvh_node *)xmalloc(most * sizeof *boxes);
  float *memory = (float *)xmalloc((size_t)most * 24);
  uint32_t c, kind, k;
  for (c = 0; c < sizeof counts / sizeof counts[0]; c++)
    for (kind = 0; kind < 4 + HOLES; kind++)
      for (k = 0; k < 4; k++) {
        const uint32_t n = counts[c];
        trbvh_options o;
        trbvh_geometry g;
        trbvh_stats stats;
        trb_build b;
        trbvh want, got;
        if (n > TRB_BLOCK && (k + kind + c) % 4) continue;
        CONTEXT("%u boxes, kind %u, leaves of %u", n, kind, leaves[k]);
        memset(&want, 0, sizeof want);
        memset(&got, 0, sizeof got);
        memset(&o, 0, sizeof o);
        o.quality = TRBVH_QUALITY_FAST;
        o.max_leaf = leaves[k];
        some_boxes(boxes, n, kind < 4 ? kind : 0);
        if (kind >= 4) make_holes(boxes, n, kind - 4);
        g = geometry_of_boxes(boxes, n, memory);
        o.stats = &stats;
        CHECK(trbvh_build(&got, &g, &o) == TRBVH_OK);
        o.stats = NULL;
        begin_build(&b, &g, &o);
        CHECK(b.final && trb_read(&b) == TRBVH_OK);
        CHECK(stats.ref_count == b.ref_count);
        if (b.ref_count) {
          b.final = 0;
          CHECK(!trb_make_keys(&b) && trb_sort_keys(&b) == TRBVH_OK && trb_build_hierarchy(&b) == TRBVH_OK);
          trb_start_phase(&b, 0);
          CHECK(trb_restructure_and_settle(&b) == TRBVH_OK && trb_emit(&b, &want) == TRBVH_OK);
          trb_hand_over(&b, &want, n);
          CHECK(want.node_count == got.node_count && want.ref_count == got.ref_count);
          CHECK(want.node_count == got.node_count && !memcmp(want.nodes, got.nodes, want.node_count * sizeof *want.nodes));
          CHECK(want.ref_count == got.ref_count && !memcmp(want.prims, got.prims, 4 * (size_t)want.ref_count));
          CHECK_MSG(stats.max_depth == b.stats.max_depth && fabs(stats.sah_cost - b.stats.sah_cost) <= 1e-6 * b.stats.sah_cost,
                    "depth %u and %u, SAH %g and %g", stats.max_depth, b.stats.max_depth, stats.sah_cost, b.stats.sah_cost);
        }
        end_build(&b);
        trbvh_free(&want);
        trbvh_free(&got);
      }
  free(boxes);
  free(memory);
}

// >>the depth bound
/* A tree over boxes first..first + count - 1, its pairs at any places: shape 0 a chain to the left, 1 one to the right,
 * 2 random. */
typedef struct grower {
  trbvh_node       *nodes;
  const trbvh_node *boxes;
  const uint32_t   *pairs;
  uint32_t          used;
  trb_costs         costs;
  rng               r;
} grower;
static void grow(grower *w, uint32_t node, uint32_t first, uint32_t count, uint32_t shape) {
  uint32_t pair, left;
  if (count == 1) {
    trbvh_node box = w->boxes[first];
    box.first = first;
    w->nodes[node] = trb_reference(box, w->costs);
    return;
  }
  pair = 2 * w->pairs[w->used++];
  left = shape == 0 ? count - 1 : shape == 1 ? 1 : 1 + rng_below(&w->r, count - 1);
  grow(w, pair, first, left, shape);
  grow(w, pair + 1, first + left, count - left, shape);
  w->nodes[node] = trb_parent(w->nodes[pair], w->nodes[pair + 1], pair, w->costs);
}

static uint32_t depth_below(const trbvh_node *nodes, uint32_t node) {
  uint32_t left, right;
  if (trb_count(nodes[node].count) == 1) return 0;
  left = depth_below(nodes, nodes[node].first);
  right = depth_below(nodes, nodes[node].first + 1);
  return 1 + TRB_MAX(left, right);
}
static uint32_t pairs_below(const trbvh_node *nodes, uint32_t node, unsigned char *used) {
  if (trb_count(nodes[node].count) == 1) return 0;
  used[nodes[node].first / 2]++;
  return 1 + pairs_below(nodes, nodes[node].first, used) + pairs_below(nodes, nodes[node].first + 1, used);
}
static int refs_in_order(const trbvh_node *nodes, uint32_t node, const trbvh_node *boxes, uint32_t first,
                         trb_costs costs) {
  const trbvh_node *n = &nodes[node];
  if (trb_count(n->count) == 1) {
    trbvh_node want = boxes[first];
    want.first = first;
    want = trb_reference(want, costs);
    return !memcmp(&want, n, sizeof want);
  }
  return refs_in_order(nodes, n->first, boxes, first, costs) &&
         refs_in_order(nodes, n->first + 1, boxes, first + trb_count(nodes[n->first].count), costs);
}

/* A balanced tree of the same references in the same order, in the same places; nothing else is touched. */
static void test_balance(void) {
  enum { MOST = 5000 };
  trbvh_node *boxes = (trbvh_node *)xmalloc(MOST * sizeof *boxes);
  trbvh_node *nodes = (trbvh_node *)xmalloc(2 * MOST * sizeof *nodes);
  trbvh_node *before = (trbvh_node *)xmalloc(2 * MOST * sizeof *nodes);
  uint32_t *pairs = (uint32_t *)xmalloc(MOST * 4), round, i, shape;
  trb_u64 *low = (trb_u64 *)xmalloc(MOST * 8), *high = (trb_u64 *)xmalloc(MOST * 8);
  unsigned char *used = (unsigned char *)xmalloc(MOST), *used_before = (unsigned char *)xmalloc(MOST);
  rng r = {10};
  some_boxes(boxes, MOST, 0);
  for (round = 0; round < QUICK_OR(60, 300); round++)
    for (shape = 0; shape < 3; shape++) {
      const uint32_t count = round < 60 ? 2 + round : 2 + rng_below(&r, MOST - 2);
      uint32_t root = 0, first = 0, n, depth = 0;
      trb_collapser c;
      grower w;
      memset(&c, 0, sizeof c);
      for (i = 0; i + 1 < count; i++) {
        uint32_t j = rng_below(&r, i + 1);
        pairs[i] = pairs[j];
        pairs[j] = i + 1;
      }
      w.nodes = nodes;
      w.boxes = boxes;
      w.pairs = pairs;
      w.used = 0;
      w.r = r;
      w.costs = c.costs = costs_of(1 / 1.2f, round % 2 ? 8 : 1);
      memset(nodes, 0, 2 * count * sizeof *nodes);
      grow(&w, 0, 0, count, shape);
      for (i = rng_below(&r, 6); i > 0; i--) {        /* of the root, or of a node below it */
        const uint32_t left = nodes[root].first, side = rng_below(&r, 2);
        if (trb_count(nodes[left + side].count) < 2) continue;
        if (side) first += trb_count(nodes[left].count);
        root = left + side;
      }
      c.nodes = nodes;
      c.words = trb_split_words(low, high, count);
      memset(low, 0xAA, count * 8);
      memset(high, 0xAA, count * 8);
      memset(used, 0, count);
      memset(used_before, 0, count);
      memcpy(before, nodes, 2 * count * sizeof *nodes);
      n = trb_count(nodes[root].count);
      CONTEXT("%u references of %u, shape %u", n, count, shape);
      pairs_below(nodes, root, used_before);
      trb_balance(&c, root, first);
      while (1u << depth < n) depth++;
      CHECK(trb_count(nodes[root].count) == n && depth_below(nodes, root) == depth);
      CHECK(pairs_below(nodes, root, used) == n - 1 && !memcmp(used, used_before, count));
      CHECK(refs_in_order(nodes, root, boxes, first, c.costs) && costs_are_right(nodes, root, c.costs));
      for (i = 2; i < 2 * count; i++)
        CHECK(used[i / 2] || i == root || !memcmp(&nodes[i], &before[i], sizeof *nodes));
      for (i = 0; i < count; i++) {                   /* nor words of other references */
        const uint32_t *plane = (const uint32_t *)low;
        if (i >= first && i < first + n) continue;
        CHECK(plane[i] == 0xAAAAAAAAu && plane[count + i] == 0xAAAAAAAAu);
        plane = (const uint32_t *)high;
        CHECK(plane[i] == 0xAAAAAAAAu && plane[count + i] == 0xAAAAAAAAu);
      }
    }
  free(boxes); free(nodes); free(before); free(pairs); free(low); free(high); free(used); free(used_before);
}

/* A tree that no build makes: each node a reference and all the rest. It must come out within the bound, whole. */
static void test_depth_bound(void) {
  static const uint32_t counts[] = {50, 66, 67, 100, 1000, BOXES};
  trbvh_node *boxes = (trbvh_node *)xmalloc(BOXES * sizeof *boxes);
  float *memory = (float *)xmalloc(BOXES * 24);
  uint32_t c, i, left, hollow, rounds;
  for (hollow = 0; hollow < 2; hollow++)
    for (c = 0; c < 6; c++)
      for (left = 0; left < 2; left++)
        for (rounds = 0; rounds < 4; rounds += 3) {
          const uint32_t n = counts[c];
          trbvh_options o;
          trbvh_geometry g;
          trb_build b;
          trbvh bvh;
          walk_info info;
          char why[256];
          CONTEXT("a chain of %u, left %u, %u rounds", n, left, rounds);
          memset(&bvh, 0, sizeof bvh);
          memset(&o, 0, sizeof o);
          o.max_leaf = hollow ? 1 : 8;
          o.treelet_rounds = rounds ? (int32_t)rounds : -1;
          some_boxes(boxes, n, 0);
          g = geometry_of_boxes(boxes, n, memory);
          build_hierarchy(&b, &g, &o);
          for (i = 0; i < n; i++) {
            boxes[i].first = i;
            boxes[i] = trb_reference(boxes[i], b.costs);
          }
          for (i = n - 1; i > 0; i--) {               /* pair i holds reference i - 1 and what follows */
            trbvh_node rest = i == n - 1 ? boxes[n - 1]
                                         : trb_parent(b.nodes[2 * i + 2], b.nodes[2 * i + 3], 2 * i + 2, b.costs);
            b.nodes[2 * i + left] = boxes[i - 1];
            b.nodes[2 * i + 1 - left] = rest;
          }
          b.nodes[0] = trb_parent(b.nodes[2], b.nodes[3], 2, b.costs);
          for (i = 0; i < trb_phases(&b); i++) CHECK(trb_run_phase(&b, i) == TRBVH_OK);
          CHECK(trb_emit(&b, &bvh) == TRBVH_OK && trb_finish(&b) == TRBVH_OK);
          trb_hand_over(&b, &bvh, n);
          CHECK_MSG(trbvh_validate(&bvh, &g, why, sizeof why) == TRBVH_OK, "%s", why);
          CHECK_MSG(walk_tree(&bvh, &g, o.max_leaf, 0, &info, why, sizeof why), "%s", why);
          CHECK(bvh.ref_count == n && info.depth == b.stats.max_depth);
          CHECK_MSG(b.stats.max_depth <= TRBVH_MAX_DEPTH, "depth %u", b.stats.max_depth);
          if (n == 50 && hollow && !rounds)
            CHECK_MSG(b.stats.max_depth == 49, "depth %u: nothing was to be mended", b.stats.max_depth);
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
/* The most important plane that crosses a box, found by halving the scene; of equal ones that across the longest side. */
static void test_median_plane(void) {
  rng r = {11};
  trbvh_node bounds = {{0, 0, 0}, 0, {1024, 1024, 1024}, 0};
  const trb_grid grid = trb_make_grid(bounds);
  uint32_t i, ties = 0;
  for (i = 0; i < 20000; i++) {
    trbvh_node box;
    trb_plane plane;
    int level, k, found = 0, axis = 0;
    float longest = 0;
    double position = 0;
    for (k = 0; k < 3; k++) {
      const float size = i % 3 == 0 ? (float)(1u << rng_below(&r, 9)) : 300 * rng_unit(&r);
      box.min[k] = i % 3 == 1 ? 0.37f + (float)rng_below(&r, 700) : 700 * rng_unit(&r);
      box.max[k] = box.min[k] + size;
    }
    for (level = 1; level <= 12 && !found; level++) {
      const double side = 1024.0 / (double)(1u << level);    /* between planes of this level, and those above */
      for (k = 0; k < 3; k++) {
        const double at = side * floor((double)box.max[k] / side);
        const float length = box.max[k] - box.min[k];
        if (at <= box.min[k]) continue;
        ties += found > 0;
        if (!found || length > longest) { axis = k; position = at; longest = length; }
        found = level;
      }
    }
    plane = trb_median_plane(box, grid);
    if (!found) continue;
    CHECK_MSG(plane.level == -found && plane.axis == axis && fabs(plane.position - position) < 1e-2,
              "level %d, axis %d at %g, not %d, %d at %g", plane.level, plane.axis, (double)plane.position, -found, axis, position);
  }
  CHECK(ties > 1000);
}

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
    trb_u64 sum = 0, slots;
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
    for (i = 0, slots = 0; i < b.block_count; i++) slots += b.blocks[i].slots;
    CHECK_MSG(slots == COUNT + sum && slots <= b.ref_max, "%u slots", (unsigned)slots);
    CHECK(b.ref_count <= slots && b.ref_count > COUNT + b.split_max * 8 / 10);
    end_build(&b);
  }
  free(soup);
}

// >>moves
/* The sum of the inner nodes' half areas below `node`, and its box, as if `gone` were taken out and `target` had it as a
 * sibling; TRBVH_NONE for neither. All in double. */
typedef struct double_box { double min[3], max[3]; } double_box;
static double_box join_boxes(double_box a, double_box b) {
  int k;
  for (k = 0; k < 3; k++) {
    if (b.min[k] < a.min[k]) a.min[k] = b.min[k];
    if (b.max[k] > a.max[k]) a.max[k] = b.max[k];
  }
  return a;
}
static double box_area(double_box b) {
  const double x = b.max[0] - b.min[0], y = b.max[1] - b.min[1], z = b.max[2] - b.min[2];
  return x * y + z * (x + y);
}
static double_box box_of(const trbvh_node *n) {
  double_box b;
  int k;
  for (k = 0; k < 3; k++) { b.min[k] = n->min[k]; b.max[k] = n->max[k]; }
  return b;
}
static double area_after(const trbvh_node *nodes, uint32_t node, uint32_t gone, uint32_t target, double_box *box) {
  const trbvh_node *n = &nodes[node];
  double sum = 0;
  if (trb_count(n->count) == 1) {
    *box = box_of(n);
  } else if (gone != TRBVH_NONE && n->first == (gone & ~1u)) {
    sum = area_after(nodes, gone ^ 1u, gone, target, box);           /* the parent vanishes */
  } else {
    double_box right;
    sum = area_after(nodes, n->first, gone, target, box) + area_after(nodes, n->first + 1, gone, target, &right);
    *box = join_boxes(*box, right);
    sum += box_area(*box);
  }
  if (node == target) {
    *box = join_boxes(*box, box_of(&nodes[gone]));
    sum += box_area(*box);
  }
  return sum;
}
static int is_below(const trb_mover *m, uint32_t node, uint32_t above) {
  while (node != above && node) node = m->parents[node / 2];
  return node == above;
}
/* Nothing below a node that is better as a leaf is a place to go to. */
static int is_a_place(const trb_mover *m, uint32_t target, uint32_t node) {
  const uint32_t parent = m->parents[node / 2];
  uint32_t at = target;
  if (target < 2 || target == parent || target == (node ^ 1u) || is_below(m, target, node)) return 0;
  while (at) {
    at = m->parents[at / 2];
    if (trb_is_leaf(m->nodes[at].count) && !is_below(m, node, at)) return 0;
  }
  return 1;
}
static trb_mover start_moving(trb_build *b) {
  const trb_mover m = trb_build_mover(b);
  uint32_t pair;
  m.parents[0] = m.parents[b->nodes[0].first / 2] = 0;
  for (pair = 1; pair < b->ref_count; pair++) trb_score_pair(&m, pair);
  return m;
}

/* The place that is found has the gain that it says, and no other one is better: all are tried. */
static void test_places(void) {
  trbvh_node boxes[40];
  float memory[40 * 6];
  uint32_t kind, n, leaf, node, target, places = 0;
  for (kind = 0; kind < 5; kind++)
    for (n = 3; n <= 40; n += kind == 0 ? 1 : 7)
      for (leaf = 1; leaf <= 8; leaf += 7) {
        trbvh_options o;
        trbvh_geometry g;
        trb_build b;
        trb_mover m;
        double before, inside;
        double_box box;
        CONTEXT("%u boxes of kind %u, leaves of %u", n, kind, leaf);
        memset(&o, 0, sizeof o);
        o.max_leaf = leaf;
        some_boxes(boxes, n, kind);
        g = geometry_of_boxes(boxes, n, memory);
        build_hierarchy(&b, &g, &o);
        m = start_moving(&b);
        before = area_after(b.nodes, 0, TRBVH_NONE, TRBVH_NONE, &box);
        for (node = 2; node < 2 * n; node++) {
          const double unit = 1e-5 * before + 1e-30;
          double best = 0;
          trb_move move;
          if (m.parents[node / 2] == 0) continue;
          inside = area_after(b.nodes, node, TRBVH_NONE, TRBVH_NONE, &box);
          for (target = 2; target < 2 * n; target++) {
            double gain;
            if (!is_a_place(&m, target, node)) continue;
            gain = before - inside - area_after(b.nodes, 0, node, target, &box);
            best = TRB_MAX(gain, best);
          }
          move = trb_find_place(&m, node, 1e-30f);
          CHECK_MSG(move.gain >= best - unit, "node %u: gains %g, %g is possible", node, (double)move.gain, best);
          if (!(move.gain > 0)) continue;
          places++;
          CHECK_MSG(is_a_place(&m, move.target, node), "node %u cannot go to %u", node, move.target);
          CHECK_MSG(is_below(&m, node, move.above) && is_below(&m, move.target, move.above), "%u is not above", move.above);
          best = before - inside - area_after(b.nodes, 0, node, move.target, &box);
          CHECK_MSG(fabs(best - move.gain) <= unit, "node %u: gains %g, not %g", node, best, (double)move.gain);
        }
        end_build(&b);
      }
  CHECK_MSG(places > 500, "only %u moves", places);
}

/* After reinsertion and unsplitting: a tree, all of whose nodes are what their children make them; every primitive in
 * it; no pair left with an owner; and less area. */
static uint32_t check_moved(const trb_build *b, uint32_t node, unsigned char *prims) {
  const trbvh_node *n = &b->nodes[node];
  trbvh_node made;
  uint32_t count;
  if (trb_is_single(n->count)) {
    const uint32_t prim = b->refs ? b->refs[n->first].first : n->first;
    if (b->refs) CHECK_MSG(b->refs[n->first].count != TRBVH_NONE, "reference %u was taken away", n->first);
    prims[prim] = 1;
    return 1;
  }
  count = check_moved(b, n->first, prims) + check_moved(b, n->first + 1, prims);
  made = trb_parent(b->nodes[n->first], b->nodes[n->first + 1], n->first, b->costs);
  CHECK_MSG(!memcmp(&made, n, sizeof made), "node %u is not what its children make it", node);
  return count;
}
static double tree_cost(const trb_build *b, uint32_t node) {
  const trbvh_node *n = &b->nodes[node];
  double cost = 0;
  uint32_t side;
  if (trb_is_single(n->count)) return 0;
  for (side = 0; side < 2; side++) {
    const trbvh_node *child = &b->nodes[n->first + side];
    if (trb_is_leaf(child->count) && !trb_is_leaf(n->count))
      cost += 0.5 * (double)b->costs.ratio * (double)trb_area(*child) * trb_count(child->count);
    cost += tree_cost(b, n->first + side);
  }
  return trb_is_leaf(n->count) ? cost : cost + (double)trb_area(*n);
}

static void test_moved_trees(void) {
  trbvh_node *boxes = (trbvh_node *)xmalloc(BOXES * sizeof *boxes);
  float *memory = (float *)xmalloc(BOXES * 36);
  unsigned char *prims = (unsigned char *)xmalloc(BOXES);
  uint32_t kind, i, n, passed;
  for (kind = 0; kind < 10; kind++) {
    trbvh_options o;
    trbvh_geometry g;
    trb_build b;
    double before, after, cost;
    double_box box;
    CONTEXT("kind %u", kind);
    memset(&o, 0, sizeof o);
    o.quality = TRBVH_QUALITY_HIGH;
    o.reinsert_share = 0.25f;
    n = kind < 5 ? BOXES : BOXES / 3;
    if (kind < 5) {
      some_boxes(boxes, n, kind);
      g = geometry_of_boxes(boxes, n, memory);
    } else {
      some_triangles(memory, n, 0);
      for (i = 0; i < 9 * n; i++)                    /* long ones, whose splits do not all pay */
        if (i % 9 >= 6) memory[i] += (i % 9 == 5 + (kind - 4) % 3) * 0.3f;
      g = geometry_of_soup(memory, n);
      o.split_budget = 0.1f * (float)(kind - 4);
    }
    build_hierarchy(&b, &g, &o);
    b.runner.options = &b.options;
    before = area_after(b.nodes, 0, TRBVH_NONE, TRBVH_NONE, &box);
    CHECK(!trb_unsplit(&b, 2));
    for (i = 0, passed = 0; b.refs && i < b.slot_count; i++)
      passed += b.refs[i].first != TRBVH_NONE && b.refs[i].count == TRBVH_NONE;
    if (b.refs) CHECK_MSG(passed > 0, "all splits pay");
    CHECK(!trb_reinsert_candidates(&b));
    memset(prims, 0, n);
    CHECK_MSG(check_moved(&b, 0, prims) == b.ref_count - passed, "%u references, %u taken back", b.ref_count, passed);
    CHECK(trb_count(b.nodes[0].count) == b.ref_count - passed);
    for (i = 0; i < n; i++) CHECK_MSG(prims[i], "primitive %u is lost", i);
    for (i = 0; i < b.ref_count; i++) CHECK_MSG(trb_build_mover(&b).owners[i] == TRBVH_NONE, "pair %u is owned", i);
    CHECK(!trb_sum_costs(&b, &cost));
    cost /= (double)trb_cost_unit(b.nodes[0], b.costs);
    CHECK_MSG(fabs(cost - tree_cost(&b, 0)) <= 1e-5 * cost, "cost %g, not %g", cost, tree_cost(&b, 0));
    after = area_after(b.nodes, 0, TRBVH_NONE, TRBVH_NONE, &box);
    CHECK_MSG(after <= before && (after < before || (kind >= 2 && kind < 5)), "%g before, %g after", before, after);
    end_build(&b);
  }
  free(boxes);
  free(memory);
  free(prims);
}

/* Two subtrees that would each go into the other one: the move that gains more, or the first one, happens alone. And of
 * two moves next to the same target, too. */
static void test_conflicts(void) {
  static const float gains[][2] = {{2, 1}, {1, 2}, {1, 1}};
  static const uint32_t moves[][4] = {{8, 14, 10, 12}, {8, 15, 10, 13}, {12, 10, 9, 11}, {12, 14, 13, 15}};   /* nodes, targets */
  trbvh_node boxes[8];
  float memory[8 * 6];
  unsigned char prims[8];
  uint32_t at, k, i;
  for (at = 0; at < sizeof moves / sizeof moves[0]; at++)
    for (k = 0; k < 3; k++) {
      const uint32_t winner = gains[k][1] > gains[k][0];
      trbvh_options o;
      trbvh_geometry g;
      trb_build b;
      trb_mover m;
      CONTEXT("moves %u, gains %u", at, k);
      memset(&o, 0, sizeof o);
      o.max_leaf = 1;
      some_boxes(boxes, 8, 0);
      g = geometry_of_boxes(boxes, 8, memory);
      build_hierarchy(&b, &g, &o);
      for (i = 0; i < 8; i++) {
        boxes[i].first = i;
        boxes[i] = trb_reference(boxes[i], b.costs);
      }
      for (i = 0; i < 4; i++) b.nodes[12 + i] = boxes[i];              /* below 8 and 10 */
      b.nodes[5] = boxes[4]; b.nodes[7] = boxes[5]; b.nodes[9] = boxes[6]; b.nodes[11] = boxes[7];
      b.nodes[8] = trb_parent(b.nodes[12], b.nodes[13], 12, b.costs);
      b.nodes[10] = trb_parent(b.nodes[14], b.nodes[15], 14, b.costs);
      b.nodes[4] = trb_parent(b.nodes[8], b.nodes[9], 8, b.costs);
      b.nodes[6] = trb_parent(b.nodes[10], b.nodes[11], 10, b.costs);
      b.nodes[2] = trb_parent(b.nodes[4], b.nodes[5], 4, b.costs);
      b.nodes[3] = trb_parent(b.nodes[6], b.nodes[7], 6, b.costs);
      b.nodes[0] = trb_parent(b.nodes[2], b.nodes[3], 2, b.costs);
      m = start_moving(&b);
      memset(m.owners, 0xFF, b.ref_count * sizeof *m.owners);
      for (i = 0; i < 2; i++) {
        m.moves[i].node = moves[at][2 * i];
        m.moves[i].target = moves[at][2 * i + 1];
        m.moves[i].above = 0;
        m.moves[i].gain = gains[k][i];
      }
      trb_choose_moves(&m, 2);
      CHECK_MSG(m.moves[winner].gain == gains[k][winner], "the better one gains %g", (double)m.moves[winner].gain);
      CHECK_MSG(m.moves[!winner].gain == -gains[k][!winner], "the other one gains %g", (double)m.moves[!winner].gain);
      CHECK(m.moves[!winner].node == moves[at][2 * !winner]);
      trb_reinsert(&m, &m.moves[winner]);
      trb_remake_moved(&m, 2);
      memset(prims, 0, 8);
      CHECK(check_moved(&b, 0, prims) == 8);
      for (i = 0; i < 8; i++) CHECK(prims[i]);
      for (i = 0; i < b.ref_count; i++) CHECK(m.owners[i] == TRBVH_NONE);
      end_build(&b);
    }
}

int main(int argc, char **argv) {
  test_start(argc, argv);
  RUN(test_numbers);
  RUN(test_node_words);
  RUN(test_dynamic_program);
  RUN(test_instruction_sets);
  RUN(test_partition);
  RUN(test_hierarchy);
  RUN(test_keys);
  RUN(test_slots_of_splits);
  RUN(test_leaf_order);
  RUN(test_treelet_of_a_root);
  RUN(test_rounds);
  RUN(test_balance);
  RUN(test_guessed_grid);
  RUN(test_final_trees);
  RUN(test_depth_bound);
  RUN(test_fragments);
  RUN(test_median_plane);
  RUN(test_split_budget);
  RUN(test_places);
  RUN(test_moved_trees);
  RUN(test_conflicts);
  return test_finish();
}
