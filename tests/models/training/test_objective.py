"""The loss: confusing right and left costs, and never without bound."""

from __future__ import annotations

import pytest

torch = pytest.importorskip("torch")

from torch import Tensor  # noqa: E402

from library_store.skeleton import LSP14  # noqa: E402
from models.training.network import ConvolutionalPoseMachine, CpmConfig  # noqa: E402
from models.training.objective import (  # noqa: E402
    DEPTH_WEIGHT,
    LEFT,
    RIGHT,
    depth_loss,
    exchanged,
    gaussian_targets,
    total_loss,
)

SIZE, CELLS = 64, 16


def people(count: int) -> tuple[Tensor, Tensor]:
    """Joints somewhere in the crop, the two of a pair far apart, and full trust in them."""
    joints = 4 + 56 * torch.rand(count, 14, 2, generator=torch.Generator().manual_seed(2))
    joints[:, RIGHT, 0] = 10.0
    joints[:, LEFT, 0] = 50.0
    return joints, torch.ones(count, 14)


def logits_at(joints: Tensor) -> Tensor:
    """(B, 14, cells, cells) of a network that is sure of these joints."""
    return 12 * gaussian_targets(joints, CELLS, SIZE / CELLS, 1.0)


def log_marginals(logits: Tensor) -> Tensor:
    return torch.log_softmax(logits.flatten(2), -1)


def test_pairs_are_right_and_left() -> None:
    for right, left in zip(RIGHT, LEFT, strict=True):
        assert LSP14.joint_names[right] == LSP14.joint_names[left].replace("l_", "r_")
    assert len(RIGHT) == 6


def test_exchanged_sides_cost_most_and_no_more_than_two() -> None:
    joints, trust = people(5)
    mirrored = joints[:, list(LSP14.mirror)]
    right = exchanged(log_marginals(logits_at(joints)), joints, trust, SIZE)
    wrong = exchanged(log_marginals(logits_at(mirrored)), joints, trust, SIZE)
    surer = exchanged(log_marginals(9 * logits_at(mirrored)), joints, trust, SIZE)
    undecided = exchanged(log_marginals(0 * logits_at(joints)), joints, trust, SIZE)
    assert right < 0.1
    assert undecided == pytest.approx(1.0)
    assert 1.9 < wrong <= surer <= 2.0


def test_the_loss_is_reckoned_where_the_network_lies() -> None:
    """On a device without values, which refuses to mix with the CPU as GPUs do."""
    network = ConvolutionalPoseMachine(
        CpmConfig(width=8, blocks=(1, 1, 1, 1), stage_width=8, n_stages=2, depths=True)
    ).to("meta")
    joints, trust = (part.to("meta") for part in people(2))
    seen = network.seen(torch.zeros(2, 3, SIZE, SIZE, device="meta"))
    assert seen.depths is not None
    loss = total_loss(seen.stages, joints, trust, trust, SIZE)
    (loss + depth_loss(seen.depths, trust, trust)).backward()
    assert loss.device.type == "meta"


def test_pairs_without_labels_or_in_one_place_have_no_sides() -> None:
    joints, trust = people(3)
    wrong = log_marginals(logits_at(joints[:, list(LSP14.mirror)]))
    assert exchanged(wrong, joints, 0 * trust, SIZE) == 0
    together = joints.clone()
    together[:, LEFT] = together[:, RIGHT] + 1
    assert exchanged(wrong, together, trust, SIZE) == 0


def test_the_whole_loss_falls_from_exchanged_to_right_and_has_gradients() -> None:
    joints, trust = people(4)
    background = torch.zeros(4, 1, CELLS, CELLS)
    losses = []
    for places in (joints[:, list(LSP14.mirror)], joints):
        logits = torch.cat([logits_at(places), background], 1).requires_grad_()
        loss = total_loss([logits, logits], joints, trust, trust, SIZE)
        loss.backward()
        assert logits.grad is not None
        assert torch.isfinite(logits.grad).all()
        losses.append(float(loss.detach()))
    assert losses[1] < losses[0] - 1


def test_unknown_depths_cost_nothing() -> None:
    depths = torch.linspace(-0.3, 0.3, 14).repeat(3, 1)
    trust = torch.ones_like(depths)
    found = (depths + 0.1).requires_grad_()
    depths[:, 4] = torch.nan
    loss = depth_loss(found, depths, trust)
    assert loss.item() == pytest.approx(0.1 * DEPTH_WEIGHT)
    assert depth_loss(found, depths, 0 * trust) == 0
    loss.backward()
    assert found.grad is not None
    assert torch.isfinite(found.grad).all()
    assert not found.grad[:, 4].any()
