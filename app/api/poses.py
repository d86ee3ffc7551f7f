"""POST /v1/poses and /v1/poses/batch: a photo in, everybody's 2D and 3D pose out."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Sequence
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Query, Request, Response
from pydantic import Field, ValidationInfo, field_validator

from app import schemas
from app.admission import Arrival, ClientGoneError
from app.answers import poses_answer, timed
from app.api.bodies import (
    Part,
    WatchedArrival,
    image_parts,
    is_multipart,
    photo_bytes,
    read_body,
)
from app.api.deps import EngineDep, Service, ServiceDep, authorise, each_once
from app.api.problems import describe, describe_ok, problem_of
from app.engine import MAX_PEOPLE, Engine
from app.errors import (
    BodyTooLargeError,
    EmptyBodyError,
    InvalidInputError,
    MalformedBodyError,
    RequestError,
)
from app.imaging import KNOWN_TYPES
from app.pipeline import PhotoQuery

router = APIRouter(tags=["poses"], dependencies=[Depends(authorise), Depends(each_once)])


class PoseParameters(schemas.Given):
    """What to do with a photo."""

    max_people: int = Field(
        5, ge=1, le=MAX_PEOPLE, description="Most people to answer: the surest, most certain first."
    )
    candidates: schemas.Candidates = Field(
        3,
        description="How many of the shortlist (30; 10 with `method=paper`) to return at most; "
        "never changes the answer.",
    )
    method: schemas.Method = Field(
        "fusion", description="`paper` is the method of Chen & Ramanan (2017) to the letter."
    )
    skeleton: schemas.AnswerSkeleton = Field(
        "lsp14",
        description="In whose joints to answer. Joints that lsp14 does not give are left out of "
        "lists by name and null in `joints_mm`.",
    )
    box_px: str | None = Field(
        None,
        description="`x,y,w,h`: the extent of the one person to look at; skips detection.",
        examples=["160,27,312,436"],
    )
    focal_length_px: schemas.FocalLengthPx | None = Field(
        None, description="Focal length in pixels of the photo as sent. Excludes fov_deg."
    )
    fov_deg: float | None = Field(
        None,
        ge=5,
        le=170,
        allow_inf_nan=False,
        description="Field of view over the longer side. Excludes focal_length_px.",
    )
    subject_height_mm: schemas.SubjectHeightMm | None = Field(
        None, description="How tall the person is; fixes the scale, else the library's people do."
    )
    mirrored: bool = Field(
        False,
        description="The photo is a mirror image (a selfie): left and right are told apart on the "
        "flipped photo; the answer is in the pixels given.",
    )

    @field_validator("box_px")
    @classmethod
    def _is_a_box(cls, text: str | None) -> str | None:
        if text is not None:
            _parse_box(text)
        return text

    @field_validator("fov_deg")
    @classmethod
    def _excludes_focal_length(cls, fov_deg: float | None, info: ValidationInfo) -> float | None:
        if fov_deg is not None and info.data.get("focal_length_px") is not None:
            raise ValueError("give focal_length_px or fov_deg, not both")
        return fov_deg

    def query(self) -> PhotoQuery:
        """The pipeline's form of these parameters."""
        box_px = None if self.box_px is None else _parse_box(self.box_px)
        return PhotoQuery(**{**self.model_dump(exclude={"skeleton"}), "box_px": box_px})


def _parse_box(text: str) -> schemas.Box:
    """``x,y,w,h`` as numbers; ``ValueError`` when it is not four sensible ones."""
    try:
        x, y, width, height = (float(part) for part in text.split(","))
    except ValueError:
        raise ValueError("four numbers x,y,w,h are wanted") from None
    limit = schemas.MAX_COORDINATE_PX
    if not all(abs(value) <= limit for value in (x, y, width, height)):  # also refuses nan
        raise ValueError(f"numbers within {limit:g} are wanted")
    if width < 1 or height < 1:
        raise ValueError("width and height must be at least 1 px")
    return x, y, width, height


_BINARY = {"schema": {"type": "string", "format": "binary"}}


def _form(schema: dict[str, Any]) -> dict[str, Any]:
    return {
        "multipart/form-data": {
            "schema": {"type": "object", "required": ["image"], "properties": {"image": schema}}
        }
    }


_FOUND = "Everybody found; nobody found is an answer too."


