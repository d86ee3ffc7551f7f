"""Type, size, completeness and EXIF block of a JPEG, PNG or WebP, without decoding a pixel.

Decoders forgive: OpenCV returns the upper half of a truncated JPEG and greys the rest. The walks
below go over the container to its end, so that a truncated file is an error, and they bound the
number of pieces they visit, so that no file makes them slow.
"""

from __future__ import annotations

import re
import zlib
from dataclasses import dataclass
from typing import NoReturn

from app.errors import UndecodableImageError, UnsupportedImageTypeError
from app.imaging.heic import HEIC_TYPE, is_available, is_heic

_ALWAYS_ACCEPTED = ("image/jpeg", "image/png", "image/webp")
KNOWN_TYPES = (*_ALWAYS_ACCEPTED, HEIC_TYPE)
"""What can be accepted; HEIC only where its extra is installed."""
_HEIC_NEEDS = "HEIC, which needs the server's `heic` extra"

_MAX_PIECES = 65_536
_MAX_SCANS = 64
"""Of a JPEG. Encoders make about ten; each is a walk over all pixels, for as little as 20 bytes."""
_PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
_PNG_NEEDED = frozenset({b"tRNS"})
"""Of the ancillary chunks: pixels do not depend on the others, of which libpng inflates each text,
to 8 MB at most, and complains of each that it does not like. Of an animation OpenCV would hold
more frames than the one that it gives."""
_PNG_GREY_STEPS = {1: 255, 2: 85, 4: 17}
"""By bits of a sample: what fewer than 8 are multiplied by to be 8."""
_PNG_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}
"""By colour type."""
_PNG_UNCHECKED = 1_000_000
"""Compressed bytes of pixels that are not inflated to see how many they are: libpng would inflate
whatever follows the last row too, a thousand bytes from each."""
_PNG_PIECE = 1 << 20
_JPEG_NOT_FILL = re.compile(rb"[^\xff]")
_JPEG_MARKER = re.compile(rb"\xff[\x01-\xcf\xd8-\xfe]")
_TEXT = re.compile(rb"[\t-\r\x1b -~]+")
_ISO_BRANDS = {
    b"hevc": "a HEIF sequence",
    b"mif1": "HEIF",
    b"msf1": "HEIF",
    b"avif": "AVIF",
    b"avis": "AVIF",
}
_OTHER_MAGICS = (
    (b"GIF87a", "GIF"),
    (b"GIF89a", "GIF"),
    (b"%PDF-", "PDF"),
    (b"BM", "BMP"),
    (b"II*\x00", "TIFF"),
    (b"MM\x00*", "TIFF"),
    (b"PK\x03\x04", "a ZIP archive"),
    (b"\x1f\x8b", "gzip"),
    (b"\x00\x00\x00\x0cjP  ", "JPEG 2000"),
    (b"\xff\x0a", "JPEG XL"),
)


@dataclass(frozen=True)
class Deflated:
    """Pixels as a zlib stream, in pieces from and to, of ``most`` bytes at the utmost."""

    media_type: str
    spans: tuple[tuple[int, int], ...]
    most: int

    def check(self, data: bytes) -> None:
        """Raise ``UndecodableImageError`` where more follows, which a decoder would inflate."""
        inflater, n = zlib.decompressobj(), 0
        for start, end in self.spans:
            left = data[start:end]
            while left and not inflater.eof:
                try:
                    n += len(inflater.decompress(left, _PNG_PIECE))
                except zlib.error:
                    return  # the decoder ends there too, and says so
                if n > self.most:
                    _corrupt(self.media_type, "more data than its pixels take follows them")
                left = inflater.unconsumed_tail


@dataclass(frozen=True)
class ImageHeader:
    """What the container says of its image.

    ``width_px`` and ``height_px`` are those stored, before any EXIF orientation; ``exif`` is the
    TIFF block of the EXIF data; ``has_alpha`` says that some pixels may be transparent.
    ``clear_grey`` are the transparent ones of a grey PNG, as decoded: OpenCV sees no difference.
    ``needless`` are the bytes, from and to, that a decoder would only lose time on; ``deflated``
    pixels are to be checked before they are decoded.
    """

    media_type: str
    width_px: int
    height_px: int
    exif: bytes | None
    has_alpha: bool
    clear_grey: int | None = None
    needless: tuple[tuple[int, int], ...] = ()
    deflated: Deflated | None = None


