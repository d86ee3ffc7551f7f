"""Fusion: the posterior mean of the 3D pose given the 2D joints, from a few hundred neighbours.

The nearest exemplars, each moved in front of the camera, are an *ensemble*: samples of the poses
that look about like this. Their weighted mean and covariance over (image position, depth) of all
joints make a local Gaussian prior, and the observed joints update it by the ensemble Kalman filter:

    x̂ = m + B (B + R)⁻¹ (x - m)          image positions, denoised as far as the noise R demands
    ẑ = z̄ + C_zp (B + R)⁻¹ (x - m)        depths, regressed on the image residuals

with B the covariance of the projections plus what the library's granularity leaves over, and C_zp
the depths' covariance with them. One formula is at once the posterior mean over candidates, the
local ridge regression of depth (its ridge is the noise) and a soft warp (all of the way to the
observation at R = 0, none of it where 2D is worthless); a missing joint is a row left out, and the
posterior covariance tells how sure the depths are.

Covariances between joints fade with the number of bones between them (*localisation*): those of far
joints are mostly sampling error of a small ensemble.

The noise is estimated: R = what the 2D network said + ν² I, the evidence of the observation under
the ensemble deciding over ν. The same evidence, with each joint left out in turn, tells whether one
joint contradicts the others.

Units: *standard pixels* (``app.lifting.posterior``) in the image; depths relative to the root's.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from app.lifting.geometry import Floats, Integers, lift_to_depth, normalised_projection
from app.lifting.posterior import STANDARD_PX_PER_MM, standard_px_per_unit
from app.lifting.resection import initial_translation
from library_store.skeleton import L_HIP, LSP14, R_HIP, Skeleton

OUTLIER_SIGMA_PX = 80.0
"""Spread of a joint that is simply elsewhere, standard pixels: half an arm's length."""


@dataclass(frozen=True)
class FusionSettings:
    """What shapes the local prior.

    Chosen on mocap subjects of whom no table is measured (and who were not in that trial's
    library), except ``outlier_prior``: other frames of the held-out subjects of the tables.

    ``bandwidth_px``: kernel over the squared image distance of a neighbour, standard pixels a
    coordinate; ``adaptive``: how much of the nearest neighbour's mean squared residual is added to
    the kernel's variance, for people the library knows less densely; ``granularity_px``: spread of
    a projection that no neighbour accounts for; ``localisation_bones``: bones over which a
    covariance between joints fades to 1/e; ``noise_px``: the noise levels ν that are weighed by
    evidence; ``outlier_prior``: probability that a joint of full confidence is elsewhere.
    """

    bandwidth_px: float = 12.0
    adaptive: float = 4.0
    granularity_px: float = 2.0
    localisation_bones: float = 10.0
    noise_px: tuple[float, ...] = (1.0, 2.0, 3.0, 4.5, 6.5, 9.0, 13.0)
    outlier_prior: float = 0.02


@dataclass(frozen=True)
class Ensemble:
    """Neighbours in front of the camera.

    ``positions_px`` (K, J, 2) standard pixels; ``depths`` (K, J) relative to the root's depth:
    z / z_root - 1; ``root_depth_mm`` (K,); ``px_per_unit`` standard pixels in a normalised unit.
    """

    positions_px: Floats
    depths: Floats
    root_depth_mm: Floats
    px_per_unit: float


@dataclass(frozen=True)
class FusedPose:
    """The answer of :func:`fuse`.

    ``joints_mm`` (J, 3) in the centred view's camera frame; ``spread_mm`` (J,) posterior standard
    deviation of a joint about the root, all axes together, not calibrated; ``noise_px`` the noise
    found, standard pixels; ``outlier`` the joint that contradicts the others, or None.
    """

    joints_mm: Floats
    spread_mm: Floats
    noise_px: float
    outlier: int | None


