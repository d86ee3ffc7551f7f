"""The lifter's samples, its loss and its ONNX graph; needs the train extra."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")
onnx = pytest.importorskip("onnx")

import onnxruntime as ort  # noqa: E402
from torch import Tensor  # noqa: E402

from library_store.prior import PosePrior  # noqa: E402
from library_store.skeleton import LSP14  # noqa: E402
from library_store.upright import MOST_LEAN, MOST_LEAN_OF_HALF, lean_rad  # noqa: E402
from models import ModelError, PoseLifter  # noqa: E402
from models.card import WEIGHTS_DIR, LiftOutput, read_card  # noqa: E402
from models.training import lifter_samples, train_lifter  # noqa: E402
from models.training.lifter_network import (  # noqa: E402
    PoseMlp,
    lifter_model,
    losses,
    read_last,
    read_network,
    with_depths,
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


def hinted(samples: Samples) -> Samples:
    """The same people, seen by a network that reads depths of two thirds of their joints."""
    rng = np.random.default_rng(11)
    known = samples.present * (rng.random(samples.present.shape) < 2 / 3)
    hint = samples.depths + rng.normal(0.0, 0.05, known.shape)
    return replace(samples, hint=(hint * known).astype(np.float32), known=known.astype(np.float32))


def lively(*, reads_depths: bool = False) -> PoseMlp:
    """A small network that heeds all it is given."""
    torch.manual_seed(1)
    network = PoseMlp(width=32, n_blocks=2, reads_depths=reads_depths)
    with torch.no_grad():
        network.first.weight.normal_(0.0, 0.2)
        network.last.weight.normal_(0.0, 0.2)
    return network


def given(samples: Samples, *, reads_depths: bool) -> Floats:
    """What a graph takes of samples: (n, 14, 3), or (n, 14, 5) if it reads depths."""
    columns = [*np.moveaxis(samples.points, 2, 0), samples.present - samples.doubt]
    if reads_depths:
        columns += [samples.hint, samples.known]
    return np.stack(columns, 2).astype(np.float32)


def answers(network: PoseMlp, joints: Floats) -> Floats:
    """The depths (n, 14) that the network's graph says."""
    data = lifter_model(network, np.eye(42)).SerializeToString()
    session = ort.InferenceSession(data, providers=["CPUExecutionProvider"])
    answer: Floats = session.run(None, {"joints": joints})[0]
    assert answer.shape == (len(joints), 43, 42)
    return answer[:, 0, 28:]


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
    assert 0.06 < 1.0 - there.mean() < 0.13
    units = np.concatenate([samples.points, np.ones((500, 14, 1), np.float32)], 2)
    units /= np.linalg.norm(units, axis=2, keepdims=True)
    middle = (samples.present[..., None] * units).sum(1)
    np.testing.assert_allclose(middle[:, :2] / middle[:, 2:], 0.0, atol=1e-4)
    hips = samples.depths[:, [8, 11]].mean(1)
    np.testing.assert_allclose(hips, 0.0, atol=1e-5)


def test_edges_leave_the_joints_on_one_side_of_a_line(
    poses: Floats, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lifter_samples, "INCOMPLETE", 0.0)
    monkeypatch.setattr(lifter_samples, "CUT_OFF", 1.0)
    monkeypatch.setattr(lifter_samples, "MAX_NOISE_MM", 0.0)
    monkeypatch.setattr(lifter_samples, "ELSEWHERE", 0.0)
    samples = draw(poses, 400, np.random.default_rng(0))
    beyond = (samples.present == 0).sum(1)
    assert beyond.min() == lifter_samples.FEWEST_BEYOND
    assert beyond.max() == lifter_samples.MOST_BEYOND
    directions = np.linspace(0, 2 * np.pi, 720, endpoint=False)
    along = samples.truth @ np.stack([np.sin(directions), np.cos(directions)])
    there = samples.present[..., None] > 0
    inner = np.where(there, along, -np.inf).max(1)
    outer = np.where(there, np.inf, along).min(1)
    apart = inner <= outer + 1e-4
    assert apart.any(1).mean() > 0.99
    # Mostly it is the lower edge (y points down), though not of who lies: it is turned with them.
    assert (apart[:, np.cos(directions) > np.cos(0.6)].any(1)).mean() > 0.7


def test_nobody_leans_farther_than_the_service_lets_them(poses: Floats) -> None:
    lying = poses @ np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]], np.float32)
    samples = draw(np.concatenate([poses, lying]), 500, np.random.default_rng(0))
    lean = np.abs(lean_rad(samples.points, samples.present > 0))
    assert lean.max() < MOST_LEAN_OF_HALF + 1e-4
    assert lean[samples.present.all(1)].max() < MOST_LEAN + 1e-4
    assert 0.2 < (lean < 1e-4).mean() < 0.8
    upright = samples.truth[:, 1, 1] < samples.truth[:, [8, 11], 1].mean(1)
    assert upright.mean() > 0.95, "the truth is turned with what is seen"


