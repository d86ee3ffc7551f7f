"""Virtual cameras: where the exemplars are seen from.

A camera orbits the pose. ``azimuth`` 0 stands before a person who faces +Z and grows towards the
person's left (+X); ``elevation`` is positive above the person, looking down; ``roll`` turns the
picture clockwise; ``distance`` is measured to the point looked at, the mean of the pose's joints,
which thereby lies on the optical axis. The exemplar's frame has Y up and the hip midpoint as its
origin, the camera's has OpenCV's axes (x right, y down, z forward), both are in millimetres:

    X_camera = R X_exemplar + t,    t = (0, 0, distance) - R mean(X_exemplar)

A library's cameras are rolled until nobody before them leans far (``library_store.upright``).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from library_store.upright import turn_rad

Float = NDArray[np.float64]

COLUMNS = ("azimuth_deg", "elevation_deg", "roll_deg", "distance_mm")
"""What the four columns of a camera table hold."""

DISTANCE_RANGE_MM = (2500.0, 8000.0)


def sample_cameras(n: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """Draw ``n`` cameras as photographs are taken; returns (n, 4) float32, see ``COLUMNS``.

    Azimuth is uniform. Most photographs are taken from about head height by somebody standing, so
    elevation is a normal around 8 degrees, mixed with a uniform -15..40 and with 5% of anything
    between a worm's and a bird's eye. Roll is the unsteady hand, N(0, 5 degrees), with 6% of tilted
    shots. Distance is uniform in its inverse square root, between near and uniform.
    """
    azimuth = rng.uniform(-180.0, 180.0, n)
    kind = rng.random(n)
    elevation = np.select(
        [kind < 0.45, kind < 0.95],
        [rng.normal(8.0, 10.0, n), rng.uniform(-15.0, 40.0, n)],
        rng.uniform(-45.0, 80.0, n),
    )
    roll = np.where(rng.random(n) < 0.94, rng.normal(0.0, 5.0, n), rng.normal(0.0, 30.0, n))
    near, far = (limit**-0.5 for limit in DISTANCE_RANGE_MM)
    distance = rng.uniform(far, near, n) ** -2
    return np.stack([azimuth, elevation, roll, distance], axis=-1).astype(np.float32)


def rolled_upright(cameras: ArrayLike, poses_mm: ArrayLike) -> NDArray[np.float32]:
    """Cameras (n, 4), those rolled before whom poses (n, 14, 3) mm lean far: (n, 4)."""
    table = np.array(cameras, dtype=np.float64)
    table[:, 2] -= np.degrees(turn_rad(project(table, poses_mm)))
    table[:, 2] -= 360.0 * np.round(table[:, 2] / 360.0)
    return table.astype(np.float32)


def rotations(cameras: ArrayLike) -> Float:
    """Rotation R of camera rows (..., 4): (..., 3, 3) float64, exemplar to camera axes."""
    table = np.asarray(cameras, dtype=np.float64)
    azimuth, elevation, roll = (np.radians(table[..., column]) for column in range(3))
    sin_a, cos_a = np.sin(azimuth), np.cos(azimuth)
    sin_e, cos_e = np.sin(elevation), np.cos(elevation)
    sin_r, cos_r = np.sin(roll), np.cos(roll)
    # Of the level camera: right (cos a, 0, -sin a), down (forward x right) and forward.
    down_x, down_y, down_z = sin_e * sin_a, -cos_e, sin_e * cos_a
    rotation = np.empty((*azimuth.shape, 3, 3))
    rotation[..., 0, 0] = cos_r * cos_a - sin_r * down_x
    rotation[..., 0, 1] = -sin_r * down_y
    rotation[..., 0, 2] = -cos_r * sin_a - sin_r * down_z
    rotation[..., 1, 0] = sin_r * cos_a + cos_r * down_x
    rotation[..., 1, 1] = cos_r * down_y
    rotation[..., 1, 2] = -sin_r * sin_a + cos_r * down_z
    rotation[..., 2, 0] = -sin_a * cos_e
    rotation[..., 2, 1] = -sin_e
    rotation[..., 2, 2] = -cos_a * cos_e
    return rotation


def extrinsics(cameras: ArrayLike, poses_mm: ArrayLike) -> tuple[Float, Float]:
    """R and t of cameras (..., 4) that look at poses (..., 14, 3) mm.

    Returns (..., 3, 3) and (..., 3) mm float64: X_camera = R X_exemplar + t.
    """
    table = np.asarray(cameras, dtype=np.float64)
    rotation = rotations(table)
    target = np.asarray(poses_mm, dtype=np.float64).mean(axis=-2)
    translation = -np.einsum("...ij,...j->...i", rotation, target)
    translation[..., 2] += table[..., 3]
    return rotation, translation


def project(cameras: ArrayLike, poses_mm: ArrayLike) -> Float:
    """Image points of poses (..., 14, 3) mm under a pinhole of unit focal length: (..., 14, 2)."""
    rotation, translation = extrinsics(cameras, poses_mm)
    seen = np.einsum("...ij,...nj->...ni", rotation, np.asarray(poses_mm, dtype=np.float64))
    seen += translation[..., None, :]
    image: Float = seen[..., :2] / seen[..., 2:]
    return image
