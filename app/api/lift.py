"""POST /v1/lift: 2D joints in, 3D out, no photo."""

from __future__ import annotations

import json
from collections import Counter

import numpy as np
from fastapi import APIRouter, Depends, Request, Response
from pydantic import ValidationError

from app import schemas
from app.answers import lift_answer, timed
from app.api.bodies import WatchedArrival, read_body
from app.api.deps import EngineDep, ServiceDep, authorise, no_query
from app.api.problems import describe, describe_ok, invalid_input
from app.errors import InvalidInputError, MalformedBodyError
from app.pipeline import LiftQuery
from library_store.conversion import CONVERSIONS

router = APIRouter(tags=["lift"], dependencies=[Depends(authorise), Depends(no_query)])

MAX_LIFT_BODY_BYTES = 2_000_000
"""256 people of 14 joints, generously indented."""


@router.post(
    "/v1/lift",
    summary="Lift given 2D joints",
    response_class=Response,
    responses=describe_ok(schemas.LiftAnswer, "Everybody, in order.")
    | describe(400, 401, 408, 413, 422, 429, 503),
    openapi_extra={
        "requestBody": {
            "required": True,
            "content": {
                "application/json": {"schema": {"$ref": "#/components/schemas/LiftRequest"}}
            },
        }
    },
)
async def lift_people(request: Request, service: ServiceDep, engine: EngineDep) -> Response:
    """Joints left out or with confidence 0 are missing; up to 256 people a call."""
    request_id = request.state.request_id
    with service.uploads.share() as take:
        body = await read_body(
            request,
            limit_bytes=min(MAX_LIFT_BODY_BYTES, service.settings.max_body_bytes),
            timeout_s=service.settings.upload_timeout_s,
            take=take,
            wanted="2D joints as JSON",
        )
        with WatchedArrival(request.receive) as arrival:

            def lift() -> schemas.LiftAnswer:
                wanted = parse_lift_request(body)
                result = engine.pipeline.lift(query_of(wanted))
                return lift_answer(
                    engine, result, wanted.method, request_id, wanted.answer_skeleton
                )

            answer, encoded = await service.admission.run(
                "lift", lambda: timed(lift, arrival.at_s), arrival
            )
    request.state.timings_ms.update(answer.timings_ms)
    warnings = (person.warnings for person in answer.people)
    service.metrics.count_answer("joints", answer.timings_ms, warnings)
    return Response(encoded, media_type="application/json")


def parse_lift_request(body: bytes) -> schemas.LiftRequest:
    """The request in ``body``; ``MalformedBodyError`` or ``InvalidInputError`` when it is none."""
    try:
        wanted = schemas.LiftRequest.model_validate_json(body, strict=True)
    except ValidationError as error:
        for item in error.errors():
            if item["type"] == "json_invalid":
                # No cause for the log: its text quotes the body.
                why = item["msg"].removeprefix("Invalid JSON: ")
                raise MalformedBodyError(f"the body is not JSON: {why}") from None
        raise invalid_input(error) from None
    # Of such members pydantic takes the last and says nothing (RFC 8259: "unpredictable").
    json.loads(body, object_pairs_hook=_refuse_twins, parse_int=str, parse_float=str)
    return wanted


def _refuse_twins(members: list[tuple[str, object]]) -> None:
    """``InvalidInputError`` when an object of the body has two members of one name."""
    names = [name for name, _ in members]
    if len(set(names)) < len(names):
        twice = [name for name, times in Counter(names).items() if times > 1]
        raise InvalidInputError([(name, "given twice in one object") for name in twice])


def query_of(wanted: schemas.LiftRequest) -> LiftQuery:
    """The pipeline's form of a request: arrays in lsp14's order, 0 where missing."""
    conversion = CONVERSIONS[wanted.skeleton]
    given_px = np.zeros((len(wanted.people), conversion.skeleton.n_joints, 2))
    sure = np.zeros((len(wanted.people), conversion.skeleton.n_joints))
    for row, person in enumerate(wanted.people):
        for joint in person.joints_2d:
            column = conversion.skeleton.index(joint.name)
            given_px[row, column] = joint.x_px, joint.y_px
            sure[row, column] = joint.confidence
    joints_px, confidence = conversion.to_lsp14(given_px, sure)
    return LiftQuery(
        width_px=wanted.image.width_px,
        height_px=wanted.image.height_px,
        joints_px=joints_px,
        confidence=confidence,
        focal_length_px=wanted.focal_length_px,
        principal_point_px=wanted.principal_point_px,
        candidates=wanted.candidates,
        method=wanted.method,
        subject_height_mm=wanted.subject_height_mm,
    )
