// A control step of free flight for one aircraft of many, from its column of a table to its next
// observation, and to the start of its next episode where one is over: a thread of a GPU for each.
//
// quadrl/device/text.py writes what stands before it: numbers (ROTORS, ...), the functions begin,
// command, finish and start, and those that give them what they take. The forces, the integrator and
// the random numbers are those of native/free_flight.c, whose steps this one's equal to the bit.
#ifndef QUADRL_KERNEL_H_
#define QUADRL_KERNEL_H_

#include "aero.h"
#include "philox.h"
#include "runge_kutta.h"

// The tables of n aircraft, a column for each. table: motion, what the task remembers, and numbers of
// the aircraft that differ between them. action: ACTIONS numbers a row. out: the observation of the
// present episodes and of the ones that the step has flown, SEEN numbers each, then reward, error and
// the terms of the reward. flags: over, terminated, truncated, success, diverged and the task's ends,
// a byte each. marks: the number from 1 on of an aircraft whose action, reward or start is no
// number, in this order. The seeds are keys, and numbers of the next episodes.
typedef struct {
  double *table, *out;
  const double* action;
  const int64_t* keys;
  int64_t* episodes;
  uint8_t* flags;
  int32_t* marks;
  int64_t columns;
} Batch;
enum { OVER, TERMINATED, TRUNCATED, SUCCESS, DIVERGED, OWN_ENDS };
enum { OF_ACTION, OF_REWARD, OF_START };
enum { REWARD = 2 * SEEN, ERROR, OWN_TERMS };
enum { MOTION = SPEED + ROTORS };

// The motion of a row, whether MuJoCo calls it stable and a physics step resolves it.
static inline int resolved(const Lanes* m, const Aircraft* a) {
  const double v[3] = {m[VELOCITY][0], m[VELOCITY + 1][0], m[VELOCITY + 2][0]};
  const double r[3] = {m[BODY_RATE][0], m[BODY_RATE + 1][0], m[BODY_RATE + 2][0]};
  int sound = (aero_length(v) <= a->resolved_speed[0]) & (aero_length(r) <= a->resolved_turn[0]);
#pragma GCC unroll 32
  for (int k = 0; k < MOTION; ++k) sound &= fabs(m[k][0]) < 1e10;  // mjMAXVAL; not NaN
  return sound;
}

// Begins the episode of a row that comes next: writes its motion, what is remembered, and its first
// observation.
static inline void begin_row(const Batch* b, int64_t row) {
  double* column = b->table + row;
  const int64_t key = b->keys[row], episode = b->episodes[row];
  Lanes x[start_taken], y[start_given];
  Aircraft a;
  uint32_t block[4];
  words(block, 0, MEMBERS, episode, key);
  x[0][0] = uniform(block[0]);
#pragma GCC unroll 64
  for (int k = 0; k < DRAWN; ++k) {
    if (k % 4 == 0) words(block, k / 4, START, episode, key);
    x[1 + k][0] = uniform(block[k % 4]);
  }
  aircraft(&a, column, b->columns);
  start_takes(x, &a);
  start_function((const double*)0, (const Lanes*)x, y, 1);
#pragma GCC unroll 256
  for (int k = 0; k < MOTION + KEPT; ++k) column[k * b->columns] = y[k][0];
#pragma GCC unroll 256
  for (int k = 0; k < SEEN; ++k) b->out[k * b->columns + row] = y[MOTION + KEPT + k][0];
  if (!resolved((const Lanes*)y, &a)) b->marks[OF_START] = (int32_t)(row + 1);
  b->episodes[row] = episode + 1;
}

