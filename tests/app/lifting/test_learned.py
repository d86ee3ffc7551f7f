"""The learned lifter as an observation: between no trust and all of it, and what it is worth."""

from dataclasses import replace

import numpy as np
import pytest

from app.lifting.ensemble import LocalPrior
from app.lifting.fusion import FusionSettings
from app.lifting.learned import apart_mm, misplaced, with_learned
from app.lifting.lifter import Lifter, LiftingSettings
from evaluation.metrics import rigid_error_mm, similarity_error_mm
from library_store.library import Library
from models import PoseLifter
from models.pose_lifter import LearnedPose
from tests.app.lifting.conftest import People, lift_one, observe

PX_PER_UNIT = 1100.0


@pytest.fixture(scope="module")
def both(library: Library) -> Lifter:
    return Lifter(library, network=PoseLifter())


def gaussian(seed: int, scale: float) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(42, 60))
    unit = np.concatenate([np.full(28, scale), np.full(14, scale / PX_PER_UNIT)])
    return unit * rng.normal(size=42), np.outer(unit, unit) * (root @ root.T) / 60


def test_doubt_goes_from_the_network_to_the_neighbours() -> None:
    mean, covariance = gaussian(1, 10.0)
    pose = LocalPrior(mean, covariance, 4000.0)
    said, error = gaussian(2, 10.0)
    to_unit = np.concatenate([np.full(28, 1.0 / PX_PER_UNIT), np.ones(14)])
    learned = LearnedPose(
        (said * to_unit)[:28].reshape(14, 2), said[28:], np.outer(to_unit, to_unit) * error
    )
    unsure = with_learned(pose, learned, PX_PER_UNIT, 1e12)
    np.testing.assert_allclose(unsure.mean, mean, atol=1e-6)
    sure = with_learned(pose, learned, PX_PER_UNIT, 1e-9)
    np.testing.assert_allclose(sure.mean * to_unit, said * to_unit, atol=2e-3)
    halfway = with_learned(pose, learned, PX_PER_UNIT, 1.0)
    assert (np.diag(halfway.covariance) < np.diag(covariance)).all()
    assert halfway.root_depth_mm == 4000.0, "the network does not know how large people are"


def test_weights_that_are_not_the_best_leave_more_uncertainty() -> None:
    mean, covariance = gaussian(1, 10.0)
    said, error = gaussian(2, 10.0)
    to_unit = np.concatenate([np.full(28, 1.0 / PX_PER_UNIT), np.ones(14)])
    learned = LearnedPose(
        (said * to_unit)[:28].reshape(14, 2), said[28:], np.outer(to_unit, to_unit) * error
    )
    scale = np.sqrt(np.diag(covariance))
    left = {
        doubt: with_learned(
            LocalPrior(mean, covariance, 4000.0), learned, PX_PER_UNIT, doubt
        ).covariance
        / np.outer(scale, scale)
        for doubt in (0.3, 2.0, 8.0)
    }
    for doubt in (0.3, 8.0):
        assert np.linalg.eigvalsh(left[doubt] - left[2.0]).min() > -1e-9
        assert np.trace(left[doubt]) > 1.05 * np.trace(left[2.0])
    assert np.linalg.eigvalsh(left[2.0]).min() > -1e-9


def test_what_it_disagrees_by_is_counted_in_mm_about_the_root() -> None:
    mean, covariance = gaussian(1, 10.0)
    pose = LocalPrior(mean, covariance, 4000.0)
    points, depths = mean[:28].reshape(14, 2) / PX_PER_UNIT, mean[28:]

    def apart(points: np.ndarray, depths: np.ndarray) -> np.ndarray:
        return apart_mm(pose, LearnedPose(points, depths, covariance), PX_PER_UNIT, 4000.0)

    np.testing.assert_allclose(apart(points, depths), 0.0, atol=1e-9)
    np.testing.assert_allclose(apart(points, depths + 0.1), 0.0, atol=1e-9)
    # The root is between the hips: one of them moved moves it by half, all others away from it.
    hip = depths.copy()
    hip[8] += 0.02
    wanted = np.full(14, 40.0)
    np.testing.assert_allclose(apart(points, hip), wanted, atol=1e-9)
    moved, nearer = points.copy(), depths.copy()
    moved[4] += [3.0 / PX_PER_UNIT, 4.0 / PX_PER_UNIT]
    nearer[7] -= 0.01
    wanted = np.zeros(14)
    wanted[4], wanted[7] = 5.0 / 0.25, 40.0
    np.testing.assert_allclose(apart(moved, nearer), wanted, atol=1e-9)


def test_whom_the_two_disagree_about_is_less_sure_and_not_answered_otherwise(
    library: Library, people: People
) -> None:
    settings = LiftingSettings()
    without = LiftingSettings(fusion=replace(settings.fusion, disagreement=0.0))
    network = PoseLifter()
    told, untold = Lifter(library, settings, network), Lifter(library, without, network)
    added = []
    for index in range(10):
        here, there = (lift_one(one, people.observation(index)) for one in (told, untold))
        np.testing.assert_array_equal(here.joints_3d_mm, there.joints_3d_mm)
        assert here.sigma_mm is not None
        assert there.sigma_mm is not None
        assert (here.sigma_mm >= there.sigma_mm).all()
        added.append((here.sigma_mm / there.sigma_mm).mean())
    assert np.ptp(added) > 0.01


