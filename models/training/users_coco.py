"""A user's own labelled images: a COCO keypoints file and the folder its images lie in.

Keypoints are taken by their names in ``categories[*].keypoints``: shoulders, elbows, wrists, hips,
knees and ankles with ``left_``/``right_`` (or ``l_``/``r_``) before them, and ``neck`` and
``head_top`` where there are any; others (eyes, ears, toes) are left out, and so are categories
without these limbs. Visibility is COCO's: 0 not labelled, 1 labelled but hidden, 2 seen; null and
NaN, which some tools write for what is not labelled, are taken for 0. Pixels are those of the
stored file, or of the photo turned upright, as its EXIF orientation says (phones' photos in tools
that show them upright): whichever has the size that the file of labels states.
"""

from __future__ import annotations

import codecs
import hashlib
import re
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ValidationError

from library_store.skeleton import LSP14, NECK
from models.crop import square_crop
from models.errors import AnnotationError
from models.training.dataset import Image, LabelledCrop

KEPT_SCALE = 1.6
"""Side of the square kept around a person over the joints' extent: room for random views."""
KEPT_PX = 256
LEAST_JOINTS = 6
_HEAD = {"head_top": "head_top", "top_head": "head_top", "headtop": "head_top", "neck": "neck"}
_LIMB = re.compile(r"(l|left|r|right)_?(shoulder|elbow|wrist|hip|knee|ankle)")


class _Image(BaseModel):
    id: int
    file_name: str
    width: int | None = None
    height: int | None = None


class _Annotation(BaseModel):
    id: int | None = None
    image_id: int
    category_id: int
    keypoints: list[float | None] | None = None
    iscrowd: int | None = None


class _Category(BaseModel):
    id: int
    keypoints: list[str] | None = None


class _Coco(BaseModel):
    images: list[_Image]
    annotations: list[_Annotation]
    categories: list[_Category]


def read_coco(annotations: Path, images: Path) -> list[LabelledCrop]:
    """Every person with at least six labelled joints, grouped by image file.

    Raises ``AnnotationError`` at the first thing that makes the labels doubtful: a record that is
    not COCO's, an image that is missing or of another size, coordinates that cannot be pixels.
    """
    coco = _parse(annotations)
    joints = _joints_by_category(annotations, coco)
    if not joints and any(record.keypoints for record in coco.annotations):
        raise AnnotationError(
            f"{annotations}: people have keypoints, but no category says in "
            "categories[*].keypoints what each is called: add their names, like left_shoulder, in "
            "their order"
        )
    if not joints:
        raise AnnotationError(
            f"{annotations}: no category has keypoints; is it a file of boxes only? "
            "person_keypoints_*.json is wanted"
        )
    files: dict[int, _Image] = {}
    for image in coco.images:
        if files.setdefault(image.id, image).file_name != image.file_name:
            raise AnnotationError(
                f"{annotations}: image {image.id} is {files[image.id].file_name} and again "
                f"{image.file_name}; whose are its labels?"
            )
    people: dict[int, list[tuple[str, NDArray[np.float64]]]] = {}
    for index, record in enumerate(coco.annotations):
        name = f"annotation {index if record.id is None else record.id}"
        if record.iscrowd or record.category_id not in joints:
            continue
        keypoints = np.array(record.keypoints or [], np.float64)
        if not np.nan_to_num(keypoints).any():
            continue
        if record.image_id not in files:
            raise AnnotationError(
                f"{annotations}: {name} is of image {record.image_id}, which is not among images"
            )
        points = _points(annotations, name, keypoints, joints[record.category_id])
        if (points[:, 2] > 0).sum() >= LEAST_JOINTS:
            people.setdefault(record.image_id, []).append((name, points))
    if not people:
        raise AnnotationError(
            f"{annotations}: nobody has {LEAST_JOINTS} labelled joints or more; nothing to learn"
        )
    crops = []
    groups: dict[bytes, int] = {}
    for image_id, persons in sorted(people.items()):
        file = files[image_id]
        pixels = _read_image(annotations, images, file)
        # Merged sets have photos twice: whoever is held out must not be trained on under another
        # id or name.
        group = groups.setdefault(hashlib.sha256(pixels.tobytes()).digest(), image_id)
        for name, points in persons:
            _check_points(annotations, name, points, pixels)
            crops.append(cut_out(f"{file.file_name}/{name}", group, pixels, points))
    return crops


def cut_out(
    name: str, group: int, pixels: Image, points: NDArray[np.float64], *, wild: bool = False
) -> LabelledCrop:
    """The square around a person, at most KEPT_PX wide; ``points`` (14, 3) x, y, visibility."""
    known = points[:, 2] > 0
    low, high = points[known, :2].min(0), points[known, :2].max(0)
    center, extent = (low + high) / 2, max(float((high - low).max()), 1.0)
    side = KEPT_SCALE * extent
    size = max(8, min(KEPT_PX, round(side)))
    crop, scale, origin = square_crop(pixels, (float(center[0]), float(center[1])), side, size)
    joints = (points[:, :2] - np.array(origin)) / scale
    return LabelledCrop(
        name=name,
        group=group,
        image=crop,
        joints_px=np.where(known[:, None], joints, 0).astype(np.float32),
        weight=known.astype(np.float32),
        visible=(points[:, 2] > 1).astype(np.float32),
        wild=wild,
    )


