// The reverse of aero.h and of the derivative in runge_kutta.h: from the derivatives of a number by
// the results of a function to those by its arguments, to which each function here adds.
//
// In the names, x_ is the derivative of that number by x. What is not smooth is taken piece by
// piece, as the functions themselves are written: by an `if` on the same condition.
#ifndef QUADRL_ADJOINT_H_
#define QUADRL_ADJOINT_H_

#include "runge_kutta.h"

INLINE double dot(const double a[3], const double b[3]) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

INLINE void add_cross(const double a[3], const double b[3], double factor, double sum[3]) {
  for (int n = 0; n < 3; ++n) {
    const int next = (n + 1) % 3, last = (n + 2) % 3;
    sum[n] += factor * (a[next] * b[last] - a[last] * b[next]);
  }
}

// One over a length, and nothing over none: where a root's own derivative is infinite.
INLINE double inverse(double length) { return length > 0 ? 1 / length : 0; }

// Of aero_rotor_acceleration.
INLINE void back_lag(const Rotor* rotor, double speed, double command, double faster_,
                     double* speed_, double* command_, int i) {
  const double largest = rotor->max_speed[i], goal = command < largest ? command : largest;
  const double rate = goal > speed ? rotor->lag_up[i] : rotor->lag_down[i];
  *speed_ -= rate * faster_;
  *command_ += command > largest ? 0 : rate * faster_;
}

// Of the force -c |v| v, as drag and aerodynamic moment are.
INLINE void back_quadratic(double c, const double v[3], const double force_[3], double v_[3]) {
  const double length = aero_length(v), along = dot(v, force_) * inverse(length);
  for (int k = 0; k < 3; ++k) v_[k] -= c * (length * force_[k] + along * v[k]);
}

// Of aero_flow_step, a step of which is w - was = through * lacking / slope.
INLINE void back_flow_step(double was, double w0, double k, double v, double p_square, double* w_,
                           double* w0_, double* k_, double* v_, double* p_square_) {
  const double through = sqrt(was * was + p_square), more = was - v;
  const double lacking = (w0 + k) * w0 - k * was - more * through;
  const double slope = (k + through) * through + more * was + 1e-12;
  const double lacking_ = *w_ * through / slope, slope_ = -lacking_ * lacking / slope;
  const double through_ = *w_ * lacking / slope + slope_ * (k + 2 * through) - lacking_ * more;
  const double over = inverse(through);
  *w0_ += lacking_ * (2 * w0 + k);
  *k_ += lacking_ * (w0 - was) + slope_ * through;
  *v_ += lacking_ * through - slope_ * was;
  *p_square_ += through_ * 0.5 * over;
  *w_ += slope_ * (more + was) - lacking_ * (k + through) + through_ * was * over;
}

// Of aero_lift_change, with its w0 = induced * speed.
INLINE void back_lift_change(const Aircraft* a, const Rotor* rotor, const Disc* disc, double speed,
                             double climb, double p_square, double noise, double change_,
                             double* speed_, double* climb_, double* p_square_, int i) {
  const double w0 = disc->induced[i] * speed, k = disc->response[i] * w0;
  const double rest = rotor->thrust_coefficient[i] * speed * speed;
  const double v = aero_clip(climb, -2 * w0, 3 * w0);
  const double root = sqrt((v - k) * (v - k) + 4 * w0 * (w0 + k));
  const double first = 0.5 * (v - k + root), second = aero_flow_step(first, w0, k, v, p_square);
  const double w = aero_flow_step(second, w0, k, v, p_square);
  const double over = 1 / (w0 + 1e-6), off = (climb * over + 1.4) * (1 / 1.2);
  const double steep = aero_positive(1 - off * off), wide = over * over * (1 / (0.95 * 0.95));
  const double slow = aero_positive(1 - p_square * wide), ring = steep * steep * steep * slow;
  const double taken = a->vortex_ring[i], shaken = a->vortex_ring_noise[i] * noise;
  const double lost = w0 - w - taken * w0 * ring, flow = disc->flow[i];
  const double lift = a->inflow[i] * a->translational_lift[i];
  const double change = flow * k * lost + lift * p_square + shaken * rest * ring;
  const int low = change < -rest, high = change > 0.6 * rest;
  const double inner_ = low || high ? 0 : change_;
  const double rest_ = (low ? -1 : high ? 0.6 : 0) * change_ + inner_ * shaken * ring;
  double k_ = inner_ * flow * lost, w0_ = inner_ * flow * k * (1 - taken * ring);
  double w_ = -inner_ * flow * k, v_ = 0;
  const double ring_ = inner_ * (shaken * rest - flow * k * taken * w0);
  const double slow_ = slow > 0 ? ring_ * steep * steep * steep : 0;
  const double off_ = -2 * off * ring_ * 3 * steep * steep * slow * (1 / 1.2);
  *p_square_ += inner_ * lift - slow_ * wide;
  const double over_ = off_ * climb - slow_ * 2 * p_square * wide / over;
  *climb_ += off_ * over;
  w0_ -= over_ * over * over;
  back_flow_step(second, w0, k, v, p_square, &w_, &w0_, &k_, &v_, p_square_);
  back_flow_step(first, w0, k, v, p_square, &w_, &w0_, &k_, &v_, p_square_);
  const double inner = 0.25 * w_ * inverse(root);  // by what the root is taken of
  v_ += 0.5 * w_ + inner * 2 * (v - k);
  k_ += inner * (4 * w0 - 2 * (v - k)) - 0.5 * w_;
  w0_ += inner * 4 * (2 * w0 + k);
  if (climb < -2 * w0) {
    w0_ -= 2 * v_;
  } else if (climb > 3 * w0) {
    w0_ += 3 * v_;
  } else {
    *climb_ += v_;
  }
  w0_ += disc->response[i] * k_;
  *speed_ += disc->induced[i] * w0_ + 2 * rotor->thrust_coefficient[i] * speed * rest_;
}

