// MuJoCo's actuator and passive-force callbacks for the rotors and the airframe.
//
// They are global to the process, so each first asks whether the actuator or body is ours and
// otherwise answers exactly what MuJoCo does with no callback installed.
#include <mujoco/mujoco.h>

#include "equations.h"

#define QUADRL_EXPORT __attribute__((visibility("default")))

// The struct layouts of mjModel and mjData are compiled in: the loader compares these.
QUADRL_EXPORT int quadrl_mujoco_version(void) { return mjVERSION_HEADER; }

static int is_rotor(const mjModel* m, int actuator) {
  return m->actuator_dynprm[mjNDYN * actuator + QUADRL_MARK_SLOT] == QUADRL_MARK;
}

QUADRL_EXPORT mjtNum quadrl_act_dyn(const mjModel* m, const mjData* d, int actuator) {
  if (!is_rotor(m, actuator)) return 0;
  return rotor_acceleration(d->act[m->actuator_actadr[actuator]],
                            d->ctrl[m->actuator_ctrladr[actuator]],
                            m->actuator_dynprm[mjNDYN * actuator]);
}

QUADRL_EXPORT mjtNum quadrl_act_gain(const mjModel* m, const mjData* d, int actuator) {
  if (!is_rotor(m, actuator)) return 1;
  return rotor_gain(d->act[m->actuator_actadr[actuator]],
                    m->actuator_gainprm[mjNGAIN * actuator]);
}

QUADRL_EXPORT void quadrl_passive(const mjModel* m, mjData* d) {
  if (m->nuser_body < QUADRL_BODY_USER) return;
  for (int body = 1; body < m->nbody; ++body) {
    const mjtNum* parameters = m->body_user + (size_t)m->nuser_body * body;
    if (parameters[0] != QUADRL_MARK) continue;
    const int dof = m->body_dofadr[body];
    // A model of ours carries a gravity compensation that is not a number, so that stepping it
    // without these callbacks fails at once (MuJoCo warns and resets). Here it is taken out again.
    for (int k = dof; k < dof + 6; ++k) {
      d->qfrc_passive[k] = d->qfrc_spring[k] + d->qfrc_damper[k] + d->qfrc_fluid[k];
    }
    mjtNum airspeed[3];
    for (int k = 0; k < 3; ++k) airspeed[k] = d->qvel[dof + k] - m->opt.wind[k];
    add_quadratic_drag(parameters[1], airspeed, d->qfrc_passive + dof);
    add_quadratic_drag(parameters[2], d->qvel + dof + 3, d->qfrc_passive + dof + 3);
  }
}

// MuJoCo reads the clock at both ends of every stage, for mjData.timer: a quarter of a step of so
// small a model. This clock stands still.
QUADRL_EXPORT mjtNum quadrl_time(void) { return 0; }
