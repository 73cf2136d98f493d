// The world as three.js draws it: two views of one scene, each with an aircraft of its own.

import * as THREE from "three";
import { decoded } from "./flight.mjs";

const UP = new THREE.Vector3(0, 0, 1);
const SKY_TOP = 0x070b12, HAZE = 0x2a4560, GROUND = 0x131c27, LINES = 0x5f7f9d;
const TRAIL_LENGTH = 600; // physics steps
const BLUR = 0.12; // of the real rotor speed, so that the blades are seen to turn
const FOV = 42; // [deg]

const VERTEX = `
varying vec3 place;
void main() {
  vec4 at = modelMatrix * vec4(position, 1.0);
  place = at.xyz;
  gl_Position = projectionMatrix * viewMatrix * at;
}`;
const GRID = `
varying vec3 place; uniform vec3 ground, lines, haze; uniform vec2 centre;
float line(vec2 at, float width) {
  vec2 near = abs(fract(at - 0.5) - 0.5) / fwidth(at);
  return 1.0 - min(min(near.x, near.y) / width, 1.0);
}
void main() {
  float far = length(place.xy - centre);
  float mark = 0.30 * line(place.xy, 1.4) * exp(-far / 9.0);
  mark += 0.55 * line(place.xy / 5.0, 1.6) * exp(-far / 20.0);
  vec3 colour = mix(ground * (1.0 + 1.2 * exp(-far / 5.0)), lines, mark);
  gl_FragColor = vec4(mix(colour, haze, smoothstep(6.0, 70.0, far)), 1.0);
  #include <colorspace_fragment>
}`;
const SKY = `
varying vec3 place; uniform vec3 top, haze;
void main() {
  float height = normalize(place - cameraPosition).z;
  gl_FragColor = vec4(mix(haze, top, smoothstep(0.0, 0.45, height)), 1.0);
  #include <colorspace_fragment>
}`;

function shaded(fragmentShader, colours, more = {}) {
  const uniforms = { ...more };
  for (const [name, hex] of Object.entries(colours)) uniforms[name] = { value: new THREE.Color(hex) };
  return new THREE.ShaderMaterial({ vertexShader: VERTEX, fragmentShader, uniforms });
}

function geometry({ kind, size: [x, y, z], mesh }, meshes) {
  if (kind === "box") return new THREE.BoxGeometry(2 * x, 2 * y, 2 * z);
  if (kind === "sphere") return new THREE.SphereGeometry(x, 20, 14);
  if (kind === "ellipsoid") return new THREE.SphereGeometry(1, 20, 14).scale(x, y, z);
  if (kind === "cylinder") return new THREE.CylinderGeometry(x, x, 2 * y, 28).rotateX(Math.PI / 2);
  if (kind === "capsule") return new THREE.CapsuleGeometry(x, 2 * y, 4, 12).rotateX(Math.PI / 2);
  const made = new THREE.BufferGeometry();
  const vertices = new Float32Array(decoded(meshes[mesh].vertices).buffer);
  const faces = new Uint16Array(decoded(meshes[mesh].faces).buffer);
  made.setAttribute("position", new THREE.BufferAttribute(vertices, 3));
  made.setIndex(new THREE.BufferAttribute(faces, 1));
  const smooth = made.attributes.position.count > 100;
  const whole = smooth ? made : made.toNonIndexed();
  whole.computeVertexNormals();
  return whole;
}

// A material that needs no light, seen from both sides and through.
function flat(options) {
  const usual = { transparent: true, depthWrite: false, side: THREE.DoubleSide };
  return new THREE.MeshBasicMaterial({ ...usual, ...options });
}

function paint([red, green, blue]) {
  return new THREE.Color().setRGB(red, green, blue, THREE.SRGBColorSpace);
}

// Of (w, x, y, z).
function attitude([w, x, y, z]) {
  return new THREE.Quaternion(x, y, z, w);
}

