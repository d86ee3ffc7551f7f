// Plate (b): the people in 3D, with the photo's camera, the exemplar and the uncertainty.
//
// Everything is built in the answer's frame (camera frame, mm, x right, y down, z forward) inside a
// group that turns it over (y up) and into metres. Drawn only when something changes.

import * as THREE from "../vendor/three/three.module.min.js";
import { OrbitControls } from "../vendor/three/OrbitControls.js";
import { bonesOf, palette, sideOf } from "./figure.js";
import { cameraFrustum, ground, sightLines, textureOf } from "./scenery.js";

const FOV = 32;
const LIMB_MM = 21;
const GHOST_MM = 13;
const STEP = THREE.MathUtils.degToRad(6);
/** Azimuth (from the photo's camera to its right) and elevation in degrees. */
const VIEWS = { quarter: [38, 14], side: [90, 4], above: [20, 68] };

export class Stage {
  selected = 0;
  #canvas;
  #onView;
  #renderer;
  #camera = new THREE.PerspectiveCamera(FOV, 1, 0.02, 200);
  #controls;
  #scene = new THREE.Scene();
  #world = new THREE.Group();
  #shown;
  #answer = null;
  #texture = null;
  #candidate = 0;
  #lit = -1;
  #joints = [];
  #ground = null;
  #preset = "quarter";
  #frame = 0;
  #flight = 0;

