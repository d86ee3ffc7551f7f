"""The paper's tables on small folders in the layouts that users have."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from app.errors import PoseMatchError
from app.lifting.lifter import Lifter
from evaluation.metrics import rigid_error_mm, root_centred_error_mm
from evaluation.paper import figures, study
from evaluation.paper.__main__ import main
from evaluation.paper.datasets import find_cmu, find_h36m, find_humaneva, h36m_column
from evaluation.paper.exemplars import exemplars_of, fraction, orbit_rows, write_library
from evaluation.paper.published import ACTIONS, HUMANEVA, P1, P1_GT, P2
from evaluation.paper.systems import (
    Seen2D,
    System,
    default_method,
    known_depths,
    optimal_exemplars,
    paper_method,
)
from evaluation.paper.videos import find_videos, look_at_videos
from evaluation.paper.views import draw, look
from library_store.cameras import rotations
from library_store.errors import LibraryError
from library_store.importers import Clip, write_npz
from library_store.importers.h36m import CAMERAS, H36M_32
from library_store.importers.rotation import up_to_y
from models.card import WEIGHTS_DIR
from models.errors import ModelError
from tests.evaluation.paper.made_data import (
    DISTANCE_MM,
    acting,
    h36m_npz,
    humaneva_npz,
    made_camera,
    metadata_xml,
    video,
)
from tests.library_store.importers.test_h36m import write_cdf

SMALL = ("--entries", "1500", "--views", "24", "--curve-views", "8")
ACTED = ("Directions 1", "Walking", "_ALL")


@pytest.fixture(scope="module")
def users_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("h36m")
    h36m_npz(folder / "data_3d_h36m.npz", ACTED)
    humaneva_npz(folder / "data_3d_humaneva15.npz")
    metadata_xml(folder / "metadata.xml")
    for camera in ("54138969", "55011271"):
        video(folder / "S11" / "Videos" / f"Walking.{camera}.mp4", 70)
    return folder


def test_every_table_of_a_users_folder(users_folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    main(["--data", str(users_folder), "--out", str(out), *SMALL])
    text = (out / "report.md").read_text()
    for number in range(1, 10):
        assert f"Table {number}:" in text, number
    assert "| paper | 71.63 | 66.60 |" in text
    assert "82.72 | 69.05 |" in text
    assert "Cameras: the real ones" in text
    assert "* Human3.6M, 32 joints: metres, Z up (clips: 21)" in text
    assert "* HumanEva, 15 joints: metres, Z up (clips: 12)" in text
    assert "video of S9_Walking, camera" in text
    assert text.count("action '_ALL': not in the paper") == 1
    for row in ("default, training frames", "matching alone, training frames"):
        assert text.count(f"| **{row}") == 6, "tables 1, 2, 4, the one after it, 5 and 9"
    assert "| default given gt |" in text
    for by_action, short in (("Table 1:", "X* given x"), ("Table 2:", "X* given gt")):
        # The same method on the same people.
        table = text.split(by_action)[1].split("##")[0]
        *_, mean, median, _ = next(
            line for line in table.splitlines() if "paper's method, training frames" in line
        ).split("|")
        line = next(it for it in text.splitlines() if it.startswith(f"| {short} |"))
        assert line.endswith(f"| {mean.strip()} / {median.strip()} |")
    # Nobody is on the made-up films.
    assert "figure 5: nobody can be lifted given x" in text
    for name in ("2", "3", "4a", "4c", "6a", "6b", "7", "8"):
        assert (out / f"figure{name}.svg").read_text().startswith("<svg"), name


def test_without_cameras_and_videos_the_rest_is_done(tmp_path: Path) -> None:
    data, out = tmp_path / "data", tmp_path / "out"
    data.mkdir()
    h36m_npz(data / "data_3d_h36m.npz", ("Walking 1",))
    main(["--data", str(data), "--out", str(out), *SMALL])
    text = (out / "report.md").read_text()
    assert "Table 2:" in text
    assert "Table 1:" not in text
    missing = text.split("## Missing")[1]
    for what in ("metadata.xml", "tables 1, 3, 4 and 6", "HumanEva-I: no"):
        assert what in missing


def test_table_5_is_of_the_first_camera_where_each_has_its_own_files(tmp_path: Path) -> None:
    data, out = tmp_path / "data", tmp_path / "out"
    data.mkdir()
    metadata_xml(data / "metadata.xml")
    for number, subject in enumerate(("S1", "S9", "S11")):
        for index in (0, 1):
            rotation, place = made_camera(index)
            mono = (acting(60, number) - place) @ rotation.T
            folder = data / subject / "MyPoseFeatures" / "D3_Positions_mono"
            write_cdf(folder / f"Walking 1.{CAMERAS[index]}.cdf", mono)
    arguments = ["--data", str(data), "--out", str(out), "--entries", "0", "--curve-views", "4"]
    main([*arguments, "--views", "0"])
    # 12 frames of 60 by two cameras of two subjects; table 5 has one camera of them.
    assert "2, 48, 24 (diagnostic)" in (out / "report.md").read_text()
    for path in data.rglob(f"*.{CAMERAS[0]}.cdf"):
        path.unlink()
    main([*arguments, "--views", "4"])
    text = (out / "report.md").read_text()
    assert "Table 5:" not in text
    assert f"table 5: needs camera {CAMERAS[0]}" in text


def test_an_empty_folder_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="no table can be made"):
        main(["--data", str(tmp_path), "--out", str(tmp_path / "out")])
    assert "Human3.6M: no data_3d_h36m.npz" in capsys.readouterr().out


@pytest.mark.parametrize("option", ["--library", "--mlp", "--mocap", "--cross-set"])
def test_a_file_that_is_not_there_is_named_at_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], option: str
) -> None:
    """Not after the hours that the tables before take."""
    mocap = tmp_path / "cmu.npz"
    mocap.touch()
    with pytest.raises(SystemExit):
        main(["--data", "cmu", "--mocap", str(mocap), option, str(tmp_path / "none")])
    assert f"{option} {tmp_path / 'none'} does not exist" in capsys.readouterr().err


@pytest.mark.parametrize("option", ["--library", "--mlp", "--cross-set", "--network"])
def test_a_file_that_is_no_good_is_named_at_once(tmp_path: Path, option: str) -> None:
    bad, out = tmp_path / "bad", tmp_path / "out"
    bad.write_text("not what is wanted")
    with pytest.raises((PoseMatchError, LibraryError, ModelError), match="bad"):
        main(["--data", str(tmp_path), "--out", str(out), option, str(bad)])
    assert not out.exists()


def test_mocap_without_people_to_test_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    joints = acting(90, 1)[:, H36M_32] @ up_to_y("+Z").T
    mocap = tmp_path / "cmu.npz"
    write_npz(
        mocap,
        [Clip("cmu_01", "cmu_01", "walk", 30.0, joints.astype(np.float32), np.arange(90))],
    )
    with pytest.raises(SystemExit, match=r"no table can be made of what is in .*cmu\.npz"):
        main(["--data", "cmu", "--mocap", str(mocap), "--out", str(tmp_path / "out"), *SMALL])
    assert "CMU subject cmu_35" in capsys.readouterr().out


def test_videos_are_seen_by_the_network_of_the_settings(
    users_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("cpm.onnx", "person.onnx", "person.json"):
        shutil.copy(WEIGHTS_DIR / name, tmp_path)
    card = json.loads((WEIGHTS_DIR / "cpm.json").read_text())
    (tmp_path / "ours.json").write_text(json.dumps(card | {"name": "ours"}))
    monkeypatch.setenv("POSEMATCH_WEIGHTS_DIR", str(tmp_path))
    monkeypatch.setenv("POSEMATCH_MODEL", "ours")
    views = look(find_h36m(users_folder).of(["S11"]), seconds_apart=1.0)
    shown, seen, _ = look_at_videos(views, find_videos(users_folder))
    assert len(shown) == len(seen.points_px) > 0


def test_a_clip_beyond_use_costs_only_itself(tmp_path: Path) -> None:
    path = tmp_path / "data_3d_humaneva15.npz"
    humaneva_npz(path)
    whole = find_humaneva(tmp_path)
    with np.load(path, allow_pickle=True) as packed:
        held = packed["positions_3d"].item()
    held["Validate/S1"]["Jog 1 chunk0"][:] = np.nan
    np.savez(path, positions_3d=np.array(held, dtype=object))
    found = find_humaneva(tmp_path)
    assert len(found.scenes) == len(whole.scenes) - 1
    (missing,) = found.missing
    assert "clip 'Validate_S1_Jog_1_chunk0' has no frame" in missing


def test_frames_that_the_importer_drops_are_told(tmp_path: Path) -> None:
    """They are in no mean: whoever reads it must know."""
    path = tmp_path / "data_3d_h36m.npz"
    h36m_npz(path, ("Walking 1",))
    with np.load(path, allow_pickle=True) as packed:
        held = packed["positions_3d"].item()
    held["S11"]["Walking 1"][[20, 40], 15] += 3.0
    np.savez(path, positions_3d=np.array(held, dtype=object))
    found = find_h36m(tmp_path)
    assert len(look(found.of(["S11"]))) == 4 * 68
    (dropped,) = [line for line in found.noticed if "dropped" in line]
    assert dropped.startswith("2 of 70 frames with a jumping joint")
    assert dropped.endswith("(clips: 1)")


def test_tables_of_free_mocap(tmp_path: Path) -> None:
    clips = []
    for subject, action in (("cmu_01", "climb"), ("cmu_02", "walk"), ("cmu_35", "run/jog")):
        joints = acting(90, int(subject[-2:]))[:, H36M_32] @ up_to_y("+Z").T
        clips.append(
            Clip(
                subject, subject, action, 30.0, joints.astype(np.float32), np.arange(90), (), "free"
            )
        )
    mocap = tmp_path / "cmu.npz"
    write_npz(mocap, clips)
    out = tmp_path / "out"
    main(["--data", "cmu", "--mocap", str(mocap), "--out", str(out), *SMALL])
    text = (out / "report.md").read_text()
    assert "| | Run | **Avg.** | Median |" in text
    assert "table 9: no --cross-set" in text
    assert "| **matching alone, training frames** |" in text
    assert "**default" not in text, "the network that ships has seen these people"
    assert "CMU subject cmu_05" in text
    found, held_out = find_cmu(mocap)
    assert {scene.clip.subject for scene in found.of(held_out)} == {"cmu_35"}


def test_real_cameras_see_the_person_where_they_stand(users_folder: Path) -> None:
    found = find_h36m(users_folder)
    views = look(found.of(["S11"]))
    assert np.abs(views.joints_mm[..., 2] - DISTANCE_MM).max() < 1500
    # Upright, in the middle of a 1000 pixel picture.
    points = views.points_px()
    assert (points[:, 0, 1] < points[:, 10, 1]).all()
    assert ((points > 0) & (points < 1000)).all()
    humaneva = find_humaneva(users_folder)
    assert {scene.clip.subject for scene in humaneva.scenes} == {"Validate/S1", "Validate/S2"}


def test_the_authors_own_files(tmp_path: Path) -> None:
    """World and camera-frame CDF files of one clip give the same views by the same camera."""
    world = acting(20, 5)
    for name in ("world", "camera"):
        metadata = tmp_path / name / "code" / "metadata.xml"
        metadata.parent.mkdir(parents=True)
        metadata_xml(metadata)
        # The importer looks for it in the folders above its files.
        metadata_xml(tmp_path / name / "metadata.xml")
    write_cdf(tmp_path / "world/S9/MyPoseFeatures/D3_Positions/Eating 2.cdf", world)
    rotation, place = made_camera(1)
    mono = (world - place) @ rotation.T
    write_cdf(tmp_path / "camera/S9/Poses_D3_Positions_mono/Eating 2.55011271.cdf", mono)
    of_world, of_camera = (find_h36m(tmp_path / name) for name in ("world", "camera"))
    assert [camera.name for camera in of_camera.scenes[0].cameras] == ["55011271"]
    seen, expected = look(of_camera.scenes), look(of_world.scenes)
    expected = expected[np.flatnonzero(expected.camera == 1)]
    assert set(seen.actions) == {"Eat"}
    np.testing.assert_allclose(seen.joints_mm, expected.joints_mm, atol=0.01)
    np.testing.assert_allclose(seen.joints_mm, mono[:, H36M_32], atol=0.01)
    assert "Human3.6M subject S11" in of_world.missing


def test_a_library_of_views_knows_them(users_folder: Path, tmp_path: Path) -> None:
    """1NN with true 2D finds the very exemplar; its camera, turned onto it, is the view's."""
    train = find_h36m(users_folder).of(["S1", "S5"])
    views = draw(train, 400, np.random.default_rng(0))
    library = write_library(tmp_path / "frames", exemplars_of(views))
    seen = Seen2D(views.points_px())
    found = paper_method(library, 1)(views, seen)
    assert found.exemplar_mm is not None
    assert np.median(root_centred_error_mm(found.exemplar_mm, views.joints_mm)) < 0.5
    best = optimal_exemplars(library, views)
    assert rigid_error_mm(best, views.joints_mm).max() < 0.5
    # Known depths leave what weak perspective costs.
    bound = rigid_error_mm(known_depths(views, seen), views.joints_mm).mean()
    assert 0 < bound < 30
    # No graph that would miss some of the nearest, other ones whenever it is built.
    assert library.index_backend == "exact"
    again = write_library(tmp_path / "again", exemplars_of(views))
    assert again.manifest.files == library.manifest.files
    part = write_library(tmp_path / "part", fraction(library, 50, 3))
    assert len(part) == 50
    assert part.match(library.descriptors([0]).reshape(1, 14, 2), None, 1).entries.shape == (1, 1)


