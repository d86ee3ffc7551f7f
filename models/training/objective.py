"""The loss: where is each joint (spatial cross-entropy), on which side, and is it there at all."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from library_store.skeleton import LSP14

PRESENCE_WEIGHT = 0.1
EXCHANGE_WEIGHT = 1.5
APART = 0.06
"""Share of the input's side from which on two joints of a pair count as being in two places."""
PAIR_NATS, PERSON_NATS = 4.0, 2.0
"""Log odds of a pair, and mean log odds of a person's pairs, that are as good as decided."""
RIGHT = [j for j, other in enumerate(LSP14.mirror) if j < other]
LEFT = [LSP14.mirror[j] for j in RIGHT]
MIRROR = list(LSP14.mirror)
HALVES = (slice(0, 3), slice(3, 6))
"""Of the pairs: shoulders, elbows, wrists; hips, knees, ankles."""
EVIDENCE_NATS = 2.5
"""Most that the network's own belief counts for or against a label's sides."""
COARSE_SIGMA_CELLS, FINE_SIGMA_CELLS = 0.8, 1.2
"""Blur of the targets at stride 8 and at stride 4, in cells."""


def gaussian_targets(joints_px: Tensor, cells: int, stride: float, sigma_cells: float) -> Tensor:
    """(B, J, 2) pixels -> (B, J, cells, cells) maps with peak value 1."""
    axis = torch.arange(cells, dtype=torch.float32)
    # The centre of cell c lies at pixel (c + 0.5) * stride - 0.5.
    at = (joints_px + 0.5) / stride - 0.5
    gx = torch.exp(-((axis - at[..., :1]) ** 2) / (2 * sigma_cells**2))
    gy = torch.exp(-((axis - at[..., 1:]) ** 2) / (2 * sigma_cells**2))
    return gy[..., :, None] * gx[..., None, :]


def stage_loss(
    logits: Tensor,
    joints_px: Tensor,
    weight: Tensor,
    presence: Tensor,
    size: int,
    sigma: float,
    mislabelled: Tensor,
) -> Tensor:
    """Loss of one stage's (B, 15, h, w) logits.

    The joint maps' softmax over positions is compared with a Gaussian (weighted by trust in the
    label), right with left by it; their sigmoid, and the background's, with the Gaussian itself
    where presence is known. A half ``mislabelled`` (B, 2) with probability q counts by 1 - q as
    labelled and by q with its sides exchanged.
    """
    n_joints = joints_px.shape[1]
    cells = logits.shape[-1]
    logits = logits.float()
    target = gaussian_targets(joints_px, cells, size / cells, sigma)
    marginal = target.flatten(2)
    marginal = marginal / marginal.sum(-1, keepdim=True).clamp_min(1e-6)
    log_p = F.log_softmax(logits[:, :n_joints].flatten(2), -1)
    other_way = torch.zeros_like(weight)
    other_way[:, RIGHT] = other_way[:, LEFT] = mislabelled.repeat_interleave(3, 1)
    where = -(marginal * log_p).sum(-1) * weight * (1 - other_way)
    where = where - (marginal[:, MIRROR] * log_p).sum(-1) * weight[:, MIRROR] * other_way
    where = where.sum() / weight.sum().clamp_min(1.0)
    sides = exchanged(log_p, joints_px, weight, size, mislabelled)

    seen = (presence > 0).float()[..., None, None] * target
    known = (presence >= 0).float()
    belief = F.binary_cross_entropy_with_logits(logits[:, :n_joints], seen, reduction="none")
    belief = (belief.flatten(2).sum(-1) * known).sum() / known.sum().clamp_min(1.0)
    whole = (known.sum(1) == n_joints).float()
    empty = 1 - seen.amax(1)
    background = F.binary_cross_entropy_with_logits(logits[:, n_joints], empty, reduction="none")
    background = (background.flatten(1).sum(-1) * whole).sum() / whole.sum().clamp_min(1.0)
    return where + EXCHANGE_WEIGHT * sides + PRESENCE_WEIGHT * (belief + 0.1 * background)


