"""8-bit twins give the same answers on every CPU; needs the train extra."""

from pathlib import Path

import numpy as np
import onnxruntime as ort
import pytest

torch = pytest.importorskip("torch")
onnx = pytest.importorskip("onnx")

from models.card import ModelCard, read_card  # noqa: E402
from models.providers import runtime_of  # noqa: E402
from models.training.export import person_card, publish  # noqa: E402
from models.training.network import PersonConfig, PersonNetwork  # noqa: E402
from models.training.onnx_graph import person_model  # noqa: E402
from models.training.quantize import quantize  # noqa: E402

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
