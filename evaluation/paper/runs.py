"""What is run for which data: protocols, libraries, and the report with every table in order."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from app.commands.console import stage_progress
from app.drawing.picture import Picture
from app.drawing.svg import to_svg
from app.lifting.lifter import Lifter
from evaluation.metrics import rigid_error_mm, root_centred_error_mm
from evaluation.paper import figures, published, report, study
from evaluation.paper.chart import chart
from evaluation.paper.datasets import (
    P1_TEST,
    P1_TRAIN,
    P2_TEST,
    P2_TRAIN,
    Found,
    find_cmu,
    find_h36m,
    find_humaneva,
)
from evaluation.paper.exemplars import exemplars_of, fraction, write_library
from evaluation.paper.network import Network
from evaluation.paper.study import TestSet
from evaluation.paper.systems import Seen2D, System, learned, ours, paper_method
from evaluation.paper.videos import find_videos, look_at_videos
from evaluation.paper.views import (
    FIRST_VIRTUAL,
    Scene,
    Views,
    draw,
    look,
    of_lifting_set,
    some,
)
from evaluation.protocols import load_lifting_set
from library_store.importers.h36m import CAMERAS
from library_store.library import Library, load
from models.pose_lifter import PoseLifter

P1_SECONDS, P2_SECONDS = 64 / 50, 0.1
"""Every 64th frame of 50 Hz; 10 frames a second."""
DIAGNOSTIC_SECONDS = 30.0
FIRST_CAMERAS = (CAMERAS[0], FIRST_VIRTUAL)
HUMANEVA_SECONDS = 0.25


@dataclass(frozen=True)
class Options:
    """See the command's ``--help``; None: no limit, or not given."""

    out: Path
    entries: int | None
    views: int | None
    curve_views: int | None
    seed: int
    library: Path | None
    mlp: Path | None
    network: PoseLifter | None

    def rng(self) -> np.random.Generator:
        """Anew for every draw, so that none depends on which were made before."""
        return np.random.default_rng(self.seed)


@dataclass
class Report:
    """Markdown that is printed as it grows, and written with the figures into ``directory``."""

    directory: Path
    parts: list[str] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)

    def say(self, *lines: str) -> None:
        """A paragraph or a table."""
        self.parts.append("\n".join(lines) + "\n")
        print(self.parts[-1], flush=True)
        self.directory.mkdir(parents=True, exist_ok=True)
        (self.directory / "report.md").write_text("\n".join(self.parts), encoding="utf-8")

    def draw(self, name: str, picture: Picture, caption: str) -> None:
        """A figure, beside the report."""
        self.directory.mkdir(parents=True, exist_ok=True)
        (self.directory / f"{name}.svg").write_text(to_svg(picture), encoding="utf-8")
        self.say(f"![{caption}]({name}.svg)")

    def close(self) -> None:
        """Say what is missing."""
        found = [f"* {line}" for line in dict.fromkeys(self.missing)]
        self.say("## Missing or left out", *(found or ["Nothing."]))


@dataclass(frozen=True)
class Protocols:
    """The test sets of one data set, and the libraries of its training frames.

    ``p1_x``, ``p2_x``: those of which there is 2D from a network, None where there is none;
    ``diagnostic``: None where the first camera's frames are not there.
    """

    p1: TestSet
    p2: TestSet
    p1_x: TestSet | None
    p2_x: TestSet | None
    diagnostic: TestSet | None
    p1_library: Library
    p2_library: Library
    x_is: str
    by_action: bool


