from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from library_store.anatomy import LENGTHS, measure_lengths, root_of
from library_store.errors import LibraryError
from library_store.fit_prior import (
    Mocap,
    PriorSettings,
    face_ahead,
    fit_prior,
    read_mocap,
)
from library_store.limits import measure
from library_store.prior import DEFAULT_PRIOR, KINDS, Kind, PosePrior, save_prior
from library_store.prior_sheet import prior_sheet
from library_store.sheet import TILE_PX
from library_store.skeleton import L_HIP, L_KNEE, LSP14, NECK, R_HIP, R_KNEE


@pytest.fixture(scope="module")
def poses(prior: PosePrior) -> np.ndarray:
    return prior.sample(6000, np.random.default_rng(11))


def test_the_same_seed_gives_the_same_people(prior: PosePrior) -> None:
    first, second = (prior.sample(200, np.random.default_rng(5)) for _ in range(2))
    assert_array_equal(first, second)
    assert not np.array_equal(first, prior.sample(200, np.random.default_rng(6)))


def test_poses_are_whole_and_rooted(poses: np.ndarray) -> None:
    assert poses.shape == (6000, 14, 3)
    assert np.isfinite(poses).all()
    assert_allclose(root_of(poses), 0.0, atol=1e-9)


def test_people_have_human_proportions(poses: np.ndarray) -> None:
    lengths = dict(zip(LENGTHS, measure_lengths(poses).T, strict=True))
    # Between the fifth and the last hundredth adults; below them children.
    expected_mm = {
        "trunk": (430, 650),
        "hips": (110, 260),
        "shoulder": (120, 260),
        "head": (190, 320),
        "upper_arm": (220, 350),
        "forearm": (200, 350),
        "thigh": (320, 490),
        "shank": (340, 530),
    }
    for name, (low, high) in expected_mm.items():
        inside = (lengths[name] > low) & (lengths[name] < high)
        assert inside.mean() > 0.95, name
        assert lengths[name].min() > 0.45 * low, name
    assert 0.85 < np.median(lengths["thigh"] / lengths["shank"]) < 1.05


def test_evened_people_have_the_same_proportions_at_their_own_size(prior: PosePrior) -> None:
    own, evened = (
        dict(zip(LENGTHS, measure_lengths(drawn).T, strict=True))
        for drawn in (
            prior.sample(3000, np.random.default_rng(4)),
            prior.sample(3000, np.random.default_rng(4), evened=True),
        )
    )
    for name in ("hips", "head", "upper_arm", "forearm", "shank"):
        ratio = evened[name] / evened["thigh"]
        same = np.abs(ratio / np.median(ratio) - 1.0) < 1e-6
        # All but the children.
        assert same.mean() > 0.95, name
        assert np.std(np.log(own[name] / own["thigh"])) > 0.02, name
    sizes = [np.log(lengths["thigh"] + lengths["shank"]) for lengths in (own, evened)]
    assert_allclose(np.median(sizes[0]), np.median(sizes[1]), atol=0.03)
    assert 0.6 * sizes[0].std() < sizes[1].std() < 1.1 * sizes[0].std()


def test_left_and_right_are_alike(poses: np.ndarray) -> None:
    mirrored = poses[:, LSP14.mirror] * (-1.0, 1.0, 1.0)
    spread = poses.std(axis=0)
    # 6,000 people: a mean is known to within spread / 77.
    assert np.all(np.abs(poses.mean(axis=0) - mirrored.mean(axis=0)) < 0.1 * spread + 1e-9)
    assert_allclose(measure(poses).mean(axis=0), measure(mirrored).mean(axis=0), atol=0.05)


def test_most_people_are_upright_and_some_lie(poses: np.ndarray) -> None:
    trunk = poses[:, NECK] / np.linalg.norm(poses[:, NECK], axis=1, keepdims=True)
    tilt = np.degrees(np.arccos(trunk[:, 1]))
    assert np.mean(tilt < 45) > 0.6
    assert 0.04 < np.mean(np.abs(tilt - 90) < 30) < 0.25
    assert 0.01 < np.mean(tilt > 120) < 0.08


def test_the_prior_is_small_and_its_card_says_what_it_is(prior: PosePrior) -> None:
    assert DEFAULT_PRIOR.stat().st_size < 1_500_000
    assert "mocap.cs.cmu.edu" in prior.card.licences[0]["credit"]
    assert prior.card.notes["command"]
    assert prior.card.notes["measured"]


def test_written_and_read_again(prior: PosePrior, tmp_path: Path) -> None:
    paths = [tmp_path / "one" / "p.npz", tmp_path / "two" / "p.npz"]
    for path in paths:
        save_prior(prior, path)
    assert paths[0].read_bytes() == paths[1].read_bytes()
    again = PosePrior.load(paths[0])
    assert_allclose(
        again.sample(100, np.random.default_rng(0)), prior.sample(100, np.random.default_rng(0))
    )


@pytest.mark.parametrize("damage", ["truncated", "not a zip", "no card", "bad card", "missing"])
def test_a_damaged_prior_is_named(damage: str, tmp_path: Path) -> None:
    path = tmp_path / "cmu.npz"
    shutil.copy(DEFAULT_PRIOR, path)
    shutil.copy(DEFAULT_PRIOR.with_suffix(".json"), path.with_suffix(".json"))
    if damage == "truncated":
        path.write_bytes(path.read_bytes()[:5000])
    elif damage == "not a zip":
        path.write_bytes(b"nothing")
    elif damage == "no card":
        path.with_suffix(".json").unlink()
    elif damage == "bad card":
        path.with_suffix(".json").write_text(json.dumps({"name": "x"}))
    else:
        path.unlink()
    with pytest.raises(LibraryError, match=r"cmu\.npz"):
        PosePrior.load(path)


