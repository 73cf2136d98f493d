// One aircraft in an episode. All that is computed here is quadrl's own C: the kernels of free
// flight, of the state and of the random numbers, and the functions that
// quadrl/deploy/flights.py writes from the tasks and the geometric controller.

export const SLOTS = 4; // flights that the memory has room for

const ONE = 1n;

// The bytes of base64.
export function decoded(text) {
  return Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
}

// Which numbers of a task's observation, of a pair of the book, are seen beside sensors.
export function visible(book, pair, sensors) {
  const hidden = Object.entries(sensors).flatMap(([name, { beside_goal: beside = false }]) => book.hides[name]?.[Number(beside)] ?? []);
  const shown = Object.entries(pair.layout).filter(([name]) => !hidden.includes(name));
  return shown.flatMap(([, [from, to]]) => Array.from({ length: to - from }, (_, k) => from + k));
}

// The compiled C, and where the parts of a flight stand in its memory.
export class Kernel {
  // bytes: the WebAssembly; book: what quadrl/deploy/web.py exports.
  static async load(bytes, book) {
    const { instance } = await WebAssembly.instantiate(bytes, {});
    return new Kernel(instance.exports, book);
  }

  constructor(exports, book) {
    this.functions = exports;
    this.book = book;
    exports._initialize?.();
  }

  address(slot, part) {
    return this.functions.flight_memory(slot) + 8 * this.book.layout[part][0];
  }

  // A live view of a part of a flight's memory.
  view(slot, part, type = Float64Array) {
    const size = (8 * this.book.layout[part][1]) / type.BYTES_PER_ELEMENT;
    return new type(this.functions.memory.buffer, this.address(slot, part), size);
  }
}

export class Flight {
  constructor(kernel, slot, taskName, vehicleName) {
    const { book } = kernel;
    Object.assign(this, { kernel, slot, vehicleName });
    this.vehicle = book.vehicles[vehicleName];
    this.memory = kernel.functions.flight_memory(slot);
    new Float64Array(kernel.functions.memory.buffer, this.memory, book.flightSize).fill(0);
    const motion = ["qpos", "qvel", "act", "ctrl", "wind"];
    const seen = ["observation", "felt", "share", "modelled", "aim", "solids", "ranges"];
    for (const part of [...motion, ...seen, "action", "scale", "given", "drawn", "flown", "ceiling"]) {
      this[part] = kernel.view(slot, part);
    }
    this.keys = kernel.view(slot, "keys", BigInt64Array);
    this.episodes = kernel.view(slot, "episodes", BigInt64Array);
    this.diverged = kernel.view(slot, "diverged");
    kernel.view(slot, "parameters").set(this.vehicle.row);
    kernel.view(slot, "limits").set(this.vehicle.limits);
    this.#take(taskName);
    const { rotors } = this.vehicle;
    this.scale[0] = this.vehicle.actionScale;
    this.estimates = false; // whether the rotor speeds that are seen follow from the commands
    const flown = "qpos qvel act ctrl warm wind ceiling flown world near solids nearby";
    const { solids, rays } = this.pair, count = solids?.looks.length ?? 0;
    this.#point("flight_rows", flown, [0, 0, rotors, count]);
    this.#point("state_rows", "qpos qvel act origin limits wind", [0, 0, 1, rotors]);
    if (solids) {
      kernel.view(slot, "outline").set(solids.outline.flat());
      this.#point("solid_rows", "qpos outline solids nearby", [0, count, solids.outline.length]);
    }
    if (rays) {
      const eye = kernel.address(slot, "eye"), reach = eye + 3 * Float64Array.BYTES_PER_ELEMENT;
      kernel.view(slot, "along").set(rays.along.flat());
      kernel.view(slot, "eye").set(rays.eye);
      this.#point("finder", "qpos along eye eye solids", [0, count, rays.along[0].length, rays.frame]);
      kernel.view(slot, "finder", Int32Array)[3] = reach;
    }
  }

