from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_array_equal

from library_store import thin
from library_store.thin import Poses, greedy_cover
from tests.library_store.clips import moving


def walk(n: int, seed: int, step_mm: float) -> Poses:
    """A crowd of poses in which some are near and some far."""
    rng = np.random.default_rng(seed)
    centres = rng.normal(0.0, 60.0, (max(1, n // 7), 14, 3))
    poses = centres[rng.integers(0, len(centres), n)] + rng.normal(0.0, step_mm, (n, 14, 3))
    return np.asarray(poses, dtype=np.float32)


def distances(a: Poses, b: Poses) -> np.ndarray:
    """RMS over the joints, (len(a), len(b))."""
    gaps = a[:, None].astype(float) - b[None].astype(float)
    result: np.ndarray = np.sqrt((gaps**2).sum(axis=-1).mean(axis=-1))
    return result


@settings(max_examples=25, deadline=None)
@given(
    n=st.integers(1, 120), seed=st.integers(0, 99), radius=st.sampled_from([0.0, 5.0, 30.0, 1e4])
)
def test_all_are_covered_and_none_twice(n: int, seed: int, radius: float) -> None:
    poses = walk(n, seed, step_mm=15.0)
    kept = greedy_cover(poses, radius)
    between = distances(poses, poses[kept])
    assert between.min(axis=1).max() <= radius + 1e-3
    among = distances(poses[kept], poses[kept])
    assert np.all(among[~np.eye(len(kept), dtype=bool)] > radius - 1e-3)
    assert_array_equal(kept, np.unique(kept))


@pytest.mark.parametrize("radius", [0.0, 0.5, 1.0])
def test_poses_far_apart_do_not_blur_near_ones(radius: float) -> None:
    """Of lengths in the thousands, single precision tells no distances of a millimetre."""
    rng = np.random.default_rng(0)
    people = rng.normal(0.0, 600.0, (100, 14, 3))
    shift = rng.normal(0.0, 0.55 * radius, (600, 14, 3))
    poses = np.asarray(people[rng.integers(0, 100, 600)] + shift, dtype=np.float32)
    kept = greedy_cover(poses, radius)
    assert distances(poses, poses[kept]).min(axis=1).max() <= radius + 1e-6
    among = distances(poses[kept], poses[kept])
    assert np.all(among[~np.eye(len(kept), dtype=bool)] > radius)


def test_blocks_do_not_matter(monkeypatch: pytest.MonkeyPatch) -> None:
    poses = walk(3_000, 3, step_mm=20.0)
    whole = greedy_cover(poses, 25.0)
    monkeypatch.setattr(thin, "_BLOCK", 37)
    assert_array_equal(greedy_cover(poses, 25.0), whole)


def test_the_same_poses_in_double_and_progress() -> None:
    poses = moving(400, 1).astype(np.float32)
    heard: list[float] = []
    kept = greedy_cover(np.concatenate([poses, poses]), 30.0, heard.append)
    assert len(kept) == len(greedy_cover(poses, 30.0))
    assert heard == sorted(heard)
    assert heard[-1] == 1.0
