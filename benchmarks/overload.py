"""More work than there is room for: what is accepted must be answered as fast as ever.

    python -m benchmarks.overload [--times 4] [--seconds 10] [--rounds 5]

Which of a few concurrencies gives the most images a second (closed loop) is found first. Then, in
turn, the capacity at that concurrency and ``--times`` as many a second, sent whatever happens to
them (open loop): a shared machine's speed drifts, so each goodput is compared with the capacity
measured just before it, and the median round is what counts. Printed for each: goodput, latency of
the accepted and of the refused, every status, resident memory, and the CPU time of server and
generator, which share the machine. Exit code 1 when anything but 200 and 503 came back, a
connection broke, or the median goodput fell under 90% of capacity.
"""

from __future__ import annotations

import argparse
import statistics
import sys
from pathlib import Path

import numpy as np

from benchmarks.load import Load, closed_loop, encode_request, open_loop
from benchmarks.service import DEFAULT_PHOTO, Service, given_or_started
from library_store.arguments import integer, real

WANTED_GOODPUT = 0.9


def main() -> None:
    """Parse the command line, measure, print, judge."""
    parser = argparse.ArgumentParser(description="Behaviour under overload.")
    parser.add_argument("--url", help="measure this server instead of starting one")
    parser.add_argument("--pid", type=integer(1), help="its process (with --url)")
    parser.add_argument("--photo", type=Path, default=DEFAULT_PHOTO)
    parser.add_argument("--times", type=real(0.1), default=4.0, help="offered load over capacity")
    parser.add_argument("--seconds", type=real(1, 300), default=10.0, help="of each load")
    parser.add_argument(
        "--rounds", type=integer(1), default=5, help="of capacity and overload in turn"
    )
    arguments = parser.parse_args()
    seconds: float = arguments.seconds
    with given_or_started(arguments.url, arguments.pid) as service:
        request = encode_request(service, arguments.photo.read_bytes())
        closed_loop(service, request, 2, seconds=2.0)  # warm up
        tried = {n: closed_loop(service, request, n, seconds).goodput for n in (2, 4, 8)}
        print({n: f"{goodput:.1f} images/s" for n, goodput in tried.items()})
        concurrency = max(tried, key=lambda n: tried[n])
        rounds = [
            _round(service, request, concurrency, arguments.times, seconds)
            for _ in range(max(1, arguments.rounds))
        ]
    shares = [overload.goodput / capacity.goodput for capacity, overload in rounds]
    per_cpu = [_answers_per_cpu_s(load) / _answers_per_cpu_s(full) for full, load in rounds]
    share = statistics.median(shares)
    listed = ", ".join(f"{100 * each:.0f}" for each in shares)
    print(f"\ngoodput {100 * share:.0f}% of capacity, median of {listed}")
    median = statistics.median(per_cpu)
    print(f"answers per CPU second of the server: {100 * median:.0f}% of those at capacity")
    loads = [load for each in rounds for load in each]
    strange = {status for load in loads for status in load.statuses} - {200, 503}
    broken = sum(load.broken for load in loads)
    if strange or broken or share < WANTED_GOODPUT:
        sys.exit(f"failed: statuses {strange or 'fine'}, {broken} broken, {share:.2f}")


def _round(
    service: Service, request: bytes, concurrency: int, times: float, seconds: float
) -> tuple[Load, Load]:
    """The capacity, then ``times`` of it offered; both are reported."""
    capacity = closed_loop(service, request, concurrency, seconds)
    report(f"capacity (closed loop, {concurrency} clients)", capacity, service)
    rate = times * capacity.goodput
    overload = open_loop(service, request, rate, seconds)
    report(f"offered {rate:.0f}/s (open loop)", overload, service)
    return capacity, overload


def _answers_per_cpu_s(load: Load) -> float:
    return load.statuses[200] / load.server_cpu_s


def report(title: str, load: Load, service: Service) -> None:
    """Print what a run measured."""
    cores = (load.server_cpu_s / load.seconds, load.client_cpu_s / load.seconds)
    print(f"\n{title}: {load.goodput:.1f} images/s, statuses {dict(load.statuses)}")
    print(f"  cores used: server {cores[0]:.2f}, generator {cores[1]:.2f}")
    print(f"  resident memory {service.resident_mb():.0f} MB, open files {service.open_files()}")
    rows = {
        "accepted": load.latencies_ms,
        "refused": load.refusals_ms,
        "refused, in the server": load.refusals_app_ms,
    }
    for name, spent_ms in rows.items():
        if spent_ms:
            p50, p99 = np.percentile(spent_ms, [50, 99])
            print(f"  {name:>24}: p50 {p50:.1f} ms, p99 {p99:.1f} ms")


if __name__ == "__main__":
    main()
