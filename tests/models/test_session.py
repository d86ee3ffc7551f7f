import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from models import ModelError, PersonDetector, PoseEstimator
from models.card import WEIGHTS_DIR
from models.session import OnnxModel


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    for file in WEIGHTS_DIR.iterdir():
        shutil.copy(file, tmp_path / file.name)
    return tmp_path


def test_missing_card_is_named(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=r"cpm\.json is missing"):
        PoseEstimator(weights_dir=tmp_path)


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


def test_a_file_that_is_no_onnx_is_refused(weights: Path) -> None:
    import hashlib

    (weights / "cpm.onnx").write_bytes(b"not a network")
    card = json.loads((weights / "cpm.json").read_text())
    card["sha256"] = hashlib.sha256(b"not a network").hexdigest()
    (weights / "cpm.json").write_text(json.dumps(card))
    with pytest.raises(ModelError, match="no usable ONNX model"):
        OnnxModel(weights, "cpm")


def test_a_card_with_a_wrong_value_names_the_field(weights: Path) -> None:
    card = json.loads((weights / "cpm.json").read_text())
    card["output"]["input_px"] = "wide"
    (weights / "cpm.json").write_text(json.dumps(card))
    with pytest.raises(ModelError, match="input_px"):
        PoseEstimator(weights_dir=weights)


def test_a_detector_is_no_pose_network_and_the_other_way_round() -> None:
    with pytest.raises(ModelError, match="no pose network"):
        PoseEstimator("person")
    with pytest.raises(ModelError, match="no person detector"):
        PersonDetector("cpm")


def test_a_batch_gives_what_its_images_give_alone() -> None:
    model = OnnxModel(WEIGHTS_DIR, "cpm")
    size = model.card.output.model_dump()["input_px"]
    images = np.random.default_rng(0).integers(0, 256, (3, size, size, 3)).astype(np.uint8)
    together = model.run(images)
    for i in range(3):
        np.testing.assert_allclose(model.run(images[i : i + 1])[0], together[i], atol=1e-3)
