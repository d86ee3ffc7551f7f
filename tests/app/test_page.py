"""The page's files over HTTP: whole, cacheable, from nowhere else, under a strict policy."""

from __future__ import annotations

import gzip
import hashlib
import re
from pathlib import Path

import pytest

import app
from app.api.page import read_assets
from tests.app.server import Server

STATIC = Path(app.__file__).parent / "static"
OWN = [p for p in sorted(STATIC.rglob("*")) if p.suffix in {".html", ".css", ".js"}]
OWN = [path for path in OWN if "vendor" not in path.parts]


def test_the_page_and_its_policy(server: Server) -> None:
    page = server.client.get("/")
    assert page.headers["content-type"] == "text/html; charset=utf-8"
    policy = page.headers["content-security-policy"]
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy
    assert "http" not in policy
    assert server.client.head("/").status_code == 200


def test_every_file_that_is_named_is_served(server: Server) -> None:
    """The page's references and every import of a module resolve, and nothing leads elsewhere."""
    named = set(re.findall(r'(?:src|href)="(static/[^"]+)"', server.client.get("/").text))
    for path in STATIC.rglob("*.js"):
        for target in re.findall(r"""(?:from|import\()\s*["'](\.[^"']+)["']""", path.read_text()):
            resolved = (path.parent / target).resolve().relative_to(STATIC)
            named.add(f"static/{resolved.as_posix()}")
    assert len(named) > 12
    for path in sorted(named):
        assert server.client.get(f"/{path}").status_code == 200, path


@pytest.mark.parametrize("path", OWN, ids=lambda path: path.name)
def test_nothing_is_loaded_from_elsewhere(path: Path) -> None:
    text = path.read_text()
    assert not re.findall(r"(?:https?:)?//[\w.-]+\.\w", re.sub(r"^\s*//.*", "", text, flags=re.M))
    assert "innerHTML" not in text
    assert not re.search(r"\sstyle=|\son\w+=", text) or path.suffix == ".js"


def test_files_are_asked_for_once(server: Server) -> None:
    url = "/static/js/main.js"
    first = server.client.get(url, headers={"Accept-Encoding": "identity"})
    assert first.headers["content-type"].startswith("text/javascript")
    assert "content-encoding" not in first.headers
    zipped = server.client.get(url)
    assert zipped.headers["content-encoding"] == "gzip"
    assert zipped.content == first.content
    again = server.client.get(url, headers={"If-None-Match": first.headers["etag"]})
    assert (again.status_code, again.content) == (304, b"")
    other = server.client.get(url, headers={"If-None-Match": '"other"'})
    assert other.status_code == 200


def test_the_page_is_light() -> None:
    """What a first visit transfers; the 3D library is loaded after the rest."""
    assets = read_assets(STATIC)
    sizes = {path: len(it.zipped or it.data) for path, it in assets.items()}
    vendored = sum(size for path, size in sizes.items() if path.startswith("vendor/three/"))
    own = sum(size for path, size in sizes.items() if not path.startswith(("vendor/", "samples/")))
    assert own < 40_000
    assert vendored < 250_000


def test_no_way_out_of_the_directory(server: Server) -> None:
    for path in ("/static/", "/static/../main.py", "/static/%2e%2e/main.py", "/static/vendor"):
        response = server.client.get(path)
        assert response.status_code == 404
        assert response.headers["content-type"] == "application/problem+json"


@pytest.mark.parametrize("package", ["three", "swagger-ui-dist"])
def test_vendored_files_are_those_that_were_checked(package: str) -> None:
    directory = STATIC / "vendor" / package
    sums = dict(line.split()[::-1] for line in (directory / "SHA256SUMS").read_text().splitlines())
    files = {path.name for path in directory.iterdir()} - {"SHA256SUMS", "VERSION"}
    assert files == sums.keys()
    assert "LICENSE" in sums
    for name, digest in sums.items():
        assert hashlib.sha256((directory / name).read_bytes()).hexdigest() == digest, name


def test_gzip_is_the_same_every_time() -> None:
    asset = read_assets(STATIC)["style.css"]
    assert asset.zipped is not None
    assert gzip.decompress(asset.zipped) == asset.data
