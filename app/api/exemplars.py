"""GET /v1/exemplars/{id}: one exemplar's 3D pose and where it comes from."""

from __future__ import annotations

from fastapi import APIRouter, Depends, Response

from app import schemas
from app.answers import exemplar_answer
from app.api.deps import EngineDep, authorise
from app.api.problems import describe, describe_ok
from app.errors import ExemplarNotFoundError

router = APIRouter(tags=["exemplars"], dependencies=[Depends(authorise)])


@router.get(
    "/v1/exemplars/{exemplar_id}",
    summary="An exemplar's pose and provenance",
    response_class=Response,
    responses=describe_ok(schemas.ExemplarAnswer, "The exemplar.") | describe(401, 404, 429, 503),
)
async def get_exemplar(exemplar_id: str, engine: EngineDep) -> Response:
    """The pose is in the exemplar's own frame: root-centred, Y up, millimetres."""
    try:
        answer = exemplar_answer(engine.library, exemplar_id)
    except KeyError:
        raise ExemplarNotFoundError("the library has no exemplar of this id") from None
    return Response(answer.model_dump_json(), media_type="application/json")
