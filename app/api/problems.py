"""Errors as problem+json (RFC 9457): one shape for everything that is refused."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, ValidationError
from starlette.exceptions import HTTPException

from app.admission import ClientGoneError
from app.errors import (
    PROBLEM_MEDIA_TYPE,
    PROBLEM_TYPE_PREFIX,
    InvalidInputError,
    LibraryUnavailableError,
    OverloadedError,
    RequestError,
    encode_problem,
)
from app.schemas import Problem

logger = logging.getLogger("posematch")

CLIENT_CLOSED_REQUEST = 499
"""The status logged, never sent, when the client has gone (nginx's convention)."""


def problem_of(error: RequestError, request_id: str) -> Problem:
    """The problem details of a refusal, as a part of an answer."""
    return Problem.model_validate(error.problem(request_id))


def problem_response(error: RequestError, request_id: str) -> Response:
    """The answer to a refused request."""
    return _response(error.problem(request_id), error.status, error.headers)


def invalid_input(error: ValidationError | RequestValidationError) -> InvalidInputError:
    """Pydantic's complaints, naming each value by where the client wrote it."""
    # FastAPI's begin with the part of the request: "query", which is a name to the client too.
    first = 1 if isinstance(error, RequestValidationError) else 0
    return InvalidInputError(
        [
            (
                ".".join(map(str, item["loc"][first:])) or "request",
                item["msg"].removeprefix("Value error, "),
            )
            for item in error.errors()
        ]
    )


def install(app: FastAPI) -> None:
    """Answer every error of ``app`` as a problem."""
    app.add_exception_handler(RequestError, _on_request_error)
    app.add_exception_handler(RequestValidationError, _on_validation_error)
    app.add_exception_handler(HTTPException, _on_http_exception)
    app.add_exception_handler(ClientGoneError, _on_client_gone)


async def _on_request_error(request: Request, error: Exception) -> Response:
    assert isinstance(error, RequestError)
    if isinstance(error, OverloadedError):
        request.app.state.service.metrics.refused.labels(error.reason).inc()
    if isinstance(error, LibraryUnavailableError):
        request.app.state.service.metrics.refused.labels("library").inc()
    if error.__cause__ is not None:
        logger.info(
            "%s: %s",
            error.slug,
            error.__cause__,
            extra={"request_id": request.state.request_id},
        )
    return problem_response(error, request.state.request_id)


async def _on_validation_error(request: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)
    return await _on_request_error(request, invalid_input(error))


async def _on_http_exception(request: Request, error: Exception) -> Response:
    """Starlette's own refusals: unknown paths and wrong verbs."""
    assert isinstance(error, HTTPException)
    status = HTTPStatus(error.status_code)
    problem = {
        "type": PROBLEM_TYPE_PREFIX + status.phrase.lower().replace(" ", "-"),
        "title": status.phrase,
        "status": status.value,
        "detail": f"{request.method} {request.url.path}: {status.description or status.phrase}",
        "request_id": request.state.request_id,
    }
    headers = dict(error.headers or {})
    if headers.get("Allow") == "GET":
        headers["Allow"] = "GET, HEAD"  # RequestContextMiddleware answers it wherever GET is
    return _response(problem, status.value, headers)


async def _on_client_gone(request: Request, _: Exception) -> Response:
    request.app.state.service.metrics.abandoned.inc()
    return Response(status_code=CLIENT_CLOSED_REQUEST)


def _response(problem: Mapping[str, object], status: int, headers: Mapping[str, str]) -> Response:
    return Response(encode_problem(problem), status, headers, PROBLEM_MEDIA_TYPE)


def describe_ok(model: type[BaseModel], text: str) -> dict[int | str, dict[str, Any]]:
    """OpenAPI response of a success."""
    return {200: {"model": model, "description": text}}


def describe(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """OpenAPI responses of these error statuses."""
    return {
        status: {
            "description": HTTPStatus(status).phrase,
            "content": {
                PROBLEM_MEDIA_TYPE: {
                    "schema": {"$ref": "#/components/schemas/Problem"},
                    "example": _EXAMPLES.get(status, _EXAMPLES[422]) | {"status": status},
                }
            },
        }
        for status in statuses
    }


def _example(slug: str, title: str, detail: str, **extra: object) -> dict[str, object]:
    return {
        "type": PROBLEM_TYPE_PREFIX + slug,
        "title": title,
        "detail": detail,
        "request_id": "0b6f6cbd7c1f4e7f8f1a3cf1d2e5a9b4",
        **extra,
    }


_EXAMPLES = {
    400: _example("empty-body", "Empty body", "the body is empty; send the bytes of an image"),
    401: _example(
        "unauthorized",
        "API key missing or wrong",
        "give a key as 'Authorization: Bearer KEY' or 'X-API-Key: KEY'",
    ),
    404: _example(
        "exemplar-not-found", "Exemplar not found", "the library has no exemplar of this id"
    ),
    408: _example("upload-too-slow", "Upload too slow", "the body was not complete after 20 s"),
    413: _example(
        "too-many-pixels",
        "Too many pixels",
        "the image has 20000 x 20000 pixels, more than 50000000",
        width_px=20000,
        height_px=20000,
        limit_px=50000000,
    ),
    415: _example(
        "unsupported-image-type",
        "Unsupported image type",
        "this looks like GIF; accepted are image/jpeg, image/png, image/webp",
        accepted_types=["image/jpeg", "image/png", "image/webp"],
    ),
    422: _example(
        "invalid-input",
        "Invalid input",
        "max_people: Input should be less than or equal to 10",
        errors=[{"where": "max_people", "message": "Input should be less than or equal to 10"}],
    ),
    429: _example(
        "quota-exceeded", "Quota exceeded", "too many requests with this key; try again in 2 s"
    ),
    503: _example(
        "overloaded",
        "At capacity",
        "the service is at capacity; try again in 1 s",
        reason="deadline",
    ),
}
