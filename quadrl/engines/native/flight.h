// A few aircraft in flight, side by side: read from the rows of a simulation, advanced, written back.
//
// Away from the ground an aircraft follows an ordinary differential equation and nothing else, so it
// needs no general engine. The attitude is of fourth order here and of second in MuJoCo, which turns
// the quaternion once per step by the mean of the stages' body rates.
#ifndef QUADRL_FLIGHT_H_
#define QUADRL_FLIGHT_H_

#include <math.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>

// Aircraft are flown LANES at a time, so that the compiler makes vector instructions of them: the
// same operations, each rounded as IEEE 754 says, so that no bit depends on the machine's vectors.
#define LANES 8
#include "aero.h"
#include "export.h"
#include "runge_kutta.h"
#include "solids.h"

VECTORISED static void fly(const Aircraft* a, int effects, int rotors, const World* world,
                           Setting* s, Lanes* m, int64_t steps) {
  if (effects == GROUND_EFFECT) {
    runge_kutta(a, GROUND_EFFECT, rotors, world, s, m, steps);
  } else if (effects == ROTOR_EFFECTS) {
    runge_kutta(a, ROTOR_EFFECTS, rotors, world, s, m, steps);
  } else if (rotors == 4) {  // with the number of rotors known, the compiler unrolls their loop
    runge_kutta(a, STILL_AIR, 4, world, s, m, steps);
  } else {
    runge_kutta(a, STILL_AIR, rotors, world, s, m, steps);
  }
}

// Upper bound of the acceleration of the aircraft of a lane within `time` [s].
static double strongest_pull(const Aircraft* a, int rotors, const World* world, const Setting* s,
                             const Lanes* m, double time, int i) {
  double lift = 0, squares = 0, speeds = 0;
  for (int k = 0; k < rotors; ++k) {
    const double speed = m[SPEED + k][i], wanted = s->command[k][i];
    const double fastest = speed > wanted ? speed : wanted;
    lift += aero_rotor_gain(a->rotor + k, fastest, i) * fastest;
    speeds += fastest;
  }
  for (int k = 0; k < 3; ++k) {
    const double air = m[VELOCITY + k][i] - s->air[k][i];
    squares += air * air;
  }
  const double f[3] = {a->steady_force[0][i], a->steady_force[1][i], a->steady_force[2][i]};
  double pull = fabs(world->gravity) + (lift + aero_length(f)) / a->mass[i] +
                aero_largest_drag(a, squares, i);
  if (a->effects[i] != STILL_AIR) {
    const double r[3] = {m[BODY_RATE][i], m[BODY_RATE + 1][i], m[BODY_RATE + 2][i]};
    double reach, radius;
    extent(a, rotors, &reach, &radius, i);
    pull += (aero_largest_lift(a, i) - 1) * lift / a->mass[i];
    pull += aero_largest_push(a, speeds, sqrt(squares) + aero_length(r) * reach + pull * time, i);
  }
  return pull;
}

// Lower bound of its height in that time.
static double lowest(const Lanes* m, double pull, double time, int i) {
  const double sink = m[VELOCITY + 2][i] < 0 ? -m[VELOCITY + 2][i] : 0;
  return m[POSITION + 2][i] - (sink + pull * time) * time;
}

// Whether it may touch a solid in that time; everything of it is within `reach` [m].
static int may_touch(const Solid* solids, int64_t count, Nearby* list, double reach, const Lanes* m,
                     double pull, double time, int i) {
  if (count == 0) return 0;
  const double p[3] = {m[POSITION][i], m[POSITION + 1][i], m[POSITION + 2][i]};
  const double v[3] = {m[VELOCITY][i], m[VELOCITY + 1][i], m[VELOCITY + 2][i]};
  const double way = (aero_length(v) + pull * time) * time + reach + list->leap;
  if (way_since(list, p) + way < list->distance[0]) return 0;
  if (!(way_since(list, p) + way < list->distance[LISTED])) list_nearest(solids, count, p, list);
  for (int64_t k = 0; k < count && k < LISTED; ++k) {
    if (!(solid_distance(list->solid + k, p) > way)) return 1;
  }
  return !(way_since(list, p) + way < list->distance[LISTED]);
}

// The largest effects of aircraft that stay above a height each (`low`), without a ground effect
// that is exactly zero up there.
static int effects_of(const Aircraft* a, int rotors, const double low[LANES]) {
  int effects = STILL_AIR;
  for (int i = 0; i < LANES; ++i) {
    int own = aero_effects(a, i);
    if (own == GROUND_EFFECT && !is_near_ground(a, rotors, low[i], i)) own = ROTOR_EFFECTS;
    if (own > effects) effects = own;
  }
  return effects;
}

