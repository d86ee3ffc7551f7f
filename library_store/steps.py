"""The steps of a build, each kept when the build is killed.

A build's directory has a ledger, ``steps.json``: the steps that are done, the files each wrote with
their sizes, and what it found. The files of a step are flushed to the disk before it is entered.
A build that is started again with the same inputs finds the ledger and goes on after the last step
that is whole; the directory's name carries a digest of the inputs, so others never see it.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

LEDGER = "steps.json"

Facts = Mapping[str, Any]


class Steps:
    """Runs the steps of a build in a directory, in order, skipping those done before."""

    def __init__(self, workshop: Path) -> None:
        self._workshop = workshop
        self._ledger = workshop / LEDGER
        self._reached: list[str] = []
        self.reused: list[str] = []
        try:
            self._done: dict[str, Any] = json.loads(self._ledger.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            self._done = {}
            for path in workshop.iterdir():
                shutil.rmtree(path) if path.is_dir() else path.unlink()

    def run(self, name: str, work: Callable[[], Facts], *files: str) -> Facts:
        """The facts that ``work`` returns, or returned in a build before this one.

        ``files`` are what it writes. Facts must survive JSON. Steps that follow one that had to be
        run again are run again too.
        """
        self._reached.append(name)
        if self._is_whole(name, files):
            self.reused.append(name)
        else:
            facts = work()
            for file in files:
                flush(self._workshop / file)
            self._done = {step: self._done[step] for step in self._reached[:-1]}
            sizes = {file: (self._workshop / file).stat().st_size for file in files}
            self._done[name] = {"files": sizes, "facts": facts}
            self._write()
        facts_done: Facts = self._done[name]["facts"]
        return facts_done

    def sweep(self, kept: Mapping[str, Any]) -> None:
        """Remove the ledger and all files that are not among ``kept``."""
        for path in self._workshop.iterdir():
            if path.name not in kept:
                path.unlink()

    def _is_whole(self, name: str, files: tuple[str, ...]) -> bool:
        if name not in self._done or set(self._done[name]["files"]) != set(files):
            return False
        sizes = self._done[name]["files"]
        return all(
            (self._workshop / file).is_file() and (self._workshop / file).stat().st_size == size
            for file, size in sizes.items()
        )

    def _write(self) -> None:
        unfinished = self._ledger.with_suffix(".unfinished")
        unfinished.write_text(json.dumps(self._done), encoding="utf-8")
        flush(unfinished)
        unfinished.replace(self._ledger)
        flush(self._workshop)


def flush(path: Path) -> None:
    """Have the disk hold what was written to a file, or the entries of a directory."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