def place_ensemble(
    exemplars_mm: Floats, rotations: Floats, points: Floats, weights: Floats
) -> Ensemble:
    """Move exemplars in front of the camera: library rotation, least-squares translation.

    The rotation is left as the library has it: turning every neighbour onto the observation (eq. 5)
    fits its noise and hides from the regression how the image changes with the view.

    Args:
        exemplars_mm: (K, J, 3) exemplar frame.
        rotations: (K, 3, 3) of the library cameras.
        points: (J, 2) observed, normalised image coordinates of the centred view.
        weights: (J,) 0 = missing.

    """
    rotated = exemplars_mm @ np.swapaxes(rotations, 1, 2)
    placed = rotated + initial_translation(rotated, points, weights)[:, None]
    root_depth = 0.5 * (placed[:, R_HIP, 2] + placed[:, L_HIP, 2])
    px_per_unit = standard_px_per_unit(float(np.sort(root_depth)[len(root_depth) // 2]))
    return Ensemble(
        positions_px=px_per_unit * normalised_projection(placed),
        depths=placed[..., 2] / root_depth[:, None] - 1.0,
        root_depth_mm=root_depth,
        px_per_unit=px_per_unit,
    )


@cache
def localisation(bones: float, skeleton: Skeleton = LSP14) -> Floats:
    """(J, J) factors exp(-d / bones), d the bones between two joints; positive definite."""
    n = skeleton.n_joints
    distance = np.where(np.eye(n, dtype=bool), 0.0, np.inf)
    for parent, child in skeleton.edges:
        distance[parent, child] = distance[child, parent] = 1.0
    for via in range(n):
        distance = np.minimum(distance, distance[:, via, None] + distance[None, via, :])
    factors: Floats = np.exp(-distance / bones)
    factors.flags.writeable = False
    return factors


def fuse(
    ensemble: Ensemble,
    points: Floats,
    confidence: Floats,
    covariance_px2: Floats | None,
    settings: FusionSettings,
) -> FusedPose:
    """Update the ensemble's Gaussian by the observed joints.

    Args:
        ensemble: the neighbours.
        points: (J, 2) observed, normalised image coordinates.
        confidence: (J,) 0 = missing.
        covariance_px2: (J, 2, 2) of the observation in standard pixels², or None.
        settings: the local prior.

    """
    n = len(points)
    seen = np.flatnonzero(confidence > 0)
    rows = (2 * seen[:, None] + np.arange(2)).ravel()
    observed = ensemble.px_per_unit * points.ravel()
    weights = _kernel_weights(ensemble, rows, observed, settings)

    # Image coordinates first, depths after them.
    members = np.concatenate(
        [ensemble.positions_px.reshape(len(weights), 2 * n), ensemble.depths], axis=1
    )
    mean = weights @ members
    anomalies = np.sqrt(weights)[:, None] * (members - mean)
    covariance = _coordinate_factors(settings.localisation_bones) * (anomalies.T @ anomalies)
    image = np.arange(2 * n)
    covariance[image, image] += settings.granularity_px**2

    innovation = observed[rows] - mean[rows]
    gain = covariance[:, rows]
    prior = gain[rows]
    if covariance_px2 is not None:
        blocks = prior.reshape(len(seen), 2, len(seen), 2)
        each = np.arange(len(seen))
        blocks[each, :, each] += covariance_px2[seen] / confidence[seen, None, None]
    evidence = _Evidence(prior, innovation, np.square(settings.noise_px))
    pulled = gain @ evidence.mean_precision
    updated = mean + pulled @ innovation
    position, depth = updated[: 2 * n].reshape(n, 2), updated[2 * n :]

    position_var = covariance[image, image] - (pulled[: 2 * n] * gain[: 2 * n]).sum(1)
    depth_post = covariance[2 * n :, 2 * n :] - pulled[2 * n :] @ gain[2 * n :].T
    root_depth = float(weights @ ensemble.root_depth_mm)
    suspect = evidence.suspect(confidence[seen], settings.outlier_prior)
    return FusedPose(
        joints_mm=lift_to_depth(position / ensemble.px_per_unit, root_depth * (1.0 + depth)),
        spread_mm=_spread_about_root(position_var, depth_post, root_depth),
        noise_px=float(np.sqrt(evidence.mean_noise_var)),
        outlier=None if suspect is None else int(seen[suspect]),
    )


def _kernel_weights(
    ensemble: Ensemble, rows: Integers, observed: Floats, settings: FusionSettings
) -> Floats:
    """(K,) weights of the neighbours, summing to 1, by their distance in the image ``rows``."""
    flat = ensemble.positions_px.reshape(len(ensemble.positions_px), -1)
    if len(rows) < flat.shape[1]:
        flat, observed = flat[:, rows], observed[rows]
    squared = ((flat - observed) ** 2).sum(1)
    # Per coordinate; two coordinates a joint less the translation and scale already fitted.
    nearest = squared.min() / max(len(observed) - 4, 1)
    variance = settings.bandwidth_px**2 + settings.adaptive * nearest
    weights = np.exp(-0.5 * (squared - squared.min()) / variance)
    normalised: Floats = weights / weights.sum()
    return normalised


@cache
def _coordinate_factors(bones: float) -> Floats:
    """:func:`localisation` by coordinate: (3 J, 3 J), image coordinates first, then depths."""
    joints = np.arange(LSP14.n_joints)
    joint_of = np.concatenate([np.repeat(joints, 2), joints])
    factors: Floats = localisation(bones)[np.ix_(joint_of, joint_of)]
    factors.flags.writeable = False
    return factors


def _spread_about_root(position_var: Floats, depth_cov: Floats, root_depth_mm: float) -> Floats:
    """Posterior standard deviation (J,) in mm of joints about the hip midpoint."""
    from_root = np.eye(len(depth_cov))
    from_root[:, [R_HIP, L_HIP]] -= 0.5
    depth_var = ((from_root @ depth_cov) * from_root).sum(1) * root_depth_mm**2
    image_var = position_var.reshape(-1, 2).sum(1) / STANDARD_PX_PER_MM**2
    spread: Floats = np.sqrt(np.maximum(depth_var, 0.0) + np.maximum(image_var, 0.0))
    return spread


class _Evidence:
    """Evidence of an innovation under N(0, prior + ν² I), for every noise level ν² at once.

    One eigendecomposition serves all levels, and the blocks of the precision give the evidence with
    any one joint left out (Schur complement).
    """

    def __init__(self, prior: Floats, innovation: Floats, noise_var: Floats) -> None:
        values, self._vectors = np.linalg.eigh(prior)
        total = np.maximum(values, 0.0) + noise_var[:, None]
        self._inverse = 1.0 / total
        self._rotated = innovation @ self._vectors
        self._log_evidence = -0.5 * (np.log(total) + self._rotated**2 * self._inverse).sum(1)
        share = np.exp(self._log_evidence - self._log_evidence.max())
        share /= share.sum()
        self.mean_noise_var = float(share @ noise_var)
        self.mean_precision: Floats = (self._vectors * (share @ self._inverse)) @ self._vectors.T

    def suspect(self, confidence: Floats, outlier_prior: float) -> int | None:
        """The joint (row of the seen ones) that is more probably elsewhere than noisy, if any.

        Compares "all joints are where they say" with "all but j, and j is anywhere within
        :data:`OUTLIER_SIGMA_PX`", each at its own noise level.
        """
        # The 2 x 2 blocks (a, b; b, c) of the precision, and the pull (p, q), at every level.
        x, y = self._vectors[0::2], self._vectors[1::2]
        a, b, c = self._inverse @ np.stack([x * x, x * y, y * y]).swapaxes(1, 2)
        pull = (self._rotated * self._inverse) @ self._vectors.T
        p, q = pull[:, 0::2], pull[:, 1::2]
        determinant = a * c - b * b
        # The residual about the prediction by the other joints is B⁻¹ times the pull.
        residual_x = (c * p - b * q) / determinant
        residual_y = (a * q - b * p) / determinant
        left_out = residual_x * p + residual_y * q
        without = self._log_evidence[:, None] + 0.5 * (left_out - np.log(determinant))
        # What the joint's own position would have cost as an outlier: a broad Gaussian about the
        # prediction by the others.
        elsewhere = -0.5 * (residual_x**2 + residual_y**2) / OUTLIER_SIGMA_PX**2
        elsewhere = elsewhere - np.log(OUTLIER_SIGMA_PX**2)
        wrong = np.clip(1.0 - confidence, outlier_prior, 1.0 - outlier_prior)
        odds = (
            _log_sum(without + elsewhere, axis=0)
            - _log_sum(self._log_evidence, axis=0)
            + np.log(wrong / (1.0 - wrong))
        )
        worst = int(np.argmax(odds))
        return worst if odds[worst] > 0 else None


def _log_sum(values: Floats, axis: int) -> Floats:
    top = values.max(axis=axis, keepdims=True)
    total: Floats = np.log(np.exp(values - top).sum(axis=axis)) + np.squeeze(top, axis=axis)
    return total
