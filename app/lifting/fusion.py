"""Fusion: the posterior mean of the 3D pose given the 2D joints, from a few hundred neighbours.

The neighbours' Gaussian (``app.lifting.ensemble``) is updated by the observed joints as an ensemble
Kalman filter does:

    x̂ = m + B (B + R)⁻¹ (x - m)          image positions, denoised as far as the noise R demands
    ẑ = z̄ + C_zp (B + R)⁻¹ (x - m)        depths, regressed on the image residuals

with B the covariance of the projections plus what the library's granularity leaves over, and C_zp
the depths' covariance with them. One formula is at once the posterior mean over candidates, the
local ridge regression of depth (its ridge is the noise) and a soft warp (all of the way to the
observation at R = 0, none of it where 2D is worthless); a missing joint is a row left out, and the
posterior covariance tells how sure the depths are.

The noise is estimated: R = what the 2D network said + ν² I (``app.lifting.evidence``).

A learned lifter's answer, if there is one, is observed next (``app.lifting.learned``). A last
observation holds for everybody: the right side of a body is as long as the left. It often tells
which way a foreshortened limb points. The whole is then made as tall as the neighbours are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from app.lifting.ensemble import Ensemble, local_prior
from app.lifting.evidence import Evidence
from app.lifting.geometry import Floats
from app.lifting.learned import apart_mm, misplaced, with_learned
from app.lifting.update import answer_of, made_symmetric, observe_joints
from models.pose_lifter import LearnedPose


@dataclass(frozen=True)
class FusionSettings:
    """What shapes the local prior.

    Chosen on mocap subjects of whom no table is measured (and who were not in that trial's
    library), except those that came later: ``bandwidth_px``, ``localisation_bones``,
    ``proportion_spread``, ``asymmetry`` and ``outlier_prior`` on some of the even-numbered people
    of the tables' sets, ``ambiguous_mm`` on every fifth of the first and ``disagreement`` on every
    fourth; and the doubts, which frames of the network's own subjects hardly tell apart, on every
    tenth of both.

    ``bandwidth_px``, ``adaptive``, ``granularity_px``, ``localisation_bones``: see
    ``ensemble.local_prior``; ``proportion_spread``: see ``ensemble.place_ensemble``;
    ``doubt_of_noisy``, ``doubt_of_exact``, ``doubt_px``: see :meth:`doubt`;
    ``asymmetry``: standard deviation of the log ratio of two sides' lengths; ``disagreement``: the
    share of a joint's distance from the neighbours' to the network's that counts as spread of its
    own; ``noise_px``: the noise levels ν that are weighed by evidence; ``outlier_prior``:
    probability that a joint of full confidence is elsewhere. Depth is ambiguous if a limb's far
    end is within ``ambiguous_sigmas`` of being as deep as its near end and the standard deviation
    of that difference is above ``ambiguous_mm``.
    """

    bandwidth_px: float = 16.0
    adaptive: float = 4.0
    granularity_px: float = 2.0
    localisation_bones: float = 20.0
    proportion_spread: float = 0.1
    doubt_of_noisy: float = 0.6
    doubt_of_exact: float = 6.0
    doubt_px: float = 2.0
    asymmetry: float = 0.15
    disagreement: float = 0.55
    noise_px: tuple[float, ...] = (1.0, 2.0, 3.0, 4.5, 6.5, 9.0, 13.0)
    outlier_prior: float = 0.06
    ambiguous_mm: float = 85.0
    ambiguous_sigmas: float = 0.5

    def doubt(self, noise_var: float) -> float:
        """What the covariance of the network's errors is multiplied by at a noise of ν² px².

        Exact 2D the neighbours explain best, whatever the proportions; by noise they lose more than
        the network, which has learned from noisy joints. So from ``doubt_of_exact`` above it, doubt
        falls to ``doubt_of_noisy``, half of the way at ``doubt_px``.
        """
        share = 1.0 / (1.0 + noise_var**2 / self.doubt_px**4)
        return self.doubt_of_noisy + self.doubt_of_exact * share


@dataclass(frozen=True)
class FusedPose:
    """The answer of :func:`fuse`.

    ``joints_mm`` (J, 3) in the centred view's camera frame; ``spread_mm`` (J,) posterior standard
    deviation of a joint about the root, all axes together, with what neighbours and network
    disagree by, not calibrated; ``noise_px`` the noise found, standard pixels; ``outlier`` the
    joint that contradicts the others, or None; ``ambiguous``: some limb may as well point towards
    the camera as away from it.
    """

    joints_mm: Floats
    spread_mm: Floats
    noise_px: float
    outlier: int | None
    ambiguous: bool


def fuse(
    ensemble: Ensemble,
    points: Floats,
    confidence: Floats,
    covariance_px2: Floats | None,
    settings: FusionSettings,
    learned: LearnedPose | None = None,
) -> FusedPose:
    """Update the ensemble's Gaussian by the observed joints.

    Args:
        ensemble: the neighbours.
        points: (J, 2) observed, normalised image coordinates.
        confidence: (J,) 0 = missing.
        covariance_px2: (J, 2, 2) of the observation in standard pixels², or None.
        settings: the local prior.
        learned: what the network says of the same joints, or None.

    """
    seen = np.flatnonzero(confidence > 0)
    rows = (2 * seen[:, None] + np.arange(2)).ravel()
    observed = ensemble.px_per_unit * points.ravel()
    prior = local_prior(
        ensemble,
        rows,
        observed,
        bandwidth_px=settings.bandwidth_px,
        adaptive=settings.adaptive,
        granularity_px=settings.granularity_px,
        localisation_bones=settings.localisation_bones,
    )
    innovation = observed[rows] - prior.mean[rows]
    reach = prior.covariance[rows]
    expected = reach.take(rows, axis=1)
    if covariance_px2 is not None:
        blocks = expected.reshape(len(seen), 2, len(seen), 2)
        each = np.arange(len(seen))
        blocks[each, :, each] += covariance_px2[seen] / confidence[seen, None, None]
    evidence = Evidence(expected, innovation, np.square(settings.noise_px))
    posterior = observe_joints(prior, reach, evidence.mean_precision, innovation)
    of_neighbours = posterior
    if learned is not None:
        doubt = settings.doubt(evidence.mean_noise_var)
        posterior = with_learned(posterior, learned, ensemble.px_per_unit, doubt)
    posterior = made_symmetric(posterior, ensemble.px_per_unit, settings.asymmetry)
    answer = answer_of(posterior, ensemble.px_per_unit, ensemble.stature_mm)
    suspect = evidence.suspect(confidence[seen], settings.outlier_prior)
    outlier = None if suspect is None else int(seen[suspect])
    spread = answer.spread_mm
    if learned is not None:
        # Both saw the same joints: how far they differ tells how far either may be wrong.
        apart = apart_mm(of_neighbours, learned, ensemble.px_per_unit, answer.root_depth_mm)
        spread = np.hypot(spread, settings.disagreement * apart)
        outlier = misplaced(learned, points, confidence, ensemble.px_per_unit, outlier)
    return FusedPose(
        joints_mm=answer.joints_mm,
        spread_mm=spread,
        noise_px=float(np.sqrt(evidence.mean_noise_var)),
        outlier=outlier,
        ambiguous=answer.is_ambiguous(settings.ambiguous_sigmas, settings.ambiguous_mm),
    )
