"""posematch on Ray Serve: the service's own application in every replica, behind Ray's proxy.

``serve run deploy/ray_serve.yaml`` runs it; docs/scale.md says how, and what it costs. A replica
has networks and an admission queue of its own; the library is memory-mapped, so the replicas of a
machine share its pages. Settings are the POSEMATCH_* variables of the cluster or of the
``runtime_env``; host and port are Ray's to decide, and by default a replica computes on as many
threads as it has been given CPUs.
"""

from __future__ import annotations

import asyncio
import os

import ray
from fastapi import FastAPI
from ray import serve
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from app.api.deps import Service
from app.main import create_app
from app.observability import configure_logging
from app.settings import ENV_PREFIX, load_settings

_LOAD_POLL_S = 0.05


class _ProxiedApplication:
    """The application behind Ray's proxy, which adds the X-Request-ID header itself."""

    def __init__(self, application: FastAPI) -> None:
        self._application: ASGIApp = application
        self.service: Service = application.state.service

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async def send_without_id(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = message["headers"]
                message["headers"] = [pair for pair in headers if pair[0] != b"x-request-id"]
            await send(message)

        await self._application(scope, receive, send_without_id)


def build_application() -> _ProxiedApplication:
    """The application of one replica; Ray calls this in the replica's process.

    Raises ``StartupError`` when the settings are bad.
    """
    threads = max(1, round(ray.get_runtime_context().get_assigned_resources().get("CPU", 1)))
    is_set = ENV_PREFIX + "WORKERS" in os.environ
    settings = load_settings(**({} if is_set else {"workers": threads}))
    configure_logging(settings.log_level)
    # An engine that cannot be loaded is Ray's to hear of, by check_health.
    return _ProxiedApplication(create_app(settings, on_startup_failure=lambda _: None))


# Every request goes straight to a replica: its admission queue knows what the deadline leaves room
# for and refuses the rest with Retry-After, which Ray's own queue does not. With 200 ms and 35 ms a
# photo that is about five at a time, so the autoscaling has to aim well below.
@serve.deployment(
    name="posematch",
    ray_actor_options={"num_cpus": 1},
    autoscaling_config={
        "min_replicas": 1,
        "max_replicas": 4,
        "target_ongoing_requests": 2,
        "upscale_delay_s": 5,
        "downscale_delay_s": 300,
    },
    max_ongoing_requests=100,
    health_check_period_s=5,
    health_check_timeout_s=30,
    graceful_shutdown_wait_loop_s=1,
    graceful_shutdown_timeout_s=15,
)
@serve.ingress(build_application)
class PoseMatch:
    """A replica."""

    app: _ProxiedApplication

    async def check_health(self) -> None:
        """Return once the engine is loaded; Ray sends no requests before, and asks again later.

        Raises ``StartupError`` when it cannot be loaded.
        """
        service = self.app.service
        while service.engine is None:
            if service.startup_error is not None:
                raise service.startup_error
            await asyncio.sleep(_LOAD_POLL_S)


app = PoseMatch.bind()  # type: ignore[attr-defined]
"""What ``serve run`` deploys."""
