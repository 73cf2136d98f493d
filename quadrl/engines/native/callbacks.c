// MuJoCo's actuator and passive-force callbacks of the rotors and the airframe.
//
// They are global to the process, so each first asks whether the actuator or body is ours and
// otherwise answers exactly what MuJoCo does with no callback installed.
//
// Where an aircraft's numbers are in a model (written there by quadrl/engines/mjcf.py):
//   body_user         its row, an Aircraft
//   actuator_dynprm   [0] number of the rotor, [MARK_SLOT] mark
//   actuator_gear     along and about the rotor's axis: 1, aero_reaction
//   userdata (mjData) its air, as in quadrl/aircraft/parameters.py: the wind [m/s], world frame,
//                     and the noise of the rotors; in a world with solids then HIT numbers: 1 + the
//                     solid that was hit fastest since they were cleared, and how fast [m/s]; and
//                     FEET numbers of the first touch of a foot
//   geom_user         [0] mark, [1] the number of the geom's solid, [GRIP] with how many times its
//                     weight it holds an aircraft whose feet touch it, [MOTION] its velocity and
//                     angular velocity, then their derivatives, world frame
#include <math.h>
#include <mujoco/mujoco.h>
#include <stdint.h>
#include <string.h>

#define LANES 1
#include "aero.h"
#include "contacts.h"
#include "export.h"

enum { MARK_SLOT = 9 };

// The struct layouts of mjModel and mjData are compiled in: the loader compares these.
QUADRL_EXPORT int quadrl_mujoco_version(void) { return mjVERSION_HEADER; }

// The row of a body, or NULL where it is not one of ours.
static const Aircraft* aircraft_of(const mjModel* m, int body) {
  if (m->nuser_body < ROW_SIZE) return 0;
  const Aircraft* a = (const Aircraft*)(m->body_user + (size_t)m->nuser_body * body);
  return is_same(a->mark[0], QUADRL_MARK) && is_same(a->size[0], ROW_SIZE) ? a : 0;
}

// A number of a model as an index below `count`, or -1 if it is none: a model can be edited, so
// that every index in it has to be checked.
static int index_of(mjtNum number, int count) {
  if (!(number >= 0 && number < count)) return -1;  // also where it is NaN
  const int index = (int)number;
  return index == number ? index : -1;
}

// Whether an aircraft can fly: on a free joint, with a possible number of rotors and known effects.
static int can_fly(const mjModel* m, const Aircraft* a, int body) {
  const int joint = m->body_jntadr[body], dof = m->body_dofadr[body];
  return joint >= 0 && joint < m->njnt && m->jnt_type[joint] == mjJNT_FREE && dof >= 0 &&
         dof + 6 <= m->nv && index_of(a->rotor_count[0], MAX_ROTORS + 1) >= 0 &&
         aero_effects(a, 0) >= 0;
}

enum { FOREIGN = -1, UNSOUND = -2 };

// What a marked actuator that is on no aircraft is: FOREIGN, or UNSOUND if the model has an
// aircraft that it may have been removed from. Out of line, since it is rare.
static __attribute__((noinline, cold)) int lost_rotor(const mjModel* m) {
  for (int body = 1; body < m->nbody; ++body) {
    if (aircraft_of(m, body)) return UNSOUND;
  }
  return FOREIGN;
}

// The number of an actuator's rotor, and its aircraft. FOREIGN if it is not one of ours; UNSOUND if
// it is, but the model does not tell of which aircraft, or which of its rotors.
static int rotor_of(const mjModel* m, int actuator, const Aircraft** owner) {
  const mjtNum* parameters = m->actuator_dynprm + mjNDYN * actuator;
  if (!is_same(parameters[MARK_SLOT], QUADRL_MARK)) return FOREIGN;
  const int site = m->actuator_trnid[2 * actuator];
  if (m->actuator_trntype[actuator] != mjTRN_SITE || !is_in(site, m->nsite)) return lost_rotor(m);
  const Aircraft* a = aircraft_of(m, m->site_bodyid[site]);
  if (!a) return lost_rotor(m);
  *owner = a;
  if (!is_in(m->actuator_actadr[actuator], m->na)) return UNSOUND;
  if (!(parameters[0] < a->rotor_count[0])) return UNSOUND;
  const int rotor = index_of(parameters[0], MAX_ROTORS);
  return rotor >= 0 ? rotor : UNSOUND;
}

// The command of an actuator of ours: 0 once a solid grips the aircraft.
static mjtNum command_of(const mjModel* m, const mjData* d, int actuator) {
  const int grips = m->nuser_geom > GRIP && m->nuserdata >= AIR + HIT + FEET;
  if (grips && d->userdata[AIR + HIT + HELD] > 0) return 0;
  return d->ctrl[m->actuator_ctrladr[actuator]];
}

