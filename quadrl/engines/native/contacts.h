// Contacts of an aircraft with the solids of the world: hits, solids that grip, and solids that
// move.
//
// userdata (mjData) and geom_user (mjModel) are those of callbacks.c.
#include <math.h>
#include <mujoco/mujoco.h>
#include <stdint.h>
#include <string.h>

enum { GRIP = 5, MOTION = 6, LEGS = 4 };

// Whether two numbers are equal bit for bit, which is quicker than `==`.
static int is_same(mjtNum number, mjtNum expected) {
  return memcmp(&number, &expected, sizeof number) == 0;
}

// Whether an index of a model is within an array of some length; compared as unsigned numbers, of
// which a negative one is too large.
static int is_in(int address, mjtSize length) { return (uint64_t)address < (uint64_t)length; }

// Pulls a foot towards the solid that it touches, along the unit vector `way`.
static void hold(const mjModel* m, mjData* d, const Aircraft* a, int body, mjtNum grip,
                 const mjtNum way[3], const mjtNum arm[3]) {
  const int dof = m->body_dofadr[body];
  const mjtNum* turn = d->xmat + 9 * body;
  const mjtNum pull = grip * a->mass[0] * -m->opt.gravity[2] / LEGS;
  for (int k = 0; k < 3; ++k) {
    const int next = (k + 1) % 3, last = (k + 2) % 3;
    d->qfrc_passive[dof + k] += pull * way[k];
    const mjtNum moment = pull * (arm[next] * way[last] - arm[last] * way[next]);
    for (int j = 0; j < 3; ++j) d->qfrc_passive[dof + 3 + j] += turn[3 * k + j] * moment;
  }
  d->userdata[AIR + HIT + HELD] = 1;
}

// Records the first touch of a foot on a solid that moves with a velocity.
static void note_touch(const mjModel* m, mjData* d, int body, const mjtNum way[3],
                       const mjtNum moves[3]) {
  const mjtNum *velocity = d->qvel + m->body_dofadr[body], *rate = velocity + 3;
  const mjtNum* turn = d->xmat + 9 * body;
  mjtNum *feet = d->userdata + AIR + HIT, into = 0, along = 0, spin = 0, cosine = 0;
  if (feet[0] > 0) return;
  for (int k = 0; k < 3; ++k) {
    into += (velocity[k] - moves[k]) * way[k];
    cosine -= turn[3 * k + 2] * way[k];
    spin += rate[k] * rate[k];
  }
  for (int k = 0; k < 3; ++k) {
    const mjtNum aside = velocity[k] - moves[k] - into * way[k];
    along += aside * aside;
  }
  const mjtNum touch[HELD] = {1, into, sqrt(along), cosine, sqrt(spin)};
  memcpy(feet, touch, sizeof touch);
}

// Adds the cross product of two vectors to a third one.
static void add_cross(const mjtNum a[3], const mjtNum b[3], mjtNum sum[3]) {
  for (int k = 0; k < 3; ++k) {
    const int next = (k + 1) % 3, last = (k + 2) % 3;
    sum[k] += a[next] * b[last] - a[last] * b[next];
  }
}

// Velocity and acceleration of a point of a solid's geom, world frame.
static void solid_motion(const mjModel* m, const mjData* d, int geom, const mjtNum place[3],
                         mjtNum velocity[3], mjtNum acceleration[3]) {
  for (int k = 0; k < 3; ++k) velocity[k] = acceleration[k] = 0;
  if (m->nuser_geom < MOTION + 12) return;
  const mjtNum* motion = m->geom_user + (size_t)m->nuser_geom * geom + MOTION;
  mjtNum arm[3], swing[3] = {0};
  for (int k = 0; k < 3; ++k) {
    arm[k] = place[k] - d->geom_xpos[3 * geom + k];
    acceleration[k] = motion[6 + k];
  }
  add_cross(motion + 3, arm, swing);
  add_cross(motion + 9, arm, acceleration);
  add_cross(motion + 3, swing, acceleration);
  for (int k = 0; k < 3; ++k) velocity[k] = motion[k] + swing[k];
}

