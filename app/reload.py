"""Hot reload: at SIGHUP the library that now lies where the old one was takes over.

`posematch library build` puts a new library in the old one's place in one step; whoever serves it
keeps reading the old files until told. Then the new one is verified, opened and warmed beside the
old one, which answers meanwhile; the swap is one assignment. Requests under way keep the engine
they began with, and the old library's memory and files are let go with the last of them. A library
that cannot be used changes nothing: the log says why, and the metrics count it.
"""

from __future__ import annotations

import asyncio
import logging
import weakref

from app.api.deps import Service
from app.engine import Engine, reload_engine
from app.errors import StartupError
from app.version import VERSION

logger = logging.getLogger("posematch")


class Reloader:
    """Reloads the library of a service, one reload at a time; to be used on the event loop."""

    def __init__(self, service: Service) -> None:
        self._service = service
        self._task: asyncio.Task[None] | None = None
        self._again = False

    def request(self) -> None:
        """Reload now, or once more after the reload under way. While starting it is too early."""
        if self._service.engine is None or self._service.stopping:
            logger.warning("reload ignored: the service is starting or stopping")
        elif self._task is not None and not self._task.done():
            self._again = True
        else:
            self._task = asyncio.create_task(self._run())

    async def finish(self) -> None:
        """Wait until no reload is under way."""
        if self._task is not None:
            await self._task

    async def _run(self) -> None:
        self._again = True
        while self._again and not self._service.stopping:
            self._again = False
            await self._reload()

    async def _reload(self) -> None:
        service = self._service
        assert service.engine is not None
        logger.info("reloading the library")
        try:
            fresh = await asyncio.to_thread(reload_engine, service.engine, service.settings)
        except StartupError as error:
            self._refused(str(error))
        except Exception as error:
            logger.exception("unexpected error while reloading")
            self._refused(f"unexpected {type(error).__name__}: {error}")
        else:
            if fresh is None:
                logger.info("the library is the one in service")
                service.metrics.reloads.labels("unchanged").inc()
            elif service.stopping:
                fresh.library.close()
            else:
                self._swap(fresh)

    def _refused(self, why: str) -> None:
        logger.error("reload refused, the library in service stays: %s", why)
        self._service.metrics.reloads.labels("refused").inc()

    def _swap(self, fresh: Engine) -> None:
        service = self._service
        old = service.engine
        assert old is not None
        service.engine = fresh
        describe(service, fresh)
        service.metrics.reloads.labels("done").inc()
        sums = {"old": old.library.manifest.sha256, "new": fresh.library.manifest.sha256}
        logger.info("library reloaded", extra={"exemplars": len(fresh.library), **sums})
        # Not closed here: requests under way still read it, and go on until their threads end.
        weakref.finalize(old.library, logger.info, "old library let go").atexit = False


def describe(service: Service, engine: Engine) -> None:
    """Have the metrics say what is served."""
    manifest = engine.library.manifest
    service.metrics.describe(
        version=VERSION,
        model=f"{engine.card.name} {engine.card.version}",
        library=f"{manifest.name} {manifest.version}",
    )
    for network in engine.networks:
        service.metrics.describe_network(
            network.card.output.kind,
            name=network.card.name,
            version=network.card.version,
            provider=network.runtime.provider,
            precision=network.runtime.precision,
        )
