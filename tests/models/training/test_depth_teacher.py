"""Which of a teacher's depths are kept; the teacher itself is the user's to supply."""

from __future__ import annotations

from dataclasses import replace
from typing import cast

import numpy as np
import pytest
from numpy.typing import NDArray

from library_store.skeleton import L_WRIST, R_KNEE, R_SHOULDER
from models.training.dataset import MP33_LIMBS, LabelledCrop
from models.training.depth_teacher import depths_px
from models.training.teachers import BlazePose, TeacherPose

LIMBS = list(MP33_LIMBS)


class Teacher:
    """Puts the limb joints at ``at_px`` (12, 2), each as deep as its number; keeps what it saw."""

    def __init__(self, at_px: NDArray[np.float64], score: float = 0.9) -> None:
        self.at_px, self.score = at_px, score
        self.circles: list[tuple[NDArray[np.float64], NDArray[np.float64]]] = []

    def person(
        self, _: NDArray[np.uint8], hip: NDArray[np.float64], rim: NDArray[np.float64]
    ) -> TeacherPose:
        self.circles.append((hip, rim))
        landmarks = np.zeros((33, 2))
        landmarks[LIMBS] = self.at_px
        depths = np.zeros(33)
        depths[LIMBS] = np.arange(2, 14)
        return TeacherPose(landmarks, np.zeros((33, 3)), depths, self.score)


@pytest.fixture
def crop() -> LabelledCrop:
    """Somebody who stands, hips at (50, 60), a trunk of 30 px."""
    x = [50, 50, 40, 35, 35, 60, 65, 65, 45, 45, 45, 55, 55, 55]
    y = [10, 20, 30, 45, 60, 30, 45, 60, 60, 80, 100, 60, 80, 100]
    ones = np.ones(14, np.float32)
    return LabelledCrop(
        name="x",
        group=0,
        image=np.zeros((120, 100, 3), np.uint8),
        joints_px=np.stack([x, y], 1).astype(np.float32),
        weight=ones,
        visible=ones,
        wild=False,
    )


def taught(crop: LabelledCrop, teacher: Teacher) -> NDArray[np.float32]:
    return depths_px(crop, cast(BlazePose, teacher))


def test_depths_are_the_teacher_s_where_it_puts_the_joint_where_the_label_is(
    crop: LabelledCrop,
) -> None:
    at_px = crop.joints_px[2:].astype(np.float64)
    at_px[L_WRIST - 2] += (0, 8.0)  # over a quarter of the trunk away
    at_px[R_KNEE - 2] += (0, 7.0)
    crop = replace(crop, weight=np.where(np.arange(14) == R_SHOULDER + 1, 0, crop.weight))
    teacher = Teacher(at_px)
    found = taught(crop, teacher)
    unknown = np.isin(np.arange(14), [0, 1, L_WRIST, R_SHOULDER + 1])
    np.testing.assert_array_equal(np.isnan(found), unknown)
    np.testing.assert_array_equal(found[~unknown], np.flatnonzero(~unknown))
    ((hip, rim),) = teacher.circles
    np.testing.assert_allclose(hip, (50, 60))
    np.testing.assert_allclose(rim[0], 50, atol=1e-6)
    assert rim[1] < 60 - 50  # upwards, and beyond the farthest joint


def test_nothing_is_taken_of_whom_the_teacher_does_not_see_or_cannot_be_shown(
    crop: LabelledCrop,
) -> None:
    at_px = crop.joints_px[2:].astype(np.float64)
    assert np.isnan(taught(crop, Teacher(at_px, score=0.3))).all()
    no_trunk = replace(crop, weight=np.where(np.arange(14) == R_SHOULDER, 0, crop.weight))
    teacher = Teacher(at_px)
    assert np.isnan(taught(no_trunk, teacher)).all()
    assert not teacher.circles
