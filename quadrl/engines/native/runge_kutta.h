// Equations 3 to 10 and the air, and the classical Runge-Kutta steps of them, for free_flight.c.
#ifndef QUADRL_RUNGE_KUTTA_H_
#define QUADRL_RUNGE_KUTTA_H_

#include <math.h>
#include <stdint.h>

#include "aero.h"

// Keeps the compiler from joining what is before it with what comes after.
#ifndef KEPT_APART
#define KEPT_APART __asm__("" ::: "memory")
#endif
#define INLINE static inline __attribute__((always_inline))

// Rows of a motion, with a column for each aircraft. Rates of change are in the same rows.
enum {
  POSITION = 0,     // [m], world
  QUATERNION = 3,   // w, x, y, z, body to world
  VELOCITY = 7,     // [m/s], world
  BODY_RATE = 10,   // [rad/s], body
  SPEED = 13,       // of the rotors [rad/s]
  ROWS = SPEED + MAX_ROTORS
};
// The same for all aircraft. gravity [m/s^2] is along z. An aircraft may touch something only with
// its centre of mass below `floor`, or nearer to a solid than `reach` [m].
typedef struct {
  double timestep, gravity, floor, reach;
} World;

// Constants of the steps of one call.
typedef struct {
  Lanes lever[6 * MAX_ROTORS], command[MAX_ROTORS];
  Lanes air[AIR];
  Disc disc[MAX_ROTORS];
} Setting;

// Gives every lane the same row of parameters.
static inline void spread(const double* row, Aircraft* a) {
  for (int k = 0; k < ROW_SIZE; ++k) {
    for (int i = 0; i < LANES; ++i) ((double*)a)[k * LANES + i] = row[k];
  }
}

// Whether a row of parameters, which users can edit, is still one with so many rotors.
INLINE int is_sound(const Aircraft* a, int rotors, int i) {
  return a->rotor_count[i] == rotors && aero_effects(a, i) >= 0;
}

// Distance of the farthest rotor from the centre of mass [m], and the largest disc.
static inline void extent(const Aircraft* a, int rotors, double* reach, double* radius, int i) {
  *reach = *radius = 0;
  for (int k = 0; k < rotors; ++k) {
    const Rotor* rotor = a->rotor + k;
    const double r[3] = {rotor->position[0][i], rotor->position[1][i], rotor->position[2][i]};
    const double distance = aero_length(r);
    *reach = distance > *reach ? distance : *reach;
    *radius = rotor->disc_radius[i] > *radius ? rotor->disc_radius[i] : *radius;
  }
}

// Rotation matrix, body to world. Between the stages the quaternion is not quite of unit length;
// only its direction counts.
INLINE void rotation(const Lanes* q, double turn[3][3], int i) {
  const double w = q[0][i], x = q[1][i], y = q[2][i], z = q[3][i];
  const double twice = 2 / (w * w + x * x + y * y + z * z);
  const double rows[3][3] = {
      {1 - twice * (y * y + z * z), twice * (x * y - w * z), twice * (x * z + w * y)},
      {twice * (x * y + w * z), 1 - twice * (x * x + z * z), twice * (y * z - w * x)},
      {twice * (x * z - w * y), twice * (y * z + w * x), 1 - twice * (x * x + y * y)}};
  for (int k = 0; k < 3; ++k) {
    for (int n = 0; n < 3; ++n) turn[k][n] = rows[k][n];
  }
}

// Velocity minus wind, body frame.
INLINE void airspeed_of(const Setting* s, const Lanes* m, double turn[3][3], double u[3], int i) {
  const double air[3] = {m[VELOCITY][i] - s->air[0][i], m[VELOCITY + 1][i] - s->air[1][i],
                         m[VELOCITY + 2][i] - s->air[2][i]};
  for (int k = 0; k < 3; ++k) {
    u[k] = turn[0][k] * air[0] + turn[1][k] * air[1] + turn[2][k] * air[2];
  }
}

