"""What the service tells its operators: metrics, request ids, JSON logs, Server-Timing."""

from __future__ import annotations

import asyncio
import json
import logging
import random
import re
import sys
import time
from collections.abc import Callable, Collection, Iterable, Mapping
from datetime import UTC, datetime

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, Info
from prometheus_client.platform_collector import PlatformCollector
from prometheus_client.process_collector import ProcessCollector
from starlette.datastructures import MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from app.api.problems import problem_response
from app.errors import NotReadyError, RequestError

logger = logging.getLogger("posematch")
access_logger = logging.getLogger("posematch.access")

_REQUEST_ID = re.compile(r"[A-Za-z0-9._:-]{1,64}")
_SECONDS = (0.001, 0.0025, 0.005, 0.01, 0.02, 0.03, 0.05, 0.075, 0.1, 0.15, 0.2, 0.3, 0.5, 1, 2.5)


class Metrics:
    """The Prometheus metrics of one application, in a registry of their own."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        self.requests = Counter(
            "posematch_requests",
            "Answered requests",
            ["route", "method", "status"],
            registry=self.registry,
        )
        self.request_seconds = Histogram(
            "posematch_request_seconds",
            "From a request's head to the end of its answer",
            ["route"],
            buckets=_SECONDS,
            registry=self.registry,
        )
        self.stage_seconds = Histogram(
            "posematch_stage_seconds",
            "Time spent in each stage of the pipeline",
            ["stage"],
            buckets=_SECONDS,
            registry=self.registry,
        )
        self.refused = Counter(
            "posematch_refused",
            "Requests refused with a 503 or, over their key's quota, a 429",
            ["reason"],
            registry=self.registry,
        )
        self.abandoned = Counter(
            "posematch_abandoned",
            "Requests given up because their client had left",
            registry=self.registry,
        )
        self.people = Histogram(
            "posematch_people_per_image",
            "People found in a photo",
            buckets=(0, 1, 2, 3, 5, 10),
            registry=self.registry,
        )
        self.answered = Counter(
            "posematch_people",
            "People answered, of photos or of joints that were given",
            ["source"],
            registry=self.registry,
        )
        self.far_from_library = Counter(
            "posematch_far_from_library",
            "People unlike anything in the library",
            registry=self.registry,
        )
        self.reloads = Counter(
            "posematch_library_reloads",
            "Reloads of the library: done, unchanged or refused",
            ["outcome"],
            registry=self.registry,
        )
        self._running = Gauge(
            "posematch_running", "Requests being computed", registry=self.registry
        )
        self._waiting = Gauge(
            "posematch_waiting", "Requests waiting for a worker", registry=self.registry
        )
        self._upload_bytes = Gauge(
            "posematch_upload_bytes", "Bytes of the bodies held in memory", registry=self.registry
        )
        self._build = Info("posematch", "What is being served", registry=self.registry)
        self._networks = Info(
            "posematch_model", "The networks in service", ["kind", "name"], registry=self.registry
        )
        self._of_requests: dict[tuple[str, str, int], tuple[Counter, Histogram]] = {}
        ProcessCollector(registry=self.registry)
        PlatformCollector(registry=self.registry)

    def count_request(self, route: str, method: str, status: int, spent_s: float) -> None:
        """Count an answered request."""
        kind = route, method, status
        found = self._of_requests.get(kind)
        if found is None:  # looking labels up costs as much as a refusal may
            found = (
                self.requests.labels(route, method, str(status)),
                self.request_seconds.labels(route),
            )
            self._of_requests[kind] = found
        answered, seconds = found
        answered.inc()
        seconds.observe(spent_s)

    def count_answer(
        self, source: str, timings_ms: Mapping[str, float], warnings: Iterable[Collection[str]]
    ) -> None:
        """Count an answer about a "photo" or "joints": its stages, its people's warnings."""
        for stage, spent_ms in timings_ms.items():
            self.stage_seconds.labels(stage).observe(spent_ms / 1e3)
        for of_one in warnings:
            self.answered.labels(source).inc()
            self.far_from_library.inc("far_from_library" in of_one)

    def watch(
        self,
        *,
        running: Callable[[], float],
        waiting: Callable[[], float],
        upload_bytes: Callable[[], float],
    ) -> None:
        """Read the gauges from these functions whenever the metrics are scraped."""
        self._running.set_function(running)
        self._waiting.set_function(waiting)
        self._upload_bytes.set_function(upload_bytes)

    def describe(self, **labels: str) -> None:
        """State which version, model and library are served."""
        self._build.info(labels)

    def describe_network(self, kind: str, name: str, **labels: str) -> None:
        """State which network does what, and what runs it in which precision."""
        self._networks.labels(kind, name).info(labels)


def server_timing(timings_ms: Mapping[str, float]) -> str:
    """The ``Server-Timing`` header (W3C): ``decode;dur=3.1, pose;dur=11.0``."""
    return ", ".join(f"{stage};dur={spent:.3f}" for stage, spent in timings_ms.items())


