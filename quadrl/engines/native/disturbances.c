// Disturbances of many aircraft at a control step: errors of the estimated state, and pushes.
//
// Random numbers are those of quadrl/engines/rng.py: a stream for each episode, with blocks of four
// words for each control step. quadrl/conditions/randomizer.py chooses the streams.
#include <math.h>
#include <stdint.h>

#include "export.h"
#include "philox.h"

enum { ERRORS = 12, NOISE_BLOCKS = 6, PUSH_BLOCKS = 2 };

// Addresses of the rows. Filled by quadrl/conditions/sensors.py.
typedef struct {
  const int64_t *keys, *episodes, *steps;
  const double *qpos, *qvel, *act;  // of aircraft i at i * stride doubles, act at i * act_stride
  const double *noise, *bias;       // (12) standard deviations; (12) at i * bias_stride
  double* estimate;                 // (13 + rotors) at i * estimate_stride
  int64_t stride, act_stride, bias_stride, estimate_stride, rotors, noisy, stream;
} Rows;

// Nearly normal numbers (n, count) of a control step of streams.
QUADRL_EXPORT void quadrl_normal(int64_t n, const int64_t* keys, const int64_t* episodes,
                                 const int64_t* steps, int64_t stream, int64_t count, double* out) {
  const int64_t blocks = (count + 1) / 2;
  for (int64_t i = 0; i < n; ++i) {
    for (int64_t k = 0; k < count; ++k) {
      uint32_t w[4];
      words(w, steps[i] * blocks + k / 2, stream, episodes[i], keys[i]);
      out[i * count + k] = normal(w[2 * (k % 2)], w[2 * (k % 2) + 1]);
    }
  }
}

// The estimate (qpos, qvel, act) of n aircraft: position, attitude, velocity and body rate with
// three errors each.
QUADRL_EXPORT void quadrl_estimate(const Rows* rows, int64_t n) {
  for (int64_t i = 0; i < n; ++i) {
    const double *p = rows->qpos + i * rows->stride, *v = rows->qvel + i * rows->stride;
    const double* speed = rows->act + i * rows->act_stride;
    const double* bias = rows->bias + i * rows->bias_stride;
    double e[ERRORS], *out = rows->estimate + i * rows->estimate_stride;
    for (int k = 0; k < ERRORS; ++k) e[k] = bias[k];
    if (rows->noisy) {
      for (int b = 0; b < NOISE_BLOCKS; ++b) {
        uint32_t w[4];
        words(w, rows->steps[i] * NOISE_BLOCKS + b, rows->stream, rows->episodes[i], rows->keys[i]);
        e[2 * b] += rows->noise[2 * b] * normal(w[0], w[1]);
        e[2 * b + 1] += rows->noise[2 * b + 1] * normal(w[2], w[3]);
      }
    }
    for (int k = 0; k < 3; ++k) out[k] = p[k] + e[k];
    // The attitude is turned about the axes of the body by small angles.
    const double a = e[3] / 2, b = e[4] / 2, c = e[5] / 2, w = p[3], x = p[4], y = p[5], z = p[6];
    const double q[4] = {w - x * a - y * b - z * c, x + w * a + y * c - z * b,
                         y + w * b + z * a - x * c, z + w * c + x * b - y * a};
    const double length = sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
    const int turned = a != 0 || b != 0 || c != 0;  // else it keeps every bit
    for (int k = 0; k < 4; ++k) out[3 + k] = turned ? q[k] / length : p[3 + k];
    for (int k = 0; k < 6; ++k) out[7 + k] = v[k] + e[6 + k];
    for (int k = 0; k < rows->rotors; ++k) out[13 + k] = speed[k];
  }
}

// Adds a vector of a length; two uniform words choose its direction, evenly over the sphere.
static void add(double* to, double length, uint32_t share, uint32_t turn) {
  const double height = 2 * (share * 0x1p-32) - 1, level = sqrt(1 - height * height);
  const double heading = 0x1.921fb54442d18p+2 * (turn * 0x1p-32);
  to[0] += length * (level * cos(heading));
  to[1] += length * (level * sin(heading));
  to[2] += length * height;
}

// Changes velocity and body rate of the aircraft among n that a push hits at this control step.
QUADRL_EXPORT void quadrl_push(int64_t n, const int64_t* keys, const int64_t* episodes,
                               const int64_t* steps, int64_t stream, double chance,
                               double velocity, double body_rate, double* qvel, int64_t stride) {
  for (int64_t i = 0; i < n; ++i) {
    uint32_t w[2 * 4];
    words(w, steps[i] * PUSH_BLOCKS, stream, episodes[i], keys[i]);
    if (w[0] * 0x1p-32 >= chance) continue;
    words(w + 4, steps[i] * PUSH_BLOCKS + 1, stream, episodes[i], keys[i]);
    add(qvel + i * stride, velocity, w[1], w[2]);
    add(qvel + i * stride + 3, body_rate, w[3], w[4]);
  }
}
