import numpy as np
import pytest
from numpy.typing import NDArray

from library_store.cameras import project, rolled_upright, rotations, sample_cameras
from library_store.skeleton import (
    HEAD_TOP,
    L_ANKLE,
    L_HIP,
    L_KNEE,
    L_SHOULDER,
    NECK,
    R_ANKLE,
    R_HIP,
    R_KNEE,
    R_SHOULDER,
)
from library_store.upright import MOST_LEAN, MOST_LEAN_OF_HALF, lean_rad, turn_rad

RNG = np.random.default_rng(0)


def standing() -> NDArray[np.float64]:
    """(14, 2), y down."""
    points = RNG.normal(size=(14, 2)) * 60
    points[[HEAD_TOP, NECK]] = [[2, -170], [0, -120]]
    points[[R_SHOULDER, L_SHOULDER, R_HIP, L_HIP]] = [[-40, -100], [40, -99], [-25, 0], [25, 1]]
    return points


def leaning(points: NDArray[np.float64], angle: float) -> NDArray[np.float64]:
    cos, sin = np.cos(angle), np.sin(angle)
    return np.asarray(points @ [[cos, sin], [-sin, cos]])


def test_how_much_somebody_leans() -> None:
    person = standing()
    upright = lean_rad(person)
    assert abs(upright) < 0.02
    angles = (0.5, -1.5, 3.0)
    people = np.stack([leaning(person, angle) for angle in angles])
    np.testing.assert_allclose(lean_rad(people), upright + angles)
    assert people[0, NECK, 0] > person[NECK, 0], "clockwise, to the right"
    for missing in ([R_HIP], [L_SHOULDER, R_SHOULDER], [NECK, HEAD_TOP], [L_HIP, NECK]):
        present = np.ones(14, bool)
        present[missing] = False
        assert lean_rad(leaning(person, 1.0), present) == pytest.approx(1.0, abs=0.3), missing
    for missing in ([R_HIP, L_HIP, HEAD_TOP], [R_HIP, L_SHOULDER, NECK, HEAD_TOP]):
        present = np.ones(14, bool)
        present[missing] = False
        assert lean_rad(leaning(person, 1.0), present) == 0.0, missing


def test_people_cut_off_at_the_waist_lean_too() -> None:
    person = standing()
    person[[R_KNEE, L_KNEE, R_ANKLE, L_ANKLE]] = [[-25, 90], [25, 92], [-25, 180], [25, 180]]
    for seen in ([R_SHOULDER, L_SHOULDER, NECK, HEAD_TOP], [R_HIP, L_HIP, R_KNEE, L_KNEE]):
        present = np.zeros(14, bool)
        present[seen] = True
        for angle in (1.0, -2.0, 3.0):
            turned = leaning(person, angle)
            assert lean_rad(turned, present) == pytest.approx(angle, abs=0.1), seen
            assert turn_rad(turned, present) == lean_rad(turned, present)
        assert turn_rad(leaning(person, 0.9 * MOST_LEAN_OF_HALF), present) == 0.0


def test_who_leans_a_little_is_left_so() -> None:
    person = standing()
    people = np.stack([leaning(person, share * MOST_LEAN) for share in (0.9, -0.9, 1.1, -1.1)])
    np.testing.assert_array_equal(turn_rad(people) != 0, [False, False, True, True])


def test_cameras_are_rolled_until_nobody_leans_far() -> None:
    poses = RNG.normal(size=(400, 14, 3)) * 300
    drawn = sample_cameras(400, RNG)
    cameras = rolled_upright(drawn, poses)
    assert cameras.dtype == np.float32
    assert np.abs(cameras[:, 2]).max() <= 180
    before, after = (lean_rad(project(each, poses)) for each in (drawn, cameras))
    far = np.abs(before) > MOST_LEAN
    assert 100 < far.sum() < 400
    np.testing.assert_allclose(after[far], 0.0, atol=1e-4)
    np.testing.assert_array_equal(cameras[~far], drawn[~far])
    # The same view of the same pose but for the turn.
    np.testing.assert_allclose(rotations(cameras)[:, 2], rotations(drawn)[:, 2], atol=1e-6)
