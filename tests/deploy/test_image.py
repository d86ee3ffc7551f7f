"""The Dockerfile, read: what it copies, what is let through to it, and its health check, run."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import yaml

from app.settings import ENV_PREFIX, Settings
from library_store.build import BuildSettings, build_library
from library_store.prior import PosePrior
from tests.app.server import Server, free_port

ROOT = Path(__file__).parents[2]
DOCKERFILE = (ROOT / "Dockerfile").read_text()
BUILD, SERVED = DOCKERFILE.rsplit("\nFROM ", 1)


def test_all_that_the_package_is_made_of_is_copied_and_not_ignored() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    wheel = project["tool"]["hatch"]["build"]["targets"]["wheel"]
    needed = {*wheel["packages"], wheel["hooks"]["custom"]["path"], project["project"]["readme"]}
    needed |= {*project["project"]["license-files"], "pyproject.toml", "requirements.lock"}
    copied = {
        name
        for line in re.findall(r"^COPY (?!--from)(.+) \S+$", BUILD, re.MULTILINE)
        for name in line.split()
    }
    assert copied == needed
    passed = re.findall(r"^!(.+)$", (ROOT / ".dockerignore").read_text(), re.MULTILINE)
    assert set(passed) == needed


def test_every_loop_in_cpp_is_compiled() -> None:
    compiled = re.findall(r'"([\w/]+\.cpp)"', (ROOT / "hatch_build.py").read_text())
    written = [
        path.relative_to(ROOT)
        for room in ("app", "library_store", "models")
        for path in (ROOT / room).rglob("*.cpp")
    ]
    assert sorted(compiled) == sorted(map(str, written))
    assert "g++" in BUILD
    assert "HNSWLIB_NO_NATIVE=1" in BUILD, "it is to run on other CPUs than the builder's"


def test_its_variables_are_settings_and_compose_keeps_its_cache() -> None:
    variables = dict(re.findall(rf"\b{ENV_PREFIX}(\w+)=(\S+)", SERVED))
    assert {name.lower() for name in variables} <= Settings.model_fields.keys()
    (service,) = yaml.safe_load((ROOT / "docker-compose.yml").read_text())["services"].values()
    (volume,) = service["volumes"]
    assert volume.partition(":")[2] == variables["CACHE_DIR"]
    assert f"VOLUME {variables['CACHE_DIR']}" in SERVED
    (port,) = service["ports"]
    assert port.rpartition(":")[2] == variables["PORT"]
    assert float(service["stop_grace_period"].removesuffix("s")) > Settings().shutdown_grace_s


def test_the_health_check_tells_a_ready_service_from_none(tmp_path: Path) -> None:
    check = re.search(r"HEALTHCHECK .*?CMD (\[.*?\])$", SERVED, re.DOTALL | re.MULTILINE)
    assert check is not None
    python, *arguments = json.loads(check[1])
    assert python == "python"

    def code(port: int) -> int:
        proxy = {"http_proxy": "http://127.0.0.1:9", "no_proxy": ""}  # as Docker may set it
        environment = {**os.environ, "POSEMATCH_PORT": str(port), **proxy}
        return subprocess.run(
            [sys.executable, *arguments], env=environment, stderr=subprocess.DEVNULL, check=False
        ).returncode

    build_library(tmp_path / "small", PosePrior.load(), BuildSettings(name="small", n_poses=500))
    with Server(tmp_path / "log", library_dir=tmp_path / "small") as server:
        assert code(server.port) == 0
    assert code(free_port()) != 0
