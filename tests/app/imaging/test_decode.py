"""Decoding: orientations, reduced scales, formats, refusals; against OpenCV's own encoders."""

from __future__ import annotations

import re
import struct
import zlib
from contextlib import suppress

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from app.errors import (
    RequestError,
    TooManyPixelsError,
    UndecodableImageError,
    UnsupportedImageTypeError,
)
from app.imaging import Photo, decode_photo, read_header
from app.imaging.exif import read_exif

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


def png_with_exif(png: bytes, block: bytes) -> bytes:
    return png[:33] + png_chunk(b"eXIf", block) + png[33:]


def webp_with_exif(webp: bytes, block: bytes, width: int, height: int) -> bytes:
    canvas = b"\x08\x00\x00\x00" + (width - 1).to_bytes(3, "little")
    canvas += (height - 1).to_bytes(3, "little")
    chunks = b"VP8X" + struct.pack("<I", 10) + canvas + webp[12:]
    chunks += b"EXIF" + struct.pack("<I", len(block)) + block + b"\x00" * (len(block) & 1)
    return b"RIFF" + struct.pack("<I", 4 + len(chunks)) + b"WEBP" + chunks


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("kind", ["jpeg", "png", "webp"])
def test_every_orientation_is_turned_upright(orientation: int, kind: str) -> None:
    upright = scene()
    stored = STORED[orientation](upright)
    block = tiff(orientation)
    if kind == "jpeg":
        data = with_exif(encode(stored, ".jpg", cv2.IMWRITE_JPEG_QUALITY, 95), block)
    elif kind == "png":
        data = png_with_exif(encode(stored, ".png"), block)
    else:
        webp = encode(stored, ".webp", cv2.IMWRITE_WEBP_QUALITY, 95)
        data = webp_with_exif(webp, block, stored.shape[1], stored.shape[0])
    photo = decode(data)
    assert photo.orientation == orientation
    assert (photo.width_px, photo.height_px) == (160, 96)
    assert np.abs(photo.pixels_bgr.astype(int) - upright).mean() < 4


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("reduction", [1, 2, 4, 8])
@pytest.mark.parametrize("mirrored", [False, True])
def test_a_reduced_photo_knows_where_its_pixels_are(
    orientation: int, reduction: int, mirrored: bool
) -> None:
    """A blob is found at the same full-size place at every scale, also on sizes not divisible."""
    height, width, where = 611, 843, np.array([301.0, 222.0])
    y, x = np.mgrid[:height, :width]
    blob = 230 * np.exp(-((x - where[0]) ** 2 + (y - where[1]) ** 2) / (2 * 20.0**2))
    upright = np.repeat(blob[..., None], 3, 2).astype(np.uint8)
    data = with_exif(encode(STORED[orientation](upright), ".jpg"), tiff(orientation))
    photo = decode(data, max_pixels=10**7, side_px=width // reduction)
    assert photo.reduction == reduction
    expected = where
    if mirrored:
        photo = photo.mirrored()
        expected = np.array([width - 1 - where[0], where[1]])
    weights = photo.pixels_bgr[..., 0].astype(float)
    weights[weights < 12] = 0
    rows, columns = np.indices(weights.shape)
    centre = np.array([(weights * columns).sum(), (weights * rows).sum()]) / weights.sum()
    found = centre * photo.reduction + photo.offset_px
    # The blob's faint rim is cut off on whole pixels, which are coarse at 1/8.
    np.testing.assert_allclose(found, expected, atol=max(0.15, 0.05 * reduction))


def test_a_given_box_keeps_its_resolution() -> None:
    data = encode(scene(2000, 3000), ".jpg")
    assert decode(data).reduction == 2
    near = decode(data, box_px=(0, 0, 300, 500))
    assert near.reduction == 1
    far = decode(data, box_px=(0, 0, 1000, 1900))
    assert far.reduction == 4


@pytest.mark.parametrize("extension", [".jpg", ".png", ".webp"])
@pytest.mark.parametrize("size", [(1, 1), (1, 2000), (2000, 1), (7, 5)])
def test_odd_sizes(extension: str, size: tuple[int, int]) -> None:
    photo = decode(encode(scene(*size), extension))
    assert photo.pixels_bgr.shape == (*size, 3)


def test_sixteen_bits_grey_and_alpha() -> None:
    colour = scene()
    deep = colour.astype(np.uint16) * 257
    assert np.array_equal(decode(encode(deep, ".png")).pixels_bgr, colour)
    grey = decode(encode(colour[..., 0], ".png")).pixels_bgr
    assert np.array_equal(grey, np.repeat(colour[..., :1], 3, 2))
    alpha = np.zeros(colour.shape[:2], np.uint8)
    alpha[:, 80:] = 255
    for extension in (".png", ".webp"):
        flags = (cv2.IMWRITE_WEBP_QUALITY, 101) if extension == ".webp" else ()
        cut_out = encode(np.dstack([colour, alpha]), extension, *flags)
        pixels = decode(cut_out).pixels_bgr
        assert (pixels[:, :80] == 255).all(), "transparent pixels are white"
        assert np.array_equal(pixels[:, 80:], colour[:, 80:])
    deep_cut_out = encode(np.dstack([deep, alpha.astype(np.uint16) * 257]), ".png")
    assert (decode(deep_cut_out).pixels_bgr[:, :80] == 255).all()


def made_png(size: tuple[int, int], depth: int, colour: int, row: bytes, *chunks: bytes) -> bytes:
    """A PNG of equal rows; ``size`` is width and height, ``chunks`` come before the pixels."""
    header = png_chunk(b"IHDR", struct.pack(">IIBBBBB", *size, depth, colour, 0, 0, 0))
    pixels = png_chunk(b"IDAT", zlib.compress(size[1] * (b"\0" + row)))
    return b"\x89PNG\r\n\x1a\n" + header + b"".join(chunks) + pixels + png_chunk(b"IEND", b"")


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


def test_the_first_frame_of_an_animation() -> None:
    frames = [scene(), 255 - scene()]
    animation = cv2.Animation()
    animation.frames = [np.dstack([f, np.full(f.shape[:2], 255, np.uint8)]) for f in frames]
    animation.durations = [100, 100]
    for extension in (".png", ".webp"):
        done, data = cv2.imencodeanimation(extension, animation)
        assert done
        pixels = decode(data.tobytes()).pixels_bgr
        assert np.abs(pixels.astype(int) - frames[0]).mean() < 8


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


def test_a_wrong_png_checksum_is_refused() -> None:
    png = bytearray(encode(scene(), ".png"))
    png[len(png) // 2] ^= 1
    with pytest.raises(UndecodableImageError):
        decode(bytes(png))


def test_many_empty_segments_do_not_take_long() -> None:
    flood = b"\xff\xd8" + b"\xff\xfe\x00\x02" * 3_000_000
    with pytest.raises(UndecodableImageError):
        read_header(flood)
    with pytest.raises(UndecodableImageError):
        read_header(b"\xff\xd8\xff" + b"\xff" * 15_000_000)


def test_exif_focal_length_holds_for_the_whole_sensor_only() -> None:
    stated = read_exif(tiff(1, focal_35mm=26, size=(4032, 3024)))
    focal = stated.focal_length_px(4032, 3024)
    assert focal is not None
    assert focal == pytest.approx(26 * 5040 / 43.2666, rel=1e-4)
    assert stated.focal_length_px(1008, 756) == pytest.approx(focal / 4), "scaled"
    assert stated.focal_length_px(3024, 4032) == pytest.approx(focal), "turned"
    assert stated.focal_length_px(3024, 3024) is None, "cropped"
    assert read_exif(tiff(1, focal_35mm=26)).focal_length_px(4032, 3024) is None
    assert read_exif(tiff(1, focal_35mm=0, size=(40, 30))).focal_length_px(40, 30) is None


def test_broken_exif_is_no_exif() -> None:
    whole = tiff(6, 26, (40, 30))
    for end in range(len(whole)):
        read_exif(whole[:end])
    rng = np.random.default_rng(0)
    for _ in range(300):
        damaged = bytearray(whole)
        damaged[rng.integers(len(whole))] = rng.integers(256)
        exif = read_exif(bytes(damaged))
        assert 1 <= exif.orientation <= 8
    assert read_exif(tiff(9)).orientation == 1
