from dataclasses import replace

import numpy as np
import pytest

from library_store.skeleton import LSP14
from models.heatmaps import Joints2D
from models.person_detector import PersonBox
from models.presence import present


def person(shift_px: float = 0.0, confidence: float = 0.9) -> Joints2D:
    rng = np.random.default_rng(0)
    return Joints2D(
        positions_px=rng.uniform(0, 100, (14, 2)) + np.array([shift_px, 0]),
        covariance_px2=np.tile(np.eye(2), (14, 1, 1)),
        confidence=np.full(14, confidence),
        sigma_px=None,
        peak=np.full(14, 0.9),
    )


def kept(people: list[Joints2D], score: float = 0.8) -> list[int]:
    """What is left of people in boxes of that score."""
    box = PersonBox(x_px=0.0, y_px=0.0, width_px=100.0, height_px=100.0, score=score)
    return present([box] * len(people), people)


def test_distinct_people_stay_in_order() -> None:
    assert kept([person(), person(80), person(160)]) == [0, 1, 2]


def test_the_same_pose_twice_is_one_person() -> None:
    assert kept([person(), person(3), person(80)]) == [0, 2]


@pytest.mark.parametrize("exchanged", [False, True])
def test_somebody_else_s_head_and_arms_are_no_second_person(exchanged: bool) -> None:
    """A box about the upper body alone, whose legs are put anywhere."""
    first = person()
    positions, confidence = first.positions_px.copy(), np.full(14, 0.9)
    if exchanged:
        positions = positions[list(LSP14.mirror)]
    positions[8:] += np.array([300.0, 0.0])
    confidence[8:] = 0.3
    second = replace(first, positions_px=positions, confidence=confidence)
    assert kept([first, second]) == [0]
    assert kept([second]) == [0]
    assert kept([first, replace(second, confidence=np.full(14, 0.9))]) == [0, 1], "with sure legs"


def test_somebody_cut_off_at_the_chest_is_somebody() -> None:
    confidence = np.full(14, 0.05)
    confidence[:5] = 0.9
    assert kept([replace(person(), confidence=confidence)]) == [0]


def test_a_pose_that_nobody_believes_is_nobody() -> None:
    assert kept([person(confidence=0.05), person(80)]) == [1]
    unsure = replace(person(), confidence=None, peak=np.full(14, 0.05))
    assert kept([unsure]) == []


def test_either_network_may_doubt_but_not_both() -> None:
    assert kept([person(confidence=0.9)], score=0.45) == [0]
    assert kept([person(confidence=0.6)], score=0.8) == [0]
    assert kept([person(confidence=0.61)], score=0.45) == [], "a raised forearm"
