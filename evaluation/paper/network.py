"""A learned lifter to compare with: a residual MLP after Martinez et al. (ICCV 2017).

``evaluation.paper.mlp`` trains it on the poses of a library; here is what it computes, in numpy, so
that measuring it needs no torch. Differences from the original: 14 joints, a mask of missing ones,
2D as the library's own descriptor (position and size taken out), RMS norm in place of batch norm.

    h₀ = relu(W_in f);   h ← h + relu(V relu(U h̄)) per block, h̄ = h / rms(h);   X = W_out h̄
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from app.errors import PoseMatchError
from app.lifting.geometry import Floats, Mask
from app.lifting.resection import resect
from app.lifting.warp import warp_perspective
from evaluation.protocols import UNREADABLE_NPZ
from library_store.descriptor import normalise
from library_store.skeleton import L_HIP, LSP14, R_HIP

N_JOINTS = LSP14.n_joints
N_FEATURES = 3 * N_JOINTS + 1
UNIT_MM = 500.0
"""What the network calls 1."""
RMS_FLOOR = 1e-4
_LOG_RADIUS = -2.0
"""About the logarithm of a person's RMS radius in normalised image coordinates."""


def features(points: Floats, present: Mask) -> Floats:
    """(N, 14, 2) normalised image coordinates, (N, 14) bool -> (N, 43).

    The descriptor (0 for missing joints), which joints there are, and the logarithm of the radius
    that the descriptor forgets: how strong perspective is.
    """
    shares = present.astype(np.float64)
    shape = np.where(present[..., None], normalise(points, shares), 0.0)
    total = shares.sum(-1)
    centre = (shares[..., None] * points).sum(-2) / total[:, None]
    squared = ((points - centre[:, None]) ** 2).sum(-1)
    log_radius = 0.5 * np.log((shares * squared).sum(-1) / total)
    return np.concatenate(
        [shape.reshape(len(points), -1), shares, (log_radius - _LOG_RADIUS)[:, None]], axis=1
    )


@dataclass(frozen=True)
class Network:
    """The trained network.

    ``weights``: ``w_in`` (43, W), ``b_in`` (W,), per block i ``w_<i>a``, ``b_<i>a``, ``w_<i>b``,
    ``b_<i>b``, and ``w_out`` (W, 42), ``b_out``; ``n_samples`` seen in training; ``poses``, the
    SHA-256 of the ``poses.npy`` it was trained on.
    """

    weights: Mapping[str, Floats]
    n_blocks: int
    n_samples: int
    poses: str

    @staticmethod
    def load(path: Path) -> Network:
        """Read what ``evaluation.paper.mlp`` wrote; ``PoseMatchError`` for any other file."""
        try:
            with path.open("rb") as file, np.load(file, allow_pickle=False) as data:
                names = [k for k in data.files if k[:2] in ("w_", "b_")]
                weights = {k: data[k].astype(np.float64) for k in names}
                return Network(
                    weights, int(data["n_blocks"]), int(data["n_samples"]), str(data["poses"])
                )
        except UNREADABLE_NPZ as error:
            raise PoseMatchError(
                f"{path} is no network of evaluation.paper.mlp: {error}"
            ) from error

    @property
    def width(self) -> int:
        """Units of a hidden layer."""
        return len(self.weights["b_in"])

    def lift(self, points: Floats, present: Mask) -> Floats:
        """Poses about the hip midpoint, (N, 14, 3) mm, camera axes.

        Args:
            points: (N, 14, 2) normalised image coordinates, the camera turned onto the person.
            present: (N, 14) bool.

        """
        w = self.weights
        hidden = np.maximum(features(points, present) @ w["w_in"] + w["b_in"], 0.0)
        for block in range(self.n_blocks):
            inner = np.maximum(_unit(hidden) @ w[f"w_{block}a"] + w[f"b_{block}a"], 0.0)
            hidden = hidden + np.maximum(inner @ w[f"w_{block}b"] + w[f"b_{block}b"], 0.0)
        joints = UNIT_MM * (_unit(hidden) @ w["w_out"] + w["b_out"]).reshape(-1, N_JOINTS, 3)
        return about_root(joints)


def warp_onto(poses_mm: Floats, points: Floats, present: Mask) -> Floats:
    """Poses (N, 14, 3) placed by resection (eq. 5) and put on the rays of their joints.

    What makes the network's answer agree with the image, as warping does for an exemplar.
    """
    upright = np.broadcast_to(np.eye(3), (len(poses_mm), 3, 3))
    cameras = resect(poses_mm, upright, points, present.astype(np.float64))
    return warp_perspective(cameras.points_mm, points, present)


def about_root(joints: Floats) -> Floats:
    """Joints (..., 14, 3) less their hip midpoint."""
    middle: Floats = joints - 0.5 * (joints[..., [R_HIP], :] + joints[..., [L_HIP], :])
    return middle


def _unit(hidden: Floats) -> Floats:
    scaled: Floats = hidden / np.sqrt((hidden**2).mean(1, keepdims=True) + RMS_FLOOR)
    return scaled
