"""Everything the service refuses, as one tree.

::

    PoseMatchError
    ├── StartupError                 the service cannot start; read by the `posematch` command
    └── RequestError                 one request cannot be answered; becomes problem+json
        ├── EmptyBodyError               400
        ├── MalformedBodyError           400
        ├── MalformedHttpError           400
        ├── PreflightRefusedError        400
        ├── UnauthorizedError            401
        ├── ExemplarNotFoundError        404
        ├── UploadTooSlowError           408
        ├── BodyTooLargeError            413
        ├── TooManyPixelsError           413
        ├── UnsupportedImageTypeError    415
        ├── UndecodableImageError        422
        ├── InvalidInputError            422
        ├── QuotaExceededError           429
        ├── HeadTooLargeError            431
        ├── OverloadedError              503
        ├── LibraryUnavailableError      503
        └── NotReadyError                503

``RequestError.detail`` is written for the client. What only the log may know goes into the
exception's cause (``raise ... from``) and never into the answer.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import ClassVar

PROBLEM_MEDIA_TYPE = "application/problem+json"
PROBLEM_TYPE_PREFIX = "urn:posematch:problem:"


class PoseMatchError(Exception):
    """Base of every error the service raises on purpose."""


class StartupError(PoseMatchError):
    """Settings, model or library make starting impossible; the message says what to mend."""


class RequestError(PoseMatchError):
    """One request cannot be answered.

    ``slug`` is the stable part of the problem's ``type``; ``extra`` holds the problem's extension
    members; ``headers`` go onto the response.
    """

    status: ClassVar[int] = 500
    slug: ClassVar[str] = "internal-error"
    title: ClassVar[str] = "Internal error"
    closes_connection: ClassVar[bool] = False

    def __init__(
        self,
        detail: str,
        *,
        extra: Mapping[str, object] | None = None,
        headers: Mapping[str, str] | None = None,
    ) -> None:
        super().__init__(detail)
        self.detail = detail
        self.extra = dict(extra or {})
        self.headers = dict(headers or {})
        if self.closes_connection:
            # The rest of the body is still on the wire: do not read it as the next request.
            self.headers["Connection"] = "close"

    @property
    def type_uri(self) -> str:
        """The problem's ``type``, stable across versions."""
        return PROBLEM_TYPE_PREFIX + self.slug

    def problem(self, request_id: str) -> dict[str, object]:
        """The problem details (RFC 9457) of this error in the request of that id."""
        return {
            "type": self.type_uri,
            "title": self.title,
            "status": self.status,
            "detail": self.detail,
            "request_id": request_id,
            **self.extra,
        }


def encode_problem(problem: Mapping[str, object]) -> bytes:
    """Problem details as a body of ``PROBLEM_MEDIA_TYPE``."""
    return json.dumps(problem, ensure_ascii=False, separators=(",", ":")).encode()


class EmptyBodyError(RequestError):
    """No bytes were sent."""

    status = 400
    slug = "empty-body"
    title = "Empty body"


class MalformedBodyError(RequestError):
    """The envelope of the body (multipart, JSON) cannot be read."""

    status = 400
    slug = "malformed-body"
    title = "Malformed body"


class MalformedHttpError(RequestError):
    """The bytes on the connection are no HTTP."""

    status = 400
    slug = "malformed-http"
    title = "Malformed HTTP"
    closes_connection = True


class PreflightRefusedError(RequestError):
    """A page of another origin asked for what ``POSEMATCH_CORS_ORIGINS`` does not allow."""

    status = 400
    slug = "preflight-refused"
    title = "Cross-origin request refused"


class UnauthorizedError(RequestError):
    """API keys are on and none, or a wrong one, was given."""

    status = 401
    slug = "unauthorized"
    title = "API key missing or wrong"
    closes_connection = True

    def __init__(self, detail: str) -> None:
        super().__init__(detail, headers={"WWW-Authenticate": 'Bearer realm="posematch"'})


class ExemplarNotFoundError(RequestError):
    """The library has no exemplar of that id."""

    status = 404
    slug = "exemplar-not-found"
    title = "Exemplar not found"


