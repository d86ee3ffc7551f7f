"""The lifting network that ships: what must hold for any joints, and what its card promises."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from library_store.cameras import extrinsics, sample_cameras
from library_store.prior import PosePrior
from library_store.skeleton import L_HIP, L_WRIST, LSP14, R_HIP
from models import ModelError, PersonDetector, PoseLifter
from models.card import WEIGHTS_DIR, read_card, write_card
from models.pose_lifter import lifter_names
from tests.models import tiny_onnx

Floats = NDArray[np.float64]
EVERYBODY = np.ones(14)


@pytest.fixture(scope="module")
def lifter() -> PoseLifter:
    return PoseLifter()


@pytest.fixture(scope="module")
def seen() -> Floats:
    """People (60, 14, 3) of the prior in front of cameras that look at their middle, mm."""
    rng = np.random.default_rng(5)
    poses = PosePrior.load().sample(60, rng)
    rotation, translation = extrinsics(sample_cameras(60, rng), poses)
    placed: Floats = poses @ np.swapaxes(rotation, 1, 2) + translation[:, None]
    return placed


def image(seen: Floats) -> Floats:
    points: Floats = seen[..., :2] / seen[..., 2:]
    return points


def true_depths(seen: Floats) -> Floats:
    root = 0.5 * (seen[:, [R_HIP], 2] + seen[:, [L_HIP], 2])
    depths: Floats = seen[..., 2] / root - 1.0
    return depths


def test_it_finds_depths_and_its_deviations_are_of_that_size(
    lifter: PoseLifter, seen: Floats
) -> None:
    found = [lifter.lift(points, EVERYBODY) for points in image(seen)]
    errors = np.stack([pose.depths for pose in found]) - true_depths(seen)
    assert np.sqrt((errors**2).mean()) < 0.5 * np.sqrt((true_depths(seen) ** 2).mean())
    sigma = np.sqrt(np.stack([np.diag(pose.covariance)[28:] for pose in found]))
    assert 0.6 < (np.abs(errors) < sigma).mean() < 0.95
    sure = sigma.mean(1) < np.median(sigma.mean(1))
    assert np.abs(errors[sure]).mean() < np.abs(errors[~sure]).mean()


def test_what_is_true_of_a_person_is_true_in_the_mirror(lifter: PoseLifter, seen: Floats) -> None:
    mirror = list(LSP14.mirror)
    for points in image(seen)[:5]:
        pose = lifter.lift(points, EVERYBODY)
        flipped = lifter.lift((points * [-1.0, 1.0])[mirror], EVERYBODY)
        np.testing.assert_allclose(flipped.depths, pose.depths[mirror], atol=1e-5)
        np.testing.assert_allclose(flipped.points, pose.points[mirror] * [-1.0, 1.0], atol=1e-5)


def test_where_the_person_is_in_the_picture_changes_nothing(
    lifter: PoseLifter, seen: Floats
) -> None:
    points = image(seen)[0]
    here = lifter.lift(points, EVERYBODY)
    there = lifter.lift(points + np.array([0.02, -0.01]), EVERYBODY)
    np.testing.assert_allclose(there.depths, here.depths, atol=1e-5)
    np.testing.assert_allclose(there.points - here.points, [[0.02, -0.01]] * 14, atol=1e-5)


def test_the_hips_are_at_the_root(lifter: PoseLifter, seen: Floats) -> None:
    depths = lifter.lift(image(seen)[0], EVERYBODY).depths
    assert depths[R_HIP] + depths[L_HIP] == pytest.approx(0.0, abs=1e-6)


def test_a_missing_joint_is_not_looked_at_and_is_less_sure(
    lifter: PoseLifter, seen: Floats
) -> None:
    present = EVERYBODY.copy()
    present[L_WRIST] = 0.0
    ratios = []
    for points in image(seen)[:20]:
        whole = lifter.lift(points, EVERYBODY)
        hidden = points.copy()
        hidden[L_WRIST] = np.nan
        without = lifter.lift(hidden, present)
        hidden[L_WRIST] = 3.0
        np.testing.assert_array_equal(lifter.lift(hidden, present).depths, without.depths)
        variances = [np.diag(pose.covariance)[28 + L_WRIST] for pose in (without, whole)]
        ratios.append(variances[0] / variances[1])
    assert np.median(ratios) > 1.3


def test_covariances_are_covariances(lifter: PoseLifter, seen: Floats) -> None:
    for points in image(seen)[:5]:
        covariance = lifter.lift(points, EVERYBODY).covariance
        np.testing.assert_allclose(covariance, covariance.T, rtol=1e-5)
        scale = np.sqrt(np.diag(covariance))
        assert np.linalg.eigvalsh(covariance / np.outer(scale, scale)).min() > -1e-5


def test_joints_that_are_not_all_sure_are_another_network_s(
    lifter: PoseLifter, seen: Floats
) -> None:
    stated, found = lifter.networks
    assert not stated.card.output.model_dump()["reads_confidence"]
    assert found.card.output.model_dump()["reads_confidence"]
    unsure = EVERYBODY.copy()
    unsure[L_WRIST] = 0.4
    points = image(seen)[0]
    guessed = EVERYBODY.copy()
    guessed[[0, 1]] = 0.0, 0.5  # of another skeleton's sure joints
    for confidence, network in ((EVERYBODY, stated), (unsure, found), (guessed, stated)):
        own = PoseLifter(network.card.name).lift(points, confidence)
        np.testing.assert_array_equal(lifter.lift(points, confidence).depths, own.depths)
    missing = EVERYBODY.copy()
    missing[L_WRIST] = 0.0
    assert not np.array_equal(
        lifter.lift(points, missing).depths, found.lift(points, missing).depths
    )


def test_doubt_in_a_joint_makes_it_less_sure_and_lets_it_go(seen: Floats) -> None:
    found = PoseLifter("lifter-found")
    ratios, moves = [], []
    for points in image(seen)[:20]:
        radius = np.sqrt(((points - points.mean(0)) ** 2).sum(1).mean())
        astray = points.copy()
        astray[L_WRIST] += 0.5 * radius
        unsure = np.full(14, 0.95)
        sure = found.lift(astray, unsure)
        unsure[L_WRIST] = 0.25
        doubted = found.lift(astray, unsure)
        variances = [np.diag(pose.covariance)[2 * L_WRIST] for pose in (doubted, sure)]
        ratios.append(variances[0] / variances[1])
        off = [np.linalg.norm(p.points[L_WRIST] - points[L_WRIST]) for p in (doubted, sure)]
        moves.append(off[0] / off[1])
    assert np.median(ratios) > 1.5
    assert np.median(moves) < 0.85


@pytest.fixture
def believing(tmp_path: Path) -> PoseLifter:
    """The shipped network, and for found joints one that believes the depths it is told."""
    for suffix in (".onnx", ".json"):
        shutil.copy(WEIGHTS_DIR / f"lifter{suffix}", tmp_path)
    card = read_card(tmp_path / "lifter.json")
    output = card.output.model_copy(update={"found": "deep"})
    write_card(tmp_path / "lifter.json", card.model_copy(update={"output": output}))
    deep = tiny_onnx.lift_output(reads_confidence=True, reads_depths=True)
    tiny_onnx.write(tmp_path, "deep", tiny_onnx.believer(5, 0.1), output=deep)
    tiny_onnx.write(tmp_path, "known", tiny_onnx.believer(5, 0.1, depths_from=4), output=deep)
    tiny_onnx.write(tmp_path, "sure", tiny_onnx.believer(5, 0.1, depths_from=2), output=deep)
    return PoseLifter(weights_dir=tmp_path)


def test_depths_reach_the_network_that_reads_them(
    believing: PoseLifter, tmp_path: Path, seen: Floats
) -> None:
    points, depths = image(seen)[0], true_depths(seen)[0]
    unsure = np.linspace(0.3, 1.0, 14)
    unsure[L_WRIST] = 0.0
    hidden = depths.copy()
    hidden[L_WRIST] = np.nan
    told = np.where(unsure > 0, depths, 0.0)
    known, sure = (PoseLifter(name, weights_dir=tmp_path) for name in ("known", "sure"))
    for given_depths, expected in ((depths, told), (hidden, told), (None, 0 * told)):
        pose = believing.lift(points, unsure, given_depths)
        np.testing.assert_allclose(pose.depths, expected, atol=1e-7)
        np.testing.assert_allclose(pose.points[unsure > 0], points[unsure > 0], atol=1e-7)
        of_known = known.lift(points, unsure, given_depths).depths
        np.testing.assert_array_equal(of_known, (unsure > 0) & (given_depths is not None))
        of_sure = sure.lift(points, unsure, given_depths).depths
        np.testing.assert_allclose(of_sure, unsure, atol=1e-7)


def test_who_does_not_read_depths_is_not_told(
    lifter: PoseLifter, believing: PoseLifter, seen: Floats
) -> None:
    for points, depths in zip(image(seen)[:3], true_depths(seen), strict=False):
        for network in (lifter, believing):
            told, untold = (network.lift(points, EVERYBODY, d) for d in (depths, None))
            np.testing.assert_array_equal(told.points, untold.points)
            np.testing.assert_array_equal(told.depths, untold.depths)
            np.testing.assert_array_equal(told.covariance, untold.covariance)


def test_depths_mend_what_the_shipped_network_makes_of_found_joints(
    lifter: PoseLifter, seen: Floats
) -> None:
    true, unsure = true_depths(seen), np.full(14, 0.8)
    told, untold = (
        np.stack([lifter.lift(*person).depths for person in people])
        for people in (
            [(points, unsure, depths) for points, depths in zip(image(seen), true, strict=True)],
            [(points, unsure) for points in image(seen)],
        )
    )
    assert np.abs(told - true).mean() < 0.8 * np.abs(untold - true).mean()


def test_a_network_for_found_joints_may_not_name_a_further_one(tmp_path: Path) -> None:
    for name in ("lifter", "lifter-found"):
        for suffix in (".onnx", ".json"):
            shutil.copy(WEIGHTS_DIR / f"{name}{suffix}", tmp_path)
    card = read_card(tmp_path / "lifter-found.json")
    output = card.output.model_copy(update={"found": "lifter"})
    write_card(tmp_path / "lifter-found.json", card.model_copy(update={"output": output}))
    with pytest.raises(ModelError, match="names a further one"):
        PoseLifter(weights_dir=tmp_path)
    (tmp_path / "lifter-found.json").unlink()
    with pytest.raises(ModelError, match=r"lifter-found\.json is missing"):
        PoseLifter(weights_dir=tmp_path)
    assert lifter_names("lifter", tmp_path) == ("lifter", "lifter-found")
    assert lifter_names("nobody", tmp_path) == ("nobody",)


def test_other_networks_are_no_lifters_and_it_is_none_of_theirs() -> None:
    with pytest.raises(ModelError, match="no lifter"):
        PoseLifter("person")
    with pytest.raises(ModelError, match="no person detector"):
        PersonDetector("lifter", provider="cpu")


@pytest.mark.parametrize(
    ("damage", "said"), [("cut", "sha256 differs"), ("foreign", "one float input of joints")]
)
def test_damaged_and_foreign_weights_are_refused(tmp_path: Path, damage: str, said: str) -> None:
    for suffix in (".onnx", ".json"):
        shutil.copy(WEIGHTS_DIR / f"lifter{suffix}", tmp_path)
    path = tmp_path / "lifter.onnx"
    if damage == "cut":
        path.write_bytes(path.read_bytes()[:-100])
    else:
        shutil.copy(WEIGHTS_DIR / "person.onnx", path)
        card = read_card(WEIGHTS_DIR / "lifter.json")
        person = read_card(WEIGHTS_DIR / "person.json")
        card = card.model_copy(update={"sha256": person.sha256})
        (tmp_path / "lifter.json").write_text(card.model_dump_json())
    with pytest.raises(ModelError, match=said):
        PoseLifter(weights_dir=tmp_path)