def run_users_data(root: Path, options: Options) -> bool:
    """Human3.6M and HumanEva-I, as far as they are under ``root``; whether there is any table."""
    told = Report(options.out)
    h36m, humaneva = find_h36m(root), find_humaneva(root)
    told.missing += h36m.missing + humaneva.missing
    told.say("# The paper's tables", _what_is_drawn(options))
    library: Library | None = None
    train1, test1 = h36m.of(P1_TRAIN), h36m.of(P1_TEST)
    train2, test2 = h36m.of(P2_TRAIN), h36m.of(P2_TEST)
    if train1 and test1 and train2 and test2:
        protocols = Protocols(
            p1=_test_set(look(test1, seconds_apart=P1_SECONDS), h36m, options),
            p2=_test_set(look(test2, seconds_apart=P2_SECONDS), h36m, options),
            p1_x=None,
            p2_x=None,
            diagnostic=_diagnostic_set(test2, h36m, options),
            p1_library=_frames_library("h36m-p1", train1, options),
            p2_library=_frames_library("h36m-p2", train2, options),
            x_is="the pose network on the videos' frames, given the true box",
            by_action=True,
        )
        videos = find_videos(root) if h36m.real_cameras else {}
        if videos:
            protocols = replace(
                protocols,
                p1_x=_with_videos(protocols.p1, videos, told),
                p2_x=_with_videos(protocols.p2, videos, told),
            )
        else:
            reason = "S*/Videos/*.mp4" if h36m.real_cameras else "metadata.xml and the videos"
            told.missing.append(f"{reason}: tables 1, 3, 4 and 6 and the |x lines need them")
        _cameras_said(told, h36m)
        _noticed(told, h36m)
        _all_tables(told, protocols, options)
        library = protocols.p1_library
    elif h36m.scenes:
        told.missing.append(
            "tables 1 to 8: subjects to learn from and to test on are not all there"
        )
    if humaneva.scenes and library is not None:
        _noticed(told, humaneva)
        views = look(humaneva.scenes, seconds_apart=HUMANEVA_SECONDS)
        test = _test_set(views, humaneva, options)
        _table9(told, test, library, options, "HumanEva-I, virtual cameras", by_action=True)
    elif humaneva.scenes:
        told.missing.append("table 9: needs Human3.6M, to learn from")
    told.close()
    return library is not None


def run_cmu(mocap: Path, cross_set: Path | None, noise_px: float, options: Options) -> bool:
    """The analogues on free mocap: split by subject; Gaussian noise stands for a network.

    Whether there is any table.
    """
    told = Report(options.out)
    found, held_out = find_cmu(mocap)
    told.missing += found.missing
    train = [scene for scene in found.scenes if scene.clip.subject not in held_out]
    test = found.of(held_out)
    told.say("# The paper's tables on CMU's mocap", _what_is_drawn(options))
    if not train or not test:
        told.missing.append("tables: subjects to learn from and to test on are not all there")
        told.close()
        return False
    library = _frames_library("cmu-frames", train, options)
    p1 = _test_set(look(test, seconds_apart=P1_SECONDS), found, options)
    p2 = _test_set(look(test, seconds_apart=P2_SECONDS), found, options)
    protocols = Protocols(
        p1=p1,
        p2=p2,
        p1_x=_noisy(p1, noise_px),
        p2_x=_noisy(p2, noise_px),
        diagnostic=_diagnostic_set(test, found, options),
        p1_library=library,
        p2_library=library,
        x_is=f"true 2D plus Gaussian noise of {noise_px:g} px (people are about 400 px tall)",
        by_action=False,
    )
    told.say(
        f"Held out: {', '.join(held_out)} ({sum(len(s.clip) for s in test):,} frames); "
        f"to learn from: {len({s.clip.subject for s in train})} others "
        f"({sum(len(s.clip) for s in train):,} frames). Four virtual cameras a clip. "
        "The paper's own rows are of Human3.6M: another data set, beside for the order of things."
    )
    _all_tables(told, protocols, options)
    if cross_set is None:
        told.missing.append("table 9: no --cross-set")
    else:
        other = _lifting_views(cross_set, options)
        _table9(told, other, library, options, cross_set.stem, by_action=False)
    told.close()
    return True


