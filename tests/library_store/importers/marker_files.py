"""A person who stands in a motion capture suit, and C3D files of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from ezc3d import c3d

from library_store.anatomy import Float
from library_store.importers.rotation import about_axis

STANDING: dict[str, tuple[float, float, float]] = {
    # mm, x to the person's left, y up, z ahead; the left side, the right is its mirror image
    "LFHD": (70, 1650, 95),
    "LBHD": (70, 1650, -75),
    "LSHO": (150, 1450, -10),
    "LELB": (290, 1180, -40),
    "LWRA": (262, 975, 90),
    "LWRB": (262, 935, 60),
    "LFWT": (125, 1000, 80),
    "LBWT": (50, 1020, -110),
    "LKNE": (147, 510, 60),
    "LANK": (132, 80, -20),
    "LHEE": (92, 40, -80),
    "LTOE": (92, 40, 110),
}
MIDDLE: dict[str, tuple[float, float, float]] = {
    "C7": (0, 1490, -70),
    "T10": (0, 1260, -100),
    "CLAV": (0, 1440, 60),
    "STRN": (0, 1250, 90),
}
PLUG_IN_GAIT = {"FWT": "ASI", "BWT": "PSI"}


def standing(*, plug_in_gait: bool = False) -> dict[str, Float]:
    """The markers (3,) of CMU's set, or of Plug-in Gait."""
    markers = {name: np.array(place, dtype=float) for name, place in MIDDLE.items()}
    for name, place in STANDING.items():
        for side, sign in (("L", 1.0), ("R", -1.0)):
            kind = PLUG_IN_GAIT.get(name[1:], name[1:]) if plug_in_gait else name[1:]
            markers[side + kind] = np.array(place) * (sign, 1.0, 1.0)
    return markers


def turning(markers: dict[str, Float], n_frames: int = 60) -> dict[str, Float]:
    """Markers (F, 3) of the person turning on the spot."""
    turns = about_axis("y", np.linspace(0.0, 80.0, n_frames))
    return {name: turns @ place for name, place in markers.items()}


def write_c3d(
    path: Path,
    tracks: dict[str, Float],
    *,
    rate_hz: float = 120.0,
    unit: str = "mm",
    unit_mm: float | None = None,
    up: str = "+Z",
    stated: dict[str, float] | None = None,
) -> Path:
    """A C3D file of markers (F, 3) in mm, Y up, which the file has in ``unit`` and with Z up.

    ``unit_mm``: how long the unit really is, where that is not what its name says.
    """
    file = c3d()
    names = list(tracks)
    points = np.stack([tracks[name] for name in names], axis=1)  # (F, N, 3)
    scale = 1.0 / (unit_mm or {"mm": 1.0, "m": 1000.0}[unit])
    z_up = points[..., [0, 2, 1]] * (scale, -scale, scale)
    n_frames = len(z_up)
    data = np.ones((4, len(names), n_frames))
    data[:3] = z_up.transpose(2, 1, 0)
    file["parameters"]["POINT"]["RATE"]["value"] = [rate_hz]
    file["parameters"]["POINT"]["LABELS"]["value"] = names
    file["parameters"]["POINT"]["UNITS"]["value"] = [unit]
    if up:
        file.add_parameter("POINT", "Y_SCREEN", [up])
    for name, value in (stated or {}).items():
        file.add_parameter("PROCESSING", name, [value])
    file["data"]["points"] = data
    file.write(str(path))
    return path