def pair_odds(log_p: Tensor, joints_px: Tensor, weight: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Of each pair, (B, 6): log odds as labelled against exchanged, and trust in them.

    ``log_p`` (B, J, h w) log marginals; ``joints_px`` and ``weight`` as in :func:`stage_loss`.
    Pairs in one place, or without labels, have no sides: no trust.
    """
    cells = round(log_p.shape[-1] ** 0.5)
    cell = ((joints_px + 0.5) / (size / cells) - 0.5).round().long().clamp(0, cells - 1)
    place = cell[..., 1] * cells + cell[..., 0]

    def at(maps: list[int], places: list[int]) -> Tensor:
        return log_p[:, maps].gather(2, place[:, places, None])[..., 0]

    apart = (joints_px[:, RIGHT] - joints_px[:, LEFT]).norm(dim=-1) > APART * size
    trust = torch.minimum(weight[:, RIGHT], weight[:, LEFT]) * apart
    odds = at(RIGHT, RIGHT) - at(RIGHT, LEFT) + at(LEFT, LEFT) - at(LEFT, RIGHT)
    return odds, trust


def exchanged(
    log_p: Tensor, joints_px: Tensor, weight: Tensor, size: int, mislabelled: Tensor
) -> Tensor:
    """Share of pairs, plus share of people, whose sides are believed the wrong way round.

    From :func:`pair_odds` through a sigmoid: it is bounded, so the few people whose labels are
    exchanged do not outweigh those who are merely undecided. Halves ``mislabelled`` (B, 2) with
    probability q count 1 - 2 q: the other way round where that is surer than not.
    """
    odds, trust = pair_odds(log_p, joints_px, weight, size)
    odds = odds * (1 - 2 * mislabelled.repeat_interleave(3, 1))
    pairs = (torch.sigmoid(-odds / PAIR_NATS) * trust).sum() / trust.sum().clamp_min(1.0)
    mean = (odds * trust).sum(1) / trust.sum(1).clamp_min(0.1)
    several = (trust.sum(1) > 1).float()
    people = (torch.sigmoid(-mean / PERSON_NATS) * several).sum() / several.sum().clamp_min(1.0)
    return pairs + people


def mislabelled_halves(
    log_p: Tensor, joints_px: Tensor, weight: Tensor, size: int, side_doubt: Tensor
) -> Tensor:
    """How probably right and left are exchanged in the labels, (B, 2): upper half, lower half.

    The prior is ``side_doubt`` (B, 2); the evidence is what the network believes, the mean odds of
    a half's pairs: one pair's worth, for the joints of a half are believed together, and at most
    ``EVIDENCE_NATS``, for it may know these very labels by heart. Constant for the gradient, and
    the prior itself where fewer than two pairs are apart.
    """
    odds, trust = pair_odds(log_p.detach(), joints_px, weight, size)
    mean = torch.stack(
        [
            (odds[:, half] * trust[:, half]).sum(1) / trust[:, half].sum(1).clamp_min(0.1)
            for half in HALVES
        ],
        1,
    )
    several = torch.stack([trust[:, half].sum(1) > 1 for half in HALVES], 1)
    mean = mean.clamp(-EVIDENCE_NATS, EVIDENCE_NATS)
    return torch.where(several, torch.sigmoid(torch.logit(side_doubt, 1e-9) - mean), side_doubt)


def total_loss(
    stages: list[Tensor],
    joints_px: Tensor,
    weight: Tensor,
    presence: Tensor,
    side_doubt: Tensor,
    size: int,
) -> Tensor:
    """Mean over the stages (intermediate supervision), the last, finer one counting double.

    The last one's belief tells which labels have their sides exchanged, where ``side_doubt`` (B, 2)
    allows for it.
    """
    log_p = F.log_softmax(stages[-1][:, : joints_px.shape[1]].detach().float().flatten(2), -1)
    wrong = mislabelled_halves(log_p, joints_px, weight, size, side_doubt)
    sigmas = [COARSE_SIGMA_CELLS] * (len(stages) - 1) + [FINE_SIGMA_CELLS]
    terms = [
        stage_loss(logits, joints_px, weight, presence, size, sigma, wrong)
        for logits, sigma in zip(stages, sigmas, strict=True)
    ]
    return torch.stack([*terms, terms[-1]]).mean()
