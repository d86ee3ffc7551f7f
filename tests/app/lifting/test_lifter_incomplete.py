"""Joints that are missing, and whom nobody can lift."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from app.lifting.lifter import Lifter
from app.lifting.types import Intrinsics, LiftedPerson, Method, NotLiftable, Observation
from tests.app.lifting.conftest import INTRINSICS, METHODS, People, lift_one, observe


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("missing", [(4,), (0, 10, 13), (8, 11), (9, 10, 12, 13, 0)])
def test_missing_joints_are_inferred(
    lifter: Lifter, people: People, method: Method, missing: tuple[int, ...]
) -> None:
    pixels = people.joints_px[7].copy()
    pixels[list(missing)] = np.nan
    person = lift_one(lifter, observe(pixels, missing), method=method)
    assert np.isfinite(person.joints_3d_mm).all()
    assert np.isfinite(person.warped_mm).all()
    assert "truncated" in person.warnings


def test_who_lacks_joints_stands_about_where_they_would_with_them(
    lifter: Lifter, people: People
) -> None:
    missing = (0, 9, 10, 12, 13)
    apart_mm = []
    for pixels in people.joints_px[:20]:
        whole = lift_one(lifter, observe(pixels)).root_mm
        apart_mm.append(np.linalg.norm(lift_one(lifter, observe(pixels, missing)).root_mm - whole))
    assert np.mean(apart_mm) < 400.0


def test_a_missing_joint_is_less_sure(lifter: Lifter, people: People) -> None:
    wrist = 4
    larger = []
    for i in range(20):
        whole = lift_one(lifter, people.observation(i)).sigma_mm
        hidden = lift_one(lifter, observe(people.joints_px[i], (wrist,))).sigma_mm
        assert whole is not None
        assert hidden is not None
        larger.append(hidden[wrist] > whole[wrist])
    # Not each time: without the wrist other exemplars are nearest.
    assert np.mean(larger) > 0.8


@pytest.mark.parametrize(
    ("kept", "reason"),
    [
        ((0, 1, 2, 5, 8), "5 joints"),
        ((3, 4, 6, 7, 9, 10, 12, 13), "fewer than 2"),
        ((2,), "1 joint is"),
        ((), "0 joints"),
    ],
)
def test_too_few_joints_are_not_guessed(
    lifter: Lifter, people: People, kept: tuple[int, ...], reason: str
) -> None:
    missing = tuple(set(range(14)) - set(kept))
    (answer,) = lifter.lift([observe(people.joints_px[0], missing)], INTRINSICS)
    assert isinstance(answer, NotLiftable)
    assert reason in answer.reason


def test_joints_on_one_spot_are_not_lifted(lifter: Lifter) -> None:
    (answer,) = lifter.lift([observe(np.full((14, 2), 77.0))], INTRINSICS)
    assert isinstance(answer, NotLiftable)


@pytest.mark.parametrize("method", METHODS)
def test_joints_on_one_line_are_not_lifted(lifter: Lifter, people: People, method: Method) -> None:
    joints_px = people.joints_px[0].copy()
    thin = joints_px * (0.2, 1.0)
    joints_px[:, 0] = 0.5 * joints_px[:, 1] + np.tile((0.0, 1.0), 7)
    answers = lifter.lift([observe(joints_px), observe(thin)], INTRINSICS, method=method)
    assert isinstance(answers[0], NotLiftable)
    assert "one line" in answers[0].reason
    assert isinstance(answers[1], LiftedPerson)


@pytest.mark.parametrize(
    ("focal_length_px", "centre_px", "reason"),
    [
        (1.0, (320.0, 240.0), "joints span"),
        (5.0, (320.0, 240.0), "joints span"),
        (1150.0, (1e6, 240.0), "off the optical axis"),
    ],
)
@pytest.mark.parametrize("method", METHODS)
def test_a_camera_that_cannot_be_is_no_reason_to_guess(
    lifter: Lifter,
    people: People,
    method: Method,
    focal_length_px: float,
    centre_px: tuple[float, float],
    reason: str,
) -> None:
    camera = Intrinsics(focal_length_px, centre_px, "request")
    (answer,) = lifter.lift([people.observation(0)], camera, method=method)
    assert isinstance(answer, NotLiftable)
    assert reason in answer.reason
    assert "truncated" not in answer.warnings


@pytest.mark.parametrize("method", METHODS)
def test_nobody_is_behind_the_camera(lifter: Lifter, method: Method) -> None:
    rng = np.random.default_rng(0)
    scales_px = 10.0 ** rng.uniform(1, 6, 60)
    centres_px = rng.normal(0, 1, (60, 1, 2)) * 10.0 ** rng.uniform(1, 6, (60, 1, 1))
    strange = centres_px + scales_px[:, None, None] * rng.normal(0, 1, (60, 14, 2))
    answers = lifter.lift([observe(joints) for joints in strange], INTRINSICS, method=method)
    lifted = [answer for answer in answers if isinstance(answer, LiftedPerson)]
    assert 0 < len(lifted) < len(answers)
    for person in lifted:
        for joints_mm in (person.joints_3d_mm, person.warped_mm, person.exemplar.joints_mm):
            assert (joints_mm[:, 2] > 0).all()
        assert (np.abs(person.joints_3d_mm) < 1e6).all()


@pytest.mark.parametrize(
    "build",
    [
        lambda: Observation(np.zeros((13, 2)), np.ones(13)),
        lambda: Observation(np.zeros((14, 2)), np.full(14, 1.5)),
        lambda: Observation(np.full((14, 2), np.nan), np.ones(14)),
        lambda: Observation(np.zeros((14, 2)), np.ones(14), np.zeros((14, 2))),
        lambda: Observation(np.zeros((14, 2)), np.ones(14), depths_px=np.zeros((14, 1))),
        lambda: Observation(np.zeros((14, 2)), np.ones(14), depths_px=np.full(14, np.nan)),
    ],
)
def test_wrong_observations_are_refused(build: Callable[[], Observation]) -> None:
    with pytest.raises(ValueError, match=r"must|not finite"):
        build()
