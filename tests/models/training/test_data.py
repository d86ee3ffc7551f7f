"""What needs no torch: reading data sets, holding photos out, random views."""

import json
import tarfile
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from library_store.skeleton import LSP14, R_HIP
from models.errors import AnnotationError
from models.training.augment import MIRROR, canonical, crop_matrix, random_view
from models.training.dataset import (
    DEV_LABELLED,
    DEV_RENDERED,
    LabelledCrop,
    decode_members,
    depths_of,
    held_out,
    load,
    read_crops,
)
from models.training.rendered import open_studio
from models.training.scenes import mosaic, read_scenes
from tests.models.training.data_files import write_tar


def labelled_crop(group: int = 0) -> LabelledCrop:
    rng = np.random.default_rng(group)
    return LabelledCrop(
        name="x",
        group=group,
        image=rng.integers(0, 256, (120, 120, 3)).astype(np.uint8),
        joints_px=rng.uniform(30, 90, (14, 2)).astype(np.float32),
        weight=np.ones(14, np.float32),
        visible=np.ones(14, np.float32),
        wild=True,
    )


def test_labels_are_read_and_hardly_labelled_crops_left_out(tmp_path: Path) -> None:
    joints = np.arange(28.0).reshape(14, 2).tolist()
    records = [
        {"image": "a.jpg", "joints_px": joints, "labelled": [1] * 13 + [0]},
        {"image": "b.jpg", "joints_px": joints, "labelled": [1] * 3 + [0] * 11},
    ]
    for record in records:
        cv2.imwrite(str(tmp_path / str(record["image"])), np.zeros((32, 32, 3), np.uint8))
    (tmp_path / "annotations.json").write_text(json.dumps({"images": records}))
    crops = load(tmp_path)
    assert [c.name for c in crops] == ["a.jpg"]
    np.testing.assert_allclose(crops[0].joints_px, joints)
    assert crops[0].weight[-1] == 0


def _photo(path: Path, brightness: int = 0) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.full((32, 32, 3), brightness, np.uint8))
    return path


def test_photos_in_subfolders_and_of_any_suffix_are_read(tmp_path: Path) -> None:
    _photo(tmp_path / "one" / "a.jpg")
    _photo(tmp_path / "two" / "b.JPG")
    _photo(tmp_path / "c.jpeg")
    (tmp_path / "two" / "._b.JPG").write_bytes(b"of macOS")
    (tmp_path / "notes.txt").write_text("no photo")
    assert set(decode_members(tmp_path)) == {"a.jpg", "b.JPG", "c.jpeg"}
    with tarfile.open(tmp_path / "all.tar", "w") as tar:
        for folder in ("one", "two"):
            tar.add(tmp_path / folder, folder)
    assert set(decode_members(tmp_path / "all.tar")) == {"a.jpg", "b.JPG"}


def test_photos_that_cannot_be_told_or_read_are_named(tmp_path: Path) -> None:
    with pytest.raises(AnnotationError, match="has no JPEG"):
        decode_members(tmp_path)
    _photo(tmp_path / "one" / "a.jpg")
    second = _photo(tmp_path / "two" / "a.jpg", 99)
    with pytest.raises(AnnotationError, match=r"two files a\.jpg"):
        decode_members(tmp_path)
    second.rename(tmp_path / "b.jpg")
    for data in (b"", b"oops"):
        (tmp_path / "b.jpg").write_bytes(data)
        with pytest.raises(AnnotationError, match=r"b\.jpg is no JPEG"):
            decode_members(tmp_path)
    record = {"image": "gone.jpg", "joints_px": [[1, 2]] * 14, "labelled": [1] * 14}
    (tmp_path / "annotations.json").write_text(json.dumps({"images": [record]}))
    with pytest.raises(AnnotationError, match=r"names gone\.jpg, which is not there"):
        load(tmp_path)


