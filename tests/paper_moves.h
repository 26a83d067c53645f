/* Tests of the builders of examples/paper that improve a tree, by rotations (Kensler) and insertion (Bittner). Part of
 * test_paper.c. */
#ifndef TESTS_PAPER_MOVES_H
#define TESTS_PAPER_MOVES_H
#include "paper.h"
#include "../examples/paper/sweep.h"
#include "../examples/paper/kensler.h"
#include "../examples/paper/bittner.h"

// >>trees ---- what the tests know of a tree, by recursion of their own -------------------------------------
static const paper_moves_settings from_sweep = {paper_sweep};

static double area_of(const trbvh_node *a, const trbvh_node *b)   /* half that of the box around both */
{
  double size[3];
  for (int k = 0; k < 3; ++k) {
    double low = a->min[k] < b->min[k] ? a->min[k] : b->min[k];
    size[k] = (a->max[k] > b->max[k] ? a->max[k] : b->max[k]) - low;
  }
  return size[0] * size[1] + size[1] * size[2] + size[2] * size[0];
}
/* The box of what is below, from the leaves up; adds the areas of inner nodes to *cost, and compares boxes
 * and links with what is there, where there are any. Trees here are of few references. */
static trbvh_node weigh(const trbvh_node *nodes, uint32_t slot, double *cost, const paper_mover *m)
{
  trbvh_node n = nodes[slot];
  if (trb_is_single(n.count)) return n;
  trbvh_node l = weigh(nodes, n.first, cost, m), r = weigh(nodes, n.first + 1, cost, m), box = l;
  for (int k = 0; k < 3; ++k) {
    if (r.min[k] < box.min[k]) box.min[k] = r.min[k];
    if (r.max[k] > box.max[k]) box.max[k] = r.max[k];
  }
  *cost += area_of(&box, &box);
  if (m) {
    CHECK_MSG(!memcmp(box.min, n.min, 12) && !memcmp(box.max, n.max, 12), "box of node %u", slot);
    CHECK_MSG(m->parent[n.first / 2] == slot, "%u: %u, not %u", n.first, m->parent[n.first / 2], slot);
  }
  return box;
}
static double cost_of(const trbvh_node *nodes) { double cost = 0; weigh(nodes, 0, &cost, NULL); return cost; }
static void check_mover(const paper_mover *m, double cost)   /* cost: of subtrees that are out of it */
{
  weigh(m->nodes, 0, &cost, m);
  CHECK_MSG(fabs(m->cost - cost) <= 1e-5 * cost, "cost %g, but it is %g", m->cost, cost);   /* from floats */
}
static uint32_t seed;
/* A random tree over the first references that there are, so that moves have much to do. */
static void shuffled(paper_build *p)
{
  uint32_t open = p->ref_count;
  trbvh_node *top = (trbvh_node *)ex_allocate(open, sizeof *top);
  memcpy(top, p->refs, open * sizeof *top);
  while (open > 1) {
    uint32_t i = ex_random_bits(&seed) % open, first = paper_new_pair(p);
    p->nodes[first] = top[i];
    top[i] = top[--open];
    i = ex_random_bits(&seed) % open;
    p->nodes[first + 1] = top[i];
    top[i] = paper_parent(p, first);
  }
  p->nodes[0] = top[0];
  free(top);
}
/* Runs a builder, or a test in its place, over the first triangles of each ordinary scene. */
static void with_few(paper_builder *builder, const void *parameters, uint32_t triangles)
{
  for (size_t i = 0; i < SCENE_COUNT; ++i) {
    scene s;
    if (!(scene_defs[i].flags & SCENE_ORDINARY)) continue;
    scene_make(&s, &scene_defs[i]);
    CONTEXT("scene %s, %u triangles", s.name, triangles);
    trbvh_geometry g = scene_geometry(&s);
    uint32_t from = ex_random_bits(&seed) % (g.count - triangles);
    if (g.indices) g.indices = (const uint32_t *)g.indices + 3 * from;
    else g.positions = (const float *)g.positions + 9 * from, g.position_count -= 3 * from;
    g.count = triangles;
    paper_tree t = paper_test_make(&g, builder, parameters, 0, 0);
    paper_test_tree(&t, &g, 0);
    trbvh_free(&t.bvh);
    scene_free(&s);
  }
  CONTEXT("%s", "");
}

