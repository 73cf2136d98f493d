// The page: two flights of one episode, side by side, and all that can be done to them.

import { decoded, Kernel } from "./flight.mjs";
import { Policy } from "./policy.mjs";
import { Episode } from "./episode.mjs";
import { fromFragment, rounded, toFragment, unread } from "./link.mjs";
import { Stage } from "./scene.mjs";
import { Plot } from "./plot.mjs";

const SIDES = ["left", "right"];
const COLOURS = ["#58a6ff", "#ffa24c"];
const RATES = [0.25, 0.5, 1, 2];
const LONGEST_FRAME = 0.25; // [s]; a page that was hidden does not catch up
const TUMBLE = 0.35; // of the largest body rate that stays resolved, at most TUMBLE_MOST
const TUMBLE_MOST = 6; // [rad/s]
// What lasts, where nothing happens: the wind and its gusts; the slider's rotor and what is left of it; the payload.
const CALM = { wind: [0, 0, 0, 0], rotor: [1, 1], payload: [0] };
const LABELS = {
  ppo: "PPO", trpo: "TRPO", gae: "Policy gradient", vpg: "Policy gradient", apg: "APG", robust: "Robust",
};

const at = (id) => document.getElementById(id);
const words = (name) => name.replaceAll("_", " ");

class Page {
  constructor(kernel, book) {
    Object.assign(this, { kernel, book });
    this.policies = new Map();
    const order = Object.keys(LABELS);
    const rank = ([name, { task }]) => order.indexOf(name.slice(task.length + 1));
    const shipped = Object.entries(book.policies).sort((one, other) => rank(one) - rank(other));
    for (const [name, { file }] of shipped) {
      this.policies.set(name, new Policy(decoded(file).buffer, book.policy));
    }
    const panels = SIDES.map((side) => at(`${side}-view`));
    this.stage = new Stage(at("world"), panels, COLOURS, book.drawn);
    this.plots = {
      error: new Plot(at("error-plot"), { from: 0, least: 0.05 }),
      left: new Plot(at("left-plot"), { least: 10 }),
      right: new Plot(at("right-plot"), { least: 10 }),
    };
    this.orbit = { azimuth: -2.3, elevation: 0.32, distance: 2 };
    this.paused = false;
    this.rate = 1;
    this.wire();
    this.open(location.hash);
    this.last = performance.now();
    this.drawn = 0;
    requestAnimationFrame((now) => this.frame(now));
  }

  // ------------------------------------------------------------------ what is flown

  // Takes up the settings of a link.
  open(hash) {
    this.settings = fromFragment(hash, this.book);
    const strange = unread(hash, this.settings);
    const { at: step } = this.settings;
    this.begin();
    const { substeps } = this.vehicle;
    for (let k = 0; k < step * substeps; ++k) this.tick();
    this.pause(step > 0);
    if (step > 0) {
      this.say(`This is the moment of the link, ${this.time.toFixed(1)} s. Press Play to fly on.`);
    }
    if (strange.length) this.say(`Not understood in the link: ${strange.join(", ").slice(0, 80)}.`);
    this.orbit.distance = this.#distance();
    this.showSliders();
  }

  get vehicle() {
    return this.book.vehicles[this.settings.aircraft];
  }

  get time() {
    return Math.max(...this.episodes.map((episode) => episode.time));
  }

  // The control step that comes next.
  get step() {
    const ticks = Math.max(...this.episodes.map((episode) => episode.ticks));
    return Math.ceil(ticks / this.vehicle.substeps);
  }

  // Names of the controllers that can fly the aircraft in the task, those trained for it first.
  controllers() {
    const { task, aircraft } = this.settings;
    const fits = ([, policy]) => !policy.unfit(this.book, task, aircraft);
    const own = [], several = [], others = [];
    for (const [name, policy] of [...this.policies].filter(fits)) {
      (policy.task === task ? own : policy.several ? several : others).push(name);
    }
    return { own: [...own, ...several], others };
  }

  // Begins the episode of the settings.
  begin() {
    const { settings } = this, { own, others } = this.controllers();
    for (const side of SIDES) {
      if (["geometric", ...own, ...others].includes(settings[side])) continue;
      if (settings[side]) this.say(`${words(settings[side])} cannot fly this: another one does.`);
      settings[side] = (side === "left" && own[0]) || "geometric";
    }
    this.fillControllers(own, others);
    this.episodes = SIDES.map((side, k) => {
      const controller = this.policies.get(settings[side]);
      return new Episode(this.kernel, k, settings, controller, settings.events);
    });
    const { scene } = this.book.tasks[settings.task], { obstacles } = this.episodes[0].flight;
    this.stage.begin(this.vehicle, { ...scene, shapes: [...scene.shapes, ...obstacles] });
    this.behind = 0; // [s] that pictures are ahead of the last physics step
    this.poses = this.episodes.map((episode) => [pose(episode), pose(episode)]);
    this.showSettings();
  }

