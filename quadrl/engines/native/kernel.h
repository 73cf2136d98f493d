// A control step of free flight for one aircraft of many, from its column of a table to its next
// observation, and to the start of its next episode where one is over: a thread of a GPU for each.
//
// quadrl/core/source.py writes what stands before it: numbers (ROTORS, ...), where things stand in the
// tables (AT_...), the functions begin, command, finish and start, and those that give them what they
// take. The forces, the integrator, the weather, solids, rays and the random numbers are those of
// free flight, whose steps this one's equal to the bit.
#ifndef QUADRL_KERNEL_H_
#define QUADRL_KERNEL_H_

#include "aero.h"
#include "philox.h"
#include "push.h"
#include "runge_kutta.h"
#if BLOWS
#include "weather.c"
#endif
#if SOLIDS || RAYS
#include "rays.c"
#endif

// The tables of n aircraft, a column for each. table: motion, what task and sensors remember, and all
// else that differs between the aircraft. pool: columns with which episodes begin, their first
// observation last, where they are not computed here. action: ACTIONS numbers a row. out: what is
// observed in the present episodes and in the ones that the step has flown, SEEN numbers each, then
// reward, error and the terms of the reward. flags: over, terminated, truncated, success, diverged
// and the task's ends, a byte each. marks: the number from 1 on of an aircraft whose action, reward or
// start is no number, in this order. The seeds are keys, and numbers of the next episodes.
typedef struct {
  double* table;
  const double* pool;
  double* out;
  const double* action;
  const int64_t* keys;
  int64_t* episodes;
  uint8_t* flags;
  int32_t* marks;
  int64_t columns, pooled;
} Batch;
enum { OVER, TERMINATED, TRUNCATED, SUCCESS, DIVERGED, OWN_ENDS };
enum { OF_ACTION, OF_REWARD, OF_START };
enum { REWARD = 2 * SEEN, ERROR, OWN_TERMS };
enum { MOTION = SPEED + ROTORS };
#define AT(k) column[(int64_t)(k) * columns]
#define UNROLLED _Pragma("GCC unroll 256")

// Whether MuJoCo calls a motion stable and a physics step resolves it.
static inline int resolved(const Lanes* m, const Aircraft* a) {
  const double v[3] = {m[VELOCITY][0], m[VELOCITY + 1][0], m[VELOCITY + 2][0]};
  const double r[3] = {m[BODY_RATE][0], m[BODY_RATE + 1][0], m[BODY_RATE + 2][0]};
  int sound = (aero_length(v) <= a->resolved_speed[0]) & (aero_length(r) <= a->resolved_turn[0]);
  UNROLLED for (int k = 0; k < MOTION; ++k) sound &= fabs(m[k][0]) < 1e10;  // mjMAXVAL; not NaN
  return sound;
}

#if POOLED
// Begins the episode of a row that comes next: the first one in the column of the pool with its own
// number, further ones in any.
static inline void begin_row(const Batch* b, int64_t row) {
  const int64_t columns = b->columns, key = b->keys[row], episode = b->episodes[row];
  double* column = b->table + row;
  uint32_t w[4];
  words(w, 0, POOL, episode, key);
  const uint64_t any = (uint64_t)w[0] * (uint64_t)b->pooled >> 32;
  const double* from = b->pool + (episode ? (int64_t)any : row % b->pooled);
  for (int k = 0; k < BEGUN; ++k) AT(k) = from[k * b->pooled];
  for (int k = 0; k < SEEN; ++k) b->out[k * columns + row] = from[(BEGUN + k) * b->pooled];
#if LATE
  for (int k = 0; k < LENGTH * ROTORS; ++k) AT(AT_QUEUE + k) = AT(SPEED + k % ROTORS);
  for (int k = 0; k < AGED * LENGTH * SPEED; ++k) AT(AT_PAST + k) = AT(k % SPEED);
#endif
  b->episodes[row] = episode + 1;
}
#else
// Begins the episode of a row that comes next: writes its motion, what is remembered, and its first
// observation.
static inline void begin_row(const Batch* b, int64_t row) {
  const int64_t columns = b->columns, key = b->keys[row], episode = b->episodes[row];
  double* column = b->table + row;
  Lanes x[start_taken], y[start_given];
  Aircraft a;
  uint32_t block[4];
  words(block, 0, MEMBERS, episode, key);
  x[0][0] = uniform(block[0]);
  UNROLLED for (int k = 0; k < DRAWN; ++k) {
    if (k % 4 == 0) words(block, k / 4, START, episode, key);
    x[1 + k][0] = uniform(block[k % 4]);
  }
  aircraft(&a, column, columns);
  start_takes(x, &a);
  start_function((const double*)0, (const Lanes*)x, y, 1);
  UNROLLED for (int k = 0; k < MOTION + KEPT; ++k) AT(k) = y[k][0];
  UNROLLED for (int k = 0; k < SEEN; ++k) b->out[k * columns + row] = y[MOTION + KEPT + k][0];
  if (!resolved((const Lanes*)y, &a)) b->marks[OF_START] = (int32_t)(row + 1);
  b->episodes[row] = episode + 1;
}
#endif

