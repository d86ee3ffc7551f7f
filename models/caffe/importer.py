"""The published Convolutional Pose Machines (Wei et al. 2016) -> our ONNX file and model card.

Behind ``posematch model import-caffe``. What the network needs besides the image (its scaling, the
map of the person's centre, the joints' order) goes into the graph, so that the card alone is
enough to serve it.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Literal

from library_store.skeleton import LSP14
from models.caffe.caffemodel import read_caffemodel
from models.caffe.graph import Graph, build
from models.caffe.net import read_net
from models.card import ModelCard, PoseOutput, printable, write_network
from models.errors import CaffeError
from models.session import OnnxModel

JointOrder = Literal["cpm", "lsp", "mpii"]
JOINT_ORDERS: dict[JointOrder, tuple[int, ...]] = {
    "cpm": tuple(range(15)),
    "lsp": (13, 12, 8, 7, 6, 9, 10, 11, 2, 1, 0, 3, 4, 5, 14),
    "mpii": (9, 8, 12, 11, 10, 13, 14, 15, 2, 1, 0, 3, 4, 5, 16),
}
"""Which of a network's maps is which lsp14 joint, the background's last.

``cpm``: the published networks, whether trained on MPII or on LSP, have our 14 joints in our order.
``lsp``, ``mpii``: networks that kept those data sets' own order (of MPII's 16 joints the pelvis and
the thorax are dropped).
"""
_N_MAPS: dict[JointOrder, int] = {"cpm": 15, "lsp": 15, "mpii": 17}

BODY_PX = 200 * 41 / 35
"""How tall people were made for training: 1.171 times MPII's reference of 200 px."""
JOINTS_OF_BODY = 0.95
"""The joints' extent over the height of a standing body: soles and hair are beyond."""
TARGET_SIGMA_PX = 7.0
"""Width of the training targets' Gaussians."""
GREY = 128
"""What the authors put beyond the photo's edge."""
LICENCE = (
    "the weights' authors': published for non-commercial use, trained on images with terms of "
    "their own; not part of this project, ask the authors before any other use"
)


def import_caffe(
    prototxt: Path,
    caffemodel: Path,
    out: Path,
    *,
    name: str = "cpm-original",
    joints: JointOrder = "cpm",
    licence: str = LICENCE,
) -> ModelCard:
    """Write ``out/name.onnx`` and ``out/name.json``; returns the card.

    Raises ``CaffeError``, naming the file, for what is no pose network or cannot be read, before
    anything is written.
    """
    try:
        text = prototxt.read_text("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise CaffeError(f"{prototxt} cannot be read as text: {error}") from error
    weights = read_caffemodel(caffemodel)
    try:
        graph = build(read_net(text), weights, JOINT_ORDERS[joints], _N_MAPS[joints])
    except CaffeError as error:
        raise CaffeError(f"{prototxt} with {caffemodel.name}: {error}") from error
    source = hashlib.sha256(caffemodel.read_bytes()).hexdigest()
    stem, file = printable(caffemodel.stem), printable(caffemodel.name)
    card = _card(graph, name, stem, f"{file} (sha256 {source})", licence)
    card = write_network(out, graph.data, card)
    OnnxModel(out, name)  # what was written is what the card says and runs
    return card


def _card(graph: Graph, name: str, version: str, source: str, licence: str) -> ModelCard:
    stride_px = graph.input_px / graph.map_cells
    return ModelCard(
        name=name,
        version=version,
        file=f"{name}.onnx",
        sha256=hashlib.sha256(graph.data).hexdigest(),
        description="Convolutional Pose Machine of Wei et al. 2016 with a map of the person's "
        f"centre, imported from {source}",
        parameters=graph.parameters,
        multiply_adds=graph.multiply_adds,
        output=PoseOutput(
            kind="pose",
            joint_names=list(LSP14.joint_names),
            input_px=graph.input_px,
            # 1.65 for 368 px: the share of the crop that people filled in training.
            crop_scale=round(graph.input_px / (JOINTS_OF_BODY * BODY_PX), 3),
            stride_px=stride_px,
            target_sigma_cells=TARGET_SIGMA_PX / stride_px,
            maps="beliefs",
            border_grey=GREY,
        ),
        training_data=["as the weights' authors say (the published ones: MPII, LSP)"],
        licence=licence,
        limits=[
            "confidence and sigma are not calibrated: they are null in every answer",
            "one person per crop, the one in its centre",
            "made for GPUs: see its cost",
        ],
        measured={},
    )
