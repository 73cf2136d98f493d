// Philox4x32-10 (Salmon et al. 2011, "Parallel Random Numbers: As Easy as 1, 2, 3").
#ifndef QUADRL_PHILOX_H_
#define QUADRL_PHILOX_H_

#include <stdint.h>

// Replaces a counter by the four random words of its block.
static inline __attribute__((always_inline)) void philox(uint32_t c[4], uint32_t low,
                                                         uint32_t high) {
#pragma GCC unroll 10
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

#endif  // QUADRL_PHILOX_H_
