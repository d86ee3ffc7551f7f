"""Pictures: viewpoints are rotations, marks lie where the joints are, PNG and SVG agree."""

from __future__ import annotations

import re
from dataclasses import replace
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest

from app.drawing import (
    NOVEL_VIEWS,
    PICTURE_TYPES,
    Viewpoint,
    draw_novel_view,
    draw_overlay,
    draw_result,
    encode_picture,
    to_pixels,
    to_svg,
)
from app.drawing.picture import Disc, Picture, Stroke, Words
from app.engine import Engine, load_engine
from app.imaging import decode_photo
from app.imaging.decode import Photo
from app.lifting.types import LiftedPerson, NotLiftable
from app.pipeline import PhotoQuery, PhotoResult, SeenPerson
from app.settings import Settings
from tests.app.conftest import Render


@pytest.fixture(scope="module")
def engine(library_dir: object) -> Engine:
    return load_engine(Settings(library_dir=library_dir))


@pytest.fixture(scope="module")
def seen(engine: Engine, renders: list[Render]) -> tuple[Photo, PhotoResult]:
    """A render and what the pipeline finds in it."""
    data = renders[0].data
    result = engine.pipeline.estimate(data, PhotoQuery(box_px=(120, 40, 330, 420)))
    return decode_photo(data, max_pixels=10**7, side_px=1280), result


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


def test_turning_the_view_goes_to_the_right() -> None:
    """Somebody at the camera's right sees depth running to their right, and the right nearest."""
    rotation = Viewpoint("", 90, 0).rotation()
    np.testing.assert_allclose(rotation @ [0, 0, 1], [1, 0, 0], atol=1e-12)
    assert (rotation @ [1, 0, 0])[2] < 0


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
    plain = to_pixels(draw_overlay(photo, [], height_px=480)).astype(int)
    marked = to_pixels(draw_overlay(photo, [person], height_px=480)).astype(int)
    changed = np.abs(marked - plain).max(axis=2) > 20
    x, y = np.round(render.joints_px).astype(int).T
    assert changed[y, x].mean() > 0.8
    assert changed.mean() < 0.1
    # Joints that are not there are not drawn.
    nobody = replace(person, present=np.zeros(14, bool))
    assert (to_pixels(draw_overlay(photo, [nobody], height_px=480)) == plain).all()


def test_the_overlay_of_a_reduced_photo_is_the_same(renders: list[Render]) -> None:
    """Joints are in pixels of the full photo, wherever the decoder stopped."""
    render = renders[0]
    full = decode_photo(render.data, max_pixels=10**7, side_px=1280)
    half = decode_photo(render.data, max_pixels=10**7, side_px=256)
    assert half.reduction > full.reduction
    person = SeenPerson(
        box_px=(0, 0, 10, 10),
        score=None,
        joints_px=render.joints_px,
        present=np.ones(14, bool),
        confidence=None,
        sigma_px=None,
        lifted=NotLiftable("not tried"),
    )
    discs = [
        np.array([it.centre for it in picture.marks if isinstance(it, Disc)])
        for picture in (draw_overlay(photo, [person], height_px=480) for photo in (full, half))
    ]
    np.testing.assert_allclose(discs[0], discs[1], atol=1e-6)
    np.testing.assert_allclose(discs[0], render.joints_px + 0.5, atol=1e-6)


def test_the_whole_picture(seen: tuple[Photo, PhotoResult]) -> None:
    picture = draw_result(*seen, height_px=360)
    assert (picture.width, picture.height) == (480 + 360 + 360, 360)
    pixels = to_pixels(picture)
    assert pixels.shape == (360, 1200, 3)
    for start in (480, 840):
        panel = pixels[:, start : start + 360].astype(int)
        blue = (panel[..., 0] > 180) & (panel[..., 2] < 80)
        orange = (panel[..., 2] > 180) & (panel[..., 0] < 80)
        assert blue.mean() > 0.001
        assert orange.mean() > 0.001


@pytest.mark.parametrize("view", NOVEL_VIEWS)
def test_everything_is_within_its_view(seen: tuple[Photo, PhotoResult], view: Viewpoint) -> None:
    """People, exemplars, camera and ground: nothing reaches into the picture beside it."""
    marks = draw_novel_view(seen[1], view, side_px=400).marks
    points = np.concatenate([it.points for it in marks if isinstance(it, Stroke)])
    assert points.min() > 0
    assert points.max() < 400


