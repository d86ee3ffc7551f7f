"""Photo -> people -> 2D joints -> 3D, as frozen dataclasses in and out.

Pixels are those of the upright full-size photo as the client sent it, also when it was decoded at
a reduced scale or is mirrored; millimetres are in that photo's camera frame (OpenCV axes).
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
import numpy.typing as npt

from app.errors import InvalidInputError, LibraryUnavailableError
from app.imaging import Photo, decode_photo
from app.lifting.lifter import Lifter
from app.lifting.types import (
    Hypothesis,
    Intrinsics,
    LiftedPerson,
    Method,
    NotLiftable,
    Observation,
)
from library_store.errors import IndexUnavailableError
from models.heatmaps import Joints2D
from models.person_detector import PersonBox
from models.presence import present
from models.truncation import beyond_edge

Floats = npt.NDArray[np.float64]

ASSUMED_FOV_DEG = 55.0
"""Field of view over the longer side when neither the client nor EXIF states one."""

_REFLECT_X = np.diag([-1.0, 1.0, 1.0])


class Detector(Protocol):
    """Finds people: (H, W, 3) uint8 BGR -> boxes around their joints, best first."""

    def detect(self, image: npt.NDArray[np.uint8], max_people: int) -> list[PersonBox]:
        """At most ``max_people`` boxes in the image's pixels."""
        ...

    def detect_close(self, image: npt.NDArray[np.uint8], max_people: int) -> list[PersonBox]:
        """The same of people who fill the photo, for photos in which ``detect`` led to nobody."""
        ...


class Estimator(Protocol):
    """Finds joints: (H, W, 3) uint8 BGR and boxes -> 2D joints with their uncertainty."""

    def estimate(self, image: npt.NDArray[np.uint8], boxes: Sequence[PersonBox]) -> list[Joints2D]:
        """One ``Joints2D`` per box in the image's pixels."""
        ...


@dataclass(frozen=True)
class PhotoQuery:
    """What the client asks of a photo; see POST /v1/poses."""

    max_people: int = 5
    candidates: int = 3
    method: Method = "fusion"
    box_px: tuple[float, float, float, float] | None = None
    focal_length_px: float | None = None
    fov_deg: float | None = None
    subject_height_mm: float | None = None
    mirrored: bool = False


@dataclass(frozen=True)
class LiftQuery:
    """2D joints to lift.

    ``joints_px`` (P, 14, 2) px; ``confidence`` (P, 14) in [0, 1], 0 for missing joints.
    """

    width_px: int
    height_px: int
    joints_px: Floats
    confidence: Floats
    focal_length_px: float | None = None
    principal_point_px: tuple[float, float] | None = None
    candidates: int = 3
    method: Method = "fusion"
    subject_height_mm: float | None = None


@dataclass(frozen=True)
class SeenPerson:
    """One person as answered.

    ``box_px`` x, y, width, height; ``joints_px`` (14, 2); ``present`` (14,) bool, False for joints
    the client did not give; ``confidence`` and ``sigma_px`` (14,), or None where not calibrated.
    """

    box_px: tuple[float, float, float, float]
    score: float | None
    joints_px: Floats
    present: npt.NDArray[np.bool_]
    confidence: Floats | None
    sigma_px: Floats | None
    lifted: LiftedPerson | NotLiftable


@dataclass(frozen=True)
class PhotoResult:
    """Everything found in one photo; ``timings_ms`` by stage."""

    width_px: int
    height_px: int
    orientation: int
    intrinsics: Intrinsics
    people: tuple[SeenPerson, ...]
    timings_ms: dict[str, float]


@dataclass(frozen=True)
class LiftResult:
    """Everybody whose joints were given, in order; ``timings_ms`` by stage."""

    intrinsics: Intrinsics
    people: tuple[SeenPerson, ...]
    timings_ms: dict[str, float]


@dataclass
class StageClock:
    """Measures the stages of one request in milliseconds, by default of wall time."""

    now_s: Callable[[], float] = time.perf_counter
    timings_ms: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._since_s = self.now_s()

    def lap(self, stage: str) -> None:
        """End ``stage``, which began with the lap before; a stage's laps add up."""
        now_s = self.now_s()
        spent_ms = 1e3 * (now_s - self._since_s)
        self.timings_ms[stage] = self.timings_ms.get(stage, 0.0) + spent_ms
        self._since_s = now_s


def intrinsics_of(
    width_px: int,
    height_px: int,
    *,
    focal_length_px: float | None = None,
    fov_deg: float | None = None,
    exif_focal_length_px: float | None = None,
    principal_point_px: tuple[float, float] | None = None,
) -> Intrinsics:
    """The pinhole of a photo: what the client states, else EXIF, else 55 degrees.

    ``fov_deg`` spans the longer side; the principal point defaults to the centre.
    """
    centre = principal_point_px or ((width_px - 1) / 2, (height_px - 1) / 2)
    if focal_length_px is not None:
        return Intrinsics(focal_length_px, centre, "request")
    if fov_deg is not None:
        return Intrinsics(_focal_of_fov(width_px, height_px, fov_deg), centre, "request")
    if exif_focal_length_px is not None:
        return Intrinsics(exif_focal_length_px, centre, "exif")
    return Intrinsics(_focal_of_fov(width_px, height_px, ASSUMED_FOV_DEG), centre, "assumed")


