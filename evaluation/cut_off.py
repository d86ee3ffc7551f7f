"""People whom the photo's edge cuts off: answered, and which of their joints are right.

    python -m evaluation.cut_off --renders TAR | --data DIR [--people 150]

``--renders`` is a set of ``models.training.rendered``, ``--data`` has ``photos_*.tar``, of which
the held-out ones are taken. Of the first so many people who stand, or sit, upright in their
picture, the photo is made to end below their feet, at their knees, thighs, hips or waist, and
answered as the service answers photos. A joint that is still there is right within a fifth of the
trunk's length; those of nobody who is answered are not. PA is of the joints that are there and have
been lifted, where the truth in 3D is known.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from app.engine import load_engine
from app.lifting.types import LiftedPerson
from app.pipeline import PhotoQuery, Pipeline
from app.settings import load_settings
from evaluation.metrics import Floats, similarity_error_mm
from evaluation.pose2d import held_out_photos
from evaluation.progress import followed
from library_store.arguments import integer
from library_store.skeleton import (
    L_ANKLE,
    L_HIP,
    L_KNEE,
    L_SHOULDER,
    NECK,
    R_ANKLE,
    R_HIP,
    R_KNEE,
    R_SHOULDER,
)
from library_store.upright import MOST_LEAN, lean_rad
from models.pck import correct_keypoints
from models.training.dataset import Image, decode_members, read_annotations

ENLARGED = 3
"""Rendered crops are 192 px: as large as somebody in a photo."""
LEAST_JOINTS = 4
_PAIRS = ((R_HIP, L_HIP), (R_KNEE, L_KNEE), (R_ANKLE, L_ANKLE))


@dataclass(frozen=True)
class Standing:
    """Somebody upright: (h, w, 3) uint8 BGR, (14, 2) px, which of these are ``known`` (14,).

    Of rendered people also (14, 3) mm, and the focal length in px.
    """

    image: Image
    joints_px: Floats
    known: NDArray[np.bool_]
    joints_mm: Floats | None = None
    focal_length_px: float | None = None

    @property
    def upright(self) -> bool:
        """Known from neck to ankles, knees below the hips and ankles below the knees."""
        needed = [NECK, R_SHOULDER, L_SHOULDER, *(joint for pair in _PAIRS for joint in pair)]
        y = self.joints_px[:, 1]
        levels = [y[NECK], *(y[list(pair)].mean() for pair in _PAIRS)]
        stands = abs(lean_rad(self.joints_px)) < MOST_LEAN and (np.diff(levels) > 0).all()
        return bool(self.known[needed].all() and stands)

    @property
    def ends(self) -> dict[str, float]:
        """Rows at which the photo ends, by what they lie at."""
        y = self.joints_px[:, 1]
        hips, knees = y[[R_HIP, L_HIP]].mean(), y[[R_KNEE, L_KNEE]].mean()
        return {
            "below the feet": len(self.image),
            "the knees": knees,
            "the thighs": 0.5 * (hips + knees),
            "the hips": hips,
            "the waist": 0.4 * y[NECK] + 0.6 * hips,
        }


@dataclass
class Tally:
    """Of one row: who was answered, joints right (a list a person), PA in mm of the lifted."""

    answered: list[bool] = field(default_factory=list)
    right: list[Floats] = field(default_factory=list)
    pa_mm: list[float] = field(default_factory=list)

    def row(self, label: str) -> str:
        """A line of the table."""
        if not self.answered:
            return f"| {label} | 0 | - | - | - |"
        error = f"{np.mean(self.pa_mm):.0f}" if self.pa_mm else "-"
        return (
            f"| {label} | {len(self.answered)} | {np.mean(self.answered):.1%} "
            f"| {np.concatenate(self.right).mean():.1%} | {error} |"
        )


def rendered(path: Path) -> Iterator[Standing]:
    """The people of a rendered set."""
    images = decode_members(path)
    for record in read_annotations(path):
        joints = np.array(record["joints_px"])
        known = np.ones(len(joints), np.bool_)
        truth_mm = np.array(record["joints_mm"])
        focal_length_px = float(record["focal_length_px"])
        yield Standing(images[record["image"]], joints, known, truth_mm, focal_length_px)


def photographed(data: Path) -> Iterator[Standing]:
    """The people of the held-out photos, each crop a photo of its own."""
    for crop in held_out_photos(data):
        yield Standing(crop.image, crop.joints_px.astype(np.float64), crop.weight > 0)


def look(pipeline: Pipeline, person: Standing, end: float, tally: Tally) -> None:
    """Add the answer to the photo of ``person`` that ends at row ``end``."""
    photo = person.image[: int(end)]
    there = person.known & (person.joints_px[:, 1] < len(photo) - 1)
    if there.sum() < LEAST_JOINTS:
        return
    photo = np.asarray(cv2.resize(photo, None, fx=ENLARGED, fy=ENLARGED), np.uint8)
    truth_px = (person.joints_px + 0.5) * ENLARGED - 0.5
    focal_length_px = person.focal_length_px and ENLARGED * person.focal_length_px
    query = PhotoQuery(max_people=1, focal_length_px=focal_length_px)
    people = pipeline.estimate(cv2.imencode(".png", photo)[1].tobytes(), query).people
    tally.answered.append(bool(people))
    if not people:
        tally.right.append(np.zeros(int(there.sum())))
        return
    right = correct_keypoints(people[0].joints_px[None], truth_px[None])[0]
    tally.right.append(right[there].astype(np.float64))
    lifted = people[0].lifted
    if isinstance(lifted, LiftedPerson) and person.joints_mm is not None:
        found = lifted.joints_3d_mm[there]
        tally.pa_mm.append(float(similarity_error_mm(found, person.joints_mm[there]).mean()))


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line: see the module."""
    parser = argparse.ArgumentParser(prog="evaluation.cut_off", description=__doc__)
    of = parser.add_mutually_exclusive_group(required=True)
    of.add_argument("--renders", type=Path, help="tar of models.training.rendered")
    of.add_argument("--data", type=Path, help="folder with photos_*.tar")
    parser.add_argument("--people", type=integer(1), default=150)
    chosen = parser.parse_args(arguments)
    everybody = rendered(chosen.renders) if chosen.renders else photographed(chosen.data)
    people = list(islice((person for person in everybody if person.upright), chosen.people))
    if not people:
        raise SystemExit(f"{chosen.renders or chosen.data}: nobody stands upright")
    engine = load_engine(load_settings())
    tallies: dict[str, Tally] = {}
    for person in followed(people, "cut off"):
        for label, end in person.ends.items():
            look(engine.pipeline, person, end, tallies.setdefault(label, Tally()))
    print("| the photo ends at | people | answered | joints that are there, right | PA mm |")
    print("|---|---|---|---|---|")
    for label, tally in tallies.items():
        print(tally.row(label))


if __name__ == "__main__":
    main()
