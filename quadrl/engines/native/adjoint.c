// The reverse of free flight: from the derivatives of a number by where aircraft are after some
// physics steps to those by where they were and by what their rotors were commanded.
//
// It is the reverse of the very steps that free_flight.c makes, stage by stage, not of the equation
// that they approximate: it agrees with differences of those steps to their rounding.
#include <math.h>
#include <stdint.h>
#include <string.h>

#define LANES 8
#include "adjoint.h"
#include "export.h"

// Of one Runge-Kutta step from m: m_, the derivatives by where it leads, become those by m.
INLINE void back_step(const Aircraft* a, int effects, int rotors, const World* world,
                      const Setting* s, const Lanes* m, Lanes* m_, Lanes* command_) {
  const double h = world->timestep, ahead[3] = {0.5 * h, 0.5 * h, h};
  const double share[4] = {h / 6, h / 3, h / 3, h / 6};
  const int rows = SPEED + rotors;
  Lanes at[4][ROWS], rate[4][ROWS], end_[ROWS], rate_[ROWS], at_[ROWS];
  memcpy(at[0], m, sizeof at[0]);
  for (int n = 0; n < 4; ++n) {
    derivative(a, s, effects, rotors, world->gravity, at[n], rate[n]);
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
    memset(at_, 0, sizeof at_);
    back_derivative(a, s, effects, rotors, world->gravity, at[n], rate[n], rate_, at_, command_);
    move(rows, m_, 1, at_, m_);
  }
}

// Flies some steps from m, whose beginnings it keeps in `path`; then, if m_ holds the derivatives
// by where they lead, it makes them those by m.
INLINE void there_and_back(const Aircraft* a, int effects, int rotors, const World* world,
                           Setting* s, Lanes* m, int64_t steps, Lanes* path, Lanes* m_,
                           Lanes* command_) {
  for (int64_t step = 0; step < steps; ++step) {
    memcpy(path + ROWS * step, m, ROWS * sizeof(Lanes));
    runge_kutta(a, effects, rotors, world, s, m, 1);
  }
  for (int64_t step = steps; m_ && step-- > 0;) {
    back_step(a, effects, rotors, world, s, path + ROWS * step, m_, command_);
  }
}

VECTORISED static void calm(const Aircraft* a, int rotors, const World* world, Setting* s, Lanes* m,
                            int64_t steps, Lanes* path, Lanes* m_, Lanes* command_) {
  if (rotors == 4) {
    there_and_back(a, STILL_AIR, 4, world, s, m, steps, path, m_, command_);
  } else {
    there_and_back(a, STILL_AIR, rotors, world, s, m, steps, path, m_, command_);
  }
}

VECTORISED static void in_air(const Aircraft* a, int rotors, const World* world, Setting* s,
                              Lanes* m, int64_t steps, Lanes* path, Lanes* m_, Lanes* command_) {
  there_and_back(a, ROTOR_EFFECTS, rotors, world, s, m, steps, path, m_, command_);
}

VECTORISED static void near_ground(const Aircraft* a, int rotors, const World* world, Setting* s,
                                   Lanes* m, int64_t steps, Lanes* path, Lanes* m_,
                                   Lanes* command_) {
  there_and_back(a, GROUND_EFFECT, rotors, world, s, m, steps, path, m_, command_);
}

// Where the rows are, all contiguous: motions (7 of qpos, 6 of qvel, one per rotor), commands (one
// per rotor), air (AIR) and parameters as in free_flight.c. given: the derivatives by the motions
// at the end, or NULL to fly alone. Filled: end, from_start and from_command. path has room for
// ROWS * LANES numbers per step. rotors: as in free_flight.c. Filled by quadrl/engines.
typedef struct {
  const double *start, *command, *air, *parameters, *given;
  const World* world;
  double *end, *from_start, *from_command, *path;
  int64_t block, rotors;
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
  const int rotors = (int)r.rotors, rows = SPEED + rotors;
  for (int64_t row = 0; row < count; row += LANES) {
    const int filled = count - row < LANES ? (int)(count - row) : LANES;
    if (r.block) a = (const Aircraft*)(r.parameters + row / LANES * r.block);
    int effects = STILL_AIR;
    for (int i = 0; i < LANES; ++i) {
      const int64_t place = row + (i < filled ? i : 0);  // spare lanes: twins
      for (int k = 0; k < rows; ++k) m[k][i] = r.start[place * rows + k];
      for (int k = 0; k < rows; ++k) m_[k][i] = r.given ? r.given[place * rows + k] : 0;
      for (int k = 0; k < rotors; ++k) s.command[k][i] = r.command[place * rotors + k];
      for (int k = 0; k < AIR; ++k) s.air[k][i] = r.air[place * AIR + k];
      if (aero_effects(a, i) > effects) effects = aero_effects(a, i);
      if (!is_sound(a, rotors, i)) m[QUATERNION][i] = NAN;
    }
    memset(command_, 0, sizeof command_);
    Lanes* back = r.given ? m_ : 0;
    Lanes* path = (Lanes*)r.path;
    if (effects == GROUND_EFFECT) {
      near_ground(a, rotors, r.world, &s, m, steps, path, back, command_);
    } else if (effects == ROTOR_EFFECTS) {
      in_air(a, rotors, r.world, &s, m, steps, path, back, command_);
    } else {
      calm(a, rotors, r.world, &s, m, steps, path, back, command_);
    }
    for (int i = 0; i < filled; ++i) {
      for (int k = 0; k < rows; ++k) r.end[(row + i) * rows + k] = m[k][i];
      if (!r.given) continue;
      for (int k = 0; k < rows; ++k) r.from_start[(row + i) * rows + k] = m_[k][i];
      for (int k = 0; k < rotors; ++k) {
        r.from_command[(row + i) * rotors + k] = command_[k][i];
      }
    }
  }
}