def test_a_folder_is_no_prior() -> None:
    with pytest.raises(LibraryError, match=r"the pose prior \. .*Is a directory"):
        PosePrior.load(Path())


def test_limits_that_refuse_everything_do_not_hang(prior: PosePrior) -> None:
    nobody = replace(prior, limits=replace(prior.limits, low=np.full_like(prior.limits.low, 1e9)))
    with pytest.raises(RuntimeError, match="refuse nearly every sample"):
        nobody.sample(2, np.random.default_rng(0))


def test_every_kind_is_drawn_as_often_as_composed(prior: PosePrior) -> None:
    drawn = prior.draw(20_000, np.random.default_rng(2))
    share = dict(zip(KINDS, np.bincount(drawn.kinds, minlength=len(KINDS)) / 20_000, strict=True))
    made = prior.composition
    kept_on = (1 - made.lying) * (1 - made.turned)
    # Later kinds cover earlier ones, and the limits refuse some more than others.
    assert share["turned"] == pytest.approx(made.turned, rel=0.2)
    assert share["lying"] == pytest.approx(made.lying * (1 - made.turned), rel=0.2)
    assert share["reaching"] == pytest.approx(made.reaching * kept_on, rel=0.4)
    assert share["sitting"] == pytest.approx(made.sitting * kept_on, rel=0.4)
    assert min(share["captured"], share["recombined"], share["limbs"]) > 0.15
    assert sum(share.values()) == pytest.approx(1.0)


def test_the_sitting_sit_and_the_lying_lie(prior: PosePrior) -> None:
    drawn = prior.draw(20_000, np.random.default_rng(3))

    def direction(kind: Kind, start: int, end: int) -> np.ndarray:
        poses = drawn.poses[drawn.kinds == KINDS.index(kind)]
        bone = poses[:, end] - (poses[:, start] if start >= 0 else 0.0)
        pointing: np.ndarray = bone / np.linalg.norm(bone, axis=-1, keepdims=True)
        return pointing

    # Tilted ones aside, thighs are about level; of standing people they hang.
    for hip, knee in ((R_HIP, R_KNEE), (L_HIP, L_KNEE)):
        assert abs(np.median(direction("sitting", hip, knee)[:, 1])) < 0.25
        assert np.median(direction("captured", hip, knee)[:, 1]) < -0.8
    assert np.quantile(np.abs(direction("lying", -1, NECK)[:, 1]), 0.9) < 0.5


def test_the_contact_sheet_has_a_row_of_people_a_kind(prior: PosePrior) -> None:
    sheet = prior_sheet(prior, columns=3)
    assert sheet.shape[1:] == (3 * TILE_PX, 3)
    rows = np.array_split(sheet, len(KINDS))
    assert all(len(np.unique(row.reshape(-1, 3), axis=0)) > 20 for row in rows)
    with pytest.raises(ValueError, match="only 0 of 20,000 people turned"):
        prior_sheet(replace(prior, composition=replace(prior.composition, turned=0.0)), columns=1)


def test_facing_ahead_turns_about_the_vertical(poses: np.ndarray) -> None:
    ahead = face_ahead(poses)
    hips = ahead[:, L_HIP] - ahead[:, R_HIP]
    assert np.all(hips[:, 0] > 0)
    assert_allclose(hips[:, 2], 0.0, atol=1e-9)
    assert_allclose(ahead[..., 1], poses[..., 1])
    assert_allclose(measure(ahead), measure(poses), atol=1e-9)


def test_a_prior_fitted_on_its_own_samples(poses: np.ndarray, tmp_path: Path) -> None:
    path = tmp_path / "mocap.npz"
    subjects = np.array(["cmu_01", "cmu_02", "cmu_03", "cmu_35"])
    clip = np.arange(1000) % 4
    np.savez(path, positions=poses[:1000] + 100.0, clip=clip, clip_subject=subjects)
    assert len(read_mocap(path).poses_mm) == 1000
    mocap = read_mocap(path, exclude_subjects=("35",))
    assert set(mocap.subjects) == {"cmu_01", "cmu_02", "cmu_03"}
    settings = PriorSettings()
    fitted = fit_prior(mocap, settings, {"name": "tiny", "version": "1", "licences": []})
    again = fit_prior(
        Mocap(mocap.poses_mm, mocap.subjects), settings, {"name": "tiny", "version": "1"}
    )
    assert_array_equal(fitted.exemplars.legs, again.exemplars.legs)
    drawn = fitted.sample(500, np.random.default_rng(0))
    height = np.median(np.linalg.norm(poses[:, NECK], axis=1))
    assert np.median(np.linalg.norm(drawn[:, NECK], axis=1)) == pytest.approx(height, rel=0.05)
    # One pose, seen a thousand times from all sides, is one exemplar.
    turns = np.linspace(0.0, 6.0, 1000)
    cosine, sine = np.cos(turns)[:, None], np.sin(turns)[:, None]
    x, y, z = np.moveaxis(poses[:1].repeat(1000, axis=0), -1, 0)
    round_and_round = np.stack([cosine * x + sine * z, y, cosine * z - sine * x], axis=-1)
    one = fit_prior(
        Mocap(round_and_round, mocap.subjects[:1].repeat(1000)),
        settings,
        {"name": "one", "version": "1", "licences": []},
    )
    assert len(one.exemplars.legs) == 1
