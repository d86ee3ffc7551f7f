"""What is on the pictures: joints over the photo; people, exemplars, camera and ground in 3D."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from app.drawing.picture import (
    Area,
    Colour,
    Disc,
    Floats,
    Mark,
    Photograph,
    Picture,
    Stroke,
    Words,
)
from app.imaging import Photo
from app.lifting.types import Intrinsics, LiftedPerson
from app.pipeline import PhotoResult, SeenPerson
from library_store.skeleton import L_HIP, LSP14, R_HIP

_PAPER: Colour = (255, 255, 255)
_INK: Colour = (30, 28, 25)
_SOFT: Colour = (110, 104, 95)
_GRID: Colour = (222, 217, 208)
_SHADOW: Colour = (205, 199, 188)
_GHOST: Colour = (168, 162, 152)
_RIGHT: Colour = (214, 84, 22)
_LEFT: Colour = (31, 110, 214)
_MIDDLE: Colour = (92, 86, 78)
_OVER_PHOTO: dict[Colour, Colour] = {
    _RIGHT: (255, 122, 51),
    _LEFT: (74, 168, 255),
    _MIDDLE: (244, 241, 234),
}
"""Lighter, for photos of any brightness; with a dark outline."""

_BONES = (*LSP14.edges, (R_HIP, L_HIP))
_GRID_STEP_MM = 500.0
_SURE = 0.5
"""Confidence from which a joint is drawn as one that is there."""
_MOST_ASPECT = 4.0
"""Photos that are wider than this many heights get bars above and below."""
_NEAR = 1.7
"""The camera is drawn at most this many extents of the people away from them."""


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
    Viewpoint("from the camera's right", 90.0, 6.0),
    Viewpoint("40° to the left, 28° above", -40.0, 28.0),
)


def draw_result(photo: Photo, result: PhotoResult, *, height_px: int = 720) -> Picture:
    """The photo with everybody's joints, and two novel views of the 3D beside it.

    Args:
        photo: the decoded photo ``result`` is about.
        result: what the pipeline found in it.
        height_px: height of the picture.

    """
    picture = draw_overlay(photo, result.people, height_px=height_px)
    for view in NOVEL_VIEWS:
        picture = picture.beside(draw_novel_view(result, view, side_px=height_px))
    return picture


def draw_overlay(photo: Photo, people: Sequence[SeenPerson], *, height_px: int) -> Picture:
    """The photo at this height with limbs and joints; faint and hollow where unsure."""
    rows, columns = photo.pixels_bgr.shape[:2]
    scale = height_px * min(1 / rows, _MOST_ASPECT / columns)
    width_px = max(1, round(scale * columns))
    drawn_px = max(1, round(scale * rows))
    corner = np.array([0.0, (height_px - drawn_px) // 2])
    marks: list[Mark] = [Photograph(photo.pixels_bgr, corner, float(width_px), float(drawn_px))]
    thickness = max(2.0, height_px / 180)
    for person in people:
        # Pixel centres are at whole numbers in results, at halves in pictures.
        decoded_px = (person.joints_px - photo.offset_px) / photo.reduction
        joints = (decoded_px + 0.5) * scale + corner
        sure = person.present & (
            np.ones(len(joints), bool)
            if person.confidence is None
            else np.asarray(person.confidence >= _SURE)
        )
        for parent, child in _BONES:
            if person.present[parent] and person.present[child]:
                opacity = 1.0 if sure[parent] and sure[child] else 0.45
                line = joints[[parent, child]]
                colour = _OVER_PHOTO[_bone_colour(child)]
                marks.append(Stroke(line, _INK, thickness + 2, opacity))
                marks.append(Stroke(line, colour, thickness, opacity))
        for joint in np.flatnonzero(person.present).tolist():
            colour = _OVER_PHOTO[_bone_colour(joint)]
            inside, outline = (colour, _INK) if sure[joint] else (_INK, colour)
            marks.append(Disc(joints[joint], thickness, inside, outline))
    return Picture(width_px, height_px, _PAPER, tuple(marks))


def draw_novel_view(result: PhotoResult, view: Viewpoint, *, side_px: int) -> Picture:
    """Orthographic view of everybody in 3D over a ground grid, with the photo's camera.

    The ground is level for the photo's camera, under the lowest joint. A camera far away is drawn
    nearer, and the picture says so.
    """
    people = [it.lifted for it in result.people if isinstance(it.lifted, LiftedPerson)]
    title = Words(view.title, np.array([14.0, 26.0]), _SOFT)
    if not people:
        nothing = Words("nothing in 3D", np.array([side_px / 2 - 45, side_px / 2]), _SOFT)
        return Picture(side_px, side_px, _PAPER, (title, nothing))
    points = np.concatenate([person.joints_3d_mm for person in people])
    extent_mm = float(np.ptp(points, axis=0).max())
    apex_mm = np.array([0.0, 0.0, max(0.0, points[:, 2].min() - _NEAR * extent_mm)])
    pyramid = _pyramid(result, apex_mm, 0.35 * extent_mm)
    grid, floor_mm = _grid(points)

    rotation = view.rotation()
    ghosts = [person.exemplar.joints_mm for person in people]
    seen = np.concatenate([points, *ghosts, pyramid, grid.reshape(-1, 3)]) @ rotation.T
    low, high = seen[:, :2].min(axis=0), seen[:, :2].max(axis=0)
    scale = 0.88 * side_px / float(max(high - low))
    middle = (low + high) / 2

    def place(points_mm: Floats) -> Floats:
        flat: Floats = ((points_mm @ rotation.T)[..., :2] - middle) * scale + side_px / 2
        return flat

    thickness = max(3.0, side_px / 130)
    marks: list[Mark] = [Stroke(place(line), _GRID, 1.0) for line in grid]
    for person in people:
        fallen = person.joints_3d_mm.copy()
        fallen[:, 1] = floor_mm
        marks += [Stroke(place(fallen[list(bone)]), _SHADOW, thickness) for bone in _BONES]
    marks += _camera_marks(place(pyramid))
    marks += [
        Stroke(place(np.stack([apex_mm, joint])), _GHOST, 1.0, 0.5)
        for person in people
        for joint in person.joints_3d_mm
        if apex_mm[2] == 0
    ]
    marks += _bone_marks(people, rotation, place, thickness)
    below = "grid 0.5 m"
    if apex_mm[2] > 0:
        below += f"; the camera, {_distance_m(people):.1f} m away, is drawn nearer"
    note = Words(below, np.array([14.0, side_px - 14.0]), _SOFT)
    return Picture(side_px, side_px, _PAPER, (*marks, title, note))


def _bone_marks(
    people: Sequence[LiftedPerson], rotation: Floats, place: object, thickness: float
) -> list[Mark]:
    """Exemplars and answers, the farthest bones first."""
    assert callable(place)
    depths: list[tuple[float, list[Mark]]] = []
    for person in people:
        ghost, answer = person.exemplar.joints_mm, person.joints_3d_mm
        for pose, is_ghost in ((ghost, True), (answer, False)):
            flat = place(pose)
            for parent, child in _BONES:
                line = flat[[parent, child]]
                depth = float((pose[[parent, child]] @ rotation[2]).mean())
                if is_ghost:
                    bone: list[Mark] = [Stroke(line, _GHOST, 0.5 * thickness, 0.8)]
                else:
                    colour = _bone_colour(child)
                    bone = [
                        Stroke(line, _PAPER, thickness + 3),
                        Stroke(line, colour, thickness),
                        Disc(flat[child], 0.75 * thickness, colour),
                    ]
                depths.append((depth, bone))
    depths.sort(key=lambda item: -item[0])
    return [mark for _, bone in depths for mark in bone]


def _pyramid(result: PhotoResult, apex_mm: Floats, depth_mm: float) -> Floats:
    """(5, 3) the camera's centre, then the corners of its view (clockwise) at ``depth_mm``."""
    intrinsics: Intrinsics = result.intrinsics
    corners_px = np.array(
        [[0, 0], [result.width_px, 0], [result.width_px, result.height_px], [0, result.height_px]]
    )
    slopes = (corners_px - 0.5 - intrinsics.principal_point_px) / intrinsics.focal_length_px
    corners = apex_mm + depth_mm * np.column_stack([slopes, np.ones(4)])
    pyramid: Floats = np.concatenate([apex_mm[None], corners])
    return pyramid