def _focal_of_fov(width_px: int, height_px: int, fov_deg: float) -> float:
    return max(width_px, height_px) / (2.0 * math.tan(math.radians(fov_deg) / 2.0))


class Pipeline:
    """The whole computation of a request; safe to call from several threads at once."""

    def __init__(
        self,
        detector: Detector,
        estimator: Estimator,
        lifter: Lifter,
        *,
        max_pixels: int,
        decode_side_px: int,
    ) -> None:
        self._detector = detector
        self._estimator = estimator
        self._lifter = lifter
        self._max_pixels = max_pixels
        self._decode_side_px = decode_side_px

    def estimate(
        self, data: bytes, query: PhotoQuery, clock: StageClock | None = None
    ) -> PhotoResult:
        """Answer ``query`` about the photo in ``data`` (JPEG, PNG, WebP; HEIC with its extra).

        Raises the ``RequestError``s of ``app.imaging.decode_photo``, and ``InvalidInputError`` when
        the box lies outside the photo.
        """
        clock = StageClock() if clock is None else clock
        photo = decode_photo(
            data,
            max_pixels=self._max_pixels,
            side_px=self._decode_side_px,
            box_px=query.box_px,
        )
        seen = photo.mirrored() if query.mirrored else photo
        intrinsics = intrinsics_of(
            photo.width_px,
            photo.height_px,
            focal_length_px=query.focal_length_px,
            fov_deg=query.fov_deg,
            exif_focal_length_px=photo.exif_focal_length_px,
        )
        clock.lap("decode")
        boxes, joints = self._find(seen, query, clock)
        observations = [
            Observation(
                joints_px=found.positions_px,
                confidence=found.belief,
                covariance_px2=found.covariance_px2,
                depths_px=found.depths_px,
                truncated=bool(
                    beyond_edge(found.positions_px, photo.width_px, photo.height_px).any()
                ),
            )
            for found in joints
        ]
        lifted = self._lift(observations, intrinsics, query, clock)
        people = tuple(
            SeenPerson(
                box_px=_box_to_image(box, seen),
                score=None if query.box_px else box.score,
                joints_px=found.positions_px,
                present=np.ones(len(found.positions_px), bool),
                confidence=found.confidence,
                sigma_px=found.sigma_px,
                lifted=person,
            )
            for box, found, person in zip(boxes, joints, lifted, strict=True)
        )
        if query.mirrored:
            people = tuple(_mirror(person, photo.width_px) for person in people)
        return PhotoResult(
            width_px=photo.width_px,
            height_px=photo.height_px,
            orientation=photo.orientation,
            intrinsics=intrinsics,
            people=people,
            timings_ms=clock.timings_ms,
        )

    def lift(self, query: LiftQuery) -> LiftResult:
        """Lift given 2D joints."""
        clock = StageClock()
        intrinsics = intrinsics_of(
            query.width_px,
            query.height_px,
            focal_length_px=query.focal_length_px,
            principal_point_px=query.principal_point_px,
        )
        observations = [
            Observation(joints_px=joints, confidence=confidence, covariance_px2=None)
            for joints, confidence in zip(query.joints_px, query.confidence, strict=True)
        ]
        lifted = self._lift(observations, intrinsics, query, clock)
        people = tuple(
            SeenPerson(
                box_px=_extent(seen.joints_px[seen.confidence > 0]),
                score=None,
                joints_px=seen.joints_px,
                present=seen.confidence > 0,
                confidence=seen.confidence,
                sigma_px=None,
                lifted=person,
            )
            for seen, person in zip(observations, lifted, strict=True)
        )
        return LiftResult(intrinsics, people, clock.timings_ms)

    def _lift(
        self,
        observations: Sequence[Observation],
        intrinsics: Intrinsics,
        query: PhotoQuery | LiftQuery,
        clock: StageClock,
    ) -> list[LiftedPerson | NotLiftable]:
        if not observations:
            return []
        for stage in ("match", "camera", "warp"):
            clock.timings_ms[stage] = 0.0  # in the order of the contract, whatever comes first
        try:
            return self._lifter.lift(
                observations,
                intrinsics,
                method=query.method,
                subject_height_mm=query.subject_height_mm,
                n_candidates=query.candidates,
                lap=clock.lap,
            )
        except IndexUnavailableError as error:
            raise LibraryUnavailableError(error.retry_after_s) from error

    def _find(
        self, seen: Photo, query: PhotoQuery, clock: StageClock
    ) -> tuple[list[PersonBox], list[Joints2D]]:
        """Whom to answer, in the decoded photo's pixels, and their joints in full-size pixels.

        Where there is nobody, who fills the photo is looked for.
        """
        boxes = self._boxes(seen, query)
        clock.lap("detect")
        boxes, joints = self._people(seen, boxes, query)
        clock.lap("pose")
        if not boxes:
            boxes = self._detector.detect_close(seen.pixels_bgr, 2 * query.max_people)
            clock.lap("detect")
            boxes, joints = self._people(seen, boxes, query)
        joints = [_to_image(found, seen) for found in joints]
        clock.lap("pose")
        return boxes, joints

    def _boxes(self, seen: Photo, query: PhotoQuery) -> list[PersonBox]:
        """The people to look at, in the decoded photo's own pixels."""
        if query.box_px is None:
            # Some may turn out to be nobody.
            return self._detector.detect(seen.pixels_bgr, 2 * query.max_people)
        x, y, width, height = query.box_px
        if x >= seen.width_px or y >= seen.height_px or x + width <= 0 or y + height <= 0:
            raise InvalidInputError(
                [("box_px", f"lies outside the {seen.width_px} x {seen.height_px} photo")]
            )
        if query.mirrored:
            x = seen.width_px - 1 - x - width
        return [
            PersonBox(
                x_px=(x - seen.offset_px[0]) / seen.reduction,
                y_px=(y - seen.offset_px[1]) / seen.reduction,
                width_px=width / seen.reduction,
                height_px=height / seen.reduction,
                score=1.0,
            )
        ]

    def _people(
        self, seen: Photo, boxes: list[PersonBox], query: PhotoQuery
    ) -> tuple[list[PersonBox], list[Joints2D]]:
        """Whom to answer, and their joints: the first ``max_people`` boxes that show somebody."""
        if query.box_px is not None:
            return boxes, self._estimator.estimate(seen.pixels_bgr, boxes)
        joints: list[Joints2D] = []
        kept: list[int] = []
        while len(kept) < query.max_people and len(joints) < len(boxes):
            more = boxes[len(joints) :][: query.max_people - len(kept)]
            joints += self._estimator.estimate(seen.pixels_bgr, more)
            kept = present(boxes[: len(joints)], joints)
        return [boxes[i] for i in kept], [joints[i] for i in kept]


