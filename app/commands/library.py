"""``posematch library``: build, describe, check and fill pose libraries."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape
from rich.table import Table

from app.commands.console import build_if_missing, notices, output, stage_progress
from app.settings import load_settings
from library_store.build import (
    BuildSettings,
    build_library,
    describe_library,
    verify_library,
)
from library_store.importers import Clip, read_all, write_npz
from library_store.manifest import Manifest
from library_store.prior import DEFAULT_PRIOR, PosePrior

commands = typer.Typer(help="The exemplar library.", no_args_is_help=True)


@commands.command("build")
def build(
    directory: Annotated[
        Path | None,
        typer.Option(help="Build here; default POSEMATCH_LIBRARY_DIR, else the cache."),
    ] = None,
    poses: Annotated[int, typer.Option(min=1, help="How many poses to sample.")] = 200_000,
    seed: Annotated[int, typer.Option(help="Another seed gives other poses.")] = 0,
) -> None:
    """Sample a library from the pose prior; in the cache, only if it is not there yet."""
    settings = load_settings()
    directory = directory or settings.library_dir
    if directory is None:
        if (poses, seed) != (200_000, 0):
            raise typer.BadParameter("a library of your own needs --directory")
        directory = build_if_missing(settings)
    else:
        try:
            wanted = BuildSettings(name=directory.name, n_poses=poses, seed=seed)
        except ValueError as error:
            raise typer.BadParameter(str(error), param_hint="--directory") from error
        with stage_progress() as report:
            build_library(directory, PosePrior.load(DEFAULT_PRIOR), wanted, report)
    output.print(str(directory), highlight=False, soft_wrap=True)


@commands.command("info")
def print_info() -> None:
    """Print the manifest of the library that is served."""
    settings = load_settings()
    _print_manifest(describe_library(build_if_missing(settings)))


@commands.command("verify")
def verify() -> None:
    """Check every file of the library that is served against its SHA-256."""
    settings = load_settings()
    directory = build_if_missing(settings)
    verify_library(directory)
    output.print(f"{directory}: whole", highlight=False)


@commands.command("import")
def import_mocap(
    paths: Annotated[
        list[Path], typer.Argument(exists=True, help="AMC (with its ASF), BVH, npz, or folders.")
    ],
    out: Annotated[Path, typer.Option(help="Write the clips here, as one npz file.")],
    mapping: Annotated[
        Path | None,
        typer.Option(exists=True, dir_okay=False, help="JSON: lsp14 joint to BVH joint."),
    ] = None,
    fps: Annotated[float, typer.Option(min=0.1, help="Keep at least so many poses a second.")] = 30,
    strict: Annotated[bool, typer.Option(help="Refuse all if one file cannot be read.")] = False,
) -> None:
    """Read motion capture files as 14-joint poses in mm, Y up, and say what was noticed."""
    if out.suffix.lower() != ".npz":
        raise typer.BadParameter("must end in .npz", param_hint="--out")
    clips, skipped = read_all(paths, mapping=mapping, strict=strict)
    for error in skipped:
        notices.print(
            f"[yellow]skipped:[/yellow] {escape(str(error))}", highlight=False, soft_wrap=True
        )
    kept = [clip.thinned(fps) for clip in clips]
    write_npz(out, kept)
    output.print(_clips_table(kept))
    poses = sum(len(clip) for clip in kept)
    total = f"{len(kept)} clips, {poses} poses; {len(skipped)} files skipped"
    output.print(f"{out}: {total}", highlight=False, markup=False, soft_wrap=True)


def _clips_table(clips: list[Clip]) -> Table:
    table = Table()
    for heading in ("clip", "subject", "action", "poses", "noticed"):
        table.add_column(heading, justify="right" if heading == "poses" else "left")
    for clip in clips:
        said = (clip.name, clip.subject, clip.action, str(len(clip)), "; ".join(clip.findings))
        table.add_row(*map(escape, said))
    return table


def _print_manifest(manifest: Manifest) -> None:
    output.print_json(json.dumps(json.loads(manifest.to_json())))
