// The page: one photo at a time, its answer on two plates and in words. State lives here.

import { Refusal, Stopped, curlCommand, estimate, fetchInfo } from "./api.js";
import { Panels } from "./panels.js";
import { PhotoView } from "./photo.js";
import { listenForPhotos } from "./sources.js";
import { decoded, upright } from "./upright.js";
import { captionOf, failureInWords, viewInWords } from "./words.js";

const $ = (id) => document.getElementById(id);

/** The photo shown and asked about, whether it is known to lie upright, and what came back. */
const state = { photo: null, name: "", bitmap: null, isUpright: false, answer: null, selected: 0 };
let stage = null;
let inFlight = null;
let turns = 0;
let limits = null;

const photoView = new PhotoView($("photo"), { onPerson: select, onJoint: light });
const panels = new Panels({ onPerson: select, onCandidate: pickCandidate, onJoint: light });

listenForPhotos(open);
$("form").addEventListener("change", () => $("form").reportValidity() && state.photo && ask());
$("form").addEventListener("submit", (event) => event.preventDefault());
for (const button of document.querySelectorAll("[data-copy]")) {
  button.addEventListener("click", () => copy(button));
}
for (const query of ["(prefers-color-scheme: dark)", "(min-width: 40rem)"]) {
  matchMedia(query).addEventListener("change", redraw);
}
addEventListener("resize", () => panels.redraw());
$("stop").addEventListener("click", stop);
addEventListener("keydown", (event) => event.key === "Escape" && !$("camera").open && stop());
openStage();

/**
 * Take in a photo, show it and ask about it. The last one that was chosen counts, however long each
 * takes to be had and decoded.
 *
 * @param {Blob | Promise<Blob>} source
 * @param {string} name
 */
async function open(source, name) {
  inFlight?.abort();
  inFlight = null;
  state.photo = null; // until then there is nothing to ask about
  const turn = ++turns;
  showWait(false);
  $("findings").inert = $("stage-frame").inert = true; // of another photo
  $("refusal").hidden = true;
  caption(`${name}: opening …`);
  let photo = null;
  let bitmap = null;
  let failure = null;
  try {
    photo = await source;
    // Not every browser decodes what is dropped here; the service says why it does not either.
    bitmap = await decoded(photo);
  } catch (error) {
    failure = error;
  }
  if (turn !== turns) {
    bitmap?.close();
    return;
  }
  Object.assign(state, { photo, name, bitmap, isUpright: false, answer: null, selected: 0 });
  $("welcome").hidden = bitmap !== null;
  photoView.show(bitmap);
  $("photo").setAttribute("aria-label", `The photo ${name}`);
  if (failure) refuse(failure);
  else await ask();
}

/** Ask about the photo with the options as they are. */
async function ask() {
  inFlight?.abort();
  const mine = new AbortController();
  inFlight = mine;
  const { photo } = state;
  const { query, key } = options();
  $("refusal").hidden = true;
  const scan = setTimeout(() => showWait(true), 250);
  caption(`${state.name}: asking …`);
  let answer;
  let { bitmap } = state;
  try {
    await refuseTooLarge(photo, key);
    answer = await estimate(photo, query, {
      key,
      signal: mine.signal,
      onWait: (seconds, problem) =>
        caption(`${problem?.title ?? "Busy"}: asking again in ${Math.ceil(seconds)} s`),
    });
    if (bitmap && !state.isUpright) bitmap = await upright(bitmap, photo, answer.image).catch(() => bitmap);
  } catch (error) {
    const canBeRead = await isReadable(photo);
    // Not every browser's fetch fails with the reason that it was aborted for.
    const why = mine.signal.aborted ? mine.signal.reason : error;
    if (mine === inFlight && why.name !== "AbortError") refuse(why, canBeRead);
    return;
  } finally {
    clearTimeout(scan);
    if (mine === inFlight) showWait(false);
  }
  if (mine !== inFlight) return;
  if (bitmap !== state.bitmap) photoView.show(bitmap);
  Object.assign(state, { bitmap, isUpright: true });
  show(answer, query, key);
}

/** Wait no longer for the answer, if there is one to wait for; the service drops what it has not begun. */
function stop() {
  if (!$("stop").hidden) inFlight?.abort(new Stopped());
}

function showWait(isWaiting) {
  $("scan").hidden = $("stop").hidden = !isWaiting;
}

/** A body over the limit is cut off by the server, which browsers report as a lost connection. */
async function refuseTooLarge(photo, key) {
  if (photo.size < 1e6) return;
  limits ??= (await fetchInfo(key))?.limits; // once: it counts towards a key's quota
  const limit = limits?.max_body_bytes;
  if (photo.size > limit) {
    const detail = `the file has ${photo.size} bytes, the limit is ${limit}`;
    throw new Refusal(413, { type: "urn:posematch:problem:body-too-large", detail });
  }
}

