"""Projective geometry of one person: rays, projection, turning the camera to the person.

Camera axes are OpenCV's: x right, y down, z forward; millimetres. *Normalised image coordinates*
are those of a pinhole of focal length 1 with its principal point at (0, 0): ``x = X / Z``.

A perspective camera sees the same pose differently at the edge of the photo than at its centre,
while every exemplar was projected near the optical axis; and photos lie on their side, while every
exemplar stands (``library_store.upright``). So the person is turned onto the axis first, and
upright if they lean far: the picture that a camera with the same centre, pointed at the person and
rolled with them, would have taken. There they are lifted, and the answer is turned back. Both steps
are exact, a rotation about the camera centre.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from library_store.upright import rotations_by, turn_rad

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]

_LEAST_DEPTH = 1e-3


def project(points_mm: Floats, focal_length_px: float, principal_point_px: Floats) -> Floats:
    """Pinhole projection of camera-frame points.

    Args:
        points_mm: (..., 3) camera frame; z > 0.
        focal_length_px: focal length, the same for both axes.
        principal_point_px: (2,) pixel the optical axis meets.

    Returns:
        (..., 2) pixels.

    """
    return focal_length_px * normalised_projection(points_mm) + principal_point_px


def normalised_projection(points_mm: Floats) -> Floats:
    """(..., 3) camera-frame points -> (..., 2) normalised image coordinates."""
    projected: Floats = points_mm[..., :2] / points_mm[..., 2:]
    return projected


def lift_to_depth(points: Floats, depths_mm: Floats) -> Floats:
    """(..., 2) normalised image coordinates at (...) depths in mm -> (..., 3) mm."""
    return np.concatenate([points * depths_mm[..., None], depths_mm[..., None]], axis=-1)


def rotation_onto_axis(direction: Floats) -> Floats:
    """Smallest rotation that turns ``direction`` (3,) with z > 0 onto +z; returns (3, 3)."""
    x, y, z = (direction / math.sqrt(direction @ direction)).tolist()
    # Rodrigues' formula for the axis d × e_z; 1 + cos > 1, so there is no degenerate case.
    scale = 1.0 / (1.0 + z)
    return np.array(
        [
            [1.0 - scale * x * x, -scale * x * y, -x],
            [-scale * x * y, 1.0 - scale * y * y, -y],
            [x, y, z],
        ]
    )


@dataclass(frozen=True)
class CentredView:
    """One person as a camera pointed straight at them would see them, upright if they lean far.

    ``rotation`` (3, 3) takes the photo's camera frame to the centred one; ``points`` (14, 2) are
    normalised image coordinates there; ``covariance`` (14, 2, 2) their uncertainty in the same
    units squared, or None.
    """

    rotation: Floats
    points: Floats
    covariance: Floats | None

    def to_photo(self, points_mm: Floats) -> Floats:
        """(..., 3) centred-frame points or vectors -> the photo's camera frame."""
        return points_mm @ self.rotation


def centre_view(
    joints_px: Floats,
    weights: Floats,
    covariance_px2: Floats | None,
    focal_length_px: float,
    principal_point_px: Floats,
) -> CentredView:
    """Turn the camera onto the weighted centre of a person's joints; who leans far, upright.

    Args:
        joints_px: (J, 2) pixels; rows of weight 0 may hold anything, NaN too.
        weights: (J,) in [0, 1], not all 0.
        covariance_px2: (J, 2, 2) px² or None; carried over to first order. Of rows of weight 0 it
            may be anything and becomes 0.
        focal_length_px: focal length.
        principal_point_px: (2,).

    Returns:
        The centred view; rows of weight 0 lie on the axis.

    """
    present = weights > 0
    rays = np.ones((len(weights), 3))
    flat = (joints_px - principal_point_px) / focal_length_px
    rays[:, :2] = np.where(present[:, None], flat, 0.0)
    # Each counts as the unit vector along it.
    rotation = rotation_onto_axis((weights / np.sqrt((rays**2).sum(1))) @ rays)
    turned = rays @ rotation.T
    turn = turn_rad(turned[:, :2] / np.maximum(turned[:, 2:], _LEAST_DEPTH), present)
    if turn:
        rotation = rotations_by(turn) @ rotation
        turned = rays @ rotation.T
    # A joint more than 90° from the person's own centre cannot be seen: it would be behind.
    depth = np.maximum(turned[:, 2:], _LEAST_DEPTH)
    points = np.where(present[:, None], turned[:, :2] / depth, 0.0)
    covariance = None
    if covariance_px2 is not None:
        jacobian = (rotation[:2, :2] - points[:, :, None] * rotation[2, :2]) / depth[:, :, None]
        given = np.where(present[:, None, None], covariance_px2, 0.0)
        covariance = jacobian @ given @ np.swapaxes(jacobian, 1, 2) / focal_length_px**2
    return CentredView(rotation, points, covariance)