def test_boxes_of_other_photos_are_refused(tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    for name in ("a.jpg", "b.jpg"):
        _photo(photos / name)
    labels = tmp_path / "scenes.json"
    people = {"a.jpg": [[1, 2, 3, 4, 0.9]], "b.jpg": [], "c.jpg": []}

    def label(*names: str) -> None:
        labels.write_text(json.dumps([{"image": n, "people": people[n]} for n in names]))

    label("a.jpg", "b.jpg")
    train, dev = read_scenes(photos, labels)
    assert [len(scene.people) for scene in (*dev, *train)] == [1, 0]
    label("a.jpg", "c.jpg")
    with pytest.raises(AnnotationError, match=r"labels c\.jpg, which is not in"):
        read_scenes(photos, labels)
    label("a.jpg")
    with pytest.raises(AnnotationError, match=r"does not say who is in b\.jpg"):
        open_studio(tmp_path, tmp_path, photos, people=labels)


def _tar(path: Path, count: int, joints: list[list[float]], no_torso: int = -1) -> None:
    """Crops, one of them (``no_torso``) with a hip that nobody labelled."""
    labelled = np.ones((count, 14), int)
    if no_torso >= 0:
        labelled[no_torso, R_HIP] = 0
    write_tar(path, np.zeros((count, 8, 8, 3), np.uint8), joints, labelled)


def test_a_starred_file_is_drawn_more_often_and_what_is_kept_aside_is_not_trained_on(
    tmp_path: Path,
) -> None:
    joints = np.arange(28.0).reshape(14, 2).tolist()
    _tar(tmp_path / "lspet_x.tar", DEV_LABELLED + 3, joints)
    _tar(tmp_path / "rendered_x.tar", DEV_RENDERED + 2, joints)
    crops, kept = read_crops(tmp_path, "lspet_x*2,rendered_x", "")
    names = [c.name for c in crops]
    assert sorted(names) == ["lspet_x0.jpg"] * 2 + ["lspet_x1.jpg"] * 2 + ["lspet_x2.jpg"] * 2 + [
        "rendered_x0.jpg",
        "rendered_x1.jpg",
    ]
    aside = {c.name for crops_kept in kept.values() for c in crops_kept}
    assert len(aside) == DEV_LABELLED + DEV_RENDERED
    assert not aside & set(names)


def test_errors_are_not_measured_by_a_torso_that_nobody_labelled(tmp_path: Path) -> None:
    joints = np.arange(28.0).reshape(14, 2).tolist()
    _tar(tmp_path / "lspet_x.tar", DEV_LABELLED + 3, joints, no_torso=10)
    crops, kept = read_crops(tmp_path, "lspet_x", "")
    names = {c.name for c in kept["labelled_dev"]}
    assert len(names) == DEV_LABELLED - 1
    assert "lspet_x10.jpg" not in names | {c.name for c in crops}
    # The same by its path, and of what is only measured on.
    _tar(tmp_path / "mine.tar", 12, joints, no_torso=10)
    crops, kept = read_crops(Path("/elsewhere"), str(tmp_path / "lspet_x"), str(tmp_path / "mine"))
    assert {c.name for c in kept["labelled_dev"]} == names
    assert len(crops) == 3
    assert len(kept[str(tmp_path / "mine")]) == 11


def test_a_photo_is_held_out_whole_and_always_the_same_ones() -> None:
    kept = [held_out(labelled_crop(group)) for group in range(700)]
    assert 60 < sum(kept) < 140
    assert kept == [held_out(labelled_crop(group)) for group in range(700)]


def test_a_mirrored_crop_exchanges_left_and_right() -> None:
    crop = labelled_crop()
    center, extent = crop.extent_px
    plain = crop_matrix(center, extent, 0.0, 96)
    mirrored = crop_matrix(center, extent, 0.0, 96, flip=True)
    x = crop.joints_px @ plain[:, :2].T + plain[:, 2]
    flipped = crop.joints_px @ mirrored[:, :2].T + mirrored[:, 2]
    np.testing.assert_allclose(flipped[:, 0], 95 - x[:, 0], atol=1e-3)
    assert [LSP14.joint_names[i][2:] for i in MIRROR[2:]] == [n[2:] for n in LSP14.joint_names[2:]]


def test_a_view_is_its_seed_s_and_leaves_the_crop_alone() -> None:
    crop, other = labelled_crop(1), labelled_crop(2)
    before = crop.image.copy()
    a, b = (random_view(crop, other, 64, np.random.default_rng(5)) for _ in range(2))
    np.testing.assert_array_equal(a.image, b.image)
    np.testing.assert_array_equal(a.joints_px, b.joints_px)
    np.testing.assert_array_equal(crop.image, before)


def test_joints_outside_a_view_are_absent_and_not_learned_as_places() -> None:
    crop = labelled_crop(1)
    for seed in range(60):
        view = random_view(crop, crop, 64, np.random.default_rng(seed))
        outside = ((view.joints_px < -0.5) | (view.joints_px > 63.5)).any(1)
        assert (view.weight[outside] == 0).all()
        assert (view.presence[outside] == 0).all()
        assert (view.weight[~outside] > 0).all()


def test_depths_grow_with_a_view_and_change_sides_in_the_mirror() -> None:
    depths = np.arange(14, dtype=np.float32) - 6
    crop = replace(labelled_crop(1), depths_px=depths)
    _, extent = crop.extent_px
    np.testing.assert_allclose(canonical(crop, 96).depths, depths / (extent * 1.25), rtol=1e-5)
    here = np.concatenate([crop.joints_px, np.ones((14, 1))], 1)
    orders = set()
    for seed in range(20):
        view = random_view(crop, crop, 64, np.random.default_rng(seed))
        # The view is an affine map of the joints, in their own order or with the sides exchanged.
        (own,) = (
            order
            for order in (tuple(range(14)), tuple(int(i) for i in MIRROR))
            if np.linalg.lstsq(here, view.joints_px[list(order)])[1].sum() < 0.1
        )
        np.testing.assert_allclose(
            view.depths[list(own)] / view.depths[0], depths / depths[0], rtol=1e-4, atol=1e-5
        )
        orders.add(own)
    assert len(orders) == 2
    assert np.isnan(canonical(labelled_crop(1), 64).depths).all()


def test_rendered_depths_are_along_the_ray_to_the_person() -> None:
    joints_mm = np.random.default_rng(0).normal(0, 300, (14, 3))
    joints_mm[:, 2] -= joints_mm[[8, 11], 2].mean()
    ahead = joints_mm + np.array([0, 0, 4000])
    ahead[:, :2] -= (ahead / np.linalg.norm(ahead, axis=1)[:, None]).mean(0)[:2] * 4000
    middle = (ahead / np.linalg.norm(ahead, axis=1)[:, None]).mean(0)
    turn = cv2.Rodrigues(np.array([0.0, 0.4, 0.0]))[0]
    straight = depths_of({"joints_mm": ahead, "focal_length_px": 500.0})
    aside = depths_of({"joints_mm": ahead @ turn, "focal_length_px": 500.0})
    assert abs(middle[:2]).max() < 0.02
    np.testing.assert_allclose(straight, joints_mm[:, 2] / 4000 * 500, atol=2)
    np.testing.assert_allclose(aside, straight, atol=1e-3)


def test_another_set_s_depths_are_refused(tmp_path: Path) -> None:
    write_tar(tmp_path / "lspet_x.tar", np.zeros((DEV_LABELLED + 2, 16, 16, 3), np.uint8), 3.0)
    folder = tmp_path / "depths"
    folder.mkdir()
    names = [f"lspet_x{i}.jpg" for i in range(DEV_LABELLED + 2)]
    np.savez(folder / "lspet_x.npz", image=names, depths_px=np.ones((len(names), 14), np.float32))
    crops, _ = read_crops(tmp_path, "lspet_x", "", folder)
    known = [crop.depths_px for crop in crops if crop.depths_px is not None]
    assert len(known) == len(crops)
    assert (np.stack(known) == 1).all()
    plain, _ = read_crops(tmp_path, "lspet_x", "", tmp_path)
    assert all(crop.depths_px is None for crop in plain)
    np.savez(folder / "lspet_x.npz", image=names[1:], depths_px=np.ones((len(names) - 1, 14)))
    with pytest.raises(AnnotationError, match="depths of another set"):
        read_crops(tmp_path, "lspet_x", "", folder)
    (folder / "lspet_x.npz").write_bytes(b"no archive")
    with pytest.raises(AnnotationError, match="not what depth_teacher wrote"):
        read_crops(tmp_path, "lspet_x", "", folder)


def test_the_canonical_view_holds_every_joint() -> None:
    view = canonical(labelled_crop(3), 96)
    assert (view.presence == 1).all()
    low, high = view.joints_px.min(0), view.joints_px.max(0)
    np.testing.assert_allclose((low + high) / 2, 47.5, atol=0.01)
    np.testing.assert_allclose((high - low).max(), 96 / 1.25, atol=0.01)


def test_mosaic_boxes_lie_in_the_picture() -> None:
    crops = [labelled_crop(i) for i in range(5)]
    back = [np.full((90, 120, 3), 90, np.uint8)]
    for seed in range(40):
        scene = mosaic(crops, back, (160, 96), np.random.default_rng(seed))
        assert scene.image.shape == (96, 160, 3)
        assert (scene.boxes >= 0).all()
        assert (scene.boxes <= (159, 95, 159, 95)).all()
        assert scene.trust.shape == (12, 20)
