// The forces on an aircraft, written once for the MuJoCo callbacks and for free flight.
//
// Aircraft are flown LANES at a time: every parameter is an array of LANES numbers, and each
// function takes the lane i. The callbacks have one lane, which makes an Aircraft exactly a row of
// quadrl/aircraft/parameters.py. quadrl/engines/dynamics.py has the same equations in NumPy and
// torch.
//
// Body frame: x forward, y left, z up, the origin at the centre of mass.
#ifndef QUADRL_AERO_H_
#define QUADRL_AERO_H_

#include <math.h>
#include <stdint.h>

#include "layout.h"  // Rotor, Aircraft: written by quadrl/native from quadrl/aircraft/parameters.py

#define AERO static inline __attribute__((always_inline))

typedef double Lanes[LANES];

// A loop that is not unrolled: short as it is, the compiler would unroll it, and then make no
// vector instructions.
#define EACH_LANE _Pragma("GCC unroll 1") for (int i = 0; i < LANES; ++i)

// Aerodynamics.effects of an aircraft, for each of which the kernels are compiled, or -1 where its
// row has another number, which need not be an int.
AERO int aero_effects(const Aircraft* a, int i) {
  if (a->effects[i] == STILL_AIR) return STILL_AIR;
  if (a->effects[i] == ROTOR_EFFECTS) return ROTOR_EFFECTS;
  return a->effects[i] == GROUND_EFFECT ? GROUND_EFFECT : -1;
}

// Equation 10: the lag of the rotor speed [rad/s^2]; it may rise and fall at different rates, and a
// command above the rotor's largest speed counts as that speed.
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

// Quadratic drag and moment, equations 8 and 9, and the steady moment of an episode.
//   airspeed: velocity less wind [m/s]; body_rate [rad/s]; both in the body frame.
//   force [N] and moment [N m] are added to, body frame.
AERO void aero_wrench(const Aircraft* a, const double airspeed[3], const double body_rate[3],
                      double force[3], double moment[3], int i) {
  const double drag = a->drag_coefficient[i] * aero_length(airspeed);
  const double damping = a->moment_coefficient[i] * aero_length(body_rate);
  for (int k = 0; k < 3; ++k) force[k] -= drag * airspeed[k];
  for (int k = 0; k < 3; ++k) moment[k] += a->steady_moment[k][i] - damping * body_rate[k];
}

// Bound of the acceleration that the forces of aero_wrench give at an airspeed [m/s^2].
AERO double aero_largest_drag(const Aircraft* a, double airspeed_square, int i) {
  return a->drag_coefficient[i] * airspeed_square / a->mass[i];
}

// --------------------------------------------- effects of the air on rotors beyond equation 7

AERO double aero_clip(double x, double low, double high) {
  x = x < low ? low : x;
  return x > high ? high : x;
}

// The larger of x and 0, without a branch that would keep the compiler from vector instructions.
AERO double aero_positive(double x) { return 0.5 * (x + fabs(x)); }

// Quantities that follow from the disc and the blades of a rotor.
typedef struct {
  Lanes flow;      // 2 rho A [kg/m]
  Lanes induced;   // nu [m/rad]: induced velocity in hover over rotor speed
  Lanes response;  // kappa: how strongly the thrust answers the flow through the disc
} Disc;

AERO void aero_disc(const Aircraft* a, const Rotor* rotor, Disc* disc) {
  for (int i = 0; i < LANES; ++i) {
    const double radius = rotor->disc_radius[i], thrust = rotor->thrust_coefficient[i];
    const double flow = 2 * 3.14159265358979323846 * a->air_density[i] * radius * radius;
    const double induced = sqrt(thrust / flow);
    disc->flow[i] = flow;
    disc->induced[i] = induced;
    disc->response[i] =
        a->inflow[i] * a->blade_lift[i] * flow * radius * induced / (8 * thrust);
  }
}

// A Newton step towards the flow w through a disc, from (w0 + k) w0 - k w = (w - v) |(w, p)|.
AERO double aero_flow_step(double w, double w0, double k, double v, double p_square) {
  const double through = sqrt(w * w + p_square);
  const double lacking = (w0 + k) * w0 - k * w - (w - v) * through;
  return w + through * lacking / ((k + through) * through + (w - v) * w + 1e-12);
}