def _camera_marks(pyramid: Floats) -> list[Mark]:
    apex, corners = pyramid[0], pyramid[1:]
    edges = [Stroke(np.stack([apex, corner]), _INK, 1.4) for corner in corners]
    frame = Stroke(np.concatenate([corners, corners[:1]]), _INK, 1.4)
    return [Area(corners, _GHOST, 0.25), *edges, frame]


def _grid(points_mm: Floats) -> tuple[Floats, float]:
    """(L, 2, 3) lines of a half-metre grid under the points, and its height."""
    floor_mm = float(points_mm[:, 1].max())
    step = _GRID_STEP_MM
    (x0, z0), (x1, z1) = (
        np.floor(points_mm[:, [0, 2]].min(axis=0) / step) * step,
        np.ceil(points_mm[:, [0, 2]].max(axis=0) / step) * step,
    )
    along_z = [[[x, floor_mm, z0], [x, floor_mm, z1]] for x in np.arange(x0, x1 + step / 2, step)]
    along_x = [[[x0, floor_mm, z], [x1, floor_mm, z]] for z in np.arange(z0, z1 + step / 2, step)]
    return np.array(along_z + along_x), floor_mm


def _distance_m(people: Sequence[LiftedPerson]) -> float:
    return min(float(np.linalg.norm(person.root_mm)) for person in people) / 1e3


def _bone_colour(joint: int) -> Colour:
    name = LSP14.joint_names[joint]
    return _RIGHT if name.startswith("r_") else _LEFT if name.startswith("l_") else _MIDDLE
