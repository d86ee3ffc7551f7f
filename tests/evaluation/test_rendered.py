"""3D of rendered people: the rows of the table, and who is left out of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from app.lifting.lifter import Lifter
from app.lifting.types import Intrinsics, Observation
from evaluation import rendered
from evaluation.photo_sigma import Seen
from library_store.build import BuildSettings, build_library
from library_store.library import load
from library_store.prior import PosePrior
from tests.evaluation.rendered_set import write_set


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("rendered") / "tiny"
    build_library(directory, PosePrior.load(), BuildSettings(name="tiny", n_poses=2_000, seed=3))
    return directory


def test_every_way_of_lifting_has_a_row_of_the_same_people(
    library: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("POSEMATCH_LIBRARY_DIR", str(library))
    people = write_set(tmp_path / "set")
    rendered.main(["--renders", str(tmp_path / "set")])
    first, _, _, *rows = capsys.readouterr().out.strip().splitlines()
    assert first == f"{people} of {people} people, lifted every way"
    means = {row.split("|")[1].strip(): float(row.split("|")[3]) for row in rows}
    assert len(means) == 4
    assert min(means, key=lambda label: means[label]) == "from true 2D"
    assert rows[-1].split("|")[2].strip() == "100.0%"
    rendered.main(["--renders", str(tmp_path / "set"), "--people", "2"])
    assert capsys.readouterr().out.startswith("2 of 2 people")


def test_who_cannot_be_lifted_has_no_error(library: Path) -> None:
    truth_mm = PosePrior.load().sample(1, np.random.default_rng(0))[0] * [1, -1, -1] + [0, 0, 4000]
    joints_px = 1000 * truth_mm[:, :2] / truth_mm[:, 2:]
    camera = Intrinsics(1000.0, (0.0, 0.0), "request")
    there = Seen(Observation(joints_px, np.ones(14)), camera, truth_mm)
    point = Seen(Observation(0 * joints_px, np.ones(14)), camera, truth_mm)
    errors = rendered.lifted_pa_mm(Lifter(load(library)), [there, point])
    assert errors[0] < 150
    assert np.isnan(errors[1])
