// How far aircraft are from the solids about them.
#include <math.h>
#include <stddef.h>
#include <stdint.h>

#define LANES 1
#include "aero.h"
#include "export.h"
#include "solids.h"

// Where the rows of a simulation are: qpos (7) of aircraft i stands at i * stride doubles, its
// parameters at i * row doubles (0: all the same), its solids, `count` of them, side by side.
typedef struct {
  const double *qpos, *parameters;
  const Solid* solids;
  int64_t stride, row, count, rotors;
} Rows;

// Distance of the nearest solid from the spheres around the hull and around each rotor's disc, for
// n aircraft: what is free at least [m].
QUADRL_EXPORT void quadrl_clearance(const Rows* rows, int64_t n, double* out) {
  for (int64_t i = 0; i < n; ++i) {
    const double* p = rows->qpos + i * rows->stride;
    const Aircraft* a = (const Aircraft*)(rows->parameters + i * rows->row);
    const double w = p[3], x = p[4], y = p[5], z = p[6];
    const double r[9] = {1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
                         2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
                         2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)};
    double points[MAX_ROTORS + 1][3], radii[MAX_ROTORS + 1], reach = 0, least = HUGE_VAL;
    for (int k = -1; k < rows->rotors; ++k) {
      double centre[3] = {0}, radius = 0, out = 0;
      if (k < 0) {
        for (int j = 0; j < 3; ++j) radius = a->hull[j][0] > radius ? a->hull[j][0] : radius;
      } else {
        const Rotor* rotor = a->rotor + k;
        radius = rotor->radius[0];
        for (int j = 0; j < 3; ++j) {
          centre[j] = rotor->position[j][0] + a->rotor_height[0] * rotor->axis[j][0];
        }
      }
      for (int j = 0; j < 3; ++j) {
        points[k + 1][j] =
            p[j] + r[3 * j] * centre[0] + r[3 * j + 1] * centre[1] + r[3 * j + 2] * centre[2];
        out += centre[j] * centre[j];
      }
      radii[k + 1] = radius;
      reach = sqrt(out) + radius > reach ? sqrt(out) + radius : reach;
    }
    for (int64_t s = 0; s < rows->count; ++s) {
      const Solid* solid = rows->solids + i * rows->count + s;
      // No part of the aircraft is nearer to it than this, which spares most solids a closer look.
      if (solid_distance(solid, p) - reach > least) continue;
      for (int k = 0; k <= rows->rotors; ++k) {
        const double free = solid_distance(solid, points[k]) - radii[k];
        least = free < least ? free : least;
      }
    }
    out[i] = least;
  }
}
