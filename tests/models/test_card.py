"""Cards and weights on the disk."""

import resource
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from models.card import (
    WEIGHTS_DIR,
    LiftOutput,
    read_card,
    read_weights,
    write_card,
    write_network,
)


@contextmanager
def files_of_at_most(size: int) -> Iterator[None]:
    """No file may grow beyond ``size`` bytes: what a full disk is like."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, before)


def test_a_network_is_written_with_its_digest(tmp_path: Path) -> None:
    card = read_card(WEIGHTS_DIR / "person.json")
    written = write_network(tmp_path / "new", b"weights", card)
    assert read_card(tmp_path / "new" / "person.json") == written
    assert read_weights(tmp_path / "new" / card.file, written) == b"weights"
    assert {path.name for path in (tmp_path / "new").iterdir()} == {"person.json", card.file}


@pytest.mark.parametrize("size", [50, 10_000])
def test_a_full_disk_leaves_the_old_network_and_nothing_else(tmp_path: Path, size: int) -> None:
    card = write_network(tmp_path, b"old", read_card(WEIGHTS_DIR / "person.json"))
    with files_of_at_most(100), pytest.raises(OSError, match="too large"):
        write_network(tmp_path, bytes(size), card)
    with files_of_at_most(100), pytest.raises(OSError, match="too large"):
        write_card(tmp_path / "person.json", card.model_copy(update={"version": "9"}))
    assert read_card(tmp_path / "person.json") == card
    assert read_weights(tmp_path / card.file, card) == b"old"
    assert {path.name for path in tmp_path.iterdir()} == {"person.json", card.file}


def test_depths_are_of_joints_that_were_found() -> None:
    output = read_card(WEIGHTS_DIR / "lifter-found.json").output.model_dump()
    assert LiftOutput.model_validate(output | {"reads_depths": False}).n_columns == 3
    assert LiftOutput.model_validate(output | {"reads_depths": True}).n_columns == 5
    with pytest.raises(ValueError, match="only a network that reads confidence"):
        LiftOutput.model_validate(output | {"reads_depths": True, "reads_confidence": False})