// A shape of quadrl's list where it stands; lines are ribbons.
function solid(shape, meshes) {
  const color = paint(shape.rgba), opacity = shape.rgba[3], { shine, glow } = shape;
  const clear = { opacity, transparent: opacity < 1, depthWrite: opacity === 1 };
  const light = { emissive: color, emissiveIntensity: 0.9 * glow };
  const material = glow === 1
    ? flat({ color, ...clear, side: THREE.FrontSide })
    : new THREE.MeshStandardMaterial({ color, ...clear, roughness: 0.95 - 0.6 * shine, metalness: 0.1, ...light });
  const mesh = new THREE.Mesh(geometry(shape, meshes), material);
  mesh.position.fromArray(shape.position);
  if (shape.quaternion) mesh.quaternion.copy(attitude(shape.quaternion));
  else mesh.quaternion.setFromRotationMatrix(turned(shape.turn));
  return mesh;
}

// Of a rotation matrix, row by row.
function turned([a, b, c, d, e, f, g, h, i]) {
  return new THREE.Matrix4().set(a, b, c, 0, d, e, f, 0, g, h, i, 0, 0, 0, 0, 1);
}

// A disc as it looks while it turns: clear at the hub, brighter towards the tip.
const TURNING = [[0, 0.05], [0.3, 0.22], [0.8, 0.42], [0.94, 0.55], [1, 0]];
const SHADOW = [[0, 0.75], [0.35, 0.6], [0.7, 0.2], [1, 0]];

// A round texture, from shares of the radius and opacities.
function round(stops) {
  const canvas = document.createElement("canvas");
  canvas.width = canvas.height = 128;
  const context = canvas.getContext("2d");
  const fill = context.createRadialGradient(64, 64, 4, 64, 64, 63);
  for (const [at, alpha] of stops) fill.addColorStop(at, `rgba(255,255,255,${alpha})`);
  context.fillStyle = fill;
  context.fillRect(0, 0, 128, 128);
  return new THREE.CanvasTexture(canvas);
}

// A strip through points that faces the camera, wider and brighter towards its end; half as wide as it is told.
class Ribbon {
  constructor(length, colour, width, opacity) {
    this.length = length;
    this.width = width;
    this.positions = new Float32Array(6 * length);
    const alpha = new Float32Array(8 * length), index = [];
    const shade = new THREE.Color(colour);
    for (let k = 0; k < length; ++k) {
      for (const side of [0, 1]) alpha.set([shade.r, shade.g, shade.b, opacity], 8 * k + 4 * side);
      if (k) index.push(2 * k - 2, 2 * k - 1, 2 * k, 2 * k, 2 * k - 1, 2 * k + 1);
    }
    const made = new THREE.BufferGeometry();
    made.setAttribute("position", new THREE.BufferAttribute(this.positions, 3));
    made.setAttribute("color", new THREE.BufferAttribute(alpha, 4));
    made.setIndex(index);
    this.opacity = opacity;
    this.colours = alpha;
    this.mesh = new THREE.Mesh(made, flat({ vertexColors: true }));
    this.mesh.frustumCulled = false;
  }

  // points: flat x, y, z, from the oldest on; fades towards the oldest if told to.
  show(points, camera, fades = true) {
    const count = Math.min(points.length / 3, this.length), first = points.length / 3 - count;
    const [here, ahead, behind, across] = [1, 2, 3, 4].map(() => new THREE.Vector3());
    for (let k = 0; k < count; ++k) {
      const next = 3 * (first + Math.min(k + 1, count - 1)), last = 3 * (first + Math.max(k - 1, 0));
      here.fromArray(points, 3 * (first + k));
      ahead.fromArray(points, next).sub(behind.fromArray(points, last));
      const youth = fades ? k / Math.max(count - 1, 1) : 1;
      across.subVectors(camera.position, here).cross(ahead);
      across.setLength(this.width * (0.35 + 0.65 * youth));
      ahead.subVectors(here, across).toArray(this.positions, 6 * k);
      ahead.addVectors(here, across).toArray(this.positions, 6 * k + 3);
      this.colours[8 * k + 3] = this.colours[8 * k + 7] = this.opacity * youth;
    }
    this.mesh.geometry.attributes.position.needsUpdate = true;
    this.mesh.geometry.attributes.color.needsUpdate = true;
    this.mesh.geometry.setDrawRange(0, 6 * Math.max(count - 1, 0));
  }
}

