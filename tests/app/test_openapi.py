"""The OpenAPI document: complete, as committed, with examples that hold; the page that shows it."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from app.api.openapi import encode_document
from app.schemas import LiftAnswer, LiftRequest, PosesAnswer
from tests.app.server import Server

ROOT = Path(__file__).parents[2]


def test_the_contract_is_the_committed_one(server: Server) -> None:
    document: dict[str, Any] = server.client.get("/openapi.json").json()
    committed = (ROOT / "docs" / "openapi.json").read_text()
    assert encode_document(document) == committed, "run scripts/openapi and read its diff"


def test_it_is_whole(server: Server) -> None:
    document: dict[str, Any] = server.client.get("/openapi.json").json()
    text = json.dumps(document)
    defined = set(document["components"]["schemas"])
    assert set(re.findall(r'"#/components/schemas/(\w+)"', text)) <= defined
    assert "HTTPValidationError" not in text, "every error is a problem"
    poses = document["paths"]["/v1/poses"]["post"]
    assert {"200", "400", "401", "408", "413", "415", "422", "429", "503"} == set(
        poses["responses"]
    )


def test_its_examples_hold(server: Server) -> None:
    paths = server.client.get("/openapi.json").json()["paths"]
    poses = paths["/v1/poses"]["post"]
    answer = poses["responses"]["200"]["content"]["application/json"]["example"]
    assert PosesAnswer.model_validate(answer).people
    lift = paths["/v1/lift"]["post"]
    asked = lift["requestBody"]["content"]["application/json"]["example"]
    assert LiftRequest.model_validate(asked).people
    assert server.client.post("/v1/lift", json=asked).status_code == 200
    lifted = lift["responses"]["200"]["content"]["application/json"]["example"]
    assert LiftAnswer.model_validate(lifted).people


def test_the_reference_asks_nobody_else(server: Server) -> None:
    page = server.client.get("/docs")
    assert page.headers["content-type"].startswith("text/html")
    assert "default-src 'none'" in page.headers["content-security-policy"]
    parts = re.findall(r'(?:src|href)="([^"]+)"', page.text)
    assert len(parts) >= 4
    for part in parts:
        assert not part.startswith(("http", "//", "/")), "relative, for path prefixes"
        assert server.client.get(f"/{part}").status_code == 200
