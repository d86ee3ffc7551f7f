"""The compiled loops of the ensemble against the same in numpy, written out."""

import numpy as np
import pytest

from app.lifting.ensemble import Ensemble, local_prior, localisation, place_ensemble
from app.lifting.geometry import Floats
from app.lifting.posterior import STANDARD_PX_PER_MM
from app.lifting.proportions import PROPORTION_DIRECTIONS
from library_store.library import Library
from library_store.skeleton import L_HIP, R_HIP

RNG = np.random.default_rng(8)
SETTINGS = {
    "bandwidth_px": 16.0,
    "adaptive": 4.0,
    "granularity_px": 2.0,
    "localisation_bones": 20.0,
}


@pytest.fixture(scope="module")
def neighbours(library: Library) -> tuple[Floats, Floats]:
    """Exemplars that look alike, so that nobody comes too near to the camera."""
    alike = library.match(library.descriptors(1_234).reshape(1, 14, 2), None, 50).entries[0]
    return library.poses_mm(alike), library.rotations(alike)


def seen_points(neighbours: tuple[Floats, Floats]) -> Floats:
    placed = neighbours[0][3] @ neighbours[1][3].T + [30.0, -20.0, 4200.0]
    points: Floats = placed[:, :2] / placed[:, 2:] + RNG.normal(size=(14, 2)) * 0.002
    return points


def translated(rotated: Floats, points: Floats, weights: Floats) -> Floats:
    """The least-squares translation as a linear system: x (Z + t_z) = X + t_x."""
    root = np.sqrt(np.repeat(weights, 2))
    system = np.zeros((28, 3))
    system[0::2, 0] = system[1::2, 1] = 1.0
    system[:, 2] = -points.ravel()
    wanted = (points * rotated[:, 2:] - rotated[:, :2]).ravel()
    shift = np.linalg.lstsq(root[:, None] * system, root * wanted, rcond=None)[0]
    return rotated + np.asarray(shift, dtype=np.float64)


@pytest.mark.parametrize("missing", [(), (4, 9)])
def test_everybody_stands_where_least_squares_says(
    neighbours: tuple[Floats, Floats], missing: tuple[int, ...]
) -> None:
    poses, rotations = neighbours
    points, weights = seen_points(neighbours), RNG.uniform(0.3, 1.0, 14)
    weights[list(missing)] = 0.0
    points[list(missing)] = 1e3  # not read
    found = place_ensemble(poses, rotations, points, weights, 0.1)
    rotated = poses @ np.swapaxes(rotations, 1, 2)
    typical = rotated[:16].mean(0)
    people = [*rotated, typical, *(typical + 0.1 * PROPORTION_DIRECTIONS @ typical)]
    points[list(missing)] = 0.0
    placed = np.stack([translated(one, points, weights) for one in people])
    depth = placed[..., 2]
    root = 0.5 * (depth[:, R_HIP] + depth[:, L_HIP])
    px = STANDARD_PX_PER_MM * np.sort(root[: len(poses)])[len(poses) // 2]
    image = px * placed[..., :2] / depth[..., None]
    states = np.concatenate([image.reshape(-1, 28), depth / root[:, None] - 1.0], axis=1)
    assert found.px_per_unit == pytest.approx(px, rel=1e-9)
    np.testing.assert_allclose(found.states, states[: len(poses)], rtol=1e-7, atol=1e-7)
    np.testing.assert_allclose(found.root_depth_mm, root[: len(poses)], rtol=1e-9)
    changes = states[len(poses) + 1 :] - states[len(poses)]
    np.testing.assert_allclose(found.proportions, changes, atol=1e-7)


@pytest.mark.parametrize("n_rows", [28, 17])
def test_the_gaussian_is_that_of_the_weighted_neighbours(
    neighbours: tuple[Floats, Floats], n_rows: int
) -> None:
    points = seen_points(neighbours)
    ensemble = place_ensemble(*neighbours, points, np.ones(14), 0.1)
    rows = np.sort(RNG.permutation(28)[:n_rows])
    observed = ensemble.px_per_unit * points.ravel()
    prior = local_prior(ensemble, rows, observed, **SETTINGS)

    residual = ensemble.states[:, rows] - observed[rows]
    directions = ensemble.proportions[:, rows]
    metric = np.linalg.inv(16.0**2 * np.eye(n_rows) + directions.T @ directions) * 16.0**2
    squared = np.einsum("kr,rs,ks->k", residual, metric, residual)
    variance = 16.0**2 + 4.0 * squared.min() / (n_rows - 4)
    weights = np.exp(-0.5 * squared / variance)
    weights /= weights.sum()
    mean = weights @ ensemble.states
    spread = np.cov(ensemble.states.T, aweights=weights, bias=True)
    joint = np.concatenate([np.repeat(np.arange(14), 2), np.arange(14)])
    wanted = localisation(20.0)[np.ix_(joint, joint)] * spread
    wanted += ensemble.proportions.T @ ensemble.proportions
    wanted += np.diag(np.repeat([4.0, 0.0], [28, 14]))
    np.testing.assert_allclose(prior.mean, mean, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(prior.covariance, wanted, rtol=1e-7, atol=1e-9)
    np.testing.assert_array_equal(prior.covariance, prior.covariance.T)
    assert prior.root_depth_mm == pytest.approx(weights @ ensemble.root_depth_mm)


def test_what_does_not_belong_together_is_refused(neighbours: tuple[Floats, Floats]) -> None:
    """The compiled loops trust the shapes."""
    poses, rotations = neighbours
    with pytest.raises(ValueError, match="belong together"):
        place_ensemble(poses, rotations[1:], np.zeros((14, 2)), np.ones(14), 0.1)
    with pytest.raises(ValueError, match="belong together"):
        place_ensemble(poses, rotations, np.zeros((13, 2)), np.ones(13), 0.1)
    whole = place_ensemble(poses, rotations, seen_points(neighbours), np.ones(14), 0.1)
    with pytest.raises(ValueError, match="rows"):
        local_prior(whole, np.array([0, 42]), np.zeros(28), **SETTINGS)
    short = Ensemble(whole.states[:, :39], whole.root_depth_mm, whole.proportions, 1.0, 1700.0)
    with pytest.raises(ValueError, match="states"):
        local_prior(short, np.arange(4), np.zeros(28), **SETTINGS)
