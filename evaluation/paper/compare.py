"""The paper's method, the default one and the MLP on the same people, library and noise.

    python -m evaluation.paper.compare --library DIR --mlp mlp.npz --data set.npz

``--data`` is a lifting set (``evaluation.protocols``), repeatable; the MLP should have been trained
on the library's own poses, which are checked to be the same.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from evaluation.metrics import summarise
from evaluation.networks import add_network_option, network_of
from evaluation.paper.network import Network
from evaluation.paper.systems import Seen2D, System, default_method, learned, paper_method
from evaluation.paper.views import Views, of_lifting_set
from evaluation.protocols import load_lifting_set, one_missing
from library_store.arguments import integer
from library_store.library import load


def rows(views: Views, seen: Seen2D, noise: str, systems: Sequence[System]) -> list[str]:
    """A line of the table for each method."""
    lines = []
    for system in systems:
        answers = system.lift(views, seen)
        found = summarise(answers.answer_mm, views.joints_mm)
        lines.append(
            f"| {noise} | {answers.labelled(system.label)} "
            f"| {found.p1_mean:.1f} / {found.p1_median:.1f} "
            f"| {found.p2_mean:.1f} / {found.p2_median:.1f} "
            f"| {found.pa_mean:.1f} / {found.pa_median:.1f} |"
        )
    return lines


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line: see the module."""
    parser = argparse.ArgumentParser(prog="evaluation.paper.compare", description=__doc__)
    parser.add_argument("--library", type=Path, required=True)
    parser.add_argument("--mlp", type=Path, required=True)
    parser.add_argument("--data", type=Path, action="append", required=True)
    parser.add_argument(
        "--people", type=integer(1), default=None, help="only N, spread over each set"
    )
    parser.add_argument("--only", action="append", help="a method; repeatable; default all")
    add_network_option(parser)
    chosen = parser.parse_args(arguments)
    library, network = load(chosen.library), Network.load(chosen.mlp)
    lifter = network_of(chosen.network, library)
    systems = [
        System("paper", paper_method(library)),
        System("default", default_method(library, lifter)),
        System("default, matching alone", default_method(library)),
        System("MLP", learned(network, warped=False)),
        System("MLP, warped", learned(network, warped=True)),
    ]
    systems = [s for s in systems if chosen.only is None or s.label in chosen.only]
    if network.poses != library.manifest.files["poses.npy"].sha256:
        print("The MLP was trained on other poses than the library's.")
    print(
        f"Library {library.manifest.name}, {len(library):,} exemplars; MLP of width "
        f"{network.width}, {network.n_samples:,} samples. Errors in mm, mean / median."
    )
    for path in chosen.data:
        data = load_lifting_set(path)
        everybody = of_lifting_set(data)
        n = len(everybody)
        people = np.linspace(0, n - 1, min(chosen.people or n, n)).round().astype(np.int64)
        views = everybody[people]
        print(f"\n## {data.name}: {len(views)} people\n\n| 2D | method | P1 | P2 | PA |")
        print("|---|---|---|---|---|")
        for noise, points in data.joints_2d_px.items():
            seen = Seen2D(points[people])
            print(*rows(views, seen, f"{noise} px", systems), sep="\n", flush=True)
        spoilt = one_missing(data.joints_2d_px[min(data.joints_2d_px)][people])
        missing = Seen2D(spoilt.points_px, present=np.asarray(spoilt.confidence > 0))
        print(*rows(views, missing, "a limb joint missing", systems), sep="\n", flush=True)


if __name__ == "__main__":
    main()
