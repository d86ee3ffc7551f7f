"""People without some of their joints: who is lifted without which, the fit, the table."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from app.lifting.calibration import SigmaCalibration
from app.lifting.types import Intrinsics
from evaluation import missing_joints
from evaluation.missing_joints import MISSING, fit_missing, row, without
from evaluation.photo_sigma import Answers
from evaluation.protocols import LiftingSet
from library_store.build import BuildSettings, build_library
from library_store.prior import PosePrior

PLAIN = SigmaCalibration((1.0,) * 14, 0.0, missing_doubt=0.8)


def made_up(people: int, missing: tuple[int, ...]) -> Answers:
    """Answers whose errors ``PLAIN`` covers by 68%."""
    rng = np.random.default_rng(len(missing))
    confidence = np.ones((people, 14))
    confidence[:, list(missing)] = 0.0
    spread = rng.uniform(30, 90, (people, 14))
    answers = Answers(spread, np.zeros_like(spread), confidence, np.zeros(people))
    error = np.abs(rng.normal(size=spread.shape)) / 0.9945 * answers.sigma_mm(PLAIN)
    return replace(answers, error_mm=error)


def test_everybody_is_there_at_every_noise_level_without_the_joints() -> None:
    points = np.random.default_rng(0).normal(size=(5, 14, 2))
    truth = np.random.default_rng(1).normal(size=(5, 14, 3))
    data = LiftingSet("x", truth, {0: points, 5: points + 1}, Intrinsics(1e3, (0, 0), "request"))
    people = without(data, (4, 7))
    assert len(people) == 10
    for n, person in enumerate(people):
        assert np.flatnonzero(person.observation.confidence == 0).tolist() == [4, 7]
        np.testing.assert_array_equal(person.observation.joints_px, points[n % 5] + (n >= 5))
        np.testing.assert_array_equal(person.joints_mm, truth[n % 5])


def test_the_fit_finds_what_missing_joints_are_worth() -> None:
    answers = [made_up(2000, missing) for missing in MISSING.values()]
    fitted = fit_missing(answers, replace(PLAIN, missing_doubt=0.0))
    assert fitted.missing_doubt == pytest.approx(0.8, abs=0.1001)


def test_rows_tell_stated_joints_from_the_others() -> None:
    cells = row("x", made_up(2000, (3, 4, 6, 7)), (3, 4, 6, 7), PLAIN).split("|")
    assert cells[2].strip() == "2000"
    for column in (4, 7):
        assert abs(int(cells[column].strip("% ")) - 68) <= 2
    for column in (5, 8):
        assert int(cells[column].strip("% ")) < 63, "without the growth less is covered"
    assert row("x", made_up(50, ()), (), PLAIN).endswith("| - | - | - |")


def test_the_command_has_a_row_for_each_case(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    cases = {"nothing": (), "the legs": MISSING["the legs"]}
    monkeypatch.setattr(missing_joints, "MISSING", cases)
    prior = PosePrior.load()
    build_library(tmp_path / "tiny", prior, BuildSettings(name="tiny", n_poses=2_000, seed=3))
    poses = prior.sample(40, np.random.default_rng(9)) * (1, -1, -1)
    truth = poses + np.array([0.0, 0.0, 4000.0])
    points = 1150.0 * truth[..., :2] / truth[..., 2:]
    np.savez(
        tmp_path / "people.npz",
        joints_3d_mm=truth,
        focal_length_px=1150.0,
        joints_2d_px_noise0=points,
    )
    of = ["--library", str(tmp_path / "tiny"), "--data", str(tmp_path / "people.npz")]
    missing_joints.main([*of, "--every", "4"])
    printed = capsys.readouterr().out.splitlines()
    assert printed[0] == "10 people at 1 noise levels"
    assert [line.split(" |")[0] for line in printed[4:]] == ["| nothing", "| the legs"]
