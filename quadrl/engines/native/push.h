// A push in a random direction, for the processor's aircraft and a GPU's.
#ifndef QUADRL_PUSH_H_
#define QUADRL_PUSH_H_

#include <math.h>

#include "philox.h"

// Adds a vector of a length; two uniform words choose its direction, evenly over the sphere.
static inline void add_push(double* to, double length, uint32_t share, uint32_t turn) {
  const double height = 2 * uniform(share) - 1, level = sqrt(1 - height * height);
  const double heading = 0x1.921fb54442d18p+2 * uniform(turn);
  to[0] += length * (level * cos(heading));
  to[1] += length * (level * sin(heading));
  to[2] += length * height;
}

#endif  // QUADRL_PUSH_H_
