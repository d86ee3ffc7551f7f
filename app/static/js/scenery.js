// What stands around the people in 3D: the ground, the photo's camera, its lines of sight.
// In the answer's frame: camera frame, mm, x right, y down, z forward.

import * as THREE from "../vendor/three/three.module.min.js";

const CELL_MM = 500;
const REACH_MM = 3000;
const FOOT_MM = 30;

/**
 * A grid of half metres below the lowest joint, fading out, and everybody's shadow on it.
 *
 * It is level for the photo's camera; nothing in a photo says which way is down.
 */
export function ground(poses, colours, bones) {
  const points = poses.flat();
  const centre = points.length ? [mean(points, 0), mean(points, 2)] : [0, 3000];
  const floor = (points.length ? Math.max(...points.map((point) => point[1])) : 900) + FOOT_MM;
  const group = new THREE.Group();
  group.add(grid(centre, floor, colours));
  for (const pose of poses) {
    for (const [a, b] of bones) group.add(shadow(pose[a], pose[b], floor, colours));
  }
  return group;
}

function grid([xc, zc], floor, colours) {
  const positions = [];
  const tints = [];
  const colour = new THREE.Color(colours.ground);
  const fade = (x, z) => Math.max(0, 1 - Math.hypot(x - xc, z - zc) / REACH_MM);
  const put = (x, z) => {
    positions.push(x, floor, z);
    tints.push(colour.r, colour.g, colour.b, fade(x, z));
  };
  const first = (c) => Math.ceil((c - REACH_MM) / CELL_MM) * CELL_MM;
  for (let x = first(xc); x <= xc + REACH_MM; x += CELL_MM) {
    for (let z = first(zc); z <= zc + REACH_MM; z += CELL_MM) {
      put(x, z);
      put(x + CELL_MM, z);
      put(x, z);
      put(x, z + CELL_MM);
    }
  }
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.Float32BufferAttribute(positions, 3));
  geometry.setAttribute("color", new THREE.Float32BufferAttribute(tints, 4));
  return new THREE.LineSegments(
    geometry,
    new THREE.LineBasicMaterial({ vertexColors: true, transparent: true, depthWrite: false }),
  );
}

/** A flat stroke on the floor under a bone; opaque, so that strokes do not add up. */
function shadow(a, b, floor, colours) {
  const from = new THREE.Vector2(a[0], a[2]);
  const to = new THREE.Vector2(b[0], b[2]);
  const across = to.clone().sub(from);
  const along = across.clone().setLength(26);
  across.set(-along.y, along.x);
  const corners = [
    from.clone().sub(along).add(across),
    from.clone().sub(along).sub(across),
    to.clone().add(along).sub(across),
    to.clone().add(along).add(across),
  ];
  const geometry = quad(corners.map((corner) => [corner.x, floor - 2, corner.y]));
  return new THREE.Mesh(geometry, new THREE.MeshBasicMaterial({ color: colours.ground, side: THREE.DoubleSide }));
}

/** The pyramid of what the photo's camera sees, cut off by the photo itself. */
export function cameraFrustum(image, camera, pose, texture, colours) {
  const { width_px: width, height_px: height } = image;
  const depth = 0.3 * Math.min(...pose.map((point) => point[2]), 4000);
  const [cx, cy] = camera.principal_point_px;
  const scale = depth / camera.focal_length_px;
  const corner = (x, y) => [scale * (x - cx), scale * (y - cy), depth];
  // Pixel centres are at whole numbers: the photo reaches half a pixel further.
  const corners = [
    corner(-0.5, -0.5),
    corner(-0.5, height - 0.5),
    corner(width - 0.5, height - 0.5),
    corner(width - 0.5, -0.5),
  ];
  const edges = corners.flatMap((point, i) => [[0, 0, 0], point, point, corners[(i + 1) % 4]]);
  const group = new THREE.Group();
  group.add(lines(edges, colours.ink, 0.75));
  if (texture) {
    const material = new THREE.MeshBasicMaterial({ map: texture, side: THREE.DoubleSide, depthWrite: false });
    const plane = new THREE.Mesh(quad(corners), material);
    plane.renderOrder = -1; // people stay visible before their own photo
    group.add(plane);
  }
  return group;
}

/** From the camera through each joint: what matching in 2D leaves open is the place on these lines. */
export function sightLines(pose, colours) {
  return lines(
    pose.flatMap((point) => [[0, 0, 0], point]),
    colours.ghost,
    0.3,
  );
}

function lines(points, colour, opacity) {
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.Float32BufferAttribute(points.flat(), 3));
  return new THREE.LineSegments(
    geometry,
    new THREE.LineBasicMaterial({ color: colour, opacity, transparent: true, depthWrite: false }),
  );
}

/** Two triangles; corners in order: top left, bottom left, bottom right, top right of the texture. */
function quad(corners) {
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.Float32BufferAttribute(corners.flat(), 3));
  geometry.setAttribute("uv", new THREE.Float32BufferAttribute([0, 1, 0, 0, 1, 0, 1, 1], 2));
  geometry.setIndex([0, 1, 2, 0, 2, 3]);
  return geometry;
}

/** The photo, shrunk, for the camera's image plane. */
export function textureOf(bitmap) {
  const scale = Math.min(1, 640 / Math.max(bitmap.width, bitmap.height));
  const canvas = document.createElement("canvas");
  canvas.width = Math.max(1, Math.round(scale * bitmap.width));
  canvas.height = Math.max(1, Math.round(scale * bitmap.height));
  canvas.getContext("2d").drawImage(bitmap, 0, 0, canvas.width, canvas.height);
  const texture = new THREE.CanvasTexture(canvas);
  texture.colorSpace = THREE.SRGBColorSpace;
  return texture;
}

function mean(points, axis) {
  return points.reduce((sum, point) => sum + point[axis], 0) / points.length;
}
