from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from library_store.anatomy import LENGTHS, Float, frame_of, measure_lengths, root_of
from library_store.clean import face_ahead
from library_store.limits import Limits, learn_limits
from library_store.prior import PosePrior
from library_store.proportions import draw_factors, resize
from library_store.recombine import Recombined, join, mirror, recombine
from library_store.skeleton import L_HIP, LSP14, NECK, R_HIP


@pytest.fixture(scope="module")
def poses(prior: PosePrior) -> Float:
    return face_ahead(prior.sample(200, np.random.default_rng(11)))


def in_pelvis_frame(poses: Float) -> Float:
    frames = frame_of(poses[:, L_HIP] - poses[:, R_HIP], poses[:, NECK], keep="x")
    seen: Float = np.einsum("nij,nkj->nki", frames, poses)
    return seen


def test_parts_are_those_of_their_poses(poses: Float) -> None:
    legs, upper = poses[:100], poses[100:]
    joined = join(legs, upper, np.ones((100, 8)))
    assert_allclose(joined[:, R_HIP:], legs[:, R_HIP:])
    assert_allclose(
        in_pelvis_frame(joined)[:, :R_HIP], in_pelvis_frame(upper)[:, :R_HIP], atol=1e-6
    )
    assert_allclose(join(legs, legs, np.ones((100, 8))), legs, atol=1e-6)


def test_resizing_changes_lengths_and_no_direction(poses: Float) -> None:
    factors = draw_factors(200, np.random.default_rng(0), stature_sd=0.1, bone_sd=0.1)
    resized = resize(poses, factors)
    assert_allclose(measure_lengths(resized), measure_lengths(poses) * factors, rtol=1e-9)
    assert_allclose(root_of(resized), 0.0, atol=1e-9)
    for parent, child in LSP14.edges:
        if parent == NECK and child in (R_HIP, L_HIP):
            continue  # the trunk is root to neck
        before, after = (p[:, child] - p[:, parent] for p in (poses, resized))
        cosine = (before * after).sum(-1) / np.linalg.norm(before, axis=-1)
        assert_allclose(cosine, np.linalg.norm(after, axis=-1), rtol=1e-9)
    assert_allclose(resize(poses, np.ones((200, 8))), poses, atol=1e-9)


def test_spread_of_proportions() -> None:
    factors = np.log(draw_factors(20_000, np.random.default_rng(0), stature_sd=0.05, bone_sd=0.03))
    assert factors.mean() == pytest.approx(0.0, abs=0.002)
    assert factors.std() == pytest.approx(np.hypot(0.05, 0.03), rel=0.02)
    assert factors.mean(axis=1).std() == pytest.approx(np.hypot(0.05, 0.03 / 8**0.5), rel=0.02)


def drawn(
    poses: Float,
    limits: Limits,
    seed: int = 1,
    n: int = 500,
    *,
    may_mirror: bool = True,
    **spread: float,
) -> Recombined:
    return recombine(
        poses.astype(np.float32),
        measure_lengths(poses),
        n,
        np.random.default_rng(seed),
        limits=limits,
        may_mirror=may_mirror,
        **({"stature_sd": 0.05, "bone_sd": 0.03} | spread),
    )


def test_recombined_poses_name_their_parts_and_keep_the_limits(poses: Float) -> None:
    limits = learn_limits(poses, 0.02)
    result = drawn(poses, limits, stature_sd=0.0, bone_sd=0.0)
    assert limits.allow(result.poses).all()
    assert result.mirrored.any()
    assert not result.mirrored.all()
    assert len(np.unique(result.rows)) > 150
    legs = poses[result.rows[:, 0]]
    legs = np.where(result.mirrored[:, :1, None], mirror(legs), legs)
    assert_allclose(result.poses[:, R_HIP:], legs[:, R_HIP:], atol=1e-3)
    again = drawn(poses, limits, stature_sd=0.0, bone_sd=0.0)
    assert_allclose(again.poses, result.poses)
    # The upper body takes the proportions of the legs' person.
    own = measure_lengths(legs)
    trunk = LENGTHS.index("trunk")
    assert_allclose(measure_lengths(result.poses)[:, trunk], own[:, trunk], rtol=1e-5)


def test_nothing_is_mirrored_where_that_is_not_wanted(poses: Float) -> None:
    result = drawn(poses, learn_limits(poses, 0.02), may_mirror=False, stature_sd=0.0, bone_sd=0.0)
    assert not result.mirrored.any()
    assert_allclose(result.poses[:, R_HIP:], poses[result.rows[:, 0]][:, R_HIP:], atol=1e-3)


def test_limits_that_refuse_all_are_an_error(poses: Float) -> None:
    nothing = learn_limits(poses, 0.02)
    with pytest.raises(ValueError, match="refuse nearly every"):
        drawn(poses, Limits(low=nothing.high, high=nothing.low), n=10)
