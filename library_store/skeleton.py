"""Skeletons as data: joint names, left/right pairs and edges.

``LSP14`` is the skeleton every stage of the service speaks: the CPM's heatmaps, the library's
poses and the JSON all list its fourteen joints in this order. Left and right are the person's own.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Skeleton:
    """A named, ordered set of joints.

    ``edges`` are bones as (parent, child) joint indices; ``mirror[j]`` is the joint that ``j``
    becomes when the person is seen in a mirror.
    """

    name: str
    joint_names: tuple[str, ...]
    edges: tuple[tuple[int, int], ...]
    mirror: tuple[int, ...]

    @property
    def n_joints(self) -> int:
        """How many joints the skeleton has."""
        return len(self.joint_names)

    def index(self, name: str) -> int:
        """Position of the joint called ``name``; ``ValueError`` when there is none."""
        return self.joint_names.index(name)


HEAD_TOP, NECK = 0, 1
R_SHOULDER, R_ELBOW, R_WRIST = 2, 3, 4
L_SHOULDER, L_ELBOW, L_WRIST = 5, 6, 7
R_HIP, R_KNEE, R_ANKLE = 8, 9, 10
L_HIP, L_KNEE, L_ANKLE = 11, 12, 13

LSP14 = Skeleton(
    name="lsp14",
    joint_names=(
        "head_top",
        "neck",
        "r_shoulder",
        "r_elbow",
        "r_wrist",
        "l_shoulder",
        "l_elbow",
        "l_wrist",
        "r_hip",
        "r_knee",
        "r_ankle",
        "l_hip",
        "l_knee",
        "l_ankle",
    ),
    edges=(
        (NECK, HEAD_TOP),
        (NECK, R_SHOULDER),
        (R_SHOULDER, R_ELBOW),
        (R_ELBOW, R_WRIST),
        (NECK, L_SHOULDER),
        (L_SHOULDER, L_ELBOW),
        (L_ELBOW, L_WRIST),
        (NECK, R_HIP),
        (R_HIP, R_KNEE),
        (R_KNEE, R_ANKLE),
        (NECK, L_HIP),
        (L_HIP, L_KNEE),
        (L_KNEE, L_ANKLE),
    ),
    mirror=(0, 1, 5, 6, 7, 2, 3, 4, 11, 12, 13, 8, 9, 10),
)

LIMB_JOINTS: tuple[int, ...] = tuple(range(2, 14))
"""The twelve joints every reference network has too (no head top, no neck)."""