def _parse(path: Path) -> _Coco:
    try:
        return _Coco.model_validate_json(path.read_bytes().removeprefix(codecs.BOM_UTF8))
    except FileNotFoundError:
        raise AnnotationError(f"{path}: there is no such file") from None
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"]) or "the file"
        raise AnnotationError(
            f"{path} is no COCO keypoints file: {where}: {first['msg']}; wanted are images, "
            "annotations and categories as on cocodataset.org/#format-data"
        ) from None


def _joints_by_category(path: Path, coco: _Coco) -> dict[int, list[int | None]]:
    """By category, which joint each keypoint is; those that are no people (dogs) left out."""
    found: dict[int, list[int | None]] = {}
    problems: list[AnnotationError] = []
    for category in coco.categories:
        if category.keypoints:
            try:
                found[category.id] = _joints(path, category.id, category.keypoints)
            except AnnotationError as error:
                problems.append(error)
    if problems and not found:
        raise problems[0]
    return found


def _joints(path: Path, category: int, names: list[str]) -> list[int | None]:
    """Which lsp14 joint each keypoint of a category is, None for those that are none."""
    joints: list[int | None] = []
    for raw in names:
        name = re.sub(r"[\s\-]+", "_", raw.strip().lower())
        limb = _LIMB.fullmatch(name)
        joint = f"{limb[1][0]}_{limb[2]}" if limb else _HEAD.get(name)
        index = None if joint is None else LSP14.joint_names.index(joint)
        if index is not None and index in joints:
            raise AnnotationError(
                f"{path}: category {category} has two keypoints for {joint}: which is it?"
            )
        joints.append(index)
    missing = sorted(
        name for j, name in enumerate(LSP14.joint_names) if j > NECK and j not in joints
    )
    if missing:
        raise AnnotationError(
            f"{path}: category {category} lacks the keypoints {', '.join(missing)}; it has "
            f"{', '.join(names)}. Rename them like left_shoulder"
        )
    return joints


def _points(
    path: Path, name: str, values: NDArray[np.float64], joints: list[int | None]
) -> NDArray[np.float64]:
    """(14, 3): x, y, visibility."""
    if len(values) != 3 * len(joints):
        raise AnnotationError(
            f"{path}: {name} has {len(values)} numbers in keypoints, wanted are x, y, visibility "
            f"for each of its category's {len(joints)} keypoints"
        )
    triples = values.reshape(-1, 3)
    visibility = np.nan_to_num(triples[:, 2])
    if not np.isin(visibility, (0, 1, 2)).all():
        raise AnnotationError(
            f"{path}: {name} has a visibility that is not 0, 1 or 2: keypoints are x, y, "
            "visibility; confidences have to be made into labels first"
        )
    labelled = visibility > 0
    if not np.isfinite(triples[labelled]).all():
        raise AnnotationError(
            f"{path}: {name} has a keypoint with a visibility over 0, but its x or y is no number"
        )
    points = np.zeros((LSP14.n_joints, 3))
    for joint, triple in zip(joints, np.where(labelled[:, None], triples, 0.0), strict=True):
        if joint is not None:
            points[joint] = triple
    return points


def _read_image(annotations: Path, folder: Path, record: _Image) -> Image:
    path = folder / record.file_name
    if not path.is_file():
        raise AnnotationError(
            f"{annotations}: image {record.id} is {path}, which does not exist; "
            "is this the folder that file_name is relative to?"
        )
    data = path.read_bytes()
    ways = [cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION]
    if b"exif" in data.lower():
        ways.append(cv2.IMREAD_COLOR)
    decoded = [cv2.imdecode(np.frombuffer(data, np.uint8), way) if data else None for way in ways]
    found = [np.asarray(pixels, np.uint8) for pixels in decoded if pixels is not None]
    if not found:
        raise AnnotationError(f"{path} is no image that can be decoded")
    height, width = found[0].shape[:2]
    fitting = [
        pixels
        for pixels in found
        if record.width in (None, 0, pixels.shape[1])
        and record.height in (None, 0, pixels.shape[0])
    ]
    if not fitting:
        raise AnnotationError(
            f"{path} is {width}x{height} px, but {annotations} labelled an image of "
            f"{record.width or width}x{record.height or height}: it was resized or turned since"
        )
    if not np.array_equal(fitting[0], fitting[-1]):
        raise AnnotationError(
            f"{path} is to be turned by its EXIF orientation, and {annotations} does not tell "
            "whether it was labelled so: its size fits either way. Store it turned, without the "
            "orientation; if it was labelled as it is stored, drop the orientation alone"
        )
    return fitting[0]


def _check_points(path: Path, name: str, points: NDArray[np.float64], pixels: Image) -> None:
    known = points[points[:, 2] > 0, :2]
    height, width = pixels.shape[:2]
    if (known <= 1).all():
        raise AnnotationError(
            f"{path}: all keypoints of {name} lie within 0..1: they look divided by the image's "
            "size; COCO has pixels"
        )
    slack = 0.1 * max(height, width)
    if (known < -slack).any() or (known > (width + slack, height + slack)).any():
        x, y = known[np.argmax(np.abs(known - (width / 2, height / 2)).max(1))]
        raise AnnotationError(
            f"{path}: {name} has a keypoint at ({x:g}, {y:g}), far outside its image of "
            f"{width}x{height} px"
        )
    if np.ptp(known, axis=0).max() < 4:
        raise AnnotationError(f"{path}: the keypoints of {name} all lie on one spot")
