"""What the routers share: the service's state, the loaded engine, the API key check."""

from __future__ import annotations

import hashlib
import hmac
from dataclasses import dataclass, field
from typing import Annotated

from fastapi import Depends, Request

from app.admission import Admission
from app.api.bodies import UploadMemory
from app.engine import Engine
from app.errors import (
    InvalidInputError,
    NotReadyError,
    QuotaExceededError,
    StartupError,
    UnauthorizedError,
)
from app.observability import Metrics
from app.quota import Quota
from app.settings import Settings


@dataclass
class Service:
    """The state of one application, kept on ``app.state.service``.

    ``engine`` is None until loaded; ``stopping`` is set when the shutdown begins;
    ``startup_error`` is why the service has to end before it was ready.
    """

    settings: Settings
    metrics: Metrics = field(default_factory=Metrics)
    admission: Admission = field(init=False)
    uploads: UploadMemory = field(init=False)
    quota: Quota | None = None
    engine: Engine | None = None
    stopping: bool = False
    startup_error: StartupError | None = None
    key_digests: tuple[bytes, ...] = field(init=False)

    def __post_init__(self) -> None:
        settings = self.settings
        self.admission = Admission(
            workers=settings.workers,
            queue_size=settings.queue_size,
            deadline_s=settings.deadline_ms / 1e3,
        )
        self.uploads = UploadMemory(settings.upload_memory_bytes)
        self.metrics.watch(
            running=lambda: self.admission.running,
            waiting=lambda: self.admission.waiting,
            upload_bytes=lambda: self.uploads.held_bytes,
        )
        self.key_digests = tuple(_digest(key.get_secret_value()) for key in settings.api_keys)
        if settings.quota_per_minute is not None:
            self.quota = Quota(self.key_digests, settings.quota_per_minute)


async def get_service(request: Request) -> Service:
    """The application's state."""
    service: Service = request.app.state.service
    return service


ServiceDep = Annotated[Service, Depends(get_service)]


async def authorise(request: Request, service: ServiceDep) -> None:
    """Check the API key and its quota, when keys are on.

    Every key is compared, by digests of equal length, so that the time taken tells nothing.
    """
    if not service.key_digests:
        return
    scheme, _, token = request.headers.get("authorization", "").partition(" ")
    given = token if scheme.lower() == "bearer" else request.headers.get("x-api-key", "")
    digest = _digest(given.strip())
    matches = [hmac.compare_digest(digest, key) for key in service.key_digests]
    if not any(matches):
        raise UnauthorizedError("give a key as 'Authorization: Bearer KEY' or 'X-API-Key: KEY'")
    if service.quota is not None:
        retry_after_s = service.quota.take(digest)
        if retry_after_s is not None:
            service.metrics.refused.labels("quota").inc()
            raise QuotaExceededError(retry_after_s)


async def each_once(request: Request) -> None:
    """No query parameter may be given twice: one of the two would be ignored."""
    names = [name for name, _ in request.query_params.multi_items()]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise InvalidInputError([(name, "is given more than once") for name in twice])


async def no_query(request: Request) -> None:
    """The request is all in the body: what is in the query would be ignored."""
    if names := sorted(request.query_params):
        raise InvalidInputError([(name, "belongs into the JSON body") for name in names])


async def get_engine(service: ServiceDep) -> Engine:
    """The loaded engine; ``NotReadyError`` until there is one, and while shutting down."""
    if service.stopping:
        raise NotReadyError("the service is shutting down")
    if service.engine is None:
        raise NotReadyError("the service is starting")
    return service.engine


EngineDep = Annotated[Engine, Depends(get_engine)]


def _digest(key: str) -> bytes:
    """SHA-256 of an API key: what is kept, compared and counted by."""
    return hashlib.sha256(key.encode("utf-8", "surrogateescape")).digest()
