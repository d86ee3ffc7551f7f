"""What photos go through before a network sees them in training."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from library_store.skeleton import HEAD_TOP, NECK
from models.training.augment import expose, in_company, shaken, worsen
from models.training.dataset import Image, LabelledCrop
from models.training.users_coco import read_coco
from tests.models.training import user_files


def photo(seed: int = 0) -> Image:
    """A smooth picture with an edge in it, (96, 128, 3)."""
    rng = np.random.default_rng(seed)
    ramp = np.linspace(40, 200, 128)[None, :, None] + rng.uniform(-20, 20, 3)
    image = np.broadcast_to(ramp, (96, 128, 3)).copy()
    image[30:60, 50:80] = 230
    return image.astype(np.uint8)


@pytest.mark.parametrize("change", [expose, worsen])
def test_a_changed_photo_keeps_its_size_and_is_its_seed_s(
    change: Callable[[Image, np.random.Generator], Image],
) -> None:
    for seed in range(40):
        first, again = (change(photo(), np.random.default_rng(seed)) for _ in range(2))
        np.testing.assert_array_equal(first, again)
        assert first.shape == (96, 128, 3)
        assert first.dtype == np.uint8


def test_worsening_is_of_many_kinds_and_each_is_seen() -> None:
    before = photo().astype(float)
    means, edges = [], []
    for seed in range(80):
        after = worsen(photo(), np.random.default_rng(seed)).astype(float)
        assert not np.array_equal(after, before)
        means.append(after.mean() / before.mean())
        edges.append(np.abs(np.diff(after, axis=1)).mean() / np.abs(np.diff(before, axis=1)).mean())
    assert min(means) < 0.4  # dark
    assert max(means) > 1.3  # glaring
    assert max(edges) > 3  # noisy


@pytest.mark.parametrize("angle_deg", [0, 30, 90, 135])
def test_shaking_smears_along_its_line_and_moves_nothing(angle_deg: float) -> None:
    dot = np.zeros((61, 61, 3), np.uint8)
    dot[30, 30] = 255
    smeared = shaken(dot, 12.0, np.deg2rad(angle_deg))[..., 0].astype(float)
    y, x = np.mgrid[0:61, 0:61] - 30.0
    total = smeared.sum()
    assert total == pytest.approx(255, rel=0.1)
    assert abs((smeared * x).sum() / total) < 0.1
    assert abs((smeared * y).sum() / total) < 0.1
    cos, sin = np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))
    along = np.sqrt((smeared * (x * cos + y * sin) ** 2).sum() / total)
    across = np.sqrt((smeared * (y * cos - x * sin) ** 2).sum() / total)
    assert along == pytest.approx(12 / np.sqrt(12), rel=0.2)
    assert across < 0.6


def test_where_joints_without_a_label_are_said_to_lie_does_not_matter(tmp_path: Path) -> None:
    """COCO labels neither head nor neck: to be in company they must not reach into a corner."""
    records = user_files.coco(tmp_path / "images")
    people = read_coco(user_files.write(tmp_path / "l.json", records), tmp_path / "images")

    def labelled_elsewhere(crop: LabelledCrop) -> LabelledCrop:
        assert not crop.weight[[HEAD_TOP, NECK]].any()
        joints = crop.joints_px.copy()
        joints[[HEAD_TOP, NECK]] = joints[NECK + 1]
        return replace(crop, joints_px=joints)

    for seed in range(5):
        views = [
            in_company(view(people[0]), view(people[2]), np.random.default_rng(seed)).image
            for view in (lambda crop: crop, labelled_elsewhere)
        ]
        assert not np.array_equal(views[0], people[0].image)
        np.testing.assert_array_equal(views[0], views[1])
