"""The learned lifter in torch, and as an ONNX graph: a residual MLP from 2D joints to a pose.

After Martinez et al. (ICCV 2017), with 14 joints, a mask of missing ones, the doubt in each of the
others (how probably it is elsewhere, 0 for exact ones and for missing ones), RMS norm in place of
batch norm, and everything in units that hold at any size and distance: ``c`` and ``r`` are the mean
and the RMS radius of the present joints in normalised image coordinates.

    f = ((x - c) / r, present, log r, doubt);
    h₀ = relu(W f);   h ← h + V relu(U h / rms(h)) per block

Where the pose network reads depths off the picture, its hints ``z / z_root - 1`` are features too,
in units of r, with a mask of the joints it gives any for:

    f = (…, hint / r, known)

Of the last layer: where the joints really are in the image, as a correction in units of r; depths
about the root's, ``z / z_root - 1``, in units of r; the logarithm of the body's radius in mm,
``log(r z_root)``; and the logarithms of the standard deviations of all these, one for both image
coordinates of a joint. The radius is learned beside the rest and not exported: how large people
are, the library says.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from onnx import numpy_helper
from torch import Tensor, nn
from torch.nn import functional

from library_store.skeleton import L_HIP, LSP14, R_HIP
from models.errors import ModelError
from models.training.onnx_graph import HALF, PREFIX, GraphWriter

N = LSP14.n_joints
_MIRROR = np.array(LSP14.mirror)
LOG_RADIUS = -2.0
"""About the logarithm of a person's radius in normalised image coordinates."""
LOG_SIZE = 5.75
"""About that of a person's radius in mm."""
_RMS_FLOOR = 1e-4
_TINY = 1e-12
_BYTES, _SCALE = ".bytes", ".scale"
"""How the parts of a weight in 8 bits are called."""
_WEIGHT_LEVELS = 63
"""Of 8-bit weights to either side of 0: with 7 bits no CPU's 16-bit sums of products overflow."""
N_FEATURES = 4 * N + 1
N_FEATURES_WITH_DEPTHS = N_FEATURES + 2 * N
_IMAGE, _DEPTH = slice(0, 2 * N), slice(2 * N, 3 * N)
_SIZE = 3 * N
_ACROSS, _ALONG = slice(3 * N + 1, 4 * N + 1), slice(4 * N + 1, 5 * N + 1)
_SIZE_SIGMA = 5 * N + 1


class PoseMlp(nn.Module):
    """Features (N, 85) -> the last layer (N, 72), float32; see the module.

    One that reads no depths takes the first 57 of them and looks at no others.
    """

    def __init__(self, width: int = 512, n_blocks: int = 3, *, reads_depths: bool = False) -> None:
        super().__init__()
        self.first = nn.Linear(N_FEATURES_WITH_DEPTHS if reads_depths else N_FEATURES, width)
        self.blocks = nn.ModuleList(
            nn.ModuleList((nn.Linear(width, width), nn.Linear(width, width)))
            for _ in range(n_blocks)
        )
        self.last = nn.Linear(width, 5 * N + 2)
        with torch.no_grad():
            for layer in (self.first, *(block[0] for block in self.blocks)):
                nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
                nn.init.zeros_(layer.bias)
            for block in self.blocks:
                block[1].weight.mul_(0.1)
                nn.init.zeros_(block[1].bias)
            self.first.weight[:, 3 * N + 1 :] = 0.0  # doubt and hints are heeded once learned
            nn.init.zeros_(self.last.weight)
            nn.init.zeros_(self.last.bias)
            self.last.bias[_SIZE + 1 :] = -2.0

    @property
    def reads_depths(self) -> bool:
        """Whether it takes depths that a pose network read off the picture."""
        return self.first.in_features == N_FEATURES_WITH_DEPTHS

    def forward(self, features: Tensor) -> Tensor:
        """The last layer is computed in single precision whatever the rest is computed in."""
        hidden = torch.relu(self.first(features[:, : self.first.in_features]))
        for block in self.blocks:
            hidden = hidden + block[1](torch.relu(block[0](_unit(hidden))))
        with torch.autocast(hidden.device.type, enabled=False):
            return functional.linear(_unit(hidden.float()), self.last.weight, self.last.bias)


def _unit(hidden: Tensor) -> Tensor:
    return hidden * torch.rsqrt((hidden * hidden).mean(1, keepdim=True) + _RMS_FLOOR)


