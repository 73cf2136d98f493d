// The weather of many aircraft over a control step: mean wind, turbulence, gust, noise of the lift.
//
// tests/air_reference.py defines it in the array API; this is the same arithmetic in the same order
// (the tests compare bit by bit). quadrl/engines/air.py writes the rows of the table (WEATHER_...)
// into layout.h.
#include <stdint.h>
#include <string.h>

// Floating-point exceptions are not used here, so that a choice between numbers needs no branch.
#if defined(__GNUC__) && !defined(__clang__)
#pragma GCC optimize("no-trapping-math")
#endif

#define LANES 8
#include "aero.h"
#include "export.h"
#include "philox.h"

typedef double Lanes[LANES];

// Addresses of the rows, and numbers that are the same for all. The table has a row per quantity
// and `columns` columns, one per aircraft. Height above the ground [m] and air of aircraft i are at
// i * stride doubles. Filled by quadrl/conditions/weather.py.
typedef struct {
  double* table;
  const int64_t *keys, *episodes;
  const double* height;
  double* air;
  int64_t columns, stride, rotors;
  double per_roughness, timestep, per_gust_time;
} Rows;

// Seeds, episodes and control steps.
typedef struct {
  int64_t key[LANES], episode[LANES], step[LANES];
} Streams;

// The four words of a block of random numbers, of each aircraft.
AERO void words_of(const Streams* s, int block, uint32_t w[4][LANES]) {
  for (int i = 0; i < LANES; ++i) {
    uint32_t c[4];
    words(c, s->step[i] * BLOCKS + block, TURBULENCE, s->episode[i], s->key[i]);
    for (int k = 0; k < 4; ++k) w[k][i] = c[k];
  }
}

// ln(max(x, 1)). With the C library's logarithm, bits would depend on the machine.
AERO double logarithm(double x) {
  x = x > 1.0 ? x : 1.0;
#ifdef SINGLE
  return log(x);
#else
  uint64_t bits, exponent;
  memcpy(&bits, &x, sizeof bits);
  // Vectors cannot convert an integer of 64 bits: its bits stand behind the point of 2^52.
  exponent = (bits >> 52) | 0x4330000000000000u;
  bits = (bits & 0xFFFFFFFFFFFFFu) | 0x3FE0000000000000u;
  double part, power;
  memcpy(&part, &bits, sizeof part);
  memcpy(&power, &exponent, sizeof power);
  power -= 0x1p52 + 1022;
  const int low = part < 0x1.6a09e667f3bcdp-1;  // the root of 1/2
  const double twice = 2.0 * part, less = power - 1.0;  // without branches, for vector instructions
  part = low ? twice : part;
  power = low ? less : power;
  const double ratio = (part - 1.0) / (part + 1.0), square = ratio * ratio;
  double total = 0;
#pragma GCC unroll 16
  for (int k = LOG_TERMS - 1; k >= 0; --k) total = 1.0 / (2 * k + 1) + square * total;
  return power * 0x1.62e42fefa39efp-1 + 2.0 * ratio * total;
#endif
}

// sin(pi share) for a share between 0 and 1, else 0.
AERO double half_wave(double share) {
  const double rest = 1.0 - share, nearer = share < rest ? share : rest;
  const double angle = 0x1.921fb54442d18p+1 * (nearer > 0.0 ? nearer : 0.0);
  const double square = angle * angle;
  double total = 1;
#pragma GCC unroll 16
  for (int k = SINE_TERMS - 1; k >= 1; --k) {
    total = 1.0 - square * (1.0 / (2 * k * (2 * k + 1))) * total;
  }
  return angle * total;
}

// Starts the filters, and the noise of `rotors` rotors, or advances them by a step.
AERO void filters(Lanes* t, Streams* s, int rotors, int begin) {
  uint32_t w[3][4][LANES];
  for (int i = 0; i < LANES; ++i) t[WEATHER_STEPS][i] = begin ? 0.0 : t[WEATHER_STEPS][i] + 1.0;
  for (int i = 0; i < LANES; ++i) s->step[i] = (int32_t)t[WEATHER_STEPS][i];
  for (int b = 0; b < 3; ++b) words_of(s, b, w[b]);
  for (int i = 0; i < LANES; ++i) {
    const double n[5] = {normal(w[0][0][i], w[0][1][i]), normal(w[0][2][i], w[0][3][i]),
                         normal(w[1][0][i], w[1][1][i]), normal(w[1][2][i], w[1][3][i]),
                         normal(w[2][0][i], w[2][1][i])};
    double* along = &t[WEATHER_ALONG][i];
    *along = begin ? n[0]
                   : t[WEATHER_ALONG_KEEP][i] * *along + t[WEATHER_ALONG_FRESH][i] * n[0];
    for (int k = 0; k < 2; ++k) {
      Lanes *x = t + (k ? WEATHER_UP : WEATHER_LEFT),
            *f = t + (k ? WEATHER_UP_KEEP : WEATHER_LEFT_KEEP);
      const double keep = f[0][i], rate = f[1][i], first = f[2][i], across = f[3][i],
                   second = f[4][i], one = n[1 + 2 * k], other = n[2 + 2 * k];
      const double now = x[0][i], lag = x[1][i];
      x[0][i] = begin ? 0x1.6a09e667f3bcdp-1 * one : keep * now + first * one;
      x[1][i] = begin ? 0x1.6a09e667f3bcdp-2 * (one + other)
                      : keep * (lag + rate * now) + (across * one + second * other);
    }
  }
  for (int k = 0; k < rotors; ++k) {
    if (k % 2 == 0) words_of(s, 3 + k / 2, w[0]);
    double* noise = t[WEATHER_NOISE_0 + k];
    for (int i = 0; i < LANES; ++i) {
      const double n = normal(w[0][k % 2 * 2][i], w[0][k % 2 * 2 + 1][i]);
      noise[i] = begin ? n : t[WEATHER_NOISE_KEEP][i] * noise[i] + t[WEATHER_NOISE_FRESH][i] * n;
    }
  }
}