def _all_tables(told: Report, data: Protocols, options: Options) -> None:
    """Tables 1 to 8, figures 2 to 8."""
    p1, p2, library = data.p1, data.p2, data.p1_library
    systems, systems2 = _systems(library, options), _systems(data.p2_library, options)
    told.say(
        f"Libraries of training frames: {len(library):,} exemplars (protocol 1), "
        f"{len(data.p2_library):,} (protocol 2). Test views: {len(p1.views):,}, {len(p2.views):,}, "
        f"{_count(data.diagnostic):,} (diagnostic); of these with x: "
        f"{_count(data.p1_x):,}, {_count(data.p2_x):,}. *x*: {data.x_is}. Errors in mm."
    )

    def by_action(
        title: str, rows: Sequence[published.Row], test: TestSet, found: list[published.Row]
    ) -> None:
        told.say(f"## {title}")
        told.say(report.action_table(test.columns, rows, found, by_action=data.by_action))

    if data.p1_x is not None:
        found = study.comparison(data.p1_x, "x", systems, rigid_error_mm)
        by_action("Table 1: protocol 1, given x", published.P1, data.p1_x, found)
    found = study.comparison(p1, "gt", systems, rigid_error_mm)
    by_action("Table 2: protocol 1, given true 2D", published.P1_GT, p1, found)
    if data.p2_x is not None:
        found = study.comparison(data.p2_x, "x", systems2, root_centred_error_mm)
        by_action("Table 4: protocol 2, given x", published.P2, data.p2_x, found)
    found = study.comparison(p2, "gt", systems2, root_centred_error_mm)
    by_action("Protocol 2, given true 2D (not in the paper)", (), p2, found)
    if data.diagnostic is None:
        told.missing.append(f"table 5: needs camera {CAMERAS[0]}, the first")
    else:
        found = study.diagnostic(data.diagnostic, data.p2_library, systems2[1:])
        title = "Table 5: similarity alignment, first 30 seconds, first camera, true 2D"
        by_action(title, published.DIAGNOSTIC, data.diagnostic, found)

    for number, source, rows, test in (
        (6, "x", published.PREDICTED, data.p1_x),
        (7, "gt", published.TRUE_2D, p1),
    ):
        if test is not None:
            told.say(f"## Table {number}: with and without the warp, given {source}, protocol 1")
            ours = study.warping(test, source, library)
            theirs = [*rows, None][: len(ours)]
            told.say(report.short_table(list(zip(theirs, ours, strict=True))))
    told.say("## Table 8: the optimal exemplar, protocol 1")
    best = study.optimal(p1, library)
    told.say(report.short_table(list(zip(published.OPTIMAL, best, strict=True))))
    shown = data.p1_x or p1
    _curves(told, shown, library, "training frames", "", options)
    if options.library is not None:
        own = load(options.library, backend="exact")
        _curves(told, shown, own, own.manifest.name, "-own", options)
    _figures(told, shown, Lifter(library, network=options.network))


def _curves(
    told: Report, p1: TestSet, library: Library, name: str, suffix: str, options: Options
) -> None:
    """Figures 7 and 8, and table 3, whose numbers they are."""
    rows = np.sort(options.rng().permutation(len(p1.views))[: options.curve_views])
    test = TestSet(
        p1.views[rows], {source: seen.of(rows) for source, seen in p1.seen.items()}, p1.columns
    )
    with tempfile.TemporaryDirectory() as folder:

        def library_of(size: int) -> Library:
            if size >= len(library):
                return load(library.directory, verify=False, backend="exact")
            return write_library(Path(folder) / str(size), fraction(library, size, options.seed))

        curve = study.size_curve(test, study.sizes_up_to(len(library)), library_of, options.network)
    told.say(f"## Figures 7 and 8: protocol 1 by library size, {name} ({len(rows):,} views)")
    for number, kind, lines in ((7, "mean", curve.mean), (8, "median", curve.median)):
        title = f"{kind} P1 by library size: {name}"
        told.draw(f"figure{number}{suffix}", chart(title, curve.sizes, lines), title)
    told.say(report.curve_table(curve))
    plateaus = ", ".join(f"{n:,.0f} given {source}" for source, n in published.PLATEAUS.items())
    told.say(f"The paper's curves are flat from {plateaus}.")
    if "X*|x" in curve.mean:
        told.say(f"## Table 3: size of the library, given x, {name}")
        told.say(report.size_table(curve, "X*|x"))


