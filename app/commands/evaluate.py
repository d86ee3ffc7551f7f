"""``posematch evaluate``: the programs of the package ``evaluation``, by name.

They are found, not listed: whatever module of that package is a program can be run here. The
package is above this one, which therefore never imports it.
"""

from __future__ import annotations

import ast
import importlib.abc
import importlib.util
import pkgutil
import runpy
import sys
from importlib.machinery import ModuleSpec
from typing import Annotated

import typer

PASS_ON = {"ignore_unknown_options": True, "allow_interspersed_args": False}
"""What follows the program's name, ``--help`` too, is the program's."""

_PACKAGE = "evaluation"


def evaluate(
    program: Annotated[str | None, typer.Argument(help="Which; none lists them.")] = None,
    arguments: Annotated[list[str] | None, typer.Argument(help="Its own arguments.")] = None,
) -> None:
    """Measure accuracy: run one of the programs.

    \b
    posematch evaluate
    posematch evaluate lifting --help
    posematch evaluate renders --data tests/data/renders
    posematch evaluate paper --data DIR
    """  # noqa: D301
    programs = find_programs()
    if program is None:
        width = max(map(len, programs), default=0)
        for name, purpose in programs.items():
            typer.echo(f"{name:<{width}}  {purpose}")
        return
    if program not in programs:
        raise typer.BadParameter(f"one of {', '.join(programs)}", param_hint="PROGRAM")
    sys.argv = [f"posematch evaluate {program}", *(arguments or [])]
    runpy.run_module(f"{_PACKAGE}.{program}", run_name="__main__")


def find_programs() -> dict[str, str]:
    """What each evaluation program is for: the first line of its docstring."""
    package = importlib.util.find_spec(_PACKAGE)
    if package is None:
        return {}
    programs = {}
    for module in pkgutil.iter_modules(package.submodule_search_locations):
        name = f"{_PACKAGE}.{module.name}"
        spec = module.module_finder.find_spec(name, None)
        if module.ispkg and spec is not None:
            # A package is run by its __main__.
            inside = pkgutil.iter_modules(spec.submodule_search_locations)
            mains = [it for it in inside if it.name == "__main__"]
            spec = mains[0].module_finder.find_spec(f"{name}.__main__", None) if mains else None
        source = _source(spec)
        if '__name__ == "__main__"' in source:
            lines = (ast.get_docstring(ast.parse(source)) or "").splitlines()
            programs[module.name] = lines[0] if lines else ""
    return programs


def _source(spec: ModuleSpec | None) -> str:
    if spec is None or not isinstance(spec.loader, importlib.abc.InspectLoader):
        return ""
    return spec.loader.get_source(spec.name) or ""