// A normal number of a control step: number j of `count` of a stream.
static inline double normal_of(int64_t key, int64_t episode, int64_t step, int64_t stream,
                               int64_t count, int64_t j) {
  uint32_t w[4];
  words(w, step * ((count + 1) / 2) + j / 2, stream, episode, key);
  return j % 2 ? normal(w[2], w[3]) : normal(w[0], w[1]);
}

#if SOLIDS || RAYS
// Measures the world about a row: the clearance, and what is read along rays.
static inline double measure(const double* column, int64_t columns, const Lanes* m, int64_t key,
                             int64_t episode, int64_t step, double* read) {
  double p[7], r[9], point[3], least = HUGE_VAL;
  Fan fan;
  UNROLLED for (int k = 0; k < 7; ++k) p[k] = m[POSITION + k][0];
  rotation_of(p + 3, r);
#if RAYS
  aim(&fan, RAYS, ray_along, ray_place, RAY_FRAME, RAY_REACH, p, point, read);
#endif
  for (int k = 0; k < SOLIDS; ++k) {
    Solid solid;
    take_solid(&solid, k, column, columns);
    const double far = least + solid.size[0] + solid.size[1] + solid.size[2] + BALLS_REACH;
    if (squared(p, solid.position) < far * far) least = nearer(&solid, balls, BALLS, p, r, least);
#if RAYS
    look(&solid, point, RAY_REACH, RAYS, &fan, read);
#endif
  }
#if RAYS
  for (int k = 0; k < RAYS; ++k) {
    double seen = read[k];
    int nothing = seen >= RAY_REACH;
    if (RAY_BIASED) seen += AT(AT_GIVEN + RAY_BIAS + k);
    if (RAY_NOISE > 0 || RAY_SHARE > 0) {
      const double share = RAY_SHARE * read[k];
      const double deviation = sqrt(RAY_NOISE * RAY_NOISE + share * share);
      seen += deviation * normal_of(key, episode, step, RAY_STREAM, RAYS_DRAWN, k);
    }
    if (RAY_DROPOUT) {
      const int64_t j = RAYS_DRAWN - RAYS + k;
      nothing |= normal_of(key, episode, step, RAY_STREAM, RAYS_DRAWN, j) > RAY_LOST;
    }
    if (RAY_STEP > 0) seen = RAY_STEP * floor(seen / RAY_STEP + 0.5);
    seen = seen < 0 ? 0 : seen > RAY_REACH ? RAY_REACH : seen;
    seen = nothing ? RAY_REACH : seen;
    read[k] = RAY_LOG ? log(seen > RAY_LEAST ? seen : RAY_LEAST) : seen;
  }
#endif
  return least;
}
#endif

