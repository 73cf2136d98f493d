// Distances along rays to the nearest solid or to the ground.
#include <math.h>
#include <stddef.h>
#include <stdint.h>

#include "export.h"
#include "solids.h"

// Frames in which rays keep their directions, in the order of quadrl/engines/solids.py.
enum { BODY, YAW, WORLD };
#ifndef MAX_RAYS
#define MAX_RAYS 1024
#endif
#ifdef SINGLE
#define TINY 1e-30
#else
#define TINY 1e-300
#endif

// Rays of a sensor on aircraft i, whose qpos (7) is at i * stride doubles and whose solids, `count`
// of them, are at i * count. along: unit vectors, x, y and z of all after each other. place: where
// they begin, body frame [m]. reach: the largest distance that is seen [m].
typedef struct {
  const double *qpos, *along, *place, *reach;
  const Solid* solids;
  int64_t stride, count, rays, frame;
} Finder;

// Directions of the rays of an aircraft, world frame, and how near each passes: see `pass`.
typedef struct {
  double x[MAX_RAYS], y[MAX_RAYS], z[MAX_RAYS], passes[MAX_RAYS];
} Fan;

// Marks rays that pass a mantle about an axis, or a ball with an axis of zero, from a point outside:
// those whose number is not negative. Most solids are met by few rays, so that most of the time goes
// into this. off: of the point from the middle; along: its part along the axis; outside: square of
// its distance from the axis less that of the radius [m].
VECTORISED static void pass(Fan* fan, int64_t n, const double off[3], const double axis[3], double along,
                     double outside) {
  for (int64_t k = 0; k < n; ++k) {
    const double x = fan->x[k], y = fan->y[k], z = fan->z[k];
    const double slope = x * axis[0] + y * axis[1] + z * axis[2];
    const double nears = along * slope - (x * off[0] + y * off[1] + z * off[2]);
    fan->passes[k] = nears * fabs(nears) - (1 - slope * slope) * outside;
  }
}

// The piece of a ray that lies within something convex: from enter to leave [m].
typedef struct {
  double enter, leave;
} Piece;

static inline void cut(Piece* piece, double one, double other) {
  const double enter = one < other ? one : other, leave = one < other ? other : one;
  piece->enter = enter > piece->enter ? enter : piece->enter;
  piece->leave = leave < piece->leave ? leave : piece->leave;
}

// Between the planes at -half and half of a coordinate that begins at `from`.
static inline void between(Piece* piece, double from, double slope, double half) {
  const double by = fabs(slope) < TINY ? TINY : slope;
  cut(piece, (-half - from) / by, (half - from) / by);
}

// As far as either reaches: both lie in something convex.
static inline void join(Piece* piece, const Piece* other) {
  if (!(other->enter < other->leave)) return;
  if (!(piece->enter < piece->leave)) *piece = *other;
  piece->enter = other->enter < piece->enter ? other->enter : piece->enter;
  piece->leave = other->leave > piece->leave ? other->leave : piece->leave;
}

// Within a ball about the origin (flat = 1), or within a mantle about the z axis (flat = 0).
static inline void within(Piece* piece, const double p[3], const double d[3], double radius,
                          double flat) {
  const double square = d[0] * d[0] + d[1] * d[1] + flat * d[2] * d[2];
  const double half = p[0] * d[0] + p[1] * d[1] + flat * p[2] * d[2];
  const double outside = p[0] * p[0] + p[1] * p[1] + flat * p[2] * p[2] - radius * radius;
  const double root = half * half - square * outside;
  if (square < TINY ? outside > 0 : root < 0) {
    piece->leave = -HUGE_VAL;
  } else if (square >= TINY) {  // else it is along the axis, and within all the way
    cut(piece, (-half - sqrt(root)) / square, (-half + sqrt(root)) / square);
  }
}

// Where a ray from a point of a solid's frame meets it [m]: from within at its far side, as MuJoCo
// has it; HUGE_VAL where it does not.
static double meet(const Solid* solid, const double from[3], const double along[3]) {
  const double *t = solid->turn, *size = solid->size;
  double d[3];
  for (int j = 0; j < 3; ++j) d[j] = t[j] * along[0] + t[3 + j] * along[1] + t[6 + j] * along[2];
  Piece piece = {-HUGE_VAL, HUGE_VAL};
  if (solid->kind == BOX) {
    for (int j = 0; j < 3; ++j) between(&piece, from[j], d[j], size[j]);
  } else {
    within(&piece, from, d, size[0], solid->kind == SPHERE);
    if (solid->kind != SPHERE) between(&piece, from[2], d[2], size[1]);
  }
  for (int end = -1; end <= 1 && solid->kind == CAPSULE; end += 2) {
    const double off[3] = {from[0], from[1], from[2] - end * size[1]};
    Piece ball = {-HUGE_VAL, HUGE_VAL};
    within(&ball, off, d, size[0], 1);
    join(&piece, &ball);
  }
  if (piece.enter > piece.leave || piece.leave < 0) return HUGE_VAL;
  return piece.enter < 0 ? piece.leave : piece.enter;
}

