"""The table of dependencies in docs/licences.md, made from the lock file and what is installed."""

from __future__ import annotations

import re
from importlib import metadata
from pathlib import Path

from app.page_table import renew_page, with_table

START, END = "<!-- dependencies: scripts/licences-table -->", "<!-- end of dependencies -->"
LOCK = Path(__file__).resolve().parent.parent / "requirements.lock"
_SPDX = {
    "License :: OSI Approved :: Apache Software License": "Apache-2.0",
    "License :: OSI Approved :: ISC License (ISCL)": "ISC",
    "License :: OSI Approved :: MIT License": "MIT",
    "3-Clause BSD License": "BSD-3-Clause",
    "BSD-3-Clause": "BSD-3-Clause",
}
"""What packages without a licence expression say, in such expressions."""
_BY_HAND = {"colorama": "BSD-3-Clause", "hnswlib": "Apache-2.0"}
"""Packages that only another system installs, and those that say it in their licence file alone."""


def locked_packages() -> list[str]:
    """Names in requirements.lock, in its order."""
    names = re.findall(r"^([A-Za-z0-9][\w.-]*)==", LOCK.read_text(), re.MULTILINE)
    return list(dict.fromkeys(names))


def licence_of(package: str) -> str:
    """SPDX expression of an installed package; ``KeyError`` when it says something unknown."""
    if package in _BY_HAND:
        return _BY_HAND[package]
    said = metadata.metadata(package)
    if "License-Expression" in said:
        return str(said["License-Expression"])
    classifiers = said.get_all("Classifier") or []
    chosen = [line for line in classifiers if line.startswith("License ::")]
    return " OR ".join(_SPDX[line] for line in chosen or [said["License"]])


def licences_table() -> str:
    """Markdown: package, licence."""
    rows = ["| package | licence |", "|---|---|"]
    rows += [
        f"| [{name}](https://pypi.org/project/{name}/) | {licence_of(name)} |"
        for name in locked_packages()
    ]
    return "\n".join(rows)


def renewed(text: str) -> str:
    """``text`` of a page with the table between the two marks renewed."""
    return with_table(text, START, END, licences_table())


if __name__ == "__main__":
    renew_page(renewed)
