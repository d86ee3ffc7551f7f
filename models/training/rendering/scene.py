"""Cameras, light and backgrounds: one crop of one rendered person.

Camera frame: x right, y down, z forward; metres. Pixel (0, 0) is the centre of the top-left pixel.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from models.training.rendering.backdrop import Backgrounds, backdrop, patch
from models.training.rendering.body import HAIR, SKIRT, BodyModel, Floats, Shape
from models.training.rendering.look import BodyMap, Look, X, Z
from models.training.rendering.pose import Poser, turn
from models.training.rendering.poses import PoseSource
from models.training.rendering.raster import Pixels, normals, rasterise

Image = NDArray[np.uint8]

CROP_SCALE = 1.6
"""Side of a crop over the extent of the joints, as in the photo sets."""
OVERSAMPLE = 2
JOINT_DEPTH_M = np.array(
    [0.06, 0.12, 0.13, 0.07, 0.07, 0.13, 0.07, 0.07, 0.2, 0.1, 0.08, 0.2, 0.1, 0.08], np.float32
)
"""How far behind the surface a joint may lie and still count as seen."""


@dataclass(frozen=True)
class Crop:
    """A rendered crop.

    ``image`` (s, s, 3) uint8 BGR, ``joints_px`` (14, 2), ``visible`` (14,), ``mask`` (s, s) the
    share of each pixel that the person covers. ``joints_mm`` (14, 3) in the camera's frame;
    ``focal_length_px`` and ``principal_point_px`` (2,) are the camera's, in pixels of the crop.
    """

    image: Image
    joints_px: Floats
    joints_mm: Floats
    focal_length_px: float
    principal_point_px: Floats
    visible: NDArray[np.bool_]
    mask: Floats


@dataclass(frozen=True)
class _Actor:
    """A dressed, posed person in the camera's frame: ``vertices`` (V, 3), ``joints`` (14, 3) m."""

    vertices: Floats
    joints: Floats
    quads: NDArray[np.int64]
    kind: NDArray[np.int8]
    look: Look


@dataclass(frozen=True)
class _Light:
    """``towards`` the lamp and ``up``, unit vectors in the camera's frame; BGR strengths."""

    towards: Floats
    up: Floats
    lamp: Floats
    sky: Floats
    ground: Floats