// Makes a contact with a solid one with a moving solid. MuJoCo asks each of its rows for the
// acceleration -b v - k r, where v is the row's speed of the aircraft alone, since geoms of the
// world do not move: r is changed so that speed and acceleration are relative to the solid.
static void carry(const mjModel* m, mjData* d, const mjContact* contact, const mjtNum velocity[3],
                  const mjtNum acceleration[3], int solid_is_first) {
  const int row = contact->efc_address, pyramid = contact->dim > 1;
  const int rows = pyramid ? 2 * (contact->dim - 1) : 1;
  if (row < 0 || row + rows > d->nefc || (pyramid && m->opt.cone != mjCONE_PYRAMIDAL)) return;
  mjtNum speed[3] = {0}, faster[3] = {0};  // along the normal and the two tangents
  for (int j = 0; j < 3; ++j) {
    for (int k = 0; k < 3; ++k) {
      speed[j] += contact->frame[3 * j + k] * velocity[k];
      faster[j] += contact->frame[3 * j + k] * acceleration[k];
    }
  }
  for (int k = 0; k < rows; ++k) {
    const int tangent = 1 + k / 2;  // the two are followed by rotations, which are not changed
    const mjtNum* kbi = d->efc_KBIP + 4 * (row + k);
    mjtNum asked = kbi[1] * speed[0] + faster[0], stiffness = kbi[0] * kbi[2];
    if (pyramid && tangent < 3) {
      const mjtNum aside =
          contact->friction[tangent - 1] * (kbi[1] * speed[tangent] + faster[tangent]);
      asked += k % 2 ? -aside : aside;
    }
    if (stiffness > 0) d->efc_pos[row + k] += (solid_is_first ? -asked : asked) / stiffness;
  }
}

// Records the fastest hit of an aircraft on a solid and the first touch of its feet, from the
// present contacts, and holds feet that a solid grips.
static void note_hits(const mjModel* m, mjData* d, const Aircraft* a, int body) {
  const mjtNum *rate = d->qvel + m->body_dofadr[body] + 3, *turn = d->xmat + 9 * body;
  const int notes = m->nuserdata >= AIR + HIT + FEET, grips = notes && m->nuser_geom > GRIP;
  mjtNum* hit = d->userdata + AIR;
  for (int c = 0; c < d->ncon; ++c) {
    const mjContact* contact = d->contact + c;
    const int first = contact->geom[0], second = contact->geom[1];
    if (!is_in(first, m->ngeom) || !is_in(second, m->ngeom)) continue;
    const int own = m->geom_bodyid[second] == body;
    const int other = own ? first : second;
    const mjtNum* solid = m->geom_user + (size_t)m->nuser_geom * other;
    if ((!own && m->geom_bodyid[first] != body) || !is_same(solid[0], QUADRL_MARK)) continue;
    mjtNum arm[3], spin[3], velocity[3], way[3], moves[3], faster[3], speed = 0;
    solid_motion(m, d, other, contact->pos, moves, faster);
    carry(m, d, contact, moves, faster, own);
    for (int k = 0; k < 3; ++k) {
      // The frame's axis points from the first geom to the second.
      way[k] = own ? -contact->frame[k] : contact->frame[k];
      arm[k] = contact->pos[k] - d->xpos[3 * body + k];
      spin[k] = turn[3 * k] * rate[0] + turn[3 * k + 1] * rate[1] + turn[3 * k + 2] * rate[2];
    }
    for (int k = 0; k < 3; ++k) {
      const int next = (k + 1) % 3, last = (k + 2) % 3;
      velocity[k] = d->qvel[m->body_dofadr[body] + k] + spin[next] * arm[last] -
                    spin[last] * arm[next];
      speed += (velocity[k] - moves[k]) * way[k];
    }
    // The feet are the aircraft's only spheres.
    const int foot = m->geom_type[own ? second : first] == mjGEOM_SPHERE;
    if (contact->dist > 0) {  // they do not touch
      const int held = grips && d->userdata[AIR + HIT + HELD] > 0;
      if (held && foot && solid[GRIP] > 0) hold(m, d, a, body, solid[GRIP], way, arm);
      continue;
    }
    if (notes && foot) note_touch(m, d, body, way, moves);
    if (grips && foot && solid[GRIP] > 0) hold(m, d, a, body, solid[GRIP], way, arm);
    if (hit[0] > 0 && !(speed > hit[1])) continue;
    hit[0] = 1 + solid[1];
    hit[1] = speed > 0 ? speed : 0;
  }
}
