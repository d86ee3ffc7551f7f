"""Decoding: orientations, reduced scales, odd sizes, formats; against OpenCV's own encoders."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from tests.app.imaging.image_files import (
    STORED,
    decode,
    encode,
    png_with_exif,
    scene,
    tiff,
    webp_with_exif,
    with_exif,
)


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
