"""``scripts/setup`` where something is there already."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]

PROJECT = """
[build-system]
requires = []
build-backend = "backend"
backend-path = ["."]
[project]
name = "nothing"
version = "1"
"""
BACKEND = '''
"""Builds a wheel of nothing: no index is asked."""
import zipfile
NAME = "nothing-1-py3-none-any.whl"
FILES = {
    "METADATA": "Metadata-Version: 2.1\\nName: nothing\\nVersion: 1\\n",
    "WHEEL": "Wheel-Version: 1.0\\nRoot-Is-Purelib: true\\nTag: py3-none-any\\n",
    "RECORD": "",
}
def build_editable(directory, *_):
    with zipfile.ZipFile(f"{directory}/{NAME}", "w") as wheel:
        for name, text in FILES.items():
            wheel.writestr(f"nothing-1.dist-info/{name}", text)
    return NAME
build_wheel = build_editable
'''


def test_an_environment_without_pip_is_completed(tmp_path: Path) -> None:
    """As Debian's Python leaves it when its package python3-venv is missing, and as uv makes it."""
    (tmp_path / "scripts").mkdir()
    shutil.copy(ROOT / "scripts" / "setup", tmp_path / "scripts")
    for folder in ("library_store", "app/lifting"):
        (tmp_path / folder).mkdir(parents=True)
        (tmp_path / folder / "loops.cpp").touch()
    for name in ("requirements.lock", "hatch_build.py"):
        (tmp_path / name).touch()
    (tmp_path / "pyproject.toml").write_text(PROJECT)
    (tmp_path / "backend.py").write_text(BACKEND)
    venv = [sys.executable, "-m", "venv", "--without-pip", str(tmp_path / ".venv")]
    subprocess.run(venv, check=True)
    environment = {**os.environ, "PYTHON": sys.executable}
    done = subprocess.run(
        [tmp_path / "scripts" / "setup"],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / ".venv" / ".locked").exists()
