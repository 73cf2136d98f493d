// Contacts of an aircraft with the solids of the world: hits, solids that grip, and solids that
// move.
//
// userdata (mjData) and geom_user (mjModel) are those of callbacks.c.
#include <math.h>
#include <mujoco/mujoco.h>
#include <stdint.h>
#include <string.h>

#include "solids.h"

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

// The velocity of a point that is fixed to the body, world frame.
static void body_motion(const mjModel* m, const mjData* d, int body, const mjtNum place[3],
                        mjtNum velocity[3]) {
  const mjtNum *rate = d->qvel + m->body_dofadr[body] + 3, *turn = d->xmat + 9 * body;
  mjtNum arm[3], spin[3];
  for (int k = 0; k < 3; ++k) {
    arm[k] = place[k] - d->xpos[3 * body + k];
    spin[k] = turn[3 * k] * rate[0] + turn[3 * k + 1] * rate[1] + turn[3 * k + 2] * rate[2];
    velocity[k] = d->qvel[m->body_dofadr[body] + k];
  }
  add_cross(spin, arm, velocity);
}

// Notes a hit if it is the fastest of this control step.
static void note_hit(mjData* d, mjtNum solid, mjtNum speed) {
  mjtNum* hit = d->userdata + AIR;
  if (hit[0] > 0 && !(speed > hit[1])) return;
  hit[0] = 1 + solid;
  hit[1] = speed > 0 ? speed : 0;
}

static mjtNum length_of(const mjtNum v[3]) {
  return sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]);
}

// The smallest length of a geom: of a ball about its centre, within it, it is the radius.
static mjtNum inner_radius(const mjModel* m, int geom) {
  const mjtNum* size = m->geom_size + 3 * geom;
  mjtNum least = size[0];
  for (int k = 1; k < 3; ++k) least = size[k] > 0 && size[k] < least ? size[k] : least;
  return least;
}

// Notes where a geom has passed through a solid, or a part of one, in the last `span` seconds, in
// which no contact was seen: a ball within it, on its straight way as seen from the solid.
static void note_pass(const mjModel* m, mjData* d, int body, int own, int other, const Solid* solid,
                      mjtNum span) {
  const mjtNum *place = d->geom_xpos + 3 * own, radius = inner_radius(m, own);
  mjtNum velocity[3], moves[3], faster[3], way[3], at[3], normal[3], speed = 0;
  body_motion(m, d, body, place, velocity);
  solid_motion(m, d, other, place, moves, faster);
  for (int k = 0; k < 3; ++k) way[k] = (velocity[k] - moves[k]) * span;
  const mjtNum length = length_of(way);
  if (!(length > 2 * radius)) return;  // it would still touch
  mjtNum gone = 0, gap = 1;
  for (int n = 0; gone < length && gap > ROUNDING; ++n) {
    for (int k = 0; k < 3; ++k) at[k] = place[k] + (gone / length - 1) * way[k];
    gap = solid_distance(solid, at) - radius;
    if ((n == 0 && gap <= ROUNDING) || n == 99) return;
    gone += gap;
  }
  if (gap > ROUNDING) return;
  solid_normal(solid, at, gap + radius, normal);
  for (int k = 0; k < 3; ++k) speed -= normal[k] * way[k] / span;
  note_hit(d, m->geom_user[(size_t)m->nuser_geom * other + 1], speed);
}

// Upper bound of the length of a vector.
static mjtNum at_most(const mjtNum v[3]) { return fabs(v[0]) + fabs(v[1]) + fabs(v[2]); }

// Notes passes of all parts of an aircraft through all solids.
static void note_passes(const mjModel* m, mjData* d, int body, mjtNum span) {
  const mjtNum *place = d->xpos + 3 * body, *velocity = d->qvel + m->body_dofadr[body];
  const int first = m->body_geomadr[body], end = first + m->body_geomnum[body];
  mjtNum reach = 0, thin = HUGE_VAL;
  for (int own = first; own < end; ++own) {
    if (!m->geom_conaffinity[own]) continue;
    reach = fmax(reach, at_most(m->geom_pos + 3 * own) + m->geom_rbound[own]);
    thin = fmin(thin, inner_radius(m, own));
  }
  const mjtNum own_way = (at_most(velocity) + at_most(velocity + 3) * reach) * span;
  for (int other = 0; other < m->ngeom; ++other) {
    const mjtNum* user = m->geom_user + (size_t)m->nuser_geom * other;
    if (!is_same(user[0], QUADRL_MARK)) continue;
    const mjtNum room = reach + m->geom_rbound[other];
    const mjtNum its_way = (at_most(user + MOTION) + at_most(user + MOTION + 3) * room) * span;
    // Contacts are seen twice in a step; between the two a solid does not move.
    if (own_way / 2 + its_way <= 2 * (thin + inner_radius(m, other))) continue;
    Solid solid = {.kind = m->geom_type[other]};
    memcpy(solid.size, m->geom_size + 3 * other, sizeof solid.size);
    memcpy(solid.position, d->geom_xpos + 3 * other, sizeof solid.position);
    memcpy(solid.turn, d->geom_xmat + 9 * other, sizeof solid.turn);
    if (solid_distance(&solid, place) > reach + own_way + its_way) continue;
    for (int own = first; own < end; ++own) {
      if (m->geom_conaffinity[own]) note_pass(m, d, body, own, other, &solid, span);
    }
  }
}

// Records the fastest hit of an aircraft on a solid and the first touch of its feet, from the
// present contacts, and holds feet that a solid grips; where those show none, a pass through a solid
// since the last one.
static void note_hits(const mjModel* m, mjData* d, const Aircraft* a, int body) {
  const int notes = m->nuserdata >= AIR + HIT + FEET, grips = notes && m->nuser_geom > GRIP;
  int touches = 0;
  for (int c = 0; c < d->ncon; ++c) {
    const mjContact* contact = d->contact + c;
    const int first = contact->geom[0], second = contact->geom[1];
    if (!is_in(first, m->ngeom) || !is_in(second, m->ngeom)) continue;
    const int own = m->geom_bodyid[second] == body;
    const int other = own ? first : second;
    const mjtNum* solid = m->geom_user + (size_t)m->nuser_geom * other;
    if ((!own && m->geom_bodyid[first] != body) || !is_same(solid[0], QUADRL_MARK)) continue;
    mjtNum arm[3], velocity[3], way[3], moves[3], faster[3], speed = 0;
    solid_motion(m, d, other, contact->pos, moves, faster);
    carry(m, d, contact, moves, faster, own);
    body_motion(m, d, body, contact->pos, velocity);
    for (int k = 0; k < 3; ++k) {
      // The frame's axis points from the first geom to the second.
      way[k] = own ? -contact->frame[k] : contact->frame[k];
      arm[k] = contact->pos[k] - d->xpos[3 * body + k];
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
    note_hit(d, solid[1], speed);
    touches = 1;
  }
  if (!notes) return;
  mjtNum* since = d->userdata + AIR + HIT + SINCE;
  const mjtNum free = d->time - *since, span = free < m->opt.timestep ? free : m->opt.timestep;
  // What comes out on the other side touches at no speed.
  const int known = m->nuser_geom >= MOTION + 12;
  if (known && span > 0 && !(d->userdata[AIR + 1] > 0)) {
    note_passes(m, d, body, span);
    if (d->userdata[AIR + 1] > 0) *since = d->time;
  }
  if (touches) *since = d->time;
}
