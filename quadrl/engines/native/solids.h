// Solids of the world: the distance of a point from one, and lists of the nearest ones.
#include <math.h>
#include <stdint.h>

// Kinds of solids, by MuJoCo's numbers (mjtGeom).
enum { SPHERE = 2, CAPSULE = 3, CYLINDER = 5, BOX = 6 };

// size: radius; radius and half the height, of a capsule half the way between the middles of its
// ends; halves of the edges [m]. turn: rotation matrix to the
// world. Written by quadrl/engines/solids.py.
typedef struct {
  double kind, size[3], position[3], turn[9];
} Solid;

// Rotation matrix to the world of a unit quaternion.
static inline void rotation_of(const double q[4], double r[9]) {
  const double w = q[0], x = q[1], y = q[2], z = q[3];
  r[0] = 1 - 2 * (y * y + z * z), r[1] = 2 * (x * y - w * z), r[2] = 2 * (x * z + w * y);
  r[3] = 2 * (x * y + w * z), r[4] = 1 - 2 * (x * x + z * z), r[5] = 2 * (y * z - w * x);
  r[6] = 2 * (x * z - w * y), r[7] = 2 * (y * z + w * x), r[8] = 1 - 2 * (x * x + y * y);
}

// A point in a solid's own frame.
static inline void to_solid(const Solid* s, const double point[3], double local[3]) {
  double away[3];
  for (int k = 0; k < 3; ++k) away[k] = point[k] - s->position[k];
  for (int k = 0; k < 3; ++k) {
    local[k] = s->turn[k] * away[0] + s->turn[3 + k] * away[1] + s->turn[6 + k] * away[2];
  }
}

// Of a point in a solid's own frame, what lies beyond the piece of the axis inside a capsule.
static inline double past_axis(const Solid* s, double z) {
  const double past = fabs(z) - s->size[1];
  return past > 0 ? copysign(past, z) : 0;
}

// Unit vector to a point outside of a solid from the nearest one of it, at a distance.
static inline void solid_normal(const Solid* s, const double point[3], double distance,
                                double normal[3]) {
  double local[3], off[3], squares;
  to_solid(s, point, local);
  if (s->kind == CAPSULE) local[2] = past_axis(s, local[2]);
  const int is_ball = s->kind == SPHERE || s->kind == CAPSULE;
  squares = local[0] * local[0] + local[1] * local[1];
  const double round = sqrt(is_ball ? squares + local[2] * local[2] : squares);
  for (int k = 0; k < 3; ++k) {
    const int is_round = is_ball || (s->kind == CYLINDER && k < 2);
    const double from = is_round ? round : fabs(local[k]);
    const double past = from - s->size[is_round ? 0 : s->kind == CYLINDER ? 1 : k];
    off[k] = past > 0 ? past * local[k] / from : 0;
  }
  for (int k = 0; k < 3; ++k) {
    normal[k] = s->turn[3 * k] * off[0] + s->turn[3 * k + 1] * off[1] + s->turn[3 * k + 2] * off[2];
    normal[k] /= distance;
  }
}

// Signed distance of a point from the surface of a solid [m]; negative inside.
static double solid_distance(const Solid* s, const double point[3]) {
  double local[3], out = 0, in;
  to_solid(s, point, local);
  if (s->kind == CAPSULE) local[2] = past_axis(s, local[2]);
  if (s->kind == SPHERE || s->kind == CAPSULE) {
    return sqrt(local[0] * local[0] + local[1] * local[1] + local[2] * local[2]) - s->size[0];
  }
  // Distance beyond each pair of faces, or beyond the mantle: positive outside.
  double past[3] = {fabs(local[0]) - s->size[0], fabs(local[1]) - s->size[1],
                    fabs(local[2]) - s->size[2]};
  if (s->kind == CYLINDER) {
    past[0] = past[1] = sqrt(local[0] * local[0] + local[1] * local[1]) - s->size[0];
    past[2] = fabs(local[2]) - s->size[1];
  }
  in = past[0];
  for (int k = 0; k < 3; ++k) {
    const int twice = s->kind == CYLINDER && k == 1;  // the mantle counts once
    if (past[k] > 0 && !twice) out += past[k] * past[k];
    if (past[k] > in) in = past[k];
  }
  return out > 0 ? sqrt(out) : in;
}