QUADRL_EXPORT mjtNum quadrl_act_dyn(const mjModel* m, const mjData* d, int actuator) {
  const Aircraft* a;
  const int rotor = rotor_of(m, actuator, &a);
  if (rotor < 0) return rotor == FOREIGN ? 0 : NAN;
  return aero_rotor_acceleration(a->rotor + rotor, d->act[m->actuator_actadr[actuator]],
                                 command_of(m, d, actuator), 0);
}

QUADRL_EXPORT mjtNum quadrl_act_gain(const mjModel* m, const mjData* d, int actuator) {
  const Aircraft* a;
  const int rotor = rotor_of(m, actuator, &a);
  if (rotor < 0) return rotor == FOREIGN ? 1 : NAN;
  return aero_rotor_gain(a->rotor + rotor, d->act[m->actuator_actadr[actuator]], 0);
}

// Adds the effects of the air on the rotors of a body beyond equation 7, and of their inertia.
static void add_rotor_effects(const mjModel* m, const mjData* d, const Aircraft* a, int body,
                              const mjtNum airspeed[3], mjtNum force[3], mjtNum moment[3]) {
  const mjtNum *turn = d->xmat + 9 * body, *rate = d->qvel + m->body_dofadr[body] + 3;
  Lanes speed[MAX_ROTORS] = {{0}}, command[MAX_ROTORS] = {{0}}, noise[MAX_ROTORS] = {{0}};
  Lanes air[3], body_rate[3], up[3], push[3] = {{0}}, twist[3] = {{0}}, height;
  Disc disc[MAX_ROTORS];
  for (int k = 0; k < m->nactuator; ++k) {
    const Aircraft* owner;
    const int rotor = rotor_of(m, k, &owner);
    if (rotor < 0 || owner != a) continue;
    speed[rotor][0] = d->act[m->actuator_actadr[k]];
    command[rotor][0] = command_of(m, d, k);
    if (m->nuserdata >= AIR) noise[rotor][0] = d->userdata[WIND + rotor];
  }
  for (int k = 0; k < 3; ++k) {
    air[k][0] = airspeed[k];
    body_rate[k][0] = rate[k];
    up[k][0] = turn[6 + k];
  }
  height[0] = d->xpos[3 * body + 2];
  const int rotors = (int)a->rotor_count[0];
  for (int k = 0; k < rotors; ++k) aero_disc(a, a->rotor + k, disc + k);
  const int effects = a->effects[0] == GROUND_EFFECT ? GROUND_EFFECT : ROTOR_EFFECTS;
  aero_rotors(a, disc, effects, rotors, speed, command, noise, air, body_rate, up, height, push,
              twist);
  for (int k = 0; k < 3; ++k) {
    force[k] += push[k][0];
    moment[k] += twist[k][0];
  }
}

QUADRL_EXPORT void quadrl_passive(const mjModel* m, mjData* d) {
  for (int body = 1; body < m->nbody; ++body) {
    const Aircraft* a = aircraft_of(m, body);
    if (!a) continue;
    if (!can_fly(m, a, body)) {
      // It must fail, as a model of ours without callbacks does.
      for (int k = 0; k < m->nv; ++k) d->qfrc_passive[k] = NAN;
      return;
    }
    const int dof = m->body_dofadr[body];
    // A model of ours carries a gravity compensation that is not a number, so that stepping it
    // without these callbacks fails at once (MuJoCo warns and resets). Here it is taken out again.
    for (int k = dof; k < dof + 6; ++k) {
      d->qfrc_passive[k] = d->qfrc_spring[k] + d->qfrc_damper[k] + d->qfrc_fluid[k];
    }
    const mjtNum* turn = d->xmat + 9 * body;  // body to world
    mjtNum air[3], airspeed[3], force[3] = {0}, moment[3] = {0};
    for (int k = 0; k < 3; ++k) {
      air[k] = d->qvel[dof + k] - (m->nuserdata >= AIR ? d->userdata[k] : 0);
    }
    for (int k = 0; k < 3; ++k) {
      airspeed[k] = turn[k] * air[0] + turn[3 + k] * air[1] + turn[6 + k] * air[2];
    }
    aero_wrench(a, airspeed, d->qvel + dof + 3, force, moment, 0);
    if (a->effects[0] != STILL_AIR) add_rotor_effects(m, d, a, body, airspeed, force, moment);
    if (m->nuser_geom >= 2 && m->nuserdata >= AIR + HIT) note_hits(m, d, a, body);
    for (int k = 0; k < 3; ++k) {
      d->qfrc_passive[dof + k] += turn[3 * k] * force[0] + turn[3 * k + 1] * force[1] +
                                  turn[3 * k + 2] * force[2] + a->steady_force[k][0];
    }
    for (int k = 0; k < 3; ++k) d->qfrc_passive[dof + 3 + k] += moment[k];
  }
}

// MuJoCo reads the clock at both ends of every stage, for mjData.timer: a quarter of a step of so
// small a model. This clock stands still.
QUADRL_EXPORT mjtNum quadrl_time(void) { return 0; }
