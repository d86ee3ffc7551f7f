"""POST /v1/poses and /v1/poses/batch: the contract's invariants, over a real socket."""

from __future__ import annotations

import re
from typing import Any

import cv2
import numpy as np
import pytest

from app.schemas import BatchAnswer, PosesAnswer
from library_store.skeleton import L_HIP, LSP14, R_HIP
from tests.app.conftest import RENDERS, Render
from tests.app.imaging.image_files import STORED, decode, encode, png_with_exif, tiff
from tests.app.server import Server

TIMINGS = re.compile(rb'"timings_ms":\{[^}]*\}')
STAGES = ["decode", "detect", "pose", "match", "camera", "warp", "total"]


def post(server: Server, data: bytes, query: str = "", **kwargs: Any) -> dict[str, Any]:
    response = server.client.post(f"/v1/poses?{query}", content=data, **kwargs)
    assert response.status_code == 200, response.text
    PosesAnswer.model_validate_json(response.content)
    answer: dict[str, Any] = response.json()
    return answer


def joints_px(person: dict[str, Any]) -> np.ndarray[Any, np.dtype[np.float64]]:
    return np.array([[joint["x_px"], joint["y_px"]] for joint in person["joints_2d"]])


def joints_mm(person: dict[str, Any]) -> np.ndarray[Any, np.dtype[np.float64]]:
    return np.array([[j["x_mm"], j["y_mm"], j["z_mm"]] for j in person["joints_3d"]])


def project(points: Any, camera: dict[str, Any]) -> np.ndarray[Any, np.dtype[np.float64]]:
    points = np.asarray(points)
    flat = camera["focal_length_px"] * points[:, :2] / points[:, 2:]
    return np.asarray(flat + camera["principal_point_px"], np.float64)


def boxed(server: Server, render: Render, query: str = "") -> dict[str, Any]:
    """The answer for the render's one person, found or not by the detector."""
    return post(server, render.data, f"box_px={render.box_px()}&{query}")


def test_the_surest_people_are_answered_most_certain_first(
    server: Server, renders: list[Render]
) -> None:
    """Fewer are the first of more."""
    shown = [decode(render.data).pixels_bgr for render in renders[:3]]
    small = [cv2.resize(pixels, None, fx=0.5, fy=0.5) for pixels in shown[1:]]
    photo = encode(np.hstack([shown[0], np.vstack(small)]), ".png")
    boxes = {}
    for wanted in (1, 2, 10):
        people = post(server, photo, f"max_people={wanted}")["people"]
        scores = [person["score"] for person in people]
        assert scores == sorted(scores, reverse=True)
        boxes[wanted] = [person["box_px"] for person in people]
    assert len(boxes[10]) == 3
    assert boxes[1] == boxes[10][:1]
    assert boxes[2] == boxes[10][:2]


def test_the_contract(server: Server, renders: list[Render]) -> None:
    answer = boxed(server, renders[0])
    assert answer["image"] == {"width_px": 640, "height_px": 480, "orientation_applied": 1}
    assert tuple(answer["skeleton"]["joint_names"]) == LSP14.joint_names
    assert [stage for stage in answer["timings_ms"] if stage != "wait"] == STAGES
    (person,) = answer["people"]
    assert person["score"] is None, "nothing was detected"
    assert [joint["name"] for joint in person["joints_2d"]] == list(LSP14.joint_names)
    assert len(person["candidates"]) == 3
    assert person["candidates"][0]["id"] == person["exemplar"]["id"]
    assert person["candidates"][0]["joints_mm"] == person["exemplar"]["joints_mm"]
    probabilities = [candidate["probability"] for candidate in person["candidates"]]
    assert probabilities == sorted(probabilities, reverse=True)
    assert person["camera"]["focal_source"] == "assumed"
    assert "assumed_focal" in person["warnings"]


