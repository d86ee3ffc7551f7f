import cv2
import numpy as np
import pytest

from app.lifting.geometry import Floats, normalised_projection
from app.lifting.resection import LEAST_EXTENT_MM, NEAREST_TO_EXTENT, resect
from library_store.library import Library
from tests.rotations import rotation_exponential

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


def test_agrees_with_opencv_on_noisy_cases(poses: Floats) -> None:
    rotations, translations = random_cameras(len(poses))
    targets = see(poses, rotations, translations) + RNG.normal(size=(len(poses), 14, 2)) * 0.005
    start = nudge(rotations, 0.1)
    found = resect(poses, start, targets, np.ones(14), iterations=20)
    first = resect(poses, start, targets, np.ones(14), iterations=0).translation_mm
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


def test_what_is_found_belongs_together(poses: Floats) -> None:
    """Points and residuals are those of the cameras; nothing given is written to."""
    rotations, translations = random_cameras(len(poses))
    targets = see(poses, rotations, translations) + RNG.normal(size=(len(poses), 14, 2)) * 0.003
    start = nudge(rotations)
    given = [array.copy() for array in (poses, start, targets)]
    found = resect(poses, start, targets, np.ones(14), iterations=3)
    for array, before in zip((poses, start, targets), given, strict=True):
        np.testing.assert_array_equal(array, before)
    placed = poses @ np.swapaxes(found.rotation, 1, 2) + found.translation_mm[:, None]
    np.testing.assert_allclose(found.points_mm, placed, rtol=1e-12, atol=1e-6)
    np.testing.assert_allclose(found.residuals, normalised_projection(placed) - targets, atol=1e-12)
    product = found.rotation @ np.swapaxes(found.rotation, 1, 2)
    np.testing.assert_allclose(product, np.broadcast_to(np.eye(3), product.shape), atol=1e-12)


def test_no_step_raises_the_cost(poses: Floats) -> None:
    rotations, _ = random_cameras(len(poses))
    targets = RNG.normal(size=(len(poses), 14, 2)) * 0.1
    weights = RNG.uniform(0.2, 1.0, (len(poses), 14))
    costs = []
    for iterations in range(8):
        found = resect(poses, rotations, targets, weights, iterations=iterations)
        costs.append((weights[..., None] * found.residuals**2).sum((1, 2)))
    assert (np.diff(costs, axis=0) <= 1e-12 * np.array(costs[:-1])).all()
    assert np.median(costs[-1] / costs[0]) < 0.9


def test_what_does_not_belong_together_is_refused(poses: Floats) -> None:
    """The compiled loop trusts the shapes."""
    with pytest.raises(ValueError, match="belong together"):
        resect(poses[:3], np.eye(3), np.zeros((14, 2)), np.ones(14))
    with pytest.raises(ValueError, match="belong together"):
        resect(poses[:3], np.stack([np.eye(3)] * 3), np.zeros((13, 2)), np.ones(14))
    with pytest.raises(ValueError, match="belong together"):
        resect(poses[:3], np.stack([np.eye(3)] * 3), np.zeros((13, 2)), np.ones(13))


@pytest.mark.parametrize("size", [0.2, 5.0])
def test_stays_in_front_of_the_camera_when_the_joints_are_nonsense(
    poses: Floats, size: float
) -> None:
    """Also where somebody so large could only be explained by a camera among the joints."""
    rotations, _ = random_cameras(len(poses))
    targets = RNG.normal(size=(len(poses), 14, 2)) * size
    found = resect(poses, rotations, targets, np.ones(14))
    depth_mm = found.translation_mm[:, 2]
    forward_mm = -(found.points_mm[..., 2] - depth_mm[:, None]).min(1)
    assert (depth_mm > (NEAREST_TO_EXTENT - 1e-9) * np.maximum(forward_mm, LEAST_EXTENT_MM)).all()
    assert (found.points_mm[..., 2] > 0).all()
    assert np.isfinite(found.residuals).all()


def test_a_step_follows_the_derivatives_taken_by_finite_differences(poses: Floats) -> None:
    """One damped Gauss-Newton step, by a Jacobian that only projects."""
    rotations, translations = random_cameras(len(poses))
    targets = see(poses, rotations, translations) + RNG.normal(size=(len(poses), 14, 2)) * 0.005
    weights = RNG.uniform(0.2, 1.0, (len(poses), 14))
    start = nudge(rotations)
    before = resect(poses, start, targets, weights, iterations=0)
    after = resect(poses, start, targets, weights, iterations=1)
    columns = []
    for direction in np.eye(6) * ([1e-5] * 3 + [1e-2] * 3):
        turn = rotation_exponential(direction[None, :3])
        ahead = see(poses, turn @ start, before.translation_mm + direction[3:])
        back = see(poses, np.swapaxes(turn, 1, 2) @ start, before.translation_mm - direction[3:])
        columns.append((ahead - back) / (2.0 * np.linalg.norm(direction)))
    jacobian = np.stack(columns, -1).reshape(len(poses), 28, 6)
    weighted = np.repeat(weights, 2, axis=1)[..., None] * jacobian
    normal = np.swapaxes(jacobian, 1, 2) @ weighted
    normal += 1e-4 * np.eye(6) * normal
    pull = np.swapaxes(weighted, 1, 2) @ before.residuals.reshape(len(poses), 28, 1)
    step = -np.linalg.solve(normal, pull)[..., 0]
    taken = (after.translation_mm != before.translation_mm).any(1)
    assert taken.mean() > 0.9
    expected = rotation_exponential(step[taken, :3]) @ start[taken]
    np.testing.assert_allclose(after.rotation[taken], expected, atol=1e-6)
    moved = (after.translation_mm - before.translation_mm)[taken]
    np.testing.assert_allclose(moved, step[taken, 3:], rtol=1e-4, atol=0.01)
