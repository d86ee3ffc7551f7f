"""What pose networks get wrong: how it is found, kept and given to others."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from library_store.prior import PosePrior
from library_store.skeleton import L_ANKLE, L_KNEE, LSP14, R_ANKLE, R_KNEE
from models import PoseEstimator
from models.errors import AnnotationError
from models.training import lifter_mistakes
from models.training.lifter_mistakes import Mistakes, Transplanter, find
from models.training.lifter_samples import Floats, Samples, samples_of, seen_people

RENDERS = Path("tests/data/renders")


@pytest.fixture(scope="module")
def poses() -> Floats:
    return PosePrior.load().sample(200, np.random.default_rng(3)).astype(np.float32)


def rendered(folder: Path, *, truth: bool = True) -> Path:
    """The test renders as ``models.training.rendered`` lays them down."""
    records = []
    for image in json.loads((RENDERS / "ground_truth.json").read_text())["images"]:
        shutil.copy(RENDERS / image["file"], folder)
        record = {
            "image": image["file"],
            "joints_px": image["joints_2d_px"],
            "focal_length_px": image["K"][0][0],
            "principal_point_px": [image["K"][0][2], image["K"][1][2]],
        }
        records.append(record | ({"joints_mm": image["joints_3d_mm"]} if truth else {}))
    listed = {"joint_names": list(LSP14.joint_names), "images": records}
    (folder / "annotations.json").write_text(json.dumps(listed))
    return folder


def mistaken(n: int = 60, *, depths: bool = False) -> Mistakes:
    """People in mid-stride whose right ankle was put on the left one, without much confidence.

    ``depths``: by a network that also reads them, with no error but that it takes the one ankle's
    for the other's.
    """
    poses = PosePrior.load().sample(200, np.random.default_rng(4)).astype(np.float32)
    joints = seen_people(poses, 10 * n, np.random.default_rng(5))
    truth = joints[..., :2] / joints[..., 2:]
    radius = np.sqrt(((truth - truth.mean(1, keepdims=True)) ** 2).sum(2).mean(1))
    stride = np.linalg.norm(truth[:, R_ANKLE] - truth[:, L_ANKLE], axis=1) / radius
    joints, truth = (part[np.argsort(-stride)[:n]] for part in (joints, truth))
    found, confidence = truth.copy(), np.full((n, 14), 0.95, np.float32)
    found[:, R_ANKLE], confidence[:, R_ANKLE] = truth[:, L_ANKLE], 0.4
    read = np.full((n, 14), np.nan, np.float32)
    if depths:
        read = samples_of(found, np.ones_like(confidence), 1 - confidence, joints).depths
        read[:, R_ANKLE] = read[:, L_ANKLE]
    return Mistakes(found, confidence, truth, joints, read)


def radii(samples: Samples) -> Floats:
    """Of people (n, 14): one a person, in the view of the camera turned onto them."""
    off = samples.truth - samples.truth.mean(1, keepdims=True)
    return np.repeat(np.sqrt((off**2).sum(2).mean(1))[:, None], 14, 1)


@pytest.mark.parametrize("depths", [False, True])
def test_mistakes_are_kept_whole(tmp_path: Path, *, depths: bool) -> None:
    mistakes = mistaken(depths=depths)
    assert mistakes.have_depths == depths
    mistakes.write(tmp_path / "mistakes.npz")
    again = Mistakes.read(tmp_path / "mistakes.npz")
    assert len(again) == 60
    for name, value in vars(mistakes).items():
        np.testing.assert_array_equal(getattr(again, name), value)


def test_files_from_before_depths_were_read_have_none(tmp_path: Path) -> None:
    columns = vars(mistaken(depths=True))
    del columns["depths"]
    np.savez(tmp_path / "before.npz", **columns)
    again = Mistakes.read(tmp_path / "before.npz")
    assert not again.have_depths
    assert np.isnan(again.depths).all()
    assert again.depths.shape == (60, 14)


def test_other_files_hold_no_mistakes(tmp_path: Path) -> None:
    np.save(tmp_path / "array.npy", np.zeros(3))
    np.savez(tmp_path / "other.npz", found=np.zeros(3))
    (tmp_path / "cut.npz").write_bytes((tmp_path / "other.npz").read_bytes()[:100])
    for name in ("array.npy", "other.npz", "cut.npz", "missing.npz"):
        with pytest.raises(AnnotationError, match=f"{name} is not what lifter_mistakes wrote"):
            Mistakes.read(tmp_path / name)


def test_an_ankle_that_was_put_on_the_other_one_is_so_for_others_too(poses: Floats) -> None:
    samples = Transplanter(mistaken()).samples(poses, 400, np.random.default_rng(6))
    assert (samples.present == 1).all()
    # Of people in the mirror it is the left ankle.
    ankles = np.array([R_ANKLE, L_ANKLE])
    wrong = samples.doubt[:, ankles] > 0.5
    assert (wrong.sum(1) == 1).all()
    assert 0.3 < wrong[:, 0].mean() < 0.7
    there = samples.points[:, ankles[::-1]]
    np.testing.assert_allclose(samples.points[:, ankles][wrong], there[wrong], atol=1e-4)
    right = np.ones_like(samples.present, bool)
    right[:, ankles] = ~wrong
    np.testing.assert_allclose(samples.points[right], samples.truth[right], atol=1e-4)


def test_known_people_come_as_they_were_found_and_in_the_mirror() -> None:
    mistakes = mistaken()
    samples = mistakes.people(300, np.random.default_rng(8))
    wrong = samples.doubt[:, [R_ANKLE, L_ANKLE]] > 0.5
    assert (wrong.sum(1) == 1).all()
    assert 0.3 < wrong[:, 0].mean() < 0.7
    heights = np.ptp(mistakes.joints_mm[..., 1], axis=1)
    found = np.ptp(samples.truth[..., 1], axis=1) * samples.root_mm
    assert heights.min() * 0.7 < np.median(found) < heights.max() * 1.3


def test_joints_that_hardly_anything_says_are_missing() -> None:
    mistakes = mistaken()
    mistakes.confidence[:, R_ANKLE] = 0.1
    samples = Transplanter(mistakes).samples(mistakes.joints_mm, 50, np.random.default_rng(1))
    missing = samples.present == 0
    assert (missing.sum(1) == 1).all()
    assert (samples.points[missing] == 0).all()
    assert (samples.doubt[missing] == 0).all()


def test_a_depth_read_without_error_is_the_receiver_s_own(
    poses: Floats, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lifter_mistakes, "NO_HINTS", 0.0)
    mistakes = mistaken(depths=True)
    rng = np.random.default_rng(6)
    for samples in (Transplanter(mistakes).samples(poses, 400, rng), mistakes.people(400, rng)):
        assert (samples.known == 1).all()
        # But for the one ankle: it lies where it was put, as deep as the other.
        ankles = np.array([R_ANKLE, L_ANKLE])
        wrong = samples.doubt[:, ankles] > 0.5
        assert 0.3 < wrong[:, 0].mean() < 0.7
        there = samples.depths[:, ankles[::-1]]
        np.testing.assert_allclose(samples.hint[:, ankles][wrong], there[wrong], atol=1e-4)
        right = np.ones_like(samples.present, bool)
        right[:, ankles] = ~wrong
        np.testing.assert_allclose(samples.hint[right], samples.depths[right], atol=1e-4)


def test_errors_of_depths_are_as_large_as_the_person_is_and_the_same_in_the_mirror(
    poses: Floats, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lifter_mistakes, "NO_HINTS", 0.0)
    mistakes = mistaken(depths=True)
    centred = mistakes.truth - mistakes.truth.mean(1, keepdims=True)
    mistakes.depths[:, R_KNEE] += 0.5 * np.sqrt((centred**2).sum(2).mean(1))
    samples = Transplanter(mistakes).samples(poses, 400, np.random.default_rng(6))
    off = ((samples.hint - samples.depths) / radii(samples))[:, [R_KNEE, L_KNEE]]
    assert 0.3 < (off[:, 0] > off[:, 1]).mean() < 0.7
    np.testing.assert_allclose(off.max(1), 0.5, atol=0.05)
    np.testing.assert_allclose(off.min(1), 0.0, atol=1e-3)


def test_depths_that_are_understated_are_so_for_others_too(
    poses: Floats, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lifter_mistakes, "NO_HINTS", 0.0)
    joints = seen_people(poses, 4000, np.random.default_rng(5))
    truth, sure = joints[..., :2] / joints[..., 2:], np.ones(joints.shape[:2], np.float32)
    read = 0.3 * samples_of(truth, sure, 1 - sure, joints).depths
    mistakes = Mistakes(truth, sure, truth, joints, read)
    samples = Transplanter(mistakes).samples(poses, 1000, np.random.default_rng(6))
    # Errors of people who are merely seen alike would overstate most of them.
    slope = (samples.hint * samples.depths).sum() / (samples.depths**2).sum()
    assert slope < 0.5


def test_depths_of_missing_joints_and_of_some_people_are_not_known(poses: Floats) -> None:
    mistakes = mistaken(depths=True)
    mistakes.confidence[:, R_ANKLE] = 0.1
    rng = np.random.default_rng(6)
    for samples in (Transplanter(mistakes).samples(poses, 2000, rng), mistakes.people(2000, rng)):
        heard = samples.known.any(1)
        assert heard.mean() == pytest.approx(1 - lifter_mistakes.NO_HINTS, abs=0.05)
        np.testing.assert_array_equal(samples.known[heard], samples.present[heard])
        assert (samples.hint[samples.known == 0] == 0).all()


def test_who_reads_no_depths_gives_no_hints(poses: Floats) -> None:
    rng = np.random.default_rng(6)
    mistakes = mistaken()
    for samples in (Transplanter(mistakes).samples(poses, 50, rng), mistakes.people(50, rng)):
        assert not samples.known.any()
        assert not samples.hint.any()


def test_a_network_s_joints_are_kept_beside_the_truth(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = rendered(tmp_path)
    monkeypatch.setattr(lifter_mistakes, "CUT_OFF", 0.0)
    mistakes = find([folder], PoseEstimator("cpm"), np.random.default_rng(0))
    assert len(mistakes) == len(list(RENDERS.glob("*.jpg")))
    truth = mistakes.joints_mm[..., :2] / mistakes.joints_mm[..., 2:]
    np.testing.assert_allclose(mistakes.truth, truth, atol=0.01)
    radius = np.sqrt(((truth - truth.mean(1, keepdims=True)) ** 2).sum(2).mean(1))
    off = np.linalg.norm(mistakes.found - mistakes.truth, axis=2) / radius[:, None]
    assert np.median(off) < 0.15
    sure = mistakes.confidence > 0.8
    assert off[sure].mean() < off[~sure].mean()


def test_of_who_is_cut_off_the_rest_is_kept_though_hardly_anything_says_where(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = rendered(tmp_path)
    estimator = PoseEstimator("cpm")
    monkeypatch.setattr(lifter_mistakes, "CUT_OFF", 0.0)
    entire = find([folder], estimator, np.random.default_rng(0))
    monkeypatch.setattr(lifter_mistakes, "CUT_OFF", 1.0)
    cut = find([folder], estimator, np.random.default_rng(0))
    assert 0.6 * len(entire) < len(cut) <= len(entire)
    legs = [R_KNEE, L_KNEE, R_ANKLE, L_ANKLE]
    assert cut.confidence[:, legs].mean() < entire.confidence[:, legs].mean() - 0.2
    assert np.isin(cut.truth.sum((1, 2)), entire.truth.sum((1, 2))).all()


def test_depths_are_kept_relative_to_the_hips(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lifter_mistakes, "CUT_OFF", 0.0)
    mistakes = find([rendered(tmp_path)], PoseEstimator("cpm"), np.random.default_rng(0))
    assert mistakes.have_depths
    sure = np.ones_like(mistakes.confidence)
    true = samples_of(mistakes.truth, sure, 1 - sure, mistakes.joints_mm).depths
    assert np.corrcoef(mistakes.depths.ravel(), true.ravel())[0, 1] > 0.45, "of a few people"
    assert 0.4 < np.abs(mistakes.depths).mean() / np.abs(true).mean() < 1.6


def test_sets_without_the_truth_in_3d_are_refused(tmp_path: Path) -> None:
    folder = rendered(tmp_path, truth=False)
    with pytest.raises(AnnotationError, match="no 3D truth"):
        find([folder], PoseEstimator("cpm"), np.random.default_rng(0))


def test_sets_in_which_nobody_is_found_are_named(tmp_path: Path) -> None:
    folder = rendered(tmp_path)
    for picture in folder.glob("*.jpg"):
        assert cv2.imwrite(str(picture), np.zeros((480, 640, 3), np.uint8))
    with pytest.raises(AnnotationError, match="nobody is found"):
        find([folder], PoseEstimator("cpm"), np.random.default_rng(0))
