"""Heat maps -> marginals (eq. 3) -> joints: sub-pixel place, spread and confidence, vectorised.

Positions are pixels with integers at pixel centres. All functions take maps (N, J, h, w) and know
nothing of the network that made them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Maps = NDArray[np.float32]
N_FEATURES = 5
"""See ``confidence_features``."""
RESIDUE = 0.05
"""Beliefs below this share of the strongest are none."""
REACH = 0.0375
"""Of the map's side: standard deviation of what is near enough to count as the same place, a fifth
of a usual trunk's length."""


@dataclass(frozen=True)
class Joints2D:
    """One person's joints in the photo.

    ``positions_px`` (J, 2); ``covariance_px2`` (J, 2, 2), the spread of each joint's marginal about
    its position; ``confidence`` (J,), calibrated probability that the joint lies within 0.2 torso
    lengths, or None while the model has no calibration; ``sigma_px`` (J,), the radius that holds
    68% of errors, or None likewise; ``peak`` (J,), the raw belief at the position, in [0, 1];
    ``depths_px`` (J,), how much farther from the camera than the hip midpoint as the picture shows
    it, in the photo's pixels at the hips' distance, ``(z / z_root - 1) * focal_length_px``, or None
    where the network reads none.
    """

    positions_px: Floats
    covariance_px2: Floats
    confidence: Floats | None
    sigma_px: Floats | None
    peak: Floats
    depths_px: Floats | None = None

    @property
    def belief(self) -> Floats:
        """What is known of each joint's presence (J,): ``confidence``, or else ``peak``."""
        return self.peak if self.confidence is None else self.confidence


def marginals(maps: NDArray[np.float32], kind: str) -> Maps:
    """Each joint's distribution over the cells (eq. 3), (N, J, h, w), summing to 1.

    ``logits`` are normalised by a softmax (odds of the beliefs), ``beliefs`` by their sum.
    """
    flat = maps.reshape(*maps.shape[:2], -1)
    if kind == "logits":
        flat = np.exp(flat - flat.max(-1, keepdims=True))
    else:
        flat = np.maximum(flat, np.float32(1e-12))
    p: Maps = (flat / flat.sum(-1, keepdims=True)).reshape(maps.shape)
    return p


def without_residue(p: Maps) -> Maps:
    """Marginals (N, J, h, w) less what is everywhere, summing to 1 again; empty ones stay empty.

    A regression of beliefs leaves a hundredth or so in every cell: over the whole map more than the
    peak holds, it would make each joint's spread as wide as the crop.
    """
    kept = np.where(p < RESIDUE * p.max((-1, -2), keepdims=True), np.float32(0), p)
    rest: Maps = kept / np.maximum(kept.sum((-1, -2), keepdims=True), np.float32(1e-12))
    return rest


def pooled(p: Maps) -> Maps:
    """Marginals (N, J, h, w) -> how much of each lies near a cell, by a Gaussian of ``REACH``.

    The place with most belief about it is the one that is most probably right to within that reach;
    the strongest cell is another where a marginal is broad, or has one sharp peak beside a hill.
    Beyond the border there is nothing, so within three cells of it peaks move inwards.
    """
    rows, columns = (_gaussian_rows(size, REACH * max(p.shape[2:])) for size in p.shape[2:])
    near: Maps = rows @ (p @ columns)
    return near


@cache
def _gaussian_rows(size: int, sigma: float) -> Maps:
    """Symmetric (size, size): row i is a Gaussian about i, of weight 1 far from the ends."""
    step = np.arange(size)
    rows = np.exp(-((step[:, None] - step) ** 2) / (2 * sigma * sigma))
    return np.asarray(rows / (sigma * np.sqrt(2 * np.pi)), np.float32)


def sub_cell_peaks(p: Maps) -> tuple[Floats, NDArray[np.int64]]:
    """Peak of each map as (x, y) in cells, (N, J, 2), and its cell's flat index (N, J).

    One Newton step on log p from the strongest cell, exact for a Gaussian (Zhang et al. 2020).
    """
    n, j, h, w = p.shape
    best = p.reshape(n, j, -1).argmax(-1)
    y, x = np.divmod(best, w)
    # The 3x3 neighbourhood must exist: at the border the peak stays on its cell in that axis.
    cy, cx = np.clip(y, 1, h - 2), np.clip(x, 1, w - 2)
    ni, ji = np.ogrid[:n, :j]
    steps = np.arange(-1, 2)
    patch = p[
        ni[..., None, None],
        ji[..., None, None],
        cy[..., None, None] + steps[:, None],
        cx[..., None, None] + steps,
    ]
    log_p = np.log(np.maximum(patch, 1e-30).astype(np.float64))
    gx = (log_p[..., 1, 2] - log_p[..., 1, 0]) / 2
    gy = (log_p[..., 2, 1] - log_p[..., 0, 1]) / 2
    xx = log_p[..., 1, 2] - 2 * log_p[..., 1, 1] + log_p[..., 1, 0]
    yy = log_p[..., 2, 1] - 2 * log_p[..., 1, 1] + log_p[..., 0, 1]
    xy = (log_p[..., 2, 2] - log_p[..., 2, 0] - log_p[..., 0, 2] + log_p[..., 0, 0]) / 4
    det = xx * yy - xy * xy
    sound = (xx < 0) & (yy < 0) & (det > 1e-9)
    det = np.where(sound, det, 1.0)
    dx = np.where(sound, (xy * gy - yy * gx) / det, 0.0)
    dy = np.where(sound, (xy * gx - xx * gy) / det, 0.0)
    # A narrow slanting peak can lie almost a cell from its strongest cell.
    dx = np.where(cx == x, np.clip(dx, -1.0, 1.0), 0.0)
    dy = np.where(cy == y, np.clip(dy, -1.0, 1.0), 0.0)
    return np.stack([x + dx, y + dy], -1), best


