"""The local prior: what poses that look about like this one are, as one Gaussian.

The nearest exemplars, each moved in front of the camera, are an *ensemble*. Their weighted mean and
covariance, plus what body proportions that the library does not have would do, make a Gaussian over
the *state* of a person: the image positions of all joints in *standard pixels*
(``app.lifting.posterior``), x and y of the first joint first, and after them the depths of all
joints relative to the root's, ``z / z_root - 1``.

Covariances between joints fade with the number of bones between them (*localisation*): those of far
joints are mostly sampling error of a small ensemble. Neighbours are weighed by their distance in
the image, apart from what other proportions explain of it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from app.lifting.compiled import compiled, pointer
from app.lifting.geometry import Floats, Integers
from app.lifting.posterior import STANDARD_PX_PER_MM
from app.lifting.proportions import PROPORTION_DIRECTIONS
from app.lifting.resection import LEAST_EXTENT_MM, NEAREST_TO_EXTENT
from app.lifting.stature import STATURE_SEGMENTS, STATURE_SHARES
from library_store.skeleton import L_HIP, LSP14, R_HIP

_TYPICAL = 16
"""Neighbours whose mean shows what proportions do: they need not be told apart for that."""


@dataclass(frozen=True)
class Ensemble:
    """Neighbours in front of the camera.

    ``states`` (K, 3 J), see the module; ``root_depth_mm`` (K,); ``proportions`` (D, 3 J): what a
    typical deviation of the body's proportions adds to a state, one independent direction a row;
    ``px_per_unit``: standard pixels in a normalised unit; ``stature_mm``: how tall they are.
    """

    states: Floats
    root_depth_mm: Floats
    proportions: Floats
    px_per_unit: float
    stature_mm: float


@dataclass(frozen=True)
class LocalPrior:
    """A Gaussian over states: ``mean`` (3 J,), ``covariance`` (3 J, 3 J); mean root depth in mm."""

    mean: Floats
    covariance: Floats
    root_depth_mm: float


def place_ensemble(
    exemplars_mm: Floats,
    rotations: Floats,
    points: Floats,
    weights: Floats,
    proportion_spread: float,
) -> Ensemble:
    """Move exemplars in front of the camera: library rotation, least-squares translation.

    The rotation is left as the library has it: turning every neighbour onto the observation (eq. 5)
    fits its noise and hides from the regression how the image changes with the view.

    Args:
        exemplars_mm: (K, J, 3) exemplar frame, nearest first.
        rotations: (K, 3, 3) of the library cameras.
        points: (J, 2) observed, normalised image coordinates of the centred view.
        weights: (J,) 0 = missing.
        proportion_spread: standard deviation of the log of a segment's length about the library's;
            0 for none.

    """
    n, n_joints = len(exemplars_mm), len(points)
    exemplars, turned = _contiguous(exemplars_mm), _contiguous(rotations)
    directions = proportion_spread * PROPORTION_DIRECTIONS
    targets, shares = _contiguous(points), _contiguous(weights)
    if (
        exemplars.shape != (n, n_joints, 3)
        or turned.shape != (n, 3, 3)
        or targets.shape != (n_joints, 2)
        or shares.shape != (n_joints,)
        or directions.shape[1:] != (n_joints, n_joints)
    ):
        raise ValueError("exemplars, rotations, points and weights do not belong together")
    states = np.empty((n + 1 + len(directions), 3 * n_joints))
    root_depth, stature = np.empty(len(states)), np.empty(1)
    px_per_unit = compiled().posematch_place(
        n,
        n_joints,
        pointer(exemplars),
        pointer(turned),
        pointer(targets),
        pointer(shares),
        _TYPICAL,
        len(directions),
        pointer(directions),
        R_HIP,
        L_HIP,
        NEAREST_TO_EXTENT,
        LEAST_EXTENT_MM,
        STANDARD_PX_PER_MM,
        len(STATURE_SEGMENTS),
        pointer(STATURE_SEGMENTS),
        pointer(STATURE_SHARES),
        pointer(stature),
        pointer(states),
        pointer(root_depth),
    )
    return Ensemble(
        states=states[:n],
        root_depth_mm=root_depth[:n],
        proportions=states[n + 1 :] - states[n],
        px_per_unit=px_per_unit,
        stature_mm=float(stature[0]),
    )


def local_prior(
    ensemble: Ensemble,
    rows: Integers,
    observed: Floats,
    *,
    bandwidth_px: float,
    adaptive: float,
    granularity_px: float,
    localisation_bones: float,
) -> LocalPrior:
    """The ensemble's Gaussian about an observation.

    Args:
        ensemble: the neighbours.
        rows: which image coordinates of the state are observed.
        observed: (2 J,) their values at ``rows``, standard pixels.
        bandwidth_px: kernel over the image distance of a neighbour, standard pixels a coordinate.
        adaptive: how much of the nearest neighbour's mean squared residual is added to the
            kernel's variance, for people the library knows less densely.
        granularity_px: spread of a projection that no neighbour accounts for.
        localisation_bones: bones over which a covariance between joints fades to 1/e.

    """
    states, proportions = _contiguous(ensemble.states), _contiguous(ensemble.proportions)
    seen, wanted = np.ascontiguousarray(rows, dtype=np.int64), _contiguous(observed)
    factors = _state_factors(localisation_bones)
    size = states.shape[1]
    if proportions.shape[1:] != (size,) or factors.shape != (size, size) or not len(states):
        raise ValueError("the states are not those of these joints")
    if len(seen) and not 0 <= seen.min() <= seen.max() < min(size, len(wanted)):
        raise ValueError("rows are observed that no state has")
    weights, mean, covariance = np.empty(len(states)), np.empty(size), np.empty((size, size))
    compiled().posematch_local_prior(
        len(states),
        size,
        pointer(states),
        len(seen),
        pointer(seen),
        pointer(wanted),
        len(proportions),
        pointer(proportions),
        bandwidth_px,
        adaptive,
        pointer(factors),
        pointer(weights),
        pointer(mean),
        pointer(covariance),
    )
    image = np.arange(2 * LSP14.n_joints)
    covariance[image, image] += granularity_px**2
    return LocalPrior(mean, covariance, float(weights @ ensemble.root_depth_mm))


def _contiguous(values: Floats) -> Floats:
    return np.ascontiguousarray(values, dtype=np.float64)


@cache
def localisation(bones: float) -> Floats:
    """(J, J) factors exp(-d / bones), d the bones between two joints; positive definite."""
    n = LSP14.n_joints
    distance = np.where(np.eye(n, dtype=bool), 0.0, np.inf)
    for parent, child in LSP14.edges:
        distance[parent, child] = distance[child, parent] = 1.0
    for via in range(n):
        distance = np.minimum(distance, distance[:, via, None] + distance[None, via, :])
    factors: Floats = np.exp(-distance / bones)
    factors.flags.writeable = False
    return factors


@cache
def _state_factors(bones: float) -> Floats:
    """:func:`localisation` by coordinate of the state, (3 J, 3 J)."""
    joints = np.arange(LSP14.n_joints)
    joint_of = np.concatenate([np.repeat(joints, 2), joints])
    factors: Floats = localisation(bones)[np.ix_(joint_of, joint_of)]
    factors.flags.writeable = False
    return factors
