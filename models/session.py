"""A network and its card, checked against each other at start, run by the provider that was found.

Whatever is wrong with the files, or with a provider somebody asked for, is a ``ModelError`` that
says which and how to mend it; nothing is left for the first request to find out.
"""

from __future__ import annotations

import logging
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from models.card import (
    DetectorOutput,
    LiftOutput,
    ModelCard,
    PoseOutput,
    read_card,
    read_weights,
)
from models.errors import ModelError
from models.looks import Images, Seen
from models.providers import (
    ProviderChoice,
    Runtime,
    cpu_features,
    open_session,
    present_providers,
    runtime_of,
)

logger = logging.getLogger("posematch.models")

_PREFIX = re.compile(
    r"^(\[ONNXRuntimeError\] : \d+ : \w+ : )?(/\S+\.(h|cc|cpp):\d+ .*?\) (?=[A-Z]))?"
)
MEND = "restore the file and its card, or make both with 'posematch model export'"
PROBE_PX = (64, 96)
"""Height and width that a network for photos of any size is tried with."""


class OnnxModel:
    """A weights file and its card, ready to run. Safe to call from several threads.

    ``provider`` auto tries those present, the fastest first, and says so in the log when one of
    them fails; any other is used or refused. A run uses one thread; ``concurrency`` is how many
    are made side by side.
    """

    def __init__(
        self,
        directory: Path,
        name: str,
        *,
        provider: ProviderChoice = "auto",
        concurrency: int = 1,
    ) -> None:
        self.card: ModelCard = read_card(directory / f"{name}.json")
        self._path = directory / self.card.file
        weights = read_weights(self._path, self.card)
        candidates = runtimes(self.card, provider)
        probe = _probe(self.card)
        for runtime in candidates:
            try:
                session = open_session(weights, runtime, concurrency=concurrency)
                if runtime.provider != "cpu":  # a GPU too old or too full fails when it first runs
                    session.run(None, {session.get_inputs()[0].name: probe.batch})
            except Exception as error:
                if runtime.provider == "cpu":
                    raise self._error(
                        f"no ONNX model that onnxruntime {ort.__version__} can run ({_said(error)})"
                    ) from error
                if runtime is candidates[-1]:
                    raise ModelError(
                        f"POSEMATCH_PROVIDER={provider}: {runtime.provider} cannot run model "
                        f"{name} here ({_said(error)}); mend its drivers, or choose another"
                    ) from error
                logger.warning(
                    "provider %s cannot run model %s: %s", runtime.provider, name, _said(error)
                )
            else:
                self._session, self.runtime = session, runtime
                break
        self._check(probe)

    def run(self, batch: NDArray[Any]) -> NDArray[np.float32]:
        """What the network makes of a batch, float32.

        Of (N, H, W, 3) uint8 BGR its maps (N, C, h, w); of joints (N, 14, 3 or 5), see
        ``models.pose_lifter``, their answer (N, rows, columns).
        """
        answer: NDArray[np.float32] = self._session.run([self._outputs[0]], {self._input: batch})[0]
        return answer

    def see(self, crops: Images) -> Seen:
        """What a pose network makes of crops (N, S, S, 3) uint8 BGR."""
        return Seen(*self._session.run(self._outputs, {self._input: crops}))

    def warm_up(self, batch: NDArray[Any]) -> None:
        """Run a batch before any photo does; ``ModelError`` if it is too much, for a GPU's memory.

        Who asks for it knows how large the largest may be.
        """
        try:
            self.run(batch)
        except Exception as error:
            n, height, width, _ = batch.shape
            raise ModelError(
                f"model {self.card.name} runs on {self.runtime.provider}, but not on {n} images of "
                f"{width}x{height} px at once ({_said(error)}): choose another model or provider"
            ) from error

    def _check(self, probe: _Probe) -> None:
        """The network takes and gives what its card says, in batches; ``ModelError`` if not."""
        inputs, outputs = self._session.get_inputs(), self._session.get_outputs()
        kinds = [it.type for it in (*inputs, *outputs)]
        if len(inputs) != 1 or kinds != [probe.kind, *["tensor(float)"] * len(probe.answers)]:
            many = "two float outputs" if len(probe.answers) == 2 else "one float output"
            raise self._error(
                f"another kind of network: expected {probe.wanted} and {many}, "
                f"found {[f'{i.name} {i.type} {i.shape}' for i in inputs]} and "
                f"{[f'{o.name} {o.type}' for o in outputs]}"
            )
        self._input, self._outputs = inputs[0].name, [output.name for output in outputs]
        shape = inputs[0].shape
        if len(shape) != probe.batch.ndim or isinstance(shape[0], int):
            raise self._error(f"fixed to inputs {shape}: the batch size must be free")
        try:
            answers = self._session.run(self._outputs, {self._input: probe.batch})
        except Exception as error:
            raise self._error(
                f"at odds with their card: {probe.given}, as the card has "
                f"it, are refused ({_said(error)})"
            ) from error
        for answer, expected in zip(answers, probe.answers, strict=True):
            if answer.shape != (2, *expected):
                raise self._error(
                    f"at odds with their card: maps of shape {answer.shape[1:]} instead of "
                    f"{expected} ({probe.meaning})"
                )
            if not np.isfinite(answer).all():
                raise self._error(f"damaged: the {probe.of_nothing} are not finite")

    def _error(self, what: str) -> ModelError:
        return ModelError(f"model weights {self._path} are {what}; {MEND}")


