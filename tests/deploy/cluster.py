"""A Ray cluster of one machine for tests, in processes of its own, and posematch on it."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Self

import httpx
import yaml

from tests.app.server import free_port
from tests.deploy.states import States

ROOT = Path(__file__).parents[2]
CONFIG = ROOT / "deploy" / "ray_serve.yaml"
REPLICA = b"ray::ServeReplica:posematch:posematch"
PATIENCE_S = 200.0
# An address of this machine that Ray does not take for a laptop's own.
_NODE = "127.0.0.2"
# Ray gives its own processes 30 s to start, which a busy machine may exceed.
_STARTS = 3


def wait_until(done: Callable[[], bool], what: str) -> None:
    """Ask every now and then; fails after ``PATIENCE_S``."""
    deadline = time.monotonic() + PATIENCE_S
    while not done():
        assert time.monotonic() < deadline, f"waited {PATIENCE_S:g} s in vain: {what}"
        time.sleep(0.2)


class Cluster:
    """Runs ``ray start --head`` for the time of a ``with`` block; ``bin`` is Ray's environment."""

    def __init__(self, bin_dir: Path, log: Path) -> None:
        self._bin = bin_dir
        self._log = log
        self._gcs_port = free_port()
        self._address = f"{_NODE}:{self._gcs_port}"
        self.port = free_port()
        self.url = f"http://127.0.0.1:{self.port}"

    def __enter__(self) -> Self:
        for tried in range(1, _STARTS + 1):
            try:
                self._start()
                break
            except AssertionError:
                self._end()
                if tried == _STARTS:
                    raise
        return self

    def _start(self) -> None:
        # Not pytest's: the paths of Ray's sockets have to be short.
        self._directory = Path(tempfile.mkdtemp(prefix="ray-"))
        outside = ("POSEMATCH_", "RAY_")
        inherited = {k: v for k, v in os.environ.items() if not k.startswith(outside)}
        # By default Ray's workers, replicas among them, stand back behind all other processes.
        self._environment = {**inherited, "RAY_worker_niceness": "0"}
        command = [
            *(str(self._bin / "ray"), "start", "--head", "--block", "--num-cpus=2"),
            *("--include-dashboard=false", "--disable-usage-stats"),
            *("--object-store-memory=100000000", f"--node-ip-address={_NODE}"),
            *(f"--port={self._gcs_port}", f"--ray-client-server-port={free_port()}"),
            f"--temp-dir={self._directory}",
        ]
        with self._log.open("w") as log:
            self._process = subprocess.Popen(
                command,
                cwd=ROOT,
                env=self._environment,
                stdout=log,
                stderr=log,
                start_new_session=True,  # which tells this cluster's processes from all others
            )
        wait_until(self._has_started, "ray start")

    def _has_started(self) -> bool:
        log = self._log.read_text()
        assert self._process.poll() is None, log
        return "Ray runtime started" in log

    def deploy(self, *, replicas: int, **settings: object) -> None:
        """``serve run`` what deploy/ray_serve.yaml says, with these settings; does not wait."""
        config = yaml.safe_load(CONFIG.read_text())
        config["http_options"]["port"] = self.port
        (application,) = config["applications"]
        variables = application["runtime_env"]["env_vars"]
        variables |= {f"POSEMATCH_{key.upper()}": str(value) for key, value in settings.items()}
        (deployment,) = application["deployments"]
        bounds = {"min_replicas": replicas, "max_replicas": replicas}
        deployment["autoscaling_config"] |= bounds
        self._serve_run(config)

    def autoscale(self, **autoscaling: float) -> None:
        """Deploy again with this changed in ``autoscaling_config``, which replaces no replica."""
        config = yaml.safe_load((self._directory / "config.yaml").read_text())
        config["applications"][0]["deployments"][0]["autoscaling_config"] |= autoscaling
        self._serve_run(config)

    def _serve_run(self, config: object) -> None:
        path = self._directory / "config.yaml"
        path.write_text(yaml.safe_dump(config))
        command = [
            *(str(self._bin / "serve"), "run", "--non-blocking"),
            *("--address", self._address, str(path)),
        ]

        for tried in range(1, _STARTS + 1):
            run = subprocess.run(
                command,
                cwd=ROOT,
                env=self._environment,
                capture_output=True,
                text=True,
                timeout=PATIENCE_S,
            )
            if run.returncode == 0:
                return
            assert tried < _STARTS, run.stdout + run.stderr

    def replicas(self) -> set[int]:
        """The process ids of the replicas that run or are being started."""
        return {pid for pid in self._members() if _command(pid).startswith(REPLICA)}

    def states(self, log: Path) -> States:
        """What Ray says of the replicas, watched for the time of a ``with`` block."""
        return States(self._bin, self._address, log, self._environment)

    def wait_for(self, replicas: int) -> None:
        """Until so many replicas answer; says what is there when they do not."""
        try:
            wait_until(lambda: len(self.answering()) == replicas, f"{replicas} replicas answer")
        except AssertionError as error:
            raise AssertionError(
                f"{error}; these answer: {self.answering()}, these run: {self.replicas()}; Ray"
                f" says:\n{self._log.read_text()[-4000:]}"
            ) from None

    def answering(self, asked: int = 12) -> dict[str, int]:
        """Which replicas answer /metrics: when each began -> how many photos it has answered.

        By when it made its counters: processes that Ray starts together may share the start time
        that the kernel states, in hundredths of a second.
        """
        seen = {}
        for _ in range(asked):
            try:
                text = httpx.get(f"{self.url}/metrics", timeout=30).text
            except httpx.TransportError:
                continue
            began = re.search(r"^posematch_abandoned_created (\S+)", text, re.MULTILINE)
            photos = re.search(
                r'^posematch_requests_total{[^}]*route="/v1/poses",status="200"} (\S+)',
                text,
                re.MULTILINE,
            )
            if began:
                seen[began[1]] = int(float(photos[1])) if photos else 0
        return seen

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._end()

    def _end(self) -> None:
        # SIGTERM would have Ray wait half a minute for its actors.
        for pid in self._members():
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        self._process.wait(timeout=10)
        shutil.rmtree(self._directory, ignore_errors=True)

    def _members(self) -> set[int]:
        pids = (int(path.name) for path in Path("/proc").glob("[0-9]*"))
        return {pid for pid in pids if _session(pid) == self._process.pid}


def _session(pid: int) -> int | None:
    try:
        return os.getsid(pid)
    except ProcessLookupError:
        return None


def _command(pid: int) -> bytes:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return b""  # it has ended
