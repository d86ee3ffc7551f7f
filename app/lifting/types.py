"""What goes into lifting and what comes out of it.

Joints are in ``library_store.skeleton.LSP14`` order. Camera frame: OpenCV axes (x right, y down, z
forward), millimetres. Pixels: the upright photo, (0, 0) the centre of its top-left pixel.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from app.lifting.geometry import Floats
from library_store.skeleton import LSP14
from library_store.sources import Source

Method = Literal["fusion", "paper"]
FocalSource = Literal["request", "exif", "assumed"]
ScaleSource = Literal["library", "request"]


@dataclass(frozen=True)
class Observation:
    """The 2D joints of one person.

    ``joints_px`` (14, 2) float64; ``confidence`` (14,) in [0, 1], 0 = missing (all else of it is
    ignored and may be NaN); ``covariance_px2`` (14, 2, 2) px², or None when unknown: the noise is
    then estimated from the joints themselves; ``depths_px`` (14,) how much farther from the camera
    than the hip midpoint each joint is by what the picture shows of it, in pixels at the hips'
    distance, ``(z / z_root - 1) * focal_length_px``, or None when unknown; ``truncated`` when the
    photo cuts the person off and what lies beyond its edge is guessed. ``ValueError`` on wrong
    shapes, on confidences outside [0, 1] and on present joints that are not finite.
    """

    joints_px: Floats
    confidence: Floats
    covariance_px2: Floats | None = None
    depths_px: Floats | None = None
    truncated: bool = False

    def __post_init__(self) -> None:
        n = LSP14.n_joints
        if self.joints_px.shape != (n, 2) or self.confidence.shape != (n,):
            raise ValueError(f"joints_px must be ({n}, 2) and confidence ({n},)")
        if not ((self.confidence >= 0) & (self.confidence <= 1)).all():
            raise ValueError("confidence must lie in [0, 1]")
        present = self.confidence > 0
        if not np.isfinite(self.joints_px[present]).all():
            raise ValueError("a joint of non-zero confidence is not finite")
        if self.covariance_px2 is not None:
            if self.covariance_px2.shape != (n, 2, 2):
                raise ValueError(f"covariance_px2 must be ({n}, 2, 2)")
            if not np.isfinite(self.covariance_px2[present]).all():
                raise ValueError("the covariance of a present joint is not finite")
        if self.depths_px is not None:
            if self.depths_px.shape != (n,):
                raise ValueError(f"depths_px must be ({n},)")
            if not np.isfinite(self.depths_px[present]).all():
                raise ValueError("the depth of a present joint is not finite")


@dataclass(frozen=True)
class Intrinsics:
    """A pinhole camera: focal length and principal point in pixels, and where the focal is from."""

    focal_length_px: float
    principal_point_px: tuple[float, float]
    source: FocalSource


@dataclass(frozen=True)
class Hypothesis:
    """One exemplar of the shortlist, placed in front of the camera by M* (eq. 5).

    ``probability`` is eq. 4 over the whole shortlist; ``distance`` the descriptor's;
    ``reprojection_error_px`` the RMS over observed joints, in pixels of the photo; ``joints_mm``
    (14, 3) = ``scale * (rotation @ exemplar) + translation_mm`` in the camera frame; ``scale`` is 1
    unless a subject height was given.
    """

    entry: int
    exemplar_id: str
    source: Source
    probability: float
    distance: float
    reprojection_error_px: float
    rotation: Floats
    translation_mm: Floats
    scale: float
    joints_mm: Floats


@dataclass(frozen=True)
class LiftedPerson:
    """A person in 3D.

    ``exemplar`` is candidate 0 and ``warped_mm`` (14, 3) its warp by eq. 6; ``candidates`` are the
    most probable first; ``joints_3d_mm`` (14, 3) the method's answer; ``sigma_mm`` (14,) the radius
    that holds 68% of root-relative errors, or None where it is not calibrated; ``noise_px`` the
    noise found in the 2D joints beyond what was stated of them, standard pixels, None for the
    paper's method; ``root_mm`` (3,) the hip midpoint of the answer.
    """

    exemplar: Hypothesis
    warped_mm: Floats
    candidates: tuple[Hypothesis, ...]
    joints_3d_mm: Floats
    sigma_mm: Floats | None
    noise_px: float | None
    root_mm: Floats
    scale_source: ScaleSource
    warnings: tuple[str, ...] = field(default=())


@dataclass(frozen=True)
class NotLiftable:
    """A person whose joints do not determine a pose: ``reason`` in words, and warnings."""

    reason: str
    warnings: tuple[str, ...] = field(default=())
