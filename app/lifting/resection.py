"""Camera resectioning (eq. 5): the camera M* that best explains 2D joints by a given exemplar.

``M* = argmin_M Σ_j w_j ||M(X_j) - x_j||²`` over rotation and translation, the focal length being
known. Solved by Levenberg-Marquardt with the analytic Jacobian for any number of (joints, exemplar)
pairs at once, starting from the exemplar's library camera M_i.

All image coordinates here are normalised (focal length 1, principal point (0, 0)), all lengths mm,
``X_camera = rotation @ X_exemplar + translation``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from app.lifting.geometry import Floats, normalised_projection

_INITIAL_DAMPING = 1e-4
_NEAREST_TO_EXTENT = 1.05
"""The root stays at least this many times the exemplar's forward extent away from the camera."""


@dataclass(frozen=True)
class Cameras:
    """Resectioned cameras, leading shape (...).

    ``rotation`` (..., 3, 3); ``translation_mm`` (..., 3); ``points_mm`` (..., J, 3) the exemplars'
    joints in the camera frame; ``residuals`` (..., J, 2) projection minus observation, normalised
    image coordinates, unweighted.
    """

    rotation: Floats
    translation_mm: Floats
    points_mm: Floats
    residuals: Floats


def initial_translation(rotated_mm: Floats, targets: Floats, weights: Floats) -> Floats:
    """Translation that projects already rotated points onto the targets, by linear least squares.

    ``x (Z + t_z) = X + t_x`` (and the same for y) is linear in t: scaled projection made exact for
    perspective. Weighted normal equations, solved in closed form.

    Args:
        rotated_mm: (..., J, 3) ``R @ X``, about the root.
        targets: (..., J, 2) normalised image coordinates.
        weights: (..., J), not all 0.

    Returns:
        (..., 3) mm, in front of the camera also when the joints say nothing about depth.

    """
    total = weights.sum(-1)[..., None]
    share = weights / total
    mean_target = (share[..., None] * targets).sum(-2)
    spread = share[..., None] * (targets - mean_target[..., None, :])
    # With shift = x Z - X all that is needed is linear in the points: mean(shift) and the
    # spread's moment with it.
    loads = np.zeros((*spread.shape[:-1], 3, 3))
    loads[..., 0, 0] = loads[..., 1, 1] = -share
    loads[..., :2, 2] = -spread
    loads[..., 2, :2] = share[..., None] * targets
    loads[..., 2, 2] = (spread * targets).sum(-1)
    loads = loads.reshape(*loads.shape[:-3], -1, 3)
    flat = rotated_mm.reshape(*rotated_mm.shape[:-2], -1)
    shared = loads.ndim == 2
    moments = flat @ loads if shared else (flat[..., None, :] @ loads)[..., 0, :]
    # The first two unknowns eliminated: t_xy = mean(shift) + mean(x) t_z.
    depth = -moments[..., 2] / np.maximum((spread * targets).sum((-1, -2)), 1e-12)
    depth = np.maximum(depth, _nearest_depth(rotated_mm))[..., None]
    return np.concatenate([moments[..., :2] + mean_target * depth, depth], axis=-1)


def resect(
    exemplars_mm: Floats,
    rotations: Floats,
    targets: Floats,
    weights: Floats,
    *,
    iterations: int = 6,
    robust_scale: Floats | float | None = None,
) -> Cameras:
    """Solve eq. 5 for a batch.

    Args:
        exemplars_mm: (..., J, 3) exemplar frame, about the root.
        rotations: (..., 3, 3) of the library cameras M_i, where the search starts.
        targets: (..., J, 2) observed joints, normalised image coordinates; broadcasts.
        weights: (..., J) in [0, 1], 0 = missing; broadcasts.
        iterations: Levenberg-Marquardt steps; each costs one Jacobian.
        robust_scale: None for least squares; else the residual (normalised image coordinates) at
            which a joint's pull is halved (Cauchy weights, re-evaluated at every step).

    Returns:
        The cameras; a step that would raise the cost is not taken.

    """
    lead = exemplars_mm.shape[:-2]
    joints = exemplars_mm.shape[-2]
    shape = (-1, joints)
    points = exemplars_mm.reshape(*shape, 3)
    observed = np.broadcast_to(targets, (*lead, joints, 2)).reshape(*shape, 2)
    base_weights = np.broadcast_to(weights, (*lead, joints)).reshape(shape)
    rotation = rotations.reshape(-1, 3, 3)
    rotated = points @ np.swapaxes(rotation, 1, 2)
    shared = targets.ndim == 2 and weights.ndim == 1
    translation = initial_translation(
        rotated, *((targets, weights) if shared else (observed, base_weights))
    )
    damping = np.full(len(points), _INITIAL_DAMPING)
    residuals = _residuals(rotated, translation, observed)
    for _ in range(iterations):
        weight = base_weights[:, None]
        if robust_scale is not None:
            # IRLS: the weight of this step is held while the step is judged.
            squared = (residuals**2).sum(1, keepdims=True)
            weight = weight / (1.0 + squared / robust_scale**2)
        jacobian = projection_jacobian(rotated, translation)
        step, cost = _damped_step(jacobian, residuals, weight, damping)
        new_rotation = rotation_exponential(step[:, :3]) @ rotation
        new_rotated = points @ np.swapaxes(new_rotation, 1, 2)
        new_translation = translation + step[:, 3:]
        ahead = new_translation[:, 2] >= _nearest_depth(new_rotated)
        new_translation[~ahead] = translation[~ahead]
        new_residuals = _residuals(new_rotated, new_translation, observed)
        new_cost = (weight * new_residuals**2).sum((1, 2))
        better = ahead & (new_cost <= cost)
        damping *= np.where(better, 0.1, 10.0)
        keep = better[:, None, None]
        rotation = np.where(keep, new_rotation, rotation)
        rotated = np.where(keep, new_rotated, rotated)
        residuals = np.where(keep, new_residuals, residuals)
        translation = np.where(better[:, None], new_translation, translation)
    return Cameras(
        rotation.reshape(*lead, 3, 3),
        translation.reshape(*lead, 3),
        (rotated + translation[:, None]).reshape(*lead, joints, 3),
        np.swapaxes(residuals, 1, 2).reshape(*lead, joints, 2),
    )


