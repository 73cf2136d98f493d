// Free flight: equations 3 to 10 of the paper, integrated by the classical Runge-Kutta method.
#include "flight.h"

// Advances aircraft first..last-1 by a number of steps, in place, with the commands in ctrl. first
// is a multiple of LANES. Returns how many are marked in near and left as they were.
QUADRL_EXPORT int64_t quadrl_free_flight(const Rows* rows, int64_t first, int64_t last,
                                         int64_t steps) {
  Block b;
  Aircraft own;
  int64_t marked = 0;
  if (!rows->block) spread(rows->parameters, &own);
  for (int64_t row = first; row < last; row += LANES) {
    load(rows, NULL, row, last, &b, &own);
    advance(rows, &b, steps);
    marked += store(rows, &b);
  }
  return marked;
}
