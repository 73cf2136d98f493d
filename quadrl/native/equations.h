// Equations 7 to 10 of the paper, written once for every C consumer.
//
// Where the numbers stand in a compiled model (written there by quadrl/vehicle.py):
//   actuator_dynprm   [0] k_c [1/s], [MARK_SLOT] mark
//   actuator_gainprm  [0] k_T [N s^2]
//   body_user         [0] mark, [1] k_D [N s^2/m^2], [2] k_M [N m s^2]
// The yaw reaction k_Q/k_T stands in actuator_gear and the wind [m/s, world] in opt.wind.
#ifndef QUADRL_EQUATIONS_H_
#define QUADRL_EQUATIONS_H_

#include <math.h>

// Tells the actuators and bodies of quadrl from everybody else's: "quad" in ASCII.
#define QUADRL_MARK 1903518052.0
#define QUADRL_MARK_SLOT 9
#define QUADRL_BODY_USER 3

// Equation 10: first-order lag of the rotor speed [rad/s^2].
static inline double rotor_acceleration(double speed, double command, double lag_rate) {
  return -lag_rate * (speed - command);
}

// Equation 7 as MuJoCo wants it: thrust is gain * speed, so the gain is k_T Omega [N s].
static inline double rotor_gain(double speed, double thrust_coefficient) {
  return thrust_coefficient * speed;
}

// Equations 8 and 9: force += -coefficient |v| v. Isotropic, so it holds in any frame.
static inline void add_quadratic_drag(double coefficient, const double velocity[3],
                                      double force[3]) {
  const double magnitude = sqrt(velocity[0] * velocity[0] + velocity[1] * velocity[1] +
                                velocity[2] * velocity[2]);
  for (int k = 0; k < 3; ++k) force[k] -= coefficient * magnitude * velocity[k];
}

#endif  // QUADRL_EQUATIONS_H_
