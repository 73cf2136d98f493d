// A trained policy: reads the file and gives the mean action, as quadrl/evaluation/policy.py does.

import { visible } from "./flight.mjs";

const LAYERS = ["weight", "bias"];
const DAMAGED = "The file is damaged or not a safetensors file.";
const WRITTEN = { "\b": "an ONNX model", PK: "an archive, such as a program of torch" };
const CHECKPOINT = "This is a checkpoint, from which a training goes on. The policy is policy.safetensors in the same folder.";

// What a safetensors file says of itself: its text table, its arrays' places, and the bytes that hold them.
function readTable(buffer) {
  const bytes = new Uint8Array(buffer);
  const size = bytes.length < 8 ? NaN : Number(new DataView(bytes.buffer).getBigUint64(0, true));
  if (!(size <= bytes.length - 8)) {
    const start = new TextDecoder().decode(bytes.subarray(0, 2));
    const [, other] = Object.entries(WRITTEN).find(([first]) => start.startsWith(first)) ?? [];
    throw new Error(other ? `This is ${other}, for other programs. Drop the policy.safetensors that it was made of.` : DAMAGED);
  }
  try {
    const table = JSON.parse(new TextDecoder().decode(bytes.subarray(8, 8 + size)));
    const { __metadata__: texts = {}, ...entries } = table;
    return { texts, entries, data: bytes.subarray(8 + size) };
  } catch {
    throw new Error(DAMAGED);
  }
}

// Arrays (float32) of a safetensors file.
function readArrays({ entries, data }) {
  const arrays = {};
  try {
    for (const [name, { dtype, data_offsets: [from, to] }] of Object.entries(entries)) {
      if (dtype !== "F32" || to > data.length) throw new Error(DAMAGED);
      arrays[name] = new Float32Array(data.slice(from, to).buffer);
    }
  } catch {
    throw new Error(DAMAGED);
  }
  return arrays;
}

// Options of the observation that this page knows, by their names in quadrl/conditions/observing.py.
const KNOWN = { disturbance: false, action_history: 0, observation_history: 0, rotor_speed: "true", sensors: {} };

// Sensors that it knows, with the options that it knows of each.
const SENSORS = { aim: ["beside_goal"], disturbance: ["smoothing"], standard: [] };

// What of the options of an observation this page does not know, in words; nothing if it knows all.
function strange(observe) {
  const options = Object.keys(observe).filter((name) => observe[name] && !(name in KNOWN));
  const { rotor_speed: speed, sensors } = observe;
  if (!["true", "estimated"].includes(speed)) options.push(`rotor_speed ${speed}`);
  for (const [name, given] of Object.entries(sensors)) {
    if (!(name in SENSORS)) options.push(`the sensor ${name}`);
    else {
      const own = Object.keys(given).filter((option) => !SENSORS[name].includes(option));
      options.push(...own.map((option) => `${name} with its own ${option}`));
    }
  }
  return options[0];
}

export class Policy {
  // rules: the `policy` entry of the book.
  constructor(buffer, rules) {
    const table = readTable(buffer);
    let header = {};
    try {
      header = JSON.parse(table.texts[rules.header] ?? "{}");
    } catch {
      // The format below is missing then.
    }
    if (`${header.format}`.startsWith("quadrl-checkpoint")) throw new Error(CHECKPOINT);
    if (header.format !== rules.format) throw new Error("The file holds no policy of quadrl.");
    const arrays = readArrays(table);
    const length = Math.max(1, Math.floor(Object.keys(arrays).length / 2) - 1);
    const names = Array.from({ length }, (_, k) => LAYERS.map((name) => `${name}_${k}`));
    for (const name of ["mean", "deviation", ...names.flat()]) {
      if (!arrays[name]) throw new Error(`The file is damaged: the array ${name} is missing.`);
    }
    this.clip = rules.clip;
    this.task = header.task;
    this.metadata = header.metadata ?? {};
    this.observe = { ...KNOWN, ...this.metadata.observe };
    const { vehicle = {}, changed = {} } = this.metadata;
    this.vehicle = vehicle.name;
    this.loops = (this.metadata.control_mode ?? "rotor") !== "rotor"; // whether it commands loops
    this.changed = changed.vehicle ?? []; // what is not as the aircraft of that name has it
    this.scale = this.changed.includes("action_scale") ? vehicle.action_scale : undefined;
    this.mean = arrays.mean;
    this.deviation = arrays.deviation;
    this.layers = names.map(([weight, bias]) => ({ weight: arrays[weight], bias: arrays[bias] }));
    let width = this.mean.length, sound = this.deviation.length === width;
    for (const { weight, bias } of this.layers) {
      sound &&= weight.length === bias.length * width;
      width = bias.length;
    }
    sound &&= Object.values(arrays).every((array) => array.every(Number.isFinite));
    if (!sound || !this.deviation.every((x) => x > 0)) {
      throw new Error("The file is damaged: its arrays do not make a network.");
    }
    this.size = this.mean.length;
    this.actionSize = width / 2;
  }

