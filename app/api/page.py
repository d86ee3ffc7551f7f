"""GET /, /docs and /static: the pages and their files, from memory, under strict content policies.

The pages are plain JavaScript without a build step. They load nothing from elsewhere and link to
everything relatively, so that they also work under a path prefix.
"""

from __future__ import annotations

import gzip
import hashlib
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from fastapi import APIRouter, Request, Response
from starlette.exceptions import HTTPException

_MEDIA_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
    ".jpg": "image/jpeg",
}

_POLICY = "; ".join(
    (
        "default-src 'none'",
        "script-src 'self'",
        "style-src 'self'",
        "img-src 'self' blob:",
        "connect-src 'self'",
        "base-uri 'none'",
        "form-action 'none'",
        "frame-ancestors 'none'",
        "require-trusted-types-for 'script'",
    )
)

_HEADERS = {
    "Content-Security-Policy": _POLICY,
    "Permissions-Policy": "camera=(self), microphone=(), geolocation=()",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
}

# Swagger UI draws its icons as data: images and styles elements as it makes them.
_DOCS_POLICY = "; ".join(
    (
        "default-src 'none'",
        "script-src 'self'",
        "style-src 'self' 'unsafe-inline'",
        "img-src 'self' data: blob:",
        "connect-src 'self'",
        "base-uri 'none'",
        "form-action 'none'",
        "frame-ancestors 'none'",
    )
)


@dataclass(frozen=True)
class Asset:
    """A file of the page, held in memory."""

    data: bytes
    media_type: str

    @cached_property
    def etag(self) -> str:
        """Names these bytes and no others."""
        return f'"{hashlib.sha256(self.data).hexdigest()[:32]}"'

    @cached_property
    def zipped(self) -> bytes | None:
        """The bytes after gzip, None where that gains nothing; made at the first request."""
        if self.media_type == "image/jpeg":
            return None
        return gzip.compress(self.data, mtime=0)

    def respond(self, request: Request) -> Response:
        """The file, or 304 when the client's copy is this one."""
        headers = {"ETag": self.etag, "Cache-Control": "no-cache", "Vary": "Accept-Encoding"}
        # A proxy that compresses turns our ETag into a weak one.
        known = request.headers.get("if-none-match", "").replace("W/", "")
        if self.etag in {tag.strip() for tag in known.split(",")}:
            return Response(status_code=304, headers=headers)
        body = self.data
        if self.zipped is not None and "gzip" in request.headers.get("accept-encoding", ""):
            body = self.zipped
            headers["Content-Encoding"] = "gzip"
        return Response(body, media_type=self.media_type, headers=headers)


def read_assets(directory: Path) -> dict[str, Asset]:
    """Every file under ``directory`` of a type the page is made of, by its relative path."""
    return {
        path.relative_to(directory).as_posix(): Asset(path.read_bytes(), _MEDIA_TYPES[path.suffix])
        for path in sorted(directory.rglob("*"))
        if path.suffix in _MEDIA_TYPES
    }


def page_router(directory: Path) -> APIRouter:
    """Routes for ``index.html`` and ``docs.html`` in ``directory`` and the files beside them."""
    assets = read_assets(directory)
    page, docs = assets.pop("index.html"), assets.pop("docs.html")
    router = APIRouter(include_in_schema=False)

    @router.get("/")
    async def get_page(request: Request) -> Response:
        response = page.respond(request)
        response.headers.update(_HEADERS)
        return response

    @router.get("/docs")
    async def get_docs(request: Request) -> Response:
        response = docs.respond(request)
        response.headers.update(_HEADERS | {"Content-Security-Policy": _DOCS_POLICY})
        return response

    @router.get("/static/{path:path}")
    async def get_asset(path: str, request: Request) -> Response:
        if path not in assets:
            raise HTTPException(404)
        return assets[path].respond(request)

    return router
