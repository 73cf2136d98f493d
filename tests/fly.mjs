// What tests/slow/test_web.py runs in node: the JavaScript of docs/fly, without what draws.
//     node tests/fly.mjs BOOK < JOBS > RESULTS
// Jobs and results are JSON lists; numbers keep every digit.

import { readFileSync } from "node:fs";
import { Episode } from "../docs/fly/episode.mjs";
import { Flight, Kernel } from "../docs/fly/flight.mjs";
import { fromFragment, toFragment, unread } from "../docs/fly/link.mjs";
import { Policy } from "../docs/fly/policy.mjs";

const book = JSON.parse(readFileSync(process.argv[2]));
const kernel = await Kernel.load(Buffer.from(book.wasm, "base64"), book);

function policy(name) {
  const bytes = Uint8Array.from(Buffer.from(book.policies[name].file, "base64"));
  return new Policy(bytes.buffer, book.policy);
}

const coordinates = ({ qpos, qvel, act, vehicle }) => [...qpos, ...qvel, ...act.subarray(0, vehicle.rotors)];

function place(flight, start) {
  flight.qpos.set(start.slice(0, 7));
  flight.qvel.set(start.slice(7, 13));
  flight.act.set(start.slice(13));
}

const jobs = {
  // The start of an episode: coordinates and observation.
  begin({ task, aircraft, seed, episode }) {
    const flight = new Flight(kernel, 0, task, aircraft);
    flight.begin(seed, episode);
    return { coordinates: coordinates(flight), observation: [...Float32Array.from(flight.seen())] };
  },

  // Physics steps with commands to the rotors, from an episode's start.
  physics({ task, aircraft, seed, start, wind, commands }) {
    const flight = new Flight(kernel, 0, task, aircraft);
    flight.begin(seed);
    place(flight, start);
    flight.wind.set(wind);
    return commands.map((command) => {
      flight.ctrl.set(command);
      flight.advance();
      return coordinates(flight);
    });
  },

  // The actions of a policy.
  act: ({ name, observations }) => observations.map((each) => [...policy(name).act(Float32Array.from(each))]),

  // A flight as the page flies it, control step by control step; perhaps from another start.
  fly({ settings, controller, steps, events, start }) {
    const episode = new Episode(kernel, 1, settings, controller && policy(controller), events);
    const { flight } = episode, flown = [];
    if (start) {
      place(flight, start);
      flight.first();
    }
    while (flown.length < steps && !episode.outcome) {
      const shown = Float32Array.from(flight.seen());
      do episode.tick();
      while (!episode.outcome && episode.ticks % flight.vehicle.substeps);
      const { error, terminated, truncated, succeeded, wind, goal } = flight, action = [...flight.action.subarray(0, flight.vehicle.rotors)];
      flown.push({ observation: [...(episode.saw ?? shown)], action, coordinates: coordinates(flight), error, reward: flight.given[1], terminated, truncated, succeeded, wind: [...wind.subarray(0, 3)], goal: [...goal] });
    }
    return { flown, outcome: episode.outcome };
  },

  // What is wrong with a file that somebody drops.
  read({ file, task, aircraft }) {
    try {
      return new Policy(Uint8Array.from(Buffer.from(file, "base64")).buffer, book.policy).unfit(book, task, aircraft);
    } catch (error) {
      return error.message;
    }
  },

  // Settings through a link and back.
  link: ({ settings }) => fromFragment(toFragment(settings), book),
  open: ({ fragment }) => fromFragment(fragment, book),
  unread: ({ fragment }) => unread(fragment, fromFragment(fragment, book)),
};

const asked = JSON.parse(readFileSync(0));
process.stdout.write(JSON.stringify(asked.map(({ job, ...rest }) => jobs[job](rest))));
