/* grid.h - GridSAH (Garanzha, Premoze, Bely and Galaktionov 2011, "Grid-based SAH BVH Construction on a
 * GPU").
 *
 * References are put once into a grid, whose cells know the box and the number of what is in them. The tree
 * above the cells is by the surface area heuristic, with the grid's planes as candidates, and looks at
 * nothing but cells. In a cell with more than one reference there is another grid, and so on: O(k n). All
 * grids are those of the Morton codes: one sort fills them, their cells are runs of references, and each
 * starts at the first plane that parts what is in it.
 *
 * The published builder also gives long thin triangles several references. As the paper's table is of trees
 * without splits, this one does not.
 */
#ifndef PAPER_GRID_H
#define PAPER_GRID_H
#include "hlbvh.h"

/* How fine the published grids are we do not know. With 8 cells along an axis, trees are as good as HLBVH's,
 * as in the paper's table; with 32, SAH is 5 % lower in about the same time; with 4, it is 4 % higher (13
 * meshes). */
enum { PAPER_GRID_BITS = 3 };

/* The references of a cell that waits for its grid. */
typedef struct paper_run { uint32_t begin, end, slot; } paper_run;

/* The lowest bit of its code that tells where in a run's grid a reference is. */
static inline uint32_t paper_grid_shift(uint64_t first, uint64_t last)
{
  uint64_t differ = first ^ last;
  uint32_t high = (uint32_t)(differ >> 32), bit = high ? 32 + trb_log2(high) : trb_log2((uint32_t)differ);
  uint32_t levels = bit / 3 + 1;       /* of the octree below what all have in common */
  return levels > PAPER_GRID_BITS ? 3 * (levels - PAPER_GRID_BITS) : 0;
}
static inline paper_cell paper_new_cell(const trbvh_node *ref, uint64_t place)
{
  paper_cell cell = {*ref, 1, 0, {0, 0, 0}};
  for (uint32_t bit = 0; bit < 3 * PAPER_GRID_BITS; bit++) {
    unsigned char *bin = &cell.bin[2 - bit % 3];
    *bin = (unsigned char)(*bin | (place >> bit & 1) << bit / 3);
  }
  return cell;
}
/* The cells of the grid over a run, and how many. References with equal codes get a cell each, all of one
 * place. The `first` of a larger cell's node is its first reference. */
static inline uint32_t paper_make_cells(const paper_build *p, const uint64_t *codes, paper_run run,
                                        paper_cell *cells)
{
  uint32_t low = 63 - paper_code_bits(p), made = 0;
  uint64_t first = codes[run.begin] << low, last = codes[run.end - 1] << low, place = 0;
  uint32_t shift = first == last ? 0 : paper_grid_shift(first, last);
  for (uint32_t i = run.begin; i < run.end; i++) {
    uint64_t before = place;
    place = codes[i] << low >> shift;
    if (made == 0 || place != before || first == last) {
      cells[made++] = paper_new_cell(&p->refs[i], place);
    } else {
      paper_cell *cell = &cells[made - 1];
      cell->node = paper_union(cell->node, &p->refs[i]);
      cell->node.first = i - cell->count++;
    }
  }
  return made;
}
static inline void paper_grid(paper_build *p)
{
  uint32_t count = p->ref_count, waiting = 0;
  uint64_t *codes = paper_sort_refs(p);
  paper_cell *cells = (paper_cell *)ex_allocate(count, sizeof *cells);
  paper_cell *spare = (paper_cell *)ex_allocate(count, sizeof *spare);
  paper_run *runs = (paper_run *)ex_allocate(count, sizeof *runs);
  runs[waiting++] = (paper_run){0, count, 0};
  while (waiting) {
    paper_run run = runs[--waiting];
    uint32_t made = paper_make_cells(p, codes, run, cells);
    paper_build_cells(p, cells, made, spare, run.slot, NULL);
    for (uint32_t i = 0; i < made; i++) {
      uint32_t begin = cells[i].node.first;
      if (cells[i].count > 1) runs[waiting++] = (paper_run){begin, begin + cells[i].count, cells[i].slot};
    }
  }
  paper_fit(p);
  free(runs);
  free(spare);
  free(cells);
  free(codes);
}

#endif
