"""The Grafana dashboard asks for metrics that exist, with labels they have."""

from __future__ import annotations

import json
import re
from pathlib import Path

import httpx

from tests.app.server import Server

DASHBOARD = Path(__file__).parents[2] / "deploy" / "grafana" / "posematch.json"
METRIC = re.compile(r"\b((?:posematch|process)_\w+)(?:\{([^}]*)\})?")
BY = re.compile(r"sum by \(([^)]*)\)")


def expressions() -> list[str]:
    panels = json.loads(DASHBOARD.read_text())["panels"]
    return [target["expr"] for panel in panels for target in panel["targets"]]


def test_every_metric_and_label_exists(server: Server, photo: bytes) -> None:
    httpx.post(f"{server.url}/v1/poses", content=photo, timeout=60).raise_for_status()
    text = server.client.get("/metrics").text
    declared = set(re.findall(r"^# TYPE (\w+)", text, re.MULTILINE))
    asked = expressions()
    assert len(asked) > 10
    for expression in asked:
        grouped = {name.strip() for names in BY.findall(expression) for name in names.split(",")}
        for metric, selector in METRIC.findall(expression):
            family = re.sub(r"_(bucket|sum|count)$", "", metric)
            assert {metric, family} & declared, metric
            samples = re.findall(rf"^{metric}(?:\{{(.*)\}})? ", text, re.MULTILINE)
            if not samples:  # no refusal may have happened yet
                assert family == "posematch_refused_total", metric
                continue
            labels = {label for sample in samples for label in re.findall(r'(\w+)="', sample)}
            used = set(re.findall(r"(\w+)\s*(?:=~|!=|=)", selector)) | grouped
            assert used <= labels | {"instance"}, (expression, used - labels)
            for exactly in re.findall(r'(\w+="[^"]*")', selector):
                assert any(exactly in sample for sample in samples), (expression, exactly)


def test_panels_do_not_overlap() -> None:
    taken: set[tuple[int, int]] = set()
    for panel in json.loads(DASHBOARD.read_text())["panels"]:
        place = panel["gridPos"]
        cells = {
            (x, y)
            for x in range(place["x"], place["x"] + place["w"])
            for y in range(place["y"], place["y"] + place["h"])
        }
        assert not cells & taken
        assert max(x for x, _ in cells) < 24
        taken |= cells
