"""A machine where CUDA is installed and does not start."""

from __future__ import annotations

from typing import Any

import onnxruntime as ort
import pytest


def claim_cuda(monkeypatch: pytest.MonkeyPatch) -> None:
    """What onnxruntime's GPU build does without a driver: it has CUDA, and falls back silently."""
    real: Any = ort.InferenceSession

    def falls_back(data: bytes, options: ort.SessionOptions, providers: list[Any]) -> Any:
        del providers
        options.add_session_config_entry("session.disable_cpu_ep_fallback", "0")
        return real(data, options, providers=["CPUExecutionProvider"])

    monkeypatch.setattr(ort, "InferenceSession", falls_back)
    monkeypatch.setattr(
        ort, "get_available_providers", lambda: ["CUDAExecutionProvider", "CPUExecutionProvider"]
    )