  /**
   * @param {HTMLCanvasElement} canvas
   * @param {{shown: {camera: boolean, exemplar: boolean, sigma: boolean},
   *   onView: (azimuth: number, elevation: number, preset: string) => void,
   *   onJoint: (index: number) => void}} setup
   * @throws when the browser has no WebGL
   */
  constructor(canvas, { shown, onView, onJoint }) {
    this.#canvas = canvas;
    this.#shown = shown;
    this.#onView = onView;
    this.#renderer = new THREE.WebGLRenderer({ canvas, antialias: true, alpha: true });
    this.#world.rotation.x = Math.PI;
    this.#world.scale.setScalar(0.001);
    const sun = new THREE.DirectionalLight(0xffffff, 1.7);
    sun.position.set(-1.5, 4, 2.5);
    this.#scene.add(this.#world, sun, new THREE.HemisphereLight(0xffffff, 0xa8a29a, 1.9));
    this.#controls = this.#makeControls();
    canvas.addEventListener("keydown", (event) => this.#onKey(event));
    canvas.addEventListener("pointermove", (event) => event.buttons || onJoint(this.#jointAt(event)));
    canvas.addEventListener("pointerleave", () => onJoint(-1));
    new ResizeObserver(() => this.#resize()).observe(canvas.parentElement);
    this.#rebuild();
    this.#resize();
  }

  /** Show everybody of an answer (null: nobody), seen by a camera that took `bitmap`. */
  show(answer, selected, bitmap) {
    this.#answer = answer;
    this.selected = selected;
    this.#candidate = 0;
    this.#texture?.dispose();
    this.#texture = bitmap && textureOf(bitmap);
    this.#rebuild();
    this.view(this.#preset === "own" ? "quarter" : this.#preset, false);
  }

  /** Put another person in front. */
  select(index) {
    this.selected = index;
    this.#candidate = 0;
    this.#rebuild();
  }

  /** Change what is shown: camera, exemplar, sigma (booleans), candidate (which exemplar). */
  set({ candidate = this.#candidate, ...shown }) {
    this.#candidate = candidate;
    Object.assign(this.#shown, shown);
    this.#rebuild();
  }

  /** Point out a joint of the selected person; -1 for none. */
  light(index) {
    if (index === this.#lit) return;
    this.#lit = index;
    this.#rebuild();
  }

  /** Take the colours from the style sheet again. */
  recolour() {
    this.#rebuild();
  }

  /** Look from one of VIEWS, or as the photo's camera does ("photo"). */
  view(name, smoothly = true) {
    const goal = name === "photo" && this.#person() ? this.#photoGoal() : this.#fittingGoal(name);
    this.#fly(goal, smoothly && !matchMedia("(prefers-reduced-motion: reduce)").matches, name);
  }

  #person() {
    const person = this.#answer?.people[this.selected];
    return person?.joints_3d ? person : null;
  }

  #makeControls() {
    const controls = new OrbitControls(this.#camera, this.#canvas);
    // One finger up and down scrolls the page, as everywhere else on it.
    this.#canvas.style.touchAction = "pan-y";
    controls.enableZoom = false;
    this.#canvas.addEventListener("pointerdown", () => this.#canvas.focus({ preventScroll: true }));
    this.#canvas.addEventListener("focus", () => (controls.enableZoom = true));
    this.#canvas.addEventListener("blur", () => (controls.enableZoom = false));
    controls.addEventListener("start", () => {
      this.#flight = 0;
      this.#preset = "own";
    });
    controls.addEventListener("change", () => this.#draw());
    return controls;
  }

  // --- what is there -----------------------------------------------------------------------

  #rebuild() {
    for (const child of [...this.#world.children]) {
      this.#world.remove(child);
      child.traverse((part) => {
        part.geometry?.dispose();
        part.material?.dispose();
      });
    }
    const colours = palette();
    const people = (this.#answer?.people ?? []).filter((person) => person.joints_3d);
    const poses = people.map((person) => person.joints_3d.map(({ x_mm, y_mm, z_mm }) => [x_mm, y_mm, z_mm]));
    this.#joints = [];
    this.#ground = ground(poses, colours, this.#answer ? bonesOf(this.#answer.skeleton) : []);
    this.#world.add(this.#ground);
    people.forEach((person, index) => {
      const isSelected = person === this.#person();
      const opacity = isSelected ? 1 : 0.35;
      const group = this.#figure(poses[index], colours, { radius: LIMB_MM, opacity });
      this.#world.add(group);
      if (isSelected) {
        this.#joints = poses[index];
        this.#addExtras(person, poses[index], colours);
      }
    });
    this.#draw();
  }

  #addExtras(person, pose, colours) {
    if (this.#shown.camera) {
      this.#world.add(cameraFrustum(this.#answer.image, person.camera, pose, this.#texture, colours));
      this.#world.add(sightLines(pose, colours));
    }
    if (this.#shown.exemplar) {
      const exemplar = person.candidates[this.#candidate]?.joints_mm ?? person.exemplar.joints_mm;
      this.#world.add(this.#figure(exemplar, colours, { radius: GHOST_MM, opacity: 0.5, ghost: true }));
    }
    person.joints_3d.forEach(({ name, sigma_mm }, index) => {
      const isLit = index === this.#lit;
      const colour = colours[sideOf(name)];
      if (isLit) this.#world.add(ball(pose[index], 2.2 * LIMB_MM, paint(colour, 1)));
      if ((isLit || this.#shown.sigma) && sigma_mm !== null) {
        this.#world.add(ball(pose[index], sigma_mm, paint(colour, isLit ? 0.25 : 0.13)));
      }
    });
  }

  /** Bones and joints of one pose. */
  #figure(pose, colours, { radius, opacity, ghost = false }) {
    const names = this.#answer.skeleton.joint_names;
    const group = new THREE.Group();
    const colourOf = (index) => (ghost ? colours.ghost : colours[sideOf(names[index])]);
    for (const [a, b] of bonesOf(this.#answer.skeleton)) {
      group.add(rod(pose[a], pose[b], radius, paint(colourOf(b), opacity)));
    }
    pose.forEach((point, index) => {
      const isHead = names[index] === "head_top";
      group.add(ball(point, (isHead ? 1.9 : 1.35) * radius, paint(colourOf(index), opacity)));
    });
    return group;
  }

  // --- where it is seen from ---------------------------------------------------------------

  #worldPoints() {
    const points = (this.#answer?.people ?? []).flatMap((person) => person.joints_3d ?? []);
    const world = points.map(({ x_mm, y_mm, z_mm }) => inWorld([x_mm, y_mm, z_mm]));
    if (world.length === 0) return [[-0.9, -1, -3], [0.9, 0.9, -3], [0, 0, -2.4]].map((p) => new THREE.Vector3(...p));
    return world;
  }

  /** Camera, target and field of view that show all of the people, and their camera if it is on. */
  #fittingGoal(name) {
    const [azimuth, elevation] = (VIEWS[name] ?? VIEWS.quarter).map(THREE.MathUtils.degToRad);
    const back = new THREE.Vector3(
      Math.sin(azimuth) * Math.cos(elevation),
      Math.sin(elevation),
      Math.cos(azimuth) * Math.cos(elevation),
    );
    const right = new THREE.Vector3(0, 1, 0).cross(back).normalize();
    const up = back.clone().cross(right);
    const people = this.#worldPoints();
    const centre = new THREE.Box3().setFromPoints(people).getCenter(new THREE.Vector3());
    const points = [...people];
    if (this.#shown.camera && this.#person() && centre.length() < 6) points.push(new THREE.Vector3());
    const along = (axis) => points.map((point) => point.dot(axis));
    const [u, v, w] = [right, up, back].map(along);
    const middle = (values) => (Math.min(...values) + Math.max(...values)) / 2;
    const [uc, vc, wc] = [middle(u), middle(v), centre.dot(back)];
    const slope = 0.86 * Math.tan(THREE.MathUtils.degToRad(FOV / 2));
    const reach = Math.max(
      ...points.map((_, i) =>
        Math.max(w[i] + Math.abs(v[i] - vc) / slope, w[i] + Math.abs(u[i] - uc) / (slope * this.#camera.aspect)),
      ),
    );
    const target = new THREE.Vector3()
      .addScaledVector(right, uc)
      .addScaledVector(up, vc)
      .addScaledVector(back, wc);
    return { position: target.clone().addScaledVector(back, reach - wc), target, fov: FOV };
  }

  #photoGoal() {
    const { width_px, height_px } = this.#answer.image;
    const focal = this.#person().camera.focal_length_px;
    const slope = Math.max(height_px, width_px / this.#camera.aspect) / (2 * focal);
    const depth = this.#person().root_mm[2] / 1000;
    return {
      position: new THREE.Vector3(0, 0, 0),
      target: new THREE.Vector3(0, 0, -depth),
      fov: 2 * THREE.MathUtils.radToDeg(Math.atan(slope)),
    };
  }

  #fly(goal, smoothly, preset) {
    this.#preset = preset;
    const from = {
      position: this.#camera.position.clone(),
      target: this.#controls.target.clone(),
      fov: this.#camera.fov,
    };
    const flight = ++this.#frame;
    this.#flight = flight;
    const started = performance.now();
    const step = (now) => {
      if (this.#flight !== flight) return;
      const linear = smoothly ? Math.min(Math.max((now - started) / 500, 0), 1) : 1;
      const t = linear * linear * (3 - 2 * linear);
      this.#camera.position.lerpVectors(from.position, goal.position, t);
      this.#controls.target.lerpVectors(from.target, goal.target, t);
      this.#camera.fov = THREE.MathUtils.lerp(from.fov, goal.fov, t);
      this.#camera.updateProjectionMatrix();
      this.#controls.update();
      this.#draw();
      if (linear < 1) requestAnimationFrame(step);
    };
    step(started);
  }

  #onKey(event) {
    const turns = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
    const zoom = { "+": 1 / 1.15, "=": 1 / 1.15, "-": 1.15 }[event.key];
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.key === "0" || event.key === "Home") {
      this.view("quarter");
    } else if (turns || zoom) {
      const arm = new THREE.Spherical().setFromVector3(this.#camera.position.clone().sub(this.#controls.target));
      arm.theta += STEP * (turns?.[0] ?? 0);
      arm.phi -= STEP * (turns?.[1] ?? 0);
      arm.radius *= zoom ?? 1;
      arm.makeSafe();
      this.#flight = 0;
      this.#preset = "own";
      this.#camera.position.setFromSpherical(arm).add(this.#controls.target);
      this.#controls.update();
      this.#draw();
    } else {
      return;
    }
    event.preventDefault();
  }

  #jointAt(event) {
    const box = this.#canvas.getBoundingClientRect();
    let found = -1;
    let least = 16;
    this.#joints.forEach((point, index) => {
      const seen = inWorld(point).project(this.#camera);
      const x = ((seen.x + 1) / 2) * box.width + box.left;
      const y = ((1 - seen.y) / 2) * box.height + box.top;
      const distance = Math.hypot(x - event.clientX, y - event.clientY);
      if (distance < least) [found, least] = [index, distance];
    });
    return found;
  }

  // --- drawing -----------------------------------------------------------------------------

  #resize() {
    const { clientWidth: width, clientHeight: height } = this.#canvas.parentElement;
    if (!width || !height) return;
    this.#renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.#renderer.setSize(width, height, false);
    this.#camera.aspect = width / height;
    this.#camera.updateProjectionMatrix();
    if (this.#preset === "own") this.#draw();
    else this.view(this.#preset, false);
  }

  #pending = false;

  #draw() {
    if (this.#pending) return;
    this.#pending = true;
    requestAnimationFrame(() => {
      this.#pending = false;
      // Through the photo's camera the photo has a ground of its own.
      this.#ground.visible = this.#preset !== "photo" || !this.#person();
      this.#renderer.render(this.#scene, this.#camera);
      const arm = this.#camera.position.clone().sub(this.#controls.target);
      const azimuth = THREE.MathUtils.radToDeg(Math.atan2(arm.x, arm.z));
      const elevation = THREE.MathUtils.radToDeg(Math.atan2(arm.y, Math.hypot(arm.x, arm.z)));
      this.#onView(azimuth, elevation, this.#preset);
    });
  }
}

/** From the answer's frame (mm) to the scene's (metres, y up). */
function inWorld([x, y, z]) {
  return new THREE.Vector3(x, -y, -z).multiplyScalar(0.001);
}

function paint(colour, opacity) {
  const isClear = opacity < 1;
  return new THREE.MeshLambertMaterial({ color: colour, opacity, transparent: isClear, depthWrite: !isClear });
}

function ball(centre, radius, material) {
  const mesh = new THREE.Mesh(new THREE.SphereGeometry(radius, 24, 16), material);
  mesh.position.set(...centre);
  return mesh;
}

/** A cylinder from `a` to `b`. */
function rod(a, b, radius, material) {
  const from = new THREE.Vector3(...a);
  const along = new THREE.Vector3(...b).sub(from);
  const mesh = new THREE.Mesh(new THREE.CylinderGeometry(radius, radius, along.length(), 12), material);
  mesh.position.copy(from).addScaledVector(along, 0.5);
  mesh.quaternion.setFromUnitVectors(new THREE.Vector3(0, 1, 0), along.normalize());
  return mesh;
}
