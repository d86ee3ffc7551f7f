"""Which card and which provider are taken: by what is installed, the CPU and the budget."""

import platform
from pathlib import Path

import onnxruntime as ort
import pytest

from models import ModelError
from models.card import WEIGHTS_DIR, read_card
from models.choice import cards_of, choose
from models.providers import cpu_features, cpu_name, runtime_of
from models.session import runtimes
from tests.models import tiny_onnx

VNNI = frozenset({"avx2", "avx512_vnni"})
PLAIN = frozenset({"avx2"})
OLD = frozenset({"sse4_1", "avx"})


@pytest.fixture
def cards(tmp_path: Path) -> Path:
    """Three networks: small, its 8-bit twin, and a better one for the patient."""
    data = tiny_onnx.model(tiny_onnx.planes())
    int8 = {"precision": "int8", "cpu_features": ["avx512_vnni"], "providers": ["openvino", "cpu"]}
    for name, accuracy, cost, more in [
        ("small", 0.700, {"cpu/fp32": 11.0, "openvino/bf16": 4.0, "openvino/fp32": 11.5}, {}),
        ("small-int8", 0.697, {"cpu/int8": 5.0, "openvino/int8": 5.5}, int8),
        ("large", 0.760, {"cpu/fp32": 30.0, "openvino/bf16": 9.0}, {}),
        ("unmeasured", None, {}, {}),
    ]:
        tiny_onnx.write(tmp_path, name, data, accuracy=accuracy, cost_ms=cost, **more)
    return tmp_path


@pytest.mark.parametrize(
    ("available", "features", "budget_ms", "chosen"),
    [
        ("CPU", PLAIN, 12, "small"),
        ("CPU", VNNI, 12, "small-int8"),
        ("CPU", VNNI, 40, "large"),
        ("OpenVINO CPU", VNNI, 12, "small"),
        ("OpenVINO CPU", VNNI | {"amx_bf16"}, 12, "large"),
        ("OpenVINO CPU", VNNI | {"amx_bf16"}, 8, "small"),
        ("CUDA CPU", PLAIN, 1, "large"),
        ("CPU", PLAIN, 1, "small"),
    ],
)
def test_the_best_card_within_the_budget(
    cards: Path,
    monkeypatch: pytest.MonkeyPatch,
    available: str,
    features: frozenset[str],
    budget_ms: float,
    chosen: str,
) -> None:
    names = [f"{name}ExecutionProvider" for name in available.split()]
    monkeypatch.setattr(ort, "get_available_providers", lambda: names)
    if available == "OpenVINO CPU" and chosen == "small" and "amx_bf16" not in features:
        chosen = "small-int8"  # without bf16 OpenVINO is no faster than the CPU provider
    assert choose(cards, "pose", budget_ms=budget_ms, features=features) == chosen


def test_the_cheapest_provider_comes_first(cards: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = ["OpenVINOExecutionProvider", "CPUExecutionProvider"]
    monkeypatch.setattr(ort, "get_available_providers", lambda: names)
    monkeypatch.setattr("models.providers.cpu_features", lambda: VNNI | {"amx_bf16"})
    assert [str(r) for r in runtimes(read_card(cards / "small.json"))] == [
        "openvino/bf16",
        "cpu/fp32",
    ]
    assert [str(r) for r in runtimes(read_card(cards / "small-int8.json"))] == [
        "cpu/int8",
        "openvino/int8",
    ]


def test_an_8_bit_network_runs_where_it_was_named_even_if_slow(cards: Path) -> None:
    card = read_card(cards / "small-int8.json")
    assert runtime_of(card, "cpu", PLAIN) is None
    assert [str(r) for r in runtimes(card, "cpu")] == ["cpu/int8"]


def test_no_card_of_that_kind(cards: Path) -> None:
    with pytest.raises(ModelError, match="no model card of kind 'people'"):
        choose(cards, "people")


def test_features_of_a_cpu(tmp_path: Path) -> None:
    info = tmp_path / "cpuinfo"
    flags = "flags\t\t: fpu avx512_vnni amx_bf16"
    info.write_text(f"processor\t: 0\nmodel name\t: Big 9: one\n{flags}\n\nprocessor : 1\n")
    assert cpu_features(info) == {"fpu", "avx512_vnni", "amx_bf16"}
    assert cpu_name(info) == "Big 9: one"
    info = tmp_path / "arm"
    info.write_text("processor\t: 0\nFeatures\t: fp asimd asimddp\n")
    assert cpu_features(info) == {"fp", "asimd", "asimddp"}
    assert cpu_name(info) == cpu_name(tmp_path / "none") == platform.machine()


@pytest.mark.parametrize("kind", ["pose", "people"])
def test_the_shipped_cards_have_what_the_choice_needs(kind: str) -> None:
    """On any CPU the shipped network that is chosen is one whose accuracy and cost are stated.

    Of 8 bits where the CPU multiplies bytes faster than numbers, and it need not be a new one.
    """
    for features in (OLD, PLAIN, VNNI):
        card = read_card(WEIGHTS_DIR / f"{choose(WEIGHTS_DIR, kind, features=features)}.json")  # type: ignore[arg-type]
        assert card.accuracy is not None
        assert card.precision == ("fp32" if features == OLD else "int8")
        assert all(cost > 0 for cost in card.cost_ms.values())
        assert card.cost_ms


def test_what_macos_puts_beside_cards_is_none(cards: Path) -> None:
    (cards / "._small.json").write_bytes(b"\x00\x05\x16\x07\x00\x02\x00\x00Mac OS X")
    names = {card.name for card in cards_of(cards, "pose")}
    assert names == {"small", "small-int8", "large", "unmeasured"}
