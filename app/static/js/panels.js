// What is below the plates: people, summary, warnings, candidates, joints, JSON and curl.

import { drawFromSide, sideOf, spoken } from "./figure.js";
import { sourceInWords, summaryOf, warningInWords } from "./words.js";

const $ = (id) => document.getElementById(id);

/** An element with properties and children. */
function make(tag, properties = {}, ...children) {
  const element = Object.assign(document.createElement(tag), properties);
  element.append(...children);
  return element;
}

/**
 * Buttons of which one is checked: arrow keys go through them, tab enters and leaves (ARIA's
 * radio group).
 *
 * @param {HTMLElement} group
 * @param {HTMLElement[]} buttons
 * @param {number} checked index, or -1
 * @param {(index: number) => void} onPick
 */
function fillRadioGroup(group, buttons, checked, onPick) {
  buttons.forEach((button, index) => {
    button.type = "button";
    button.setAttribute("role", "radio");
    button.addEventListener("click", () => onPick(index));
  });
  group.replaceChildren(...buttons);
  group.onkeydown = (event) => {
    const step = { ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1 }[event.key];
    if (!step || event.altKey || event.ctrlKey || event.metaKey) return;
    event.preventDefault();
    const now = buttons.indexOf(document.activeElement);
    const next = (now + step + buttons.length) % buttons.length;
    buttons[next].focus();
    onPick(next);
  };
  check(group, checked);
}

function check(group, checked) {
  [...group.children].forEach((button, index) => {
    button.setAttribute("aria-checked", String(index === checked));
    button.tabIndex = index === Math.max(checked, 0) ? 0 : -1;
  });
}

export class Panels {
  #events;

  /**
   * @param {{onPerson: (index: number) => void, onCandidate: (index: number) => void,
   *   onJoint: (index: number) => void}} events
   */
  constructor(events) {
    this.#events = events;
  }

  /** All of an answer, with one of its people. */
  showAnswer(answer, selected) {
    $("findings").hidden = answer === null;
    if (answer === null) return;
    $("json").textContent = readableJson(answer);
    const buttons = answer.people.map((person, index) => {
      const score = person.score === null ? "" : `, ${Math.round(100 * person.score)}%`;
      return make("button", { textContent: `Person ${index + 1}${score}` });
    });
    fillRadioGroup($("people"), buttons, selected, this.#events.onPerson);
    $("people").hidden = answer.people.length < 2;
    document.querySelector(".columns").hidden = answer.people.length === 0;
    if (answer.people.length === 0) {
      $("summary").textContent = "Nobody was found in this photo.";
      $("warnings").replaceChildren();
    } else {
      this.showPerson(answer, selected);
    }
  }

  /** One person of an answer. */
  showPerson(answer, selected) {
    const person = answer.people[selected];
    check($("people"), selected);
    $("summary").textContent = summaryOf(answer, person);
    $("warnings").replaceChildren(
      ...person.warnings.map((warning) => make("li", { textContent: warningInWords(warning, person) })),
    );
    this.#fillCandidates(answer, person);
    this.#fillJoints(answer, person);
  }

  /** Mark the candidate that is shown. */
  checkCandidate(person, index) {
    check($("candidates"), index);
    const candidate = person.candidates[index];
    $("candidate-caption").textContent = candidate
      ? sourceInWords(candidate, index === 0 ? person.exemplar.source : null)
      : "";
  }

  /** Mark the joint the pointer is at; -1 for none. */
  light(index) {
    const rows = document.querySelectorAll("#joints tbody tr");
    rows.forEach((row) => row.classList.toggle("lit", Number(row.dataset.joint) === index));
  }

  #fillCandidates(answer, person) {
    const canvases = [];
    const buttons = person.candidates.map((candidate, index) => {
      const canvas = make("canvas");
      canvases.push(() => drawFromSide(canvas, candidate.joints_mm, answer.skeleton));
      const share = `${(100 * candidate.probability).toFixed(1)}%`;
      const button = make("button", {}, canvas, share);
      button.setAttribute("aria-label", `Exemplar ${index + 1}, ${share}`);
      return button;
    });
    fillRadioGroup($("candidates"), buttons, 0, this.#events.onCandidate);
    this.checkCandidate(person, 0);
    this.redraw = () => canvases.forEach((draw) => draw());
    this.redraw();
  }

  /** Draw the candidates anew, after a change of size or colours. */
  redraw = () => {};

  #fillJoints(answer, person) {
    const deep = new Map(person.joints_3d?.map((joint) => [joint.name, joint]));
    const flat = new Map(person.joints_2d.map((joint) => [joint.name, joint]));
    const rows = answer.skeleton.joint_names.map((name, index) => {
      const { x_px, y_px, confidence } = flat.get(name) ?? {};
      const joint = deep.get(name);
      const certainty = make("td");
      if (confidence != null) {
        const percent = `${Math.round(100 * confidence)}%`;
        certainty.append(
          make("meter", { value: confidence, low: 0.5, high: 0.75, optimum: 1, ariaLabel: percent }),
          percent,
        );
      }
      const row = make(
        "tr",
        { className: sideOf(name) },
        make("th", { scope: "row", textContent: spoken(name) }),
        certainty,
        make("td", { textContent: x_px === undefined ? "" : `${x_px.toFixed(0)}, ${y_px.toFixed(0)}` }),
        make("td", {
          textContent: joint ? [joint.x_mm, joint.y_mm, joint.z_mm].map((mm) => mm.toFixed(0)).join(", ") : "",
        }),
        make("td", { textContent: joint?.sigma_mm == null ? "" : joint.sigma_mm.toFixed(0) }),
      );
      row.dataset.joint = index;
      row.addEventListener("pointerenter", () => this.#events.onJoint(index));
      row.addEventListener("pointerleave", () => this.#events.onJoint(-1));
      return row;
    });
    document.querySelector("#joints tbody").replaceChildren(...rows);
  }
}

/** Indented JSON whose lists of numbers, and objects of plain values, stay on one line. */
function readableJson(value, indent = "") {
  const plain = JSON.stringify(value);
  if (typeof value !== "object" || value === null || (plain.length <= 100 && isFlat(value))) {
    return plain.replaceAll(/,(?="|\[|\{|-?\d)/g, ", ");
  }
  const inner = `${indent}  `;
  const lines = Array.isArray(value)
    ? value.map((item) => inner + readableJson(item, inner))
    : Object.entries(value).map(([key, item]) => `${inner}${JSON.stringify(key)}: ${readableJson(item, inner)}`);
  const [open, close] = Array.isArray(value) ? "[]" : "{}";
  return lines.length ? `${open}\n${lines.join(",\n")}\n${indent}${close}` : open + close;
}

function isFlat(value) {
  return Object.values(value).every((item) => typeof item !== "object" || item === null || Array.isArray(item));
}