// Copies of the solids that were nearest to a place, in order, and their distances; the last
// distance is that of the next one, which is not listed. When the aircraft moves, no distance
// changes by more than the length of its way, so that most steps need not read all the others,
// which are far away in memory. With a place of NaN the list is unknown, which
// quadrl/engines/solids.py sets whenever a solid gets another pose. leap: how much farther than free
// flight's margin a solid has come in the last physics step [m].
enum { LISTED = 8 };
#define ROUNDING 1e-9  // [m], more than the error of any distance
typedef struct {
  double place[3], leap, distance[LISTED + 1];
  Solid solid[LISTED];
} Nearby;

// Square of the distance between two points [m^2].
static inline double squared(const double one[3], const double other[3]) {
  double squares = 0;
  for (int k = 0; k < 3; ++k) squares += (one[k] - other[k]) * (one[k] - other[k]);
  return squares;
}

// Distance of a point from the place of a list [m].
static double way_since(const Nearby* list, const double point[3]) {
  return sqrt(squared(point, list->place)) + ROUNDING;
}

// Lists the solids nearest to a point.
static void list_nearest(const Solid* solids, int64_t count, const double point[3], Nearby* list) {
  double* sorted = list->distance;
  int64_t which[LISTED + 1] = {0};
  for (int k = 0; k <= LISTED; ++k) sorted[k] = HUGE_VAL;
  for (int64_t s = 0; s < count; ++s) {
    const Solid* solid = solids + s;
    // Most need no closer look, since not even a ball about them comes so near.
    const double far = sorted[LISTED] + solid->size[0] + solid->size[1] + solid->size[2] + ROUNDING;
    if (squared(point, solid->position) > far * far) continue;
    const double distance = solid_distance(solid, point);
    int k = LISTED;
    if (distance >= sorted[k]) continue;
    for (; k > 0 && !(distance >= sorted[k - 1]); --k) {
      sorted[k] = sorted[k - 1], which[k] = which[k - 1];
    }
    sorted[k] = distance, which[k] = s;
  }
  for (int k = 0; k < 3; ++k) list->place[k] = point[k];
  for (int k = 0; k < LISTED && k < count; ++k) list->solid[k] = solids[which[k]];
}

// A ball about some of what can touch of an aircraft: its centre, body frame, its radius, and how
// far from the centre of mass it reaches [m].
typedef struct {
  double centre[3], radius, reach;
} Ball;

// The distance [m] of the balls of an aircraft, the one that reaches farthest first, from a solid, or
// `least` where that is less. p, r: position and rotation matrix to the world.
static inline __attribute__((always_inline)) double nearer(const Solid* solid, const Ball* balls,
                                                           int64_t parts, const double* p,
                                                           const double r[9], double least) {
  const double away = solid_distance(solid, p);
  if (away - balls->reach > least + ROUNDING) return least;
  double normal[3] = {0}, along[3];
  if (away > 0) solid_normal(solid, p, away, normal);
  for (int j = 0; j < 3; ++j) {
    along[j] = r[j] * normal[0] + r[3 + j] * normal[1] + r[6 + j] * normal[2];
  }
  for (const Ball* ball = balls; ball < balls + parts; ++ball) {
    if (away - ball->reach > least + ROUNDING) break;  // nor does what reaches less far
    const double *c = ball->centre, off = along[0] * c[0] + along[1] * c[1] + along[2] * c[2];
    // The distance from something convex grows at least as its slope says.
    if (away > 0 && away + off - ball->radius > least + ROUNDING) continue;
    double place[3];
    for (int j = 0; j < 3; ++j) {
      place[j] = p[j] + r[3 * j] * c[0] + r[3 * j + 1] * c[1] + r[3 * j + 2] * c[2];
    }
    const double free = solid_distance(solid, place) - ball->radius;
    least = free < least ? free : least;
  }
  return least;
}
