"""2D joints: our pose network beside networks that users would pick instead, on the same crops.

    python -m evaluation.pose2d --data DIR --reference DIR [--name cpm-int8]

``--data`` has ``lspet_val.tar`` (human labels) and ``photos_*.tar`` (labels by the heavy reference;
only the photos that training held out are used); ``--reference`` the networks to compare with, in
ONNX: ``mobile_cpm.onnx``, ``blazepose_full.onnx``, ``blazepose_heavy.onnx``. All get the same
axis-aligned square, 1.25 x the joints' extent.

Some people of ``lspet_val`` are labelled with left and right exchanged. ``lspet_sides.json`` names
those among the people whose sides were looked at and could be told; a second table has them put
right, and its last row counts the swaps of the people who could be told alone.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from evaluation.metrics import Floats
from evaluation.progress import followed
from library_store.arguments import integer
from library_store.skeleton import LIMB_JOINTS, LSP14
from models import PersonBox, PoseEstimator
from models.crop import square_crop
from models.pck import correct_keypoints
from models.training.dataset import MP33_LIMBS, LabelledCrop, held_out, load
from models.training.teachers import BlazePose, onnx_session

SCALE = 1.25
ROWS = ("head_top", "neck", "shoulder", "elbow", "wrist", "hip", "knee", "ankle")

Estimate = Callable[[LabelledCrop], Floats]


LSPET_SIDES = Path(__file__).with_name("lspet_sides.json")
_LEFT = [j for j in LIMB_JOINTS if LSP14.mirror[j] < j]
_RIGHT = [LSP14.mirror[j] for j in _LEFT]


@dataclass(frozen=True)
class Found:
    """What one network found in a set: (N, 14, 2) pixels, nan where it has no such joint."""

    joints_px: Floats
    cpu_ms: float


@dataclass(frozen=True)
class Score:
    """Of one network on one set: ``near``, ``known`` (N, 14), ``swapped``, ``pairs`` (N, 6) bool.

    Pairs are those of limb joints with both labels known.
    """

    near: np.ndarray
    known: np.ndarray
    swapped: np.ndarray
    pairs: np.ndarray
    cpu_ms: float

    def pck(self, joints: tuple[int, ...]) -> float:
        """PCK@0.2 in per cent over the known ones of ``joints``; nan when none is known."""
        chosen = list(joints)
        known = self.known[:, chosen]
        return 100 * float(self.near[:, chosen][known].mean()) if known.any() else float("nan")

    def swaps(self, people: np.ndarray | None = None) -> float:
        """Pairs nearer to each other's truth than to their own, in per cent of the pairs."""
        who = slice(None) if people is None else people
        return 100 * float(self.swapped[who].sum() / self.pairs[who].sum())


def pose_estimator(name: str, weights: Path | None) -> PoseEstimator:
    """Our network of that name, from where it ships unless told otherwise."""
    return PoseEstimator(name, weights_dir=weights) if weights else PoseEstimator(name)


def true_square(crop: LabelledCrop) -> PersonBox:
    """The square about the labelled joints."""
    center, extent = crop.extent_px
    x, y = (float(v) for v in center - extent / 2)
    return PersonBox(x_px=x, y_px=y, width_px=extent, height_px=extent, score=1.0)


def ours(name: str, weights: Path | None) -> Estimate:
    """Our network through its shipped path."""
    estimator = pose_estimator(name, weights)

    def estimate(crop: LabelledCrop) -> Floats:
        return estimator.estimate(crop.image, [true_square(crop)])[0].positions_px

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


def held_out_photos(data: Path) -> list[LabelledCrop]:
    """The people of ``photos_*.tar`` whose photos no network of ours was trained on."""
    return [
        crop
        for name in ("photos_a", "photos_b")
        for crop in load(data / f"{name}.tar")
        if held_out(crop)
    ]