// An aircraft, from what quadrl's own pictures draw of it.
class Aircraft {
  constructor(vehicle, disc) {
    this.group = new THREE.Group();
    this.rotors = Array.from({ length: vehicle.rotors }, () => ({ turning: new THREE.Group(), discs: [] }));
    for (const shape of vehicle.shapes) {
      const [, number, part] = /^rotor_(\d+)_(.*)$/.exec(shape.name) ?? [];
      const rotor = number && this.rotors[number - 1];
      const turns = part === "disc";
      const mesh = turns ? this.#disc(vehicle, number - 1, shape, disc) : solid(shape, vehicle.meshes);
      this.group.add(mesh);
      if (part === "hub") {
        rotor.turning.position.fromArray(shape.position);
        const axis = new THREE.Vector3(...vehicle.axis[number - 1]);
        rotor.base = new THREE.Quaternion().setFromUnitVectors(UP, axis);
        this.group.add(rotor.turning);
      }
      if (part?.startsWith("blade")) (rotor.blades ??= []).push(mesh);
    }
    for (const rotor of this.rotors) {
      rotor.turning.updateMatrixWorld();
      rotor.blades.forEach((blade) => rotor.turning.attach(blade));
      rotor.angle = 0;
    }
    this.vehicle = vehicle;
  }

  #disc(vehicle, k, { position, quaternion }, texture) {
    const radius = vehicle.radius[k], group = new THREE.Group();
    group.position.fromArray(position);
    group.quaternion.copy(attitude(quaternion));
    const colour = paint(vehicle.colour[k]), face = flat({ color: colour, map: texture });
    const rim = new THREE.TorusGeometry(0.98 * radius, 0.012 * radius, 6, 64);
    const edge = new THREE.MeshBasicMaterial({ color: colour, transparent: true, opacity: 0.75 });
    const disc = new THREE.CircleGeometry(radius, 48);
    group.add(new THREE.Mesh(disc, face), new THREE.Mesh(rim, edge));
    this.rotors[k].discs.push(face);
    return group;
  }

  // speeds [rad/s]; time since the last picture [s].
  turn(speeds, time) {
    this.rotors.forEach((rotor, k) => {
      rotor.angle += this.vehicle.spin[k] * BLUR * speeds[k] * time;
      const turn = new THREE.Quaternion().setFromAxisAngle(UP, rotor.angle);
      rotor.turning.quaternion.copy(rotor.base).multiply(turn);
      const opacity = Math.min(0.25 + 0.9 * (speeds[k] / this.vehicle.maxSpeed[k]), 1);
      for (const face of rotor.discs) face.opacity = opacity;
    });
  }
}

// One of the two views: its aircraft and what belongs to its flight.
class View {
  constructor(scene, layer, colour) {
    Object.assign(this, { scene, layer, colour });
    this.camera = new THREE.PerspectiveCamera(FOV, 1, 0.02, 400);
    this.camera.up.copy(UP);
    this.camera.layers.enable(layer);
    this.group = null;
    this.focus = new THREE.Vector3();
  }

  begin(vehicle, textures, trailWidth) {
    if (this.group) this.scene.remove(this.group);
    this.group = new THREE.Group();
    this.aircraft = new Aircraft(vehicle, textures.disc);
    const { wide, goal } = vehicle, goalColour = paint(goal[0].rgba);
    this.trail = new Ribbon(TRAIL_LENGTH, this.colour, trailWidth * wide, 0.9);
    this.path = new Ribbon(TRAIL_LENGTH, goalColour, 0.5 * trailWidth * wide, 0.45);
    this.drop = new Ribbon(2, this.colour, 0.3 * trailWidth * wide, 0.35);
    this.goal = goal.map((shape) => {
      const { kind, points, size, rgba } = shape;
      if (kind !== "line") return { shape, mesh: solid(shape) };
      const ribbon = new Ribbon(points.length, paint(rgba), size, rgba[3]);
      return { shape, ribbon, mesh: ribbon.mesh };
    });
    const below = new THREE.CircleGeometry(1.5 * vehicle.size, 40);
    this.shadow = new THREE.Mesh(below, flat({ color: 0x000000, map: textures.shadow }));
    this.beams = new THREE.LineSegments(new THREE.BufferGeometry(), flat({ vertexColors: true }));
    this.beams.frustumCulled = false;
    const meshes = [this.trail, this.path, this.drop, ...this.goal].map(({ mesh }) => mesh).concat(this.beams);
    this.group.add(this.aircraft.group, this.shadow, ...meshes);
    this.group.traverse((object) => object.layers.set(this.layer));
    this.scene.add(this.group);
    this.points = [];
    this.goals = [];
    this.fresh = true;
  }

