"""What all commands print with: results on stdout, notices and progress bars on stderr."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from app.engine import locate_library
from app.settings import Settings

output = Console()
notices = Console(stderr=True)


def print_json(text: str) -> None:
    """JSON, indented; escaped where the terminal or pipe is not of UTF-8."""
    output.print_json(text, ensure_ascii=not output.encoding.startswith("utf"))


@contextmanager
def stage_progress() -> Iterator[Callable[[str, float], None]]:
    """A bar per stage on stderr; yields the callback that stages report their fraction to.

    Where stderr is no terminal but a log, a line per stage as it begins.
    """
    columns = (TextColumn("{task.description:>24}"), BarColumn(), TimeElapsedColumn())
    bars = Progress(*columns, console=notices, disable=not notices.is_terminal)
    tasks: dict[str, TaskID] = {}

    def report(stage: str, fraction: float) -> None:
        if not tasks:
            bars.start()  # not before there is something to say: stderr may be a full disk
        if stage not in tasks:
            tasks[stage] = bars.add_task(stage, total=1.0)
            if bars.disable:
                notices.print(f"{stage} ...", highlight=False, markup=False)
        bars.update(tasks[stage], completed=fraction)

    try:
        yield report
    finally:
        if tasks:
            bars.stop()


def build_if_missing(settings: Settings) -> Path:
    """The directory of the library to serve, the default one built first when it is missing."""
    with stage_progress() as report:
        return locate_library(settings, report)