  // The same episode from its start: as the sliders are, or with everything that happened in it.
  again(replayed = false) {
    const lasting = Object.keys(CALM).map((kind) => ({ step: 0, kind, values: this.set(kind) }));
    this.settings.at = 0;
    if (!replayed) {
      this.settings.events = lasting.filter(({ kind, values }) => values.some((x, k) => x !== CALM[kind][k]));
    }
    this.begin();
    this.showSliders();
    this.pause(false);
    this.remember();
  }

  change(part) {
    Object.assign(this.settings, part);
    this.again();
    if (part.task || part.aircraft) this.orbit.distance = this.#distance();
  }

  #distance() {
    const wide = { hover: 1, navigation: 2.6 }[this.settings.task] ?? 1.35;
    return wide * (0.6 + 6.5 * this.vehicle.size);
  }

  tick() {
    this.episodes.forEach((episode, k) => {
      if (!episode.tick()) return;
      this.poses[k] = [this.poses[k][1], pose(episode)];
      this.stage.views[k].remember(this.poses[k][0].position, episode.flight.goal);
    });
  }

  // ------------------------------------------------------------------ what happens from outside

  event(kind, values) {
    const { step } = this, { events } = this.settings;
    const last = events.at(-1);
    if (kind !== "push" && last?.kind === kind && last.step === step) events.pop();
    events.push({ step, kind, values: rounded(values) });
    this.remember();
  }

  // right, away: as the viewer sees it.
  push(right, away) {
    const strength = Number(at("push").value);
    const [east, north] = [Math.cos(this.orbit.azimuth), Math.sin(this.orbit.azimuth)];
    const velocity = [-right * north - away * east, right * east - away * north, 0];
    this.event("push", [...velocity.map((x) => strength * x), 0, 0, 0]);
  }

  tumble() {
    const rate = Math.min(TUMBLE * (0.5 / this.vehicle.physicsTimestep), TUMBLE_MOST);
    const angle = 2.399963 * this.step; // another axis each time, and the same in a link
    this.event("push", [0, 0, 0, rate * Math.cos(angle), rate * Math.sin(angle), 0]);
  }

  // The values of an event that lasts, as the sliders say.
  set(kind) {
    if (kind === "rotor") return [1, Number(at("rotor").value)];
    if (kind === "payload") return [Number(at("payload").value)];
    const speed = Number(at("wind").value), from = (Number(at("bearing").value) * Math.PI) / 180;
    return rounded([speed * Math.cos(from), speed * Math.sin(from), 0, Number(at("gusts").value)]);
  }

  // Sets the sliders to what the link says of this moment.
  showSliders() {
    const past = this.settings.events.filter(({ step }) => step <= this.step);
    const last = (kind) => past.findLast((event) => event.kind === kind && (kind !== "rotor" || event.values[0] === 1));
    const values = (kind) => last(kind)?.values ?? CALM[kind];
    const [east, north, , gusts] = values("wind");
    at("rotor").value = values("rotor")[1];
    at("payload").value = values("payload")[0];
    at("wind").value = Math.hypot(east, north);
    at("bearing").value = ((Math.atan2(north, east) * 180) / Math.PI + 360) % 360;
    at("gusts").value = gusts;
    this.showValues();
  }

  // ------------------------------------------------------------------ what is shown

  frame(now) {
    const { physicsTimestep } = this.vehicle, { orbit, settings, paused } = this;
    const frame = Math.min((now - this.last) / 1000, LONGEST_FRAME);
    const passed = paused ? 0 : frame * this.rate;
    this.last = now;
    this.behind += passed;
    for (; this.behind >= physicsTimestep; this.behind -= physicsTimestep) this.tick();
    // Nothing moves in a pause, but for the camera and the window.
    const still = paused && JSON.stringify([orbit, innerWidth, innerHeight, settings]);
    if (!still || still !== this.still) this.draw(this.behind / physicsTimestep, passed);
    this.still = still;
    if (now - this.drawn > 60) {
      this.drawn = now;
      this.showFigures();
    }
    requestAnimationFrame((next) => this.frame(next));
  }

  // The flights a share of the way to their next physics step, some time after the last picture.
  draw(share, passed) {
    const shown = this.episodes.map(({ flight: { goal, wind, beams } }, k) => ({
      pose: between(...this.poses[k], share), goal: [...goal], wind: [...wind], beams,
    }));
    this.stage.draw(shown, this.orbit, passed);
  }

  showFigures() {
    const pushes = this.settings.events.filter(({ kind }) => kind === "push");
    const marks = pushes.map(({ step }) => step * this.vehicle.controlTimestep);
    this.episodes.forEach((episode, k) => {
      const { flight: { error, qpos, qvel }, history } = episode, side = SIDES[k];
      const speed = Math.hypot(...qvel.subarray(0, 3));
      const tilt = Math.acos(Math.min(1 - 2 * (qpos[4] ** 2 + qpos[5] ** 2), 1));
      at(`${side}-error`).textContent = length(error);
      at(`${side}-error`).dataset.metres = error;
      at(`${side}-speed`).textContent = `${speed.toFixed(2)} m/s`;
      at(`${side}-tilt`).textContent = `${((180 / Math.PI) * tilt).toFixed(0)}°`;
      at(`${side}-outcome`).textContent = verdict(episode);
      at(`${side}-view`).classList.toggle("over", episode.outcome !== "");
      at(`${side}-view`).classList.toggle("solved", episode.solved === true && !episode.outcome);
      const commands = this.vehicle.colour.map((colour, rotor) => ({
        colour: tint(colour, rotor),
        width: 1.4,
        points: history.map(({ time, command }) => [time, command[rotor]]),
      }));
      this.plots[side].draw(commands, this.time, marks);
    });
    const errors = this.episodes.map(({ history }, k) => ({
      colour: COLOURS[k],
      width: 2,
      points: history.map(({ time, error }) => [time, error]),
    }));
    this.plots.error.draw(errors, this.time, marks);
    // What is flown now: a flight may have gone on with another task.
    const { taskName, task: { asks, starts, ends } } = this.episodes[0].flight;
    at("task-words").textContent = `It asks to ${asks}. It starts ${starts}. It ends ${ends}.`;
    pressed("turns", words(taskName));
    at("time").textContent = `${this.time.toFixed(1)} s`;
    document.documentElement.dataset.time = this.time;
  }

  showSettings() {
    const { settings } = this;
    at("task").value = settings.task;
    at("seed").value = settings.seed;
    pressed("aircraft", settings.aircraft);
    const { mass, size, rotors } = this.vehicle;
    const weight = mass < 0.1 ? `${(1000 * mass).toFixed(0)} g` : `${mass.toFixed(2)} kg`;
    const arm = `${(100 * size).toFixed(1)} cm from the centre to a rotor`;
    at("aircraft-words").textContent = `${weight}, ${rotors} rotors, ${arm}.`;
    const flies = SIDES.map((side) => this.policies.get(settings[side]));
    at("turn").hidden = !flies.some((one) => one?.several) || flies.some((one) => one && !one.several);
    at("no-policy").hidden = this.controllers().own.length > 0;
    this.showValues();
  }

  fillControllers(own, others) {
    const groups = [
      ["Policies trained for the task", own],
      ["A controller", ["geometric"]],
      ["Policies trained for other tasks", others],
    ];
    for (const side of SIDES) {
      const made = groups.filter(([, names]) => names.length).map(([label, names]) => {
        const group = Object.assign(document.createElement("optgroup"), { label });
        group.append(...names.map((name) => new Option(this.label(name), name)));
        return group;
      });
      at(`${side}-controller`).replaceChildren(...made);
      at(`${side}-controller`).value = this.settings[side];
    }
  }

  label(name) {
    if (name === "geometric") return "Geometric controller";
    const { task } = this.policies.get(name), ships = this.book.policies[name];
    return `${ships ? LABELS[name.slice(task.length + 1)] : name}, ${words(task)}`;
  }

  showValues() {
    for (const name of ["wind", "gusts", "push"]) {
      at(`${name}-value`).textContent = `${Number(at(name).value).toFixed(1)} m/s`;
    }
    for (const name of ["rotor", "payload"]) {
      at(`${name}-value`).textContent = `${(100 * Number(at(name).value)).toFixed(0)} %`;
    }
    at("bearing-value").textContent = `${Number(at("bearing").value).toFixed(0)}°`;
    pressed("rate", this.rate);
  }

  pause(paused = !this.paused) {
    this.paused = paused;
    at("pause").textContent = paused ? "▶ Play" : "❚❚ Pause";
  }

  say(text) {
    const note = at("note");
    note.textContent = text;
    note.classList.add("shown");
    clearTimeout(this.noted);
    this.noted = setTimeout(() => note.classList.remove("shown"), 5000);
  }

  // The address shows the present settings, so that a bookmark keeps them.
  remember() {
    history.replaceState(null, "", toFragment({ ...this.settings, at: 0 }));
  }

  async copyLink() {
    const { settings, policies, book } = this, steps = this.episodes.map((episode) => episode.steps);
    const link = location.href.split("#")[0] + toFragment({ ...settings, at: Math.max(...steps) });
    history.replaceState(null, "", link);
    const own = SIDES.some((side) => policies.has(settings[side]) && !book.policies[settings[side]]);
    const note = own ? " It cannot hold the file that you dropped." : "";
    try {
      await navigator.clipboard.writeText(link);
      this.say(`The link to this moment is copied.${note}`);
    } catch {
      this.say(`The address of this page is now the link to this moment.${note}`);
    }
  }

  async take(file) {
    try {
      const { book } = this, policy = new Policy(await file.arrayBuffer(), book.policy);
      let { task, aircraft } = this.settings;
      const problem = policy.unfit(book, task, aircraft);
      if (problem) {  // then to what it was trained for
        if (Object.hasOwn(book.tasks, policy.task)) task = policy.task;
        if (Object.hasOwn(book.vehicles, policy.vehicle)) aircraft = policy.vehicle;
        if (policy.unfit(book, task, aircraft)) throw new Error(problem);
      }
      const name = `my ${file.name.replace(/\.safetensors$/, "").slice(0, 40)}`;
      this.policies.set(name, policy);
      this.change({ task, aircraft, left: name });
      this.say(`${file.name} flies on the left.`);
    } catch (error) {
      this.say(`${file.name}: ${error.message}`);
    }
  }

  // ------------------------------------------------------------------ what the user does

  wire() {
    const { book } = this;
    const usual = { left: "", right: "geometric" };
    at("task").append(...Object.keys(book.tasks).map((name) => new Option(words(name), name)));
    at("task").onchange = ({ target }) => this.change({ task: target.value, ...usual });
    const names = Object.keys(book.tasks);
    choices("turns", book.standard.filter((name) => names.includes(name)).map(words), (name) => {
      this.event("task", [names.findIndex((known) => words(known) === name)]);
    });
    choices("aircraft", Object.keys(book.vehicles), (aircraft) => this.change({ aircraft, ...usual }));
    choices("rate", RATES, (rate) => {
      this.rate = rate;
      this.showValues();
    }, "×");
    for (const side of SIDES) {
      at(`${side}-controller`).onchange = ({ target }) => {
        this.change({ [side]: target.value });
        target.blur();
      };
    }
    const seed = (value) => {
      this.change({ seed: Math.min(Math.max(Math.round(value) || 0, 0), Number.MAX_SAFE_INTEGER) });
    };
    at("seed").onchange = ({ target }) => seed(Number(target.value));
    const actions = {
      pause: () => this.pause(),
      again: () => this.again(),
      replay: () => this.again(true),
      link: () => this.copyLink(),
      next: () => seed(this.settings.seed + 1),
      last: () => seed(this.settings.seed - 1),
      tumble: () => this.tumble(),
      "push-left": () => this.push(-1, 0),
      "push-right": () => this.push(1, 0),
      "push-away": () => this.push(0, 1),
      "push-near": () => this.push(0, -1),
    };
    for (const [id, act] of Object.entries(actions)) {
      at(id).onclick = ({ currentTarget }) => {
        act();
        currentTarget.blur();
      };
    }
    const sliders = { wind: "wind", bearing: "wind", gusts: "wind", rotor: "rotor", payload: "payload" };
    for (const [id, kind] of Object.entries(sliders)) {
      at(id).oninput = () => this.showValues();
      at(id).onchange = () => this.event(kind, this.set(kind));
    }
    at("push").oninput = () => this.showValues();
    const keys = {
      " ": "pause", r: "again", p: "replay", n: "next", l: "link", t: "tumble",
      ArrowLeft: "push-left", ArrowRight: "push-right", ArrowUp: "push-away", ArrowDown: "push-near",
    };
    addEventListener("keydown", (event) => {
      const typing = event.target.closest?.("input, select");
      const id = keys[event.key] ?? keys[event.key.toLowerCase()];
      if (typing || event.ctrlKey || event.metaKey || event.altKey || !id) return;
      event.preventDefault();
      actions[id]();
    });
    addEventListener("hashchange", () => this.open(location.hash));
    at("file").onchange = ({ target }) => {
      if (target.files[0]) this.take(target.files[0]);
      target.value = "";
    };
    const hovers = (does) => document.body.classList.toggle("dropping", does);
    addEventListener("dragover", (event) => {
      event.preventDefault();
      hovers(true);
    });
    addEventListener("dragleave", (event) => hovers(event.relatedTarget !== null));
    addEventListener("drop", (event) => {
      event.preventDefault();
      hovers(false);
      if (event.dataTransfer.files[0]) this.take(event.dataTransfer.files[0]);
    });
    this.wireCamera(at("stage"));
  }

  wireCamera(stage) {
    const fingers = new Map(), { orbit } = this;
    const zoom = (factor) => {
      orbit.distance = Math.min(Math.max(orbit.distance * factor, 0.25), 25);
    };
    stage.addEventListener("pointerdown", (event) => {
      if (event.target.closest("select, button")) return;
      stage.setPointerCapture(event.pointerId);
      fingers.set(event.pointerId, event);
    });
    stage.addEventListener("pointermove", (event) => {
      const before = fingers.get(event.pointerId);
      if (!before) return;
      if (fingers.size === 1) {
        orbit.azimuth -= 0.006 * (event.clientX - before.clientX);
        orbit.elevation += 0.005 * (event.clientY - before.clientY);
        orbit.elevation = Math.min(Math.max(orbit.elevation, -0.3), 1.5);
      } else {
        const [, other] = [...fingers].find(([id]) => id !== event.pointerId);
        const apart = ({ clientX, clientY }) => Math.hypot(clientX - other.clientX, clientY - other.clientY);
        zoom(apart(before) / Math.max(apart(event), 1));
      }
      fingers.set(event.pointerId, event);
    });
    for (const name of ["pointerup", "pointercancel"]) {
      stage.addEventListener(name, ({ pointerId }) => fingers.delete(pointerId));
    }
    const wheel = (event) => {
      event.preventDefault();
      zoom(Math.exp(0.001 * event.deltaY));
    };
    stage.addEventListener("wheel", wheel, { passive: false });
  }
}

