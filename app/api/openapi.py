"""The OpenAPI document: FastAPI's, with the schemas of the bodies we read ourselves.

    python -m app.api.openapi docs/openapi.json

writes it to a file. ``docs/openapi.json`` is compared with the code by the tests, so that no change
of the contract goes unnoticed; ``docs/api.md`` says which changes are allowed.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi

from app import schemas

DESCRIPTION = """\
POST a photo, get every person's 2D joints, the matched exemplar, the camera and a 3D skeleton.

**Pixels** are those of the upright photo (EXIF orientation applied), (0, 0) the centre of its
top-left pixel. **Millimetres** are in the camera frame: x right, y down, z forward. **Left and
right** are the person's own. A number that is not calibrated is `null`. Errors are
`application/problem+json` (RFC 9457) with a stable `type`.
"""

EXAMPLES_DIR = Path(__file__).resolve().parent.parent / "examples"

_EXAMPLES = (
    ("/v1/lift", "requestBody", "lift_request"),
    ("/v1/lift", "responses", "lift_answer"),
    ("/v1/poses", "responses", "poses_answer"),
)


def openapi_document(app: FastAPI) -> dict[str, Any]:
    """The document of ``app``'s routes."""
    document = get_openapi(
        title=app.title,
        version=app.version,
        description=app.description,
        routes=app.routes,
        servers=[{"url": "."}],  # beside the document, also under a path prefix
    )
    components = document["components"]["schemas"]
    for model in (schemas.LiftRequest, schemas.Problem):
        schema = model.model_json_schema(ref_template="#/components/schemas/{model}")
        components |= schema.pop("$defs", {})
        components[model.__name__] = schema
    for path, kind, example in _EXAMPLES:
        place = document["paths"][path]["post"][kind]
        place = place["200"] if kind == "responses" else place
        text = (EXAMPLES_DIR / f"{example}.json").read_text()
        place["content"]["application/json"]["example"] = json.loads(text)
    # FastAPI's own validation errors, which here are problems like all others.
    for name in ("HTTPValidationError", "ValidationError"):
        components.pop(name, None)
    for operation in (op for path in document["paths"].values() for op in path.values()):
        if "HTTPValidationError" in json.dumps(operation["responses"].get("422", {})):
            del operation["responses"]["422"]
    return document


def encode_document(document: dict[str, Any]) -> str:
    """As it is kept in the repository: keys sorted, so that differences are small."""
    return json.dumps(document, indent=1, sort_keys=True, ensure_ascii=False) + "\n"


def main() -> None:
    """Write the document to the file named on the command line."""
    from app.main import create_app
    from app.settings import Settings

    Path(sys.argv[1]).write_text(encode_document(create_app(Settings()).openapi()))


if __name__ == "__main__":
    main()