class Studio:
    """Everything that renders share; ``crop(rng)`` makes one."""

    def __init__(
        self, model: BodyModel, poser: Poser, poses: PoseSource, photos: Backgrounds, cast: int
    ) -> None:
        """``cast`` different bodies play all the people."""
        shapes = [Shape.draw(np.random.default_rng(k)) for k in range(cast)]
        self._cast = [(shape, model.rest(shape)) for shape in shapes]
        self._model = model
        self._poser = poser
        self._poses = poses
        self._photos = photos
        self._map = BodyMap(model)

    def crop(self, rng: np.random.Generator, size: int) -> Crop:
        """A person in a random pose, look, light and place, ``size`` px."""
        big = size * OVERSAMPLE
        rotation = _camera_rotation(rng)
        distance = float(np.exp(rng.uniform(np.log(2.0), np.log(9.0))))
        aim = np.array([rng.normal(0, 0.08), rng.normal(0, 0.08), 1.0]) * distance
        star = self._actor(rng, rotation, aim)
        flat = star.joints[:, :2] / star.joints[:, 2:]
        low, high = flat.min(0), flat.max(0)
        focal = big / (CROP_SCALE * float((high - low).max()))
        offset = (big - 1) / 2 - focal * (low + high) / 2

        actors = [star]
        if rng.random() < 0.15:
            side = rng.choice([-1, 1]) * rng.uniform(0.35, 1.1)
            shift = np.array([side, 0, rng.normal(0, 0.7)])
            other = self._actor(rng, rotation, aim + shift)
            if other.vertices[:, 2].min() > 0.5:
                actors.append(other)
        v = np.concatenate([actor.vertices for actor in actors])
        starts = np.cumsum([0, *(len(actor.vertices) for actor in actors)])
        q = np.concatenate([a.quads + n for a, n in zip(actors, starts, strict=False)])
        kind = np.concatenate([actor.kind for actor in actors])
        who = np.repeat(np.arange(len(actors)), [len(actor.quads) for actor in actors])
        xy = (v[:, :2] / v[:, 2:] * focal + offset).astype(np.float32)
        seen = rasterise(v, xy, q, (kind == HAIR) | (kind == SKIRT), big)

        canvas = backdrop(rng, self._photos, size)
        light = _light(rng, rotation, canvas)
        canvas = _resized(canvas, big)
        colors = np.empty((len(seen.index), 3), np.float32)
        normal = normals(v, q)
        shading = _shade(v, normal, q, seen, light, big)
        for i, actor in enumerate(actors):
            mine = who[seen.quad] == i
            corner = q[seen.quad[mine]] - starts[i]
            place = np.einsum("pk,pkc->pc", seen.corner_weights[mine], self._map.places[corner])
            colors[mine] = actor.look.albedo(self._map, place, kind[seen.quad[mine]])
            colors[mine] *= _wear(rng, place)[:, None]
        colors *= shading
        if rng.random() < 0.6:
            canvas = _with_shadow(canvas, v, rotation, light, focal, offset, rng)
        flat_canvas = canvas.reshape(-1, 3)
        flat_canvas[seen.index] = colors
        mask = np.zeros(big * big, np.float32)
        mask[seen.index] = who[seen.quad] == 0

        joints_big = star.joints[:, :2] / star.joints[:, 2:] * focal + offset
        visible = _visible(star.joints, joints_big, seen, big)
        image, hidden = _finish(rng, canvas, self._photos, size)
        joints_px = _reduced(joints_big)
        if hidden is not None:
            x0, y0, x1, y1 = hidden
            under = (joints_px >= (x0 - 0.5, y0 - 0.5)).all(1)
            under &= (joints_px <= (x1 - 0.5, y1 - 0.5)).all(1)
            visible &= ~under
        return Crop(
            image=image,
            joints_px=joints_px,
            joints_mm=1000 * star.joints,
            focal_length_px=focal / OVERSAMPLE,
            principal_point_px=_reduced(offset),
            visible=visible,
            mask=_resized(mask.reshape(big, big), size),
        )

    def _actor(self, rng: np.random.Generator, rotation: Floats, at: NDArray[np.float64]) -> _Actor:
        shape, rest = self._cast[rng.integers(len(self._cast))]
        photo = self._photos.photo(rng)
        look = Look.draw(rng, shape.female > 0.5, photo)
        out = look.offsets(self._map, rng)
        dressed = type(rest)(rest.vertices + out[:, None] * self._map.rest_normals, rest.bone_heads)
        posed = self._poser.pose(dressed, self._poses.draw(rng), rng)
        center = (posed.joints.min(0) + posed.joints.max(0)) / 2
        keep = np.isin(self._model.kind, list(look.kinds()))
        return _Actor(
            ((posed.vertices - center) @ rotation.T + at).astype(np.float32),
            ((posed.joints - center) @ rotation.T + at).astype(np.float32),
            self._model.quads[keep],
            self._model.kind[keep],
            look,
        )


def _reduced(points: NDArray[np.floating]) -> Floats:
    """Pixels of the oversampled picture -> of the crop."""
    result: Floats = ((points + 0.5) / OVERSAMPLE - 0.5).astype(np.float32)
    return result


def _resized(plane: Floats, size: int) -> Floats:
    """To (size, size, ...), by area when it shrinks."""
    how = cv2.INTER_AREA if size < len(plane) else cv2.INTER_LINEAR
    result: Floats = cv2.resize(plane, (size, size), interpolation=how).astype(np.float32)
    return result