@dataclass(frozen=True)
class _Probe:
    """Two inputs for a network of some card, the shapes of its answers, and words for refusals."""

    batch: NDArray[Any]
    kind: str
    answers: tuple[tuple[int, ...], ...]
    wanted: str
    given: str
    meaning: str
    of_nothing: str


def _probe(card: ModelCard) -> _Probe:
    output = card.output
    if isinstance(output, PoseOutput | DetectorOutput):
        if isinstance(output, PoseOutput):
            height = width = output.input_px
            channels = len(output.joint_names) + 1
            also = ((len(output.joint_names),),) if output.depths else ()
        else:
            (height, width), channels, also = PROBE_PX, 5, ()
        maps = (channels, int(height / output.stride_px), int(width / output.stride_px))
        return _Probe(
            batch=np.zeros((2, height, width, 3), np.uint8),
            kind="tensor(uint8)",
            answers=(maps, *also),
            wanted="one uint8 image input (N, H, W, 3)",
            given=f"two images of {width}x{height} px",
            meaning="joints and background or box, input over stride_px; a depth a joint",
            of_nothing="maps of a black image",
        )
    joints = len(output.joint_names)
    return _Probe(
        batch=made_up_joints(2, output),
        kind="tensor(float)",
        answers=((1 + 3 * joints, 3 * joints),),
        wanted=f"one float input of joints (N, J, {output.n_columns})",
        given=f"two people of {joints} joints" + (" and depths" if output.reads_depths else ""),
        meaning="a state and the covariance of its errors",
        of_nothing="answer for made-up joints",
    )


def made_up_joints(n: int, output: LiftOutput) -> NDArray[np.float32]:
    """Joints of ``n`` people as a lifting network takes them: anywhere, all present and known."""
    shape = (n, len(output.joint_names), output.n_columns)
    batch = np.random.default_rng(0).random(shape, np.float32)
    batch[..., 2::2] = 1.0
    return batch


def runtimes(card: ModelCard, wanted: ProviderChoice = "auto") -> list[Runtime]:
    """How the present providers would run a card's network, the best first.

    That is by the card's measured cost, a GPU before all. A provider that was asked for by name
    runs whatever it can, fast or not; ``ModelError`` when there is none.
    """
    features = None if wanted == "auto" else cpu_features() | set(card.cpu_features)
    present = present_providers(wanted)
    found = [r for p in present if (r := runtime_of(card, p, features)) is not None]
    if not found and "cpu" in present:
        found = [Runtime("cpu", card.precision)]  # slow, but what was asked for by name
    if not found:
        raise ModelError(
            f"model {card.name} is for {', '.join(card.providers)}, not for {', '.join(present)}"
        )
    return sorted(found, key=lambda runtime: cost_ms(card, runtime))


def cost_ms(card: ModelCard, runtime: Runtime) -> float:
    """CPU-ms an input as the card has it: 0 on a GPU; infinite where nobody measured it."""
    return 0.0 if runtime.provider == "cuda" else card.cost_ms.get(str(runtime), np.inf)


def _said(error: Exception) -> str:
    """The gist of an onnxruntime error: its first line, without the prefix."""
    text = str(error).strip().partition("\n")[0]
    return _PREFIX.sub("", text)[:300] or type(error).__name__