  // Remembers where aircraft and goal were after a physics step.
  remember(position, goal) {
    for (const [list, place] of [[this.points, position], [this.goals, goal]]) {
      list.push(...place);
      if (list.length > 3 * TRAIL_LENGTH) list.splice(0, 3);
    }
  }

  // Lines to what rays meet, brighter where it is near.
  #look(from, beams) {
    const shade = new THREE.Color(this.colour), geometry = this.beams.geometry;
    const colours = beams.flatMap(({ near }) => [0.15 * near, near].flatMap((alpha) => [shade.r, shade.g, shade.b, 0.8 * alpha]));
    geometry.setAttribute("position", new THREE.Float32BufferAttribute(beams.flatMap(({ to }) => [...from, ...to]), 3));
    geometry.setAttribute("color", new THREE.Float32BufferAttribute(colours, 4));
  }

  // pose: position (3), quaternion (w, x, y, z), rotor speeds; beams: where rays end, and how near
  // that is; orbit: azimuth, elevation, distance.
  show({ pose, goal, beams }, orbit, time) {
    const { position, quaternion, speeds } = pose;
    this.aircraft.group.position.fromArray(position);
    this.aircraft.group.quaternion.copy(attitude(quaternion)).normalize();
    this.aircraft.turn(speeds, time);
    this.#look(position, beams);
    this.shadow.position.set(position[0], position[1], 0.002);
    this.shadow.scale.setScalar(1 + 0.15 * position[2]);
    // Looks at the aircraft, and a little towards its goal.
    const away = Math.hypot(...position.map((x, k) => goal[k] - x));
    const near = Math.min(0.45, (0.2 * orbit.distance) / Math.max(away, 1e-9));
    const target = new THREE.Vector3(...position.map((x, k) => x + near * (goal[k] - x)));
    this.focus.lerp(target, this.fresh ? 1 : 1 - Math.exp(-6 * time));
    this.fresh = false;
    const { distance, elevation, azimuth } = orbit;
    const from = new THREE.Vector3().setFromSphericalCoords(distance, Math.PI / 2 - elevation, 0);
    from.set(from.z * Math.cos(azimuth), from.z * Math.sin(azimuth), from.y);
    this.camera.position.addVectors(this.focus, from);
    this.camera.position.z = Math.max(this.camera.position.z, 0.05);
    this.camera.lookAt(this.focus);
    this.trail.show([...this.points, ...position], this.camera);
    this.path.show(this.goals, this.camera);
    this.drop.show([...position, position[0], position[1], 0], this.camera, false);
    // It is listed for a goal a metre above the ground.
    const placed = ([x, y, z]) => [goal[0] + x, goal[1] + y, goal[2] * z];
    for (const { shape, mesh, ribbon } of this.goal) {
      if (ribbon) ribbon.show(shape.points.flatMap(placed), this.camera, false);
      else mesh.position.fromArray(placed(shape.position));
    }
  }
}