def test_a_row_says_how_many_people_were_refused(users_folder: Path, tmp_path: Path) -> None:
    views = draw(find_h36m(users_folder).of(["S1"]), 30, np.random.default_rng(0))
    library = write_library(tmp_path / "frames", exemplars_of(views))
    points = views.points_px()
    points[7] = points[7, 0]
    test = study.TestSet(views, {"gt": Seen2D(points)}, ("Walk",))
    systems = [System("default", default_method(library)), System("paper", paper_method(library))]
    rows = study.comparison(test, "gt", systems, root_centred_error_mm)
    assert [row.label for row in rows] == ["default (1 refused)", "paper (1 refused)"]
    # All their joints at one place: as far off as the true ones are from the hips.
    far = root_centred_error_mm(0 * views.joints_mm[7], views.joints_mm[7]).mean()
    for row in rows:
        assert row.mean is not None
        assert row.mean > 0.99 * far / len(views) > 5


def test_the_mean_of_table_9_is_of_the_actions_means(users_folder: Path, tmp_path: Path) -> None:
    for theirs in HUMANEVA:
        assert theirs.mean == pytest.approx(np.mean(theirs.actions), abs=0.005)
    found = find_humaneva(users_folder)
    views = look(found.scenes)
    library = write_library(tmp_path / "frames", exemplars_of(views[::7]))
    few = np.flatnonzero(views.actions == "Jog")[:3]
    views = views[np.concatenate([few, np.flatnonzero(views.actions == "Walk")[:40]])]
    test = study.TestSet(views, {"gt": Seen2D(views.points_px())}, found.columns)
    warped, unwarped = study.transfer(test, library, [])
    of_frames, _, _ = study.warping(test, "gt", library)
    assert unwarped.mean == pytest.approx(np.nanmean(unwarped.actions))
    np.testing.assert_array_equal(unwarped.actions, of_frames.actions)
    assert of_frames.mean is not None
    assert of_frames.mean != pytest.approx(unwarped.mean, rel=1e-3)
    assert warped.mean == pytest.approx(np.nanmean(warped.actions))


