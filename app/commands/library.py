"""``posematch library``: import mocap; build, merge, push, check and look at pose libraries."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Annotated, get_args

import cv2
import typer
from rich.markup import escape
from rich.table import Table

from app.commands.console import build_if_missing, notices, output, stage_progress
from app.engine import milvus_of
from app.settings import load_settings
from library_store.backends import index_settings
from library_store.build import (
    BuildSettings,
    Mocap,
    build_library,
    describe_library,
    verify_library,
)
from library_store.importers import Clip, find_files, read_each, states_licence, write_npz
from library_store.importers.clip import counted
from library_store.library import load
from library_store.manifest import MANIFEST, Manifest
from library_store.merge import merge_libraries
from library_store.milvus_push import push_library
from library_store.mocap import MocapSettings
from library_store.prior import DEFAULT_PRIOR, PosePrior
from library_store.sheet import contact_sheet, draw_entries
from library_store.sources import Kind

commands = typer.Typer(help="The exemplar library.", no_args_is_help=True)

DEFAULT_SIZE = 200_000
MAX_SIZE = 2**31 - 1
"""Poses and cameras are numbered in four bytes."""
MAX_RATE_HZ = 10_000
"""No camera is so fast: all poses are taken. Of an infinite rate a manifest would be no JSON."""

LibraryArgument = Annotated[
    Path | None,
    typer.Argument(help="A library; default POSEMATCH_LIBRARY_DIR, else the cached default one."),
]

HnswOption = Annotated[
    bool | None,
    typer.Option(
        "--hnsw/--no-hnsw",
        help="Index with an HNSW graph; default up to a million exemplars. Without it the cells "
        "serve complete poses too.",
        show_default=False,
    ),
]


@commands.command("build")
def build(
    context: typer.Context,
    directory: Annotated[
        Path | None,
        typer.Option(help="Build here; default POSEMATCH_LIBRARY_DIR, else the cache."),
    ] = None,
    files: Annotated[
        list[Path] | None,
        typer.Option(
            "--from", exists=True, dir_okay=False, help="Clips, as `import` writes them; repeat."
        ),
    ] = None,
    prior: Annotated[
        str | None,
        typer.Option(help="default, none or a file: sample from a prior; none with --from."),
    ] = None,
    size: Annotated[
        int,
        typer.Option(
            min=1,
            max=MAX_SIZE,
            help="How many exemplars; of several cameras a pose, whole poses.",
        ),
    ] = DEFAULT_SIZE,
    prior_share: Annotated[
        float, typer.Option(min=0, max=1, help="Share sampled where a prior joins --from.")
    ] = 0.5,
    cameras_per_pose: Annotated[
        int, typer.Option(min=1, help="Cameras of each sampled or recombined pose.")
    ] = 1,
    rate: Annotated[
        float,
        typer.Option(
            min=0.1, max=MAX_RATE_HZ, help="Every n-th pose, as few as still give so many a second."
        ),
    ] = 30,
    radius_mm: Annotated[
        float, typer.Option(min=0, max=1_000, help="Of poses nearer than this one is kept.")
    ] = 30,
    mirror: Annotated[bool, typer.Option(help="Add mirror images.")] = True,
    recombined: Annotated[
        float, typer.Option(min=0, max=1, help="Share with the legs of one, arms of another.")
    ] = 0.5,
    stature_sd: Annotated[
        float, typer.Option(min=0, max=0.3, help="Spread of recombined people's size.")
    ] = 0.05,
    bone_sd: Annotated[
        float, typer.Option(min=0, max=0.3, help="Spread of recombined people's bones.")
    ] = 0.03,
    licence: Annotated[
        str, typer.Option(help="What clips that state no licence may be used for.")
    ] = "",
    credit: Annotated[str, typer.Option(help="Whom to credit for them.")] = "",
    name: Annotated[str, typer.Option(help="In exemplar ids; default the directory's.")] = "",
    version: Annotated[str, typer.Option(help="Default the prior's and the recipe's, or 1.")] = "",
    seed: Annotated[int, typer.Option(min=0, help="Another seed gives other poses.")] = 0,
    hnsw: HnswOption = None,
) -> None:
    """Build a library from clips, from a pose prior or both.

    Killed, it goes on where it was when it is started again. With no option at all it builds the
    default library in the cache, if it is not there yet.
    """
    settings = load_settings()
    directory = directory or settings.library_dir
    sources = [context.get_parameter_source(name) for name in context.params]
    asked = any(source is not None and source.name == "COMMANDLINE" for source in sources)
    if directory is not None and not asked and (directory / MANIFEST).exists():
        raise typer.BadParameter(
            f"POSEMATCH_LIBRARY_DIR, {directory}, holds a library, which poses of the default "
            "prior would replace: name it if that is wanted",
            param_hint="--directory",
        )
    if directory is None:
        if asked:
            raise typer.BadParameter("a library of your own needs --directory")
        directory = build_if_missing(settings)
        output.print(str(directory), highlight=False, soft_wrap=True)
        return
    for file in files or ():
        if file.suffix.lower() != ".npz":
            raise typer.BadParameter(
                f"{file} is no npz file of clips: `posematch library import` makes one of it",
                param_hint="--from",
            )
    try:
        wanted = BuildSettings(
            name=name or directory.absolute().name,
            n_poses=max(1, size // cameras_per_pose),
            cameras_per_pose=min(cameras_per_pose, size),
            seed=seed,
            version=version,
            index=index_settings(size, hnsw),
        )
    except ValueError as error:
        raise typer.BadParameter(str(error), param_hint="--name") from error
    mocap = None
    if files:
        mocap = Mocap(
            files=tuple(files),
            settings=MocapSettings(
                rate_hz=rate,
                radius_mm=radius_mm,
                mirror=mirror,
                recombined=recombined,
                stature_sd=stature_sd,
                bone_sd=bone_sd,
                licence=licence or _ask_for_licence(files),
                credit=credit,
            ),
            prior_share=prior_share,
        )
    with stage_progress() as report:
        manifest = build_library(directory, _prior(prior, mocap), wanted, report, mocap=mocap)
    _print_licences(manifest)
    output.print(str(directory), highlight=False, soft_wrap=True)


def _prior(choice: str | None, mocap: Mocap | None) -> PosePrior | None:
    choice = choice or ("none" if mocap else "default")
    if choice == "none":
        if mocap is None:
            raise typer.BadParameter("without a prior there must be --from", param_hint="--prior")
        return None
    return PosePrior.load(DEFAULT_PRIOR if choice == "default" else Path(choice))


def _ask_for_licence(files: list[Path]) -> str:
    """What somebody at a terminal says about files that state no licence."""
    unstated = [file.name for file in files if not states_licence(file)]
    if not unstated or not sys.stdin.isatty():
        return ""  # the build refuses what is needed and missing
    text: str = typer.prompt(f"Under which licence may the poses of {', '.join(unstated)} be used?")
    return text


@commands.command("merge")
def merge(
    libraries: Annotated[
        list[Path], typer.Argument(exists=True, file_okay=False, help="Two libraries or more.")
    ],
    directory: Annotated[Path, typer.Option(help="Write the merged library here.")],
    name: Annotated[str, typer.Option(help="In exemplar ids; default the directory's.")] = "",
    version: Annotated[str, typer.Option(help="The new library's.")] = "1",
    hnsw: HnswOption = None,
) -> None:
    """Make one library of several, without building their parts anew."""
    size = sum(describe_library(library).n_exemplars for library in libraries)
    try:
        with stage_progress() as report:
            manifest = merge_libraries(
                directory,
                libraries,
                name=name or directory.absolute().name,
                version=version,
                index=index_settings(size, hnsw),
                progress=report,
            )
    except ValueError as error:
        raise typer.BadParameter(str(error), param_hint="--name") from error
    _print_licences(manifest)
    output.print(str(directory), highlight=False, soft_wrap=True)


@commands.command("push")
def push(
    library: LibraryArgument = None,
    uri: Annotated[str, typer.Option(help="Where Milvus is; default POSEMATCH_MILVUS_URI.")] = "",
) -> None:
    """Bring a library into Milvus, indexed and loaded.

    Killed, it goes on where it was when it is started again; what is there is not sent twice.
    """
    settings = load_settings(**({"milvus_uri": uri} if uri else {}))
    milvus = milvus_of(settings)
    if milvus is None:
        raise typer.BadParameter("or POSEMATCH_MILVUS_URI must be given", param_hint="--uri")
    directory = library or build_if_missing(settings)
    with stage_progress() as report:
        pushed = push_library(directory, milvus, report)
    output.print(
        f"{pushed.collection}: {pushed.n_entries} exemplars, {pushed.n_before} of them were there",
        highlight=False,
        markup=False,
        soft_wrap=True,
    )


@commands.command("info")
def print_info(
    library: LibraryArgument = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the manifest.")] = False,
) -> None:
    """Print what a library holds, how it was built, and the licences of its sources."""
    directory = library or build_if_missing(load_settings())
    manifest = describe_library(directory)
    if as_json:
        output.print_json(json.dumps(json.loads(manifest.to_json())))
        return
    total_bytes = sum(file.bytes for file in manifest.files.values())
    table = Table(show_header=False, box=None)
    table.add_column()
    table.add_column(overflow="fold")
    for label, value in (
        ("library", f"{manifest.name} {manifest.version}"),
        ("directory", str(directory)),
        ("exemplars", f"{manifest.n_exemplars:,} of {manifest.n_poses:,} poses"),
        (
            "on the disk",
            f"{total_bytes / 1e6:,.0f} MB, {total_bytes // manifest.n_exemplars} B each",
        ),
        ("index", ", ".join(f"{key} {_compact(it)}" for key, it in manifest.index.items())),
        ("sha256", manifest.sha256),
        *((f"build: {name}", _compact(value)) for name, value in manifest.build.items()),
    ):
        table.add_row(label, escape(value))
    output.print(table, highlight=False)
    _print_licences(manifest)


def _compact(value: object) -> str:
    """A value of a manifest as one reads it: a line for each step or source."""
    if isinstance(value, dict) and any(isinstance(part, dict) for part in value.values()):
        return "\n".join(f"{name}: {_compact(part)}" for name, part in value.items())
    if isinstance(value, dict):
        return ", ".join(f"{name} {part}" for name, part in value.items())
    if isinstance(value, list):
        joint = "\n" if any(isinstance(part, dict) for part in value) else ", "
        return joint.join(_compact(part) for part in value)
    return str(value)


def _print_licences(manifest: Manifest) -> None:
    for it in manifest.licences:
        text = f"licence of {it.source}: {it.licence}" + (f". {it.credit}" if it.credit else "")
        output.print(text, highlight=False, markup=False, soft_wrap=True)


@commands.command("verify")
def verify(library: LibraryArgument = None) -> None:
    """Check every file of a library against its SHA-256, and open it."""
    directory = library or build_if_missing(load_settings())
    verify_library(directory)
    output.print(f"{directory}: whole", highlight=False, markup=False, soft_wrap=True)


@commands.command("sample")
def sample(
    library: LibraryArgument = None,
    out: Annotated[Path, typer.Option(help="Write the picture here (PNG).")] = Path("sheet.png"),
    count: Annotated[int, typer.Option(min=1, max=2_000, help="How many exemplars.")] = 48,
    kind: Annotated[str, typer.Option(help="Only mocap, composed or sampled ones.")] = "",
    seed: Annotated[int, typer.Option(min=0, help="Another seed shows others.")] = 0,
) -> None:
    """Draw some of a library's exemplars, as their cameras see them, on a contact sheet."""
    kinds: tuple[Kind, ...] = get_args(Kind)
    chosen = next((known for known in kinds if known == kind), None)
    if kind and chosen is None:
        raise typer.BadParameter(", ".join(kinds), param_hint="--kind")
    if not cv2.haveImageWriter(str(out)):
        raise typer.BadParameter(f"{out} is no picture: .png, .jpg", param_hint="--out")
    directory = library or build_if_missing(load_settings())
    opened = load(directory, backend="exact")
    entries = draw_entries(opened, count, chosen, seed)
    if not entries:
        raise typer.BadParameter(f"{directory} has no {kind} exemplars", param_hint="--kind")
    if not cv2.imwrite(str(out), contact_sheet(opened, entries)):
        raise typer.BadParameter(f"{out} cannot be written", param_hint="--out")
    output.print(
        f"{out}: {len(entries)} of {len(opened)} exemplars",
        highlight=False,
        markup=False,
        soft_wrap=True,
    )


