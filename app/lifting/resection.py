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

from app.lifting.geometry import Floats

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
        rotated_mm: (..., 3, J) ``R @ X``, about the root.
        targets: (..., J, 2) normalised image coordinates.
        weights: (..., J), not all 0.

    Returns:
        (..., 3) mm, in front of the camera also when the joints say nothing about depth.

    """
    share = weights / weights.sum(-1, keepdims=True)
    moment = share[..., None] * targets
    mean_target = moment.sum(-2)
    spread = moment - share[..., None] * mean_target[..., None, :]
    own = (spread * targets).sum(-1)
    # With shift = x Z - X all that is needed is linear in the points: mean(shift) and the
    # spread's moment with it.
    loads = np.zeros((*own.shape[:-1], 3, own.shape[-1], 3))
    loads[..., 0, :, 0] = loads[..., 1, :, 1] = -share
    loads[..., :2, :, 2] = -np.swapaxes(spread, -1, -2)
    loads[..., 2, :, :2] = moment
    loads[..., 2, :, 2] = own
    loads = loads.reshape(*loads.shape[:-3], -1, 3)
    flat = rotated_mm.reshape(*rotated_mm.shape[:-2], -1)
    shared = loads.ndim == 2
    moments = flat @ loads if shared else (flat[..., None, :] @ loads)[..., 0, :]
    # The first two unknowns eliminated: t_xy = mean(shift) + mean(x) t_z.
    depth = -moments[..., 2] / np.maximum(own.sum(-1), 1e-12)
    moments[..., 2] = np.maximum(depth, _nearest_depth(rotated_mm))
    moments[..., :2] += mean_target * moments[..., 2:]
    return moments


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
    # Coordinates before joints from here on: that is how small products are fast.
    points = np.swapaxes(exemplars_mm.reshape(-1, joints, 3), 1, 2).copy()
    rotation = rotations.reshape(-1, 3, 3)
    rotated = rotation @ points
    if targets.ndim > 2 or weights.ndim > 1:
        targets = np.broadcast_to(targets, (*lead, joints, 2)).reshape(-1, joints, 2)
        weights = np.broadcast_to(weights, (*lead, joints)).reshape(-1, joints)
    translation = initial_translation(rotated, targets, weights)
    observed = np.swapaxes(targets, -1, -2)
    weight = base_weight = weights[..., None, :]
    damping = np.full(len(points), _INITIAL_DAMPING)
    image, inverse = _image(rotated, translation)
    residuals = image - observed
    # Six derivatives of (x, y) by the camera, and the residual as the seventh row.
    rows = np.zeros((len(points), 7, 2, joints))
    for _ in range(iterations):
        if robust_scale is not None:
            # IRLS: the weight of this step is held while the step is judged.
            squared = (residuals**2).sum(1, keepdims=True)
            weight = base_weight / (1.0 + squared / robust_scale**2)
        _fill_jacobian(rows, rotated, image, inverse)
        rows[:, 6] = residuals
        step, cost = _damped_step(rows, weight, damping)
        new_rotation = rotation_exponential(step[:, :3]) @ rotation
        new_rotated = new_rotation @ points
        new_translation = translation + step[:, 3:]
        ahead = new_translation[:, 2] >= _nearest_depth(new_rotated)
        if not ahead.all():
            new_translation[~ahead] = translation[~ahead]
        new_image, new_inverse = _image(new_rotated, new_translation)
        new_residuals = new_image - observed
        new_cost = (weight * new_residuals**2).sum((1, 2))
        better = ahead & (new_cost <= cost)
        damping *= np.where(better, 0.1, 10.0)
        if not better.all():
            worse = ~better
            new_rotation[worse], new_translation[worse] = rotation[worse], translation[worse]
            new_rotated[worse], new_residuals[worse] = rotated[worse], residuals[worse]
            new_image[worse], new_inverse[worse] = image[worse], inverse[worse]
        rotation, translation, rotated = new_rotation, new_translation, new_rotated
        image, inverse, residuals = new_image, new_inverse, new_residuals
    placed = rotated + translation[:, :, None]
    return Cameras(
        rotation.reshape(*lead, 3, 3),
        translation.reshape(*lead, 3),
        np.swapaxes(placed, 1, 2).reshape(*lead, joints, 3),
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
    rotated = np.swapaxes(rotated_mm, 1, 2)
    jacobian = np.zeros((len(rotated), 6, 2, rotated.shape[2]))
    _fill_jacobian(jacobian, rotated, *_image(rotated, translation_mm))
    return jacobian


def _fill_jacobian(rows: Floats, rotated_mm: Floats, image: Floats, inverse: Floats) -> None:
    """Write :func:`projection_jacobian` into the first six ``rows``, which were zeros at first.

    ``rotated_mm`` (B, 3, J); ``image`` (B, 2, J) and ``inverse`` (B, 1, J) as of :func:`_image`.
    """
    # Of each joint: right, down and forward of the root, over its depth.
    right, down, forward = (rotated_mm[:, axis] * inverse[:, 0] for axis in range(3))
    np.multiply(image, -down[:, None], out=rows[:, 0])
    rows[:, 0, 1] -= forward
    np.multiply(image, right[:, None], out=rows[:, 1])
    rows[:, 1, 0] += forward
    np.negative(down, out=rows[:, 2, 0])
    rows[:, 2, 1] = right
    rows[:, 3, 0] = rows[:, 4, 1] = inverse[:, 0]
    np.multiply(image, -inverse, out=rows[:, 5])


def rotation_exponential(omega: Floats) -> Floats:
    """Rotation matrices (B, 3, 3) of rotation vectors (B, 3), by Rodrigues' formula."""
    squared = (omega**2).sum(-1)
    half = np.maximum(0.5 * np.sqrt(squared), 1e-8)
    sinc = np.sin(half) / half
    # sin(a)/a and (1 - cos a)/a², by the half angle: exact also where a vanishes.
    first, second = sinc * np.cos(half), 0.5 * sinc**2
    cross = (omega @ _GENERATORS).reshape(-1, 3, 3)
    rotation: Floats = second[:, None, None] * (cross @ cross)
    rotation += first[:, None, None] * cross
    rotation += _IDENTITY
    return rotation


