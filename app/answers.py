"""From the pipeline's results to the JSON contract, rounded to what the numbers can mean."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from app import schemas
from app.engine import Engine
from app.lifting.types import Hypothesis, Intrinsics, LiftedPerson, Method
from app.pipeline import LiftResult, PhotoResult, SeenPerson
from library_store.conversion import CONVERSIONS
from library_store.library import Library
from library_store.manifest import Licence
from library_store.skeleton import LSP14
from library_store.sources import Source

Floats = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]
Answer = TypeVar("Answer", schemas.PosesAnswer, schemas.LiftAnswer)

LENGTH_DIGITS = 3
"""Decimals of pixels and millimetres."""
RATIO_DIGITS = 6
"""Decimals of probabilities and distances."""
ROTATION_DIGITS = 9
TIMING_DIGITS = 3

SKELETON = schemas.Skeleton(name=LSP14.name, joint_names=LSP14.joint_names, edges=LSP14.edges)


@dataclass(frozen=True)
class Wording:
    """The skeleton that an answer is given in: (N, 14) ``weights`` of the lsp14 joints.

    ``known`` (N,) are the joints that lsp14 determines; the others' coordinates are nan.
    """

    skeleton: schemas.Skeleton
    weights: Floats
    known: Bools

    def points(self, joints: Floats) -> Floats:
        """(14, D) -> (N, D)."""
        placed: Floats = self.weights @ joints
        return placed

    def sigma(self, sigma: Floats | None) -> list[float] | list[None]:
        """68% radii (14,) -> (N,): of a mean of joints at most the mean of theirs."""
        if sigma is None:
            return [None] * len(self.weights)
        return _list(self.weights @ sigma)

    def confidence(self, confidence: Floats | None) -> list[float] | list[None]:
        """(14,) -> (N,): a mean of joints is as sure as the least sure of them."""
        if confidence is None:
            return [None] * len(self.weights)
        return _list(np.where(self.weights > 0, confidence, np.inf).min(axis=1))

    def present(self, present: Bools) -> Bools:
        """(14,) -> (N,): known, and made of joints that are all there."""
        complete: Bools = self.known & (present | ~(self.weights > 0)).all(axis=1)
        return complete


@cache
def wording_in(name: schemas.AnswerSkeleton) -> Wording:
    """The wording in the skeleton of that name."""
    conversion = CONVERSIONS[name]
    skeleton = schemas.Skeleton(
        name=conversion.skeleton.name,
        joint_names=conversion.skeleton.joint_names,
        edges=conversion.skeleton.edges,
    )
    weights = conversion.from_lsp14
    return Wording(skeleton, weights, known=np.array(np.isfinite(weights).all(axis=1)))


def model_of(engine: Engine) -> schemas.Model:
    """The pose network served."""
    card = engine.card
    return schemas.Model(name=card.name, version=card.version, sha256=card.sha256)


def networks_of(engine: Engine) -> tuple[schemas.Network, ...]:
    """The networks in service and what runs them."""
    return tuple(
        schemas.Network(
            kind=network.card.output.kind,
            name=network.card.name,
            version=network.card.version,
            sha256=network.card.sha256,
            provider=network.runtime.provider,
            precision=network.runtime.precision,
            parameters=network.card.parameters,
            gflop=round(network.card.gflop, 3),
            input_px=network.card.output.side_px,
        )
        for network in engine.networks
    )


def library_of(library: Library) -> schemas.LibraryRef:
    """The library served."""
    manifest = library.manifest
    return schemas.LibraryRef(
        name=manifest.name,
        version=manifest.version,
        exemplars=manifest.n_exemplars,
        sha256=manifest.sha256,
    )


def poses_answer(
    engine: Engine,
    result: PhotoResult,
    method: Method,
    request_id: str,
    skeleton: schemas.AnswerSkeleton = "lsp14",
) -> schemas.PosesAnswer:
    """The answer to POST /v1/poses, without ``wait`` and ``total`` (:func:`timed` adds them)."""
    wording = wording_in(skeleton)
    return schemas.PosesAnswer(
        request_id=request_id,
        method=method,
        model=model_of(engine),
        library=library_of(engine.library),
        image=schemas.Image(
            width_px=result.width_px,
            height_px=result.height_px,
            orientation_applied=result.orientation,
        ),
        skeleton=wording.skeleton,
        people=tuple(_person(person, result.intrinsics, wording) for person in result.people),
        timings_ms=_rounded(result.timings_ms),
    )


def lift_answer(
    engine: Engine,
    result: LiftResult,
    method: Method,
    request_id: str,
    skeleton: schemas.AnswerSkeleton = "lsp14",
) -> schemas.LiftAnswer:
    """The answer to POST /v1/lift, without ``wait`` and ``total`` (:func:`timed` adds them)."""
    wording = wording_in(skeleton)
    return schemas.LiftAnswer(
        request_id=request_id,
        method=method,
        library=library_of(engine.library),
        skeleton=wording.skeleton,
        people=tuple(_person(person, result.intrinsics, wording) for person in result.people),
        timings_ms=_rounded(result.timings_ms),
    )


def licence_of(licence: Licence) -> schemas.Licence:
    """One of the licences of a library's sources."""
    return schemas.Licence(source=licence.source, licence=licence.licence, credit=licence.credit)


def exemplar_answer(library: Library, exemplar_id: str) -> schemas.ExemplarAnswer:
    """One exemplar; ``KeyError`` when the library has none of that id."""
    entry = library.find(exemplar_id)
    entries = np.array([entry])
    rotation, translation_mm = library.cameras(entries)
    return schemas.ExemplarAnswer(
        id=exemplar_id,
        library=library_of(library),
        skeleton=SKELETON,
        source=_source(library.source(entry)),
        licences=tuple(licence_of(licence) for licence in library.licences(entry)),
        joints_mm=_rows(library.poses_mm(entries)[0]),
        rotation=_matrix(rotation[0]),
        translation_mm=_vector(translation_mm[0]),
    )


