"""The client for asynchronous code, on asyncio or trio."""

from __future__ import annotations

from collections.abc import Iterable
from types import TracebackType
from typing import Self, Unpack, cast

import anyio
import anyio.to_thread
import httpx

from posematch_client import calls, types
from posematch_client.calls import Call, Photo
from posematch_client.retries import Attempts, Retries, parsed


class AsyncClient:
    """Asks a posematch service; see ``Client``. Use it in an ``async with`` block."""

    def __init__(
        self,
        url: str,
        *,
        api_key: str | None = None,
        retries: Retries | None = None,
        transport: httpx.AsyncBaseTransport | None = None,
    ) -> None:
        self._retries = retries or Retries()
        headers = calls.headers(api_key)
        self._http = httpx.AsyncClient(base_url=url, headers=headers, transport=transport)

    async def poses(
        self, photo: Photo, **parameters: Unpack[types.PoseParameters]
    ) -> types.PosesAnswer:
        """Everybody's pose in a photo: its bytes, its path, or an open file."""
        data = await anyio.to_thread.run_sync(calls.read, photo)
        return cast(types.PosesAnswer, await self._ask(calls.poses(data, parameters)))

    async def poses_batch(
        self, photos: Iterable[Photo], **parameters: Unpack[types.PoseParameters]
    ) -> types.BatchAnswer:
        """The same of several photos; each has an answer or a problem, in their order."""
        data = [await anyio.to_thread.run_sync(calls.read, photo) for photo in photos]
        return cast(types.BatchAnswer, await self._ask(calls.poses_batch(data, parameters)))

    async def lift(self, request: types.LiftRequest) -> types.LiftAnswer:
        """3D of people whose 2D joints are known."""
        return cast(types.LiftAnswer, await self._ask(calls.lift(request)))

    async def exemplar(self, exemplar_id: str) -> types.ExemplarAnswer:
        """One exemplar of the library: its pose in its own frame and where it is from."""
        return cast(types.ExemplarAnswer, await self._ask(calls.exemplar(exemplar_id)))

    async def info(self) -> types.InfoAnswer:
        """Version, model, library and limits of the service."""
        return cast(types.InfoAnswer, await self._ask(calls.info()))

    async def wait_until_ready(self) -> None:
        """Return as soon as photos can be sent; an error when the deadline passes before."""
        await self._ask(calls.readiness(), self._retries.until_deadline())

    async def _ask(self, call: Call, retries: Retries | None = None) -> object:
        attempts = Attempts(retries or self._retries)
        while True:
            try:
                response = await self._http.request(
                    call.method, call.path, timeout=attempts.left_s(), **call.keywords
                )
            except httpx.RequestError as error:
                pause_s = attempts.pause_after_failure(error)
            else:
                again_s = attempts.pause_after(response)
                if again_s is None:
                    return parsed(response)
                pause_s = again_s
            await anyio.sleep(pause_s)

    async def aclose(self) -> None:
        """Close the connections."""
        await self._http.aclose()

    async def __aenter__(self) -> Self:
        """Start a block at whose end the connections are closed."""
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close the connections."""
        await self.aclose()
