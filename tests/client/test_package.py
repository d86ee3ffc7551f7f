"""The client's package: its types are the service's, and it needs nothing of the service."""

from __future__ import annotations

import ast
import json
import subprocess
import sys
import tomllib
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

import posematch_client
from posematch_client.version import VERSION

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "client" / "posematch_client"
PROJECT = tomllib.loads((ROOT / "client" / "pyproject.toml").read_text())["project"]


def test_types_are_those_of_the_contract() -> None:
    spec = spec_from_file_location("generate_types", ROOT / "client" / "generate_types.py")
    assert spec is not None
    assert spec.loader is not None
    generator = module_from_spec(spec)
    spec.loader.exec_module(generator)
    document = json.loads((ROOT / "docs" / "openapi.json").read_text())
    written = (PACKAGE / "types.py").read_text()
    assert generator.generate(document) == written, "run scripts/openapi"


def test_it_imports_nothing_but_what_it_declares() -> None:
    declared = {requirement.split(">")[0] for requirement in PROJECT["dependencies"]}
    allowed = declared | {"posematch_client"} | set(sys.stdlib_module_names)
    for path in PACKAGE.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            names = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                assert node.level == 0
                names = [node.module or ""]
            assert {name.split(".")[0] for name in names} <= allowed, path.name


def test_it_works_where_the_service_is_not() -> None:
    code = """
import sys
class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {"app", "models", "library_store", "numpy", "cv2", "onnxruntime",
                                  "pydantic", "fastapi", "starlette", "uvicorn", "typer"}:
            raise ModuleNotFoundError(name)
sys.meta_path.insert(0, Missing())
import posematch_client
print(posematch_client.__version__)
"""
    environment = {"PYTHONPATH": str(ROOT / "client")}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False
    )
    assert done.stdout.strip() == VERSION, done.stderr


def test_what_is_exported_is_there_and_documented() -> None:
    assert PROJECT["version"] == VERSION
    for name in posematch_client.__all__:
        assert getattr(posematch_client, name).__doc__ or name == "Photo"
    assert (PACKAGE / "py.typed").exists()
