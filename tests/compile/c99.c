/* The implementation alone, as strict C99: nothing else is included before it. */
#define TRBVH_IMPLEMENTATION
#include "../../trbvh.h"

int main(void) { return trbvh_version() == TRBVH_VERSION ? 0 : 1; }