export class Stage {
  // canvas: what to draw on; panels: the two elements over it that say where the views are; drawn: of the book.
  constructor(canvas, panels, colours, drawn) {
    this.drawn = drawn;
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: true });
    this.renderer.setScissorTest(true);
    this.panels = panels;
    this.scene = new THREE.Scene();
    this.textures = { disc: round(TURNING), shadow: round(SHADOW) };
    this.centre = { value: new THREE.Vector2() };
    const grid = shaded(GRID, { ground: GROUND, lines: LINES, haze: HAZE }, { centre: this.centre });
    const ground = new THREE.Mesh(new THREE.PlaneGeometry(600, 600), grid);
    const sky = shaded(SKY, { top: SKY_TOP, haze: HAZE });
    this.sky = new THREE.Mesh(new THREE.SphereGeometry(250, 32, 16), sky);
    this.sky.material.side = THREE.BackSide;
    const sun = new THREE.DirectionalLight(0xfff4e6, 2.6);
    const fill = new THREE.DirectionalLight(0x88b4ff, 0.9);
    sun.position.set(-4.2, -2.5, 5);
    fill.position.set(3, 4, 1);
    const hemisphere = new THREE.HemisphereLight(0xbcd7ff, 0x26303c, 1.3);
    this.streaks = this.#makeStreaks();
    this.obstacles = new THREE.Group();
    for (const object of [ground, this.obstacles, this.sky, sun, fill, hemisphere]) this.scene.add(object);
    for (const light of [sun, fill, hemisphere]) light.layers.enableAll();
    this.views = colours.map((colour, k) => new View(this.scene, k + 1, colour));
  }

  // scene: what stands in the world of the task.
  begin(vehicle, scene) {
    this.wide = vehicle.wide;
    this.obstacles.clear();
    for (const shape of scene.shapes) this.obstacles.add(solid(shape, scene.meshes));
    for (const view of this.views) view.begin(vehicle, this.textures, this.drawn.trailWidth);
  }

  #makeStreaks() {
    const made = new THREE.BufferGeometry(), { places, rgba } = this.drawn;
    const shade = paint(rgba), colours = places.flatMap(() => [0, 1].flatMap(() => [shade.r, shade.g, shade.b, 0]));
    this.drift = [0, 0, 0]; // [m], how far the air has come
    made.setAttribute("position", new THREE.BufferAttribute(new Float32Array(6 * places.length), 3));
    made.setAttribute("color", new THREE.BufferAttribute(new Float32Array(colours), 4));
    const lines = new THREE.LineSegments(made, flat({ vertexColors: true }));
    lines.frustumCulled = false;
    this.scene.add(lines);
    return lines;
  }

  // Streaks that blow with the wind [m/s] around a place; they fade towards the sides of their box and their tails.
  #blow(wind, place, time) {
    const { places, box, seconds, rgba } = this.drawn, wide = Math.sqrt(this.wide);
    const { position, color } = this.streaks.geometry.attributes;
    const strength = rgba[3] * Math.min(Math.hypot(...wind), 1);
    this.drift = this.drift.map((x, axis) => x + wind[axis] * time);
    places.forEach((from, k) => {
      const shares = from.map((x, axis) => {
        const share = x + (this.drift[axis] - place[axis]) / (box[axis] * wide);
        return share - Math.floor(share) - 0.5;
      });
      const head = shares.map((x, axis) => place[axis] + x * box[axis] * wide);
      position.setXYZ(2 * k, ...head.map((x, axis) => x - seconds * wide * wind[axis]));
      position.setXYZ(2 * k + 1, ...head);
      const near = shares.map((x) => Math.min(3 * (1 - Math.abs(2 * x)), 1));
      const opacity = strength * near[0] * near[1] * near[2];
      color.setW(2 * k, 0.25 * opacity);
      color.setW(2 * k + 1, opacity);
    });
    position.needsUpdate = color.needsUpdate = true;
  }

  // shown: for each view { pose, goal, wind, beams }; time since the last picture [s].
  draw(shown, orbit, time) {
    const canvas = this.renderer.domElement, whole = canvas.getBoundingClientRect();
    const ratio = Math.min(window.devicePixelRatio, 2);
    const size = `${whole.width} ${whole.height} ${ratio}`;
    if (this.size !== size) {
      this.size = size;
      this.renderer.setPixelRatio(ratio);
      this.renderer.setSize(whole.width, whole.height, false);
    }
    this.views.forEach((view, k) => {
      const box = this.panels[k].getBoundingClientRect();
      const corner = [box.left - whole.left, whole.bottom - box.bottom, box.width, box.height];
      view.camera.aspect = box.width / Math.max(box.height, 1);
      view.camera.updateProjectionMatrix();
      view.show(shown[k], orbit, time);
      this.centre.value.set(view.focus.x, view.focus.y);
      this.sky.position.copy(view.camera.position);
      this.#blow(shown[k].wind, view.focus.toArray(), k ? 0 : time);
      this.renderer.setViewport(...corner);
      this.renderer.setScissor(...corner);
      this.renderer.render(this.scene, view.camera);
    });
  }
}
