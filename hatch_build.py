"""Compiles the loops in C++ when the project is installed, in place or into a wheel."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

COMPILED = {
    "library_store/_scan.so": ["library_store/scan.cpp"],
    "app/lifting/_lifting.so": [
        "app/lifting/resection.cpp",
        "app/lifting/ensemble.cpp",
        "app/lifting/evidence.cpp",
        "app/lifting/update.cpp",
    ],
}
FLAGS = ["-std=c++17", "-O3", "-fno-math-errno", "-fno-trapping-math", "-shared", "-fPIC"]


class CompileLoops(BuildHookInterface):  # type: ignore[type-arg]
    """The parts of the project that are not Python."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:  # noqa: ARG002
        """Compile, and say that the wheel holds for this platform."""
        compiler = os.environ.get("CXX") or shutil.which("c++") or shutil.which("g++")
        if compiler is None:
            raise SystemExit("a C++ compiler is needed (Debian: apt-get install g++)")
        root = Path(self.root)
        for compiled, sources in COMPILED.items():
            # In one step, for the file may be in use.
            unfinished = root / f"{compiled}.{os.getpid()}"
            paths = [root / source for source in sources]
            subprocess.run([compiler, *FLAGS, "-o", unfinished, *paths], check=True)
            unfinished.replace(root / compiled)
            build_data["artifacts"].append(compiled)
        build_data["pure_python"] = False
        build_data["infer_tag"] = True
