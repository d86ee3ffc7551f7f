"""Invariants of the whole lift, on a small real library."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from app.lifting.geometry import project, rotation_onto_axis
from app.lifting.lifter import MIN_JOINTS, Lifter, LiftingSettings
from app.lifting.posterior import STANDARD_PX_PER_MM
from app.lifting.stature import stature_mm
from app.lifting.types import Intrinsics, LiftedPerson, Method, NotLiftable, Observation
from app.lifting.warp import warp_weak_perspective
from evaluation.metrics import rigid_error_mm, root_centred_error_mm
from library_store.library import Library
from library_store.skeleton import L_HIP, LSP14, R_HIP
from models import PoseLifter
from tests.app.lifting.conftest import INTRINSICS, People, lift_one, observe, project_px
from tests.models import tiny_onnx

METHODS: tuple[Method, ...] = ("fusion", "paper")


def same(a: LiftedPerson, b: LiftedPerson) -> bool:
    def answer(person: LiftedPerson) -> tuple[object, ...]:
        sigma = None if person.sigma_mm is None else person.sigma_mm.tobytes()
        exemplar = person.exemplar
        return (
            person.joints_3d_mm.tobytes(),
            person.warped_mm.tobytes(),
            (exemplar.exemplar_id, exemplar.probability, exemplar.rotation.tobytes()),
            sigma,
            person.warnings,
        )

    return answer(a) == answer(b)


@pytest.mark.parametrize("method", METHODS)
def test_an_exemplar_seen_by_its_own_camera_is_found(
    library: Library, lifter: Lifter, method: Method
) -> None:
    for entry in (0, 1234, 3999):
        rotation, translation = library.cameras(entry)
        placed = library.poses_mm(entry) @ rotation.T + translation
        person = lift_one(lifter, observe(project_px(placed)), method=method, n_candidates=50)
        assert person.exemplar.entry == entry
        assert library.find(person.exemplar.exemplar_id) == entry
        assert person.exemplar.reprojection_error_px < 0.05
        np.testing.assert_allclose(person.exemplar.joints_mm, placed, atol=2.0)
        probabilities = [candidate.probability for candidate in person.candidates]
        assert sum(probabilities) == pytest.approx(1.0)
        assert np.isfinite(probabilities).all()
        assert probabilities == sorted(probabilities, reverse=True)
        assert person.candidates[0] is person.exemplar


def test_camera_places_the_exemplar(library: Library, lifter: Lifter, people: People) -> None:
    best = lift_one(lifter, people.observation(0)).exemplar
    placed = library.poses_mm(best.entry) @ best.rotation.T + best.translation_mm
    np.testing.assert_allclose(best.joints_mm, placed, atol=1e-6)
    error = ((project_px(placed) - people.joints_px[0]) ** 2).sum(1)
    assert best.reprojection_error_px == pytest.approx(np.sqrt(error.mean()))


def test_paper_answer_is_equation_6_on_axis(lifter: Lifter, people: People) -> None:
    # A person whose joints centre on the principal point needs no turning.
    pixels = people.joints_px[3]
    person = lift_one(lifter, observe(pixels), method="paper")
    np.testing.assert_array_equal(person.joints_3d_mm, person.warped_mm)
    assert person.sigma_mm is None
    rays = np.c_[(pixels - INTRINSICS.principal_point_px) / INTRINSICS.focal_length_px, np.ones(14)]
    turn = rotation_onto_axis((rays / np.linalg.norm(rays, axis=1, keepdims=True)).sum(0))
    turned = rays @ turn.T
    exemplar = person.exemplar.joints_mm @ turn.T
    expected = warp_weak_perspective(exemplar, turned[:, :2] / turned[:, 2:], np.ones(14, bool))
    np.testing.assert_allclose(person.joints_3d_mm, expected @ turn, atol=1e-6)


def test_fusions_warped_exemplar_reprojects_exactly(lifter: Lifter, people: People) -> None:
    person = lift_one(lifter, people.observation(5))
    np.testing.assert_allclose(project_px(person.warped_mm), people.joints_px[5], atol=1e-9)


def test_fusion_beats_the_paper(lifter: Lifter, people: People) -> None:
    errors = {}
    for method in METHODS:
        lifted = [
            lift_one(lifter, people.observation(i), method=method).joints_3d_mm
            for i in range(len(people.joints_px))
        ]
        errors[method] = rigid_error_mm(np.stack(lifted), people.joints_mm).mean()
    assert errors["fusion"] < 0.9 * errors["paper"]


@pytest.mark.parametrize("method", METHODS)
def test_the_same_bytes_whatever_is_asked_beside(
    lifter: Lifter, people: People, method: Method
) -> None:
    observations = [people.observation(i) for i in range(6)]
    together = lifter.lift(observations, INTRINSICS, method=method, n_candidates=7)
    for observation, one in zip(observations, together, strict=True):
        assert isinstance(one, LiftedPerson)
        assert len(one.candidates) == 7
        assert same(one, lift_one(lifter, observation, method=method, n_candidates=0))
        assert same(one, lift_one(lifter, observation, method=method, n_candidates=50))


@pytest.mark.parametrize("method", METHODS)
def test_subject_height_is_met_exactly_and_changes_no_image(
    lifter: Lifter, people: People, method: Method
) -> None:
    plain = lift_one(lifter, people.observation(2), method=method)
    scaled = lift_one(lifter, people.observation(2), method=method, subject_height_mm=1900.0)
    assert (plain.scale_source, scaled.scale_source) == ("library", "request")
    for joints in (scaled.joints_3d_mm, scaled.warped_mm, scaled.exemplar.joints_mm):
        assert stature_mm(joints) == pytest.approx(1900.0)
    np.testing.assert_allclose(
        project_px(scaled.joints_3d_mm), project_px(plain.joints_3d_mm), atol=1e-8
    )
    ratio = scaled.joints_3d_mm / plain.joints_3d_mm
    np.testing.assert_allclose(ratio, ratio[0, 2])
    for person in (plain, scaled):
        np.testing.assert_allclose(person.root_mm, person.joints_3d_mm[[R_HIP, L_HIP]].mean(0))
    assert (plain.sigma_mm is None) == (scaled.sigma_mm is None) == (method == "paper")
    if plain.sigma_mm is not None and scaled.sigma_mm is not None:
        np.testing.assert_allclose(scaled.sigma_mm, ratio[0, 2] * plain.sigma_mm)


def test_camera_places_the_exemplar_at_a_given_height(
    library: Library, lifter: Lifter, people: People
) -> None:
    for height_mm in (None, 1250.0):
        person = lift_one(lifter, people.observation(2), subject_height_mm=height_mm)
        for one in person.candidates:
            placed = one.scale * (library.poses_mm(one.entry) @ one.rotation.T) + one.translation_mm
            np.testing.assert_allclose(one.joints_mm, placed, atol=1e-6)
            assert (one.scale == 1.0) == (height_mm is None)


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


def test_who_is_cut_off_is_warned_of_though_nothing_is_missing(
    lifter: Lifter, people: People
) -> None:
    whole = observe(people.joints_px[7])
    cut = lift_one(lifter, replace(whole, truncated=True))
    plain = lift_one(lifter, whole)
    assert "truncated" not in plain.warnings
    assert cut.warnings == ("truncated", *plain.warnings)
    np.testing.assert_array_equal(cut.joints_3d_mm, plain.joints_3d_mm)


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


def test_stated_covariance_is_used(lifter: Lifter, people: People) -> None:
    pixels = people.joints_px[4].copy()
    pixels[4] += [60.0, 0.0]
    covariance = np.broadcast_to(np.eye(2), (14, 2, 2)).copy()
    sure = lift_one(lifter, Observation(pixels, np.ones(14), covariance))
    covariance[4] = 90.0**2 * np.eye(2)
    unsure = lift_one(lifter, Observation(pixels, np.ones(14), covariance))
    truth = project_px(people.joints_mm[4])[4]
    moved = [np.linalg.norm(project_px(p.joints_3d_mm)[4] - truth) for p in (sure, unsure)]
    assert moved[1] < moved[0]


def test_noise_that_is_stated_is_not_found_again(lifter: Lifter, people: People) -> None:
    rng = np.random.default_rng(0)
    noise_px = 12.0
    found: dict[bool, list[float]] = {False: [], True: []}
    for index in range(20):
        pixels = people.joints_px[index] + rng.normal(0, noise_px, (14, 2))
        stated = np.tile(noise_px**2 * np.eye(2), (14, 1, 1))
        for is_stated, covariance in ((False, None), (True, stated)):
            person = lift_one(lifter, Observation(pixels, np.ones(14), covariance))
            assert person.noise_px is not None
            found[is_stated].append(person.noise_px)
    assert np.mean(found[True]) < 0.6 * np.mean(found[False])


def test_candidates_of_noisy_joints_are_told_apart_as_poorly_as_stated(
    library: Library, people: People
) -> None:
    """A covariance in the photo's pixels counts as one in standard pixels at the person's depth."""
    noise_px = 60.0
    by_default = LiftingSettings(sigma_2d_px=noise_px)
    for index in range(4):
        pixels = people.joints_px[index]
        wanted = lift_one(Lifter(library, by_default), observe(pixels), n_candidates=50)
        depths_mm = [one.joints_mm[[R_HIP, L_HIP], 2].mean() for one in wanted.candidates]
        to_photo = INTRINSICS.focal_length_px / (STANDARD_PX_PER_MM * np.median(depths_mm))
        stated = np.tile((to_photo * noise_px) ** 2 * np.eye(2), (14, 1, 1))
        told = Observation(pixels, np.ones(14), stated)
        person = lift_one(Lifter(library), told, n_candidates=50)
        probable = {one.entry: one.probability for one in wanted.candidates}
        assert {one.entry: one.probability for one in person.candidates} == pytest.approx(
            probable, rel=0.02
        )


def test_the_camera_follows_unsure_joints_less(lifter: Lifter, people: People) -> None:
    """Eq. 5 weighs joints by confidence."""
    wrist = 4
    pixels = people.joints_px[4].copy()
    pixels[wrist] += [60.0, 0.0]
    off_px = []
    for confidence in (1.0, 0.25):
        sure = np.ones(14)
        sure[wrist] = confidence
        person = lift_one(lifter, Observation(pixels, sure), method="paper", n_candidates=10)
        by_entry = {
            one.entry: np.linalg.norm(project_px(one.joints_mm)[wrist] - pixels[wrist])
            for one in person.candidates
        }
        off_px.append(by_entry)
    assert off_px[0].keys() == off_px[1].keys()
    further = [off_px[1][entry] > off_px[0][entry] for entry in off_px[0]]
    assert np.mean(further) > 0.8


def test_neighbours_stand_by_all_joints_alike_however_sure(lifter: Lifter, people: People) -> None:
    """Confidence tells which joint is elsewhere; how far joints scatter, covariances do."""
    for index in range(4):
        pixels = people.joints_px[index]
        rays = np.column_stack(
            [(pixels - INTRINSICS.principal_point_px) / INTRINSICS.focal_length_px, np.ones(14)]
        )
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        # Confidences of the same centre: the camera is turned onto it.
        across = (rays @ rotation_onto_axis(rays.sum(axis=0)).T)[:, :2]
        apart = np.linalg.svd(across.T)[2][-1]
        unsure = 0.85 + 0.15 * apart / np.abs(apart).max()
        person = lift_one(lifter, Observation(pixels, unsure))
        alike = lift_one(lifter, observe(pixels))
        np.testing.assert_allclose(person.joints_3d_mm, alike.joints_3d_mm, atol=1e-3)


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


def test_lifting_is_pinhole_consistent_at_any_focal(lifter: Lifter, people: People) -> None:
    for focal_px in (500.0, 3000.0):
        camera = Intrinsics(focal_px, INTRINSICS.principal_point_px, "exif")
        person = lift_one(lifter, people.observation(6), camera)
        back = project(person.warped_mm, focal_px, np.array(camera.principal_point_px))
        np.testing.assert_allclose(back, people.joints_px[6], atol=1e-9)


def test_who_was_seen_with_doubt_is_answered_with_doubt(lifter: Lifter, people: People) -> None:
    """The joints may be those of an exchanged leg, which no spread about them tells."""
    sure = lift_one(lifter, people.observation(5))
    seen = people.observation(5)
    unsure = lift_one(lifter, replace(seen, confidence=np.full(14, 0.7)))
    assert sure.sigma_mm is not None
    assert unsure.sigma_mm is not None
    assert (unsure.sigma_mm > sure.sigma_mm + 50).all()
