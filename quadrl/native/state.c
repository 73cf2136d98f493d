// Named quantities of many aircraft from MuJoCo's generalised coordinates, in one pass.
//
// The definition is quadrl/state.py and quadrl/rotation.py; this is the same arithmetic in the
// same order (the tests compare bit by bit), because a single environment cannot afford forty
// NumPy calls a step. Compiled without contraction to fused multiply-add.
#include <math.h>
#include <stdint.h>

#define QUADRL_EXPORT __attribute__((visibility("default")))

enum {  // rows of the output, one column an aircraft; quadrl/state.py slices them by name
  POSITION = 0, QUATERNION = 3, ROTATION = 7, SIN_ATTITUDE = 16, COS_ATTITUDE = 19,
  VELOCITY = 22, BODY_VELOCITY = 25, BODY_RATE = 28, ROTOR_SPEED = 31, SPEED = 35,
  SPIN = 36, LEVEL_ERROR = 37, EAST_ERROR = 38, ROWS = 39
};

static int is_sound(double x) { return fabs(x) < 1e10; }  // mjMAXVAL; false for NaN

static double norm(const double* vector, int size) {
  double sum = vector[0] * vector[0];
  for (int k = 1; k < size; ++k) sum += vector[k] * vector[k];
  return sqrt(sum);
}

QUADRL_EXPORT int quadrl_state_rows(void) { return ROWS; }

// qpos (7), qvel (6) and act (4) of aircraft i stand at i * stride doubles. ids lists the n
// aircraft to compute, or is NULL for the first n. out is (ROWS, columns), row-major. Returns how
// many of them hold a number that is not finite or is past what MuJoCo itself calls unstable, or
// are faster than max_speed [m/s] or max_spin [rad/s].
QUADRL_EXPORT int64_t quadrl_state(int64_t n, const int64_t* ids, const double* qpos,
                                   const double* qvel, const double* act, int64_t stride,
                                   const double* origin, double max_speed, double max_spin,
                                   double* out, int64_t columns) {
  int64_t broken = 0;
  for (int64_t i = 0; i < n; ++i) {
    const int64_t row = ids ? ids[i] : i;
    const double* p = qpos + row * stride;
    const double* v = qvel + row * stride;
    const double* speed = act + row * stride;
    double* o = out + row;
#define OUT(k) o[(k) * columns]
    const double w = p[3], x = p[4], y = p[5], z = p[6];
    const double r[9] = {1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
                         2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
                         2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)};
    // Z-Y-X angles without trigonometry: only operations that IEEE 754 rounds exactly.
    const double horizontal = sqrt(r[0] * r[0] + r[3] * r[3]);
    const double cos_pitch = horizontal > 1e-9 ? horizontal : 1e-9;
    int sound = 1;
    for (int k = 0; k < 3; ++k) {
      OUT(POSITION + k) = p[k] - origin[k];
      OUT(VELOCITY + k) = v[k];
      OUT(BODY_VELOCITY + k) = r[k] * v[0] + r[3 + k] * v[1] + r[6 + k] * v[2];
      OUT(BODY_RATE + k) = v[3 + k];
      sound &= is_sound(p[k]) & is_sound(v[k]) & is_sound(v[3 + k]);
    }
    for (int k = 0; k < 4; ++k) {
      OUT(QUATERNION + k) = p[3 + k];
      OUT(ROTOR_SPEED + k) = speed[k];
      sound &= is_sound(p[3 + k]) & is_sound(speed[k]);
    }
    for (int k = 0; k < 9; ++k) OUT(ROTATION + k) = r[k];
    const double sine[3] = {r[7] / cos_pitch, -r[6], r[3] / cos_pitch};
    const double cosine[3] = {r[8] / cos_pitch, horizontal, r[0] / cos_pitch};
    double off[3];
    for (int k = 0; k < 3; ++k) {
      OUT(SIN_ATTITUDE + k) = sine[k];
      OUT(COS_ATTITUDE + k) = cosine[k];
      off[k] = cosine[k] - 1;
    }
    OUT(SPEED) = norm(v, 3);
    OUT(SPIN) = norm(v + 3, 3);
    OUT(LEVEL_ERROR) = norm(sine, 2) + norm(off, 2);
    OUT(EAST_ERROR) = norm(sine, 3) + norm(off, 3);
    sound &= (OUT(SPEED) <= max_speed) & (OUT(SPIN) <= max_spin);
#undef OUT
    broken += !sound;
  }
  return broken;
}
