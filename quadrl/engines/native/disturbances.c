// Disturbances of many aircraft at a control step: random numbers of their errors, pushes, and what
// the link does to their commands.
//
// Random numbers are those of quadrl/engines/rng.py: a stream for each episode, with blocks of four
// words for each control step. quadrl/conditions/randomizer.py chooses the streams.
#include <math.h>
#include <stdint.h>

#include "export.h"
#include "philox.h"
#include "push.h"

enum { PUSH_BLOCKS = 2 };

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

// Changes velocity and body rate of the aircraft among n that a push hits at this control step.
QUADRL_EXPORT void quadrl_push(int64_t n, const int64_t* keys, const int64_t* episodes,
                               const int64_t* steps, int64_t stream, double chance,
                               double velocity, double body_rate, double* qvel, int64_t stride) {
  for (int64_t i = 0; i < n; ++i) {
    uint32_t w[2 * 4];
    words(w, steps[i] * PUSH_BLOCKS, stream, episodes[i], keys[i]);
    if (w[0] * 0x1p-32 >= chance) continue;
    words(w + 4, steps[i] * PUSH_BLOCKS + 1, stream, episodes[i], keys[i]);
    add_push(qvel + i * stride, velocity, w[1], w[2]);
    add_push(qvel + i * stride + 3, body_rate, w[3], w[4]);
  }
}

// Decides for n aircraft whether the commands of this control step are one control step later than
// `usual` [physics steps], and whether the link is lost: `left` are the control steps for which it is,
// this one counted. An outage of `lasts` begins with chance `loss` where there is a link.
QUADRL_EXPORT void quadrl_link(int64_t n, const int64_t* keys, const int64_t* episodes,
                               const int64_t* steps, int64_t stream, const double* jitter,
                               const double* loss, const int64_t* lasts, const int64_t* usual,
                               int64_t substeps, int64_t* delay, int64_t* left) {
  for (int64_t i = 0; i < n; ++i) {
    uint32_t w[4];
    words(w, steps[i], stream, episodes[i], keys[i]);
    delay[i] = usual[i] + (w[0] * 0x1p-32 < jitter[i] ? substeps : 0);
    left[i] -= left[i] > 0;
    if (!left[i] && w[1] * 0x1p-32 < loss[i]) left[i] = lasts[i];
  }
}
