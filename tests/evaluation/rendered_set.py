"""The renders of tests/data in the form that ``models.training.rendered`` gives its sets."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

RENDERS = Path(__file__).parents[1] / "data" / "renders"


def write_set(folder: Path, *, times: int = 1, with_3d: bool = True) -> int:
    """Copy the images, write their annotations ``times`` over; how many people that makes.

    ``with_3d`` false: the first one's truth in 3D is lacking.
    """
    folder.mkdir(exist_ok=True)
    records: list[dict[str, Any]] = [
        {
            "image": render["file"],
            "joints_px": render["joints_2d_px"],
            "joints_mm": render["joints_3d_mm"],
            "focal_length_px": render["K"][0][0],
            "principal_point_px": [render["K"][0][2], render["K"][1][2]],
        }
        for render in json.loads((RENDERS / "ground_truth.json").read_text())["images"]
    ]
    for record in records:
        shutil.copy(RENDERS / record["image"], folder)
    if not with_3d:
        del records[0]["joints_mm"]
    (folder / "annotations.json").write_text(json.dumps({"images": times * records}))
    return times * len(records)
