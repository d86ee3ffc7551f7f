"""People whom the photo's edge cuts off: where it does, and which box is to be found then."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from library_store.skeleton import HEAD_TOP, L_WRIST, NECK
from models.training.cut_short import bust, can_be_cut, close_up, end_px, standing
from models.training.scenes import LabelledScene
from tests.models.training import crops
from tests.models.training.crops import SIZE

Floats = NDArray[np.float64]

JOINTS = crops.standing().joints_px.astype(np.float64)


def test_photos_end_between_the_chest_and_the_knees() -> None:
    rng = np.random.default_rng(0)
    ends = np.array([end_px(JOINTS, rng) for _ in range(500)])
    # Neck at 26, hips at 66, knees at 88: below the shoulders, now and then by the shins.
    assert 36 < ends.min() < 42
    assert 95 < ends.max() < 105


def test_only_upright_people_with_head_and_trunk_are_cut() -> None:
    crop = crops.standing()
    assert can_be_cut(crop)
    on_their_head = crop.joints_px.copy()
    on_their_head[:, 1] = 119 - on_their_head[:, 1]
    assert not can_be_cut(replace(crop, joints_px=on_their_head))
    for joint, needed in ((HEAD_TOP, True), (NECK, True), (L_WRIST, False)):
        weight = crop.weight.copy()
        weight[joint] = 0
        assert can_be_cut(replace(crop, weight=weight)) != needed


@pytest.mark.parametrize("colour", [120, 230])
def test_a_bust_ends_where_its_photo_does(colour: int) -> None:
    empty = np.full((256, 320, 3), 128, np.uint8)
    framed = found = 0
    for seed in range(80):
        sample = bust(crops.standing(colour), [empty], SIZE, np.random.default_rng(seed))
        assert sample.image.shape == (256, 320, 3)
        assert sample.trust.shape == (32, 40)
        lit = np.flatnonzero(sample.image.max((1, 2)) > 0)
        framed += int(lit.max() < 250)
        if not len(sample.boxes):
            assert (sample.trust == 0).all()
            continue
        found += 1
        (x0, y0, x1, y1) = sample.boxes[0]
        assert 0 <= x0 < x1 <= 320
        assert 0 <= y0 < y1 <= 256
        assert abs(y1 - lit.max()) < 14, "some row of thighs is the last one"
        assert y1 - y0 > 30
    assert 4 < framed < 35
    assert found > 60


def peopled(shown: tuple[int, int, int, int], score: float) -> LabelledScene:
    image = np.random.default_rng(0).integers(60, 256, (256, 320, 3)).astype(np.uint8)
    people = np.array([[*shown, score], [200, 20, 300, 120, 0.9]], np.float32)
    return LabelledScene(image, people)


def test_those_stand_who_are_tall_sure_and_large() -> None:
    assert standing(peopled((100, 40, 160, 200), 0.9)).tolist() == [0]
    assert standing(peopled((100, 40, 160, 200), 0.5)).tolist() == []
    assert standing(peopled((100, 40, 200, 200), 0.9)).tolist() == []
    assert standing(peopled((100, 40, 140, 120), 0.9)).tolist() == []


def test_a_close_up_ends_above_the_knees_of_who_stands() -> None:
    for seed in range(40):
        sample = close_up(peopled((100, 40, 160, 200), 0.9), SIZE, np.random.default_rng(seed))
        lit = np.flatnonzero(sample.image.max((1, 2)) > 0)
        first = sample.boxes[0]
        assert abs(first[3] - lit.max()) <= 2
        width, height = first[2:] - first[:2]
        # The box was 60 wide and 160 tall; 28 to 75% of that is left, and it may be cut beside.
        assert width / height < 60 / (0.27 * 160)
        assert (sample.boxes >= 0).all()
        assert (sample.boxes <= np.tile(SIZE, 2)).all()
