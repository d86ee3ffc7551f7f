"""The whole pipeline on rendered people with exact truth: photo in, 2D and 3D errors out.

    python -m evaluation.renders --data DIR [--own-boxes] [--figure PATH]

``--data`` has the JPEGs and a ``ground_truth.json`` as in ``tests/data/renders``. The service's own
settings (POSEMATCH_*) choose model and library. The true focal length is given.

The second table lifts the same people from better and worse 2D: it tells what of the error is the
network's and what is the lifting's. ``--figure`` draws the worst of them.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from app.drawing import NOVEL_VIEWS, draw_novel_view, draw_overlay
from app.drawing.picture import Pixels, Words
from app.drawing.raster import to_pixels
from app.engine import load_engine
from app.imaging import decode_photo
from app.lifting.types import LiftedPerson
from app.pipeline import LiftQuery, PhotoQuery, PhotoResult, Pipeline, SeenPerson
from app.settings import load_settings
from evaluation.metrics import (
    Floats,
    root,
    root_centred_error_mm,
    similarity_error_mm,
)
from library_store.skeleton import L_HIP, L_SHOULDER, LIMB_JOINTS, NECK, R_HIP, R_SHOULDER
from models.pck import correct_keypoints, torso_px

LIMBS = list(LIMB_JOINTS)
NOISE_TORSOS = (0.025, 0.05, 0.1, 0.2)
"""Standard deviation a coordinate, torso lengths."""
NOISE_DRAWS = 5
WORST, FIGURE_PX, PAPER, MOST_PIXELS = 3, 380, 255, 100_000_000


@dataclass(frozen=True)
class Render:
    """One image and its truth: (14, 2) px, (14, 3) mm in the camera frame, the world's up there."""

    file: str
    size_px: tuple[int, int]
    focal_length_px: float
    joints_px: Floats
    joints_mm: Floats
    up: Floats


def read_renders(folder: Path) -> list[Render]:
    """All records of a folder's ``ground_truth.json``."""
    return [
        Render(
            file=record["file"],
            size_px=(record["width"], record["height"]),
            focal_length_px=float(record["K"][0][0]),
            joints_px=np.asarray(record["joints_2d_px"], np.float64),
            joints_mm=np.asarray(record["joints_3d_mm"], np.float64),
            up=np.asarray(record["R_world_to_cam"], np.float64)[:, 2],
        )
        for record in json.loads((folder / "ground_truth.json").read_text())["images"]
    ]


def nearest(people: tuple[SeenPerson, ...], truth_px: Floats) -> SeenPerson | None:
    """The answered person whose joints lie nearest to the truth, None when nobody is near."""
    extent = float(np.ptp(truth_px, axis=0).max())
    best, least = None, 0.5 * extent
    for person in people:
        distance = float(np.linalg.norm(person.joints_px.mean(0) - truth_px.mean(0)))
        if distance < least:
            best, least = person, distance
    return best


def trunk_axes(joints_mm: Floats) -> Floats:
    """Right, up and back of a trunk (14, 3) as the rows of a rotation (3, 3)."""
    up = joints_mm[NECK] - 0.5 * (joints_mm[R_HIP] + joints_mm[L_HIP])
    up /= np.linalg.norm(up)
    right = joints_mm[R_SHOULDER] - joints_mm[L_SHOULDER] + joints_mm[R_HIP] - joints_mm[L_HIP]
    right -= up * (right @ up)
    right /= np.linalg.norm(right)
    return np.stack([right, up, np.cross(right, up)])


def turn_deg(a: Floats, b: Floats) -> float:
    """Angle of the rotation between two (3, 3), degrees."""
    return float(np.degrees(np.arccos(np.clip((np.trace(a @ b.T) - 1) / 2, -1, 1))))