/** Whether the file is still there as it was chosen; fetch does not say that it is not. */
function isReadable(photo) {
  return photo.slice(0, 1).arrayBuffer().then(
    () => true,
    () => false,
  );
}

function options() {
  const fields = Object.fromEntries(new FormData($("form")));
  const { key, ...given } = fields;
  const query = new URLSearchParams({ candidates: 10 });
  for (const [name, value] of Object.entries(given)) {
    if (value !== "") query.set(name, name === "mirrored" ? "true" : value);
  }
  return { query, key };
}

function show(answer, query, key) {
  Object.assign(state, { answer, selected: 0 });
  $("findings").inert = $("stage-frame").inert = false;
  caption(captionOf(state.name, answer));
  $("welcome").hidden = true;
  photoView.overlay(answer, 0);
  panels.showAnswer(answer, 0);
  stage?.show(answer, 0, state.bitmap);
  const type = state.photo.type || "application/octet-stream";
  $("curl").textContent = curlCommand(state.name, type, query.toString(), key !== "");
}

function refuse(error, canBeRead = true) {
  state.answer = null;
  $("findings").inert = $("stage-frame").inert = false;
  photoView.overlay(null, 0);
  $("welcome").hidden = state.bitmap !== null;
  panels.showAnswer(null, 0);
  stage?.show(null, 0, null);
  caption(state.name);
  const words = failureInWords(error, canBeRead);
  const small = document.createElement("small");
  small.textContent = words.detail + (words.id ? ` (request ${words.id})` : "");
  $("refusal").replaceChildren(`${words.headline} ${words.advice}`, small);
  if (words.mayPass && state.photo) {
    const again = document.createElement("button");
    Object.assign(again, { type: "button", textContent: "Ask again", onclick: ask });
    $("refusal").append(again);
  }
  $("refusal").hidden = false;
  if (error instanceof Stopped) $("refusal").lastChild.focus(); // the button that was pressed is gone
  if (error.status === 401) {
    $("options").open = true;
    $("form").elements.key.focus();
  }
}

function select(index) {
  if (index === state.selected && stage?.selected === index) return;
  state.selected = index;
  photoView.overlay(state.answer, index);
  panels.showPerson(state.answer, index);
  stage?.select(index);
}

function pickCandidate(index) {
  $("show-exemplar").checked = true;
  panels.checkCandidate(state.answer.people[state.selected], index);
  stage?.set({ candidate: index, exemplar: true });
}

function light(index) {
  photoView.light(index);
  panels.light(index);
  stage?.light(index);
}

function redraw() {
  panels.redraw();
  stage?.recolour();
}

/** The 3D view comes after the rest: its library is most of the page's weight. */
async function openStage() {
  const names = ["camera", "exemplar", "sigma"];
  const shown = () => Object.fromEntries(names.map((name) => [name, $(`show-${name}`).checked]));
  const views = [...document.querySelectorAll("[data-view]")];
  const press = (name) => {
    for (const button of views) button.setAttribute("aria-pressed", String(button.dataset.view === name));
  };
  try {
    const { Stage } = await import("./stage.js");
    stage = new Stage($("stage"), {
      shown: shown(),
      onView: (azimuth, elevation, preset) => {
        $("stage-caption").textContent = viewInWords(azimuth, elevation);
        press(preset);
      },
      onJoint: light,
    });
  } catch (error) {
    console.warn("no 3D view:", error);
    $("stage").hidden = true;
    for (const control of [...views, ...names.map((name) => $(`show-${name}`))]) control.disabled = true;
    $("stage-notice").hidden = false;
    $("stage-notice").textContent =
      "This browser does not let the page draw in 3D (WebGL 2). The numbers below are complete.";
    return;
  }
  for (const name of names) $(`show-${name}`).addEventListener("change", () => stage.set(shown()));
  for (const button of views) button.addEventListener("click", () => stage.view(button.dataset.view));
  if (state.answer) stage.show(state.answer, state.selected, state.bitmap);
}

function caption(text) {
  $("photo-caption").textContent = text;
}

async function copy(button) {
  const source = $(button.dataset.copy);
  const isCopied = await navigator.clipboard?.writeText(source.textContent).then(
    () => true,
    () => false,
  );
  // Without HTTPS there is no clipboard: select the text, so that the keyboard copies it.
  if (!isCopied) getSelection().selectAllChildren(source);
  button.textContent = isCopied ? "Copied" : "Selected";
  setTimeout(() => (button.textContent = "Copy"), 1500);
}
