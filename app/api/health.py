"""GET /livez and /readyz: for whoever restarts the process, and whoever sends it work."""

from __future__ import annotations

from fastapi import APIRouter

from app import schemas
from app.api.deps import EngineDep
from app.api.problems import describe

router = APIRouter(tags=["health"])


@router.get("/livez", summary="The process lives")
async def get_livez() -> schemas.Health:
    """Answers as long as the event loop turns."""
    return schemas.Health()


@router.get("/readyz", summary="Photos can be sent", responses=describe(503))
async def get_readyz(engine: EngineDep) -> schemas.Health:  # noqa: ARG001
    """503 until model, library and warm-up are done, and again once the service is stopping."""
    return schemas.Health()
