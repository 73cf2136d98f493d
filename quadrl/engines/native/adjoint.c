// The reverse of free flight: from the derivatives of a number by where aircraft are after some
// physics steps to those by where they were and by what their rotors were commanded.
//
// It is the reverse of the very steps that free_flight.c makes, stage by stage, not of the equation
// that they approximate: it agrees with differences of those steps to their rounding. In the names,
// x_ is the derivative of that number by x.
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

// A function of its own, which spares the compiler the copies that a loop over stages would make.
VECTORISED static void rate_at(const Aircraft* restrict a, const Setting* restrict s,
                               double gravity, const Lanes* restrict m, Lanes* restrict rate) {
  derivative(a, s, EFFECTS, ROTORS, gravity, m, rate);
}

// Of one Runge-Kutta step from m: m_, the derivatives by where it leads, become those by m.
INLINE void back_step(const Aircraft* a, const World* world, const Setting* s, const Lanes* m,
                      Lanes* m_, Lanes* command_) {
  const double h = world->timestep, ahead[3] = {0.5 * h, 0.5 * h, h};
  const double share[4] = {h / 6, h / 3, h / 3, h / 6};
  const int rows = SPEED + ROTORS;
  Lanes at[4][ROWS], rate[4][ROWS], end_[ROWS], rate_[ROWS], at_[ROWS];
  memcpy(at[0], m, sizeof at[0]);
  for (int n = 0; n < 4; ++n) {
    rate_at(a, s, world->gravity, at[n], rate[n]);
    if (n < 3) move(rows, m, ahead[n], rate[n], at[n + 1]);
  }
  // The quaternion is made one of unit length at the end.
  for (int i = 0; i < LANES; ++i) {
    double q[4], square = 0, along = 0;
    for (int k = 0; k < 4; ++k) {
      const int row = QUATERNION + k;
      q[k] = m[row][i] + h / 6 * (rate[0][row][i] + 2 * rate[1][row][i] + 2 * rate[2][row][i] +
                                  rate[3][row][i]);
      square += q[k] * q[k];
      along += q[k] * m_[row][i];
    }
    const double over = 1 / square, scale = sqrt(over);
    for (int k = 0; k < 4; ++k) {
      m_[QUATERNION + k][i] = scale * (m_[QUATERNION + k][i] - over * along * q[k]);
    }
  }
  memcpy(end_, m_, sizeof end_);
  for (int n = 3; n >= 0; --n) {
    for (int k = 0; k < rows; ++k) {
      for (int i = 0; i < LANES; ++i) {
        rate_[k][i] = share[n] * end_[k][i] + (n < 3 ? ahead[n] * at_[k][i] : 0);
      }
    }
    back_derivative((const Lanes*)a, at[n], s->command, s->air, rate_, at_, command_);
    move(rows, m_, 1, at_, m_);
  }
}

// Flies some steps from m, whose beginnings it keeps in `path`; then, if m_ holds the derivatives
// by where they lead, it makes them those by m.
VECTORISED static void there_and_back(const Aircraft* a, const World* world, Setting* s, Lanes* m,
                                      int64_t steps, Lanes* path, Lanes* m_, Lanes* command_) {
  for (int64_t step = 0; step < steps; ++step) {
    memcpy(path + ROWS * step, m, ROWS * sizeof(Lanes));
    runge_kutta(a, EFFECTS, ROTORS, world, s, m, 1);
  }
  for (int64_t step = steps; m_ && step-- > 0;) {
    back_step(a, world, s, path + ROWS * step, m_, command_);
  }
}

// Where the rows are, all contiguous: motions (7 of qpos, 6 of qvel, one per rotor), commands (one
// per rotor), air (AIR) and parameters as in free_flight.c. given: the derivatives by the motions
// at the end, or NULL to fly alone. Filled: end, from_start and from_command. path has room for
// ROWS * LANES numbers per step. Filled by quadrl/engines.
typedef struct {
  const double *start, *command, *air, *parameters, *given;
  const World* world;
  double *end, *from_start, *from_command, *path;
  int64_t block;
} Legs;

// Flies `count` aircraft some steps, and goes back. It knows no ground: the derivatives are those
// of a flight that touches nothing. Nothing of one whose parameters are not sound is a number.
QUADRL_EXPORT void quadrl_adjoint(const Legs* legs, int64_t count, int64_t steps) {
  const Legs r = *legs;
  Setting s;
  Aircraft same;
  Lanes m[ROWS] = {{0}}, m_[ROWS], command_[MAX_ROTORS];
  if (!r.block) {
    for (int k = 0; k < ROW_SIZE; ++k) {
      for (int i = 0; i < LANES; ++i) ((double*)&same)[k * LANES + i] = r.parameters[k];
    }
  }
  const Aircraft* a = r.block ? (const Aircraft*)r.parameters : &same;
  const int rows = SPEED + ROTORS;
  for (int64_t row = 0; row < count; row += LANES) {
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
    there_and_back(a, r.world, &s, m, steps, (Lanes*)r.path, r.given ? m_ : 0, command_);
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
