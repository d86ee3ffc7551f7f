"""The Convolutional Pose Machine: a dense residual backbone and stage-wise refinement.

All convolutions are dense (no depthwise ones): on CPUs with bf16 or int8 matrix tiles only those
profit, and elsewhere they cost little more. Every stage emits 14 joint maps and a background map,
each stage reads the beliefs of the one before (Wei et al. 2016), every stage is supervised. Beside
the last one it may be read how deep the joints lie.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

BACKGROUND = 1
COARSEST_STRIDE_PX = 32
"""Of both networks' pyramids: sizes of images are multiples of it."""


@dataclass(frozen=True)
class CpmConfig:
    """Sizes of the network; written into the checkpoint and the model card."""

    n_joints: int = 14
    width: int = 48
    blocks: tuple[int, int, int, int] = (1, 2, 3, 2)
    stage_width: int = 96
    n_stages: int = 3
    depths: bool = False

    def as_dict(self) -> dict[str, object]:
        """Plain values, for JSON."""
        return asdict(self)


def _conv_bn(c_in: int, c_out: int, k: int = 3, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(c_in, c_out, k, stride, k // 2, bias=False), nn.BatchNorm2d(c_out)
    )


class Residual(nn.Module):
    """Two 3x3 convolutions and a shortcut (He et al. 2016), optionally strided."""

    def __init__(self, c_in: int, c_out: int, stride: int = 1) -> None:
        super().__init__()
        self.a = _conv_bn(c_in, c_out, 3, stride)
        self.b = _conv_bn(c_out, c_out)
        nn.init.zeros_(self.b[1].weight)
        self.skip = (
            nn.Identity() if c_in == c_out and stride == 1 else _conv_bn(c_in, c_out, 1, stride)
        )

    def forward(self, x: Tensor) -> Tensor:
        """(B, c_in, h, w) -> (B, c_out, h / stride, w / stride)."""
        y: Tensor = self.b(F.relu(self.a(x)))
        return F.relu(y + self.skip(x))


def _chain(c_in: int, c_out: int, n: int, stride: int) -> nn.Sequential:
    return nn.Sequential(
        Residual(c_in, c_out, stride), *(Residual(c_out, c_out) for _ in range(n - 1))
    )


def _up2(x: Tensor) -> Tensor:
    return F.interpolate(x, scale_factor=2.0, mode="nearest")


class Backbone(nn.Module):
    """Image -> features at stride 4 (``width`` channels) and at stride 8 (``stage_width``).

    A residual pyramid down to stride 32 with a top-down path back to stride 8, so that each cell
    knows the whole body: left and right cannot be told apart locally.
    """

    def __init__(self, cfg: CpmConfig) -> None:
        super().__init__()
        w, s = cfg.width, cfg.stage_width
        n4, n8, n16, n32 = cfg.blocks
        # Space-to-depth first: 48 channels fill the matrix tiles that three never would.
        self.stem = nn.Sequential(nn.PixelUnshuffle(4), _conv_bn(48, w), nn.ReLU())
        self.c4 = _chain(w, w, n4, 1)
        self.c8 = _chain(w, 2 * w, n8, 2)
        self.c16 = _chain(2 * w, 4 * w, n16, 2)
        self.c32 = _chain(4 * w, 4 * w, n32, 2)
        self.t16 = _conv_bn(4 * w, s, 1)
        self.t32 = _conv_bn(4 * w, s, 1)
        self.t8 = _conv_bn(2 * w, s, 1)
        self.m16 = Residual(s, s)
        self.m8 = Residual(s, s)

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """(B, 3, H, W) in [-1, 1] -> ((B, width, H/4, W/4), (B, stage_width, H/8, W/8))."""
        x4 = self.c4(self.stem(image))
        x8 = self.c8(x4)
        x16 = self.c16(x8)
        x32 = self.c32(x16)
        y16 = self.m16(F.relu(self.t16(x16) + _up2(self.t32(x32))))
        return x4, self.m8(F.relu(self.t8(x8) + _up2(y16)))


class Stage(nn.Module):
    """One CPM stage at stride 8: features and the last beliefs -> sharper beliefs.

    The original's stacks of 7x7 convolutions become a small hourglass: the same reach for a
    fraction of the cost.
    """

    def __init__(self, cfg: CpmConfig, first: bool) -> None:
        super().__init__()
        s, out = cfg.stage_width, cfg.n_joints + BACKGROUND
        self.enter = _conv_bn(s if first else s + out, s, 1 if first else 3)
        self.down = Residual(s, s, 2)
        self.low = Residual(s, s)
        self.high = Residual(s, s)
        self.score = nn.Conv2d(s, out, 1)
        nn.init.normal_(self.score.weight, std=0.01)
        nn.init.constant_(self.score.bias, -4.0)

    def forward(self, features: Tensor, logits: Tensor | None) -> tuple[Tensor, Tensor]:
        """-> (hidden features, logits), both at stride 8."""
        x = features
        if logits is not None:
            x = torch.cat([features, torch.sigmoid(logits)], 1)
        x = F.relu(self.enter(x))
        x = self.high(x + _up2(self.low(self.down(x))))
        return x, self.score(x)


class DepthHead(nn.Module):
    """What is seen at all joints -> how deep each of them lies.

    Depths are less the hip midpoint's, over the crop's side. Features are read where the last stage
    believes the joints, and of all of them at once: which leg is the nearer one shows at the hips,
    and at the knee that hides the other. A map of depths read at each joint (Mehta et al. 2017)
    tells less on the same features: docs/experiments.md.
    """

    WIDTHS = (192, 128)
    DROPPED = 0.2

    def __init__(self, cfg: CpmConfig) -> None:
        super().__init__()
        wide, narrow = self.WIDTHS
        inputs = cfg.n_joints * (2 * cfg.stage_width + 2)
        self.norm = nn.BatchNorm1d(inputs, affine=False)
        self.drop = nn.Dropout(self.DROPPED)
        self.a = nn.Linear(inputs, wide)
        self.b = nn.Linear(wide, narrow)
        self.score = nn.Linear(narrow, cfg.n_joints)
        nn.init.zeros_(self.score.weight)
        nn.init.zeros_(self.score.bias)

    def forward(self, features: Tensor, hidden: Tensor, logits: Tensor) -> Tensor:
        """(B, s, h, w) twice and (B, J + 1, h, w) -> (B, J)."""
        read = read_at(torch.cat([features, hidden, places(features)], 1), logits[:, :-1])
        x = F.relu(self.a(self.drop(self.norm(read.flatten(1)))))
        out: Tensor = self.score(F.relu(self.b(x)))
        return out


def places(maps: Tensor) -> Tensor:
    """Where each cell lies, x and y from -1 to 1, of maps (B, C, h, w): (B, 2, h, w)."""
    rows, columns = (torch.linspace(-1, 1, n, device=maps.device) for n in maps.shape[2:])
    grid = torch.stack([columns.expand(len(rows), -1), rows[:, None].expand(-1, len(columns))])
    return grid.to(maps.dtype).expand(len(maps), -1, -1, -1)


def read_at(maps: Tensor, logits: Tensor) -> Tensor:
    """Means of maps (B, C, h, w) by each joint's marginal, of logits (B, J, h, w): (B, J, C)."""
    where = torch.softmax(logits.float().flatten(2), -1)
    return torch.einsum("bjp,bcp->bjc", where, maps.float().flatten(2))


@dataclass(frozen=True)
class Seen:
    """What the network makes of crops: logits per stage, and depths (B, J) if it reads them."""

    stages: list[Tensor]
    depths: Tensor | None


class ConvolutionalPoseMachine(nn.Module):
    """Image crop -> one logit map per joint and one for the background, per stage.

    The stages work at stride 8; the last logits are raised to stride 4 with the backbone's fine
    features for sub-pixel joints.
    """

    ADDED = r"depth\.|backbone\.c\d+\.[1-9]\d*\."
    """Parts that networks may lack which training goes on from: depths are learned anew, and
    further blocks of a pyramid level change nothing until they have learned something."""

    def __init__(self, cfg: CpmConfig) -> None:
        super().__init__()
        self.cfg = cfg
        self.backbone = Backbone(cfg)
        self.stages = nn.ModuleList(Stage(cfg, first=i == 0) for i in range(cfg.n_stages))
        w, out = cfg.width, cfg.n_joints + BACKGROUND
        self.fine_low = _conv_bn(cfg.stage_width, w, 1)
        self.fine = Residual(w, w)
        self.fine_score = nn.Conv2d(w, out, 1)
        nn.init.zeros_(self.fine_score.weight)
        nn.init.zeros_(self.fine_score.bias)
        self.depth = DepthHead(cfg) if cfg.depths else None

    def forward(self, image: Tensor) -> list[Tensor]:
        """(B, 3, H, W) in [-1, 1] -> logits per stage: (B, 15, H/8, W/8) ..., (B, 15, H/4, W/4)."""
        return self.seen(image).stages

    def seen(self, image: Tensor, *, only_depths: bool = False) -> Seen:
        """``forward``, and depths (B, 14); gradients of these alone if so wanted."""
        with torch.set_grad_enabled(torch.is_grad_enabled() and not only_depths):
            stages, features, hidden = self._stages(image)
        if self.depth is None:
            return Seen(stages, None)
        return Seen(stages, self.depth(features, hidden, stages[-2].detach()))

    def _stages(self, image: Tensor) -> tuple[list[Tensor], Tensor, Tensor]:
        x4, features = self.backbone(image)
        logits: Tensor | None = None
        every: list[Tensor] = []
        hidden = features
        for stage in self.stages:
            hidden, logits = stage(features, logits)
            every.append(logits)
        assert logits is not None
        up = F.interpolate(logits, scale_factor=2.0, mode="bilinear", align_corners=False)
        x = self.fine(F.relu(x4 + _up2(self.fine_low(hidden))))
        every.append(up + self.fine_score(x))
        return every, features, hidden


@dataclass(frozen=True)
class PersonConfig:
    """Sizes of the person network."""

    width: int = 32
    blocks: tuple[int, int, int] = (2, 3, 3)

    def as_dict(self) -> dict[str, object]:
        """Plain values, for JSON."""
        return asdict(self)


class PersonNetwork(nn.Module):
    """Whole image -> where people's centres are, and their boxes, at stride 8.

    A centre map and four distances a cell (to the box's left, top, right and bottom), as in
    CenterNet and FCOS, on a residual pyramid down to stride 32.
    """

    STRIDE = 8

    def __init__(self, cfg: PersonConfig) -> None:
        super().__init__()
        self.cfg = cfg
        w = cfg.width
        n8, n16, n32 = cfg.blocks
        self.stem = nn.Sequential(nn.PixelUnshuffle(4), _conv_bn(48, w, 3, 2), nn.ReLU())
        self.c8 = _chain(w, w, n8, 1)
        self.c16 = _chain(w, 2 * w, n16, 2)
        self.c32 = _chain(2 * w, 3 * w, n32, 2)
        self.t32 = _conv_bn(3 * w, 2 * w, 1)
        self.m16 = Residual(2 * w, 2 * w)
        self.t16 = _conv_bn(2 * w, w, 1)
        self.m8 = Residual(w, w)
        self.score = nn.Conv2d(w, 5, 1)
        nn.init.normal_(self.score.weight, std=0.01)
        nn.init.constant_(self.score.bias, 0.0)
        with torch.no_grad():
            assert self.score.bias is not None
            self.score.bias[0] = -4.0

    def forward(self, image: Tensor) -> Tensor:
        """(B, 3, H, W) in [-1, 1] -> (B, 5, H/8, W/8): centre logit, log distances in 32 px."""
        x8 = self.c8(self.stem(image))
        x16 = self.c16(x8)
        y16 = self.m16(F.relu(x16 + _up2(self.t32(self.c32(x16)))))
        out: Tensor = self.score(self.m8(F.relu(x8 + _up2(self.t16(y16)))))
        return out
