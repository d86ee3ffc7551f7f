"""What a rendered person wears: skin, face, hair, clothes, as colours of places on the body.

A place is described by coordinates that do not depend on pose or shape (``BodyMap``): how far down
an arm, how far up the body, where on the head. Garments are intervals of these coordinates, so that
their edges are sharp at every distance, and the face is on the front of the head only.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from models.training.rendering.body import BODY, EYES, HAIR, SKIRT, BodyModel, Floats
from models.training.rendering.raster import normals

ARM, HEIGHT, X, Y, Z, FRONT, HEAD, HAND = range(8)
"""Columns of a place: along the arm (0 shoulder, 1 elbow, 2 wrist; below 0 not an arm), up the
body (-2.3 sole, -2 ankle, -1 knee, 0 hip, 1 neck bone, 2 crown), rest position in m, the rest
normal's z, share of the head and of the hands."""

Image = NDArray[np.uint8]


class BodyMap:
    """Places of all vertices of the mesh, ``places`` (V, 8), and where the face is."""

    def __init__(self, model: BodyModel) -> None:
        base = model.base
        heads = {b: model.cube_center(base, c) for b, c in _MARKERS.items()}
        share = {
            part: sum(
                (model.weights[:, model.index(b)] for b in model.bones if b.startswith(names)),
                start=np.zeros(len(base), np.float32),
            )
            for part, names in _PARTS.items()
        }
        arm = np.full(len(base), -1.0, np.float32)
        for side, sign in (("r", -1), ("l", 1)):
            a, b, c = (heads[f"{j}_{side}"] for j in ("shoulder", "elbow", "wrist"))
            first = (base - a) @ (b - a) / ((b - a) @ (b - a))
            second = (base - b) @ (c - b) / ((c - b) @ (c - b))
            along = np.where(first < 1, first, 1 + np.maximum(second, 0))
            near = (share["arm"] + share["clavicle"] > 0.3) & (base[:, 0] * sign > 0)
            arm[near] = np.clip(along[near], -0.6, 3)
        y = base[:, 1]
        levels = [heads[k][1] for k in ("ankle_l", "knee_l", "hip_l", "neck")]
        body = np.unique(model.quads[model.kind == BODY])
        height = np.interp(y, [y[body].min(), *levels, y[body].max()], [-2.3, -2, -1, 0, 1, 2])
        on_arm = (arm > 0.05) & (share["arm"] > 0.5)
        height = np.where(on_arm, 0.8, height)
        normal = normals(base, model.quads)
        self.places = np.stack(
            [arm, height, *base.T, normal[:, 2], share["head"], share["hand"]], 1
        ).astype(np.float32)
        self.rest_normals = normal
        self.eyes = (heads["eye_l"] + heads["eye_r"]) / 2
        self.eye_x = float(heads["eye_l"][0])
        self.mouth_y = float(heads["mouth"][1])


_MARKERS = {
    f"{name}_{side}": f"joint-{side}-{cube}"
    for side in "rl"
    for name, cube in (
        ("shoulder", "shoulder"),
        ("elbow", "elbow"),
        ("wrist", "hand"),
        ("hip", "upper-leg"),
        ("knee", "knee"),
        ("ankle", "ankle"),
        ("eye", "eye"),
    )
} | {"neck": "joint-neck", "mouth": "joint-mouth"}

_PARTS: dict[str, tuple[str, ...]] = {
    "arm": ("upperarm", "lowerarm", "hand", "index", "middle", "ring", "pinky", "thumb"),
    "hand": ("hand", "index", "middle", "ring", "pinky", "thumb"),
    "clavicle": ("clavicle",),
    "head": ("head", "neck"),
}

_SKIN = np.array([[170, 192, 226], [142, 170, 212], [110, 142, 188], [72, 98, 140], [45, 60, 92]])
_HAIR = np.array([[20, 20, 24], [28, 36, 52], [40, 66, 100], [84, 140, 190], [150, 150, 155]])


def _palette(table: NDArray[np.int_], rng: np.random.Generator) -> Floats:
    """A colour between two neighbours of a row of colours, BGR 0..1."""
    at = (len(table) - 1) * rng.random() ** 1.5
    low = min(int(at), len(table) - 2)
    color = table[low] + (at - low) * (table[low + 1] - table[low])
    result: Floats = np.clip((color + rng.normal(0, 5, 3)) / 255, 0, 1).astype(np.float32)
    return result