@router.post(
    "/v1/poses",
    summary="Estimate everybody's pose in a photo",
    response_class=Response,
    responses=describe_ok(schemas.PosesAnswer, _FOUND)
    | describe(400, 401, 408, 413, 415, 422, 429, 503),
    openapi_extra={
        "requestBody": {
            "required": True,
            "content": dict.fromkeys(KNOWN_TYPES, _BINARY) | _form(_BINARY["schema"]),
        }
    },
)
async def estimate_poses(
    request: Request,
    parameters: Annotated[PoseParameters, Query()],
    service: ServiceDep,
    engine: EngineDep,
) -> Response:
    """The body is the photo itself, or a form with the photo in its field `image`.

    Pixels are those of the upright photo (EXIF orientation applied), (0, 0) the centre of its
    top-left pixel. Millimetres are in the camera frame: x right, y down, z forward. HEIC needs the
    server's `heic` extra: `/v1/info` lists the types it accepts.
    """
    limits = service.settings
    content_type = request.headers.get("content-type")
    with service.uploads.share() as take:
        body = await read_body(
            request,
            limit_bytes=limits.max_body_bytes,
            timeout_s=limits.upload_timeout_s,
            take=take,
        )
        with WatchedArrival(request.receive) as arrival:
            answer, encoded = await service.admission.run(
                "poses",
                _work(
                    engine,
                    lambda: photo_bytes(body, content_type),
                    parameters,
                    request.state.request_id,
                    arrival,
                ),
                arrival,
            )
    request.state.timings_ms.update(answer.timings_ms)
    _observe(service, answer)
    return Response(encoded, media_type="application/json")


def _work(
    engine: Engine,
    photo: Callable[[], bytes],
    parameters: PoseParameters,
    request_id: str,
    arrival: Arrival,
) -> Callable[[], tuple[schemas.PosesAnswer, bytes]]:
    """The computation of one photo up to its JSON, to be run on a worker thread."""
    query = parameters.query()

    def estimate() -> schemas.PosesAnswer:
        result = engine.pipeline.estimate(photo(), query)
        return poses_answer(engine, result, query.method, request_id, parameters.skeleton)

    return lambda: timed(estimate, arrival.at_s)


def _observe(service: Service, answer: schemas.PosesAnswer) -> None:
    warnings = (person.warnings for person in answer.people)
    service.metrics.count_answer("photo", answer.timings_ms, warnings)
    service.metrics.people.observe(len(answer.people))


@router.post(
    "/v1/poses/batch",
    summary="Estimate everybody's pose in several photos",
    response_class=Response,
    responses=describe_ok(schemas.BatchAnswer, _FOUND)
    | describe(400, 401, 408, 413, 422, 429, 503),
    openapi_extra={
        "requestBody": {
            "required": True,
            "content": _form({"type": "array", "items": _BINARY["schema"]}),
        }
    },
)
async def estimate_batch(
    request: Request,
    parameters: Annotated[PoseParameters, Query()],
    service: ServiceDep,
    engine: EngineDep,
) -> Response:
    """A form with the field `image` once per photo; the parameters hold for all of them.

    A photo that cannot be answered has a `problem` in its place; the others are answered.
    """
    limits = service.settings
    content_type = request.headers.get("content-type")
    if not is_multipart(content_type):
        raise MalformedBodyError("a batch is a multipart form, its field 'image' once per photo")
    with service.uploads.share() as take:
        body = await read_body(
            request,
            limit_bytes=limits.max_batch_body_bytes,
            timeout_s=limits.upload_timeout_s,
            take=take,
        )
        images = await asyncio.to_thread(image_parts, body, content_type)
        if len(images) > limits.max_batch_images:
            raise InvalidInputError([("image", f"more than {limits.max_batch_images} images")])
        with WatchedArrival(request.receive) as arrival:
            work = _batch_work(
                engine,
                images,
                parameters,
                request.state.request_id,
                arrival,
                limits.max_body_bytes,
            )
            answers, encoded = await service.admission.run(
                "poses", work, arrival, units=len(images)
            )
    for answer in answers:
        _observe(service, answer)
    return Response(encoded, media_type="application/json")


def _batch_work(
    engine: Engine,
    images: Sequence[Part],
    parameters: PoseParameters,
    request_id: str,
    arrival: Arrival,
    limit_bytes: int,
) -> Callable[[], tuple[list[schemas.PosesAnswer], bytes]]:
    """The computation of all photos of a batch up to its JSON, to be run on a worker thread."""

    def work() -> tuple[list[schemas.PosesAnswer], bytes]:
        items = []
        for position, image in enumerate(images):
            if arrival.gone.done():
                raise ClientGoneError
            name = image.filename or str(position)
            photo = _one_photo(image.data, limit_bytes)
            own = Arrival(time.monotonic(), arrival.gone)
            try:
                answer, _ = _work(engine, photo, parameters, request_id, own)()
                items.append(schemas.BatchItem(name=name, answer=answer, problem=None))
            except RequestError as error:
                problem = problem_of(error, request_id)
                items.append(schemas.BatchItem(name=name, answer=None, problem=problem))
        answers = [item.answer for item in items if item.answer is not None]
        batch = schemas.BatchAnswer(request_id=request_id, images=tuple(items))
        return answers, batch.model_dump_json().encode()

    return work


def _one_photo(data: bytes, limit_bytes: int) -> Callable[[], bytes]:
    """The bytes of one photo of a batch, held to the limits a photo of its own has."""

    def photo() -> bytes:
        if not data:
            raise EmptyBodyError("this image is empty")
        if len(data) > limit_bytes:
            raise BodyTooLargeError(limit_bytes)
        return data

    return photo
