"""HEIC, what iPhones save, by libheif through the optional package ``pi_heif`` (extra ``heic``).

libheif turns the picture upright itself, by the container's own rotation; the EXIF orientation
repeats that and must not be applied again.
"""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass
from functools import cache
from types import ModuleType
from typing import Any

import numpy as np
import numpy.typing as npt

from app.errors import UndecodableImageError

HEIC_TYPE = "image/heic"

_BRANDS = frozenset({b"heic", b"heix", b"heim", b"heis"})
_GENERIC_BRANDS = frozenset({b"mif1", b"msf1"})
_MAX_BRANDS = 32


@dataclass(frozen=True)
class HeicHeader:
    """What the container says: upright size, TIFF block of the EXIF data, alpha."""

    width_px: int
    height_px: int
    exif: bytes | None
    has_alpha: bool


def is_available() -> bool:
    """Whether the extra is installed."""
    return importlib.util.find_spec("pi_heif") is not None


def is_heic(data: bytes) -> bool:
    """By its file type box: a HEIC brand, or a general one that names HEIC among its kin."""
    if data[4:8] != b"ftyp":
        return False
    if data[8:12] in _BRANDS:
        return True
    end = min(int.from_bytes(data[:4], "big"), 16 + 4 * _MAX_BRANDS, len(data))
    others = {data[at : at + 4] for at in range(16, end - 3, 4)}
    return data[8:12] in _GENERIC_BRANDS and not others.isdisjoint(_BRANDS)


def read_heic_header(data: bytes) -> HeicHeader:
    """Read the boxes, decode nothing; ``UndecodableImageError`` when they are truncated."""
    image = _open(data)
    width, height = image.size
    exif = image.info.get("exif")
    return HeicHeader(
        width_px=width,
        height_px=height,
        exif=None if exif is None else bytes(exif).removeprefix(b"Exif\x00\x00"),
        has_alpha=image.mode.endswith("A"),
    )


def decode_heic(data: bytes) -> npt.NDArray[np.uint8]:
    """Upright (h, w, 3) BGR or (h, w, 4) BGRA; ``UndecodableImageError``."""
    image = _open(data)
    try:
        plane = np.frombuffer(image.data, np.uint8)
    except (ValueError, OSError, RuntimeError, SyntaxError, EOFError) as error:
        raise UndecodableImageError(f"the {HEIC_TYPE} cannot be decoded") from error
    width, height = image.size
    channels = len(image.mode)
    rows = plane[: image.stride * height].reshape(height, image.stride)
    # A copy: the plane is libheif's memory and goes with ``image``.
    return np.array(rows[:, : width * channels]).reshape(height, width, channels)


def _open(data: bytes) -> Any:
    try:
        return _library().open_heif(data, bgr_mode=True, convert_hdr_to_8bit=True)
    except (ValueError, OSError, RuntimeError, SyntaxError, EOFError) as error:
        raise UndecodableImageError(f"the {HEIC_TYPE} cannot be decoded") from error


@cache
def _library() -> ModuleType:
    import pi_heif

    pi_heif.options.DECODE_THREADS = 1  # the workers are the parallelism
    pi_heif.options.THUMBNAILS = False
    pi_heif.options.DEPTH_IMAGES = False
    library: ModuleType = pi_heif
    return library
