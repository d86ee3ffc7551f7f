"""``posematch bench``: how fast this machine is, stage by stage, in this process."""

from __future__ import annotations

import json
import math
import platform
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.table import Table

from app.commands.console import build_if_missing, output, print_json
from app.commands.machine import describe_cpu
from app.engine import Engine, load_engine
from app.pipeline import PhotoQuery
from app.settings import load_settings

SAMPLE = Path(__file__).parent.parent / "static" / "samples" / "dance.jpg"


@dataclass(frozen=True)
class Speed:
    """Measurements at one number of threads; ``stages_ms`` are medians of wall time."""

    threads: int
    photos: int
    people: int
    stages_ms: dict[str, float]
    median_ms: float
    p95_ms: float
    photos_per_s: float
    cpu_ms_per_photo: float


def bench(
    photo: Annotated[
        Path, typer.Option(exists=True, dir_okay=False, help="What to measure with.")
    ] = SAMPLE,
    seconds: Annotated[
        float, typer.Option(min=0.2, max=60, help="How long, per number of threads.")
    ] = 5.0,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Measure every stage on this machine.

    One photo after another, then all workers at once; in this process, without HTTP (`python -m
    benchmarks.latency` measures the service). Wall times suffer from whatever else the machine
    does, CPU time much less.

    \b
    posematch bench
    posematch bench --photo crowd.jpg --seconds 10 --json
    """  # noqa: D301
    settings = load_settings()
    build_if_missing(settings)
    engine = load_engine(settings)
    data = photo.read_bytes()
    counts = sorted({1, settings.workers})
    speeds = [measure(engine, data, threads, seconds) for threads in counts]
    if as_json:
        about = {"photo": photo.name, "cpu": describe_cpu(), "python": platform.python_version()}
        print_json(json.dumps({**about, "runs": [asdict(speed) for speed in speeds]}))
        return
    output.print(f"{photo.name} on {describe_cpu()}", highlight=False, markup=False)
    output.print(_table(speeds))


def measure(engine: Engine, data: bytes, threads: int, seconds: float) -> Speed:
    """Estimate the photo again and again in so many threads, in each once at least."""
    query = PhotoQuery()
    people = len(engine.pipeline.estimate(data, query).people)
    end_s = time.perf_counter() + seconds
    timings: list[tuple[float, dict[str, float]]] = []
    lock = threading.Lock()

    def work() -> None:
        now_s = -math.inf
        while now_s < end_s:
            started_s = time.perf_counter()
            stages_ms = engine.pipeline.estimate(data, query).timings_ms
            now_s = time.perf_counter()
            with lock:
                timings.append((1e3 * (now_s - started_s), stages_ms))

    started_s, cpu_s = time.perf_counter(), time.process_time()
    with ThreadPoolExecutor(threads) as pool:
        for running in [pool.submit(work) for _ in range(threads)]:
            running.result()
    wall_s, cpu_s = time.perf_counter() - started_s, time.process_time() - cpu_s
    totals_ms = [total for total, _ in timings]
    stages_ms = {
        stage: float(np.median([stages.get(stage, 0.0) for _, stages in timings]))
        for stage in timings[0][1]
    }
    return Speed(
        threads=threads,
        photos=len(timings),
        people=people,
        stages_ms=stages_ms,
        median_ms=float(np.median(totals_ms)),
        p95_ms=float(np.percentile(totals_ms, 95)),
        photos_per_s=len(timings) / wall_s,
        cpu_ms_per_photo=1e3 * cpu_s / len(timings),
    )


def _table(speeds: list[Speed]) -> Table:
    table = Table()
    table.add_column("ms, medians")
    for speed in speeds:
        table.add_column("1 thread" if speed.threads == 1 else f"{speed.threads} threads")
        table.columns[-1].justify = "right"
    for stage in speeds[0].stages_ms:
        table.add_row(stage, *(f"{speed.stages_ms[stage]:.2f}" for speed in speeds))
    table.add_section()
    table.add_row("a photo", *(f"{speed.median_ms:.1f}" for speed in speeds))
    table.add_row("95th percentile", *(f"{speed.p95_ms:.1f}" for speed in speeds))
    table.add_row("CPU time a photo", *(f"{speed.cpu_ms_per_photo:.1f}" for speed in speeds))
    table.add_row("photos a second", *(f"{speed.photos_per_s:.1f}" for speed in speeds))
    table.add_row("photos, people in each", *(f"{s.photos}, {s.people}" for s in speeds))
    return table
