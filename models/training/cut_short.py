"""People whom the photo's edge cuts off, for the person network: portraits, webcams, tables.

Their box ends where the photo does: it holds what can be seen of their limbs and trunk, not the
joints alone. So portraits of the labelled crops end somewhere between the chest and the knees, and
so do views of the scenes, which are sharper than the crops but whose joints nobody labelled.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from library_store.skeleton import HEAD_TOP, L_HIP, NECK, R_HIP
from library_store.upright import MOST_LEAN, lean_rad
from models.training.augment import expose
from models.training.cutout import over, place, silhouette, whole
from models.training.dataset import Image, LabelledCrop
from models.training.scenes import (
    SURE,
    LabelledScene,
    SceneSample,
    backdrop,
    cells,
    moved,
    still_inside,
)
from models.training.shortened import seen_box

LEAST_TRUNKS, MOST_TRUNKS = 0.3, 1.9
"""Where photos end, in lengths of the trunk below the neck: from the chest to above the knees."""
LEAST_SHARE, MOST_SHARE = 0.28, 0.75
"""The same of a box about all of somebody who stands, from its top."""
LEAST_ASPECT, LEAST_TALL_PX = 1.7, 90.0
"""Boxes of scenes that are taller are of people who stand; smaller ones are not worth enlarging."""
SMALLEST, LARGEST = 0.35, 1.05
"""Height of what is left of the person, of the photo's."""
FRAMED, MOST_FRAME = 0.25, 0.2
"""Share of the portraits with black beyond the photo, and how far from each side it may reach."""
OTHER_GROUND = 0.35
"""Share of the portraits that are set before another background."""
Floats = NDArray[np.float64]


def can_be_cut(crop: LabelledCrop) -> bool:
    """Whether head, neck and trunk are labelled and the person is upright."""
    known = crop.has_torso and bool((crop.weight[[HEAD_TOP, NECK]] > 0).all())
    return known and bool(abs(lean_rad(crop.joints_px)) < MOST_LEAN)


def end_px(joints_px: Floats, rng: np.random.Generator) -> float:
    """The row at which a photo of somebody upright (14, 2) ends, between chest and knees."""
    neck, hips = joints_px[NECK], joints_px[[R_HIP, L_HIP]].mean(0)
    trunk_px = max(float(np.linalg.norm(hips - neck)), 1.0)
    return float(neck[1]) + trunk_px * float(rng.uniform(LEAST_TRUNKS, MOST_TRUNKS))


def _photo(size: tuple[int, int], rng: np.random.Generator) -> Floats:
    """Corners of the photo on a canvas of ``size`` (w, h): all of it, or with black around it."""
    frame: Floats = np.array([0.0, 0.0, *size])
    if rng.random() < FRAMED:
        frame += rng.uniform(0, MOST_FRAME, 4) * np.tile(size, 2) * (1, 1, -1, -1)
    return np.rint(frame)


def _framed(image: Image, photo: Floats) -> Image:
    x0, y0, x1, y1 = (int(v) for v in photo)
    canvas = np.zeros_like(image)
    canvas[y0:y1, x0:x1] = image[y0:y1, x0:x1]
    return canvas


def _zoom(photo: Floats, tall_px: float, rng: np.random.Generator) -> float:
    share = float(np.exp(rng.uniform(np.log(SMALLEST), np.log(LARGEST))))
    return share * float(photo[3] - photo[1]) / max(tall_px, 1.0)


def _shift(
    photo: Floats, end: tuple[float, float], scale: float, flip: bool, rng: np.random.Generator
) -> Floats:
    """Where ``place`` must put an image for its point ``end`` to lie on the photo's lower edge."""
    x = photo[0] + rng.uniform(0.1, 0.9) * (photo[2] - photo[0])
    return np.array([x - scale * end[0] * (-1 if flip else 1), photo[3] - scale * end[1]])


def bust(
    crop: LabelledCrop, backs: list[Image], size: tuple[int, int], rng: np.random.Generator
) -> SceneSample:
    """Somebody who ``can_be_cut``, down to the photo's lower edge, on a canvas of ``size`` (w, h).

    The crop's own background is carried on, or it is one of ``backs``.
    """
    photo = _photo(size, rng)
    known = crop.weight > 0
    joints = crop.joints_px.astype(np.float64)
    lowest = min(float(joints[known, 1].max()), float(crop.image.shape[0] - 1))
    end = min(end_px(joints, rng), lowest)
    scale = _zoom(photo, end - float(joints[known, 1].min()), rng)
    flip = bool(rng.random() < 0.5)
    middle = float(joints[[NECK, R_HIP, L_HIP], 0] @ (0.5, 0.25, 0.25))
    shift = _shift(photo, (middle, end), scale, flip, rng)
    matrix = np.array([[-scale if flip else scale, 0, shift[0]], [0, scale, shift[1]]])
    trust = np.full((size[1] // 8, size[0] // 8), 0.4, np.float32)
    if whole(crop) and rng.random() < OTHER_GROUND:
        placed, _ = place(crop.image, size, scale, shift, flip, np.zeros(3))
        front, _ = place(silhouette(crop), size, scale, shift, flip, np.zeros(3))
        image = over(backdrop(backs, size, 0.7, rng), placed, front)
        trust[:] = 0.8
    else:
        image = cv2.warpAffine(crop.image, matrix, size, borderMode=cv2.BORDER_REPLICATE)
    box = seen_box(joints @ matrix[:, :2].T + matrix[:, 2], known, photo)
    boxes = np.array([] if box is None else [box], np.float32).reshape(-1, 4)
    if box is None:
        trust[:] = 0.0
    for corners in boxes:
        trust[cells(corners)] = 1.0
    return SceneSample(_framed(expose(image, rng), photo), boxes, trust)


def standing(scene: LabelledScene) -> NDArray[np.int64]:
    """Numbers of the people in a scene who surely stand and are large enough to be enlarged."""
    width, height = (scene.people[:, 2:4] - scene.people[:, :2]).T
    tall = (height > LEAST_TALL_PX) & (height > LEAST_ASPECT * width)
    return np.flatnonzero(tall & (scene.people[:, 4] >= SURE))


def close_up(scene: LabelledScene, size: tuple[int, int], rng: np.random.Generator) -> SceneSample:
    """A scene with somebody ``standing``, enlarged, that ends above their knees; (w, h) px."""
    photo = _photo(size, rng)
    who = int(rng.choice(standing(scene)))
    x0, y0, x1, y1 = (float(v) for v in scene.people[who, :4])
    tall = (y1 - y0) * float(rng.uniform(LEAST_SHARE, MOST_SHARE))
    scale = _zoom(photo, tall, rng)
    flip = bool(rng.random() < 0.5)
    shift = _shift(photo, (0.5 * (x0 + x1), y0 + tall), scale, flip, rng)
    image, matrix = place(scene.image, size, scale, shift, flip, rng.uniform(0, 255, 3))
    boxes = moved(scene.people, matrix) - np.tile(photo[:2], 2).astype(np.float32)
    shown, inside = still_inside(boxes, (int(photo[2] - photo[0]), int(photo[3] - photo[1])))
    shown = (shown + np.tile(photo[:2], 2)).astype(np.float32)
    found = inside & (scene.people[:, 4] >= SURE)
    found[who] = True
    trust = np.full((size[1] // 8, size[0] // 8), 0.25, np.float32)
    for box in shown[~found]:
        trust[cells(box)] = 0.0
    return SceneSample(_framed(expose(image, rng), photo), shown[found], trust)
