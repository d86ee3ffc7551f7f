"""From 2D joints to 3D people: match (eq. 4) → camera (eq. 5) → warp (eq. 6), and fusion.

People are lifted one by one, each batched over its candidates: the answer for a person is the same
bytes whoever else is in the call.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from app.lifting import NEIGHBOURS
from app.lifting.calibration import FUSION_SIGMA, SigmaCalibration
from app.lifting.ensemble import place_ensemble
from app.lifting.fusion import FusedPose, FusionSettings, fuse
from app.lifting.geometry import CentredView, Floats, Integers, Mask, centre_view, project
from app.lifting.posterior import shortlist_probabilities, standard_px_per_unit
from app.lifting.resection import Cameras, resect
from app.lifting.stature import stature_mm
from app.lifting.types import (
    Hypothesis,
    Intrinsics,
    LiftedPerson,
    Method,
    NotLiftable,
    Observation,
)
from app.lifting.warp import warp_perspective, warp_weak_perspective
from library_store.library import Library
from library_store.skeleton import (
    L_HIP,
    L_SHOULDER,
    NECK,
    R_HIP,
    R_SHOULDER,
)
from models.pose_lifter import PoseLifter

MIN_JOINTS = 6
"""A camera has six unknowns; with fewer joints (two equations each) every exemplar fits."""
MIN_TRUNK_JOINTS = 2
"""Of shoulders, hips and neck: without them limbs hang on nothing."""
TRUNK = (NECK, R_SHOULDER, L_SHOULDER, R_HIP, L_HIP)
_TRUNK_JOINTS = np.array(TRUNK)
MIN_EXTENT_PX = 8.0
"""Larger side of the joints' bounding box, pixels of the photo."""
MIN_BREADTH = 0.02
"""Spread of the joints across over along their line; 0.04 is the least of the hips and legs alone
in 50,000 exemplars, 0.08 of all joints."""
MAX_SPREAD_DEG = 70.0
"""Angle of a joint's ray from the person's centre: wider, and no camera has seen them whole."""
MAX_OFF_AXIS_DEG = 85.0
"""Angle of the person's centre from the optical axis; at 90 it is in no picture."""


@dataclass(frozen=True)
class LiftingSettings:
    """Constants of lifting.

    σ(library) maximises the probability eq. 4 gives to the candidate that is truly nearest in 3D,
    over held-out people at 0, 5 and 10 px of known noise (``evaluation.calibration``); it is wide:
    the image tells thirty close candidates apart poorly (mean log probability -3.0 to -3.1 for 30
    to 40 px; -3.40 is chance).

    ``shortlist``, ``paper_shortlist``: k of eq. 4 for the two methods; ``neighbours``: ensemble of
    the fusion; ``least_confidence``: joints below it count as missing; ``sigma_library_px``,
    ``sigma_2d_px``: the two parts of eq. 4's σ in standard pixels a coordinate, the latter where
    the 2D's own covariance is unknown; ``far_px``: RMS residual of the best candidate, in standard
    pixels, beyond which a person is ``far_from_library`` (1 in 100 held-out people);
    ``resection_iterations``: Levenberg-Marquardt steps; ``max_outliers``: joints that may be set
    aside as contradicting the rest; ``sigma``: what makes the posterior's spread a radius, None for
    no ``sigma_mm``.
    """

    shortlist: int = 30
    paper_shortlist: int = 10
    neighbours: int = NEIGHBOURS
    least_confidence: float = 0.2
    sigma_library_px: float = 30.0
    sigma_2d_px: float = 6.5
    far_px: float = 35.0
    resection_iterations: int = 3
    max_outliers: int = 2
    fusion: FusionSettings = field(default_factory=FusionSettings)
    sigma: SigmaCalibration | None = FUSION_SIGMA


@dataclass(frozen=True)
class _Wanted:
    """What a call asks for everybody; see :meth:`Lifter.lift`."""

    intrinsics: Intrinsics
    method: Method
    subject_height_mm: float | None
    n_candidates: int
    lap: Callable[[str], None]


@dataclass(frozen=True)
class _Neighbours:
    """What eq. 4 finds for one person, nearest first: (K,), (K,), (K, 14, 3), (K, 3, 3)."""

    entries: Integers
    distances: Floats
    poses_mm: Floats
    rotations: Floats


@dataclass(frozen=True)
class _Matched:
    """One person in the centred view, and what was found for the joints that are relied on.

    ``confidence`` (14,), 0 for joints that are missing or among the ``n_outliers`` set aside;
    ``fused`` is None with the paper's method.
    """

    view: CentredView
    confidence: Floats
    neighbours: _Neighbours
    fused: FusedPose | None
    n_outliers: int


