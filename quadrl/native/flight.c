// Free flight: equations 3 to 10 of the paper, integrated by the classical Runge-Kutta method.
//
// Away from the ground the aircraft is this ordinary differential equation and nothing else, so
// there is no need of a general engine. Attitude is fourth order here; MuJoCo's is second, since
// it turns the quaternion once a step by the mean of the stages' body rates.
#include <math.h>
#include <stdint.h>

#include "equations.h"

#define QUADRL_EXPORT __attribute__((visibility("default")))

enum { ROTORS = 4 };

// Aircraft are flown LANES at a time, so that the compiler makes vector instructions of them: the
// same operations, each rounded as IEEE 754 says, so that no bit depends on the machine's vectors.
enum { LANES = 8 };
// The clones are chosen while the library is loaded, before a sanitizer is ready for its own calls.
#if defined(__x86_64__) && defined(__GLIBC__) && defined(__GNUC__) && !defined(__clang__) && \
    !defined(__SANITIZE_ADDRESS__)
#define VECTORISED __attribute__((target_clones("default", "avx2", "avx512f")))
#else
#define VECTORISED
#endif

// Read from the compiled model by quadrl/simulation.py, which fills it field by field.
typedef struct {
  double step;             // [s]
  double mass;             // [kg]
  double inertia[3];       // [kg m^2], principal axes are the body's
  double gravity[3];       // [m/s^2], world
  double thrust[ROTORS];   // k_T [N s^2]
  double lag_rate[ROTORS]; // k_c [1/s]
  double x[ROTORS], y[ROTORS];  // of the rotors [m], body
  double yaw[ROTORS];      // moment about z over thrust [m]
  double drag;             // k_D [N s^2/m^2]
  double moment;           // k_M [N m s^2]
  double floor;            // height of the centre of mass under which something may be touched [m]
} Aircraft;

QUADRL_EXPORT int64_t quadrl_aircraft_size(void) { return sizeof(Aircraft) / sizeof(double); }

// What moves, a row each, an aircraft a column. Rates of change stand in the same rows.
enum {
  POSITION = 0,     // [m], world
  QUATERNION = 3,   // w, x, y, z, body to world
  VELOCITY = 7,     // [m/s], world
  BODY_RATE = 10,   // [rad/s], body
  SPEED = 13,       // of the rotors [rad/s]
  ROWS = 17
};
typedef double Lanes[LANES];

// The time derivative of a motion.
static inline __attribute__((always_inline)) void derivative(const Aircraft* a, const Lanes* wind,
                                                             const Lanes* command, const Lanes* m,
                                                             Lanes* d) {
  for (int i = 0; i < LANES; ++i) {
    double lift = 0, moment[3] = {0, 0, 0};
    for (int k = 0; k < ROTORS; ++k) {
      const double speed = m[SPEED + k][i];
      const double thrust = rotor_gain(speed, a->thrust[k]) * speed;
      lift += thrust;
      moment[0] += a->y[k] * thrust;
      moment[1] -= a->x[k] * thrust;
      moment[2] += a->yaw[k] * thrust;
      d[SPEED + k][i] = rotor_acceleration(speed, command[k][i], a->lag_rate[k]);
    }
    const double w = m[QUATERNION][i], x = m[QUATERNION + 1][i], y = m[QUATERNION + 2][i],
                 z = m[QUATERNION + 3][i];
    // Between the stages the quaternion is not quite of unit length; its direction counts.
    const double twice = 2 / (w * w + x * x + y * y + z * z);
    double force[3] = {lift * twice * (x * z + w * y), lift * twice * (y * z - w * x),
                       lift * (1 - twice * (x * x + y * y))};
    const double airspeed[3] = {m[VELOCITY][i] - wind[0][i], m[VELOCITY + 1][i] - wind[1][i],
                                m[VELOCITY + 2][i] - wind[2][i]};
    const double r[3] = {m[BODY_RATE][i], m[BODY_RATE + 1][i], m[BODY_RATE + 2][i]};
    add_quadratic_drag(a->drag, airspeed, force);
    add_quadratic_drag(a->moment, r, moment);
    for (int k = 0; k < 3; ++k) {
      d[POSITION + k][i] = m[VELOCITY + k][i];
      d[VELOCITY + k][i] = a->gravity[k] + force[k] / a->mass;
    }
    const double* j = a->inertia;
    d[BODY_RATE][i] = (moment[0] - (j[2] - j[1]) * r[1] * r[2]) / j[0];
    d[BODY_RATE + 1][i] = (moment[1] - (j[0] - j[2]) * r[2] * r[0]) / j[1];
    d[BODY_RATE + 2][i] = (moment[2] - (j[1] - j[0]) * r[0] * r[1]) / j[2];
    d[QUATERNION][i] = 0.5 * (-x * r[0] - y * r[1] - z * r[2]);
    d[QUATERNION + 1][i] = 0.5 * (w * r[0] + y * r[2] - z * r[1]);
    d[QUATERNION + 2][i] = 0.5 * (w * r[1] + z * r[0] - x * r[2]);
    d[QUATERNION + 3][i] = 0.5 * (w * r[2] + x * r[1] - y * r[0]);
  }
}