def accepted_types() -> tuple[str, ...]:
    """The media types this installation decodes."""
    return KNOWN_TYPES if is_available() else _ALWAYS_ACCEPTED


def read_header(data: bytes) -> ImageHeader:
    """Read the header of ``data`` and walk its container to the end.

    Raises ``UnsupportedImageTypeError`` unless the magic bytes are those of these types, and
    ``UndecodableImageError`` when the container is truncated or contradicts itself.
    """
    if data.startswith(b"\xff\xd8\xff"):
        header = _read_jpeg(data)
    elif data.startswith(_PNG_MAGIC):
        header = _read_png(data)
    elif data[:4] == b"RIFF" and data[8:12] == b"WEBP":
        header = _read_webp(data)
    else:
        raise UnsupportedImageTypeError(_other_type(data), accepted_types())
    if header.width_px == 0 or header.height_px == 0:
        _corrupt(header.media_type, "it has no pixels")
    return header


def _other_type(data: bytes) -> str | None:
    """A name for well-known bytes that are not accepted, for the error's text."""
    if is_heic(data):
        return _HEIC_NEEDS
    if data[4:8] == b"ftyp" and (name := _ISO_BRANDS.get(data[8:12])):
        return name
    for magic, name in _OTHER_MAGICS:
        if data.startswith(magic):
            return name
    head = data[:512].lstrip(b"\xef\xbb\xbf \t\r\n").lower()
    if head.startswith((b"<svg", b"<?xml")) and b"<svg" in data[:4096].lower():
        return "SVG"
    if head.startswith((b"<!doctype html", b"<html")):
        return "HTML"
    if data[4:8] == b"ftyp":
        return "a video"
    return "text" if _TEXT.fullmatch(data[:512]) else None


def _corrupt(media_type: str, why: str) -> NoReturn:
    raise UndecodableImageError(f"the {media_type} cannot be decoded: {why}")


def _read_jpeg(data: bytes) -> ImageHeader:
    """Walk the segments and scans up to the end-of-image marker (ITU T.81, annex B)."""
    kind = "image/jpeg"
    size: tuple[int, int] | None = None
    exif: bytes | None = None
    position = 2
    n_scans = 0
    for _ in range(_MAX_PIECES):
        position = data.find(b"\xff", position)
        found = _JPEG_NOT_FILL.search(data, position) if position >= 0 else None
        if found is None:
            _corrupt(kind, "it is truncated")
        marker = data[found.start()]
        position = found.end()
        if marker == 0xD9:
            break
        if marker <= 0x01 or 0xD0 <= marker <= 0xD7:
            continue
        if marker == 0xD8:
            _corrupt(kind, "a second image starts inside it")
        length = int.from_bytes(data[position : position + 2], "big")
        if length < 2 or position + length > len(data):
            _corrupt(kind, "it is truncated")
        segment = data[position + 2 : position + length]
        position += length
        if 0xC0 <= marker <= 0xCF and marker not in {0xC4, 0xC8, 0xCC}:
            if size is not None or len(segment) < 6:
                _corrupt(kind, "it has two frame headers")
            height, width = segment[1:3], segment[3:5]
            size = int.from_bytes(width, "big"), int.from_bytes(height, "big")
        elif marker == 0xE1 and segment.startswith(b"Exif\x00\x00") and exif is None:
            exif = segment[6:]
        elif marker == 0xDA:
            n_scans += 1
            if n_scans > _MAX_SCANS:
                _corrupt(kind, f"it has more than {_MAX_SCANS} scans")
            found = _JPEG_MARKER.search(data, position)
            position = found.start() if found else len(data)
    else:
        _corrupt(kind, "it has too many segments")
    if size is None or n_scans == 0:
        _corrupt(kind, "it holds no image")
    return ImageHeader(kind, size[0], size[1], exif, has_alpha=False)


