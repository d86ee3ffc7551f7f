"""Parts of poses that motion capture hardly has, composed from what bodies do.

Photographs show people on chairs and on the floor, with a hand at the ear, the mouth or the hip;
motion-capture studios have none of it. Legs that sit, kneel or squat are drawn from angles about
the seat; arms reach for places on the body by the geometry of two bones (the elbow swings about the
line from shoulder to wrist). Both come out as parts in the frames of :mod:`library_store.anatomy`,
to be put together with captured ones.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from library_store.anatomy import LENGTHS, Float, unit

_SIDES = np.array([-1.0, 1.0])  # right, left: the sign of x


@dataclass(frozen=True)
class _Seat:
    """Legs of one way to sit: means and spreads in degrees, each leg's own spread beside.

    ``raise_``: thighs above the horizontal; ``apart``: away from straight ahead; ``forward``:
    shanks from straight down towards the front; ``inward``: shanks towards the other leg.
    """

    weight: float
    raise_: tuple[float, float]
    apart: tuple[float, float]
    forward: tuple[float, float]
    inward: tuple[float, float] = (0.0, 8.0)


_SEATS = (
    _Seat(0.62, (-3.0, 9.0), (8.0, 8.0), (5.0, 18.0)),  # on a chair
    _Seat(0.08, (-25.0, 8.0), (10.0, 8.0), (-5.0, 12.0)),  # on a high stool
    _Seat(0.08, (10.0, 8.0), (55.0, 9.0), (0.0, 10.0), (80.0, 8.0)),  # cross-legged on the floor
    _Seat(0.08, (4.0, 7.0), (8.0, 9.0), (78.0, 9.0)),  # on the floor, legs stretched out
    _Seat(0.06, (-82.0, 10.0), (4.0, 8.0), (-80.0, 10.0)),  # kneeling
    _Seat(0.08, (18.0, 12.0), (18.0, 10.0), (-18.0, 12.0)),  # squatting
)
_LEG_OVER_LEG = 0.2
"""Share of the people on chairs with one leg over the other."""


@dataclass(frozen=True)
class _Reach:
    """A place for a wrist: mm from the neck in the chest frame of an average adult's left arm
    (mirrored for the right), where the elbow points, and how often both arms go there.
    """  # noqa: D205

    weight: float
    place_mm: tuple[float, float, float]
    elbow: tuple[float, float, float]
    both: float


_REACHES = (
    _Reach(0.18, (125.0, 90.0, 70.0), (0.7, -1.0, 0.2), 0.03),  # phone at the ear
    _Reach(0.20, (75.0, 20.0, 165.0), (0.8, -1.0, 0.0), 0.1),  # eating, drinking, smoking
    _Reach(0.08, (85.0, 90.0, 185.0), (0.7, -1.0, 0.1), 0.7),  # camera at the eye
    _Reach(0.14, (95.0, -190.0, 280.0), (0.6, -1.0, -0.4), 0.6),  # something held before the chest
    _Reach(0.14, (175.0, -470.0, 20.0), (1.0, 0.0, -0.5), 0.5),  # hand on the hip
    _Reach(0.10, (120.0, -430.0, 230.0), (0.7, -0.4, -0.8), 0.7),  # hands in the lap
    _Reach(0.08, (-110.0, -220.0, 130.0), (0.8, -1.0, 0.0), 1.0),  # arms crossed
    _Reach(0.04, (70.0, 130.0, -60.0), (1.0, 0.3, 0.2), 0.5),  # behind the head
    _Reach(0.04, (40.0, -420.0, -140.0), (1.0, -0.2, -0.6), 0.8),  # behind the back
)
_PLACE_SD_MM, _ELBOW_SD, _AVERAGE_TRUNK_MM = 35.0, 0.35, 540.0


def sitting_legs(n: int, rng: np.random.Generator) -> Float:
    """Legs (n, 15) of people who sit, kneel or squat, with their orientation."""
    table = np.array([(*s.raise_, *s.apart, *s.forward, *s.inward) for s in _SEATS])
    seat = rng.choice(len(_SEATS), size=n, p=_shares([s.weight for s in _SEATS]))
    means, spreads = table[seat, 0::2], table[seat, 1::2]
    # Half of the variance is common to both legs.
    shared, own = rng.standard_normal((n, 1, 4)), rng.standard_normal((n, 2, 4))
    angles = means[:, None] + spreads[:, None] * np.sqrt(0.5) * (shared + own)
    over = np.flatnonzero((seat == 0) & (rng.random(n) < _LEG_OVER_LEG))
    upper_leg = rng.integers(2, size=len(over))
    angles[over, upper_leg] += rng.normal((14.0, -20.0, 25.0, 15.0), 5.0, (len(over), 4))

    # The trunk is the pelvis frame's y; it leans back by a few degrees or forwards by more.
    recline = np.where(rng.random(n) < 0.75, rng.normal(8.0, 13.0, n), rng.normal(-28.0, 12.0, n))
    recline, roll = np.radians(recline), np.radians(rng.normal(0.0, 5.0, n))
    up = unit(np.stack([np.sin(roll), np.cos(recline), np.sin(recline)], axis=-1))
    left = unit(np.array([1.0, 0.0, 0.0]) - up[:, :1] * up)
    ahead = np.cross(left, up)

    lift, apart, forward, inward = np.moveaxis(np.radians(angles), -1, 0)[..., None]
    side = _SIDES[:, None] * left[:, None]
    outwards = np.cos(apart) * ahead[:, None] + np.sin(apart) * side
    thigh = np.cos(lift) * outwards + np.sin(lift) * up[:, None]
    hanging = np.sin(forward) * outwards - np.cos(forward) * up[:, None]
    shank = np.cos(inward) * hanging - np.sin(inward) * side
    legs: Float = np.concatenate([thigh, unit(shank)], axis=-1).reshape(n, 12)
    return np.concatenate([legs, up], axis=-1)


def reaching_arms(upper: Float, lengths_mm: Float, rng: np.random.Generator) -> Float:
    """Upper bodies (n, 23), of people of lengths (n, 8), with one arm or both put to a place.

    The trunk, the shoulders and the head stay, and so does the arm that is not used.
    """
    n = len(upper)
    reach = rng.choice(len(_REACHES), size=n, p=_shares([r.weight for r in _REACHES]))
    place = np.array([r.place_mm for r in _REACHES])[reach]
    elbow = np.array([r.elbow for r in _REACHES])[reach]
    both = rng.random(n) < np.array([r.both for r in _REACHES])[reach]
    used = rng.integers(2, size=n)
    shoulder, upper_arm, forearm, trunk = (
        lengths_mm[:, LENGTHS.index(name), None]
        for name in ("shoulder", "upper_arm", "forearm", "trunk")
    )
    reaching = upper.copy()
    for arm, (shoulder_at, arm_at) in enumerate((([3, 4, 7], 8), ([5, 6, 7], 14))):
        mirror = np.array([_SIDES[arm], 1.0, 1.0])
        noise = rng.normal(0.0, _PLACE_SD_MM, (n, 3))
        wrist = (mirror * place + noise) * trunk / _AVERAGE_TRUNK_MM
        pole = mirror * elbow + rng.normal(0.0, _ELBOW_SD, (n, 3))
        bones = two_bones(wrist - shoulder * upper[:, shoulder_at], upper_arm, forearm, pole)
        chosen = both | (used == arm)
        reaching[chosen, arm_at : arm_at + 6] = bones[chosen]
    return reaching


def two_bones(target: Float, first: Float, second: Float, pole: Float) -> Float:
    """Unit directions (n, 6) of two bones of lengths (n, 1) that reach from the origin to a target.

    The joint between them swings towards ``pole`` (n, 3). A target (n, 3) out of reach is moved
    along its direction to where the bones are nearly straight, or nearly folded.
    """
    along = unit(target)
    least, most = np.abs(first - second) + 0.25 * np.minimum(first, second), 0.99 * (first + second)
    distance = np.clip(np.linalg.norm(target, axis=-1, keepdims=True), least, most)
    foot = (first**2 - second**2 + distance**2) / (2.0 * distance)
    off = np.sqrt(np.maximum(first**2 - foot**2, 0.0))
    swing = unit(pole - (pole * along).sum(-1, keepdims=True) * along)
    joint = foot * along + off * swing
    return np.concatenate([unit(joint), unit(distance * along - joint)], axis=-1)


def _shares(weights: list[float]) -> Float:
    shares: Float = np.array(weights) / sum(weights)
    return shares
