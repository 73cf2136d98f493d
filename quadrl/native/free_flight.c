// Free flight: equations 3 to 10 of the paper, integrated by the classical Runge-Kutta method.
//
// Away from the ground the aircraft is this ordinary differential equation and nothing else, so it
// needs no general engine. The attitude is of fourth order here and of second in MuJoCo, which turns
// the quaternion once per step by the mean of the stages' body rates.
#include <math.h>
#include <stdint.h>

// Aircraft are flown LANES at a time, so that the compiler makes vector instructions of them: the
// same operations, each rounded as IEEE 754 says, so that no bit depends on the machine's vectors.
#define LANES 8
#include "aero.h"

#define QUADRL_EXPORT __attribute__((visibility("default")))
#define INLINE static inline __attribute__((always_inline))

// The clones are chosen while the library is loaded, before a sanitizer is ready for its own calls.
#if defined(__x86_64__) && defined(__GLIBC__) && defined(__GNUC__) && !defined(__clang__) && \
    !defined(__SANITIZE_ADDRESS__)
#define VECTORISED __attribute__((target_clones("default", "avx2", "avx512f")))
#else
#define VECTORISED
#endif

// What moves, a row each, an aircraft a column. Rates of change stand in the same rows.
enum {
  POSITION = 0,     // [m], world
  QUATERNION = 3,   // w, x, y, z, body to world
  VELOCITY = 7,     // [m/s], world
  BODY_RATE = 10,   // [rad/s], body
  SPEED = 13,       // of the rotors [rad/s]
  ROWS = SPEED + MAX_ROTORS
};
typedef double Lanes[LANES];

// What is the same for all: gravity [m/s^2] points along z.
typedef struct {
  double timestep, gravity, floor;
} World;

