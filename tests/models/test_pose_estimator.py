"""From a network's maps to joints in the photo, on a network small enough to know its answers."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from library_store.skeleton import L_HIP, LSP14, R_HIP
from models import PersonBox, PoseEstimator
from tests.models import tiny_onnx
from tests.models.tiny_onnx import node, planes

RENDERS = Path(__file__).parents[1] / "data" / "renders"
BRIGHT = np.array([150.0, 200.0, 250.0])


@pytest.fixture(params=[True, False], ids=["depths", "none"])
def estimator(tmp_path: Path, request: pytest.FixtureRequest) -> PoseEstimator:
    """Takes the brightest blue for the 1st, 4th, ... joint, and its brightness for the depth."""
    deep: bool = request.param
    depths = [
        node("ReduceMax", ["planes"], "bright", axes=[2, 3], keepdims=0),
        node("ReduceMax", ["bright"], "most", axes=[1]),
        node("Concat", ["bright"] * 4 + ["most"] * 2, "depths", axis=1),
    ]
    data = tiny_onnx.model(
        planes(
            node("Concat", ["planes"] * 5, "all", axis=1), *(depths if deep else ()), last="all"
        ),
        also="depths" if deep else None,
    )
    output: Any = tiny_onnx.card("tiny", data)["output"]
    output |= {"joint_names": LSP14.joint_names, "depths": deep}
    tiny_onnx.write(tmp_path, "tiny", data, output=output)
    return PoseEstimator("tiny", weights_dir=tmp_path)


def photo(size: int) -> tuple[NDArray[np.uint8], PersonBox]:
    """A black square with a bright spot, and the box about its middle."""
    image = np.zeros((size, size, 3), np.uint8)
    middle = slice(size // 2 - size // 16, size // 2 + size // 16)
    image[middle, middle] = BRIGHT
    return image, PersonBox(size / 4, size / 4, size / 2, size / 2, 1.0)


def test_depths_are_in_pixels_of_the_photo(estimator: PoseEstimator) -> None:
    for size in (128, 256, 512):
        image, box = photo(size)
        (found,) = estimator.estimate(image, [box])
        np.testing.assert_allclose(found.positions_px, size / 2, atol=0.1 * size)
        if not estimator.card.output.model_dump()["depths"]:
            assert found.depths_px is None
            continue
        assert found.depths_px is not None
        side_px = 1.25 * size / 2
        expected = BRIGHT[np.arange(14) % 3] * side_px
        expected[12:] = BRIGHT.max() * side_px
        np.testing.assert_allclose(found.depths_px, expected, rtol=1e-3)


def test_people_are_told_apart(estimator: PoseEstimator) -> None:
    image, box = photo(256)
    wide = np.concatenate([image, image // 2], 1)
    other = PersonBox(box.x_px + 256, box.y_px, box.width_px, box.height_px, 1.0)
    found = estimator.estimate(wide, [box, other])
    for person, own in zip(found, (box, other), strict=True):
        (alone,) = estimator.estimate(wide, [own])
        assert (person.depths_px is None) == (alone.depths_px is None)
        if person.depths_px is not None and alone.depths_px is not None:
            np.testing.assert_allclose(person.depths_px, alone.depths_px, rtol=1e-6)


@pytest.mark.parametrize(("level", "taken"), [(83, False), (120, True)])
def test_a_cut_off_person_s_larger_view_counts_where_it_is_plainly_believed_in_more(
    tmp_path: Path, level: int, taken: bool
) -> None:
    """Joints, spread and depths are then those of that view."""
    # Belief and depths grow with the brightest spot of the crop: 80 is believed in by 0.18.
    data = tiny_onnx.model(
        planes(
            tiny_onnx.constant("middle", np.array([128.0], np.float32)),
            tiny_onnx.constant("unit", np.array([32.0], np.float32)),
            node("Sub", ["planes", "middle"], "lighter"),
            node("Div", ["lighter", "unit"], "logits"),
            node("ReduceMax", ["planes"], "bright", axes=[2, 3], keepdims=0),
            node("ReduceMax", ["bright"], "most", axes=[1]),
            node("Concat", ["bright"] * 4 + ["most"] * 2, "depths", axis=1),
            node("Concat", ["logits"] * 5, "all", axis=1),
            last="all",
        ),
        also="depths",
    )
    output: Any = tiny_onnx.card("tiny", data)["output"]
    output |= {"joint_names": LSP14.joint_names, "depths": True}
    tiny_onnx.write(tmp_path, "tiny", data, output=output)
    estimator = PoseEstimator("tiny", weights_dir=tmp_path)
    image = np.zeros((400, 400, 3), np.uint8)
    image[330:370, 180:220] = 80
    image[330:370, 94:134] = level  # beside the crop, but not beside that of the whole person
    (found,) = estimator.estimate(image, [PersonBox(150.0, 300.0, 100.0, 95.0, 1.0)])
    assert found.depths_px is not None
    at, side_px, seen = (114, 1.25 * 1.8 * 95, level) if taken else (200, 1.25 * 100, 80)
    np.testing.assert_allclose(found.positions_px, np.tile([at, 350.0], (14, 1)), atol=8)
    np.testing.assert_allclose(found.depths_px, seen * side_px, rtol=0.02)


@pytest.mark.parametrize("name", ["cpm", "cpm-int8"])
def test_the_shipped_networks_see_which_limb_is_nearer(name: str) -> None:
    """Of people with exact truth, and as well of their mirror images."""
    estimator = PoseEstimator(name)
    read, true = [], []
    for render in json.loads((RENDERS / "ground_truth.json").read_text())["images"]:
        image = np.asarray(cv2.imread(str(RENDERS / render["file"])), np.uint8)
        joints_px, joints_mm = np.array(render["joints_2d_px"]), np.array(render["joints_3d_mm"])
        hips_mm = joints_mm[[R_HIP, L_HIP], 2].mean()
        depths_px = (joints_mm[:, 2] / hips_mm - 1) * render["K"][0][0]
        (x, y), (width, height) = joints_px.min(0), np.ptp(joints_px, axis=0)
        right = image.shape[1] - 1 - (x + width)
        mirrored = np.ascontiguousarray(image[:, ::-1])
        for photo, left, names in (
            (image, x, list(range(14))),
            (mirrored, right, list(LSP14.mirror)),
        ):
            (found,) = estimator.estimate(photo, [PersonBox(left, y, width, height, 1.0)])
            assert found.depths_px is not None
            read.append(found.depths_px[names] / height)
            true.append(depths_px / height)
    assert np.corrcoef(np.ravel(read), np.ravel(true))[0, 1] > 0.5, "of four people"
    apart = np.abs(np.subtract(read[0::2], read[1::2])).mean()
    assert apart < 0.5 * np.abs(true).mean()