  // Whether it has learned several tasks, and flies each of them.
  get several() {
    return "standard" in this.observe.sensors;
  }

  // Why this policy cannot fly an aircraft of the book in a task; nothing if it can.
  unfit(book, taskName, vehicleName) {
    const { rotors, layout } = book.vehicles[vehicleName], { actionSize, metadata, observe } = this;
    const pair = book.pairs[`${taskName}_${vehicleName}`], { aim, standard } = observe.sensors;
    const late = (aim ? 3 : 0) + (standard ? 3 + book.standard.length : 0);
    const single = visible(book, pair, observe.sensors).length + late + 3 * observe.disturbance;
    const size = single * (1 + observe.observation_history) + rotors * observe.action_history;
    const foreign = strange(observe);
    if (foreign) return `It observes ${foreign}, which this page does not know.`;
    if (standard && !book.standard.includes(taskName)) return `It has learned ${book.standard.join(", ")}.`;
    const other = this.changed.find((name) => name !== "action_scale");
    if (other) return `It has learned another ${other} than the aircraft here have.`;
    const mode = metadata.control_mode ?? "rotor", loops = this.loops && pair.loops;
    if (this.loops && loops?.mode !== mode) return `Its control mode is ${mode}, and this page knows ${pair.loops?.mode ?? "rotor"}.`;
    if (loops && vehicleName !== this.vehicle) return `Its loops are those of ${this.vehicle}.`;
    if (!loops && actionSize !== rotors) return `It commands ${actionSize} rotors; ${vehicleName} has ${rotors}.`;
    if (this.size !== size) return `It observes ${this.size} numbers; ${taskName} shows ${size}.`;
    const trained = book.vehicles[this.vehicle] ?? book.vehicles[vehicleName];
    const alike = JSON.stringify(trained.layout) === JSON.stringify(layout);
    if (!alike) return `It has learned the rotor layout of ${this.vehicle}.`;
    const own = this.scale ?? trained.actionScale;
    if (loops) return own === loops.scale ? "" : `Its loops change the rotor speeds by ${own} rad/s, and those of this page by ${loops.scale}.`;
    if (this.scale || own === book.vehicles[vehicleName].actionScale) return "";
    return `Its actions change the rotor speeds by ${own} rad/s, as those of ${this.vehicle}.`;
  }

  // The mean action of a flat observation (float32), within [-1, 1].
  act(observation) {
    let values = Float32Array.from(observation, (x, k) => {
      const normal = Math.fround(Math.fround(x - this.mean[k]) / this.deviation[k]);
      return Math.min(Math.max(normal, -this.clip), this.clip);
    });
    this.layers.forEach(({ weight, bias }, layer) => {
      const width = values.length, last = layer === this.layers.length - 1;
      values = Float32Array.from(bias, (offset, row) => {
        let sum = offset;
        for (let k = 0; k < width; ++k) sum += weight[row * width + k] * values[k];
        return last ? sum : Math.tanh(sum);
      });
    });
    return values.subarray(0, this.actionSize).map((x) => Math.min(Math.max(x, -1), 1));
  }
}
