// Free flight: equations 3 to 10 of the paper, integrated by the classical Runge-Kutta method; and
// whole control steps of it: commands, physics, and what the task makes of it.
//
// The commands and the task are functions of rows that quadrl/engines/rowwise.py generates. LANES
// aircraft pass through all of them while their numbers are at hand.
#include "flight.h"
#include "philox.h"

// Advances aircraft first..last-1 by a number of steps, in place, with the commands in ctrl. first
// is a multiple of LANES. Returns how many are marked in near and left as they were.
QUADRL_EXPORT int64_t quadrl_free_flight(const Rows* rows, int64_t first, int64_t last,
                                         int64_t steps) {
  Block b;
  Aircraft own;
  int64_t marked = 0;
  if (!rows->block) spread(rows->parameters, &own);
  for (int64_t row = first; row < last; row += LANES) {
    load(rows, NULL, row, last, &b, &own);
    advance(rows, &b, steps);
    marked += store(rows, &b);
  }
  return marked;
}

// A generated function: `taken` to `given` numbers of each of LANES rows.
typedef struct {
  void (*run)(const double* constants, const Lanes* x, Lanes* y, int rows);
  const double* constants;
  int64_t taken, given;
} Function;

// Calls a function of a Step.
static inline void run(const Function* function, const Lanes* x, Lanes* y, int rows) {
  function->run(function->constants, x, y, rows);
}

// A number that each row has, at i * stride for row i, and which one it is for a function.
typedef struct {
  const double* at;
  int64_t stride, number;
} Place;

// Commands that arrive late, and motions that are remembered. queue: commands of the last `length`
// physics steps, one per rotor of each of `rows` aircraft, the newest at `newest`; past: as many
// motions (qpos, qvel), each of before its step, or NULL; `newest` is where the control step that is
// flown ends. delay: of each aircraft, in physics steps; less than `length` by the physics steps of a
// control step. left: for how many control steps the link of each aircraft is lost, this one
// counted. last: its commands that arrived last, one per rotor. Filled by quadrl/conditions.
typedef struct {
  double *queue, *past, *last;
  const int64_t *delay, *newest, *left;
  int64_t length, rows;
} Late;

// What sensors are given: the control steps since the start of each episode; then, unless age is
// NULL, AGED coordinates, ten as many physics steps old as age[row] says and three as age[rows + row]
// does; then normal numbers, for each of `drawn` sensors a stream and how many. They follow from
// keys, episodes and steps. Filled by quadrl/core/tables.py.
typedef struct {
  const int64_t *keys, *episodes, *steps, *age, *draws;
  int64_t drawn, rows;
} Senses;
enum { AGED = SPEED, MOTION_AGED = BODY_RATE };

// What a control step reads and fills. motion: 7 of qpos, 6 of qvel and one per rotor of each
// aircraft, at the end of this control step. setpoint, mean: as many numbers a row as the first
// function gives, and one per rotor [rad/s], the mean of the commands over the control step. limits:
// largest speed [m/s] and body rate [rad/s] of aircraft i at i * limit_stride. diverged: a byte a row.
// `finish` takes the motion, whether it has diverged, what `senses` give (NULL: nothing), and what is
// at `reads` places; it gives `kept` numbers for the table `out`, then as many as go to the table
// `rest`, both with `columns` columns, and as the last ones BYTES flags. `reward` is the one in
// `rest` that must be finite. late: NULL where commands arrive at once. loops: whether commands
// change with each of the `substeps` physics steps; held: from each of these, for how many they
// stay. Filled by quadrl/core/compiled.py.
typedef struct {
  const Rows* rows;
  const Late* late;
  const Senses* senses;
  const int64_t* held;
  const Function *begin, *command, *finish, *start;
  const double *action, *limits;
  double *motion, *setpoint, *mean;
  const uint8_t* diverged;
  const Place* places;
  double *out, *rest;
  uint8_t* flags;
  int64_t reads, actions, limit_stride, kept, reward, columns, loops, substeps;
} Step;
enum { BYTES = 4, LEFT = 1, BROKEN = 2 };
// How far ahead tables are fetched, which have more rows than a processor follows by itself.
enum { AHEAD = 2 * LANES };
// Parts of a control step after its physics: end with a sound motion, finish the task's step.
enum { ENDS = 1, FINISHES = 2 };

// Which motions are such that MuJoCo calls them stable and a physics step resolves them.
VECTORISED static void resolve(const Lanes* m, int rotors, const Lanes limits[2],
                               int64_t sound[LANES]) {
  for (int i = 0; i < LANES; ++i) {
    const double v[3] = {m[VELOCITY][i], m[VELOCITY + 1][i], m[VELOCITY + 2][i]};
    const double r[3] = {m[BODY_RATE][i], m[BODY_RATE + 1][i], m[BODY_RATE + 2][i]};
    sound[i] = (aero_length(v) <= limits[0][i]) & (aero_length(r) <= limits[1][i]);
  }
  for (int k = 0; k < SPEED + rotors; ++k) {
    for (int i = 0; i < LANES; ++i) sound[i] &= fabs(m[k][i]) < 1e10;  // mjMAXVAL; not NaN
  }
}

