"""What a lifted person is warned of, and the joints that are set aside."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from app.lifting.lifter import MIN_JOINTS, Lifter, LiftingSettings
from app.lifting.posterior import STANDARD_PX_PER_MM
from evaluation.metrics import rigid_error_mm
from library_store.library import Library
from library_store.skeleton import L_HIP, R_HIP
from models import PoseLifter
from tests.app.lifting.conftest import INTRINSICS, People, lift_one, observe


def test_who_is_cut_off_is_warned_of_though_nothing_is_missing(
    lifter: Lifter, people: People
) -> None:
    whole = observe(people.joints_px[7])
    cut = lift_one(lifter, replace(whole, truncated=True))
    plain = lift_one(lifter, whole)
    assert "truncated" not in plain.warnings
    assert cut.warnings == ("truncated", *plain.warnings)
    np.testing.assert_array_equal(cut.joints_3d_mm, plain.joints_3d_mm)


def test_a_joint_far_off_is_set_aside(library: Library, people: People) -> None:
    lifter = Lifter(library, network=PoseLifter())
    pixels = people.joints_px[1].copy()
    pixels[10] += [900.0, -900.0]
    person = lift_one(lifter, observe(pixels))
    assert "inconsistent_joints" in person.warnings
    assert "inconsistent_joints" not in lift_one(lifter, people.observation(1)).warnings


def test_as_many_joints_are_set_aside_as_the_settings_allow(
    library: Library, people: People
) -> None:
    network = PoseLifter()
    errors = []
    for most in (0, 1, 2):
        lifter = Lifter(library, LiftingSettings(max_outliers=most), network)
        error = []
        for index in range(8):
            pixels = people.joints_px[index].copy()
            pixels[[3, 12]] += [[500.0, 500.0], [-700.0, -500.0]]
            person = lift_one(lifter, observe(pixels))
            assert ("inconsistent_joints" in person.warnings) == (most > 0)
            error.append(rigid_error_mm(person.joints_3d_mm, people.joints_mm[index]).mean())
        errors.append(np.median(error))
    assert errors[2] < 0.5 * errors[1] < 0.5 * errors[0]
    assert LiftingSettings().max_outliers == 2


def test_nobody_is_left_with_fewer_joints_than_a_pose_needs(
    library: Library, people: People
) -> None:
    """Of six joints each is needed, also one that contradicts the others."""
    lifter = Lifter(library, network=PoseLifter())
    rng = np.random.default_rng(0)
    for n_joints in (MIN_JOINTS, MIN_JOINTS + 1):
        set_aside = 0
        for joints_px in people.joints_px:
            kept = rng.choice(14, n_joints, replace=False)
            missing = tuple(set(range(14)) - set(kept.tolist()))
            pixels = joints_px.copy()
            pixels[kept[0]] += rng.normal(0, 1000, 2)
            (answer,) = lifter.lift([observe(pixels, missing)], INTRINSICS)
            set_aside += "inconsistent_joints" in answer.warnings
        assert (set_aside > 0) == (n_joints > MIN_JOINTS)


def test_who_is_far_from_the_library_is_said_by_standard_pixels(
    library: Library, people: People
) -> None:
    """The RMS residual of the best exemplar, as if its person were shown at a fixed size."""
    for index in range(4):
        seen = people.observation(index)
        best = lift_one(Lifter(library), seen, n_candidates=1).exemplar
        depth_mm = best.joints_mm[[R_HIP, L_HIP], 2].mean()
        px = best.reprojection_error_px
        rms_px = px / INTRINSICS.focal_length_px * STANDARD_PX_PER_MM * depth_mm
        for share in (0.8, 1.2):
            settings = LiftingSettings(far_px=share * rms_px)
            warnings = lift_one(Lifter(library, settings), seen).warnings
            assert ("far_from_library" in warnings) == (share < 1)


def test_a_limb_that_may_point_either_way_is_said(lifter: Lifter, people: People) -> None:
    errors: dict[bool, list[float]] = {False: [], True: []}
    for observation, truth in zip(
        (people.observation(i) for i in range(len(people.joints_px))), people.joints_mm, strict=True
    ):
        person = lift_one(lifter, observation)
        error = rigid_error_mm(person.joints_3d_mm[None], truth[None]).mean()
        errors["ambiguous_depth" in person.warnings].append(float(error))
    assert min(len(group) for group in errors.values()) >= 4
    assert np.mean(errors[True]) > np.mean(errors[False])


def test_an_assumed_focal_length_is_said(lifter: Lifter, people: People) -> None:
    assumed = replace(INTRINSICS, source="assumed")
    assert "assumed_focal" in lift_one(lifter, people.observation(0), assumed).warnings
    assert "assumed_focal" not in lift_one(lifter, people.observation(0)).warnings
