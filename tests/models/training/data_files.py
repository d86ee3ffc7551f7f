"""Small data sets of labelled crops, as training reads them."""

from __future__ import annotations

import io
import json
import tarfile
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray


def write_tar(
    path: Path, images: NDArray[np.uint8], joints_px: ArrayLike, labelled: ArrayLike = 1
) -> None:
    """Crops (N, h, w, 3) with their joints (N, 14, 2), and which of them (N, 14) are labelled."""
    joints = np.broadcast_to(np.asarray(joints_px, np.float64), (len(images), 14, 2))
    known = np.broadcast_to(np.asarray(labelled, np.int64), (len(images), 14))
    records = [
        {"image": f"{path.stem}{i}.jpg", "joints_px": at.tolist(), "labelled": which.tolist()}
        for i, (at, which) in enumerate(zip(joints, known, strict=True))
    ]
    members = [("annotations.json", json.dumps({"images": records}).encode())]
    for record, image in zip(records, images, strict=True):
        members.append((str(record["image"]), cv2.imencode(".jpg", image)[1].tobytes()))
    with tarfile.open(path, "w") as tar:
        for name, data in members:
            info = tarfile.TarInfo(name)
            info.size = len(data)
            tar.addfile(info, io.BytesIO(data))
