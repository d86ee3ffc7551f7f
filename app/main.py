"""``create_app``: the FastAPI application, its state and its life.

The socket listens while the engine loads, so that /livez and /readyz answer; everything else is a
503 until then. An engine that cannot be loaded ends the process through ``on_startup_failure``.
"""

from __future__ import annotations

import asyncio
import gc
import logging
import signal
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from pathlib import Path

from fastapi import FastAPI
from starlette.middleware import Middleware

from app.api import exemplars, health, info, lift, metrics, page, poses, problems
from app.api.cors import CorsMiddleware
from app.api.deps import Service
from app.api.openapi import DESCRIPTION, openapi_document
from app.api.shedding import SheddingMiddleware
from app.engine import load_engine
from app.errors import StartupError
from app.observability import LastResortMiddleware, RequestContextMiddleware
from app.reload import Reloader, describe
from app.settings import Settings, load_settings
from app.version import VERSION

logger = logging.getLogger("posematch")

_HERE = Path(__file__).resolve().parent


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
        describe(service, engine)
        # What was loaded stays: let the collector not walk over it again and again.
        gc.collect()
        gc.freeze()
        service.admission.expect("poses", engine.photo_s)
        service.engine = engine
        logger.info("ready", extra={"exemplars": len(engine.library)})

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        starting = asyncio.create_task(start())
        reloader = Reloader(service)
        loop = asyncio.get_running_loop()
        with suppress(RuntimeError, ValueError):  # only a main thread hears signals
            loop.add_signal_handler(signal.SIGHUP, reloader.request)
        try:
            yield
        finally:
            service.stopping = True
            await starting
            await reloader.finish()
            await asyncio.to_thread(service.admission.close)
            if service.engine is not None:
                service.engine.library.close()

    middleware = [Middleware(RequestContextMiddleware, metrics=service.metrics)]
    if settings.cors_origins:
        middleware.append(
            Middleware(
                CorsMiddleware,
                allow_origins=settings.cors_origins,
                allow_methods=["GET", "POST"],
                allow_headers=["Authorization", "Content-Type", "X-API-Key", "X-Request-ID"],
                expose_headers=["X-Request-ID", "Server-Timing", "Retry-After"],
            )
        )
    # Within the former, so that pages of other origins can read what went wrong, too.
    middleware.append(Middleware(LastResortMiddleware))
    middleware.append(Middleware(SheddingMiddleware, service=service))
    app = FastAPI(
        title="posematch",
        version=VERSION,
        description=DESCRIPTION,
        lifespan=lifespan,
        middleware=middleware,
        docs_url=None,  # ours is in app.api.page: FastAPI's loads its scripts from elsewhere
        redoc_url=None,
        # /v1/poses/ is a 404 that says so: a redirect loses the bodies of most clients.
        redirect_slashes=False,
    )
    app.state.service = service
    problems.install(app)
    for router in (poses, lift, exemplars, info, health, metrics):
        app.include_router(router.router)
    app.include_router(page.page_router(_HERE / "static"))

    document = openapi_document(app)
    app.openapi = lambda: document  # type: ignore[method-assign]
    return app
