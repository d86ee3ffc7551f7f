"""3D of many rendered people, ours beside BlazePose's own.

    python -m evaluation.rendered --renders TAR [--reference DIR] [--people N]

``--renders`` is a set of ``models.training.rendered`` that nothing was trained on; ``--reference``
has ``blazepose_*.onnx``. Ours gets the true box and focal length, BlazePose a view turned upright
by the true trunk, as good as its own first pass could make it. PA over the 12 limb joints:
BlazePose has no neck, and its metres no camera.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from app.engine import load_engine
from app.lifting.lifter import Lifter
from app.lifting.types import LiftedPerson, Observation
from app.settings import load_settings
from evaluation.metrics import Floats, similarity_error_mm
from evaluation.photo_sigma import Seen, find_joints
from evaluation.progress import followed
from library_store.arguments import integer
from library_store.skeleton import LIMB_JOINTS
from models.pck import correct_keypoints
from models.training.dataset import MP33_LIMBS, Image, decode_members, read_annotations
from models.training.teachers import BlazePose, circle

LIMBS = list(LIMB_JOINTS)


def lifted_pa_mm(lifter: Lifter, people: Sequence[Seen]) -> Floats:
    """PA of each person's 12 limb joints (N,), nan for who cannot be lifted."""
    errors = np.full(len(people), np.nan)
    for i, person in enumerate(followed(people, "3D")):
        (answer,) = lifter.lift([person.observation], person.intrinsics, n_candidates=1)
        if isinstance(answer, LiftedPerson):
            errors[i] = pa_mm(answer.joints_3d_mm[LIMBS], person.joints_mm[LIMBS])
    return errors


def pa_mm(found: Floats, truth: Floats) -> float:
    """Mean over joints (12, 3)."""
    return float(similarity_error_mm(found, truth).mean())


def blazepose(network: BlazePose, image: Image, joints_px: Floats) -> tuple[Floats, Floats]:
    """Its limb joints (12, 2) px and (12, 3) mm, about a person who is where the truth says."""
    about = circle(joints_px, np.ones(len(joints_px), bool))
    if about is None:  # the trunk points at the camera: which way up is as good as any
        about = joints_px.mean(0), joints_px.mean(0) - np.array([0.0, np.ptp(joints_px)])
    seen = network.person(image, *about)
    return seen.landmarks_px[list(MP33_LIMBS)], seen.landmarks_mm[list(MP33_LIMBS)]


def row(label: str, pck: float, errors_mm: Floats) -> str:
    """One line of the table."""
    return f"| {label} | {pck:.1%} | {errors_mm.mean():.1f} | {np.median(errors_mm):.1f} |"


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line: see the module."""
    parser = argparse.ArgumentParser(prog="evaluation.rendered", description=__doc__)
    parser.add_argument("--renders", type=Path, required=True)
    parser.add_argument("--reference", type=Path, help="folder with blazepose_*.onnx")
    parser.add_argument("--people", type=integer(1), help="only the first so many")
    chosen = parser.parse_args(arguments)
    engine = load_engine(load_settings())
    people = list(find_joints(chosen.renders, engine.estimator, chosen.people))
    records = read_annotations(chosen.renders)[: len(people)]
    truth_px = np.array([record["joints_px"] for record in records])
    found_px = np.array([person.observation.joints_px for person in people])

    untold = [
        replace(person, observation=replace(person.observation, depths_px=None))
        for person in people
    ]
    exact = [
        replace(person, observation=Observation(joints, np.ones(len(joints))))
        for person, joints in zip(people, truth_px, strict=True)
    ]
    served = Lifter(engine.library, network=engine.lifter)
    errors = {
        "matching alone": lifted_pa_mm(Lifter(engine.library), people),
        "and the lifting network": lifted_pa_mm(served, untold),
        "and the depths that the CPM reads: as served": lifted_pa_mm(served, people),
        "from true 2D": lifted_pa_mm(served, exact),
    }
    px = {label: found_px for label in errors} | {"from true 2D": truth_px}
    if chosen.reference is not None:
        images = decode_members(chosen.renders)
        for variant in ("full", "heavy"):
            network = BlazePose(chosen.reference, variant)
            seen = [
                blazepose(network, images[record["image"]], joints)
                for record, joints in zip(followed(records, variant), truth_px, strict=True)
            ]
            label = f"BlazePose {variant}'s own 3D"
            px[label] = truth_px.copy()
            px[label][:, LIMBS] = [joints for joints, _ in seen]
            errors[label] = np.array(
                [
                    pa_mm(joints_mm, person.joints_mm[LIMBS])
                    for (_, joints_mm), person in zip(seen, people, strict=True)
                ]
            )
    every = np.all([np.isfinite(own) for own in errors.values()], axis=0)
    print(f"{every.sum()} of {len(people)} people, lifted every way")
    print("| | PCK@0.2, 12 limb joints | PA mm, 12: mean | median |")
    print("|---|---|---|---|")
    for label, own in errors.items():
        pck = correct_keypoints(px[label], truth_px)[every][:, LIMBS].mean()
        print(row(label, float(pck), own[every]))


if __name__ == "__main__":
    main()