def test_it_helps(lifter: Lifter, both: Lifter, people: People) -> None:
    errors = []
    for one in (lifter, both):
        found = np.stack([lift_one(one, people.observation(i)).joints_3d_mm for i in range(40)])
        errors.append(rigid_error_mm(found, people.joints_mm).mean())
    assert errors[1] < 0.9 * errors[0]


def test_without_trust_it_changes_nothing(library: Library, people: People) -> None:
    settings = LiftingSettings()
    doubtful = LiftingSettings(fusion=replace(settings.fusion, doubt_of_noisy=1e14))
    alone = lift_one(Lifter(library), people.observation(0))
    beside = lift_one(Lifter(library, doubtful, PoseLifter()), people.observation(0))
    np.testing.assert_allclose(beside.joints_3d_mm, alone.joints_3d_mm, atol=1e-3)


def test_missing_joints_are_less_sure_and_matter_little_to_others(
    both: Lifter, people: People
) -> None:
    whole = lift_one(both, people.observation(3))
    without = lift_one(both, observe(people.joints_px[3], missing=(4, 10)))
    assert whole.sigma_mm is not None
    assert without.sigma_mm is not None
    assert (without.sigma_mm[[4, 10]] > whole.sigma_mm[[4, 10]]).all()
    moved = np.linalg.norm(without.joints_3d_mm - whole.joints_3d_mm, axis=1)
    assert np.delete(moved, [4, 10]).mean() < 60.0


def test_of_portraits_it_is_asked_too(lifter: Lifter, both: Lifter, people: People) -> None:
    errors = []
    for index in range(12):
        portrait = observe(people.joints_px[index], missing=(8, 9, 10, 11, 12, 13))
        truth = people.joints_mm[index, :8]
        answers = [lift_one(one, portrait).joints_3d_mm[:8] for one in (lifter, both)]
        assert np.abs(answers[0] - answers[1]).max() > 1.0
        errors.append([similarity_error_mm(it, truth).mean() for it in answers])
    alone, beside = np.mean(errors, axis=0)
    assert beside < alone


def test_the_papers_method_does_not_ask_it(lifter: Lifter, both: Lifter, people: People) -> None:
    answers = [
        lift_one(one, people.observation(1), method="paper").joints_3d_mm for one in (lifter, both)
    ]
    np.testing.assert_array_equal(answers[0], answers[1])


def test_a_joint_that_lies_far_from_where_the_network_puts_it_is_found(people: People) -> None:
    network, found, wrongly = PoseLifter(), 0, 0
    for index in range(20):
        points = (people.joints_px[index] - people.joints_px[index].mean(0)) / 1150.0
        joint = (4, 7, 10, 13)[index % 4]
        clean = network.lift(points, np.ones(14))
        wrongly += misplaced(clean, points, np.ones(14), PX_PER_UNIT, joint) is not None
        moved = points.copy()
        # Outwards: what makes a limb shorter may as well be a bent one.
        outwards = points[joint] - points[joint - 2]
        moved[joint] += np.linalg.norm(points[1] - points[8]) * outwards / np.linalg.norm(outwards)
        said = network.lift(moved, np.ones(14))
        found += misplaced(said, moved, np.ones(14), PX_PER_UNIT, joint) == joint
        confidence = np.ones(14)
        confidence[joint] = 0.0
        without = network.lift(moved, confidence)
        assert misplaced(without, moved, confidence, PX_PER_UNIT, joint) != joint
    assert found >= 10
    assert wrongly <= 3


def test_the_noisier_the_joints_the_more_is_left_to_the_network() -> None:
    settings = FusionSettings()
    doubts = [settings.doubt(noise_px**2) for noise_px in (0.0, 2.0, 4.0, 10.0)]
    assert doubts == sorted(doubts, reverse=True)
    assert doubts[0] == pytest.approx(settings.doubt_of_noisy + settings.doubt_of_exact)
    assert doubts[1] == pytest.approx(settings.doubt_of_noisy + 0.5 * settings.doubt_of_exact)
    # By the fourth power of the noise: little is left of it at twice as much.
    assert doubts[2] == pytest.approx(settings.doubt_of_noisy + settings.doubt_of_exact / 17)


def test_suspected_joints_are_more_readily_set_aside() -> None:
    points = np.random.default_rng(0).normal(size=(14, 2)) * 0.05
    for apart_px, suspect, found in (
        (6.5 * 4.0, 3, 3),
        (6.5 * 4.0, None, None),
        (6.5 * 4.0, 9, None),
        (9.0 * 4.0, None, 3),
        (4.5 * 4.0, 3, None),
    ):
        said = points + np.array([2.0, 0.0]) / PX_PER_UNIT
        said[3] = points[3] + np.array([0.0, apart_px]) / PX_PER_UNIT
        learned = LearnedPose(said, np.zeros(14), np.eye(42))
        assert misplaced(learned, points, np.ones(14), PX_PER_UNIT, suspect) == found
