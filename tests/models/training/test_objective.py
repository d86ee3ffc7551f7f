"""The loss: confusing right and left costs, never without bound, and not against all evidence."""

from __future__ import annotations

import pytest

torch = pytest.importorskip("torch")

from torch import Tensor  # noqa: E402

from library_store.skeleton import LSP14  # noqa: E402
from models.training.objective import (  # noqa: E402
    LEFT,
    RIGHT,
    exchanged,
    gaussian_targets,
    mislabelled_halves,
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


def sure(joints: Tensor, doubt: float = 0.0) -> Tensor:
    """The same doubt about the sides of everybody's both halves."""
    return torch.full((len(joints), 2), doubt)


def test_pairs_are_right_and_left() -> None:
    for right, left in zip(RIGHT, LEFT, strict=True):
        assert LSP14.joint_names[right] == LSP14.joint_names[left].replace("l_", "r_")
    assert len(RIGHT) == 6


def test_exchanged_sides_cost_most_and_no_more_than_two() -> None:
    joints, trust = people(5)
    mirrored = joints[:, list(LSP14.mirror)]
    right = exchanged(log_marginals(logits_at(joints)), joints, trust, SIZE, sure(joints))
    wrong = exchanged(log_marginals(logits_at(mirrored)), joints, trust, SIZE, sure(joints))
    surer = exchanged(log_marginals(9 * logits_at(mirrored)), joints, trust, SIZE, sure(joints))
    undecided = exchanged(log_marginals(0 * logits_at(joints)), joints, trust, SIZE, sure(joints))
    assert right < 0.1
    assert undecided == pytest.approx(1.0)
    assert 1.9 < wrong <= surer <= 2.0


def test_pairs_without_labels_or_in_one_place_have_no_sides() -> None:
    joints, trust = people(3)
    wrong = log_marginals(logits_at(joints[:, list(LSP14.mirror)]))
    assert exchanged(wrong, joints, 0 * trust, SIZE, sure(joints)) == 0
    together = joints.clone()
    together[:, LEFT] = together[:, RIGHT] + 1
    assert exchanged(wrong, together, trust, SIZE, sure(joints)) == 0


def test_the_whole_loss_falls_from_exchanged_to_right_and_has_gradients() -> None:
    joints, trust = people(4)
    background = torch.zeros(4, 1, CELLS, CELLS)
    losses = []
    for places in (joints[:, list(LSP14.mirror)], joints):
        logits = torch.cat([logits_at(places), background], 1).requires_grad_()
        loss = total_loss([logits, logits], joints, trust, trust, sure(joints), SIZE)
        loss.backward()
        assert logits.grad is not None
        assert torch.isfinite(logits.grad).all()
        losses.append(float(loss.detach()))
    assert losses[1] < losses[0] - 1


def test_labels_count_as_exchanged_where_the_network_sees_them_so_and_doubt_allows() -> None:
    joints, trust = people(3)
    seen = log_marginals(logits_at(joints))
    mirrored = log_marginals(logits_at(joints[:, list(LSP14.mirror)]))

    def wrong(log_p: Tensor, doubt: float) -> Tensor:
        return mislabelled_halves(log_p, joints, trust, SIZE, sure(joints, doubt))

    assert (wrong(seen, 0.06) < 0.01).all()
    assert (wrong(mirrored, 0.4) > 0.85).all()
    assert (wrong(mirrored, 0.01) < 0.2).all()  # its own belief alone does not turn labels
    assert (wrong(mirrored, 0.0) < 1e-6).all()
    torch.testing.assert_close(
        mislabelled_halves(mirrored, joints, 0 * trust, SIZE, sure(joints, 0.4)), sure(joints, 0.4)
    )


def test_one_half_is_judged_apart_from_the_other() -> None:
    joints, trust = people(3)
    seen = joints.clone()
    lower = [8, 9, 10, 11, 12, 13]
    seen[:, lower] = joints[:, [LSP14.mirror[j] for j in lower]]
    halves = mislabelled_halves(
        log_marginals(logits_at(seen)), joints, trust, SIZE, sure(joints, 0.3)
    )
    assert (halves[:, 0] < 0.1).all()
    assert (halves[:, 1] > 0.8).all()


def test_exchanged_sides_of_doubted_labels_cost_less() -> None:
    joints, trust = people(4)
    places = logits_at(joints[:, list(LSP14.mirror)])
    logits = torch.cat([places, torch.zeros(4, 1, CELLS, CELLS)], 1)

    def loss(doubt: float) -> float:
        return float(total_loss([logits, logits], joints, trust, trust, sure(joints, doubt), SIZE))

    assert loss(0.75) < loss(0.4) < loss(0.02) < loss(0.0)
