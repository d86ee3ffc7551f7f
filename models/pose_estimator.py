"""2D joints of every person: crops -> CPM -> heat maps -> joints in the photo's pixels."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from library_store.skeleton import LSP14
from models.card import WEIGHTS_DIR, ModelCard, PoseOutput
from models.crop import square_crop
from models.errors import ModelError
from models.heatmaps import Floats, Joints2D, Maps, calibrated, read_maps
from models.looks import Seen, belief, looked_at
from models.person_detector import PersonBox
from models.providers import ProviderChoice, Runtime
from models.rivals import shares
from models.session import OnnxModel
from models.truncation import PLAINLY, whole


class _Crop(NamedTuple):
    """A square of a photo, its pixels' size there, and where its pixel (0, 0) lies."""

    image: NDArray[np.uint8]
    scale: float
    origin_px: tuple[float, float]


def _images(crops: Sequence[_Crop]) -> NDArray[np.uint8]:
    return np.stack([crop.image for crop in crops])


class PoseEstimator:
    """The Convolutional Pose Machine with its card. Thread-safe."""

    def __init__(
        self,
        name: str = "cpm",
        *,
        weights_dir: Path = WEIGHTS_DIR,
        provider: ProviderChoice = "auto",
        concurrency: int = 1,
    ) -> None:
        self._model = OnnxModel(weights_dir, name, provider=provider, concurrency=concurrency)
        output = self._model.card.output
        if not isinstance(output, PoseOutput):
            raise ModelError(f"model {name} is no pose network: its card says {output.kind}")
        if tuple(output.joint_names) != LSP14.joint_names:
            raise ModelError(f"model {name} has other joints than lsp14: {output.joint_names}")
        self._output = output

    @property
    def card(self) -> ModelCard:
        """The network's model card."""
        return self._model.card

    @property
    def runtime(self) -> Runtime:
        """The provider in use and the precision it runs the network in."""
        return self._model.runtime

    def warm_up(self, people: int) -> None:
        """Run the batch sizes up to ``people``: all but the CPU's provider compile each anew."""
        size = self._output.input_px
        for count in range(people if self.runtime.provider == "cpu" else 1, people + 1):
            self._model.warm_up(np.zeros((count, size, size, 3), np.uint8))

    def estimate(self, image: NDArray[np.uint8], boxes: Sequence[PersonBox]) -> list[Joints2D]:
        """Joints of the person in each box of a photo (H, W, 3) uint8 BGR, one batch for all."""
        if not boxes:
            return []
        crops = [self._crop(image, box) for box in boxes]
        first = self._model.see(_images(crops))
        first = self._seen_whole(image, boxes, crops, first)
        seen = looked_at(self._model.see, _images(crops), self._output.looks, first)
        return self.read(seen, [it.scale for it in crops], [it.origin_px for it in crops])

    def _crop(self, image: NDArray[np.uint8], box: PersonBox) -> _Crop:
        center = (box.x_px + box.width_px / 2, box.y_px + box.height_px / 2)
        side = max(box.width_px, box.height_px, 1.0) * self._output.crop_scale
        size, grey = self._output.input_px, self._output.border_grey
        return _Crop(*square_crop(image, center, side, size, grey))

    def _seen_whole(
        self,
        image: NDArray[np.uint8],
        boxes: Sequence[PersonBox],
        crops: list[_Crop],
        first: Seen,
    ) -> Seen:
        """The first look, of who seems to be cut off at the scale of the whole person.

        Replaces crops of those whom the network plainly believes in more then.
        """
        height, width = image.shape[:2]
        believed = belief(first.maps)
        larger = {}
        for i, box in enumerate(boxes):
            grown = whole(box, width, height, float(believed[i]))
            if grown is not None:
                larger[i] = self._crop(image, grown)
        if not larger:
            return first
        again = self._model.see(_images(list(larger.values())))
        better = belief(again.maps) > PLAINLY * believed[list(larger)]
        maps = first.maps.copy()
        depths = None if first.depths is None else first.depths.copy()
        for row, (i, crop) in enumerate(larger.items()):
            if better[row]:
                crops[i], maps[i] = crop, again.maps[row]
                if depths is not None and again.depths is not None:
                    depths[i] = again.depths[row]
        return Seen(maps, depths)

    def read(
        self, seen: Seen, scales: Sequence[float], origins: Sequence[tuple[float, float]]
    ) -> list[Joints2D]:
        """Joints from what the network made of N people in one photo.

        A crop's pixel lies in the photo at origin + scale * pixel.
        """
        maps = seen.maps
        out = self._output
        scale, origin_px = np.asarray(scales, np.float64), np.asarray(origins, np.float64)

        def own(p: Maps, belief: Floats) -> Maps:
            return shares(p, belief, scale, origin_px, out.stride_px)

        several = own if len(maps) > 1 else None
        read = read_maps(maps, len(out.joint_names), out.maps, out.target_sigma_cells, several)
        # The centre of cell c lies at crop pixel (c + 0.5) * stride - 0.5.
        crop_px = (read.at + 0.5) * out.stride_px - 0.5
        positions = origin_px[:, None] + scale[:, None, None] * crop_px
        covariance_px2 = read.covariance * (scale * out.stride_px)[:, None, None, None] ** 2
        confidence: Floats | None = None
        sigma: Floats | None = None
        depths: Floats | None = None
        if out.confidence is not None:
            confidence = calibrated(read.features, np.asarray(out.confidence.coefficients))
        if out.spread is not None:
            deviation = np.sqrt(np.trace(covariance_px2, axis1=-2, axis2=-1))
            sigma = deviation * np.asarray(out.spread.factor)
        if seen.depths is not None:
            depths = seen.depths * (scale * out.input_px)[:, None]
        return [
            Joints2D(
                positions_px=positions[i],
                covariance_px2=covariance_px2[i],
                confidence=None if confidence is None else confidence[i],
                sigma_px=None if sigma is None else sigma[i],
                peak=read.peak[i],
                depths_px=None if depths is None else depths[i],
            )
            for i in range(len(maps))
        ]
