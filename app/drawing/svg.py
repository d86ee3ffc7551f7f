"""A picture as SVG, complete in itself: the photo is inside."""

from __future__ import annotations

import base64
from xml.sax.saxutils import escape, quoteattr

import cv2

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

_JPEG_QUALITY = 90
_FONT = "Helvetica, Arial, sans-serif"


def to_svg(picture: Picture) -> str:
    """The text of an SVG 1.1 file of the picture's size in pixels."""
    size = f'width="{picture.width}" height="{picture.height}"'
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" {size} '
        f'viewBox="0 0 {picture.width} {picture.height}" stroke-linecap="round" '
        f'stroke-linejoin="round" font-family={quoteattr(_FONT)}>',
        f'<rect {size} fill="{_rgb(picture.ground)}"/>',
        *map(_element, picture.marks),
        "</svg>\n",
    ]
    return "\n".join(lines)


def _element(mark: Mark) -> str:
    if isinstance(mark, Stroke):
        dashes = ' stroke-dasharray="6"' if mark.dashed else ""
        return (
            f'<polyline points="{_points(mark.points)}" fill="none" stroke="{_rgb(mark.colour)}" '
            f'stroke-width="{mark.width:g}"{_opacity(mark.opacity)}{dashes}/>'
        )
    if isinstance(mark, Disc):
        outline = "" if mark.outline is None else f' stroke="{_rgb(mark.outline)}"'
        x, y = mark.centre
        return (
            f'<circle cx="{x:.2f}" cy="{y:.2f}" r="{mark.radius:g}" '
            f'fill="{_rgb(mark.colour)}"{outline}/>'
        )
    if isinstance(mark, Area):
        corners = _points(mark.corners)
        return f'<polygon points="{corners}" fill="{_rgb(mark.colour)}"{_opacity(mark.opacity)}/>'
    x, y = mark.at
    if isinstance(mark, Photograph):
        return (
            f'<image x="{x:g}" y="{y:g}" width="{mark.width:g}" height="{mark.height:g}" '
            f'preserveAspectRatio="none" href="{_data_url(mark.pixels_bgr)}"/>'
        )
    style = f'font-size="{mark.size:g}" fill="{_rgb(mark.colour)}"'
    return f'<text x="{x:g}" y="{y:g}" {style}>{escape(mark.text)}</text>'


def _data_url(pixels: Pixels) -> str:
    _, encoded = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    return "data:image/jpeg;base64," + base64.b64encode(encoded.tobytes()).decode()


def _points(points: Floats) -> str:
    return " ".join(f"{x:.2f},{y:.2f}" for x, y in points)


def _opacity(opacity: float) -> str:
    return "" if opacity == 1 else f' opacity="{opacity:g}"'


def _rgb(colour: Colour) -> str:
    return "#{:02x}{:02x}{:02x}".format(*colour)
