"""The 8-bit twin's graph; needs the train extra."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnxruntime as ort
import pytest

onnx = pytest.importorskip("onnx")

from models.card import WEIGHTS_DIR  # noqa: E402
from models.training import quantize  # noqa: E402


@pytest.mark.parametrize(("name", "shape"), [("cpm", (160, 160)), ("person", (96, 64))])
def test_the_stem_reads_blocks_as_it_read_pixels(
    tmp_path: Path, name: str, shape: tuple[int, int]
) -> None:
    """Before any rounding the twin's graph computes what the network does."""
    folded, blocks = tmp_path / "folded.onnx", tmp_path / "blocks.onnx"
    quantize.fold(WEIGHTS_DIR / f"{name}.onnx", folded)
    model = onnx.load(str(folded))
    quantize.take_blocks(model)
    onnx.save(model, str(blocks))
    images = np.random.default_rng(0).integers(0, 256, (2, *shape, 3)).astype(np.uint8)
    first, second = (
        ort.InferenceSession(str(path), providers=["CPUExecutionProvider"]).run(
            None, {"image": images}
        )[0]
        for path in (WEIGHTS_DIR / f"{name}.onnx", blocks)
    )
    np.testing.assert_allclose(second, first, atol=2e-3 * np.abs(first).max())


def test_networks_that_find_nobody_agree() -> None:
    photos = [np.zeros((96, 128, 3), np.uint8)]
    assert quantize.same_boxes(WEIGHTS_DIR, ("person", "person"), photos) == 1.0
