"""Scenes for the person network: turned with their boxes, people over the whole canvas."""

from dataclasses import replace

import numpy as np
import pytest

from models.training.dataset import LabelledCrop
from models.training.scenes import SceneSample, box_of, portrait, turned

SIZE = (320, 256)


def marked() -> SceneSample:
    """Black but for the one box, and trusted but for the box's cells."""
    image = np.zeros((256, 320, 3), np.uint8)
    image[40:80, 104:112] = 255
    trust = np.ones((32, 40), np.float32)
    trust[5:10, 13:14] = 0
    return SceneSample(image, np.array([[104, 40, 111, 79]], np.float32), trust)


def filling(colour: int = 200) -> LabelledCrop:
    """A crop of one colour with its joints along the edge of its inner three quarters."""
    around = np.linspace(0, 2 * np.pi, 14, endpoint=False)
    joints = 60 + 45 * np.stack([np.cos(around), np.sin(around)], 1)
    return LabelledCrop(
        name="x",
        group=0,
        image=np.full((120, 120, 3), colour, np.uint8),
        joints_px=joints.astype(np.float32),
        weight=np.ones(14, np.float32),
        visible=np.ones(14, np.float32),
        wild=False,
    )


@pytest.mark.parametrize("quarters", [0, 1, 2, 3])
def test_boxes_and_trust_turn_with_the_picture(quarters: int) -> None:
    sample = turned(marked(), quarters)
    assert sample.image.shape[:2] == ((256, 320), (320, 256))[quarters % 2]
    assert sample.boxes.dtype == np.float32
    x0, y0, x1, y1 = (int(v) for v in sample.boxes[0])
    assert (sample.image[y0 : y1 + 1, x0 : x1 + 1] == 255).all()
    assert int((sample.image > 0).sum()) == 3 * (x1 + 1 - x0) * (y1 + 1 - y0)
    row, column = np.nonzero(sample.trust == 0)
    assert (row.min(), column.min()) == (y0 // 8, x0 // 8)
    assert (row.max(), column.max()) == (y1 // 8, x1 // 8)


def test_a_quarter_clockwise_takes_the_top_to_the_right() -> None:
    sample = turned(marked(), 1)
    # From 40 below the top and 104 right of the left edge, on a picture 256 tall.
    np.testing.assert_array_equal(sample.boxes, [[256 - 1 - 79, 104, 256 - 1 - 40, 111]])


def test_four_quarters_change_nothing_and_so_do_no_boxes() -> None:
    sample = marked()
    for _ in range(4):
        sample = turned(sample, 1)
    np.testing.assert_array_equal(sample.image, marked().image)
    np.testing.assert_array_equal(sample.boxes, marked().boxes)
    np.testing.assert_array_equal(sample.trust, marked().trust)
    nobody = turned(replace(marked(), boxes=np.zeros((0, 4), np.float32)), 3)
    assert nobody.boxes.shape == (0, 4)


def test_portraits_hold_their_person_on_carried_on_or_black_ground() -> None:
    black = 0
    for seed in range(60):
        sample = portrait(filling(), SIZE, np.random.default_rng(seed))
        assert sample.image.shape == (256, 320, 3)
        assert len(sample.boxes) == 1
        assert (sample.boxes >= 0).all()
        assert (sample.boxes <= np.array([319, 255, 319, 255])).all()
        corners = sample.image[[0, 0, -1, -1], [0, -1, 0, -1]].max(1)
        black += int(corners.min() < 0.25 * sample.image[128, 160].max())
    assert 6 < black < 40


def test_a_portrait_s_person_may_be_small_enough_for_the_second_pass() -> None:
    box = box_of(filling())[0]
    extent = float((box[2:] - box[:2]).max()) / 120
    long_sides = []
    for seed in range(60):
        sample = portrait(filling(), SIZE, np.random.default_rng(seed))
        long_sides.append(float(np.ptp(sample.boxes[0].reshape(2, 2), axis=0).max()) / 320)
    assert min(long_sides) < 0.7 * extent
