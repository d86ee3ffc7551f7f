from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from library_store.anatomy import root_of
from library_store.clean import clean, face_ahead, in_order
from library_store.importers import MocapError
from library_store.importers.rotation import about_axis
from library_store.prior import PosePrior
from library_store.skeleton import L_HIP, LSP14, R_HIP
from tests.library_store.clips import clip, moving, write_clips


def test_poses_are_centred_and_face_ahead(prior: PosePrior) -> None:
    poses = prior.sample(300, np.random.default_rng(3))
    ahead = face_ahead(poses)
    assert_allclose(root_of(ahead), 0.0, atol=1e-9)
    for degrees in (0.0, 33.0, 180.0, -110.0):
        turned = poses @ about_axis("y", np.array(degrees)).T + np.array([5.0, 7.0, -9.0])
        assert_allclose(face_ahead(turned), ahead, atol=1e-6)
    hips = ahead[:, L_HIP] - ahead[:, R_HIP]
    upright = ahead[:, 1, 1] > 400.0
    assert np.all(hips[upright, 0] > 0.0), "the person's left is at +x"


def test_people_lying_and_upside_down_have_one_heading_too() -> None:
    standing = moving(1, 5)
    for axis, degrees in (("x", 90.0), ("x", -90.0), ("z", 90.0), ("x", 180.0)):
        laid = standing @ about_axis(axis, np.array(degrees)).T
        ahead = face_ahead(laid)
        again = face_ahead(laid @ about_axis("y", np.array(77.0)).T)
        assert_allclose(again, ahead, atol=1e-6)


def test_somebody_on_their_side_does_not_flip(prior: PosePrior) -> None:
    """The hip axis is vertical then: what little it leans must not decide."""
    laid = face_ahead(prior.sample(20, np.random.default_rng(1)))
    laid[:, R_HIP], laid[:, L_HIP] = (-100.0, 0.0, 0.0), (100.0, 0.0, 0.0)
    laid = laid @ about_axis("z", np.array(90.0)).T
    one, other = laid.copy(), laid.copy()
    one[:, L_HIP, 2] += 1.0
    other[:, L_HIP, 2] -= 1.0
    assert_allclose(face_ahead(one), face_ahead(other), atol=60.0)


def test_mirroring_keeps_the_heading() -> None:
    ahead = face_ahead(moving(50, 2))
    mirrored = ahead[:, LSP14.mirror] * np.array([-1.0, 1.0, 1.0])
    assert_allclose(face_ahead(mirrored), mirrored, atol=1e-6)


def test_clips_are_thinned_ordered_and_licensed(tmp_path: Path) -> None:
    shuffled = clip("b", 40, 2, licence="")
    order = np.random.default_rng(0).permutation(40)
    twice = np.r_[order, order[:3]]
    path = write_clips(tmp_path / "a.npz", clip("a", 60, 1))
    (first,) = clean(path, rate_hz=10.0, licence="")
    assert (first.name, first.subject, first.licence) == ("a", "person 1", "free for all uses")
    assert first.frames.tolist() == list(range(0, 120, 6))
    assert first.poses.shape == (20, 14, 3)
    original = clip("a", 60, 1)
    backwards = replace(
        original, positions_mm=original.positions_mm[::-1], frames=original.frames[::-1]
    )
    (same,) = clean(write_clips(tmp_path / "b.npz", backwards), rate_hz=10.0, licence="")
    assert same.frames.tolist() == first.frames.tolist()
    assert_allclose(same.poses, first.poses, atol=1e-3)
    mixed = in_order(
        type(shuffled)(
            name="b",
            subject="",
            action="",
            frame_rate_hz=30.0,
            positions_mm=shuffled.positions_mm[twice],
            frames=shuffled.frames[twice],
        )
    )
    assert_array_equal(mixed.frames, shuffled.frames)
    assert_array_equal(mixed.positions_mm, shuffled.positions_mm)


def test_a_clip_of_unknown_licence_is_refused(tmp_path: Path) -> None:
    path = write_clips(tmp_path / "a.npz", clip("a", 30, 1, licence=""))
    with pytest.raises(MocapError, match=r"a\.npz.*licence.*--licence"):
        list(clean(path, rate_hz=30.0, licence=""))
    (only,) = clean(path, rate_hz=30.0, licence="CC BY 4.0")
    assert only.licence == "CC BY 4.0"
