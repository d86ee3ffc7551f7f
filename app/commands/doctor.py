"""``posematch doctor``: whether this machine and these settings can serve, and what to mend."""

from __future__ import annotations

import ipaddress
import json
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from http.client import HTTPException
from importlib import metadata
from pathlib import Path
from typing import Annotated, Literal
from urllib import request

import numpy as np
import onnxruntime as ort
import typer
from rich.markup import escape

from app.commands.bench import SAMPLE
from app.commands.console import output, print_json
from app.commands.machine import cpu_flags, describe_cpu, memory, why_no_listening
from app.engine import chosen_networks, load_engine
from app.errors import RequestError, StartupError
from app.pipeline import PhotoQuery
from app.settings import LIFTER_OFF, Settings, load_settings
from library_store.build import default_library_dir, verify_library
from library_store.errors import LibraryError
from models.card import read_card, read_weights
from models.errors import ModelError
from models.pose_lifter import lifter_names

State = Literal["ok", "warning", "failure"]
_COLOURS: dict[State, str] = {"ok": "green", "warning": "yellow", "failure": "red"}

SERVING_BYTES = 450_000_000
"""Memory of a serving process with the default library, with room for a few large photos; a build
of that library takes less."""
LIBRARY_BYTES = 250_000_000
"""Disk space a build of the default library takes while it runs."""


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at; ``mend`` says what to do where it is not well."""

    name: str
    state: State
    said: str
    mend: str = ""


def doctor(
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Check that this machine can serve.

    Looks at settings, machine, weights, library, cache and port, and says what to mend.
    Builds nothing and changes nothing. Exit code: 0 when it can serve, 1 when it cannot.

    \b
    posematch doctor
    POSEMATCH_PORT=9000 POSEMATCH_LIBRARY_DIR=/data/ours posematch doctor
    """  # noqa: D301
    findings = []
    for finding in examine():
        findings.append(finding)
        if not as_json:
            _print(finding)
    failed = any(finding.state == "failure" for finding in findings)
    if as_json:
        report = {"can_serve": not failed, "findings": [asdict(it) for it in findings]}
        print_json(json.dumps(report))
    if failed:
        raise typer.Exit(1)


def examine() -> Iterator[Finding]:
    """All findings, one after another; without readable settings there is only the first."""
    yield _software()
    try:
        settings = load_settings()
    except StartupError as error:
        yield Finding("settings", "failure", str(error), "correct the environment variables")
        return
    yield _settings()
    yield _cpu()
    yield _memory()
    yield _cache(settings)
    yield _disk(settings)
    yield _port(settings)
    yield _exposure(settings)
    weights = list(_networks(settings))
    yield from weights
    library = _library(settings)
    yield library
    if library.state == "ok" and all(finding.state == "ok" for finding in weights):
        yield _photo(settings)


def _software() -> Finding:
    names = ("posematch", "onnxruntime", "numpy", "hnswlib", "opencv-python-headless")
    versions = [f"Python {sys.version.split()[0]}", *(f"{it} {_version(it)}" for it in names)]
    providers = ", ".join(ort.get_available_providers())
    return Finding("software", "ok", f"{', '.join(versions)}; onnxruntime can use {providers}")


def _version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "under another name"


def _settings() -> Finding:
    given = sorted(name for name in os.environ if name.upper().startswith("POSEMATCH_"))
    return Finding("settings", "ok", f"set: {', '.join(given)}" if given else "all defaults")


def _cpu() -> Finding:
    flags = cpu_flags()
    if "avx2" in flags or "asimd" in flags:
        return Finding("CPU", "ok", describe_cpu())
    return Finding(
        "CPU",
        "warning",
        describe_cpu(),
        "without AVX2 (or ARM's ASIMD) the networks run several times slower; raise "
        "POSEMATCH_DEADLINE_MS, or use another machine",
    )


