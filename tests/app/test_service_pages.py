"""Health, info, metrics, headers and logs."""

from __future__ import annotations

import asyncio
import json
import re
import time

import httpx

from app.main import create_app
from app.schemas import InfoAnswer
from app.settings import Settings
from tests.app.server import Server


def test_health(server: Server) -> None:
    assert server.client.get("/livez").json() == {"status": "ok"}
    assert server.client.get("/readyz").json() == {"status": "ok"}


def test_info(server: Server) -> None:
    response = server.client.get("/v1/info")
    info = InfoAnswer.model_validate_json(response.content)
    assert info.library.name == "small"
    assert info.library.exemplars == 4000
    assert len(info.model.sha256) == 64
    assert info.limits.max_body_bytes == 2_000_000
    assert info.licences
    assert [network.kind for network in info.networks] == ["pose", "people", "lift", "lift"]
    assert len({network.name for network in info.networks}) == 4
    assert info.networks[2].input_px is None


def test_request_ids_are_taken_or_made(server: Server) -> None:
    def answered(given: str) -> str:
        response = server.client.get("/livez", headers={"X-Request-ID": given})
        return response.headers["x-request-id"]

    assert answered("client-id.42:a") == "client-id.42:a"
    made = server.client.get("/livez").headers["x-request-id"]
    assert re.fullmatch(r"[0-9a-f]{32}", made)
    for bad in ("x" * 65, "a b", "<script>", ""):
        assert re.fullmatch(r"[0-9a-f]{32}", answered(bad))


def test_server_timing_has_the_stages(server: Server, photo: bytes) -> None:
    response = server.client.post("/v1/poses", content=photo)
    timing = response.headers["server-timing"]
    stages = dict(re.findall(r"(\w+);dur=([\d.]+)", timing))
    assert {"decode", "detect", "pose", "total", "app"} <= stages.keys()
    total = response.json()["timings_ms"]["total"]
    assert float(stages["total"]) == total
    assert float(stages["app"]) >= total


def test_metrics(server: Server, photo: bytes) -> None:
    sample = 'posematch_requests_total{method="POST",route="/v1/poses",status="200"}'
    before = server.metric(sample)
    server.client.post("/v1/poses", content=photo)
    server.client.get("/some/unknown/path")
    assert server.metric(sample) == before + 1
    assert server.metric('posematch_stage_seconds_count{stage="decode"}') >= 1
    assert server.metric("posematch_people_per_image_count") >= 1
    text = server.client.get("/metrics").text
    assert "some/unknown" not in text, "clients cannot make labels"
    assert 'route="unmatched"' in text


def test_metrics_know_the_paths_that_the_framework_serves(server: Server) -> None:
    sample = 'posematch_requests_total{method="GET",route="/openapi.json",status="200"}'
    before = server.metric(sample)
    server.client.get("/openapi.json")
    assert server.metric(sample) == before + 1


def test_metrics_name_the_library(server: Server) -> None:
    text = server.client.get("/metrics").text
    assert 'library="small ' in text


def test_metrics_name_every_network_in_service(server: Server) -> None:
    """Of a kind there may be two: one that lifts stated joints, one for found ones."""
    info = InfoAnswer.model_validate_json(server.client.get("/v1/info").content)
    said = re.findall(
        r'^posematch_model_info\{kind="(.+?)",name="(.+?)".*version="(.+?)"\} 1.0$',
        server.client.get("/metrics").text,
        re.MULTILINE,
    )
    assert sorted(said) == sorted((it.kind, it.name, it.version) for it in info.networks)


def test_log_lines_are_json_with_the_request_id(server: Server) -> None:
    server.client.get("/livez", headers={"X-Request-ID": "find-me-in-the-log"})
    deadline = time.monotonic() + 5  # the line is written after the answer
    while not (found := [s for s in server.log.read_text().splitlines() if "find-me" in s]):
        assert time.monotonic() < deadline
        time.sleep(0.01)
    (line,) = map(json.loads, found)
    assert (line["method"], line["path"], line["status"]) == ("GET", "/livez", 200)


def test_an_error_of_ours_says_nothing_but_its_id_to_pages_of_other_origins_too() -> None:
    app = create_app(Settings(cors_origins="https://example.org"))

    @app.get("/broken")
    async def broken() -> None:
        raise RuntimeError("/srv/secret")

    async def ask() -> httpx.Response:
        transport = httpx.ASGITransport(app)
        headers = {"X-Request-ID": "mine", "Origin": "https://example.org"}
        async with httpx.AsyncClient(transport=transport, base_url="http://x") as client:
            return await client.get("/broken", headers=headers)

    response = asyncio.run(ask())
    assert response.status_code == 500
    assert response.headers["access-control-allow-origin"] == "https://example.org"
    assert response.headers["content-type"] == "application/problem+json"
    problem = response.json()
    assert (problem["type"], problem["status"]) == ("urn:posematch:problem:internal-error", 500)
    assert problem["request_id"] == response.headers["x-request-id"] == "mine"
    assert "secret" not in response.text


def test_the_page_asks_nobody_else(server: Server) -> None:
    page = server.client.get("/")
    assert page.headers["content-type"].startswith("text/html")
    assert not re.findall(r"(?:src|href|url\()\s*=?\s*[\"']?(?:https?:)?//", page.text)