// Flies a row through a control step and lets the task judge it.
static inline void step_row(const Batch* b, int64_t row) {
  const World world = FREE_WORLD;
  const int64_t columns = b->columns, key = b->keys[row], episode = b->episodes[row] - 1;
  double* column = b->table + row;
  const double* action = b->action + row * ACTIONS;
  Lanes m[ROWS], last[MOTION], x[begin_taken], setpoint[begin_given], mean[ROTORS];
  Lanes taken[finish_taken], y[finish_given];
  Setting s;
  Aircraft a;
  aircraft(&a, column, columns);
  UNROLLED for (int k = 0; k < MOTION; ++k) x[k][0] = last[k][0] = m[k][0] = AT(k);
  int given = 1;
  UNROLLED for (int k = 0; k < ACTIONS; ++k) {
    x[MOTION + k][0] = action[k];
    given &= fabs(action[k]) < HUGE_VAL;
  }
  if (!given) b->marks[OF_ACTION] = (int32_t)(row + 1);
  const int64_t begun = (int64_t)AT(AT_STEPS), steps = begun + 1;
#if PUSHED
  uint32_t hit[8];
  words(hit, begun * 2, PUSHES, episode, key);
  if (uniform(hit[0]) < PUSH_CHANCE) {
    words(hit + 4, begun * 2 + 1, PUSHES, episode, key);
    double speed[3] = {m[VELOCITY][0], m[VELOCITY + 1][0], m[VELOCITY + 2][0]};
    double turn[3] = {m[BODY_RATE][0], m[BODY_RATE + 1][0], m[BODY_RATE + 2][0]};
    add_push(speed, PUSH_VELOCITY, hit[1], hit[2]);
    add_push(turn, PUSH_BODY_RATE, hit[3], hit[4]);
    UNROLLED for (int k = 0; k < 3; ++k) {
      m[VELOCITY + k][0] = speed[k], m[BODY_RATE + k][0] = turn[k];
    }
    UNROLLED for (int k = 0; k < MOTION; ++k) x[k][0] = m[k][0];
  }
#endif
  begin_function((const double*)0, (const Lanes*)x, setpoint, 1);
  UNROLLED for (int k = 0; k < AIR; ++k) s.air[k][0] = 0;
#if BLOWS
  Lanes t[WEATHER_ROWS], wind[3];
  Streams streams = {{key}, {episode}, {0}};
  const Rows rows = {0, 0, 0, 0, 0, 1, 1, NOISY, PER_ROUGHNESS, CONTROL_TIMESTEP, PER_GUST_TIME};
  weather_takes(t, column, columns);
  blow(t, &streams, &rows, m[POSITION + 2], wind, 0);
  weather_gives((const Lanes*)t, column, columns);
  for (int k = 0; k < 3; ++k) s.air[k][0] = wind[k][0];
  for (int k = 0; k < NOISY; ++k) s.air[3 + k][0] = t[WEATHER_NOISE_0 + k][0];
#endif
#if LATE
  int64_t delay = (int64_t)AT(AT_DELAY);
#if LINKED
  uint32_t link[4];
  words(link, begun, LINK, episode, key);
  delay += uniform(link[0]) < AT(AT_LINK) ? SUBSTEPS : 0;
  int64_t left = (int64_t)AT(AT_LINK + 3);
  left -= left > 0;
  if (!left && uniform(link[1]) < AT(AT_LINK + 1)) left = (int64_t)AT(AT_LINK + 2);
  AT(AT_LINK + 3) = (double)left;
#endif
#endif
  UNROLLED for (int k = 0; k < ROTORS; ++k) mean[k][0] = LOOPS ? 0 : setpoint[k][0];
#if LOOPS || LATE
  for (int step = 0; step < SUBSTEPS; ++step) {
#if LOOPS
    Lanes now[MOTION + begin_given];
    UNROLLED for (int k = 0; k < MOTION; ++k) now[k][0] = m[k][0];
    UNROLLED for (int k = 0; k < begin_given; ++k) now[MOTION + k][0] = setpoint[k][0];
    command_function((const double*)0, (const Lanes*)now, s.command, 1);
    UNROLLED for (int k = 0; k < ROTORS; ++k) {
      mean[k][0] = mean[k][0] + s.command[k][0] / SUBSTEPS;
    }
#else
    UNROLLED for (int k = 0; k < ROTORS; ++k) s.command[k][0] = setpoint[k][0];
#endif
#if LATE
    const int64_t newest = begun * SUBSTEPS + step + 1, at = newest % LENGTH;
    UNROLLED for (int k = 0; k < ROTORS; ++k) AT(AT_QUEUE + at * ROTORS + k) = s.command[k][0];
    int64_t from = AT_QUEUE + (newest + LENGTH - delay) % LENGTH * ROTORS;
#if LINKED
    from = left ? AT_LAST : from;
#endif
    UNROLLED for (int k = 0; k < ROTORS; ++k) s.command[k][0] = AT(from + k);
#if LINKED
    UNROLLED for (int k = 0; k < ROTORS; ++k) AT(AT_LAST + k) = s.command[k][0];
#endif
    for (int k = 0; k < AGED * SPEED; ++k) AT(AT_PAST + at * SPEED + k) = m[k][0];
#endif
    runge_kutta(&a, EFFECTS, ROTORS, &world, &s, m, 1);
  }
#else
  UNROLLED for (int k = 0; k < ROTORS; ++k) s.command[k][0] = setpoint[k][0];
  runge_kutta(&a, EFFECTS, ROTORS, &world, &s, m, SUBSTEPS);
#endif
  const int sound = resolved((const Lanes*)m, &a);
  UNROLLED for (int k = 0; k < MOTION; ++k) taken[k][0] = m[k][0] = sound ? m[k][0] : last[k][0];
  UNROLLED for (int k = 0; LOOPS && k < ROTORS; ++k) {
    mean[k][0] = sound ? mean[k][0] : last[SPEED + k][0];
  }
  taken[MOTION][0] = !sound;
  double clearance = HUGE_VAL, read[RAYS + 1];
#if SOLIDS || RAYS
  clearance = measure(column, columns, (const Lanes*)m, key, episode, steps, read);
#endif
#if SENSES
  int at = MOTION + 1;
  taken[at++][0] = (double)steps;
#if AGED
  for (int k = 0; k < SPEED; ++k, ++at) {
    const int64_t age = (int64_t)AT(AT_AGES + (k >= BODY_RATE)), end = steps * SUBSTEPS;
    taken[at][0] = age ? AT(AT_PAST + (end + LENGTH - age + 1) % LENGTH * SPEED + k) : m[k][0];
  }
#endif
#if SENSORS
  UNROLLED for (int d = 0; d < SENSORS; ++d) {
    const int64_t count = sensed[d][1], first = steps * ((count + 1) / 2);
    uint32_t w[4];
    for (int64_t k = 0; k < count; ++k, ++at) {
      if (k % 2 == 0) words(w, first + k / 2, sensed[d][0], episode, key);
      taken[at][0] = normal(w[2 * (k % 2)], w[2 * (k % 2) + 1]);
    }
  }
#endif
#endif
  finish_takes(taken, (const Lanes*)last, action, (const Lanes*)mean, (const Lanes*)s.air, column,
               columns, &a, clearance, read);
  finish_function((const double*)0, (const Lanes*)taken, y, 1);
  double* out = b->out + row;
  const Lanes* rest = y + KEPT + OBSERVED + TRUTH;
  UNROLLED for (int k = 0; k < SEEN; ++k) {
    const int from = k < OBSERVED ? KEPT + k : PRIVILEGED + k - OBSERVED;
    out[(SEEN + k) * columns] = out[k * columns] = y[from][0];
  }
  UNROLLED for (int k = 0; k < TERMS; ++k) out[(OWN_TERMS + k) * columns] = rest[k][0];
  rest += TERMS + ENDS;
  out[REWARD * columns] = rest[0][0];
  out[ERROR * columns] = rest[1][0];
  if (!(fabs(rest[0][0]) < HUGE_VAL)) b->marks[OF_REWARD] = (int32_t)(row + 1);
  uint8_t* flags = b->flags + row;
  const int over = (rest[2][0] != 0) | (rest[3][0] != 0);
  flags[0] = (uint8_t)over;
  UNROLLED for (int k = 0; k < 4; ++k) flags[(TERMINATED + k) * columns] = rest[2 + k][0] != 0;
  UNROLLED for (int k = 0; k < ENDS; ++k) {
    flags[(OWN_ENDS + k) * columns] = y[KEPT + OBSERVED + TRUTH + TERMS + k][0] != 0;
  }
  if (over) {
    begin_row(b, row);
    return;
  }
  UNROLLED for (int k = 0; k < MOTION; ++k) AT(k) = m[k][0];
  UNROLLED for (int k = 0; k < KEPT; ++k) AT(MOTION + k) = y[k][0];
}