def test_a_camera_far_away_is_drawn_nearer(seen: tuple[Photo, PhotoResult]) -> None:
    _, result = seen
    person = result.people[0]
    assert isinstance(person.lifted, LiftedPerson)
    far = np.array([0, 0, 20_000.0])
    moved = replace(
        person.lifted,
        joints_3d_mm=person.lifted.joints_3d_mm + far,
        root_mm=person.lifted.root_mm + far,
        exemplar=replace(person.lifted.exemplar, joints_mm=person.lifted.exemplar.joints_mm + far),
    )
    distant = replace(result, people=(replace(person, lifted=moved),))
    texts = [
        " ".join(
            it.text
            for it in draw_novel_view(each, NOVEL_VIEWS[1], side_px=400).marks
            if isinstance(it, Words)
        )
        for each in (result, distant)
    ]
    assert "drawn nearer" not in texts[0]
    assert re.search(r"2\d\.\d m away, is drawn nearer", texts[1])


def test_nobody(seen: tuple[Photo, PhotoResult]) -> None:
    photo, result = seen
    empty = replace(result, people=())
    words = [it.text for it in draw_result(photo, empty).marks if isinstance(it, Words)]
    assert words.count("nothing in 3D") == 2


def test_svg_is_xml_with_the_photo_inside(seen: tuple[Photo, PhotoResult]) -> None:
    picture = draw_result(*seen, height_px=360)
    root = ElementTree.fromstring(to_svg(picture))
    space = "{http://www.w3.org/2000/svg}"
    assert root.tag == f"{space}svg"
    assert (root.get("width"), root.get("height")) == ("1200", "360")
    assert len(root.findall(f"{space}image")) == 1
    assert len(root) == len(picture.marks) + 1
    assert "http" not in to_svg(picture).replace("http://www.w3.org/2000/svg", "")
    nasty = Picture(9, 9, (0, 0, 0), (Words("<&>\"'", np.zeros(2), (1, 2, 3)),))
    assert ElementTree.fromstring(to_svg(nasty))[1].text == "<&>\"'"


@pytest.mark.parametrize("ending", PICTURE_TYPES)
def test_files(ending: str) -> None:
    stroke = Stroke(np.array([[2.0, 2.0], [30.0, 30.0]]), (250, 0, 0), 3.0)
    data = encode_picture(Picture(40, 40, (255, 255, 255), (stroke,)), ending)
    if ending == ".svg":
        assert data.startswith(b"<svg")
        return
    decoded = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    assert decoded is not None
    assert decoded.shape == (40, 40, 3)
    blue, green, red = decoded[16, 16].astype(int)
    assert red - max(blue, green) > 100


def test_no_other_files() -> None:
    with pytest.raises(ValueError, match=r"\.png"):
        encode_picture(Picture(4, 4, (0, 0, 0)), ".gif")


@pytest.mark.parametrize("shape", [(1, 40_000), (300, 9_000)])
def test_the_widest_photos_become_files_too(
    seen: tuple[Photo, PhotoResult], shape: tuple[int, int]
) -> None:
    """JPEG and WebP end at 65,535 and 16,383 pixels; the joints stay where the photo is."""
    data = cv2.imencode(".png", np.full((*shape, 3), 90, np.uint8))[1].tobytes()
    photo = decode_photo(data, max_pixels=10**7, side_px=1280)
    result = replace(seen[1], width_px=photo.width_px, height_px=photo.height_px)
    person = replace(result.people[0], joints_px=np.tile([[100.0, shape[0] / 2 - 0.5]], (14, 1)))
    picture = draw_result(photo, replace(result, people=(person,)), height_px=720)
    assert (picture.width, picture.height) == (2880 + 2 * 720, 720)
    disc = next(mark for mark in picture.marks if isinstance(mark, Disc))
    np.testing.assert_allclose(disc.centre, [100.5 * 2880 / shape[1], 360], atol=1)
    for ending in (".jpg", ".webp"):
        pixels = cv2.imdecode(np.frombuffer(encode_picture(picture, ending), np.uint8), 1)
        assert pixels is not None
        assert pixels.shape == (720, 4320, 3)
