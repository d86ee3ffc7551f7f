"""POST /v1/lift: 2D in, 3D out, over a real socket."""

from __future__ import annotations

import json
import re
from typing import Any

import numpy as np
import pytest

from app.schemas import LiftAnswer
from library_store.conversion import CONVERSIONS
from library_store.skeleton import L_ANKLE, LSP14, R_ANKLE
from tests.app.conftest import Render
from tests.app.server import Server
from tests.app.test_errors_over_http import problem
from tests.app.test_poses_over_http import boxed, joints_mm, joints_px, project


def person_of(render: Render, leave_out: tuple[int, ...] = ()) -> dict[str, Any]:
    return {
        "joints_2d": [
            {"name": name, "x_px": x, "y_px": y}
            for joint, (name, (x, y)) in enumerate(
                zip(LSP14.joint_names, render.joints_px.tolist(), strict=True)
            )
            if joint not in leave_out
        ]
    }


def request_of(render: Render, **fields: Any) -> dict[str, Any]:
    return {
        "image": {"width_px": render.width_px, "height_px": render.height_px},
        "focal_length_px": render.focal_length_px,
        "people": [person_of(render)],
        **fields,
    }


def lift(server: Server, body: dict[str, Any]) -> list[dict[str, Any]]:
    response = server.client.post("/v1/lift", json=body)
    assert response.status_code == 200, response.text
    LiftAnswer.model_validate_json(response.content)
    people: list[dict[str, Any]] = response.json()["people"]
    return people


def root_relative_error_mm(person: dict[str, Any], render: Render) -> float:
    hips = [LSP14.index("r_hip"), LSP14.index("l_hip")]
    found, truth = joints_mm(person), render.joints_mm
    found = found - found[hips].mean(axis=0)
    truth = truth - truth[hips].mean(axis=0)
    return float(np.linalg.norm(found - truth, axis=1).mean())


@pytest.mark.parametrize(
    ("once", "twice", "name"),
    [
        ('"people":', '"people": [], "people":', "people"),
        ('"x_px":', '"x_px": 1.0, "x_px":', "x_px"),
        ('"width_px":', '"width_px": 1, "width_px":', "width_px"),
        ('"name":', '"na\\u006de": "neck", "name":', "name"),
    ],
)
def test_members_given_twice_are_refused(
    server: Server, renders: list[Render], once: str, twice: str, name: str
) -> None:
    body = json.dumps(request_of(renders[0])).replace(once, twice, 1)
    response = server.client.post("/v1/lift", content=body)
    (error,) = problem(response, 422, "invalid-input")["errors"]
    assert error == {"where": name, "message": "given twice in one object"}


def test_true_joints_give_nearly_the_true_pose(server: Server, renders: list[Render]) -> None:
    errors = []
    for render in renders:
        (person,) = lift(server, request_of(render))
        assert person["camera"]["focal_source"] == "request"
        np.testing.assert_allclose(joints_px(person), render.joints_px, atol=0.001)
        errors.append(root_relative_error_mm(person, render))
        seen = project(joints_mm(person), person["camera"])
        assert np.linalg.norm(seen - render.joints_px, axis=1).mean() < 10
    assert np.mean(errors) < 120, errors


def test_what_was_found_in_a_photo_lifts_to_nearly_the_same(
    server: Server, renders: list[Render]
) -> None:
    """The paper's method takes nothing from the photo but the joints and how sure they are.

    Joints are answered in thousandths of a pixel: where two exemplars explain a photo equally well,
    that decides between them, so not each of the answers but half of them have to be the same.
    """
    apart_mm = []
    for render in renders:
        (seen,) = boxed(server, render, "method=paper&candidates=0")["people"]
        body = request_of(render, method="paper", candidates=0, focal_length_px=None)
        joints = [
            {
                key: joint[key]
                for key in ("name", "x_px", "y_px", "confidence")
                if joint[key] is not None
            }
            for joint in seen["joints_2d"]
        ]
        (lifted,) = lift(server, body | {"people": [{"joints_2d": joints}]})
        apart = joints_mm(lifted) - lifted["root_mm"] - joints_mm(seen) + seen["root_mm"]
        apart_mm.append(np.linalg.norm(apart, axis=1).mean())
    assert np.median(apart_mm) < 100, apart_mm


def test_people_do_not_influence_each_other(server: Server, renders: list[Render]) -> None:
    together = lift(server, request_of(renders[0], people=[person_of(r) for r in renders]))
    alone = [lift(server, request_of(renders[0], people=[person_of(r)]))[0] for r in renders]
    assert together == alone


