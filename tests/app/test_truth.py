"""The whole service against exact ground truth: renders with known joints, camera and pose."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from tests.app.conftest import Render
from tests.app.server import Server
from tests.app.test_lift_over_http import root_relative_error_mm
from tests.app.test_poses_over_http import joints_px, post, project

Floats = npt.NDArray[np.float64]


@pytest.fixture(scope="module")
def found(server: Server, renders: list[Render]) -> list[tuple[Render, dict[str, Any]]]:
    """Each render with the person found in it; the service finds the person by itself."""
    pairs = []
    for render in renders:
        people = post(server, render.data, f"focal_length_px={render.focal_length_px}")["people"]
        assert len(people) == 1, f"{render.name}: {len(people)} people"
        pairs.append((render, people[0]))
    return pairs


def test_the_person_is_found(found: list[tuple[Render, dict[str, Any]]]) -> None:
    for render, person in found:
        x, y, width, height = person["box_px"]
        low, high = render.joints_px.min(axis=0), render.joints_px.max(axis=0)
        overlap = np.minimum(high, [x + width, y + height]) - np.maximum(low, [x, y])
        union = width * height + np.prod(high - low) - np.prod(overlap)
        assert (overlap > 0).all(), render.name
        assert np.prod(overlap) / union > 0.5, render.name


def test_joints_2d(found: list[tuple[Render, dict[str, Any]]]) -> None:
    """PCK@0.2: within a fifth of the torso's diagonal."""
    correct = []
    for render, person in found:
        joints = render.joints_px
        torso = max(np.linalg.norm(joints[2] - joints[11]), np.linalg.norm(joints[5] - joints[8]))
        distance = np.linalg.norm(joints_px(person) - joints, axis=1)
        correct.append(distance < 0.2 * torso)
    assert np.mean(correct) > 0.8, np.mean(correct, axis=1)


def test_pose_3d(found: list[tuple[Render, dict[str, Any]]]) -> None:
    errors = [root_relative_error_mm(person, render) for render, person in found]
    assert np.mean(errors) < 150, errors


def test_where_the_person_stands(found: list[tuple[Render, dict[str, Any]]]) -> None:
    """The direction is exact; the distance is as uncertain as the person's size."""
    for render, person in found:
        root = np.array(person["root_mm"])
        truth = render.joints_mm[[8, 11]].mean(axis=0)
        assert np.linalg.norm(root) == pytest.approx(np.linalg.norm(truth), rel=0.2)
        cosine = root @ truth / (np.linalg.norm(root) * np.linalg.norm(truth))
        assert np.degrees(np.arccos(min(1.0, cosine))) < 3


def test_answer_projects_onto_the_joints(found: list[tuple[Render, dict[str, Any]]]) -> None:
    for render, person in found:
        points = np.array([[j["x_mm"], j["y_mm"], j["z_mm"]] for j in person["joints_3d"]])
        residual = np.linalg.norm(project(points, person["camera"]) - joints_px(person), axis=1)
        assert residual.mean() < 0.06 * np.ptp(render.joints_px[:, 1])
