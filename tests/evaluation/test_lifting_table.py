"""The command that prints the lifting table and the calibration, on a set made here."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from app.errors import PoseMatchError
from app.lifting.calibration import FUSION_SIGMA
from evaluation import calibration, lifting
from evaluation.calibration import Errors, coverage, fit_sigma
from evaluation.protocols import load_lifting_set, one_corrupted, one_missing
from library_store.build import BuildSettings, build_library
from library_store.prior import PosePrior


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    poses = PosePrior.load().sample(12, np.random.default_rng(5)) * [1.0, -1.0, -1.0]
    joints = poses + np.array([0.0, 0.0, 4500.0])
    pixels = 1150.0 * joints[..., :2] / joints[..., 2:]
    path = tmp_path_factory.mktemp("data") / "made_here.npz"
    np.savez(
        path,
        joints_3d_mm=joints.astype(np.float32),
        joints_2d_px_noise0=pixels,
        joints_2d_px_noise5=pixels + 5 * np.random.default_rng(6).normal(size=pixels.shape),
        focal_length_px=1150.0,
    )
    return path


@pytest.fixture(scope="module")
def library_directory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("library") / "tiny"
    settings = BuildSettings(name="tiny", n_poses=2_000, seed=3)
    build_library(directory, PosePrior.load(), settings)
    return directory


def test_the_table_has_a_row_for_every_case(
    data: Path, library_directory: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lifting.main(["--library", str(library_directory), "--data", str(data)])
    printed = capsys.readouterr().out.splitlines()
    assert "fusion: network lifter" in printed[0]
    rows = [line for line in printed if line.startswith("| ")]
    assert len(rows) == 1 + 3 * 2 * 2
    assert sum("| fusion |" in row for row in rows) == 6


def test_somebody_who_cannot_be_lifted_is_named_not_left_out(
    data: Path, library_directory: Path, tmp_path: Path
) -> None:
    bad = tmp_path / "bad.npz"
    with np.load(data) as held:
        arrays = dict(held)
    arrays["joints_2d_px_noise0"][3] = 5.0
    np.savez(bad, **arrays)
    with pytest.raises(PoseMatchError, match=r"1 of the set's 12 people .* first number 3: "):
        lifting.main(["--library", str(library_directory), "--data", str(bad)])


def test_calibration_prints_its_constants(
    data: Path,
    library_directory: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(calibration, "LIBRARY_SIGMAS_PX", (30.0,))
    calibration.main(
        [
            *("--library", str(library_directory), "--data", str(data), "--search"),
            *("--check", str(library_directory), str(data)),
        ]
    )
    printed = capsys.readouterr().out
    assert "SigmaCalibration(factors=" in printed
    # Put in place of what is there, it changes nothing that another command fits.
    assert f"person_doubt_mm={FUSION_SIGMA.person_doubt_mm}, joint_doubt_mm=" in printed
    assert "log P" in printed
    assert printed.count("claimed -> nearest") == 4


def test_spoiling_touches_one_joint(data: Path) -> None:
    points = load_lifting_set(data).joints_2d_px[0]
    missing, corrupted = one_missing(points), one_corrupted(points)
    assert (missing.confidence.sum(1) == 13).all()
    moved = np.linalg.norm(corrupted.points_px - points, axis=-1)
    assert ((moved > 0).sum(1) == 1).all()
    np.testing.assert_array_equal(moved.argmax(1), corrupted.joint)


def test_sigma_fit_recovers_what_made_the_errors() -> None:
    rng = np.random.default_rng(0)
    levels = []
    for noise in (1.0, 5.0, 10.0):
        spread = rng.uniform(20, 120, size=(3_000, 14))
        noise_px = noise * rng.uniform(0.7, 1.3, size=3_000)
        sd = np.sqrt(spread**2 + (8.0 * noise_px[:, None]) ** 2)
        levels.append(Errors(spread, np.abs(rng.normal(size=spread.shape)) * sd, noise_px))
    fitted = fit_sigma(levels)
    np.testing.assert_allclose(fitted.factors, 0.994, atol=0.08)
    assert fitted.noise_mm_per_px == pytest.approx(8.0, abs=3.0)
    for level in levels:
        assert coverage(fitted, level) == pytest.approx(0.68, abs=0.03)
