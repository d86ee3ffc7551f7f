"""What each stage of a request costs: CPU time, without HTTP and without competition.

    python -m benchmarks.stages [--photo FILE ...] [--runs 50]

Runs the service's own pipeline on one thread and prints the median CPU-milliseconds (of the thread,
so that a busy machine distorts less) of every stage, of making the answer and of writing its JSON.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from app.answers import poses_answer
from app.engine import Engine, load_engine
from app.pipeline import PhotoQuery, StageClock
from app.settings import load_settings
from benchmarks.service import DEFAULT_PHOTO
from library_store.arguments import integer

_WARM_UP_RUNS = 5


def main() -> None:
    """Parse the command line, measure, print."""
    parser = argparse.ArgumentParser(description="CPU time per stage.")
    parser.add_argument("--photo", type=Path, nargs="+", default=[DEFAULT_PHOTO])
    parser.add_argument("--runs", type=integer(1), default=50)
    parser.add_argument("--max-people", type=integer(1), default=5)
    arguments = parser.parse_args()
    engine = load_engine(load_settings())
    query = PhotoQuery(max_people=arguments.max_people)
    for photo in arguments.photo:
        data = photo.read_bytes()
        people, runs = 0, []
        for _ in range(_WARM_UP_RUNS + arguments.runs):
            people, spent_ms = run_once(engine, data, query)
            runs.append(spent_ms)
        medians = {
            stage: float(np.median([run[stage] for run in runs[_WARM_UP_RUNS:]]))
            for stage in runs[-1]
        }
        print(f"\n{photo.name}, {len(data) / 1e3:.0f} kB, {people} people: CPU-ms, median")
        for stage, median_ms in (*medians.items(), ("all", sum(medians.values()))):
            print(f"  {stage:>8} {median_ms:8.2f}")


def run_once(engine: Engine, data: bytes, query: PhotoQuery) -> tuple[int, dict[str, float]]:
    """How many people were found, and CPU milliseconds by stage."""
    clock = StageClock(time.thread_time)
    result = engine.pipeline.estimate(data, query, clock)
    answer = poses_answer(engine, result, query.method, "id")
    clock.lap("answer")
    answer.model_dump_json().encode()
    clock.lap("json")
    return len(result.people), clock.timings_ms


if __name__ == "__main__":
    main()
