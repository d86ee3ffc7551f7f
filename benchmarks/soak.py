"""Full load for a long time, to see whether anything grows, fails or slows down.

    python -m benchmarks.soak [--minutes 15] [--concurrency 8]

Sends a mix of photos (JPEG, PNG, WebP; one person, several, nobody; damaged ones) over kept-alive
connections and prints, minute by minute, images a second, the 50th and 99th percentile, every
status, resident memory and open files; at the end the slope of memory after the first fifth, in MB
an hour, and the drift of p99 between the first and the last third. Exit code 1 when a status came
back that none of these photos deserves.
"""

from __future__ import annotations

import argparse
import asyncio
import sys
import time
from collections import Counter
from dataclasses import dataclass

import cv2
import numpy as np

from benchmarks.load import Connection, Load, encode_request
from benchmarks.service import DEFAULT_PHOTO, Service, given_or_started
from library_store.arguments import integer, real

EXPECTED = {200, 413, 415, 422, 503}


@dataclass(frozen=True)
class Minute:
    """What one stretch of the soak measured."""

    at_s: float
    images_per_s: float
    p50_ms: float
    p99_ms: float
    statuses: Counter[int]
    resident_mb: float
    open_files: int

    def __str__(self) -> str:
        return (
            f"{self.at_s / 60:6.1f} min {self.images_per_s:6.1f}/s p50 {self.p50_ms:6.1f} "
            f"p99 {self.p99_ms:6.1f} ms {self.resident_mb:6.1f} MB {self.open_files:4d} files "
            f"{dict(sorted(self.statuses.items()))}"
        )


def main() -> None:
    """Parse the command line, soak, print, judge."""
    parser = argparse.ArgumentParser(description="Full load for a long time.")
    parser.add_argument("--url", help="soak this server instead of starting one")
    parser.add_argument("--pid", type=integer(1), help="its process (with --url)")
    parser.add_argument("--minutes", type=real(0.1, 120), default=15.0)
    parser.add_argument("--concurrency", type=integer(1), default=8)
    arguments = parser.parse_args()
    with given_or_started(arguments.url, arguments.pid) as service:
        requests = [encode_request(service, photo) for photo in make_photos()]
        history = asyncio.run(
            soak(service, requests, arguments.concurrency, 60 * arguments.minutes)
        )
    judge(history)


def make_photos() -> list[bytes]:
    """Photos of several kinds from one; most of them good."""
    data = DEFAULT_PHOTO.read_bytes()
    image = np.asarray(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR), np.uint8)
    small = cv2.resize(image, (320, 240), interpolation=cv2.INTER_AREA)
    crowd = np.tile(small, (2, 3, 1))
    nobody = np.full((480, 640, 3), 127, np.uint8)
    good = [data, data, data, data]
    good += [cv2.imencode(kind, small)[1].tobytes() for kind in (".png", ".webp", ".jpg")]
    good += [cv2.imencode(".jpg", picture)[1].tobytes() for picture in (crowd, nobody)]
    return [*good, data[: len(data) // 2], b"GIF89a" + bytes(100)]


async def soak(
    service: Service, requests: list[bytes], concurrency: int, seconds: float
) -> list[Minute]:
    """Keep ``concurrency`` clients busy; one ``Minute`` a minute (ten in all at the least)."""
    stretch = min(60.0, seconds / 10)
    load = Load()
    begin = time.perf_counter()
    end = begin + seconds
    rng = np.random.default_rng(0)

    async def client() -> None:
        connection = await Connection.open(service)
        while time.perf_counter() < end:
            started = time.perf_counter()
            head = await connection.ask(requests[int(rng.integers(len(requests)))])
            load.record(head, 1e3 * (time.perf_counter() - started))
            if head[9:12] == b"503":
                await asyncio.sleep(0.05)
        connection.close()

    history: list[Minute] = []

    async def watch() -> None:
        nonlocal load
        while (now := time.perf_counter()) < end:
            await asyncio.sleep(min(stretch, max(0.01, end - now)))
            done, load = load, Load()
            p50, p99 = np.percentile(done.latencies_ms or [np.nan], [50, 99])
            history.append(
                Minute(
                    at_s=time.perf_counter() - begin,
                    images_per_s=done.statuses[200] / stretch,
                    p50_ms=float(p50),
                    p99_ms=float(p99),
                    statuses=done.statuses,
                    resident_mb=service.resident_mb(),
                    open_files=service.open_files(),
                )
            )
            print(history[-1], flush=True)

    await asyncio.gather(watch(), *(client() for _ in range(concurrency)))
    return history


def judge(history: list[Minute]) -> None:
    """Print slope and drift; exit code 1 on a status that should not be."""
    settled = history[len(history) // 5 :]
    hours = np.array([minute.at_s for minute in settled]) / 3600
    slope = np.polyfit(hours, [minute.resident_mb for minute in settled], 1)[0]
    third = max(1, len(settled) // 3)
    first = np.nanmedian([minute.p99_ms for minute in settled[:third]])
    last = np.nanmedian([minute.p99_ms for minute in settled[-third:]])
    statuses = sum((minute.statuses for minute in history), Counter())
    print(f"\nmemory slope {slope:+.1f} MB/h; p99 {first:.0f} -> {last:.0f} ms; {dict(statuses)}")
    strange = set(statuses) - EXPECTED
    if strange:
        sys.exit(f"failed: statuses {strange}")


if __name__ == "__main__":
    main()