// The wind [m/s], world frame, at a height [m].
AERO void blowing(const Lanes* t, const Rows* r, const double* height, Lanes* wind) {
  const double root = 0x1.bb67ae8584caap+0;  // of 3
  const double per_roughness = r->per_roughness, per_gust_time = r->per_gust_time;
  const double timestep = r->timestep;
  Lanes shear, pulse;
  for (int i = 0; i < LANES; ++i) {
    shear[i] = t[WEATHER_SHEAR][i] * logarithm(height[i] * per_roughness);
  }
  for (int i = 0; i < LANES; ++i) {
    const double time = t[WEATHER_STEPS][i] * timestep - t[WEATHER_GUST_START][i];
    const double half = half_wave(time * per_gust_time);
    pulse[i] = half * half;
  }
  for (int i = 0; i < LANES; ++i) {
    const double deviation = t[WEATHER_LEVEL_DEVIATION][i];
    const double along = shear[i] + deviation * t[WEATHER_ALONG][i];
    const double left =
        deviation * (root * t[WEATHER_LEFT][i] + (1 - root) * t[WEATHER_LEFT_LAG][i]);
    const double up = root * t[WEATHER_UP][i] + (1 - root) * t[WEATHER_UP_LAG][i];
    const double east = t[WEATHER_EAST][i], north = t[WEATHER_NORTH][i];
    wind[0][i] = east * along - north * left + t[WEATHER_GUST_EAST][i] * pulse[i] + 0.0;
    wind[1][i] = north * along + east * left + t[WEATHER_GUST_NORTH][i] * pulse[i] + 0.0;
    double share = height[i] * PER_LOWEST;  // of the upward gusts: none blows through the ground
    share = share < 1.0 ? share : 1.0;
    share = share > 0.0 ? share : 0.0;
    wind[2][i] = t[WEATHER_UPWARD_DEVIATION][i] * share * up + 0.0;
  }
}

VECTORISED static void blow(Lanes* t, Streams* s, const Rows* r, const double* height, Lanes* wind,
                            int begin) {
  if (begin) {
    filters(t, s, (int)r->rotors, 1);
  } else {
    filters(t, s, (int)r->rotors, 0);
  }
  blowing(t, r, height, wind);
}

#ifdef QUADRL_EXPORT
// Begins the episodes of n aircraft, or advances them by a control step, and writes their air.
// ids lists them, or is NULL for the first n.
QUADRL_EXPORT void quadrl_weather(const Rows* rows, int64_t n, const int64_t* ids, int64_t begin) {
  const Rows r = *rows;
  Lanes t[WEATHER_ROWS], wind[3], height;
  Streams s;
  int64_t row[LANES];
  const int used = WEATHER_NOISE_0 + (int)r.rotors;
  for (int64_t first = 0; first < n; first += LANES) {
    const int filled = n - first < LANES ? (int)(n - first) : LANES;
    for (int i = 0; i < LANES; ++i) {
      const int64_t at = first + (i < filled ? i : 0);  // spare lanes: twins
      row[i] = ids ? ids[at] : at;
      s.key[i] = r.keys[row[i]];
      s.episode[i] = r.episodes[row[i]];
      height[i] = r.height[row[i] * r.stride];
    }
    if (!ids && filled == LANES) {
      for (int k = 0; k < used; ++k) memcpy(t[k], r.table + k * r.columns + first, sizeof t[k]);
    } else {
      for (int k = 0; k < used; ++k) {
        for (int i = 0; i < LANES; ++i) t[k][i] = r.table[k * r.columns + row[i]];
      }
    }
    blow(t, &s, &r, height, wind, (int)begin);
    for (int k = WEATHER_STEPS; k < used; ++k) {
      for (int i = 0; i < filled; ++i) r.table[k * r.columns + row[i]] = t[k][i];
    }
    for (int i = 0; i < filled; ++i) {
      double* air = r.air + row[i] * r.stride;
      for (int k = 0; k < 3; ++k) air[k] = wind[k][i];
      for (int k = 0; k < (int)r.rotors; ++k) air[3 + k] = t[WEATHER_NOISE_0 + k][i];
    }
  }
}
#endif
