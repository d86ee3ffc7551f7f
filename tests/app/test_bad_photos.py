"""Photos meant to hurt, and photos that merely are odd, over a real socket."""

from __future__ import annotations

import io
import struct
import time
import zlib
from collections import Counter
from pathlib import Path
from urllib.parse import quote

import cv2
import httpx
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from benchmarks import fuzz
from benchmarks.service import Service, started_service
from tests.app.imaging.image_files import encode, png_chunk
from tests.app.server import Server

PNG = b"\x89PNG\r\n\x1a\n"
KINDS = [".jpg", ".png", ".webp"]


@pytest.fixture(scope="module")
def small(photo: bytes) -> npt.NDArray[np.uint8]:
    """The photo at 160 x 120."""
    pixels = cv2.imdecode(np.frombuffer(photo, np.uint8), cv2.IMREAD_COLOR)
    assert pixels is not None
    return np.asarray(cv2.resize(pixels, (160, 120), interpolation=cv2.INTER_AREA), np.uint8)


def ask(server: Server, data: bytes, query: str = "max_people=1") -> httpx.Response:
    response = server.client.post(f"/v1/poses?{query}", content=data)
    if response.status_code != 200:
        assert response.headers["content-type"] == "application/problem+json"
    return response


def resident_mb(server: Server) -> float:
    return Service(server.url, server.process.pid).resident_mb()


def png(width: int, height: int, data: bytes, *extra: bytes, depth: int = 1) -> bytes:
    header = png_chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, depth, 0, 0, 0, 0))
    return PNG + header + b"".join(extra) + png_chunk(b"IDAT", data) + png_chunk(b"IEND", b"")


