"""Pictures: viewpoints are rotations, and what is drawn lies where the joints are."""

from __future__ import annotations

import numpy as np
import pytest

from app.drawing import NOVEL_VIEWS, Viewpoint, draw_overlay, draw_skeletons
from app.imaging import decode_photo
from app.lifting.types import NotLiftable
from app.pipeline import SeenPerson
from tests.app.conftest import Render


@pytest.mark.parametrize("view", NOVEL_VIEWS)
def test_views_are_rotations(view: Viewpoint) -> None:
    rotation = view.rotation()
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1)


def test_raising_the_view_looks_down() -> None:
    """Seen from above, what is farther from the photo's camera is higher in the picture."""
    rotation = Viewpoint("", 0, 30).rotation()
    assert (rotation @ [0, 0, 1000])[1] < 0
    np.testing.assert_allclose(Viewpoint("", 0, 0).rotation(), np.eye(3))


def test_the_overlay_marks_the_joints(renders: list[Render]) -> None:
    render = renders[0]
    photo = decode_photo(render.data, max_pixels=10**7, side_px=1280)
    person = SeenPerson(
        box_px=(0, 0, 10, 10),
        score=None,
        joints_px=render.joints_px,
        present=np.ones(14, bool),
        confidence=None,
        sigma_px=None,
        lifted=NotLiftable("not tried"),
    )
    plain = draw_overlay(photo, [], height_px=480).astype(int)
    marked = draw_overlay(photo, [person], height_px=480).astype(int)
    changed = np.abs(marked - plain).max(axis=2) > 20
    x, y = np.round(render.joints_px).astype(int).T
    assert changed[y, x].mean() > 0.8
    assert changed.mean() < 0.1


def test_skeletons_and_nobody(renders: list[Render]) -> None:
    poses = [render.joints_mm for render in renders]
    for view in NOVEL_VIEWS:
        drawn = draw_skeletons(poses, view, side_px=300)
        assert drawn.shape == (300, 300, 3)
        empty = draw_skeletons([], view, side_px=300)
        assert (drawn != empty).any()