// >>rotations -----------------------------------------------------------------------------------------------
/* How much the cost falls, at the best, by the swap of any two subtrees that hang from the children of the
 * node at slot, or of a child and one of those: all six rotations, twice or more, found without the
 * builder's list of them. */
static double best_swap(trbvh_node *nodes, uint32_t slot)
{
  uint32_t at[6], above[6], count = 0, first = nodes[slot].first;
  double old = cost_of(nodes), best = 0;
  for (uint32_t i = first; i < first + 2; ++i) {
    at[count] = above[count] = i;
    ++count;
    for (uint32_t k = 0; k < 2 && !trb_is_single(nodes[i].count); ++k) {
      at[count] = nodes[i].first + k;
      above[count++] = i;
    }
  }
  for (uint32_t a = 0; a < count; ++a)
    for (uint32_t b = a + 1; b < count; ++b) {
      if (above[a] == above[b]) continue;      /* siblings, or parent and child */
      trbvh_node keep = nodes[at[a]];
      nodes[at[a]] = nodes[at[b]];
      nodes[at[b]] = keep;
      double gain = old - cost_of(nodes);
      nodes[at[b]] = nodes[at[a]];
      nodes[at[a]] = keep;
      if (gain > best) best = gain;
    }
  return best;
}
static uint32_t rotations_seen;
/* Each rotation's gain is what the cost falls by, and the best is the best swap. */
static void rotations_and_look(paper_build *p)
{
  paper_moves_settings start = {shuffled};
  p->parameters = &start;
  paper_mover m = paper_start_moves(p);
  check_mover(&m, 0);
  for (uint32_t slot = 0, n = 0; n < p->pair_end - 1; ++n) {
    slot = paper_next_inner(&m, slot);
    double best = 0, want = best_swap(m.nodes, slot), root = cost_of(m.nodes);
    for (uint32_t i = 0; i < PAPER_ROTATIONS; ++i) {
      paper_rotation r = paper_rotation_below(&m, slot, i);
      double old = cost_of(m.nodes);
      if (!r.a) continue;
      ++rotations_seen;
      if (r.gain > best) best = r.gain;
      paper_rotate(&m, slot, r);
      check_mover(&m, 0);
      double gain = old - cost_of(m.nodes);
      CHECK_MSG(fabs(gain - r.gain) <= 1e-5 * root, "gain %g, is %g", r.gain, gain);
      r.gain = -r.gain;
      paper_rotate(&m, slot, r);       /* and back */
      check_mover(&m, 0);
    }
    CHECK_MSG(fabs(best - want) <= 1e-5 * root, "node %u: best gain %g, by brute force %g", slot, best, want);
    CHECK((slot == 0) == (n == p->pair_end - 2));
  }
  paper_end_moves(&m);
}
static void test_rotations(void)
{
  seed = 1;
  for (uint32_t n = 2; n <= 12; ++n) with_few(rotations_and_look, NULL, n);
  CHECK_MSG(rotations_seen > 1000, "only %u rotations", rotations_seen);
}
static double start_cost;
static void shuffled_and_look(paper_build *p)
{
  shuffled(p);
  start_cost = cost_of(p->nodes);
}
static const paper_moves_settings from_shuffled = {shuffled_and_look};
static void check_top(const paper_build *p)   /* no rotation helps */
{
  for (uint32_t i = 0; i < 2 * p->pair_end; ++i) {
    if (i == 1 || trb_is_single(p->nodes[i].count)) continue;
    /* its own threshold, and that areas are in float */
    double gain = best_swap(p->nodes, i), area = area_of(&p->nodes[i], &p->nodes[i]);
    double least = 1e-5 * area + 1e-6 * cost_of(p->nodes);
    CHECK_MSG(gain <= least, "a rotation at node %u would gain %g", i, gain);
  }
}
static void climb_and_look(paper_build *p)
{
  paper_kensler_climb(p);
  CHECK(cost_of(p->nodes) <= start_cost * (1 + 1e-6));
  check_top(p);
}
static void test_climb_to_the_top(void)
{
  seed = 2;
  for (uint32_t n = 2; n <= 6; ++n)
    for (int i = 0; i < 8; ++i) with_few(climb_and_look, &from_shuffled, n);
  with_few(climb_and_look, &from_shuffled, 100);
}
static double climbed_cost;
static void climb_and_note(paper_build *p) { paper_kensler_climb(p); climbed_cost = cost_of(p->nodes); }
static uint32_t anneals, anneals_better;
static void anneal_and_look(paper_build *p)
{
  paper_kensler_anneal(p);
  double cost = cost_of(p->nodes);
  CHECK_MSG(cost <= climbed_cost * (1 + 1e-6), "%g, by hill climbing %g", cost, climbed_cost);
  check_top(p);
  ++anneals;
  anneals_better += cost < 0.999 * climbed_cost;
}
static void anneal_after_climb(paper_build *p)   /* from the same tree */
{
  uint32_t here = seed;
  climb_and_note(p);
  seed = here;
  p->pair_end = 1;
  p->parameters = &from_shuffled;
  anneal_and_look(p);
}
static void test_anneal_is_no_worse(void)
{
  seed = 3;
  for (uint32_t n = 2; n <= 200; n += n / 4 + 1) with_few(anneal_after_climb, &from_shuffled, n);
  CHECK_MSG(2 * anneals_better > anneals, "%u of %u are better", anneals_better, anneals);
}