class RequestContextMiddleware:
    """Gives each request its id, and each response its headers, metrics and log line.

    The handlers leave stage timings in ``scope["state"]["timings_ms"]``.
    """

    def __init__(self, app: ASGIApp, metrics: Metrics) -> None:
        self._app = app
        self._metrics = metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one ASGI connection."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        started_s = time.perf_counter()
        request_id = request_id_of(scope)
        state = scope.setdefault("state", {})
        state["request_id"] = request_id
        timings_ms: dict[str, float] = {}
        state["timings_ms"] = timings_ms
        status = 0

        async def send_with_headers(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                elapsed = {"app": 1e3 * (time.perf_counter() - started_s)}
                add_context(MutableHeaders(scope=message), request_id, timings_ms | elapsed)
            await send(message)

        # Whatever can be got can be asked about (RFC 9110, 9.1); the server leaves the body out.
        inner = {**scope, "method": "GET"} if scope["method"] == "HEAD" else scope
        try:
            await self._app(inner, receive, send_with_headers)
        finally:
            route = state.get("route") or _route_of(inner)
            record_request(
                self._metrics, scope, route, status, time.perf_counter() - started_s, request_id
            )


def _route_of(scope: Scope) -> str:
    """The path that a request was matched with, as it is declared: few for any number of them."""
    if "route" in scope:
        return str(scope["route"].path)
    # Starlette's own routes, such as the OpenAPI document's, do not tell: they have no parameters.
    return str(scope["path"]) if "endpoint" in scope else "unmatched"


class LastResortMiddleware:
    """Answers what nothing else did.

    An exception becomes a 500 that says nothing but the request id; the log has the rest. Whatever
    the server cancels, as it does when it has waited long enough before it ends, is a 503.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one ASGI connection."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        has_begun = False

        async def send_and_see(message: Message) -> None:
            nonlocal has_begun
            has_begun = True
            await send(message)

        request_id = scope["state"]["request_id"]
        try:
            await self._app(scope, receive, send_and_see)
        except asyncio.CancelledError:
            if has_begun:
                raise
            error: RequestError = NotReadyError("the service is shutting down")
            await problem_response(error, request_id)(scope, receive, send)
        except Exception:
            logger.exception("unhandled error", extra={"request_id": request_id})
            if has_begun:
                raise  # only closing the connection is left
            wrong = "something went wrong here; the request id identifies it in our log"
            await problem_response(RequestError(wrong), request_id)(scope, receive, send)


def request_id_of(scope: Scope) -> str:
    """The id that the client gave its request, or a new one."""
    for name, value in scope["headers"]:
        if name == b"x-request-id":
            given = value.decode("latin-1").strip()  # the parser leaves the blanks at its end
            return given if _REQUEST_ID.fullmatch(given) else new_request_id()
    return new_request_id()


def new_request_id() -> str:
    """32 hexadecimal digits, unlike all others but no secret.

    Not of the system's random numbers: that call lets go of the interpreter, which under load takes
    the event loop milliseconds to get back.
    """
    return f"{random.getrandbits(128):032x}"


def add_context(headers: MutableHeaders, request_id: str, timings_ms: Mapping[str, float]) -> None:
    """What every response has: its request's id, where the time went, and no guessing of types."""
    headers["X-Request-ID"] = request_id
    headers["Server-Timing"] = server_timing(timings_ms)
    headers.setdefault("X-Content-Type-Options", "nosniff")


def record_request(
    metrics: Metrics, scope: Scope, route: str, status: int, spent_s: float, request_id: str
) -> None:
    """Count an answered request and log it; ``status`` 0: its client left."""
    method = scope["method"] if scope["method"] in _METHODS else "other"
    metrics.count_request(route, method, status or 499, spent_s)
    if access_logger.isEnabledFor(logging.INFO):
        access_logger.info(
            "request",
            extra={
                "request_id": request_id,
                "method": scope["method"],
                "path": scope["path"],
                "status": status or 499,
                "duration_ms": round(1e3 * spent_s, 3),
                "client": (scope.get("client") or ("",))[0],
            },
        )


_METHODS = {"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"}


class JsonFormatter(logging.Formatter):
    """One JSON object a line: time, level, logger, message and the record's extra fields."""

    _STANDARD = frozenset(logging.makeLogRecord({}).__dict__) | {"message", "asctime", "taskName"}

    def format(self, record: logging.LogRecord) -> str:
        """Serialise ``record``; values JSON does not know become their text."""
        line: dict[str, object] = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
        }
        line |= {k: v for k, v in record.__dict__.items() if k not in self._STANDARD}
        line.pop("color_message", None)
        if record.exc_info:
            line["exception"] = self.formatException(record.exc_info)
        return json.dumps(line, default=str)


def configure_logging(level: str) -> None:
    """Send every record of ``level`` and above to stderr as JSON lines."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonFormatter())
    logging.basicConfig(level=level.upper(), handlers=[handler], force=True)
    for name in ("uvicorn", "uvicorn.error"):
        logging.getLogger(name).handlers.clear()