def _cloth_color(rng: np.random.Generator) -> Floats:
    dice = rng.random()
    if dice < 0.25:
        base = np.full(3, rng.uniform(0.75, 0.97))
    elif dice < 0.42:
        base = np.full(3, rng.uniform(0.04, 0.2))
    elif dice < 0.55:
        base = np.full(3, rng.uniform(0.2, 0.7))
    else:
        hsv = np.array([[[rng.uniform(0, 180), rng.uniform(60, 255), rng.uniform(70, 250)]]])
        base = cv2.cvtColor(hsv.astype(np.uint8), cv2.COLOR_HSV2BGR)[0, 0] / 255
    result: Floats = np.clip(base + rng.normal(0, 0.03, 3), 0.01, 1).astype(np.float32)
    return result


@dataclass(frozen=True)
class Fabric:
    """A colour by place; ``kind`` plain, rings, stripes, checks, blotches or photo."""

    kind: str
    first: Floats
    second: Floats
    pitch_m: float
    phase: float
    photo: Image | None

    @classmethod
    def draw(cls, rng: np.random.Generator, photo: Image, plain: float = 0.55) -> Fabric:
        """A random fabric; ``photo`` lends its texture to some."""
        others = np.array([0.22, 0.13, 0.15, 0.2, 0.3])
        kind = rng.choice(
            ["plain", "rings", "stripes", "checks", "blotches", "photo"],
            p=[plain, *(others / others.sum() * (1 - plain))],
        )
        first, second = _cloth_color(rng), _cloth_color(rng)
        pitch = float(np.exp(rng.uniform(np.log(0.02), np.log(0.2))))
        return cls(str(kind), first, second, pitch, float(rng.uniform(0, 9)), photo)

    def at(self, place: Floats) -> Floats:
        """Colours (P, 3) at places (P, 8)."""
        u, v = place[:, X] / self.pitch_m + self.phase, place[:, Y] / self.pitch_m + self.phase
        if self.kind == "plain":
            return np.broadcast_to(self.first, (len(place), 3))
        if self.kind == "photo" and self.photo is not None:
            side = min(self.photo.shape[:2])
            back = np.where(place[:, FRONT] < 0, side * 0.37, 0)
            zoom = 60 + 200 * self.pitch_m / 0.2
            row = ((0.9 - place[:, Y]) * zoom + 7 * self.phase).astype(int) % self.photo.shape[0]
            column = ((place[:, X] + 1) * zoom + back).astype(int) % self.photo.shape[1]
            texture: Floats = self.photo[row, column].astype(np.float32) / 255
            return texture
        if self.kind == "rings":
            mix = np.sin(2 * np.pi * v) > 0.3
        elif self.kind == "stripes":
            mix = np.sin(2 * np.pi * u) > 0.5
        elif self.kind == "checks":
            mix = (np.sin(2 * np.pi * u) > 0) ^ (np.sin(2 * np.pi * v) > 0)
        else:
            mix = np.sin(5 * u + 3 * np.sin(2 * v)) + np.sin(4 * v + 2 * np.sin(3 * u)) > 0.6
        return np.where(mix[:, None], self.second, self.first)


