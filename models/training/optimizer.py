"""Muon for convolution kernels, AdamW for the rest.

Muon (Jordan et al. 2024) replaces the momentum matrix by its nearest semi-orthogonal one, found
with a Newton-Schulz iteration; a kernel (c_out, c_in, k, k) counts as a (c_out, c_in k k) matrix.
It needs far fewer crops than AdamW for the same accuracy, and crops are what CPU training lacks.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor, nn

from models.training.precision import has_bf16

_COEFFICIENTS = (3.4445, -4.7750, 2.0315)


def orthogonalise(matrix: Tensor, steps: int = 5) -> Tensor:
    """Approximately U V^T of the (rows, cols) matrix's singular value decomposition."""
    a, b, c = _COEFFICIENTS
    x = matrix.bfloat16() if has_bf16(matrix.device) else matrix.float()
    tall = x.shape[0] > x.shape[1]
    if tall:
        x = x.T
    x = x / (x.norm() + 1e-7)
    for _ in range(steps):
        gram = x @ x.T
        x = a * x + (b * gram + c * gram @ gram) @ x
    return (x.T if tall else x).to(matrix.dtype)


class Muon(torch.optim.Optimizer):
    """Momentum, orthogonalised; for parameters of two or more dimensions."""

    def __init__(
        self,
        params: Iterable[Tensor],
        lr: float = 0.02,
        momentum: float = 0.95,
        weight_decay: float = 0.01,
    ) -> None:
        super().__init__(params, {"lr": lr, "momentum": momentum, "weight_decay": weight_decay})

    @torch.no_grad()
    def step(self, closure: Any = None) -> None:  # type: ignore[override]  # noqa: ARG002
        """One update from the gradients."""
        for group in self.param_groups:
            for p in group["params"]:
                if p.grad is None:
                    continue
                state = self.state[p]
                if "momentum" not in state:
                    state["momentum"] = torch.zeros_like(p.grad)
                buffer: Tensor = state["momentum"]
                buffer.lerp_(p.grad, 1 - group["momentum"])
                nesterov = p.grad.lerp(buffer, group["momentum"])
                flat = nesterov.reshape(nesterov.shape[0], -1)
                update = orthogonalise(flat).reshape(p.shape)
                scale = max(1.0, flat.shape[0] / flat.shape[1]) ** 0.5
                p.mul_(1 - group["lr"] * group["weight_decay"])
                p.add_(update, alpha=-group["lr"] * scale)


def build(model: nn.Module, kind: str, lr: float) -> list[torch.optim.Optimizer]:
    """``muon`` or ``adamw``; ``lr`` is AdamW's rate, Muon's is ten times that."""
    kernels: list[Tensor] = []
    rest: list[Tensor] = []
    for name, p in model.named_parameters():
        is_kernel = kind == "muon" and p.ndim == 4 and "score" not in name
        (kernels if is_kernel else rest).append(p)
    optimizers: list[torch.optim.Optimizer] = [
        torch.optim.AdamW(rest, lr=lr, betas=(0.9, 0.99), weight_decay=0.01)
    ]
    if kernels:
        optimizers.append(Muon(kernels, lr=10 * lr))
    return optimizers