def _camera_rotation(rng: np.random.Generator) -> Floats:
    """World (y up) to camera: any azimuth, mostly level, sometimes from above, a little roll."""
    dice = rng.random()
    low, high = (-12, 25) if dice < 0.7 else (25, 50) if dice < 0.92 else (50, 80)
    elevation = np.deg2rad(rng.uniform(low, high))
    roll = np.deg2rad(rng.normal(0, 6))
    x, y, z = np.eye(3)
    to_camera = np.diag([1.0, -1.0, -1.0])
    rotation: Floats = (
        turn(z, float(roll))
        @ to_camera
        @ turn(x, float(elevation))
        @ turn(y, float(rng.uniform(0, 2 * np.pi)))
    ).astype(np.float32)
    return rotation


def _light(rng: np.random.Generator, rotation: Floats, around: Floats) -> _Light:
    """A lamp above the horizon and a sky, as bright as the background suggests."""
    up = rotation[:, 1]
    above = rng.normal(0, 1, 3)
    above[1] = abs(above[1]) + 0.4
    towards = rotation @ (above / np.linalg.norm(above))
    level = float(np.clip(around.mean() * rng.uniform(1.0, 1.8) + 0.4, 0.55, 1.25))
    tint = np.clip(around.mean((0, 1)) / max(float(around.mean()), 0.05), 0.7, 1.3) ** 0.35
    share = rng.uniform(0.15, 0.75)
    sky = level * tint * (1.05 - 0.6 * share)
    return _Light(
        towards.astype(np.float32),
        up,
        (level * 1.7 * share * np.clip(rng.normal(1, 0.06, 3), 0.8, 1.2)).astype(np.float32),
        sky.astype(np.float32),
        (sky * rng.uniform(0.45, 0.85)).astype(np.float32),
    )


def _shade(
    v: Floats, normal: Floats, quads: NDArray[np.int64], seen: Pixels, light: _Light, size: int
) -> Floats:
    """Light that arrives at every covered pixel, (P, 3)."""
    corner = quads[seen.quad]
    n = np.einsum("pk,pkc->pc", seen.corner_weights, normal[corner])
    n /= np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-6)
    n[n[:, 2] > 0.3] *= -1  # the inside of skirts and hair
    at = np.einsum("pk,pkc->pc", seen.corner_weights, v[corner])
    lit = np.clip(n @ light.towards, 0, 1)
    lit *= _smooth(_unshadowed(v, at + 0.01 * n, light.towards), seen.index, size, 1.2)
    around = _smooth(at[:, 2], seen.index, size, size / 28)
    hollow = np.clip(1 - 2.2 * np.clip(at[:, 2] - around, 0, 0.25), 0.5, 1)
    open_sky = 0.5 + 0.5 * (n @ light.up)
    ambient = light.ground + open_sky[:, None] * (light.sky - light.ground)
    result: Floats = ambient * hollow[:, None] + lit[:, None] * light.lamp
    return result


