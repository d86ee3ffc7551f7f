r"""The 28-D descriptor of a 2D pose, and its distance when joints are unsure or missing.

A pose of fourteen image points becomes a descriptor by forgetting where and how large it is:

.. math:: d_j = (x_j - \bar x) / r, \quad \bar x = \sum_j w_j x_j / W, \quad
          r^2 = \sum_j w_j |x_j - \bar x|^2 / W, \quad W = \sum_j w_j

with all weights 1 the joints' RMS distance from their centroid is 1 and the 28 numbers have the
Euclidean norm sqrt(14). Unlike the vertical extent, the RMS radius does not collapse for a lying
person. The centroid, not the root, is subtracted: it averages the noise of all joints.

**Distance.** Two descriptors differ by their Euclidean distance. When joints of the query are
missing (weight 0) or unsure (weight < 1), *both* poses are normalised on the query's weights, so
that the best shift and scale over the visible joints is taken out, and

.. math:: D^2 = 14 \sum_j w_j |q_j - e_j|^2 / W

which is the plain Euclidean distance when all weights are equal. D / sqrt(14) is the RMS distance
of the joints in units of the person's RMS radius, whatever the mask.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from library_store.skeleton import LSP14

Float = NDArray[np.float64]

N_JOINTS = LSP14.n_joints
DIMENSIONS = 2 * N_JOINTS


def normalise(points: ArrayLike, weights: ArrayLike | None = None) -> Float:
    """Take position and size out of 2D poses.

    ``points``: (..., 14, 2), any unit; ``weights``: (..., 14) in [0, 1], ``None`` for all 1.
    Returns (..., 14, 2) float64 with zero weighted mean and unit weighted RMS radius; coordinates
    of weight 0 are carried through the same shift and scale. Raises ``ValueError`` where the
    weighted joints coincide, or fewer than two have any weight, for then there is no size.
    """
    points = np.asarray(points, dtype=np.float64)
    if weights is None:
        centred = points - points.mean(axis=-2, keepdims=True)
        radius = np.sqrt((centred**2).sum(axis=-1).mean(axis=-1))
    else:
        share = np.asarray(weights, dtype=np.float64)
        total = share.sum(axis=-1, keepdims=True)
        if not np.all(total > 0):
            raise ValueError("a pose needs at least two joints of positive weight")
        share = share / total
        # NaN or infinite coordinates of missing joints must not reach the sums.
        unread = (share[..., None] == 0) & ~np.isfinite(points)
        points = np.where(unread, 0.0, points)
        centred = points - (share[..., None] * points).sum(axis=-2, keepdims=True)
        radius = np.sqrt((share * (centred**2).sum(axis=-1)).sum(axis=-1))
    if not np.all(radius > 0):
        raise ValueError("a pose needs at least two distinct joints of positive weight")
    normalised: Float = centred / radius[..., None, None]
    return normalised


def describe(points: ArrayLike) -> NDArray[np.float32]:
    """Descriptors of complete 2D poses: (..., 14, 2) in any unit to (..., 28) float32."""
    normalised = normalise(points)
    return normalised.reshape(*normalised.shape[:-2], DIMENSIONS).astype(np.float32)


def weighted_distance(query: ArrayLike, weights: ArrayLike, poses: ArrayLike) -> Float:
    """Exact distance D of a query to poses, both normalised on the query's weights.

    ``query``: (14, 2), any unit; ``weights``: (14,) in [0, 1]; ``poses``: (n, 14, 2), any unit,
    finite. Returns (n,) float64. Raises ``ValueError`` as :func:`normalise` does.
    """
    share = np.asarray(weights, dtype=np.float64)
    return distance_from_normalised(normalise(query, share), share, poses)


def distance_from_normalised(query: Float, weights: Float, poses: ArrayLike) -> Float:
    """:func:`weighted_distance` of a query already normalised on its weights."""
    share = np.repeat(weights / weights.sum(), 2)
    centred = np.array(poses, dtype=np.float64).reshape(-1, N_JOINTS, 2)
    centred -= (centred.reshape(-1, DIMENSIONS) @ (share[:, None] * _AXIS_OF))[:, None]
    flat = centred.reshape(-1, DIMENSIONS)
    radius = np.sqrt(flat**2 @ share)
    if not np.all(radius > 0):
        raise ValueError("a pose needs at least two distinct joints of positive weight")
    flat /= radius[:, None]
    flat -= np.where(share > 0, query.ravel(), 0.0)
    distance: Float = np.sqrt(N_JOINTS * (flat**2 @ share))
    return distance


_AXIS_OF = np.tile(np.eye(2), (N_JOINTS, 1))
"""(28, 2): which numbers of a flattened pose are x, which y."""
