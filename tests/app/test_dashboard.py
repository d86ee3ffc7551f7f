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
    labels = {
        name for line in re.findall(r"\{([^}]*)\}", text) for name in re.findall(r"(\w+)=", line)
    }
    labels |= {"instance", "reason"}  # Prometheus' own; no refusal may have happened yet
    asked = expressions()
    assert len(asked) > 10
    for expression in asked:
        for metric, _ in METRIC.findall(expression):
            family = re.sub(r"_(bucket|sum|count)$", "", metric)
            assert {metric, family} & declared, metric
        selectors = " ".join(inside for _, inside in METRIC.findall(expression))
        used = set(re.findall(r"(\w+)\s*(?:=~|!=|=)", selectors))
        used |= {name.strip() for names in BY.findall(expression) for name in names.split(",")}
        assert used <= labels, used - labels


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