def _figures(told: Report, p1: TestSet, lifter: Lifter) -> None:
    told.say("## Figures 2 to 6: people (training frames as library)")
    source = "x" if figures.liftable(p1, "x", lifter) else "gt"
    told.draw("figure2", figures.failure(p1, source, lifter), "Figure 2: a failure")
    told.draw("figure3", figures.warp(p1, lifter), "Figure 3: the warp")
    for number, picture in enumerate(figures.typical(p1, source, lifter)):
        told.draw(f"figure4{'abc'[number]}", picture, "Figure 4: answers")
    for number, given in ((5, "x"), (6, "gt")):
        if not figures.liftable(p1, given, lifter):
            told.missing.append(f"figure {number}: nobody can be lifted given {given}")
        else:
            for letter, picture in zip("ab", figures.side_by_side(p1, given, lifter), strict=True):
                caption = f"Figure {number}: the paper's method and the default, given {given}"
                told.draw(f"figure{number}{letter}", picture, caption)


def _table9(
    told: Report, test: TestSet, library: Library, options: Options, name: str, *, by_action: bool
) -> None:
    told.say(f"## Table 9: another data set ({name}), true 2D, protocol 1")
    rows = study.transfer(test, library, _systems(library, options)[1:])
    told.say(report.action_table(test.columns, published.HUMANEVA, rows, by_action=by_action))


def _systems(frames: Library, options: Options) -> list[System]:
    """The paper's method on training frames first; then ours, and what the options add."""
    libraries = {"training frames": frames}
    if options.library is not None:
        own = load(options.library, backend="exact")
        libraries[own.manifest.name] = own
    systems = [
        System(f"{label}, {name}", lift)
        for name, library in libraries.items()
        for label, lift in (
            ("paper's method", paper_method(library)),
            *ours(library, options.network).items(),
        )
    ]
    if options.mlp is not None:
        network = Network.load(options.mlp)
        systems += [
            System("MLP", learned(network, warped=False)),
            System("MLP, warped", learned(network, warped=True)),
        ]
    return systems


def _frames_library(name: str, scenes: Sequence[Scene], options: Options) -> Library:
    views = draw(scenes, options.entries, options.rng())
    with stage_progress() as done:
        return write_library(options.out / "libraries" / name, exemplars_of(views), done)


def _test_set(views: Views, found: Found, options: Options) -> TestSet:
    views = some(views, options.views, options.rng())
    return TestSet(views, {"gt": Seen2D(views.points_px())}, found.columns)


def _diagnostic_set(scenes: Sequence[Scene], found: Found, options: Options) -> TestSet | None:
    """By name: where each camera has files of its own, every one is the first of its scene."""
    views = look(
        scenes,
        seconds_apart=P2_SECONDS,
        first_seconds=DIAGNOSTIC_SECONDS,
        cameras=FIRST_CAMERAS,
    )
    return _test_set(views, found, options) if len(views) else None


def _noisy(test: TestSet, noise_px: float) -> TestSet:
    points = test.seen["gt"].points_px
    noise = np.random.default_rng(1).normal(0.0, noise_px, points.shape)
    return replace(test, seen={**test.seen, "x": Seen2D(points + noise)})


def _with_videos(
    test: TestSet, videos: dict[tuple[str, str, str, str], Path], told: Report
) -> TestSet | None:
    """The views that videos show, with both kinds of 2D; None where there are none."""
    views, seen, missing = look_at_videos(test.views, videos)
    told.missing += missing
    if not len(views):
        return None
    return TestSet(views, {"gt": Seen2D(views.points_px()), "x": seen}, test.columns)


def _lifting_views(path: Path, options: Options) -> TestSet:
    """A lifting set (``evaluation.protocols``), or some of it."""
    views = some(of_lifting_set(load_lifting_set(path)), options.views, options.rng())
    return TestSet(views, {"gt": Seen2D(views.points_px())}, ("all",))


def _count(test: TestSet | None) -> int:
    return 0 if test is None else len(test.views)


def _what_is_drawn(options: Options) -> str:
    entries = f"{options.entries:,} drawn" if options.entries else "all"
    views = f"at most {options.views:,} a protocol" if options.views else "all"
    return f"Training frames: {entries}; test views: {views}; seed {options.seed}."


def _cameras_said(told: Report, found: Found) -> None:
    real = "the real ones" if found.real_cameras else "virtual (no metadata.xml)"
    told.say(f"Cameras: {real}.")


def _noticed(told: Report, found: Found) -> None:
    """What the importer did to the poses that errors are measured by: frames may be gone."""
    told.say("The poses as they were read:", *(f"* {line}" for line in found.noticed))
