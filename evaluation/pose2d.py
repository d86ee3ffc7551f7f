"""2D joints: our pose network beside networks that users would pick instead, on the same crops.

    python -m evaluation.pose2d --data DIR --reference DIR [--name cpm]

``--data`` has ``lspet_val.tar`` (human labels) and ``photos_*.tar`` (labels by the heavy reference;
only the photos that training held out are used); ``--reference`` the networks to compare with, in
ONNX: ``mobile_cpm.onnx``, ``blazepose_full.onnx``, ``blazepose_heavy.onnx``. All get the same
axis-aligned square, 1.25 x the joints' extent.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from rich.console import Console
from rich.progress import track

from evaluation.metrics import Floats
from library_store.skeleton import LIMB_JOINTS, LSP14
from models import PersonBox, PoseEstimator
from models.crop import square_crop
from models.pck import correct_keypoints
from models.training.dataset import MP33_LIMBS, LabelledCrop, held_out, load
from models.training.teachers import BlazePose, onnx_session

SCALE = 1.25
ROWS = ("head_top", "neck", "shoulder", "elbow", "wrist", "hip", "knee", "ankle")

Estimate = Callable[[LabelledCrop], Floats]


@dataclass(frozen=True)
class Score:
    """Of one network on one set: ``near``, ``known`` (N, 14) bool, ``swapped`` % of pairs."""

    near: np.ndarray
    known: np.ndarray
    swapped: float
    cpu_ms: float

    def pck(self, joints: tuple[int, ...]) -> float:
        """PCK@0.2 in per cent over the known ones of ``joints``; nan when none is known."""
        chosen = list(joints)
        known = self.known[:, chosen]
        return 100 * float(self.near[:, chosen][known].mean()) if known.any() else float("nan")


def ours(name: str, weights: Path | None) -> Estimate:
    """Our network through its shipped path."""
    estimator = PoseEstimator(name, weights_dir=weights) if weights else PoseEstimator(name)

    def estimate(crop: LabelledCrop) -> Floats:
        center, extent = crop.extent_px
        x, y = (float(v) for v in center - extent / 2)
        box = PersonBox(x_px=x, y_px=y, width_px=extent, height_px=extent, score=1.0)
        return estimator.estimate(crop.image, [box])[0].positions_px

    return estimate


def mobile_cpm(path: Path) -> Estimate:
    """A public mobile CPM: blurred heat maps, then the strongest cell."""
    session = onnx_session(path)
    name = session.get_inputs()[0].name

    def estimate(crop: LabelledCrop) -> Floats:
        center, extent = crop.extent_px
        image, scale, origin = square_crop(
            crop.image, (float(center[0]), float(center[1])), SCALE * extent, 192
        )
        x = image.transpose(2, 0, 1)[None].astype(np.float32)
        maps = session.run(None, {name: x})[0].reshape(14, 96, 96)
        smooth = np.stack([cv2.GaussianBlur(m, (0, 0), 2) for m in maps]).reshape(14, -1)
        y, cell_x = np.divmod(smooth.argmax(-1), 96)
        px = (np.stack([cell_x, y], -1) + 0.5) * 2 - 0.5
        joints: Floats = np.asarray(origin) + scale * px
        return joints

    return estimate


def blazepose(folder: Path, variant: str) -> Estimate:
    """BlazePose landmarks of the same square; it has no head top and no neck (nan)."""
    network = BlazePose(folder, variant)

    def estimate(crop: LabelledCrop) -> Floats:
        center, extent = crop.extent_px
        hip = center.astype(np.float64)
        at, _ = network.landmarks(crop.image, hip, hip - np.array([0, SCALE * extent / 2.5]))
        joints = np.full((14, 2), np.nan)
        joints[2:] = at[list(MP33_LIMBS)]
        return joints

    return estimate


def networks(name: str, weights: Path | None, reference: Path) -> dict[str, Estimate]:
    """Ours and those to compare with, by the name of their column."""
    return {
        "ours": ours(name, weights),
        "mobile CPM": mobile_cpm(reference / "mobile_cpm.onnx"),
        "BlazePose full": blazepose(reference, "full"),
        "BlazePose heavy": blazepose(reference, "heavy"),
    }


def score(estimate: Estimate, crops: list[LabelledCrop], label: str) -> Score:
    """Run a network over a set."""
    predicted = []
    spent = 0.0
    for crop in track(crops, label, transient=True, console=Console(stderr=True)):
        began = time.process_time()
        predicted.append(estimate(crop))
        spent += time.process_time() - began
    found = np.stack(predicted)
    truth = np.stack([c.joints_px for c in crops]).astype(np.float64)
    known = np.stack([c.weight > 0 for c in crops]) & np.isfinite(found).all(-1)
    error = np.linalg.norm(found - truth, axis=-1)
    near = correct_keypoints(found, truth)
    left = [j for j in LIMB_JOINTS if LSP14.mirror[j] > j]
    right = [LSP14.mirror[j] for j in left]
    both = known[:, left] & known[:, right]
    across = [
        np.linalg.norm(found[:, a] - truth[:, b], axis=-1) < error[:, a]
        for a, b in ((left, right), (right, left))
    ]
    swapped = float((across[0] & across[1])[both].mean())
    return Score(near, known, 100 * swapped, 1e3 * spent / len(crops))


def table(scores: dict[str, Score]) -> str:
    """Markdown, a column per network."""
    lines = [
        "| PCK@0.2, % | " + " | ".join(scores) + " |",
        "|---|" + "---|" * len(scores),
    ]

    def row(label: str, values: list[float]) -> None:
        cells = ["-" if np.isnan(v) else f"{v:.1f}" for v in values]
        lines.append(f"| {label} | " + " | ".join(cells) + " |")

    for part in ROWS:
        joints = tuple(j for j, name in enumerate(LSP14.joint_names) if name.endswith(part))
        row(part, [s.pck(joints) for s in scores.values()])
    row("**12 limb joints**", [s.pck(LIMB_JOINTS) for s in scores.values()])
    everything = tuple(range(LSP14.n_joints))
    row(
        "**14 joints**",
        [s.pck(everything) if s.known[:, :2].any() else float("nan") for s in scores.values()],
    )
    row("left/right swaps, % of pairs", [s.swapped for s in scores.values()])
    row("CPU-ms a crop", [s.cpu_ms for s in scores.values()])
    return "\n".join(lines)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--reference", type=Path, required=True)
    parser.add_argument("--weights", type=Path)
    parser.add_argument("--name", default="cpm")
    parser.add_argument(
        "--photos", type=int, default=100_000, help="at most so many held-out photos"
    )
    args = parser.parse_args()
    cv2.setNumThreads(1)
    compared = networks(args.name, args.weights, args.reference)
    labelled = load(args.data / "lspet_val.tar")
    photos = [
        crop
        for name in ("photos_a", "photos_b")
        for crop in load(args.data / f"{name}.tar")
        if held_out(crop)
    ][: args.photos]
    print(f"## lspet_val: {len(labelled)} people, human labels\n")
    print(table({k: score(run, labelled, k) for k, run in compared.items()}))
    # The heavy reference made these labels, on crops of the photos themselves turned upright: its
    # own column says how far it repeats itself on the stored crop, which bounds all the others.
    print(f"\n## held-out photos: {len(photos)} people, labels by BlazePose heavy\n")
    print(table({k: score(run, photos, k) for k, run in compared.items()}))


if __name__ == "__main__":
    main()
