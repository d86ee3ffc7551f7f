"""The methods that the tables compare, and the paper's upper bounds.

The paper's method is the product's ``method="paper"``: k nearest by eq. 4, M* by eq. 5, sorted by
eq. 4 again, X* by eq. 6. ``X`` is the exemplar as M* places it. All answers are (N, 14, 3) mm in
the camera frame of the view.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from app.lifting.geometry import CentredView, Floats, Integers, Mask, centre_view
from app.lifting.lifter import Lifter, LiftingSettings
from app.lifting.types import LiftedPerson, Method, Observation
from app.lifting.warp import warp_weak_perspective
from evaluation.metrics import align, rigid_error_mm
from evaluation.paper.network import Network, warp_onto
from evaluation.paper.views import SceneCamera, Views
from evaluation.progress import followed
from library_store.library import Library
from models.pose_lifter import PoseLifter

CANDIDATES = 1_000
"""Exemplars, nearest by their inter-joint distances, among which the optimal one is sought."""


@dataclass(frozen=True)
class Seen2D:
    """2D of N views.

    ``points_px`` (N, 14, 2); from a network also its own ``confidence`` (N, 14),
    ``covariance_px2`` (N, 14, 2, 2) and ``depths_px`` (N, 14) if it says any, which the paper's
    method does not look at; ``present`` (N, 14), all by default.
    """

    points_px: Floats
    confidence: Floats | None = None
    covariance_px2: Floats | None = None
    present: Mask | None = None
    depths_px: Floats | None = None

    @property
    def there(self) -> Mask:
        """(N, 14) which joints there are."""
        shape = self.points_px.shape[:2]
        return np.ones(shape, dtype=bool) if self.present is None else self.present

    def of(self, rows: Integers) -> Seen2D:
        """That of some of the views."""
        confidence, covariance, depths = self.confidence, self.covariance_px2, self.depths_px
        return Seen2D(
            self.points_px[rows],
            None if confidence is None else confidence[rows],
            None if covariance is None else covariance[rows],
            self.there[rows],
            None if depths is None else depths[rows],
        )

    def observation(self, row: int, *, plain: bool) -> Observation:
        """One person; ``plain``: all joints alike."""
        points = self.points_px[row]
        if plain or self.confidence is None or self.covariance_px2 is None:
            return Observation(points, self.there[row].astype(np.float64))
        confidence = np.where(self.there[row], self.confidence[row], 0.0)
        depths = None if self.depths_px is None else self.depths_px[row]
        return Observation(points, confidence, self.covariance_px2[row], depths)


@dataclass(frozen=True)
class Answers:
    """``answer_mm`` (N, 14, 3): the method's; ``exemplar_mm``: X, where there is one.

    ``refused``: how many people the method does not lift; their joints are all at one place.
    """

    answer_mm: Floats
    exemplar_mm: Floats | None = None
    refused: int = 0

    def labelled(self, label: str) -> str:
        """A row's label, with how many were refused if any."""
        return f"{label} ({self.refused:,} refused)" if self.refused else label


Lift = Callable[[Views, Seen2D], Answers]


@dataclass(frozen=True)
class System:
    """A named way to lift."""

    label: str
    lift: Lift


def paper_method(library: Library, k: int = 10) -> Lift:
    """The paper's: X* as the answer, X beside it."""
    return _by_lifter(library, "paper", LiftingSettings(paper_shortlist=k))


def default_method(library: Library, network: PoseLifter | None = None) -> Lift:
    """What the service answers by default, with its lifting network or by matching alone."""
    return _by_lifter(library, "fusion", LiftingSettings(), network)


def ours(library: Library, network: PoseLifter | None) -> dict[str, Lift]:
    """The default method, and matching alone; without a network these are one."""
    alone = {"matching alone": default_method(library)}
    return alone if network is None else {"default": default_method(library, network)} | alone


def learned(network: Network, *, warped: bool) -> Lift:
    """The MLP's answer, or that put onto the joints' rays."""

    def lift(views: Views, seen: Seen2D) -> Answers:
        turned = _centred(views, seen)
        points = np.stack([view.points for view in turned])
        poses = network.lift(points, seen.there)
        if warped:
            poses = warp_onto(poses, points, seen.there)
        return Answers(_back(turned, poses))

    return lift


