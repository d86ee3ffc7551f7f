"""The network compared with: what it is fed, that both forwards agree, that it learns."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from app.lifting.geometry import normalised_projection
from app.lifting.types import Intrinsics
from evaluation.metrics import root_centred_error_mm
from evaluation.paper import compare, mlp
from evaluation.paper.network import Network, features, warp_onto
from library_store.build import BuildSettings, build_library
from library_store.library import Library, load
from library_store.prior import PosePrior
from library_store.skeleton import L_HIP, R_HIP


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Library:
    directory = tmp_path_factory.mktemp("mlp") / "tiny"
    build_library(directory, PosePrior.load(), BuildSettings(name="tiny", n_poses=1_000))
    return load(directory)


@pytest.fixture(scope="module")
def weights(library: Library, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An untrained network, as training writes it."""
    path = tmp_path_factory.mktemp("mlp") / "mlp.npz"
    drawn = mlp.initial_weights(16, 2, np.random.default_rng(0))
    poses = library.manifest.files["poses.npy"].sha256
    # mypy takes the expanded names for savez's own options.
    np.savez(path, n_blocks=2, n_samples=0, poses=poses, **drawn)  # type: ignore[arg-type]
    return path


def test_samples_are_views_of_the_librarys_people(library: Library) -> None:
    poses = library.poses_mm(np.arange(20))
    drawn = mlp.draw(poses, 4_000, np.random.default_rng(1))
    middle = 0.5 * (drawn.joints_mm[:, R_HIP] + drawn.joints_mm[:, L_HIP])
    np.testing.assert_allclose(middle, 0, atol=1e-9)
    assert (~drawn.present).sum(1).max() == 1
    assert (~drawn.present).sum() == pytest.approx(400, rel=0.2)
    # Seen upright for the most part: y points down, the head is above the feet.
    assert (drawn.joints_mm[:, 0, 1] < drawn.joints_mm[:, 10, 1]).mean() > 0.6


def test_features_forget_place_and_size_but_not_strength_of_perspective(library: Library) -> None:
    drawn = mlp.draw(library.poses_mm(np.arange(50)), 50, np.random.default_rng(2))
    once = features(drawn.points, drawn.present)
    twice = features(2.0 * drawn.points + 0.3, drawn.present)
    np.testing.assert_allclose(twice[:, :-1], once[:, :-1], atol=1e-9)
    np.testing.assert_allclose(twice[:, -1] - once[:, -1], np.log(2.0), atol=1e-9)
    hidden = drawn.points.copy()
    hidden[~drawn.present] = np.nan
    np.testing.assert_allclose(features(np.nan_to_num(hidden), drawn.present), once, atol=1e-9)


def test_warping_agrees_with_the_image(library: Library) -> None:
    drawn = mlp.draw(library.poses_mm(np.arange(50)), 20, np.random.default_rng(3))
    warped = warp_onto(drawn.joints_mm, drawn.points, np.ones_like(drawn.present))
    np.testing.assert_allclose(normalised_projection(warped), drawn.points, atol=1e-9)


def test_compare_prints_every_method(
    library: Library, weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    joints = library.poses_mm(np.arange(8)) * [1.0, -1.0, -1.0] + [0.0, 0.0, 4000.0]
    pinhole = Intrinsics(1000.0, (0.0, 0.0), "request")
    data = tmp_path / "set.npz"
    points = pinhole.focal_length_px * normalised_projection(joints)
    np.savez(data, joints_3d_mm=joints, joints_2d_px_noise0=points, focal_length_px=1000.0)
    arguments = ["--library", str(library.directory), "--mlp", str(weights), "--data", str(data)]
    compare.main(arguments)
    printed = capsys.readouterr().out
    assert "other poses" not in printed
    for method in ("paper", "default", "MLP", "MLP, warped"):
        assert printed.count(f"| {method} |") == 2


def test_training_is_in_bf16_only_where_that_is_quick(
    library: Library, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    torch = pytest.importorskip("torch", reason="of the extra train")
    from models.training.precision import has_bf16

    real, seen = mlp.forward, set()

    def noted(*arguments: Any) -> Any:
        seen.add(torch.is_autocast_enabled("cpu"))
        return real(*arguments)

    monkeypatch.setattr(mlp, "forward", noted)
    mlp.train(library, 8, 1, 0.01, 0, tmp_path / "mlp.npz")
    assert seen == {has_bf16("cpu")}


def test_training_learns_and_both_forwards_agree(library: Library, tmp_path: Path) -> None:
    torch = pytest.importorskip("torch", reason="of the extra train")
    out = tmp_path / "mlp.npz"
    n = mlp.train(library, 32, 1, 0.05, 0, out)
    network = Network.load(out)
    assert network.n_samples == n > 0
    drawn = mlp.draw(library.poses_mm(np.arange(1_000)), 200, np.random.default_rng(4))
    found = network.lift(drawn.points, drawn.present)
    flat = np.zeros_like(found)
    # A few seconds, on whatever machine this is: less than knowing nothing.
    nothing_known = root_centred_error_mm(flat, drawn.joints_mm).mean()
    assert root_centred_error_mm(found, drawn.joints_mm).mean() < nothing_known
    tensors = {k: torch.tensor(v, dtype=torch.float32) for k, v in network.weights.items()}
    inputs = torch.tensor(features(drawn.points, drawn.present), dtype=torch.float32)
    theirs = mlp.forward(tensors, 1, inputs).numpy().reshape(-1, 14, 3) * 500.0
    np.testing.assert_allclose(
        theirs - theirs.mean(1, keepdims=True), found - found.mean(1, keepdims=True), atol=1.0
    )
