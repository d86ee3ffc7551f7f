"""HEIC, what iPhones save, by libheif through the optional package ``pi_heif`` (extra ``heic``).

libheif crashes on some damaged files. It therefore runs in a process of its own for each photo
(``heic_child``), bounded in memory and time: a tenth of a second more, for a format that takes
longer than that to decode, and no photo can end the service. Nothing touches the disk.

libheif turns the picture upright itself, by the container's own rotation; the EXIF orientation
repeats that and must not be applied again.
"""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from app.errors import TooManyPixelsError, UndecodableImageError

HEIC_TYPE = "image/heic"

_BRANDS = frozenset({b"heic", b"heix", b"heim", b"heis"})
_GENERIC_BRANDS = frozenset({b"mif1", b"msf1"})
_MAX_BRANDS = 32
_CHILD = Path(__file__).with_name("heic_child.py")
_TIMEOUT_S = 30.0


@dataclass(frozen=True)
class HeicPicture:
    """Upright ``pixels`` (h, w, 3) BGR or (h, w, 4) BGRA; ``exif`` is the TIFF block, if any."""

    pixels: npt.NDArray[np.uint8]
    exif: bytes | None


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


def decode_heic(data: bytes, *, max_pixels: int) -> HeicPicture:
    """Decode the primary image.

    Raises ``TooManyPixelsError`` before a pixel is decoded, or ``UndecodableImageError``, also when
    libheif crashes or does not come to an end.
    """
    command = [sys.executable, "-I", str(_CHILD), str(max_pixels)]
    try:
        child = subprocess.run(
            command, input=data, capture_output=True, env={}, timeout=_TIMEOUT_S, check=True
        )
        line, _, rest = child.stdout.partition(b"\n")
        said = json.loads(line)
    except (subprocess.SubprocessError, ValueError) as error:
        raise UndecodableImageError(f"the {HEIC_TYPE} cannot be decoded") from error
    width, height, channels = said["width"], said["height"], said["channels"]
    if width * height > max_pixels:
        raise TooManyPixelsError(width, height, max_pixels)
    exif, plane = rest[: said["exif"]], rest[said["exif"] :]
    if len(plane) != width * height * channels:
        raise UndecodableImageError(f"the {HEIC_TYPE} cannot be decoded")
    return HeicPicture(
        pixels=np.frombuffer(plane, np.uint8).reshape(height, width, channels),
        exif=exif.removeprefix(b"Exif\x00\x00") or None,
    )