// Gives spare lanes what the first one has, where a function has computed that alone.
static void twin(Lanes* y, int64_t numbers, int filled) {
  for (int64_t k = 0; filled == 1 && k < numbers; ++k) {
    for (int i = 1; i < LANES; ++i) y[k][i] = y[k][0];
  }
}

// Queues the commands of a block for some physics steps, and takes those that arrive in the first.
static void arrive(const Late* late, Block* b, int rotors, int64_t first, int64_t steps,
                   int64_t substeps) {
  for (int i = 0; i < b->filled; ++i) {  // spare lanes may fly another aircraft
    const int64_t row = b->row[i], newest = *late->newest + late->length - substeps + 1 + first;
    for (int64_t step = 0; step < steps; ++step) {
      double* to = late->queue + ((newest + step) % late->length * late->rows + row) * rotors;
      for (int k = 0; k < rotors; ++k) to[k] = b->s.command[k][i];
    }
    const int64_t then = (newest + late->length - late->delay[row]) % late->length;
    const double* from = late->queue + (then * late->rows + row) * rotors;
    if (late->left[row]) from = late->last + row * rotors;
    for (int k = 0; k < rotors; ++k) {
      b->s.command[k][i] = late->last[row * rotors + k] = from[k];
    }
    if (late->past) {
      double* kept = late->past + (newest % late->length * late->rows + row) * SPEED;
      for (int k = 0; k < SPEED; ++k) kept[k] = b->m[k][i];
    }
  }
}

// Commands the rotors of a block for the next physics steps, from the motion or from the setpoint,
// within their ceiling; the mean is of what is wanted.
static void command(const Step* s, Block* b, const Lanes* setpoint, Lanes* mean, Lanes* x,
                    int64_t first, int64_t steps) {
  const int rotors = (int)s->rows->rotors, motion = SPEED + rotors;
  if (s->loops) {
    memcpy(x, b->m, motion * sizeof(Lanes));
    memcpy(x + motion, setpoint, s->begin->given * sizeof(Lanes));
    run(s->command, (const Lanes*)x, b->s.command, b->filled);
    twin(b->s.command, rotors, b->filled);
  }
  for (int k = 0; k < rotors; ++k) {
    for (int i = 0; i < LANES; ++i) {
      const double wanted = s->loops ? b->s.command[k][i] : setpoint[k][i];
      mean[k][i] = s->loops ? mean[k][i] + wanted / s->substeps : wanted;
      b->s.command[k][i] = wanted;
    }
  }
  if (s->late) arrive(s->late, b, rotors, first, steps, s->substeps);
  for (int k = 0; k < rotors; ++k) {
    for (int i = 0; i < LANES; ++i) {
      const double ceiling = s->rows->ceiling[b->row[i] * rotors + k], given = b->s.command[k][i];
      b->s.command[k][i] = ceiling < given ? ceiling : given;
    }
  }
}

// Takes the action or what was made of it, and commands and flies physics steps first..end-1 of the
// control step. Marks the aircraft that may touch something in near; theirs and the others' commands
// are written.
static void fly_on(const Step* s, Block* b, int64_t first, int64_t end, Lanes* x) {
  const Rows* r = s->rows;
  const int rotors = (int)r->rotors, motion = SPEED + rotors;
  const int64_t numbers = s->begin->given;
  Lanes setpoint[s->begin->given], mean[MAX_ROTORS];
  if (first == 0) {
    memcpy(x, b->m, motion * sizeof(Lanes));
    for (int64_t k = 0; k < s->actions; ++k) {
      for (int i = 0; i < LANES; ++i) x[motion + k][i] = s->action[b->row[i] * s->actions + k];
    }
    run(s->begin, (const Lanes*)x, setpoint, b->filled);
    twin(setpoint, numbers, b->filled);
    memset(mean, 0, sizeof mean);
  } else {
    for (int i = 0; i < LANES; ++i) {
      for (int64_t k = 0; k < numbers; ++k) setpoint[k][i] = s->setpoint[b->row[i] * numbers + k];
      for (int k = 0; k < rotors; ++k) mean[k][i] = s->mean[b->row[i] * rotors + k];
    }
  }
  char left[LANES] = {0};
  for (int64_t flown = first; flown < end; flown += s->held[flown]) {
    command(s, b, (const Lanes*)setpoint, mean, x, flown, s->held[flown]);
    advance(r, b, s->held[flown]);
    for (int i = 0; i < b->filled; ++i) left[i] |= r->near[b->row[i]];
  }
  for (int i = 0; i < b->filled; ++i) {
    const int64_t row = b->row[i];
    r->near[row] = left[i];
    for (int64_t k = 0; k < numbers; ++k) s->setpoint[row * numbers + k] = setpoint[k][i];
    for (int k = 0; k < rotors; ++k) {
      s->mean[row * rotors + k] = mean[k][i];
      r->ctrl[row * r->stride + k] = b->s.command[k][i];
    }
  }
}

