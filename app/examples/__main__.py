"""Renew the example answers from what is served now; ``scripts/examples`` calls this.

    python -m app.examples docs/images/sample.jpg

answers the photo and ``lift_request.json`` as the service would, with the library and the weights
the settings name, and writes ``poses_answer.json`` and ``lift_answer.json`` beside this file.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from pydantic import BaseModel

from app.answers import lift_answer, poses_answer
from app.api.lift import parse_lift_request, query_of
from app.engine import load_engine
from app.pipeline import PhotoQuery
from app.settings import load_settings

_HERE = Path(__file__).resolve().parent
_REQUEST_ID = "0b6f6cbd7c1f4e7f8f1a3cf1d2e5a9b4"
_LINE = 100


def main() -> None:
    """Renew both files from the photo named on the command line."""
    photo = Path(sys.argv[1]).read_bytes()
    engine = load_engine(load_settings())
    query = PhotoQuery(candidates=1)
    result = engine.pipeline.estimate(photo, query)
    _write("poses_answer", poses_answer(engine, result, query.method, _REQUEST_ID))
    wanted = parse_lift_request((_HERE / "lift_request.json").read_bytes())
    lifted = engine.pipeline.lift(query_of(wanted))
    _write("lift_answer", lift_answer(engine, lifted, wanted.method, _REQUEST_ID))


def _write(name: str, answer: BaseModel) -> None:
    plain = json.loads(answer.model_dump_json())
    plain["timings_ms"]["total"] = round(sum(plain["timings_ms"].values()), 3)
    (_HERE / f"{name}.json").write_text(_compact(plain) + "\n")


def _compact(value: object, indent: str = "") -> str:
    """JSON in which whatever fits stands on one line."""
    flat = json.dumps(value, ensure_ascii=False)
    if not isinstance(value, dict | list) or len(indent) + len(flat) <= _LINE:
        return flat
    deeper = indent + " "
    if isinstance(value, dict):
        items = [f"{json.dumps(key)}: {_compact(item, deeper)}" for key, item in value.items()]
        left, right = "{}"
    else:
        items = [_compact(item, deeper) for item in value]
        left, right = "[]"
    return f"{left}\n{deeper}" + f",\n{deeper}".join(items) + f"\n{indent}{right}"


if __name__ == "__main__":
    main()
