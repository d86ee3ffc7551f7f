"""The paper's network from Caffe files: what is imported computes what Caffe would.

Against plain numpy here; at 368 px and in full depth against torch, where there is torch.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from library_store.skeleton import LSP14
from models import PoseEstimator
from models.caffe import JOINT_ORDERS, import_caffe, wire
from models.caffe.caffemodel import read_caffemodel
from models.errors import CaffeError
from models.person_detector import PersonBox
from models.session import OnnxModel
from tests.models.caffe import caffe_files
from tests.models.caffe.caffe_files import Cat, Conv, Drop, Pool, Relu, Step

SIDE_PX = 64


def images(n: int, side_px: int) -> NDArray[np.uint8]:
    return np.random.default_rng(1).integers(0, 256, (n, side_px, side_px, 3)).astype(np.uint8)


@pytest.mark.parametrize("old", [False, True], ids=["layer", "layers"])
@pytest.mark.parametrize("make", [caffe_files.vgg_like, caffe_files.nine_by_nine])
def test_maps_are_those_of_plain_numpy(
    tmp_path: Path, make: Callable[..., list[Step]], old: bool
) -> None:
    steps = make(divide=16, n_stages=3)
    weights = caffe_files.random_weights(steps)
    card = import_caffe(*caffe_files.write(tmp_path, steps, weights, SIDE_PX, old=old), tmp_path)
    batch = images(3, SIDE_PX)
    truth = caffe_files.forward(steps, weights, batch)
    assert truth.shape == (3, 15, SIDE_PX // 8, SIDE_PX // 8)
    assert truth.std() > 0.1
    maps = OnnxModel(tmp_path, card.name).run(batch)
    np.testing.assert_allclose(maps, truth, atol=2e-4 * np.abs(truth).max())
    assert card.parameters == sum(w.size + b.size for w, b in weights.values())


def test_unpacked_numbers_are_read_too(tmp_path: Path) -> None:
    steps = caffe_files.vgg_like(divide=64, n_stages=2)
    weights = caffe_files.random_weights(steps)
    paths = caffe_files.write(tmp_path, steps, weights, SIDE_PX)
    packed = import_caffe(*paths, tmp_path / "packed")
    paths[1].write_bytes(caffe_files.caffemodel(weights, packed=False))
    assert import_caffe(*paths, tmp_path / "unpacked").sha256 == packed.sha256


@pytest.mark.parametrize("joints", JOINT_ORDERS)
def test_joints_come_in_our_order(tmp_path: Path, joints: Any) -> None:
    n_maps = 17 if joints == "mpii" else 15
    steps = caffe_files.vgg_like(divide=64, n_stages=2, n_maps=n_maps)
    weights = caffe_files.random_weights(steps)
    paths = caffe_files.write(tmp_path, steps, weights, SIDE_PX)
    card = import_caffe(*paths, tmp_path, joints=joints)
    batch = images(1, SIDE_PX)
    maps = OnnxModel(tmp_path, card.name).run(batch)
    truth = caffe_files.forward(steps, weights, batch)
    # The data sets' own lists, as their authors give them.
    named = {
        "cpm": "head_top neck r_shoulder r_elbow r_wrist l_shoulder l_elbow l_wrist "
        "r_hip r_knee r_ankle l_hip l_knee l_ankle",
        "lsp": "r_ankle r_knee r_hip l_hip l_knee l_ankle r_wrist r_elbow r_shoulder "
        "l_shoulder l_elbow l_wrist neck head_top",
        "mpii": "r_ankle r_knee r_hip l_hip l_knee l_ankle pelvis thorax neck head_top "
        "r_wrist r_elbow r_shoulder l_shoulder l_elbow l_wrist",
    }[joints].split()
    wanted = [named.index(name) for name in LSP14.joint_names] + [n_maps - 1]
    np.testing.assert_allclose(maps, truth[:, wanted], atol=2e-4 * np.abs(truth).max())


def a_finder_of_red() -> tuple[list[Step], caffe_files.Weights]:
    """Every joint's map is how red a cell is: a network whose answer is known."""
    steps: list[Step] = [
        caffe_files.CENTER,
        Pool("image", "cells", 8, 8, mean=True),
        Conv("red", "cells", "red", 15, 1),
        Relu("red"),
        Cat(("red", "pool_center_lower"), "both"),
        Conv("maps", "both", "maps", 15, 1),
    ]
    red = np.zeros((15, 3, 1, 1), np.float32)
    red[:, :, 0, 0] = (-1, -1, 1)  # blue, green, red
    keep = np.concatenate([np.eye(15), np.zeros((15, 1))], axis=1).astype(np.float32)
    zeros = np.zeros(15, np.float32)
    return steps, {"red": (red, zeros), "maps": (keep[..., None, None], zeros)}


