"""The lifter's samples, its loss and its ONNX graph; needs the train extra."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("onnx")

from torch import Tensor  # noqa: E402

from library_store.prior import PosePrior  # noqa: E402
from library_store.skeleton import LSP14  # noqa: E402
from models import PoseLifter  # noqa: E402
from models.training import lifter_samples, train_lifter  # noqa: E402
from models.training.lifter_network import PoseMlp, losses, read_last  # noqa: E402
from models.training.lifter_samples import IN_MIRROR, Floats, Samples, draw  # noqa: E402


@pytest.fixture(scope="module")
def poses() -> Floats:
    return PosePrior.load().sample(200, np.random.default_rng(3)).astype(np.float32)


def test_samples_without_noise_are_where_they_are(
    poses: Floats, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lifter_samples, "MAX_NOISE_MM", 0.0)
    monkeypatch.setattr(lifter_samples, "ELSEWHERE", 0.0)
    samples = draw(poses, 500, np.random.default_rng(0))
    there = samples.present > 0
    np.testing.assert_allclose(samples.points[there], samples.truth[there], atol=1e-4)
    assert (samples.points[~there] == 0).all()
    assert 0.02 < 1.0 - there.mean() < 0.06
    units = np.concatenate([samples.points, np.ones((500, 14, 1), np.float32)], 2)
    units /= np.linalg.norm(units, axis=2, keepdims=True)
    middle = (samples.present[..., None] * units).sum(1)
    np.testing.assert_allclose(middle[:, :2] / middle[:, 2:], 0.0, atol=1e-4)
    hips = samples.depths[:, [8, 11]].mean(1)
    np.testing.assert_allclose(hips, 0.0, atol=1e-5)


def test_the_graph_says_what_the_network_says(poses: Floats, tmp_path: Path) -> None:
    torch.manual_seed(1)
    network = PoseMlp(width=32, n_blocks=2)
    with torch.no_grad():
        network.last.weight.normal_(0.0, 0.2)
    samples = draw(poses, 64, np.random.default_rng(1))
    train_lifter.save(network, 0, PosePrior.load(), poses, tmp_path, name="tiny", version="1")
    lifter = PoseLifter("tiny", weights_dir=tmp_path)
    mirror = list(LSP14.mirror)
    flipped = Samples(
        (samples.points * IN_MIRROR[:2])[:, mirror],
        samples.present[:, mirror],
        samples.truth,
        samples.depths,
        samples.root_mm,
    )
    for row in range(3):
        found = lifter.lift(samples.points[row].astype(np.float64), samples.present[row])
        said = []
        for view in (samples, flipped):
            one = Samples(*(part[row : row + 1] for part in vars(view).values()))
            with torch.no_grad():
                said.append(read_last(network(train_lifter.tensors(one)[0])).depths[0].numpy())
        there = samples.present[row, :, None]
        centred = (samples.points[row] - (there * samples.points[row]).sum(0) / there.sum()) * there
        radius = np.sqrt((centred**2).sum() / there.sum())
        depths = 0.5 * radius * (said[0] + said[1][mirror])
        depths -= 0.5 * (depths[8] + depths[11])
        # The hidden layers' weights have 7 bits.
        np.testing.assert_allclose(found.depths, depths, atol=0.05 * np.abs(depths).max())


def test_the_loss_is_least_at_the_truth_and_at_honest_deviations(poses: Floats) -> None:
    _, image, depths, size = train_lifter.tensors(draw(poses, 64, np.random.default_rng(2)))

    def last(error: float, log_sigma: float) -> Tensor:
        said = torch.zeros(64, 72)
        said[:, :28], said[:, 28:42], said[:, 42] = image.flatten(1), depths + error, size + error
        said[:, 43:57], said[:, 57:] = -5.0, log_sigma
        return said

    exact, off = (losses(last(error, 0.0), image, depths, size)[0] for error in (0.0, 0.3))
    assert exact < 0.01 < off
    surprises = [
        float(losses(last(0.3, np.log(sigma)), image, depths, size)[1]) for sigma in (0.1, 0.3, 0.9)
    ]
    assert min(surprises) == surprises[1]
