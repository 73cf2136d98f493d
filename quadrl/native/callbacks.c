// MuJoCo's actuator and passive-force callbacks of the rotors and the airframe.
//
// They are global to the process, so each first asks whether the actuator or body is ours and
// otherwise answers exactly what MuJoCo does with no callback installed.
//
// Where an aircraft's numbers stand in a model (written there by quadrl/mjcf.py):
//   body_user         its row, an Aircraft
//   actuator_dynprm   [0] number of the rotor, [MARK_SLOT] mark
//   actuator_gear     along and about the rotor's axis: 1, aero_reaction
//   userdata (mjData) its air: the wind [m/s], world frame
#include <mujoco/mujoco.h>

#define LANES 1
#include "aero.h"

#define QUADRL_EXPORT __attribute__((visibility("default")))
enum { MARK_SLOT = 9 };

// The struct layouts of mjModel and mjData are compiled in: the loader compares these.
QUADRL_EXPORT int quadrl_mujoco_version(void) { return mjVERSION_HEADER; }

// The row of a body, or NULL where it is not one of ours.
static const Aircraft* aircraft_of(const mjModel* m, int body) {
  if (m->nuser_body < ROW_SIZE) return 0;
  const Aircraft* a = (const Aircraft*)(m->body_user + (size_t)m->nuser_body * body);
  return a->mark[0] == QUADRL_MARK && a->size[0] == ROW_SIZE ? a : 0;
}

// The rotor of an actuator, or NULL where it is not one of ours.
static const Rotor* rotor_of(const mjModel* m, int actuator) {
  const mjtNum* parameters = m->actuator_dynprm + mjNDYN * actuator;
  if (parameters[MARK_SLOT] != QUADRL_MARK) return 0;
  const Aircraft* a = aircraft_of(m, m->site_bodyid[m->actuator_trnid[2 * actuator]]);
  return a ? a->rotor + (int)parameters[0] : 0;
}

QUADRL_EXPORT mjtNum quadrl_act_dyn(const mjModel* m, const mjData* d, int actuator) {
  const Rotor* rotor = rotor_of(m, actuator);
  if (!rotor) return 0;
  return aero_rotor_acceleration(rotor, d->act[m->actuator_actadr[actuator]],
                                 d->ctrl[m->actuator_ctrladr[actuator]], 0);
}

QUADRL_EXPORT mjtNum quadrl_act_gain(const mjModel* m, const mjData* d, int actuator) {
  const Rotor* rotor = rotor_of(m, actuator);
  return rotor ? aero_rotor_gain(rotor, d->act[m->actuator_actadr[actuator]], 0) : 1;
}

QUADRL_EXPORT void quadrl_passive(const mjModel* m, mjData* d) {
  for (int body = 1; body < m->nbody; ++body) {
    const Aircraft* a = aircraft_of(m, body);
    if (!a) continue;
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
    for (int k = 0; k < 3; ++k) {
      d->qfrc_passive[dof + k] +=
          turn[3 * k] * force[0] + turn[3 * k + 1] * force[1] + turn[3 * k + 2] * force[2];
    }
    for (int k = 0; k < 3; ++k) d->qfrc_passive[dof + 3 + k] += moment[k];
  }
}

// MuJoCo reads the clock at both ends of every stage, for mjData.timer: a quarter of a step of so
// small a model. This clock stands still.
QUADRL_EXPORT mjtNum quadrl_time(void) { return 0; }
