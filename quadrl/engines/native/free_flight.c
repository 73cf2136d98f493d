// Free flight: equations 3 to 10 of the paper, integrated by the classical Runge-Kutta method.
//
// Away from the ground an aircraft follows this ordinary differential equation and nothing else, so
// it needs no general engine. The attitude is of fourth order here and of second in MuJoCo, which
// turns the quaternion once per step by the mean of the stages' body rates.
#include <math.h>
#include <stddef.h>
#include <stdint.h>

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
// aircraft i are at i * stride doubles. parameters: with block = 0 a row for all, an Aircraft of
// one lane; else those of aircraft i..i+LANES-1 side by side at i / LANES * block doubles, an
// Aircraft without the rotors that there are not. rotors: the number that all have, at most
// MAX_ROTORS. solids: those of aircraft i, `count` of them, at i * count. nearby: the list of the
// nearest solids of each. Filled by quadrl/engines.
typedef struct {
  double *qpos, *qvel, *act;
  const double* ctrl;
  double* warm;
  const double *air, *parameters;
  const World* world;
  char* near;  // one per aircraft
  const Solid* solids;
  Nearby* nearby;
  int64_t stride, block, rotors, count;
} Rows;

// Advances aircraft first..last-1 by a number of steps, in place, except those that may touch
// something meanwhile, which are marked in near. The position of one whose parameters are not sound
// becomes NaN. first is a multiple of LANES. Returns how many are marked.
QUADRL_EXPORT int64_t quadrl_free_flight(const Rows* rows, int64_t first, int64_t last,
                                         int64_t steps) {
  const Rows r = *rows;
  const World* world = r.world;
  const int64_t stride = r.stride;
  double *qpos = r.qpos, *qvel = r.qvel, *act = r.act;
  const double* ctrl = r.ctrl;
  Lanes m[ROWS];
  Setting s;
  Aircraft same;
  const double time = steps * world->timestep;
  int64_t marked = 0;
  if (!r.block) spread(r.parameters, &same);
  const Aircraft* a = r.block ? (const Aircraft*)r.parameters : &same;
  const int rotors = (int)r.rotors;
  for (int64_t row = first; row < last; row += LANES) {
    const int filled = last - row < LANES ? (int)(last - row) : LANES;
    if (r.block) a = (const Aircraft*)(r.parameters + row / LANES * r.block);
    int air = WIND;
    for (int i = 0; i < LANES; ++i) {
      if (a->effects[i] != STILL_AIR) air = WIND + rotors;
    }
    for (int i = 0; i < LANES; ++i) {
      const int64_t place = (row + (i < filled ? i : 0)) * stride;  // spare lanes: twins
      for (int k = 0; k < 7; ++k) m[POSITION + k][i] = qpos[place + k];
      for (int k = 0; k < 6; ++k) m[VELOCITY + k][i] = qvel[place + k];
      for (int k = 0; k < rotors; ++k) m[SPEED + k][i] = act[place + k];
      for (int k = 0; k < rotors; ++k) s.command[k][i] = ctrl[place + k];
      for (int k = 0; k < air; ++k) s.air[k][i] = r.air[place + k];
      if (!is_sound(a, rotors, i)) m[POSITION][i] = m[POSITION + 2][i] = NAN;
    }
    double low[LANES], pull[LANES];
    int touching = 0;
    for (int i = 0; i < LANES; ++i) {
      pull[i] = strongest_pull(a, rotors, world, &s, m, time, i);
      low[i] = lowest(m, pull[i], time, i);
    }
    for (int i = 0; i < filled; ++i) {
      r.near[row + i] = low[i] < world->floor ||
                        may_touch(r.solids + (row + i) * r.count, r.count, r.nearby + row + i,
                                  world->reach, m, pull[i], time, i);
      touching += r.near[row + i];
    }
    marked += touching;
    if (touching == filled) continue;
    fly(a, effects_of(a, rotors, low), rotors, world, &s, m, steps);
    for (int i = 0; i < filled; ++i) {
      if (r.near[row + i]) continue;
      const int64_t place = (row + i) * stride;
      for (int k = 0; k < 7; ++k) qpos[place + k] = m[POSITION + k][i];
      for (int k = 0; k < 6; ++k) qvel[place + k] = m[VELOCITY + k][i];
      for (int k = 0; k < rotors; ++k) act[place + k] = m[SPEED + k][i];
      for (int k = 0; k < 6; ++k) r.warm[place + k] = 0;
    }
  }
  return marked;
}