@dataclass(frozen=True)
class _Shortlist:
    """Candidates of one person, most probable first; everything in the centred view."""

    entries: Integers
    distances: Floats
    cameras: Cameras
    probabilities: Floats
    rms_px: float


@dataclass(frozen=True)
class _Answer:
    """The method's answer and the warped exemplar, (14, 3) each; ``sigma_mm`` (14,) of the former.

    In the photo's camera frame.
    """

    joints_mm: Floats
    warped_mm: Floats
    sigma_mm: Floats | None

    def at_height(self, height_mm: float) -> _Answer:
        """Both poses so tall; lengths scaled about the camera centre, so that no image changes."""
        scale = height_mm / float(stature_mm(self.joints_mm))
        return _Answer(
            joints_mm=self.joints_mm * scale,
            warped_mm=self.warped_mm * (height_mm / float(stature_mm(self.warped_mm))),
            sigma_mm=None if self.sigma_mm is None else self.sigma_mm * scale,
        )


class Lifter:
    """Lifts people with one library; immutable and safe to share between threads.

    ``network``: a learned lifter whose answer the fusion observes too, or None.
    """

    def __init__(
        self,
        library: Library,
        settings: LiftingSettings | None = None,
        network: PoseLifter | None = None,
    ) -> None:
        self._library = library
        self._network = network
        self._settings = settings or LiftingSettings()

    def lift(
        self,
        observations: Sequence[Observation],
        intrinsics: Intrinsics,
        *,
        method: Method = "fusion",
        subject_height_mm: float | None = None,
        n_candidates: int = 3,
        lap: Callable[[str], None] | None = None,
    ) -> list[LiftedPerson | NotLiftable]:
        """Lift people seen by one camera.

        Args:
            observations: the people.
            intrinsics: of the photo.
            method: ``paper``: the best of 10 exemplars warped by eq. 6; ``fusion``: the posterior
                mean over a few hundred neighbours.
            subject_height_mm: the people's standing height; scales all lengths about the camera
                centre, which changes no image. None: the library's body size.
            n_candidates: how many hypotheses to return; never changes the answer.
            lap: called with ``match``, ``camera`` or ``warp`` whenever a piece of that stage ends.

        Returns:
            One result per observation, in order.

        """
        wanted = _Wanted(intrinsics, method, subject_height_mm, n_candidates, lap or _no_lap)
        return [self._lift_person(person, wanted) for person in observations]

    def _lift_person(self, person: Observation, wanted: _Wanted) -> LiftedPerson | NotLiftable:
        confidence = np.where(
            person.confidence >= self._settings.least_confidence, person.confidence, 0.0
        )
        cut_off = person.truncated or (confidence == 0).any()
        truncated = ("truncated",) if cut_off else ()
        refusal = _why_not_liftable(person.joints_px, confidence)
        if refusal is not None:
            return NotLiftable(refusal, truncated)
        assumed = ("assumed_focal",) if wanted.intrinsics.source == "assumed" else ()
        matched = self._match(person, confidence, wanted)
        if isinstance(matched, NotLiftable):
            return replace(matched, warnings=(*assumed, *truncated))
        shortlist = self._shortlist(matched)
        wanted.lap("camera")
        warnings = (*assumed, *truncated, *self._doubts(matched, shortlist))
        answer = self._answer(matched, shortlist)
        if wanted.subject_height_mm is not None:
            answer = answer.at_height(wanted.subject_height_mm)
        candidates = self._hypotheses(shortlist, matched, person, wanted)
        answered = (answer.joints_mm, answer.warped_mm, candidates[0].joints_mm)
        if not all((joints_mm[:, 2] > 0).all() for joints_mm in answered):
            return NotLiftable("no pose in front of the camera explains the joints", warnings)
        wanted.lap("warp")
        return LiftedPerson(
            exemplar=candidates[0],
            warped_mm=answer.warped_mm,
            candidates=candidates[: wanted.n_candidates],
            joints_3d_mm=answer.joints_mm,
            sigma_mm=answer.sigma_mm,
            noise_px=None if matched.fused is None else matched.fused.noise_px,
            root_mm=0.5 * (answer.joints_mm[R_HIP] + answer.joints_mm[L_HIP]),
            scale_source="library" if wanted.subject_height_mm is None else "request",
            warnings=warnings,
        )

    def _match(
        self, person: Observation, confidence: Floats, wanted: _Wanted
    ) -> _Matched | NotLiftable:
        """The person's neighbours and their posterior, without joints that contradict the rest."""
        focal_px = wanted.intrinsics.focal_length_px
        centre_px = np.array(wanted.intrinsics.principal_point_px)
        depths = None if person.depths_px is None else person.depths_px / focal_px
        n_outliers = 0
        while True:
            view = centre_view(
                person.joints_px, confidence, person.covariance_px2, focal_px, centre_px
            )
            refusal = _why_not_seen(view)
            if refusal is not None:
                return NotLiftable(refusal)
            neighbours = self._neighbours(view, confidence > 0, wanted.method)
            wanted.lap("match")
            if wanted.method == "paper":
                return _Matched(view, confidence, neighbours, None, n_outliers)
            fused = self._fuse(view, confidence, depths, neighbours)
            wanted.lap("warp")
            matched = _Matched(view, confidence, neighbours, fused, n_outliers)
            if fused.outlier is None or n_outliers == self._settings.max_outliers:
                return matched
            without = confidence.copy()
            without[fused.outlier] = 0.0
            if _why_not_liftable(person.joints_px, without) is not None:
                return matched
            # Its neighbours were found with the contradicting joint: match again without it.
            confidence, n_outliers = without, n_outliers + 1

    def _doubts(self, matched: _Matched, shortlist: _Shortlist) -> tuple[str, ...]:
        """Warnings about the answer itself."""
        doubts = {
            "inconsistent_joints": matched.n_outliers > 0,
            "ambiguous_depth": matched.fused is not None and matched.fused.ambiguous,
            "far_from_library": shortlist.rms_px > self._settings.far_px,
        }
        return tuple(warning for warning, holds in doubts.items() if holds)

    def _answer(self, matched: _Matched, shortlist: _Shortlist) -> _Answer:
        """Eq. 6, or the fusion and the warped exemplar beside it."""
        view, confidence, fused = matched.view, matched.confidence, matched.fused
        best, present = shortlist.cameras.points_mm[0], confidence > 0
        if fused is None:
            warped = view.to_photo(warp_weak_perspective(best, view.points, present))
            return _Answer(warped, warped, None)
        warped = view.to_photo(warp_perspective(best, view.points, present))
        sigma_mm = None
        if self._settings.sigma is not None:
            sigma_mm = self._settings.sigma(fused.spread_mm, fused.noise_px, confidence)
        return _Answer(view.to_photo(fused.joints_mm), warped, sigma_mm)

    def _neighbours(self, view: CentredView, present: Mask, method: Method) -> _Neighbours:
        """Eq. 4's nearest exemplars, of the joints that are present."""
        settings = self._settings
        k = settings.paper_shortlist if method == "paper" else settings.neighbours
        matches = self._library.match(view.points[None], present[None].astype(np.float64), k)
        entries = matches.entries[0]
        return _Neighbours(
            entries=entries,
            distances=matches.distances[0],
            poses_mm=self._library.poses_mm(entries),
            rotations=self._library.rotations(entries),
        )

    def _fuse(
        self,
        view: CentredView,
        confidence: Floats,
        depths: Floats | None,
        neighbours: _Neighbours,
    ) -> FusedPose:
        """The posterior; ``depths`` (14,) as the network takes them, relative to the hips'."""
        weights = (confidence > 0).astype(np.float64)
        ensemble = place_ensemble(
            neighbours.poses_mm,
            neighbours.rotations,
            view.points,
            weights,
            self._settings.fusion.proportion_spread,
        )
        covariance = view.covariance
        if covariance is not None:
            covariance = covariance * ensemble.px_per_unit**2
        learned = None
        if self._network is not None:
            learned = self._network.lift(view.points, confidence, depths)
        return fuse(ensemble, view.points, confidence, covariance, self._settings.fusion, learned)

    def _shortlist(self, matched: _Matched) -> _Shortlist:
        """Eq. 5 for the k nearest, sorted by eq. 4 with M*."""
        view, confidence, neighbours = matched.view, matched.confidence, matched.neighbours
        settings = self._settings
        k = settings.shortlist
        cameras = resect(
            neighbours.poses_mm[:k],
            neighbours.rotations[:k],
            view.points,
            confidence,
            iterations=settings.resection_iterations,
        )
        px = standard_px_per_unit(
            float(np.sort(cameras.translation_mm[:, 2])[len(cameras.translation_mm) // 2])
        )
        residuals = px * cameras.residuals
        if view.covariance is None:
            covariance = np.broadcast_to(settings.sigma_2d_px**2 * np.eye(2), (14, 2, 2))
        else:
            covariance = px**2 * view.covariance
        probabilities = shortlist_probabilities(
            residuals, confidence, covariance, settings.sigma_library_px
        )
        order = np.argsort(-probabilities, kind="stable")
        squared = (residuals[order[0]] ** 2).sum(-1)
        return _Shortlist(
            entries=neighbours.entries[:k][order],
            distances=neighbours.distances[:k][order],
            cameras=Cameras(
                cameras.rotation[order],
                cameras.translation_mm[order],
                cameras.points_mm[order],
                cameras.residuals[order],
            ),
            probabilities=probabilities[order],
            rms_px=float(np.sqrt((confidence * squared).sum() / confidence.sum())),
        )

    def _hypotheses(
        self,
        shortlist: _Shortlist,
        matched: _Matched,
        person: Observation,
        wanted: _Wanted,
    ) -> tuple[Hypothesis, ...]:
        """The most probable candidates in the photo's camera frame, at least one."""
        view, cameras, intrinsics = matched.view, shortlist.cameras, wanted.intrinsics
        present = matched.confidence > 0
        n = max(wanted.n_candidates, 1)
        joints = view.to_photo(cameras.points_mm[:n])
        # One product a candidate, so that the bytes do not depend on how many there are.
        translations = view.to_photo(cameras.translation_mm[:n, None])[:, 0]
        rotations = view.rotation.T @ cameras.rotation[:n]
        pixels = project(
            joints[:, present], intrinsics.focal_length_px, np.array(intrinsics.principal_point_px)
        )
        errors = np.sqrt(((pixels - person.joints_px[present]) ** 2).sum(-1).mean(-1))
        scale = np.ones(len(joints))
        if wanted.subject_height_mm is not None:
            scale = wanted.subject_height_mm / stature_mm(joints)
            joints, translations = scale[:, None, None] * joints, scale[:, None] * translations
        return tuple(
            Hypothesis(
                entry=entry,
                exemplar_id=self._library.exemplar_id(entry),
                source=self._library.source(entry),
                probability=float(shortlist.probabilities[rank]),
                distance=float(shortlist.distances[rank]),
                reprojection_error_px=float(errors[rank]),
                rotation=rotations[rank],
                translation_mm=translations[rank],
                scale=float(scale[rank]),
                joints_mm=joints[rank],
            )
            for rank, entry in enumerate(shortlist.entries[:n].tolist())
        )


def _no_lap(_: str) -> None:
    """Nobody measures."""


def _why_not_liftable(joints_px: Floats, confidence: Floats) -> str | None:
    """Why joints of these confidences do not determine a pose, or None if they do."""
    present = confidence > 0
    n = int(np.count_nonzero(present))
    if n < MIN_JOINTS:
        joints = "joint is" if n == 1 else "joints are"
        return f"{n} {joints} visible; at least {MIN_JOINTS} are needed"
    if np.count_nonzero(present[_TRUNK_JOINTS]) < MIN_TRUNK_JOINTS:
        return (
            f"fewer than {MIN_TRUNK_JOINTS} of neck, shoulders and hips are visible: "
            "limbs alone do not place a body"
        )
    seen = joints_px[present]
    if (seen.max(axis=0) - seen.min(axis=0)).max() < MIN_EXTENT_PX:
        return f"the joints lie within {MIN_EXTENT_PX:g} pixels of each other"
    centred = seen - seen.sum(axis=0) / n
    # Of the scatter, whose eigenvalues are along² and across².
    (xx, xy), (_, yy) = (centred.T @ centred).tolist()
    along2 = 0.5 * (xx + yy + math.hypot(xx - yy, 2.0 * xy))
    if xx * yy - xy * xy < (MIN_BREADTH * along2) ** 2:
        return "the joints lie on one line: nobody is seen as thin as that"
    return None


def _why_not_seen(view: CentredView) -> str | None:
    """Why no camera sees somebody like that, or None if one may: a wrong focal length, mostly."""
    remedy = "check the focal length, which is in pixels of this photo"
    off_axis = view.rotation[2, 2] < math.cos(math.radians(MAX_OFF_AXIS_DEG))
    if off_axis:
        return (
            f"the person is more than {MAX_OFF_AXIS_DEG:g} degrees off the optical axis; {remedy}"
        )
    if (view.points**2).sum(1).max() > math.tan(math.radians(MAX_SPREAD_DEG)) ** 2:
        return f"the joints span more than {MAX_SPREAD_DEG:g} degrees from their centre; {remedy}"
    return None
