// Everything the page says about answers and refusals, in words.

import { Refusal, Stopped } from "./api.js";
import { spoken } from "./figure.js";

const REFUSALS = {
  "empty-body": ["That file is empty.", "Choose another one."],
  "unsupported-image-type": ["That is no photo the service reads.", ""],
  "undecodable-image": ["The photo is damaged: its beginning is fine, the rest cannot be decoded.", "Save it anew or take another."],
  "body-too-large": ["The photo’s file is too large.", "Make it smaller; the joints do not need that much."],
  "too-many-pixels": ["The photo has too many pixels.", "Make it smaller; the joints do not need that many."],
  "invalid-input": ["One of the options makes no sense to the service.", ""],
  "upload-too-slow": ["The upload took too long.", "Try a smaller photo or a better connection."],
  unauthorized: ["This server wants an API key.", "Enter it under Options."],
  "quota-exceeded": ["This key has used up its requests for the moment.", "Try again in a little while."],
  overloaded: ["The server is at capacity.", "It was asked several times; try again in a little while."],
  "not-ready": ["The server is still starting.", "Try again in a few seconds."],
  "internal-error": ["Something broke in the server.", "Its log knows this request by the id below."],
};

/**
 * Why there is no answer, as {headline, advice, detail, id, mayPass}; `mayPass` when the same may
 * succeed a little later.
 *
 * @param {Error} error a Refusal, or what fetch throws
 * @param {boolean} canBeRead whether the photo's file can
 */
export function failureInWords(error, canBeRead) {
  if (error instanceof Stopped) return { headline: "Stopped.", advice: "", detail: "", mayPass: true };
  if (!(error instanceof Refusal)) {
    const [headline, advice] = canBeRead
      ? ["The server cannot be reached.", "Is it still running?"]
      : ["The photo’s file cannot be read.", "It may have been moved or changed: choose it again."];
    return { headline, advice, detail: error.message, mayPass: canBeRead };
  }
  const [headline, advice] = REFUSALS[error.slug] ?? ["The server refused.", ""];
  const problem = error.problem;
  return {
    headline,
    advice,
    detail: problem?.detail ?? `status ${error.status}`,
    id: problem?.request_id,
    mayPass: [408, 429].includes(error.status) || error.status >= 500,
  };
}

const WARNINGS = {
  assumed_focal: (person) =>
    "Nothing says how far the photo was zoomed, so a field of view of 55° was assumed: the distance " +
    `(${metres(Math.hypot(...person.root_mm))}) is only as good as that. Options can state it.`,
  truncated: () =>
    "Not everything of this person is seen. What is missing is guessed from similar poses, with a larger uncertainty.",
  inconsistent_joints: () =>
    "Some 2D joints contradict the others as a human pose; they were set aside and placed from the rest.",
  ambiguous_depth: () =>
    "Some limb may as well point towards the camera as away from it; the uncertainty says how much that matters.",
  far_from_library: () =>
    "No pose of the library explains these joints well. Take the 3D as a rough guess.",
};

/** One of the answer's warnings; the service may know some that the page does not. */
export function warningInWords(warning, person) {
  return WARNINGS[warning] && (person.root_mm || warning !== "assumed_focal")
    ? WARNINGS[warning](person)
    : warning.replaceAll("_", " ").replace(/^./, (first) => first.toUpperCase()) + ".";
}

/** What was found of this person, in a sentence or two. */
export function summaryOf(answer, person) {
  if (!person.joints_3d) return "The joints of this person do not suffice for 3D.";
  const distance = Math.hypot(...person.root_mm);
  const many = answer.library.exemplars.toLocaleString("en");
  const share = Math.round(100 * person.exemplar.probability);
  const parts = [
    `${metres(distance)} from the camera. The best of ${many} exemplars meets the joints to about ` +
      `${person.camera.reprojection_error_px.toFixed(0)} px and has ${share}% of the probability.`,
  ];
  const sigmas = person.joints_3d.map((joint) => joint.sigma_mm).filter((sigma) => sigma !== null);
  if (sigmas.length) {
    const worst = person.joints_3d.reduce((a, b) => (b.sigma_mm > a.sigma_mm ? b : a));
    parts.push(
      `Two joints in three should be within ${centimetres(median(sigmas))} of the truth; ` +
        `least sure is the ${spoken(worst.name)}, ± ${centimetres(worst.sigma_mm)}.`,
    );
  }
  const doubtful = person.joints_2d.filter((joint) => joint.confidence !== null && joint.confidence < 0.5);
  if (doubtful.length) {
    parts.push(`In the photo, doubtful: ${doubtful.map((joint) => spoken(joint.name)).join(", ")}.`);
  }
  return parts.join(" ");
}

/** Whence an exemplar, from its id and, for the first, its source. */
export function sourceInWords(candidate, source) {
  const chance = `${(100 * candidate.probability).toFixed(1)}% probable`;
  const error = `${candidate.reprojection_error_px.toFixed(1)} px off the joints`;
  return `${chance}, ${error}; ${originOf(source) ?? candidate.id}`;
}

function originOf(source) {
  switch (source?.kind) {
    case "mocap":
      return `captured: ${source.clip}, frame ${source.frame}${source.mirrored ? ", mirrored" : ""}`;
    case "composed":
      return `composed: ${source.parts.map((it) => `${it.part.replace("_", " ")} of ${it.clip}`).join(", ")}`;
    case "sampled":
      return `sampled from the prior ${source.prior}, draw ${source.index.toLocaleString("en")}`;
  }
}

/** The line below the photo. */
export function captionOf(name, answer) {
  const { width_px, height_px } = answer.image;
  const people = ["nobody found", "one person"][answer.people.length] ?? `${answer.people.length} people`;
  return `${name}, ${width_px} × ${height_px} px: ${people} in ${Math.round(answer.timings_ms.total)} ms`;
}

/** Where the 3D view looks from; angles in degrees, seen from the photo's camera. */
export function viewInWords(azimuth, elevation) {
  const turn = Math.round(Math.abs(azimuth));
  const rise = Math.round(Math.abs(elevation));
  if (turn === 0 && rise === 0) return "As the photo’s camera sees it; grid 0.5\u00a0m";
  const sides = turn ? `${turn}° to the ${azimuth > 0 ? "right" : "left"}` : "straight on";
  const height = rise ? `, ${rise}° ${elevation > 0 ? "above" : "below"}` : "";
  return `From ${sides}${height}; grid 0.5\u00a0m`;
}

function metres(mm) {
  return `${(mm / 1000).toFixed(1)} m`;
}

function centimetres(mm) {
  return `${Math.round(mm / 10)} cm`;
}

function median(values) {
  const sorted = values.toSorted((a, b) => a - b);
  return sorted[sorted.length >> 1];
}
