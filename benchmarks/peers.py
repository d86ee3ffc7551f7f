"""Our whole pipeline beside MediaPipe Pose's networks: time and memory on the same photos.

    python -m benchmarks.peers --reference DIR [--photo FILE ...] [--runs 50]

``--reference`` has ``blazepose_{detector,full,heavy}.onnx``. Every contender gets the bytes of the
photo, runs in a process of its own on one thread of the same onnxruntime, and looks at one person:
BlazePose decodes, detects and runs its landmark network (2D and 3D come out of it); ours decodes,
detects, runs the CPM, matches, warps and writes the JSON. MediaPipe's own framework, which tracks
through videos and so leaves the detector out in most frames, is not part of this: "landmarks only"
and "box given" are without a detector. Memory is the process' resident set at its largest, less
that of the Python process with numpy, OpenCV and onnxruntime imported.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from benchmarks.service import DEFAULT_PHOTO
from library_store.arguments import integer
from models.training.teachers import BlazePose

Answer = Callable[[bytes], object]

_WARM_UP_RUNS = 3
_THRESHOLD = 0.5


def main() -> None:
    """Parse the command line; measure every contender, or one of them as a child process."""
    parser = argparse.ArgumentParser(description="Beside MediaPipe Pose's networks.")
    parser.add_argument("--reference", type=Path, required=True)
    parser.add_argument("--photo", type=Path, nargs="+", default=[DEFAULT_PHOTO])
    parser.add_argument("--runs", type=integer(1), default=50)
    parser.add_argument("--only", choices=list(CONTENDERS), help="measure one; prints JSON")
    arguments = parser.parse_args()
    if arguments.only:
        print(json.dumps(measure(arguments)))
        return
    print(f"{'':>26} {'p50 ms':>8} {'p99 ms':>8} {'CPU-ms':>8} {'MB':>6}")
    for name in CONTENDERS:
        command = [sys.executable, "-m", "benchmarks.peers", *sys.argv[1:], "--only", name]
        out = subprocess.run(command, check=True, capture_output=True, text=True).stdout
        row = json.loads(out.splitlines()[-1])
        print(
            f"{name:>26} {row['p50_ms']:8.1f} {row['p99_ms']:8.1f} {row['cpu_ms']:8.1f} "
            f"{row['resident_mb']:6.0f}",
            flush=True,
        )


def measure(arguments: argparse.Namespace) -> dict[str, float]:
    """Time, CPU time and memory of one contender in this process."""
    cv2.setNumThreads(1)
    before_mb = _resident_mb()
    answer = CONTENDERS[arguments.only](arguments.reference)
    photos = [path.read_bytes() for path in arguments.photo]
    wall_ms, cpu_ms = [], []
    for run in range(_WARM_UP_RUNS + arguments.runs):
        for data in photos:
            wall, cpu = time.perf_counter(), time.process_time()
            answer(data)
            if run >= _WARM_UP_RUNS:
                wall_ms.append(1e3 * (time.perf_counter() - wall))
                cpu_ms.append(1e3 * (time.process_time() - cpu))
    return {
        "p50_ms": float(np.percentile(wall_ms, 50)),
        "p99_ms": float(np.percentile(wall_ms, 99)),
        "cpu_ms": float(np.median(cpu_ms)),
        "resident_mb": _resident_mb() - before_mb,
    }


def ours(_: Path, *, boxed: bool = False) -> Answer:
    """The service's pipeline and JSON, without HTTP."""
    from app.answers import poses_answer
    from app.engine import load_engine
    from app.pipeline import PhotoQuery
    from app.settings import load_settings

    engine = load_engine(load_settings())
    whole = PhotoQuery(max_people=1)
    boxes: dict[bytes, PhotoQuery] = {}

    def answer(data: bytes) -> object:
        if boxed and data not in boxes:
            found = engine.pipeline.estimate(data, whole).people
            box_px = found[0].box_px if found else (0.0, 0.0, 640.0, 480.0)
            boxes[data] = PhotoQuery(box_px=box_px)
        query = boxes[data] if boxed else whole
        result = engine.pipeline.estimate(data, query)
        return poses_answer(engine, result, "fusion", "id").model_dump_json()

    return answer


def blazepose(folder: Path, variant: str, *, boxed: bool = False) -> Answer:
    """Detector and landmark network of MediaPipe Pose."""
    networks = BlazePose(folder, variant)
    found_in: dict[bytes, tuple[np.ndarray, np.ndarray]] = {}

    def answer(data: bytes) -> object:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        if pixels is None:
            raise SystemExit("a photo does not decode")
        image = np.asarray(pixels, np.uint8)
        if not boxed or data not in found_in:
            found = networks.detect(image, _THRESHOLD)
            if not found:
                return None
            found_in[data] = found[0][:2]
        return networks.landmarks(image, *found_in[data])

    return answer


CONTENDERS: dict[str, Callable[[Path], Answer]] = {
    "ours": ours,
    "ours, box given": lambda folder: ours(folder, boxed=True),
    "BlazePose full": lambda folder: blazepose(folder, "full"),
    "BlazePose heavy": lambda folder: blazepose(folder, "heavy"),
    "full, landmarks only": lambda folder: blazepose(folder, "full", boxed=True),
    "heavy, landmarks only": lambda folder: blazepose(folder, "heavy", boxed=True),
}


def _resident_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


if __name__ == "__main__":
    main()
