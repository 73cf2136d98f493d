// Keyed random numbers: Philox4x32-10 (Salmon et al. 2011, "Parallel Random Numbers: As Easy as
// 1, 2, 3"). The definition in the array API stands in quadrl/rng.py.
#include <stdint.h>

#define QUADRL_EXPORT __attribute__((visibility("default")))

static void philox(uint32_t c[4], uint32_t low, uint32_t high) {
  for (int round = 0; round < 10; ++round) {
    const uint64_t p0 = (uint64_t)0xD2511F53u * c[0], p1 = (uint64_t)0xCD9E8D57u * c[2];
    const uint32_t c1 = c[1], c3 = c[3];
    c[0] = (uint32_t)(p1 >> 32) ^ c1 ^ low;
    c[1] = (uint32_t)p1;
    c[2] = (uint32_t)(p0 >> 32) ^ c3 ^ high;
    c[3] = (uint32_t)p0;
    low += 0x9E3779B9u;
    high += 0xBB67AE85u;
  }
}

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
        block[0] = (uint32_t)at;
        block[1] = (uint32_t)stream;
        block[2] = (uint32_t)episodes[i];
        block[3] = (uint32_t)(episodes[i] >> 32);
        philox(block, (uint32_t)keys[i], (uint32_t)(keys[i] >> 32));
      }
      out[i * count + j - first] = block[j % 4] * 0x1p-32;
    }
  }
}
