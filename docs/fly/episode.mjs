// An episode as the page shows it: a flight, who flies it, and what happens to it from outside.
//
// What happens from outside is a list of events { step, kind, values }, by the control step that
// they come before. A task, by its number in the book, is what is flown from then on. A push changes
// the velocity (world frame) and the body rates (body frame); a wind event sets the mean wind (world frame) and the standard deviation of the gusts; a rotor
// event leaves a rotor, numbered from 1 on, a share of its largest speed; a payload is a share of
// the aircraft's mass, and 0 drops it.

import { Flight } from "./flight.mjs";

const GUSTS = 0x67757374; // a stream of random numbers that no task uses

export class Episode {
  constructor(kernel, slot, { task, aircraft, seed }, controller, events) {
    this.flight = new Flight(kernel, slot, task, aircraft);
    if (controller?.scale) this.flight.scale[0] = controller.scale;
    this.flight.estimates = controller?.observe.rotor_speed === "estimated";
    const { smoothing = kernel.book.smoothing } = controller?.observe.sensors.disturbance ?? {};
    const { controlTimestep } = this.flight.vehicle;
    this.flight.share[0] = smoothing ? 1 - Math.exp(-controlTimestep / smoothing) : 1;
    this.flight.begin(seed);
    Object.assign(this, { controller, events });
    this.past = []; // what was seen and done before, the newest first
    this.steps = 0; // control steps
    this.ticks = 0; // physics steps
    this.outcome = ""; // why it is over, in words
    this.solved = null; // whether the task was done, once the episode's time is up
    this.air = { mean: [0, 0, 0], deviation: 0 };
    this.gust = null;
    const { vehicle } = this.flight;
    this.keep = Math.exp(-vehicle.controlTimestep / kernel.book.gustTime);
    const command = [...this.flight.act.subarray(0, vehicle.rotors)];
    this.history = [{ time: 0, error: this.flight.error, command }];
  }

  get time() {
    return this.ticks * this.flight.vehicle.physicsTimestep;
  }

  // One physics step; false once it is over.
  tick() {
    if (this.outcome) return false;
    const { vehicle } = this.flight;
    if (this.ticks % vehicle.substeps === 0) this.#control();
    if (!this.flight.tick()) {
      this.outcome = this.flight.clear ? "near the ground" : "at an obstacle";
      return false;
    }
    this.ticks += 1;
    if (this.ticks % vehicle.substeps === 0) this.#finish();
    return true;
  }

  #control() {
    const { flight } = this;
    const action = this.controller?.act(this.#see());
    if (action) this.past[0].action = action;
    for (const { kind, values } of this.events.filter((event) => event.step === this.steps)) {
      if (kind === "task") this.#turn(Object.keys(flight.kernel.book.tasks)[values[0]]);
      else if (kind === "push") values.forEach((value, k) => (flight.qvel[k] += value));
      else if (kind === "rotor") flight.weaken(...values);
      else if (kind === "payload") flight.load(...values);
      else this.air = { mean: values.slice(0, 3), deviation: values[3] };
    }
    this.#blow();
    flight.command(action, this.controller?.loops);
  }

  // Flies another task from here on, if there is one without solids, whose time begins now.
  #turn(taskName) {
    const { book } = this.flight.kernel, pair = book.pairs[`${taskName}_${this.flight.vehicleName}`];
    if (!pair || pair.solids) return;
    this.flight.turn(taskName);
    this.solved = null;
  }

  // What the controller sees now: as the options of its observation say (quadrl/core/observer.py).
  #see() {
    const { action_history, observation_history } = this.controller.observe;
    const seen = this.flight.seen(this.controller.observe), { rotors } = this.flight.vehicle;
    const rest = { seen: this.past.at(-1)?.seen ?? seen, action: new Float32Array(rotors) };
    const before = (k) => this.past[k] ?? rest;
    const actions = Array.from({ length: action_history }, (_, k) => [...before(k).action]);
    const older = Array.from({ length: observation_history }, (_, k) => before(k).seen);
    this.past.unshift({ seen });
    this.past.length = Math.min(this.past.length, 1 + Math.max(action_history, observation_history));
    this.saw = Float32Array.from([seen, ...actions, ...older].flat());
    return this.saw;
  }

  // Gusts: an Ornstein-Uhlenbeck process in each direction, a step per control step.
  #blow() {
    const numbers = this.flight.uniform(GUSTS, 4 * this.steps, 4);
    const lengths = [0, 2].map((k) => Math.sqrt(-2 * Math.log(1 - numbers[k])));
    const turns = [1, 3].map((k) => 2 * Math.PI * numbers[k]);
    const [cosine, sine] = [Math.cos(turns[0]), Math.sin(turns[0])];
    const normal = [lengths[0] * cosine, lengths[0] * sine, lengths[1] * Math.cos(turns[1])];
    const fresh = Math.sqrt(1 - this.keep ** 2);
    this.gust = this.gust ? normal.map((x, k) => this.keep * this.gust[k] + fresh * x) : normal;
    this.flight.wind.set(this.gust.map((x, k) => this.air.mean[k] + this.air.deviation * x));
  }

  #finish() {
    const { flight } = this;
    flight.finish();
    this.steps += 1;
    const command = [...flight.ctrl.subarray(0, flight.vehicle.rotors)];
    this.history.push({ time: this.time, error: flight.error, command });
    if (flight.truncated) this.solved = flight.succeeded;
    if (flight.diverged[0]) this.outcome = "faster than a physics step resolves";
    else if (flight.terminated) this.outcome = this.#end();
  }

  // Why the task has ended it: with success, tipped over, on the ground, or by what else `Task.ends` names.
  #end() {
    const { qpos, vehicle, succeeded, task: { ends } } = this.flight, [lost, won] = ends.split("; ").reverse();
    if (succeeded) return won;
    const others = lost.split(", ").filter((cause) => !/on the ground|tilted/.test(cause));
    if (qpos[4] ** 2 + qpos[5] ** 2 > 0.5 && /tilted/.test(ends)) return "tipped over";
    return qpos[2] < vehicle.size ? "on the ground" : others.join(" or ");
  }
}
