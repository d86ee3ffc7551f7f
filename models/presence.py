"""Second thoughts on detections: a box without a readable pose, or with a taken one, is nobody."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from library_store.skeleton import LSP14
from models.heatmaps import Floats, Joints2D
from models.person_detector import PersonBox

_MIRROR = np.array(LSP14.mirror)
SURE_JOINTS, LEAST_BELIEF = 5, 0.28
"""Least product of the box's score and the mean confidence of that many best joints. Of a face and
shoulders alone five joints are sure; of a chair or a raised arm the two networks seldom err
together, where either alone would. It keeps 99.4% of the boxes that a teacher confirms in 350
scenes; in mosaics, where half the people are tiny or cut off, it keeps 89% of the people's and
drops two thirds of those that show nobody (docs/experiments.md)."""
SAME_PERSON = 0.1
"""Mean distance of two people's joints, over the larger extent, below which they are one."""
SAME_PLACE = 0.06
"""Distance of two joints of a kind, over that extent, below which they are one: a fifth of a usual
trunk."""


def belief(box: PersonBox, person: Joints2D, others: Sequence[Joints2D] = ()) -> float:
    """How far both networks believe that ``box`` shows somebody besides ``others``, 0..1.

    Joints that lie on those of others, left or right, are no sign of one more person.
    """
    own = person.belief.copy()
    for other in others:
        apart = np.minimum(_apart(person, other), _apart(person, other, _MIRROR))
        own[apart < SAME_PLACE * _extent(person, other)] = 0.0
    return box.score * float(np.sort(own)[-SURE_JOINTS:].mean())


def present(boxes: Sequence[PersonBox], people: Sequence[Joints2D]) -> list[int]:
    """Which of the detected ``people`` in ``boxes`` (best first) to answer, as indices in order.

    Dropped are poses that the pose network itself does not believe, and poses that lie, as a whole
    or by their sure joints, on those of somebody more certain: two boxes of one person, which their
    overlap alone did not give away.
    """
    kept: list[int] = []
    for i, (box, person) in enumerate(zip(boxes, people, strict=True)):
        before = [people[k] for k in kept]
        if belief(box, person, before) < LEAST_BELIEF:
            continue
        if not any(_same(person, other) for other in before):
            kept.append(i)
    return kept


def _same(a: Joints2D, b: Joints2D) -> bool:
    return float(_apart(a, b).mean()) < SAME_PERSON * _extent(a, b)


def _apart(a: Joints2D, b: Joints2D, order: NDArray[np.int64] | None = None) -> Floats:
    """Distance (J,) of the joints of ``a`` from those of ``b``, which are put in ``order``."""
    theirs = b.positions_px if order is None else b.positions_px[order]
    apart: Floats = np.linalg.norm(a.positions_px - theirs, axis=-1)
    return apart


def _extent(a: Joints2D, b: Joints2D) -> float:
    return max(float(np.ptp(p.positions_px, axis=0).max()) for p in (a, b))