def test_drawn_is_who_both_methods_lift(users_folder: Path, tmp_path: Path) -> None:
    """The paper's method trusts a joint that the network says it has not seen."""
    views = draw(find_h36m(users_folder).of(["S1"]), 30, np.random.default_rng(0))
    library = write_library(tmp_path / "frames", exemplars_of(views))
    points = views.points_px()
    unseen = np.ones(points.shape[:2])
    unseen[:, 4] = 0.0
    sharp = np.broadcast_to(np.eye(2), (*points.shape, 2))
    test = study.TestSet(views, {"x": Seen2D(points, unseen, sharp)}, ("Walk",))
    lifter = Lifter(library)
    assert figures.liftable(test, "x", lifter)
    points[:, 4] = 1e5
    assert not figures.liftable(test, "x", lifter)


def test_what_a_network_says_of_a_person_is_lifted_with_them() -> None:
    rng = np.random.default_rng(0)
    points, confidence = rng.normal(size=(3, 14, 2)), rng.uniform(0.5, 1.0, (3, 14))
    sharp = np.broadcast_to(np.eye(2), (3, 14, 2, 2))
    depths = rng.normal(size=(3, 14))
    some = Seen2D(points, confidence, sharp, depths_px=depths).of(np.array([2, 0]))
    told = some.observation(0, plain=False)
    assert told.depths_px is not None
    np.testing.assert_array_equal(told.depths_px, depths[2])
    np.testing.assert_array_equal(told.confidence, confidence[2])
    assert some.observation(0, plain=True).depths_px is None
    untold = Seen2D(points, confidence, sharp).of(np.array([2])).observation(0, plain=False)
    assert untold.depths_px is None