// >>insertion -----------------------------------------------------------------------------------------------
static double insertion_cost(const paper_mover *m, uint32_t slot, const trbvh_node *node)
{
  double cost = area_of(&m->nodes[slot], node);
  while (slot) {
    slot = m->parent[slot / 2];
    cost += area_of(&m->nodes[slot], node) - area_of(&m->nodes[slot], &m->nodes[slot]);
  }
  return cost;
}
static void places_and_look(paper_build *p)
{
  paper_moves_settings start = {ex_random_bits(&seed) & 1 ? shuffled : paper_lbvh};
  p->parameters = &start;
  paper_inserter s = paper_start_insertion(p);
  for (uint32_t i = 2; i < 2 * p->pair_end; ++i) {
    double old = s.m.cost, left, best = DBL_MAX, own = 0;
    trbvh_node node = s.m.nodes[i];
    uint32_t old_place = s.m.parent[i / 2], slot = 0;
    trbvh_node sibling = s.m.nodes[i ^ 1];
    weigh(s.m.nodes, i, &own, NULL);
    paper_take_out(&s.m, i);
    check_mover(&s.m, own);
    left = cost_of(s.m.nodes) + own;
    do {                               /* all places */
      slot = slot ? paper_next(&s.m, slot) : paper_first_below(&s.m, 0);
      double cost = insertion_cost(&s.m, slot, &node);
      if (cost < best) best = cost;
    } while (slot);
    paper_place place = paper_find_place(&s, &node);
    CHECK_MSG(fabs(place.cost - best) <= 1e-5 * (best + left), "cost %g, the least is %g", place.cost, best);
    CHECK_MSG(insertion_cost(&s.m, place.slot, &node) <= best + 1e-5 * (best + left), "not where it says");
    paper_insert(&s.m, node, i & ~1u, place.slot);
    check_mover(&s.m, 0);
    CHECK_MSG(fabs(cost_of(s.m.nodes) - left - best) <= 1e-5 * (best + left), "%g more, not %g",
              cost_of(s.m.nodes) - left, best);
    paper_take_out(&s.m, (i & ~1u) + 1);
    paper_insert(&s.m, node, i & ~1u, old_place);
    check_mover(&s.m, 0);
    CHECK(fabs(s.m.cost - old) <= 1e-5 * old);
    if (!(i & 1)) {                    /* it was the left one: back to where it stood */
      paper_put(&s.m, i, node);
      paper_put(&s.m, i + 1, sibling);
    }
  }
  paper_end_insertion(&s);
}
static void test_places(void)
{
  seed = 4;
  for (uint32_t n = 3; n <= 48; n += n / 3 + 1) with_few(places_and_look, NULL, n);
}
/* What the node above a pair costs when it is dissolved and its children are inserted by trial of all
 * places. */
