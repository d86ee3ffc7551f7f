"""A contact sheet: exemplars as their cameras see them, to look at what a library holds.

Right limbs are orange, left limbs blue (the person's own right and left), the rest light grey. The
nearer a bone, the later and thicker it is drawn.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from library_store.anatomy import Float
from library_store.library import Library
from library_store.skeleton import HEAD_TOP, L_HIP, LSP14, NECK, R_HIP
from library_store.sources import Kind

Image = NDArray[np.uint8]
Colour = tuple[int, int, int]

TILE_PX = 220

_RIGHT: Colour = (48, 128, 255)
_LEFT: Colour = (255, 168, 64)
_MIDDLE: Colour = (225, 225, 225)
BACKGROUND: Colour = (38, 34, 32)
_RULE: Colour = (60, 55, 52)
TEXT: Colour = (170, 166, 162)
_BONES = (*LSP14.edges, (R_HIP, L_HIP))
_CAPTION_PX = 34
_SUBPIXEL_BITS = 4


def contact_sheet(library: Library, entries: Sequence[int], columns: int = 0) -> Image:
    """A picture (H, W, 3) uint8 BGR of exemplars, ``columns`` a row (0: about square)."""
    columns = columns or max(1, math.ceil(math.sqrt(1.4 * len(entries))))
    rows = math.ceil(len(entries) / columns)
    sheet = np.full((rows * TILE_PX, columns * TILE_PX, 3), BACKGROUND, dtype=np.uint8)
    rotations, translations = library.cameras(entries)
    seen = np.einsum("nij,nkj->nki", rotations, library.poses_mm(entries))
    seen += translations[:, None]
    for number, (entry, pose) in enumerate(zip(entries, seen, strict=True)):
        top, left = TILE_PX * (number // columns), TILE_PX * (number % columns)
        tile = sheet[top : top + TILE_PX, left : left + TILE_PX]
        draw_pose(tile, pose)
        _caption(tile, library, entry)
    return sheet


def draw_entries(library: Library, n: int, kind: Kind | None = None, seed: int = 0) -> list[int]:
    """``n`` entries drawn from those of one kind, or of all, ascending; all if there are fewer."""
    there = library.entries_of(kind) if kind else np.arange(len(library))
    chosen = np.random.default_rng(seed).permutation(len(there))[:n]
    entries: list[int] = there[np.sort(chosen)].tolist()
    return entries


def draw_pose(tile: Image, pose_mm: Float) -> None:
    """The pose (14, 3), camera frame, in the middle of the tile above the caption."""
    flat = pose_mm[:, :2] / pose_mm[:, 2:]
    low, high = flat.min(axis=0), flat.max(axis=0)
    room = np.array([TILE_PX - 24.0, TILE_PX - _CAPTION_PX - 24.0])
    scale = float((room / np.maximum(high - low, 1e-9)).min())
    centre = np.array([TILE_PX / 2, (TILE_PX - _CAPTION_PX) / 2])
    points = (flat - 0.5 * (low + high)) * scale + centre
    depths = pose_mm[:, 2]
    order = sorted(_BONES, key=lambda bone: -float(depths[list(bone)].mean()))
    nearness = (depths.max() - depths) / max(float(np.ptp(depths)), 1.0)
    for a, b in order:
        thickness = 2 + round(2.0 * float(nearness[[a, b]].mean()))
        draw_bone(tile, points[a], points[b], b, thickness)
    radius = 0.35 * float(np.linalg.norm(points[HEAD_TOP] - points[NECK]))
    middle = _fixed(0.35 * points[NECK] + 0.65 * points[HEAD_TOP])
    size = round(radius * (1 << _SUBPIXEL_BITS))
    cv2.circle(tile, middle, size, _MIDDLE, 1, cv2.LINE_AA, _SUBPIXEL_BITS)


def draw_bone(tile: Image, start_px: Float, end_px: Float, joint: int, thickness: int) -> None:
    """The bone that ends at ``joint``, in the colour of its side."""
    ends = (_fixed(start_px), _fixed(end_px))
    cv2.line(tile, *ends, _colour(joint), thickness, cv2.LINE_AA, _SUBPIXEL_BITS)


def _caption(tile: Image, library: Library, entry: int) -> None:
    cv2.line(tile, (0, TILE_PX - 1), (TILE_PX, TILE_PX - 1), _RULE, 1)
    _, kind, name, frame, camera = library.exemplar_id(entry).split(":")
    for line, text in enumerate((f"{kind} {name}", f"{frame} : {camera}")):
        place = (6, TILE_PX - _CAPTION_PX + 12 + 14 * line)
        cv2.putText(tile, text[:40], place, cv2.FONT_HERSHEY_SIMPLEX, 0.34, TEXT, 1, cv2.LINE_AA)


def _fixed(point: Float) -> tuple[int, int]:
    x, y = np.round(point * (1 << _SUBPIXEL_BITS)).astype(int).tolist()
    return x, y


def _colour(joint: int) -> Colour:
    name = LSP14.joint_names[joint]
    return {"r": _RIGHT, "l": _LEFT}.get(name.split("_")[0], _MIDDLE)
