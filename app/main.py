"""``create_app``: the FastAPI application, its state and its life.

The socket listens while the engine loads, so that /livez and /readyz answer; everything else is a
503 until then. An engine that cannot be loaded ends the process through ``on_startup_failure``.
"""

from __future__ import annotations

import asyncio
import gc
import json
import logging
import signal
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi
from starlette.middleware import Middleware
from starlette.middleware.cors import CORSMiddleware

from app import schemas
from app.api import exemplars, health, info, lift, metrics, page, poses, problems
from app.api.deps import Service
from app.api.shedding import SheddingMiddleware
from app.engine import load_engine
from app.errors import StartupError
from app.observability import RequestContextMiddleware
from app.settings import Settings, load_settings
from app.version import VERSION

logger = logging.getLogger("posematch")

_HERE = Path(__file__).resolve().parent

_DESCRIPTION = """\
POST a photo, get every person's 2D joints, the matched exemplar, the camera and a 3D skeleton.

**Pixels** are those of the upright photo (EXIF orientation applied), (0, 0) the centre of its
top-left pixel. **Millimetres** are in the camera frame: x right, y down, z forward. **Left and
right** are the person's own. A number that is not calibrated is `null`. Errors are
`application/problem+json` (RFC 9457) with a stable `type`.
"""


def _end_process(error: StartupError) -> None:
    """Ask whichever server runs us to stop, as an operator would."""
    logger.critical("cannot start: %s", error)
    signal.raise_signal(signal.SIGTERM)


def create_app(
    settings: Settings | None = None,
    *,
    on_startup_failure: Callable[[StartupError], None] = _end_process,
) -> FastAPI:
    """The application; its state is ``app.state.service``.

    ``settings`` default to the environment's (``StartupError`` when they are bad).
    ``on_startup_failure`` is called on the event loop when model or library cannot be loaded.
    """
    settings = load_settings() if settings is None else settings
    service = Service(settings)

    async def start() -> None:
        try:
            engine = await asyncio.to_thread(load_engine, settings)
        except StartupError as error:
            service.startup_error = error
            on_startup_failure(error)
            return
        except Exception as error:
            logger.exception("unexpected error while starting")
            service.startup_error = StartupError(f"unexpected {type(error).__name__}: {error}")
            on_startup_failure(service.startup_error)
            return
        manifest = engine.library.manifest
        service.metrics.describe(
            version=VERSION,
            model=f"{engine.card.name} {engine.card.version}",
            library=f"{manifest.name} {manifest.version}",
        )
        # What was loaded stays: let the collector not walk over it again and again.
        gc.collect()
        gc.freeze()
        service.admission.expect("poses", engine.photo_s)
        service.engine = engine
        logger.info("ready", extra={"exemplars": len(engine.library)})

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        starting = asyncio.create_task(start())
        try:
            yield
        finally:
            service.stopping = True
            await starting
            await asyncio.to_thread(service.admission.close)
            if service.engine is not None:
                service.engine.library.close()

    middleware = [Middleware(RequestContextMiddleware, metrics=service.metrics)]
    if settings.cors_origins:
        middleware.append(
            Middleware(
                CORSMiddleware,
                allow_origins=settings.cors_origins,
                allow_methods=["GET", "POST"],
                allow_headers=["Authorization", "Content-Type", "X-API-Key", "X-Request-ID"],
                expose_headers=["X-Request-ID", "Server-Timing", "Retry-After"],
            )
        )
    middleware.append(Middleware(SheddingMiddleware, service=service))
    app = FastAPI(
        title="posematch",
        version=VERSION,
        description=_DESCRIPTION,
        lifespan=lifespan,
        middleware=middleware,
        redoc_url=None,
    )
    app.state.service = service
    problems.install(app)
    for router in (poses, lift, exemplars, info, health, metrics):
        app.include_router(router.router)
    app.include_router(page.page_router(_HERE / "static"))

    app.openapi = lambda: _openapi(app)  # type: ignore[method-assign]
    return app


def _openapi(app: FastAPI) -> dict[str, Any]:
    """The OpenAPI document: FastAPI's, with the schemas of the bodies we read ourselves."""
    if app.openapi_schema is None:
        document = get_openapi(
            title=app.title,
            version=app.version,
            description=app.description,
            routes=app.routes,
        )
        components = document["components"]["schemas"]
        for model in (schemas.LiftRequest, schemas.Problem):
            schema = model.model_json_schema(ref_template="#/components/schemas/{model}")
            components |= schema.pop("$defs", {})
            components[model.__name__] = schema
        for path, kind, media, example in (
            ("/v1/lift", "requestBody", "application/json", "lift_request"),
            ("/v1/lift", "responses", "application/json", "lift_answer"),
            ("/v1/poses", "responses", "application/json", "poses_answer"),
        ):
            place = document["paths"][path]["post"][kind]
            place = place["200"] if kind == "responses" else place
            place["content"][media]["example"] = _read_example(example)
        # FastAPI's own validation errors, which here are problems like all others.
        for name in ("HTTPValidationError", "ValidationError"):
            components.pop(name, None)
        for operation in (op for path in document["paths"].values() for op in path.values()):
            if "HTTPValidationError" in json.dumps(operation["responses"].get("422", {})):
                del operation["responses"]["422"]
        app.openapi_schema = document
    return app.openapi_schema


def _read_example(name: str) -> object:
    return json.loads((_HERE / "examples" / f"{name}.json").read_text())
