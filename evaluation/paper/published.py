"""What the paper's tables say, in mm; printed beside whatever is measured here.

Chen & Ramanan, "3D Human Pose Estimation = 2D Pose Estimation + Matching", CVPR 2017.
"""

from __future__ import annotations

from dataclasses import dataclass

ACTIONS = (
    *("Direction", "Discuss", "Eat", "Greet", "Phone", "Pose", "Purchase", "Sit", "SitDown"),
    *("Smoke", "Photo", "Wait", "Walk", "WalkDog", "WalkPair"),
)
"""Human3.6M's actions, by the names and in the order of the paper's columns."""

HUMANEVA_ACTIONS = ("Walk", "Jog", "ThrowCatch", "Gestures", "Box")


@dataclass(frozen=True)
class Row:
    """A row of a table: per action (the table's order; empty where not published), mean, median."""

    label: str
    actions: tuple[float, ...] = ()
    mean: float | None = None
    median: float | None = None


def _row(label: str, actions: str = "", mean: float = 0.0, median: float = 0.0) -> Row:
    return Row(label, tuple(float(n) for n in actions.split()), mean or None, median or None)


P1 = (
    _row(
        "Yasin 2016",
        "88.4 72.5 108.5 110.2 97.1 81.6 107.2 119.0 170.8 108.2 142.5 86.9 92.1 165.7 102.0",
        108.3,
    ),
    _row("Rogez 2016", "", 88.1),
    _row(
        "paper",
        "71.63 66.60 74.74 79.09 70.05 67.56 89.30 90.74 195.62 83.46 93.26 71.15 55.74 85.86 "
        "62.51",
        82.72,
        69.05,
    ),
)
"""Table 1: Protocol 1, 2D from the photo."""

P1_GT = (
    _row(
        "Yasin 2016",
        "60.0 54.7 71.6 67.5 63.8 61.9 55.7 73.9 110.8 78.9 96.9 67.9 47.5 89.3 53.4",
        70.5,
    ),
    _row(
        "paper",
        "53.27 46.75 58.63 61.21 55.98 58.13 48.85 55.60 73.41 60.25 76.05 62.19 35.76 61.93 51.08",
        57.50,
        51.93,
    ),
)
"""Table 2: Protocol 1, true 2D."""


@dataclass(frozen=True)
class SizeRow:
    """Table 3: mean by the sizes of the 2D and the 3D source, in thousands."""

    label: str
    thousands_2d: int
    thousands_3d: int
    mean: float


SIZES = (
    SizeRow("Yasin 2016", 64_000, 380, 108.3),
    SizeRow("Rogez 2016", 207, 190, 88.1),
    SizeRow("paper", 18, 18, 85.94),
    SizeRow("paper", 180, 180, 82.37),
    SizeRow("paper", 1_800, 1_800, 82.72),
)

P2 = (
    _row(
        "Zhou 2016",
        "87.36 109.31 87.05 103.16 116.18 106.88 99.78 124.52 199.23 107.42 139.46 118.09 79.39 "
        "114.23 97.70",
        113.01,
    ),
    _row(
        "Tekin 2016",
        "102.41 147.72 88.83 125.38 118.02 112.38 129.17 138.89 224.9 118.42 182.73 138.75 55.07 "
        "126.29 65.76",
        124.97,
    ),
    _row(
        "paper",
        "89.87 97.57 89.98 107.87 107.31 93.56 136.09 133.14 240.12 106.65 139.17 106.21 87.03 "
        "114.05 90.55",
        114.18,
        93.05,
    ),
)
"""Table 4: Protocol 2."""

DIAGNOSTIC = (
    _row("Ramakrishna 2012, several frames", "", 89.50),
    _row("Dai 2014, several frames", "", 72.98),
    _row("Zhou 2016", "", 50.04),
    _row("Zhou 2016, several frames", "", 49.64),
    _row("paper, X* k=1", "", 51.06),
    _row("paper, X* k=10", "", 49.55),
)
"""Table 5: similarity alignment, first 30 seconds, first camera, true 2D."""

PREDICTED = (
    _row("X given x", "", 85.52, 75.04),
    _row("X* given x", "", 82.72, 69.05),
    _row("[s x, Z_GT]", "", 43.86, 30.19),
)
"""Table 6: Protocol 1, 2D from the photo."""

TRUE_2D = (_row("X given gt", "", 70.93, 65.35), _row("X* given gt", "", 57.50, 51.93))
"""Table 7: Protocol 1, true 2D."""

OPTIMAL = (_row("X given GT", "", 60.11, 55.36), _row("X* given GT", "", 37.32, 33.91))
"""Table 8: Protocol 1, the exemplar that is nearest in 3D."""

HUMANEVA = (
    _row("X* (warped)", "64.46 69.88 59.99 67.89 79.22", 68.29),
    _row("X (unwarped)", "90.17 95.27 82.74 88.82 103.85", 92.17),
)
"""Table 9: HumanEva-I by a library of Human3.6M, Protocol 1, true 2D; means of the actions'."""

PLATEAUS = {"x": 2e5, "gt": 5e5}
"""Figures 7 and 8: library sizes beyond which the error no longer falls."""
