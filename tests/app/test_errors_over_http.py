"""Every row of the error table, over a real socket."""

from __future__ import annotations

import struct
import time
import zlib
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from typing import Any

import cv2
import httpx
import numpy as np
import pytest

from tests.app.conftest import API_KEY
from tests.app.server import Server, read_response, read_whole


def problem(response: httpx.Response, status: int, slug: str) -> dict[str, Any]:
    """The problem in ``response``, checked to be the expected one and complete."""
    assert response.status_code == status, response.text
    assert response.headers["content-type"] == "application/problem+json"
    body: dict[str, Any] = response.json()
    assert body["type"] == f"urn:posematch:problem:{slug}"
    assert body["status"] == status
    assert body["title"]
    assert body["detail"]
    assert body["request_id"] == response.headers["x-request-id"]
    assert "server-timing" in response.headers
    return body


def post(server: Server, data: bytes, path: str = "/v1/poses", **kwargs: Any) -> httpx.Response:
    return server.client.post(path, content=data, **kwargs)


@pytest.mark.parametrize("path", ["/v1/poses", "/v1/poses/batch", "/v1/lift"])
def test_empty_body(server: Server, path: str) -> None:
    form = {"Content-Type": "multipart/form-data; boundary=b"} if "batch" in path else {}
    problem(post(server, b"", path, headers=form), 400, "empty-body")


def test_truncated_and_corrupt(server: Server, photo: bytes) -> None:
    problem(post(server, photo[:20_000]), 422, "undecodable-image")
    problem(post(server, b"\xff\xd8\xff\xe0" + bytes(500)), 422, "undecodable-image")
    problem(post(server, b"\x89PNG\r\n\x1a\n" + bytes(50)), 422, "undecodable-image")


@pytest.mark.parametrize(
    ("data", "name"),
    [(b"GIF89a" + bytes(64), "GIF"), (b"<svg xmlns='x'/>", "SVG"), (b"%PDF-1.4", "PDF")],
)
def test_unsupported_type(server: Server, data: bytes, name: str) -> None:
    # What the client says it is does not matter.
    response = post(server, data, headers={"Content-Type": "image/jpeg"})
    body = problem(response, 415, "unsupported-image-type")
    assert name in body["detail"]
    assert body["accepted_types"] == ["image/jpeg", "image/png", "image/webp", "image/heic"]


def test_body_over_the_limit(server: Server) -> None:
    body = problem(post(server, bytes(2_000_001)), 413, "body-too-large")
    assert body["limit_bytes"] == 2_000_000
    response = post(server, bytes(2_000_001), "/v1/lift")
    problem(response, 413, "body-too-large")


def test_stated_length_is_refused_before_anything_is_read(server: Server) -> None:
    with server.connect() as connection:
        connection.sendall(
            b"POST /v1/poses HTTP/1.1\r\nHost: x\r\nContent-Length: 99999999999\r\n\r\n"
        )
        status, body = read_response(connection)
        assert status == 413
        assert b"body-too-large" in body
        assert connection.recv(1) == b"", "the connection is closed"


def test_chunked_oversize_is_cut_off(server: Server) -> None:
    """Without a length the bytes are counted; the server stops reading soon after the limit."""
    chunk = b"%x\r\n" % 65536 + bytes(65536) + b"\r\n"
    with server.connect() as connection:
        connection.sendall(
            b"POST /v1/poses HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\n"
        )
        sent = 0
        with suppress(OSError):  # closed on us, as it should be
            while sent < 200_000_000:
                connection.sendall(chunk)
                sent += 65536
        assert sent < 20_000_000
    assert server.client.get("/livez").status_code == 200


def test_pixels_over_the_limit(server: Server) -> None:
    header = struct.pack(">IIBBBBB", 20_000, 20_000, 1, 0, 0, 0, 0)
    png = b"\x89PNG\r\n\x1a\n"
    for name, body in ((b"IHDR", header), (b"IDAT", zlib.compress(bytes(9))), (b"IEND", b"")):
        png += struct.pack(">I", len(body)) + name + body
        png += struct.pack(">I", zlib.crc32(name + body))
    answer = problem(post(server, png), 413, "too-many-pixels")
    assert (answer["width_px"], answer["limit_px"]) == (20_000, 4_000_000)


