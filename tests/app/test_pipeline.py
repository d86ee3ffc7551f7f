"""Whom the pipeline answers when some of the boxes turn out to show nobody."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, cast

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from app.lifting.lifter import Lifter
from app.lifting.types import NotLiftable, Observation
from app.pipeline import PhotoQuery, Pipeline
from models import Joints2D, PersonBox

PHOTO = cv2.imencode(".png", np.zeros((60, 400, 3), np.uint8))[1].tobytes()


@dataclass
class Boxes:
    """Detects a box at every multiple of 30 px; a pose is believed where ``real`` says so."""

    real: str
    close: bool = False
    asked: list[int] = field(default_factory=list)
    depths_px: NDArray[np.float64] | None = None
    told: list[Observation] = field(default_factory=list)

    def detect(self, image: NDArray[np.uint8], max_people: int) -> list[PersonBox]:
        del image
        many = min(max_people, len(self.real))
        return [PersonBox(30.0 * i, 0, 20, 50, 0.9 - 0.01 * i) for i in range(many)]

    def detect_close(self, image: NDArray[np.uint8], max_people: int) -> list[PersonBox]:
        del image, max_people
        return [PersonBox(0.0, 0, 390, 50, 0.8)] if self.close else []

    def estimate(self, image: NDArray[np.uint8], boxes: Sequence[PersonBox]) -> list[Joints2D]:
        del image
        self.asked.append(len(boxes))
        shape = np.random.default_rng(0).uniform(0, 20, (14, 2))
        return [
            Joints2D(
                positions_px=shape + np.array([box.x_px, 0]),
                covariance_px2=np.tile(np.eye(2), (14, 1, 1)),
                confidence=np.full(14, 0.9 if self._is_real(box) else 0.05),
                sigma_px=None,
                peak=np.full(14, 0.9),
                depths_px=self.depths_px,
            )
            for box in boxes
        ]

    def _is_real(self, box: PersonBox) -> bool:
        return box.width_px > 300 or self.real[round(box.x_px / 30)] == "x"

    def lift(self, observations: Sequence[Observation], *_: Any, **__: Any) -> list[NotLiftable]:
        self.told.extend(observations)
        return [NotLiftable("too few joints")] * len(observations)


@pytest.mark.parametrize(
    ("real", "max_people", "answered", "asked"),
    [
        ("x", 5, [0], [1]),
        ("xxxx", 2, [0, 1], [2]),
        ("-x", 1, [1], [1, 1]),
        ("x--xx", 3, [0, 3, 4], [3, 2]),
        ("---x", 1, [], [1, 1]),  # no more than twice as many boxes are looked at
        ("", 5, [], []),
    ],
)
def test_a_box_that_shows_nobody_leaves_its_place_to_the_next(
    real: str, max_people: int, answered: list[int], asked: list[int]
) -> None:
    boxes = Boxes(real)
    lifter = cast("Lifter", boxes)
    pipeline = Pipeline(boxes, boxes, lifter, max_pixels=10**6, decode_side_px=448)
    result = pipeline.estimate(PHOTO, PhotoQuery(max_people=max_people))
    assert [round(person.box_px[0] / 30) for person in result.people] == answered
    assert boxes.asked == asked


@pytest.mark.parametrize(
    ("real", "width_px", "asked"),
    [("-", 390, [1, 1]), ("", 390, [1]), ("-x", 20, [2])],  # nobody, no box, somebody
)
def test_whoever_fills_the_photo_is_looked_for_where_nobody_else_is(
    real: str, width_px: float, asked: list[int]
) -> None:
    boxes = Boxes(real, close=True)
    lifter = cast("Lifter", boxes)
    pipeline = Pipeline(boxes, boxes, lifter, max_pixels=10**6, decode_side_px=448)
    (person,) = pipeline.estimate(PHOTO, PhotoQuery()).people
    assert person.box_px[2] == width_px
    assert boxes.asked == asked


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("reduction", [1, 2, 4])
def test_depths_are_lifted_in_pixels_of_the_photo_as_it_was_sent(
    reduction: int, mirrored: bool
) -> None:
    photo = cv2.imencode(".jpg", np.zeros((60, 400, 3), np.uint8))[1].tobytes()
    depths_px = np.random.default_rng(1).normal(0, 9, 14)
    boxes = Boxes("x", depths_px=depths_px)
    lifter = cast("Lifter", boxes)
    side_px = 400 // reduction
    pipeline = Pipeline(boxes, boxes, lifter, max_pixels=10**6, decode_side_px=side_px)
    pipeline.estimate(photo, PhotoQuery(mirrored=mirrored))
    (told,) = boxes.told
    assert told.covariance_px2 is not None
    np.testing.assert_allclose(told.covariance_px2, np.tile(reduction**2 * np.eye(2), (14, 1, 1)))
    assert told.depths_px is not None
    np.testing.assert_allclose(told.depths_px, reduction * depths_px)
    boxes.depths_px = None
    pipeline.estimate(photo, PhotoQuery(mirrored=mirrored))
    assert boxes.told[1].depths_px is None


@pytest.mark.parametrize("mirrored", [False, True])
def test_a_given_box_comes_back_as_it_was_given_and_has_no_score(mirrored: bool) -> None:
    boxes = Boxes("x" * 14)
    pipeline = Pipeline(
        boxes, boxes, cast(Lifter, boxes), max_pixels=1_000_000, decode_side_px=1000
    )
    box_px = (10.0, 5.0, 20.0, 40.0)
    (person,) = pipeline.estimate(PHOTO, PhotoQuery(box_px=box_px, mirrored=mirrored)).people
    assert person.box_px == box_px
    assert person.score is None


def test_people_with_joints_beyond_the_photo_are_warned_of() -> None:
    boxes = Boxes("x")
    pipeline = Pipeline(boxes, boxes, cast("Lifter", boxes), max_pixels=10**6, decode_side_px=448)
    pipeline.estimate(PHOTO, PhotoQuery())
    low = cv2.imencode(".png", np.zeros((10, 400, 3), np.uint8))[1].tobytes()
    (cut,) = pipeline.estimate(low, PhotoQuery()).people
    assert 2 < (cut.joints_px[:, 1] > 9.5).sum() < 12
    assert [told.truncated for told in boxes.told] == [False, True]