@pytest.mark.parametrize("reads_depths", [False, True])
def test_the_graph_says_what_the_network_says(poses: Floats, *, reads_depths: bool) -> None:
    network = lively(reads_depths=reads_depths)
    samples = hinted(doubted(draw(poses, 8, np.random.default_rng(1))))
    mirror = list(LSP14.mirror)
    found = answers(network, given(samples, reads_depths=reads_depths))
    for row in range(8):
        said = []
        for view in (samples, in_mirror(samples)):
            # A row at a time, as hidden layers are rounded by the batch.
            one = view.taken(np.array([row]))
            with torch.no_grad():
                said.append(read_last(network(train_lifter.tensors(one)[0])).depths[0].numpy())
        there = samples.present[row, :, None]
        centred = (samples.points[row] - (there * samples.points[row]).sum(0) / there.sum()) * there
        radius = np.sqrt((centred**2).sum() / there.sum())
        depths = 0.5 * radius * (said[0] + said[1][mirror])
        depths -= 0.5 * (depths[8] + depths[11])
        # The hidden layers' weights have 7 bits.
        np.testing.assert_allclose(found[row], depths, atol=0.05 * np.abs(depths).max())


def test_the_service_runs_what_is_written(poses: Floats, tmp_path: Path) -> None:
    network = lively()
    samples = doubted(draw(poses, 3, np.random.default_rng(1)))
    lifter = written(network, poses, tmp_path)
    for row in range(3):
        one = samples.taken(np.array([row]))
        belief = (one.present - one.doubt)[0]
        found = lifter.lift(one.points[0].astype(np.float64), belief).depths
        said = answers(network, given(one, reads_depths=False))[0]
        np.testing.assert_allclose(found, said, atol=1e-6)


def test_depths_that_are_not_known_are_not_looked_at(poses: Floats) -> None:
    network = lively(reads_depths=True)
    samples = hinted(doubted(draw(poses, 8, np.random.default_rng(1))))
    unheard = replace(samples, known=np.zeros_like(samples.known))
    silent = replace(unheard, hint=np.zeros_like(samples.hint))
    missing = replace(samples, present=samples.present.copy(), doubt=samples.doubt.copy())
    missing.present[:, 3] = missing.doubt[:, 3] = 0.0
    without = replace(missing, hint=missing.hint.copy(), known=missing.known.copy())
    without.hint[:, 3] = without.known[:, 3] = 0.0
    for one, other in ((unheard, silent), (missing, without)):
        here, there = (given(view, reads_depths=True) for view in (one, other))
        assert not np.array_equal(here, there)
        np.testing.assert_array_equal(answers(network, here), answers(network, there))
        here, there = (train_lifter.tensors(view)[0].numpy() for view in (one, other))
        np.testing.assert_array_equal(here, there)
    heard = answers(network, given(samples, reads_depths=True))
    assert np.abs(heard - answers(network, given(silent, reads_depths=True))).max() > 0.01


def test_depths_are_as_deep_in_the_mirror(poses: Floats) -> None:
    network = lively(reads_depths=True)
    samples = hinted(doubted(draw(poses, 8, np.random.default_rng(1))))
    mirror = list(LSP14.mirror)
    plain, flipped = (
        answers(network, given(view, reads_depths=True)) for view in (samples, in_mirror(samples))
    )
    np.testing.assert_allclose(flipped[:, mirror], plain, atol=1e-5)


def test_a_widened_network_says_the_same_until_it_has_learned(poses: Floats) -> None:
    network = lively()
    samples = hinted(doubted(draw(poses, 8, np.random.default_rng(1))))
    wider = with_depths(network)
    assert (network.reads_depths, wider.reads_depths) == (False, True)
    assert with_depths(wider) is wider
    features = train_lifter.tensors(samples)[0]
    with torch.no_grad():
        np.testing.assert_allclose(wider(features), network(features), atol=1e-6)
    np.testing.assert_allclose(
        answers(wider, given(samples, reads_depths=True)),
        answers(network, given(samples, reads_depths=False)),
        atol=1e-5,
    )
    read_last(wider(features)).depths.square().mean().backward()
    slopes = wider.first.weight.grad
    assert slopes is not None
    assert (slopes[:, 57:].abs().max(0).values > 0).all()


@pytest.mark.parametrize("name", ["lifter", "lifter-found"])
def test_what_ships_would_be_written_so_again(name: str) -> None:
    path = WEIGHTS_DIR / f"{name}.onnx"
    squares = [
        value
        for value in map(onnx.numpy_helper.to_array, onnx.load(path).graph.initializer)
        if value.shape == (42, 42) and (np.diag(value) > 0).all()
    ]
    (moments,) = (value for value in squares if (value == value.T).all())
    again = lifter_model(read_network(path), moments.astype(np.float64))
    assert again.SerializeToString(deterministic=True) == path.read_bytes()


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


@pytest.mark.parametrize("depths", [False, True])
def test_training_goes_on_from_what_was_written(
    poses: Floats, tmp_path: Path, *, depths: bool
) -> None:
    network = lively(reads_depths=depths)
    card = train_lifter.lifter_card(network, "tiny", "1", PosePrior.load(), {}, mistaken=True)
    drawn = train_lifter.drawing(poses, mistaken(depths=depths))
    train_lifter.save(network, card, drawn, tmp_path)
    output = read_card(tmp_path / "tiny.json").output
    assert isinstance(output, LiftOutput)
    assert output.reads_depths == depths
    again = read_network(tmp_path / "tiny.onnx")
    assert again.reads_depths == depths
    samples = hinted(doubted(draw(poses, 64, np.random.default_rng(1))))
    features = train_lifter.tensors(samples)[0]
    with torch.no_grad():
        np.testing.assert_allclose(again(features), network(features), atol=0.05)


def test_what_ships_can_be_gone_on_from_and_other_files_cannot() -> None:
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
