"""Refusing work there is no room for from its request line, before its body is read.

Under overload most requests are refused, so a refusal has to cost next to nothing: it is decided
here, ahead of routing, keys and query. The connection stays usable; the rest of the refused body
is read and dropped (``app.connection`` bounds for how long).

``posematch serve`` writes refusals even before the application is called (:class:`EarlyRefusals`);
under other servers, and for pages of other origins, :class:`SheddingMiddleware` does.
"""

from __future__ import annotations

import time
from http import HTTPStatus

from starlette.types import ASGIApp, Receive, Scope, Send

from app.api.deps import Service
from app.api.problems import problem_response
from app.errors import OverloadedError
from app.observability import add_context, record_request, request_id_of

_WORK = {"/v1/poses": "poses", "/v1/poses/batch": "poses", "/v1/lift": "lift"}
"""Path -> the kind of work admission knows it as."""


class SheddingMiddleware:
    """Answers 503 to requests for work that admission would refuse now."""

    def __init__(self, app: ASGIApp, service: Service) -> None:
        self._app = app
        self._service = service

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one ASGI connection."""
        error = _refusal(self._service, scope) if scope["type"] == "http" else None
        if error is None:
            await self._app(scope, receive, send)
            return
        scope["state"]["route"] = scope["path"]
        await problem_response(error, scope["state"]["request_id"])(scope, receive, send)


class EarlyRefusals:
    """The same refusals as bytes, with all that the application adds to a response."""

    def __init__(self, service: Service) -> None:
        self._service = service

    def encoded(self, scope: Scope) -> bytes | None:
        """The response to a request with this head; None if the application has to answer it."""
        if self._service.settings.cors_origins and any(
            name == b"origin" for name, _ in scope["headers"]
        ):
            return None
        started_s = time.perf_counter()
        error = _refusal(self._service, scope)
        if error is None:
            return None
        request_id = request_id_of(scope)
        response = problem_response(error, request_id)
        spent_s = time.perf_counter() - started_s
        add_context(response.headers, request_id, {"app": 1e3 * spent_s})
        record_request(
            self._service.metrics, scope, scope["path"], error.status, spent_s, request_id
        )
        status = HTTPStatus(error.status)
        lines = [b"HTTP/1.1 %d %s" % (status, status.phrase.encode())]
        lines += [b"%s: %s" % header for header in response.raw_headers]
        return b"\r\n".join([*lines, b"", response.body])


def _refusal(service: Service, scope: Scope) -> OverloadedError | None:
    """Why this request is refused now, counted; None if it is not."""
    kind = _WORK.get(scope["path"]) if scope["method"] == "POST" else None
    if kind is None:
        return None
    try:
        service.admission.check(kind)
    except OverloadedError as error:
        service.metrics.refused.labels(error.reason).inc()
        return error
    return None
