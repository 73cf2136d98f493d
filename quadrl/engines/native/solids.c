// Clearance of aircraft from the solids around them.
#include <math.h>
#include <stddef.h>
#include <stdint.h>

#define LANES 1
#include "aero.h"
#include "export.h"
#include "solids.h"

// Addresses of the rows of a simulation: qpos (7) of aircraft i is at i * stride doubles, its
// parameters are at i * row doubles (0: the same for all), its solids, `count` of them, at i *
// count, and its list of the nearest ones at i.
typedef struct {
  const double *qpos, *parameters;
  const Solid* solids;
  Nearby* nearby;
  int64_t stride, row, count, rotors;
} Rows;

enum { AHEAD = 4, CACHE_LINE = 64 };  // aircraft, bytes

// Spheres around the hull and around each rotor's disc, body frame, and the radius of a sphere
// about the centre of mass that encloses them.
typedef struct {
  double centre[MAX_ROTORS + 1][3], radius[MAX_ROTORS + 1], reach;
} Outline;

static Outline outline_of(const Aircraft* a, int64_t rotors) {
  Outline o = {0};
  for (int j = 0; j < 3; ++j) {
    if (a->hull[j][0] > o.radius[0]) o.radius[0] = a->hull[j][0];
  }
  o.reach = o.radius[0];
  for (int64_t k = 1; k <= rotors; ++k) {
    const Rotor* rotor = a->rotor + k - 1;
    double squares = 0;
    for (int j = 0; j < 3; ++j) {
      const double at = rotor->position[j][0] + a->rotor_height[0] * rotor->axis[j][0];
      o.centre[k][j] = at;
      squares += at * at;
    }
    o.radius[k] = rotor->radius[0];
    if (sqrt(squares) + o.radius[k] > o.reach) o.reach = sqrt(squares) + o.radius[k];
  }
  return o;
}

// Distance [m] of the nearest solid from the spheres of the outline, a lower bound of the
// clearance, for the aircraft first..last-1, or for those of ids.
QUADRL_EXPORT int64_t quadrl_clearance(const Rows* rows, int64_t first, int64_t last,
                                       const int64_t* ids, double* out) {
  Outline own = outline_of((const Aircraft*)rows->parameters, rows->rotors);
  for (int64_t row = first; row < last; ++row) {
    const int64_t i = ids ? ids[row] : row;
    const double* p = rows->qpos + i * rows->stride;
    const double w = p[3], x = p[4], y = p[5], z = p[6];
    const double r[9] = {1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
                         2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
                         2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)};
    if (rows->row) {
      own = outline_of((const Aircraft*)(rows->parameters + i * rows->row), rows->rotors);
    }
    double points[MAX_ROTORS + 1][3], least = HUGE_VAL;
    for (int64_t k = 0; k <= rows->rotors; ++k) {
      const double* c = own.centre[k];
      for (int j = 0; j < 3; ++j) {
        points[k][j] = p[j] + r[3 * j] * c[0] + r[3 * j + 1] * c[1] + r[3 * j + 2] * c[2];
      }
    }
    const Solid* solids = rows->solids + i * rows->count;
    Nearby* list = rows->nearby + i;
    // The list of an aircraft ahead is not in the cache: fetch it as far as its two nearest solids.
    if (row + AHEAD < last) {
      const int64_t next = ids ? ids[row + AHEAD] : row + AHEAD;
      for (size_t k = 0; k < offsetof(Nearby, solid[2]); k += CACHE_LINE) {
        __builtin_prefetch((const char*)(rows->nearby + next) + k);
      }
      __builtin_prefetch(rows->qpos + next * rows->stride);
    }
    // List anew if some part of the aircraft may be nearer to a solid that is not listed.
    const double *then = list->distance, *next = then + LISTED;
    double way = way_since(list, p);
    if (!(then[0] + 2 * way + own.reach < *next)) {
      list_nearest(solids, rows->count, p, list);
      way = way_since(list, p);
    }
    const int all = !(then[0] + 2 * way + own.reach < *next);
    const int64_t count = all || rows->count < LISTED ? rows->count : LISTED;
    for (int64_t s = 0; s < count; ++s) {
      // Most solids need no closer look: no part of the aircraft is nearer to this one than that,
      // nor to any of those after it, which were farther when they were listed.
      if (!all && then[s] - way - own.reach > least) break;
      const Solid* solid = (all ? solids : list->solid) + s;
      if (solid_distance(solid, p) - own.reach > least) continue;
      for (int64_t k = 0; k <= rows->rotors; ++k) {
        const double free = solid_distance(solid, points[k]) - own.radius[k];
        least = free < least ? free : least;
      }
    }
    out[row] = least;
  }
  return last - first;
}
