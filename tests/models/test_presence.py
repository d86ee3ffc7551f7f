from dataclasses import replace

import numpy as np

from models.heatmaps import Joints2D
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


def test_distinct_people_stay_in_order() -> None:
    assert present([person(), person(80), person(160)]) == [0, 1, 2]


def test_the_same_pose_twice_is_one_person() -> None:
    assert present([person(), person(3), person(80)]) == [0, 2]


def test_somebody_cut_off_at_the_chest_is_somebody() -> None:
    confidence = np.full(14, 0.05)
    confidence[:5] = 0.9
    assert present([replace(person(), confidence=confidence)]) == [0]


def test_a_pose_that_nobody_believes_is_nobody() -> None:
    assert present([person(confidence=0.05), person(80)]) == [1]
    unsure = replace(person(), confidence=None, peak=np.full(14, 0.05))
    assert present([unsure]) == []
