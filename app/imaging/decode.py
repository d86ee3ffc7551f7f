"""Decode a photo, at a reduced scale where that suffices, and turn it upright.

Coordinates: pixels of the upright, full-size image, (0, 0) the centre of its top-left pixel. A
reduced photo knows the exact affine map from its own pixels to those.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from app.errors import TooManyPixelsError, UndecodableImageError
from app.imaging.exif import read_exif
from app.imaging.headers import ImageHeader, read_header
from app.imaging.heic import decode_heic, is_available, is_heic

_REDUCED = {
    1: cv2.IMREAD_COLOR,
    2: cv2.IMREAD_REDUCED_COLOR_2,
    4: cv2.IMREAD_REDUCED_COLOR_4,
    8: cv2.IMREAD_REDUCED_COLOR_8,
}

# EXIF orientation -> (transpose, flip x, flip y), applied in this order, makes it upright.
_TO_UPRIGHT = {
    1: (False, False, False),
    2: (False, True, False),
    3: (False, True, True),
    4: (False, False, True),
    5: (True, False, False),
    6: (True, True, False),
    7: (True, True, True),
    8: (True, False, True),
}
BOX_SIDE_PX = 384
"""Pixels kept of a given box, along its longer side: more than a pose network sees of it."""
_STRIP_ROWS = 64


@dataclass(frozen=True)
class Photo:
    """An upright photo.

    ``pixels_bgr`` (h, w, 3) uint8 may be reduced: ``image_px = reduction * pixel + offset_px``
    leads from its pixel coordinates to those of the full-size image, ``width_px`` x ``height_px``.
    ``orientation`` is the EXIF value that was applied; ``exif_focal_length_px`` is in full-size
    pixels, None when EXIF does not settle it.
    """

    pixels_bgr: npt.NDArray[np.uint8]
    width_px: int
    height_px: int
    orientation: int
    reduction: int
    offset_px: tuple[float, float]
    exif_focal_length_px: float | None

    def mirrored(self) -> Photo:
        """The photo with left and right exchanged; same size."""
        width = self.pixels_bgr.shape[1]
        offset_x = self.width_px - 1 - self.reduction * (width - 1) - self.offset_px[0]
        return replace(
            self,
            pixels_bgr=_bytes(cv2.flip(self.pixels_bgr, 1)),
            offset_px=(offset_x, self.offset_px[1]),
        )


def decode_photo(
    data: bytes,
    *,
    max_pixels: int,
    side_px: int,
    box_px: tuple[float, float, float, float] | None = None,
) -> Photo:
    """Decode ``data`` (JPEG, PNG, WebP, HEIC with its extra) and turn it upright.

    A JPEG is decoded at 1/2, 1/4 or 1/8 as long as its longer side keeps ``side_px`` pixels, or,
    when the client says where the person is, as long as that box keeps :data:`BOX_SIDE_PX`.
    Transparent pixels are shown on white, as viewers do; of an animation the first frame is taken,
    of an animated PNG the picture for viewers that know no animations: as a rule that is the same.

    Raises ``UnsupportedImageTypeError``, ``TooManyPixelsError`` (before decoding) or
    ``UndecodableImageError``.
    """
    if is_heic(data) and is_available():
        return _heic_photo(data, max_pixels)
    header = read_header(data)
    if header.width_px * header.height_px > max_pixels:
        raise TooManyPixelsError(header.width_px, header.height_px, max_pixels)
    if header.deflated is not None:
        header.deflated.check(data)
    exif = read_exif(header.exif)
    long_side, wanted = max(header.width_px, header.height_px), side_px
    if box_px is not None:
        long_side, wanted = int(max(box_px[2:])), BOX_SIDE_PX
    reduction = _reduction(header, long_side, wanted)
    pixels = _decode(data, header, reduction)
    width, height = header.width_px, header.height_px

    transpose, flip_x, flip_y = _TO_UPRIGHT[exif.orientation]
    if transpose:
        pixels = _bytes(cv2.transpose(pixels))
        width, height = height, width
    if flip_x or flip_y:
        pixels = _bytes(cv2.flip(pixels, -1 if flip_x and flip_y else int(flip_x)))
    # A reduced pixel covers `reduction` full ones; the last one hangs over the edge when the size
    # is not divisible, and a flip brings that overhang to the front.
    offset = (reduction - 1) / 2
    return Photo(
        pixels_bgr=pixels,
        width_px=width,
        height_px=height,
        orientation=exif.orientation,
        reduction=reduction,
        offset_px=(
            offset + (width - reduction * pixels.shape[1] if flip_x else 0),
            offset + (height - reduction * pixels.shape[0] if flip_y else 0),
        ),
        exif_focal_length_px=exif.focal_length_px(width, height),
    )


def _heic_photo(data: bytes, max_pixels: int) -> Photo:
    """Full size and upright as libheif gives it, whatever EXIF says of the orientation."""
    picture = decode_heic(data, max_pixels=max_pixels)
    height, width = picture.pixels.shape[:2]
    return Photo(
        pixels_bgr=_opaque_bgr(picture.pixels),
        width_px=width,
        height_px=height,
        orientation=1,
        reduction=1,
        offset_px=(0.0, 0.0),
        exif_focal_length_px=read_exif(picture.exif).focal_length_px(width, height),
    )


def _bytes(pixels: npt.NDArray[Any]) -> npt.NDArray[np.uint8]:
    """What OpenCV made of bytes is bytes; its type stubs do not know."""
    return pixels.astype(np.uint8, copy=False)


def _reduction(header: ImageHeader, long_side_px: int, wanted_px: int) -> int:
    if header.media_type != "image/jpeg":
        return 1  # only JPEG decodes faster when reduced
    return next((r for r in (8, 4, 2) if long_side_px >= r * wanted_px), 1)


def _decode(data: bytes, header: ImageHeader, reduction: int) -> npt.NDArray[np.uint8]:
    """Stored pixels, not turned, as (h, w, 3) BGR uint8."""
    flags = cv2.IMREAD_UNCHANGED if header.has_alpha else _REDUCED[reduction]
    flags |= cv2.IMREAD_IGNORE_ORIENTATION
    if header.needless:
        starts, ends = zip(*header.needless, strict=True)
        kept = zip((0, *ends), (*starts, len(data)), strict=True)
        data = b"".join(data[start:end] for start, end in kept)
    try:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        raise UndecodableImageError(f"the {header.media_type} cannot be decoded") from error
    if pixels is None:
        raise UndecodableImageError(f"the {header.media_type} cannot be decoded")
    expected = (-(-header.height_px // reduction), -(-header.width_px // reduction))
    if pixels.shape[:2] != expected:
        raise UndecodableImageError(f"the {header.media_type}'s header states another size")
    if header.clear_grey is not None:
        pixels[pixels == header.clear_grey] = 255 if pixels.dtype == np.uint8 else 65535
    return _opaque_bgr(pixels)


def _opaque_bgr(pixels: npt.NDArray[Any]) -> npt.NDArray[np.uint8]:
    """(h, w[, 1|3|4]) of 8 or 16 bits -> (h, w, 3) of 8 bits, transparent pixels on white."""
    if pixels.dtype == np.uint16:
        pixels = cv2.convertScaleAbs(pixels, alpha=1 / 257)
    image = _bytes(pixels)
    if image.ndim == 2 or image.shape[2] == 1:
        return _bytes(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
    if image.shape[2] == 3:
        return image
    opaque = np.empty((*image.shape[:2], 3), np.uint8)
    for top in range(0, len(image), _STRIP_ROWS):  # the wider numbers of a strip, not of all
        strip = image[top : top + _STRIP_ROWS]
        alpha = strip[..., 3:].astype(np.uint16)
        opaque[top : top + _STRIP_ROWS] = (
            strip[..., :3] * alpha + 255 * (255 - alpha) + 127
        ) // 255
    return opaque