@pytest.mark.parametrize(
    ("query", "where"),
    [
        ("max_people=0", "max_people"),
        ("max_people=11", "max_people"),
        ("max_people=two", "max_people"),
        ("candidates=51", "candidates"),
        ("candidates=-1", "candidates"),
        ("method=best", "method"),
        ("box_px=1,2,3", "box_px"),
        ("box_px=1,2,nan,4", "box_px"),
        ("box_px=1,2,0,4", "box_px"),
        ("box_px=5000,5000,10,10", "box_px"),
        ("focal_length_px=0", "focal_length_px"),
        ("focal_length_px=inf", "focal_length_px"),
        ("fov_deg=nan", "fov_deg"),
        ("fov_deg=180", "fov_deg"),
        ("focal_length_px=600&fov_deg=60", "fov_deg"),
        ("subject_height_mm=1.8", "subject_height_mm"),
        ("mirrored=perhaps", "mirrored"),
        ("max_peple=3", "max_peple"),
        ("path=photo.jpg", "path"),
    ],
)
def test_bad_query_values_are_named(server: Server, photo: bytes, query: str, where: str) -> None:
    body = problem(post(server, photo, f"/v1/poses?{query}"), 422, "invalid-input")
    assert [error["where"] for error in body["errors"]] == [where]


def test_slow_upload(server: Server) -> None:
    with server.connect() as connection:
        connection.sendall(
            b"POST /v1/poses HTTP/1.1\r\nHost: x\r\nContent-Length: 100000\r\n\r\n\xff\xd8\xff"
        )
        started = time.monotonic()
        status, body = read_response(connection)
    assert status == 408
    assert b"upload-too-slow" in body
    assert 1.0 < time.monotonic() - started < 10.0


def test_keys(keyed_server: Server, photo: bytes) -> None:
    problem(post(keyed_server, photo), 401, "unauthorized")
    wrong = {"X-API-Key": API_KEY[:-1] + "1"}
    response = post(keyed_server, photo, headers=wrong)
    problem(response, 401, "unauthorized")
    assert response.headers["www-authenticate"].startswith("Bearer")
    for path in ("/v1/info", "/v1/exemplars/x", "/v1/lift"):
        assert keyed_server.client.request("GET", path).status_code in {401, 405}
    for path in ("/livez", "/readyz", "/metrics", "/", "/docs", "/openapi.json"):
        assert keyed_server.client.get(path).status_code == 200, "open without a key"


def test_quota_and_both_ways_to_give_a_key(keyed_server: Server) -> None:
    client = keyed_server.client
    ways = ({"X-API-Key": API_KEY}, {"Authorization": f"Bearer {API_KEY}"})
    answered = 0
    # While a slow machine answers, some of the quota comes back.
    while (response := client.get("/v1/info", headers=ways[answered % 2])).status_code == 200:
        answered += 1
        assert answered < 60
    assert answered >= 6
    problem(response, 429, "quota-exceeded")
    assert 1 <= int(response.headers["retry-after"]) <= 10
    other = {"X-API-Key": "another-key-with-enough-characters"}
    assert client.get("/v1/info", headers=other).status_code == 200, "quotas are per key"


def test_blanks_at_the_end_of_a_header_are_not_its_value(keyed_server: Server) -> None:
    with keyed_server.connect() as connection, connection.makefile("rb") as stream:
        connection.sendall(
            b"GET /v1/info HTTP/1.1\r\nHost: x\r\nX-Request-ID: mine \r\n"
            b"X-API-Key: another-key-with-enough-characters \t\r\n\r\n"
        )
        status, headers, _ = read_whole(stream)
    assert (status, headers["x-request-id"]) == (200, "mine")


def test_cors_is_an_allow_list(keyed_server: Server, server: Server) -> None:
    allowed = keyed_server.client.get("/livez", headers={"Origin": "https://example.org"})
    assert allowed.headers["access-control-allow-origin"] == "https://example.org"
    other = keyed_server.client.get("/livez", headers={"Origin": "https://example.com"})
    assert "access-control-allow-origin" not in other.headers
    closed = server.client.get("/livez", headers={"Origin": "https://example.org"})
    assert "access-control-allow-origin" not in closed.headers, "off by default"


def test_preflights(keyed_server: Server) -> None:
    asked = {"Origin": "https://example.org", "Access-Control-Request-Method": "POST"}
    fine = keyed_server.client.options("/v1/poses", headers=asked)
    assert fine.status_code == 200
    assert fine.headers["access-control-allow-origin"] == "https://example.org"
    for more, named in (
        ({"Origin": "https://example.com"}, "origin"),
        ({"Access-Control-Request-Method": "DELETE"}, "method"),
        ({"Access-Control-Request-Headers": "X-Other"}, "headers"),
    ):
        refused = keyed_server.client.options("/v1/poses", headers=asked | more)
        problem(refused, 400, "preflight-refused")
        assert named in refused.json()["detail"]
        assert "origin" in refused.headers["vary"].lower()


