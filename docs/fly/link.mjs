// The settings of a session as the fragment of its address, so that a link shows the same flight.

const DIGITS = 4;
// How many numbers an event of a kind has, and the least and largest of them.
const KINDS = { task: [1, 0, 100], push: [6, -100, 100], wind: [4, -100, 100], rotor: [2, 0, 8], payload: [1, 0, 1] };
export const DEFAULTS = { task: "hover", aircraft: "paper", left: "", right: "geometric", seed: 0, at: 0, events: [] };

export function toFragment({ task, aircraft, left, right, seed, at, events }) {
  const parts = { task, aircraft, left, right, seed, at };
  const text = Object.entries(parts).map(([name, value]) => `${name}=${encodeURIComponent(value)}`);
  const listed = events.map(({ step, kind, values }) => `${kind}@${step}:${values.join(",")}`);
  return `#${[...text, ...(listed.length ? [`events=${listed.join(";")}`] : [])].join("&")}`;
}

// What cannot be read is left as it is by default.
export function fromFragment(fragment, book) {
  const found = new URLSearchParams(fragment.replace(/^#/, ""));
  const settings = { ...DEFAULTS, events: [] };
  for (const [name, known] of [["task", book.tasks], ["aircraft", book.vehicles]]) {
    if (Object.hasOwn(known, found.get(name))) settings[name] = found.get(name);
  }
  for (const side of ["left", "right"]) settings[side] = found.get(side) ?? settings[side];
  for (const [name, largest] of [["seed", Number.MAX_SAFE_INTEGER], ["at", 20000]]) {
    const number = Number(found.get(name));
    if (Number.isInteger(number) && number >= 0) settings[name] = Math.min(number, largest);
  }
  for (const [, kind, step, list] of (found.get("events") ?? "").matchAll(/(task|push|wind|rotor|payload)@(\d+):([-\d.,e]+)/g)) {
    const values = list.split(",").map(Number), [count, least, most] = KINDS[kind];
    if (values.length === count && values.every((x) => least <= x && x <= most)) {
      settings.events.push({ step: Number(step), kind, values });
    }
  }
  return settings;
}

// Names of the parts of a link that were not understood: settings do not say what they say.
export function unread(fragment, settings) {
  const understood = new URLSearchParams(toFragment(settings).slice(1));
  const parts = [...new URLSearchParams(fragment.replace(/^#/, ""))];
  return parts.filter(([name, value]) => understood.get(name) !== value).map(([name]) => name);
}

// As a link writes it, so that what is flown now and what the link shows are the same numbers.
export function rounded(values) {
  return values.map((x) => Number(x.toFixed(DIGITS)));
}
