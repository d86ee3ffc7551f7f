"""GET /v1/exemplars/{id}: pose, source and licence of every kind of exemplar."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from app.schemas import ExemplarAnswer, InfoAnswer
from library_store.build import BuildSettings, Mocap, build_library
from library_store.library import Library, load
from library_store.mocap import MocapSettings
from library_store.prior import PosePrior
from tests.app.server import Server
from tests.library_store.clips import clip, write_clips


@pytest.fixture(scope="module")
def own(tmp_path_factory: pytest.TempPathFactory) -> Library:
    """Captured, composed and sampled exemplars, from two sources of different licences."""
    folder = tmp_path_factory.mktemp("own")
    files = (
        write_clips(folder / "a.npz", clip("walk", 120, 1, licence="CC BY 4.0")),
        write_clips(folder / "b.npz", clip("dance", 120, 2, licence="")),
    )
    settings = MocapSettings(radius_mm=0.0, licence="studio use only", credit="the dancers")
    build_library(
        folder / "own",
        PosePrior.load(),
        BuildSettings(name="own", n_poses=600),
        mocap=Mocap(files, settings, prior_share=0.2),
    )
    return load(folder / "own")


@pytest.fixture(scope="module")
def server(own: Library, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    log = tmp_path_factory.mktemp("server") / "log"
    with Server(log, library_dir=own.directory, deadline_ms=60_000) as running:
        yield running


def get(server: Server, exemplar_id: str) -> ExemplarAnswer:
    response = server.client.get(f"/v1/exemplars/{exemplar_id}")
    assert response.status_code == 200, response.text
    return ExemplarAnswer.model_validate_json(response.content)


def test_captured(server: Server, own: Library) -> None:
    entry = int(own.entries_of("mocap")[30])
    answer = get(server, own.exemplar_id(entry))
    np.testing.assert_allclose(
        np.array(answer.joints_mm, dtype=float), own.poses_mm(entry), atol=0.001
    )
    assert answer.source.kind == "mocap"
    assert (answer.source.clip, answer.source.mirrored) == ("walk", False)
    assert (answer.source.subject, answer.source.action) == ("person 1", "moves about")
    assert answer.source.frame == own.source(entry).frame
    (licence,) = answer.licences
    assert (licence.source, licence.licence, licence.credit) == ("a.npz", "CC BY 4.0", "")


def test_mirrored(server: Server, own: Library) -> None:
    entry = int(own.entries_of("mocap")[-1])
    answer = get(server, own.exemplar_id(entry))
    assert answer.source.kind == "mocap"
    assert (answer.source.clip, answer.source.mirrored) == ("dance", True)
    assert ":dance~mirrored:" in answer.id
    (licence,) = answer.licences
    assert (licence.licence, licence.credit) == ("studio use only", "the dancers")


def test_composed_exemplars_name_their_parts_and_all_licences(server: Server, own: Library) -> None:
    terms = {"walk": "CC BY 4.0", "dance": "studio use only"}
    seen = set()
    for entry in own.entries_of("composed")[:12].tolist():
        answer = get(server, own.exemplar_id(entry))
        assert answer.source.kind == "composed"
        assert [part.part for part in answer.source.parts] == ["legs", "upper_body"]
        clips = {part.clip for part in answer.source.parts}
        assert {licence.licence for licence in answer.licences} == {terms[c] for c in clips}
        seen.add(len(clips))
    assert seen == {1, 2}


def test_sampled(server: Server, own: Library) -> None:
    entry = int(own.entries_of("sampled")[0])
    answer = get(server, own.exemplar_id(entry))
    assert answer.source.kind == "sampled"
    assert answer.source.index == 0
    assert "CMU" in answer.licences[0].source


def test_info_has_the_licences_of_all_sources(server: Server) -> None:
    info = InfoAnswer.model_validate_json(server.client.get("/v1/info").content)
    assert {licence.licence for licence in info.licences} >= {"CC BY 4.0", "studio use only"}
    assert len(info.licences) == 3


def test_answers_name_the_kind(server: Server, own: Library) -> None:
    """The projection of a composed exemplar is matched with it, and says so."""
    entry = int(own.entries_of("composed")[5])
    rotation, translation = own.cameras(entry)
    seen = own.poses_mm(entry) @ rotation.T + translation
    pixels = 1000.0 * seen[:, :2] / seen[:, 2:] + 500.0
    names = server.client.get("/v1/info").json()["skeleton"]["joint_names"]
    joints = [
        {"name": name, "x_px": x, "y_px": y, "confidence": 1.0}
        for name, (x, y) in zip(names, pixels.tolist(), strict=True)
    ]
    body = {
        "image": {"width_px": 1001, "height_px": 1001},
        "focal_length_px": 1000.0,
        "principal_point_px": [500.0, 500.0],
        "people": [{"joints_2d": joints}],
    }
    (person,) = server.client.post("/v1/lift", json=body).raise_for_status().json()["people"]
    assert person["exemplar"]["id"] == own.exemplar_id(entry)
    assert person["exemplar"]["source"]["kind"] == "composed"
    assert len(person["exemplar"]["source"]["parts"]) == 2
