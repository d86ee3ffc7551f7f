"""Reading request bodies into memory: bounded in size and time, never onto the disk."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

from python_multipart.exceptions import FormParserError
from python_multipart.multipart import MultipartParser, parse_options_header
from starlette.requests import Request
from starlette.types import Receive

from app.admission import Arrival, ClientGoneError
from app.errors import (
    BodyTooLargeError,
    EmptyBodyError,
    InvalidInputError,
    MalformedBodyError,
    OverloadedError,
    UploadTooSlowError,
)

if TYPE_CHECKING:
    from python_multipart.multipart import MultipartCallbacks

_MAX_PARTS = 1024


@dataclass(frozen=True)
class Part:
    """One part of a multipart body: its field, the file name if any, and its bytes."""

    field: str
    filename: str | None
    data: bytes


class UploadMemory:
    """Bounds the bytes of all bodies held at once, so that many uploads cannot exhaust memory."""

    def __init__(self, limit_bytes: int) -> None:
        self._limit_bytes = limit_bytes
        self._held_bytes = 0

    @property
    def held_bytes(self) -> int:
        """Bytes of the bodies being received, waiting or computed."""
        return self._held_bytes

    @contextmanager
    def share(self) -> Iterator[Callable[[int], None]]:
        """For one request: a function to call with the size of each piece before it is kept.

        It raises ``OverloadedError`` when there is no room. Everything is given back at the end.
        """
        mine = 0

        def take(size: int) -> None:
            nonlocal mine
            if self._held_bytes + size > self._limit_bytes:
                raise OverloadedError("upload_memory", 1)
            self._held_bytes += size
            mine += size

        try:
            yield take
        finally:
            self._held_bytes -= mine


async def read_body(
    request: Request,
    *,
    limit_bytes: int,
    timeout_s: float,
    take: Callable[[int], None],
    wanted: str = "the bytes of an image",
) -> bytes:
    """The whole body; ``take`` is asked for every piece of it (see ``UploadMemory``).

    ``wanted`` is what to send, for whoever sent nothing.

    Raises ``BodyTooLargeError`` as soon as the stated or the counted length passes the limit,
    ``UploadTooSlowError`` when it is not complete in time, ``EmptyBodyError``, or
    ``ClientGoneError``.
    """
    stated = request.headers.get("content-length", "")
    if stated.isdecimal() and int(stated) > limit_bytes:
        raise BodyTooLargeError(limit_bytes)
    chunks: list[bytes] = []
    size = 0
    try:
        async with asyncio.timeout(timeout_s):
            more = True
            while more:
                message = await request.receive()
                if message["type"] == "http.disconnect":
                    raise ClientGoneError
                chunk = message.get("body", b"")
                more = message.get("more_body", False)
                size += len(chunk)
                if size > limit_bytes:
                    raise BodyTooLargeError(limit_bytes)
                take(len(chunk))
                chunks.append(chunk)
    except TimeoutError:
        raise UploadTooSlowError(f"the body was not complete after {timeout_s:g} s") from None
    if size == 0:
        raise EmptyBodyError(f"the body is empty; send {wanted}")
    return b"".join(chunks)


class WatchedArrival:
    """An ``Arrival`` for the time of a ``with`` block: notices when the client leaves.

    To be entered when the body is complete; its deadline counts from there.
    """

    def __init__(self, receive: Receive) -> None:
        self._receive = receive
        self._watch: asyncio.Task[None] | None = None

    def __enter__(self) -> Arrival:
        """Start watching."""
        self._watch = asyncio.create_task(_until_gone(self._receive))
        return Arrival(time.monotonic(), self._watch)

    def __exit__(self, *_: object) -> None:
        """Stop watching."""
        if self._watch is not None:
            self._watch.cancel()


async def _until_gone(receive: Receive) -> None:
    while (await receive())["type"] != "http.disconnect":
        pass


def is_multipart(content_type: str | None) -> bool:
    """Whether a Content-Type announces a form with files."""
    return (content_type or "").partition(";")[0].strip().lower() == "multipart/form-data"


def photo_bytes(body: bytes, content_type: str | None) -> bytes:
    """The photo in ``body``: all of it, or the field ``image`` of a multipart form."""
    if not is_multipart(content_type):
        return body
    images = image_parts(body, content_type)
    if len(images) != 1:
        raise InvalidInputError([("image", "give one image; /v1/poses/batch takes several")])
    if not images[0].data:
        raise EmptyBodyError("the field 'image' is empty")
    return images[0].data


def image_parts(body: bytes, content_type: str | None) -> list[Part]:
    """The parts of field ``image``, in order.

    ``InvalidInputError`` when there is none, or another field, which would be ignored.
    """
    parts = parse_multipart(body, content_type)
    images = [part for part in parts if part.field == "image"]
    if not images:
        given = ", ".join(sorted({part.field for part in parts})) or "no fields"
        raise InvalidInputError([("image", f"the form has no field 'image', but {given}")])
    others = sorted({part.field for part in parts} - {"image"})
    if others:
        why = "the form may have the field 'image' only; parameters go into the URL's query"
        raise InvalidInputError([(field, why) for field in others])
    return images


def parse_multipart(body: bytes, content_type: str | None) -> list[Part]:
    """Split a multipart/form-data body held in memory (RFC 7578).

    Raises ``MalformedBodyError`` when the boundary is missing, the syntax is wrong, or the closing
    boundary never comes.
    """
    _, options = parse_options_header(content_type)
    boundary = options.get(b"boundary", b"")
    if not 0 < len(boundary) <= 70:
        raise MalformedBodyError("the Content-Type states no usable multipart boundary")
    collector = _PartCollector()
    try:
        parser = MultipartParser(boundary, collector.callbacks())
        parser.write(body)
    except FormParserError as error:
        raise MalformedBodyError("the multipart body cannot be parsed") from error
    if not collector.ended:
        raise MalformedBodyError("the multipart body is not closed by its boundary")
    return collector.parts


class _PartCollector:
    """Gathers the parser's callbacks into parts."""

    def __init__(self) -> None:
        self.parts: list[Part] = []
        self.ended = False
        self._name = bytearray()
        self._value = bytearray()
        self._disposition = b""
        self._chunks: list[bytes] = []

    def callbacks(self) -> MultipartCallbacks:
        return {
            "on_part_begin": self._begin,
            "on_header_begin": self._header_begin,
            "on_header_field": lambda data, start, end: self._name.extend(data[start:end]),
            "on_header_value": lambda data, start, end: self._value.extend(data[start:end]),
            "on_header_end": self._header_end,
            "on_part_data": lambda data, start, end: self._chunks.append(data[start:end]),
            "on_part_end": self._end,
            "on_end": self._finish,
        }

    def _begin(self) -> None:
        if len(self.parts) >= _MAX_PARTS:
            raise MalformedBodyError(f"the multipart body has more than {_MAX_PARTS} parts")
        self._disposition = b""
        self._chunks = []

    def _header_begin(self) -> None:
        self._name, self._value = bytearray(), bytearray()

    def _header_end(self) -> None:
        if self._name.lower() == b"content-disposition":
            self._disposition = bytes(self._value)

    def _end(self) -> None:
        _, options = parse_options_header(self._disposition)
        filename = options.get(b"filename")
        self.parts.append(
            Part(
                field=options.get(b"name", b"").decode("utf-8", "replace"),
                filename=None if filename is None else filename.decode("utf-8", "replace"),
                data=b"".join(self._chunks),
            )
        )

    def _finish(self) -> None:
        self.ended = True
