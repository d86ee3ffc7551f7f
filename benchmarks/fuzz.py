"""Damaged photos and odd queries against the running service, for as long as one likes.

    python -m benchmarks.fuzz [--seconds 120] [--seed 1] [--url URL --pid PID]

Mutates small photos of every kind (bytes changed, cut, doubled, spliced, lengths overwritten) and
asks for them with mutated queries. Every answer must be one the API documents, problem+json unless
200, and come in time; the process must not grow, keep files open, or leave any behind in the
temporary directory. The first photo that breaks a rule is written to ``--out`` and ends the run.
"""

from __future__ import annotations

import argparse
import http.client
import json
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

import cv2
import numpy as np

from benchmarks.service import DEFAULT_PHOTO, Service, given_or_started, started_service
from library_store.arguments import SEED, integer, real

DOCUMENTED = {200, 400, 413, 415, 422}
PATIENCE_S = 60.0
MAX_GROWTH_MB = 60.0
_NUMBERS = (0, 1, -1, 127, 128, 255, 256, 32767, 65535, 65536, 2**31 - 1, 2**32 - 1)
VALUES = (
    *("1", "0", "-1", "1e400", "nan", "inf", "", " ", "true", "null", "[]", "{}", "'", "\0", "%"),
    *("fusion", "paper", "lsp14", "\ud7ff", "é", "1,2,3,4", "0,0,1e6,1e6", "-1e9,0,1,1", "١٢"),
    *("9" * 400, "0x10", "1_0", "+5", "1.0", "5e0", "..", "../../etc/passwd", "<b>", "a" * 3000),
)
NAMES = (
    *("max_people", "candidates", "method", "skeleton", "box_px", "focal_length_px", "fov_deg"),
    *("subject_height_mm", "mirrored", "unknown", "max_people[]", "", "é"),
)


class BrokenRuleError(Exception):
    """The service did what it must not."""


@dataclass(frozen=True)
class Case:
    """One request of the fuzzer."""

    body: bytes
    query: str


def main() -> None:
    """Parse the command line, fuzz, print."""
    parser = argparse.ArgumentParser(description="Fuzz the service with damaged photos.")
    parser.add_argument("--url", help="fuzz this server instead of starting one")
    parser.add_argument("--pid", type=integer(1), help="its process (with --url)")
    parser.add_argument("--seconds", type=real(0.1, 3600), default=120.0)
    parser.add_argument("--seed", type=SEED, default=1)
    parser.add_argument("--out", type=Path, default=Path("fuzz-finding.bin"))
    arguments = parser.parse_args()
    end = time.monotonic() + arguments.seconds
    cases = iterate_cases(np.random.default_rng(arguments.seed), make_seeds())
    with tempfile.TemporaryDirectory() as scratch:
        temporary = Path(scratch)
        service_context = (
            started_service(variables={"TMPDIR": scratch})
            if arguments.url is None
            else given_or_started(arguments.url, arguments.pid)
        )
        with service_context as service:
            try:
                statuses = assault(service, cases, temporary, until=end)
            except BrokenRuleError as error:
                case: Case = error.args[1]
                arguments.out.write_bytes(case.body)
                sys.exit(f"{error.args[0]}: body in {arguments.out}, query {case.query!r}")
    print(f"{statuses.total()} cases, statuses {dict(sorted(statuses.items()))}: nothing broke")


def assault(
    service: Service, cases: Iterator[Case], temporary: Path, *, until: float, limit: int = 10**9
) -> Counter[int]:
    """Send cases until ``time.monotonic()`` is past ``until`` or ``limit`` are sent; the statuses.

    ``temporary`` is the directory the service would use for temporary files.
    Raises ``BrokenRuleError`` with a text and the case.
    """
    statuses: Counter[int] = Counter()
    connection = http.client.HTTPConnection(*service.address, timeout=PATIENCE_S)
    settled_mb, files = 0.0, service.open_files() + 2
    for number, case in enumerate(cases):
        if number == limit or time.monotonic() > until:
            break
        try:
            status = exchange(connection, case)
        except (OSError, http.client.HTTPException) as error:
            raise BrokenRuleError(f"no answer: {error!r}", case) from error
        statuses[status] += 1
        if status not in DOCUMENTED:
            raise BrokenRuleError(f"status {status}", case)
        if any(temporary.iterdir()):
            raise BrokenRuleError("a file was left behind", case)
        if number == 150:
            settled_mb = service.resident_mb()
        if settled_mb and service.resident_mb() > settled_mb + MAX_GROWTH_MB:
            raise BrokenRuleError("it grows", case)
    connection.close()
    if service.open_files() > files + 2:
        raise BrokenRuleError("it keeps files open", Case(b"", ""))
    return statuses


