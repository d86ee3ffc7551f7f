from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from library_store.descriptor import describe, normalise, weighted_distance


def random_pose(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(14, 2)) * 80.0 + 300.0


@given(
    seed=st.integers(0, 1000),
    scale=st.floats(1e-3, 1e3),
    x=st.floats(-1e3, 1e3),
    y=st.floats(-1e3, 1e3),
)
def test_position_and_size_are_forgotten(seed: int, scale: float, x: float, y: float) -> None:
    pose = random_pose(seed)
    assert_allclose(describe(scale * pose + (x, y)), describe(pose), atol=1e-5)


def test_centroid_is_zero_and_rms_radius_one() -> None:
    pose = normalise(random_pose(0))
    assert_allclose(pose.mean(axis=0), 0.0, atol=1e-12)
    assert_allclose((pose**2).sum(axis=1).mean(), 1.0)
    assert_allclose(np.linalg.norm(describe(random_pose(0))), np.sqrt(14.0), rtol=1e-6)


def test_a_lying_person_is_as_large_as_a_standing_one() -> None:
    standing = random_pose(1) * (0.1, 1.0)
    lying = standing[:, ::-1]
    assert_allclose(normalise(lying), normalise(standing)[:, ::-1])


def test_equal_weights_are_the_plain_distance() -> None:
    query, poses = random_pose(0), np.stack([random_pose(seed) for seed in range(1, 6)])
    plain = np.linalg.norm(
        describe(query).astype(np.float64) - describe(poses).astype(np.float64), axis=1
    )
    for weight in (1.0, 0.3):
        assert_allclose(weighted_distance(query, np.full(14, weight), poses), plain, rtol=1e-5)


def test_masked_distance_takes_out_the_best_shift_and_scale() -> None:
    pose = random_pose(0)
    weights = np.ones(14)
    weights[[3, 4]] = 0.0
    moved = 2.5 * pose + (7.0, -3.0)
    moved[[3, 4]] += 1e4
    assert_allclose(weighted_distance(moved, weights, pose[None]), 0.0, atol=1e-12)


def test_missing_joints_are_not_read() -> None:
    pose = random_pose(0)
    weights = np.ones(14)
    weights[9] = 0.0
    blank = pose.copy()
    blank[9] = np.nan
    others = np.stack([random_pose(1), random_pose(2)])
    assert_allclose(
        weighted_distance(blank, weights, others), weighted_distance(pose, weights, others)
    )


def test_a_pose_without_size_is_refused() -> None:
    with pytest.raises(ValueError, match="two distinct joints"):
        normalise(np.ones((14, 2)))
    with pytest.raises(ValueError, match="two joints"):
        normalise(random_pose(0), np.zeros(14))
    with pytest.raises(ValueError, match="two distinct joints"):
        normalise(random_pose(0), np.eye(14)[0])
