"""One HTTP connection: uvicorn's, with the waits and sizes bounded that uvicorn leaves open.

========================================= ==================================================
a head that does not arrive               408 after ``patience_s``, closed without an answer
                                          if not a byte of it came
a head that does not end                  431 after ``MAX_HEAD_BYTES``
bytes that are no HTTP                    400
the rest of a body refused unread         read and dropped for ``patience_s``, then closed; so it
                                          is where the connection ends with the answer, and
                                          there after ``MAX_DROPPED_BYTES`` at the latest
an answer that the client does not take   closed after ``patience_s``
========================================= ==================================================

Requests that came whole before any of these have their answers first.

Under overload nearly all requests are refused, and what a refusal costs is taken from the answers:
those that can be given from the request's head alone (``app.api.shedding``) are written from here,
without a task and a walk through the application. And no answer is sent with Python's lock held
(``_Sender``): who is woken by it may take the processor, and all workers would wait.

The errors of the table arise before there is a request, so they are sent from here, with a request
id of their own, which the log has too.
"""

from __future__ import annotations

import asyncio
import logging
import os
import re
from collections.abc import Callable
from contextlib import suppress
from email.utils import formatdate
from http import HTTPStatus
from typing import Any, ClassVar, cast

from starlette.types import Scope
from uvicorn._types import ASGI3Application
from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol, RequestResponseCycle

from app.errors import (
    PROBLEM_MEDIA_TYPE,
    HeadTooLargeError,
    MalformedHttpError,
    RequestError,
    UploadTooSlowError,
    encode_problem,
)
from app.observability import new_request_id

logger = logging.getLogger("posematch.connection")

EarlyAnswer = Callable[[Scope], bytes | None]
"""The whole response to a request of which the head is read, if there is one already."""

MAX_HEAD_BYTES = 65_536
MAX_DROPPED_BYTES = 12_000_000
"""Of an upload that is answered and closed: most clients look for the answer before that."""
_UPGRADE = re.compile(rb"(?im)^Upgrade(?=[ \t]*:)")
"""Offers of h2c, as Java's client makes with every request, may be ignored (RFC 9110, 7.8), but the
parser would take the body for the other protocol: it must not see them."""