// Addresses of the rows of a simulation. qpos (7), qvel (6), act, ctrl (one per rotor), warm (6,
// MuJoCo's warm start, cleared) and air (AIR: wind [m/s, world], noise of the rotors' thrust) of
// aircraft i are at i * stride doubles. ceiling: the
// largest commands that the rotors take, side by side. parameters: with block = 0 a row for all, an Aircraft of
// one lane; else those of aircraft i..i+LANES-1 side by side at i / LANES * block doubles, an
// Aircraft without the rotors that there are not. rotors: the number that all have, at most
// MAX_ROTORS. world: NULL where MuJoCo flies them all, and then parameters are not looked at.
// solids: those of aircraft i, `count` of them, at i * count. nearby: the list of the nearest solids
// of each. Filled by quadrl/engines.
typedef struct {
  double *qpos, *qvel, *act, *ctrl, *warm;
  const double *air, *ceiling, *parameters;
  const World* world;
  char* near;  // one per aircraft
  const Solid* solids;
  Nearby* nearby;
  int64_t stride, block, rotors, count;
} Rows;

// LANES aircraft in flight.
typedef struct {
  int64_t row[LANES];  // which ones; spare lanes have twins
  int filled;          // lanes that are not spare
  const Aircraft* a;
  Lanes m[ROWS];
  Setting s;
} Block;

// Reads aircraft first..last-1 of a list (NULL: of all) that fit. `own` is room for parameters.
static void load(const Rows* r, const int64_t* ids, int64_t first, int64_t last, Block* b,
                 Aircraft* own) {
  const int rotors = (int)r->rotors;
  b->filled = last - first < LANES ? (int)(last - first) : LANES;
  for (int i = 0; i < LANES; ++i) {
    const int64_t k = first + (i < b->filled ? i : 0);
    b->row[i] = ids ? ids[k] : k;
  }
  b->a = own;
  if (r->block && !ids) {
    b->a = (const Aircraft*)(r->parameters + first / LANES * r->block);
    // Those of the next ones, which do not follow each other as they are read.
    const double* next = r->parameters + (first / LANES + 1) * r->block;
    for (int64_t k = 0; k < r->block && first + LANES < last; k += LANES) __builtin_prefetch(next + k);
  } else if (r->block) {
    for (int i = 0; i < LANES; ++i) {
      const double* from = r->parameters + b->row[i] / LANES * r->block + b->row[i] % LANES;
      for (int64_t k = 0; k < r->block / LANES; ++k) ((double*)own)[k * LANES + i] = from[k * LANES];
    }
  }
  int air = WIND;
  for (int i = 0; i < LANES; ++i) {
    if (b->a->effects[i] != STILL_AIR) air = WIND + rotors;
  }
  for (int i = 0; i < LANES; ++i) {
    const int64_t place = b->row[i] * r->stride;
    for (int k = 0; k < 7; ++k) b->m[POSITION + k][i] = r->qpos[place + k];
    for (int k = 0; k < 6; ++k) b->m[VELOCITY + k][i] = r->qvel[place + k];
    for (int k = 0; k < rotors; ++k) b->m[SPEED + k][i] = r->act[place + k];
    for (int k = 0; k < rotors; ++k) b->s.command[k][i] = r->ctrl[place + k];
    for (int k = 0; k < air; ++k) b->s.air[k][i] = r->air[place + k];
    if (r->world && !is_sound(b->a, rotors, i)) b->m[POSITION][i] = b->m[POSITION + 2][i] = NAN;
  }
}

// Advances the aircraft of a block by some physics steps, except those that may touch something
// meanwhile, which are marked in near. The position of one whose parameters are not sound is NaN.
static void advance(const Rows* r, Block* b, int64_t steps) {
  const World* world = r->world;
  const int rotors = (int)r->rotors;
  const double time = steps * world->timestep;
  double low[LANES], pull[LANES];
  int touching = 0;
  for (int i = 0; i < LANES; ++i) {
    pull[i] = strongest_pull(b->a, rotors, world, &b->s, b->m, time, i);
    low[i] = lowest(b->m, pull[i], time, i);
  }
  for (int i = 0; i < b->filled; ++i) {
    const int64_t row = b->row[i];
    r->near[row] = low[i] < world->floor ||
                   may_touch(r->solids + row * r->count, r->count, r->nearby + row, world->reach,
                             b->m, pull[i], time, i);
    touching += r->near[row];
  }
  if (touching == b->filled) return;
  fly(b->a, effects_of(b->a, rotors, low), rotors, world, &b->s, b->m, steps);
}

// Writes back the motion of those aircraft of a block that are not marked in near; returns how many
// are.
static int64_t store(const Rows* r, const Block* b) {
  int64_t marked = 0;
  for (int i = 0; i < b->filled; ++i) {
    if (r->near[b->row[i]]) {
      ++marked;
      continue;
    }
    const int64_t place = b->row[i] * r->stride;
    for (int k = 0; k < 7; ++k) r->qpos[place + k] = b->m[POSITION + k][i];
    for (int k = 0; k < 6; ++k) r->qvel[place + k] = b->m[VELOCITY + k][i];
    for (int k = 0; k < r->rotors; ++k) r->act[place + k] = b->m[SPEED + k][i];
    for (int k = 0; k < 6; ++k) r->warm[place + k] = 0;
  }
  return marked;
}

#endif  // QUADRL_FLIGHT_H_
