"""What a learned lifter says of a person, as one more observation of the fused state.

The network (``models.pose_lifter``) has seen ever new views of people of many builds and errs
otherwise than the neighbours do. Its answer is a state as in ``app.lifting.ensemble`` and comes
with the covariance of its errors, so the update is that of any observation:

    x̂ = x + P (P + κ R)⁻¹ (y - x)

with P the fused posterior and R the network's covariance. Both have looked at the same 2D joints,
so their errors are not independent, and neither's are quite as large as it says: κ (``doubt``)
weighs one against the other. What is left of the covariance is that of a gain so weighed and of
network errors with twice the covariance that was foretold. How large the person is stays
what the neighbours say; the network does not know.
"""

from __future__ import annotations

import numpy as np

from app.lifting.ensemble import LocalPrior
from app.lifting.geometry import Floats
from app.lifting.posterior import STANDARD_PX_PER_MM
from app.lifting.update import observe_state
from library_store.skeleton import L_HIP, LSP14, R_HIP
from models.pose_lifter import LearnedPose

_SETTLED_PX = 0.1
"""Spread added to each coordinate: a depth relative to the root's has none along the root's."""
_ERRORS = 2.0
"""What the foretold covariance of the network's errors is multiplied by to say what is left."""
_ASTRAY, _FAR_ASTRAY, _CLOSE_PX = 5.0, 8.0, 2.0
"""How many times farther than is usual for this person's joints a misplaced one lies, if the
neighbours suspect it too and if they do not; and what is added to the usual distance, standard
pixels."""


def misplaced(
    learned: LearnedPose,
    points: Floats,
    confidence: Floats,
    px_per_unit: float,
    suspect: int | None = None,
) -> int | None:
    """The joint that the network puts far from where it was seen, if there is one.

    That the neighbours suspect a joint is not enough: people in rare postures contradict them as
    well, and without that joint they are told still worse.

    Args:
        learned: the network's answer in the same view.
        points: (J, 2) observed, normalised image coordinates.
        confidence: (J,) 0 = missing.
        px_per_unit: standard pixels in a normalised unit.
        suspect: the joint that contradicts the neighbours, if any.

    """
    apart = px_per_unit * np.sqrt(((learned.points - points) ** 2).sum(1))
    seen = apart[confidence > 0]
    usual = float(np.sort(seen)[len(seen) // 2]) + _CLOSE_PX
    found = int(np.argmax(np.where(confidence > 0, apart, -1.0)))
    far = _ASTRAY if found == suspect else _FAR_ASTRAY
    return found if apart[found] > far * usual else None


def with_learned(
    pose: LocalPrior, learned: LearnedPose, px_per_unit: float, doubt: float
) -> LocalPrior:
    """``pose`` after this observation.

    Args:
        pose: a Gaussian over states.
        learned: the network's answer in the same view.
        px_per_unit: standard pixels in a normalised unit.
        doubt: what the covariance of the network's errors is multiplied by to weigh it.

    """
    n = LSP14.n_joints
    to_state = np.ones(3 * n)
    to_state[: 2 * n] = px_per_unit
    return observe_state(
        pose,
        np.concatenate([px_per_unit * learned.points.ravel(), learned.depths]),
        to_state[:, None] * learned.covariance * to_state,
        settled_var=np.square(_SETTLED_PX / px_per_unit * to_state),
        doubt=doubt,
        errors=_ERRORS,
    )


def apart_mm(
    pose: LocalPrior, learned: LearnedPose, px_per_unit: float, root_depth_mm: float
) -> Floats:
    """How far from each other ``pose`` and the network put each joint (J,).

    Args:
        pose: a Gaussian over states that has not seen the network's answer.
        learned: that answer in the same view.
        px_per_unit: standard pixels in a normalised unit.
        root_depth_mm: at which a difference of depths about the root counts.

    """
    n = LSP14.n_joints
    across_px = px_per_unit * learned.points - pose.mean[: 2 * n].reshape(n, 2)
    along = learned.depths - pose.mean[2 * n :]
    along_mm = root_depth_mm * (along - 0.5 * (along[R_HIP] + along[L_HIP]))
    distance: Floats = np.sqrt((across_px**2).sum(1) / STANDARD_PX_PER_MM**2 + along_mm**2)
    return distance