// aero_image, and its derivative by z.
INLINE double image(double radius, double distance_square, double z, double* slope) {
  const double square = distance_square + 4 * z * z;
  const double value = aero_image(radius, distance_square, z);
  *slope += value * (1 / z - 12 * z / square);
  return value;
}

// The share of a rotor's flow that the ground takes, as in aero_rotors, and its derivatives by
// height and up.
INLINE double ground_share(const Aircraft* a, int rotors, const Rotor* rotor, const double up[3],
                           double height, double* by_height, double by_up[3], int i) {
  const double r[3] = {rotor->position[0][i], rotor->position[1][i], rotor->position[2][i]};
  const double n[3] = {rotor->axis[0][i], rotor->axis[1][i], rotor->axis[2][i]};
  const double radius = rotor->disc_radius[i], over = height + dot(up, r);
  const double z = over > 0.5 * radius ? over : 0.5 * radius;
  double slope = 0;
  double whole = 4 * a->body_lift[i] * image(radius, 4 * (r[0] * r[0] + r[1] * r[1]), z, &slope);
  slope *= 4 * a->body_lift[i];
  for (const Rotor* other = a->rotor; other < a->rotor + rotors; ++other) {
    const double x = other->position[0][i] - r[0], y = other->position[1][i] - r[1];
    whole += image(other->disc_radius[i], x * x + y * y, z, &slope);
  }
  const double far = (8 * radius - z) / (2 * radius), near = aero_clip(far, 0, 1);
  const double cosine = aero_positive(dot(up, n)), fade = near * near * (3 - 2 * near);
  const double fading = near == far ? -6 * near * (1 - near) / (2 * radius) : 0;
  const double most = a->ground_effect[i] * cosine * cosine;
  *by_height = over > 0.5 * radius ? most * (slope * fade + whole * fading) : 0;
  for (int m = 0; m < 3; ++m) {
    by_up[m] = *by_height * r[m] + 2 * a->ground_effect[i] * whole * fade * cosine * n[m];
  }
  return most * whole * fade;
}

