"""What the learned lifter is taught: people of a pose prior, seen by cameras and badly located.

Half of the people have other proportions than the prior's, and joints in slightly other places, as
other skeletons define them: bodies it will meet are not those of any mocap. Joints are noisy (in a
quarter of the samples not at all, in others each as much as it likes), one may be elsewhere, some
may be missing. What pose networks mistake, lifter_mistakes.py adds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from library_store.cameras import rotations, sample_cameras
from library_store.proportions import resize
from library_store.skeleton import L_HIP, LIMB_JOINTS, LSP14, R_HIP
from library_store.upright import rotations_by, turn_rad

Floats = NDArray[np.float32]

N = LSP14.n_joints
OTHER_BUILD, LENGTH_SD, PLACE_SD_MM = 0.5, 0.1, 10.0
"""Share of people of another build; spread of their log lengths and of their joints' places."""
NO_NOISE, MAX_NOISE_MM = 0.25, 64.0
UNEVEN, UNEVEN_SD = 0.4, 0.5
"""Share of samples whose joints are not equally noisy, and by how much, as a logarithm."""
ELSEWHERE, NEAREST_MM, FARTHEST_MM = 0.12, 80.0, 550.0
"""Share of samples with a limb joint that is elsewhere, and how far at the person's distance."""
IN_MIRROR = np.array([-1.0, 1.0, 1.0], np.float32)
INCOMPLETE, MOST_MISSING, LIMB_MISSING = 0.15, 4, 0.75
CUT_OFF, FEWEST_BEYOND, MOST_BEYOND = 0.15, 2, 8
"""Share of people whom the photo's edge cuts off, and how many joints lie beyond it."""
EDGE_ANYWHERE, EDGE_TURN_SD = 0.2, 0.3
"""Share of these edges that are not the lower one; how far that is turned, in radians."""


@dataclass(frozen=True)
class Samples:
    """2D in, 3D out, in the view of a camera turned onto the joints that are there.

    ``points`` (n, 14, 2) normalised image coordinates, 0 where missing; ``present`` (n, 14);
    ``doubt`` (n, 14) how probably a present joint is elsewhere, as a pose network would say;
    ``hint`` (n, 14) what it read off the picture of ``depths``, 0 where it said nothing, and
    ``known`` (n, 14) where it did; ``truth`` (n, 14, 2) where they really are; ``depths`` (n, 14)
    relative to the hip midpoint's, ``z / z_root - 1``; ``root_mm`` (n,) its depth.
    """

    points: Floats
    present: Floats
    doubt: Floats
    hint: Floats
    known: Floats
    truth: Floats
    depths: Floats
    root_mm: Floats

    def taken(self, rows: NDArray[np.int64]) -> Samples:
        """Those of these rows, in their order."""
        return Samples(*(column[rows] for column in vars(self).values()))


def draw(poses_mm: Floats, n: int, rng: np.random.Generator) -> Samples:
    """``n`` samples of root-centred poses (P, 14, 3), Y up."""
    seen = seen_people(poses_mm, n, rng)
    root = _root_depth(seen)
    points = seen[..., :2] / seen[..., 2:]
    points = points + _noise_mm(n, rng) / root[:, None, None]
    present = _present(n, rng) * _within(points, rng)
    return samples_of(points, present, np.zeros_like(present), seen)


def samples_of(points: Floats, present: Floats, doubt: Floats, joints_mm: Floats) -> Samples:
    """Samples of people (n, 14, 3) mm before the camera, whose joints were seen at ``points``.

    Of their depths the picture said nothing.
    """
    turn, rays = _onto_axis(points, present)
    turned, truth = rays @ turn, joints_mm @ turn
    return Samples(
        points=turned[..., :2] / turned[..., 2:] * present[..., None],
        present=present,
        doubt=doubt * present,
        hint=np.zeros_like(present),
        known=np.zeros_like(present),
        truth=truth[..., :2] / truth[..., 2:],
        depths=relative_depths(truth),
        root_mm=_root_depth(truth),
    )


def in_mirror(samples: Samples) -> Samples:
    """What is seen of the same people in a mirror; their truth stays."""
    order = list(LSP14.mirror)
    return replace(
        samples,
        points=(samples.points * IN_MIRROR[:2])[:, order],
        present=samples.present[:, order],
        doubt=samples.doubt[:, order],
        hint=samples.hint[:, order],
        known=samples.known[:, order],
    )


def joined(parts: Sequence[Samples]) -> Samples:
    """All samples of all parts, in order."""
    columns = zip(*(vars(part).values() for part in parts), strict=True)
    return Samples(*(np.concatenate(column) for column in columns))


def relative_depths(joints_mm: Floats) -> Floats:
    """Of people (n, 14, 3) before the camera, (n, 14): about the hip midpoint's, in its units."""
    depths: Floats = joints_mm[..., 2] / _root_depth(joints_mm)[:, None] - 1.0
    return depths


def seen_people(poses_mm: Floats, n: int, rng: np.random.Generator) -> Floats:
    """``n`` people of various builds (n, 14, 3) in poses (P, 14, 3), before a camera each, mm."""
    return _seen(_people(poses_mm, n, rng), n, rng)


