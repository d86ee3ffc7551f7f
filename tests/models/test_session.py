"""What is loaded is what its card says, by the provider that was asked for; all else is refused."""

import json
import logging
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from library_store.skeleton import LSP14
from models import ModelError, PersonDetector, PoseEstimator
from models.card import WEIGHTS_DIR, LiftOutput, read_card
from models.choice import choose
from models.session import OnnxModel, made_up_joints
from tests.cuda import claim_cuda, claim_cuda_that_cannot_run
from tests.models import tiny_onnx
from tests.models.tiny_onnx import FLOAT16, node, planes


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    for file in WEIGHTS_DIR.iterdir():
        shutil.copy(file, tmp_path / file.name)
    return tmp_path


def test_missing_card_is_named_and_the_others_are_offered(tmp_path: Path, weights: Path) -> None:
    with pytest.raises(ModelError, match=r"cpm\.json is missing; restore"):
        PoseEstimator(weights_dir=tmp_path / "none")
    with pytest.raises(ModelError, match=r"cpn\.json is missing \(there are: cpm, .*person"):
        PoseEstimator("cpn", weights_dir=weights)


def test_missing_weights_are_named(weights: Path) -> None:
    (weights / "cpm.onnx").unlink()
    with pytest.raises(ModelError, match=r"cpm\.onnx are missing"):
        PoseEstimator(weights_dir=weights)