// Of aero_rotors: from the derivatives by force and moment.
INLINE void back_rotors(const Aircraft* a, const Disc* disc, int effects, int rotors,
                        const Lanes* speed, const Lanes* command, const Lanes* noise,
                        const Lanes* airspeed, const Lanes* body_rate, const Lanes* up,
                        const Lanes height, const Lanes* force_, const Lanes* moment_,
                        Lanes* speed_, Lanes* command_, Lanes* airspeed_, Lanes* body_rate_,
                        Lanes* up_, Lanes height_) {
  for (int k = 0; k < rotors; ++k) {
    const Rotor* rotor = a->rotor + k;
    for (int i = 0; i < LANES; ++i) {
      const double r[3] = {rotor->position[0][i], rotor->position[1][i], rotor->position[2][i]};
      const double n[3] = {rotor->axis[0][i], rotor->axis[1][i], rotor->axis[2][i]};
      const double turn[3] = {body_rate[0][i], body_rate[1][i], body_rate[2][i]};
      const double gained[3] = {force_[0][i], force_[1][i], force_[2][i]};
      const double twisted[3] = {moment_[0][i], moment_[1][i], moment_[2][i]};
      const double omega = speed[k][i], w0 = disc[k].induced[i] * omega;
      double u[3] = {airspeed[0][i], airspeed[1][i], airspeed[2][i]};
      add_cross(turn, r, 1, u);
      const double climb = dot(u, n);
      for (int m = 0; m < 3; ++m) u[m] -= climb * n[m];
      const double p_square = dot(u, u);
      const double drag = a->rotor_drag[i] * omega, flap = a->flapping_moment[i] * omega;
      const double inertia = rotor->spin[i] * a->rotor_inertia[i];
      double push_[3] = {gained[0], gained[1], gained[2]}, u_[3] = {0}, turn_[3] = {0};
      double omega_ = 0, climb_ = 0, p_square_ = 0;
      add_cross(twisted, r, 1, push_);
      // moment = r x push + flap u x n - turn x momentum - inertia faster n.
      double lever[3] = {0}, swing[3] = {0};
      add_cross(n, twisted, 1, lever);
      add_cross(twisted, turn, 1, swing);
      for (int m = 0; m < 3; ++m) u_[m] = flap * lever[m] - drag * push_[m];
      add_cross(n, twisted, -inertia * omega, turn_);
      omega_ += a->flapping_moment[i] * dot(u, lever) - a->rotor_drag[i] * dot(u, push_);
      omega_ -= inertia * dot(n, swing);
      back_lag(rotor, omega, command[k][i], -inertia * dot(n, twisted), &omega_,
               &command_[k][i], i);
      double change_ = dot(n, push_);
      if (effects == GROUND_EFFECT) {
        const double upright[3] = {up[0][i], up[1][i], up[2][i]};
        double by_height, by_up[3];
        const double share =
            ground_share(a, rotors, rotor, upright, height[i], &by_height, by_up, i);
        const double rest = rotor->thrust_coefficient[i] * omega * omega, hover = w0 * w0;
        const double all = hover + p_square + 1e-12, taken = share * hover / all;
        const double most = taken < 0.36 ? taken : 0.36;
        const double change = aero_lift_change(a, rotor, disc + k, omega, w0, climb, p_square,
                                               noise[k][i], i);
        const double taken_ =
            taken < 0.36 ? change_ * (rest + change) / ((1 - most) * (1 - most)) : 0;
        omega_ += change_ * most / (1 - most) * 2 * rotor->thrust_coefficient[i] * omega;
        change_ /= 1 - most;
        omega_ += taken_ * share * (all - hover) / (all * all) * 2 * w0 * disc[k].induced[i];
        p_square_ -= taken_ * taken / all;
        height_[i] += taken_ * hover / all * by_height;
        for (int m = 0; m < 3; ++m) up_[m][i] += taken_ * hover / all * by_up[m];
      }
      back_lift_change(a, rotor, disc + k, omega, climb, p_square, noise[k][i], change_, &omega_,
                       &climb_, &p_square_, i);
      for (int m = 0; m < 3; ++m) u_[m] += 2 * p_square_ * u[m];
      climb_ -= dot(u_, n);
      for (int m = 0; m < 3; ++m) u_[m] += climb_ * n[m];
      add_cross(r, u_, 1, turn_);
      speed_[k][i] += omega_;
      for (int m = 0; m < 3; ++m) {
        airspeed_[m][i] += u_[m];
        body_rate_[m][i] += turn_[m];
      }
    }
  }
}

// Of `rotation`: from the derivatives t by the matrix to those by the quaternion.
INLINE void back_rotation(const Lanes* q, double t[3][3], Lanes* q_, int i) {
  const double w = q[0][i], x = q[1][i], y = q[2][i], z = q[3][i];
  const double over = 1 / (w * w + x * x + y * y + z * z), twice = 2 * over;
  // Sums and differences of elements across the diagonal.
  const double yz = t[1][2] + t[2][1], zx = t[2][0] + t[0][2], xy = t[0][1] + t[1][0];
  const double a = t[2][1] - t[1][2], b = t[0][2] - t[2][0], c = t[1][0] - t[0][1];
  const double by[4] = {x * a + y * b + z * c,
                        w * a + y * xy + z * zx - 2 * x * (t[1][1] + t[2][2]),
                        w * b + x * xy + z * yz - 2 * y * (t[0][0] + t[2][2]),
                        w * c + x * zx + y * yz - 2 * z * (t[0][0] + t[1][1])};
  // The matrix less 1 is `twice` times a quadratic form, which is half of what q . by gives.
  const double form = 0.5 * (w * by[0] + x * by[1] + y * by[2] + z * by[3]);
  for (int k = 0; k < 4; ++k) q_[k][i] += twice * (by[k] - 2 * over * form * q[k][i]);
}

