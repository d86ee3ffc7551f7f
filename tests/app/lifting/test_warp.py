import numpy as np

from app.lifting.geometry import normalised_projection
from app.lifting.warp import warp_perspective, warp_weak_perspective

RNG = np.random.default_rng(2)
EXEMPLAR = RNG.normal(size=(5, 14, 3)) * 400 + [0, 0, 4000]
POINTS = RNG.normal(size=(5, 14, 2)) * 0.1
ALL = np.ones((5, 14), bool)


def test_perspective_warp_reprojects_exactly_and_keeps_the_depth() -> None:
    warped = warp_perspective(EXEMPLAR, POINTS, ALL)
    np.testing.assert_allclose(normalised_projection(warped), POINTS, atol=1e-15)
    np.testing.assert_array_equal(warped[..., 2], EXEMPLAR[..., 2])


def test_weak_perspective_warp_is_equation_6() -> None:
    focal_px = 1150.0
    pixels = POINTS * focal_px
    warped = warp_weak_perspective(EXEMPLAR, POINTS, ALL)
    for pose, pixel, answer in zip(EXEMPLAR, pixels, warped, strict=True):
        s = pose[:, 2].mean() / focal_px
        np.testing.assert_allclose(answer, np.column_stack([s * pixel, pose[:, 2]]))


def test_missing_joints_stay_the_exemplars() -> None:
    present = RNG.random((5, 14)) > 0.3
    for warp in (warp_perspective, warp_weak_perspective):
        np.testing.assert_array_equal(warp(EXEMPLAR, POINTS, present)[~present], EXEMPLAR[~present])
