"""The top of the head, for formats that end at the base of the skull."""

from __future__ import annotations

import numpy as np

from library_store.anatomy import Float, root_of, unit
from library_store.skeleton import HEAD_TOP, NECK

HEAD_PER_TRUNK = 0.47
"""Neck to head top over root to neck: the median of CMU's people."""


def put_head_top(positions: Float) -> tuple[Float, float]:
    """Poses (F, 14, 3) whose head top is the skull's base, with the top put beyond it.

    It lies from the neck towards the skull's base, at 0.47 of the person's median trunk. Returns
    the poses and that distance, in the poses' unit.
    """
    neck = positions[:, NECK]
    trunk = np.linalg.norm(neck - root_of(positions), axis=-1)
    seen = trunk[np.isfinite(trunk)]  # frames with missing joints are dropped later, not all
    reach = HEAD_PER_TRUNK * float(np.median(seen)) if len(seen) else np.nan
    raised = positions.copy()
    raised[:, HEAD_TOP] = neck + reach * unit(positions[:, HEAD_TOP] - neck)
    return raised, reach
