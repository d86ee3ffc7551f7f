"""What a body cannot do: limits learned from real poses, by which sampled ones are rejected.

Two kinds of measures are limited. Clearances: the distances between segments of the body (as line
segments, in trunk lengths), so that an arm does not pass through the chest or a leg through the
other. Angles: how far knees, elbows and head bend, and that knees do not bend forwards. A limit is
a small quantile of a measure over the poses the prior was fitted on.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from library_store.anatomy import Float, frame_of, root_of, unit
from library_store.skeleton import (
    HEAD_TOP,
    L_ANKLE,
    L_ELBOW,
    L_HIP,
    L_KNEE,
    L_SHOULDER,
    L_WRIST,
    LSP14,
    NECK,
    R_ANKLE,
    R_ELBOW,
    R_HIP,
    R_KNEE,
    R_SHOULDER,
    R_WRIST,
)

_ROOT = -1
# (name, from, to, fraction left out at the start: the part inside the neighbouring segment)
_SEGMENTS: tuple[tuple[str, int, int, float], ...] = (
    ("head", NECK, HEAD_TOP, 0.3),
    ("trunk", _ROOT, NECK, 0.0),
    ("r_upper_arm", R_SHOULDER, R_ELBOW, 0.5),
    ("l_upper_arm", L_SHOULDER, L_ELBOW, 0.5),
    ("r_forearm", R_ELBOW, R_WRIST, 0.0),
    ("l_forearm", L_ELBOW, L_WRIST, 0.0),
    ("r_thigh", R_HIP, R_KNEE, 0.5),
    ("l_thigh", L_HIP, L_KNEE, 0.5),
    ("r_shank", R_KNEE, R_ANKLE, 0.0),
    ("l_shank", L_KNEE, L_ANKLE, 0.0),
)
_ADJACENT = {
    frozenset(pair)
    for pair in (
        ("head", "trunk"),
        ("r_upper_arm", "r_forearm"),
        ("l_upper_arm", "l_forearm"),
        ("r_thigh", "r_shank"),
        ("l_thigh", "l_shank"),
    )
}
_PAIRS = tuple(
    (i, j)
    for i in range(len(_SEGMENTS))
    for j in range(i + 1, len(_SEGMENTS))
    if frozenset((_SEGMENTS[i][0], _SEGMENTS[j][0])) not in _ADJACENT
)
_ANGLES = (
    "r_knee_cos",
    "l_knee_cos",
    "r_knee_hinge",
    "l_knee_hinge",
    "r_elbow_cos",
    "l_elbow_cos",
    "head_up",
    "head_side",
    "head_front",
)

MEASURES: tuple[str, ...] = (
    *(f"{_SEGMENTS[i][0]}-{_SEGMENTS[j][0]}" for i, j in _PAIRS),
    *_ANGLES,
)
"""Names of the measures, clearances first."""


@dataclass(frozen=True)
class Limits:
    """Lower and upper limits of every measure, each (len(MEASURES),)."""

    low: Float
    high: Float

    def allow(self, poses_mm: Float) -> NDArray[np.bool_]:
        """Which of the poses (n, 14, 3) a body can take: (n,) bool."""
        measured = measure(poses_mm)
        return np.asarray(((measured >= self.low) & (measured <= self.high)).all(axis=1))


def learn_limits(poses_mm: Float, quantile: float) -> Limits:
    """Limits that all but a fraction ``quantile`` of the poses (n, 14, 3) keep, each on its own.

    A mirrored person is as possible as the person, so the two sides share their limits; clearances
    have no upper limit.
    """
    measured = measure(poses_mm)
    mirrored = measure(poses_mm[:, LSP14.mirror] * np.array([-1.0, 1.0, 1.0]))
    both = np.concatenate([measured, mirrored])
    low = np.quantile(both, quantile, axis=0)
    high = np.quantile(both, 1.0 - quantile, axis=0)
    high[: len(_PAIRS)] = np.inf
    return Limits(low=low, high=high)


def measure(poses_mm: Float) -> Float:
    """All measures of poses (n, 14, 3): (n, len(MEASURES)); clearances in trunk lengths."""
    root = root_of(poses_mm)
    trunk_length = np.linalg.norm(poses_mm[:, NECK] - root, axis=-1)
    ends = []
    for _name, start, end, skip in _SEGMENTS:
        a = root if start == _ROOT else poses_mm[:, start]
        b = poses_mm[:, end]
        ends.append((a + skip * (b - a), b))
    clearances = [segment_distance(*ends[i], *ends[j]) / trunk_length for i, j in _PAIRS]
    return np.column_stack([*clearances, *_angles(poses_mm, root)])


def _angles(poses: Float, root: Float) -> list[Float]:
    def bone(a: int, b: int) -> Float:
        return unit(poses[:, b] - poses[:, a])

    def dot(a: Float, b: Float) -> Float:
        product: Float = (a * b).sum(axis=-1)
        return product

    trunk = unit(poses[:, NECK] - root)
    left = unit(poses[:, L_HIP] - poses[:, R_HIP])
    chest = frame_of(poses[:, L_SHOULDER] - poses[:, R_SHOULDER], trunk, keep="y")
    head = bone(NECK, HEAD_TOP)
    legs = [
        (bone(hip, knee), bone(knee, ankle))
        for hip, knee, ankle in ((R_HIP, R_KNEE, R_ANKLE), (L_HIP, L_KNEE, L_ANKLE))
    ]
    arms = [
        (bone(shoulder, elbow), bone(elbow, wrist))
        for shoulder, elbow, wrist in (
            (R_SHOULDER, R_ELBOW, R_WRIST),
            (L_SHOULDER, L_ELBOW, L_WRIST),
        )
    ]
    return [
        *(dot(thigh, shank) for thigh, shank in legs),
        # Positive when the shank folds backwards about the hip axis.
        *(dot(np.cross(thigh, shank), left) for thigh, shank in legs),
        *(dot(upper, lower) for upper, lower in arms),
        dot(head, trunk),
        dot(head, chest[:, 0]),
        dot(head, chest[:, 2]),
    ]


def segment_distance(a0: Float, a1: Float, b0: Float, b1: Float) -> Float:
    """Least distance between line segments a0-a1 and b0-b1, each end (n, 3): (n,)."""
    u, v, w = a1 - a0, b1 - b0, a0 - b0
    uu, vv, uv = (u * u).sum(-1), (v * v).sum(-1), (u * v).sum(-1)
    uw, vw = (u * w).sum(-1), (v * w).sum(-1)
    denominator = np.maximum(uu * vv - uv * uv, 1e-12 * uu * vv)
    s = np.clip((uv * vw - vv * uw) / denominator, 0.0, 1.0)
    # The best t for that s, then the best s for the clipped t: exact for segments.
    t = np.clip((uv * s + vw) / vv, 0.0, 1.0)
    s = np.clip((uv * t - uw) / uu, 0.0, 1.0)
    gap = w + s[:, None] * u - t[:, None] * v
    distance: Float = np.linalg.norm(gap, axis=-1)
    return distance