#ifdef __CUDACC__
// Measured on compute capability 9.0: four blocks at a time are fastest. Elsewhere they would spill.
#if __CUDA_ARCH__ == 900
#define RESIDENT __launch_bounds__(128, 4)
#else
#define RESIDENT __maxnreg__(160)
#endif
extern "C" __global__ void RESIDENT step(const Batch* batch, int64_t n) {
  const Batch b = *batch;
  const int64_t row = (int64_t)blockIdx.x * blockDim.x + threadIdx.x;
  if (row < n) step_row(&b, row);
}
extern "C" __global__ void __launch_bounds__(128) start(const Batch* batch, int64_t n,
                                                        const uint8_t* chosen) {
  const Batch b = *batch;
  const int64_t row = (int64_t)blockIdx.x * blockDim.x + threadIdx.x;
  if (row < n && (!chosen || chosen[row])) begin_row(&b, row);
}
#else
#define EXPORTED __attribute__((visibility("default")))
EXPORTED void step(const Batch* batch, int64_t n) {
  for (int64_t row = 0; row < n; ++row) step_row(batch, row);
}
EXPORTED void start(const Batch* batch, int64_t n, const uint8_t* chosen) {
  for (int64_t row = 0; row < n; ++row) {
    if (!chosen || chosen[row]) begin_row(batch, row);
  }
}
#endif

#endif  // QUADRL_KERNEL_H_