_IDENTITY = np.eye(3)
_GENERATORS = np.zeros((3, 9))
_GENERATORS[[0, 1, 2], [7, 2, 3]] = 1.0
_GENERATORS[[0, 1, 2], [5, 6, 1]] = -1.0
"""(3, 9): a rotation vector times this is its cross-product matrix, row by row."""


def _image(rotated_mm: Floats, translation_mm: Floats) -> tuple[Floats, Floats]:
    """Projections (B, 2, J) of rotated points (B, 3, J), and their inverse depths (B, 1, J)."""
    placed = rotated_mm + translation_mm[:, :, None]
    inverse = 1.0 / placed[:, 2:]
    return placed[:, :2] * inverse, inverse


def _damped_step(rows: Floats, weight: Floats, damping: Floats) -> tuple[Floats, Floats]:
    """Solve (JᵀWJ + λ diag) δ = -JᵀWr for the batch; returns δ (B, 6) and the cost rᵀWr (B,).

    ``rows`` (B, 7, 2, J): six of the Jacobian and the residual, so that one product gives JᵀWJ,
    JᵀWr and rᵀWr.
    """
    batch = len(rows)
    weighted = (rows * weight[..., None, :, :]).reshape(batch, 7, -1)
    products = rows.reshape(batch, 7, -1) @ np.swapaxes(weighted, 1, 2).copy()
    normal, gradient = products[:, :6, :6], products[:, :6, 6:]
    curvature = np.einsum("bii->bi", normal)  # a view
    # The floor keeps the system solvable when the joints leave a direction undetermined.
    floor = curvature.max(1, keepdims=True) * (1e-12 * _UNIT_BALANCE)
    curvature *= 1.0 + damping[:, None]
    curvature += floor + 1e-300
    step = np.asarray(-np.linalg.solve(normal, gradient)[..., 0], dtype=np.float64)
    return step, products[:, 6, 6]


_UNIT_BALANCE = np.array([1.0, 1.0, 1.0, 1e-6, 1e-6, 1e-6])
"""Radians against millimetres: a radian moves a joint by about a metre."""


def _nearest_depth(rotated_mm: Floats) -> Floats:
    """Least root depth at which every joint is in front of the camera, with some margin."""
    extent: Floats = _NEAREST_TO_EXTENT * np.maximum(-rotated_mm[..., 2, :].min(-1), 50.0)
    return extent
