import numpy as np
import pytest

from app.lifting.fusion import Ensemble, FusionSettings, fuse, localisation
from app.lifting.geometry import Floats, normalised_projection
from app.lifting.posterior import standard_px_per_unit

ROOT_DEPTH_MM = 4000.0
PX = standard_px_per_unit(ROOT_DEPTH_MM)
ALL = np.ones(14)


def linear_world(n: int = 200, seed: int = 0) -> tuple[Ensemble, Floats, Floats]:
    """An ensemble whose depths are linear in its image positions, and one more such person."""
    rng = np.random.default_rng(seed)
    modes = rng.normal(size=(4, 14, 3))
    base = rng.normal(size=(14, 3)) * [80.0, 80.0, 0.05]
    codes = rng.normal(size=(n + 1, 4))
    people = base + np.einsum("nm,mjd->njd", codes, modes) * [6.0, 6.0, 0.01]
    ensemble = Ensemble(people[:n, :, :2], people[:n, :, 2], np.full(n, ROOT_DEPTH_MM), PX)
    return ensemble, people[n, :, :2] / PX, ROOT_DEPTH_MM * (1 + people[n, :, 2])


EXACT = FusionSettings(
    bandwidth_px=1e4, granularity_px=1e-4, localisation_bones=1e9, noise_px=(1e-4,)
)


def test_depth_is_regressed_on_the_image() -> None:
    ensemble, points, depth = linear_world()
    fused = fuse(ensemble, points, ALL, None, EXACT)
    np.testing.assert_allclose(fused.joints_mm[:, 2], depth, atol=1.0)


def test_without_noise_the_answer_reprojects() -> None:
    ensemble, points, _ = linear_world()
    fused = fuse(ensemble, points, ALL, None, EXACT)
    np.testing.assert_allclose(normalised_projection(fused.joints_mm) * PX, points * PX, atol=0.01)


def test_with_boundless_noise_the_answer_is_the_ensembles_mean() -> None:
    ensemble, points, _ = linear_world()
    noise = np.broadcast_to(1e12 * np.eye(2), (14, 2, 2))
    fused = fuse(ensemble, points, ALL, noise, FusionSettings(bandwidth_px=1e6))
    mean = ensemble.positions_px.mean(0)
    np.testing.assert_allclose(normalised_projection(fused.joints_mm) * PX, mean, atol=0.1)


def test_a_missing_joint_is_inferred_from_the_others_and_is_less_sure() -> None:
    ensemble, points, depth = linear_world()
    confidence = ALL.copy()
    confidence[4] = 0.0
    hidden = points.copy()
    hidden[4] = 0.0
    fused = fuse(ensemble, hidden, confidence, None, EXACT)
    np.testing.assert_allclose(
        normalised_projection(fused.joints_mm)[4] * PX, points[4] * PX, atol=1
    )
    np.testing.assert_allclose(fused.joints_mm[4, 2], depth[4], atol=1.0)
    ordinary = FusionSettings()
    spread = fuse(ensemble, hidden, confidence, None, ordinary).spread_mm[4]
    assert spread > fuse(ensemble, points, ALL, None, ordinary).spread_mm[4]


@pytest.mark.parametrize("noise_px", [2.0, 6.5, 13.0])
def test_the_noise_is_estimated(noise_px: float) -> None:
    found = []
    for seed in range(30):
        ensemble, points, _ = linear_world(seed=seed)
        noise = np.random.default_rng(seed + 1000).normal(size=(14, 2)) * noise_px / PX
        found.append(fuse(ensemble, points + noise, ALL, None, FusionSettings()).noise_px)
    assert np.median(found) == pytest.approx(noise_px, rel=0.4)


def test_a_joint_that_contradicts_the_others_is_named() -> None:
    named, falsely = 0, 0
    for seed in range(20):
        ensemble, points, _ = linear_world(seed=seed)
        noise = np.random.default_rng(seed).normal(size=(14, 2)) * 2.0 / PX
        falsely += fuse(ensemble, points + noise, ALL, None, FusionSettings()).outlier is not None
        moved = points + noise
        moved[10] += 70.0 / PX
        named += fuse(ensemble, moved, ALL, None, FusionSettings()).outlier == 10
    assert named >= 19
    assert falsely <= 1


def test_localisation_is_positive_definite_and_fades_with_bones() -> None:
    factors = localisation(3.0)
    assert np.linalg.eigvalsh(factors).min() > 0
    assert factors[4, 3] > factors[4, 2] > factors[4, 10]
    np.testing.assert_array_equal(np.diag(factors), 1.0)
