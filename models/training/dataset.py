"""Labelled person crops in memory: human labels and filtered teacher labels alike.

A dataset folder or tar holds JPEG crops and an ``annotations.json``; two dialects are read:
human labels (``joints_px`` + ``labelled``; rendered people too, whose records add ``visible`` per
joint and ``wild`` per image) and teacher labels (``mp33_px`` of a 33-landmark teacher plus
``cpm14_px``). Every joint carries a weight, 0 when nothing is known.
"""

from __future__ import annotations

import json
import tarfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import cv2
import numpy as np
from numpy.typing import NDArray

from library_store.skeleton import (
    HEAD_TOP,
    L_HIP,
    L_SHOULDER,
    LSP14,
    NECK,
    R_HIP,
    R_SHOULDER,
)
from models.errors import AnnotationError

MP33_LIMBS = (12, 14, 16, 11, 13, 15, 24, 26, 28, 23, 25, 27)
"""The teacher's landmarks for joints 2..13 of lsp14, in that order."""

Image = NDArray[Any]
"""(h, w, 3) uint8 BGR; OpenCV's type stubs promise less."""

TORSO = (R_SHOULDER, L_SHOULDER, R_HIP, L_HIP)

HOLD_OUT_ONE_IN = 7
DEV_LABELLED = 200
"""Labelled crops of each training file kept aside to choose by; lspet_val is only reported."""
DEV_RENDERED = 100


@dataclass(frozen=True)
class LabelledCrop:
    """One person. Pixels are the crop's own, centres at integers.

    ``image`` (h, w, 3) uint8 BGR; ``joints_px`` (14, 2) float32; ``weight`` (14,) float32, how far
    the position is trusted; ``visible`` (14,) float32, 1 where the joint is known to be seen;
    ``wild`` marks sport poses, which may stand on their heads; ``depths_px`` (14,) float32, how
    much farther than the hip midpoint, in pixels at its distance, nan where unknown (None: all).
    """

    name: str
    group: int
    image: Image
    joints_px: NDArray[np.float32]
    weight: NDArray[np.float32]
    visible: NDArray[np.float32]
    wild: bool
    depths_px: NDArray[np.float32] | None = None

    @property
    def extent_px(self) -> tuple[NDArray[np.float32], float]:
        """Centre (2,) and longer side of the box around the known joints."""
        known = self.joints_px[self.weight > 0]
        low, high = known.min(0), known.max(0)
        return (low + high) / 2, float((high - low).max())

    @property
    def has_torso(self) -> bool:
        """Shoulders and hips are labelled: without them there is no length to measure errors by."""
        return bool((self.weight[list(TORSO)] > 0).all())


def _files(path: Path) -> Iterator[tuple[str, bytes]]:
    if path.is_dir():
        for file in sorted(file for file in path.rglob("*") if file.is_file()):
            yield file.name, file.read_bytes()
        return
    with tarfile.open(path) as tar:
        for member in tar:
            stream = tar.extractfile(member)
            if stream is not None:
                yield Path(member.name).name, stream.read()


def _members(path: Path) -> Iterator[tuple[str, bytes]]:
    """Every file of a folder or tar by its bare name, whatever folders within it lies in."""
    seen: set[str] = set()
    for name, data in _files(path):
        if name.startswith("."):  # what macOS puts beside files
            continue
        if name in seen:
            raise AnnotationError(f"{path} has two files {name}: which is meant?")
        seen.add(name)
        yield name, data


def _is_jpeg(name: str) -> bool:
    return name.lower().endswith((".jpg", ".jpeg"))


def _decode(path: Path, name: str, data: bytes) -> Image:
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) if data else None
    if image is None:
        raise AnnotationError(f"{path}: {name} is no JPEG that can be decoded")
    return image


def decode_members(path: Path) -> dict[str, Image]:
    """Every JPEG of a folder or tar, by name, (h, w, 3) uint8 BGR.

    Raises ``AnnotationError`` when there is none, one that cannot be decoded, or a name twice.
    """
    images = {name: _decode(path, name, data) for name, data in _members(path) if _is_jpeg(name)}
    if not images:
        raise AnnotationError(f"{path} has no JPEG")
    return images


