"""What a network costs here: CPU time an input, one thread."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.card import DetectorOutput, ModelCard, PoseOutput
from models.looks import usual
from models.person_detector import shrunk
from models.providers import cpu_features, cpu_name
from models.session import OnnxModel, made_up_joints

WARM_UP_RUNS = 5
MATRIX_FEATURES = ("amx_int8", "avx512_vnni", "avx_vnni", "avx2", "asimddp")
"""What makes 8-bit networks fast, the fastest first."""
ENOUGH_S, LEAST_RUNS = 20.0, 3
"""Networks for GPUs take seconds a crop on a CPU: then a few runs must do."""


def cpu_ms(model: OnnxModel, runs: int = 60) -> float:
    """CPU milliseconds of one crop, of one 4:3 photo after shrinking, or of one person's joints.

    Of a crop that a network may look at several times, what an everyday person costs on average.
    The least of ``runs``: what other work on the machine adds is not the network's. Only the CPU's
    own time is counted, also where a GPU does the work.
    """
    output = model.card.output
    rng = np.random.default_rng(0)
    batch: NDArray[Any]
    if isinstance(output, PoseOutput):
        side = output.input_px
        batch = rng.integers(0, 256, (1, side, side, 3)).astype(np.uint8)
    elif isinstance(output, DetectorOutput):
        photo = rng.integers(0, 256, (480, 640, 3)).astype(np.uint8)
        batch = shrunk(photo, output.long_side_px)[0][None]
    else:
        batch = made_up_joints(1, output)
    spent_s = []
    for _ in range(WARM_UP_RUNS + runs):
        started_s = time.process_time()
        model.run(batch)
        spent_s.append(time.process_time() - started_s)
        if len(spent_s) >= LEAST_RUNS and sum(spent_s) > ENOUGH_S:
            break
    runs_each = usual(output.looks) if isinstance(output, PoseOutput) else 1.0
    return 1e3 * runs_each * min(spent_s[WARM_UP_RUNS:] or spent_s[1:])


def with_cost(card: ModelCard, model: OnnxModel) -> ModelCard:
    """The card with what its network costs here, and on which CPU that is."""
    runtime = str(model.runtime)
    best = next((name for name in MATRIX_FEATURES if name in cpu_features()), None)
    cpu = cpu_name() if best is None else f"{cpu_name()}, {best}"
    costs = card.cost_ms | {runtime: round(cpu_ms(model), 2)}
    return card.model_copy(update={"cost_ms": costs, "cost_cpu": card.cost_cpu | {runtime: cpu}})