class UploadTooSlowError(RequestError):
    """The head or the body did not arrive in time."""

    status = 408
    slug = "upload-too-slow"
    title = "Upload too slow"
    closes_connection = True


class BodyTooLargeError(RequestError):
    """The body is over the limit; it was not read further."""

    status = 413
    slug = "body-too-large"
    title = "Body too large"
    closes_connection = True

    def __init__(self, limit_bytes: int) -> None:
        super().__init__(
            f"the body is larger than {limit_bytes} bytes", extra={"limit_bytes": limit_bytes}
        )


class TooManyPixelsError(RequestError):
    """The image's header promises more pixels than are decoded."""

    status = 413
    slug = "too-many-pixels"
    title = "Too many pixels"

    def __init__(self, width_px: int, height_px: int, limit_px: int) -> None:
        super().__init__(
            f"the image has {width_px} x {height_px} pixels, more than {limit_px}",
            extra={"width_px": width_px, "height_px": height_px, "limit_px": limit_px},
        )


class UnsupportedImageTypeError(RequestError):
    """The bytes are of no accepted image type."""

    status = 415
    slug = "unsupported-image-type"
    title = "Unsupported image type"

    def __init__(self, found: str | None, accepted: Sequence[str]) -> None:
        what = f"this looks like {found}" if found else "the type of the image is not recognised"
        super().__init__(
            f"{what}; accepted are {', '.join(accepted)}",
            extra={"accepted_types": list(accepted)},
            headers={"Accept": ", ".join(accepted)},
        )


class UndecodableImageError(RequestError):
    """The bytes claim an accepted type and cannot be decoded as it."""

    status = 422
    slug = "undecodable-image"
    title = "Image cannot be decoded"


class InvalidInputError(RequestError):
    """A parameter or a field has a value that makes no sense.

    ``errors`` lists them as ``{"where": ..., "message": ...}``.
    """

    status = 422
    slug = "invalid-input"
    title = "Invalid input"

    def __init__(self, errors: Sequence[tuple[str, str]]) -> None:
        super().__init__(
            "; ".join(f"{where}: {message}" for where, message in errors),
            extra={"errors": [{"where": where, "message": text} for where, text in errors]},
        )


class QuotaExceededError(RequestError):
    """The key has used up its requests for now."""

    status = 429
    slug = "quota-exceeded"
    title = "Quota exceeded"
    closes_connection = True

    def __init__(self, retry_after_s: int) -> None:
        super().__init__(
            f"too many requests with this key; try again in {retry_after_s} s",
            headers={"Retry-After": str(retry_after_s)},
        )


class HeadTooLargeError(RequestError):
    """The request's line and headers do not end."""

    status = 431
    slug = "head-too-large"
    title = "Head too large"
    closes_connection = True

    def __init__(self, limit_bytes: int) -> None:
        super().__init__(f"the head is larger than {limit_bytes} bytes")


class OverloadedError(RequestError):
    """No permit is free, or waiting for one would break the deadline."""

    status = 503
    slug = "overloaded"
    title = "At capacity"

    def __init__(self, reason: str, retry_after_s: int) -> None:
        super().__init__(
            f"the service is at capacity; try again in {retry_after_s} s",
            extra={"reason": reason},
            headers={"Retry-After": str(retry_after_s)},
        )
        self.reason = reason


class LibraryUnavailableError(RequestError):
    """The engine that searches the library does not answer; it may well do so in a moment."""

    status = 503
    slug = "library-unavailable"
    title = "Library unavailable"

    def __init__(self, retry_after_s: int) -> None:
        super().__init__(
            f"the library's index does not answer; try again in {retry_after_s} s",
            headers={"Retry-After": str(retry_after_s)},
        )


class NotReadyError(RequestError):
    """The model and the library are not loaded yet, or the service is shutting down."""

    status = 503
    slug = "not-ready"
    title = "Not ready"
    closes_connection = True

    def __init__(self, detail: str) -> None:
        super().__init__(detail, headers={"Retry-After": "1"})
