"""From posterior spread to sigma_mm: invariants of the radius."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from app.lifting.calibration import FUSION_SIGMA, SigmaCalibration

PLAIN = SigmaCalibration((1.0,) * 14, 0.0, person_doubt_mm=300.0, joint_doubt_mm=400.0)
SPREAD_MM = np.full(14, 50.0)
SURE = np.ones(14)


def test_sure_joints_add_nothing() -> None:
    exact = FUSION_SIGMA(SPREAD_MM, 3.0)
    np.testing.assert_array_equal(FUSION_SIGMA(SPREAD_MM, 3.0, SURE), exact)


def test_a_doubtful_joint_widens_its_own_radius_most_and_everybody_s_a_little() -> None:
    confidence = SURE.copy()
    confidence[4] = 0.3
    radius = PLAIN(SPREAD_MM, 0.0, confidence)
    others = np.delete(radius, 4)
    np.testing.assert_allclose(others, np.hypot(50.0, 300.0 * 0.7 / 14))
    assert radius[4] == pytest.approx(np.sqrt(50.0**2 + (300.0 * 0.7 / 14) ** 2 + 280.0**2))


def test_the_noise_found_widens_all_radii() -> None:
    noisy = SigmaCalibration((1.0, *(2.0,) * 13), 4.0)
    radius = noisy(SPREAD_MM, 9.0, SURE)
    np.testing.assert_allclose(radius, np.hypot(50.0, 36.0) * np.array([1.0, *(2.0,) * 13]))


def test_missing_joints_are_no_doubtful_ones() -> None:
    """What is not seen contradicts nobody."""
    confidence = SURE.copy()
    confidence[[4, 7]] = 0.0
    np.testing.assert_array_equal(PLAIN(SPREAD_MM, 0.0, confidence), SPREAD_MM)
    confidence[3] = 0.4
    np.testing.assert_allclose(
        PLAIN(SPREAD_MM, 0.0, confidence)[4], np.hypot(50.0, 300.0 * 0.6 / 12)
    )


def test_what_is_missing_widens_every_radius() -> None:
    growing = replace(PLAIN, missing_doubt=0.7)
    np.testing.assert_array_equal(growing(SPREAD_MM, 0.0, SURE), SPREAD_MM)
    confidence = SURE.copy()
    confidence[7:] = 0.0
    np.testing.assert_allclose(growing(SPREAD_MM, 0.0, confidence), 1.35 * SPREAD_MM)
    confidence[0] = 0.5
    plain = PLAIN(1.35 * SPREAD_MM, 0.0, confidence)
    np.testing.assert_allclose(growing(SPREAD_MM, 0.0, confidence), plain)


def test_people_do_not_mix() -> None:
    rng = np.random.default_rng(0)
    spread, noise = rng.uniform(20, 200, (5, 14)), rng.uniform(0, 9, 5)
    confidence = rng.uniform(0.2, 1, (5, 14))
    together = FUSION_SIGMA(spread, noise, confidence)
    for i in range(5):
        alone = FUSION_SIGMA(spread[i], noise[i], confidence[i])
        np.testing.assert_allclose(together[i], alone, rtol=1e-12)