def known_depths(views: Views, seen: Seen2D, placed_mm: Floats | None = None) -> Floats:
    """``[s x, Z]`` with the depths of ``placed_mm``, by default the truth's: an upper bound."""
    turned = _centred(views, seen)
    placed = views.joints_mm if placed_mm is None else placed_mm
    warped = [
        warp_weak_perspective(joints @ view.rotation.T, view.points, present)
        for joints, view, present in zip(placed, turned, seen.there, strict=True)
    ]
    return _back(turned, np.stack(warped))


def optimal_exemplars(library: Library, views: Views) -> Floats:
    """Of each view the exemplar nearest to the truth after a rigid motion, moved there.

    Sought among the :data:`CANDIDATES` nearest by the distances between all pairs of joints, which
    no rigid motion changes. Frames seen by several cameras are looked up once.
    """
    joints = views.joints_mm.shape[1]
    a, b = np.triu_indices(joints, 1)

    def distances(poses: Floats) -> NDArray[np.float32]:
        apart = ((poses[:, a] - poses[:, b]) ** 2).sum(-1)
        return np.asarray(np.sqrt(apart), dtype=np.float32)

    table = np.concatenate(
        [
            distances(library.poses_mm(np.arange(start, min(start + 10_000, len(library)))))
            for start in range(0, len(library), 10_000)
        ]
    )
    squared = (table**2).sum(1)
    frames, which = np.unique(
        np.stack([views.scene, views.at], axis=1), axis=0, return_inverse=True
    )
    which = which.reshape(-1)
    best = np.empty((len(frames), joints, 3))
    for number in followed(range(len(frames)), f"optimal exemplars, {library.manifest.name}"):
        truth = views.joints_mm[np.flatnonzero(which == number)[0]]
        rank = squared - 2.0 * (table @ distances(truth[None])[0])
        n = min(CANDIDATES, len(table))
        poses = library.poses_mm(np.argpartition(rank, n - 1)[:n])
        best[number] = poses[rigid_error_mm(poses, truth).mean(1).argmin()]
    return align(best[which], views.joints_mm, scale=False)


def _by_lifter(
    library: Library,
    method: Method,
    settings: LiftingSettings,
    network: PoseLifter | None = None,
) -> Lift:
    lifter = Lifter(library, settings, network)

    def lift(views: Views, seen: Seen2D) -> Answers:
        answer = np.empty_like(views.joints_mm)
        exemplar = np.empty_like(views.joints_mm)
        refused = 0
        for row in followed(range(len(views)), f"{method}, {library.manifest.name}"):
            camera = views.camera_of(row)
            observation = seen.observation(row, plain=method == "paper")
            (person,) = lifter.lift([observation], camera.intrinsics, method=method, n_candidates=1)
            if isinstance(person, LiftedPerson):
                answer[row], exemplar[row] = person.joints_3d_mm, person.exemplar.joints_mm
            else:
                # A mean pose would flatter.
                answer[row] = exemplar[row] = _nothing(seen.points_px[row], camera)
                refused += 1
        return Answers(answer, exemplar if method == "paper" else None, refused)

    return lift


def _nothing(points_px: Floats, camera: SceneCamera) -> Floats:
    """All joints at one place."""
    pinhole = camera.intrinsics
    x, y = (points_px.mean(0) - pinhole.principal_point_px) / pinhole.focal_length_px
    return np.tile(1000.0 * np.array([x, y, 1.0]), (len(points_px), 1))


def _centred(views: Views, seen: Seen2D) -> list[CentredView]:
    turned = []
    for row in range(len(views)):
        pinhole = views.camera_of(row).intrinsics
        turned.append(
            centre_view(
                seen.points_px[row],
                seen.there[row].astype(np.float64),
                None,
                pinhole.focal_length_px,
                np.array(pinhole.principal_point_px),
            )
        )
    return turned


def _back(turned: list[CentredView], poses: Floats) -> Floats:
    return np.stack([view.to_photo(pose) for view, pose in zip(turned, poses, strict=True)])
