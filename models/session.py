"""A network and its card, checked against each other at start, run by the provider that was found.

Whatever is wrong with the files, or with a provider somebody asked for, is a ``ModelError`` that
says which and how to mend it; nothing is left for the first request to find out.
"""

from __future__ import annotations

import logging
import re
from pathlib import Path

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from models.card import ModelCard, PoseOutput, read_card, read_weights
from models.errors import ModelError
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
    them fails; any other is used or refused. ``threads`` is how many one run may use,
    ``concurrency`` how many runs are made side by side.
    """

    def __init__(
        self,
        directory: Path,
        name: str,
        *,
        provider: ProviderChoice = "auto",
        threads: int = 1,
        concurrency: int = 1,
    ) -> None:
        self.card: ModelCard = read_card(directory / f"{name}.json")
        self._path = directory / self.card.file
        weights = read_weights(self._path, self.card)
        candidates = runtimes(self.card, provider)
        for runtime in candidates:
            try:
                session = open_session(weights, runtime, threads=threads, concurrency=concurrency)
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
        self._check()

    def run(self, images: NDArray[np.uint8]) -> NDArray[np.float32]:
        """(N, H, W, 3) uint8 BGR -> the network's maps (N, C, h, w) float32."""
        maps: NDArray[np.float32] = self._session.run(None, {self._input: images})[0]
        return maps

    def _check(self) -> None:
        """The network takes and gives what its card says, in batches; ``ModelError`` if not."""
        inputs, outputs = self._session.get_inputs(), self._session.get_outputs()
        if len(inputs) != 1 or len(outputs) != 1 or inputs[0].type != "tensor(uint8)":
            raise self._error(
                "another kind of network: expected one uint8 image input (N, H, W, 3) and one "
                f"output, found {[f'{i.name} {i.type} {i.shape}' for i in inputs]} and "
                f"{[o.name for o in outputs]}"
            )
        self._input = inputs[0].name
        if len(inputs[0].shape) != 4 or isinstance(inputs[0].shape[0], int):
            raise self._error(f"fixed to inputs {inputs[0].shape}: the batch size must be free")
        output = self.card.output
        if isinstance(output, PoseOutput):
            height = width = output.input_px
            channels = len(output.joint_names) + 1
        else:
            (height, width), channels = PROBE_PX, 5
        size = (int(height / output.stride_px), int(width / output.stride_px))
        try:
            maps = self.run(np.zeros((2, height, width, 3), np.uint8))
        except Exception as error:
            raise self._error(
                f"at odds with their card: two images of {width}x{height} px, as the card has "
                f"it, are refused ({_said(error)})"
            ) from error
        if maps.shape != (2, channels, *size):
            raise self._error(
                f"at odds with their card: maps of shape {maps.shape[1:]} instead of "
                f"{(channels, *size)} (joints and background or box, input over stride_px)"
            )
        if not np.isfinite(maps).all():
            raise self._error("damaged: the maps of a black image are not finite")

    def _error(self, what: str) -> ModelError:
        return ModelError(f"model weights {self._path} are {what}; {MEND}")


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