def lifted_error_mm(
    pipeline: Pipeline, render: Render, joints_px: Floats, *, true_focal: bool = True
) -> float:
    """PA over the 12 limb joints of a render lifted from other 2D joints (14, 2)."""
    query = LiftQuery(
        *render.size_px,
        joints_px=joints_px[None],
        confidence=np.ones((1, len(joints_px))),
        focal_length_px=render.focal_length_px if true_focal else None,
    )
    (person,) = pipeline.lift(query).people
    if not isinstance(person.lifted, LiftedPerson):
        return float("nan")
    answer = person.lifted.joints_3d_mm
    return float(similarity_error_mm(answer[LIMBS], render.joints_mm[LIMBS]).mean())


def by_2d(pipeline: Pipeline, renders: list[Render], found: list[Floats | None]) -> str:
    """Markdown: the 3D error by what 2D was lifted; ``found`` are the network's joints.

    Every row is of the people whom the network found: the true 2D of the others would flatter it.
    """
    rng = np.random.default_rng(0)
    seen = [
        (render, joints)
        for render, joints in zip(renders, found, strict=True)
        if joints is not None
    ]

    def put_right(render: Render, joints_px: Floats) -> Floats:
        near = correct_keypoints(joints_px, render.joints_px)
        mended: Floats = np.where(near[:, None], joints_px, render.joints_px)
        return mended

    def noisy(render: Render, torsos: float) -> Floats:
        sigma_px = torsos * torso_px(render.joints_px)
        drawn: Floats = render.joints_px + rng.normal(0, sigma_px, render.joints_px.shape)
        return drawn

    def row(label: str, errors: list[float]) -> str:
        lifted = [error for error in errors if np.isfinite(error)]
        if len(lifted) < len(errors):
            label += f" ({len(errors) - len(lifted)} of {len(errors)} refused)"
        if not lifted:
            return f"| {label} | - | - |"
        return f"| {label} | {np.mean(lifted):.0f} | {np.median(lifted):.0f} |"

    def network(change: Callable[[Render, Floats], Floats]) -> list[float]:
        return [
            lifted_error_mm(pipeline, render, change(render, joints)) for render, joints in seen
        ]

    true = [lifted_error_mm(pipeline, r, r.joints_px) for r, _ in seen]
    assumed = [lifted_error_mm(pipeline, r, r.joints_px, true_focal=False) for r, _ in seen]
    lines = [
        f"| 2D that is lifted, {len(seen)} people | PA mm, 12: mean | median |",
        "|---|---|---|",
        row("the network's, all trusted alike", network(lambda _, joints: joints)),
        row("the same, joints beyond 0.2 torsos put right", network(put_right)),
        row("true", true),
        row("true, focal length not given", assumed),
    ]
    for torsos in NOISE_TORSOS:
        drawn = [
            lifted_error_mm(pipeline, r, noisy(r, torsos))
            for r, _ in seen
            for _ in range(NOISE_DRAWS)
        ]
        lines.append(row(f"true plus noise of {torsos:g} torsos a coordinate", drawn))
    return "\n".join(lines)