def _from_labels(record: dict[str, Any], image: Image, group: int) -> LabelledCrop | None:
    labelled = np.asarray(record["labelled"], np.float32)
    if labelled.sum() < 6:
        return None
    return LabelledCrop(
        name=record["image"],
        group=group,
        image=image,
        joints_px=np.asarray(record["joints_px"], np.float32),
        weight=labelled,
        visible=np.asarray(record.get("visible", labelled), np.float32) * labelled,
        wild=bool(record.get("wild", True)),
        depths_px=depths_of(record) if "joints_mm" in record else None,
    )


def depths_of(record: dict[str, Any]) -> NDArray[np.float32]:
    """Depths (14,) of a rendered person's joints less the hips', pixels at the hips' distance.

    Along the ray through the middle of the joints, which is how a crop shows them.
    """
    joints_mm = np.asarray(record["joints_mm"], np.float64)
    rays = joints_mm / np.linalg.norm(joints_mm, axis=1, keepdims=True)
    middle = rays.mean(0)
    depth_mm = joints_mm @ (middle / np.linalg.norm(middle))
    root_mm = 0.5 * (depth_mm[R_HIP] + depth_mm[L_HIP])
    depths: NDArray[np.float64] = (depth_mm / root_mm - 1.0) * float(record["focal_length_px"])
    return depths.astype(np.float32)


def _trust(
    joints_px: NDArray[np.float32], second_px: NDArray[np.float32], agreement: NDArray[np.float32]
) -> NDArray[np.float32]:
    """How far the first teacher's limbs (joints 2..13) are believed, (12,).

    The teachers err independently: agreement is the best sign that a label is right. Where they
    differ about the side only, the landmark network is right far more often than the small CPM.
    """
    torso = max(
        float(np.linalg.norm(joints_px[R_SHOULDER] - joints_px[L_HIP])),
        float(np.linalg.norm(joints_px[L_SHOULDER] - joints_px[R_HIP])),
        1.0,
    )
    other_side = second_px[list(LSP14.mirror)]
    side_only = np.linalg.norm(joints_px - other_side, axis=1)[2:] < 0.25 * torso
    trust = np.where(agreement < 0.6, 0.6, 0.35)
    trust = np.where(side_only, 0.8, trust)
    return np.where(agreement < 0.25, 1.0, trust).astype(np.float32)


def _from_teachers(record: dict[str, Any], image: Image) -> LabelledCrop | None:
    landmarks = np.asarray(record["mp33_px"], np.float32)
    visibility = np.asarray(record["mp_visibility"], np.float32)[list(MP33_LIMBS)]
    agreement = np.array([9.0 if v is None else v for v in record["agreement"]], np.float32)
    joints = np.zeros((LSP14.n_joints, 2), np.float32)
    weight = np.zeros(LSP14.n_joints, np.float32)
    visible = np.zeros(LSP14.n_joints, np.float32)
    joints[2:] = landmarks[list(MP33_LIMBS)]
    trust = _trust(joints, np.asarray(record["cpm14_px"], np.float32), agreement)
    weight[2:] = np.clip(visibility, 0.25, 1.0) * trust
    visible[2:] = ((visibility > 0.5) & (agreement < 0.25)).astype(np.float32)
    confidence = np.asarray(record["cpm_confidence"], np.float32)
    shoulders_agree = agreement[[0, 3]].max() < 0.35
    for joint in (HEAD_TOP, NECK):
        joints[joint] = record["cpm14_px"][joint]
        if shoulders_agree and confidence[joint] > 0.3:
            weight[joint] = confidence[joint]
            visible[joint] = float(confidence[joint] > 0.5)
    if weight[2:].sum() < 2.5:
        return None
    return LabelledCrop(
        name=record["image"],
        group=int(record["photo"]),
        image=image,
        joints_px=joints,
        weight=weight,
        visible=visible,
        wild=record["source"].startswith(("sports", "yoga")),
    )


