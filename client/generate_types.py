"""Write ``posematch_client/types.py`` from the service's OpenAPI document.

    python client/generate_types.py docs/openapi.json client/posematch_client/types.py

Every schema becomes a TypedDict, the parameters of POST /v1/poses one more. What the service
answers is always complete; what it is given may leave out whatever has a default.
"""

from __future__ import annotations

import json
import sys
import textwrap
from pathlib import Path
from typing import Any

Schema = dict[str, Any]

_HEAD = '''\
"""The JSON of the posematch service as types. Generated from its OpenAPI document: do not edit.

Pixels are those of the upright photo, (0, 0) the centre of its top-left pixel. Millimetres are in
the camera frame: x right, y down, z forward.
"""

# ruff: noqa: D205
from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NotRequired, TypedDict
'''

_PLAIN = {"string": "str", "integer": "int", "number": "float", "boolean": "bool", "null": "None"}
_WIDTH = 96


def generate(document: Schema) -> str:
    """The module's text."""
    schemas = document["components"]["schemas"]
    classes = [_typed_dict(name, schema) for name, schema in sorted(schemas.items())]
    parameters = document["paths"]["/v1/poses"]["post"]["parameters"]
    classes.append(_parameters(parameters))
    return "\n\n".join([_HEAD, *classes])


def _typed_dict(name: str, schema: Schema) -> str:
    # The service forbids unknown fields in what it is given, and only there.
    is_given = schema.get("additionalProperties") is False
    required = set(schema.get("required", ())) if is_given else set(schema["properties"])
    lines = []
    for field, its_schema in schema["properties"].items():
        kind = _type(its_schema, "Sequence" if is_given else "list")
        lines.append(f"{field}: {kind if field in required else f'NotRequired[{kind}]'}")
    return _class(name, schema["description"], lines)


def _parameters(parameters: list[Schema]) -> str:
    lines = []
    for parameter in parameters:
        schema = {**parameter["schema"]}
        kind = (
            "str | Sequence[float]" if parameter["name"] == "box_px" else _type(schema, "Sequence")
        )
        kind = kind.removesuffix(" | None")
        lines += textwrap.wrap(
            parameter["description"], _WIDTH - 2, initial_indent="# ", subsequent_indent="# "
        )
        lines.append(f"{parameter['name']}: NotRequired[{kind}]")
    return _class("PoseParameters", "What to do with a photo.", lines)


def _class(name: str, description: str, lines: list[str]) -> str:
    first, *rest = description.split("\n")
    text = "\n".join([f'"""{first}', *rest])
    closing = '\n"""' if rest else '"""'
    body = "\n".join([text + closing, "", *lines])
    return f"class {name}(TypedDict):\n{textwrap.indent(body, '    ')}\n"


def _type(schema: Schema, array: str) -> str:
    if "$ref" in schema:
        return str(schema["$ref"]).rsplit("/", 1)[1]
    for union in ("anyOf", "oneOf"):
        if union in schema:
            return " | ".join(dict.fromkeys(_type(option, array) for option in schema[union]))
    if "enum" in schema or "const" in schema:
        values = schema.get("enum", [schema.get("const")])
        return f"Literal[{', '.join(json.dumps(value) for value in values)}]"
    if schema.get("type") == "array":
        items = schema.get("items") or {"anyOf": schema["prefixItems"]}
        return f"{array}[{_type(items, array)}]"
    if schema.get("type") == "object":
        return f"dict[str, {_type(schema['additionalProperties'], array)}]"
    return _PLAIN[schema["type"]]


if __name__ == "__main__":
    source, target = map(Path, sys.argv[1:])
    target.write_text(generate(json.loads(source.read_text())))