// Of `derivative`: from those by the rates to those by motion and command.
//   rate: what `derivative` gives.
INLINE void back_derivative(const Aircraft* a, const Setting* s, int effects, int rotors,
                            double gravity, const Lanes* m, const Lanes* rate,
                            const Lanes* rate_, Lanes* m_, Lanes* command_) {
  Lanes push_[3], twist_[3], airspeed[3], airspeed_[3], up[3], up_[3] = {{0}}, turn_[9];
  for (int i = 0; i < LANES; ++i) {
    const double mass = a->mass[i];
    const double j[3] = {a->inertia[0][i], a->inertia[1][i], a->inertia[2][i]};
    const double r[3] = {m[BODY_RATE][i], m[BODY_RATE + 1][i], m[BODY_RATE + 2][i]};
    const double w = m[QUATERNION][i], x = m[QUATERNION + 1][i], y = m[QUATERNION + 2][i],
                 z = m[QUATERNION + 3][i];
    const double d = 0.5 * rate_[QUATERNION][i], e = 0.5 * rate_[QUATERNION + 1][i],
                 f = 0.5 * rate_[QUATERNION + 2][i], g = 0.5 * rate_[QUATERNION + 3][i];
    const double pull[3] = {rate[VELOCITY][i], rate[VELOCITY + 1][i],
                            rate[VELOCITY + 2][i] - gravity};  // over the mass
    double turn[3][3], u[3], u_[3] = {0}, body[3], twisted[3];
    double r_[3] = {e * w + f * z - g * y - d * x, f * w + g * x - d * y - e * z,
                    e * y + g * w - d * z - f * x};
    rotation(m + QUATERNION, turn, i);
    airspeed_of(s, m, turn, u, i);
    for (int n = 0; n < 3; ++n) {
      const double force = turn[0][n] * pull[0] + turn[1][n] * pull[1] + turn[2][n] * pull[2];
      for (int k = 0; k < 3; ++k) turn_[3 * k + n][i] = rate_[VELOCITY + k][i] * force;
      body[n] = (turn[0][n] * rate_[VELOCITY][i] + turn[1][n] * rate_[VELOCITY + 1][i] +
                 turn[2][n] * rate_[VELOCITY + 2][i]) /
                mass;
      twisted[n] = rate_[BODY_RATE + n][i] / j[n];
      m_[VELOCITY + n][i] += rate_[POSITION + n][i];
    }
    for (int n = 0; n < 3; ++n) {
      const int next = (n + 1) % 3, last = (n + 2) % 3;
      const double bias = (j[last] - j[next]) * twisted[n];
      r_[next] -= bias * r[last];
      r_[last] -= bias * r[next];
    }
    back_quadratic(a->drag_coefficient[i], u, body, u_);
    back_quadratic(a->moment_coefficient[i], r, twisted, r_);
    m_[QUATERNION][i] += e * r[0] + f * r[1] + g * r[2];
    m_[QUATERNION + 1][i] += g * r[1] - d * r[0] - f * r[2];
    m_[QUATERNION + 2][i] += e * r[2] - d * r[1] - g * r[0];
    m_[QUATERNION + 3][i] += f * r[0] - d * r[2] - e * r[1];
    for (int k = 0; k < 3; ++k) {
      m_[BODY_RATE + k][i] += r_[k];
      push_[k][i] = body[k];
      twist_[k][i] = twisted[k];
      airspeed[k][i] = u[k];
      airspeed_[k][i] = u_[k];
      up[k][i] = turn[2][k];
    }
  }
  for (int k = 0; k < rotors; ++k) {
    const Rotor* rotor = a->rotor + k;
    const Lanes* lever = s->lever + 6 * k;
    for (int i = 0; i < LANES; ++i) {
      const double speed = m[SPEED + k][i];
      double thrust_ = 0, speed_ = 0;
      for (int n = 0; n < 3; ++n) {
        thrust_ += lever[n][i] * push_[n][i] + lever[3 + n][i] * twist_[n][i];
      }
      back_lag(rotor, speed, s->command[k][i], rate_[SPEED + k][i], &speed_, &command_[k][i], i);
      m_[SPEED + k][i] += speed_ + 2 * aero_rotor_gain(rotor, speed, i) * thrust_;
    }
  }
  if (effects != STILL_AIR) {
    back_rotors(a, s->disc, effects, rotors, m + SPEED, s->command, s->air + WIND, airspeed,
                m + BODY_RATE, up, m[POSITION + 2], push_, twist_, m_ + SPEED, command_, airspeed_,
                m_ + BODY_RATE, up_, m_[POSITION + 2]);
  }
  for (int i = 0; i < LANES; ++i) {
    double turn[3][3], whole_[3][3];
    rotation(m + QUATERNION, turn, i);
    for (int k = 0; k < 3; ++k) {
      const double air = m[VELOCITY + k][i] - s->air[k][i];
      for (int n = 0; n < 3; ++n) {
        whole_[k][n] = turn_[3 * k + n][i] + air * airspeed_[n][i] + (k == 2 ? up_[n][i] : 0);
        m_[VELOCITY + k][i] += turn[k][n] * airspeed_[n][i];
      }
    }
    back_rotation(m + QUATERNION, whole_, m_ + QUATERNION, i);
  }
}

#endif  // QUADRL_ADJOINT_H_
