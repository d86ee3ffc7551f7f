"""People whom the photo's edge cuts off: answered, and which of their joints are right.

    python -m evaluation.cut_off --renders TAR [--people 150]

``--renders`` is a set of ``models.training.rendered``. Of the first so many people who stand, or
sit, upright in their picture, the photo is made to end below their feet, at their knees, thighs,
hips or waist, and answered as the service answers photos. A joint that is still there is right
within a fifth of the trunk's length; those of nobody who is answered are not. PA is of the joints
that are there and have been lifted.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from app.engine import load_engine
from app.lifting.types import LiftedPerson
from app.pipeline import PhotoQuery, Pipeline
from app.settings import load_settings
from evaluation.metrics import Floats, similarity_error_mm
from evaluation.progress import followed
from library_store.skeleton import L_ANKLE, L_HIP, L_KNEE, NECK, R_ANKLE, R_HIP, R_KNEE
from library_store.upright import MOST_LEAN, lean_rad
from models.pck import correct_keypoints
from models.training.dataset import Image, decode_members, read_annotations

ENLARGED = 3
"""Rendered crops are 192 px: as large as somebody in a photo."""
LEAST_JOINTS = 4
_PAIRS = ((R_HIP, L_HIP), (R_KNEE, L_KNEE), (R_ANKLE, L_ANKLE))


@dataclass(frozen=True)
class Standing:
    """Somebody upright: (h, w, 3) uint8 BGR, (14, 2) px, (14, 3) mm, focal length in px."""

    image: Image
    joints_px: Floats
    joints_mm: Floats
    focal_length_px: float

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
        return (
            f"| {label} | {len(self.answered)} | {np.mean(self.answered):.1%} "
            f"| {np.concatenate(self.right).mean():.1%} | {np.mean(self.pa_mm):.0f} |"
        )


def standing(renders: Path) -> Iterator[Standing]:
    """Who is upright in a rendered set, knees below the hips and ankles below the knees."""
    images = decode_members(renders)
    for record in read_annotations(renders):
        joints = np.array(record["joints_px"])
        y = joints[:, 1]
        levels = [y[NECK], *(y[list(pair)].mean() for pair in _PAIRS)]
        if abs(lean_rad(joints)) < MOST_LEAN and (np.diff(levels) > 0).all():
            image = images[record["image"]]
            truth_mm = np.array(record["joints_mm"])
            yield Standing(image, joints, truth_mm, float(record["focal_length_px"]))


def look(pipeline: Pipeline, person: Standing, end: float, tally: Tally) -> None:
    """Add the answer to the photo of ``person`` that ends at row ``end``."""
    photo = person.image[: int(end)]
    there = person.joints_px[:, 1] < len(photo) - 1
    if there.sum() < LEAST_JOINTS:
        return
    photo = np.asarray(cv2.resize(photo, None, fx=ENLARGED, fy=ENLARGED), np.uint8)
    truth_px = (person.joints_px + 0.5) * ENLARGED - 0.5
    query = PhotoQuery(max_people=1, focal_length_px=ENLARGED * person.focal_length_px)
    people = pipeline.estimate(cv2.imencode(".png", photo)[1].tobytes(), query).people
    tally.answered.append(bool(people))
    if not people:
        tally.right.append(np.zeros(int(there.sum())))
        return
    right = correct_keypoints(people[0].joints_px[None], truth_px[None])[0]
    tally.right.append(right[there].astype(np.float64))
    lifted = people[0].lifted
    if isinstance(lifted, LiftedPerson):
        found = lifted.joints_3d_mm[there]
        tally.pa_mm.append(float(similarity_error_mm(found, person.joints_mm[there]).mean()))


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line: see the module."""
    parser = argparse.ArgumentParser(prog="evaluation.cut_off", description=__doc__)
    parser.add_argument("--renders", type=Path, required=True)
    parser.add_argument("--people", type=int, default=150)
    chosen = parser.parse_args(arguments)
    people = list(standing(chosen.renders))[: chosen.people]
    if not people:
        raise SystemExit(f"{chosen.renders}: nobody stands upright")
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
