"""What changes no answer: the place in the photo, which way is up, a mirror, the focal length."""

from __future__ import annotations

import numpy as np
import pytest

from app.lifting.geometry import project, rotation_onto_axis
from app.lifting.lifter import Lifter
from app.lifting.types import Intrinsics, Method
from evaluation.metrics import root_centred_error_mm
from library_store.skeleton import LSP14
from tests.app.lifting.conftest import INTRINSICS, METHODS, People, lift_one, observe, project_px


@pytest.mark.parametrize("method", METHODS)
def test_moving_photo_and_principal_point_together_changes_nothing(
    lifter: Lifter, people: People, method: Method
) -> None:
    shift = np.array([250.0, -75.0])
    centre = np.array(INTRINSICS.principal_point_px) + shift
    moved = Intrinsics(INTRINSICS.focal_length_px, (centre[0], centre[1]), "request")
    for i in range(4):
        here = lift_one(lifter, people.observation(i), method=method)
        there = lift_one(lifter, observe(people.joints_px[i] + shift), moved, method)
        np.testing.assert_allclose(there.joints_3d_mm, here.joints_3d_mm, atol=1e-6)


def test_twenty_degrees_off_axis_costs_nothing(lifter: Lifter, people: People) -> None:
    angle = np.radians(20.0)
    turn = rotation_onto_axis(np.array([np.sin(angle), 0.0, np.cos(angle)])).T
    errors = []
    for move in (np.eye(3), turn):
        truth = people.joints_mm @ move.T
        lifted = [lift_one(lifter, observe(pixels)).joints_3d_mm for pixels in project_px(truth)]
        errors.append(root_centred_error_mm(np.stack(lifted), truth).mean())
    assert abs(errors[1] - errors[0]) < 2.0


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("missing", [(), (8, 9, 10, 11, 12, 13), (0, 1, 2, 3, 4, 5, 6, 7)])
def test_a_photo_on_its_side_costs_nothing(
    lifter: Lifter, people: People, method: Method, missing: tuple[int, ...]
) -> None:
    """Whoever leans far is turned upright first: then any further turn of the photo is undone.

    Also of people cut off at the waist, whose upper or lower half alone is seen.
    """
    centre = np.array(INTRINSICS.principal_point_px)
    quarter = np.array([[0.0, 1.0], [-1.0, 0.0]])
    for i in range(4):
        pixels = (people.joints_px[i] - centre) @ quarter + centre
        person = lift_one(lifter, observe(pixels, missing), method=method)
        half = (people.joints_px[i] - centre) @ quarter @ quarter + centre
        other = lift_one(lifter, observe(half, missing), method=method)
        turned = other.joints_3d_mm.copy()
        turned[:, :2] = turned[:, :2] @ quarter.T
        np.testing.assert_allclose(turned, person.joints_3d_mm, atol=1e-6)
        placed = other.exemplar.joints_mm.copy()
        placed[:, :2] = placed[:, :2] @ quarter.T
        np.testing.assert_allclose(placed, person.exemplar.joints_mm, atol=1e-6)
        assert other.exemplar.reprojection_error_px == pytest.approx(
            person.exemplar.reprojection_error_px
        )


def test_a_mirrored_person_gives_about_the_mirrored_pose(lifter: Lifter, people: People) -> None:
    mirror = list(LSP14.mirror)
    differences = []
    for i in range(20):
        person = lift_one(lifter, people.observation(i)).joints_3d_mm
        pixels = people.joints_px[i][mirror] * [-1, 1]
        pixels[:, 0] += 2 * INTRINSICS.principal_point_px[0]
        mirrored = lift_one(lifter, observe(pixels)).joints_3d_mm[mirror] * [-1, 1, 1]
        differences.append(root_centred_error_mm(mirrored[None], person[None]).mean())
    # The library is not symmetric: as good as two different samples of it agree.
    assert np.median(differences) < 90.0


def test_lifting_is_pinhole_consistent_at_any_focal(lifter: Lifter, people: People) -> None:
    for focal_px in (500.0, 3000.0):
        camera = Intrinsics(focal_px, INTRINSICS.principal_point_px, "exif")
        person = lift_one(lifter, people.observation(6), camera)
        back = project(person.warped_mm, focal_px, np.array(camera.principal_point_px))
        np.testing.assert_allclose(back, people.joints_px[6], atol=1e-9)