def test_unknown_and_wrong_verb(server: Server) -> None:
    problem(server.client.get("/v2/poses"), 404, "not-found")
    for name in ("nope", "small:sampled:x:1:1", "small:sampled:x:9" + 40 * "9" + ":1", "%00"):
        problem(server.client.get(f"/v1/exemplars/{name}"), 404, "exemplar-not-found")
    response = server.client.get("/v1/poses")
    problem(response, 405, "method-not-allowed")
    assert response.headers["allow"] == "POST"
    problem(post(server, b"x", "/v1/poses/"), 404, "not-found")


@pytest.mark.parametrize(
    "path", ["/livez", "/v1/info", "/metrics", "/openapi.json", "/", "/docs", "/static/style.css"]
)
def test_what_can_be_got_can_be_asked_about(server: Server, path: str) -> None:
    response = server.client.head(path)
    assert (response.status_code, response.content) == (200, b"")
    allowed = server.client.delete(path).headers["allow"]
    assert set(allowed.split(", ")) == {"GET", "HEAD"}


def test_what_would_be_ignored_is_refused(server: Server, photo: bytes) -> None:
    form = {"image": ("a.jpg", photo)}
    aside = server.client.post("/v1/poses", files=form, data={"max_people": "1"})
    assert "query" in problem(aside, 422, "invalid-input")["detail"]
    twice = post(server, photo, "/v1/poses?max_people=1&max_people=2")
    assert "more than once" in problem(twice, 422, "invalid-input")["detail"]
    lifted = post(server, b"{}", "/v1/lift?candidates=3")
    assert problem(lifted, 422, "invalid-input")["errors"][0]["where"] == "candidates"


def test_multipart_syntax(server: Server, photo: bytes) -> None:
    form = {"Content-Type": "multipart/form-data; boundary=b"}
    head = b'--b\r\nContent-Disposition: form-data; name="image"; filename="a.jpg"\r\n\r\n'
    whole = head + photo + b"\r\n--b--\r\n"
    assert post(server, whole, headers=form).status_code == 200
    problem(post(server, head + photo, headers=form), 400, "malformed-body")
    problem(post(server, b"nonsense", headers=form), 400, "malformed-body")
    bare = {"Content-Type": "multipart/form-data"}
    problem(post(server, whole, headers=bare), 400, "malformed-body")
    other = whole.replace(b'name="image"', b'name="photo"')
    body = problem(post(server, other, headers=form), 422, "invalid-input")
    assert "photo" in body["detail"]
    problem(post(server, head + b"\r\n--b--\r\n", headers=form), 400, "empty-body")


def test_overload_is_refused_with_retry_after(narrow_server: Server) -> None:
    """One worker, one place in the queue: of six photos at once some are refused, none fail."""
    heavy = cv2.imencode(".png", np.zeros((5000, 5000, 3), np.uint8))[1].tobytes()
    url = narrow_server.url + "/v1/poses"
    with ThreadPoolExecutor(6) as pool:
        answers = list(pool.map(lambda _: httpx.post(url, content=heavy, timeout=60), range(6)))
    statuses = sorted(answer.status_code for answer in answers)
    assert set(statuses) == {200, 503}
    for answer in answers:
        if answer.status_code == 503:
            assert problem(answer, 503, "overloaded")["reason"] == "queue_full"
            assert int(answer.headers["retry-after"]) >= 1
    assert narrow_server.metric('posematch_refused_total{reason="queue_full"}') >= 1


def test_abandoned_work_is_dropped(narrow_server: Server) -> None:
    """Clients that leave while they wait are never computed, and the permit comes back."""
    heavy = cv2.imencode(".png", np.zeros((5000, 5000, 3), np.uint8))[1].tobytes()
    head = b"POST /v1/poses HTTP/1.1\r\nHost: x\r\nContent-Length: %d\r\n\r\n" % len(heavy)
    before = narrow_server.metric("posematch_abandoned_total")
    with narrow_server.connect() as first:
        first.sendall(head + heavy)
        time.sleep(0.1)
        with narrow_server.connect() as second:
            second.sendall(head + heavy)
            time.sleep(0.1)
        assert read_response(first)[0] == 200
    deadline = time.monotonic() + 10
    while narrow_server.metric("posematch_abandoned_total") == before:
        assert time.monotonic() < deadline
        time.sleep(0.05)
    assert narrow_server.metric("posematch_running") == 0
    assert narrow_server.metric("posematch_waiting") == 0
