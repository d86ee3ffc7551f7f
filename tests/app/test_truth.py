"""The whole service against exact ground truth: renders with known joints, camera and pose.

The floors are what the weights in the repository reach with something to spare: raise them with
every better network.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.app.conftest import Render
from tests.app.server import Server
from tests.app.test_lift_over_http import root_relative_error_mm
from tests.app.test_poses_over_http import joints_px, post, project

PCK_FLOOR = 0.7
ERROR_CEILING_MM = 230.0


@pytest.fixture(scope="module")
def found(server: Server, renders: list[Render]) -> list[tuple[Render, dict[str, Any]]]:
    """Each render with the person in it, looked for where they are."""
    query = "focal_length_px={:.4f}&box_px={}"
    return [
        (
            render,
            post(server, render.data, query.format(render.focal_length_px, render.box_px()))[
                "people"
            ][0],
        )
        for render in renders
    ]


def overlap(box_px: list[float], render: Render) -> float:
    """Intersection over union of an answered box and the true extent of the joints."""
    x, y, width, height = box_px
    low, high = render.joints_px.min(axis=0), render.joints_px.max(axis=0)
    common = np.minimum(high, [x + width, y + height]) - np.maximum(low, [x, y])
    shared = float(np.prod(np.maximum(common, 0)))
    return shared / (width * height + float(np.prod(high - low)) - shared)


def test_people_are_found(server: Server, renders: list[Render]) -> None:
    """The service finds the one person by itself in most renders, and knows where."""
    hits = 0
    for render in renders:
        people = post(server, render.data)["people"]
        hits += len(people) == 1 and overlap(people[0]["box_px"], render) > 0.5
    assert hits >= len(renders) - 1


def test_joints_2d(found: list[tuple[Render, dict[str, Any]]]) -> None:
    """PCK@0.2: within a fifth of the torso's diagonal."""
    correct = []
    for render, person in found:
        joints = render.joints_px
        torso = max(np.linalg.norm(joints[2] - joints[11]), np.linalg.norm(joints[5] - joints[8]))
        distance = np.linalg.norm(joints_px(person) - joints, axis=1)
        correct.append(distance < 0.2 * torso)
    assert np.mean(correct) > PCK_FLOOR, np.mean(correct, axis=1)


def test_pose_3d(found: list[tuple[Render, dict[str, Any]]]) -> None:
    errors = [root_relative_error_mm(person, render) for render, person in found]
    assert np.mean(errors) < ERROR_CEILING_MM, errors


def test_where_the_person_stands(found: list[tuple[Render, dict[str, Any]]]) -> None:
    """The direction is exact; the distance is as uncertain as the person's size."""
    for render, person in found:
        root = np.array(person["root_mm"])
        truth = render.joints_mm[[8, 11]].mean(axis=0)
        assert np.linalg.norm(root) == pytest.approx(np.linalg.norm(truth), rel=0.2)
        cosine = root @ truth / (np.linalg.norm(root) * np.linalg.norm(truth))
        assert np.degrees(np.arccos(min(1.0, cosine))) < 3


def test_answer_projects_onto_the_joints(found: list[tuple[Render, dict[str, Any]]]) -> None:
    """All joints do, but for those set aside as contradicting the rest (two at the most)."""
    for render, person in found:
        points = np.array([[j["x_mm"], j["y_mm"], j["z_mm"]] for j in person["joints_3d"]])
        residual = np.linalg.norm(project(points, person["camera"]) - joints_px(person), axis=1)
        if "inconsistent_joints" in person["warnings"]:
            residual = np.sort(residual)[:-2]
        assert residual.mean() < 0.06 * np.ptp(render.joints_px[:, 1])
