"""Train the person network: ``python -m models.training.train_people --help``.

Learns from mosaics of the labelled crops and from scenes that label_scenes.py has gone through.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F

from library_store.arguments import integers
from models.crop import warped
from models.errors import AnnotationError
from models.person_detector import decode
from models.training import loop
from models.training.augment import worsen
from models.training.crowds import calm_patches, crowd
from models.training.cut_short import bust, can_be_cut, close_up, standing
from models.training.cutout import whole
from models.training.dataset import Image, LabelledCrop, read_crops
from models.training.measure_people import recall_and_extra
from models.training.network import COARSEST_STRIDE_PX, PersonConfig, PersonNetwork
from models.training.precision import mixed_precision
from models.training.scenes import (
    UNSURE,
    LabelledScene,
    SceneSample,
    mosaic,
    portrait,
    read_scenes,
    scene_view,
    turned,
)

UNIT_PX = 32.0
"""Distances to the box's sides are learned as logarithms of multiples of this."""
QUARTERS = (0.64, 0.13, 0.1, 0.13)
"""Shares of the samples that are upright and turned by one, two and three quarters: photos without
EXIF come on their side, and sport is done upside down."""
KINDS = {
    "scene": 0.22,
    "close-up": 0.06,
    "portrait": 0.26,
    "bust": 0.12,
    "crowd": 0.17,
    "mosaic": 0.17,
}
"""Shares of what samples show: a scene; somebody in one, enlarged and cut off; somebody who fills
the photo; somebody down to its lower edge; who overlap; who are beside each other, or nobody."""
ROUGH_SHARE = 0.3
"""Of the samples that are worsened beyond what ``expose`` does to all of them."""
LEAST_SCORE = 0.3
"""Of the boxes that count while training goes on; what is served has its card's threshold."""


