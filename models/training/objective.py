"""The loss: where is each joint, on which side, is it there at all, and how deep does it lie."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from library_store.skeleton import LSP14

PRESENCE_WEIGHT = 0.1
DEPTH_WEIGHT = 10.0
EXCHANGE_WEIGHT = 1.5
APART = 0.06
"""Share of the input's side from which on two joints of a pair count as being in two places."""
PAIR_NATS, PERSON_NATS = 4.0, 2.0
"""Log odds of a pair, and mean log odds of a person's pairs, that are as good as decided."""
RIGHT = [j for j, other in enumerate(LSP14.mirror) if j < other]
LEFT = [LSP14.mirror[j] for j in RIGHT]
COARSE_SIGMA_CELLS, FINE_SIGMA_CELLS = 0.8, 1.2
"""Blur of the targets at stride 8 and at stride 4, in cells."""


def gaussian_targets(joints_px: Tensor, cells: int, stride: float, sigma_cells: float) -> Tensor:
    """(B, J, 2) pixels -> (B, J, cells, cells) maps with peak value 1."""
    axis = torch.arange(cells, dtype=torch.float32, device=joints_px.device)
    # The centre of cell c lies at pixel (c + 0.5) * stride - 0.5.
    at = (joints_px + 0.5) / stride - 0.5
    gx = torch.exp(-((axis - at[..., :1]) ** 2) / (2 * sigma_cells**2))
    gy = torch.exp(-((axis - at[..., 1:]) ** 2) / (2 * sigma_cells**2))
    return gy[..., :, None] * gx[..., None, :]


def stage_loss(
    logits: Tensor, joints_px: Tensor, weight: Tensor, presence: Tensor, size: int, sigma: float
) -> Tensor:
    """Loss of one stage's (B, 15, h, w) logits.

    The joint maps' softmax over positions is compared with a Gaussian (weighted by trust in the
    label), right with left by it; their sigmoid, and the background's, with the Gaussian itself
    where presence is known.
    """
    n_joints = joints_px.shape[1]
    cells = logits.shape[-1]
    logits = logits.float()
    target = gaussian_targets(joints_px, cells, size / cells, sigma)
    marginal = target.flatten(2)
    marginal = marginal / marginal.sum(-1, keepdim=True).clamp_min(1e-6)
    log_p = F.log_softmax(logits[:, :n_joints].flatten(2), -1)
    where = -(marginal * log_p).sum(-1)
    where = (where * weight).sum() / weight.sum().clamp_min(1.0)
    sides = exchanged(log_p, joints_px, weight, size)

    seen = (presence > 0).float()[..., None, None] * target
    known = (presence >= 0).float()
    belief = F.binary_cross_entropy_with_logits(logits[:, :n_joints], seen, reduction="none")
    belief = (belief.flatten(2).sum(-1) * known).sum() / known.sum().clamp_min(1.0)
    whole = (known.sum(1) == n_joints).float()
    empty = 1 - seen.amax(1)
    background = F.binary_cross_entropy_with_logits(logits[:, n_joints], empty, reduction="none")
    background = (background.flatten(1).sum(-1) * whole).sum() / whole.sum().clamp_min(1.0)
    return where + EXCHANGE_WEIGHT * sides + PRESENCE_WEIGHT * (belief + 0.1 * background)


def exchanged(log_p: Tensor, joints_px: Tensor, weight: Tensor, size: int) -> Tensor:
    """Share of pairs, plus share of people, whose sides are believed the wrong way round.

    ``log_p`` (B, J, h w) log marginals; ``joints_px`` and ``weight`` as in :func:`stage_loss`. From
    the log odds of a pair as labelled against exchanged, through a sigmoid: it is bounded, so the
    few people whose labels are exchanged do not outweigh those who are merely undecided.
    """
    cells = round(log_p.shape[-1] ** 0.5)
    cell = ((joints_px + 0.5) / (size / cells) - 0.5).round().long().clamp(0, cells - 1)
    place = cell[..., 1] * cells + cell[..., 0]

    def at(maps: list[int], places: list[int]) -> Tensor:
        return log_p[:, maps].gather(2, place[:, places, None])[..., 0]

    apart = (joints_px[:, RIGHT] - joints_px[:, LEFT]).norm(dim=-1) > APART * size
    trust = torch.minimum(weight[:, RIGHT], weight[:, LEFT]) * apart
    odds = at(RIGHT, RIGHT) - at(RIGHT, LEFT) + at(LEFT, LEFT) - at(LEFT, RIGHT)
    pairs = (torch.sigmoid(-odds / PAIR_NATS) * trust).sum() / trust.sum().clamp_min(1.0)
    mean = (odds * trust).sum(1) / trust.sum(1).clamp_min(0.1)
    several = (trust.sum(1) > 1).float()
    people = (torch.sigmoid(-mean / PERSON_NATS) * several).sum() / several.sum().clamp_min(1.0)
    return pairs + people


def total_loss(
    stages: list[Tensor], joints_px: Tensor, weight: Tensor, presence: Tensor, size: int
) -> Tensor:
    """Mean over the stages (intermediate supervision), the last, finer one counting double."""
    terms = [
        stage_loss(logits, joints_px, weight, presence, size, COARSE_SIGMA_CELLS)
        for logits in stages[:-1]
    ]
    terms += [stage_loss(stages[-1], joints_px, weight, presence, size, FINE_SIGMA_CELLS)] * 2
    return torch.stack(terms).mean()


def depth_loss(found: Tensor, depths: Tensor, weight: Tensor) -> Tensor:
    """Mean distance of depths (B, J), over the crop's side, from the true ones, nan where unknown.

    ``weight`` (B, J) is the trust in the joints' labels.
    """
    trust = weight * torch.isfinite(depths)
    distance = (found.float() - torch.nan_to_num(depths)).abs() * trust
    return DEPTH_WEIGHT * distance.sum() / trust.sum().clamp_min(1.0)
