"""The ``posematch`` command: serve, predict, version; others are in :mod:`app.commands`."""

from __future__ import annotations

import sys
from contextlib import suppress
from pathlib import Path
from typing import Annotated

import cv2
import typer
import uvicorn
from rich.markup import escape
from rich.table import Table

from app.answers import poses_answer
from app.commands import library
from app.commands.console import build_if_missing, notices, output
from app.connection import connection_class
from app.drawing import draw_result
from app.engine import load_engine
from app.errors import PoseMatchError, RequestError, StartupError
from app.imaging import decode_photo
from app.lifting.types import Method
from app.main import create_app
from app.observability import configure_logging
from app.pipeline import PhotoQuery
from app.schemas import Person, PosesAnswer
from app.settings import load_settings
from app.version import VERSION
from library_store.errors import LibraryError
from library_store.importers import MocapError

cli = typer.Typer(
    help="Photo in, 3D human pose out. Settings are environment variables, POSEMATCH_*.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
cli.add_typer(library.commands, name="library")


def main() -> None:
    """Run the command; an error made on purpose is one line on stderr and exit code 1."""
    try:
        cli()
    except RequestError as error:
        notices.print(f"[red]error:[/red] {error.detail}", highlight=False, soft_wrap=True)
        sys.exit(1)
    except MocapError as error:
        notices.print(f"[red]error:[/red] {escape(str(error))}", highlight=False, soft_wrap=True)
        sys.exit(1)
    except (PoseMatchError, LibraryError) as error:
        notices.print(f"[red]cannot start:[/red] {error}", highlight=False, soft_wrap=True)
        sys.exit(1)


@cli.command()
def serve(
    host: Annotated[str | None, typer.Option(help="Address; default POSEMATCH_HOST.")] = None,
    port: Annotated[int | None, typer.Option(help="Port; default POSEMATCH_PORT.")] = None,
) -> None:
    """Build the default library if it is not cached, and serve."""
    given = {"host": host, "port": port}
    settings = load_settings(**{name: value for name, value in given.items() if value is not None})
    build_if_missing(settings)
    configure_logging(settings.log_level)

    def stop(_: StartupError) -> None:
        server.should_exit = True

    app = create_app(settings, on_startup_failure=stop)
    server = uvicorn.Server(
        uvicorn.Config(
            app,
            host=settings.host,
            port=settings.port,
            http=connection_class(settings.upload_timeout_s),
            lifespan="on",
            ws="none",
            access_log=False,
            log_config=None,
            server_header=False,
            timeout_keep_alive=settings.keep_alive_s,
            timeout_graceful_shutdown=settings.shutdown_grace_s,
        )
    )
    with suppress(KeyboardInterrupt):  # uvicorn shuts down in order, then raises it again
        server.run()
    if app.state.service.startup_error is not None:
        raise app.state.service.startup_error


@cli.command()
def predict(
    photo: Annotated[Path, typer.Argument(exists=True, dir_okay=False, help="JPEG, PNG, WebP.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print the JSON of the API.")] = False,
    image: Annotated[
        Path | None, typer.Option(help="Write a picture of the result here (PNG, JPEG).")
    ] = None,
    method: Annotated[str, typer.Option(help="fusion or paper.")] = "fusion",
    max_people: Annotated[int, typer.Option(min=1, max=10)] = 5,
    mirrored: Annotated[bool, typer.Option(help="The photo is a mirror image.")] = False,
) -> None:
    """Estimate everybody's pose in a photo, without a server."""
    if method not in ("fusion", "paper"):
        raise typer.BadParameter("fusion or paper", param_hint="--method")
    chosen: Method = "paper" if method == "paper" else "fusion"
    settings = load_settings()
    build_if_missing(settings)
    engine = load_engine(settings)
    data = photo.read_bytes()
    query = PhotoQuery(max_people=max_people, method=chosen, mirrored=mirrored)
    result = engine.pipeline.estimate(data, query)
    answer = poses_answer(engine, result, chosen, request_id=photo.name)
    if image is not None:
        decoded = decode_photo(
            data, max_pixels=settings.max_pixels, side_px=settings.decode_side_px
        )
        if not cv2.imwrite(str(image), draw_result(decoded, result)):
            raise typer.BadParameter(f"{image} cannot be written", param_hint="--image")
    if as_json:
        output.print_json(answer.model_dump_json())
    else:
        _print_people(photo, answer)


def _print_people(photo: Path, answer: PosesAnswer) -> None:
    size = f"{answer.image.width_px} x {answer.image.height_px} px"
    output.print(f"{photo.name}: {size}, {len(answer.people)} people")
    for number, person in enumerate(answer.people, 1):
        output.print(_person_table(number, person))
        for warning in person.warnings:
            output.print(f"warning: {warning}", style="yellow", highlight=False)
    spent = ", ".join(f"{stage} {ms:.1f}" for stage, ms in answer.timings_ms.items())
    output.print(f"ms: {spent}", highlight=False)


def _person_table(number: int, person: Person) -> Table:
    match = person.exemplar
    title = f"person {number}" + (f": {match.id}, p = {match.probability:.2f}" if match else "")
    table = Table(title=title, title_justify="left")
    for heading in ("joint", "x px", "y px", "x mm", "y mm", "z mm"):
        table.add_column(heading, justify="left" if heading == "joint" else "right")
    joints_3d = person.joints_3d or (None,) * len(person.joints_2d)
    for flat, deep in zip(person.joints_2d, joints_3d, strict=True):
        mm = [f"{v:.0f}" for v in (deep.x_mm, deep.y_mm, deep.z_mm)] if deep else [""] * 3
        table.add_row(flat.name, f"{flat.x_px:.1f}", f"{flat.y_px:.1f}", *mm)
    return table


@cli.command("version")
def print_version() -> None:
    """Print the version."""
    output.print(VERSION, highlight=False)
