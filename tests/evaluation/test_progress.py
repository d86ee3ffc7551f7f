"""What a user sees of the minutes that an evaluation takes."""

import pytest

from evaluation.progress import followed


def test_a_bar_on_a_terminals_stderr_alone(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert list(followed(range(3), "videos")) == [0, 1, 2]
    assert capsys.readouterr() == ("", "")
    monkeypatch.setenv("FORCE_COLOR", "1")
    assert list(followed(range(3), "videos")) == [0, 1, 2]
    printed = capsys.readouterr()
    assert printed.out == ""
    assert "videos" in printed.err