def test_it_serves_by_its_card_and_finds_what_is_there(tmp_path: Path) -> None:
    steps, weights = a_finder_of_red()
    import_caffe(*caffe_files.write(tmp_path, steps, weights, 368), tmp_path)
    y, x = np.mgrid[:300, :400]
    at = (211.0, 140.0)
    spot = np.exp(-((x - at[0]) ** 2 + (y - at[1]) ** 2) / (2 * 9.0**2))
    photo = np.zeros((300, 400, 3), np.uint8)
    photo[..., 2] = np.round(255 * spot)
    estimator = PoseEstimator("cpm-original", weights_dir=tmp_path)
    assert estimator.card.output.model_dump()["input_px"] == 368
    found = estimator.estimate(photo, [PersonBox(120, 60, 150, 180, 1.0)])[0]
    # The softened edge of the photo and the grey beyond it are not red; 255 is not 256.
    np.testing.assert_allclose(found.positions_px, np.tile(at, (14, 1)), atol=0.5)
    assert found.confidence is None
    assert found.sigma_px is None


def test_every_node_is_one_that_a_gpu_runs(tmp_path: Path) -> None:
    """Shapes are reckoned with on the CPU by CUDA, to which the service leaves no node."""
    steps = caffe_files.vgg_like(divide=64, n_stages=2)
    paths = caffe_files.write(tmp_path, steps, caffe_files.random_weights(steps), SIDE_PX)
    card = import_caffe(*paths, tmp_path)

    def parts(data: Any, field: int) -> list[Any]:
        return [value for number, _, value in wire.fields(memoryview(data)) if number == field]

    (graph,) = parts((tmp_path / card.file).read_bytes(), 7)
    operators = {bytes(kind).decode() for node in parts(graph, 1) for kind in parts(node, 4)}
    assert operators >= {"Conv", "AveragePool"}
    assert not operators & {"Shape", "Size", "ConstantOfShape"}


def test_the_card_says_whose_weights_they_are(tmp_path: Path) -> None:
    steps = caffe_files.vgg_like(divide=64, n_stages=2)
    paths = caffe_files.write(tmp_path, steps, caffe_files.random_weights(steps), SIDE_PX)
    card = import_caffe(*paths, tmp_path, name="cpm-lsp", licence="research only")
    assert card.licence == "research only"
    assert "non-commercial" in import_caffe(*paths, tmp_path).licence
    assert "pose_iter_1.caffemodel (sha256 " in card.description
    assert json.loads((tmp_path / "cpm-lsp.json").read_text())["output"]["maps"] == "beliefs"
    in_latin_1 = paths[1].rename(tmp_path / os.fsdecode(b"modell_gr\xf6\xdfer.caffemodel"))
    assert import_caffe(paths[0], in_latin_1, tmp_path).version == "modell_gr??er"


