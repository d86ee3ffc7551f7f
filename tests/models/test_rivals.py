"""Whose joint it is, when several people of a photo claim a place."""

import numpy as np
import pytest

from library_store.skeleton import L_WRIST, LSP14, R_ANKLE, R_WRIST
from models import PersonBox, PoseEstimator
from models.heatmaps import Maps, marginals, pooled, sub_cell_peaks
from models.rivals import shares

CELLS, STRIDE = 40, 4.0
N = LSP14.n_joints
Peak = tuple[int, tuple[float, float], float]
"""A joint, its place in the photo in px, and how much of its marginal lies there."""


def seen(scale: float, origin: tuple[float, float], peaks: list[Peak]) -> Maps:
    """Marginals (14, h, h) of one crop, flat but for ``peaks``."""
    v, u = np.mgrid[0:CELLS, 0:CELLS]
    x, y = (o + scale * ((c + 0.5) * STRIDE - 0.5) for o, c in zip(origin, (u, v), strict=True))
    sigma = 1.5 * scale * STRIDE
    p = np.full((N, CELLS, CELLS), 1e-6)
    for joint, (at_x, at_y), mass in peaks:
        bump = np.exp(-(((x - at_x) ** 2 + (y - at_y) ** 2) / (2 * sigma**2)))
        p[joint] += mass * bump / bump.sum()
    marginal: Maps = (p / p.sum((1, 2), keepdims=True)).astype(np.float32)
    return marginal


def places(p: Maps, scale: list[float], origin: list[tuple[float, float]]) -> np.ndarray:
    """Where the pooled marginals peak, (N, 14, 2) px of the photo."""
    cells, _ = sub_cell_peaks(pooled(p))
    crop_px = (cells + 0.5) * STRIDE - 0.5
    found: np.ndarray = np.array(origin)[:, None] + np.array(scale)[:, None, None] * crop_px
    return found


def settled(
    p: Maps,
    scale: list[float],
    origin: list[tuple[float, float]],
    belief: np.ndarray | None = None,
) -> np.ndarray:
    """Their places after everybody has been given the own share."""
    sure = np.full(p.shape[:2], 0.9) if belief is None else belief
    own = shares(p, sure, np.array(scale), np.array(origin), STRIDE)
    assert own.dtype == np.float32
    assert (own >= 0).all()
    assert (own <= 1).all()
    return places(p * own, scale, origin)


SCALE = [1.0, 1.7]
ORIGIN = [(10.0, 20.0), (60.0, -30.0)]
MINE, THEIRS = (60.0, 120.0), (120.0, 100.0)
"""Two wrists: the first one's, in its crop alone, and the second one's, in both crops."""


@pytest.mark.parametrize("joint", [R_WRIST, L_WRIST])
def test_a_wrist_that_another_is_surer_of_is_left_to_that_one(joint: int) -> None:
    first = seen(SCALE[0], ORIGIN[0], [(R_WRIST, THEIRS, 0.6), (R_WRIST, MINE, 0.35)])
    second = seen(SCALE[1], ORIGIN[1], [(joint, THEIRS, 0.95)])
    p = np.stack([first, second])
    assert np.abs(places(p, SCALE, ORIGIN)[0, R_WRIST] - THEIRS).max() < 1
    after = settled(p, SCALE, ORIGIN)
    assert np.abs(after[0, R_WRIST] - MINE).max() < 1
    assert np.abs(after[1, joint] - THEIRS).max() < 1


def test_joints_of_other_kinds_do_not_contest_a_place() -> None:
    first = seen(SCALE[0], ORIGIN[0], [(R_WRIST, THEIRS, 0.6), (R_WRIST, MINE, 0.35)])
    second = seen(SCALE[1], ORIGIN[1], [(R_ANKLE, THEIRS, 0.95)])
    after = settled(np.stack([first, second]), SCALE, ORIGIN)
    assert np.abs(after[0, R_WRIST] - THEIRS).max() < 1


