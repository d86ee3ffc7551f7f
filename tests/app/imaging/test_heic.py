"""HEIC against the JPEG it was made of; with its extra, and as if without."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from app.errors import TooManyPixelsError, UndecodableImageError, UnsupportedImageTypeError
from app.imaging import accepted_types, decode_photo, heic

RENDERS = Path(__file__).parents[2] / "data" / "renders"


@pytest.fixture(scope="module")
def photo() -> bytes:
    """The render 000, stored turned, with a rotation in its container and EXIF orientation 6."""
    return (RENDERS / "000.heic").read_bytes()


def test_it_is_upright_and_the_same_picture(photo: bytes) -> None:
    decoded = decode_photo(photo, max_pixels=10**6, side_px=1000)
    assert (decoded.width_px, decoded.height_px) == (640, 480)
    assert decoded.orientation == 1, "libheif has turned it; doing so twice would be wrong"
    original = cv2.imread(str(RENDERS / "000.jpg"))
    assert original is not None
    assert np.abs(decoded.pixels_bgr.astype(int) - original).mean() < 4
    assert decoded.exif_focal_length_px == pytest.approx(26 * 800 / 43.2666, rel=1e-4)


def test_limits_and_damage(photo: bytes) -> None:
    with pytest.raises(TooManyPixelsError):
        decode_photo(photo, max_pixels=640 * 480 - 1, side_px=1000)
    for percent in (1, 20, 60, 95):
        with pytest.raises(UndecodableImageError):
            decode_photo(photo[: len(photo) * percent // 100], max_pixels=10**6, side_px=1000)


def test_a_file_that_crashes_libheif_crashes_nothing_else(photo: bytes) -> None:
    """Found by the fuzzer: the offset of the EXIF item overwritten."""
    damaged = photo[:177] + b"\xff\xff" + photo[179:]
    with pytest.raises(UndecodableImageError):
        decode_photo(damaged, max_pixels=10**6, side_px=1000)


def test_without_the_extra_the_refusal_says_so(
    photo: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert "image/heic" in accepted_types()
    for user in ("headers", "decode"):
        monkeypatch.setattr(f"app.imaging.{user}.is_available", lambda: False)
    assert "image/heic" not in accepted_types()
    with pytest.raises(UnsupportedImageTypeError, match="`heic` extra") as caught:
        decode_photo(photo, max_pixels=10**6, side_px=1000)
    assert "image/heic" not in str(caught.value.extra["accepted_types"])


@pytest.mark.parametrize(
    ("data", "wanted"),
    [
        (b"\x00\x00\x00\x18ftypheic\x00\x00\x00\x00mif1heic", True),
        (b"\x00\x00\x00\x18ftypmif1\x00\x00\x00\x00mif1heic", True),
        (b"\x00\x00\x00\x18ftypmif1\x00\x00\x00\x00avifmif1", False),
        (b"\xff\xff\xff\xffftypmif1", False),
        (b"\x00\x00\x00\x18ftypavif\x00\x00\x00\x00mif1heic", False),
        (b"", False),
    ],
)
def test_brands(data: bytes, wanted: bool) -> None:
    assert heic.is_heic(data) is wanted
