"""The whole pipeline on rendered people: rows of one table are of the same people."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from app.engine import load_engine
from app.settings import load_settings
from evaluation import renders as program
from evaluation.renders import NOISE_TORSOS, by_2d, read_renders
from library_store.build import BuildSettings, build_library
from library_store.prior import PosePrior

RENDERS = Path(__file__).parents[1] / "data" / "renders"


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("renders") / "tiny"
    build_library(directory, PosePrior.load(), BuildSettings(name="tiny", n_poses=2_000, seed=3))
    return directory


@pytest.fixture
def settings(library: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("POSEMATCH_LIBRARY_DIR", str(library))


@pytest.mark.usefixtures("settings")
def test_every_row_is_of_the_people_whom_the_network_found() -> None:
    pipeline = load_engine(load_settings()).pipeline
    renders = read_renders(RENDERS)
    found = [renders[0].joints_px, *[None] * (len(renders) - 1)]
    of_one = by_2d(pipeline, renders, found)
    assert of_one == by_2d(pipeline, renders[:1], found[:1])
    everybody = by_2d(pipeline, renders, [render.joints_px for render in renders])
    assert f"{len(renders)} people" in everybody
    assert everybody.splitlines()[4] != of_one.splitlines()[4]
    # Nobody is as small as that.
    refused = by_2d(pipeline, renders[:1], [0 * renders[0].joints_px + np.array([[9.0, 9.0]])])
    assert "all trusted alike (1 of 1 refused) | - | - |" in refused
    assert refused.count("refused") == 1
    assert len(refused.splitlines()) == 6 + len(NOISE_TORSOS)


@pytest.mark.usefixtures("settings")
def test_pictures_with_nobody_on_them_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    truth = json.loads((RENDERS / "ground_truth.json").read_text())
    (tmp_path / "ground_truth.json").write_text(json.dumps({"images": truth["images"][:1]}))
    record = truth["images"][0]
    grey = np.full((record["height"], record["width"], 3), 128, np.uint8)
    cv2.imwrite(str(tmp_path / record["file"]), grey)
    monkeypatch.setattr("sys.argv", ["renders", "--data", str(tmp_path), "--own-boxes"])
    with pytest.raises(SystemExit, match="nobody of 1 pictures"):
        program.main()
    assert "| 0 | not found |" in capsys.readouterr().out


@pytest.mark.usefixtures("settings")
def test_the_worst_answers_are_drawn_before_the_truth(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    figure = tmp_path / "worst.png"
    monkeypatch.setattr("sys.argv", ["renders", "--data", str(RENDERS), "--figure", str(figure)])
    program.main()
    errors = [
        float(line.split("|")[4])
        for line in capsys.readouterr().out.splitlines()
        if line.startswith("| 0")
    ]
    assert len(errors) > program.WORST
    picture = cv2.imread(str(figure))
    assert picture is not None
    assert picture.shape[0] == program.WORST * program.FIGURE_PX
    assert picture.shape[1] > 3 * program.FIGURE_PX