def targets(
    samples: list[SceneSample], stride: int
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Centre maps (B, h, w), distances (B, 4, h, w) px, weight of the distances (B, h, w)."""
    h, w = samples[0].image.shape[0] // stride, samples[0].image.shape[1] // stride
    heat = np.zeros((len(samples), h, w), np.float32)
    sides = np.zeros((len(samples), 4, h, w), np.float32)
    weight = np.zeros((len(samples), h, w), np.float32)
    y, x = np.mgrid[0:h, 0:w].astype(np.float32)
    cx, cy = (x + 0.5) * stride - 0.5, (y + 0.5) * stride - 0.5
    for b, sample in enumerate(samples):
        # Small boxes last: where people overlap, the one in front is usually the whole one.
        for box in sorted(sample.boxes, key=lambda v: -float((v[2:] - v[:2]).prod())):
            size = np.maximum(box[2:] - box[:2], 4.0)
            # Sharp across, so that neighbours stay apart; never narrower than a cell.
            sx, sy = np.maximum(0.12 * size, 0.6 * stride)
            mx, my = (box[:2] + box[2:]) / 2
            mx = (np.round((mx + 0.5) / stride - 0.5) + 0.5) * stride - 0.5
            my = (np.round((my + 0.5) / stride - 0.5) + 0.5) * stride - 0.5
            bump = np.exp(-(((cx - mx) / sx) ** 2 + ((cy - my) / sy) ** 2) / 2)
            near = bump > np.maximum(weight[b], 0.3)
            heat[b] = np.maximum(heat[b], bump)
            offsets = np.stack([cx - box[0], cy - box[1], box[2] - cx, box[3] - cy])
            sides[b][:, near] = offsets[:, near]
            weight[b][near] = bump[near]
    return heat, sides, weight


def loss_from(out: Tensor, heat: Tensor, sides: Tensor, weight: Tensor, trust: Tensor) -> Tensor:
    """CenterNet's focal loss on the centres plus -log IoU of the boxes."""
    out = out.float()
    logit = out[:, 0]
    p = torch.sigmoid(logit)
    centre = (heat > 0.999).float()
    positive = -F.logsigmoid(logit) * (1 - p) ** 2 * centre
    negative = -F.logsigmoid(-logit) * p**2 * (1 - heat) ** 4 * (1 - centre) * trust
    n = centre.sum().clamp_min(1.0)
    guess = torch.exp(out[:, 1:].clamp(-4, 4)) * UNIT_PX
    truth = sides.clamp_min(1.0)
    overlap = torch.minimum(guess[:, :2], truth[:, :2]) + torch.minimum(guess[:, 2:], truth[:, 2:])
    inter = overlap.prod(1)
    area_g = (guess[:, :2] + guess[:, 2:]).prod(1)
    area_t = (truth[:, :2] + truth[:, 2:]).prod(1)
    ratio = inter / (area_g + area_t - inter)
    box = (-torch.log(ratio.clamp_min(1e-4)) * weight).sum() / weight.sum().clamp_min(1.0)
    return (positive.sum() + negative.sum()) / n + box


@dataclass(frozen=True)
class Material:
    """What samples are made of: labelled crops, and scenes that label_scenes.py has gone through.

    Of the ``crops`` those that are ``whole`` and those that ``can_be_cut``; of the ``scenes`` those
    with somebody ``standing`` and the pictures of the ``empty`` ones; ``calm`` are these and
    patches of the others that come near nobody.
    """

    crops: list[LabelledCrop]
    entire: list[LabelledCrop]
    cuttable: list[LabelledCrop]
    scenes: list[LabelledScene]
    peopled: list[LabelledScene]
    empty: list[Image]
    calm: list[Image]

    @classmethod
    def of(
        cls, crops: list[LabelledCrop], scenes: list[LabelledScene], rng: np.random.Generator
    ) -> Material:
        """Sorted out; ``AnnotationError`` when there is nothing for some kind of sample."""
        empty = [s.image for s in scenes if not len(s.people) or s.people[:, 4].max() < UNSURE]
        made = cls(
            crops=crops,
            entire=[crop for crop in crops if whole(crop)],
            cuttable=[crop for crop in crops if can_be_cut(crop)],
            scenes=scenes,
            peopled=[scene for scene in scenes if len(standing(scene))],
            empty=empty,
            calm=empty + calm_patches(scenes, rng),
        )
        needed = {
            "scene": made.scenes,
            "close-up": made.peopled,
            "portrait": made.crops,
            "bust": made.cuttable,
            "crowd": made.entire,
            "mosaic": made.empty,
        }
        lacking = [kind for kind, those in needed.items() if not those]
        if lacking:
            raise AnnotationError(
                f"crops and scenes have nothing to make samples of: {', '.join(lacking)} "
                f"({made.counts()})"
            )
        return made

    def counts(self) -> dict[str, int]:
        """How much there is of each."""
        return {name: len(those) for name, those in vars(self).items()}

    def sample(self, rng: np.random.Generator, size: tuple[int, int]) -> SceneSample:
        """A random sample of ``size`` (w, h), turned and worsened as often as the shares say."""
        quarters = int(rng.choice(4, p=QUARTERS))
        made = turned(self.upright(rng, size[::-1] if quarters % 2 else size), quarters)
        return replace(made, image=worsen(made.image, rng)) if rng.random() < ROUGH_SHARE else made

    def upright(self, rng: np.random.Generator, size: tuple[int, int]) -> SceneSample:
        """A random one of the ``KINDS``."""
        kind = rng.choice(list(KINDS), p=list(KINDS.values()))
        if kind == "scene":
            return scene_view(self.scenes[rng.integers(len(self.scenes))], size, rng)
        if kind == "close-up":
            return close_up(self.peopled[rng.integers(len(self.peopled))], size, rng)
        if kind == "portrait":
            return portrait(self.crops[rng.integers(len(self.crops))], size, rng)
        if kind == "bust":
            crop = self.cuttable[rng.integers(len(self.cuttable))]
            return bust(crop, self.calm, size, rng)
        if kind == "crowd":
            return crowd(self.entire, self.calm, self.scenes, size, rng)
        return mosaic(self.crops, self.empty, size, rng)


def to_batch(samples: list[SceneSample], stride: int) -> loop.Batch:
    """Images (B, 3, h, w) in [-1, 1], what ``targets`` makes of the boxes, and the trust."""
    x = torch.from_numpy(np.stack([s.image for s in samples])).permute(0, 3, 1, 2)
    x = x.float().mul_(1 / 127.5).sub_(1).contiguous(memory_format=torch.channels_last)
    maps = [torch.from_numpy(a) for a in targets(samples, stride)]
    return (x, *maps, torch.from_numpy(np.stack([s.trust for s in samples])))


def finder(
    model: PersonNetwork, canvas: tuple[int, int], device: str
) -> Callable[[Image], NDArray[np.float64]]:
    """What the network finds in a photo on a canvas (w, h): corner boxes (n, 4) in its pixels."""

    def find(image: Image) -> NDArray[np.float64]:
        h, w = image.shape[:2]
        fit = min(canvas[0] / w, canvas[1] / h)
        small = warped(image, np.array([[fit, 0, 0], [0, fit, 0]]), canvas)
        x = torch.from_numpy(small).permute(2, 0, 1)[None].float() / 127.5 - 1
        with torch.no_grad():
            out = model(x.to(device))[0].cpu().numpy()
        boxes, _ = decode(out, PersonNetwork.STRIDE, UNIT_PX, LEAST_SCORE)
        found: NDArray[np.float64] = boxes / fit
        return found

    return find


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    loop.add_arguments(parser)
    parser.add_argument("--train", default="lspet_train_a,lspet_train_b,photos_a,photos_b")
    parser.add_argument("--scenes", default="photos_scenes.tar")
    parser.add_argument("--scenes-labels", type=Path, required=True)
    parser.add_argument(
        "--canvas",
        type=integers(2, "x", multiples_of=COARSEST_STRIDE_PX),
        default="320x256",
        help="training size in px, width x height",
    )
    args = parser.parse_args()

    crops, _ = read_crops(args.data, args.train, "")
    train, dev = read_scenes(args.data / args.scenes, args.scenes_labels)
    material = Material.of(crops, train, np.random.default_rng(args.seed))
    print(material.counts() | {"dev": len(dev)})
    width, height = args.canvas
    canvas = (width, height)

    def make_batch(step: int, size: int) -> loop.Batch:  # noqa: ARG001
        rng = np.random.default_rng((args.seed, step))
        samples = [material.sample(rng, canvas) for _ in range(args.batch)]
        return to_batch(samples, PersonNetwork.STRIDE)

    def loss_of(model: PersonNetwork, batch: loop.Batch) -> Tensor:
        x, heat, sides, weight, trust = batch
        with mixed_precision(args.device):
            out = model(x)
        return loss_from(out, heat, sides, weight, trust)

    def evaluate(model: PersonNetwork, _: int) -> dict[str, float]:
        recall, extra = recall_and_extra(finder(model, canvas, args.device), dev)
        return {"recall": recall, "unmatched_per_scene": extra}

    cfg = PersonConfig()
    loop.fit(
        PersonNetwork(cfg),
        args,
        sizes=[(1.0, width)],
        make_batch=make_batch,
        loss_of=loss_of,
        evaluate=evaluate,
        config=cfg.as_dict(),
    )


if __name__ == "__main__":
    main()
