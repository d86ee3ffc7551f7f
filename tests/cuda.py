"""Machines where CUDA is installed and does not work."""

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

    _claim(monkeypatch, falls_back)


def claim_cuda_that_cannot_run(monkeypatch: pytest.MonkeyPatch) -> None:
    """What it does with a GPU that it has no kernels for: the first run fails, nothing before."""
    real: Any = ort.InferenceSession

    class OnOldGpu(real):  # type: ignore[misc]
        def get_providers(self) -> list[str]:
            return ["CUDAExecutionProvider", "CPUExecutionProvider"]

        def run(self, *_: Any) -> Any:
            raise RuntimeError("CUDA failure 209: no kernel image is available for execution")

    def opened(data: bytes, options: ort.SessionOptions, providers: list[Any]) -> Any:
        if providers[0][0] == "CPUExecutionProvider":
            return real(data, options, providers=providers)
        options.add_session_config_entry("session.disable_cpu_ep_fallback", "0")
        return OnOldGpu(data, options, providers=["CPUExecutionProvider"])

    _claim(monkeypatch, opened)


def _claim(monkeypatch: pytest.MonkeyPatch, session: Any) -> None:
    monkeypatch.setattr(ort, "InferenceSession", session)
    monkeypatch.setattr(
        ort, "get_available_providers", lambda: ["CUDAExecutionProvider", "CPUExecutionProvider"]
    )
