/* early.h - triangles split before the build, by ESC and EVH, and then trbvh's linear BVH over the pieces;
 * run treelet rounds on it.
 *
 *   paper_esc   Early Split Clipping (Ernst and Greiner 2007, "Early Split Clipping for Bounding Volume
 *               Hierarchies"): boxes with an area above a threshold are halved at the middle of their
 *               longest side, and shrunk to what of the triangle is in each half.
 *   paper_evh   The Edge Volume Heuristic (Dammertz and Keller 2008, "The Edge Volume Heuristic - Robust
 *               Triangle Subdivision for Improved BVH Performance"): the triangle is halved at the middle
 *               of the edge whose box has the largest volume, while that is above a threshold. An edge
 *               that two triangles share is cut alike in both.
 *
 * Both leave the threshold to the user. Here the number of references is given, as the paper's "match
 * SBVH" rows need it (parameters: a uint32_t; NULL or 0: ref_max), and the least threshold that makes no
 * more is found by bisection. Each step only counts pieces; they are made when they are not too many, and
 * later steps go on from them.
 */
#ifndef PAPER_EARLY_H
#define PAPER_EARLY_H
#include "paper.h"

enum { PAPER_PIECE_DEPTH = 96 };       /* a triangle is not halved more often */

typedef struct paper_piece {
  trbvh_node box;                      /* ESC's; `first`: the primitive */
  float      v[3][3];                  /* ESC: the whole triangle, EVH: the piece of it */
  uint32_t   size, depth;              /* size: what is compared to the threshold; how often it was halved */
} paper_piece;
typedef struct paper_heuristic {
  double     (*size)(const paper_piece *piece);      /* 0: cannot be halved */
  int        (*halve)(const paper_piece *piece, paper_piece halves[2]);   /* 1 where one is empty, or 2 */
  trbvh_node (*box)(const paper_piece *piece, const float triangle[3][3]);
} paper_heuristic;

// ---- the search ----
typedef struct paper_pieces {
  const paper_heuristic *heuristic;
  paper_piece           *pieces;
  uint32_t              *sizes;        /* of them */
  uint32_t               count, most;
} paper_pieces;

/* An integer that sorts as the size does, to 20 bits behind the point. */
static inline void paper_set_size(const paper_heuristic *h, paper_piece *piece)
{
  double size = piece->depth < PAPER_PIECE_DEPTH ? h->size(piece) : 0;
  uint64_t bits;
  memcpy(&bits, &size, sizeof bits);
  piece->size = (uint32_t)(bits >> 32);
}
static inline void paper_keep_piece(paper_pieces *s, uint32_t i, const paper_piece *piece)
{
  s->pieces[i] = *piece;
  s->sizes[i] = piece->size;
}
/* How many pieces a threshold makes, or some number above the most that are allowed; with `make`, makes
 * them. */
static inline uint32_t paper_cut_pieces(paper_pieces *s, uint32_t threshold, int make)
{
  paper_piece stack[PAPER_PIECE_DEPTH + 2], halves[2];
  uint32_t total = s->count, old = s->count;
  for (uint32_t i = 0; i < old && total <= s->most; i++) {
    uint32_t top = 0, to = i;
    if (s->sizes[i] <= threshold) continue;
    stack[top++] = s->pieces[i];
    while (top && total <= s->most) {
      paper_piece piece = stack[--top];
      if (piece.size <= threshold) {
        if (make) paper_keep_piece(s, to, &piece);
        to = s->count;
        if (make && top) s->count++;
        continue;
      }
      int count = s->heuristic->halve(&piece, halves);
      total += (uint32_t)count - 1;
      for (int k = count; k-- > 0;) {
        halves[k].depth = piece.depth + 1;
        paper_set_size(s->heuristic, &halves[k]);
        stack[top++] = halves[k];
      }
    }
  }
  return total;
}
/* The least threshold that makes no more pieces than allowed: its pieces. */
static inline uint32_t paper_find_threshold(paper_pieces *s)
{
  uint32_t low = 0, high = 0;
  for (uint32_t i = 0; i < s->count; i++) high = TRB_MAX(s->sizes[i], high);
  while (low < high) {                 /* by a factor of four at most: then few pieces are counted in vain */
    uint32_t half = (high - low + 1) / 2, middle = high - TRB_MIN(half, 1u << 21);
    if (paper_cut_pieces(s, middle, 0) > s->most) {
      low = middle + 1;
    } else {
      paper_cut_pieces(s, middle, 1);
      high = middle;
    }
  }
  return high;
}
static inline uint32_t paper_split_early(paper_build *p, const paper_heuristic *heuristic)
{
  uint32_t wanted = p->parameters ? *(const uint32_t *)p->parameters : 0, vertex;
  float v[3][3];
  paper_pieces s = {heuristic, NULL, NULL, p->ref_count, wanted && wanted < p->ref_max ? wanted : p->ref_max};
  if (s.most <= p->ref_count) return UINT32_MAX;     /* always so for boxes: they are no triangles */
  s.pieces = (paper_piece *)ex_allocate(s.most, sizeof *s.pieces);
  s.sizes = (uint32_t *)ex_allocate(s.most, sizeof *s.sizes);
  for (uint32_t i = 0; i < s.count; i++) {
    paper_piece piece = {p->refs[i], {{0}}, 0, 0};
    trb_load_triangle(&p->lib.input, piece.box.first, piece.v, &vertex);
    paper_set_size(heuristic, &piece);
    paper_keep_piece(&s, i, &piece);
  }
  uint32_t threshold = paper_find_threshold(&s);
  for (uint32_t i = 0; i < s.count; i++) {
    uint32_t prim = s.pieces[i].box.first;
    trb_load_triangle(&p->lib.input, prim, v, &vertex);
    p->refs[i] = paper_reference(p, heuristic->box(&s.pieces[i], (const float (*)[3])v), prim);
  }
  p->ref_count = s.count;
  free(s.pieces);
  free(s.sizes);
  return threshold;
}

