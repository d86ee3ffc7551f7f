"""PNGs: what is transparent, animated, or beside the pixels."""

from __future__ import annotations

import struct
import zlib

import numpy as np
import pytest

from app.errors import UndecodableImageError
from tests.app.imaging.image_files import decode, encode, made_png, png_chunk, scene


@pytest.mark.parametrize(
    ("depth", "row", "clear", "shown"),
    [
        (1, b"\x50", 0, [255, 255, 255, 255]),
        (1, b"\x50", 1, [0, 255, 0, 255]),
        (2, b"\x1b", 1, [0, 255, 170, 255]),
        (4, b"\x05\xaf", 5, [0, 255, 170, 255]),
        (8, b"\x00\x32\x64\xc8", 0x32, [0, 255, 100, 200]),
        (8, b"\x00\x32\x64\xc8", 0x0132, [0, 255, 100, 200]),  # only the sample's own bits count
        # That the next sample has the same upper byte makes no difference.
        (16, b"\x00\x00\x80\x80\x80\x81\xff\xff", 0x8080, [0, 255, 128, 255]),
        (8, b"\x00\x32\x64\xc8", None, [0, 50, 100, 200]),
    ],
)
def test_the_transparent_grey_of_a_grey_png_is_white(
    depth: int, row: bytes, clear: int | None, shown: list[int]
) -> None:
    chunks = [] if clear is None else [png_chunk(b"tRNS", clear.to_bytes(2, "big"))]
    pixels = decode(made_png((4, 3), depth, 0, row, *chunks)).pixels_bgr
    assert pixels.shape == (3, 4, 3)
    assert np.array_equal(pixels, np.tile(np.array(shown, np.uint8)[:, None], (3, 1, 3)))


def test_what_is_no_statement_of_a_transparent_grey_changes_nothing() -> None:
    """Too short, too late or said again: libpng does not go by such either."""
    plain = made_png((4, 3), 8, 0, b"\x00\x32\x64\xc8")
    zero, fifty = (png_chunk(b"tRNS", bytes([0, value])) for value in (0, 0x32))
    for data in (
        plain[:33] + png_chunk(b"tRNS", b"\0") + plain[33:],
        plain[:-12] + zero + plain[-12:],
    ):
        assert np.array_equal(decode(data).pixels_bgr, decode(plain).pixels_bgr)
    twice = decode(plain[:33] + zero + fifty + plain[33:]).pixels_bgr
    assert twice[0, :, 0].tolist() == [255, 50, 100, 200]


@pytest.mark.parametrize("depth", [0, 3, 32, 255])
def test_a_grey_png_of_an_unheard_of_depth_is_refused(depth: int) -> None:
    with pytest.raises(UndecodableImageError):
        decode(made_png((4, 3), depth, 0, bytes(128), png_chunk(b"tRNS", b"\0\0")))


@pytest.mark.parametrize(
    ("colour", "row", "chunks"),
    [
        (2, bytes([0, 0, 0, 10, 20, 30]), [(b"tRNS", bytes(6))]),
        (3, b"\0\1", [(b"PLTE", bytes([9, 9, 9, 10, 20, 30])), (b"tRNS", b"\0")]),
    ],
)
def test_transparent_colours_of_other_pngs_are_white(
    colour: int, row: bytes, chunks: list[tuple[bytes, bytes]]
) -> None:
    made = made_png((2, 1), 8, colour, row, *(png_chunk(*chunk) for chunk in chunks))
    assert decode(made).pixels_bgr.tolist() == [[[255, 255, 255], [30, 20, 10]]]


def test_of_an_animated_png_the_still_picture_is_taken() -> None:
    """Also where it is none of the frames, or these are not as announced."""
    red, blue = b"\xc8\0\0", b"\0\0\xc8"
    still = made_png((1, 1), 8, 2, red)
    frames = [
        png_chunk(b"fcTL", struct.pack(">IIIIIHHBB", 2 * i, 1, 1, 0, 0, 1, 10, 0, 0))
        + png_chunk(b"fdAT", struct.pack(">I", 2 * i + 1) + zlib.compress(b"\0" + blue))
        for i in range(2)
    ]
    for announced in (0, 1, 2, 9):
        starts = png_chunk(b"acTL", struct.pack(">II", announced, 0))
        data = still[:33] + starts + still[33:-12] + b"".join(frames) + still[-12:]
        assert decode(data).pixels_bgr.tolist() == [[[0, 0, 200]]]


def test_what_a_png_says_beside_its_pixels_is_not_inflated(
    capfd: pytest.CaptureFixture[str],
) -> None:
    """Each text could be 8 MB of nothing in 8 KB; libpng, if it saw these, would complain."""
    png = encode(scene(), ".png")
    chunks = [
        png_chunk(b"zTXt", b"key\0\0" + b"no deflate"),
        png_chunk(b"iTXt", b"key\0\1\0\0\0" + b"no deflate"),
        png_chunk(b"iCCP", b"key\0\0" + b"no deflate"),
    ]
    data = png[:33] + b"".join(chunks) + png[33:-12] + b"".join(2 * chunks) + png[-12:]
    assert np.array_equal(decode(data).pixels_bgr, decode(png).pixels_bgr)
    assert capfd.readouterr().err == ""


def test_pngs_whose_pixels_are_followed_by_more_are_refused() -> None:
    """libpng inflates all of it: a file of 15 MB would take it half a minute."""
    noise = np.random.default_rng(0).integers(0, 256, (700, 701, 3)).astype(np.uint8)
    png = encode(noise, ".png")
    assert len(png) > 1_400_000
    rows = zlib.decompress(b"".join(png_bodies(png, b"IDAT")))

    def made(pixels: bytes) -> bytes:
        end = png_chunk(b"IDAT", zlib.compress(pixels, 1)) + png_chunk(b"IEND", b"")
        return png[:33] + end

    assert np.array_equal(decode(made(rows)).pixels_bgr, noise)
    with pytest.raises(UndecodableImageError, match="more data than its pixels take"):
        decode(made(rows + bytes(50_000_000)))


def png_bodies(png: bytes, name: bytes) -> list[bytes]:
    found, position = [], 8
    while position < len(png):
        length = int.from_bytes(png[position : position + 4], "big")
        if png[position + 4 : position + 8] == name:
            found.append(png[position + 8 : position + 8 + length])
        position += 12 + length
    return found


def test_a_wrong_png_checksum_is_refused() -> None:
    png = bytearray(encode(scene(), ".png"))
    png[len(png) // 2] ^= 1
    with pytest.raises(UndecodableImageError):
        decode(bytes(png))
