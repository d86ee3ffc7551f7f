"""Label whole scenes with the teacher: ``python -m models.training.label_scenes --help``.

Writes one JSON record per scene: the teacher's boxes with scores. The person network learns from
sure boxes, and takes unsure ones for "do not know".
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import cv2

from models.training.dataset import decode_members
from models.training.teachers import BlazePose


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=Path, required=True, help="folder or tar of JPEG scenes")
    parser.add_argument("--teacher", type=Path, required=True, help="folder of blazepose_*.onnx")
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    teacher = BlazePose(args.teacher)
    records = []
    scenes = decode_members(args.scenes)
    for i, (name, image) in enumerate(sorted(scenes.items())):
        people = teacher.people(image, 0.3)
        boxes = [[*(round(float(v), 1) for v in p.box_px), round(p.score, 3)] for p in people]
        records.append({"image": name, "people": boxes})
        if i % 50 == 0:
            print(f"{i}/{len(scenes)}", flush=True)
    args.out.write_text(json.dumps(records))


if __name__ == "__main__":
    main()
