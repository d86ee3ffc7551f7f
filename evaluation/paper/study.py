"""A study: test sets, libraries and methods, and every table that can be made of them.

The same code makes the tables of Human3.6M and their analogues on free mocap: what differs is where
the views come from, and what stands for "2D from the photo".
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from app.lifting.geometry import Floats
from evaluation.metrics import rigid_error_mm, similarity_error_mm
from evaluation.paper.published import Row
from evaluation.paper.systems import (
    Seen2D,
    System,
    known_depths,
    optimal_exemplars,
    ours,
    paper_method,
)
from evaluation.paper.views import Views
from library_store.library import Library
from models.pose_lifter import PoseLifter

Error = Callable[[Floats, Floats], Floats]


@dataclass(frozen=True)
class TestSet:
    """Views and their 2D: ``seen["gt"]`` the true one, ``seen["x"]`` that of a network, if any.

    ``columns``: the actions, in the table's order.
    """

    views: Views
    seen: dict[str, Seen2D]
    columns: tuple[str, ...]


@dataclass(frozen=True)
class Curve:
    """Figures 7 and 8: mean and median error by library size, a line each."""

    sizes: tuple[int, ...]
    mean: dict[str, list[float]] = field(default_factory=dict)
    median: dict[str, list[float]] = field(default_factory=dict)


def per_person(error: Error, answer: Floats, views: Views) -> Floats:
    """(N,) mean joint errors, mm."""
    mean: Floats = error(answer, views.joints_mm).mean(-1)
    return mean


def measured_row(label: str, errors: Floats, test: TestSet) -> Row:
    """Errors (N,) of a test set as a row; an action without a view is nan."""
    actions = test.views.actions
    means = [
        float(errors[actions == name].mean()) if (actions == name).any() else float("nan")
        for name in test.columns
    ]
    return Row(label, tuple(means), float(errors.mean()), float(np.median(errors)))


def comparison(test: TestSet, source: str, systems: Sequence[System], error: Error) -> list[Row]:
    """Tables 1, 2 and 4: the methods by action; a label says how many people were refused."""
    rows = []
    for system in systems:
        found = system.lift(test.views, test.seen[source])
        errors = per_person(error, found.answer_mm, test.views)
        rows.append(measured_row(found.labelled(system.label), errors, test))
    return rows


def diagnostic(test: TestSet, library: Library, systems: Sequence[System]) -> list[Row]:
    """Table 5: similarity alignment; the paper's method with k = 1 and 10, then ``systems``."""
    tried = [
        System("here, X* k=1", paper_method(library, 1)),
        System("here, X* k=10", paper_method(library, 10)),
        *systems,
    ]
    return comparison(test, "gt", tried, similarity_error_mm)


def warping(test: TestSet, source: str, library: Library) -> list[Row]:
    """Tables 6 and 7: X, X* and, with the true depths, the upper bound of both."""
    seen = test.seen[source]
    found = paper_method(library)(test.views, seen)
    rows = [
        measured_row(f"X given {source}", _p1(found.exemplar_mm, test), test),
        measured_row(f"X* given {source}", _p1(found.answer_mm, test), test),
    ]
    bound = _p1(known_depths(test.views, seen), test)
    return [*rows, measured_row("[s x, Z_GT]", bound, test)]


def optimal(test: TestSet, library: Library) -> list[Row]:
    """Table 8: the exemplar nearest in 3D, and that warped onto the true 2D."""
    exemplars = optimal_exemplars(library, test.views)
    warped = known_depths(test.views, test.seen["gt"], exemplars)
    return [
        measured_row("X given GT", _p1(exemplars, test), test),
        measured_row("X* given GT", _p1(warped, test), test),
    ]


def transfer(test: TestSet, library: Library, systems: Sequence[System]) -> list[Row]:
    """Table 9: another data set, true 2D; warped, unwarped, then ``systems``.

    The mean is of the actions' means, as the paper's two in this table are, to the last digit; all
    its others are of frames.
    """
    found = paper_method(library)(test.views, test.seen["gt"])
    rows = [
        measured_row("here, X* (warped)", _p1(found.answer_mm, test), test),
        measured_row("here, X (unwarped)", _p1(found.exemplar_mm, test), test),
    ]
    rows += comparison(test, "gt", systems, rigid_error_mm)
    return [replace(row, mean=float(np.nanmean(row.actions))) for row in rows]


def size_curve(
    test: TestSet,
    sizes: Sequence[int],
    library_of: Callable[[int], Library],
    network: PoseLifter | None,
) -> Curve:
    """Figures 7 and 8: every variant of the paper, and ours, by library size."""
    curve = Curve(tuple(sizes))
    for size in sizes:
        library = library_of(size)
        found: dict[str, Floats] = {}
        for source in test.seen:
            seen = test.seen[source]
            paper = paper_method(library)(test.views, seen)
            found[f"X|{source}"] = _p1(paper.exemplar_mm, test)
            found[f"X*|{source}"] = _p1(paper.answer_mm, test)
            for name, lift in ours(library, network).items():
                found[f"{name}|{source}"] = _p1(lift(test.views, seen).answer_mm, test)
        exemplars = optimal_exemplars(library, test.views)
        found["X|GT"] = _p1(exemplars, test)
        warped = known_depths(test.views, test.seen["gt"], exemplars)
        found["X*|GT"] = _p1(warped, test)
        for name, errors in found.items():
            curve.mean.setdefault(name, []).append(float(errors.mean()))
            curve.median.setdefault(name, []).append(float(np.median(errors)))
        library.close()
    return curve


def sizes_up_to(n: int) -> tuple[int, ...]:
    """1, 2, 5, 18, ... thousand below ``n``, the paper's 18 and 180 thousand among them; and n."""
    thousands = (1, 2, 5, 18, 50, 180, 500)
    return (*(1000 * t for t in thousands if 1000 * t < 0.9 * n), n)


def _p1(answer: Floats | None, test: TestSet) -> Floats:
    assert answer is not None
    return per_person(rigid_error_mm, answer, test.views)
