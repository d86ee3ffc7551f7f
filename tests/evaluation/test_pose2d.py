"""The table of 2D networks: swaps are counted by pairs, and labels with exchanged sides mended."""

import json
from dataclasses import replace

import numpy as np

from evaluation.pose2d import LSPET_SIDES, find, put_right, score, table
from library_store.skeleton import LSP14
from models.training.dataset import LabelledCrop
from tests.models.training.crops import standing

MIRROR = list(LSP14.mirror)


def perfect(crop: LabelledCrop) -> np.ndarray:
    return crop.joints_px.astype(np.float64)


def exchanging(crop: LabelledCrop) -> np.ndarray:
    return perfect(crop)[MIRROR]


def test_swaps_are_counted_by_pairs() -> None:
    crops = [standing(40), standing(200)]
    best = score(find(perfect, crops, "perfect"), crops)
    worst = score(find(exchanging, crops, "exchanging"), crops)
    assert (best.swaps(), worst.swaps()) == (0.0, 100.0)
    assert best.pck(tuple(range(14))) == 100.0
    half = score(
        find(lambda c: (perfect if c is crops[0] else exchanging)(c), crops, "half"), crops
    )
    assert half.swaps() == 50.0
    assert half.swaps(np.array([True, False])) == 0.0
    assert "| the same, of the 1 who can be told | 0.0 |" in table({"half": half}, [True, False])


def test_labels_put_right_are_the_other_sides() -> None:
    crops = [standing(40), replace(standing(200), name="y")]
    crops[0].visible[2] = 0
    mended = put_right(crops, {crops[0].name})
    assert mended[1] is crops[1]
    np.testing.assert_array_equal(mended[0].joints_px, crops[0].joints_px[MIRROR])
    np.testing.assert_array_equal(mended[0].visible, crops[0].visible[MIRROR])
    back = put_right(mended, {crops[0].name})
    np.testing.assert_array_equal(back[0].joints_px, crops[0].joints_px)


def test_nobody_is_both_labelled_rightly_and_exchanged() -> None:
    sides = json.loads(LSPET_SIDES.read_text())
    looked_at, right, exchanged = (set(sides[key]) for key in ("looked_at", "right", "exchanged"))
    assert right | exchanged <= looked_at
    assert not right & exchanged
