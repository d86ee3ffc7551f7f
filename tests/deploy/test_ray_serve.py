"""deploy/ray_serve.py on a real Ray cluster: the same answers, lost replicas, rolling redeploys.

Ray is installed by ``scripts/setup-ray`` on the first run, into an environment of its own.
"""

from __future__ import annotations

import os
import signal
import subprocess
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Self

import httpx
import pytest
from posematch_client import Client, Retries

from library_store.build import BuildSettings, build_library
from library_store.prior import DEFAULT_PRIOR, PosePrior
from tests.app.server import Server
from tests.deploy.cluster import ROOT, Cluster, wait_until

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]

PHOTO = (ROOT / "tests" / "data" / "renders" / "000.jpg").read_bytes()
REPLICAS = 2


@pytest.fixture(scope="module")
def ray_bin() -> Path:
    """The programs of Ray's environment, made first if need be."""
    setup = subprocess.run([ROOT / "scripts" / "setup-ray"], capture_output=True, text=True)
    if setup.returncode:
        pytest.skip(f"Ray cannot be installed here:\n{setup.stderr[-2000:]}")
    return Path(setup.stdout.strip())


@pytest.fixture(scope="module")
def library_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("libraries") / "small"
    prior = PosePrior.load(DEFAULT_PRIOR)
    build_library(directory, prior, BuildSettings(name="small", n_poses=5000))
    return directory


@pytest.fixture(scope="module")
def cluster(
    ray_bin: Path, library_dir: Path, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Cluster]:
    """Two replicas that refuse nothing for want of time, so that no failure is theirs."""
    with Cluster(ray_bin, tmp_path_factory.mktemp("ray") / "log") as running:
        running.deploy(replicas=REPLICAS, library_dir=library_dir, deadline_ms=60_000)
        running.wait_for(REPLICAS)
        yield running


class Load:
    """Clients that ask without a pause, each in a thread, for the time of a ``with`` block."""

    def __init__(self, ask: Callable[[], object], clients: int = 2) -> None:
        self.outcomes: Counter[object] = Counter()
        self._ask = ask
        self._stop = threading.Event()
        self._threads = [threading.Thread(target=self._run) for _ in range(clients)]

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                self.outcomes[self._ask()] += 1
            except Exception as error:
                self.outcomes[repr(error)] += 1

    def __enter__(self) -> Self:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        for thread in self._threads:
            thread.join()

    def goes_on(self, further: int = 20) -> None:
        """Return when that many more have been answered."""
        want = self.outcomes.total() + further
        wait_until(lambda: self.outcomes.total() >= want, "answers")


def without_times(answer: dict[str, Any]) -> dict[str, Any]:
    return {key: it for key, it in answer.items() if key not in ("request_id", "timings_ms")}


def test_both_replicas_give_the_answers_of_the_service(
    cluster: Cluster, library_dir: Path, tmp_path: Path
) -> None:
    with Server(tmp_path / "log", library_dir=library_dir, deadline_ms=60_000) as plain:
        wanted = plain.client.post("/v1/poses", content=PHOTO).raise_for_status().json()
    assert wanted["people"]
    with httpx.Client(base_url=cluster.url, timeout=60) as client:
        for number in range(16):
            sent = {"X-Request-ID": f"mine-{number}"}
            answer = client.post("/v1/poses", content=PHOTO, headers=sent)
            assert answer.status_code == 200
            assert answer.headers.get_list("x-request-id") == [f"mine-{number}"]
            assert "decode;dur=" in answer.headers["server-timing"]
            assert without_times(answer.json()) == without_times(wanted)
        answered = cluster.answering()
        assert len(answered) == REPLICAS
        assert all(answered.values()), "both have had some of the photos"

        refused = client.post("/v1/poses", content=b"GIF89a........")
        assert refused.status_code == 415
        assert refused.headers["content-type"] == "application/problem+json"
        assert refused.json()["request_id"] == refused.headers["x-request-id"]
        assert client.get("/livez").json() == {"status": "ok"}
        assert client.get("/readyz").status_code == 200
        assert "posematch" in client.get("/").text
        assert client.get("/openapi.json").json()["paths"]


def test_a_killed_replica_costs_no_answer_of_a_client_that_asks_again(cluster: Cluster) -> None:
    before = cluster.replicas()
    assert len(before) == REPLICAS
    victim = min(before)
    client = Client(cluster.url, retries=Retries(deadline_s=90))
    with client, Load(lambda: len(client.poses(PHOTO)["people"])) as load:
        load.goes_on()
        os.kill(victim, signal.SIGKILL)
        load.goes_on()
        wait_until(
            lambda: (
                len(cluster.replicas() - {victim}) == REPLICAS
                and len(cluster.answering()) == REPLICAS
            ),
            "another replica takes its place",
        )
        load.goes_on()
    assert set(load.outcomes) == {1}, load.outcomes


def test_a_redeploy_under_load_fails_no_request(cluster: Cluster, library_dir: Path) -> None:
    """Without asking again."""
    before = cluster.replicas()
    with httpx.Client(base_url=cluster.url, timeout=90) as client:
        with Load(lambda: client.post("/v1/poses", content=PHOTO).status_code) as load:
            load.goes_on()
            changed = {"max_body_bytes": 1_000_000}
            cluster.deploy(
                replicas=REPLICAS, library_dir=library_dir, deadline_ms=60_000, **changed
            )
            wait_until(
                lambda: (
                    len(cluster.replicas() - before) == REPLICAS
                    and not cluster.replicas() & before
                    and len(cluster.answering()) == REPLICAS
                ),
                "every replica is a new one",
            )
            load.goes_on()
        limits = client.get("/v1/info").json()["limits"]
    assert set(load.outcomes) == {200}, load.outcomes
    assert limits["max_body_bytes"] == 1_000_000


def test_replicas_come_and_go_with_the_load(cluster: Cluster, tmp_path: Path) -> None:
    """From one to two and back, and no request fails, without asking again."""
    # Two under way for each replica, as deployed; all else quicker, for a test.
    cluster.autoscale(
        min_replicas=1,
        max_replicas=REPLICAS,
        metrics_interval_s=1,
        look_back_period_s=3,
        upscale_delay_s=2,
        downscale_delay_s=3,
    )
    with (
        httpx.Client(base_url=cluster.url, timeout=90) as client,
        cluster.states(tmp_path / "states") as states,
    ):

        def ask() -> int:
            return client.post("/v1/poses", content=PHOTO).status_code

        wait_until(lambda: states.are(1), "one replica is enough for nobody")
        with Load(ask, clients=1) as one:
            with Load(ask, clients=4) as four:
                wait_until(lambda: states.are(2), "a second replica for five clients")
                cluster.wait_for(REPLICAS)
                four.goes_on()
            wait_until(lambda: states.are(1), "one replica for the client that is left")
            one.goes_on()
    assert set(one.outcomes + four.outcomes) == {200}, (one.outcomes, four.outcomes)
