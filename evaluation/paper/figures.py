"""Figures of people: a failure (2), the warp (3), answers (4), methods side by side (5, 6).

What is drawn: the 2D that was given, then novel views with the camera's frustum. Bones in colour
are the answer, grey ones what it is compared with: the truth, or in figure 3 the exemplar before
the warp.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from app.drawing.picture import Picture, Words
from app.drawing.views import NOVEL_VIEWS, draw_novel_view, draw_overlay
from app.imaging import Photo
from app.lifting.geometry import Floats
from app.lifting.lifter import Lifter
from app.lifting.types import Intrinsics, LiftedPerson, Method
from app.pipeline import PhotoResult, SeenPerson
from evaluation.metrics import align, rigid_error_mm
from evaluation.paper.study import TestSet

SIDE_PX = 420
_GROUND = 236
_MARGIN = 0.15
PEOPLE = 100
"""Looked at to choose the ones that are drawn."""


@dataclass(frozen=True)
class Shown:
    """One person of a figure: row of the test set, 2D source, method."""

    row: int
    source: str
    method: Method


def failure(test: TestSet, source: str, lifter: Lifter) -> Picture:
    """Figure 2: worse by the default method than 19 of 20 people (the very worst are freaks)."""
    row = _at_share(test, source, lifter, 0.95)
    return _line(test, lifter, Shown(row, source, "fusion"), "default method, against the truth")


def warp(test: TestSet, lifter: Lifter) -> Picture:
    """Figure 3: the warp of the person in the middle of the default method's errors."""
    row = _at_share(test, "gt", lifter, 0.5)
    shown = Shown(row, "gt", "paper")
    return _line(test, lifter, shown, "X* (colour) and the exemplar X (grey)", before=True)


def typical(test: TestSet, source: str, lifter: Lifter) -> list[Picture]:
    """Figure 4: people at a quarter, half and three quarters of the errors."""
    return [
        _line(
            test,
            lifter,
            Shown(_at_share(test, source, lifter, share), source, "fusion"),
            f"default method, better than {1 - share:.0%} of the errors",
        )
        for share in (0.25, 0.5, 0.75)
    ]


def side_by_side(test: TestSet, source: str, lifter: Lifter) -> list[Picture]:
    """Figures 5 and 6: the paper's method and the default one on the same 2D."""
    row = _at_share(test, source, lifter, 0.6)
    return [
        _line(test, lifter, Shown(row, source, method), f"{method}, given {source}")
        for method in ("paper", "fusion")
    ]


def liftable(test: TestSet, source: str, lifter: Lifter) -> bool:
    """Whether there is anybody to draw."""
    return source in test.seen and bool(_errors(test, source, lifter)[1])


def _at_share(test: TestSet, source: str, lifter: Lifter, share: float) -> int:
    """The person at this share of the default method's errors."""
    rows, errors = _errors(test, source, lifter)
    return rows[int(np.argsort(errors)[min(int(share * len(rows)), len(rows) - 1)])]


def _errors(test: TestSet, source: str, lifter: Lifter) -> tuple[list[int], list[float]]:
    """Rows and P1 by the default method, of about a hundred people whom both methods lift."""
    rows, errors = [], []
    for row in range(0, len(test.views), max(1, len(test.views) // PEOPLE)):
        person = _try(test, lifter, Shown(row, source, "fusion"))
        if person is not None and _try(test, lifter, Shown(row, source, "paper")) is not None:
            truth = test.views.joints_mm[row]
            rows.append(row)
            errors.append(float(rigid_error_mm(person.joints_3d_mm, truth).mean()))
    return rows, errors


def _try(test: TestSet, lifter: Lifter, shown: Shown) -> LiftedPerson | None:
    camera = test.views.camera_of(shown.row)
    person = test.seen[shown.source].observation(shown.row, plain=shown.method == "paper")
    (lifted,) = lifter.lift([person], camera.intrinsics, method=shown.method)
    return lifted if isinstance(lifted, LiftedPerson) else None


def _lift(test: TestSet, lifter: Lifter, shown: Shown) -> LiftedPerson:
    person = _try(test, lifter, shown)
    if person is None:
        raise RuntimeError(f"person {shown.row} cannot be lifted")
    return person


def _line(
    test: TestSet, lifter: Lifter, shown: Shown, title: str, *, before: bool = False
) -> Picture:
    """The 2D and two novel views of one person, side by side."""
    person = _lift(test, lifter, shown)
    truth = test.views.joints_mm[shown.row]
    answer = person.joints_3d_mm
    error = float(rigid_error_mm(answer, truth).mean())
    other = person.exemplar.joints_mm if before else align(truth, answer, scale=False)
    person = replace(person, exemplar=replace(person.exemplar, joints_mm=other))
    points = test.seen[shown.source].points_px[shown.row]
    result = _as_result(points, test.views.camera_of(shown.row).intrinsics, person)
    canvas = np.full((result.height_px, result.width_px, 3), _GROUND, np.uint8)
    photo = Photo(canvas, result.width_px, result.height_px, 1, 1, (0.0, 0.0), None)
    picture = draw_overlay(photo, result.people, height_px=SIDE_PX)
    words = Words(f"P1 {error:.0f} mm", np.array([10.0, 22.0]), (30, 28, 25), 14)
    said = Words(title, np.array([10.0, SIDE_PX - 12.0]), (30, 28, 25), 11)
    picture = replace(picture, marks=(*picture.marks, words, said))
    for view in NOVEL_VIEWS:
        picture = picture.beside(draw_novel_view(result, view, side_px=SIDE_PX))
    return picture


def _as_result(points_px: Floats, intrinsics: Intrinsics, person: LiftedPerson) -> PhotoResult:
    """A square photo around the joints; the camera's rays stay where they are."""
    low, high = points_px.min(0), points_px.max(0)
    side = float((high - low).max()) * (1 + 2 * _MARGIN)
    corner = 0.5 * (low + high) - side / 2
    moved = points_px - corner
    x, y = intrinsics.principal_point_px - corner
    seen = SeenPerson(
        box_px=(0.0, 0.0, side, side),
        score=None,
        joints_px=moved,
        present=np.ones(len(points_px), bool),
        confidence=None,
        sigma_px=None,
        lifted=person,
    )
    return PhotoResult(
        width_px=round(side),
        height_px=round(side),
        orientation=1,
        intrinsics=Intrinsics(intrinsics.focal_length_px, (float(x), float(y)), "request"),
        people=(seen,),
        timings_ms={},
    )