// The time derivative of a motion.
INLINE void derivative(const Aircraft* a, const Lanes* lever, int rotors, double gravity,
                       const Lanes* wind, const Lanes* command, const Lanes* m, Lanes* d) {
  for (int i = 0; i < LANES; ++i) {
    double force[3] = {0, 0, 0}, moment[3] = {0, 0, 0};
    for (int k = 0; k < rotors; ++k) {
      const double speed = m[SPEED + k][i];
      const double thrust = aero_rotor_gain(a->rotor + k, speed, i) * speed;
      for (int n = 0; n < 3; ++n) {
        force[n] += lever[6 * k + n][i] * thrust;
        moment[n] += lever[6 * k + 3 + n][i] * thrust;
      }
      d[SPEED + k][i] = aero_rotor_acceleration(a->rotor + k, speed, command[k][i], i);
    }
    const double w = m[QUATERNION][i], x = m[QUATERNION + 1][i], y = m[QUATERNION + 2][i],
                 z = m[QUATERNION + 3][i];
    // Between the stages the quaternion is not quite of unit length; its direction counts.
    const double twice = 2 / (w * w + x * x + y * y + z * z);
    const double turn[3][3] = {
        {1 - twice * (y * y + z * z), twice * (x * y - w * z), twice * (x * z + w * y)},
        {twice * (x * y + w * z), 1 - twice * (x * x + z * z), twice * (y * z - w * x)},
        {twice * (x * z - w * y), twice * (y * z + w * x), 1 - twice * (x * x + y * y)}};
    const double air[3] = {m[VELOCITY][i] - wind[0][i], m[VELOCITY + 1][i] - wind[1][i],
                           m[VELOCITY + 2][i] - wind[2][i]};
    const double r[3] = {m[BODY_RATE][i], m[BODY_RATE + 1][i], m[BODY_RATE + 2][i]};
    double airspeed[3];
    for (int k = 0; k < 3; ++k) {
      airspeed[k] = turn[0][k] * air[0] + turn[1][k] * air[1] + turn[2][k] * air[2];
    }
    aero_wrench(a, airspeed, r, force, moment, i);
    for (int k = 0; k < 3; ++k) {
      const double push = turn[k][0] * force[0] + turn[k][1] * force[1] + turn[k][2] * force[2];
      d[POSITION + k][i] = m[VELOCITY + k][i];
      d[VELOCITY + k][i] = push / a->mass[i] + (k == 2 ? gravity : 0);
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

INLINE void runge_kutta(const Aircraft* a, int rotors, const World* world, const Lanes* wind,
                        const Lanes* command, Lanes* m, int64_t steps) {
  Lanes at[ROWS], rate[ROWS], sum[ROWS], lever[6 * MAX_ROTORS];
  const double h = world->timestep, g = world->gravity;
  const int rows = SPEED + rotors;
  for (int k = 0; k < rotors; ++k) {
    for (int i = 0; i < LANES; ++i) {
      double column[6];
      aero_rotor_lever(a->rotor + k, column, i);
      for (int n = 0; n < 6; ++n) lever[6 * k + n][i] = column[n];
    }
  }
  for (int64_t step = 0; step < steps; ++step) {
    derivative(a, lever, rotors, g, wind, command, m, sum);
    move(rows, m, 0.5 * h, sum, at);
    derivative(a, lever, rotors, g, wind, command, at, rate);
    move(rows, sum, 2, rate, sum);
    move(rows, m, 0.5 * h, rate, at);
    derivative(a, lever, rotors, g, wind, command, at, rate);
    move(rows, sum, 2, rate, sum);
    move(rows, m, h, rate, at);
    derivative(a, lever, rotors, g, wind, command, at, rate);
    move(rows, sum, 1, rate, sum);
    move(rows, m, h / 6, sum, m);
    Lanes* q = m + QUATERNION;
    for (int i = 0; i < LANES; ++i) {
      const double scale = 1 / sqrt(q[0][i] * q[0][i] + q[1][i] * q[1][i] + q[2][i] * q[2][i] +
                                    q[3][i] * q[3][i]);
      for (int k = 0; k < 4; ++k) q[k][i] *= scale;
    }
  }
}

// With the number of rotors known, the compiler unrolls their loop.
VECTORISED static void fly(const Aircraft* a, int rotors, const World* world, const Lanes* wind,
                           const Lanes* command, Lanes* m, int64_t steps) {
  if (rotors == 4) {
    runge_kutta(a, 4, world, wind, command, m, steps);
  } else if (rotors == 6) {
    runge_kutta(a, 6, world, wind, command, m, steps);
  } else {
    runge_kutta(a, rotors, world, wind, command, m, steps);
  }
}

// Whether the aircraft of a lane could come under the floor in `time` [s], whatever it does.
static int may_touch(const Aircraft* a, const World* world, const Lanes* wind, const Lanes* command,
                     const Lanes* m, double time, int i) {
  double lift = 0, squares = 0;
  for (int k = 0; k < (int)a->rotor_count[i]; ++k) {
    const double speed = m[SPEED + k][i], wanted = command[k][i];
    const double fastest = speed > wanted ? speed : wanted;
    lift += aero_rotor_gain(a->rotor + k, fastest, i) * fastest;
  }
  for (int k = 0; k < 3; ++k) {
    squares += (m[VELOCITY + k][i] - wind[k][i]) * (m[VELOCITY + k][i] - wind[k][i]);
  }
  const double pull =
      fabs(world->gravity) + lift / a->mass[i] + aero_largest_drag(a, squares, i);
  const double sink = m[VELOCITY + 2][i] < 0 ? -m[VELOCITY + 2][i] : 0;
  return m[POSITION + 2][i] - (sink + pull * time) * time < world->floor;
}

// Puts LANES rows, each an Aircraft of one lane, side by side.
static void load(const double* rows, int64_t stride, int filled, Aircraft* a) {
  double* into = (double*)a;
  for (int i = 0; i < LANES; ++i) {
    const double* row = rows + (i < filled ? i : 0) * stride;
    for (int k = 0; k < ROW_SIZE; ++k) into[k * LANES + i] = row[k];
  }
}

// Where the rows of a simulation are. qpos (7), qvel (6), act, ctrl (one per rotor), warm (6,
// MuJoCo's warm start, cleared) and wind (3) [m/s, world] of aircraft i stand at i * stride doubles,
// its parameters at i * parameter_stride (0: all the same). Filled by quadrl/engines.
typedef struct {
  double *qpos, *qvel, *act;
  const double* ctrl;
  double* warm;
  const double *wind, *parameters;
  const World* world;
  char* near;  // one per aircraft
  int64_t stride, parameter_stride;
} Rows;

// Advances aircraft first..last-1 by a number of steps, in place, except those that may touch
// something meanwhile: these are left as they are and marked in near. Returns how many are marked.
QUADRL_EXPORT int64_t quadrl_free_flight(const Rows* rows, int64_t first, int64_t last,
                                         int64_t steps) {
  const Rows r = *rows;
  const World* world = r.world;
  const int64_t stride = r.stride, parameter_stride = r.parameter_stride;
  double *qpos = r.qpos, *qvel = r.qvel, *act = r.act;
  const double *ctrl = r.ctrl, *wind = r.wind, *parameters = r.parameters;
  Lanes m[ROWS], command[MAX_ROTORS], air[3];
  Aircraft a;
  const double time = steps * world->timestep;
  int64_t marked = 0;
  load(parameters + first * parameter_stride, parameter_stride,
       last - first < LANES ? (int)(last - first) : LANES, &a);
  const int rotors = (int)a.rotor_count[0];
  for (int64_t row = first; row < last; row += LANES) {
    const int filled = last - row < LANES ? (int)(last - row) : LANES;
    if (parameter_stride && row > first) {
      load(parameters + row * parameter_stride, parameter_stride, filled, &a);
    }
    for (int i = 0; i < LANES; ++i) {
      const int64_t place = (row + (i < filled ? i : 0)) * stride;  // spare lanes: twins
      for (int k = 0; k < 7; ++k) m[POSITION + k][i] = qpos[place + k];
      for (int k = 0; k < 6; ++k) m[VELOCITY + k][i] = qvel[place + k];
      for (int k = 0; k < rotors; ++k) m[SPEED + k][i] = act[place + k];
      for (int k = 0; k < rotors; ++k) command[k][i] = ctrl[place + k];
      for (int k = 0; k < 3; ++k) air[k][i] = wind[place + k];
    }
    int touching = 0;
    for (int i = 0; i < filled; ++i) {
      r.near[row + i] = may_touch(&a, world, air, command, m, time, i);
      touching += r.near[row + i];
    }
    marked += touching;
    if (touching == filled) continue;
    fly(&a, rotors, world, air, command, m, steps);
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
