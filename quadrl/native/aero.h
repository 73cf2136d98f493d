// Everything that acts on an aircraft, once, for the MuJoCo callbacks and for free flight.
//
// Aircraft are flown LANES at a time: every parameter is an array of LANES numbers, and each
// function takes the lane i. The callbacks have one lane, which makes an Aircraft exactly a row of
// quadrl/parameters.py. The same equations in NumPy and torch stand in quadrl/dynamics.py.
//
// Body frame: x forward, y left, z up, the origin at the centre of mass.
#ifndef QUADRL_AERO_H_
#define QUADRL_AERO_H_

#include <math.h>

#include "layout.h"  // Rotor, Aircraft: written by quadrl/native from quadrl/parameters.py

#define AERO static inline __attribute__((always_inline))

// Equation 10: the lag of the rotor speed [rad/s^2]; it may rise and fall at different rates, and a
// command above the rotor's largest speed asks for that.
AERO double aero_rotor_acceleration(const Rotor* rotor, double speed, double command, int i) {
  const double goal = command < rotor->max_speed[i] ? command : rotor->max_speed[i];
  const double rate = goal > speed ? rotor->lag_up[i] : rotor->lag_down[i];
  return -rate * (speed - goal);
}

// Equation 7 as MuJoCo wants it: thrust over the rotor speed [N s]. The reaction torque is the
// thrust times aero_reaction about the same axis.
AERO double aero_rotor_gain(const Rotor* rotor, double speed, int i) {
  return rotor->thrust_coefficient[i] * speed;
}

// Equation 7: reaction torque over thrust [m], about the rotor's axis.
AERO double aero_reaction(const Rotor* rotor, int i) {
  return -rotor->spin[i] * rotor->torque_coefficient[i] / rotor->thrust_coefficient[i];
}

// Equation 7 for any layout: force [N] and moment [N m] per unit of a rotor's thrust, body frame.
AERO void aero_rotor_lever(const Rotor* rotor, double lever[6], int i) {
  const double p[3] = {rotor->position[0][i], rotor->position[1][i], rotor->position[2][i]};
  const double axis[3] = {rotor->axis[0][i], rotor->axis[1][i], rotor->axis[2][i]};
  const double reaction = aero_reaction(rotor, i);
  for (int n = 0; n < 3; ++n) {
    const int next = (n + 1) % 3, last = (n + 2) % 3;
    lever[n] = axis[n];
    lever[3 + n] = p[next] * axis[last] - p[last] * axis[next] + reaction * axis[n];
  }
}

AERO double aero_length(const double v[3]) {
  return sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]);
}

// What acts beside thrust and reaction: equations 8 and 9, quadratic drag and moment.
//   airspeed: velocity less wind [m/s]; body_rate [rad/s]; both in the body frame.
//   force [N] and moment [N m] are added to, body frame.
AERO void aero_wrench(const Aircraft* a, const double airspeed[3], const double body_rate[3],
                      double force[3], double moment[3], int i) {
  const double drag = a->drag_coefficient[i] * aero_length(airspeed);
  const double damping = a->moment_coefficient[i] * aero_length(body_rate);
  for (int k = 0; k < 3; ++k) force[k] -= drag * airspeed[k];
  for (int k = 0; k < 3; ++k) moment[k] -= damping * body_rate[k];
}

// Bound of the acceleration that the forces of aero_wrench give at an airspeed [m/s^2].
AERO double aero_largest_drag(const Aircraft* a, double airspeed_square, int i) {
  return a->drag_coefficient[i] * airspeed_square / a->mass[i];
}

#endif  // QUADRL_AERO_H_