def _to_image(joints: Joints2D, photo: Photo) -> Joints2D:
    """Joints in the decoded photo's pixels -> full-size pixels."""
    return replace(
        joints,
        positions_px=joints.positions_px * photo.reduction + np.array(photo.offset_px),
        covariance_px2=joints.covariance_px2 * photo.reduction**2,
        sigma_px=None if joints.sigma_px is None else joints.sigma_px * photo.reduction,
        depths_px=None if joints.depths_px is None else joints.depths_px * photo.reduction,
    )


def _box_to_image(box: PersonBox, photo: Photo) -> tuple[float, float, float, float]:
    return (
        box.x_px * photo.reduction + photo.offset_px[0],
        box.y_px * photo.reduction + photo.offset_px[1],
        box.width_px * photo.reduction,
        box.height_px * photo.reduction,
    )


def _extent(points_px: Floats) -> tuple[float, float, float, float]:
    if len(points_px) == 0:
        return (0.0, 0.0, 0.0, 0.0)
    x, y = points_px.min(axis=0)
    width, height = np.ptp(points_px, axis=0)
    return (float(x), float(y), float(width), float(height))


def _mirror(person: SeenPerson, width_px: int) -> SeenPerson:
    """From the photo as it was looked at back to the photo as given: x -> width - 1 - x.

    The joints keep their names, which are right for the person; the 3D is reflected with the
    picture, so that it still projects onto the joints.
    """
    x, y, width, height = person.box_px
    joints = person.joints_px.copy()
    joints[:, 0] = width_px - 1 - joints[:, 0]
    lifted = person.lifted
    if isinstance(lifted, LiftedPerson):
        lifted = replace(
            lifted,
            exemplar=_reflect(lifted.exemplar),
            warped_mm=lifted.warped_mm @ _REFLECT_X,
            candidates=tuple(_reflect(candidate) for candidate in lifted.candidates),
            joints_3d_mm=lifted.joints_3d_mm @ _REFLECT_X,
            root_mm=lifted.root_mm @ _REFLECT_X,
        )
    return replace(
        person, box_px=(width_px - 1 - x - width, y, width, height), joints_px=joints, lifted=lifted
    )


def _reflect(hypothesis: Hypothesis) -> Hypothesis:
    return replace(
        hypothesis,
        rotation=_REFLECT_X @ hypothesis.rotation,
        translation_mm=_REFLECT_X @ hypothesis.translation_mm,
        joints_mm=hypothesis.joints_mm @ _REFLECT_X,
    )
