"""Pictures as the bytes of files."""

from __future__ import annotations

import cv2

from app.drawing.picture import Picture
from app.drawing.raster import to_pixels
from app.drawing.svg import to_svg

PICTURE_TYPES = (".png", ".svg", ".jpg", ".jpeg", ".webp")
"""File name endings that pictures can be written as."""


def encode_picture(picture: Picture, ending: str) -> bytes:
    """The bytes of a file of that ending; ``ValueError`` when it is none of PICTURE_TYPES."""
    if ending.lower() not in PICTURE_TYPES:
        raise ValueError(f"pictures end in {', '.join(PICTURE_TYPES)}, not {ending!r}")
    if ending.lower() == ".svg":
        return to_svg(picture).encode()
    _, encoded = cv2.imencode(ending.lower(), to_pixels(picture))
    return encoded.tobytes()
