"""``posematch serve``: the HTTP service."""

from __future__ import annotations

from contextlib import suppress
from typing import Annotated

import typer
import uvicorn

from app.api.shedding import EarlyRefusals
from app.commands.console import build_if_missing
from app.commands.machine import why_no_listening
from app.connection import connection_class
from app.errors import StartupError
from app.main import create_app
from app.observability import configure_logging
from app.settings import Settings, load_settings


def serve(
    host: Annotated[str | None, typer.Option(help="Address; default POSEMATCH_HOST.")] = None,
    port: Annotated[int | None, typer.Option(help="Port; default POSEMATCH_PORT.")] = None,
) -> None:
    """Serve the API and the page.

    Builds the default library first when it is not there yet.

    \b
    posematch serve
    posematch serve --host 0.0.0.0 --port 9000
    POSEMATCH_WORKERS=1 POSEMATCH_DEADLINE_MS=500 posematch serve
    """  # noqa: D301
    given = {"host": host, "port": port}
    settings = load_settings(**{name: value for name, value in given.items() if value is not None})
    why_not = why_no_listening(settings.host, settings.port)
    if why_not is not None:  # said before a library is built, which may take minutes
        raise _cannot_listen(settings, why_not)
    build_if_missing(settings)
    configure_logging(settings.log_level)

    def stop(_: StartupError) -> None:
        server.should_exit = True

    app = create_app(settings, on_startup_failure=stop)
    server = uvicorn.Server(
        uvicorn.Config(
            app,
            host=settings.host,
            port=settings.port,
            http=connection_class(
                settings.upload_timeout_s, EarlyRefusals(app.state.service).encoded
            ),
            lifespan="on",
            ws="none",
            access_log=False,
            log_config=None,
            server_header=False,
            timeout_keep_alive=settings.keep_alive_s,
            timeout_graceful_shutdown=settings.shutdown_grace_s,
        )
    )
    try:
        with suppress(KeyboardInterrupt):  # uvicorn shuts down in order, then raises it again
            server.run()
    except SystemExit:  # its word for an address that was taken in the meantime
        raise _cannot_listen(settings, "see the log") from None
    if app.state.service.startup_error is not None:
        raise app.state.service.startup_error


def _cannot_listen(settings: Settings, why: str) -> StartupError:
    return StartupError(
        f"cannot listen on {settings.host} port {settings.port} ({why}); free it, or choose "
        "another with POSEMATCH_HOST and POSEMATCH_PORT"
    )
