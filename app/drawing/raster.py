"""A picture as pixels, by OpenCV."""

from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np

from app.drawing.picture import (
    Area,
    Colour,
    Disc,
    Floats,
    Mark,
    Photograph,
    Picture,
    Pixels,
    Stroke,
)

_SHIFT = 4
"""Binary digits after the point of OpenCV's coordinates."""
_HERSHEY_PX = 22.0
"""Height of OpenCV's plain font at scale 1."""
_DASH_PX = 6.0


def to_pixels(picture: Picture) -> Pixels:
    """(height, width, 3) uint8 BGR."""
    canvas = np.empty((picture.height, picture.width, 3), np.uint8)
    canvas[:] = picture.ground[::-1]
    for mark in picture.marks:
        opacity = getattr(mark, "opacity", 1.0)
        if opacity < 1:
            layer = canvas.copy()
            _draw(layer, mark)
            canvas = cv2.addWeighted(layer, opacity, canvas, 1 - opacity, 0).astype(np.uint8)
        else:
            _draw(canvas, mark)
    return canvas


def _draw(canvas: Pixels, mark: Mark) -> None:
    if isinstance(mark, Stroke):
        width = max(1, round(mark.width))
        for start, end in _dashes(mark) if mark.dashed else _segments(mark.points):
            cv2.line(
                canvas, _fixed(start), _fixed(end), _bgr(mark.colour), width, cv2.LINE_AA, _SHIFT
            )
    elif isinstance(mark, Disc):
        centre, radius = _fixed(mark.centre), round(mark.radius * (1 << _SHIFT))
        cv2.circle(canvas, centre, radius, _bgr(mark.colour), cv2.FILLED, cv2.LINE_AA, _SHIFT)
        if mark.outline is not None:
            cv2.circle(canvas, centre, radius, _bgr(mark.outline), 1, cv2.LINE_AA, _SHIFT)
    elif isinstance(mark, Area):
        corners = np.array([_fixed(corner) for corner in mark.corners], np.int32)
        cv2.fillPoly(canvas, [corners], _bgr(mark.colour), cv2.LINE_AA, _SHIFT)
    elif isinstance(mark, Photograph):
        _paste(canvas, mark)
    else:
        x, y = mark.at
        cv2.putText(
            canvas,
            mark.text.replace("°", " deg"),  # OpenCV's fonts are ASCII
            (round(float(x)), round(float(y))),
            cv2.FONT_HERSHEY_SIMPLEX,
            mark.size / _HERSHEY_PX * 0.8,
            _bgr(mark.colour),
            1,
            cv2.LINE_AA,
        )


def _paste(canvas: Pixels, photo: Photograph) -> None:
    size = max(1, round(photo.width)), max(1, round(photo.height))
    is_smaller = size[0] < photo.pixels_bgr.shape[1]
    way = cv2.INTER_AREA if is_smaller else cv2.INTER_CUBIC
    scaled = cv2.resize(photo.pixels_bgr, size, interpolation=way)
    x, y = round(float(photo.at[0])), round(float(photo.at[1]))
    canvas[y : y + size[1], x : x + size[0]] = scaled


def _segments(points: Floats) -> list[tuple[Floats, Floats]]:
    return list(pairwise(points))


def _dashes(stroke: Stroke) -> list[tuple[Floats, Floats]]:
    pieces = []
    for start, end in _segments(stroke.points):
        length = float(np.linalg.norm(end - start))
        steps = np.arange(0.0, length, 2 * _DASH_PX) / max(length, 1e-9)
        stops = np.minimum(steps + _DASH_PX / max(length, 1e-9), 1.0)
        pieces += [
            (start + (end - start) * a, start + (end - start) * b)
            for a, b in zip(steps, stops, strict=True)
        ]
    return pieces


def _fixed(point: Floats) -> tuple[int, int]:
    # Pictures count from the corner of the first pixel, OpenCV from its centre.
    x, y = (np.clip(point, -1e5, 1e5) - 0.5) * (1 << _SHIFT)
    return round(float(x)), round(float(y))


def _bgr(colour: Colour) -> Colour:
    return colour[::-1]
