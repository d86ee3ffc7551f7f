"""The examples of README, docs/api.md and docs/client.md, run as they stand against a server."""

from __future__ import annotations

import ast
import asyncio
import inspect
import json
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import pytest

from library_store.build import BuildSettings, build_library
from library_store.prior import DEFAULT_PRIOR, PosePrior
from tests.app.server import Server
from tests.docs.test_pages import FENCE, ROOT

DOCUMENTED_URL = "http://127.0.0.1:8000"
PLACEHOLDER = '"…"'


def examples(page: str, language: str) -> list[str]:
    """The code blocks of a page in a language."""
    found = FENCE.findall((ROOT / page).read_text())
    return [body for of, body in found if of == language and "pip install" not in body]


def curls(page: str) -> list[str]:
    """The curl commands of a page, one line each."""
    lines = "\n".join(examples(page, "bash")).replace("\\\n", " ").splitlines()
    return [line for line in lines if line.startswith("curl ")]


CURLS = [(page, line) for page in ("README.md", "docs/api.md") for line in curls(page)]
PYTHON = [
    (page, code)
    for page in ("docs/api.md", "docs/client.md", "client/README.md")
    for code in examples(page, "python")
]


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    directory = tmp_path_factory.mktemp("libraries") / "small"
    prior = PosePrior.load(DEFAULT_PRIOR)
    build_library(directory, prior, BuildSettings(name="small", n_poses=4000))
    log = tmp_path_factory.mktemp("server") / "log"
    with Server(log, library_dir=directory, deadline_ms=60_000, queue_size=64) as running:
        yield running


@pytest.fixture
def clone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """What the examples find where they are run: a clone, and the photos that they name."""
    for name in ("docs", "app"):
        (tmp_path / name).symlink_to(ROOT / name)
    sample = ROOT / "docs" / "images" / "sample.jpg"
    for name in ("photo.jpg", "a.jpg"):
        shutil.copy(sample, tmp_path / name)
    image = cv2.imread(str(sample))
    assert image is not None
    cv2.imwrite(str(tmp_path / "b.png"), image)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_there_are_examples() -> None:
    assert len(CURLS) >= 4
    assert len(PYTHON) >= 3
    assert len(examples("docs/api.md", "javascript")) == 1


@pytest.mark.parametrize(("page", "line"), CURLS)
def test_curl(page: str, line: str, server: Server, clone: Path) -> None:
    assert DOCUMENTED_URL in line, page
    command = line.replace(DOCUMENTED_URL, server.url).replace(
        "curl -s", "curl -s --fail-with-body"
    )
    run = subprocess.run(["bash", "-c", command], cwd=clone, capture_output=True, text=True)
    assert run.returncode == 0, run.stdout + run.stderr
    answer = json.loads(run.stdout)
    if "images" in answer:
        assert [item["problem"] for item in answer["images"]] == [None, None]
    else:
        assert answer["people"][0]["joints_3d"]


@pytest.mark.parametrize(("page", "code"), PYTHON)
@pytest.mark.usefixtures("clone")
def test_python(page: str, code: str, server: Server, capsys: pytest.CaptureFixture[str]) -> None:
    code = code.replace(DOCUMENTED_URL, server.url).replace(PLACEHOLDER, '"a-key-of-their-own"')
    compiled = compile(code, page, "exec", flags=ast.PyCF_ALLOW_TOP_LEVEL_AWAIT)
    names: dict[str, Any] = {"photo_bytes": Path("photo.jpg").read_bytes()}
    # An example with `await` in it evaluates to a coroutine.
    result = eval(compiled, names)
    if inspect.iscoroutine(result):
        asyncio.run(result)
    else:
        assert "head_top" in capsys.readouterr().out
    assert names["answer"]["people"]


def test_javascript(server: Server, clone: Path) -> None:
    node = shutil.which("node")
    if node is None:
        pytest.skip("no node here; the page's tests run JavaScript in a browser")
    (code,) = examples("docs/api.md", "javascript")
    read = re.search(r'readFileSync\("[^"]+"\)', code)
    assert read is not None
    prelude = f'import {{ readFileSync }} from "node:fs";\nconst file = {read[0]};\n'
    source = prelude + code.replace(DOCUMENTED_URL, server.url)
    command = [node, "--input-type=module", "--eval", source]
    run = subprocess.run(command, cwd=clone, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    assert "head_top" in run.stdout
