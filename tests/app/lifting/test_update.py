"""The compiled observations of a state against their formulas in numpy."""

import ctypes

import numpy as np
import pytest

from app.lifting.compiled import pointer
from app.lifting.ensemble import LocalPrior
from app.lifting.geometry import Floats
from app.lifting.stature import stature_mm
from app.lifting.update import answer_of, made_symmetric, observe_joints, observe_state
from library_store.library import Library
from library_store.prior import PosePrior
from tests.app.lifting.conftest import asymmetry

PX = 1100.0
ROOT_MM = 4400.0


def states_of(joints_mm: Floats) -> Floats:
    """(..., 14, 3) in front of the camera -> states (..., 42)."""
    root = 0.5 * (joints_mm[..., 8, 2] + joints_mm[..., 11, 2])
    image = PX * joints_mm[..., :2] / joints_mm[..., 2:]
    depths = joints_mm[..., 2] / root[..., None] - 1.0
    return np.concatenate([image.reshape(*root.shape, 28), depths], axis=-1)


def joints_of(state: Floats) -> Floats:
    depth = ROOT_MM * (1.0 + state[28:])
    return np.concatenate([state[:28].reshape(14, 2) / PX, np.ones((14, 1))], 1) * depth[:, None]


def seen(library: Library, n: int) -> Floats:
    entries = np.arange(3, len(library), len(library) // n)[:n]
    poses = library.poses_mm(entries) @ np.swapaxes(library.rotations(entries), 1, 2)
    placed: Floats = poses + np.array([0.0, 0.0, ROOT_MM])
    return placed


@pytest.fixture(scope="module")
def people(library: Library) -> Floats:
    return seen(library, 400)


@pytest.fixture(scope="module")
def pose(people: Floats) -> LocalPrior:
    states = states_of(people)
    return LocalPrior(states[7], np.cov(states.T) / 4.0 + 1e-9 * np.eye(42), ROOT_MM)


def scaled(found: LocalPrior, wanted_mean: Floats, wanted: Floats) -> float:
    """The largest difference in standard deviations."""
    sigma = np.sqrt(np.diag(wanted))
    apart = np.abs(found.covariance - wanted) / np.outer(sigma, sigma)
    return float(max(apart.max(), (np.abs(found.mean - wanted_mean) / sigma).max()))


@pytest.mark.parametrize("doubt", [0.6, 2.0, 6.0])
def test_a_state_observed(pose: LocalPrior, people: Floats, doubt: float) -> None:
    said, error = states_of(people)[9], np.cov(states_of(people[:60]).T) / 9.0
    settled = np.r_[np.full(28, 0.01), np.full(14, 1e-8)]
    found = observe_state(pose, said, error, settled_var=settled, doubt=doubt, errors=2.0)
    prior = pose.covariance
    gain = prior @ np.linalg.inv(prior + doubt * error + np.diag(settled))
    left = prior - gain @ prior + (2.0 - doubt) * gain @ error @ gain.T
    assert scaled(found, pose.mean + gain @ (said - pose.mean), left) < 1e-7
    np.testing.assert_array_equal(found.covariance, found.covariance.T)
    assert found.root_depth_mm == ROOT_MM
    with pytest.raises(ValueError, match="no state"):
        observe_state(pose, said[1:], error, settled_var=settled, doubt=1.0, errors=2.0)


def test_joints_observed(pose: LocalPrior) -> None:
    rng = np.random.default_rng(2)
    rows = np.r_[0:6, 8:28]
    reach, innovation = pose.covariance[rows], rng.normal(size=26) * 5.0
    precision = np.linalg.inv(reach[:, rows] + 9.0 * np.eye(26)).astype(np.float64)
    found = observe_joints(pose, reach, precision, innovation)
    gain = reach.T @ precision
    left = pose.covariance - gain @ reach
    assert scaled(found, pose.mean + gain @ innovation, left) < 1e-9
    np.testing.assert_array_equal(found.covariance, found.covariance.T)
    with pytest.raises(ValueError, match="belong together"):
        observe_joints(pose, reach[1:], precision, innovation)


def test_sides_observed_as_equally_long(pose: LocalPrior) -> None:
    found = made_symmetric(pose, PX, 0.15)
    ratio = asymmetry(joints_of(pose.mean))
    slope = np.empty((5, 42))
    for i in range(42):
        step = np.zeros(42)
        step[i] = 1e-3 if i < 28 else 1e-6
        ends = [asymmetry(joints_of(pose.mean + way * step)) for way in (1, -1)]
        slope[:, i] = (ends[0] - ends[1]) / (2.0 * step[i])
    reach = pose.covariance @ slope.T
    gain = reach @ np.linalg.inv(slope @ reach + 0.15**2 * np.eye(5))
    left = pose.covariance - gain @ reach.T
    assert scaled(found, pose.mean - gain @ ratio, left) < 1e-6
    np.testing.assert_array_equal(found.covariance, found.covariance.T)
    assert np.abs(asymmetry(joints_of(found.mean))).sum() < np.abs(ratio).sum()


def test_a_segment_without_length_says_nothing_of_the_other_side(pose: LocalPrior) -> None:
    """A wrist at its elbow has no direction in which it could be longer."""
    mean = pose.mean.copy()
    mean[[8, 9, 28 + 4]] = mean[[6, 7, 28 + 3]]
    found = made_symmetric(LocalPrior(mean, pose.covariance, ROOT_MM), PX, 0.15)
    assert np.isfinite(found.mean).all()
    assert np.isfinite(found.covariance).all()


def test_the_answer_is_as_tall_and_as_unsure_as_it_should_be(pose: LocalPrior) -> None:
    still = LocalPrior(pose.mean, 1e-12 * np.eye(42), ROOT_MM)
    plain = answer_of(still, PX, 1500.0)
    assert float(stature_mm(plain.joints_mm)) == pytest.approx(1500.0, rel=1e-4)
    factor = plain.root_depth_mm / ROOT_MM
    np.testing.assert_allclose(plain.joints_mm, factor * joints_of(pose.mean), rtol=1e-9)

    answer = answer_of(pose, PX, 1500.0)
    depth = answer.root_depth_mm
    about_root = np.eye(14)
    about_root[:, [8, 11]] -= 0.5
    deep = np.diag(about_root @ pose.covariance[28:, 28:] @ about_root.T)
    image = np.diag(pose.covariance)[:28].reshape(14, 2).sum(1)
    wanted = np.sqrt(deep * depth**2 + image / 0.25**2)
    np.testing.assert_allclose(answer.spread_mm, wanted, rtol=1e-6)
    limbs = ((2, 3), (3, 4), (8, 9), (9, 10), (5, 6), (6, 7), (11, 12), (12, 13))
    for (start, end), (along, sigma) in zip(limbs, answer.bends_mm, strict=True):
        bend = np.zeros(14)
        bend[[start, end]] = -1.0, 1.0
        assert along == pytest.approx(depth * bend @ pose.mean[28:])
        variance = bend @ pose.covariance[28:, 28:] @ bend
        assert sigma == pytest.approx(depth * np.sqrt(variance), rel=1e-6)


def test_a_limb_that_may_point_either_way_is_ambiguous(pose: LocalPrior) -> None:
    bends = answer_of(pose, PX, 1500.0).bends_mm
    ratio, widest = np.abs(bends[:, 0]) / bends[:, 1], bends[:, 1].max()
    answer = answer_of(pose, PX, 1500.0)
    assert answer.is_ambiguous(1.01 * ratio.min(), 0.0)
    assert not answer.is_ambiguous(0.99 * ratio.min(), 0.0)
    assert not answer.is_ambiguous(1e9, 1.01 * widest)


def test_a_loop_is_told_where_numbers_are_and_strided_ones_are_refused() -> None:
    numbers = np.arange(6.0)
    where = pointer(numbers)
    assert not isinstance(where, int)
    assert ctypes.addressof(where) == numbers.ctypes.data
    numbers.flags.writeable = False
    assert pointer(numbers) == numbers.ctypes.data
    with pytest.raises(TypeError, match="contiguous"):
        pointer(np.zeros(6)[::2])


def test_what_spread_takes_from_a_mean_pose_is_given_back() -> None:
    rng = np.random.default_rng(4)
    person = PosePrior.load().sample(1, rng)[0].astype(np.float64) * [1.0, -1.0, -1.0]
    # Legs that point anywhere: many poses of one height, whose mean has hardly any legs.
    turned = np.repeat(person[None], 4_000, axis=0)
    for hip, knee, ankle in ((8, 9, 10), (11, 12, 13)):
        for end, start in ((knee, hip), (ankle, knee)):
            away = rng.standard_normal((len(turned), 3))
            away /= np.linalg.norm(away, axis=1, keepdims=True)
            turned[:, end] = turned[:, start] + 400.0 * away
    turned[..., 2] += 10.0 * ROOT_MM  # far away, where the image is linear in the pose
    states = states_of(turned)
    pose = LocalPrior(states.mean(0), np.cov(states.T), 10.0 * ROOT_MM)
    height = float(stature_mm(turned).mean())
    found = answer_of(pose, PX, height)
    assert found.root_depth_mm == pytest.approx(10.0 * ROOT_MM, rel=0.01)
    assert float(stature_mm(found.joints_mm)) < 0.7 * height
