"""The service's endpoints as requests to be sent; what both clients share."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO
from urllib.parse import quote

from posematch_client.types import LiftRequest, PoseParameters
from posematch_client.version import VERSION

Photo = bytes | str | os.PathLike[str] | BinaryIO
"""A photo's bytes, its file's path, or an open binary file."""


@dataclass(frozen=True)
class Call:
    """One request, complete in memory so that it can be sent again; keywords of httpx."""

    method: str
    path: str
    keywords: Mapping[str, Any] = field(default_factory=dict)


def headers(api_key: str | None) -> dict[str, str]:
    """What every request of a client carries.

    ``ValueError`` for a key that no header takes; the service's keys are ASCII.
    """
    agent = {"User-Agent": f"posematch-client/{VERSION}"}
    if api_key is not None and not api_key.isascii():
        raise ValueError("api_key has characters other than ASCII, which no service's key has")
    return agent if api_key is None else {**agent, "Authorization": f"Bearer {api_key}"}


def read(photo: Photo) -> bytes:
    """The photo's bytes. ``OSError`` when the file cannot be read."""
    if isinstance(photo, bytes):
        return photo
    if isinstance(photo, (str, os.PathLike)):
        return Path(photo).read_bytes()
    return photo.read()


def poses(photo: bytes, parameters: PoseParameters) -> Call:
    """POST /v1/poses."""
    kind = {"Content-Type": "application/octet-stream"}
    return Call(
        "POST", "v1/poses", {"content": photo, "params": _query(parameters), "headers": kind}
    )


def poses_batch(photos: Iterable[bytes], parameters: PoseParameters) -> Call:
    """POST /v1/poses/batch."""
    files = [("image", (str(index), photo)) for index, photo in enumerate(photos)]
    return Call("POST", "v1/poses/batch", {"files": files, "params": _query(parameters)})


def lift(request: LiftRequest) -> Call:
    """POST /v1/lift."""
    return Call("POST", "v1/lift", {"json": request})


def exemplar(exemplar_id: str) -> Call:
    """GET /v1/exemplars/{id}."""
    return Call("GET", f"v1/exemplars/{quote(exemplar_id, safe='')}")


def info() -> Call:
    """GET /v1/info."""
    return Call("GET", "v1/info")


def readiness() -> Call:
    """GET /readyz."""
    return Call("GET", "readyz")


def _query(parameters: PoseParameters) -> dict[str, str]:
    return {name: _text(value) for name, value in parameters.items() if value is not None}


def _text(value: object) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, Iterable) and not isinstance(value, str):
        return ",".join(map(str, value))
    return str(value)