def drawn(photo: Path, result: PhotoResult, render: Render, title: str) -> Pixels:
    """The joints found in a photo, and the answer from two sides, before the truth in grey."""
    data = photo.read_bytes()
    decoded = decode_photo(data, max_pixels=MOST_PIXELS, side_px=max(render.size_px))
    (person,) = result.people
    assert isinstance(person.lifted, LiftedPerson)
    # Where it is depends on how large somebody is taken to be: hips onto hips.
    truth_mm = render.joints_mm + root(person.lifted.joints_3d_mm) - root(render.joints_mm)
    ghost = replace(person.lifted.exemplar, joints_mm=truth_mm)
    beside_truth = replace(person, lifted=replace(person.lifted, exemplar=ghost))
    picture = draw_overlay(decoded, [person], height_px=FIGURE_PX)
    words = Words(title, np.array([14.0, 26.0]), (255, 255, 255))
    picture = replace(picture, marks=(*picture.marks, words))
    shown = replace(result, people=(beside_truth,))
    for view in NOVEL_VIEWS:
        picture = picture.beside(draw_novel_view(shown, view, side_px=FIGURE_PX))
    return to_pixels(picture)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--own-boxes", action="store_true", help="detect, instead of the true box")
    parser.add_argument("--figure", type=Path, help="picture to write of the worst answers")
    args = parser.parse_args()
    renders = read_renders(args.data)
    pipeline = load_engine(load_settings()).pipeline

    print("| image | people | PCK@0.2, 12 limb joints | PA mm, 12 | root-relative mm, 14 |")
    print("|---|---|---|---|---|")
    near, similar, centred = [], [], []
    tilts_deg, turns_deg, reprojections_px, within = [], [], [], []
    found: list[Floats | None] = []
    drawable: list[tuple[float, Render, PhotoResult]] = []
    for render in renders:
        truth_px, truth_mm = render.joints_px, render.joints_mm
        low = truth_px.min(0)
        box = None if args.own_boxes else (*low, *(truth_px.max(0) - low))
        query = PhotoQuery(focal_length_px=render.focal_length_px, box_px=box)
        result = pipeline.estimate((args.data / render.file).read_bytes(), query)
        person = nearest(result.people, truth_px)
        if person is None or not isinstance(person.lifted, LiftedPerson):
            near.append(np.zeros(len(LIMBS), bool))
            found.append(None)
            print(f"| {render.file} | {len(result.people)} | not found | - | - |")
            continue
        found.append(person.joints_px)
        answer = person.lifted.joints_3d_mm
        near.append(correct_keypoints(person.joints_px, truth_px)[LIMBS])
        similar.append(float(similarity_error_mm(answer[LIMBS], truth_mm[LIMBS]).mean()))
        drawable.append((similar[-1], render, replace(result, people=(person,))))
        errors_mm = root_centred_error_mm(answer, truth_mm)
        centred.append(float(errors_mm.mean()))
        sigma_mm = person.lifted.sigma_mm
        within.append(np.zeros(0, bool) if sigma_mm is None else errors_mm <= sigma_mm)
        exemplar = person.lifted.exemplar
        upright = float(np.clip(exemplar.rotation[:, 1] @ render.up, -1, 1))
        tilts_deg.append(float(np.degrees(np.arccos(upright))))
        turns_deg.append(turn_deg(trunk_axes(answer), trunk_axes(truth_mm)))
        reprojections_px.append(exemplar.reprojection_error_px)
        print(
            f"| {render.file} | {len(result.people)} | {100 * near[-1].mean():.0f} "
            f"| {similar[-1]:.0f} | {centred[-1]:.0f} |"
        )
    if not similar:
        raise SystemExit(f"{args.data}: nobody of {len(renders)} pictures was found and lifted")
    print(
        f"| **mean ({len(similar)} of {len(renders)} lifted)** | | **{100 * np.mean(near):.1f}** "
        f"| **{np.mean(similar):.0f}** | **{np.mean(centred):.0f}** |"
    )
    print(f"| median | | | {np.median(similar):.0f} | {np.median(centred):.0f} |")
    print(
        f"\nMedians: camera's vertical {np.median(tilts_deg):.1f}°, trunk's orientation "
        f"{np.median(turns_deg):.1f}° from the truth; reprojection of the exemplar "
        f"{np.median(reprojections_px):.1f} px. sigma_mm covers "
        f"{np.concatenate(within).mean():.0%} of the root-relative errors.\n"
    )
    print(by_2d(pipeline, renders, found))
    if args.figure is not None:
        worst = sorted(drawable, key=lambda shown: -shown[0])[:WORST]
        rows = [
            drawn(args.data / render.file, result, render, f"{render.file}: PA {error_mm:.0f} mm")
            for error_mm, render, result in worst
        ]
        width = max(pixels.shape[1] for pixels in rows)
        padded = [
            np.pad(pixels, ((0, 0), (0, width - pixels.shape[1]), (0, 0)), constant_values=PAPER)
            for pixels in rows
        ]
        if not cv2.imwrite(str(args.figure), np.concatenate(padded)):
            raise SystemExit(f"{args.figure} cannot be written")


if __name__ == "__main__":
    main()
