"""The client for ordinary code."""

from __future__ import annotations

import time
from collections.abc import Iterable
from types import TracebackType
from typing import Self, Unpack, cast

import httpx

from posematch_client import calls, types
from posematch_client.calls import Call, Photo
from posematch_client.retries import Attempts, Retries, parsed


class Client:
    """Asks a posematch service; safe to share between threads. Use it in a ``with`` block.

    Args:
        url: where the service is, such as ``http://127.0.0.1:8000``.
        api_key: when the service wants one, in ASCII; ``ValueError`` otherwise.
        retries: how patient to be with a busy or absent service.
        transport: another way to send requests (tests, proxies); see httpx.

    Every method raises ``RefusedError`` when the service answers with an error, and
    ``UnreachableError`` when there is no answer before the deadline.

    """

    def __init__(
        self,
        url: str,
        *,
        api_key: str | None = None,
        retries: Retries | None = None,
        transport: httpx.BaseTransport | None = None,
    ) -> None:
        self._retries = retries or Retries()
        headers = calls.headers(api_key)
        self._http = httpx.Client(base_url=url, headers=headers, transport=transport)

    def poses(self, photo: Photo, **parameters: Unpack[types.PoseParameters]) -> types.PosesAnswer:
        """Everybody's pose in a photo: its bytes, its path, or an open file."""
        call = calls.poses(calls.read(photo), parameters)
        return cast(types.PosesAnswer, self._ask(call))

    def poses_batch(
        self, photos: Iterable[Photo], **parameters: Unpack[types.PoseParameters]
    ) -> types.BatchAnswer:
        """The same of several photos; each has an answer or a problem, in their order."""
        call = calls.poses_batch(map(calls.read, photos), parameters)
        return cast(types.BatchAnswer, self._ask(call))

    def lift(self, request: types.LiftRequest) -> types.LiftAnswer:
        """3D of people whose 2D joints are known."""
        return cast(types.LiftAnswer, self._ask(calls.lift(request)))

    def exemplar(self, exemplar_id: str) -> types.ExemplarAnswer:
        """One exemplar of the library: its pose in its own frame and where it is from."""
        return cast(types.ExemplarAnswer, self._ask(calls.exemplar(exemplar_id)))

    def info(self) -> types.InfoAnswer:
        """Version, model, library and limits of the service."""
        return cast(types.InfoAnswer, self._ask(calls.info()))

    def wait_until_ready(self) -> None:
        """Return as soon as photos can be sent; an error when the deadline passes before."""
        self._ask(calls.readiness(), self._retries.until_deadline())

    def _ask(self, call: Call, retries: Retries | None = None) -> object:
        attempts = Attempts(retries or self._retries)
        while True:
            try:
                response = self._http.request(
                    call.method, call.path, timeout=attempts.left_s(), **call.keywords
                )
            except httpx.RequestError as error:
                pause_s = attempts.pause_after_failure(error)
            else:
                again_s = attempts.pause_after(response)
                if again_s is None:
                    return parsed(response)
                pause_s = again_s
            time.sleep(pause_s)

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    def __enter__(self) -> Self:
        """Start a block at whose end the connections are closed."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close the connections."""
        self.close()
