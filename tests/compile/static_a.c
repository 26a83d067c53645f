/* TRBVH_STATIC: two files with an implementation each, private to them. Most functions are unused here, which must not
 * make a warning. */
#define TRBVH_STATIC
#define TRBVH_IMPLEMENTATION
#include "../../trbvh.h"
#include "one_triangle.h"

int other_file(void);

int main(void) { return one_triangle() && other_file() ? 0 : 1; }
