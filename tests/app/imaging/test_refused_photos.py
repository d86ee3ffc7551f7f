"""Bytes that are no whole photo of an accepted type, or too much of one."""

from __future__ import annotations

import re
import struct
import zlib
from contextlib import suppress

import cv2
import numpy as np
import pytest

from app.errors import (
    RequestError,
    TooManyPixelsError,
    UndecodableImageError,
    UnsupportedImageTypeError,
)
from app.imaging import read_header
from tests.app.imaging.image_files import decode, encode, png_chunk, scene, tiff, webp_with_exif


@pytest.mark.parametrize("extension", [".jpg", ".png", ".webp"])
def test_every_truncation_is_refused(extension: str) -> None:
    whole = encode(scene(), extension)
    read_header(whole)
    for percent in range(1, 100):
        cut = whole[: max(12, len(whole) * percent // 100)]
        with pytest.raises(UndecodableImageError):
            decode(cut)


def test_a_truncated_progressive_jpeg_is_refused() -> None:
    whole = encode(scene(), ".jpg", cv2.IMWRITE_JPEG_PROGRESSIVE, 1)
    decode(whole)
    with pytest.raises(UndecodableImageError):
        decode(whole[:-400])


def test_a_jpeg_of_endless_scans_is_refused() -> None:
    """A scan costs 20 bytes and a walk over all pixels: a small file could keep a worker busy."""
    whole = encode(scene(), ".jpg", cv2.IMWRITE_JPEG_PROGRESSIVE, 1)
    scans = [match.start() for match in re.finditer(rb"\xff\xda", whole)]
    last, end = whole[scans[-1] : -2], whole[-2:]
    wanted = 64 - len(scans)
    decode(whole[:-2] + wanted * last + end)
    with pytest.raises(UndecodableImageError, match="more than 64 scans"):
        decode(whole[:-2] + (wanted + 1) * last + end)


def test_bytes_after_the_end_are_ignored() -> None:
    for extension in (".jpg", ".png", ".webp"):
        decode(encode(scene(), extension) + b"<script>GIF89a\xff\xd8")


@pytest.mark.parametrize("extension", [".jpg", ".png", ".webp"])
def test_damaged_files_are_decoded_or_refused(extension: str) -> None:
    """Whatever the bytes, there is a photo or one of our refusals, and soon."""
    rng = np.random.default_rng(1)
    whole = encode(scene(48, 64), extension)
    for _ in range(1500):
        data = bytearray(whole)
        for _ in range(rng.integers(1, 6)):
            at = int(rng.integers(len(data)))
            match int(rng.integers(3)):
                case 0:
                    data[at] = rng.integers(256)
                case 1:
                    del data[at : at + int(rng.integers(1, 30))]
                case _:
                    data[at : at + 4] = b"\xff\xff\xff\xff"
            if len(data) < 16:
                break
        with suppress(RequestError):
            decode(bytes(data), max_pixels=1_000_000)


@pytest.mark.parametrize(
    ("data", "name"),
    [
        (b"GIF89a" + bytes(40), "GIF"),
        (b"%PDF-1.7\n", "PDF"),
        (b'<?xml version="1.0"?><svg xmlns="http://www.w3.org/2000/svg"/>', "SVG"),
        (b"\x00\x00\x00\x18ftypmif1\x00\x00\x00\x00mif1miaf", "HEIF"),
        (b"\x00\x00\x00\x18ftyphevc\x00\x00\x00\x00mif1hevc", "HEIF"),
        (b"\x00\x00\x00\x1cftypavif\x00\x00\x00\x00", "AVIF"),
        (b"hello there", "text"),
        (b"\xff\xd8", None),
        (bytes(range(128, 256)), None),
    ],
)
def test_other_types_are_named(data: bytes, name: str | None) -> None:
    with pytest.raises(UnsupportedImageTypeError) as caught:
        decode(data)
    assert "image/jpeg, image/png, image/webp" in caught.value.detail
    if name:
        assert name in caught.value.detail


def bomb(width: int, height: int) -> bytes:
    """A 1-bit PNG of very many pixels in few bytes."""
    header = struct.pack(">IIBBBBB", width, height, 1, 0, 0, 0, 0)
    rows = zlib.compress(bytes((width // 8 + 1) * 64), 9)
    chunks = png_chunk(b"IHDR", header) + png_chunk(b"IDAT", rows) + png_chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + chunks


def test_pixels_are_counted_before_decoding() -> None:
    with pytest.raises(TooManyPixelsError):
        decode(bomb(20_000, 20_000))
    jpeg = bytearray(encode(scene(), ".jpg"))
    frame = jpeg.find(b"\xff\xc0")
    jpeg[frame + 5 : frame + 9] = struct.pack(">HH", 60_000, 60_000)
    with pytest.raises(TooManyPixelsError):
        decode(bytes(jpeg))


def test_contradicting_sizes_are_refused() -> None:
    webp = encode(scene(), ".webp", cv2.IMWRITE_WEBP_QUALITY, 90)
    with pytest.raises(UndecodableImageError):
        decode(webp_with_exif(webp, tiff(1), 10, 10))
    jpeg = encode(scene(), ".jpg")
    frame = jpeg.find(b"\xff\xc0")
    length = int.from_bytes(jpeg[frame + 2 : frame + 4], "big") + 2
    twice = jpeg[: frame + length] + jpeg[frame : frame + length] + jpeg[frame + length :]
    with pytest.raises(UndecodableImageError):
        decode(twice)


def test_many_empty_segments_do_not_take_long() -> None:
    flood = b"\xff\xd8" + b"\xff\xfe\x00\x02" * 3_000_000
    with pytest.raises(UndecodableImageError):
        read_header(flood)
    with pytest.raises(UndecodableImageError):
        read_header(b"\xff\xd8\xff" + b"\xff" * 15_000_000)