// Whether the lanes of a block are rows that follow each other, none of them marked.
static int is_whole(const Rows* r, const Block* b) {
  int whole = b->filled == LANES;
  for (int i = 0; i < LANES; ++i) whole &= b->row[i] == b->row[0] + i && !r->near[b->row[i]];
  return whole;
}

// Writes what the sensors of a block are given.
static void sense(const Senses* s, const Late* late, const Block* b, Lanes* x) {
  for (int i = 0; i < LANES; ++i) {
    const int64_t row = b->row[i];
    int64_t at = 0;
    x[at++][i] = (double)s->steps[row];
    for (int k = 0; s->age && k < AGED; ++k, ++at) {
      // The motion before each physics step is remembered.
      const int64_t age = s->age[(k < MOTION_AGED ? 0 : s->rows) + row];
      const int64_t then = (*late->newest + late->length - age + 1) % late->length;
      x[at][i] = age ? late->past[(then * late->rows + row) * SPEED + k] : b->m[k][i];
    }
    for (int64_t d = 0; d < s->drawn; ++d) {
      const int64_t stream = s->draws[2 * d], count = s->draws[2 * d + 1];
      uint32_t w[4];
      for (int64_t k = 0; k < count; ++k, ++at) {
        const int64_t block = s->steps[row] * ((count + 1) / 2) + k / 2;
        if (k % 2 == 0) words(w, block, stream, s->episodes[row], s->keys[row]);
        x[at][i] = normal(w[2 * (k % 2)], w[2 * (k % 2) + 1]);
      }
    }
  }
}

// Lets the task judge the aircraft of a block that are not marked. Returns how many have a reward
// that is not finite.
VECTORISED static int64_t finish(const Step* s, const Block* b, Lanes* x) {
  const int motion = SPEED + (int)s->rows->rotors, whole = is_whole(s->rows, b);
  const int64_t first = b->row[0], flags = s->finish->given - BYTES;
  Lanes y[s->finish->given];
  memcpy(x, b->m, motion * sizeof(Lanes));
  for (int i = 0; i < LANES; ++i) x[motion][i] = s->diverged[b->row[i]];
  if (s->senses) sense(s->senses, s->late, b, x + motion + 1);
  for (const Place* place = s->places; place < s->places + s->reads; ++place) {
    if (whole && place->stride == 1) {
      memcpy(x[place->number], place->at + first, sizeof(Lanes));
      __builtin_prefetch(place->at + first + AHEAD);
    } else {
      for (int i = 0; i < LANES; ++i) {
        x[place->number][i] = place->at[b->row[i] * place->stride];
      }
    }
  }
  run(s->finish, (const Lanes*)x, y, b->filled);
  int64_t unsound = 0;
  for (int64_t k = 0; k < flags; ++k) {
    double* to = k < s->kept ? s->out + k * s->columns : s->rest + (k - s->kept) * s->columns;
    if (whole) {
      memcpy(to + first, y[k], sizeof(Lanes));
      __builtin_prefetch(to + first + AHEAD, 1);
    } else {
      for (int i = 0; i < b->filled; ++i) {
        if (!s->rows->near[b->row[i]]) to[b->row[i]] = y[k][i];
      }
    }
  }
  for (int i = 0; i < b->filled; ++i) {
    if (s->rows->near[b->row[i]]) continue;
    uint8_t* to = s->flags + b->row[i];
    for (int k = 0; k < BYTES; ++k) to[k * s->columns] = y[flags + k][i] != 0;
    unsound += !isfinite(y[s->kept + s->reward][i]);
  }
  return unsound;
}

