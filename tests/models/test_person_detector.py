import numpy as np

from models.person_detector import decode, iou

UNIT = 32.0


def maps_with(people: list[tuple[int, int, float, float]]) -> np.ndarray:
    """Output maps (5, 30, 40) with people at cells (x, y) with a half size in px and a logit."""
    maps = np.zeros((5, 30, 40), np.float32)
    maps[0] = -9
    for x, y, half, logit in people:
        maps[0, y, x] = logit
        maps[1:, y, x] = np.log(half / UNIT)
    return maps


def test_a_lone_centre_gives_its_box() -> None:
    boxes, scores = decode(maps_with([(10, 12, 24.0, 3.0)]), 8, UNIT, 0.3)
    center = np.array([10.5, 12.5]) * 8 - 0.5
    np.testing.assert_allclose(boxes, [[*(center - 24), *(center + 24)]], atol=1e-3)
    np.testing.assert_allclose(scores, 1 / (1 + np.exp(-3.0)))


def test_nobody_gives_nothing() -> None:
    boxes, scores = decode(maps_with([]), 8, UNIT, 0.3)
    assert boxes.shape == (0, 4)
    assert scores.shape == (0,)


def test_one_person_seen_by_two_cells_is_found_once_and_neighbours_stay_two() -> None:
    twice = maps_with([(10, 12, 40.0, 3.0), (12, 12, 40.0, 2.0)])
    assert len(decode(twice, 8, UNIT, 0.3)[0]) == 1
    neighbours = maps_with([(10, 12, 16.0, 3.0), (15, 12, 16.0, 2.0)])
    assert len(decode(neighbours, 8, UNIT, 0.3)[0]) == 2


def test_best_first() -> None:
    _, scores = decode(maps_with([(5, 5, 8.0, 0.0), (20, 20, 8.0, 2.0)]), 8, UNIT, 0.3)
    assert scores[0] > scores[1]


def test_iou_of_itself_is_one_and_of_strangers_zero() -> None:
    boxes = np.array([[0.0, 0.0, 10.0, 10.0], [20.0, 20.0, 30.0, 40.0]])
    np.testing.assert_allclose(iou(boxes, boxes), np.eye(2))