def test_orbit_rows_invert_rotations() -> None:
    rng = np.random.default_rng(0)
    rows = np.stack(
        [
            rng.uniform(-180, 180, 50),
            rng.uniform(-80, 80, 50),
            rng.uniform(-170, 170, 50),
            rng.uniform(2000, 8000, 50),
        ],
        axis=1,
    )
    np.testing.assert_allclose(orbit_rows(rotations(rows), rows[:, 3]), rows, rtol=0, atol=1e-3)


@pytest.mark.parametrize(
    ("spelt", "column"),
    [
        ("WalkingDog 1", "WalkDog"),
        ("TakingPhoto", "Photo"),
        ("SittingDown 2", "SitDown"),
        ("Sitting 1", "Sit"),
        ("WalkTogether", "WalkPair"),
        ("Walking 1.54138969", "Walk"),
        ("_ALL", None),
    ],
)
def test_actions_however_they_are_spelt(spelt: str, column: str | None) -> None:
    assert h36m_column(spelt) == column


def test_the_papers_rows_are_whole() -> None:
    for row in (*P1, *P1_GT, *P2):
        assert len(row.actions) in (0, len(ACTIONS)), row.label
    # Averages are per frame, not of the actions' means, but near them.
    for row in (P1[-1], P1_GT[-1], P2[-1]):
        assert row.mean == pytest.approx(np.mean(row.actions), rel=0.05)