def _read_png(data: bytes) -> ImageHeader:
    """Walk the chunks up to IEND, checking every checksum."""
    kind = "image/png"
    size: tuple[int, int] | None = None
    exif: bytes | None = None
    has_alpha = False
    clear_grey: int | None = None
    depth = colour = row_bits = 0
    pixels: list[tuple[int, int]] = []
    needless: list[tuple[int, int]] = []
    position = len(_PNG_MAGIC)
    for _ in range(_MAX_PIECES):
        length = int.from_bytes(data[position : position + 4], "big")
        end = position + 12 + length
        if end > len(data):
            _corrupt(kind, "it is truncated")
        name = data[position + 4 : position + 8]
        body = memoryview(data)[position + 8 : end - 4]
        if zlib.crc32(body, zlib.crc32(name)) != int.from_bytes(data[end - 4 : end], "big"):
            _corrupt(kind, "a checksum is wrong")
        if size is None:
            if name != b"IHDR" or length != 13:
                _corrupt(kind, "it does not start with its header")
            size = int.from_bytes(body[:4], "big"), int.from_bytes(body[4:8], "big")
            depth, colour = body[8], body[9]
            has_alpha = colour in {4, 6}
            row_bits = size[0] * depth * _PNG_CHANNELS.get(colour, 0)
        elif name == b"IHDR":
            _corrupt(kind, "it has two headers")
        elif name == b"tRNS" and not pixels:
            has_alpha = True
            if colour == 0 and length == 2 and clear_grey is None:
                sample = int.from_bytes(body, "big") & ((1 << depth) - 1)
                clear_grey = sample * _PNG_GREY_STEPS.get(depth, 1)
        elif name == b"eXIf":
            exif = bytes(body)
        elif name == b"IDAT":
            pixels.append((position + 8, end - 4))
        elif name == b"IEND":
            break
        if name[:1].islower() and name not in _PNG_NEEDED:
            needless.append((position, end))
        position = end
    else:
        _corrupt(kind, "it has too many chunks")
    if size is None or not pixels:
        _corrupt(kind, "it holds no image")
    # Interlaced, an image has more rows, and bytes for their filters and ends.
    most = size[1] * (row_bits // 8 + 16) + _PNG_PIECE
    is_much = sum(end - start for start, end in pixels) > _PNG_UNCHECKED
    deflated = Deflated(kind, tuple(pixels), most) if is_much else None
    return ImageHeader(
        kind, size[0], size[1], exif, has_alpha, clear_grey, tuple(needless), deflated
    )


def _read_webp(data: bytes) -> ImageHeader:
    """Walk the RIFF chunks; every stated size must agree with the canvas."""
    kind = "image/webp"
    end_of_file = 8 + int.from_bytes(data[4:8], "little")
    if end_of_file > len(data):
        _corrupt(kind, "it is truncated")
    canvas: tuple[int, int] | None = None
    frame: tuple[int, int] | None = None
    exif: bytes | None = None
    has_alpha = animated = False
    position = 12
    for _ in range(_MAX_PIECES):
        if position + 8 > end_of_file:
            break
        name = data[position : position + 4]
        length = int.from_bytes(data[position + 4 : position + 8], "little")
        start, end = position + 8, position + 8 + length
        if end > end_of_file:
            _corrupt(kind, "it is truncated")
        head = data[start : start + 10]
        if name == b"VP8X" and length >= 10:
            has_alpha |= bool(head[0] & 0x10)
            animated = bool(head[0] & 0x02)
            canvas = (
                1 + int.from_bytes(head[4:7], "little"),
                1 + int.from_bytes(head[7:10], "little"),
            )
        elif name == b"VP8 " and length >= 10 and head[3:6] == b"\x9d\x01\x2a":
            frame = (
                int.from_bytes(head[6:8], "little") & 0x3FFF,
                int.from_bytes(head[8:10], "little") & 0x3FFF,
            )
        elif name == b"VP8L" and length >= 5 and head[0] == 0x2F:
            bits = int.from_bytes(head[1:5], "little")
            frame = 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)
            has_alpha |= bool(bits >> 28 & 1)
        elif name == b"EXIF":
            block = data[start:end]
            exif = block.removeprefix(b"Exif\x00\x00")
        position = end + (length & 1)
    else:
        _corrupt(kind, "it has too many chunks")
    size = canvas or frame
    if size is None or (frame is None and not animated):
        _corrupt(kind, "it holds no image")
    if frame is not None and frame != size:
        _corrupt(kind, "its sizes contradict each other")
    return ImageHeader(kind, size[0], size[1], exif, has_alpha)