static inline __attribute__((always_inline)) void move(const Lanes* from, double time,
                                                       const Lanes* rate, Lanes* to) {
  for (int k = 0; k < ROWS; ++k) {
    for (int i = 0; i < LANES; ++i) to[k][i] = from[k][i] + time * rate[k][i];
  }
}

VECTORISED static void runge_kutta(const Aircraft* a, const Lanes* wind, const Lanes* command,
                                   Lanes* m, int64_t steps) {
  Lanes at[ROWS], rate[ROWS], sum[ROWS];
  for (int64_t step = 0; step < steps; ++step) {
    derivative(a, wind, command, m, sum);
    move(m, 0.5 * a->step, sum, at);
    derivative(a, wind, command, at, rate);
    move(sum, 2, rate, sum);
    move(m, 0.5 * a->step, rate, at);
    derivative(a, wind, command, at, rate);
    move(sum, 2, rate, sum);
    move(m, a->step, rate, at);
    derivative(a, wind, command, at, rate);
    move(sum, 1, rate, sum);
    move(m, a->step / 6, sum, m);
    Lanes* q = m + QUATERNION;
    for (int i = 0; i < LANES; ++i) {
      const double scale = 1 / sqrt(q[0][i] * q[0][i] + q[1][i] * q[1][i] + q[2][i] * q[2][i] +
                                    q[3][i] * q[3][i]);
      for (int k = 0; k < 4; ++k) q[k][i] *= scale;
    }
  }
}

// Whether an aircraft could come under its floor in `time` [s], whatever it does.
static int may_touch(const Aircraft* a, const double* wind, const double* command, double height,
                     const double* velocity, const double* speed, double time) {
  double lift = 0, squares = 0;
  for (int k = 0; k < ROTORS; ++k) {
    const double fastest = speed[k] > command[k] ? speed[k] : command[k];
    lift += a->thrust[k] * fastest * fastest;
  }
  for (int k = 0; k < 3; ++k) squares += (velocity[k] - wind[k]) * (velocity[k] - wind[k]);
  const double pull = fabs(a->gravity[2]) + (lift + a->drag * squares) / a->mass;
  const double sink = velocity[2] < 0 ? -velocity[2] : 0;
  return height - (sink + pull * time) * time < a->floor;
}

// Advances aircraft first..last-1 by a number of steps, in place, except those that may touch
// something meanwhile: these are left as they are and marked in near (one char an aircraft).
// qpos (7), qvel (6), act (4), ctrl (4) and warm (6, MuJoCo's warm start, cleared) of aircraft i
// stand at i * stride doubles; its wind [m/s, world] at i * wind_stride. Returns how many are
// marked.
QUADRL_EXPORT int64_t quadrl_flight(int64_t first, int64_t last, int64_t steps, double* qpos,
                                    double* qvel, double* act, const double* ctrl, double* warm,
                                    int64_t stride, const Aircraft* aircraft, const double* wind,
                                    int64_t wind_stride, char* near) {
  Lanes m[ROWS], command[ROTORS], air[3];
  int64_t rows[LANES], marked = 0;
  int filled = 0;
  for (int64_t row = first; row < last; ++row) {
    const int64_t at = row * stride;
    near[row] = may_touch(aircraft, wind + row * wind_stride, ctrl + at, qpos[at + 2], qvel + at,
                          act + at, steps * aircraft->step);
    marked += near[row];
    if (!near[row]) rows[filled++] = row;
    if (filled == 0 || (filled < LANES && row < last - 1)) continue;
    for (int i = 0; i < LANES; ++i) {
      const int64_t from = rows[i < filled ? i : 0], place = from * stride;  // spare lanes: twins
      for (int k = 0; k < 7; ++k) m[POSITION + k][i] = qpos[place + k];
      for (int k = 0; k < 6; ++k) m[VELOCITY + k][i] = qvel[place + k];
      for (int k = 0; k < ROTORS; ++k) m[SPEED + k][i] = act[place + k];
      for (int k = 0; k < ROTORS; ++k) command[k][i] = ctrl[place + k];
      for (int k = 0; k < 3; ++k) air[k][i] = wind[from * wind_stride + k];
    }
    runge_kutta(aircraft, air, command, m, steps);
    for (int i = 0; i < filled; ++i) {
      const int64_t place = rows[i] * stride;
      for (int k = 0; k < 7; ++k) qpos[place + k] = m[POSITION + k][i];
      for (int k = 0; k < 6; ++k) qvel[place + k] = m[VELOCITY + k][i];
      for (int k = 0; k < ROTORS; ++k) act[place + k] = m[SPEED + k][i];
      for (int k = 0; k < 6; ++k) warm[place + k] = 0;
    }
    filled = 0;
  }
  return marked;
}