static double reinserted_cost(const paper_mover *m, uint32_t pair, int larger_first)
{
  size_t pairs = m->p->pair_end;
  paper_build p = *m->p;
  paper_mover copy = {&p, (trbvh_node *)ex_allocate(2 * pairs, sizeof *copy.nodes),
      (uint32_t *)ex_allocate(pairs, sizeof *copy.parent), 0};
  uint32_t slot = m->parent[pair / 2], free_pair[2] = {slot & ~1u, pair};
  const trbvh_node *n = m->nodes + pair;
  int left_first = (area_of(n, n) >= area_of(n + 1, n + 1)) == larger_first;
  trbvh_node node[2] = {n[!left_first], n[left_first]};
  p.nodes = copy.nodes;
  memcpy(copy.nodes, m->nodes, 2 * pairs * sizeof *copy.nodes);
  memcpy(copy.parent, m->parent, pairs * sizeof *copy.parent);
  paper_take_out(&copy, slot);
  for (int i = 0; i < 2; ++i) {
    uint32_t at = 0, best_at = 0;
    double best = DBL_MAX;
    do {
      at = at ? paper_next(&copy, at) : paper_first_below(&copy, 0);
      double cost = insertion_cost(&copy, at, &node[i]);
      if (cost < best) { best = cost; best_at = at; }
    } while (at);
    paper_insert(&copy, node[i], free_pair[i], best_at);
  }
  double cost = cost_of(copy.nodes);
  free(copy.nodes);
  free(copy.parent);
  return cost;
}
static uint32_t reinsertions, reinsertions_better, orders, orders_as_told;
static void reinsert_and_look(paper_build *p)
{
  paper_inserter s = paper_start_insertion(p);
  for (uint32_t i = 0; i < 4 * p->pair_end; ++i) {
    double old = cost_of(s.m.nodes), want = old, other = old;
    uint32_t pair = 2 * (1 + ex_random_bits(&seed) % (p->pair_end - 1));
    if (s.m.parent[pair / 2]) {
      want = fmin(old, reinserted_cost(&s.m, pair, 1));
      other = fmin(old, reinserted_cost(&s.m, pair, 0));
    }
    paper_reinsert(&s, pair);
    check_mover(&s.m, 0);
    if (fabs(want - other) > 1e-4 * old) {         /* the children's order matters */
      ++orders;
      orders_as_told += fabs(cost_of(s.m.nodes) - want) <= 1e-5 * old;
    }
    CHECK_MSG(cost_of(s.m.nodes) <= old * (1 + 1e-6), "the cost rises from %g", old);
    ++reinsertions;
    reinsertions_better += cost_of(s.m.nodes) < 0.9999 * old;
  }
  double old = cost_of(s.m.nodes), cost;
  s.m.cost *= 1 + 1e-9;                /* as if by roundings: with most scenes there are none in double */
  paper_reinsert_round(&s);
  cost = s.m.cost;
  paper_link(&s.m);
  CHECK_MSG(s.m.cost == cost, "roundings are left after a round: %g", s.m.cost - cost);
  CHECK(cost_of(s.m.nodes) <= old * (1 + 1e-6));
  for (uint32_t i = 1; i < p->pair_end; ++i) CHECK(s.had_turn[i]);
  paper_end_insertion(&s);
}
static void test_reinsertion(void)
{
  seed = 5;
  for (uint32_t n = 2; n <= 60; n += n / 2 + 1) with_few(reinsert_and_look, &from_shuffled, n);
  CHECK_MSG(10 * reinsertions_better > reinsertions, "%u of %u better", reinsertions_better, reinsertions);
  /* not always: of equally good places the search may find another one for the first child than the trial */
  CHECK_MSG(orders > 50 && orders_as_told >= 0.95 * orders, "larger first: %u of %u", orders_as_told, orders);
}
static void rank_and_look(paper_build *p)   /* a batch is what a sort of all measures begins with */
{
  paper_inserter s = paper_start_insertion(p);
  uint32_t count = p->pair_end / 3 + 1, turns = 0;
  for (uint32_t i = 1; i < p->pair_end; i += 2 + i % 2, ++turns) s.had_turn[i] = 1;
  if (count > p->pair_end - 1 - turns) count = p->pair_end - 1 - turns;
  paper_rank(&s, count);
  for (uint32_t k = 0; k < count; ++k) {
    uint32_t chosen = (uint32_t)s.keys[k], better = 0;
    CHECK(!s.had_turn[chosen]);
    const trbvh_node *n = s.m.nodes, *pair = n + 2 * chosen;
    double own = paper_inefficiency(&s.m, 2 * chosen), area = area_of(pair, pair + 1);
    double left = area_of(pair, pair), right = area_of(pair + 1, pair + 1);
    double want = area * area * area / ((left + right) / 2 * (left < right ? left : right));
    CHECK_MSG(!(left > 0 && right > 0) || fabs(own - want) <= 1e-4 * want, "measure %g, not %g", own, want);
    for (uint32_t i = 1; i < p->pair_end; ++i)     /* keys hold 20 bits of the mantissa */
      better += !s.had_turn[i] && paper_inefficiency(&s.m, 2 * i) > own * (1 + 2e-6);
    CHECK_MSG(better <= k, "the one at %u has %u before it", k, better);
  }
  paper_end_insertion(&s);
}
static void test_rank(void)
{
  seed = 6;
  for (uint32_t n = 2; n <= 300; n = 2 * n + 1) with_few(rank_and_look, &from_shuffled, n);
}

