// Plate (a): the photo with everybody's joints over it.

import { bonesOf, prepared, sideOf } from "./figure.js";

// Over photos of any brightness, in light and dark alike: vivid, with a dark outline.
const COLOURS = { right: "#ff7a33", left: "#4aa8ff", middle: "#f4f1ea" };
const OUTLINE = "rgb(12 11 9 / 0.75)";
const REACH = 16;

export class PhotoView {
  #canvas;
  #bitmap = null;
  #answer = null;
  #selected = 0;
  #lit = -1;

  /**
   * @param {HTMLCanvasElement} canvas
   * @param {{onPerson: (index: number) => void, onJoint: (index: number) => void}} events a person
   *   was picked; the pointer is at a joint of the selected one (-1: at none)
   */
  constructor(canvas, { onPerson, onJoint }) {
    this.#canvas = canvas;
    canvas.addEventListener("click", (event) => {
      const person = this.#personAt(this.#imagePoint(event));
      if (person >= 0) onPerson(person);
    });
    canvas.addEventListener("pointermove", (event) => onJoint(this.#jointAt(this.#imagePoint(event))));
    canvas.addEventListener("pointerleave", () => onJoint(-1));
    new ResizeObserver(() => this.#fit()).observe(canvas.parentElement);
  }

  /** Show a photo; null: the browser cannot decode it. */
  show(bitmap) {
    this.#bitmap?.close();
    this.#bitmap = bitmap;
    this.#answer = null;
    this.#canvas.hidden = bitmap === null;
    this.#fit();
  }

  /** Draw the people of `answer`; the selected one stands out. Without the photo, they alone. */
  overlay(answer, selected) {
    this.#answer = answer;
    this.#selected = selected;
    this.#canvas.hidden = !this.#bitmap && !answer;
    if (this.#bitmap) this.#draw();
    else this.#fit();
  }

  /** Point out joint `index` of the selected person; -1 for none. */
  light(index) {
    if (index === this.#lit) return;
    this.#lit = index;
    this.#draw();
  }

  #size() {
    // The answer's size where there is one: all its pixels are of that image.
    const image = this.#answer?.image;
    return image ? [image.width_px, image.height_px] : [this.#bitmap.width, this.#bitmap.height];
  }

  #fit() {
    if (!this.#bitmap && !this.#answer) return;
    const { clientWidth, clientHeight } = this.#canvas.parentElement;
    const [width, height] = this.#size();
    const scale = Math.min(clientWidth / width, clientHeight / height);
    this.#canvas.style.width = `${Math.floor(scale * width)}px`;
    this.#canvas.style.height = `${Math.floor(scale * height)}px`;
    this.#draw();
  }

  #draw() {
    const ready = (this.#bitmap || this.#answer) && prepared(this.#canvas);
    if (!ready) return;
    const { context, width, height } = ready;
    if (this.#bitmap) context.drawImage(this.#bitmap, 0, 0, width, height);
    if (!this.#answer) return;
    const others = this.#answer.people.map((_, index) => index).filter((index) => index !== this.#selected);
    for (const index of [...others, this.#selected]) {
      if (this.#answer.people[index]) this.#drawPerson(context, width, index);
    }
  }

  #drawPerson(context, width, index) {
    const person = this.#answer.people[index];
    const scale = width / this.#answer.image.width_px;
    const isSelected = index === this.#selected;
    const names = this.#answer.skeleton.joint_names;
    const byName = new Map(person.joints_2d.map((joint) => [joint.name, joint]));
    const joints = names.map((name) => byName.get(name));
    // Pixel centres are at whole numbers in the answer, at halves on a canvas.
    const at = (joint) => [scale * (joint.x_px + 0.5), scale * (joint.y_px + 0.5)];
    const sure = (...some) => some.every((joint) => joint.confidence === null || joint.confidence >= 0.5);
    const thickness = Math.max(2, Math.min(5, (scale * person.box_px[3]) / 70));

    for (const [a, b] of bonesOf(this.#answer.skeleton)) {
      if (!joints[a] || !joints[b]) continue;
      context.globalAlpha = (isSelected ? 1 : 0.55) * (sure(joints[a], joints[b]) ? 1 : 0.4);
      context.beginPath();
      context.moveTo(...at(joints[a]));
      context.lineTo(...at(joints[b]));
      for (const [colour, extra] of [[OUTLINE, 2], [COLOURS[sideOf(names[b])], 0]]) {
        context.strokeStyle = colour;
        context.lineWidth = thickness + extra;
        context.stroke();
      }
    }
    joints.forEach((joint, number) => {
      if (!joint) return;
      const isLit = isSelected && number === this.#lit;
      context.globalAlpha = isSelected ? 1 : 0.55;
      context.beginPath();
      context.arc(...at(joint), isLit ? thickness + 3 : thickness, 0, 2 * Math.PI);
      context.fillStyle = sure(joint) ? COLOURS[sideOf(names[number])] : OUTLINE;
      context.strokeStyle = sure(joint) ? OUTLINE : COLOURS[sideOf(names[number])];
      context.lineWidth = 1.5;
      context.fill();
      context.stroke();
      if (isLit && joint.sigma_px !== null) {
        context.beginPath();
        context.arc(...at(joint), scale * joint.sigma_px, 0, 2 * Math.PI);
        context.strokeStyle = "#fff";
        context.stroke();
      }
    });
    if (isSelected && this.#answer.people.length > 1) {
      const [x, y, w, h] = person.box_px.map((value) => scale * value);
      context.globalAlpha = 0.9;
      context.strokeStyle = "#fff";
      context.lineWidth = 1.5;
      context.setLineDash([5, 4]);
      context.strokeRect(x, y, w, h);
      context.setLineDash([]);
    }
    context.globalAlpha = 1;
  }

  #imagePoint(event) {
    const box = this.#canvas.getBoundingClientRect();
    const scale = this.#answer ? this.#answer.image.width_px / box.width : 1;
    return { x: scale * (event.clientX - box.left) - 0.5, y: scale * (event.clientY - box.top) - 0.5, reach: REACH * scale };
  }

  #personAt({ x, y, reach }) {
    let found = -1;
    let least = Infinity;
    this.#answer?.people.forEach((person, index) => {
      const [left, top, width, height] = person.box_px;
      const isInside = x > left - reach && x < left + width + reach && y > top - reach && y < top + height + reach;
      const distance = Math.min(...person.joints_2d.map((joint) => Math.hypot(joint.x_px - x, joint.y_px - y)));
      if (isInside && distance < least) [found, least] = [index, distance];
    });
    return found;
  }

  #jointAt({ x, y, reach }) {
    const person = this.#answer?.people[this.#selected];
    let found = -1;
    let least = reach;
    person?.joints_2d.forEach((joint) => {
      const distance = Math.hypot(joint.x_px - x, joint.y_px - y);
      if (distance < least) [found, least] = [this.#answer.skeleton.joint_names.indexOf(joint.name), distance];
    });
    return found;
  }
}
