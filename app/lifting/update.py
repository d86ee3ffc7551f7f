"""Observations of a person's state, and what a state says of the person; the loops compiled.

A state is that of ``app.lifting.ensemble``, a Gaussian over it a ``LocalPrior``.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from app.lifting.compiled import compiled, pointer
from app.lifting.ensemble import LocalPrior
from app.lifting.geometry import Floats
from app.lifting.posterior import STANDARD_PX_PER_MM
from app.lifting.proportions import SYMMETRIC_SEGMENTS
from app.lifting.stature import STATURE_SEGMENTS, STATURE_SHARES
from library_store.skeleton import L_HIP, LSP14, R_HIP

_LIMBS = ("shoulder", "elbow", "wrist"), ("hip", "knee", "ankle")
_LIMB_SEGMENTS = np.array(
    [
        (LSP14.index(f"{side}_{start}"), LSP14.index(f"{side}_{end}"))
        for side in ("r", "l")
        for limb in _LIMBS
        for start, end in pairwise(limb)
    ],
    dtype=np.int64,
)
"""(8, 2): the joints at the near and at the far end of each limb segment."""
_PAIRS = np.array(SYMMETRIC_SEGMENTS, dtype=np.int64)
_SIZE = 3 * LSP14.n_joints


def observe_state(
    pose: LocalPrior,
    seen: Floats,
    error: Floats,
    *,
    settled_var: Floats,
    doubt: float,
    errors: float,
) -> LocalPrior:
    """``pose`` after all of the state was observed with errors of covariance R.

    The gain is ``K = P (P + κ R + S)⁻¹``, the covariance left ``P - K P + (ε - κ) K R Kᵀ``: that of
    (1 - K) P (1 - K)ᵀ + ε K R Kᵀ, but for S.

    Args:
        pose: a Gaussian over states, of covariance P.
        seen: (3 J,) the observation.
        error: (3 J, 3 J) R.
        settled_var: (3 J,) S, positive; what is known without error otherwise.
        doubt: κ.
        errors: ε.

    """
    mean, covariance = _copied(pose)
    said, spread, settled = (
        np.ascontiguousarray(given, dtype=np.float64) for given in (seen, error, settled_var)
    )
    if not said.shape == settled.shape == (_SIZE,) or spread.shape != (_SIZE, _SIZE):
        raise ValueError("what was observed is no state")
    compiled().posematch_observe_state(
        _SIZE,
        pointer(mean),
        pointer(covariance),
        pointer(said),
        pointer(spread),
        pointer(settled),
        doubt,
        errors,
    )
    return LocalPrior(mean, covariance, pose.root_depth_mm)


def observe_joints(
    pose: LocalPrior, reach: Floats, precision: Floats, innovation: Floats
) -> LocalPrior:
    """``pose`` after some of the state was observed.

    Args:
        pose: a Gaussian over states.
        reach: (m, 3 J) covariance of what was observed with the state.
        precision: (m, m) inverse of the innovation's covariance.
        innovation: (m,) the observation less what was expected.

    """
    mean, covariance = _copied(pose)
    rows, weights, news = (
        np.ascontiguousarray(given, dtype=np.float64) for given in (reach, precision, innovation)
    )
    m = len(news)
    if rows.shape != (m, _SIZE) or weights.shape != (m, m) or news.shape != (m,):
        raise ValueError("reach, precision and innovation do not belong together")
    compiled().posematch_observe_joints(
        _SIZE,
        m,
        pointer(mean),
        pointer(covariance),
        pointer(rows),
        pointer(weights),
        pointer(news),
    )
    return LocalPrior(mean, covariance, pose.root_depth_mm)


def made_symmetric(pose: LocalPrior, px_per_unit: float, sigma: float) -> LocalPrior:
    """Observe that paired segments are equally long, but for ``sigma`` of their log ratio."""
    mean, covariance = _copied(pose)
    compiled().posematch_observe_pairs(
        LSP14.n_joints,
        pointer(mean),
        pointer(covariance),
        px_per_unit,
        pose.root_depth_mm,
        len(_PAIRS),
        pointer(_PAIRS),
        sigma,
    )
    return LocalPrior(mean, covariance, pose.root_depth_mm)


@dataclass(frozen=True)
class Answer:
    """What a Gaussian over states says of a person.

    ``joints_mm`` (J, 3) in the centred view's camera frame; ``spread_mm`` (J,) standard deviation
    about the root, all axes together; ``bends_mm`` (8, 2) how much deeper the far end of each limb
    segment is than its near end, and the standard deviation of that; ``root_depth_mm``.
    """

    joints_mm: Floats
    spread_mm: Floats
    bends_mm: Floats
    root_depth_mm: float

    def is_ambiguous(self, sigmas: float, least_mm: float) -> bool:
        """Whether some limb may as well point towards the camera as away from it.

        That is: by no more than so many ``sigmas``, and these above ``least_mm``.
        """
        return any(
            sigma > least_mm and abs(along) < sigmas * sigma
            for along, sigma in self.bends_mm.tolist()
        )


def answer_of(pose: LocalPrior, px_per_unit: float, stature_mm: float) -> Answer:
    """The answer, at the distance at which the person is so tall; no image or direction changes.

    The mean of many poses has shorter segments than any of them: what it lacks is their spread,
    ``E|s|² = |E s|² + tr Cov s``.
    """
    mean, covariance = _checked(pose)
    n = LSP14.n_joints
    joints, spread, bends = np.empty((n, 3)), np.empty(n), np.empty((len(_LIMB_SEGMENTS), 2))
    root_depth = compiled().posematch_answer(
        n,
        pointer(mean),
        pointer(covariance),
        px_per_unit,
        pose.root_depth_mm,
        stature_mm,
        len(STATURE_SEGMENTS),
        pointer(STATURE_SEGMENTS),
        pointer(STATURE_SHARES),
        R_HIP,
        L_HIP,
        STANDARD_PX_PER_MM,
        len(_LIMB_SEGMENTS),
        pointer(_LIMB_SEGMENTS),
        pointer(joints),
        pointer(spread),
        pointer(bends),
    )
    return Answer(joints, spread, bends, root_depth)


def _checked(pose: LocalPrior) -> tuple[Floats, Floats]:
    """Mean and covariance as the loops read them."""
    mean = np.ascontiguousarray(pose.mean, dtype=np.float64)
    covariance = np.ascontiguousarray(pose.covariance, dtype=np.float64)
    if mean.shape != (_SIZE,) or covariance.shape != (_SIZE, _SIZE):
        raise ValueError("no Gaussian over states")
    return mean, covariance


def _copied(pose: LocalPrior) -> tuple[Floats, Floats]:
    """The same, to be written to."""
    mean, covariance = _checked(pose)
    return mean.copy(), covariance.copy()
