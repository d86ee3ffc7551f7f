"""Reads one C3D file in a process of its own: ezc3d crashes on some damaged ones.

    python -P c3d_child.py FILE

writes an npz to stdout: ``points`` (N, F, 3) in the file's unit, ``names``, ``rate_hz``, ``unit``,
``up``, and ``stated`` and ``values``, the numbers that Plug-in Gait leaves. Exit code 1, with the
reason on stderr, for a file that is no C3D file.
"""

from __future__ import annotations

import io
import resource
import sys
from typing import Any

import numpy as np
from ezc3d import c3d

MEMORY_BYTES = 12 << 30


def _read(path: str) -> dict[str, Any]:
    content = c3d(path)
    parameters = content["parameters"]
    point, stated = parameters["POINT"], parameters.get("PROCESSING", {})
    labels = [
        _decoded(name).strip()
        for key in ("LABELS", "LABELS2", "LABELS3", "LABELS4")
        for name in (point[key]["value"] if key in point else ())
    ]
    return {
        "points": np.asarray(content["data"]["points"][:3]).transpose(1, 2, 0),
        "names": np.array(labels, dtype=str),
        "rate_hz": float(point["RATE"]["value"][0]),
        "unit": _text(point, "UNITS"),
        "up": _text(point, "Y_SCREEN"),
        "stated": np.array(list(stated), dtype=str),
        "values": np.array([_number(stated, name) for name in stated], dtype=np.float64),
    }


def _decoded(name: str) -> str:
    """A name as ezc3d gives it, in UTF-8 or, as most programs write it, in Latin-1."""
    content = name.encode("utf-8", "surrogateescape")
    try:
        return content.decode("utf-8")
    except UnicodeDecodeError:
        return content.decode("latin-1")


def _text(group: Any, name: str) -> str:
    values = group[name]["value"] if name in group else []
    return str(values[0]).strip() if len(values) else ""


def _number(group: Any, name: str) -> float:
    try:
        return float(group[name]["value"][0])
    except (KeyError, IndexError, TypeError, ValueError):
        return 0.0


def main() -> int:
    """Read the file named on the command line."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    try:
        found = _read(sys.argv[1])
    except Exception as error:  # whatever a reader of foreign bytes raises
        sys.stderr.write(f"{error}\n")
        return 1
    packed = io.BytesIO()
    np.savez(packed, allow_pickle=False, **found)
    sys.stdout.buffer.write(packed.getvalue())
    return 0


if __name__ == "__main__":
    sys.exit(main())
