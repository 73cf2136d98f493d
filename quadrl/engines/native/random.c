// Keyed random numbers, as quadrl/base/philox.py defines them in the array API.
#include <stdint.h>

#include "export.h"
#include "philox.h"

// Numbers first..first+count-1 of n streams, uniform in [0, 1): out is (n, count). Number j of
// stream (key, episode, stream) is word j % 4 of the block at counter (j / 4, stream, episode).
QUADRL_EXPORT void quadrl_uniform(int64_t n, const int64_t* keys, const int64_t* episodes,
                                  int64_t stream, int64_t first, int64_t count, double* out) {
  for (int64_t i = 0; i < n; ++i) {
    uint32_t block[4];
    int64_t at = -1;
    for (int64_t j = first; j < first + count; ++j) {
      if (j / 4 != at) {
        at = j / 4;
        words(block, at, stream, episodes[i], keys[i]);
      }
      out[i * count + j - first] = block[j % 4] * 0x1p-32;
    }
  }
}
