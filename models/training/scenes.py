"""Scenes for the person network: teacher-labelled photos, and mosaics whose boxes are exact."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from models.errors import AnnotationError
from models.training.augment import expose
from models.training.cutout import place
from models.training.dataset import Image, LabelledCrop, decode_members

SURE, UNSURE = 0.6, 0.3
DEV_ONE_IN = 8
"""One labelled scene in so many is held out from training."""


@dataclass(frozen=True)
class LabelledScene:
    """A photo and the teacher's ``people`` (n, 5): corner box in px and score."""

    image: Image
    people: NDArray[np.float32]


def read_people(labels: Path) -> dict[str, NDArray[np.float32]]:
    """What ``label_scenes`` wrote: by image the boxes and scores (n, 5), in its order."""
    return {
        record["image"]: np.array(record["people"], np.float32).reshape(-1, 5)
        for record in json.loads(labels.read_text())
    }


def read_scenes(images: Path, labels: Path) -> tuple[list[LabelledScene], list[LabelledScene]]:
    """The scenes to train on and the held-out ones, as ``label_scenes`` labelled them.

    Raises ``AnnotationError`` where labels are of other scenes.
    """
    pictures = decode_members(images)
    people = read_people(labels)
    missing = sorted(people.keys() - pictures.keys())
    if missing:
        raise AnnotationError(f"{labels} labels {missing[0]}, which is not in {images}")
    scenes = [LabelledScene(pictures[name], boxes) for name, boxes in people.items()]
    return [s for i, s in enumerate(scenes) if i % DEV_ONE_IN], scenes[::DEV_ONE_IN]


@dataclass(frozen=True)
class SceneSample:
    """Network input and labels.

    ``image`` (h, w, 3) uint8 BGR; ``boxes`` (n, 4) corners in px; ``trust`` (h/8, w/8) float32:
    how much a cell without a person may be counted as empty.
    """

    image: Image
    boxes: NDArray[np.float32]
    trust: NDArray[np.float32]


def moved(boxes: NDArray[np.float32], matrix: NDArray[np.float32]) -> NDArray[np.float32]:
    """Corner boxes (n, 4+) after an affine without rotation, (n, 4)."""
    a = boxes[:, :2] @ matrix[:, :2].T + matrix[:, 2]
    b = boxes[:, 2:4] @ matrix[:, :2].T + matrix[:, 2]
    corners: NDArray[np.float32] = np.concatenate([np.minimum(a, b), np.maximum(a, b)], 1)
    return corners


