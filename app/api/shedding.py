"""Refusing work there is no room for from its request line, before its body is read.

Under overload most requests are refused, so a refusal has to cost next to nothing: it is decided
here, ahead of routing, keys and query. The connection stays usable; the rest of the refused body
is read and dropped (``app.connection`` bounds for how long).
"""

from __future__ import annotations

from starlette.types import ASGIApp, Receive, Scope, Send

from app.api.deps import Service
from app.api.problems import problem_response
from app.errors import OverloadedError

_WORK = {"/v1/poses": "poses", "/v1/poses/batch": "poses", "/v1/lift": "lift"}
"""Path -> the kind of work admission knows it as."""


class SheddingMiddleware:
    """Answers 503 to requests for work that admission would refuse now."""

    def __init__(self, app: ASGIApp, service: Service) -> None:
        self._app = app
        self._service = service

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one ASGI connection."""
        kind = _WORK.get(scope["path"]) if scope["type"] == "http" else None
        if kind is not None and scope["method"] == "POST":
            try:
                self._service.admission.check(kind)
            except OverloadedError as error:
                self._service.metrics.refused.labels(error.reason).inc()
                scope["state"]["route"] = scope["path"]
                response = problem_response(error, scope["state"]["request_id"])
                await response(scope, receive, send)
                return
        await self._app(scope, receive, send)
