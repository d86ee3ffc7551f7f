import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from models.card import DetectorOutput
from models.person_detector import PersonDetector, corners, decode, iou, shrunk

PHOTO = Path(__file__).parents[1] / "data" / "renders" / "014.jpg"

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


@pytest.mark.parametrize(
    ("weak", "apart", "sure", "people"),
    [(-0.3, 5, 2.0, 1), (0.0, 5, 2.0, 2), (-0.3, 9, 2.0, 2), (-0.3, 5, 0.5, 2)],
    ids=["weak", "likely", "elsewhere", "beside nobody sure"],
)
def test_a_weak_box_that_lies_within_a_sure_one_adds_nobody(
    weak: float, apart: int, sure: float, people: int
) -> None:
    # Side by side: of boxes 80 px wide, 5 cells apart, half lies within the other; 9, a tenth.
    maps = maps_with([(10, 12, 40.0, sure), (10 + apart, 12, 40.0, weak)])
    assert len(decode(maps, 8, UNIT, 0.35)[0]) == people


def test_best_first() -> None:
    _, scores = decode(maps_with([(5, 5, 8.0, 0.0), (20, 20, 8.0, 2.0)]), 8, UNIT, 0.3)
    assert scores[0] > scores[1]


def test_iou_of_itself_is_one_and_of_strangers_zero() -> None:
    boxes = np.array([[0.0, 0.0, 10.0, 10.0], [20.0, 20.0, 30.0, 40.0]])
    np.testing.assert_allclose(iou(boxes, boxes), np.eye(2))


def test_boxes_are_in_the_pixels_of_the_photo_given() -> None:
    """A photo of every pixel four times is the same photo: pixel x becomes 2 x and 2 x + 1."""
    photo = cv2.imread(str(PHOTO))
    assert photo is not None
    detector = PersonDetector(provider="cpu")
    assert isinstance(detector.card.output, DetectorOutput)
    side = detector.card.output.long_side_px
    scale = side / max(photo.shape[:2])
    small = np.asarray(cv2.resize(photo, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA))
    assert max(small.shape[:2]) == side
    framed = np.zeros(small.shape, np.uint8)  # away from the edge, where boxes end
    half = cv2.resize(small, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    top, left = (np.array(small.shape[:2]) - half.shape[:2]) // 2
    framed[top : top + half.shape[0], left : left + half.shape[1]] = half
    (box,) = detector.detect(framed, 1, threshold=0.05)
    (other,) = detector.detect(framed.repeat(2, axis=0).repeat(2, axis=1), 1, threshold=0.05)
    first = np.array([box.x_px, box.y_px])
    assert min(first) > 1
    np.testing.assert_allclose([other.x_px, other.y_px], (first + 0.5) * 2 - 0.5, atol=1e-3)
    size = np.array([box.width_px, box.height_px])
    np.testing.assert_allclose([other.width_px, other.height_px], 2 * size, rtol=1e-5)


def test_boxes_end_with_the_photo() -> None:
    photo = cv2.imread(str(PHOTO))
    assert photo is not None
    height, width = photo.shape[0] // 2, photo.shape[1]
    cut = np.ascontiguousarray(photo[:height], np.uint8)
    boxes = PersonDetector(provider="cpu").detect(cut, 100, threshold=0.01)
    low, high = np.split(corners(boxes), 2, axis=1)
    assert low.min() >= 0
    assert (high <= np.array([width, height]) - 1 + 1e-9).all()
    assert (low == 0).any() or (high == np.array([width, height]) - 1).any()


@pytest.mark.parametrize("side", [24, 47, 64, 65, 131, 200, 255])
def test_a_shrunk_photo_keeps_its_pixels_in_place(side: int) -> None:
    """In a ramp each pixel says where it was, to a pixel of the canvas, halved exactly or not."""
    ramp = np.arange(side, dtype=np.uint8)
    photo = np.stack([*np.meshgrid(ramp, ramp), np.zeros((side, side), np.uint8)], -1)
    canvas, (width, height), _ = shrunk(np.asarray(photo, np.uint8), 32)
    assert (width, height) == (32, 32)
    meant = (np.arange(32) + 0.5) * side / 32 - 0.5
    inner = slice(1, -1)  # beyond the outermost pixels' centres there is nothing to blend with
    near = max(1.0, side / 32)
    np.testing.assert_allclose(canvas[16, inner, 0], meant[inner], atol=near)
    np.testing.assert_allclose(canvas[inner, 16, 1], meant[inner], atol=near)


@pytest.mark.parametrize("name", ["014.jpg", "022.jpg"])
def test_who_fills_the_photo_is_found_from_further_away_and_nobody_smaller(name: str) -> None:
    photo = cv2.imread(str(PHOTO.parent / name))
    assert photo is not None
    records = json.loads((PHOTO.parent / "ground_truth.json").read_text())["images"]
    (truth,) = (np.array(r["joints_2d_px"]) for r in records if r["file"] == name)
    low, high = (corner.astype(int) for corner in (truth.min(0) - 5, truth.max(0) + 5))
    tight = np.ascontiguousarray(photo[low[1] : high[1], low[0] : high[0]])
    detector = PersonDetector(provider="cpu")
    found = detector.detect_close(np.asarray(tight, np.uint8), 1)
    box = corners(found)
    wanted = np.concatenate([truth.min(0) - low, truth.max(0) - low])[None]
    assert iou(box, wanted)[0, 0] > 0.5
    assert (box >= 0).all()
    assert (box[:, 2:] <= np.array(tight.shape[1::-1])).all()
    far = np.pad(tight, [(2 * len(tight),) * 2, (2 * len(tight),) * 2, (0, 0)])
    assert detector.detect_close(np.asarray(far, np.uint8), 1) == []


@pytest.mark.parametrize(("height", "width"), [(60, 90), (91, 33), (448, 448), (7, 300)])
def test_a_margin_leaves_the_canvas_as_large_and_the_photo_in_its_middle(
    height: int, width: int
) -> None:
    photo = np.full((height, width, 3), 200, np.uint8)
    canvas, (small_w, small_h), free = shrunk(photo, 448, 0.17)
    inside = canvas[free : free + small_h, free : free + small_w]
    assert max(canvas.shape[:2]) == 448
    assert max(small_w, small_h) == 448 - 2 * free
    assert (inside == 200).all()
    assert (canvas > 0).sum() == inside.size
