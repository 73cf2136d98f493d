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

// The words of a block of a stream of an episode, for the seed `key`.
static inline __attribute__((always_inline)) void words(uint32_t w[4], int64_t block,
                                                        int64_t stream, int64_t episode,
                                                        int64_t key) {
  w[0] = (uint32_t)block;
  w[1] = (uint32_t)stream;
  w[2] = (uint32_t)episode;
  w[3] = (uint32_t)(episode >> 32);
  philox(w, (uint32_t)key, (uint32_t)(key >> 32));
}

// A random word as a number in [0, 1); in single precision its last bits would round to 1.
static inline double uniform(uint32_t word) {
#ifdef SINGLE
  return (word >> 8) * 0x1p-24;
#else
  return word * 0x1p-32;
#endif
}

// A nearly normal number, of mean 0 and variance 1: the sum of four uniform ones of 16 bits.
static inline __attribute__((always_inline)) double normal(uint32_t one, uint32_t other) {
  const int32_t halves = (int32_t)((one & 0xFFFF) + (one >> 16) + (other & 0xFFFF) + (other >> 16));
  return (halves + (2 - 131072)) * 0x1.bb67ae8584caap-16;  // the root of 3 over 2^16
}

#endif  // QUADRL_PHILOX_H_