// >>both ----------------------------------------------------------------------------------------------------
/* Of three references there are three trees, and each is one move from the others: all find the best. */
static void three_and_look(paper_build *p)
{
  double best = DBL_MAX;
  for (uint32_t i = 0; i < 3; ++i) {
    const trbvh_node *a = &p->refs[(i + 1) % 3], *b = &p->refs[(i + 2) % 3];
    double cost = area_of(a, b);
    if (cost < best) best = cost;
  }
  trbvh_node all = paper_union(paper_union(p->refs[0], &p->refs[1]), &p->refs[2]);
  best += area_of(&all, &all);
  for (int which = 0; which < 3; ++which) {
    static paper_builder *const builders[] = {paper_kensler_climb, paper_kensler_anneal, paper_bittner};
    p->pair_end = 1;
    p->parameters = &from_shuffled;
    builders[which](p);
    /* 1e-5 of the root's area is what hill climbing does not do a rotation for */
    double cost = cost_of(p->nodes);
    CHECK_MSG(cost <= best * (1 + 2e-5), "builder %d: %g, the best is %g", which, cost, best);
  }
}
static void test_three(void)
{
  seed = 7;
  for (int i = 0; i < 50; ++i) with_few(three_and_look, NULL, 3);
}
static void test_climb_scenes(void) { paper_test_scenes(paper_kensler_climb, NULL, 0, 0, 20000); }
static void test_climb_from_sweep(void) { paper_test_scenes(paper_kensler_climb, &from_sweep, 0, 0, 3000); }
static void test_anneal_scenes(void) { paper_test_scenes(paper_kensler_anneal, NULL, 0, 0, 3000); }
static void test_bittner_scenes(void) { paper_test_scenes(paper_bittner, NULL, 0, 0, 20000); }
static void test_bittner_from_sweep(void) { paper_test_scenes(paper_bittner, &from_sweep, 0, 0, 3000); }
/* What SAH costs must be like, as the trees' own costs do: hill climbing is better than its start,
 * annealing than that, and insertion than both, since it knows all places in the tree and not only those
 * nearby. The articles and the paper's table put Kensler's trees near the sweep's and Bittner's well
 * below; on scenes of uniform size, such as a sphere, there is little below the sweep, so a few percent
 * for a start from a linear tree. The margins of 1 % and 4 % are for leaves of several references, which
 * come after all moves: a lower sum of areas has been seen to cost 2.3 % more with them. */
