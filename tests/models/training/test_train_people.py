"""Training of the person network: what it is to say, what it is shown; needs the train extra."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

torch = pytest.importorskip("torch")

from torch import Tensor  # noqa: E402

from models.errors import AnnotationError  # noqa: E402
from models.person_detector import decode, iou  # noqa: E402
from models.training import train_people  # noqa: E402
from models.training.dataset import Image  # noqa: E402
from models.training.measure_people import recall_and_extra  # noqa: E402
from models.training.network import PersonConfig, PersonNetwork  # noqa: E402
from models.training.scenes import LabelledScene, SceneSample  # noqa: E402
from models.training.train_people import (  # noqa: E402
    KINDS,
    UNIT_PX,
    Material,
    finder,
    loss_from,
    targets,
    to_batch,
)
from tests.models.training.crops import standing  # noqa: E402

SIZE, STRIDE = (320, 256), PersonNetwork.STRIDE
BOXES = np.array([[30, 20, 110, 200], [150, 60, 190, 150], [230, 200, 262, 231]], np.float32)


def sample(boxes: NDArray[np.float32]) -> SceneSample:
    trust = np.ones((SIZE[1] // STRIDE, SIZE[0] // STRIDE), np.float32)
    return SceneSample(np.zeros((SIZE[1], SIZE[0], 3), np.uint8), boxes, trust)


def said(heat: NDArray[np.float32], sides: NDArray[np.float32]) -> NDArray[np.float32]:
    """The maps (B, 5, h, w) of a network that has learned these targets to the letter."""
    sure = np.clip(heat, 1e-6, 1 - 1e-6)
    logit, logs = np.log(sure / (1 - sure)), np.log(np.maximum(sides, 1.0) / UNIT_PX)
    return np.concatenate([logit[:, None], logs], 1).astype(np.float32)


def scenes() -> list[LabelledScene]:
    """One with somebody who stands, one with nobody."""
    rng = np.random.default_rng(0)
    peopled, empty = (rng.integers(0, 256, (200, 300, 3), np.uint8) for _ in range(2))
    return [
        LabelledScene(peopled, np.array([[40, 20, 90, 180, 0.9]], np.float32)),
        LabelledScene(empty, np.zeros((0, 5), np.float32)),
    ]


def test_targets_are_what_the_detector_reads_as_those_boxes() -> None:
    heat, sides, weight = targets([sample(BOXES), sample(BOXES[:0])], STRIDE)
    boxes, scores = decode(said(heat, sides)[0], STRIDE, UNIT_PX, 0.5)
    assert len(boxes) == len(BOXES)
    assert (scores > 0.99).all()
    assert (iou(boxes, BOXES.astype(np.float64)).max(0) > 0.99).all()
    assert (weight[0] > 0).any()
    assert not heat[1].any()
    assert not weight[1].any()


def test_the_loss_is_least_for_what_is_to_be_said() -> None:
    x, heat, sides, weight, trust = to_batch([sample(BOXES)], STRIDE)
    assert x.shape == (1, 3, SIZE[1], SIZE[0])
    assert x.min() == x.max() == -1
    right = torch.from_numpy(said(heat.numpy(), sides.numpy()))
    moved = torch.roll(right, 3, -1)
    larger = right.clone()
    larger[:, 1:] += 0.2
    losses = [float(loss_from(out, heat, sides, weight, trust)) for out in (right, larger, moved)]
    assert losses == sorted(losses)
    assert losses[0] < 0.15 < 0.3 < losses[1]


def test_where_nothing_is_known_somebody_strange_costs_nothing() -> None:
    _, heat, sides, weight, trust = to_batch([sample(BOXES[:0])], STRIDE)
    out = torch.zeros((1, 5, SIZE[1] // STRIDE, SIZE[0] // STRIDE))
    assert loss_from(out, heat, sides, weight, trust) > 1
    assert loss_from(out, heat, sides, weight, 0 * trust) == 0


@pytest.mark.parametrize("kind", list(KINDS))
def test_samples_of_every_kind_are_of_the_canvas_and_made_again(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(train_people, "KINDS", dict.fromkeys(KINDS, 0.0) | {kind: 1.0})
    material = Material.of([standing(), standing(90)], scenes(), np.random.default_rng(0))
    for seed in range(8):
        made, again = (material.sample(np.random.default_rng(seed), SIZE) for _ in range(2))
        assert made.image.shape == (SIZE[1], SIZE[0], 3)
        assert made.trust.shape == (SIZE[1] // STRIDE, SIZE[0] // STRIDE)
        assert ((made.boxes >= 0) & (made.boxes <= np.tile(SIZE, 2))).all()
        for one, other in zip(vars(made).values(), vars(again).values(), strict=True):
            np.testing.assert_array_equal(one, other)


def test_what_a_kind_of_sample_lacks_is_said_before_training() -> None:
    rng = np.random.default_rng(0)
    peopled, _ = scenes()
    with pytest.raises(AnnotationError, match=r"samples of: mosaic \("):
        Material.of([standing()], [peopled], rng)
    armless = replace(standing(), weight=np.r_[np.ones(3), 0, np.ones(10)].astype(np.float32))
    with pytest.raises(AnnotationError, match=r"samples of: crowd \("):
        Material.of([armless], scenes(), rng)


def test_recall_is_of_the_teachers_sure_boxes_and_strange_ones_are_counted() -> None:
    truth = np.array([[10, 10, 60, 160], [200, 10, 250, 160]], np.float64)
    unsure = np.array([[100, 20, 140, 150]], np.float64)
    known = np.concatenate([truth, unsure])
    scored = np.column_stack([known, [0.9, 0.8, 0.4]]).astype(np.float32)
    scene = LabelledScene(np.zeros((200, 300, 3), np.uint8), scored)
    strange = np.array([[150, 100, 180, 190]], np.float64)
    one_of_them = np.concatenate([truth[:1], strange])
    assert recall_and_extra(lambda _: known, [scene]) == (1.0, 0.0)
    assert recall_and_extra(lambda _: one_of_them, [scene]) == (0.5, 1.0)
    assert recall_and_extra(lambda _: truth[:0], [scene]) == (0.0, 0.0)


def test_a_networks_boxes_are_in_pixels_of_the_photo() -> None:
    class Told(PersonNetwork):
        """One that says the same of any photo."""

        def forward(self, x: Tensor) -> Tensor:
            assert x.shape == (1, 3, SIZE[1], SIZE[0])
            heat, sides, _ = targets([sample(BOXES)], STRIDE)
            return torch.from_numpy(said(heat, sides))

    photo: Image = np.zeros((2 * SIZE[1], 2 * SIZE[0], 3), np.uint8)
    found = finder(Told(PersonConfig()), SIZE, "cpu")(photo)
    assert (iou(found, 2 * BOXES.astype(np.float64)).max(0) > 0.98).all()