def _memory() -> Finding:
    free = memory()
    if free is None:
        return Finding(
            "memory", "warning", "unknown here", f"see that {_mb(SERVING_BYTES)} are free"
        )
    said = f"{_mb(free.available_bytes)} free"
    if free.container_limit_bytes is not None:
        said += f", this container's limit is {_mb(free.container_limit_bytes)}"
    if free.available_bytes >= SERVING_BYTES:
        return Finding("memory", "ok", said)
    return Finding(
        "memory",
        "warning",
        said,
        f"serving takes {_mb(SERVING_BYTES)}; free some, or raise the limit",
    )


def _cache(settings: Settings) -> Finding:
    directory = settings.cache_dir
    if settings.library_dir is not None:
        return Finding("cache", "ok", "not needed: POSEMATCH_LIBRARY_DIR is set")
    try:
        directory.exists()  # raises where this user may not look, or of a name that cannot be
        with tempfile.TemporaryFile(dir=_nearest(directory)):
            pass
    except OSError as error:
        return Finding(
            "cache",
            "ok" if _is_library_there(settings) else "failure",
            f"{directory} is not writable: {error.strerror}",
            "make it writable, or set POSEMATCH_CACHE_DIR to a directory that is",
        )
    return Finding("cache", "ok", f"{directory} is writable")


def _disk(settings: Settings) -> Finding:
    directory = settings.cache_dir
    nearest = _nearest(directory)
    free = shutil.disk_usage(nearest).free
    if free >= LIBRARY_BYTES or _is_library_there(settings):
        return Finding("disk", "ok", f"{_mb(free)} free at {nearest}")
    return Finding(
        "disk",
        "failure",
        f"{_mb(free)} free at {nearest}",
        f"building the library takes {_mb(LIBRARY_BYTES)}; free some, or set POSEMATCH_CACHE_DIR",
    )


def _port(settings: Settings) -> Finding:
    place = f"{settings.host}:{settings.port}"
    why_not = why_no_listening(settings.host, settings.port)
    if why_not is None:
        return Finding("port", "ok", f"{place} is free")
    if _answers(settings):
        return Finding("port", "ok", f"posematch is already serving on {place}")
    return Finding(
        "port",
        "failure",
        f"{place} cannot be had: {why_not}",
        "stop what uses it, or set POSEMATCH_HOST and POSEMATCH_PORT to others",
    )


def _answers(settings: Settings) -> bool:
    """Whether a posematch is what listens there, asked without the environment's proxy."""
    host = {"0.0.0.0": "127.0.0.1", "::": "[::1]"}.get(settings.host, settings.host)
    directly = request.build_opener(request.ProxyHandler({}))
    try:
        with directly.open(f"http://{host}:{settings.port}/openapi.json", timeout=2) as answer:
            document = json.load(answer)
    except (OSError, ValueError, HTTPException):
        return False
    return isinstance(document, dict) and document.get("info", {}).get("title") == "posematch"


def _exposure(settings: Settings) -> Finding:
    try:
        is_local = ipaddress.ip_address(settings.host).is_loopback
    except ValueError:
        is_local = settings.host == "localhost"
    if is_local:
        return Finding("access", "ok", "this machine only")
    if settings.api_keys:
        return Finding("access", "ok", f"the network, with {len(settings.api_keys)} API keys")
    return Finding(
        "access",
        "warning",
        "everybody who reaches this address can use it",
        "set POSEMATCH_API_KEYS, or keep it behind something that checks",
    )


def _networks(settings: Settings) -> Iterator[Finding]:
    try:
        names: tuple[str, ...] = chosen_networks(settings)
    except ModelError as error:
        yield Finding("networks", "failure", *_split(str(error)))
        return
    if settings.lifter != LIFTER_OFF:
        names = (*names, *lifter_names(settings.lifter, settings.weights_dir))
    for name in names:
        yield _weights(settings.weights_dir, name)