// A group of buttons, one of which is pressed.
function choices(id, values, choose, unit = "") {
  for (const value of values) {
    const button = document.createElement("button");
    Object.assign(button, { type: "button", textContent: `${value}${unit}`, value });
    button.onclick = () => choose(value);
    at(id).append(button);
  }
}

function pressed(id, value) {
  for (const button of at(id).children) button.setAttribute("aria-pressed", button.value === `${value}`);
}

// A length [m] in the unit in which it has digits.
function length(metres) {
  if (metres >= 1) return `${metres.toFixed(2)} m`;
  if (metres >= 0.01) return `${(100 * metres).toFixed(1)} cm`;
  return metres >= 0.001 ? `${(1000 * metres).toFixed(1)} mm` : `${(1e6 * metres).toFixed(0)} µm`;
}

// How an episode stands, in words; nothing before its end.
function verdict({ outcome, solved, time, flight }) {
  if (outcome) return `Over at ${time.toFixed(1)} s: ${outcome}`;
  if (solved === null) return "";
  return `${solved ? "Solved" : "Not solved"} in its ${flight.task.timeLimit} s`;
}

function pose({ flight: { qpos, act } }) {
  return { position: [...qpos.subarray(0, 3)], quaternion: [...qpos.subarray(3)], speeds: [...act] };
}

// The pose a share of the way from one to the next.
function between(one, next, share) {
  const cosine = one.quaternion.reduce((sum, x, k) => sum + x * next.quaternion[k], 0);
  const mixed = (name, sign) => one[name].map((x, k) => x + share * (sign * next[name][k] - x));
  return {
    position: mixed("position", 1),
    quaternion: mixed("quaternion", cosine < 0 ? -1 : 1),
    speeds: mixed("speeds", 1),
  };
}

// A colour for a rotor's line: its paint, a little different for rotors that are painted alike.
function tint([red, green, blue], k) {
  const shade = 1 - 0.1 * (k % 3), part = (x) => Math.round(255 * Math.min(x * shade + 0.08, 1));
  return `rgb(${part(red)}, ${part(green)}, ${part(blue)})`;
}

function fail(text) {
  at("problem").textContent = text;
  at("problem").hidden = false;
}

addEventListener("error", (event) => fail(event.message));
addEventListener("unhandledrejection", (event) => fail(String(event.reason?.message ?? event.reason)));

const book = JSON.parse(at("book").textContent);
const kernel = await Kernel.load(decoded(book.wasm), book);
new Page(kernel, book);