def test_camera_places_the_exemplar(server: Server, renders: list[Render]) -> None:
    """R X + t of GET /v1/exemplars is the exemplar's joints_mm, and projects as far as it says."""
    answers = (boxed(server, render)["people"][0] for render in renders)
    # Which joints are set aside is not told.
    person = next(it for it in answers if "inconsistent_joints" not in it["warnings"])
    exemplar = server.client.get(f"/v1/exemplars/{person['exemplar']['id']}").json()
    camera = person["camera"]
    rotation = np.array(camera["rotation"])
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)
    assert np.linalg.det(rotation) == pytest.approx(1)
    placed = np.array(exemplar["joints_mm"]) @ rotation.T + camera["translation_mm"]
    np.testing.assert_allclose(placed, person["exemplar"]["joints_mm"], atol=0.01)
    used = np.array([joint["confidence"] >= 0.2 for joint in person["joints_2d"]])
    off_px = (project(person["exemplar"]["joints_mm"], camera) - joints_px(person))[used]
    rms_px = np.sqrt((off_px**2).sum(axis=1).mean())
    assert camera["reprojection_error_px"] == pytest.approx(rms_px, abs=0.01)
    assert exemplar["source"] == person["exemplar"]["source"]
    root = np.array(exemplar["joints_mm"])[[R_HIP, L_HIP]].mean(axis=0)
    np.testing.assert_allclose(root, 0, atol=0.1)


def test_root_is_the_midpoint_of_the_hips(server: Server, renders: list[Render]) -> None:
    (person,) = boxed(server, renders[0])["people"]
    hips = joints_mm(person)[[R_HIP, L_HIP]].mean(axis=0)
    np.testing.assert_allclose(person["root_mm"], hips, atol=0.01)


def test_candidates_never_change_the_answer(server: Server, renders: list[Render]) -> None:
    few, many = (boxed(server, renders[0], f"candidates={n}")["people"][0] for n in (0, 50))
    assert len(few.pop("candidates")) == 0
    assert len(many.pop("candidates")) == 30, "the whole shortlist"
    assert few == many


def test_probabilities_sum_to_one(server: Server, renders: list[Render]) -> None:
    (person,) = boxed(server, renders[0], "candidates=50")["people"]
    assert sum(c["probability"] for c in person["candidates"]) == pytest.approx(1, abs=1e-4)


def test_paper_answers_its_warped_exemplar(server: Server, renders: list[Render]) -> None:
    answer = boxed(server, renders[0], "method=paper")
    (person,) = answer["people"]
    assert answer["method"] == "paper"
    np.testing.assert_allclose(joints_mm(person), person["exemplar"]["warped_mm"], atol=0.01)


def test_replay_is_byte_identical(server: Server, renders: list[Render]) -> None:
    texts = set()
    for _ in range(3):
        response = server.client.post(
            "/v1/poses?candidates=10", content=renders[1].data, headers={"X-Request-ID": "replay"}
        )
        texts.add(TIMINGS.sub(b"", response.content))
    assert len(texts) == 1


@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_turned_photo_is_the_upright_photo(
    server: Server, renders: list[Render], orientation: int
) -> None:
    """Losslessly stored in every EXIF orientation, the answer is the same to the last digit."""
    pixels = cv2.imdecode(np.frombuffer(renders[0].data, np.uint8), cv2.IMREAD_COLOR)
    assert pixels is not None
    small = cv2.resize(pixels, (320, 240), interpolation=cv2.INTER_AREA)
    upright = post(server, encode(small, ".png"))
    stored = encode(STORED[orientation](small), ".png")
    turned = post(server, png_with_exif(stored, tiff(orientation)))
    assert turned["image"].pop("orientation_applied") == orientation
    upright["image"].pop("orientation_applied")
    assert turned["image"] == upright["image"]
    assert turned["people"] == upright["people"]


def test_form_and_raw_body_are_the_same(server: Server, photo: bytes) -> None:
    raw = post(server, photo)
    response = server.client.post("/v1/poses", files={"image": ("me.jpg", photo, "image/jpeg")})
    assert response.json()["people"] == raw["people"]


def test_focal_length_and_field_of_view_agree(server: Server, renders: list[Render]) -> None:
    by_focal = boxed(server, renders[0], "focal_length_px=614.713")["people"][0]
    by_angle = boxed(server, renders[0], "fov_deg=55")["people"][0]
    assert by_focal["camera"]["focal_source"] == "request"
    assert by_focal["camera"]["focal_length_px"] == 614.713
    assert by_angle["camera"]["focal_length_px"] == pytest.approx(614.713, abs=0.2)
    np.testing.assert_allclose(joints_mm(by_focal), joints_mm(by_angle), atol=20)