// Shortens rays [m] from a point to where they meet a solid within reach.
static void shorten(const Solid* solid, const double point[3], double reach, int64_t n, Fan* fan,
                    double* out) {
  double from[3], off[3], axis[3] = {0}, radius = solid->size[0], squares = 0, part = 0;
  if (solid->kind != SPHERE) {  // about the longest axis
    const double* s = solid->size;
    int longest = 2;
    if (solid->kind == BOX) {
      longest = s[0] > s[1] ? (s[0] > s[2] ? 0 : 2) : (s[1] > s[2] ? 1 : 2);
      const double one = s[(longest + 1) % 3], other = s[(longest + 2) % 3];
      radius = sqrt(one * one + other * other);
    }
    for (int j = 0; j < 3; ++j) axis[j] = solid->turn[3 * j + longest];
  }
  for (int j = 0; j < 3; ++j) {
    off[j] = point[j] - solid->position[j];
    squares += off[j] * off[j], part += off[j] * axis[j];
  }
  const double away = squares - part * part, far = reach + radius, wide = radius + ROUNDING;
  if (away > far * far) return;
  const int inside = away <= wide * wide;
  if (!inside) pass(fan, n, off, axis, part, away - wide * wide);
  to_solid(solid, point, from);
  for (int64_t k = 0; k < n; ++k) {
    if (!inside && fan->passes[k] < 0) continue;
    const double along[3] = {fan->x[k], fan->y[k], fan->z[k]}, meets = meet(solid, from, along);
    out[k] = meets < out[k] ? meets : out[k];
  }
}

// Turns rays with an aircraft of qpos p: where they begin, their directions, and distances [m] to the
// ground, or reach.
static void aim(Fan* fan, int64_t n, const double* along, const double* place, int frame,
                double reach, const double* p, double point[3], double* out) {
  double r[9], turn[9] = {1, 0, 0, 0, 1, 0, 0, 0, 1};
  rotation_of(p + 3, r);
  if (frame == YAW) {
    const double level = sqrt(r[0] * r[0] + r[3] * r[3]);
    const double c = level > 0 ? r[0] / level : 1, s = level > 0 ? r[3] / level : 0;
    turn[0] = turn[4] = c, turn[1] = -s, turn[3] = s;
  }
  const double* t = frame == BODY ? r : turn;
  for (int j = 0; j < 3; ++j) {
    point[j] = p[j] + r[3 * j] * place[0] + r[3 * j + 1] * place[1] + r[3 * j + 2] * place[2];
  }
  for (int64_t k = 0; k < n; ++k) {
    const double x = along[k], y = along[n + k], z = along[2 * n + k];
    fan->x[k] = t[0] * x + t[1] * y + t[2] * z;
    fan->y[k] = t[3] * x + t[4] * y + t[5] * z;
    fan->z[k] = t[6] * x + t[7] * y + t[8] * z;
    const double ground = point[2] / (fan->z[k] < -TINY ? -fan->z[k] : TINY);
    out[k] = ground >= 0 && ground < reach ? ground : reach;
  }
}

// Shortens them to the distance of a solid, if that is near enough.
static void look(const Solid* solid, const double point[3], double reach, int64_t n, Fan* fan,
                 double* out) {
  const double far = reach + solid->size[0] + solid->size[1] + solid->size[2];
  if (squared(point, solid->position) < far * far) shorten(solid, point, reach, n, fan, out);
}

#ifdef QUADRL_EXPORT
// Distances [m] (rays) for the aircraft first..last-1, or for those of ids; reach where none meets.
QUADRL_EXPORT int64_t quadrl_rays(const Finder* finder, int64_t first, int64_t last,
                                  const int64_t* ids, double* out) {
  const int64_t n = finder->rays;
  Fan fan;
  for (int64_t row = first; row < last; ++row) {
    const int64_t i = ids ? ids[row] : row;
    double point[3], *least = out + row * n;
    aim(&fan, n, finder->along, finder->place, (int)finder->frame, *finder->reach,
        finder->qpos + i * finder->stride, point, least);
    const Solid* solids = finder->solids + i * finder->count;
    for (const Solid* solid = solids; solid < solids + finder->count; ++solid) {
      look(solid, point, *finder->reach, n, &fan, least);
    }
  }
  return last - first;
}
#endif
