// The photo as the service saw it: not every browser heeds every file's EXIF orientation.

/** What makes stored pixels upright, by orientation: `setTransform`'s arguments, given their size. */
const TURNS = {
  2: (width) => [-1, 0, 0, 1, width, 0],
  3: (width, height) => [-1, 0, 0, -1, width, height],
  4: (_, height) => [1, 0, 0, -1, 0, height],
  5: () => [0, 1, 1, 0, 0, 0],
  6: (_, height) => [0, 1, -1, 0, height, 0],
  7: (width, height) => [0, -1, -1, 0, height, width],
  8: (width) => [0, -1, 1, 0, 0, width],
};

/** A WebP of 2 x 1 pixels, of orientation 6. */
const TURNED_WEBP =
  "UklGRk4AAABXRUJQVlA4WAoAAAAIAAAAAQAAAAAAVlA4TA4AAAAvAQAAAAcQEf0PRET/A0VYSUYaAAAASUkqAAgAAAABABIBAwABAAAABgAAAAAAAAA=";

let turnsWebp = null;

/** The photo as this browser decodes it, which may or may not be upright; null when it cannot. */
export function decoded(photo) {
  return createImageBitmap(photo, { imageOrientation: "from-image" }).catch(() => null);
}

/**
 * The photo upright.
 *
 * @param {ImageBitmap} bitmap what `decoded` made of `photo`
 * @param {Blob} photo
 * @param {{width_px: number, height_px: number, orientation_applied: number}} image the answer's
 * @returns {Promise<ImageBitmap>} `bitmap` itself where the browser has turned it
 */
export async function upright(bitmap, photo, image) {
  if (await isUpright(bitmap, photo, image)) return bitmap;
  const canvas = document.createElement("canvas");
  canvas.width = image.width_px;
  canvas.height = image.height_px;
  const context = canvas.getContext("2d");
  context.setTransform(...TURNS[image.orientation_applied](bitmap.width, bitmap.height));
  context.drawImage(bitmap, 0, 0);
  return createImageBitmap(canvas);
}

async function isUpright(bitmap, photo, { width_px, height_px, orientation_applied }) {
  if (orientation_applied === 1) return true;
  // A quarter turn shows in the size, whatever the file.
  if (orientation_applied >= 5 && width_px !== height_px) return bitmap.width === width_px;
  return !(await isWebp(photo)) || (turnsWebp ??= findOut());
}

async function isWebp(photo) {
  const head = new Uint8Array(await photo.slice(8, 12).arrayBuffer());
  return String.fromCharCode(...head) === "WEBP";
}

/** Whether this browser turns WebPs. */
async function findOut() {
  const bytes = Uint8Array.from(atob(TURNED_WEBP), (letter) => letter.charCodeAt(0));
  const bitmap = await decoded(new Blob([bytes], { type: "image/webp" }));
  return bitmap !== null && bitmap.width < bitmap.height;
}
