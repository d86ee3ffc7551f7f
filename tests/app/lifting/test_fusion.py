import numpy as np
import pytest

from app.lifting.ensemble import Ensemble, localisation, place_ensemble
from app.lifting.fusion import FusionSettings, fuse
from app.lifting.geometry import Floats, lift_to_depth, normalised_projection
from app.lifting.posterior import standard_px_per_unit
from app.lifting.stature import stature_mm
from evaluation.metrics import similarity_error_mm
from library_store.library import Library
from tests.app.lifting.conftest import asymmetry

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
    states = np.concatenate([people[:n, :, :2].reshape(n, 28), people[:n, :, 2]], axis=1)
    points, depth = people[n, :, :2] / PX, ROOT_DEPTH_MM * (1 + people[n, :, 2])
    height = float(stature_mm(lift_to_depth(points, depth)))
    ensemble = Ensemble(states, np.full(n, ROOT_DEPTH_MM), np.zeros((0, 42)), PX, height)
    return ensemble, points, depth


EXACT = FusionSettings(
    bandwidth_px=1e4,
    granularity_px=1e-4,
    localisation_bones=1e9,
    noise_px=(1e-4,),
    asymmetry=1e9,
)
LOOSE = FusionSettings(asymmetry=1e9)


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
    fused = fuse(ensemble, points, ALL, noise, FusionSettings(bandwidth_px=1e6, asymmetry=1e9))
    mean = ensemble.states[:, :28].mean(0).reshape(14, 2)
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
    ordinary = LOOSE
    spread = fuse(ensemble, hidden, confidence, None, ordinary).spread_mm[4]
    assert spread > fuse(ensemble, points, ALL, None, ordinary).spread_mm[4]


@pytest.mark.parametrize("noise_px", [2.0, 6.5, 13.0])
def test_the_noise_is_estimated(noise_px: float) -> None:
    found = []
    for seed in range(30):
        ensemble, points, _ = linear_world(seed=seed)
        noise = np.random.default_rng(seed + 1000).normal(size=(14, 2)) * noise_px / PX
        found.append(fuse(ensemble, points + noise, ALL, None, LOOSE).noise_px)
    assert np.median(found) == pytest.approx(noise_px, rel=0.4)


def test_a_joint_that_contradicts_the_others_is_named() -> None:
    named, falsely = 0, 0
    for seed in range(20):
        ensemble, points, _ = linear_world(seed=seed)
        noise = np.random.default_rng(seed).normal(size=(14, 2)) * 2.0 / PX
        falsely += fuse(ensemble, points + noise, ALL, None, LOOSE).outlier is not None
        moved = points + noise
        moved[10] += 70.0 / PX
        named += fuse(ensemble, moved, ALL, None, LOOSE).outlier == 10
    assert named >= 19
    assert falsely <= 1


def test_an_unsure_joint_is_followed_less() -> None:
    """As its covariance grows, and as its confidence falls."""
    ensemble, points, _ = linear_world()
    moved = points.copy()
    moved[10] += 20.0 / PX

    def followed(variance_px2: float, confidence: float) -> float:
        sure, covariance = ALL.copy(), np.tile(4.0 * np.eye(2), (14, 1, 1))
        sure[10], covariance[10] = confidence, variance_px2 * np.eye(2)
        found = normalised_projection(fuse(ensemble, moved, sure, covariance, LOOSE).joints_mm)
        return float(np.linalg.norm(found[10] - points[10]) * PX)

    assert followed(4.0, 1.0) > 1.2 * followed(400.0, 1.0)
    assert followed(4.0, 1.0) > 1.2 * followed(4.0, 0.01)
    assert followed(400.0, 0.5) == pytest.approx(followed(800.0, 1.0))


def test_localisation_is_positive_definite_and_fades_with_bones() -> None:
    factors = localisation(3.0)
    assert np.linalg.eigvalsh(factors).min() > 0
    assert factors[4, 3] > factors[4, 2] > factors[4, 10]
    np.testing.assert_array_equal(np.diag(factors), 1.0)


def narrow(poses_mm: Floats, factor: float) -> Floats:
    """The same poses with shoulders of another width, arms and all."""
    changed = poses_mm.copy()
    for arm in ((2, 3, 4), (5, 6, 7)):
        shift = (factor - 1.0) * (poses_mm[:, arm[0]] - poses_mm[:, 1])
        changed[:, arm] += shift[:, None]
    return changed


def test_narrow_shoulders_are_not_taken_for_a_turned_trunk(library: Library) -> None:
    entries = np.arange(0, 4_000, 160)
    rotations = library.rotations(entries)
    truth = narrow(library.poses_mm(entries), 0.75) @ np.swapaxes(rotations, 1, 2)
    truth += np.array([0.0, 0.0, 4500.0])
    points = normalised_projection(truth)
    matches = library.match(points, None, 100)
    errors = []
    for spread in (0.0, 0.1):
        settings = FusionSettings(proportion_spread=spread)
        answers = [
            fuse(
                place_ensemble(
                    library.poses_mm(found), library.rotations(found), seen, ALL, spread
                ),
                seen,
                ALL,
                None,
                settings,
            ).joints_mm
            for found, seen in zip(matches.entries, points, strict=True)
        ]
        errors.append(similarity_error_mm(np.stack(answers), truth).mean())
    assert errors[1] < 0.95 * errors[0]


def test_sides_come_out_equally_long(library: Library) -> None:
    entries = np.arange(7, 4_000, 160)
    poses = library.poses_mm(entries) @ np.swapaxes(library.rotations(entries), 1, 2)
    points = normalised_projection(poses + np.array([0.0, 0.0, 4500.0]))
    found = library.match(points, None, 60).entries[:, 10:]
    ratios = []
    for sigma in (0.15, 1e9):
        fused = [
            fuse(
                place_ensemble(library.poses_mm(near), library.rotations(near), seen, ALL, 0.1),
                seen,
                ALL,
                None,
                FusionSettings(asymmetry=sigma),
            )
            for near, seen in zip(found, points, strict=True)
        ]
        ratios.append(np.mean([np.abs(asymmetry(one.joints_mm)).mean() for one in fused]))
        assert all(np.isfinite(one.spread_mm).all() for one in fused)
    assert ratios[0] < 0.6 * ratios[1]