@commands.command("import")
def import_mocap(
    paths: Annotated[
        list[Path],
        typer.Argument(
            exists=True, help="AMC (with its ASF), BVH, C3D, Human3.6M CDF, npz; or folders."
        ),
    ],
    out: Annotated[Path, typer.Option(help="Write the clips here, as one npz file.")],
    mapping: Annotated[
        Path | None,
        typer.Option(
            exists=True,
            dir_okay=False,
            help="JSON or TOML: lsp14 joint to BVH joint or C3D marker, or a list of them.",
        ),
    ] = None,
    fps: Annotated[
        float,
        typer.Option(min=0.1, max=MAX_RATE_HZ, help="Keep at least so many poses a second."),
    ] = 30,
    licence: Annotated[str, typer.Option(help="Of clips that state none.")] = "",
    strict: Annotated[bool, typer.Option(help="Refuse all if one file cannot be read.")] = False,
) -> None:
    """Read motion capture files as 14-joint poses in mm, Y up, and say what was noticed."""
    if out.suffix.lower() != ".npz":
        raise typer.BadParameter("must end in .npz", param_hint="--out")
    if not out.absolute().parent.is_dir():  # said before hours of reading, not after
        raise typer.BadParameter(f"there is no folder {out.parent}", param_hint="--out")
    if out.resolve() in {path.resolve() for path in find_files(paths)}:
        raise typer.BadParameter(
            f"{out} is among what is read: write it elsewhere", param_hint="--out"
        )
    kept: list[Clip] = []
    n_skipped = 0
    for it in read_each(paths, mapping=mapping, strict=strict):
        if isinstance(it, Clip):
            clip = it.thinned(fps)
            kept.append(replace(clip, licence=clip.licence or licence))
        else:
            n_skipped += 1
            notices.print(
                f"[yellow]skipped:[/yellow] {escape(str(it))}", highlight=False, soft_wrap=True
            )
    write_npz(out, kept)
    output.print(_clips_table(kept))
    poses = sum(len(clip) for clip in kept)
    total = f"{counted(len(kept), 'clip')}, {counted(poses, 'pose')}; {n_skipped} skipped"
    output.print(f"{out}: {total}", highlight=False, markup=False, soft_wrap=True)


def _clips_table(clips: list[Clip]) -> Table:
    table = Table()
    for heading in ("clip", "subject", "action", "poses", "noticed"):
        table.add_column(heading, justify="right" if heading == "poses" else "left")
    for clip in clips:
        said = (clip.name, clip.subject, clip.action, str(len(clip)), "; ".join(clip.findings))
        table.add_row(*map(escape, said))
    return table
