"""People cut off by the photo's edge: the rows of the table."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from evaluation import cut_off
from library_store.build import BuildSettings, build_library
from library_store.prior import PosePrior
from library_store.skeleton import L_ANKLE
from models.training.dataset import LabelledCrop
from tests.evaluation.rendered_set import write_set


def test_each_end_has_a_row_of_the_same_people(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    library = tmp_path / "tiny"
    build_library(library, PosePrior.load(), BuildSettings(name="tiny", n_poses=2_000, seed=3))
    monkeypatch.setenv("POSEMATCH_LIBRARY_DIR", str(library))
    monkeypatch.setattr(cut_off, "ENLARGED", 1)
    n = write_set(tmp_path / "set")
    cut_off.main(["--renders", str(tmp_path / "set")])
    _, _, *rows = capsys.readouterr().out.strip().splitlines()
    assert len(rows) == 5
    numbers = np.array([[float(it) for it in re.findall(r"\| ([\d.]+)%? ?", row)] for row in rows])
    people, answered, right, pa_mm = numbers.T
    assert (people == n).all()
    assert answered[0] == 100
    assert right[0] > 80
    assert right[3] > 60, "portraits"
    assert (pa_mm < 200).all()


def test_whom_the_photo_shows_too_little_of_is_not_asked_for(tmp_path: Path) -> None:
    write_set(tmp_path / "set")
    person = next(cut_off.rendered(tmp_path / "set"))
    tally = cut_off.Tally()
    cut_off.look(None, person, person.joints_px[1, 1], tally)  # type: ignore[arg-type]
    assert not tally.answered
    assert tally.row("the neck") == "| the neck | 0 | - | - | - |"
    assert list(person.ends.values()) == sorted(person.ends.values(), reverse=True)


def test_sets_in_which_nobody_stands_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_set(tmp_path / "set")
    monkeypatch.setattr(cut_off, "MOST_LEAN", 0.0)
    with pytest.raises(SystemExit, match="nobody stands upright"):
        cut_off.main(["--renders", str(tmp_path / "set")])


def test_of_held_out_photos_those_are_cut_off_who_are_upright_and_known(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_set(tmp_path / "set")
    renders = list(cut_off.rendered(tmp_path / "set"))[:2]
    upside_down = replace(renders[0], joints_px=renders[0].joints_px[:, [0, 1]] * (1, -1))
    without_ankle = replace(renders[0], known=np.arange(14) != L_ANKLE)
    crops = [
        LabelledCrop(
            name="x",
            group=0,
            image=person.image,
            joints_px=person.joints_px.astype(np.float32),
            weight=person.known.astype(np.float32),
            visible=np.ones(14, np.float32),
            wild=False,
        )
        for person in (*renders, upside_down, without_ankle)
    ]
    monkeypatch.setattr(cut_off, "held_out_photos", lambda _: crops)
    people = list(cut_off.photographed(tmp_path))
    assert [person.upright for person in people] == [True, True, False, False]
    np.testing.assert_array_equal(people[0].joints_px, renders[0].joints_px.astype(np.float32))


def test_without_a_truth_in_3d_there_is_no_pa() -> None:
    tally = cut_off.Tally(answered=[True, False], right=[np.ones(3), np.zeros(3)])
    assert tally.row("the hips") == "| the hips | 2 | 50.0% | 50.0% | - |"
