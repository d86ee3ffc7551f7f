"""The ``posematch`` command; what it can do is in :mod:`app.commands`, a module each."""

from __future__ import annotations

import os
import sys
from io import TextIOWrapper

import typer
from rich.markup import escape

from app.commands import bench, doctor, evaluate, library, model, predict, serve
from app.commands.console import notices, output
from app.errors import PoseMatchError, RequestError
from app.version import VERSION
from library_store.errors import LibraryError
from models import ModelError

cli = typer.Typer(
    help="Photo in, 3D human pose out. Settings are environment variables, POSEMATCH_*.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
cli.command()(serve.serve)
cli.command()(predict.predict)
cli.add_typer(library.commands, name="library")
cli.add_typer(model.commands, name="model")
cli.command(context_settings=evaluate.PASS_ON)(evaluate.evaluate)
cli.command()(bench.bench)
cli.command()(doctor.doctor)


@cli.command("version")
def print_version() -> None:
    """Print the version."""
    output.print(VERSION, highlight=False)


def main() -> None:
    """Run the command; an error made on purpose is one line on stderr and exit code 1."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):  # a name or sign that it has no letters for
            stream.reconfigure(errors="backslashreplace")
    try:
        cli()
    except RequestError as error:
        notices.print(f"[red]error:[/red] {error.detail}", highlight=False, soft_wrap=True)
        sys.exit(1)
    except (LibraryError, ModelError) as error:
        notices.print(f"[red]error:[/red] {escape(str(error))}", highlight=False, soft_wrap=True)
        sys.exit(1)
    except OSError as error:
        # Of a path that the user gave, or of a full disk under what is printed: what the service
        # itself needs has errors of its own.
        place = "the output" if error.filename is None else str(error.filename)
        notices.print(
            f"[red]error:[/red] {escape(place)}: {error.strerror or error}",
            highlight=False,
            soft_wrap=True,
        )
        if error.filename is None and sys.__stdout__ is not None:
            # What is left to be written would fail once more at exit.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.__stdout__.fileno())
        sys.exit(1)
    except PoseMatchError as error:
        notices.print(
            f"[red]cannot start:[/red] {escape(str(error))}", highlight=False, soft_wrap=True
        )
        sys.exit(1)