def _weights(directory: Path, name: str) -> Finding:
    path = directory / f"{name}.json"
    try:
        card = read_card(path)
        read_weights(directory / card.file, card)
    except ModelError as error:
        return Finding(f"weights of {name}", "failure", *_split(str(error)))
    except OSError as error:
        said = f"{path} cannot be read: {error.strerror}"
        return Finding(f"weights of {name}", "failure", said, "make it readable")
    whole = f"{card.name} {card.version}, sha256 {card.sha256[:12]}… as its card says"
    return Finding(f"weights of {name}", "ok", whole)


def _library(settings: Settings) -> Finding:
    directory = settings.library_dir or default_library_dir(settings.cache_dir)
    if settings.library_dir is None and not os.path.exists(directory):
        return Finding(
            "library",
            "warning",
            "not built yet",
            "the first start builds it, in a minute or two; to do it now: posematch library build",
        )
    try:
        manifest = verify_library(directory)
    except LibraryError as error:
        said, mend = _split(str(error))
        if settings.library_dir is None:
            otherwise = "delete that directory; the next start builds it again"
        else:
            otherwise = "set POSEMATCH_LIBRARY_DIR to the directory of a library"
        return Finding("library", "failure", said, mend or otherwise)
    except OSError as error:
        said = f"{directory} cannot be read: {error.strerror}"
        return Finding("library", "failure", said, "make it readable")
    said = f"{manifest.name} {manifest.version}, {manifest.n_exemplars} exemplars, sums as written"
    return Finding("library", "ok", f"{said}; {directory}")


def _photo(settings: Settings) -> Finding:
    """The whole way, as a request would go."""
    try:
        engine = load_engine(settings)
    except StartupError as error:
        return Finding("a photo", "failure", *_split(str(error)))
    data = SAMPLE.read_bytes()
    times_ms = []
    try:
        for _ in range(5):
            started_s = time.perf_counter()
            people = engine.pipeline.estimate(data, PhotoQuery()).people
            times_ms.append(1e3 * (time.perf_counter() - started_s))
    except RequestError as error:
        mend = "see that the settings let an ordinary photo pass"
        return Finding("a photo", "failure", f"refused: {error.detail}", mend)
    finally:
        engine.library.close()
    median_ms = float(np.median(times_ms))
    index = engine.library.index_backend
    said = f"{len(people)} of 1 person found, matched with {index}, {median_ms:.0f} ms"
    if not people:
        return Finding(
            "a photo", "failure", said, "the model finds nobody in the sample: use other weights"
        )
    if median_ms > settings.deadline_ms:
        return Finding(
            "a photo",
            "warning",
            f"{said}, more than the deadline of {settings.deadline_ms:g} ms",
            "free the machine, or raise POSEMATCH_DEADLINE_MS; posematch bench shows the stages",
        )
    return Finding("a photo", "ok", said)


def _is_library_there(settings: Settings) -> bool:
    return os.path.exists(settings.library_dir or default_library_dir(settings.cache_dir))


def _nearest(directory: Path) -> Path:
    """The first of it and its parents that is there, as far as this user may see."""
    return next(it for it in (directory, *directory.parents) if os.path.exists(it))


def _split(message: str) -> tuple[str, str]:
    """Our error messages say what is wrong; then, after a semicolon, how to mend it."""
    said, _, mend = message.partition("; ")
    return said, mend


def _mb(size_bytes: int) -> str:
    return f"{size_bytes / 1e6:.0f} MB" if size_bytes < 10e9 else f"{size_bytes / 1e9:.0f} GB"


def _print(finding: Finding) -> None:
    colour = _COLOURS[finding.state]
    line = (
        f"[{colour}]{finding.state:>7}[/{colour}]  {escape(finding.name)}: {escape(finding.said)}"
    )
    output.print(line, highlight=False, soft_wrap=True)
    if finding.state != "ok" and finding.mend:
        output.print(f"{'':>9}{escape(finding.mend)}", highlight=False, soft_wrap=True)
