"""Pictures of results: the 2D joints over the photo, and the 3D skeletons from new viewpoints.

Right limbs are orange, left limbs blue (the person's own right and left), the rest light grey.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from app.imaging import Photo
from app.lifting.types import LiftedPerson
from app.pipeline import PhotoResult, SeenPerson
from library_store.skeleton import L_HIP, LSP14, R_HIP

Floats = npt.NDArray[np.float64]
Image = npt.NDArray[np.uint8]
Colour = tuple[int, int, int]

_RIGHT: Colour = (48, 128, 255)
_LEFT: Colour = (255, 168, 64)
_MIDDLE: Colour = (225, 225, 225)
_BACKGROUND: Colour = (38, 34, 32)
_GRID: Colour = (74, 68, 64)
_SHADOW: Colour = (20, 18, 17)
_OUTLINE: Colour = (16, 14, 12)
_TEXT: Colour = (200, 196, 192)

_BONES = (*LSP14.edges, (R_HIP, L_HIP))
_SUBPIXEL_BITS = 4
_GRID_STEP_MM = 500.0


@dataclass(frozen=True)
class Viewpoint:
    """A direction to look from: turned about the vertical, then raised; 0, 0 is the photo's."""

    title: str
    azimuth_deg: float
    elevation_deg: float

    def rotation(self) -> Floats:
        """(3, 3) from the photo's camera axes to this view's (x right, y down, z away)."""
        turn, rise = np.radians([self.azimuth_deg, self.elevation_deg])
        about_y = np.array(
            [[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]]
        )
        about_x = np.array(
            [[1, 0, 0], [0, np.cos(rise), -np.sin(rise)], [0, np.sin(rise), np.cos(rise)]]
        )
        rotation: Floats = about_x @ about_y
        return rotation


NOVEL_VIEWS = (
    Viewpoint("from the side, 90 deg", 90.0, 8.0),
    Viewpoint("from above, 35 deg round, 30 deg up", -35.0, 30.0),
)


def draw_result(photo: Photo, result: PhotoResult, *, height_px: int = 720) -> Image:
    """The photo with everybody's joints, and two novel views of the 3D skeletons beside it.

    Args:
        photo: the decoded photo ``result`` is about.
        result: what the pipeline found in it.
        height_px: height of the picture.

    Returns:
        (height_px, w, 3) uint8 BGR.

    """
    panels = [draw_overlay(photo, result.people, height_px=height_px)]
    poses = [
        person.lifted.joints_3d_mm
        for person in result.people
        if isinstance(person.lifted, LiftedPerson)
    ]
    panels += [draw_skeletons(poses, view, side_px=height_px) for view in NOVEL_VIEWS]
    return np.concatenate(panels, axis=1)


