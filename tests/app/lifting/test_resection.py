import cv2
import numpy as np
import pytest

from app.lifting.geometry import Floats, normalised_projection
from app.lifting.resection import (
    initial_translation,
    projection_jacobian,
    resect,
    rotation_exponential,
)
from library_store.library import Library

RNG = np.random.default_rng(1)
FOCAL_PX = 1150.0


@pytest.fixture(scope="module")
def poses(library: Library) -> Floats:
    return library.poses_mm(np.arange(0, 4_000, 13)[:300])


def random_cameras(n: int) -> tuple[Floats, Floats]:
    rotations = rotation_exponential(RNG.normal(size=(n, 3)) * 2.0)
    translations = RNG.normal(size=(n, 3)) * [300, 300, 500] + [0, 0, 4500]
    return rotations, translations


def see(poses: Floats, rotations: Floats, translations: Floats) -> Floats:
    return normalised_projection(poses @ np.swapaxes(rotations, 1, 2) + translations[:, None])


def nudge(rotations: Floats, angle: float = 0.2) -> Floats:
    return rotation_exponential(RNG.normal(size=(len(rotations), 3)) * angle) @ rotations


def test_recovers_a_known_camera_from_exact_projections(poses: Floats) -> None:
    rotations, translations = random_cameras(len(poses))
    targets = see(poses, rotations, translations)
    found = resect(poses, nudge(rotations), targets, np.ones(14), iterations=10)
    np.testing.assert_allclose(found.rotation, rotations, atol=1e-3)
    np.testing.assert_allclose(found.translation_mm, translations, atol=1e-3)
    assert np.abs(found.residuals).max() * FOCAL_PX < 1e-3


def test_a_missing_joint_has_no_say(poses: Floats) -> None:
    rotations, translations = random_cameras(len(poses))
    targets = see(poses, rotations, translations)
    targets[:, 4] += 0.3
    weights = np.ones(14)
    weights[4] = 0.0
    found = resect(poses, nudge(rotations), targets, weights, iterations=10)
    np.testing.assert_allclose(found.translation_mm, translations, atol=1e-3)


def test_robust_weights_resist_a_wrong_joint(poses: Floats) -> None:
    rotations, translations = random_cameras(len(poses))
    targets = see(poses, rotations, translations)
    targets[:, 4] += 0.1
    start = nudge(rotations)
    plain = resect(poses, start, targets, np.ones(14), iterations=10)
    robust = resect(poses, start, targets, np.ones(14), iterations=10, robust_scale=0.005)
    errors = [
        np.median(np.linalg.norm(found.rotation - rotations, axis=(1, 2)))
        for found in (plain, robust)
    ]
    assert errors[1] < 0.2 * errors[0]


def test_agrees_with_opencv_on_noisy_cases(poses: Floats) -> None:
    rotations, translations = random_cameras(len(poses))
    targets = see(poses, rotations, translations) + RNG.normal(size=(len(poses), 14, 2)) * 0.005
    start = nudge(rotations, 0.1)
    found = resect(poses, start, targets, np.ones(14), iterations=20)
    rotated = start @ np.swapaxes(poses, 1, 2)
    first = initial_translation(rotated, targets, np.ones(14))
    theirs = []
    # OpenCV stops early unless lengths are near 1 and pixels are pixels: metres, and the real f.
    intrinsic = np.diag([FOCAL_PX, FOCAL_PX, 1.0])
    for i, pose in enumerate(poses):
        vector, translation = cv2.solvePnPRefineLM(
            pose * 1e-3,
            targets[i] * FOCAL_PX,
            intrinsic,
            None,
            cv2.Rodrigues(start[i])[0],
            first[i][:, None] * 1e-3,
            (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 100, 1e-12),
        )
        rotation = np.asarray(cv2.Rodrigues(vector)[0], dtype=np.float64)
        moved_mm = np.asarray(translation.T * 1e3, dtype=np.float64)
        theirs.append(((see(pose[None], rotation[None], moved_mm) - targets[i]) ** 2).sum())
    ours = (found.residuals**2).sum((1, 2))
    ratio = ours / np.array(theirs)
    assert ratio.max() < 1 + 1e-6
    assert np.mean(np.abs(ratio - 1) < 1e-4) > 0.97


def test_jacobian_matches_finite_differences(poses: Floats) -> None:
    rotations, translations = random_cameras(len(poses))
    rotated = poses @ np.swapaxes(rotations, 1, 2)
    jacobian = projection_jacobian(rotated, translations)
    for parameter in range(6):
        step = 1e-5 if parameter < 3 else 1e-2
        delta = np.zeros((len(poses), 6))
        delta[:, parameter] = step

        def moved(sign: float, delta: Floats = delta) -> Floats:
            turned = rotation_exponential(sign * delta[:, :3]) @ rotations
            return see(poses, turned, translations + sign * delta[:, 3:])

        numeric = np.swapaxes(moved(1.0) - moved(-1.0), 1, 2) / (2 * step)
        np.testing.assert_allclose(jacobian[:, parameter], numeric, rtol=1e-4, atol=1e-8)


def test_a_batch_is_the_same_as_one_by_one(poses: Floats) -> None:
    rotations, translations = random_cameras(24)
    targets = see(poses[:24], rotations, translations) + RNG.normal(size=(24, 14, 2)) * 0.003
    start = nudge(rotations)
    shape = (4, 6)
    batch = resect(
        poses[:24].reshape(*shape, 14, 3),
        start.reshape(*shape, 3, 3),
        targets.reshape(*shape, 14, 2),
        np.ones(14),
    )
    assert batch.points_mm.shape == (*shape, 14, 3)
    for i in range(24):
        single = resect(poses[i], start[i], targets[i], np.ones(14))
        np.testing.assert_allclose(batch.rotation[divmod(i, 6)], single.rotation, atol=1e-9)
        np.testing.assert_allclose(
            batch.translation_mm[divmod(i, 6)], single.translation_mm, rtol=1e-9, atol=1e-6
        )


def test_stays_in_front_of_the_camera_when_the_joints_are_nonsense(poses: Floats) -> None:
    rotations, _ = random_cameras(len(poses))
    targets = RNG.normal(size=(len(poses), 14, 2)) * 0.2
    found = resect(poses, rotations, targets, np.ones(14))
    assert (found.points_mm[..., 2] > 0).all()
    assert np.isfinite(found.residuals).all()
