"""The reliability command, on a small real library, and the arithmetic of its tables."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from evaluation import reliability
from evaluation.protocols import load_lifting_set
from evaluation.reliability import cases, rejection, rolled
from library_store.build import BuildSettings, build_library
from library_store.prior import PosePrior


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    poses = PosePrior.load().sample(40, np.random.default_rng(6))
    joints = poses * [1.0, -1.0, -1.0] + [0.0, 0.0, 4000.0]
    pixels = 1150.0 * joints[..., :2] / joints[..., 2:]
    path = tmp_path_factory.mktemp("set") / "people.npz"
    np.savez(path, joints_3d_mm=joints, focal_length_px=1150.0, joints_2d_px_noise0=pixels)
    return path


def test_rejection_lies_between_nobody_and_the_oracle() -> None:
    rng = np.random.default_rng(0)
    error = rng.gamma(2.0, 30.0, 5_000)
    assert rejection(error, error).share == pytest.approx(1.0)
    assert rejection(error, rng.normal(size=5_000)).share == pytest.approx(0.0, abs=0.1)
    assert rejection(error, -error).share < -0.2
    assert np.isnan(rejection(np.ones(10), error[:10]).share)


def test_cases_are_told_by_the_truth(data: Path) -> None:
    people = load_lifting_set(data)
    upright = cases(people.joints_3d_mm)
    assert upright["head below the hips"].mean() < 0.2
    upside_down = cases(rolled(people, 180.0).joints_3d_mm)
    np.testing.assert_array_equal(
        upside_down["head below the hips"],
        ~upright["head below the hips"],
    )
    sides = [upright[name] for name in upright if "view" in name]
    assert (np.sum(sides, axis=0) == 1).all()


def test_somebody_who_faces_the_camera_is_seen_from_the_front() -> None:
    """Their left is on the right of the picture; y points down, z away from the camera."""
    down = [-700, -500, *(-500, -250, 0) * 2, *(0, 400, 800) * 2]
    aside = [0, 0, *(-150,) * 3, *(150,) * 3, *(-100,) * 3, *(100,) * 3]
    facing = np.array([aside, down, [0] * 14], float).T
    turned = facing * [-1.0, 1.0, -1.0]
    sideways = facing[:, [2, 1, 0]]
    told = cases(np.stack([facing, turned, sideways]) + np.array([0.0, 0.0, 4000.0]))
    assert told["front view (within 60°)"].tolist() == [True, False, False]
    assert told["back view (within 60°)"].tolist() == [False, True, False]
    assert told["side view"].tolist() == [False, False, True]


def test_a_rolled_set_projects_onto_its_points(data: Path) -> None:
    turned = rolled(load_lifting_set(data), 90.0)
    joints = turned.joints_3d_mm
    pixels = turned.intrinsics.focal_length_px * joints[..., :2] / joints[..., 2:]
    np.testing.assert_allclose(pixels, turned.joints_2d_px[0], atol=1e-9)


def test_the_command_prints_its_tables(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    directory = tmp_path / "tiny"
    build_library(directory, PosePrior.load(), BuildSettings(name="tiny", n_poses=2_000, seed=3))
    reliability.main(["--library", str(directory), "--data", str(data)])
    printed = capsys.readouterr().out
    assert printed.count("\n|---|") == 4
    assert "| everybody, camera rolled by 180° | 40 | 0 |" in printed
    assert "| moved by half a torso | 0 |" in printed
