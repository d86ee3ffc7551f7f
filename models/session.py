"""An onnxruntime session as the service wants it: few threads, no spinning, checked at start."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from models.card import ModelCard, read_card, read_weights
from models.errors import ModelError


class OnnxModel:
    """A weights file and its card, ready to run. Safe to call from several threads."""

    def __init__(self, directory: Path, name: str, *, threads: int = 1) -> None:
        self.card: ModelCard = read_card(directory / f"{name}.json")
        path = directory / self.card.file
        weights = read_weights(path, self.card)
        options = ort.SessionOptions()
        # Requests run side by side, each on one core; spinning would steal from the others.
        options.intra_op_num_threads = threads
        options.inter_op_num_threads = 1
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        options.log_severity_level = 3
        try:
            self._session = ort.InferenceSession(
                weights, options, providers=["CPUExecutionProvider"]
            )
        except Exception as error:
            raise ModelError(f"model weights {path} are no usable ONNX model: {error}") from error
        inputs, outputs = self._session.get_inputs(), self._session.get_outputs()
        if len(inputs) != 1 or len(outputs) != 1 or inputs[0].type != "tensor(uint8)":
            raise ModelError(
                f"model weights {path} are another kind of network: expected one uint8 image "
                "input (N, H, W, 3) and one output; export with models.training.export"
            )
        self._input = inputs[0].name

    @property
    def provider(self) -> str:
        """The execution provider that runs the network."""
        return str(self._session.get_providers()[0])

    def run(self, images: NDArray[np.uint8]) -> NDArray[np.float32]:
        """(N, H, W, 3) uint8 BGR -> the network's maps (N, C, h, w) float32."""
        maps: NDArray[np.float32] = self._session.run(None, {self._input: images})[0]
        return maps
