"""Crowds for the person network: what is cut out, who hides whom, where boxes lie."""

from dataclasses import replace

import numpy as np

from library_store.skeleton import LSP14
from models.training.crowds import Member, calm_patches, crowd
from models.training.cutout import place, silhouette, whole
from models.training.scenes import LabelledScene
from tests.models.training.crops import SIZE, standing


def scene() -> LabelledScene:
    image = np.random.default_rng(0).integers(0, 256, (256, 320, 3)).astype(np.uint8)
    return LabelledScene(image, np.array([[100, 40, 160, 200, 0.9]], np.float32))


def test_a_silhouette_covers_the_joints_and_leaves_the_corners() -> None:
    mask = silhouette(standing())
    x, y = np.rint(standing().joints_px.T).astype(int)
    assert (mask[y, x] > 0.5).all()
    assert mask[[0, 0, -1, -1], [0, -1, 0, -1]].max() == 0
    assert 0.1 < mask.mean() < 0.45


def test_unlabelled_limbs_are_not_cut_out() -> None:
    crop = standing()
    weight = crop.weight.copy()
    weight[[LSP14.joint_names.index(n) for n in ("r_elbow", "r_wrist")]] = 0
    fewer = replace(crop, weight=weight)
    assert whole(crop)
    assert not whole(fewer)
    assert silhouette(fewer)[60, 40] < 0.5 < silhouette(crop)[60, 40]


def test_a_crowd_is_its_seed_s_and_its_boxes_lie_in_the_picture() -> None:
    backs = [np.zeros((90, 120, 3), np.uint8)]
    many = []
    for seed in range(40):
        first, again = (
            crowd([standing()], backs, [scene()], SIZE, np.random.default_rng(seed))
            for _ in range(2)
        )
        np.testing.assert_array_equal(first.image, again.image)
        np.testing.assert_array_equal(first.boxes, again.boxes)
        assert first.image.shape == (256, 320, 3)
        assert (first.boxes >= 0).all()
        assert (first.boxes <= np.array([319, 255, 319, 255])).all()
        many.append(len(first.boxes))
    assert max(many) >= 4


def test_who_stands_behind_others_is_seen_less() -> None:
    mask = silhouette(standing())
    area = float(mask.sum())
    box = np.array([40, 10, 80, 110], np.float32)
    cut_out = Member(box, mask.copy(), area, area)
    by_box = Member(box, None, 4000.0, 4000.0)
    left = np.zeros_like(mask)
    left[:, :60] = 1
    for member in (cut_out, by_box):
        assert member.share == 1
        member.hide_behind(left)
        assert 0.4 < member.share < 0.6
        member.hide_behind(1 - left)
        assert member.share < 0.05


def test_calm_patches_keep_away_from_people() -> None:
    marked = scene()
    marked.image[:] = 0
    marked.image[40:200, 100:160] = 255
    patches = calm_patches([marked] * 5, np.random.default_rng(0))
    assert patches
    assert all(patch.max() == 0 for patch in patches)


def test_people_far_away_are_averaged_as_the_detector_sees_them() -> None:
    noise = np.random.default_rng(0).integers(0, 256, (400, 400, 3)).astype(np.uint8)
    placed, _ = place(noise, (50, 50), 0.125, np.zeros(2), False, np.zeros(3))
    assert float(placed[2:-2, 2:-2].std()) < 1.2 * float(noise.std()) / 8
