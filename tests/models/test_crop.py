import numpy as np
import pytest

from models.crop import square_crop, warped


def ramp(height: int, width: int) -> np.ndarray:
    """Photo whose blue is x and whose green is y, so that a crop tells where it came from."""
    y, x = np.mgrid[0:height, 0:width]
    return np.stack([x, y, np.zeros_like(x)], -1).astype(np.uint8)


def test_a_crop_of_the_size_of_the_photo_is_the_photo() -> None:
    image = np.random.default_rng(0).integers(0, 256, (64, 64, 3)).astype(np.uint8)
    crop, scale, origin = square_crop(image, (31.5, 31.5), 64, 64)
    np.testing.assert_array_equal(crop, image)
    assert (scale, origin) == (1.0, (0.0, 0.0))


@pytest.mark.parametrize("side", [40.0, 90.0, 150.0, 200.0])
@pytest.mark.parametrize("center", [(120.0, 120.0), (101.3, 127.8)])
def test_crop_pixels_come_from_where_the_transform_says(
    side: float, center: tuple[float, float]
) -> None:
    image = ramp(240, 240)
    crop, scale, origin = square_crop(image, center, side, 40)
    inner = np.arange(3, 37)
    expected_x = origin[0] + scale * inner
    expected_y = origin[1] + scale * inner
    seen_x, seen_y = crop[20, inner, 0].astype(float), crop[inner, 20, 1].astype(float)
    fits_x, fits_y = (expected_x < 238) & (expected_x > 1), (expected_y < 238) & (expected_y > 1)
    np.testing.assert_allclose(seen_x[fits_x], expected_x[fits_x], atol=1.1)
    np.testing.assert_allclose(seen_y[fits_y], expected_y[fits_y], atol=1.1)


def test_shrinking_averages_instead_of_skipping() -> None:
    noise = np.random.default_rng(0).integers(0, 256, (400, 400, 3)).astype(np.uint8)
    crop, _, _ = square_crop(noise, (199.5, 199.5), 400, 50)
    deviation = float(crop[2:-2, 2:-2].std())
    assert deviation < 1.2 * float(noise.std()) / 8, "of the mean of 8 x 8 pixels"


def test_beyond_the_photo_is_black() -> None:
    image = np.full((50, 50, 3), 200, np.uint8)
    crop, _, _ = square_crop(image, (0.0, 0.0), 80, 40)
    assert crop[:18, :18].max() == 0
    assert crop[22:38, 22:38].min() == 200


@pytest.mark.parametrize("center", [(-500.0, 20.0), (20.0, 9000.0)])
def test_a_box_outside_the_photo_gives_a_black_crop(center: tuple[float, float]) -> None:
    crop, _, _ = square_crop(np.full((50, 50, 3), 200, np.uint8), center, 300, 32)
    assert crop.shape == (32, 32, 3)
    assert crop.max() == 0


def test_beyond_the_photo_is_the_grey_asked_for() -> None:
    crop, _, _ = square_crop(np.full((20, 20, 3), 200, np.uint8), (9.5, 9.5), 40, 40, 128)
    assert (crop[:5] == 128).all()
    assert (crop[15:25, 15:25] == 200).all()


@pytest.mark.parametrize("scale", [1.7, 0.8, 0.45, 0.21, 0.06])
@pytest.mark.parametrize("flip", [False, True])
def test_what_is_warped_lies_where_the_matrix_says(scale: float, flip: bool) -> None:
    turn = np.array([[np.cos(0.3), -np.sin(0.3)], [np.sin(0.3), np.cos(0.3)]])
    linear = scale * turn @ np.diag([-1.0 if flip else 1.0, 1.0])
    middle = np.array([127.3, 90.6])
    matrix = np.column_stack([linear, (60.2, 61.7) - linear @ middle])
    y, x = np.mgrid[0:200, 0:240]
    spread_px = min(20.0, 12.0 / scale)  # all of it on the canvas
    blob = np.exp(-((x - middle[0]) ** 2 + (y - middle[1]) ** 2) / (2 * spread_px**2))
    found = warped(blob.astype(np.float32), matrix, (120, 110))
    rows, columns = np.mgrid[0:110, 0:120]
    at = np.array([(columns * found).sum(), (rows * found).sum()]) / found.sum()
    np.testing.assert_allclose(at, (60.2, 61.7), atol=0.02 / min(scale, 1))


def test_warping_averages_instead_of_skipping() -> None:
    """What cv2.warpAffine does not do, also when it is asked for INTER_AREA."""
    noise = np.random.default_rng(0).integers(0, 256, (400, 400, 3)).astype(np.uint8)
    small = warped(noise, np.array([[0.125, 0, 0], [0, 0.125, 0]]), (50, 50))
    assert float(small[2:-2, 2:-2].std()) < 1.2 * float(noise.std()) / 8