def with_depths(network: PoseMlp) -> PoseMlp:
    """The network widened, if need be, to read depths: to start with it does not heed them."""
    if network.reads_depths:
        return network
    wider = PoseMlp(network.first.out_features, len(network.blocks), reads_depths=True)
    parts = network.state_dict()
    weight = parts["first.weight"]
    parts["first.weight"] = functional.pad(weight, (0, N_FEATURES_WITH_DEPTHS - N_FEATURES))
    wider.load_state_dict(parts)
    return wider


def normalised(
    points: Tensor, present: Tensor, doubt: Tensor, hint: Tensor, known: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Features (N, 85), c (N, 1, 2), r (N, 1, 1).

    Of points (N, 14, 2), their mask, the doubt in them, hints of their depths and the mask of
    these, each (N, 14). What is not known, or of joints that are missing, counts as 0.
    """
    shares = (present / present.sum(1, keepdim=True))[..., None]
    centre = (shares * points).sum(1, keepdim=True)
    centred = (points - centre) * present[..., None]
    radius = torch.sqrt((shares * centred**2).sum((1, 2), keepdim=True) + _TINY)
    shape = (centred / radius).flatten(1)
    log_radius = radius.log()[:, 0] - LOG_RADIUS
    known = known * present
    depth = hint * known / radius[:, 0]
    return torch.cat([shape, present, log_radius, doubt, depth, known], 1), centre, radius


@dataclass(frozen=True)
class Last:
    """The last layer by what it says, see the module; (N, 14, 2), (N, 14) or (N,)."""

    image: Tensor
    depths: Tensor
    log_size: Tensor
    log_across: Tensor
    log_along: Tensor
    log_size_sigma: Tensor


def read_last(last: Tensor) -> Last:
    """(N, 72) taken apart; the logarithms of deviations within reason."""
    return Last(
        last[:, _IMAGE].view(-1, N, 2),
        last[:, _DEPTH],
        last[:, _SIZE],
        last[:, _ACROSS].clamp(-7, 2),
        last[:, _ALONG].clamp(-7, 2),
        last[:, _SIZE_SIGMA].clamp(-7, 2),
    )


def losses(last: Tensor, image: Tensor, depths: Tensor, log_size: Tensor) -> tuple[Tensor, Tensor]:
    """Mean distance of joints and sizes from the truth, and how badly the errors were foretold.

    The second is the Gaussian negative log likelihood with the errors held fixed: unsure joints
    are no less learned.

    Args:
        last: (N, 72).
        image: (N, 14, 2) the true corrections.
        depths: (N, 14) the true depths, both in units of r.
        log_size: (N,) the true logarithm, less ``LOG_SIZE``.

    """
    said = read_last(last)
    across2 = ((said.image - image) ** 2).sum(-1)
    along2 = (said.depths - depths) ** 2
    size2 = (said.log_size - log_size) ** 2
    distance = torch.sqrt(across2 + along2 + 1e-5).mean() + 0.2 * torch.sqrt(size2 + 1e-5).mean()
    across, along, size = said.log_across, said.log_along, said.log_size_sigma
    surprise = (0.5 * across2.detach() * torch.exp(-2 * across) + 2 * across).mean()
    surprise = surprise + (0.5 * along2.detach() * torch.exp(-2 * along) + along).mean()
    foretold = 0.5 * size2.detach() * torch.exp(-2 * size) + size
    return distance, surprise + 0.1 * foretold.mean()


def read_network(path: Path) -> PoseMlp:
    """The network that ``lifter_model`` wrote, to go on from; hidden weights as they were rounded.

    With depths or without, as it was. Raises ``ModelError`` for any other file.
    """
    try:
        stored = {
            i.name.removeprefix(PREFIX).removesuffix(HALF): numpy_helper.to_array(i)
            for i in onnx.load(path).graph.initializer
            if i.name.startswith(PREFIX)
        }
        for name in [name for name in stored if name.endswith(_BYTES)]:
            whole = name.removesuffix(_BYTES)
            stored[whole] = (stored.pop(name) * stored.pop(whole + _SCALE)).T
        width, n_features = stored["first.weight"].shape
        n_blocks = sum(".0.bias" in name for name in stored)
        network = PoseMlp(width, n_blocks, reads_depths=n_features > N_FEATURES)
        parts = {name: torch.tensor(value.astype(np.float32)) for name, value in stored.items()}
        network.load_state_dict(parts)
    except Exception as error:  # a reader of foreign bytes fails in every way
        raise ModelError(f"{path} cannot be read as a lifter: {error}") from error
    return network


def lifter_model(network: PoseMlp, moments: NDArray[np.float64]) -> onnx.ModelProto:
    """The network as ``models.pose_lifter`` runs it.

    Joints (n, 14, 3), x and y in normalised image coordinates and how probably they are right (0
    for missing ones), to (n, 43, 42): a state (x, y of each joint, then the depths) and the
    covariance of its errors. Of a network that reads depths, joints (n, 14, 5): then come the depth
    read off the picture, ``z / z_root - 1``, and 1 where it is known, 0 where not.
    Each person is seen in a mirror too and the two answers averaged, so that left and right are
    the same to it.

    Args:
        network: the trained network.
        moments: (42, 42) second moments of the errors in units of the foretold deviations.

    """
    w = _Writer(network)
    n_given = 5 if network.reads_depths else 3
    sides = np.array([-1, 1, 1, 1, 1][:n_given], np.float32)
    flipped = w.node("Gather", "joints", w.constant(_MIRROR), axis=1)
    flipped = w.node("Mul", flipped, w.constant(sides))
    seen = _normalised(w, w.node("Concat", "joints", flipped, axis=0))
    last = _last_layer(w, w.node("Concat", *seen.features, axis=1))
    state, sigma = _in_image(w, seen, last)
    columns = w.node("Reshape", sigma, w.shape(-1, 3 * N, 1))
    rows = w.node("Reshape", sigma, w.shape(-1, 1, 3 * N))
    covariance = w.node("Mul", columns, w.constant(moments.astype(np.float32)))
    covariance = w.node("Mul", covariance, rows)
    state = w.node("Reshape", state, w.shape(-1, 1, 3 * N))
    return w.model(
        w.node("Concat", state, covariance, axis=1),
        ("n", N, n_given),
        ("n", 1 + 3 * N, 3 * N),
        kind=onnx.TensorProto.FLOAT,
        names=("joints", "answer"),
    )


class _Writer(GraphWriter):
    """A graph about people and, after them, the same people in a mirror."""

    network: PoseMlp

    def number(self, value: float) -> str:
        """A constant."""
        return self.constant(np.array(value, np.float32))

    def sum_over(self, value: str, *axes: int) -> str:
        """The sum over some axes, which stay."""
        return self.node("ReduceSum", value, self.shape(*axes), keepdims=1)

    def cut(self, value: str, part: slice, axis: int) -> str:
        """Part of a value along one axis."""
        begin, end = self.shape(part.start), self.shape(part.stop)
        return self.node("Slice", value, begin, end, self.shape(axis))

    def halves(self, value: str) -> tuple[str, str]:
        """Of the people, and of them in the mirror."""
        first = self.node("Shape", "joints", start=0, end=1)
        second = self.node("Add", first, first)
        zero, axis = self.shape(0), self.shape(0)
        return (
            self.node("Slice", value, zero, first, axis),
            self.node("Slice", value, first, second, axis),
        )

    def mean_of(self, value: str, order: NDArray[np.int64], signs: NDArray[np.float32]) -> str:
        """The mean of both, the mirror's columns put in ``order`` and given ``signs``."""
        plain, mirrored = self.halves(value)
        back = self.node("Gather", mirrored, self.constant(order), axis=1)
        back = self.node("Mul", back, self.constant(signs))
        return self.node("Mul", self.node("Add", plain, back), self.number(0.5))

    def linear(self, value: str, module: nn.Linear) -> str:
        """A layer."""
        weight, bias = self.parameter(module, "weight"), self.parameter(module, "bias")
        return self.node("Gemm", value, weight, bias, transB=1)

    def linear_in_8_bits(self, value: str, module: nn.Linear) -> str:
        """Weights a byte each: reading them is what a single person costs."""
        weight = module.weight.detach().numpy().T
        scale = np.abs(weight).max(0) / _WEIGHT_LEVELS
        rounded = np.round(weight / scale).astype(np.int8)
        parts = [f"{value}_{part}" for part in ("bytes", "scale", "zero")]
        self.nodes("DynamicQuantizeLinear", [value], parts)
        stored = PREFIX + self.name_of(module) + ".weight"
        weights = self.constant(rounded, stored + _BYTES)
        product = self.node("MatMulInteger", parts[0], weights, parts[2])
        product = self.node("Cast", product, to=onnx.TensorProto.FLOAT)
        scales = self.constant(scale.astype(np.float32), stored + _SCALE)
        scale_of = self.node("Mul", parts[1], scales)
        product = self.node("Mul", product, scale_of)
        return self.node("Add", product, self.parameter(module, "bias"))

    def unit(self, value: str) -> str:
        """``_unit``."""
        square = self.node("ReduceMean", self.node("Mul", value, value), axes=[1], keepdims=1)
        floored = self.node("Add", square, self.number(_RMS_FLOOR))
        return self.node("Div", value, self.node("Sqrt", floored))


@dataclass(frozen=True)
class _Seen:
    """Names of what ``normalised`` makes: ``features``' parts, c (2n, 1, 2) and r (2n, 1)."""

    features: tuple[str, ...]
    centre: str
    radius: str


def _normalised(w: _Writer, both: str) -> _Seen:
    """``normalised``, of joints (2n, 14, 3 or 5)."""
    points, belief = w.cut(both, slice(0, 2), 2), w.cut(both, slice(2, 3), 2)
    present = w.node("Cast", w.node("Greater", belief, w.number(0.0)), to=onnx.TensorProto.FLOAT)
    shares = w.node("Div", present, w.sum_over(present, 1))
    centre = w.sum_over(w.node("Mul", shares, points), 1)
    centred = w.node("Mul", w.node("Sub", points, centre), present)
    square = w.node("Mul", w.node("Mul", shares, centred), centred)
    radius = w.node("Sqrt", w.node("Add", w.sum_over(square, 1, 2), w.number(_TINY)))
    shape = w.node("Reshape", w.node("Div", centred, radius), w.shape(-1, 2 * N))
    mask = w.node("Reshape", present, w.shape(-1, N))
    doubt = w.node("Reshape", w.node("Sub", present, belief), w.shape(-1, N))
    flat_radius = w.node("Reshape", radius, w.shape(-1, 1))
    log_radius = w.node("Sub", w.node("Log", flat_radius), w.number(LOG_RADIUS))
    parts = [shape, mask, log_radius, doubt]
    if w.network.reads_depths:
        known = w.node("Mul", w.cut(both, slice(4, 5), 2), present)
        hint = w.node("Div", w.node("Mul", w.cut(both, slice(3, 4), 2), known), radius)
        parts += [w.node("Reshape", part, w.shape(-1, N)) for part in (hint, known)]
    return _Seen(tuple(parts), centre, flat_radius)


def _last_layer(w: _Writer, features: str) -> str:
    """``PoseMlp.forward``, its blocks in 8 bits."""
    hidden = w.node("Relu", w.linear(features, w.network.first))
    for inner, outer in w.network.blocks:  # type: ignore[misc]
        step = w.node("Relu", w.linear_in_8_bits(w.unit(hidden), inner))
        step = w.linear_in_8_bits(step, outer)
        hidden = w.node("Add", hidden, step)
    return w.linear(w.unit(hidden), w.network.last)


def _in_image(w: _Writer, seen: _Seen, last: str) -> tuple[str, str]:
    """States (n, 42) in normalised image coordinates and relative depths, and their deviations."""
    image = w.node("Add", seen.features[0], w.cut(last, _IMAGE, 1))
    depth = w.cut(last, _DEPTH, 1)
    across = w.cut(last, _ACROSS, 1)
    twice = w.node("Gather", across, w.constant(np.repeat(np.arange(N), 2)), axis=1)
    log_sigma = w.node("Concat", twice, w.cut(last, _ALONG, 1), axis=1)
    order = np.concatenate([(2 * _MIRROR[:, None] + [0, 1]).ravel(), 2 * N + _MIRROR])
    signs = np.concatenate([np.tile([-1.0, 1.0], N), np.ones(N)]).astype(np.float32)
    state = w.mean_of(w.node("Concat", image, depth, axis=1), order, signs)
    log_sigma = w.mean_of(log_sigma, order, np.ones(3 * N, np.float32))

    # From the root: depths about the mean of the hips' own.
    about_root = np.eye(3 * N, dtype=np.float32)
    about_root[2 * N + np.array([R_HIP, L_HIP]), 2 * N :] -= 0.5
    state = w.node("MatMul", state, w.constant(about_root))
    scale, _ = w.halves(seen.radius)
    origin = w.node("Reshape", w.halves(seen.centre)[0], w.shape(-1, 2))
    origin = w.node("Gather", origin, w.constant(np.tile([0, 1], N)), axis=1)
    origin = w.node("Pad", origin, w.shape(0, 0, 0, N))
    state = w.node("Add", w.node("Mul", state, scale), origin)
    return state, w.node("Mul", w.node("Exp", log_sigma), scale)