def networks(name: str, weights: Path | None, reference: Path) -> dict[str, Estimate]:
    """Ours and those to compare with, by the name of their column."""
    return {
        "ours": ours(name, weights),
        "mobile CPM": mobile_cpm(reference / "mobile_cpm.onnx"),
        "BlazePose full": blazepose(reference, "full"),
        "BlazePose heavy": blazepose(reference, "heavy"),
    }


def find(estimate: Estimate, crops: list[LabelledCrop], label: str) -> Found:
    """Run a network over a set."""
    predicted = []
    spent = 0.0
    for crop in followed(crops, label):
        began = time.process_time()
        predicted.append(estimate(crop))
        spent += time.process_time() - began
    return Found(np.stack(predicted), 1e3 * spent / len(crops))


def score(found: Found, crops: list[LabelledCrop]) -> Score:
    """Compare with the labels of the same crops, in order."""
    joints = found.joints_px
    truth = np.stack([c.joints_px for c in crops]).astype(np.float64)
    known = np.stack([c.weight > 0 for c in crops]) & np.isfinite(joints).all(-1)
    error = np.linalg.norm(joints - truth, axis=-1)
    pairs = known[:, _LEFT] & known[:, _RIGHT]
    across = [
        np.linalg.norm(joints[:, a] - truth[:, b], axis=-1) < error[:, a]
        for a, b in ((_LEFT, _RIGHT), (_RIGHT, _LEFT))
    ]
    swapped = across[0] & across[1] & pairs
    return Score(correct_keypoints(joints, truth), known, swapped, pairs, found.cpu_ms)


def put_right(crops: list[LabelledCrop], names: set[str]) -> list[LabelledCrop]:
    """The crops, with left and right exchanged in the labels of those with these names."""
    mirror = list(LSP14.mirror)
    return [
        replace(
            crop,
            joints_px=crop.joints_px[mirror],
            weight=crop.weight[mirror],
            visible=crop.visible[mirror],
        )
        if crop.name in names
        else crop
        for crop in crops
    ]


def table(scores: dict[str, Score], told: list[bool] | None = None) -> str:
    """Markdown, a column per network; ``told``: of whom a row of their own counts the swaps."""
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
    row("left/right swaps, % of pairs", [s.swaps() for s in scores.values()])
    if told is not None:
        label = f"the same, of the {sum(told)} who can be told"
        row(label, [s.swaps(np.array(told)) for s in scores.values()])
    row("CPU-ms a crop", [s.cpu_ms for s in scores.values()])
    return "\n".join(lines)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--reference", type=Path, required=True)
    parser.add_argument("--weights", type=Path)
    parser.add_argument("--name", default="cpm-int8")
    parser.add_argument(
        "--photos", type=integer(1), default=100_000, help="at most so many held-out photos"
    )
    args = parser.parse_args()
    cv2.setNumThreads(1)
    compared = networks(args.name, args.weights, args.reference)
    labelled = load(args.data / "lspet_val.tar")
    photos = held_out_photos(args.data)[: args.photos]
    print(f"## lspet_val: {len(labelled)} people, human labels\n")
    found = {k: find(run, labelled, k) for k, run in compared.items()}
    print(table({k: score(joints, labelled) for k, joints in found.items()}))
    sides = json.loads(LSPET_SIDES.read_text())
    exchanged = set(sides["exchanged"])
    mended = put_right(labelled, exchanged)
    told = [c.name in exchanged or c.name in sides["right"] for c in mended]
    print(f"\n## the same, {len(exchanged)} people's labels put right\n")
    print(table({k: score(joints, mended) for k, joints in found.items()}, told))
    # The heavy reference made these labels, on crops of the photos themselves turned upright: its
    # own column says how far it repeats itself on the stored crop, which bounds all the others.
    print(f"\n## held-out photos: {len(photos)} people, labels by BlazePose heavy\n")
    print(table({k: score(find(run, photos, k), photos) for k, run in compared.items()}))


if __name__ == "__main__":
    main()
