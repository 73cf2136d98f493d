// Named quantities of many aircraft from MuJoCo's generalised coordinates, in one pass.
//
// State.of_coordinates (quadrl/engines/state.py) defines them; this is the same arithmetic in the
// same order (the tests compare bit by bit), because a single environment cannot afford forty NumPy
// calls a step. Compiled without contraction to fused multiply-add. quadrl/engines/state.py writes
// the rows of the output (ROW_POSITION, ...) into layout.h.
#include <math.h>
#include <stdint.h>

#define LANES 1
#include "aero.h"
#include "export.h"

static int is_sound(double x) { return fabs(x) < 1e10; }  // mjMAXVAL; false for NaN

// Addresses of the rows of a simulation. qpos (7), qvel (6), act (one per rotor) and air (AIR
// numbers) of aircraft i are at i * stride doubles; its largest speed [m/s] and body rate [rad/s]
// at i * limit_stride (0: the same for all). Filled by quadrl/engines.
typedef struct {
  const double *qpos, *qvel, *act, *origin, *limits, *air;
  int64_t stride, limit_stride, columns, rotors;
} Rows;

// ids lists the n aircraft to compute, or is NULL for the first n. out has a row per quantity and
// `columns` columns, one per aircraft. Returns how many aircraft have a number that is not finite
// or that MuJoCo calls unstable, or are faster than a physics step resolves.
QUADRL_EXPORT int64_t quadrl_state(const Rows* rows, int64_t n, const int64_t* ids, double* out) {
  const int64_t stride = rows->stride, columns = rows->columns;
  const double* origin = rows->origin;
  int64_t broken = 0;
  for (int64_t i = 0; i < n; ++i) {
    const int64_t row = ids ? ids[i] : i;
    const double* limit = rows->limits + row * rows->limit_stride;
    const double* p = rows->qpos + row * stride;
    const double* v = rows->qvel + row * stride;
    const double* speed = rows->act + row * stride;
    double* o = out + row;
#define OUT(k) o[(k) * columns]
    const double w = p[3], x = p[4], y = p[5], z = p[6];
    const double r[9] = {1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
                         2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
                         2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)};
    // Z-Y-X angles without trigonometry: only operations that IEEE 754 rounds exactly.
    const double horizontal = sqrt(r[0] * r[0] + r[3] * r[3]);
    const double cos_pitch = horizontal > 1e-9 ? horizontal : 1e-9;
    const double sine[3] = {r[7] / cos_pitch, -r[6], r[3] / cos_pitch};
    const double cosine[3] = {r[8] / cos_pitch, horizontal, r[0] / cos_pitch};
    int sound = 1;
    for (int k = 0; k < 3; ++k) {
      OUT(ROW_POSITION + k) = p[k] - origin[k];
      OUT(ROW_VELOCITY + k) = v[k];
      OUT(ROW_BODY_VELOCITY + k) = r[k] * v[0] + r[3 + k] * v[1] + r[6 + k] * v[2];
      OUT(ROW_BODY_RATE + k) = v[3 + k];
      OUT(ROW_SIN_ATTITUDE + k) = sine[k];
      OUT(ROW_COS_ATTITUDE + k) = cosine[k];
      sound &= is_sound(p[k]) & is_sound(v[k]) & is_sound(v[3 + k]);
    }
    for (int k = 0; k < 4; ++k) {
      OUT(ROW_QUATERNION + k) = p[3 + k];
      sound &= is_sound(p[3 + k]);
    }
    for (int k = 0; k < 9; ++k) OUT(ROW_ROTATION + k) = r[k];
    for (int k = 0; k < rows->rotors; ++k) {
      OUT(ROW_ROTOR_SPEED + k) = speed[k];
      sound &= is_sound(speed[k]);
    }
    OUT(ROW_HEIGHT) = p[2] - origin[2] + origin[2];  // as from the position in the task's frame
    double off[3];
    for (int k = 0; k < 3; ++k) off[k] = cosine[k] - 1;
    OUT(ROW_LEVEL_ERROR) = sqrt(sine[0] * sine[0] + sine[1] * sine[1]) +
                           sqrt(off[0] * off[0] + off[1] * off[1]);
    OUT(ROW_EAST_ERROR) = aero_length(sine) + aero_length(off);
    OUT(ROW_SPEED) = aero_length(v);
    OUT(ROW_ANGULAR_SPEED) = aero_length(v + 3);
    sound &= (OUT(ROW_SPEED) <= limit[0]);
    sound &= (OUT(ROW_ANGULAR_SPEED) <= limit[1]);
#undef OUT
    broken += !sound;
  }
  return broken;
}

// The first of n aircraft whose air has a number that is not finite, or -1.
QUADRL_EXPORT int64_t quadrl_unsound_air(const Rows* rows, int64_t n) {
  for (int64_t i = 0; i < n; ++i) {
    const double* air = rows->air + i * rows->stride;
    int sound = 1;
    for (int k = 0; k < AIR; ++k) sound &= isfinite(air[k]) != 0;
    if (!sound) return i;
  }
  return -1;
}