class Connection(HttpToolsProtocol):
    """uvicorn's protocol with patience; make a class with ``connection_class``."""

    patience_s: ClassVar[float]
    early_answer: ClassVar[EarlyAnswer]

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Start waiting for the first head."""
        plain = transport.get_extra_info("sslcontext") is None
        sender = _Sender(transport, self.loop, self._awaits_rest) if plain else transport
        super().connection_made(sender)
        self._timers: dict[str, asyncio.TimerHandle] = {}
        self._running: RequestResponseCycle | None = None
        self._head_bytes = 0
        self._dropped_bytes = 0
        self._in_body = False
        self._last_word: RequestError | None = None
        self._expect("head", self.transport.close)

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget all timers, and answers under way."""
        for name in tuple(self._timers):
            self._arrived(name)
        self._disconnect()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Feed the parser; a head may be split over many pieces but not over too many bytes."""
        if self._last_word is not None:
            return  # nothing more is answered
        if self.transport.is_closing():  # for ours, the rest of an upload that is answered
            self._dropped_bytes += len(data)
            if self._dropped_bytes > MAX_DROPPED_BYTES:
                self._give_up()
                return
        if not self._in_body:
            end = data.find(b"\r\n\r\n")
            end = len(data) if end < 0 else end
            if _UPGRADE.search(data, 0, end):
                data = _UPGRADE.sub(b"X-Grade", data[:end]) + data[end:]
        head = self._timers.get("head")
        super().data_received(data)
        if head is not None and head is self._timers.get("head"):  # what began here counts anew
            self._head_bytes += len(data)
            if self._head_bytes > MAX_HEAD_BYTES:
                self._end(HeadTooLargeError(MAX_HEAD_BYTES))

    def on_message_begin(self) -> None:
        """A head begins; the parser calls this."""
        super().on_message_begin()
        self._unset_keepalive_if_required()
        self._head_bytes = 0
        why = f"the head of the request was not complete after {self.patience_s:g} s"
        self._expect("head", lambda: self._end(UploadTooSlowError(why)))

    def on_headers_complete(self) -> None:
        """The head is complete; the parser calls this."""
        self._arrived("head")
        self._in_body = True
        super().on_headers_complete()

    def on_message_complete(self) -> None:
        """The body is complete; the parser calls this."""
        self._arrived("rest")
        self._in_body = False
        super().on_message_complete()
        self.cycle.more_body = False
        if self.transport.is_closing():
            self.transport.close()
        elif self.cycle.response_complete and self.timeout_keep_alive_task is None:
            # uvicorn has forgotten it with the first piece that came after the answer.
            self.timeout_keep_alive_task = self.loop.call_later(
                self.timeout_keep_alive, self.timeout_keep_alive_handler
            )

    def on_response_complete(self) -> None:
        """The answer is written, perhaps before its request was read to the end."""
        answered = self._running
        super().on_response_complete()
        if answered is not None and answered.more_body and not self.transport.is_closing():
            self._expect("rest", self._give_up)
        word, self._last_word = self._last_word, None
        if word is not None:
            self._end(word)

    def shutdown(self) -> None:
        """The service ends, and waits for answers only."""
        super().shutdown()
        if self.transport.is_closing():
            self.transport.close()

    def pause_writing(self) -> None:
        """The client does not read as fast as it is answered."""
        super().pause_writing()
        self._expect("reader", self._give_up)

    def resume_writing(self) -> None:
        """The client has read on."""
        self._arrived("reader")
        super().resume_writing()

    def send_400_response(self, msg: str) -> None:
        """What is no HTTP is answered as a problem, too."""
        self._end(MalformedHttpError(msg))

    def _expect(self, name: str, otherwise: Callable[[], None]) -> None:
        self._arrived(name)
        self._timers[name] = self.loop.call_later(self.patience_s, otherwise)

    def _arrived(self, name: str) -> None:
        timer = self._timers.pop(name, None)
        if timer is not None:
            timer.cancel()

    def _end(self, error: RequestError) -> None:
        """Answer with a problem and close, once the requests before are answered."""
        if self.transport.is_closing():
            self.transport.close()
            return
        cycle, running = self.cycle, self._running
        own = cycle if cycle is not None and cycle.more_body else None
        if self.pipeline and self.pipeline[0][0] is own:
            self.pipeline.popleft()  # this is its answer
        if running is not None and running is not own and not running.response_complete:
            self._last_word = error
            return
        if own is None or not own.response_started:
            request_id = new_request_id()
            client = self.client[0] if self.client else None
            logger.info(
                error.detail,
                extra={"request_id": request_id, "status": error.status, "client": client},
            )
            self.transport.write(_encoded(error, request_id))
        self._disconnect()
        self.transport.close()

    def _give_up(self) -> None:
        """Drop the connection, and all that waits to be written to it."""
        self._disconnect()
        self.transport.abort()

    def _start_asgi_task(self, cycle: RequestResponseCycle, app: ASGI3Application) -> None:
        self._running = cycle
        # With others queued behind it one after the other would be answered from within the last.
        if not self.pipeline and not self.flow.write_paused:
            answer = type(self).early_answer(cast(Scope, cycle.scope))
            if answer is not None:
                self._answer_early(cycle, answer)
                return
        super()._start_asgi_task(cycle, app)

    def _answer_early(self, cycle: RequestResponseCycle, answer: bytes) -> None:
        if not cycle.keep_alive:
            answer = answer.replace(b"\r\n\r\n", b"\r\nconnection: close\r\n\r\n", 1)
        self.transport.write(answer)
        if isinstance(self.transport, _Sender):
            self.transport.flush()
        cycle.response_started = cycle.response_complete = True
        if not cycle.keep_alive:
            self.transport.close()
        cycle.on_response()

    def _awaits_rest(self) -> bool:
        """Wait for the rest of a body that is answered already; whether there is any to come."""
        cycle = self._running
        if cycle is None or not (cycle.response_complete and cycle.more_body):
            return False
        self._expect("rest", self._give_up)
        self.flow.resume_reading()
        return True

    def _disconnect(self) -> None:
        """Tell the requests there are that their answers have nowhere to go.

        uvicorn tells the one that came last, and that when the connection is lost; the one that is
        being answered may wake up before that, and would write to the closed transport.
        """
        for cycle in (self._running, self.cycle):
            if cycle is not None:
                cycle.disconnected = True
                cycle.message_event.set()


class _Sender(asyncio.Transport):
    """A transport that sends what one turn of the event loop writes in one go, without the lock.

    uvloop's own holds Python's lock while the kernel delivers the data, which on one machine may
    well include the receiver's turn.
    """

    def __init__(
        self,
        transport: asyncio.Transport,
        loop: asyncio.AbstractEventLoop,
        awaits_rest: Callable[[], bool],
    ) -> None:
        """``awaits_rest`` is asked before closing: if so, ``close`` will be called once more."""
        super().__init__()
        self._transport = transport
        self._loop = loop
        self._awaits_rest = awaits_rest
        self._half_closed = False
        self._socket: int = transport.get_extra_info("socket").fileno()
        self._written: list[bytes] = []
        # Whatever is left to it is what the client does not take: the protocol has to know.
        transport.set_write_buffer_limits(high=0)

    def write(self, data: bytes | bytearray | memoryview[Any]) -> None:
        """Send ``data`` before the loop's next turn."""
        if not self._written:
            self._loop.call_soon(self.flush)
        self._written.append(bytes(data))

    def close(self) -> None:
        """Send what is written, then close: at first one side, while the client is still sending.

        A socket closed with something unread, or still to come, resets the connection: the client
        would fail amidst its upload and might never see that it is answered.
        """
        self.flush()
        if self.is_closing() or not self._awaits_rest():
            self._transport.close()
        else:
            self._half_closed = True
            self._transport.write_eof()

    def abort(self) -> None:
        """Close at once."""
        self._written.clear()
        self._transport.abort()

    def is_closing(self) -> bool:
        """Whether the connection is closed or about to be."""
        return self._half_closed or self._transport.is_closing()

    def pause_reading(self) -> None:
        """Receive no more for now."""
        self._transport.pause_reading()

    def resume_reading(self) -> None:
        """Receive again."""
        self._transport.resume_reading()

    def get_extra_info(self, name: str, default: Any = None) -> Any:
        """What the transport knows of its connection."""
        return self._transport.get_extra_info(name, default)

    def flush(self) -> None:
        """Send what is written now."""
        data = b"".join(self._written)
        self._written.clear()
        if not data or self.is_closing():
            return
        sent = 0
        if not self._transport.get_write_buffer_size():
            # What the socket does not take, its transport waits for; so it does with its errors.
            with suppress(OSError):
                sent = os.write(self._socket, data)
        if sent < len(data):
            self._transport.write(data[sent:])


def connection_class(patience_s: float, early_answer: EarlyAnswer) -> type[Connection]:
    """The class to give to uvicorn."""
    members = {"patience_s": patience_s, "early_answer": staticmethod(early_answer)}
    return type("Connection", (Connection,), members)


def _encoded(error: RequestError, request_id: str) -> bytes:
    """The whole response; the connection is closed behind it."""
    body = encode_problem(error.problem(request_id))
    head = (
        f"HTTP/1.1 {error.status} {HTTPStatus(error.status).phrase}\r\n"
        f"date: {formatdate(usegmt=True)}\r\n"  # which 4xx must have (RFC 9110, 6.6.1)
        f"content-type: {PROBLEM_MEDIA_TYPE}\r\n"
        f"content-length: {len(body)}\r\n"
        f"x-request-id: {request_id}\r\n"
        "server-timing: app;dur=0\r\n"
        "x-content-type-options: nosniff\r\n"
        "connection: close\r\n\r\n"
    )
    return head.encode() + body
