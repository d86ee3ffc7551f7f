"""The running service against its own OpenAPI document, by schemathesis: seeded and bounded."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.app.server import Server

COMMAND = Path(sys.executable).with_name("st")
DOCUMENT = Path(__file__).parents[2] / "docs" / "openapi.json"
CHECKS = (
    "not_a_server_error",
    "status_code_conformance",
    "content_type_conformance",
    "response_headers_conformance",
    "response_schema_conformance",
    "negative_data_rejection",
    "unsupported_method",
)


@pytest.mark.slow
def test_every_operation_keeps_to_the_document(server: Server, tmp_path: Path) -> None:
    command = [
        *(str(COMMAND), "run", str(DOCUMENT), "--url", server.url),
        *("--phases", "examples,coverage,fuzzing", "--max-examples", "10", "--seed", "1"),
        *("--checks", ",".join(CHECKS), "--generation-database", "none"),
        *("--request-timeout", "60", "--continue-on-failure"),
    ]
    outcome = subprocess.run(
        command,
        cwd=tmp_path,
        env={**os.environ, "NO_COLOR": "1"},
        capture_output=True,
        text=True,
        timeout=280,
        check=False,
    )
    assert outcome.returncode == 0, outcome.stdout[-6000:] + outcome.stderr[-2000:]
    assert "Traceback" not in server.log.read_text()