def timed(compute: Callable[[], Answer], since_s: float) -> tuple[Answer, bytes]:
    """What ``compute`` answers, with ``wait`` and ``total`` among its timings; and as JSON.

    Both count from ``since_s`` (``time.monotonic`` seconds); the wait ends where this is called.
    """
    wait_ms = 1e3 * (time.monotonic() - since_s)
    answer = compute()
    total_ms = 1e3 * (time.monotonic() - since_s)
    timings_ms = {"wait": wait_ms} | answer.timings_ms | {"total": total_ms}
    answer = answer.model_copy(update={"timings_ms": _rounded(timings_ms)})
    return answer, answer.model_dump_json().encode()


def _rounded(timings_ms: Mapping[str, float]) -> dict[str, float]:
    """Milliseconds to the microsecond."""
    return {stage: round(spent, TIMING_DIGITS) for stage, spent in timings_ms.items()}


def _person(person: SeenPerson, intrinsics: Intrinsics, wording: Wording) -> schemas.Person:
    names = wording.skeleton.joint_names
    seen = {
        "box_px": tuple(_list(np.array(person.box_px))),
        "score": None if person.score is None else round(person.score, RATIO_DIGITS),
        "joints_2d": tuple(
            schemas.Joint2D(name=name, x_px=x, y_px=y, confidence=c, sigma_px=s)
            for name, (x, y), c, s, present in zip(
                names,
                (np.round(wording.points(person.joints_px), LENGTH_DIGITS) + 0.0).tolist(),
                wording.confidence(person.confidence),
                wording.sigma(person.sigma_px),
                wording.present(person.present),
                strict=True,
            )
            if present
        ),
    }
    lifted = person.lifted
    if not isinstance(lifted, LiftedPerson):
        return schemas.Person(
            **seen,
            exemplar=None,
            candidates=(),
            camera=None,
            joints_3d=None,
            root_mm=None,
            scale_source=None,
            warnings=(*lifted.warnings, lifted.reason),
        )
    best = lifted.exemplar
    rows = _rows(wording.points(lifted.joints_3d_mm))
    return schemas.Person(
        **seen,
        exemplar=schemas.Exemplar(
            id=best.exemplar_id,
            probability=round(best.probability, RATIO_DIGITS),
            distance=round(best.distance, RATIO_DIGITS),
            source=_source(best.source),
            joints_mm=_rows(wording.points(best.joints_mm)),
            warped_mm=_rows(wording.points(lifted.warped_mm)),
        ),
        candidates=tuple(_candidate(candidate, wording) for candidate in lifted.candidates),
        camera=schemas.Camera(
            focal_length_px=round(intrinsics.focal_length_px, LENGTH_DIGITS),
            principal_point_px=intrinsics.principal_point_px,
            focal_source=intrinsics.source,
            rotation=_matrix(best.rotation),
            translation_mm=_vector(best.translation_mm),
            scale=round(best.scale, RATIO_DIGITS),
            reprojection_error_px=round(best.reprojection_error_px, LENGTH_DIGITS),
        ),
        joints_3d=tuple(
            schemas.Joint3D(name=name, x_mm=row[0], y_mm=row[1], z_mm=row[2], sigma_mm=sigma)
            for name, row, sigma in zip(names, rows, wording.sigma(lifted.sigma_mm), strict=True)
            if row is not None
        ),
        root_mm=_vector(lifted.root_mm),
        scale_source=lifted.scale_source,
        warnings=lifted.warnings,
    )


def _candidate(hypothesis: Hypothesis, wording: Wording) -> schemas.Candidate:
    return schemas.Candidate(
        id=hypothesis.exemplar_id,
        probability=round(hypothesis.probability, RATIO_DIGITS),
        reprojection_error_px=round(hypothesis.reprojection_error_px, LENGTH_DIGITS),
        joints_mm=_rows(wording.points(hypothesis.joints_mm)),
    )


def _source(source: Source) -> schemas.Source:
    if source.kind == "mocap":
        return schemas.MocapSource(
            clip=str(source.clip),
            frame=int(source.frame or 0),
            mirrored=source.mirrored,
            subject=source.subject,
            action=source.action,
        )
    if source.kind == "composed":
        return schemas.ComposedSource(
            index=int(source.index or 0),
            parts=tuple(
                schemas.SourcePart(
                    part=part.name, clip=part.clip, frame=part.frame, mirrored=part.mirrored
                )
                for part in source.parts
            ),
        )
    return schemas.SampledSource(prior=str(source.prior), index=int(source.index or 0))


def _list(values: Floats) -> list[float]:
    # Adding 0.0 turns -0.0 into 0.0: one text per number.
    rounded: list[float] = (np.round(values, LENGTH_DIGITS) + 0.0).tolist()
    return rounded


def _vector(values: Floats) -> schemas.Vector3:
    x, y, z = _list(values)
    return x, y, z


def _rows(points: Floats) -> schemas.Pose:
    rows = (np.round(points, LENGTH_DIGITS) + 0.0).tolist()
    return tuple(tuple(row) if row[0] == row[0] else None for row in rows)  # nan is not itself


def _matrix(rotation: Floats) -> schemas.Matrix3:
    a, b, c = (np.round(rotation, ROTATION_DIGITS) + 0.0).tolist()
    return tuple(a), tuple(b), tuple(c)
