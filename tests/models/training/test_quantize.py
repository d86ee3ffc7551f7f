"""8-bit twins: the graph, and the same answers on every CPU; needs the train extra."""

from pathlib import Path

import numpy as np
import onnxruntime as ort
import pytest

torch = pytest.importorskip("torch")
onnx = pytest.importorskip("onnx")

from models.card import WEIGHTS_DIR, ModelCard, read_card  # noqa: E402
from models.providers import runtime_of  # noqa: E402
from models.training.export import person_card, publish  # noqa: E402
from models.training.network import PersonConfig, PersonNetwork  # noqa: E402
from models.training.onnx_graph import person_model  # noqa: E402
from models.training.quantize import fold, quantize, same_boxes, take_blocks  # noqa: E402

Photos = np.ndarray
PAIR_MAX = 2**15 - 1
"""AVX2 adds two products of a byte and a weight in 16 bits."""


@pytest.fixture(scope="module")
def photos() -> Photos:
    return np.random.default_rng(0).integers(0, 256, (8, 64, 96, 3)).astype(np.uint8)


@pytest.fixture(scope="module")
def twin(tmp_path_factory: pytest.TempPathFactory, photos: Photos) -> tuple[Path, ModelCard]:
    """Where the twin of a small person network with plain statistics is, and its card."""
    torch.manual_seed(0)
    network = PersonNetwork(PersonConfig(width=16, blocks=(1, 1, 1))).eval()
    with torch.no_grad():
        for name, value in network.state_dict().items():
            if name.endswith("b.1.weight"):  # which start at nothing
                value.fill_(0.5)
            elif name == "score.weight":
                value.mul_(100)  # what it says is far from its bias
    folder = tmp_path_factory.mktemp("weights")
    publish(person_model(network), person_card(network, "tiny", "1", 96), folder)
    return folder, quantize(folder, "tiny", photos)


def test_no_pair_of_products_overflows(twin: tuple[Path, ModelCard]) -> None:
    folder, card = twin
    weights = [
        onnx.numpy_helper.to_array(constant)
        for constant in onnx.load(str(folder / card.file)).graph.initializer
        if constant.data_type == onnx.TensorProto.INT8 and len(constant.dims) == 4
    ]
    assert len(weights) > 10
    assert max(2 * 255 * int(np.abs(w.astype(int)).max()) for w in weights) <= PAIR_MAX


def test_a_twin_computes_what_its_graph_says(twin: tuple[Path, ModelCard], photos: Photos) -> None:
    """The integer kernels agree with the same graph calculated in single precision."""
    folder, card = twin
    answers = []
    for level in (
        ort.GraphOptimizationLevel.ORT_DISABLE_ALL,
        ort.GraphOptimizationLevel.ORT_ENABLE_ALL,
    ):
        options = ort.SessionOptions()
        options.graph_optimization_level = level
        session = ort.InferenceSession(
            str(folder / card.file), options, providers=["CPUExecutionProvider"]
        )
        answers.append(session.run(None, {"image": photos})[0])
    exact, served = answers
    assert exact.std() > 0.1
    assert np.abs(served - exact).mean() < 0.02 * exact.std()


def test_a_twin_is_for_cpus_with_avx2(twin: tuple[Path, ModelCard]) -> None:
    folder, card = twin
    card = read_card(folder / f"{card.name}.json")
    assert str(runtime_of(card, "cpu", frozenset({"sse4_1", "avx", "avx2"}))) == "cpu/int8"
    assert str(runtime_of(card, "cpu", frozenset({"asimd", "asimddp"}))) == "cpu/int8"
    assert runtime_of(card, "cpu", frozenset({"sse4_1", "avx"})) is None


@pytest.mark.parametrize(("name", "shape"), [("cpm", (160, 160)), ("person", (96, 64))])
def test_the_stem_reads_blocks_as_it_read_pixels(
    tmp_path: Path, name: str, shape: tuple[int, int]
) -> None:
    """Before any rounding the twin's graph computes what the network does."""
    folded, blocks = tmp_path / "folded.onnx", tmp_path / "blocks.onnx"
    fold(WEIGHTS_DIR / f"{name}.onnx", folded)
    model = onnx.load(str(folded))
    take_blocks(model)
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
    assert same_boxes(WEIGHTS_DIR, ("person", "person"), photos) == 1.0
