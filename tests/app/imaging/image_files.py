"""Photos for tests, made with OpenCV's encoders or byte by byte, and decoding them."""

from __future__ import annotations

import struct
import zlib

import cv2
import numpy as np
import numpy.typing as npt

from app.imaging import Photo, decode_photo

Image = npt.NDArray[np.uint8]


# EXIF orientation -> what the camera stored, given the upright image (EXIF 2.32, table 6).
STORED = {
    1: lambda a: a,
    2: lambda a: a[:, ::-1],
    3: lambda a: a[::-1, ::-1],
    4: lambda a: a[::-1],
    5: lambda a: a.swapaxes(0, 1),
    6: lambda a: np.rot90(a),
    7: lambda a: a.swapaxes(0, 1)[::-1, ::-1],
    8: lambda a: np.rot90(a, -1),
}


def decode(
    data: bytes,
    *,
    max_pixels: int = 50_000_000,
    side_px: int = 1280,
    box_px: tuple[float, float, float, float] | None = None,
) -> Photo:
    """``decode_photo`` with the service's own limits."""
    return decode_photo(data, max_pixels=max_pixels, side_px=side_px, box_px=box_px)


def scene(height: int = 96, width: int = 160) -> Image:
    """A smooth picture without symmetry, so that JPEG keeps it and no flip leaves it unchanged."""
    y, x = np.mgrid[:height, :width] / max(height, width)
    channels = [200 * x + 20, 200 * y + 40 * np.sin(6 * x), 120 + 100 * np.cos(5 * x * y + x)]
    return np.asarray(np.stack(channels, -1).clip(0, 255), np.uint8)


def encode(image: npt.NDArray[np.generic], extension: str, *flags: int) -> bytes:
    done, data = cv2.imencode(extension, np.ascontiguousarray(image), flags)
    assert done
    return data.tobytes()


def tiff(orientation: int, focal_35mm: int = 0, size: tuple[int, int] = (0, 0)) -> bytes:
    """A little-endian TIFF block with the tags the service reads."""
    details = [(0xA002, 4, size[0]), (0xA003, 4, size[1]), (0xA405, 3, focal_35mm)]
    main = [(0x0112, 3, orientation), (0x8769, 4, 8 + 2 + 2 * 12 + 4)]
    block = b"II*\x00" + struct.pack("<I", 8)
    for directory in (main, details):
        block += struct.pack("<H", len(directory))
        for tag, kind, value in directory:
            block += struct.pack("<HHI", tag, kind, 1) + struct.pack("<I", value)
        block += struct.pack("<I", 0)
    return block


def with_exif(jpeg: bytes, block: bytes) -> bytes:
    segment = b"Exif\x00\x00" + block
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(segment) + 2) + segment + jpeg[2:]


def png_chunk(name: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))


def made_png(size: tuple[int, int], depth: int, colour: int, row: bytes, *chunks: bytes) -> bytes:
    """A PNG of equal rows; ``size`` is width and height, ``chunks`` come before the pixels."""
    header = png_chunk(b"IHDR", struct.pack(">IIBBBBB", *size, depth, colour, 0, 0, 0))
    pixels = png_chunk(b"IDAT", zlib.compress(size[1] * (b"\0" + row)))
    return b"\x89PNG\r\n\x1a\n" + header + b"".join(chunks) + pixels + png_chunk(b"IEND", b"")


def png_with_exif(png: bytes, block: bytes) -> bytes:
    return png[:33] + png_chunk(b"eXIf", block) + png[33:]


def webp_with_exif(webp: bytes, block: bytes, width: int, height: int) -> bytes:
    canvas = b"\x08\x00\x00\x00" + (width - 1).to_bytes(3, "little")
    canvas += (height - 1).to_bytes(3, "little")
    chunks = b"VP8X" + struct.pack("<I", 10) + canvas + webp[12:]
    chunks += b"EXIF" + struct.pack("<I", len(block)) + block + b"\x00" * (len(block) & 1)
    return b"RIFF" + struct.pack("<I", 4 + len(chunks)) + b"WEBP" + chunks
