"""The two things an EXIF block tells us: how the camera was held, and its focal length.

Broken EXIF is common and harmless: whatever cannot be read counts as not stated.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass

_ORIENTATION, _EXIF_POINTER = 0x0112, 0x8769
_PIXEL_X, _PIXEL_Y, _FOCAL_35MM = 0xA002, 0xA003, 0xA405
_SHORT, _LONG = 3, 4
_MAX_ENTRIES = 1024

_FILM_DIAGONAL_MM = math.hypot(36.0, 24.0)
_ASPECT_TOLERANCE = 0.01


@dataclass(frozen=True)
class Exif:
    """Orientation 1..8 (1 when not stated) and what the focal length is computed from."""

    orientation: int = 1
    focal_35mm_mm: int | None = None
    camera_size_px: tuple[int, int] | None = None

    def focal_length_px(self, width_px: int, height_px: int) -> float | None:
        """Focal length of an image of this size, or None when EXIF does not settle it.

        The 35 mm equivalent relates the two diagonals (CIPA DCG-001). It holds for the whole
        sensor image, also scaled, but not for a crop: the size the camera recorded must have the
        image's proportions, in either orientation, else the value is not believed.
        """
        if self.focal_35mm_mm is None or self.camera_size_px is None:
            return None
        recorded = max(self.camera_size_px) / min(self.camera_size_px)
        actual = max(width_px, height_px) / min(width_px, height_px)
        if abs(recorded / actual - 1.0) > _ASPECT_TOLERANCE:
            return None
        return self.focal_35mm_mm * math.hypot(width_px, height_px) / _FILM_DIAGONAL_MM


def read_exif(block: bytes | None) -> Exif:
    """Parse a TIFF block as EXIF uses it; never raises."""
    if block is None or block[:4] not in {b"II*\x00", b"MM\x00*"}:
        return Exif()
    order = "<" if block[:2] == b"II" else ">"
    try:
        main = _directory(block, order, struct.unpack_from(order + "I", block, 4)[0])
    except struct.error:
        return Exif()
    orientation = main.get(_ORIENTATION, 1)
    orientation = orientation if 1 <= orientation <= 8 else 1
    try:
        details = _directory(block, order, main.get(_EXIF_POINTER, 0))
    except struct.error:
        return Exif(orientation)
    focal = details.get(_FOCAL_35MM, 0)
    size = details.get(_PIXEL_X, 0), details.get(_PIXEL_Y, 0)
    return Exif(
        orientation,
        focal_35mm_mm=focal if 5 <= focal <= 2000 else None,
        camera_size_px=size if min(size) > 0 else None,
    )


def _directory(block: bytes, order: str, offset: int) -> dict[int, int]:
    """The single SHORT and LONG values of the directory at ``offset`` (0: none), by tag."""
    if offset == 0:
        return {}
    (count,) = struct.unpack_from(order + "H", block, offset)
    values: dict[int, int] = {}
    for index in range(min(count, _MAX_ENTRIES)):
        entry = offset + 2 + 12 * index
        tag, kind, number = struct.unpack_from(order + "HHI", block, entry)
        if number == 1 and kind in {_SHORT, _LONG}:
            form = order + ("H" if kind == _SHORT else "I")
            (values[tag],) = struct.unpack_from(form, block, entry + 8)
    return values
