// MuJoCo's actuator and passive-force callbacks of the rotors and the airframe.
//
// They are global to the process, so each first asks whether the actuator or body is ours and
// otherwise answers exactly what MuJoCo does with no callback installed.
//
// Where an aircraft's numbers stand in a model (written there by quadrl/mjcf.py):
//   body_user         its row, an Aircraft
//   actuator_dynprm   [0] number of the rotor, [MARK_SLOT] mark
//   actuator_gear     along and about the rotor's axis: 1, aero_reaction
//   userdata (mjData) its air: the wind [m/s], world frame, and what quadrl/parameters.py says
#include <mujoco/mujoco.h>

#define LANES 1
#include "aero.h"
#include "export.h"

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

// What the air does to the rotors of a body beside equation 7, and their inertia.
static void add_rotor_effects(const mjModel* m, const mjData* d, const Aircraft* a, int body,
                              const mjtNum airspeed[3], mjtNum force[3], mjtNum moment[3]) {
  const mjtNum *turn = d->xmat + 9 * body, *rate = d->qvel + m->body_dofadr[body] + 3;
  Lanes speed[MAX_ROTORS] = {{0}}, command[MAX_ROTORS] = {{0}}, noise[MAX_ROTORS] = {{0}};
  Lanes air[3], body_rate[3], up[3], push[3] = {{0}}, twist[3] = {{0}}, height;
  Disc disc[MAX_ROTORS];
  for (int k = 0; k < m->nu; ++k) {
    if (!rotor_of(m, k) || m->site_bodyid[m->actuator_trnid[2 * k]] != body) continue;
    const int rotor = (int)m->actuator_dynprm[mjNDYN * k];
    speed[rotor][0] = d->act[m->actuator_actadr[k]];
    command[rotor][0] = d->ctrl[m->actuator_ctrladr[k]];
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