def exchange(connection: http.client.HTTPConnection, case: Case) -> int:
    """Send one case; its status. What is not 200 must be a whole problem."""
    path = "/v1/poses" + ("?" + case.query if case.query else "")
    connection.request("POST", path, case.body)
    response = connection.getresponse()
    text = response.read()
    if response.status != 200:
        problem = json.loads(text)
        whole = {"type", "title", "status", "detail", "request_id"} <= problem.keys()
        if not whole or response.headers["content-type"] != "application/problem+json":
            raise BrokenRuleError("not a problem", case)
    elif b"NaN" in text or b"Infinity" in text:
        raise BrokenRuleError("not JSON", case)
    return response.status


def make_seeds() -> list[bytes]:
    """Small photos of every kind, from one."""
    data = DEFAULT_PHOTO.read_bytes()
    image = np.asarray(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR), np.uint8)
    small = cv2.resize(image, (96, 72), interpolation=cv2.INTER_AREA)
    deep = small.astype(np.uint16) * 257
    clear = np.dstack([small, small[..., 0]])
    kinds = [
        (".jpg", small, []),
        (".jpg", small, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]),
        (".jpg", small[..., 0], [cv2.IMWRITE_JPEG_RST_INTERVAL, 4]),
        (".png", small, []),
        (".png", deep, []),
        (".png", clear, []),
        (".webp", small, [cv2.IMWRITE_WEBP_QUALITY, 80]),
        (".webp", clear, [cv2.IMWRITE_WEBP_QUALITY, 101]),
    ]
    seeds = [cv2.imencode(kind, picture, flags)[1].tobytes() for kind, picture, flags in kinds]
    return [*seeds, (DEFAULT_PHOTO.parent / "000.heic").read_bytes()]


def iterate_cases(rng: np.random.Generator, seeds: list[bytes]) -> Iterator[Case]:
    """Cases without end, the same for the same ``rng``."""
    while True:
        body = seeds[int(rng.integers(len(seeds)))]
        for _ in range(int(rng.integers(1, 8))):
            body = mutate(rng, body, seeds)
        yield Case(body, make_query(rng) if rng.random() < 0.25 else "max_people=1")


def mutate(rng: np.random.Generator, body: bytes, seeds: list[bytes]) -> bytes:
    """One change somewhere; headers are hit as often as all the rest."""
    data = bytearray(body)
    size = len(data)
    if size == 0:
        return bytes(rng.bytes(8))
    reach = min(size, 700) if rng.random() < 0.5 else size
    at = int(rng.integers(reach))
    length = int(rng.integers(1, 64))
    match int(rng.integers(9)):
        case 0:
            data[at] ^= 1 << int(rng.integers(8))
        case 1:
            data[at] = int(rng.integers(256))
        case 2:
            del data[at : at + length]
        case 3:
            data[at:at] = data[at : at + length] * int(rng.integers(1, 20))
        case 4:
            data[at:at] = rng.bytes(length)
        case 5:
            width = int(rng.choice([1, 2, 4]))
            value = _NUMBERS[int(rng.integers(len(_NUMBERS)))] % 256**width
            number = value.to_bytes(width, "big")
            data[at : at + width] = number if rng.random() < 0.5 else number[::-1]
        case 6:
            del data[at:]
        case 7:
            other = seeds[int(rng.integers(len(seeds)))]
            data[at:] = other[int(rng.integers(len(other))) :]
        case _:
            data[at : at + length] = bytes(length)
    return bytes(data)


def make_query(rng: np.random.Generator) -> str:
    """Parameters with values that mostly make no sense, some of them twice."""
    pairs = []
    for _ in range(int(rng.integers(1, 4))):
        name = NAMES[int(rng.integers(len(NAMES)))]
        value = VALUES[int(rng.integers(len(VALUES)))]
        pairs.append(f"{quote(name)}={quote(value)}")
    if rng.random() < 0.1:
        pairs.append("%zz%ff=&&&=;a=b")
    return "&".join(pairs)


if __name__ == "__main__":
    main()
