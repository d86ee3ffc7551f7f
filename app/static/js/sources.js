// Where photos come from: a file, a drop, the clipboard, a sample, the camera.

import { Refusal } from "./api.js";

const $ = (id) => document.getElementById(id);

/**
 * Wire all sources.
 *
 * @param {(photo: Blob | Promise<Blob>, name: string) => void} onPhoto
 */
export function listenForPhotos(onPhoto) {
  const take = (file) => file && onPhoto(file, file.name || "pasted.png");

  $("choose").addEventListener("click", () => $("file").click());
  $("welcome").addEventListener("click", () => $("file").click());
  for (const input of [$("file"), $("snapshot")]) {
    input.addEventListener("change", () => {
      take(input.files[0]);
      input.value = ""; // so that the same file can be chosen again
    });
  }

  const frame = $("photo-frame");
  const hasFiles = (event) => event.dataTransfer?.types.includes("Files");
  addEventListener("dragover", (event) => {
    if (!hasFiles(event)) return;
    event.preventDefault();
    frame.classList.add("target");
  });
  addEventListener("dragleave", (event) => {
    if (!event.relatedTarget) frame.classList.remove("target");
  });
  addEventListener("drop", (event) => {
    frame.classList.remove("target");
    if (!hasFiles(event)) return;
    event.preventDefault();
    take(event.dataTransfer.files[0]);
  });

  addEventListener("paste", (event) => {
    const file = [...(event.clipboardData?.files ?? [])].find(({ type }) => type.startsWith("image/"));
    if (!file) return;
    event.preventDefault();
    take(file);
  });

  $("samples").addEventListener("click", (event) => {
    const name = event.target.closest("[data-sample]")?.dataset.sample;
    if (name) onPhoto(fetchSample(name), name);
  });

  listenToCamera((photo) => onPhoto(photo, "camera.jpg"));
}

async function fetchSample(name) {
  const response = await fetch(`static/samples/${name}`);
  if (!response.ok) throw new Refusal(response.status, null);
  return response.blob();
}

function listenToCamera(onPhoto) {
  const dialog = $("camera");
  const video = $("video");
  let stream = null;
  let facing = "user";
  let countdown = 0;
  let openings = 0;

  $("shoot").addEventListener("click", () => {
    // Without HTTPS (localhost aside) pages get no camera, but phones still open theirs for a file.
    if (!navigator.mediaDevices) return $("snapshot").click();
    dialog.showModal();
    start();
  });
  $("snap").addEventListener("click", snap);
  $("timer").addEventListener("click", () => count(5));
  $("flip").addEventListener("click", () => {
    facing = facing === "user" ? "environment" : "user";
    start();
  });
  $("close").addEventListener("click", () => dialog.close());
  dialog.addEventListener("close", stop);

  async function start() {
    stop();
    const mine = openings;
    $("snap").disabled = $("timer").disabled = true;
    $("camera-notice").hidden = true;
    try {
      const wanted = { facingMode: facing, width: { ideal: 1280 }, height: { ideal: 960 } };
      const given = await navigator.mediaDevices.getUserMedia({ video: wanted });
      if (mine !== openings) return given.getTracks().forEach((track) => track.stop());
      stream = given;
      video.srcObject = stream;
      video.classList.toggle("facing", facing === "user");
      await video.play();
      const devices = await navigator.mediaDevices.enumerateDevices();
      if (mine !== openings) return;
      $("flip").hidden = devices.filter(({ kind }) => kind === "videoinput").length < 2;
      $("snap").disabled = $("timer").disabled = false;
      $("snap").focus();
    } catch (error) {
      if (mine !== openings) return;
      $("camera-notice").hidden = false;
      $("camera-notice").textContent =
        error.name === "NotAllowedError"
          ? "The browser does not allow this page the camera; its address bar can change that."
          : "No camera can be opened here.";
    }
  }

  /** Let go of the camera, also of one that is still being opened. */
  function stop() {
    openings++;
    clearTimeout(countdown);
    $("timer").textContent = "in 5 seconds";
    stream?.getTracks().forEach((track) => track.stop());
    stream = null;
    video.srcObject = null;
  }

  function count(seconds) {
    clearTimeout(countdown);
    if (seconds === 0) return snap();
    $("timer").textContent = `${seconds} …`;
    countdown = setTimeout(count, 1000, seconds - 1);
  }

  function snap() {
    // The picture as the camera has it, not mirrored as it is shown.
    const canvas = document.createElement("canvas");
    canvas.width = video.videoWidth;
    canvas.height = video.videoHeight;
    canvas.getContext("2d").drawImage(video, 0, 0);
    dialog.close();
    canvas.toBlob((blob) => blob && onPhoto(blob), "image/jpeg", 0.92);
  }
}
