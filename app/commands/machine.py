"""What the machine is: CPU, memory, ports. Linux tells most, elsewhere less is known."""

from __future__ import annotations

import asyncio
import os
import platform
import socket
from dataclasses import dataclass
from pathlib import Path

from app.settings import available_cores

_FLAGS = ("avx2", "avx512f", "avx512_vnni", "amx_bf16", "amx_int8", "asimd")
"""Instruction sets that change how fast the networks run."""


@dataclass(frozen=True)
class Memory:
    """Bytes this process may still take, and the limit of its container if there is one."""

    available_bytes: int
    container_limit_bytes: int | None


def cpu_flags() -> tuple[str, ...]:
    """Those of the instruction sets that matter which the CPU has."""
    has = set(_cpuinfo("flags").split()) | set(_cpuinfo("Features").split())
    return tuple(flag for flag in _FLAGS if flag in has)


def describe_cpu() -> str:
    """Such as "Intel Xeon, 2 cores (avx2, avx512f)"."""
    name = _cpuinfo("model name") or platform.processor() or platform.machine()
    cores = available_cores()
    flags = ", ".join(cpu_flags()) or "no flags known"
    return f"{name}, {cores} {'core' if cores == 1 else 'cores'} ({flags})"


def memory() -> Memory | None:
    """None where it cannot be read."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
    except OSError:
        return None
    kilobytes = {line.split(":")[0]: int(line.split()[1]) for line in lines if ":" in line}
    available = kilobytes.get("MemAvailable")
    if available is None:
        return None
    group = Path("/sys/fs/cgroup")
    limit = used = None
    try:
        limit = int((group / "memory.max").read_text())
        used = int((group / "memory.current").read_text())
    except (OSError, ValueError):
        pass  # no cgroup v2, or no limit ("max")
    free = available * 1024
    if limit is not None and used is not None:
        free = min(free, limit - used)
    return Memory(free, limit)


def why_no_listening(host: str, port: int) -> str | None:
    """Why a server cannot listen there now; None if it can.

    Binds and lets go, as asyncio's servers bind: all addresses of a name, over connections that
    linger. Nobody can connect meanwhile, and whoever else binds at the same moment still may.
    """

    async def bind() -> None:
        loop = asyncio.get_running_loop()
        server = await loop.create_server(asyncio.Protocol, host, port, start_serving=False)
        server.close()

    try:
        asyncio.run(bind())
    except socket.gaierror as error:
        return error.strerror or str(error)
    except OSError as error:  # whose own text has the address once more
        return str(error) if error.errno is None else os.strerror(error.errno)
    return None


def _cpuinfo(key: str) -> str:
    """The first processor's value of ``key``, empty when it is not known."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return ""
    for line in lines:
        name, _, value = line.partition(":")
        if name.strip() == key:
            return value.strip()
    return ""
