"""The exported graphs compute what the modules do; needs the train extra."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime as ort
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("onnx")

from models.card import PoseOutput  # noqa: E402
from models.errors import ModelError  # noqa: E402
from models.session import OnnxModel  # noqa: E402
from models.training.export import (  # noqa: E402
    config_of,
    export,
    person_card,
    pose_card,
    publish,
    read_weights,
)
from models.training.network import (  # noqa: E402
    ConvolutionalPoseMachine,
    CpmConfig,
    PersonConfig,
    PersonNetwork,
)
from models.training.onnx_graph import person_model, pose_model  # noqa: E402


def shaken(network: Any) -> Any:
    """Every parameter and statistic away from where it starts, so that none can be forgotten.

    Values are those that half precision has: the files store them so.
    """
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for name, value in network.state_dict().items():
            if value.dtype.is_floating_point:
                noise = torch.rand(value.shape, generator=generator)
                spread = 0.1 if value.dim() == 4 else 0.5
                shift = 0.5 if name.endswith(("var", "weight")) and value.dim() == 1 else -0.5
                value.copy_((spread * 2 * (noise + shift)).half().float())
    return network.eval()


CPM = CpmConfig(width=16, blocks=(1, 2, 1, 1), stage_width=16, n_stages=2)


def outputs(path: Path, network: Any, images: np.ndarray) -> tuple[np.ndarray, ...]:
    session = ort.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    with torch.no_grad():
        out = network(torch.from_numpy(images).permute(0, 3, 1, 2).float() / 127.5 - 1)
    expected = (out[-1] if isinstance(out, list) else out).numpy()
    return session.run(None, {"image": images})[0], expected


def test_pose_graph_equals_its_module(tmp_path: Path) -> None:
    network = shaken(ConvolutionalPoseMachine(CPM))
    card = publish(pose_model(network, 64), pose_card(network, "tiny", "1", 64), tmp_path)
    images = np.random.default_rng(0).integers(0, 256, (3, 64, 64, 3)).astype(np.uint8)
    found, expected = outputs(tmp_path / card.file, network, images)
    assert found.shape == (3, 15, 16, 16)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4 * np.abs(expected).max())


def test_depths_are_a_second_output_and_the_logits_stay_as_they_were(tmp_path: Path) -> None:
    plain = shaken(ConvolutionalPoseMachine(CPM))
    network = shaken(ConvolutionalPoseMachine(replace(CPM, depths=True)))
    network.load_state_dict(plain.state_dict(), strict=False)
    card = publish(pose_model(network, 64), pose_card(network, "tiny", "1", 64), tmp_path)
    assert isinstance(card.output, PoseOutput)
    assert card.output.depths
    assert config_of(read_weights(tmp_path / card.file)) == network.cfg
    images = np.random.default_rng(0).integers(0, 256, (3, 64, 64, 3)).astype(np.uint8)
    _, expected = outputs(tmp_path / card.file, plain, images)
    with torch.no_grad():
        deep = network.seen(torch.from_numpy(images).permute(0, 3, 1, 2).float() / 127.5 - 1).depths
    seen = OnnxModel(tmp_path, card.name).see(images)
    assert seen.depths is not None
    assert deep is not None
    expected_deep = deep.numpy()
    scale = np.abs(expected).max()
    np.testing.assert_allclose(seen.maps, expected, rtol=1e-4, atol=1e-4 * scale)
    np.testing.assert_allclose(
        seen.depths, expected_deep, rtol=1e-3, atol=1e-4 * np.abs(expected_deep).max()
    )


@pytest.mark.parametrize("shape", [(1, 64, 96, 3), (2, 96, 32, 3)])
def test_person_graph_equals_its_module(tmp_path: Path, shape: tuple[int, ...]) -> None:
    network = shaken(PersonNetwork(PersonConfig(width=16, blocks=(1, 1, 2))))
    card = publish(person_model(network), person_card(network, "tiny", "1", 320), tmp_path)
    images = np.random.default_rng(0).integers(0, 256, shape).astype(np.uint8)
    found, expected = outputs(tmp_path / card.file, network, images)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4 * np.abs(expected).max())


def test_training_goes_on_from_an_exported_file(tmp_path: Path) -> None:
    network = shaken(ConvolutionalPoseMachine(CPM))
    card = publish(pose_model(network, 64), pose_card(network, "tiny", "1", 64), tmp_path)
    again = ConvolutionalPoseMachine(CPM)
    missing, unknown = again.load_state_dict(read_weights(tmp_path / card.file), strict=False)
    assert all(name.endswith("num_batches_tracked") for name in missing)
    assert unknown == []
    for (name, a), b in zip(network.state_dict().items(), again.state_dict().values(), strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=0, msg=name)


def test_the_same_weights_give_the_same_bytes() -> None:
    network = shaken(ConvolutionalPoseMachine(CPM))
    assert pose_model(network, 64) == pose_model(network, 64)


def test_a_checkpoint_becomes_files_that_are_served(tmp_path: Path) -> None:
    network = shaken(ConvolutionalPoseMachine(CPM))
    checkpoint = tmp_path / "last.pt"
    state = {"config": CPM.as_dict(), "ema": network.state_dict(), "step": 7, "size_px": 96}
    torch.save(state, checkpoint)
    card = export(checkpoint, tmp_path / "out", "cpm", version="1", size_px=64)
    images = np.random.default_rng(0).integers(0, 256, (1, 64, 64, 3), dtype=np.uint8)
    found, expected = outputs(tmp_path / "out" / card.file, network, images)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4 * np.abs(expected).max())
    assert OnnxModel(tmp_path / "out", card.name).card == card
    assert card.measured == {"training_steps": 7.0}
    with pytest.raises(ModelError, match="multiple of 32"):
        export(checkpoint, tmp_path / "out", "cpm", version="1", size_px=80)
    with pytest.raises(ModelError, match=r"last\.pt is of no person network"):
        export(checkpoint, tmp_path / "out", "person", version="1")
    torch.save({"ema": {}, "step": 1}, checkpoint)
    with pytest.raises(ModelError, match="no config"):
        export(checkpoint, tmp_path / "out", "cpm", version="1")
    checkpoint.write_bytes(b"no checkpoint")
    with pytest.raises(ModelError, match="cannot be read"):
        export(checkpoint, tmp_path / "out", "cpm", version="1")
    assert sorted(it.name for it in (tmp_path / "out").iterdir()) == ["cpm.json", "cpm.onnx"]
