"""Nearest neighbours: recall against the exact search, CPU time, memory and start, by backend.

    python -m benchmarks.index LIBRARY ... [--backends cells hnsw] [--queries FILE.npz:KEY ...]

Queries are poses that the library does not hold: by default drawn from the prior with another seed
and seen with 5 px of noise by a person 365 px tall, or 2D poses (N, 14, 2) from a file. Each case
leaves out other joints. All queries are asked one by one, several times over; a query's time is the
least of those, which a busy machine distorts little, and the mean over the queries is printed: CPU
milliseconds of the thread, and of the clock. With POSEMATCH_MILVUS_URI and ``--backends milvus``
the pushed library is searched; CPU time is the client's then.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from app.engine import milvus_of
from app.settings import load_settings
from library_store.arguments import integer
from library_store.backends import Backend
from library_store.cameras import project, rolled_upright, sample_cameras
from library_store.library import Library, load
from library_store.prior import PosePrior

Floats = NDArray[np.float64]

K = (10, 200)
"""What recall is stated at, and what fusion asks for."""

_NOISE = 5.0 / 365.0
"""Pixels of noise over the person's height in pixels."""
_UNSURE = (0.2, 1.0)
_SEED = 2_026

MASKS: dict[str, list[int]] = {
    "wrist": [4],
    "arm": [3, 4],
    "both arms": [3, 4, 6, 7],
    "ankle": [10],
    "leg": [9, 10],
    "both legs": [9, 10, 12, 13],
    "hips and legs": [8, 9, 10, 11, 12, 13],
    "right side": [2, 3, 4, 8, 9, 10],
    "head": [0],
}
RANDOM = (2, 4, 6)


@dataclass(frozen=True)
class Row:
    """One case with one backend: recall at each of ``K``, CPU and wall-clock ms of one query."""

    case: str
    recall: tuple[float, ...]
    cpu_ms: tuple[float, ...]
    wall_ms: tuple[float, ...]


def main() -> None:
    """Parse the command line, measure, print."""
    parser = argparse.ArgumentParser(description="Recall and time of the nearest-neighbour index.")
    parser.add_argument("libraries", type=Path, nargs="+")
    parser.add_argument("--backends", nargs="+", choices=get_args(Backend), default=["cells"])
    parser.add_argument("--queries", nargs="+", default=[], metavar="FILE:KEY")
    parser.add_argument("--count", type=integer(1), default=100, help="queries of each case")
    parser.add_argument("--cases", nargs="+", default=[], help="of the tables' first column")
    parser.add_argument("--passes", type=integer(1), default=3, help="how often each is asked")
    arguments = parser.parse_args()
    points = read_queries(arguments.queries, arguments.count)
    cases = {
        name: weights
        for name, weights in masks(len(points))
        if name in arguments.cases or not arguments.cases
    }
    for directory in arguments.libraries:
        exact = load(directory, verify=False, backend="exact")
        truth = {name: exact.match(points, mask, max(K)).entries for name, mask in cases.items()}
        n, per_entry = len(exact), bytes_per_entry(exact)
        exact.close()
        for backend in arguments.backends:
            started_s = time.perf_counter()
            library = load(directory, backend=backend, milvus=milvus_of(load_settings()))
            library.match(points[:1], None, 1)
            start_s = time.perf_counter() - started_s
            before = resident_bytes()
            rows = [
                measure(library, points, cases[name], truth[name], name, arguments.passes)
                for name in cases
            ]
            grown = (resident_bytes() - before) / n
            print(f"\n{directory.name}: {n:,} exemplars, {backend}; {per_entry:.0f} B each on disk")
            print(f"opened and verified in {start_s:.2f} s; queries then read {grown:.0f} B each")
            print_table(rows)
            library.close()


def read_queries(files: list[str], count: int) -> Floats:
    """2D poses (count, 14, 2), an equal number from each file, or drawn from the prior."""
    rng = np.random.default_rng(_SEED)
    if not files:
        poses = PosePrior.load().sample(count, rng)
        points = project(rolled_upright(sample_cameras(count, rng), poses), poses)
        heights = np.ptp(points[..., 1], axis=1)[:, None, None]
        noisy: Floats = points + rng.normal(size=points.shape) * _NOISE * heights
        return noisy
    chosen = []
    for number, text in enumerate(files):
        name, _, key = text.rpartition(":")
        with np.load(name, allow_pickle=False) as arrays:
            poses = arrays[key].astype(np.float64)
        share = count // len(files) + (number < count % len(files))
        chosen.append(poses[rng.choice(len(poses), share, replace=False)])
    return np.concatenate(chosen)


def masks(n: int) -> Iterator[tuple[str, Floats | None]]:
    """The cases: weights (n, 14), None for complete queries."""
    rng = np.random.default_rng(_SEED)
    yield "complete", None
    for name, joints in MASKS.items():
        weights = np.ones((n, 14))
        weights[:, joints] = 0.0
        yield name, weights
    for many in RANDOM:
        weights = np.ones((n, 14))
        for row in weights:
            row[rng.choice(14, many, replace=False)] = 0.0
        yield f"any {many}", weights
    yield "all unsure", rng.uniform(*_UNSURE, (n, 14))


def measure(
    library: Library,
    points: Floats,
    weights: Floats | None,
    truth: NDArray[np.int64],
    case: str,
    passes: int,
) -> Row:
    """Ask for every pose by itself; ``truth`` (n, max(K)) are the exact neighbours."""
    recall, cpu_ms, wall_ms = [], [], []
    for k in K:
        hits = np.zeros((passes, len(points)))
        spent_s = np.zeros((passes, len(points), 2))
        for number, row in np.ndindex(passes, len(points)):
            one = slice(row, row + 1)
            mask = None if weights is None else weights[one]
            started_s = time.thread_time(), time.perf_counter()
            found = library.match(points[one], mask, k)
            ended_s = time.thread_time(), time.perf_counter()
            spent_s[number, row] = np.subtract(ended_s, started_s)
            hits[number, row] = np.isin(truth[row, :k], found.entries).mean()
        recall.append(float(hits.mean()))
        least_ms = 1e3 * spent_s.min(axis=0).mean(axis=0)
        cpu_ms.append(float(least_ms[0]))
        wall_ms.append(float(least_ms[1]))
    return Row(case, tuple(recall), tuple(cpu_ms), tuple(wall_ms))


def bytes_per_entry(library: Library) -> float:
    """What an exemplar takes on the disk."""
    return sum(file.bytes for file in library.manifest.files.values()) / len(library)


def resident_bytes() -> int:
    """Memory of the process, mapped files included."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4_096


def print_table(rows: list[Row]) -> None:
    """As Markdown."""
    heads = [f"{what} {k}" for what in ("recall@", "CPU ms, k =", "wall ms, k =") for k in K]
    print("| missing | " + " | ".join(heads) + " |")
    print("|---" * (1 + len(heads)) + "|")
    for row in rows:
        numbers = [f"{it:.3f}" for it in row.recall]
        numbers += [f"{it:.2f}" for it in (*row.cpu_ms, *row.wall_ms)]
        print(f"| {row.case} | " + " | ".join(numbers) + " |")


if __name__ == "__main__":
    main()