def test_missing_joints(server: Server, renders: list[Render]) -> None:
    missing = (R_ANKLE, L_ANKLE)
    left_out = person_of(renders[0], leave_out=missing)
    unsure = person_of(renders[0])
    for joint in missing:
        unsure["joints_2d"][joint] |= {"confidence": 0, "x_px": -5e5, "y_px": 9e5}
    a, b = lift(server, request_of(renders[0], people=[left_out, unsure]))
    assert a == b
    assert len(a["joints_2d"]) == 12, "what was not given is not made up"
    assert len(a["joints_3d"]) == 14
    assert "truncated" in a["warnings"]


def test_too_few_joints_are_not_lifted(server: Server, renders: list[Render]) -> None:
    people = [
        person_of(renders[0], leave_out=tuple(range(4, 14))),
        {"joints_2d": []},
        person_of(renders[0]),
    ]
    few, none, whole = lift(server, request_of(renders[0], people=people))
    for person in (few, none):
        assert person["joints_3d"] is None
        assert person["exemplar"] is None
        assert person["camera"] is None
        assert person["candidates"] == []
        assert person["warnings"]
    assert len(few["joints_2d"]) == 4
    assert whole["joints_3d"] is not None


def test_defaults_are_those_of_photos(server: Server, renders: list[Render]) -> None:
    (person,) = lift(server, request_of(renders[0], focal_length_px=None))
    assert person["camera"]["focal_source"] == "assumed"
    assert person["camera"]["focal_length_px"] == pytest.approx(614.7, abs=0.1)
    assert person["camera"]["principal_point_px"] == [319.5, 239.5]


def test_nobody_and_many(server: Server, renders: list[Render]) -> None:
    assert lift(server, request_of(renders[0], people=[])) == []
    crowd = [person_of(renders[0])] * 256
    assert len(lift(server, request_of(renders[0], people=crowd, candidates=0))) == 256
    too_many = request_of(renders[0], people=[*crowd, crowd[0]])
    body = problem(server.client.post("/v1/lift", json=too_many), 422, "invalid-input")
    assert body["errors"][0]["where"] == "people"


@pytest.mark.parametrize(
    ("change", "where"),
    [
        ({"skeleton": "coco25"}, "skeleton"),
        ({"focal_length_px": -1}, "focal_length_px"),
        ({"image": {"width_px": 0, "height_px": 5}}, "image.width_px"),
        ({"colour": "red"}, "colour"),
        ({"body": []}, "body"),
        ({"people": [{"joints_2d": [{"name": "nose", "x_px": 1, "y_px": 2}]}]}, "people"),
        (
            {"people": [{"joints_2d": [{"name": "neck", "x_px": 1, "y_px": 2}] * 2}]},
            "people.0",
        ),
        (
            {"people": [{"joints_2d": [{"name": "neck", "x_px": 1e9, "y_px": 2}]}]},
            "people.0.joints_2d.0.x_px",
        ),
        ({"people": [{"joints_2d": [{"name": "neck", "x_px": 1}]}]}, "people.0.joints_2d.0.y_px"),
        ({"principal_point_px": [10, 1e7]}, "principal_point_px.1"),
    ],
)
def test_bad_values_are_named(
    server: Server, renders: list[Render], change: dict[str, Any], where: str
) -> None:
    response = server.client.post("/v1/lift", json=request_of(renders[0]) | change)
    assert problem(response, 422, "invalid-input")["errors"][0]["where"] == where


@pytest.mark.parametrize("body", [b"{", b"\xff\xfe", b"[" * 100_000])
def test_no_json(server: Server, body: bytes) -> None:
    problem(server.client.post("/v1/lift", content=body), 400, "malformed-body")


def test_no_json_is_placed_for_the_client_and_not_quoted_in_the_log(server: Server) -> None:
    response = server.client.post("/v1/lift", content=b'{"image": of-somebody}')
    body = problem(response, 400, "malformed-body")
    assert body["detail"] == "the body is not JSON: expected value at line 1 column 11"
    assert "of-somebody" not in server.log.read_text()


def test_a_whole_number_may_have_a_point(server: Server, renders: list[Render]) -> None:
    """In JSON Schema 640.0 is an integer, and some languages write it so."""
    body = request_of(renders[0])
    size = body["image"]
    pointed = {"image": {name: float(value) for name, value in size.items()}, "candidates": 3.0}
    answers = [server.client.post("/v1/lift", json=body | change) for change in ({}, pointed)]
    assert [answer.status_code for answer in answers] == [200, 200]
    assert len({json.dumps(answer.json()["people"]) for answer in answers}) == 1
    for value in (640.5, "640", True):
        response = server.client.post("/v1/lift", json=body | {"image": size | {"width_px": value}})
        assert problem(response, 422, "invalid-input")["errors"][0]["where"] == "image.width_px"


def test_zero_has_one_text(server: Server, renders: list[Render]) -> None:
    body = request_of(renders[0])
    body["people"][0]["joints_2d"][0]["x_px"] = -0.0
    answer = server.client.post("/v1/lift", json=body)
    assert answer.status_code == 200
    assert not re.search(r"-0\.0\b", answer.text)