// Thrust [N] less that of equation 7: inflow and vortex ring state.
//   w0: induced velocity that the rotor has at rest; climb: airspeed along its axis [m/s];
//   p_square: of the airspeed in its plane [m^2/s^2]; noise: of unit variance.
AERO double aero_lift_change(const Aircraft* a, const Rotor* rotor, const Disc* disc, double speed,
                             double w0, double climb, double p_square, double noise, int i) {
  const double rest = rotor->thrust_coefficient[i] * speed * speed, k = disc->response[i] * w0;
  const double v = aero_clip(climb, -2 * w0, 3 * w0);  // beyond, the steps would diverge
  double w = 0.5 * (v - k + sqrt((v - k) * (v - k) + 4 * w0 * (w0 + k)));  // exact for p = 0
  w = aero_flow_step(w, w0, k, v, p_square);
  w = aero_flow_step(w, w0, k, v, p_square);
  // Vortex ring state: strongest at a descent of 1.4 w0, gone at p = 0.95 w0.
  const double over = 1 / (w0 + 1e-6);
  const double off = (climb * over + 1.4) * (1 / 1.2);
  const double steep = aero_positive(1 - off * off);
  const double slow = aero_positive(1 - p_square * over * over * (1 / (0.95 * 0.95)));
  const double ring = steep * steep * steep * slow;
  const double windmill = a->inflow[i] * WINDMILL * w0 * aero_positive(-2 * w0 - climb);
  const double change = disc->flow[i] * k * (w0 - w - a->vortex_ring[i] * w0 * ring) +
                        disc->flow[i] * windmill +
                        a->inflow[i] * a->translational_lift[i] * disc->flow[i] * 0.5 * p_square +
                        a->vortex_ring_noise[i] * rest * noise * ring;
  return aero_clip(change, -rest, 0.6 * rest);  // above, the blades stall
}

// A source of the ground's mirror image, of a disc of a radius, a distance aside and 2 z below.
AERO double aero_image(double radius, double distance_square, double z) {
  const double square = distance_square + 4 * z * z;
  return 0.5 * radius * radius * z / (square * sqrt(square));
}

// Share of its flow that the ground takes from a rotor's disc, z [m] over it: the mirror images of
// all discs and of the air that rises between them.
AERO void aero_ground(const Aircraft* a, int rotors, const Rotor* rotor, const Lanes z,
                      Lanes share) {
  EACH_LANE {
    const double x = rotor->position[0][i], y = rotor->position[1][i];
    const double rising = aero_image(rotor->disc_radius[i], 4 * (x * x + y * y), z[i]);
    share[i] = 4 * a->body_lift[i] * rising;
  }
  for (const Rotor* other = a->rotor; other < a->rotor + rotors; ++other) {
    EACH_LANE {
      const double x = other->position[0][i] - rotor->position[0][i];
      const double y = other->position[1][i] - rotor->position[1][i];
      share[i] += aero_image(other->disc_radius[i], x * x + y * y, z[i]);
    }
  }
}

// Factor of the moment flap * speed * p on a hub, which limits the offset of the centre of lift to
// MOST_OFFSET radii smoothly; 1 in slow flight.
AERO double aero_flapping_share(const Aircraft* a, const Rotor* rotor, double speed,
                                double p_square, int i) {
  const double flap = a->flapping_moment[i];
  const double most =
      MOST_OFFSET * rotor->disc_radius[i] * rotor->thrust_coefficient[i] * speed;
  return most / sqrt(most * most + flap * flap * p_square + 1e-37);
}