def spread(p: Maps, at: Floats, target_sigma_cells: float) -> Floats:
    """Second moment of each marginal about ``at`` (N, J, 2) in cells², (N, J, 2, 2).

    The networks learn labels blurred by a Gaussian, so its variance is taken off again; a floor of
    a tenth of a cell keeps the matrix invertible.
    """
    _, _, h, w = p.shape
    # All moments up to the second by two products, about the middle to keep their precision.
    middle = np.array([w - 1, h - 1]) / 2
    x, y = np.arange(w) - middle[0], np.arange(h) - middle[1]
    powers_x = np.stack([np.ones(w), x, x * x], 1).astype(np.float32)
    powers_y = np.stack([np.ones(h), y, y * y]).astype(np.float32)
    moments = (powers_y @ (p @ powers_x)).astype(np.float64)
    ax, ay = np.moveaxis(at - middle, -1, 0)
    mass, mx, my = moments[..., 0, 0], moments[..., 0, 1], moments[..., 1, 0]
    xx = moments[..., 0, 2] - 2 * ax * mx + ax * ax * mass
    yy = moments[..., 2, 0] - 2 * ay * my + ay * ay * mass
    xy = moments[..., 1, 1] - ax * my - ay * mx + ax * ay * mass
    covariance = np.stack([xx, xy, xy, yy], -1).reshape(*at.shape[:2], 2, 2)
    values, vectors = np.linalg.eigh(covariance)
    values = np.maximum(values - target_sigma_cells**2, 0.01)
    unblurred: Floats = (vectors * values[..., None, :]) @ np.swapaxes(vectors, -1, -2)
    return unblurred


def peak_beliefs(maps: NDArray[np.float32], best: NDArray[np.int64], kind: str) -> Floats:
    """Belief in [0, 1] at each map's strongest cell, (N, J)."""
    flat = maps.reshape(*maps.shape[:2], -1)
    value = np.take_along_axis(flat, best[..., None], -1)[..., 0].astype(np.float64)
    if kind == "logits":
        value = 1 / (1 + np.exp(-np.clip(value, -30, 30)))
    return np.clip(value, 0.0, 1.0)


def confidence_features(
    peak: Floats, covariance_cells2: Floats, p: Maps, best: NDArray[np.int64], background: Floats
) -> Floats:
    """What confidence is read from, (N, J, N_FEATURES).

    Logit of the peak belief (absence shows there, a normalised map has forgotten it), logarithm of
    the spread, the mass within three cells of the peak, the background map's belief there, and the
    mean peak over the joints (is there a person at all).
    """
    n, j, h, w = p.shape
    y, x = np.divmod(best, w)
    near_x = (np.abs(np.arange(w) - x[..., None]) <= 3).astype(np.float32)
    near_y = (np.abs(np.arange(h) - y[..., None]) <= 3).astype(np.float32)
    mass = (near_y[..., None, :] @ (p @ near_x[..., None]))[..., 0, 0].astype(np.float64)
    logit = np.log(np.clip(peak, 1e-4, 1 - 1e-4) / (1 - np.clip(peak, 1e-4, 1 - 1e-4)))
    area = np.log(np.trace(covariance_cells2, axis1=-2, axis2=-1) / (h * w) + 1e-6)
    behind = np.take_along_axis(background.reshape(n, 1, -1), best.reshape(n, 1, j), -1)[:, 0]
    person = np.broadcast_to(peak.mean(1, keepdims=True), peak.shape)
    return np.stack([logit, area, mass, behind, person], -1)


@dataclass(frozen=True)
class Reading:
    """What a batch of maps says, in cells: before scaling to a photo and before calibration.

    ``at`` (N, J, 2), ``covariance`` (N, J, 2, 2), ``peak`` (N, J), ``features`` (N, J, F).
    """

    at: Floats
    covariance: Floats
    peak: Floats
    features: Floats


def read_maps(
    maps: NDArray[np.float32],
    n_joints: int,
    kind: str,
    target_sigma_cells: float,
    own: Callable[[Maps, Floats], Maps] | None = None,
) -> Reading:
    """Read a network's (N, n_joints + 1, h, w) maps, the last one being the background's.

    ``own`` says of marginals and of the beliefs at their strongest cells (N, J) what share of each
    place is the person's own (N, J, h, w); see models/rivals.py.
    """
    joint_maps = maps[:, :n_joints]
    background = maps[:, n_joints].astype(np.float64)
    if kind == "logits":
        background = 1 / (1 + np.exp(-np.clip(background, -30, 30)))
    p = marginals(joint_maps, kind)
    if own is not None:
        strongest = p.reshape(*p.shape[:2], -1).argmax(-1)
        p = p * own(p, peak_beliefs(joint_maps, strongest, kind))
    at, best = sub_cell_peaks(pooled(p))
    left = p
    if own is not None:  # what is lost to others counts against the joint, not for its place
        left = p / np.maximum(p.sum((-1, -2), keepdims=True), np.float32(1e-12))
    if kind == "beliefs":
        left = p = without_residue(left)
    covariance = spread(left, at, target_sigma_cells)
    peak = peak_beliefs(joint_maps, best, kind)
    return Reading(at, covariance, peak, confidence_features(peak, covariance, p, best, background))


def calibrated(features: Floats, coefficients: Floats) -> Floats:
    """Logistic model: (N, J, F) features and (J, 1 + F) coefficients -> probability (N, J)."""
    z = coefficients[:, 0] + (features * coefficients[:, 1:]).sum(-1)
    probability: Floats = 1 / (1 + np.exp(-np.clip(z, -30, 30)))
    return probability
