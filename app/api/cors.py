"""Pages of other origins: Starlette's CORS, its refusals as problems."""

from __future__ import annotations

from starlette.datastructures import Headers
from starlette.middleware.cors import CORSMiddleware
from starlette.responses import Response
from starlette.types import Receive, Scope, Send

from app.api.problems import problem_response
from app.errors import PreflightRefusedError


class CorsMiddleware(CORSMiddleware):
    """The allow-list; a preflight that asks for more gets a 400 which says what it was."""

    def preflight_response(self, request_headers: Headers) -> Response:
        """The answer to a preflight."""
        response = super().preflight_response(request_headers)
        return response if response.status_code == 200 else _Refusal(response)


class _Refusal(Response):
    """A refused preflight as a problem, whose request's id is known when it is sent."""

    def __init__(self, refused: Response) -> None:
        super().__init__()
        self._refused = refused

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        about = {"content-length", "content-type"}
        headers = {k: v for k, v in self._refused.headers.items() if k not in about}
        error = PreflightRefusedError(bytes(self._refused.body).decode(), headers=headers)
        await problem_response(error, scope["state"]["request_id"])(scope, receive, send)