@pytest.mark.parametrize("kind", KINDS)
def test_truncated_at_every_percent(
    server: Server, small: npt.NDArray[np.uint8], kind: str
) -> None:
    whole = encode(small, kind)
    for percent in range(1, 100):
        assert ask(server, whole[: len(whole) * percent // 100]).status_code in {415, 422}
    assert ask(server, whole).status_code == 200


@pytest.mark.parametrize("kind", KINDS)
def test_corrupt_at_every_percent(server: Server, small: npt.NDArray[np.uint8], kind: str) -> None:
    """Sixteen bytes overwritten: the picture is shown as viewers show it, or refused."""
    whole = encode(small, kind)
    statuses: Counter[int] = Counter()
    for percent in range(100):
        at = len(whole) * percent // 100
        damaged = whole[:at] + b"\xa5" * 16 + whole[at + 16 :]
        statuses[ask(server, damaged[: len(whole)]).status_code] += 1
    assert set(statuses) <= {200, 413, 415, 422}
    if kind == ".png":
        assert statuses[200] == 0, "its checksums tell"


def vp8l(width: int, height: int) -> bytes:
    """A lossless WebP whose header promises so many pixels."""
    bits = (width - 1) | (height - 1) << 14
    body = b"\x2f" + struct.pack("<I", bits) + bytes(20)
    chunk = b"VP8L" + struct.pack("<I", len(body)) + body + bytes(len(body) & 1)
    return b"RIFF" + struct.pack("<I", 4 + len(chunk)) + b"WEBP" + chunk


def test_bombs_are_refused_from_their_headers(server: Server, photo: bytes) -> None:
    jpeg = bytearray(photo)
    frame = jpeg.find(b"\xff\xc0")
    jpeg[frame + 5 : frame + 9] = struct.pack(">HH", 65_500, 65_500)
    before = resident_mb(server)
    for bomb in (bytes(jpeg), png(30_000, 30_000, zlib.compress(bytes(99))), vp8l(16_000, 16_000)):
        started = time.monotonic()
        response = ask(server, bomb)
        assert response.status_code == 413
        assert response.json()["type"] == "urn:posematch:problem:too-many-pixels"
        assert time.monotonic() - started < 5
    assert resident_mb(server) < before + 20


def test_bombs_that_are_honest_about_their_size(server: Server) -> None:
    """More data than the pixels need, in the image or in a text, is not unpacked."""
    much = zlib.compress(bytes(200_000_000), 9)
    before = resident_mb(server)
    for bomb in (
        png(8, 8, much),
        png(8, 8, zlib.compress(bytes(16)), png_chunk(b"zTXt", b"comment\0\0" + much)),
        png(8, 8, zlib.compress(bytes(16)), png_chunk(b"iCCP", b"profile\0\0" + much)),
    ):
        assert ask(server, bomb).status_code in {200, 422}
    assert resident_mb(server) < before + 60


def test_sizes_that_are_lies(server: Server, photo: bytes) -> None:
    """A header that promises more rows than there are data for."""
    jpeg = bytearray(photo)
    frame = jpeg.find(b"\xff\xc0")
    for height, width in ((1900, 1900), (480, 1), (0, 640), (1, 65_000)):
        jpeg[frame + 5 : frame + 9] = struct.pack(">HH", height, width)
        assert ask(server, bytes(jpeg)).status_code in {200, 422}
    assert ask(server, png(1900, 1900, zlib.compress(bytes(16)))).status_code in {200, 422}
    assert ask(server, vp8l(1900, 1900)).status_code == 422


def test_polyglots_are_what_their_first_bytes_say(
    server: Server, small: npt.NDArray[np.uint8]
) -> None:
    jpeg = encode(small, ".jpg")
    script = b"<script>alert(1)</script>"
    comment = b"\xff\xfe" + struct.pack(">H", len(script) + 2) + script
    for data in (jpeg + b"PK\x03\x04" + bytes(64), jpeg[:2] + comment + jpeg[2:], jpeg + script):
        response = ask(server, data)
        assert response.status_code == 200
        assert response.headers["content-type"] == "application/json"
        assert response.headers["x-content-type-options"] == "nosniff"
        assert b"script" not in response.content
    for data in (b"GIF89a" + jpeg, b"%PDF-1.7\n" + jpeg, script + jpeg, b"BM" + jpeg):
        assert ask(server, data).status_code == 415


def test_odd_but_good(server: Server, small: npt.NDArray[np.uint8]) -> None:
    deep = small.astype(np.uint16) * 257
    cmyk = io.BytesIO()
    Image.fromarray(small).convert("CMYK").save(cmyk, "JPEG")
    palette = io.BytesIO()
    Image.fromarray(small).convert("P").save(palette, "PNG")
    one = np.full((1, 1, 3), 90, np.uint8)
    row = np.full((1, 20_000, 3), 90, np.uint8)
    photos = {
        "1x1": [encode(one, kind) for kind in KINDS],
        "1x20000": [encode(row, ".jpg"), encode(row, ".png"), encode(np.rot90(row), ".png")],
        "16 bits": [encode(deep, ".png"), encode(np.dstack([deep, deep[..., 0]]), ".png")],
        "grey": [encode(small[..., 0], kind) for kind in KINDS],
        "alpha": [encode(np.dstack([small, small[..., 0]]), kind) for kind in (".png", ".webp")],
        "cmyk": [cmyk.getvalue()],
        "palette": [palette.getvalue()],
        "progressive": [encode(small, ".jpg", cv2.IMWRITE_JPEG_PROGRESSIVE, 1)],
        "restarts": [encode(small, ".jpg", cv2.IMWRITE_JPEG_RST_INTERVAL, 2)],
    }
    for name, datas in photos.items():
        for data in datas:
            response = ask(server, data)
            assert response.status_code == 200, f"{name}: {response.text}"


values = st.text(max_size=40) | st.floats().map(str) | st.integers().map(str)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(pairs=st.lists(st.tuples(st.sampled_from(fuzz.NAMES) | st.text(max_size=9), values)))
def test_queries(server: Server, pairs: list[tuple[str, str]]) -> None:
    query = "&".join(f"{quote(k, errors='replace')}={quote(v, errors='replace')}" for k, v in pairs)
    grey = encode(np.full((8, 8, 3), 90, np.uint8), ".jpg")
    assert ask(server, grey, query).status_code in {200, 422}


@pytest.mark.slow
def test_the_fuzzer_finds_nothing(tmp_path: Path, library_dir: Path) -> None:
    """A bounded, seeded run of ``benchmarks.fuzz``, with the temporary directory watched."""
    temporary = tmp_path / "tmp"
    temporary.mkdir()
    settings = {"library_dir": library_dir, "max_pixels": 4_000_000, "deadline_ms": 60_000}
    with started_service(settings, {"TMPDIR": str(temporary)}) as service:
        cases = fuzz.iterate_cases(np.random.default_rng(7), fuzz.make_seeds())
        statuses = fuzz.assault(service, cases, temporary, until=time.monotonic() + 120, limit=400)
    assert statuses[200] > 20
    assert statuses[422] > 100
