"""Crowds for the person network: people cut out along their limbs, set before and behind others.

Whole crops pasted side by side (scenes.mosaic) never overlap, people in photos do. Here a person
is cut out by thick strokes along the labelled bones, so that others stay visible around the limbs.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from models.training.augment import expose
from models.training.cutout import Mask, over, place, silhouette
from models.training.dataset import Image, LabelledCrop
from models.training.scenes import (
    LabelledScene,
    SceneSample,
    backdrop,
    box_of,
    cells,
    moved,
    scene_view,
    still_inside,
)

SEEN, HARDLY_SEEN = 0.45, 0.2
"""Visible share of somebody from which the box is to be found, and to which nobody can tell."""


@dataclass
class Member:
    """Somebody in the picture so far: the box, the share of the canvas covered and still seen."""

    box: NDArray[np.float32]
    mask: Mask | None
    area: float
    seen: float

    @property
    def share(self) -> float:
        """How much of the person can still be seen, 0..1."""
        return self.seen / max(self.area, 1.0)

    def hide_behind(self, front: Mask) -> None:
        """Take off what ``front`` (canvas) hides of this person."""
        if self.mask is None:  # known by the box alone
            rows, columns = cells(self.box, 1)
            self.seen -= float(front[rows, columns].sum())
        else:
            self.mask *= 1 - front
            self.seen = float(self.mask.sum())


def crowd(
    crops: list[LabelledCrop],
    backs: list[Image],
    scenes: list[LabelledScene],
    size: tuple[int, int],
    rng: np.random.Generator,
) -> SceneSample:
    """Two to six people of similar size who overlap, before a scene or a background; (w, h) px.

    ``crops`` should know all their joints (``whole``): what has no label is not cut out.
    """
    if rng.random() < 0.5:
        scene = scene_view(scenes[rng.integers(len(scenes))], size, rng)
        image, trust = scene.image, scene.trust
        areas = np.prod(scene.boxes[:, 2:] - scene.boxes[:, :2], axis=1)
        members = [
            Member(box, None, float(area), float(area))
            for box, area in zip(scene.boxes, areas, strict=True)
        ]
    else:
        image = backdrop(backs, size, 0.7, rng)
        trust = np.full((size[1] // 8, size[0] // 8), 0.6, np.float32)
        members = []
    height = float(np.exp(rng.uniform(np.log(36), np.log(0.9 * size[1]))))
    middle = rng.uniform(0.15, 0.85, 2) * size
    unsure: list[NDArray[np.float32]] = []
    for _ in range(rng.integers(2, 7)):
        crop = crops[rng.integers(len(crops))]
        box = box_of(crop)
        extent = float((box[0, 2:] - box[0, :2]).max())
        scale = height * float(np.exp(rng.normal(0, 0.15))) / extent
        flip = bool(rng.random() < 0.5)
        shift = middle - (box[0, :2] + box[0, 2:]) / 2 * scale * (-1 if flip else 1, 1)
        fill = np.zeros(3)
        placed, matrix = place(crop.image, size, scale, shift, flip, fill)
        boxes, inside = still_inside(moved(box, matrix), size)
        # The next one stands beside, at arm's length or closer.
        side = 1 if rng.random() < 0.5 else -1
        width = float(boxes[0, 2] - boxes[0, 0])
        middle[0] += side * rng.uniform(0.3, 1.0) * max(width, 0.3 * height)
        middle = np.clip(middle + rng.normal(0, 0.08 * height, 2), 0, size)
        if not inside[0]:
            continue
        front, _ = place(silhouette(crop), size, scale, shift, flip, fill)
        image = over(image, placed, front)
        for member in members:
            member.hide_behind(front)
        area = float(front.sum())
        members.append(Member(boxes[0], front.copy(), area, area))
    visible = []
    for member in members:
        if member.share > SEEN:
            visible.append(member.box)
        elif member.share > HARDLY_SEEN:
            unsure.append(member.box)
    for box in unsure:
        trust[cells(box)] = 0.0
    for box in visible:
        trust[cells(box)] = 1.0
    stacked = np.array(visible, np.float32).reshape(-1, 4)
    return SceneSample(expose(image, rng), stacked, trust)


def calm_patches(scenes: list[LabelledScene], rng: np.random.Generator) -> list[Image]:
    """Up to two patches a scene that come near no box of the teacher's, however unsure."""
    patches: list[Image] = []
    for scene in scenes:
        h, w = scene.image.shape[:2]
        rim = 0.15 * (scene.people[:, 2:4] - scene.people[:, :2])
        low, high = scene.people[:, :2] - rim, scene.people[:, 2:4] + rim
        kept = 0
        for _ in range(60):
            side = rng.uniform(0.3, 0.9, 2) * (w, h)
            corner = rng.uniform(0, 1, 2) * (np.array([w, h]) - side)
            if ((np.minimum(high, corner + side) > np.maximum(low, corner)).all(1)).any():
                continue
            x, y, sw, sh = (int(v) for v in (*corner, *side))
            patches.append(np.ascontiguousarray(scene.image[y : y + sh, x : x + sw]))
            kept += 1
            if kept == 2:
                break
    return patches
