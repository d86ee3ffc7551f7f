"""Numbers on command lines: what argparse makes of them, and that no program takes bare ones."""

from __future__ import annotations

import argparse
import ast
from pathlib import Path

import pytest

from evaluation.paper.__main__ import main
from library_store.arguments import SEED, integer, integers, real

ROOT = Path(__file__).parents[2]
PROGRAMS = ("app", "benchmarks", "deploy", "evaluation", "library_store", "models", "client")


@pytest.fixture
def parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="some")
    parser.add_argument("--count", type=integer(1), nargs="+")
    parser.add_argument("--jobs", type=integer(0, 4))
    parser.add_argument("--minutes", type=real(0.1))
    parser.add_argument("--share", type=real(0, 1))
    parser.add_argument("--seed", type=SEED)
    parser.add_argument("--blocks", type=integers(4, ","))
    parser.add_argument("--canvas", type=integers(2, "x", multiples_of=32))
    return parser


def test_bounds_are_included(parser: argparse.ArgumentParser) -> None:
    line = "--count 1 70 --jobs 4 --minutes 0.1 --share 1 --seed 9223372036854775807"
    found = vars(parser.parse_args([*line.split(), "--blocks", "2,3,4,1", "--canvas", "320x32"]))
    wanted = {"count": [1, 70], "jobs": 4, "minutes": 0.1, "share": 1.0, "seed": 2**63 - 1}
    wanted |= {"blocks": [2, 3, 4, 1], "canvas": [320, 32]}
    assert found == wanted
    assert isinstance(found["share"], float)


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("--count 3 0", "argument --count: '0' is no integer of at least 1"),
        ("--count 1.5", "argument --count: '1.5' is no integer of at least 1"),
        ("--jobs -1", "argument --jobs: '-1' is no integer from 0 to 4"),
        ("--jobs 5", "argument --jobs: '5' is no integer from 0 to 4"),
        ("--minutes 0", "argument --minutes: '0' is no number of at least 0.1"),
        ("--minutes inf", "argument --minutes: 'inf' is no number of at least 0.1"),
        ("--minutes nan", "argument --minutes: 'nan' is no number of at least 0.1"),
        ("--share 1.01", "argument --share: '1.01' is no number from 0 to 1"),
        ("--share half", "argument --share: 'half' is no number from 0 to 1"),
        ("--seed 9223372036854775808", "is no integer from 0 to 9223372036854775807"),
        ("--blocks 2,3,4", "'2,3,4' is not 4 integers above 0 with ',' between them"),
        ("--blocks 2,0,4,3", "'2,0,4,3' is not 4 integers above 0 with ',' between them"),
        ("--blocks 2,,4,3", "'2,,4,3' is not 4 integers above 0 with ',' between them"),
        ("--canvas 320x250", "'320x250' is not 2 multiples of 32 above 0 with 'x' between them"),
        ("--canvas 320", "'320' is not 2 multiples of 32 above 0 with 'x' between them"),
    ],
)
def test_what_is_out_of_range_is_refused_in_one_line(
    parser: argparse.ArgumentParser, line: str, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as refused:
        parser.parse_args(line.split())
    assert refused.value.code == 2
    assert capsys.readouterr().err.splitlines()[-1].endswith(said)


@pytest.mark.parametrize(
    "line", ["--entries -5", "--views -3", "--curve-views -1", "--seed -1", "--noise-px nan"]
)
def test_the_papers_tables_refuse_them(line: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as refused:
        main(["--data", "cmu", *line.split()])
    assert refused.value.code == 2
    assert f"argument {line.split()[0]}: " in capsys.readouterr().err


def test_no_program_takes_numbers_of_any_size() -> None:
    bare = [
        f"{path.relative_to(ROOT)}:{node.lineno}"
        for package in PROGRAMS
        for path in sorted((ROOT / package).rglob("*.py"))
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Call)
        for keyword in node.keywords
        if keyword.arg == "type"
        and isinstance(keyword.value, ast.Name)
        and keyword.value.id in ("int", "float")
    ]
    assert bare == []
