"""p(X | x), learned: 2D joints to where they are in 3D, and how far that may be wrong.

A small residual MLP after Martinez et al. (ICCV 2017). It knows neither size nor distance: joints
go in as the camera sees them and with how probably each is right, and out come, for each, where in
the image it really is and how much nearer or farther than the hips, relative to the hips' own
distance. A network may also be told what the picture shows of that: joints alone leave it open
whether a limb points to the camera or away. The architecture is in
``models.training.lifter_network``, what it is trained on in ``models.training.lifter_samples``.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from library_store.skeleton import LIMB_JOINTS, LSP14
from models.card import WEIGHTS_DIR, LiftOutput, ModelCard, read_card
from models.errors import ModelError
from models.providers import Runtime
from models.session import OnnxModel

Floats = NDArray[np.float64]

_LIMBS = np.array(LIMB_JOINTS)


@dataclass(frozen=True)
class LearnedPose:
    """What the network says of a person.

    ``points`` (14, 2) normalised image coordinates of the joints; ``depths`` (14,) their depths
    relative to the hip midpoint's, ``z / z_root - 1``; ``covariance`` (42, 42) of the errors of
    both, x and y of the first joint first, the depths last.
    """

    points: Floats
    depths: Floats
    covariance: Floats


def lifter_names(name: str, weights_dir: Path = WEIGHTS_DIR) -> tuple[str, ...]:
    """``name`` and the network for found joints that its card names, if it can be read."""
    try:
        output = read_card(weights_dir / f"{name}.json").output
    except ModelError:
        return (name,)
    found = output.found if isinstance(output, LiftOutput) else None
    return (name,) if found is None else (name, found)


class PoseLifter:
    """The lifting network with its card. Thread-safe; always on the CPU, where it takes a blink.

    Joints that are stated are noisy at worst, those that a pose network found are now and then
    elsewhere: what is best to make of the one is not of the other. So a card may name a second
    network, ``found``, for people not all of whose limb joints are sure. (Neck and head top may be
    guesses from other skeletons' joints that are.)
    """

    def __init__(self, name: str = "lifter", *, weights_dir: Path = WEIGHTS_DIR) -> None:
        self._model = OnnxModel(weights_dir, name, provider="cpu")
        output = self._model.card.output
        if not isinstance(output, LiftOutput):
            raise ModelError(f"model {name} is no lifter: its card says {output.kind}")
        if tuple(output.joint_names) != LSP14.joint_names:
            raise ModelError(f"model {name} has other joints than lsp14: {output.joint_names}")
        self._output = output
        self._found: PoseLifter | None = None
        if output.found is not None:
            if len(lifter_names(output.found, weights_dir)) > 1:
                raise ModelError(
                    f"model {name} names {output.found} for found joints, which names a further one"
                )
            self._found = PoseLifter(output.found, weights_dir=weights_dir)

    @property
    def card(self) -> ModelCard:
        """The network's model card."""
        return self._model.card

    @property
    def networks(self) -> tuple[PoseLifter, ...]:
        """Itself, and the network for joints that were found if there is one."""
        return (self,) if self._found is None else (self, *self._found.networks)

    @property
    def runtime(self) -> Runtime:
        """The provider in use and the precision it runs the network in."""
        return self._model.runtime

    def lift(self, points: Floats, confidence: Floats, depths: Floats | None = None) -> LearnedPose:
        """Lift one person.

        Args:
            points: (14, 2) normalised image coordinates, the camera turned onto the person.
            confidence: (14,) how probably each is right; 0 = missing, whose point is ignored. Two
                joints at least.
            depths: (14,) relative to the hip midpoint's, ``z / z_root - 1``, as the picture shows
                them, or None when unknown. Those of missing joints are ignored, and all of them by
                networks that do not read them.

        """
        doubted = (confidence > 0) & (confidence < 1)
        if self._found is not None and doubted[_LIMBS].any():
            return self._found.lift(points, confidence, depths)
        seen = confidence > 0
        joints = np.zeros((1, LSP14.n_joints, self._output.n_columns), np.float32)
        joints[0, seen, :2] = points[seen]
        joints[0, :, 2] = confidence if self._output.reads_confidence else seen
        if depths is not None and self._output.reads_depths:
            joints[0, seen, 3] = depths[seen]
            joints[0, seen, 4] = 1.0
        answer = self._model.run(joints)[0].astype(np.float64)
        n = 2 * LSP14.n_joints
        return LearnedPose(answer[0, :n].reshape(-1, 2), answer[0, n:], answer[1:])