def test_input_layers_separate_inputs_and_training_layers_are_understood(tmp_path: Path) -> None:
    steps, weights = a_finder_of_red()
    prototxt, caffemodel = caffe_files.write(tmp_path, steps, weights, SIDE_PX)
    wanted = import_caffe(prototxt, caffemodel, tmp_path / "a")
    text = prototxt.read_text()
    body = text[text.index('layer {\n  name: "pool_center_lower"') :]
    several = "".join(
        f'layer {{ name: "{name}" type: "Input" top: "{name}" '
        f"input_param {{ shape {{ dim: [1, {n}] dim: {SIDE_PX} dim: {SIDE_PX} }} }} }}\n"
        for name, n in (("image", 3), ("center_map", 1))
    )
    training = 'layer { name: "loss" type: "EuclideanLoss" include { phase: TRAIN } }\n'
    training += 'layer { name: "acc" type: "Accuracy" exclude: { phase: TEST } }  # "}" no end\n'
    prototxt.write_bytes(("\ufeff" + several + body + training).replace("\n", "\r\n").encode())
    given = import_caffe(prototxt, caffemodel, tmp_path / "b")
    batch = images(2, SIDE_PX)
    np.testing.assert_array_equal(
        OnnxModel(tmp_path / "b", given.name).run(batch),
        OnnxModel(tmp_path / "a", wanted.name).run(batch),
    )


def _swap(old: str, new: str) -> Callable[[str], str]:
    def change(text: str) -> str:
        assert old in text
        return text.replace(old, new)

    return change


DAMAGED_TEXT: dict[str, tuple[Callable[[str], str], str]] = {
    "empty": (lambda _: "", "there is no layer in it"),
    "other text": (lambda _: "<html>Not found</html>", "line 1"),
    "cut": (lambda text: text[: text.rindex("}")], "the end of the file"),
    "unknown layer": (_swap('"ReLU"', '"BatchNorm"'), "red_relu is of type BatchNorm; only"),
    "training net": (
        lambda t: re.sub(r'input: "data"\n(input_dim: \d+\n)*', "", t),
        "it names no input",
    ),
    "input of three sizes": (_swap("input_dim: 4\n", ""), "wanted are four sizes"),
    "not square": (_swap("input_dim: 64\ninput_dim: 64", "input_dim: 64\ninput_dim: 72"), "square"),
    "huge": (_swap("input_dim: 64", "input_dim: 640000"), "at most 2048"),
    "other input": (_swap("input_dim: 4\n", "input_dim: 57\n"), "a colour image is wanted"),
    "dangling": (_swap('bottom: "red"', 'bottom: "rot"'), "which no layer before it makes"),
    "two ends": (
        lambda t: t + 'layer { name: "s" type: "Split" bottom: "cells" top: "end" }',
        "there are maps, end",
    ),
    "other joints": (_swap("num_output: 15", "num_output: 10"), "different networks"),
    "other axis": (_swap("axis: 1", "axis: 2"), "works along axis 2"),
    "other pooling": (_swap("pool: AVE", "pool: STOCHASTIC"), "STOCHASTIC"),
    "gaps": (_swap("stride: 8", "stride: 10"), "gaps between its windows"),
    "words for numbers": (_swap("kernel_size: 1", "kernel_size: wide"), "no whole number"),
    "deep": (lambda _: "a {" * 5000, "more than 20 deep"),
}


@pytest.mark.parametrize("damage", DAMAGED_TEXT)
def test_other_prototxts_are_refused_with_a_reason(tmp_path: Path, damage: str) -> None:
    change, said = DAMAGED_TEXT[damage]
    steps, weights = a_finder_of_red()
    prototxt, caffemodel = caffe_files.write(tmp_path, steps, weights, SIDE_PX)
    prototxt.write_text(change(prototxt.read_text()))
    with pytest.raises(CaffeError, match=said) as refusal:
        import_caffe(prototxt, caffemodel, tmp_path / "out")
    assert str(prototxt) in str(refusal.value)
    assert not (tmp_path / "out").exists()


def _without_bias(weights: caffe_files.Weights) -> bytes:
    return caffe_files.caffemodel({k: w[:1] for k, w in weights.items()})  # type: ignore[misc]


def _changed(name: str, change: Callable[[Any], Any]) -> Callable[[caffe_files.Weights], bytes]:
    return lambda weights: caffe_files.caffemodel(
        weights | {name: (change(weights[name][0]), weights[name][1])}
    )