def test_a_mirrored_photo_is_answered_in_its_own_pixels(
    server: Server, renders: list[Render]
) -> None:
    """Flipping the file and saying so gives the flipped answer, joints keeping their names."""
    pixels = cv2.imdecode(np.frombuffer(renders[0].data, np.uint8), cv2.IMREAD_COLOR)
    assert pixels is not None
    straight = post(server, encode(pixels, ".png"), f"box_px={renders[0].box_px()}")
    x, y, width, height = (float(part) for part in renders[0].box_px().split(","))
    box = f"{639 - x - width},{y},{width},{height}"
    flipped = post(server, encode(pixels[:, ::-1], ".png"), f"mirrored=true&box_px={box}")
    (a,), (b,) = straight["people"], flipped["people"]
    np.testing.assert_allclose(joints_px(b), joints_px(a) * [-1, 1] + [639, 0], atol=0.01)
    np.testing.assert_allclose(joints_mm(b), joints_mm(a) * [-1, 1, 1], atol=0.5)
    assert a["exemplar"]["id"] == b["exemplar"]["id"]
    placed = project(b["exemplar"]["joints_mm"], b["camera"])
    expected = project(a["exemplar"]["joints_mm"], a["camera"]) * [-1, 1] + [639, 0]
    np.testing.assert_allclose(placed, expected, atol=0.1)
    assert np.linalg.det(np.array(b["camera"]["rotation"])) == pytest.approx(-1)


def test_subject_height_scales_without_changing_the_picture(
    server: Server, renders: list[Render]
) -> None:
    (usual,) = boxed(server, renders[0])["people"]
    (tall,) = boxed(server, renders[0], "subject_height_mm=2000")["people"]
    assert (usual["scale_source"], tall["scale_source"]) == ("library", "request")
    ratio = joints_mm(tall) / joints_mm(usual)
    np.testing.assert_allclose(ratio, ratio[0, 2], rtol=0.02)
    exemplar = server.client.get(f"/v1/exemplars/{tall['exemplar']['id']}").json()
    camera = tall["camera"]
    turned = np.array(exemplar["joints_mm"]) @ np.array(camera["rotation"]).T
    placed = camera["scale"] * turned + camera["translation_mm"]
    np.testing.assert_allclose(placed, tall["exemplar"]["joints_mm"], atol=0.02)
    assert usual["camera"]["scale"] == 1


def test_nobody_is_an_answer(server: Server) -> None:
    grey = encode(np.full((480, 640, 3), 127, np.uint8), ".jpg")
    assert post(server, grey)["people"] == []


@pytest.mark.parametrize("size", [(1, 1), (1, 3000), (3000, 1), (5, 7)])
def test_odd_sizes_are_answered(server: Server, size: tuple[int, int]) -> None:
    answer = post(server, encode(np.full((*size, 3), 90, np.uint8), ".png"))
    assert (answer["image"]["height_px"], answer["image"]["width_px"]) == size
    box = post(server, encode(np.full((*size, 3), 90, np.uint8), ".png"), "box_px=-9,-9,50,90")
    assert len(box["people"]) == 1


def test_heic_is_answered(server: Server, renders: list[Render]) -> None:
    """The same person as in the JPEG, within what the coarser compression moves joints."""
    data = (RENDERS / "000.heic").read_bytes()
    query = f"box_px={renders[0].box_px()}"
    (person,) = post(server, data, query)["people"]
    (original,) = post(server, renders[0].data, query)["people"]
    distance = np.linalg.norm(joints_px(person) - joints_px(original), axis=1)
    assert np.median(distance) < 4


def test_batch(server: Server, renders: list[Render]) -> None:
    files = [
        ("image", ("a.jpg", renders[0].data)),
        ("image", ("b.jpg", renders[1].data[:9000])),
        ("image", ("c.gif", b"GIF89a" + bytes(40))),
        ("image", ("d.jpg", b"")),
    ]
    response = server.client.post("/v1/poses/batch", files=files)
    assert response.status_code == 200
    BatchAnswer.model_validate_json(response.content)
    images = response.json()["images"]
    assert [image["name"] for image in images] == ["a.jpg", "b.jpg", "c.gif", "d.jpg"]
    assert images[0]["problem"] is None
    assert images[0]["answer"]["people"] == post(server, renders[0].data)["people"]
    assert [image["problem"]["status"] for image in images[1:]] == [422, 415, 400]
    too_many = server.client.post("/v1/poses/batch", files=[files[0]] * 5)
    assert too_many.status_code == 422
    assert server.client.post("/v1/poses/batch", content=renders[0].data).status_code == 400
