"""The precision of training on this machine: bf16 where it is multiplied natively, else fp32.

A processor without bf16 instructions emulates them, some fifty times slower than fp32.
"""

from __future__ import annotations

from contextlib import AbstractContextManager

import torch


def has_bf16(device: str | torch.device) -> bool:
    """Whether ``device`` multiplies bf16 matrices itself (CPUs: AVX-512 BF16 or AMX)."""
    kind = torch.device(device).type
    if kind == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    if kind == "cpu":
        cpu = torch.cpu
        return bool(cpu._is_avx512_bf16_supported() or cpu._is_amx_tile_supported())
    return False


def mixed_precision(device: str | torch.device) -> AbstractContextManager[object]:
    """Autocast to bf16 if :func:`has_bf16`, else no change of precision."""
    kind = torch.device(device).type
    return torch.autocast(kind, torch.bfloat16, enabled=has_bf16(device))
