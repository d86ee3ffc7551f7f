from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from library_store.steps import LEDGER, Facts, Steps
from library_store.tables import TableWriter, open_table


def writer(folder: Path, name: str, heard: list[str]) -> Callable[[], Facts]:
    def work() -> Facts:
        heard.append(name)
        (folder / name).write_text(name)
        return {"from": name}

    return work


def run(folder: Path, *names: str) -> tuple[list[str], list[Facts]]:
    heard: list[str] = []
    steps = Steps(folder)
    return heard, [steps.run(name, writer(folder, name, heard), name) for name in names]


def test_finished_steps_are_not_run_again(tmp_path: Path) -> None:
    assert run(tmp_path, "a", "b") == (["a", "b"], [{"from": "a"}, {"from": "b"}])
    assert run(tmp_path, "a", "b", "c") == (["c"], [{"from": "a"}, {"from": "b"}, {"from": "c"}])


def test_what_follows_a_damaged_step_is_run_again(tmp_path: Path) -> None:
    run(tmp_path, "a", "b", "c")
    (tmp_path / "b").write_text("cut")
    assert run(tmp_path, "a", "b", "c")[0] == ["b", "c"]
    (tmp_path / "a").unlink()
    assert run(tmp_path, "a", "b", "c")[0] == ["a", "b", "c"]


def test_a_step_that_failed_is_not_in_the_ledger(tmp_path: Path) -> None:
    run(tmp_path, "a")

    def fail() -> Facts:
        (tmp_path / "b").write_text("half")
        raise OSError

    steps = Steps(tmp_path)
    steps.run("a", fail, "a")
    with pytest.raises(OSError):  # noqa: PT011
        steps.run("b", fail, "b")
    assert run(tmp_path, "a", "b")[0] == ["b"]


@pytest.mark.parametrize("ledger", [None, "{", ""])
def test_files_without_a_ledger_are_not_trusted(tmp_path: Path, ledger: str | None) -> None:
    (tmp_path / "a").write_text("old")
    (tmp_path / "deep").mkdir()
    if ledger is not None:
        (tmp_path / LEDGER).write_text(ledger)
    Steps(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_tables_have_the_bytes_of_numpys(tmp_path: Path) -> None:
    table = np.random.default_rng(0).normal(size=(1_000, 14, 3)).astype(np.float32)
    np.save(tmp_path / "whole.npy", table)
    with TableWriter(tmp_path / "pieces.npy", table.shape, np.float32) as pieces:
        for start in range(0, 1_000, 300):
            pieces.append(table[start : start + 300].astype(np.float64))
    assert (tmp_path / "pieces.npy").read_bytes() == (tmp_path / "whole.npy").read_bytes()
    assert_array_equal(open_table(tmp_path / "pieces.npy"), table)


def test_tables_hold_what_they_announce(tmp_path: Path) -> None:
    with (
        pytest.raises(ValueError, match="2 rows of a table"),
        TableWriter(tmp_path / "a.npy", (5, 2), np.int32) as short,
    ):
        short.append(np.zeros((3, 2)))
    with TableWriter(tmp_path / "b.npy", (0, 2, 3), np.int32):
        pass
    assert open_table(tmp_path / "b.npy").shape == (0, 2, 3)
    with TableWriter(tmp_path / "c.npy", (1, 2), np.int32) as wide:
        for rows in (np.zeros((1, 3)), np.zeros((2, 2))):
            with pytest.raises(ValueError, match="do not fit"):
                wide.append(rows)
        wide.append(np.zeros((1, 2)))
