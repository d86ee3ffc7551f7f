"""How many replicas Ray says there are, watched from a process of Ray's environment."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Self

_WATCH = """
import json, sys, time
import ray
from ray import serve

ray.init(address=sys.argv[1], logging_level="ERROR", log_to_driver=False)
last = None
while True:
    said = serve.status().applications["posematch"].deployments["posematch"]
    now = [said.status, said.replica_states]
    if now != last:
        print(json.dumps([time.time(), *now]), flush=True)
    last = now
    time.sleep(0.2)
"""


class States:
    """Follows ``serve.status()`` in a ``with`` block; every change is a line in the log."""

    def __init__(
        self, bin_dir: Path, address: str, log: Path, environment: Mapping[str, str]
    ) -> None:
        self._command = [str(bin_dir / "python"), "-c", _WATCH, address]
        self._environment = environment
        self._log = log

    def __enter__(self) -> Self:
        with self._log.open("w") as log:
            self._process = subprocess.Popen(self._command, env=self._environment, stdout=log)
        return self

    def are(self, running: int) -> bool:
        """Whether that many replicas run, and none is being started or stopped."""
        assert self._process.poll() is None, "no word from Ray"
        lines = self._log.read_text().splitlines()
        return bool(lines) and json.loads(lines[-1])[1:] == ["HEALTHY", {"RUNNING": running}]

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._process.kill()
        self._process.wait()