// ---- ESC ----
static inline float paper_esc_middle(const trbvh_node *box, int *axis)   /* of the longest side */
{
  const float longest = trb_longest_side(*box);
  int k = 0;
  while (box->max[k] - box->min[k] < longest) k++;
  *axis = k;
  return 0.5f * box->min[k] + 0.5f * box->max[k];
}
static inline double paper_esc_size(const paper_piece *piece)
{
  const float longest = trb_longest_side(piece->box);
  int k;
  if (!(longest > TRB_TINY && longest < 1 / TRB_TINY)) return 0;   /* out of trb_clip's range */
  float middle = paper_esc_middle(&piece->box, &k);
  return piece->box.min[k] < middle && middle < piece->box.max[k] ? trb_area(piece->box) : 0;
}
static inline int paper_esc_halve(const paper_piece *piece, paper_piece halves[2])
{
  int k, count = 0;
  float middle = paper_esc_middle(&piece->box, &k);
  for (int side = 0; side < 2; side++) {
    halves[count] = *piece;
    if (side) halves[count].box.min[k] = middle;
    else halves[count].box.max[k] = middle;
    count += trb_clip(piece->v, &halves[count].box);
  }
  if (count == 0) halves[0] = *piece;                /* lost to rounding */
  return count ? count : 1;
}
static inline trbvh_node paper_esc_box(const paper_piece *piece, const float triangle[3][3])
{
  (void)triangle;
  return piece->box;
}
static const paper_heuristic paper_esc_heuristic = {paper_esc_size, paper_esc_halve, paper_esc_box};
static inline void paper_esc(paper_build *p)
{
  paper_split_early(p, &paper_esc_heuristic);
  paper_lbvh(p);
}

// ---- EVH ----
/* Of a, b and of b, a the same; 0 for edges so short that padding is lost among denormal numbers. */
static inline double paper_edge_volume(const float a[3], const float b[3])
{
  double volume = 1, longest = 0;
  for (int k = 0; k < 3; k++) {
    double side = a[k] < b[k] ? (double)b[k] - a[k] : (double)a[k] - b[k];
    volume *= side;
    longest = TRB_MAX(side, longest);
  }
  return longest > TRB_TINY ? volume : 0;
}
static inline int paper_largest_edge(const float v[3][3], double *volume)   /* its first corner */
{
  int largest = 0;
  *volume = paper_edge_volume(v[0], v[1]);
  for (int i = 1; i < 3; i++) {
    double next = paper_edge_volume(v[i], v[(i + 1) % 3]);
    if (next > *volume) {
      *volume = next;
      largest = i;
    }
  }
  return largest;
}
static inline void paper_edge_middle(const float a[3], const float b[3], float middle[3])   /* or of b, a */
{
  for (int k = 0; k < 3; k++) middle[k] = 0.5f * a[k] + 0.5f * b[k];
}
static inline double paper_evh_size(const paper_piece *piece)
{
  double volume;
  float middle[3];
  int from = paper_largest_edge(piece->v, &volume), to = (from + 1) % 3;
  paper_edge_middle(piece->v[from], piece->v[to], middle);
  int between = memcmp(middle, piece->v[from], sizeof middle) && memcmp(middle, piece->v[to], sizeof middle);
  return between ? volume : 0;
}
static inline int paper_evh_halve(const paper_piece *piece, paper_piece halves[2])
{
  double volume;
  float middle[3];
  int from = paper_largest_edge(piece->v, &volume), to = (from + 1) % 3;
  paper_edge_middle(piece->v[from], piece->v[to], middle);
  halves[0] = halves[1] = *piece;
  memcpy(halves[0].v[to], middle, sizeof middle);
  memcpy(halves[1].v[from], middle, sizeof middle);
  return 2;
}
/* Corners in the middle of edges are rounded. So that no ray slips between two pieces, boxes are padded as
 * trb_clip does, and cut off at the box of the whole triangle. */
static inline trbvh_node paper_evh_box(const paper_piece *piece, const float triangle[3][3])
{
  trbvh_node box, whole;
  trb_triangle_box(piece->v, &box);
  trb_triangle_box(triangle, &whole);
  for (int k = 0; k < 3; k++) {
    float a = trb_abs(whole.min[k]), b = trb_abs(whole.max[k]), pad = TRB_MAX(a, b) * 4.7683716e-7f;
    float low = box.min[k] - pad, high = box.max[k] + pad;
    box.min[k] = TRB_MAX(low, whole.min[k]);
    box.max[k] = TRB_MIN(high, whole.max[k]);
  }
  return box;
}
static const paper_heuristic paper_evh_heuristic = {paper_evh_size, paper_evh_halve, paper_evh_box};
static inline void paper_evh(paper_build *p)
{
  paper_split_early(p, &paper_evh_heuristic);
  paper_lbvh(p);
}

#endif