@dataclass(frozen=True)
class Look:
    """One person's appearance; intervals are in the columns of a place."""

    skin: Floats
    hair: Floats
    iris: Floats
    shoe: Floats
    trim: Floats
    top: Fabric
    bottom: Fabric
    sleeve: float
    leg: float
    hem: float
    waist: float
    collar: float
    shoe_top: float
    hair_line: float
    hair_tilt: float
    hair_depth_m: float
    long_hair: bool
    hat: bool
    beard: float
    glasses: bool
    open_front: float
    side_stripe: bool
    gloves: bool
    loose_top_m: float
    loose_leg_m: float
    skirt: bool
    belt: bool

    @classmethod
    def draw(cls, rng: np.random.Generator, female: bool, photo: Image) -> Look:
        """A random look."""
        skirt = bool(rng.random() < (0.2 if female else 0.02))
        sleeve = float(
            rng.choice(
                [
                    rng.uniform(-0.05, 0.1),
                    rng.uniform(0.35, 0.8),
                    rng.uniform(0.8, 1.4),
                    rng.uniform(1.8, 2.05),
                ],
                p=[0.12, 0.42, 0.08, 0.38],
            )
        )
        leg = float(
            rng.choice(
                [
                    rng.uniform(-0.35, -0.1),
                    rng.uniform(-0.95, -0.4),
                    rng.uniform(-1.6, -1.0),
                    rng.uniform(-2.05, -1.85),
                ],
                p=[0.06, 0.22, 0.08, 0.64],
            )
        )
        bare = rng.random()
        hem = float(rng.uniform(-0.3, 0.25))
        if bare < 0.06:  # bare chest, or a crop top
            hem = 0.55 if female or rng.random() < 0.3 else 2.5
        top, bottom = Fabric.draw(rng, photo, 0.5), Fabric.draw(rng, photo, 0.75)
        if rng.random() < 0.12:
            bottom = top
        jeans = rng.random() < 0.25
        if jeans:
            blue = np.array([0.55, 0.38, 0.25]) * rng.uniform(0.4, 1.4)
            bottom = Fabric(
                "plain", np.clip(blue, 0, 1).astype(np.float32), bottom.second, 1, 0, None
            )
        return cls(
            skin=_palette(_SKIN, rng),
            hair=_palette(_HAIR, rng),
            iris=np.array([[0.15, 0.2, 0.3], [0.4, 0.3, 0.15]], np.float32)[rng.integers(2)],
            shoe=_cloth_color(rng),
            trim=_cloth_color(rng),
            top=top,
            bottom=bottom,
            sleeve=sleeve,
            leg=leg,
            hem=hem,
            waist=float(rng.uniform(0.1, 0.35)),
            collar=float(rng.uniform(0.72, 1.0)),
            shoe_top=float(rng.choice([-9.0, -2.02, -1.95, -1.6], p=[0.1, 0.5, 0.25, 0.15])),
            hair_line=float(rng.normal(0.012, 0.01)),
            hair_tilt=float(np.deg2rad(rng.uniform(35, 62))),
            hair_depth_m=float(rng.choice([0.0, rng.uniform(0.004, 0.03)], p=[0.12, 0.88])),
            long_hair=bool(rng.random() < (0.5 if female else 0.06)),
            hat=bool(rng.random() < 0.12),
            beard=float(rng.choice([0.0, rng.uniform(0.2, 0.9)], p=[0.7, 0.3]) * (not female)),
            glasses=bool(rng.random() < 0.1),
            open_front=float(rng.choice([0.0, rng.uniform(0.03, 0.08)], p=[0.8, 0.2])),
            side_stripe=bool(rng.random() < 0.15),
            gloves=bool(rng.random() < 0.06),
            loose_top_m=float(rng.choice([0.003, rng.uniform(0.008, 0.03)], p=[0.35, 0.65])),
            loose_leg_m=float(rng.choice([0.003, rng.uniform(0.008, 0.03)], p=[0.45, 0.55])),
            skirt=skirt,
            belt=bool(rng.random() < 0.2),
        )

    def kinds(self) -> set[int]:
        """Which surfaces this person shows."""
        shown = {BODY, EYES}
        if self.long_hair and not self.hat:
            shown.add(HAIR)
        if self.skirt:
            shown.add(SKIRT)
        return shown

    def _cover(self, place: Floats) -> tuple[NDArray[np.bool_], ...]:
        """Where the top, the bottom and the shoes are, three (P,) masks."""
        arm, height = place[:, ARM], place[:, HEIGHT]
        on_arm = arm > 0.0
        neckline = height < self.collar + 0.1 * np.abs(place[:, X]) / 0.1 * (self.collar < 0.85)
        trunk = ~on_arm & (height > self.hem) & neckline & (place[:, HEAD] < 0.6)
        trunk &= ~((arm > self.sleeve) & (self.sleeve < 0))
        top = trunk | (on_arm & (arm < self.sleeve) & (self.hem < 2))
        bottom = ~on_arm & (height < self.waist) & (height > self.leg) & ~top
        shoes = ~on_arm & (height < self.shoe_top)
        return top, bottom & ~shoes, shoes

    def _hairiness(self, body: BodyMap, place: Floats) -> Floats:
        """Above 0 where hair (or the hat) grows."""
        y, z = place[:, Y] - body.eyes[1], place[:, Z] - (body.eyes[2] - 0.09)
        tilt = np.pi / 18 if self.hat else self.hair_tilt
        score = y * np.cos(tilt) - z * np.sin(tilt) - (0.035 if self.hat else self.hair_line)
        on_head = (place[:, HEAD] > 0.6) & (y > -0.11)
        result: Floats = np.where(on_head, score, -1.0).astype(np.float32)
        return result

    def offsets(self, body: BodyMap, rng: np.random.Generator) -> Floats:
        """How far clothes and hair stand out along the normals, (V,) m."""
        place = body.places
        top, bottom, shoes = self._cover(place)
        folds = 0.5 + 0.5 * np.sin(
            place[:, Y] * rng.uniform(15, 50)
            + place[:, X] * rng.uniform(-40, 40)
            + rng.uniform(0, 6)
        )
        out = 0.004 * (top | bottom) + 0.008 * shoes
        out += self.loose_top_m * top * (0.4 + 0.6 * folds)
        out += self.loose_leg_m * bottom * (0.4 + 0.6 * folds)
        hair = np.clip(self._hairiness(body, place) / 0.02, 0, 1)
        out += hair * (0.012 if self.hat else self.hair_depth_m)
        result: Floats = out.astype(np.float32)
        return result

    def albedo(self, body: BodyMap, place: Floats, kind: NDArray[np.int8]) -> Floats:
        """Colours (P, 3) BGR 0..1 of places (P, 8) on surfaces of these kinds."""
        color = np.broadcast_to(self.skin, (len(place), 3)).copy()
        if self.gloves:
            color[place[:, HAND] > 0.5] = self.trim
        self._paint_face(body, place, color)
        hair = self._hairiness(body, place) > 0
        if self.hat:
            color[hair] = self.trim
        elif self.hair_depth_m > 0:
            color[hair] = self.hair
        top, bottom, shoes = self._cover(place)
        on_body = kind == BODY
        for mask, fabric in ((top & on_body, self.top), (bottom & on_body, self.bottom)):
            color[mask] = fabric.at(place[mask])
        if self.open_front:
            inner = top & (np.abs(place[:, X]) < self.open_front) & (place[:, FRONT] > 0.2)
            color[inner & on_body] = self.trim
        if self.side_stripe:
            outer = bottom & (np.abs(place[:, FRONT]) < 0.25) & (np.abs(place[:, X]) > 0.1)
            color[outer & on_body] = self.trim
        if self.belt:
            color[on_body & bottom & (place[:, HEIGHT] > self.waist - 0.06)] = self.trim
        color[shoes & on_body] = self.shoe
        color[kind == HAIR] = self.hair
        skirt = kind == SKIRT
        color[skirt] = self.bottom.at(place[skirt])
        eye = kind == EYES
        if eye.any():
            dx = np.abs(place[:, X]) - body.eye_x
            iris = np.hypot(dx, place[:, Y] - body.eyes[1]) < 0.0065
            color[eye] = np.where(iris[eye, None], self.iris * 0.5, np.float32(0.85))
        return color

    def _paint_face(self, body: BodyMap, place: Floats, color: Floats) -> None:
        x, y, z = np.abs(place[:, X]), place[:, Y], place[:, Z]
        face = (place[:, HEAD] > 0.6) & (place[:, FRONT] > 0.1) & (z > body.eyes[2] - 0.06)
        eye_y = y - body.eyes[1]
        if self.beard:
            jaw = (place[:, HEAD] > 0.6) & (y < body.mouth_y + 0.022) & (z > body.eyes[2] - 0.09)
            jaw &= eye_y > -0.14
            color[jaw] = (1 - self.beard) * color[jaw] + self.beard * self.hair
        brow = face & (np.abs(eye_y - 0.02) < 0.0055) & (x > 0.012) & (x < 0.052)
        color[brow] = 0.25 * color[brow] + 0.75 * self.hair
        socket = face & (np.hypot(x - body.eye_x, 1.6 * eye_y) < 0.018)
        color[socket] *= 0.72
        nose = face & (x > 0.004) & (x < 0.014) & (np.abs(y - body.mouth_y - 0.03) < 0.004)
        color[nose] *= 0.6
        lips = face & (x < 0.026) & (np.abs(y - body.mouth_y) < 0.010 - 0.1 * x)
        color[lips] = color[lips] * np.array([0.62, 0.58, 0.88], np.float32)
        color[lips & (np.abs(y - body.mouth_y) < 0.002)] *= 0.45
        if self.glasses:
            color[face & (np.abs(eye_y) < 0.014) & (x < 0.06)] *= 0.2