def test_nan_is_no_coordinate(server: Server) -> None:
    text = '{"image":{"width_px":9,"height_px":9},"people":[{"joints_2d":'
    text += '[{"name":"neck","x_px":NaN,"y_px":1}]}]}'
    body = problem(server.client.post("/v1/lift", content=text.encode()), 422, "invalid-input")
    assert body["detail"] == "people.0.joints_2d.0.x_px: Input should be a finite number"


def in_skeleton(render: Render, name: str, leave_out: tuple[str, ...] = ()) -> dict[str, Any]:
    """The render's person with the joints of another skeleton; its face is unknown."""
    conversion = CONVERSIONS[name]
    points = conversion.from_lsp14 @ render.joints_px
    return {
        "joints_2d": [
            {"name": joint, "x_px": x, "y_px": y}
            for joint, (x, y) in zip(conversion.skeleton.joint_names, points.tolist(), strict=True)
            if np.isfinite(x) and joint not in leave_out
        ]
    }


def test_human36m_joints_give_what_the_same_lsp14_joints_give(
    server: Server, renders: list[Render]
) -> None:
    render = renders[0]
    (ours,) = lift(server, request_of(render))
    (theirs,) = lift(
        server, request_of(render, skeleton="h36m17", people=[in_skeleton(render, "h36m17")])
    )
    assert theirs == ours


@pytest.mark.parametrize("name", ["coco17", "openpose18", "mediapipe33"])
def test_skeletons_of_photos_are_lifted_nearly_as_well(
    server: Server, renders: list[Render], name: str
) -> None:
    ours, theirs = [], []
    for render in renders:
        (person,) = lift(server, request_of(render))
        ours.append(root_relative_error_mm(person, render))
        (person,) = lift(
            server, request_of(render, skeleton=name, people=[in_skeleton(render, name)])
        )
        theirs.append(root_relative_error_mm(person, render))
    assert np.mean(theirs) < 1.5 * np.mean(ours) + 20


@pytest.mark.parametrize("name", ["coco17", "h36m17"])
def test_answers_come_in_other_skeletons(server: Server, renders: list[Render], name: str) -> None:
    render = renders[0]
    body = request_of(render, answer_skeleton=name)
    response = server.client.post("/v1/lift", json=body)
    LiftAnswer.model_validate_json(response.content)
    assert response.json()["skeleton"]["name"] == name
    (person,) = response.json()["people"]
    (ours,) = lift(server, request_of(render))
    conversion = CONVERSIONS[name]
    known = np.isfinite(conversion.from_lsp14).all(axis=1)
    names = np.array(conversion.skeleton.joint_names)[known].tolist()
    assert [j["name"] for j in person["joints_2d"]] == names
    assert [j["name"] for j in person["joints_3d"]] == names
    pose = person["exemplar"]["joints_mm"]
    assert [row is not None for row in pose] == known.tolist()
    wanted = conversion.from_lsp14[known] @ np.array(ours["exemplar"]["joints_mm"])
    np.testing.assert_allclose(
        [row for row in pose if row is not None], wanted, atol=0.002, rtol=1e-9
    )
    at = {j["name"]: [j["x_mm"], j["y_mm"], j["z_mm"]] for j in person["joints_3d"]}
    ours_at = {j["name"]: [j["x_mm"], j["y_mm"], j["z_mm"]] for j in ours["joints_3d"]}
    assert at["right_wrist"] == ours_at["r_wrist"]
    for joint in person["joints_3d"]:
        assert joint["sigma_mm"] > 0


def test_joints_of_another_skeleton_than_named_are_refused(
    server: Server, renders: list[Render]
) -> None:
    render = renders[0]
    body = request_of(render, people=[in_skeleton(render, "coco17")])
    document = problem(server.client.post("/v1/lift", json=body), 422, "invalid-input")
    assert "unknown joints of lsp14 in people.0: ['left_ankle'" in str(document)


def test_lifted_people_count_in_the_metrics(server: Server, renders: list[Render]) -> None:
    names = (
        'posematch_people_total{source="joints"}',
        'posematch_people_total{source="photo"}',
        'posematch_stage_seconds_count{stage="match"}',
        "posematch_far_from_library_total",
    )
    lift(server, request_of(renders[0]))
    server.client.post("/v1/poses", content=renders[0].data)
    before = [server.metric(name) for name in names]
    people = lift(server, request_of(renders[0], people=[person_of(renders[0])] * 3))
    far = sum("far_from_library" in person["warnings"] for person in people)
    after = [server.metric(name) for name in names]
    assert [b - a for a, b in zip(before, after, strict=True)] == [3, 0, 1, far]
