"""From the pipeline's results to the JSON contract, rounded to what the numbers can mean."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from app import schemas
from app.engine import Engine
from app.lifting.types import Hypothesis, Intrinsics, LiftedPerson, Method
from app.pipeline import LiftResult, PhotoResult, SeenPerson
from library_store.library import Library, Source
from library_store.skeleton import LSP14

Floats = npt.NDArray[np.float64]

LENGTH_DIGITS = 3
"""Decimals of pixels and millimetres."""
RATIO_DIGITS = 6
"""Decimals of probabilities and distances."""
ROTATION_DIGITS = 9
TIMING_DIGITS = 3

SKELETON = schemas.Skeleton(name=LSP14.name, joint_names=LSP14.joint_names, edges=LSP14.edges)


def model_of(engine: Engine) -> schemas.Model:
    """The pose network served."""
    card = engine.card
    return schemas.Model(name=card.name, version=card.version, sha256=card.sha256)


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
    engine: Engine, result: PhotoResult, method: Method, request_id: str
) -> schemas.PosesAnswer:
    """The answer to POST /v1/poses, without the total time."""
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
        skeleton=SKELETON,
        people=tuple(_person(person, result.intrinsics) for person in result.people),
        timings_ms=rounded_timings(result.timings_ms),
    )


def lift_answer(
    engine: Engine, result: LiftResult, method: Method, request_id: str
) -> schemas.LiftAnswer:
    """The answer to POST /v1/lift, without the total time."""
    return schemas.LiftAnswer(
        request_id=request_id,
        method=method,
        library=library_of(engine.library),
        skeleton=SKELETON,
        people=tuple(_person(person, result.intrinsics) for person in result.people),
        timings_ms=rounded_timings(result.timings_ms),
    )


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
        joints_mm=_rows(library.poses_mm(entries)[0]),
        rotation=_matrix(rotation[0]),
        translation_mm=_vector(translation_mm[0]),
    )


def rounded_timings(timings_ms: Mapping[str, float]) -> dict[str, float]:
    """Milliseconds to the microsecond."""
    return {stage: round(spent, TIMING_DIGITS) for stage, spent in timings_ms.items()}


def _person(person: SeenPerson, intrinsics: Intrinsics) -> schemas.Person:
    n_joints = LSP14.n_joints
    confidence = [None] * n_joints if person.confidence is None else _list(person.confidence)
    sigma_px = [None] * n_joints if person.sigma_px is None else _list(person.sigma_px)
    seen = {
        "box_px": tuple(round(value, LENGTH_DIGITS) for value in person.box_px),
        "score": None if person.score is None else round(person.score, RATIO_DIGITS),
        "joints_2d": tuple(
            schemas.Joint2D(name=name, x_px=x, y_px=y, confidence=c, sigma_px=s)
            for name, (x, y), c, s, present in zip(
                LSP14.joint_names,
                np.round(person.joints_px, LENGTH_DIGITS).tolist(),
                confidence,
                sigma_px,
                person.present,
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
    sigma_mm = [None] * n_joints if lifted.sigma_mm is None else _list(lifted.sigma_mm)
    return schemas.Person(
        **seen,
        exemplar=schemas.Exemplar(
            id=best.exemplar_id,
            probability=round(best.probability, RATIO_DIGITS),
            distance=round(best.distance, RATIO_DIGITS),
            source=_source(best.source),
            joints_mm=_rows(best.joints_mm),
            warped_mm=_rows(lifted.warped_mm),
        ),
        candidates=tuple(_candidate(candidate) for candidate in lifted.candidates),
        camera=schemas.Camera(
            focal_length_px=round(intrinsics.focal_length_px, LENGTH_DIGITS),
            principal_point_px=intrinsics.principal_point_px,
            focal_source=intrinsics.source,
            rotation=_matrix(best.rotation),
            translation_mm=_vector(best.translation_mm),
            reprojection_error_px=round(best.reprojection_error_px, LENGTH_DIGITS),
        ),
        joints_3d=tuple(
            schemas.Joint3D(name=name, x_mm=x, y_mm=y, z_mm=z, sigma_mm=sigma)
            for name, (x, y, z), sigma in zip(
                LSP14.joint_names, _rows(lifted.joints_3d_mm), sigma_mm, strict=True
            )
        ),
        root_mm=_vector(lifted.root_mm),
        scale_source=lifted.scale_source,
        warnings=lifted.warnings,
    )


def _candidate(hypothesis: Hypothesis) -> schemas.Candidate:
    return schemas.Candidate(
        id=hypothesis.exemplar_id,
        probability=round(hypothesis.probability, RATIO_DIGITS),
        reprojection_error_px=round(hypothesis.reprojection_error_px, LENGTH_DIGITS),
        joints_mm=_rows(hypothesis.joints_mm),
    )


def _source(source: Source) -> schemas.Source:
    if source.kind == "mocap":
        return schemas.MocapSource(clip=str(source.clip), frame=int(source.frame or 0))
    return schemas.SampledSource(prior=str(source.prior), index=int(source.index or 0))


def _list(values: Floats) -> list[float]:
    rounded: list[float] = np.round(values, LENGTH_DIGITS).tolist()
    return rounded


def _vector(values: Floats) -> schemas.Vector3:
    x, y, z = _list(values)
    return x, y, z


def _rows(points: Floats) -> schemas.Pose:
    # Adding 0.0 turns -0.0 into 0.0: one text per number.
    return tuple(map(tuple, (np.round(points, LENGTH_DIGITS) + 0.0).tolist()))


def _matrix(rotation: Floats) -> schemas.Matrix3:
    a, b, c = (np.round(rotation, ROTATION_DIGITS) + 0.0).tolist()
    return tuple(a), tuple(b), tuple(c)