def still_inside(
    boxes: NDArray[np.float32], size: tuple[int, int]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Boxes cut at the canvas, and which of them have kept enough of themselves to be found."""
    clipped = np.clip(boxes, 0, np.array([*size, *size], np.float32) - 1)
    area = np.prod(boxes[:, 2:] - boxes[:, :2], axis=1)
    left = np.prod(clipped[:, 2:] - clipped[:, :2], axis=1)
    return clipped, left > 0.4 * np.maximum(area, 1)


def cells(box: NDArray[np.float32], stride: int = 8) -> tuple[slice, slice]:
    """Rows and columns of the map at ``stride`` that a corner box touches."""
    x0, y0 = (int(max(v, 0) // stride) for v in box[:2])
    x1, y1 = (int(max(v, 0) // stride) + 1 for v in box[2:4])
    return slice(y0, y1), slice(x0, x1)


def scene_view(
    scene: LabelledScene, size: tuple[int, int], rng: np.random.Generator
) -> SceneSample:
    """A random zoom into, or out of, a teacher-labelled scene; ``size`` is (w, h)."""
    h, w = scene.image.shape[:2]
    fit = min(size[0] / w, size[1] / h)
    scale = fit * float(np.exp(rng.uniform(np.log(0.6), np.log(2.2))))
    flip = bool(rng.random() < 0.5)
    free = np.array(size) - scale * np.array([w, h])
    shift = rng.uniform(np.minimum(free, 0), np.maximum(free, 0))
    if flip:
        shift[0] += scale * w
    image, matrix = place(scene.image, size, scale, shift, flip, rng.uniform(0, 255, 3))
    trust = np.full((size[1] // 8, size[0] // 8), 0.25 if len(scene.people) else 1.0, np.float32)
    boxes, inside = still_inside(moved(scene.people, matrix), size)
    score = scene.people[:, 4]
    for box in boxes[~inside | (score < SURE)]:
        trust[cells(box)] = 0.0
    # A sure box says that its surroundings were looked at as well.
    return SceneSample(expose(image, rng), boxes[inside & (score >= SURE)], trust)


def turned(sample: SceneSample, quarters: int) -> SceneSample:
    """The sample turned clockwise by so many quarters; odd ones exchange width and height."""
    image, boxes, trust = sample.image, sample.boxes, sample.trust
    for _ in range(quarters % 4):
        x0, y0, x1, y1 = boxes.T
        bottom = image.shape[0] - 1
        boxes = np.stack([bottom - y1, x0, bottom - y0, x1], 1)
        image, trust = np.rot90(image, -1), np.rot90(trust, -1)
    return SceneSample(np.ascontiguousarray(image), boxes, np.ascontiguousarray(trust))


def portrait(crop: LabelledCrop, size: tuple[int, int], rng: np.random.Generator) -> SceneSample:
    """One crop over the whole canvas: a photo of one person.

    Beyond the crop its background is carried on, or it is black: as in a detector's second pass
    over a photo that somebody fills, ``PersonDetector.detect_close``.
    """
    box = box_of(crop)
    cover = max(size) / max(crop.image.shape[:2])
    scale = cover * float(np.exp(rng.uniform(np.log(0.6), np.log(1.4))))
    flip = bool(rng.random() < 0.5)
    mid = (box[0, :2] + box[0, 2:]) / 2 * scale
    at = np.array(size) * rng.uniform(0.35, 0.65, 2)
    matrix = np.array([[-scale if flip else scale, 0, 0], [0, scale, 0]])
    matrix[:, 2] = at - mid * (-1 if flip else 1, 1)
    beyond = cv2.BORDER_CONSTANT if rng.random() < 0.5 else cv2.BORDER_REPLICATE
    image = cv2.warpAffine(crop.image, matrix, size, borderMode=beyond)
    boxes, inside = still_inside(moved(box, matrix.astype(np.float32)), size)
    trust = np.full((size[1] // 8, size[0] // 8), 0.4, np.float32)
    for b in boxes:
        trust[cells(b)] = 1.0 if inside[0] else 0.0
    return SceneSample(expose(image, rng), boxes[inside], trust)


def _paste_decoys(image: Image, empty: list[Image], rng: np.random.Generator) -> None:
    """Patches without people, in place: a pasted rectangle alone must not look like a person."""
    height, width = image.shape[:2]
    for _ in range(rng.integers(0, 4)):
        source = empty[rng.integers(len(empty))]
        w, h = (int(v) for v in np.exp(rng.uniform(np.log(16), np.log(160), 2)))
        w, h = min(w, width - 1), min(h, height - 1)
        sw = int(rng.uniform(0.2, 1) * source.shape[1])
        sh = int(rng.uniform(0.2, 1) * source.shape[0])
        sx = int(rng.integers(0, source.shape[1] - sw + 1))
        sy = int(rng.integers(0, source.shape[0] - sh + 1))
        x, y = int(rng.integers(0, width - w)), int(rng.integers(0, height - h))
        patch = source[sy : sy + sh, sx : sx + sw]
        image[y : y + h, x : x + w] = cv2.resize(patch, (w, h), interpolation=cv2.INTER_AREA)


def box_of(crop: LabelledCrop) -> NDArray[np.float32]:
    """The corner box around the known joints, (1, 4) px of the crop."""
    known = crop.joints_px[crop.weight > 0]
    return np.concatenate([known.min(0), known.max(0)])[None].astype(np.float32)


def backdrop(
    backs: list[Image], size: tuple[int, int], log_zoom: float, rng: np.random.Generator
) -> Image:
    """One of ``backs`` over a canvas of ``size`` (w, h), enlarged up to e^``log_zoom`` times."""
    back = backs[rng.integers(len(backs))]
    cover = max(size[0] / back.shape[1], size[1] / back.shape[0])
    zoom = float(np.exp(rng.uniform(0, log_zoom))) * cover
    free = np.array(size) - zoom * np.array(back.shape[1::-1])
    image, _ = place(back, size, zoom, rng.uniform(free, 0), False, np.zeros(3))
    return image


def mosaic(
    crops: list[LabelledCrop],
    empty: list[Image],
    size: tuple[int, int],
    rng: np.random.Generator,
) -> SceneSample:
    """People cut out of their crops on a background without any (0 to 4 of them)."""
    image = backdrop(empty, size, 1.0, rng)
    _paste_decoys(image, empty, rng)
    trust = np.ones((size[1] // 8, size[0] // 8), np.float32)
    boxes: list[NDArray[np.float32]] = []
    many = int(rng.choice([0, 1, 2, 3, 4], p=[0.12, 0.4, 0.23, 0.15, 0.1]))
    for index in rng.integers(0, len(crops), many):
        crop = crops[index]
        box = box_of(crop)
        extent = float((box[0, 2:] - box[0, :2]).max())
        largest = 1.05 * size[1] if many == 1 else 0.7 * size[1]
        scale = float(np.exp(rng.uniform(np.log(28), np.log(largest)))) / extent
        flip = bool(rng.random() < 0.5)
        at = rng.uniform(-0.05, 1.05, 2) * size
        mid = (box[0, :2] + box[0, 2:]) / 2 * scale
        shift = at - mid * (-1 if flip else 1, 1)
        placed, matrix = place(crop.image, size, scale, shift, flip, np.zeros(3))
        shown, inside = still_inside(moved(box, matrix), size)
        corners = np.array([[0, 0, crop.image.shape[1] - 1, crop.image.shape[0] - 1]], np.float32)
        whole = moved(corners, matrix)[0]
        # How much of the crop's own background comes along varies, so that seams teach nothing.
        keep = moved(box, matrix)[0]
        margin = rng.uniform(0.04, 0.35, 4) * extent * scale
        keep = np.clip(
            keep + margin * (-1, -1, 1, 1), [*whole[:2], *whole[:2]], [*whole[2:], *whole[2:]]
        )
        x0, y0 = (int(max(v, 0)) for v in keep[:2])
        x1, y1 = (int(max(v, 0)) for v in keep[2:])
        if not inside[0]:
            continue
        covered = [
            b
            for b in boxes
            if b[0] >= x0 - 8 and b[1] >= y0 - 8 and b[2] <= x1 + 8 and b[3] <= y1 + 8
        ]
        if covered:
            continue
        image[y0:y1, x0:x1] = placed[y0:y1, x0:x1]
        trust[cells(keep)] = 0.4  # a crop may show others too, nobody labelled them
        trust[cells(shown[0])] = 1.0
        boxes.append(shown[0])
    stacked = np.array(boxes, np.float32).reshape(-1, 4)
    return SceneSample(expose(image, rng), stacked, trust)