// The time derivative of a motion. The loops over the lanes become vector instructions; loops over
// the rotors would not, since their number is not known.
INLINE void derivative(const Aircraft* a, const Setting* s, int effects, int rotors,
                       double gravity, const Lanes* m, Lanes* d) {
  Lanes push[3], twist[3], airspeed[3], up[3];
  for (int n = 0; n < 3; ++n) {
    for (int i = 0; i < LANES; ++i) push[n][i] = twist[n][i] = 0;
    KEPT_APART;  // GCC would clear both by string instructions, which take as long as all the rest
  }
  for (int k = 0; k < rotors; ++k) {
    const Rotor* rotor = a->rotor + k;
    const Lanes* lever = s->lever + 6 * k;
    for (int i = 0; i < LANES; ++i) {
      const double speed = m[SPEED + k][i];
      const double thrust = aero_rotor_gain(rotor, speed, i) * speed;
      for (int n = 0; n < 3; ++n) {
        push[n][i] = push[n][i] + lever[n][i] * thrust;
        twist[n][i] = twist[n][i] + lever[3 + n][i] * thrust;
      }
      d[SPEED + k][i] = aero_rotor_acceleration(rotor, speed, s->command[k][i], i);
    }
  }
  if (effects != STILL_AIR) {
    for (int i = 0; i < LANES; ++i) {
      double turn[3][3], u[3];
      rotation(m + QUATERNION, turn, i);
      airspeed_of(s, m, turn, u, i);
      for (int k = 0; k < 3; ++k) {
        airspeed[k][i] = u[k];
        up[k][i] = turn[2][k];
      }
    }
    aero_rotors(a, s->disc, effects, rotors, m + SPEED, s->command, s->air + WIND, airspeed,
                m + BODY_RATE, up, m[POSITION + 2], push, twist);
  }
  for (int i = 0; i < LANES; ++i) {
    double force[3] = {push[0][i], push[1][i], push[2][i]};
    double moment[3] = {twist[0][i], twist[1][i], twist[2][i]};
    const double w = m[QUATERNION][i], x = m[QUATERNION + 1][i], y = m[QUATERNION + 2][i],
                 z = m[QUATERNION + 3][i];
    double turn[3][3], u[3];
    rotation(m + QUATERNION, turn, i);
    airspeed_of(s, m, turn, u, i);
    const double r[3] = {m[BODY_RATE][i], m[BODY_RATE + 1][i], m[BODY_RATE + 2][i]};
    aero_wrench(a, u, r, force, moment, i);
    for (int k = 0; k < 3; ++k) {
      const double pull = turn[k][0] * force[0] + turn[k][1] * force[1] + turn[k][2] * force[2];
      d[POSITION + k][i] = m[VELOCITY + k][i];
      d[VELOCITY + k][i] = (pull + a->steady_force[k][i]) / a->mass[i] + (k == 2 ? gravity : 0);
    }
    const double j[3] = {a->inertia[0][i], a->inertia[1][i], a->inertia[2][i]};
    d[BODY_RATE][i] = (moment[0] - (j[2] - j[1]) * r[1] * r[2]) / j[0];
    d[BODY_RATE + 1][i] = (moment[1] - (j[0] - j[2]) * r[2] * r[0]) / j[1];
    d[BODY_RATE + 2][i] = (moment[2] - (j[1] - j[0]) * r[0] * r[1]) / j[2];
    d[QUATERNION][i] = 0.5 * (-x * r[0] - y * r[1] - z * r[2]);
    d[QUATERNION + 1][i] = 0.5 * (w * r[0] + y * r[2] - z * r[1]);
    d[QUATERNION + 2][i] = 0.5 * (w * r[1] + z * r[0] - x * r[2]);
    d[QUATERNION + 3][i] = 0.5 * (w * r[2] + x * r[1] - y * r[0]);
  }
}

INLINE void move(int rows, const Lanes* from, double time, const Lanes* rate, Lanes* to) {
  for (int k = 0; k < rows; ++k) {
    for (int i = 0; i < LANES; ++i) to[k][i] = from[k][i] + time * rate[k][i];
  }
}

// Motion and rate of the present stage of a step, and the weighted sum of the rates.
typedef struct {
  Lanes at[ROWS], rate[ROWS], sum[ROWS];
} Stages;

INLINE void do_stage(const Aircraft* a, const Setting* s, int effects, int rotors,
                     const World* world, int number, const Lanes* m, Stages* t) {
  const double h = world->timestep, ahead[4] = {0.5 * h, 0.5 * h, h, 0}, weight[4] = {1, 2, 2, 1};
  const int rows = SPEED + rotors;
  Lanes* rate = number ? t->rate : t->sum;
  derivative(a, s, effects, rotors, world->gravity, number ? t->at : m, rate);
  if (number) move(rows, t->sum, weight[number], rate, t->sum);
  if (number < 3) move(rows, m, ahead[number], rate, t->at);
}

// Computes the constants of the steps.
INLINE void prepare(const Aircraft* a, int effects, int rotors, Setting* s) {
  for (int k = 0; k < rotors; ++k) {
    for (int i = 0; i < LANES; ++i) {
      double column[6];
      aero_rotor_lever(a->rotor + k, column, i);
      for (int n = 0; n < 6; ++n) s->lever[6 * k + n][i] = column[n];
    }
    if (effects != STILL_AIR) aero_disc(a, a->rotor + k, s->disc + k);
  }
}

// Adds the rates of the stages to the motion, and normalises the quaternion.
INLINE void finish_step(int rotors, const World* world, const Stages* t, Lanes* m) {
  move(SPEED + rotors, m, world->timestep / 6, t->sum, m);
  Lanes* q = m + QUATERNION;
  Lanes scale;
  for (int i = 0; i < LANES; ++i) {
    scale[i] = 1 / sqrt(q[0][i] * q[0][i] + q[1][i] * q[1][i] + q[2][i] * q[2][i] +
                        q[3][i] * q[3][i]);
  }
  for (int k = 0; k < 4; ++k) {
    for (int i = 0; i < LANES; ++i) q[k][i] *= scale[i];
  }
}

INLINE void runge_kutta(const Aircraft* a, int effects, int rotors, const World* world,
                        Setting* s, Lanes* m, int64_t steps) {
  Stages t;
  prepare(a, effects, rotors, s);
  for (int64_t step = 0; step < steps; ++step) {
    if (effects == STILL_AIR && rotors == 4) {  // written out it is a little faster
      do_stage(a, s, effects, rotors, world, 0, m, &t);
      do_stage(a, s, effects, rotors, world, 1, m, &t);
      do_stage(a, s, effects, rotors, world, 2, m, &t);
      do_stage(a, s, effects, rotors, world, 3, m, &t);
    } else {
      for (int n = 0; n < 4; ++n) do_stage(a, s, effects, rotors, world, n, m, &t);
    }
    finish_step(rotors, world, &t, m);
  }
}

// Whether an aircraft with a ground effect is near enough to the ground for it, with the centre of
// mass at a height.
static inline int is_near_ground(const Aircraft* a, int rotors, double height, int i) {
  double reach, radius;
  if (a->effects[i] != GROUND_EFFECT) return 0;
  extent(a, rotors, &reach, &radius, i);
  return height - reach <= 8 * radius;
}

#endif  // QUADRL_RUNGE_KUTTA_H_
