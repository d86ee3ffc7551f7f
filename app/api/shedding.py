"""Refusing work there is no room for from its request line, before its body is read.

Under overload most requests are refused, so a refusal has to cost next to nothing: it is decided
here, ahead of routing, keys and query. The connection stays usable; the rest of the refused body
is read and dropped (``app.connection`` bounds for how long).

``posematch serve`` writes refusals even before the application is called (:class:`EarlyRefusals`);
under other servers, and for pages of other origins, :class:`SheddingMiddleware` does.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from http import HTTPStatus

from starlette.types import ASGIApp, Receive, Scope, Send

from app.api.deps import Service
from app.api.problems import problem_response
from app.errors import OverloadedError
from app.observability import add_context, record_request, request_id_of, server_timing

_WORK = {"/v1/poses": "poses", "/v1/poses/batch": "poses", "/v1/lift": "lift"}
"""Path -> the kind of work admission knows it as."""
_ID = "{request id}"
"""Stands for it in a template; no request's id has such characters."""


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
    """The same refusals as bytes, with all that the application adds to a response.

    They differ in little but their request's id, so each kind of them is put together once.
    """

    def __init__(self, service: Service) -> None:
        self._service = service
        self._templates: dict[tuple[str, str], _Template] = {}

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
        kind = error.reason, error.headers["Retry-After"]
        template = self._templates.get(kind)
        if template is None:
            template = self._templates[kind] = _Template.of(error)
        request_id = request_id_of(scope)
        spent_s = time.perf_counter() - started_s
        record_request(
            self._service.metrics, scope, scope["path"], error.status, spent_s, request_id
        )
        return template.filled(request_id, spent_s)


@dataclass(frozen=True)
class _Template:
    """A response with places for a request's id and what depends on it.

    ``form`` takes ``length``, ``id`` and ``timing``; ``rest_bytes`` is the length of the body but
    for the id.
    """

    form: bytes
    rest_bytes: int

    @classmethod
    def of(cls, error: OverloadedError) -> _Template:
        """The response that the application would give to ``error``."""
        response = problem_response(error, _ID)
        add_context(response.headers, _ID, {})
        body = bytes(response.body)
        places = {
            b"content-length": b"%(length)d",
            b"x-request-id": b"%(id)s",
            b"server-timing": b"%(timing)s",
        }
        status = HTTPStatus(error.status)
        lines = [b"HTTP/1.1 %d %s" % (status, status.phrase.encode())]
        lines += [
            b"%s: %s" % (name, places.get(name) or value.replace(b"%", b"%%"))
            for name, value in response.raw_headers
        ]
        before, _, after = body.replace(b"%", b"%%").partition(_ID.encode())
        lines += [b"", before + b"%(id)s" + after]
        return cls(form=b"\r\n".join(lines), rest_bytes=len(body) - len(_ID))

    def filled(self, request_id: str, spent_s: float) -> bytes:
        """The response to the request of this id, decided on in ``spent_s`` seconds."""
        return self.form % {
            b"length": self.rest_bytes + len(request_id),
            b"id": request_id.encode(),
            b"timing": server_timing({"app": 1e3 * spent_s}).encode(),
        }


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