def test_somebody_who_is_not_there_takes_nothing() -> None:
    first = seen(SCALE[0], ORIGIN[0], [(R_WRIST, THEIRS, 0.6), (R_WRIST, MINE, 0.35)])
    second = seen(SCALE[1], ORIGIN[1], [(R_WRIST, THEIRS, 0.95)])
    belief = np.array([[0.9] * N, [0.02] * N])
    after = settled(np.stack([first, second]), SCALE, ORIGIN, belief)
    assert np.abs(after[0, R_WRIST] - THEIRS).max() < 1


def test_who_has_lost_a_place_no_longer_claims_it() -> None:
    """Of claims of 3 to 1 a quarter is left to the other at first, and then a tenth."""
    p = np.stack([seen(1.0, ORIGIN[0], [(R_WRIST, MINE, 0.9)])] * 2)
    belief = np.array([[0.9] * N, [0.3] * N])
    own = shares(p, belief, np.ones(2), np.array([ORIGIN[0]] * 2), STRIDE)
    np.testing.assert_allclose(own[0, R_WRIST], 0.9, rtol=1e-5)
    np.testing.assert_allclose(own[1, R_WRIST], 0.1, rtol=1e-5)


def test_a_place_is_the_same_in_crops_of_any_size() -> None:
    """Two views of one wrist: their claims meet where it is, not half a cell beside."""
    scale, origin = [1.0, 2.6], [ORIGIN[0], (-60.0, -70.0)]
    p = np.stack([seen(*view, [(R_WRIST, MINE, 0.9)]) for view in zip(scale, origin, strict=True)])
    before, after = places(p, scale, origin), settled(p, scale, origin)
    np.testing.assert_allclose(after[:, R_WRIST], before[:, R_WRIST], atol=0.1)


def test_a_person_found_twice_keeps_both_answers() -> None:
    peaks: list[Peak] = [(R_WRIST, THEIRS, 0.6), (R_WRIST, MINE, 0.35), (R_ANKLE, MINE, 0.8)]
    p = np.stack([seen(SCALE[0], ORIGIN[0], peaks)] * 2)
    same = [SCALE[0]] * 2, [ORIGIN[0]] * 2
    np.testing.assert_allclose(settled(p, *same), places(p, *same), atol=0.2)


def test_crops_that_do_not_meet_leave_each_other_alone() -> None:
    peaks: list[Peak] = [(R_WRIST, MINE, 0.6)]
    p = np.stack([seen(1.0, ORIGIN[0], peaks)] * 2)
    apart = np.array([ORIGIN[0], (ORIGIN[0][0] + CELLS * STRIDE + 1, ORIGIN[0][1])])
    own = shares(p, np.ones((2, N)), np.ones(2), apart, STRIDE)
    np.testing.assert_array_equal(own, 1)
    closer = apart - [(0, 0), (60, 0)]
    assert shares(p, np.ones((2, N)), np.ones(2), closer, STRIDE).min() < 0.9


def test_the_order_of_people_does_not_matter() -> None:
    rng = np.random.default_rng(0)
    maps = rng.normal(0, 2, (3, N, CELLS, CELLS)).astype(np.float32)
    p = marginals(maps, "logits")
    belief, scale = rng.uniform(0.2, 1, (3, N)), rng.uniform(0.8, 2, 3)
    origin = rng.uniform(-50, 50, (3, 2))
    own = shares(p, belief, scale, origin, STRIDE)
    order = [2, 0, 1]
    again = shares(p[order], belief[order], scale[order], origin[order], STRIDE)
    np.testing.assert_allclose(again, own[order], rtol=1e-5)


def test_people_who_stand_apart_are_answered_as_if_alone() -> None:
    estimator = PoseEstimator("cpm")
    photo = np.random.default_rng(0).integers(0, 256, (240, 640, 3)).astype(np.uint8)
    boxes = [PersonBox(x, 40.0, 80.0, 160.0, 1.0) for x in (20.0, 500.0)]
    both = estimator.estimate(photo, boxes)
    for box, found in zip(boxes, both, strict=True):
        (alone,) = estimator.estimate(photo, [box])
        np.testing.assert_allclose(found.positions_px, alone.positions_px, atol=1e-3)
        np.testing.assert_allclose(found.belief, alone.belief, atol=1e-4)
