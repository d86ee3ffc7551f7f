"""Depths that a pose network reads off the picture."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from app.lifting.lifter import Lifter
from app.lifting.types import Intrinsics, Observation
from evaluation.metrics import root_centred_error_mm
from library_store.library import Library
from library_store.skeleton import L_HIP, R_HIP
from models import PoseLifter
from tests.app.lifting.conftest import INTRINSICS, METHODS, People, lift_one, same
from tests.models import tiny_onnx


@pytest.fixture
def deep(library: Library, tmp_path: Path) -> Lifter:
    """With a network that believes the depths it is told to 2% of the distance."""
    output = tiny_onnx.lift_output(reads_confidence=True, reads_depths=True)
    tiny_onnx.write(tmp_path, "deep", tiny_onnx.believer(5, 0.02), output=output)
    return Lifter(library, network=PoseLifter("deep", weights_dir=tmp_path))


def seen_deep(people: People, index: int, sign: float = 1.0, shrunk: float = 1.0) -> Observation:
    """A person of a photo of a size, with the depths of the truth, or with near and far changed."""
    z = people.joints_mm[index, :, 2]
    relative = z / z[[R_HIP, L_HIP]].mean() - 1.0
    return Observation(
        people.joints_px[index] / shrunk,
        np.ones(14),
        np.tile(np.eye(2), (14, 1, 1)) / shrunk**2,
        sign * relative * INTRINSICS.focal_length_px / shrunk,
    )


def test_depths_that_the_picture_shows_decide_what_joints_leave_open(
    lifter: Lifter, deep: Lifter, people: People
) -> None:
    errors = []
    for one, sign in ((lifter, 1.0), (deep, 1.0), (deep, -1.0)):
        found = [lift_one(one, seen_deep(people, i, sign)).joints_3d_mm for i in range(20)]
        errors.append(root_centred_error_mm(np.stack(found), people.joints_mm[:20]).mean())
    assert errors[1] < 0.75 * errors[0] < 0.75 * errors[2]


def test_depths_of_a_photo_of_half_the_size_are_half_as_many_pixels(
    deep: Lifter, people: People
) -> None:
    x, y = INTRINSICS.principal_point_px
    half = Intrinsics(INTRINSICS.focal_length_px / 2, (x / 2, y / 2), "request")
    for index in range(4):
        whole = lift_one(deep, seen_deep(people, index))
        shrunk = lift_one(deep, seen_deep(people, index, shrunk=2.0), half)
        np.testing.assert_allclose(shrunk.joints_3d_mm, whole.joints_3d_mm, atol=1e-3)


def test_depths_change_nothing_where_nobody_reads_them(library: Library, people: People) -> None:
    """With what ships: of found joints one network does, for the fusion."""
    beside = Lifter(library, network=PoseLifter())
    for index in range(3):
        observation = seen_deep(people, index)
        unsure = replace(observation, confidence=np.full(14, 0.8))
        for told in (observation, unsure):
            for method in METHODS:
                untold = replace(told, depths_px=None)
                here, there = (lift_one(beside, one, method=method) for one in (told, untold))
                assert same(here, there) != (told is unsure and method == "fusion")


def test_the_depth_of_a_missing_joint_is_none(deep: Lifter, people: People) -> None:
    observation = seen_deep(people, 0)
    assert observation.depths_px is not None
    confidence = np.ones(14)
    confidence[4] = 0.0
    answers = []
    for depth_px in (np.nan, 0.0, 900.0):
        depths_px = observation.depths_px.copy()
        depths_px[4] = depth_px
        told = replace(observation, confidence=confidence, depths_px=depths_px)
        answers.append(lift_one(deep, told))
    assert same(answers[0], answers[1])
    assert same(answers[0], answers[2])