// Flies a row through a control step and lets the task judge it.
static inline void step_row(const Batch* b, int64_t row) {
  const World world = WORLD;
  double* column = b->table + row;
  const double* action = b->action + row * ACTIONS;
  Lanes m[ROWS], last[MOTION], x[begin_taken], setpoint[begin_given], mean[ROTORS];
  Lanes taken[finish_taken], y[finish_given];
  Setting s;
  Aircraft a;
  aircraft(&a, column, b->columns);
#pragma GCC unroll 32
  for (int k = 0; k < MOTION; ++k) x[k][0] = last[k][0] = m[k][0] = column[k * b->columns];
  int given = 1;
#pragma GCC unroll 32
  for (int k = 0; k < ACTIONS; ++k) {
    x[MOTION + k][0] = action[k];
    given &= fabs(action[k]) < HUGE_VAL;
  }
  if (!given) b->marks[OF_ACTION] = (int32_t)(row + 1);
  begin_function((const double*)0, (const Lanes*)x, setpoint, 1);
  for (int k = 0; k < AIR; ++k) s.air[k][0] = 0;
#pragma GCC unroll 8
  for (int k = 0; k < ROTORS; ++k) mean[k][0] = LOOPS ? 0 : setpoint[k][0];
#if LOOPS
  for (int step = 0; step < SUBSTEPS; ++step) {
    Lanes now[MOTION + begin_given];
#pragma GCC unroll 32
    for (int k = 0; k < MOTION; ++k) now[k][0] = m[k][0];
#pragma GCC unroll 32
    for (int k = 0; k < begin_given; ++k) now[MOTION + k][0] = setpoint[k][0];
    command_function((const double*)0, (const Lanes*)now, s.command, 1);
#pragma GCC unroll 8
    for (int k = 0; k < ROTORS; ++k) mean[k][0] = mean[k][0] + s.command[k][0] / SUBSTEPS;
    runge_kutta(&a, EFFECTS, ROTORS, &world, &s, m, 1);
  }
#else
#pragma GCC unroll 8
  for (int k = 0; k < ROTORS; ++k) s.command[k][0] = setpoint[k][0];
  runge_kutta(&a, EFFECTS, ROTORS, &world, &s, m, SUBSTEPS);
#endif
  const int sound = resolved((const Lanes*)m, &a);
#pragma GCC unroll 32
  for (int k = 0; k < MOTION; ++k) taken[k][0] = m[k][0] = sound ? m[k][0] : last[k][0];
#pragma GCC unroll 8
  for (int k = 0; LOOPS && k < ROTORS; ++k) mean[k][0] = sound ? mean[k][0] : last[SPEED + k][0];
  taken[MOTION][0] = !sound;
  finish_takes(taken, (const Lanes*)last, action, (const Lanes*)mean, column, b->columns, &a);
  finish_function((const double*)0, (const Lanes*)taken, y, 1);
  double* out = b->out + row;
  const Lanes* rest = y + KEPT + SEEN;
#pragma GCC unroll 256
  for (int k = 0; k < SEEN; ++k) {
    out[(SEEN + k) * b->columns] = out[k * b->columns] = y[KEPT + k][0];
  }
#pragma GCC unroll 64
  for (int k = 0; k < TERMS; ++k) out[(OWN_TERMS + k) * b->columns] = rest[k][0];
  rest += TERMS + ENDS;
  out[REWARD * b->columns] = rest[0][0];
  out[ERROR * b->columns] = rest[1][0];
  if (!(fabs(rest[0][0]) < HUGE_VAL)) b->marks[OF_REWARD] = (int32_t)(row + 1);
  uint8_t* flags = b->flags + row;
  const int over = (rest[2][0] != 0) | (rest[3][0] != 0);
  flags[0] = (uint8_t)over;
#pragma GCC unroll 4
  for (int k = 0; k < 4; ++k) flags[(TERMINATED + k) * b->columns] = rest[2 + k][0] != 0;
#pragma GCC unroll 16
  for (int k = 0; k < ENDS; ++k) {
    flags[(OWN_ENDS + k) * b->columns] = y[KEPT + SEEN + TERMS + k][0] != 0;
  }
  if (over) {
    begin_row(b, row);
    return;
  }
#pragma GCC unroll 32
  for (int k = 0; k < MOTION; ++k) column[k * b->columns] = m[k][0];
#pragma GCC unroll 256
  for (int k = 0; k < KEPT; ++k) column[(MOTION + k) * b->columns] = y[k][0];
}

#ifdef __CUDACC__
#ifndef RESIDENT
#define RESIDENT 4
#endif
extern "C" __global__ void __launch_bounds__(128, RESIDENT) step(const Batch* batch, int64_t n) {
  const Batch b = *batch;
  const int64_t row = (int64_t)blockIdx.x * blockDim.x + threadIdx.x;
  if (row < n) step_row(&b, row);
}
extern "C" __global__ void __launch_bounds__(128) start(const Batch* batch, int64_t n, const uint8_t* chosen) {
  const Batch b = *batch;
  const int64_t row = (int64_t)blockIdx.x * blockDim.x + threadIdx.x;
  if (row < n && (!chosen || chosen[row])) begin_row(&b, row);
}
#else
QUADRL_EXPORT void step(const Batch* batch, int64_t n) {
  for (int64_t row = 0; row < n; ++row) step_row(batch, row);
}
QUADRL_EXPORT void start(const Batch* batch, int64_t n, const uint8_t* chosen) {
  for (int64_t row = 0; row < n; ++row) {
    if (!chosen || chosen[row]) begin_row(batch, row);
  }
}
#endif

#endif  // QUADRL_KERNEL_H_
