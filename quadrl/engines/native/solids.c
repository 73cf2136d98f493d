// Poses of solids, and the clearance of aircraft from them.
#include <math.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>

#include "export.h"
#include "solids.h"

// Addresses of the rows of a simulation: qpos (7) of aircraft i is at i * stride doubles, its
// solids, `count` of them, are at i * count, and its list of the nearest ones at i. balls: those of
// all aircraft, at least one, the one that reaches farthest first.
typedef struct {
  const double* qpos;
  const Ball* balls;
  const Solid* solids;
  Nearby* nearby;
  int64_t stride, count, parts;
} Rows;

// Poses of `count` geoms about each aircraft in ids, of `width` numbers (7 or 13), as
// quadrl/engines/solids.py has them, and where both engines read them: the geoms `which` of the
// `geoms` in the fields of the models, centres of the solids, each of which begins with the geom
// `first`, and the table. declared: size and offset (6) of each geom. own: the poses of all that
// stand written; NULL for none. size, bound: NULL for poses of 7 numbers.
typedef struct {
  const double *poses, *declared, *origin;
  const int64_t *ids, *which, *first;
  double *own, *position, *quaternion, *size, *bound, *centres;
  Solid* solids;
  Nearby* nearby;
  int64_t width, count, singles, geoms;
} Placing;

enum { AHEAD = 4, CACHE_LINE = 64 };  // aircraft, bytes

// Writes poses of the solids of n aircraft.
QUADRL_EXPORT void quadrl_stand(const Placing* to, int64_t n) {
  const int64_t width = to->width, size = to->count * width;
  for (int64_t row = 0; row < n; ++row) {
    const int64_t i = to->ids[row];
    const double* given = to->poses + row * size;
    double* own = to->own ? to->own + i * size : NULL;
    if (own && !memcmp(own, given, size * sizeof(*own))) continue;
    to->nearby[i].place[0] = NAN;
    Solid* solids = to->solids + i * to->count;
    for (int64_t k = 0; k < to->count; ++k) {
      const double* pose = given + k * width;
      const int64_t geom = i * to->geoms + to->which[k];
      Solid* solid = solids + k;
      memcpy(solid->position, pose, sizeof(solid->position));
      memcpy(to->position + 3 * geom, pose, sizeof(solid->position));
      if (!own || memcmp(own + k * width + 3, pose + 3, 4 * sizeof(*pose))) {
        rotation_of(pose + 3, solid->turn);
        memcpy(to->quaternion + 4 * geom, pose + 3, 4 * sizeof(*pose));
      }
      if (to->size) {
        const double* s = pose + 7;
        memcpy(solid->size, s, sizeof(solid->size));
        memcpy(to->size + 3 * geom, s, sizeof(solid->size));
        to->bound[geom] = sqrt(s[0] * s[0] + s[1] * s[1] + s[2] * s[2]);
      }
    }
    for (int64_t s = 0; s < to->singles; ++s) {
      const int64_t k = to->first[s];
      const double *pose = given + k * width, *t = solids[k].turn;
      const double* off = to->size ? pose + 10 : to->declared + 6 * k + 3;
      double* centre = to->centres + 3 * (i * to->singles + s);
      for (int j = 0; j < 3; ++j) {
        const double turned = t[3 * j] * off[0] + t[3 * j + 1] * off[1] + t[3 * j + 2] * off[2];
        centre[j] = pose[j] - turned - to->origin[j];
      }
    }
    if (own) memcpy(own, given, size * sizeof(*own));
  }
}

// Whether no solid that is not listed may be the nearest of any part of an aircraft that has come a
// way: the first listed one is that much farther at most, and an unlisted one that much nearer.
static int is_known(const Nearby* list, double way, double reach) {
  return list->distance[0] + 2 * way + reach < list->distance[LISTED];
}

// Distance [m] of the nearest solid from the balls, a lower bound of the clearance, for the aircraft
// first..last-1, or for those of ids.
QUADRL_EXPORT int64_t quadrl_clearance(const Rows* rows, int64_t first, int64_t last,
                                       const int64_t* ids, double* out) {
  const Ball* balls = rows->balls;
  const double reach = balls->reach;
  for (int64_t row = first; row < last; ++row) {
    const int64_t i = ids ? ids[row] : row;
    const double* p = rows->qpos + i * rows->stride;
    double r[9], least = HUGE_VAL;
    rotation_of(p + 3, r);
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
    const double* then = list->distance;
    double way = way_since(list, p);
    if (!is_known(list, way, reach)) {
      list_nearest(solids, rows->count, p, list);
      way = way_since(list, p);
    }
    const int all = !is_known(list, way, reach);
    const int64_t count = all || rows->count < LISTED ? rows->count : LISTED;
    for (int64_t s = 0; s < count; ++s) {
      // Most solids need no closer look: no part of the aircraft is nearer to this one than that,
      // nor to any of those after it, which were farther when they were listed.
      if (!all && then[s] - way - reach > least) break;
      least = nearer((all ? solids : list->solid) + s, balls, rows->parts, p, r, least);
    }
    out[row] = least;
  }
  return last - first;
}
