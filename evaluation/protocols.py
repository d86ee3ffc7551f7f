"""Data sets of 2D and 3D joints, and the ways their 2D is spoilt before lifting."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from app.errors import PoseMatchError
from app.lifting.types import Intrinsics, Observation
from evaluation.metrics import Floats
from library_store.skeleton import LSP14
from models.pck import torso_px

LIMB_ENDS = tuple(
    LSP14.index(f"{side}_{joint}")
    for side in ("r", "l")
    for joint in ("elbow", "wrist", "knee", "ankle")
)
"""The joints that are spoilt in the missing and corrupted rows."""

UNREADABLE_NPZ = (KeyError, ValueError, TypeError, AttributeError, EOFError, BadZipFile)
"""What numpy raises for a file that is no npz, or not of the arrays that are wanted."""


@dataclass(frozen=True)
class LiftingSet:
    """People with 3D truth, seen by one camera.

    ``joints_3d_mm`` (N, 14, 3) camera frame; ``joints_2d_px`` by noise level in px, each (N, 14, 2)
    with the principal point at (0, 0).
    """

    name: str
    joints_3d_mm: Floats
    joints_2d_px: dict[int, Floats]
    intrinsics: Intrinsics

    def first(self, n: int | None) -> LiftingSet:
        """The first n people (all if None)."""
        return self._select(slice(n))

    def half(self, which: int) -> LiftingSet:
        """Every second person, from person 0 or 1."""
        return self._select(slice(which, None, 2))

    def every(self, step: int) -> LiftingSet:
        """One person in so many."""
        return self._select(slice(None, None, step))

    def _select(self, people: slice) -> LiftingSet:
        return LiftingSet(
            self.name,
            self.joints_3d_mm[people],
            {noise: points[people] for noise, points in self.joints_2d_px.items()},
            self.intrinsics,
        )


def load_lifting_set(path: Path) -> LiftingSet:
    """Read an ``.npz`` of ``joints_3d_mm``, ``focal_length_px``, ``joints_2d_px_noise<px>``.

    Raises ``PoseMatchError`` for any other file.
    """
    prefix = "joints_2d_px_noise"
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as data:
            points = {
                int(key.removeprefix(prefix)): data[key].astype(np.float64)
                for key in data.files
                if key.startswith(prefix)
            }
            truth = data["joints_3d_mm"].astype(np.float64)
            focal_px = float(data["focal_length_px"])
    except UNREADABLE_NPZ as error:
        raise PoseMatchError(f"{path} is no set of people to lift: {error}") from error
    problem = _problem(truth, points, focal_px)
    if problem:
        raise PoseMatchError(f"{path} is no set of people to lift: {problem}")
    return LiftingSet(
        path.stem,
        truth,
        dict(sorted(points.items())),
        Intrinsics(focal_px, (0.0, 0.0), "request"),
    )


def _problem(truth: Floats, points: dict[int, Floats], focal_px: float) -> str:
    """What keeps people with this truth and these points from being lifted, or nothing."""
    n, joints = len(truth), LSP14.n_joints
    if truth.shape != (n, joints, 3) or n == 0:
        return f"joints_3d_mm is {truth.shape}; wanted is (N, {joints}, 3)"
    if not points:
        return "no 2D joints; wanted is joints_2d_px_noise0 and the like"
    for noise, seen in points.items():
        if seen.shape != (n, joints, 2):
            return f"joints_2d_px_noise{noise} is {seen.shape}; wanted is {(n, joints, 2)}"
    # An error that is nan would make nan of every mean.
    bad = ~np.isfinite(truth).all((1, 2))
    for seen in points.values():
        bad |= ~np.isfinite(seen).all((1, 2))
    if bad.any():
        return f"{bad.sum()} of {n} people, the first number {bad.argmax()}, have joints of nan"
    if not (np.isfinite(focal_px) and focal_px > 0):
        return f"focal_length_px is {focal_px:g}"
    return ""


@dataclass(frozen=True)
class Spoilt:
    """2D input after spoiling: (N, 14, 2) px, (N, 14) confidence, (N,) spoilt joint or -1."""

    points_px: Floats
    confidence: Floats
    joint: np.ndarray[tuple[int], np.dtype[np.int64]]

    def observations(self, sigma_px: float | None = None) -> Iterator[Observation]:
        """As lifting takes them; ``sigma_px`` states an isotropic 2D noise, None leaves it open."""
        covariance = None
        if sigma_px is not None:
            covariance = np.broadcast_to(sigma_px**2 * np.eye(2), (LSP14.n_joints, 2, 2))
        for points, confidence in zip(self.points_px, self.confidence, strict=True):
            yield Observation(points, confidence, covariance)


def clean(points_px: Floats) -> Spoilt:
    """Nothing but the set's own noise."""
    n, joints = points_px.shape[:2]
    return Spoilt(points_px, np.ones((n, joints)), np.full(n, -1))


def one_missing(points_px: Floats) -> Spoilt:
    """One limb joint a person without a position, in turn."""
    spoilt = clean(points_px)
    joint = np.resize(LIMB_ENDS, len(points_px))
    confidence = spoilt.confidence.copy()
    confidence[np.arange(len(joint)), joint] = 0.0
    return Spoilt(points_px, confidence, joint)


def one_corrupted(points_px: Floats) -> Spoilt:
    """One limb joint a person moved by half a torso length in a seeded random direction."""
    joint = np.resize(LIMB_ENDS, len(points_px))
    angle = np.random.default_rng(0).uniform(0.0, 2.0 * np.pi, len(joint))
    moved = points_px.copy()
    offset = 0.5 * torso_px(points_px)[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1)
    moved[np.arange(len(joint)), joint] += offset
    return Spoilt(moved, np.ones(points_px.shape[:2]), joint)


SPOILERS: dict[str, Callable[[Floats], Spoilt]] = {
    "clean": clean,
    "one limb joint missing": one_missing,
    "one limb joint corrupted": one_corrupted,
}