static void test_moves_quality(void)
{
  double climbs = 0, anneals_sum = 0, insertions = 0, count = 0;
  for (size_t i = 0; i < SCENE_COUNT; ++i) {
    const char *name = scene_defs[i].name;
    if (!(scene_defs[i].flags & SCENE_ORDINARY) || scene_defs[i].full > 20000) continue;
    double lbvh = paper_test_sah(name, paper_lbvh, NULL, 0, 0);
    double sweep = paper_test_sah(name, paper_sweep, NULL, 0, 0);
    double climb = paper_test_sah(name, paper_kensler_climb, NULL, 0, 0);
    double anneal = paper_test_sah(name, paper_kensler_anneal, NULL, 0, 0);
    double bittner = paper_test_sah(name, paper_bittner, NULL, 0, 0);
    double climb_sweep = paper_test_sah(name, paper_kensler_climb, &from_sweep, 0, 0);
    double anneal_sweep = paper_test_sah(name, paper_kensler_anneal, &from_sweep, 0, 0);
    double bittner_sweep = paper_test_sah(name, paper_bittner, &from_sweep, 0, 0);
    CONTEXT("scene %s: linear %.2f, sweep %.2f", name, lbvh, sweep);
    CHECK_MSG(climb < 1.01 * lbvh, "hill climbing %g", climb);
    CHECK_MSG(anneal < 1.01 * climb, "annealing %g, hill climbing %g", anneal, climb);
    CHECK_MSG(bittner < 1.01 * anneal, "insertion %g, annealing %g", bittner, anneal);
    CHECK_MSG(climb_sweep < 1.04 * sweep, "hill climbing from the sweep's tree %g", climb_sweep);
    CHECK_MSG(anneal_sweep < 1.04 * sweep, "annealing from the sweep's tree %g", anneal_sweep);
    CHECK_MSG(bittner_sweep < 1.01 * sweep, "insertion from the sweep's tree %g", bittner_sweep);
    CHECK_MSG(bittner < 1.04 * sweep, "insertion %g", bittner);
    climbs += climb / lbvh;
    anneals_sum += anneal / climb;
    insertions += bittner / sweep;
    ++count;
  }
  CONTEXT("%s", "");         /* on average they do what they are for; seen: 92 to 93 %, 98 %, 98 % */
  CHECK_MSG(climbs < 0.96 * count, "hill climbing: %.1f %% of the linear tree's", 100 * climbs / count);
  CHECK_MSG(anneals_sum < 0.99 * count, "annealing: %.1f %% of hill climbing's", 100 * anneals_sum / count);
  CHECK_MSG(insertions < 0.99 * count, "insertion: %.1f %% of the sweep's", 100 * insertions / count);
}

static void run_moves_tests(void)
{
  RUN(test_rotations);
  RUN(test_climb_to_the_top);
  RUN(test_anneal_is_no_worse);
  RUN(test_places);
  RUN(test_reinsertion);
  RUN(test_rank);
  RUN(test_three);
  RUN(test_climb_scenes);
  RUN(test_climb_from_sweep);
  RUN(test_anneal_scenes);
  RUN(test_bittner_scenes);
  RUN(test_bittner_from_sweep);
  RUN(test_moves_quality);
}

#endif
