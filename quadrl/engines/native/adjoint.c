// The reverse of free flight: from the derivatives of a scalar by the motions after some physics
// steps to those by the motions before them and by the rotor commands.
//
// It is the reverse of the very steps of free_flight.c, stage by stage, not of the equation that
// they approximate: it agrees with differences of those steps to their rounding. In the names, x_
// is the derivative of the scalar by x.
#include <math.h>
#include <stdint.h>
#include <string.h>

// The reverse of a choice becomes vector instructions only where no operation counts as a trap.
#pragma GCC optimize("no-trapping-math")

#define LANES 8
#include "aero.h"
#include "export.h"
#include "runge_kutta.h"

#include "reverse.h"  // written by quadrl/engines/adjoint.py for EFFECTS of the air and ROTORS

// What the reverse needs of a step: the motions at its stages, and the quaternion at its end before
// it was normalised.
typedef struct {
  Lanes at[4][ROWS], quaternion[4];
} Step;

// Flies some steps from m.
VECTORISED static void there(const Aircraft* a, const World* world, Setting* s, Lanes* m,
                             int64_t steps, Step* path) {
  Stages t;
  prepare(a, EFFECTS, ROTORS, s);
  for (Step* now = path; now < path + steps; ++now) {
    memcpy(now->at[0], m, sizeof now->at[0]);
    for (int n = 0; n < 4; ++n) {
      do_stage(a, s, EFFECTS, ROTORS, world, n, m, &t);
      if (n < 3) memcpy(now->at[n + 1], t.at, sizeof t.at);
    }
    move(4, m + QUATERNION, world->timestep / 6, t.sum + QUATERNION, now->quaternion);
    finish_step(ROTORS, world, &t, m);
  }
}

// The reverse of a Runge-Kutta step: m_, the derivatives by the motion at its end, become those by
// the motion at its start.
INLINE void back_step(const Aircraft* a, const World* world, const Setting* s, const Step* step,
                      Lanes* m_, Lanes* command_) {
  const double h = world->timestep, ahead[3] = {0.5 * h, 0.5 * h, h};
  const double share[4] = {h / 6, h / 3, h / 3, h / 6};
  const int rows = SPEED + ROTORS;
  Lanes end_[ROWS], rate_[ROWS], at_[ROWS];
  // The step normalises the quaternion at its end.
  for (int i = 0; i < LANES; ++i) {
    double square = 0, along = 0;
    for (int k = 0; k < 4; ++k) {
      square += step->quaternion[k][i] * step->quaternion[k][i];
      along += step->quaternion[k][i] * m_[QUATERNION + k][i];
    }
    const double over = 1 / square, scale = sqrt(over);
    for (int k = 0; k < 4; ++k) {
      Lanes* q_ = m_ + QUATERNION + k;
      (*q_)[i] = scale * ((*q_)[i] - over * along * step->quaternion[k][i]);
    }
  }
  memcpy(end_, m_, sizeof end_);
  for (int n = 3; n >= 0; --n) {
    for (int k = 0; k < rows; ++k) {
      for (int i = 0; i < LANES; ++i) {
        rate_[k][i] = share[n] * end_[k][i] + (n < 3 ? ahead[n] * at_[k][i] : 0);
      }
    }
    back_derivative((const Lanes*)a, step->at[n], s->command, s->air, rate_, at_, command_);
    move(rows, m_, 1, at_, m_);
  }
}

VECTORISED static void back(const Aircraft* a, const World* world, const Setting* s, int64_t steps,
                            const Step* path, Lanes* m_, Lanes* command_) {
  while (steps-- > 0) back_step(a, world, s, path + steps, m_, command_);
}

// Whether a stage was where the ground has an effect that EFFECTS lack.
static int misses_ground(const Aircraft* a, const Step* path, int64_t steps, int filled) {
  if (EFFECTS == GROUND_EFFECT) return 0;
  for (const Step* step = path; step < path + steps; ++step) {
    for (int i = 0; i < filled; ++i) {
      for (int n = 0; n < 4; ++n) {
        if (is_near_ground(a, ROTORS, step->at[n][POSITION + 2][i], i)) return 1;
      }
    }
  }
  return 0;
}

// Addresses of the rows, all contiguous: motions (7 of qpos, 6 of qvel, one per rotor), commands
// (one per rotor), air (AIR) and parameters as in free_flight.c. given: the derivatives by the
// motions at the end, or NULL to fly without a reverse. Results: end, from_start and from_command.
// path: space for the steps. left: 1 for each LANES aircraft that are to be flown, 0 once they are.
// Filled by quadrl/engines.
typedef struct {
  const double *start, *command, *air, *parameters, *given;
  const World* world;
  double *end, *from_start, *from_command;
  Step* path;
  char* left;
  int64_t block;
} Legs;

// Flies `count` aircraft some steps, and goes back. Contacts are left out: the derivatives are
// those of a flight that touches nothing. All is NaN for an aircraft whose parameters are not
// sound. Aircraft that come where the ground has an effect which this kernel lacks are left to
// another.
QUADRL_EXPORT void quadrl_adjoint(const Legs* legs, int64_t count, int64_t steps) {
  const Legs r = *legs;
  Setting s;
  Aircraft same;
  Lanes m[ROWS] = {{0}}, m_[ROWS], command_[MAX_ROTORS];
  if (!r.block) spread(r.parameters, &same);
  const Aircraft* a = r.block ? (const Aircraft*)r.parameters : &same;
  const int rows = SPEED + ROTORS;
  for (int64_t row = 0; row < count; row += LANES) {
    if (!r.left[row / LANES]) continue;
    const int filled = count - row < LANES ? (int)(count - row) : LANES;
    if (r.block) a = (const Aircraft*)(r.parameters + row / LANES * r.block);
    for (int i = 0; i < LANES; ++i) {
      const int64_t place = row + (i < filled ? i : 0);  // spare lanes: twins
      for (int k = 0; k < rows; ++k) m[k][i] = r.start[place * rows + k];
      for (int k = 0; k < rows; ++k) m_[k][i] = r.given ? r.given[place * rows + k] : 0;
      for (int k = 0; k < ROTORS; ++k) s.command[k][i] = r.command[place * ROTORS + k];
      for (int k = 0; k < AIR; ++k) s.air[k][i] = r.air[place * AIR + k];
      if (!is_sound(a, ROTORS, i)) m[QUATERNION][i] = NAN;
    }
    memset(command_, 0, sizeof command_);
    there(a, r.world, &s, m, steps, r.path);
    if (misses_ground(a, r.path, steps, filled)) continue;
    r.left[row / LANES] = 0;
    if (r.given) back(a, r.world, &s, steps, r.path, m_, command_);
    for (int i = 0; i < filled; ++i) {
      for (int k = 0; k < rows; ++k) r.end[(row + i) * rows + k] = m[k][i];
      if (!r.given) continue;
      for (int k = 0; k < rows; ++k) r.from_start[(row + i) * rows + k] = m_[k][i];
      for (int k = 0; k < ROTORS; ++k) {
        r.from_command[(row + i) * ROTORS + k] = command_[k][i];
      }
    }
  }
}