DAMAGED_WEIGHTS: dict[str, tuple[Callable[[caffe_files.Weights], bytes], str]] = {
    "empty": (lambda _: b"", "no layer with weights"),
    "text": (lambda _: b"<html>Not found</html>", "no caffemodel"),
    "cut": (lambda w: caffe_files.caffemodel(w)[:-30], "not downloaded whole"),
    "prototxt": (lambda _: caffe_files.prototxt(a_finder_of_red()[0]).encode(), "no caffemodel"),
    "another net's": (
        lambda w: caffe_files.caffemodel({"x" + k: v for k, v in w.items()}),
        "no weights for layer red",
    ),
    "no bias": (_without_bias, "has 1 blobs for layer red"),
    "other shape": (_changed("red", lambda w: w[:, :2]), "belong to different networks"),
    "nan": (_changed("red", lambda w: w * np.nan), "not all numbers"),
}


@pytest.mark.parametrize("damage", DAMAGED_WEIGHTS)
def test_other_caffemodels_are_refused_with_a_reason(tmp_path: Path, damage: str) -> None:
    change, said = DAMAGED_WEIGHTS[damage]
    steps, weights = a_finder_of_red()
    prototxt, caffemodel = caffe_files.write(tmp_path, steps, weights, SIDE_PX)
    caffemodel.write_bytes(change(weights))
    with pytest.raises(CaffeError, match=said) as refusal:
        import_caffe(prototxt, caffemodel, tmp_path / "out")
    assert caffemodel.name in str(refusal.value)
    assert not (tmp_path / "out").exists()


def test_any_bytes_are_read_or_refused(tmp_path: Path) -> None:
    whole = np.frombuffer(caffe_files.caffemodel(a_finder_of_red()[1]), np.uint8)
    rng = np.random.default_rng(0)
    path = tmp_path / "any.caffemodel"
    refused = 0
    for i in range(400):
        data = rng.integers(0, 256, 60).astype(np.uint8) if i % 2 else whole.copy()
        data[rng.integers(0, 60, 3)] = rng.integers(0, 256, 3)
        path.write_bytes(data[: rng.integers(1, len(data))].tobytes())
        try:
            read_caffemodel(path)
        except CaffeError:
            refused += 1
    assert refused > 300


def _torch_forward(
    steps: Sequence[Step], weights: caffe_files.Weights, batch: NDArray[np.uint8]
) -> NDArray[np.float32]:
    torch = pytest.importorskip("torch")
    from torch.nn import functional

    blobs = {k: torch.from_numpy(v) for k, v in caffe_files.network_input(batch).items()}
    last = ""
    for step in steps:
        if isinstance(step, Conv):
            weight, bias = (torch.from_numpy(v) for v in weights[step.name])
            last = step.top
            blobs[last] = functional.conv2d(
                blobs[step.bottom], weight, bias, padding=step.kernel // 2
            )
        elif isinstance(step, Relu):
            blobs[step.blob] = torch.relu(blobs[step.blob])
        elif isinstance(step, Drop):
            blobs[step.blob] = functional.dropout(blobs[step.blob], training=False)
        elif isinstance(step, Cat):
            blobs[step.top] = torch.cat([blobs[b] for b in step.bottoms], 1)
        else:
            pool = functional.avg_pool2d if step.mean else functional.max_pool2d
            blobs[step.top] = pool(blobs[step.bottom], step.kernel, step.stride, ceil_mode=True)
    maps: NDArray[np.float32] = blobs[last].numpy()
    return maps


@pytest.mark.parametrize("make", [caffe_files.vgg_like, caffe_files.nine_by_nine])
def test_whole_networks_at_368_px_agree_with_torch(
    tmp_path: Path, make: Callable[..., list[Step]]
) -> None:
    """All six stages, an eighth of the published width."""
    pytest.importorskip("torch")
    steps = make(divide=8)
    weights = caffe_files.random_weights(steps)
    card = import_caffe(*caffe_files.write(tmp_path, steps, weights, 368), tmp_path)
    batch = images(1, 368)
    truth = _torch_forward(steps, weights, batch)
    assert truth.shape == (1, 15, 46, 46)
    maps = OnnxModel(tmp_path, card.name).run(batch)
    np.testing.assert_allclose(maps, truth, atol=2e-4 * np.abs(truth).max())