def _smooth(values: Floats, index: NDArray[np.int64], size: int, sigma: float) -> Floats:
    """Gaussian mean over the covered pixels only."""
    flat = np.zeros((size * size, 2), np.float32)
    flat[index, 0] = values
    flat[index, 1] = 1
    reduced = max(int(sigma / 2), 1)
    plane = _resized(flat.reshape(size, size, 2), size // reduced)
    soft = cv2.GaussianBlur(plane, (0, 0), sigma / reduced).astype(np.float32)
    top, bottom = _resized(soft, size).reshape(-1, 2).T
    result: Floats = np.divide(top[index], bottom[index] + 1e-6, dtype=np.float32)
    return result


def _unshadowed(v: Floats, at: Floats, towards: Floats, cell_m: float = 0.022) -> Floats:
    """1 where the lamp sees the point, 0 where vertices nearer to it cover it."""
    side = np.cross(towards, [0.0, 0.0, 1.0] if abs(towards[2]) < 0.9 else [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side)
    axes = np.stack([side, np.cross(towards, side)], 1)
    flat = v @ axes
    low = flat.min(0) - 2 * cell_m
    columns, rows = (np.ceil((flat.max(0) - low) / cell_m) + 3).astype(int)
    cell = ((flat - low) / cell_m).astype(int)
    height = np.full(rows * columns, -9e9, np.float32)
    np.maximum.at(height, cell[:, 1] * columns + cell[:, 0], v @ towards)
    grid = cv2.dilate(height.reshape(rows, columns), np.ones((2, 2), np.uint8))
    own = ((at @ axes - low) / cell_m).astype(int)
    own = np.clip(own, 0, (columns - 1, rows - 1))
    result: Floats = (grid[own[:, 1], own[:, 0]] < at @ towards + 0.05).astype(np.float32)
    return result


def _wear(rng: np.random.Generator, place: Floats) -> Floats:
    """Folds, dirt and uneven dye: a factor near 1 per place."""
    octaves = np.array([8.0, 8.0, 30.0, 30.0], np.float32)
    direction = (rng.normal(0, 1, (3, 4)) * octaves).astype(np.float32)
    phase = place[:, X : Z + 1] @ direction + rng.uniform(0, 6, 4).astype(np.float32)
    bend = np.sin(phase[:, 1::2])
    result: Floats = 1 + 0.06 * np.sin(phase[:, ::2] + 1.5 * bend).sum(1)
    return result


def _with_shadow(
    canvas: Floats,
    v: Floats,
    rotation: Floats,
    light: _Light,
    focal: float,
    offset: Floats,
    rng: np.random.Generator,
) -> Floats:
    """The shadow on flat ground under the lowest point."""
    up = rotation[:, 1]
    height = v @ up
    ground = height.min()
    drop = (height - ground) / max(float(light.towards @ up), 0.2)
    fallen = v - drop[:, None] * light.towards
    ahead = fallen[:, 2] > 0.3
    if -float(up @ [0, 0, 1.0]) < 0.03 or not ahead.any():
        return canvas  # the camera does not look down on the ground
    xy = np.rint(fallen[ahead, :2] / fallen[ahead, 2:] * focal + offset).astype(int)
    size = len(canvas)
    xy = xy[((xy >= 0) & (xy < size)).all(1)]
    mask = np.zeros((size, size), np.float32)
    mask[xy[:, 1], xy[:, 0]] = 1
    reach = max(int(0.035 * focal / v[:, 2].mean()), 1)
    wide = cv2.dilate(mask, np.ones((reach, 2 * reach), np.uint8))
    soft = cv2.GaussianBlur(wide, (0, 0), reach * rng.uniform(0.5, 1.5)).astype(np.float32)
    result: Floats = canvas * (1 - np.float32(rng.uniform(0.2, 0.7)) * soft[:, :, None])
    return result


def _visible(joints: Floats, xy: Floats, seen: Pixels, size: int) -> NDArray[np.bool_]:
    """Joints with nothing in front of them but the flesh around them."""
    at = np.clip(np.rint(xy).astype(int), 0, size - 1)
    surface = seen.depth[at[:, 1], at[:, 0]]
    inside = ((xy >= -0.5) & (xy < size - 0.5)).all(1)
    result: NDArray[np.bool_] = inside & (joints[:, 2] - surface < JOINT_DEPTH_M)
    return result


def _finish(
    rng: np.random.Generator, canvas: Floats, photos: Backgrounds, size: int
) -> tuple[Image, tuple[int, int, int, int] | None]:
    """Reduce, occlude, blur and add noise; also the occluder's box (x0, y0, x1, y1)."""
    image = _resized(np.clip(canvas, 0, 1), size)
    hidden = None
    if rng.random() < 0.08:
        w, h = (int(s * size) for s in rng.uniform(0.12, 0.45, 2))
        x, y = (int(s * size) for s in rng.uniform(0, 0.85, 2))
        x1, y1 = min(x + w, size), min(y + h, size)
        image[y:y1, x:x1] = patch(rng, photos, size, (0.1, 0.4))[y:y1, x:x1]
        hidden = (x, y, x1, y1)
    soft = cv2.GaussianBlur(image, (0, 0), rng.uniform(0.3, 0.8) * (1 + (rng.random() < 0.15)))
    noise = rng.normal(0, rng.uniform(0.002, 0.015), image.shape)
    eight_bit = np.clip((soft + noise) * 255 + 0.5, 0, 255).astype(np.uint8)
    return eight_bit, hidden
