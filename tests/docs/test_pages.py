"""README and docs: links lead somewhere, what they name exists, and what exists is documented."""

from __future__ import annotations

import json
import re
import shlex
import tomllib
from itertools import chain, pairwise
from pathlib import Path

import pytest
import typer
from prometheus_client import generate_latest

from app.cli import cli
from app.errors import RequestError
from app.licences_table import END, START, renewed
from app.main import create_app
from app.observability import Metrics
from app.settings import ENV_PREFIX, Settings
from models.providers import PACKAGES

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")), ROOT / "client" / "README.md"]
LINK = re.compile(r"\]\(([^)\s]+)\)")
FENCE = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)
EVERYTHING = "\n".join(page.read_text() for page in PAGES)

every_page = pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))


def anchors(page: Path) -> set[str]:
    """The anchors of a page's headings, as GitHub makes them."""
    text = FENCE.sub("", page.read_text())
    headings = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    return {
        re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in headings
    }


def commands(page: Path) -> list[str]:
    """Command lines of the page's shell examples, continued lines joined, comments taken off."""
    blocks = [body for language, body in FENCE.findall(page.read_text()) if language == "bash"]
    lines = "\n".join(blocks).replace("\\\n", " ").splitlines()
    return [re.sub(r"(^|\s)#.*", "", line).strip() for line in lines]


@every_page
def test_every_relative_link_leads_somewhere(page: Path) -> None:
    for target in LINK.findall(FENCE.sub("", page.read_text())):
        if re.match(r"[a-z]+:", target):
            continue
        path, _, anchor = target.partition("#")
        linked = (page.parent / path).resolve() if path else page
        assert linked.exists(), target
        assert linked.is_relative_to(ROOT), target
        if anchor:
            assert anchor in anchors(linked), target


@pytest.mark.parametrize("page", sorted((ROOT / "docs").glob("*.md")), ids=lambda page: page.name)
def test_every_page_is_reached_from_the_readme(page: Path) -> None:
    assert f"docs/{page.name}" in LINK.findall((ROOT / "README.md").read_text())


@every_page
def test_every_setting_named_is_one(page: Path) -> None:
    known = {ENV_PREFIX + name.upper() for name in Settings.model_fields}
    for name in re.findall(rf"\b{ENV_PREFIX}[A-Z_]*[A-Z]\b(?!\*)", page.read_text()):
        assert name in known


@every_page
def test_every_endpoint_named_is_there(page: Path) -> None:
    paths = set(create_app(Settings()).openapi()["paths"])
    patterns = [re.compile(re.sub(r"\\{.*?\\}", "[^/?#]+", re.escape(path))) for path in paths]
    named = re.findall(r"(?<![\w.])/(?:v1/[\w{}/]+|livez|readyz|metrics)\b}?", page.read_text())
    for path in named:
        assert any(pattern.fullmatch(path.rstrip("/")) for pattern in patterns), path


def test_every_endpoint_and_parameter_is_documented() -> None:
    text = (ROOT / "docs" / "api.md").read_text()
    for path, verbs in create_app(Settings()).openapi()["paths"].items():
        assert re.search(re.sub(r"\\{.*?\\}", r"{\\w+}", re.escape(path)), text), path
        for operation in verbs.values():
            for parameter in operation.get("parameters", []):
                if parameter["in"] == "query":
                    assert f"`{parameter['name']}" in text, parameter["name"]


def test_every_status_of_a_refusal_is_documented() -> None:
    table = (ROOT / "docs" / "api.md").read_text().partition("## Errors")[2]
    for kind in RequestError.__subclasses__():
        assert re.search(rf"^\|[^|]*\b{kind.status}\b", table, re.MULTILINE), kind


@every_page
def test_every_script_and_module_that_is_run_exists(page: Path) -> None:
    for line in commands(page):
        for word in re.findall(r"(?<![\w/.-])scripts/[\w-]+", line):
            assert (ROOT / word).is_file(), line
        for module in re.findall(
            r"python3? -m ((?:app|benchmarks|evaluation|library_store|models)\b[\w.]*)", line
        ):
            base = ROOT / module.replace(".", "/")
            assert base.with_suffix(".py").exists() or (base / "__main__.py").exists(), line


@every_page
def test_every_posematch_command_has_these_options(page: Path) -> None:
    group = typer.main.get_command(cli)
    for line in commands(page):
        if not re.search(r"(?:^|[/ ])posematch [a-z]", line):
            continue
        words = shlex.split(line, posix=False)
        start = next(i for i, word in enumerate(words) if word.rsplit("/", 1)[-1] == "posematch")
        known = {"--help"}
        command = group
        for word in words[start + 1 :]:
            children = getattr(command, "commands", {})
            if word in children:
                command = children[word]
        known |= {name for item in command.params for name in (*item.opts, *item.secondary_opts)}
        for word in words[start + 1 :]:
            if word in {"|", ">", "&&", "||", ";"}:
                break
            if word.startswith("--"):
                assert word.partition("=")[0] in known, line


def test_every_metric_is_documented_and_no_other() -> None:
    text = (ROOT / "docs" / "operations.md").read_text()
    watch = text.partition("## What to watch")[2].partition("\n## ")[0]
    served = generate_latest(Metrics().registry).decode()
    metrics = set(re.findall(r"^# TYPE (posematch\w*) ", served, re.MULTILINE))
    assert set(re.findall(r"`(posematch_\w+)`", watch)) == {
        name for name in metrics if not name.endswith("_created")
    }


def test_the_table_of_licences_is_that_of_the_lock_file() -> None:
    text = (ROOT / "docs" / "licences.md").read_text()
    assert START in text
    assert END in text
    assert renewed(text) == text, "run scripts/licences-table"


def test_the_licence_of_every_extra_is_stated() -> None:
    text = (ROOT / "docs" / "licences.md").read_text()
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    for requirement in chain.from_iterable(project["optional-dependencies"].values()):
        name = re.split(r"[^\w-]", requirement)[0]
        assert re.search(rf"(?<![\w-]){re.escape(name)}(?![\w-])", text), name


def test_the_vendored_versions_are_those_named() -> None:
    text = (ROOT / "docs" / "licences.md").read_text()
    for version in (ROOT / "app" / "static" / "vendor").glob("*/VERSION"):
        name, number = version.read_text().split(",")[0].split()
        assert re.search(
            rf"\| [^|]*{re.escape(number)} \| `{version.parent.relative_to(ROOT)}/`", text
        ), name


def test_headings_do_not_jump() -> None:
    for page in PAGES:
        text = FENCE.sub("", page.read_text())
        levels = [len(marks) for marks in re.findall(r"^(#+) ", text, re.MULTILINE)]
        assert levels[0] == 1, page
        assert all(deeper - level <= 1 for level, deeper in pairwise(levels)), page


def test_the_packages_of_all_providers_are_where_the_refusal_sends_to() -> None:
    operations = (ROOT / "docs" / "operations.md").read_text()
    for package in PACKAGES.values():
        assert re.search(rf"pip (un)?install {package}`|`{package}`", operations), package


def test_the_answer_in_the_readme_is_of_the_network_served() -> None:
    """Its other numbers need the whole library: `curl` as it stands there gives them anew."""
    shown = re.search(
        r'"model": {"name": "([\w-]+)", "version": "([\d.]+)", "sha256": "(\w+)…"}',
        (ROOT / "README.md").read_text(),
    )
    assert shown is not None
    name, version, digest = shown.groups()
    card = json.loads((ROOT / "models" / "weights" / f"{name}.json").read_text())
    assert version == card["version"], "renew the answer in README.md"
    assert card["sha256"].startswith(digest)
