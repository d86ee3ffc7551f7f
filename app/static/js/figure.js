// What the photo, the 3D view and the small drawings share: whose side a joint is on, the bones.

/** "right", "left" (the person's own) or "middle". */
export function sideOf(jointName) {
  return jointName.startsWith("r_") ? "right" : jointName.startsWith("l_") ? "left" : "middle";
}

/** "r_shoulder" -> "right shoulder". */
export function spoken(jointName) {
  return jointName.replace(/^r_/, "right ").replace(/^l_/, "left ").replaceAll("_", " ");
}

/** The skeleton's edges as joint indices, with the line between the hips, which is no bone of it. */
export function bonesOf(skeleton) {
  const hips = ["r_hip", "l_hip"].map((name) => skeleton.joint_names.indexOf(name));
  return [...skeleton.edges, hips];
}

/** The page's colours as CSS has them now (they follow light and dark). */
export function palette() {
  const style = getComputedStyle(document.documentElement);
  const names = ["paper", "plate", "ink", "soft", "line", "right", "left", "middle", "ghost", "ground"];
  return Object.fromEntries(names.map((name) => [name, style.getPropertyValue(`--${name}`).trim()]));
}

/** Give a canvas the pixels of its CSS size; its context in CSS units, or null while it has no size. */
export function prepared(canvas) {
  const ratio = Math.min(devicePixelRatio || 1, 3);
  const { clientWidth: width, clientHeight: height } = canvas;
  if (!width || !height) return null;
  canvas.width = Math.round(width * ratio);
  canvas.height = Math.round(height * ratio);
  const context = canvas.getContext("2d");
  context.scale(ratio, ratio);
  context.lineCap = "round";
  context.lineJoin = "round";
  return { context, width, height };
}

/** A pose (camera frame, mm) from its side, as a small line drawing that fills the canvas. */
export function drawFromSide(canvas, poseMm, skeleton) {
  const ready = prepared(canvas);
  if (!ready) return;
  const { context, width, height } = ready;
  const colours = palette();
  // The camera looks along z; for somebody at its right, looking left, z runs to the right.
  const points = poseMm.map(([, y, z]) => [z, y]);
  const [low, high] = [0, 1].map((end) =>
    [0, 1].map((axis) => points.reduce((a, p) => (end ? Math.max : Math.min)(a, p[axis]), points[0][axis])),
  );
  const scale = 0.86 * Math.min(width / (high[0] - low[0] + 1), height / (high[1] - low[1] + 1));
  const at = ([u, v]) => [
    width / 2 + scale * (u - (low[0] + high[0]) / 2),
    height / 2 + scale * (v - (low[1] + high[1]) / 2),
  ];
  const farFirst = bonesOf(skeleton).toSorted((a, b) => depth(poseMm, a) - depth(poseMm, b));
  context.lineWidth = 3;
  for (const [a, b] of farFirst) {
    context.strokeStyle = colours[sideOf(skeleton.joint_names[b])];
    context.beginPath();
    context.moveTo(...at(points[a]));
    context.lineTo(...at(points[b]));
    context.stroke();
  }
}

function depth(poseMm, [a, b]) {
  return poseMm[a][0] + poseMm[b][0];
}