def _people(poses_mm: Floats, n: int, rng: np.random.Generator) -> Floats:
    poses = poses_mm[rng.integers(len(poses_mm), size=n)].astype(np.float32)
    others = np.flatnonzero(rng.random(n) < OTHER_BUILD)
    factors = np.exp(rng.normal(0.0, LENGTH_SD, (len(others), 8)))
    poses[others] = resize(poses[others].astype(np.float64), factors)
    poses[others] += rng.normal(0.0, PLACE_SD_MM, (len(others), N, 3))
    flip = np.flatnonzero(rng.random(n) < 0.5)
    poses[flip] = (poses[flip] * IN_MIRROR)[:, list(LSP14.mirror)]
    return poses


def _seen(poses: Floats, n: int, rng: np.random.Generator) -> Floats:
    """Poses in front of cameras that look at their middle, camera axes."""
    cameras = sample_cameras(n, rng)
    seen = poses @ rotations(cameras).astype(np.float32).swapaxes(1, 2)
    seen -= seen.mean(1, keepdims=True)
    seen[..., 2] += cameras[:, 3, None]
    return seen


def _noise_mm(n: int, rng: np.random.Generator) -> Floats:
    """Displacements (n, 14, 2) at the person's distance."""
    level = rng.uniform(0.0, MAX_NOISE_MM, (n, 1)) * (rng.random((n, 1)) >= NO_NOISE)
    uneven = np.exp(rng.normal(0.0, UNEVEN_SD, (n, N)))
    sigma = level * np.where(rng.random((n, 1)) < UNEVEN, uneven, 1.0)
    noise = sigma[..., None].astype(np.float32) * rng.standard_normal((n, N, 2), np.float32)
    astray = np.flatnonzero(rng.random(n) < ELSEWHERE)
    angle = rng.uniform(0.0, 2.0 * np.pi, len(astray))
    distance = rng.uniform(NEAREST_MM, FARTHEST_MM, len(astray))
    joint = rng.choice(LIMB_JOINTS, len(astray))
    noise[astray, joint] += distance[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1)
    return noise


def _present(n: int, rng: np.random.Generator) -> Floats:
    present = np.ones((n, N), np.float32)
    incomplete = np.flatnonzero(rng.random(n) < INCOMPLETE)
    missing = rng.integers(1, MOST_MISSING + 1, len(incomplete))
    for number in range(MOST_MISSING):
        rows = incomplete[missing > number]
        limbs, any_joint = rng.choice(LIMB_JOINTS, len(rows)), rng.integers(N, size=len(rows))
        present[rows, np.where(rng.random(len(rows)) < LIMB_MISSING, limbs, any_joint)] = 0.0
    return present


def _within(points: Floats, rng: np.random.Generator) -> Floats:
    """Which joints of ``points`` (n, 14, 2) the photo's edge leaves, (n, 14): most often all."""
    n = len(points)
    within = np.ones((n, N), np.float32)
    cut = np.flatnonzero(rng.random(n) < CUT_OFF)
    anywhere = rng.random(len(cut)) < EDGE_ANYWHERE
    turn = np.where(
        anywhere,
        rng.uniform(-np.pi, np.pi, len(cut)),
        rng.normal(0.0, EDGE_TURN_SD, len(cut)),
    )
    outwards = np.stack([np.sin(turn), np.cos(turn)], 1)  # y is down
    order = np.argsort(-np.einsum("njc,nc->nj", points[cut], outwards), axis=1)
    beyond = rng.integers(FEWEST_BEYOND, MOST_BEYOND + 1, len(cut))
    rows, ranks = np.nonzero(np.arange(N) < beyond[:, None])
    within[cut[rows], order[rows, ranks]] = 0.0
    return within


def _onto_axis(points: Floats, present: Floats) -> tuple[Floats, Floats]:
    """The camera turned onto the joints that are there, and upright: rotations (n, 3, 3); the rays.

    A ray or point v becomes v @ rotation; what the service does before it lifts anybody.
    """
    rays = np.concatenate([points, np.ones((*points.shape[:2], 1), np.float32)], 2)
    units = rays / np.linalg.norm(rays, axis=2, keepdims=True)
    middle = (present[..., None] * units).sum(1)
    x, y, z = (middle / np.linalg.norm(middle, axis=1, keepdims=True)).T
    s = 1.0 / (1.0 + z)
    rows = [1 - s * x * x, -s * x * y, x, -s * x * y, 1 - s * y * y, y, -x, -y, z]
    onto_axis = np.stack(rows, 1).reshape(-1, 3, 3)
    turned = rays @ onto_axis
    turn = turn_rad(turned[..., :2] / turned[..., 2:], present > 0)
    rotation: Floats = (onto_axis @ rotations_by(turn).swapaxes(1, 2)).astype(np.float32)
    return rotation, rays


def _root_depth(joints: Floats) -> Floats:
    depth: Floats = 0.5 * (joints[:, R_HIP, 2] + joints[:, L_HIP, 2])
    return depth