def read_annotations(path: Path) -> list[dict[str, Any]]:
    """The records of a folder's or tar's ``annotations.json``, without the images."""
    for name, data in _members(path):
        if name == "annotations.json":
            records: list[dict[str, Any]] = json.loads(data)["images"]
            return records
    raise FileNotFoundError(f"{path} has no annotations.json")


def load(path: Path) -> list[LabelledCrop]:
    """Read every usable crop of a folder or tar; crops with hardly any label are left out.

    Raises ``AnnotationError`` for images that are missing or cannot be decoded.
    """
    images: dict[str, bytes] = {}
    annotations: dict[str, Any] | None = None
    for name, data in _members(path):
        if name == "annotations.json":
            annotations = json.loads(data)
        elif _is_jpeg(name):
            images[name] = data
    if annotations is None:
        raise FileNotFoundError(f"{path} has no annotations.json")
    crops: list[LabelledCrop] = []
    for i, record in enumerate(annotations["images"]):
        name = record["image"]
        if name not in images:
            raise AnnotationError(f"{path}: annotations.json names {name}, which is not there")
        image = _decode(path, name, images[name])
        by_hand = "labelled" in record
        crop = _from_labels(record, image, i) if by_hand else _from_teachers(record, image)
        if crop is not None:
            crops.append(crop)
    return crops


def in_held_out_group(group: int) -> bool:
    """Whether a photo, by its number, is held out."""
    return (group * 2654435761 % 2**32) % HOLD_OUT_ONE_IN == 0


def held_out(crop: LabelledCrop) -> bool:
    """Whether the photo that a crop was cut from is held out (whole photos at a time)."""
    return in_held_out_group(crop.group)


def with_depths(crops: list[LabelledCrop], path: Path) -> list[LabelledCrop]:
    """The crops with the depths that ``depth_teacher`` wrote for their set.

    Raises ``AnnotationError`` for another set's and for any other file.
    """
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as stored:
            depths = dict(zip(stored["image"].tolist(), stored["depths_px"], strict=True))
    except (OSError, ValueError, KeyError, TypeError, BadZipFile) as error:
        raise AnnotationError(f"{path} is not what depth_teacher wrote: {error}") from error
    if not depths.keys() >= {crop.name for crop in crops}:
        raise AnnotationError(f"{path} has the depths of another set")
    return [replace(crop, depths_px=depths[crop.name]) for crop in crops]


def read_crops(
    folder: Path, train: str, test: str, depths: Path | None = None
) -> tuple[list[LabelledCrop], dict[str, list[LabelledCrop]]]:
    """Training crops, and by name the held-out ones that errors can be measured on.

    Comma-separated names of tars in ``folder``, or paths, without ".tar"; ``name*2`` is drawn
    twice as often. Files called lspet* and rendered* are trained on whole but for their last crops,
    of others one photo in ``HOLD_OUT_ONE_IN`` is held out. ``depths`` is a folder with what
    ``depth_teacher`` wrote, a name.npz for sets without depths of their own; others have none.
    """
    crops: list[LabelledCrop] = []
    kept: dict[str, list[LabelledCrop]] = {"photos_dev": [], "labelled_dev": []}
    for item in train.split(","):
        name, _, times = item.partition("*")
        loaded = load(folder / f"{name}.tar")
        kind = Path(name).name
        if depths is not None and (depths / f"{kind}.npz").exists():
            loaded = with_depths(loaded, depths / f"{kind}.npz")
        if kind.startswith("lspet"):
            kept["labelled_dev"] += loaded[-DEV_LABELLED:]
            used = loaded[:-DEV_LABELLED]
        elif kind.startswith("rendered"):
            kept.setdefault("rendered_dev", []).extend(loaded[-DEV_RENDERED:])
            used = loaded[:-DEV_RENDERED]
        else:
            kept["photos_dev"] += [c for c in loaded if held_out(c)]
            used = [c for c in loaded if not held_out(c)]
        crops += used * int(times or 1)
    for name in filter(None, test.split(",")):
        kept[name] = load(folder / f"{name}.tar")
    return crops, {name: [c for c in those if c.has_torso] for name, those in kept.items()}