// Does physics steps begin..end-1 and some parts of a control step for aircraft first..last-1 of a
// list (NULL: of all; first is a multiple of LANES then). Marks in near those that are LEFT, with
// the motion of before, since they may touch something, and those that end BROKEN, which have none
// in `motion`. Returns how many these are, plus 2^32 for each whose reward is not finite.
QUADRL_EXPORT int64_t quadrl_step(const Step* s, const int64_t* ids, int64_t first, int64_t last,
                                  int64_t parts, int64_t begin, int64_t end) {
  const Rows* r = s->rows;
  const int rotors = (int)r->rotors, motion = SPEED + rotors;
  Block b;
  Aircraft own;
  // For the motion and an action or a setpoint, or for what the task's part takes.
  Lanes x[s->begin->taken + s->begin->given + s->finish->taken];
  int64_t marked = 0;
  if (!r->block) spread(r->parameters, &own);
  for (int64_t row = first; row < last; row += LANES) {
    load(r, ids, row, last, &b, &own);
    if (parts == FINISHES) {
      for (int i = 0; i < LANES; ++i) {
        for (int k = 0; k < motion; ++k) b.m[k][i] = s->motion[b.row[i] * motion + k];
      }
    }
    if (begin < end) {
      fly_on(s, &b, begin, end, x);
    } else {
      for (int i = 0; i < b.filled; ++i) r->near[b.row[i]] = 0;
    }
    if (parts & ENDS) {
      Lanes limits[2];
      int64_t sound[LANES];
      for (int i = 0; i < LANES; ++i) {
        const double* own = s->limits + b.row[i] * s->limit_stride;
        limits[0][i] = own[0];
        limits[1][i] = own[1];
      }
      resolve((const Lanes*)b.m, rotors, (const Lanes*)limits, sound);
      for (int i = 0; i < b.filled; ++i) {
        const int64_t at = b.row[i];
        if (r->near[at]) continue;
        if (!sound[i]) r->near[at] = BROKEN;
        for (int k = 0; k < motion && sound[i]; ++k) s->motion[at * motion + k] = b.m[k][i];
      }
    }
    if (begin < end) store(r, &b);
    for (int i = 0; i < b.filled; ++i) marked += r->near[b.row[i]] != 0;
    if (parts & FINISHES) marked += finish(s, &b, x) << 32;
  }
  return marked;
}

// Begins episodes of aircraft `ids` (n). Their `start` takes the first random number of each episode's
// stream `members` and the first `numbers` of its `stream`, for keys and episodes of the aircraft
// in the list, and what is at `places`; it gives a motion, numbers for `out`, and the observation;
// they go to `room`, for quadrl_place. Returns how many of the motions a physics step does not resolve.
QUADRL_EXPORT int64_t quadrl_begin(const Step* s, const Place* places, int64_t reads,
                                   const int64_t* ids, int64_t n, const int64_t* keys,
                                   const int64_t* episodes, int64_t stream, int64_t numbers,
                                   int64_t members, double* room) {
  const int rotors = (int)s->rows->rotors;
  const int64_t given = s->start->given;
  Lanes x[s->start->taken], y[s->start->given];
  int64_t unsound = 0;
  for (int64_t first = 0; first < n; first += LANES) {
    const int filled = n - first < LANES ? (int)(n - first) : LANES;
    Lanes limits[2];
    int64_t sound[LANES];
    for (int i = 0; i < LANES; ++i) {
      const int64_t at = first + (i < filled ? i : 0);
      uint32_t block[4];
      words(block, 0, members, episodes[at], keys[at]);
      x[0][i] = block[0] * 0x1p-32;
      for (int64_t k = 0; k < numbers; ++k) {
        if (k % 4 == 0) words(block, k / 4, stream, episodes[at], keys[at]);
        x[1 + k][i] = block[k % 4] * 0x1p-32;
      }
      for (int64_t k = 0; k < reads; ++k) {
        x[places[k].number][i] = places[k].at[ids[at] * places[k].stride];
      }
      for (int k = 0; k < 2; ++k) limits[k][i] = s->limits[ids[at] * s->limit_stride + k];
    }
    run(s->start, (const Lanes*)x, y, filled);
    twin(y, given, filled);
    resolve((const Lanes*)y, rotors, (const Lanes*)limits, sound);
    for (int i = 0; i < filled; ++i) {
      unsound += !sound[i];
      for (int64_t k = 0; k < given; ++k) room[(first + i) * given + k] = y[k][i];
    }
  }
  return unsound;
}

// Puts aircraft `ids` (n) where quadrl_begin lets their episodes begin. The first `kept` numbers
// after the motion go to `out`; an observation there is that of the last control step.
QUADRL_EXPORT void quadrl_place(const Step* s, const int64_t* ids, int64_t n, const double* room,
                                int64_t given, int64_t kept) {
  const Rows* r = s->rows;
  const int64_t rotors = r->rotors, motion = SPEED + rotors;
  for (int64_t at = 0; at < n; ++at) {
    const int64_t row = ids[at], place = row * r->stride;
    const double* from = room + at * given;
    memcpy(r->qpos + place, from, 7 * sizeof(double));
    memcpy(r->qvel + place, from + 7, 6 * sizeof(double));
    memcpy(r->act + place, from + SPEED, rotors * sizeof(double));
    memcpy(s->motion + row * motion, from, motion * sizeof(double));
    for (int64_t k = 0; k < kept; ++k) s->out[k * s->columns + row] = from[motion + k];
  }
}
