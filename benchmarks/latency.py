"""Latency and throughput of the running service, per stage, over loopback HTTP.

    python -m benchmarks.latency [--photo FILE] [--seconds 10] [--concurrency 1 8]

Starts ``posematch serve`` on a free port (or measures the one at ``--url``), posts one photo over
kept-alive connections at each concurrency for a fixed time, and prints the 50th and 99th percentile
of every stage (from ``Server-Timing``) and of the client's own clock, images a second, refusals,
the server process' CPU time per answer and its memory. The client shares the machine's cores with
the server and says how much of them it took.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

import numpy as np

from benchmarks.load import Load, closed_loop, encode_request
from benchmarks.service import DEFAULT_PHOTO, given_or_started
from library_store.arguments import integer, real


def main() -> None:
    """Parse the command line, measure, print."""
    parser = argparse.ArgumentParser(description="Latency and throughput over HTTP.")
    parser.add_argument("--url", help="measure this server instead of starting one")
    parser.add_argument("--pid", type=integer(1), help="its process (with --url)")
    parser.add_argument("--photo", type=Path, nargs="+", default=[DEFAULT_PHOTO])
    parser.add_argument("--query", default="", help="query string, such as max_people=1")
    parser.add_argument("--concurrency", type=integer(1), nargs="+", default=[1, 8])
    parser.add_argument("--seconds", type=real(0.5, 120), default=10.0, help="per concurrency")
    arguments = parser.parse_args()
    seconds: float = arguments.seconds
    with given_or_started(arguments.url, arguments.pid) as service:
        if service.ready_s is not None:
            print(f"ready {service.ready_s:.1f} s after start; {os.cpu_count()} cores")
        for photo in arguments.photo:
            request = encode_request(service, photo.read_bytes(), arguments.query)
            closed_loop(service, request, concurrency=1, seconds=1.0)  # warm up
            for concurrency in arguments.concurrency:
                load = closed_loop(service, request, concurrency, seconds)
                print(f"\n{photo.name}, concurrency {concurrency}, {seconds:g} s")
                report(load)
        print(f"\nresident memory {service.resident_mb():.0f} MB")


def report(load: Load) -> None:
    """Print one table."""
    answered = load.statuses[200]
    asked = load.statuses.total()
    others = {status: n for status, n in load.statuses.items() if status != 200}
    share = 100 * (asked - answered) / max(asked, 1)
    print(f"  {load.goodput:.1f} images/s; not answered {share:.1f}% {others or ''}")
    if answered:
        print(
            f"  CPU-ms per answer: server {1e3 * load.server_cpu_s / answered:.1f},"
            f" client {1e3 * load.client_cpu_s / answered:.1f}"
        )
    print(f"  {'ms':>8} {'p50':>8} {'p99':>8}")
    rows = {**load.stages_ms, "client": load.latencies_ms, "refused": load.refusals_ms}
    for stage, spent_ms in rows.items():
        if spent_ms:
            p50, p99 = np.percentile(spent_ms, [50, 99])
            print(f"  {stage:>8} {p50:8.2f} {p99:8.2f}")


if __name__ == "__main__":
    main()