def projection_jacobian(rotated_mm: Floats, translation_mm: Floats) -> Floats:
    """Derivative of the normalised projection by the camera.

    The camera moves as ``exp([ω]×) R, t + τ``.

    Args:
        rotated_mm: (B, J, 3) ``R @ X``.
        translation_mm: (B, 3).

    Returns:
        (B, 6, 2, J): by (ω, τ), of (x, y).

    """
    px, py, pz = rotated_mm[..., 0], rotated_mm[..., 1], rotated_mm[..., 2]
    inverse = 1.0 / (pz + translation_mm[:, 2:])
    x = (px + translation_mm[:, 0:1]) * inverse
    y = (py + translation_mm[:, 1:2]) * inverse
    jacobian = np.empty((len(rotated_mm), 6, 2, rotated_mm.shape[1]))
    jacobian[:, 0, 0] = -x * py
    jacobian[:, 0, 1] = -pz - y * py
    jacobian[:, 1, 0] = pz + x * px
    jacobian[:, 1, 1] = y * px
    jacobian[:, 2, 0] = -py
    jacobian[:, 2, 1] = px
    jacobian[:, 3, 0] = 1.0
    jacobian[:, 3, 1] = 0.0
    jacobian[:, 4, 0] = 0.0
    jacobian[:, 4, 1] = 1.0
    jacobian[:, 5, 0] = -x
    jacobian[:, 5, 1] = -y
    jacobian *= inverse[:, None, None]
    return jacobian


def rotation_exponential(omega: Floats) -> Floats:
    """Rotation matrices (B, 3, 3) of rotation vectors (B, 3), by Rodrigues' formula."""
    squared = (omega**2).sum(-1)
    half = np.maximum(0.5 * np.sqrt(squared), 1e-8)
    sinc = np.sin(half) / half
    # sin(a)/a and (1 - cos a)/a², by the half angle: exact also where a vanishes.
    first, second = sinc * np.cos(half), 0.5 * sinc**2
    rotation: Floats = omega[:, :, None] * (second[:, None] * omega)[:, None, :]
    rotation += ((first[:, None] * omega) @ _GENERATORS).reshape(-1, 3, 3)
    rotation += (1.0 - second * squared)[:, None, None] * np.eye(3)
    return rotation


_GENERATORS = np.zeros((3, 9))
_GENERATORS[[0, 1, 2], [7, 2, 3]] = 1.0
_GENERATORS[[0, 1, 2], [5, 6, 1]] = -1.0
"""(3, 9): a rotation vector times this is its cross-product matrix, row by row."""


def _residuals(rotated_mm: Floats, translation_mm: Floats, observed: Floats) -> Floats:
    """Projection minus observation (B, J, 2), as (B, 2, J)."""
    residuals = normalised_projection(rotated_mm + translation_mm[:, None]) - observed
    return np.swapaxes(residuals, 1, 2)


def _damped_step(
    jacobian: Floats, residuals: Floats, weights: Floats, damping: Floats
) -> tuple[Floats, Floats]:
    """Solve (JᵀWJ + λ diag) δ = -JᵀWr for the batch; returns δ (B, 6) and the cost rᵀWr (B,)."""
    batch = len(jacobian)
    # The residuals as a seventh column: one product gives JᵀWJ, JᵀWr and rᵀWr.
    both = np.concatenate([jacobian, residuals[:, None]], axis=1)
    weighted = (both * weights[:, None]).reshape(batch, 7, -1)
    products = weighted @ np.swapaxes(both.reshape(batch, 7, -1), 1, 2)
    normal, gradient = products[:, :6, :6], products[:, :6, 6:]
    diagonal = np.arange(6)
    curvature: Floats = normal[:, diagonal, diagonal]
    # The floor keeps the system solvable when the joints leave a direction undetermined.
    floor = 1e-12 * curvature.max(1, keepdims=True) * _UNIT_BALANCE + 1e-300
    normal[:, diagonal, diagonal] = curvature * (1.0 + damping[:, None]) + floor
    step = np.asarray(-np.linalg.solve(normal, gradient)[..., 0], dtype=np.float64)
    return step, products[:, 6, 6]


_UNIT_BALANCE = np.array([1.0, 1.0, 1.0, 1e-6, 1e-6, 1e-6])
"""Radians against millimetres: a radian moves a joint by about a metre."""


def _nearest_depth(rotated_mm: Floats) -> Floats:
    """Least root depth at which every joint is in front of the camera, with some margin."""
    extent: Floats = _NEAREST_TO_EXTENT * np.maximum(-rotated_mm[..., 2].min(-1), 50.0)
    return extent
