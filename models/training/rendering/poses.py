"""Which poses are rendered: mocap, evened out, mixed, and kept away from poses used for testing."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from library_store.skeleton import L_HIP, R_HIP
from models.training.rendering.pose import mirrored, pelvis_frame, turn

Poses = NDArray[np.float32]

TEST_RADIUS_MM = 60.0


def aligned_distance_mm(poses: Poses, tests: Poses) -> NDArray[np.float32]:
    """Mean joint distance after the best similarity transform, (N, T), at the size of the tests.

    ``poses`` (N, 14, 3), ``tests`` (T, 14, 3) mm.
    """
    p = (poses - poses.mean(1, keepdims=True)).astype(np.float64)
    t = (tests - tests.mean(1, keepdims=True)).astype(np.float64)
    square = (p**2).sum((1, 2))
    result = np.empty((len(p), len(t)), np.float32)
    for rows in np.array_split(np.arange(len(p)), max(len(p) // 500, 1)):
        u, s, vt = np.linalg.svd(np.einsum("nji,tjk->ntik", p[rows], t))
        sign = np.sign(np.linalg.det(u @ vt))
        s[..., 2] *= sign
        u[..., :, 2] *= sign[..., None]
        scale = s.sum(-1) / square[rows][:, None]
        fitted = scale[..., None, None] * (p[rows][:, None] @ (u @ vt))
        result[rows] = np.linalg.norm(fitted - t, axis=-1).mean(-1)
    return result


class PoseSource:
    """Draws poses from mocap.

    Frames are clustered and clusters drawn by the root of their size, so that a lunge is not lost
    among a thousand strides. ``tests`` (T, 14, 3) mm are poses that must stay unseen: nothing
    nearer than ``TEST_RADIUS_MM`` to one of them or its mirror image is ever drawn.
    """

    def __init__(self, poses: Poses, tests: Poses | None, clusters: int = 400) -> None:
        self._tests = np.zeros((0, 14, 3), np.float32)
        if tests is not None:
            self._tests = np.concatenate([tests, np.stack([mirrored(t) for t in tests])])
        if len(self._tests):
            near = aligned_distance_mm(poses, self._tests).min(1) < TEST_RADIUS_MM
            poses = poses[~near]
        self.poses = poses
        cv2.setRNGSeed(0)
        shape = _heading_free(poses).reshape(len(poses), -1)
        clusters = min(clusters, len(poses))
        some = shape[:: max(len(shape) // 12000, 1)].astype(np.float32)
        criteria = (cv2.TERM_CRITERIA_MAX_ITER, 12, 0.0)
        _, _, centers = cv2.kmeans(
            some, min(clusters, len(some)), np.empty(0), criteria, 1, cv2.KMEANS_PP_CENTERS
        )
        distance = (shape**2).sum(1)[:, None] - 2 * shape @ centers.T + (centers**2).sum(1)
        label = distance.argmin(1)
        self._members = [
            m for m in (np.flatnonzero(label == k) for k in range(len(centers))) if len(m)
        ]
        size = np.array([len(m) for m in self._members], float)
        self._chance = size**0.3 / (size**0.3).sum()

    def _one(self, rng: np.random.Generator) -> Poses:
        members = self._members[rng.choice(len(self._members), p=self._chance)]
        pose = self.poses[rng.choice(members)]
        return mirrored(pose) if rng.random() < 0.5 else pose

    def draw(self, rng: np.random.Generator) -> Poses:
        """A pose (14, 3) mm, y up: a third with arms of another frame, some tumbled in the air."""
        while True:
            pose = self._one(rng)
            if rng.random() >= 0.35:
                break
            pose = with_upper_body(pose, self._one(rng))
            if not len(self._tests):
                break
            if aligned_distance_mm(pose[None], self._tests).min() >= TEST_RADIUS_MM:
                break
        dice = rng.random()
        if dice < 0.14:
            heading = rng.uniform(0, 2 * np.pi)
            axis = np.array([np.cos(heading), 0, np.sin(heading)])
            angle = rng.uniform(0.6, np.pi) if dice < 0.08 else rng.normal(np.pi / 2, 0.2)
            pose = (pose @ turn(axis, float(angle)).T).astype(np.float32)
        return pose


def _heading_free(poses: Poses) -> Poses:
    """Root-centred and turned about the vertical so that the hips lie along x, in metres."""
    p = (poses - (poses[:, R_HIP] + poses[:, L_HIP])[:, None] / 2) / 1000
    hips = p[:, L_HIP] - p[:, R_HIP]
    angle = np.arctan2(hips[:, 2], hips[:, 0])
    cos, sin = np.cos(angle), np.sin(angle)
    zero, one = np.zeros_like(cos), np.ones_like(cos)
    turn_back = np.stack(
        [
            np.stack([cos, zero, sin], 1),
            np.stack([zero, one, zero], 1),
            np.stack([-sin, zero, cos], 1),
        ],
        1,
    )
    result: Poses = np.einsum("nij,nkj->nki", turn_back, p).astype(np.float32)
    return result


def with_upper_body(legs: Poses, upper: Poses) -> Poses:
    """The legs of one pose under the trunk, arms and head of another, joined at the pelvis."""
    root = (legs[R_HIP] + legs[L_HIP]) / 2
    other = (upper[R_HIP] + upper[L_HIP]) / 2
    rotation = pelvis_frame(legs.astype(float)) @ pelvis_frame(upper.astype(float)).T
    joined = legs.copy()
    rows = list(range(R_HIP))
    joined[rows] = (upper[rows] - other) @ rotation.T + root
    return joined
