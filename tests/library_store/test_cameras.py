from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose

from library_store.cameras import (
    DISTANCE_RANGE_MM,
    extrinsics,
    project,
    rotations,
    sample_cameras,
)

# A person of three axes, facing +Z: the left hand is at +X.
LEFT, TOP, FRONT = (np.array(axis) * 500.0 for axis in np.eye(3))


def figure() -> np.ndarray:
    pose = np.zeros((14, 3))
    pose[1], pose[2] = LEFT, -LEFT
    pose[3], pose[4] = TOP, -TOP
    pose[5], pose[6] = FRONT, -FRONT
    return pose


def camera(azimuth: float = 0.0, elevation: float = 0.0, roll: float = 0.0) -> np.ndarray:
    return np.array([azimuth, elevation, roll, 4000.0])


def test_rotations_are_rotations() -> None:
    rotation = rotations(sample_cameras(500, np.random.default_rng(0)))
    assert_allclose(
        rotation @ np.swapaxes(rotation, -1, -2),
        np.broadcast_to(np.eye(3), (500, 3, 3)),
        atol=1e-12,
    )
    assert_allclose(np.linalg.det(rotation), 1.0)


def test_a_camera_in_front_sees_the_left_hand_on_the_right_and_the_head_on_top() -> None:
    image = project(camera(), figure())
    assert image[1, 0] > 0 > image[2, 0]
    assert image[3, 1] < 0 < image[4, 1]


def test_azimuth_walks_to_the_persons_left() -> None:
    rotation, translation = extrinsics(camera(azimuth=90.0), figure())
    assert_allclose(-rotation.T @ translation, [4000.0, 0.0, 0.0], atol=1e-9)


def test_elevation_looks_down() -> None:
    rotation, translation = extrinsics(camera(elevation=30.0), figure())
    centre = -rotation.T @ translation
    assert_allclose(centre, [0.0, 4000.0 * 0.5, 4000.0 * np.sqrt(0.75)], atol=1e-9)
    # From above, what is in front of the person is lower in the picture.
    image = project(camera(elevation=30.0), figure())
    assert image[5, 1] > image[6, 1]


def test_roll_turns_the_picture_clockwise() -> None:
    image = project(camera(roll=90.0), figure())
    assert image[3, 0] > 0.1
    assert_allclose(image[3, 1], 0.0, atol=1e-12)


def test_the_mean_joint_lies_on_the_axis_at_the_distance() -> None:
    rng = np.random.default_rng(1)
    cameras = sample_cameras(20, rng)
    poses = rng.normal(size=(20, 14, 3)) * 300.0
    rotation, translation = extrinsics(cameras, poses)
    seen = np.einsum("nij,nkj->nki", rotation, poses) + translation[:, None]
    assert_allclose(seen.mean(axis=1)[:, :2], 0.0, atol=1e-9)
    assert_allclose(seen.mean(axis=1)[:, 2], cameras[:, 3], rtol=1e-6)
    assert_allclose(project(cameras, poses), seen[..., :2] / seen[..., 2:])


def test_sampled_cameras_are_those_of_photographs() -> None:
    azimuth, elevation, roll, distance = sample_cameras(20_000, np.random.default_rng(2)).T
    assert_allclose(np.histogram(azimuth, 8, (-180, 180))[0] / 2500.0, 1.0, atol=0.1)
    assert 0.8 < np.mean((elevation > -10) & (elevation < 35)) < 0.97
    assert elevation.max() > 60
    assert elevation.min() < -30
    assert np.quantile(np.abs(roll), 0.5) < 5.0
    assert DISTANCE_RANGE_MM[0] <= distance.min() < distance.max() <= DISTANCE_RANGE_MM[1] * 1.001
