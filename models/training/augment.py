"""Random views of a labelled crop: the variety that a few thousand photos lack."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from library_store.skeleton import LSP14
from models.crop import warped
from models.training.cutout import over, place, silhouette, whole
from models.training.dataset import TORSO, Image, LabelledCrop
from models.training.shortened import shortened

MIRROR = np.array(LSP14.mirror)
CROP_SCALE = 1.25
"""Side of a canonical crop over the extent of the joints."""
UPRIGHT_SHARE = 0.6
"""Of the views that are turned until the trunk stands upright: what the second look at a person
gets. The others teach the first look, which meets people as they are."""
UPRIGHT_SPREAD_DEG = 15.0
COMPANY_SHARE = 0.25
"""Of the views that get a second person, close by, before or behind the one they are about."""
SHORTENED_SHARE = 0.3
"""Of the views of people whom an edge of the photo cuts off."""


@dataclass(frozen=True)
class Sample:
    """A network input and its labels.

    ``image`` (size, size, 3) uint8 BGR; ``joints_px`` (14, 2) float32 in its pixels; ``weight``
    (14,) trust in the position, 0 outside the crop; ``presence`` (14,) 1 seen, 0 known to be
    outside the crop, -1 unknown; ``depths`` (14,) less the hip midpoint's, over the crop's side,
    nan where unknown.
    """

    image: Image
    joints_px: NDArray[np.float32]
    weight: NDArray[np.float32]
    presence: NDArray[np.float32]
    depths: NDArray[np.float32]


def crop_matrix(
    center_px: NDArray[np.float32], side_px: float, angle_rad: float, size: int, flip: bool = False
) -> NDArray[np.float32]:
    """(2, 3) affine that maps the square (centre, side, rotation) onto size x size pixels."""
    scale = size / side_px
    cos, sin = scale * np.cos(angle_rad), scale * np.sin(angle_rad)
    linear = np.array([[cos, -sin], [sin, cos]])
    if flip:
        linear[0] *= -1
    shift = (size - 1) / 2 - linear @ center_px
    return np.concatenate([linear, shift[:, None]], 1).astype(np.float32)


def canonical(crop: LabelledCrop, size: int, scale: float = CROP_SCALE) -> Sample:
    """The upright, centred crop that evaluation uses."""
    center, extent = crop.extent_px
    return _warp(crop, crop_matrix(center, extent * scale, 0.0, size), size, False, None)


def _warp(
    crop: LabelledCrop,
    matrix: NDArray[np.float32],
    size: int,
    flip: bool,
    rng: np.random.Generator | None,
) -> Sample:
    border, value = cv2.BORDER_CONSTANT, (0.0, 0.0, 0.0)
    if rng is not None:
        border = (cv2.BORDER_CONSTANT, cv2.BORDER_REPLICATE, cv2.BORDER_REFLECT_101)[
            rng.integers(3)
        ]
        value = tuple(rng.uniform(0, 255, 3)) if rng.random() < 0.5 else value
    image = warped(crop.image, matrix, (size, size), border=border, value=value)
    joints = crop.joints_px @ matrix[:, :2].T + matrix[:, 2]
    weight, visible = crop.weight, crop.visible
    depths = np.full(len(joints), np.nan) if crop.depths_px is None else crop.depths_px
    depths = depths * np.sqrt(abs(np.linalg.det(matrix[:, :2]))) / size
    if flip:
        joints, weight, visible, depths = (
            of_joints[MIRROR] for of_joints in (joints, weight, visible, depths)
        )
    inside = ((joints >= -0.5) & (joints <= size - 0.5)).all(1)
    presence = np.where(visible > 0, 1.0, -1.0)
    presence = np.where((weight > 0) & ~inside, 0.0, presence)
    return Sample(
        image,
        joints.astype(np.float32),
        np.where(inside, weight, 0).astype(np.float32),
        presence.astype(np.float32),
        depths.astype(np.float32),
    )


def random_view(
    crop: LabelledCrop, other: LabelledCrop, size: int, rng: np.random.Generator
) -> Sample:
    """A random crop, turn, mirror image, occlusion and exposure; ``other`` lends the occluder."""
    if rng.random() < COMPANY_SHARE and whole(other):
        crop = in_company(crop, other, rng)
    center, extent = crop.extent_px
    beyond = np.zeros(len(crop.joints_px), np.bool_)
    cut = shortened(crop, other.image, rng) if rng.random() < SHORTENED_SHARE else None
    if cut is not None:
        crop, center, extent, beyond = cut.crop, cut.center_px, cut.extent_px, cut.beyond
    scale = CROP_SCALE * float(np.exp(rng.uniform(np.log(0.85), np.log(1.4))))
    offset = rng.normal(0, 0.05, 2)
    if cut is None and rng.random() < 0.12:  # cut off at a random side
        scale *= rng.uniform(0.55, 0.9)
        offset = rng.uniform(-0.3, 0.3, 2)
    angle = _random_turn(crop, rng)
    flip = bool(rng.random() < 0.5)
    side = extent * scale
    matrix = crop_matrix(
        center + np.asarray(offset, np.float32) * side, side, float(angle), size, flip
    )
    sample = _warp(crop, matrix, size, flip, rng)
    image, presence = sample.image, sample.presence.copy()
    presence[beyond[MIRROR] if flip else beyond] = 0
    if rng.random() < 0.35:
        for _ in range(rng.integers(1, 3)):
            _occlude(image, sample.joints_px, presence, other.image, rng)
    return replace(sample, image=expose(image, rng), presence=presence)


def in_company(crop: LabelledCrop, other: LabelledCrop, rng: np.random.Generator) -> LabelledCrop:
    """``crop`` with ``other`` beside the person: cut out, of about the same size, overlapping.

    Joints that the other one covers keep their place, at half the trust, and are no longer seen.
    """
    center, extent = crop.extent_px
    other_center, other_extent = other.extent_px
    scale = extent / other_extent * float(np.exp(rng.normal(0, 0.15)))
    flip = bool(rng.random() < 0.5)
    sides = [np.ptp(one.joints_px[one.weight > 0], axis=0) for one in (crop, other)]
    reach = 0.5 * (sides[0] + scale * sides[1])
    way = rng.normal(0, 0.35 if not crop.wild else 1.0) + (np.pi if rng.random() < 0.5 else 0)
    aside = rng.uniform(0.35, 0.9) * reach * np.array([np.cos(way), np.sin(way)])
    shift = (center + aside - other_center * scale * (-1 if flip else 1, 1)).astype(np.float64)
    size = (crop.image.shape[1], crop.image.shape[0])
    placed, _ = place(other.image, size, scale, shift, flip, np.zeros(3))
    mask, _ = place(silhouette(other), size, scale, shift, flip, np.zeros(3))
    if rng.random() < 0.5 and whole(crop):
        mask = mask * (1 - silhouette(crop))
    x, y = np.clip(np.rint(crop.joints_px).astype(int), 0, np.array(size) - 1).T
    covered = mask[y, x] > 0.5
    return replace(
        crop,
        image=over(crop.image, placed, mask),
        weight=np.where(covered, 0.5 * crop.weight, crop.weight),
        visible=np.where(covered, 0, crop.visible),
    )


def _random_turn(crop: LabelledCrop, rng: np.random.Generator) -> float:
    """Angle (rad) to turn the image by, clockwise as seen."""
    if rng.random() < UPRIGHT_SHARE and crop.has_torso:
        torso = crop.joints_px[list(TORSO)]
        shoulders, hips = torso[:2].mean(0), torso[2:].mean(0)
        right, down = (float(v) for v in shoulders - hips)
        return float(np.deg2rad(rng.normal(0, UPRIGHT_SPREAD_DEG)) - np.arctan2(right, -down))
    if rng.random() < (0.25 if crop.wild else 0.08):
        return float(rng.uniform(-np.pi, np.pi))
    return float(np.deg2rad(np.clip(rng.normal(0, 25), -70, 70)))


def _occlude(
    image: Image,
    joints_px: NDArray[np.float32],
    presence: NDArray[np.float32],
    other: Image,
    rng: np.random.Generator,
) -> None:
    """Paste a patch of another photo (often somebody's limbs), in place."""
    size = image.shape[0]
    w, h = (int(v) for v in rng.uniform(0.12, 0.4, 2) * size)
    x, y = (int(v) for v in rng.uniform(-0.1, 1.0, 2) * size)
    x0, y0, x1, y1 = max(x, 0), max(y, 0), min(x + w, size), min(y + h, size)
    if x1 - x0 < 4 or y1 - y0 < 4:
        return
    if rng.random() < 0.75 and min(other.shape[:2]) > 24:
        oh, ow = other.shape[:2]
        side = int(rng.uniform(0.3, 0.8) * min(oh, ow))
        ox, oy = rng.integers(0, ow - side + 1), rng.integers(0, oh - side + 1)
        patch = cv2.resize(other[oy : oy + side, ox : ox + side], (x1 - x0, y1 - y0))
    else:
        patch = np.broadcast_to(rng.integers(0, 256, 3).astype(np.uint8), (y1 - y0, x1 - x0, 3))
    image[y0:y1, x0:x1] = patch
    under = (joints_px >= (x0, y0)).all(1) & (joints_px <= (x1, y1)).all(1)
    presence[under & (presence > 0)] = -1  # still inferable, but not to be called seen


def worsen(image: Image, rng: np.random.Generator) -> Image:
    """One of heavy noise, blur, camera shake, glare, darkness and coarse JPEG.

    Rougher than ``expose``: what phones bring home from dim rooms, against the light and through
    messengers. For people who are to be found there, not for where exactly their joints lie.
    """
    kind = rng.integers(6)
    if kind == 0:
        noise = rng.normal(0, rng.uniform(10, 32), image.shape)
        return np.clip(image + noise, 0, 255).astype(np.uint8)
    if kind == 1:
        blurred: Image = cv2.GaussianBlur(image, (0, 0), rng.uniform(1.2, 4.0))
        return blurred
    if kind == 2:
        return shaken(image, rng.uniform(4, 16), rng.uniform(0, np.pi))
    if kind == 3:
        return np.clip(image * rng.uniform(1.4, 2.3), 0, 255).astype(np.uint8)
    if kind == 4:
        return (image * rng.uniform(0.12, 0.5)).astype(np.uint8)
    return _as_jpeg(image, int(rng.integers(5, 20)))


def shaken(image: Image, length_px: float, angle_rad: float) -> Image:
    """Smeared along a straight line of ``length_px`` through every pixel, which stays where it is.

    The angle is of the image's x axis towards its y axis.
    """
    reach = int(np.ceil(length_px / 2))
    middle = np.array([reach, reach])
    half = 0.5 * length_px * np.array([np.cos(angle_rad), np.sin(angle_rad)])
    start, end = (np.rint((middle + way * half) * 16).astype(int) for way in (-1, 1))
    kernel = np.zeros((2 * reach + 1, 2 * reach + 1), np.float32)
    cv2.line(kernel, start.tolist(), end.tolist(), 1.0, 1, cv2.LINE_8, 4)
    smeared: Image = cv2.filter2D(image, -1, kernel / kernel.sum())
    return smeared


def _as_jpeg(image: Image, quality: int) -> Image:
    """What is left of an image after JPEG of that quality (0 to 100)."""
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    decoded = cv2.imdecode(data, cv2.IMREAD_COLOR)
    return image if decoded is None else decoded


def expose(image: Image, rng: np.random.Generator) -> Image:
    """Exposure, white balance, grey, blur, low resolution, noise and JPEG."""
    ramp = np.linspace(0, 1, 256, dtype=np.float32)
    gamma = np.exp(rng.normal(0, 0.25))
    gain = np.exp(rng.normal(0, 0.2) + rng.normal(0, 0.08, 3))
    offset = rng.normal(0, 0.05)
    lut = (ramp[:, None] ** gamma - 0.5) * gain + 0.5 + offset
    image = cv2.LUT(image, (np.clip(lut, 0, 1) * 255).astype(np.uint8)[None])
    dice = rng.random(5)
    if dice[0] < 0.1:
        image = cv2.cvtColor(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), cv2.COLOR_GRAY2BGR)
    if dice[1] < 0.1:
        image = cv2.GaussianBlur(image, (0, 0), rng.uniform(0.5, 2.0))
    if dice[2] < 0.1:
        less = rng.uniform(0.25, 0.6)
        image = cv2.resize(
            cv2.resize(image, None, fx=less, fy=less, interpolation=cv2.INTER_AREA),
            image.shape[1::-1],
            interpolation=cv2.INTER_LINEAR,
        )
    if dice[3] < 0.07:
        noise = rng.normal(0, rng.uniform(3, 14), image.shape)
        image = np.clip(image + noise, 0, 255).astype(np.uint8)
    if dice[4] < 0.07:
        return _as_jpeg(image, int(rng.integers(25, 75)))
    return image
