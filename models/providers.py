"""What runs the networks: execution providers, the precision they run in, what this CPU offers."""

from __future__ import annotations

import json
import platform
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal, get_args

import onnxruntime as ort

from models.card import ModelCard, Precision, Provider
from models.errors import ModelError

ProviderChoice = Literal["auto", "cpu", "cuda", "openvino"]

EXECUTION_PROVIDERS: dict[Provider, str] = {
    "cuda": "CUDAExecutionProvider",
    "openvino": "OpenVINOExecutionProvider",
    "cpu": "CPUExecutionProvider",
}
PACKAGES: dict[Provider, str] = {
    "cuda": "onnxruntime-gpu",
    "openvino": "onnxruntime-openvino",
    "cpu": "onnxruntime",
}
INT8_FEATURES = ("avx2", "asimddp")
"""CPU features with which 8-bit integers are multiplied faster than single precision: almost twice
as fast with AVX2 alone, more with what newer CPUs have beside it."""
BF16_FEATURES = ("amx_bf16", "avx512_bf16")
"""CPU features with dot products of bfloat16."""


@dataclass(frozen=True)
class Runtime:
    """A provider and the precision it runs a network in."""

    provider: Provider
    precision: Precision

    def __str__(self) -> str:
        """As cards name it, ``cpu/fp32``."""
        return f"{self.provider}/{self.precision}"


CPUINFO = Path("/proc/cpuinfo")


@cache
def cpu_features(cpuinfo: Path = CPUINFO) -> frozenset[str]:
    """What the first core says it can; empty where the system does not tell."""
    if not cpuinfo.exists():
        # Every ARM core of a Mac has the dot products.
        arm = platform.system() == "Darwin" and platform.machine() == "arm64"
        return frozenset({"asimddp"} if arm else ())
    return frozenset(_first_core(cpuinfo, {"flags", "Features"}).split())


def cpu_name(cpuinfo: Path = CPUINFO) -> str:
    """What the first core calls itself, or else its architecture."""
    return _first_core(cpuinfo, {"model name"}) or platform.machine()


def _first_core(cpuinfo: Path, keys: set[str]) -> str:
    """The first line with one of these keys; empty where there is none."""
    try:
        text = cpuinfo.read_text()
    except OSError:
        return ""
    for line in text.splitlines():
        key, _, value = line.partition(":")
        if key.strip() in keys:
            return value.strip()
    return ""


def present_providers(wanted: ProviderChoice = "auto") -> tuple[Provider, ...]:
    """Providers that the installed onnxruntime was built with; only ``wanted``, unless auto.

    Raises ``ModelError`` when ``wanted`` is not among them.
    """
    available = set(ort.get_available_providers())
    present = tuple(p for p in get_args(Provider) if EXECUTION_PROVIDERS[p] in available)
    if wanted == "auto":
        return present
    if wanted not in present:
        raise ModelError(
            f"POSEMATCH_PROVIDER={wanted}, but the installed onnxruntime {ort.__version__} has "
            f"only {', '.join(present)}; install {PACKAGES[wanted]} in its place "
            "(docs/operations.md), or choose another provider"
        )
    return (wanted,)


def runtime_of(
    card: ModelCard, provider: Provider, features: frozenset[str] | None = None
) -> Runtime | None:
    """How ``provider`` would run a card's network on this CPU; None when it should not."""
    features = cpu_features() if features is None else features
    if provider not in card.providers:
        return None
    if provider != "cuda" and card.cpu_features and not features & set(card.cpu_features):
        return None
    if card.precision == "fp32" and provider == "openvino" and features & set(BF16_FEATURES):
        return Runtime(provider, "bf16")
    return Runtime(provider, card.precision)


def open_session(weights: bytes, runtime: Runtime, *, concurrency: int) -> ort.InferenceSession:
    """A session that runs wholly on ``runtime.provider``, or an exception of onnxruntime's."""
    options = ort.SessionOptions()
    # Requests run side by side, each on one core; spinning would steal from the others.
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.log_severity_level = 3
    name = EXECUTION_PROVIDERS[runtime.provider]
    arguments: dict[str, Any] = {}
    if runtime.provider == "openvino":
        arguments = _openvino(runtime, concurrency)
    elif runtime.provider == "cuda":
        # The default tries every algorithm anew for every number of people.
        arguments = {"cudnn_conv_algo_search": "HEURISTIC"}
    if runtime.provider != "cpu":
        # Without this a provider that cannot do its work hands it to the CPU and says nothing.
        options.add_session_config_entry("session.disable_cpu_ep_fallback", "1")
    session = ort.InferenceSession(weights, options, providers=[(name, arguments)])
    session.disable_fallback()
    active = session.get_providers()[0]
    if active != name:
        raise RuntimeError(f"{name} could not be started, {active} took its place")
    return session


def _openvino(runtime: Runtime, concurrency: int) -> dict[str, str]:
    config = {
        "PERFORMANCE_HINT": "LATENCY",
        "INFERENCE_PRECISION_HINT": "f32" if runtime.precision == "fp32" else "bf16",
        # As many requests side by side, a thread each.
        "NUM_STREAMS": str(concurrency),
        "INFERENCE_NUM_THREADS": str(concurrency),
        "ENABLE_CPU_PINNING": "NO",
    }
    return {"device_type": "CPU", "load_config": json.dumps({"CPU": config})}