@pytest.mark.parametrize("damage", ["truncated", "flipped"])
def test_corrupt_weights_are_refused(weights: Path, damage: str) -> None:
    data = bytearray((weights / "cpm.onnx").read_bytes())
    if damage == "truncated":
        del data[len(data) // 2 :]
    else:
        data[len(data) // 2] ^= 1
    (weights / "cpm.onnx").write_bytes(data)
    with pytest.raises(ModelError, match="sha256 differs"):
        PoseEstimator(weights_dir=weights)


def test_another_networks_weights_under_a_card_are_refused(weights: Path) -> None:
    shutil.copy(weights / "person.onnx", weights / "cpm.onnx")
    with pytest.raises(ModelError, match="belongs to another version"):
        PoseEstimator(weights_dir=weights)


def test_a_card_with_a_wrong_value_names_the_field(weights: Path) -> None:
    card = json.loads((weights / "cpm.json").read_text())
    card["output"]["input_px"] = "wide"
    (weights / "cpm.json").write_text(json.dumps(card))
    with pytest.raises(ModelError, match="input_px"):
        PoseEstimator(weights_dir=weights)


@pytest.mark.parametrize(
    ("name", "field", "value", "said"),
    [
        ("cpm", "input_px", -1, "input_px"),
        ("cpm", "stride_px", 0, "stride_px"),
        ("cpm", "stride_px", float("nan"), "stride_px"),
        ("cpm", "crop_scale", 0, "crop_scale"),
        ("cpm", "confidence", {"coefficients": []}, "6 coefficients for 14 joints"),
        ("cpm", "confidence", {"coefficients": [[1.0] * 5] * 14}, "6 coefficients for 14"),
        ("cpm", "spread", {"factor": [1.0] * 13}, "a factor for each of 14 joints"),
        ("person", "stride_px", 0, "stride_px"),
        ("person", "unit_px", -32.0, "unit_px"),
        ("person", "threshold", 2.0, "threshold"),
    ],
)
def test_what_the_first_photo_would_fail_on_is_refused_at_start(
    weights: Path, name: str, field: str, value: Any, said: str
) -> None:
    card = json.loads((weights / f"{name}.json").read_text())
    output = card["output"]
    output[field] = output[field] | value if isinstance(value, dict) else value
    (weights / f"{name}.json").write_text(json.dumps(card))
    with pytest.raises(ModelError, match=rf"{name}\.json is not valid at output.*{said}"):
        read_card(weights / f"{name}.json")


def test_a_card_goes_by_its_models_name(weights: Path) -> None:
    (weights / "cpm.json").rename(weights / "mine.json")
    with pytest.raises(ModelError, match=r"mine\.json is of a model named 'cpm'"):
        choose(weights, "pose")


@pytest.mark.parametrize("file", ["cpm.json", "cpm.onnx"])
def test_a_file_that_cannot_be_read_is_named(weights: Path, file: str) -> None:
    (weights / file).unlink()
    (weights / file).mkdir()
    with pytest.raises(ModelError, match=rf"{file} cannot be read: Is a directory"):
        PoseEstimator(weights_dir=weights)


def test_a_detector_is_no_pose_network_and_the_other_way_round() -> None:
    with pytest.raises(ModelError, match="no pose network"):
        PoseEstimator("person")
    with pytest.raises(ModelError, match="no person detector"):
        PersonDetector("cpm")


def test_a_network_as_its_card_has_it_is_taken(tmp_path: Path) -> None:
    tiny_onnx.write(tmp_path, "tiny", tiny_onnx.model(planes()))
    image = np.random.default_rng(0).integers(0, 256, (3, 32, 32, 3)).astype(np.uint8)
    maps = OnnxModel(tmp_path, "tiny").run(image)
    np.testing.assert_array_equal(maps, image.transpose(0, 3, 1, 2))


SOUND = tiny_onnx.model(planes())


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"not a network", "no ONNX model that onnxruntime"),
        (SOUND[: len(SOUND) // 2], "no ONNX model that onnxruntime"),
        (tiny_onnx.model(planes(), opset=99), "opset"),
        (
            tiny_onnx.model(planes(node("Frobnicate", ["planes"], "odd"), last="odd")),
            "Frobnicate",
        ),
        (tiny_onnx.model(planes(), kind=tiny_onnx.FLOAT), "expected one uint8 image input"),
        (
            tiny_onnx.model(
                planes(node("Cast", ["planes"], "half", to=FLOAT16), last="half"), made=FLOAT16
            ),
            r"one float output, .* tensor\(float16\)",
        ),
        (tiny_onnx.model(planes(), image=(1, 32, 32, 3)), "batch size must be free"),
        (tiny_onnx.model(planes(), image=("n", 64, 64, 3)), "as the card has it, are refused"),
        (
            tiny_onnx.model(
                planes(node("Concat", ["planes", "planes"], "six", axis=1), last="six")
            ),
            r"maps of shape \(6, 32, 32\) instead of \(3, 32, 32\)",
        ),
        (
            tiny_onnx.model(planes(node("Div", ["planes", "planes"], "ratio"), last="ratio")),
            "not finite",
        ),
    ],
    ids=["text", "cut", "opset", "operator", "floats", "halves", "one", "size", "maps", "nan"],
)
def test_foreign_networks_are_refused_with_a_reason_and_a_mend(
    tmp_path: Path, data: bytes, said: str
) -> None:
    tiny_onnx.write(tmp_path, "tiny", data)
    with pytest.raises(ModelError, match=said) as refusal:
        OnnxModel(tmp_path, "tiny")
    assert str(tmp_path / "tiny.onnx") in str(refusal.value)
    assert "posematch model export" in str(refusal.value)


def test_depths_are_there_if_the_card_says_so_and_only_then(tmp_path: Path, weights: Path) -> None:
    card = json.loads((weights / "cpm.json").read_text())
    card["output"]["depths"] = not card["output"].get("depths", False)
    (weights / "cpm.json").write_text(json.dumps(card))
    with pytest.raises(ModelError, match=r"expected .* and (two float outputs|one float output),"):
        PoseEstimator(weights_dir=weights)

    def with_depths(joints: int) -> bytes:
        most = node("ReduceMax", ["planes"], "most", axes=[1, 2], keepdims=0)
        cut = node("Slice", ["most", "begin", "end", "axis"], "depths")
        ends = [("begin", 0), ("end", joints), ("axis", 1)]
        numbers = [tiny_onnx.constant(name, np.array([value])) for name, value in ends]
        return tiny_onnx.model(planes(most, *numbers, cut), also="depths")

    output: Any = tiny_onnx.card("tiny", b"")["output"]
    output |= {"depths": True}
    tiny_onnx.write(tmp_path, "tiny", with_depths(2), output=output)
    model = OnnxModel(tmp_path, "tiny")
    crop = np.ones((1, 32, 32, 3), np.uint8)
    seen = model.see(crop)
    np.testing.assert_array_equal(seen.maps, model.run(crop))
    np.testing.assert_array_equal(seen.depths, [[1.0, 1.0]])
    tiny_onnx.write(tmp_path, "tiny", with_depths(3), output=output)
    with pytest.raises(ModelError, match=r"shape \(3,\) instead of \(2,\) .* a depth a joint"):
        OnnxModel(tmp_path, "tiny")
    tiny_onnx.write(tmp_path, "tiny", with_depths(2))
    with pytest.raises(ModelError, match="one float output, found"):
        OnnxModel(tmp_path, "tiny")


@pytest.mark.parametrize("reads_depths", [False, True])
def test_lifting_networks_are_told_of_depths_if_their_card_says_so(
    tmp_path: Path, reads_depths: bool
) -> None:
    output = tiny_onnx.lift_output(reads_confidence=True, reads_depths=reads_depths)
    right, wrong = (5, 3) if reads_depths else (3, 5)
    tiny_onnx.write(tmp_path, "tiny", tiny_onnx.believer(right, 0.1, 2), output=output)
    OnnxModel(tmp_path, "tiny")
    tiny_onnx.write(tmp_path, "tiny", tiny_onnx.believer(wrong, 0.1, 2), output=output)
    said = "14 joints and depths, as the card" if reads_depths else "14 joints, as the card"
    with pytest.raises(ModelError, match=said):
        OnnxModel(tmp_path, "tiny")
    tiny_onnx.write(tmp_path, "tiny", (WEIGHTS_DIR / "cpm.onnx").read_bytes(), output=output)
    with pytest.raises(ModelError, match=rf"one float input of joints \(N, J, {right}\)"):
        OnnxModel(tmp_path, "tiny")


def made_up_network(reads_depths: bool) -> LiftOutput:
    return LiftOutput.model_validate(
        tiny_onnx.lift_output(reads_confidence=True, reads_depths=reads_depths)
    )


def test_made_up_joints_are_all_there_and_their_depths_known() -> None:
    joints = made_up_joints(2, made_up_network(reads_depths=True))
    assert joints.shape == (2, 14, 5)
    assert (joints[..., [2, 4]] == 1).all()
    assert (joints[..., [0, 1, 3]] != 1).all()
    plain = made_up_joints(2, made_up_network(reads_depths=False))
    assert plain.shape == (2, 14, 3)
    assert (plain[..., 2] == 1).all()


@pytest.mark.parametrize("name", ["cpm", "cpm-int8"])
def test_a_batch_gives_what_its_images_give_alone(name: str) -> None:
    model = OnnxModel(WEIGHTS_DIR, name)
    size = model.card.output.model_dump()["input_px"]
    images = np.random.default_rng(0).integers(0, 256, (3, size, size, 3)).astype(np.uint8)
    together = model.see(images)
    assert together.depths is not None
    for i in range(3):
        alone = model.see(images[i : i + 1])
        assert alone.depths is not None
        np.testing.assert_allclose(alone.maps[0], together.maps[i], atol=1e-3)
        np.testing.assert_allclose(alone.depths[0], together.depths[i], atol=1e-5)


def test_what_runs_for_two_people_and_not_for_ten_is_refused_at_start(tmp_path: Path) -> None:
    shape = tiny_onnx.constant("shape", np.array([2, 15, 32, 32]))
    nodes = [node("Concat", ["planes"] * 5, "many", axis=1), shape]
    nodes += [node("Reshape", ["many", "shape"], "two")]
    output = tiny_onnx.card("tiny", b"")["output"] | {"joint_names": LSP14.joint_names}  # type: ignore[operator]
    tiny_onnx.write(tmp_path, "tiny", tiny_onnx.model(planes(*nodes, last="two")), output=output)
    estimator = PoseEstimator("tiny", weights_dir=tmp_path)
    estimator.warm_up(2)
    with pytest.raises(ModelError, match="tiny runs on cpu, but not on 10 images of 32x32 px"):
        estimator.warm_up(10)


def test_a_provider_that_is_not_installed_is_refused() -> None:
    with pytest.raises(ModelError, match="has only cpu; install onnxruntime-gpu"):
        OnnxModel(WEIGHTS_DIR, "cpm", provider="cuda")


@pytest.mark.parametrize("claim", [claim_cuda, claim_cuda_that_cannot_run])
def test_a_provider_that_fails_is_refused_when_asked_for_and_replaced_by_auto(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    claim: Callable[[pytest.MonkeyPatch], None],
) -> None:
    """Without a driver onnxruntime's session falls back to the CPU without an error; on a GPU that
    is too old, or has no memory left, it fails when it first runs."""
    tiny_onnx.write(tmp_path, "tiny", SOUND)
    claim(monkeypatch)
    with pytest.raises(ModelError, match="POSEMATCH_PROVIDER=cuda: cuda cannot run model tiny"):
        OnnxModel(tmp_path, "tiny", provider="cuda")
    with caplog.at_level(logging.WARNING):
        model = OnnxModel(tmp_path, "tiny", provider="auto")
    assert str(model.runtime) == "cpu/fp32"
    assert "cuda cannot run" in caplog.text
