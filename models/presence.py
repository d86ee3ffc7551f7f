"""Second thoughts on detections: a box without a readable pose, or with a taken one, is nobody."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from models.heatmaps import Joints2D

SURE_JOINTS, LEAST_CONFIDENCE = 5, 0.6
"""Mean confidence of that many best joints below which a box is not called a person: of a face and
shoulders alone five joints are sure, of a chair or an arm taken for somebody hardly one."""
SAME_PERSON = 0.1
"""Mean distance of two people's joints, over the larger extent, below which they are one."""


def present(people: Sequence[Joints2D]) -> list[int]:
    """Which of the detected ``people`` (best first) to answer, as indices in order.

    Dropped are poses that the pose network itself does not believe, and poses that lie on those of
    somebody more certain: two boxes of one person, which their overlap alone did not give away.
    """
    kept: list[int] = []
    for i, person in enumerate(people):
        belief = person.peak if person.confidence is None else person.confidence
        if float(np.sort(belief)[-SURE_JOINTS:].mean()) < LEAST_CONFIDENCE:
            continue
        if not any(_same(person, people[k]) for k in kept):
            kept.append(i)
    return kept


def _same(a: Joints2D, b: Joints2D) -> bool:
    extent = max(float(np.ptp(p.positions_px, axis=0).max()) for p in (a, b))
    distance = np.linalg.norm(a.positions_px - b.positions_px, axis=-1)
    return float(distance.mean()) < SAME_PERSON * extent