def draw_overlay(photo: Photo, people: Sequence[SeenPerson], *, height_px: int) -> Image:
    """The photo at this height with boxes, limbs and joints; faint where confidence is low."""
    scale = height_px / photo.pixels_bgr.shape[0]
    canvas = cv2.resize(
        photo.pixels_bgr,
        (max(1, round(scale * photo.pixels_bgr.shape[1])), height_px),
        interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC,
    ).astype(np.uint8, copy=False)
    to_pixel = scale / photo.reduction
    thickness = max(2, height_px // 180)
    for person in people:
        joints = (person.joints_px - photo.offset_px) * to_pixel
        strength = np.ones(len(joints)) if person.confidence is None else person.confidence
        strength = np.where(person.present, strength, 0.0)
        faded = canvas.copy()
        for parent, child in _BONES:
            sure = min(strength[parent], strength[child]) >= 0.5
            if person.present[parent] and person.present[child]:
                target = canvas if sure else faded
                _line(target, joints[parent], joints[child], _OUTLINE, thickness + 2)
                _line(target, joints[parent], joints[child], _bone_colour(child), thickness)
        canvas = cv2.addWeighted(canvas, 0.6, faded, 0.4, 0).astype(np.uint8, copy=False)
        for joint, position in enumerate(joints):
            if person.present[joint]:
                filled = -1 if strength[joint] >= 0.5 else 1
                _disc(canvas, position, thickness + 1, _OUTLINE, -1 if filled < 0 else 3)
                _disc(canvas, position, thickness, _bone_colour(joint), filled)
        x, y, _, _ = person.box_px
        if person.score is not None:
            anchor = ((x - photo.offset_px[0]) * to_pixel, (y - photo.offset_px[1]) * to_pixel - 6)
            _text(canvas, f"{person.score:.2f}", anchor)
    return canvas


def draw_skeletons(poses_mm: Sequence[Floats], view: Viewpoint, *, side_px: int) -> Image:
    """Orthographic view of (14, 3) camera-frame poses over a ground grid of half-metre cells.

    The ground is horizontal for the photo's camera, under the lowest joint.
    """
    canvas: Image = np.full((side_px, side_px, 3), _BACKGROUND, np.uint8)
    _text(canvas, view.title, (12, 24))
    if not poses_mm:
        _text(canvas, "no 3D", (side_px / 2 - 30, side_px / 2))
        return canvas
    points = np.concatenate(list(poses_mm))
    floor_mm = points[:, 1].max()
    corners = _grid_corners(points, floor_mm)
    rotation = view.rotation()
    seen = np.concatenate([points, corners]) @ rotation.T
    low, high = seen[:, :2].min(axis=0), seen[:, :2].max(axis=0)
    scale = 0.9 * side_px / max(high - low)
    middle = (low + high) / 2

    def to_pixel(points_mm: Floats) -> Floats:
        flat: Floats = ((points_mm @ rotation.T)[..., :2] - middle) * scale + side_px / 2
        return flat

    _draw_grid(canvas, corners, to_pixel)
    thickness = max(3, side_px // 140)
    for pose in poses_mm:
        shadow = to_pixel(np.column_stack([pose[:, 0], np.full(len(pose), floor_mm), pose[:, 2]]))
        for parent, child in _BONES:
            _line(canvas, shadow[parent], shadow[child], _SHADOW, thickness)
    bones = [
        (float((pose[[parent, child]] @ rotation[2]).mean()), to_pixel(pose), parent, child)
        for pose in poses_mm
        for parent, child in _BONES
    ]
    for _, flat, parent, child in sorted(bones, key=lambda bone: -bone[0]):
        _line(canvas, flat[parent], flat[child], _OUTLINE, thickness + 3)
        _line(canvas, flat[parent], flat[child], _bone_colour(child), thickness)
        _disc(canvas, flat[child], thickness // 2 + 2, _bone_colour(child), -1)
    _text(canvas, "grid 0.5 m", (12, side_px - 14))
    return canvas


def _grid_corners(points_mm: Floats, floor_mm: float) -> Floats:
    """(4, 3) corners of the ground under the points, on whole grid steps."""
    low = np.floor(points_mm[:, [0, 2]].min(axis=0) / _GRID_STEP_MM - 0.5) * _GRID_STEP_MM
    high = np.ceil(points_mm[:, [0, 2]].max(axis=0) / _GRID_STEP_MM + 0.5) * _GRID_STEP_MM
    return np.array([[x, floor_mm, z] for x in (low[0], high[0]) for z in (low[1], high[1])])


def _draw_grid(canvas: Image, corners: Floats, to_pixel: object) -> None:
    assert callable(to_pixel)
    (x0, floor, z0), (x1, _, z1) = corners[0], corners[3]
    for x in np.linspace(x0, x1, round((x1 - x0) / _GRID_STEP_MM) + 1):
        a, b = to_pixel(np.array([[x, floor, z0], [x, floor, z1]]))
        _line(canvas, a, b, _GRID, 1)
    for z in np.linspace(z0, z1, round((z1 - z0) / _GRID_STEP_MM) + 1):
        a, b = to_pixel(np.array([[x0, floor, z], [x1, floor, z]]))
        _line(canvas, a, b, _GRID, 1)


def _bone_colour(joint: int) -> Colour:
    name = LSP14.joint_names[joint]
    return _RIGHT if name.startswith("r_") else _LEFT if name.startswith("l_") else _MIDDLE


def _fixed(point: Floats | tuple[float, float]) -> tuple[int, int]:
    x, y = np.clip(np.asarray(point, np.float64), -1e5, 1e5) * (1 << _SUBPIXEL_BITS)
    return round(float(x)), round(float(y))


def _line(canvas: Image, a: Floats, b: Floats, colour: Colour, thickness: int) -> None:
    cv2.line(canvas, _fixed(a), _fixed(b), colour, thickness, cv2.LINE_AA, _SUBPIXEL_BITS)


def _disc(canvas: Image, centre: Floats, radius: int, colour: Colour, thickness: int) -> None:
    fixed_radius = radius << _SUBPIXEL_BITS
    cv2.circle(canvas, _fixed(centre), fixed_radius, colour, thickness, cv2.LINE_AA, _SUBPIXEL_BITS)


def _text(canvas: Image, text: str, anchor: tuple[float, float]) -> None:
    x, y = round(anchor[0]), max(14, round(anchor[1]))
    for colour, shift in ((_OUTLINE, 1), (_TEXT, 0)):
        place = x + shift, y + shift
        cv2.putText(canvas, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.5, colour, 1, cv2.LINE_AA)
