"""The lifter's samples, its loss and its ONNX graph; needs the train extra."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("onnx")

from torch import Tensor  # noqa: E402

from library_store.prior import PosePrior  # noqa: E402
from library_store.skeleton import LSP14  # noqa: E402
from models import ModelError, PoseLifter  # noqa: E402
from models.card import WEIGHTS_DIR  # noqa: E402
from models.training import lifter_samples, train_lifter  # noqa: E402
from models.training.lifter_network import (  # noqa: E402
    PoseMlp,
    losses,
    read_last,
    read_network,
)
from models.training.lifter_samples import (  # noqa: E402
    Floats,
    Samples,
    draw,
    in_mirror,
    joined,
)
from tests.models.training.test_lifter_mistakes import mistaken  # noqa: E402


@pytest.fixture(scope="module")
def poses() -> Floats:
    return PosePrior.load().sample(200, np.random.default_rng(3)).astype(np.float32)


def doubted(samples: Samples) -> Samples:
    """The same people, seen by a network that is not sure of their joints."""
    drawn = np.random.default_rng(7).uniform(0, 0.8, samples.present.shape)
    return replace(samples, doubt=(drawn * samples.present).astype(np.float32))


def written(network: PoseMlp, poses: Floats, folder: Path) -> PoseLifter:
    """The network as the service runs it."""
    card = train_lifter.lifter_card(network, "tiny", "1", PosePrior.load(), {}, mistaken=True)
    train_lifter.save(network, card, train_lifter.drawing(poses, None), folder)
    return PoseLifter("tiny", weights_dir=folder)


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
    samples = doubted(draw(poses, 64, np.random.default_rng(1)))
    lifter = written(network, poses, tmp_path)
    mirror = list(LSP14.mirror)
    for row in range(3):
        belief = samples.present[row] - samples.doubt[row]
        found = lifter.lift(samples.points[row].astype(np.float64), belief)
        said = []
        for view in (samples, in_mirror(samples)):
            one = view.taken(np.array([row]))
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


def test_training_goes_on_from_what_was_written(poses: Floats, tmp_path: Path) -> None:
    torch.manual_seed(2)
    network = PoseMlp(width=32, n_blocks=2)
    with torch.no_grad():
        network.last.weight.normal_(0.0, 0.2)
    written(network, poses, tmp_path)
    again = read_network(tmp_path / "tiny.onnx")
    features = train_lifter.tensors(doubted(draw(poses, 64, np.random.default_rng(1))))[0]
    with torch.no_grad():
        np.testing.assert_allclose(again(features), network(features), atol=0.05)
    for name in ("lifter", "lifter-found"):
        assert len(read_network(WEIGHTS_DIR / f"{name}.onnx").blocks) == 3
    with pytest.raises(ModelError, match="cannot be read as a lifter"):
        read_network(WEIGHTS_DIR / "person.onnx")


def test_half_of_what_is_drawn_is_mistaken(poses: Floats) -> None:
    drawn = train_lifter.drawing(poses, mistaken())
    samples = drawn(600, np.random.default_rng(2))
    assert len(samples.points) == 600
    assert (samples.doubt > 0.5).any(1).mean() == pytest.approx(2 / 3, abs=0.01)
    again = joined([samples, samples])
    np.testing.assert_array_equal(again.taken(np.arange(600, 1200)).points, samples.points)
