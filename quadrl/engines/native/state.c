// Named quantities of many aircraft from MuJoCo's generalised coordinates, in one pass.
//
// State.of_coordinates (quadrl/engines/state.py) defines them: `write_state`, which is generated from
// it into layout.h, does the same arithmetic in the same order, because a single environment cannot
// afford forty NumPy calls a step. layout.h also has the rows of the output (ROW_POSITION, ...).
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
  int64_t broken = 0;
  for (int64_t i = 0; i < n; ++i) {
    const int64_t row = ids ? ids[i] : i;
    const double* limit = rows->limits + row * rows->limit_stride;
    const double* p = rows->qpos + row * stride;
    const double* v = rows->qvel + row * stride;
    const double* speed = rows->act + row * stride;
    double* o = out + row;
    write_state(p, v, rows->origin, columns, o);
    int sound = (o[ROW_SPEED * columns] <= limit[0]) & (o[ROW_ANGULAR_SPEED * columns] <= limit[1]);
    for (int k = 0; k < 7; ++k) sound &= is_sound(p[k]);
    for (int k = 0; k < 6; ++k) sound &= is_sound(v[k]);
    for (int k = 0; k < rows->rotors; ++k) {
      o[(ROW_ROTOR_SPEED + k) * columns] = speed[k];
      sound &= is_sound(speed[k]);
    }
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
