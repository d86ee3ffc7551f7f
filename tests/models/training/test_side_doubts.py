"""Doubts about a label's sides: from what a teacher sees, per half, and into training."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from library_store.skeleton import LSP14
from models.errors import AnnotationError
from models.training.dataset import (
    DEV_LABELLED,
    LabelledCrop,
    SideDoubt,
    read_crops,
    sides_file,
)
from models.training.side_doubts import doubts

COUNT = DEV_LABELLED + 5
LOWER = [8, 9, 10, 11, 12, 13]


def person() -> LabelledCrop:
    """Right joints on the left side of the picture, 50 px from the left ones; everything known."""
    joints = np.zeros((14, 2), np.float32)
    joints[:, 1] = [10, 30, 35, 60, 80, 35, 60, 80, 100, 130, 160, 100, 130, 160]
    joints[[2, 3, 4, 8, 9, 10], 0] = 20
    joints[[5, 6, 7, 11, 12, 13], 0] = 70
    joints[[0, 1], 0] = 45
    ones = np.ones(14, np.float32)
    return LabelledCrop("a.jpg", 0, np.zeros((180, 90, 3), np.uint8), joints, ones, ones, wild=True)


def seen(crop: LabelledCrop, exchanged: list[int]) -> np.ndarray:
    """The labels with the sides of these joints exchanged, no head, and a little off."""
    places = crop.joints_px.astype(np.float64)
    places[exchanged] = crop.joints_px[[LSP14.mirror[j] for j in exchanged]]
    places[:2] = np.nan
    return places + 3.0


def test_doubts_follow_what_the_teacher_sees() -> None:
    crop = person()
    same = doubts(crop, seen(crop, []))
    lower = doubts(crop, seen(crop, LOWER))
    whole = doubts(crop, seen(crop, list(range(2, 14))))
    assert max(same) < 0.05
    assert lower[1] > 0.3 > lower[0]
    assert min(whole) > 0.7


def test_joints_in_one_place_or_unknown_tell_nothing() -> None:
    crop = person()
    profile = crop.joints_px.copy()
    profile[:, 0] = 45 + np.linspace(0, 5, 14)
    turned = LabelledCrop(crop.name, 0, crop.image, profile, crop.weight, crop.visible, crop.wild)
    unknown = LabelledCrop(
        crop.name,
        0,
        crop.image,
        crop.joints_px,
        np.eye(14, dtype=np.float32)[0],
        crop.visible,
        True,
    )
    told = {doubts(each, seen(each, list(range(2, 14)))) for each in (turned, unknown)}
    assert len(told) == 1
    assert 0 < max(told.pop()) < 0.1


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    """People labelled by hand, in a folder called lspet_x.tar: five more than are kept aside."""
    folder = tmp_path / "lspet_x.tar"
    folder.mkdir()
    crop = person()
    images = []
    data = cv2.imencode(".jpg", crop.image)[1].tobytes()
    for i in range(COUNT):
        name = f"{i}.jpg"
        (folder / name).write_bytes(data)
        images.append({"image": name, "joints_px": crop.joints_px.tolist(), "labelled": [1.0] * 14})
    (folder / "annotations.json").write_text(json.dumps({"images": images}))
    return folder


def test_training_finds_what_was_written_beside_the_data(dataset: Path) -> None:
    def read() -> set[SideDoubt]:
        crops, _ = read_crops(dataset.parent, "lspet_x", "")
        return {crop.side_doubt for crop in crops}

    assert read() == {(0.0, 0.0)}
    told = {f"{i}.jpg": [0.25, 0.5] for i in range(COUNT)}
    sides_file(dataset).write_text(json.dumps(told))
    assert read() == {(0.25, 0.5)}
    del told["3.jpg"]
    sides_file(dataset).write_text(json.dumps(told))
    with pytest.raises(AnnotationError, match=r"nothing about 3\.jpg"):
        read()