  // Takes a task up: its functions, its words, and the world it is in.
  #take(taskName) {
    const { kernel, slot, vehicleName } = this, { book, functions } = kernel;
    Object.assign(this, { taskName, task: book.tasks[taskName], pair: book.pairs[`${taskName}_${vehicleName}`] });
    this.call = (name) => functions[`${taskName}_${vehicleName}_${name}`](this.memory);
    kernel.view(slot, "world").set(this.pair.world);
    kernel.view(slot, "origin").set(this.pair.origin);
  }

  // Goes on with a task as its episode begins, but from where the aircraft is and as it moves.
  turn(taskName) {
    const motion = [this.qpos, this.qvel, this.act].map((part) => [part, part.slice()]);
    this.#take(taskName);
    this.uniform(this.kernel.book.startStream, 0, this.pair.drawn);
    this.call("begin");
    for (const [part, values] of motion) part.set(values);
    this.#read();
    this.call("first");
  }

  // Fills a struct of pointers, then of int64, for the kernels of C.
  #point(part, names, numbers) {
    const pointers = this.kernel.view(this.slot, part, Int32Array);
    const parts = names.split(" ");
    parts.forEach((name, k) => (pointers[k] = this.kernel.address(this.slot, name)));
    const longs = this.kernel.view(this.slot, part, BigInt64Array);
    longs.set(numbers.map(BigInt), Math.ceil(parts.length / 2));
  }

  // Numbers of a stream of the episode, uniform in [0, 1), as quadrl/engines/rng.py gives them.
  uniform(stream, first, count) {
    const { functions } = this.kernel;
    const at = (part) => this.kernel.address(this.slot, part);
    const places = [at("keys"), at("episodes")];
    const numbers = [stream, first, count].map(BigInt);
    functions.quadrl_uniform(ONE, ...places, ...numbers, at("drawn"));
    return this.drawn.subarray(0, count);
  }

  // Begins an episode of a seed.
  begin(seed, episode = 0) {
    this.keys[0] = BigInt(seed);
    this.episodes[0] = BigInt(episode);
    this.uniform(this.kernel.book.startStream, 0, this.pair.drawn);
    this.call("begin");
    this.diverged[0] = 0;
    this.wind.fill(0);
    this.flown.set(this.vehicle.row);
    this.ceiling.fill(Infinity);
    if (this.pair.solids) {
      this.uniform(this.kernel.book.solidStream, 0, this.pair.drawn);
      this.call("place");
    }
    this.first();
  }

  // What is seen first, from where the aircraft is.
  first() {
    this.kernel.view(this.slot, "nearby")[0] = NaN; // a list that is not known
    this.#read();
    this.#measure();
    this.modelled.set(this.estimates ? this.vehicle.hoverSpeed : this.act);
    this.late = Array.from({ length: this.vehicle.deadSteps }, () => this.act.slice());
    this.call("first");
    this.call("rest");
  }

  // Commands to the rotors from an action; without one the geometric controller gives it. With
  // loops the action is their setpoint, and they command the rotors at each physics step.
  command(action, loops = false) {
    if (action) this.action.set(action);
    else this.call("geometric");
    this.loops = loops;
    this.mean = new Float64Array(this.ctrl.length);
    this.call(loops ? "aimed" : "command");
    if (this.estimates) this.call("follow");
  }

  // Flies some physics steps; whether there was nothing near that it could touch.
  advance(steps = 1) {
    const rows = this.kernel.address(this.slot, "flight_rows");
    return this.kernel.functions.quadrl_free_flight(rows, 0n, ONE, BigInt(steps)) === 0n;
  }

  // Leaves a rotor, numbered from 1 on, a share of its largest speed.
  weaken(rotor, left) {
    this.ceiling[rotor - 1] = left * this.vehicle.maxSpeed[rotor - 1];
  }

  // Lets it carry a share of its mass at its centre of mass.
  load(share) {
    const place = this.kernel.book.massPlace;
    this.flown[place] = (1 + share) * this.vehicle.row[place];
  }

  // Flies a physics step with the commands of the aircraft's dead time ago; whether as `advance`.
  tick() {
    if (this.loops) {
      this.#state();
      this.call("looped");
      this.ctrl.forEach((wanted, k) => (this.mean[k] += wanted / this.vehicle.substeps));
    }
    const command = this.ctrl.slice();
    this.late.push(command);
    this.ctrl.set(this.late.shift().map((wanted, k) => Math.min(wanted, this.ceiling[k])));
    const clear = this.advance();
    this.ctrl.set(command);
    return clear;
  }

  // The transition of a control step, after its physics steps.
  finish() {
    this.#read();
    this.#measure();
    if (this.loops) this.ctrl.set(this.mean); // which counts
    if (!this.estimates) this.modelled.set(this.act);
    this.call("step");
    this.call("feel");
  }

  #read() {
    if (this.#state()) this.diverged[0] = 1;
  }

  // Computes the state; whether it is not sound.
  #state() {
    const at = (part) => this.kernel.address(this.slot, part);
    return this.kernel.functions.quadrl_state(at("state_rows"), ONE, 0, at("state")) !== 0n;
  }

  // How far it is to solids, and along rays.
  #measure() {
    const { functions } = this.kernel, at = (part) => this.kernel.address(this.slot, part);
    const { solids, rays } = this.pair;
    if (solids) functions.quadrl_clearance(at("solid_rows"), 0n, ONE, 0, at("clearance"));
    if (rays) functions.quadrl_rays(at("finder"), 0n, ONE, 0, at("ranges"));
  }

  // Whether it is no nearer to a solid than to the ground.
  get clear() {
    this.#measure();
    return !this.pair.solids || this.kernel.view(this.slot, "clearance")[0] > this.qpos[2];
  }

  // The solids about it as the scene draws them, without those that this episode does not have.
  get obstacles() {
    return (this.pair.solids?.looks ?? []).map(({ kind, rgba }, k) => {
      const numbers = [...this.solids.subarray(16 * k, 16 * k + 16)];
      const [size, position, turn] = [numbers.slice(1, 4), numbers.slice(4, 7), numbers.slice(7)];
      return { kind, rgba, size, position, turn, shine: 0, glow: 0 };
    }).filter(({ position: [, , z], size }) => z > -Math.max(...size));
  }

  // Ends of the rays that meet something, world frame [m], and how near that is, 1 at the aircraft.
  get beams() {
    const { rays } = this.pair;
    if (!rays) return [];
    const { qpos, ranges } = this, [w, x, y, z] = qpos.subarray(3), [along, reach] = [rays.along, rays.eye[3]];
    const yaw = Math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)), [c, s] = [Math.cos(yaw), Math.sin(yaw)];
    return along[0].map((east, k) => {
      const [north, up, far] = [along[1][k], along[2][k], ranges[k]];
      const way = [c * east - s * north, s * east + c * north, up];
      return { to: way.map((part, axis) => qpos[axis] + far * part), near: 1 - far / reach };
    }).filter(({ near }) => near > 0);
  }

  // What is measured: what the task shows, and what else the options of an observation ask for.
  seen({ disturbance = false, sensors = {} } = {}) {
    const { observation, pair, kernel: { book } } = this;
    const felt = disturbance || "disturbance" in sensors;
    const own = visible(book, pair, sensors).map((k) => observation[k]);
    const late = Object.keys(sensors).map((name) => ({ aim: this.aim, standard: this.standard })[name] ?? []);
    return [...own, ...(felt ? this.felt : []), ...late.flatMap((values) => [...values])];
  }

  // As quadrl.conditions.targets.Standard gives it: how a target moves, and which task this is.
  get standard() {
    const { book } = this.kernel, [from, to] = this.pair.layout.target_velocity ?? [0, 0];
    const velocity = to ? this.observation.subarray(from, to) : [0, 0, 0];
    return [...velocity, ...book.standard.map((name) => Number(name === this.taskName))];
  }

  get error() { return this.given[0]; } // [m]
  get goal() { return this.given.subarray(2, 5); } // [m], world
  get terminated() { return this.given[5] !== 0; }
  get truncated() { return this.given[6] !== 0; }
  get succeeded() { return this.given[7] !== 0; }
}
