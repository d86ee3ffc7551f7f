from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from library_store.anatomy import (
    LENGTHS,
    Float,
    decode,
    encode,
    measure_lengths,
    mirror_legs,
    mirror_upper,
    root_of,
)
from library_store.limits import MEASURES, learn_limits, measure, segment_distance
from library_store.prior import PosePrior
from library_store.skeleton import (
    L_ELBOW,
    L_HIP,
    L_KNEE,
    L_WRIST,
    LSP14,
    NECK,
    R_ANKLE,
    R_HIP,
    R_KNEE,
)


@pytest.fixture(scope="module")
def poses(prior: PosePrior) -> Float:
    return prior.sample(1500, np.random.default_rng(3))


def pairwise(poses: Float) -> Float:
    distances: Float = np.linalg.norm(poses[:, :, None] - poses[:, None], axis=-1)
    return distances


def test_taken_apart_and_put_together_again(poses: Float) -> None:
    # Sampled people are symmetric but for the shoulders, whose mean length decode scales by.
    lengths = measure_lengths(poses)
    again = decode(encode(poses, lengths), lengths)
    assert_allclose(pairwise(again), pairwise(poses), atol=1e-6)
    assert_allclose(again[..., 1], poses[..., 1], atol=1e-6)


def test_lengths_are_exact(poses: Float) -> None:
    lengths = measure_lengths(poses) * np.linspace(0.8, 1.2, len(LENGTHS))
    again = measure_lengths(decode(encode(poses, measure_lengths(poses)), lengths))
    limbs = [
        LENGTHS.index(name) for name in ("hips", "head", "upper_arm", "forearm", "thigh", "shank")
    ]
    assert_allclose(again[:, limbs], lengths[:, limbs])


def test_mirroring_parts_mirrors_the_person(poses: Float) -> None:
    lengths = measure_lengths(poses)
    parts = encode(poses, lengths)
    mirrored = encode(poses[:, LSP14.mirror] * (-1.0, 1.0, 1.0), lengths)
    assert_allclose(mirrored.legs, mirror_legs(parts.legs), atol=1e-9)
    assert_allclose(mirrored.upper, mirror_upper(parts.upper), atol=1e-9)


def test_heading_does_not_matter(poses: Float) -> None:
    lengths = measure_lengths(poses)
    parts = encode(poses, lengths)
    turned = encode(poses[..., [2, 1, 0]] * (1.0, 1.0, -1.0), lengths)
    assert_allclose(turned.legs, parts.legs, atol=1e-9)
    assert_allclose(turned.upper, parts.upper, atol=1e-9)


def test_the_root_is_the_origin(poses: Float) -> None:
    assert_allclose(root_of(poses), 0.0, atol=1e-9)


def test_segment_distance_against_a_fine_grid() -> None:
    rng = np.random.default_rng(0)
    a0, a1, b0, b1 = rng.normal(size=(4, 50, 3))
    along = np.linspace(0.0, 1.0, 201)[:, None, None]
    on_a, on_b = a0 + along * (a1 - a0), b0 + along * (b1 - b0)
    grid = np.linalg.norm(on_a[:, None] - on_b[None], axis=-1).min(axis=(0, 1))
    exact = segment_distance(a0, a1, b0, b1)
    assert np.all(exact <= grid + 1e-12)
    assert_allclose(exact, grid, atol=0.02)


def test_limits_let_their_own_poses_pass(poses: Float) -> None:
    limits = learn_limits(poses, 0.001)
    assert limits.allow(poses).mean() > 0.93
    assert measure(poses).shape == (1500, len(MEASURES))


def test_a_knee_does_not_bend_forwards(prior: PosePrior, poses: Float) -> None:
    standing = poses[np.abs(poses[:, R_KNEE, 1] / poses[:, R_KNEE, 2]) > 3.0][:100].copy()
    hip, knee = standing[:, R_HIP], standing[:, R_KNEE]
    thigh = knee - hip
    left = standing[:, L_HIP] - standing[:, R_HIP]
    forwards = np.cross(left, -thigh)
    forwards /= np.linalg.norm(forwards, axis=1, keepdims=True)
    if np.mean(forwards[:, 2]) < 0:
        forwards = -forwards
    standing[:, R_ANKLE] = knee + 300.0 * forwards
    assert prior.limits.allow(standing).mean() < 0.05


def test_an_arm_does_not_pass_through_the_trunk(prior: PosePrior, poses: Float) -> None:
    through = poses.copy()
    middle = 0.5 * through[:, NECK]
    across = through[:, L_ELBOW] - middle
    through[:, L_WRIST] = middle - 0.3 * across
    assert not prior.limits.allow(through).any()


def test_legs_do_not_pass_through_each_other(prior: PosePrior, poses: Float) -> None:
    crossed = poses.copy()
    crossed[:, L_KNEE] = crossed[:, R_KNEE]
    assert not prior.limits.allow(crossed).any()
