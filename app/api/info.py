"""GET /v1/info: what is served, and what is accepted."""

from __future__ import annotations

from typing import get_args

from fastapi import APIRouter, Depends

from app import schemas
from app.answers import SKELETON, library_of, licence_of, model_of, networks_of
from app.api.deps import EngineDep, ServiceDep, authorise
from app.api.problems import describe
from app.imaging import accepted_types
from app.version import VERSION

router = APIRouter(tags=["info"], dependencies=[Depends(authorise)])


@router.get(
    "/v1/info", summary="Version, model, library and limits", responses=describe(401, 429, 503)
)
async def get_info(service: ServiceDep, engine: EngineDep) -> schemas.InfoAnswer:
    """Everything needed to interpret the answers and to stay within the limits."""
    settings = service.settings
    return schemas.InfoAnswer(
        name="posematch",
        version=VERSION,
        model=model_of(engine),
        networks=networks_of(engine),
        library=library_of(engine.library),
        licences=tuple(licence_of(licence) for licence in engine.library.manifest.licences),
        skeleton=SKELETON,
        methods=get_args(schemas.Method),
        limits=schemas.Limits(
            accepted_types=accepted_types(),
            max_body_bytes=settings.max_body_bytes,
            max_batch_body_bytes=settings.max_batch_body_bytes,
            max_batch_images=settings.max_batch_images,
            max_pixels=settings.max_pixels,
            max_lift_people=schemas.MAX_LIFT_PEOPLE,
            upload_timeout_s=settings.upload_timeout_s,
            deadline_ms=settings.deadline_ms,
        ),
    )
