"""Calibrate a pose network's confidence and spread, and measure it, through its ONNX file.

``python -m models.training.calibrate --data DIR [--name cpm]`` runs on photos that training held
out (whole photos, and the last crops of the labelled files): half of them fit, the other
half check. Accuracy is that on ``--test`` and on the held-out photos. All goes into the card.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from library_store.arguments import SEED
from library_store.skeleton import LIMB_JOINTS
from models.card import (
    WEIGHTS_DIR,
    ConfidenceCalibration,
    PoseOutput,
    SpreadCalibration,
    read_card,
    write_card,
)
from models.cost import with_cost
from models.heatmaps import Floats, calibrated, read_maps
from models.looks import looked_at
from models.pck import correct_keypoints
from models.session import OnnxModel
from models.training.augment import Sample, canonical, random_view
from models.training.dataset import LabelledCrop, read_crops

NEAR = 0.2
"""In torso lengths: what `confidence` is the probability of."""
COVERAGE = 0.68
RANKED_BY = "pck_0.2/lspet_val/14_joints"
"""The measure that pose networks are compared by."""


@dataclass(frozen=True)
class Readings:
    """Network readings of N crops beside their labels (J joints, F features)."""

    features: Floats  # (N, J, F)
    deviation_px: Floats  # (N, J)
    error_px: Floats  # (N, J)
    near: NDArray[np.bool_]  # (N, J) present and within NEAR
    labelled: NDArray[np.bool_]  # (N, J) position known
    judged: NDArray[np.bool_]  # (N, J) position known, or known to be outside


def read_all(model: OnnxModel, output: PoseOutput, samples: list[Sample]) -> Readings:
    """Run the network over samples of its input size."""
    parts = []
    for start in range(0, len(samples), 32):
        chunk = samples[start : start + 32]
        maps = looked_at(model.see, np.stack([s.image for s in chunk]), output.looks).maps
        parts.append(
            read_maps(maps, len(output.joint_names), output.maps, output.target_sigma_cells)
        )
    at = np.concatenate([r.at for r in parts])
    covariance = np.concatenate([r.covariance for r in parts])
    truth = np.stack([s.joints_px for s in samples])
    weight = np.stack([s.weight for s in samples])
    presence = np.stack([s.presence for s in samples])
    found = (at + 0.5) * output.stride_px - 0.5
    error = np.linalg.norm(found - truth, axis=-1)
    labelled = weight > 0
    return Readings(
        features=np.concatenate([r.features for r in parts]),
        deviation_px=np.sqrt(np.trace(covariance, axis1=-2, axis2=-1)) * output.stride_px,
        error_px=error,
        near=labelled & correct_keypoints(found, truth, NEAR),
        labelled=labelled,
        judged=labelled | (presence == 0),
    )


def fit_confidence(data: Readings, ridge: float = 1.0, steps: int = 30) -> Floats:
    """Logistic regression with slopes common to all joints, one intercept each; (J, 1 + F)."""
    n_joints, n_features = data.features.shape[1:]
    joint = np.broadcast_to(np.arange(n_joints), data.judged.shape)[data.judged]
    x = np.concatenate([np.eye(n_joints)[joint], data.features[data.judged]], 1)
    y = data.near[data.judged].astype(np.float64)
    beta = np.zeros(n_joints + n_features)
    for _ in range(steps):
        p = 1 / (1 + np.exp(-np.clip(x @ beta, -30, 30)))
        gradient = x.T @ (y - p) - ridge * beta
        curvature = (x * (p * (1 - p))[:, None]).T @ x + ridge * np.eye(len(beta))
        beta += np.linalg.solve(curvature, gradient)
    slopes = np.broadcast_to(beta[n_joints:], (n_joints, n_features))
    return np.concatenate([beta[:n_joints, None], slopes], 1)


def calibration_error(probability: Floats, happened: NDArray[np.bool_], bins: int = 10) -> float:
    """Expected calibration error: mean gap between stated and observed, over equal-width bins."""
    index = np.minimum((probability * bins).astype(int), bins - 1)
    gap = 0.0
    for b in range(bins):
        inside = index == b
        if inside.any():
            gap += inside.mean() * abs(probability[inside].mean() - happened[inside].mean())
    return float(gap)


def draw_reliability(
    path: Path, probability: Floats, check: Readings, names: tuple[str, ...], bins: int = 10
) -> None:
    """Stated against observed, a curve for each kind of joint, left and right together (PNG)."""
    import matplotlib  # a large import that only this picture needs

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    parts = dict.fromkeys(name.removeprefix("r_").removeprefix("l_") for name in names)
    figure, axes = plt.subplots(2, 4, figsize=(10, 5.2), sharex=True, sharey=True)
    for axis, part in zip(axes.flat, parts, strict=True):
        chosen = [j for j, name in enumerate(names) if name.endswith(part)]
        judged = check.judged[:, chosen]
        stated, near = probability[:, chosen][judged], check.near[:, chosen][judged]
        bin_of = np.minimum((stated * bins).astype(int), bins - 1)
        filled = [b for b in range(bins) if (bin_of == b).sum() >= 10]
        axis.plot([0, 1], [0, 1], color="0.7", linewidth=1)
        axis.plot(
            [stated[bin_of == b].mean() for b in filled],
            [near[bin_of == b].mean() for b in filled],
            marker="o",
            markersize=4,
        )
        axis.hist(stated, bins=bins, range=(0, 1), weights=np.full(len(stated), 1 / len(stated)))
        error = calibration_error(stated, near)
        axis.set_title(f"{part.replace('_', ' ')}: error {error:.3f}", fontsize=9)
    figure.supxlabel("confidence stated")
    figure.supylabel("share within 0.2 torso lengths")
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)


def accuracy(data: Readings, joints: tuple[int, ...]) -> float:
    """PCK@0.2 over the labelled ones of ``joints``."""
    chosen = list(joints)
    return float(data.near[:, chosen][data.labelled[:, chosen]].mean())


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--weights", type=Path, default=WEIGHTS_DIR)
    parser.add_argument("--name", default="cpm")
    parser.add_argument("--train", default="lspet_train_a,lspet_train_b,photos_a,photos_b")
    parser.add_argument("--test", default="lspet_val", help="measured too; several with commas")
    parser.add_argument("--seed", type=SEED, default=0)
    parser.add_argument("--figure", type=Path, help="draw the reliability diagram here (PNG)")
    args = parser.parse_args()
    cv2.setNumThreads(1)

    path = args.weights / f"{args.name}.json"
    card = read_card(path)
    output = card.output
    if not isinstance(output, PoseOutput):
        raise SystemExit(f"{path} is no pose network's card")
    model = OnnxModel(args.weights, args.name)
    _, kept = read_crops(args.data, args.train, args.test)
    rng = np.random.default_rng(args.seed)

    def views(crops: list[LabelledCrop]) -> Readings:
        """Each crop as it is, and once cut off, covered or turned at random."""
        samples = [canonical(crop, output.input_px) for crop in crops]
        for crop in crops:
            other = crops[int(rng.integers(len(crops)))]
            samples.append(random_view(crop, other, output.input_px, rng))
        return read_all(model, output, samples)

    held = kept["photos_dev"] + kept["labelled_dev"]
    fit, check = views(held[0::2]), views(held[1::2])
    coefficients = fit_confidence(fit)
    stated = calibrated(check.features, coefficients)
    ece = calibration_error(stated[check.judged], check.near[check.judged])
    ratio = fit.error_px / fit.deviation_px
    factor = [
        float(np.quantile(ratio[fit.labelled[:, j], j], COVERAGE)) for j in range(ratio.shape[1])
    ]
    covered = check.error_px < check.deviation_px * np.array(factor)
    coverage = float(covered[check.labelled].mean())

    measured: dict[str, float | str] = dict(card.measured)
    for name in (*filter(None, args.test.split(",")), "photos_dev"):
        if not kept[name]:
            continue
        data = read_all(model, output, [canonical(c, output.input_px) for c in kept[name]])
        measured[f"pck_0.2/{name}/14_joints"] = round(accuracy(data, tuple(range(14))), 4)
        measured[f"pck_0.2/{name}/12_limb_joints"] = round(accuracy(data, LIMB_JOINTS), 4)
    measured["command"] = f"python -m models.training.calibrate --data DIR --name {args.name}"
    held_text = "half of the held-out photos and labelled crops; checked on the other half"
    updated = card.model_copy(
        update={
            "measured": measured,
            "accuracy": measured.get(RANKED_BY),
            "output": output.model_copy(
                update={
                    "confidence": ConfidenceCalibration(
                        coefficients=[[round(float(v), 5) for v in row] for row in coefficients],
                        fitted_on=held_text,
                        expected_calibration_error=round(ece, 4),
                    ),
                    "spread": SpreadCalibration(
                        factor=[round(f, 4) for f in factor],
                        fitted_on=held_text,
                        coverage=round(coverage, 4),
                    ),
                }
            ),
        }
    )
    write_card(path, with_cost(updated, model))
    if args.figure:
        draw_reliability(args.figure, stated, check, tuple(output.joint_names))
    outside = check.judged & ~check.labelled
    seen = check.labelled
    print(measured)
    print(
        {
            "median confidence of joints outside the crop": round(
                float(np.median(stated[outside])), 3
            ),
            "of labelled joints": round(float(np.median(stated[seen])), 3),
        }
    )
    print({"ece": round(ece, 4), "coverage_68": round(coverage, 4)})


if __name__ == "__main__":
    main()