// Effects of the air on the rotors beyond equation 7, and of their inertia.
//   effects: STILL_AIR, ROTOR_EFFECTS or GROUND_EFFECT, a constant.
//   speed, command: of the rotors [rad/s]; noise: of their thrust. airspeed, body_rate: as in
//   aero_wrench. up: the world's vertical in the body frame; height of the centre of mass over the
//   ground [m].
//   force [N] and moment [N m] are added to, body frame.
AERO void aero_rotors(const Aircraft* a, const Disc* disc, int effects, int rotors,
                      const Lanes* speed, const Lanes* command, const Lanes* noise,
                      const Lanes* airspeed, const Lanes* body_rate, const Lanes* up,
                      const Lanes height, Lanes* force, Lanes* moment) {
  for (int k = 0; k < rotors; ++k) {
    const Rotor* rotor = a->rotor + k;
    Lanes share;
    if (effects == GROUND_EFFECT) {
      Lanes z;
      EACH_LANE {
        const double over = height[i] + up[0][i] * rotor->position[0][i] +
                            up[1][i] * rotor->position[1][i] + up[2][i] * rotor->position[2][i];
        const double least = 0.5 * rotor->disc_radius[i];
        z[i] = over > least ? over : least;
      }
      aero_ground(a, rotors, rotor, z, share);
      EACH_LANE {
        // Whole up to 6 radii, nothing from 8 on; less for a disc that is tilted.
        const double radius = rotor->disc_radius[i];
        const double near = aero_clip((8 * radius - z[i]) / (2 * radius), 0, 1);
        const double cosine =
            aero_positive(up[0][i] * rotor->axis[0][i] + up[1][i] * rotor->axis[1][i] +
                          up[2][i] * rotor->axis[2][i]);
        share[i] *= a->ground_effect[i] * cosine * cosine * near * near * (3 - 2 * near);
      }
    }
    for (int i = 0; i < LANES; ++i) {
      const double r[3] = {rotor->position[0][i], rotor->position[1][i], rotor->position[2][i]};
      const double n[3] = {rotor->axis[0][i], rotor->axis[1][i], rotor->axis[2][i]};
      const double turn[3] = {body_rate[0][i], body_rate[1][i], body_rate[2][i]};
      const double omega = speed[k][i];
      double u[3], push[3], spin[3];
      for (int m = 0; m < 3; ++m) {
        const int next = (m + 1) % 3, last = (m + 2) % 3;
        u[m] = airspeed[m][i] + (turn[next] * r[last] - turn[last] * r[next]);  // of the hub
      }
      const double climb = u[0] * n[0] + u[1] * n[1] + u[2] * n[2];
      for (int m = 0; m < 3; ++m) u[m] -= climb * n[m];  // what is left is in its plane
      const double p_square = u[0] * u[0] + u[1] * u[1] + u[2] * u[2];
      const double w0 = disc[k].induced[i] * omega;
      double change = aero_lift_change(a, rotor, disc + k, omega, w0, climb, p_square,
                                       noise[k][i], i);
      if (effects == GROUND_EFFECT) {
        const double rest = rotor->thrust_coefficient[i] * omega * omega;
        const double hover = w0 * w0;
        const double taken = share[i] * hover / (hover + p_square + 1e-12);
        const double most = taken < MOST_TAKEN ? taken : MOST_TAKEN;
        change += (rest + change) * (most / (1 - most));  // lift / (1 - most)
      }
      const double drag = a->rotor_drag[i] * omega;
      const double flap = a->flapping_moment[i] * omega *
                          aero_flapping_share(a, rotor, omega, p_square, i);
      const double inertia = rotor->spin[i] * a->rotor_inertia[i];
      const double faster = inertia * aero_rotor_acceleration(rotor, omega, command[k][i], i);
      const double tilt[3] = {flap, flap * a->flapping_pitch[i], flap};
      for (int m = 0; m < 3; ++m) {
        push[m] = change * n[m] - drag * u[m];
        spin[m] = inertia * omega * n[m];  // angular momentum
      }
      for (int m = 0; m < 3; ++m) {
        const int next = (m + 1) % 3, last = (m + 2) % 3;
        force[m][i] += push[m];
        moment[m][i] += r[next] * push[last] - r[last] * push[next] +
                        tilt[m] * (u[next] * n[last] - u[last] * n[next]) -
                        (turn[next] * spin[last] - turn[last] * spin[next]) - faster * n[m];
      }
    }
  }
}

// Bound of a rotor's lift over that of equation 7: the clip of aero_lift_change, and of aero_rotors
// by the ground.
AERO double aero_largest_lift(const Aircraft* a, int i) {
  return (a->inflow[i] ? 1.6 : 1) * (a->ground_effect[i] ? 1 / (1 - MOST_TAKEN) : 1);
}

// Bound of the acceleration by the drag of rotors [m/s^2]: of the sum of their speeds and an
// airspeed.
AERO double aero_largest_push(const Aircraft* a, double speeds, double airspeed, int i) {
  return a->rotor_drag[i] * speeds * airspeed / a->mass[i];
}

#endif  // QUADRL_AERO_H_
