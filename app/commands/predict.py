"""``posematch predict``: photos and folders of them, without a server."""

from __future__ import annotations

import itertools
import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import typer
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from app import schemas
from app.answers import poses_answer
from app.api.problems import problem_of
from app.commands.console import build_if_missing, notices, output, print_json
from app.drawing import PICTURE_TYPES, draw_result, encode_picture
from app.engine import Engine, load_engine
from app.errors import InvalidInputError, RequestError
from app.imaging import decode_photo
from app.pipeline import PhotoQuery
from app.settings import Settings, load_settings

PHOTO_TYPES = (".jpg", ".jpeg", ".png", ".webp", ".heic", ".heif")
"""Endings of the files that are taken from a folder; a file that is named is always tried."""

PictureType = Literal["png", "svg", "jpg", "webp"]


@dataclass(frozen=True)
class Outcome:
    """What became of one photo: the answer, or why there is none."""

    path: Path
    answer: schemas.PosesAnswer | None
    error: RequestError | None


def predict(
    photos: Annotated[
        list[Path], typer.Argument(exists=True, help="Photos, and folders to look for them in.")
    ],
    as_json: Annotated[
        bool,
        typer.Option("--json", help="Print the API's JSON; of several photos, one line each."),
    ] = False,
    image: Annotated[
        Path | None,
        typer.Option(
            help="Write pictures: to this file (.png, .svg, .jpg, .webp) for one photo, else into "
            "this folder, named after the photos."
        ),
    ] = None,
    image_type: Annotated[
        PictureType, typer.Option(help="Of the pictures written into a folder.")
    ] = "png",
    method: Annotated[schemas.Method, typer.Option(help="How 3D is found.")] = "fusion",
    max_people: Annotated[int, typer.Option(min=1, max=10, help="Most people a photo.")] = 5,
    candidates: Annotated[
        int, typer.Option(min=0, max=schemas.MAX_CANDIDATES, help="Exemplars in the JSON.")
    ] = 3,
    fov_deg: Annotated[
        float | None,
        typer.Option(min=5, max=170, help="Field of view over the longer side; default EXIF's."),
    ] = None,
    subject_height_mm: Annotated[
        float | None, typer.Option(min=300, max=3000, help="Of everybody; fixes the scale.")
    ] = None,
    mirrored: Annotated[bool, typer.Option(help="The photos are mirror images.")] = False,
) -> None:
    """Estimate poses in photos, without a server.

    A photo that cannot be answered is named on stderr, the others are answered all the same.
    Exit code: 0 when all were answered, 1 when some were not, 2 when the command is wrong.

    \b
    posematch predict photo.jpg
    posematch predict photo.jpg --json | jq '.people[0].joints_3d'
    posematch predict photo.jpg --image result.svg
    posematch predict holiday/ --json --image pictures/ > poses.jsonl
    """  # noqa: D301
    paths = find_photos(photos)
    targets = picture_targets(paths, image, image_type)
    query = PhotoQuery(
        max_people=max_people,
        candidates=candidates,
        method=method,
        fov_deg=fov_deg,
        subject_height_mm=subject_height_mm,
        mirrored=mirrored,
    )
    settings = load_settings()
    build_if_missing(settings)
    engine = load_engine(settings)
    alone = len(photos) == 1 and photos[0].is_file()
    failures = 0
    with _progress(len(paths)) as advance:
        for outcome in estimate_all(engine, settings, paths, targets, query):
            if outcome.error is not None:
                failures += 1
                _complain(outcome.path, outcome.error)
            if as_json:
                _print_json(outcome, alone)
            elif outcome.answer is not None:
                _print_people(outcome.path, outcome.answer)
            advance()
    if not alone:
        notices.print(f"{len(paths) - failures} of {len(paths)} photos answered", highlight=False)
    if failures:
        raise typer.Exit(1)


def find_photos(given: Sequence[Path]) -> list[Path]:
    """The files named, and those in the folders named, each once and in a stable order."""
    found: dict[Path, None] = {}
    for path in given:
        inside = [path]
        if path.is_dir():
            inside = sorted(
                it for it in path.rglob("*") if it.suffix.lower() in PHOTO_TYPES and it.is_file()
            )
        found |= dict.fromkeys(inside)
    if not found:
        raise typer.BadParameter(f"no {', '.join(PHOTO_TYPES)} in there", param_hint="PHOTOS")
    return list(found)


def picture_targets(paths: Sequence[Path], image: Path | None, kind: str) -> list[Path | None]:
    """Where the picture of each photo goes; nowhere without ``image``. Names are distinct.

    Refused is what would be written over one of the photos.
    """
    if image is None:
        return [None] * len(paths)
    if len(paths) == 1 and not image.is_dir() and image.suffix:
        if image.suffix.lower() not in PICTURE_TYPES:
            raise typer.BadParameter(
                f"ends in none of {', '.join(PICTURE_TYPES)}", param_hint="--image"
            )
        targets = [image]
    elif image.exists() and not image.is_dir():
        raise typer.BadParameter(f"{image} is no folder", param_hint="--image")
    else:
        targets = [image / f"{name}.{kind}" for name in _distinct([path.stem for path in paths])]
    photos = {path.resolve() for path in paths}
    if lost := [target for target in targets if target.resolve() in photos]:
        raise typer.BadParameter(f"{lost[0]} is a photo and would be lost", param_hint="--image")
    return list(targets)


def _distinct(names: Sequence[str]) -> list[str]:
    """Each name once; what comes again gets a number."""
    found: dict[str, None] = {}
    for name in names:
        numbered = (f"{name}-{again}" for again in itertools.count(2))
        found[name if name not in found else next(it for it in numbered if it not in found)] = None
    return list(found)


def estimate_all(
    engine: Engine,
    settings: Settings,
    paths: Sequence[Path],
    targets: Sequence[Path | None],
    query: PhotoQuery,
) -> Iterator[Outcome]:
    """Outcomes in the order of the paths, computed ``settings.workers`` at a time."""
    waiting: deque[Future[Outcome]] = deque()
    pool = ThreadPoolExecutor(settings.workers)
    try:
        for path, target in zip(paths, targets, strict=True):
            waiting.append(pool.submit(_estimate, engine, settings, path, target, query))
            if len(waiting) > 2 * settings.workers:  # do not hold every answer of a big folder
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)


def _estimate(
    engine: Engine, settings: Settings, path: Path, target: Path | None, query: PhotoQuery
) -> Outcome:
    try:
        data = read_photo(path, settings.max_body_bytes)
        result = engine.pipeline.estimate(data, query)
        answer = poses_answer(engine, result, query.method, request_id=_text(path.name))
        if target is not None:
            photo = decode_photo(
                data, max_pixels=settings.max_pixels, side_px=settings.decode_side_px
            )
            picture = draw_result(photo, result)
            _write(target, encode_picture(picture, target.suffix))
    except RequestError as error:
        return Outcome(path, None, error)
    return Outcome(path, answer, None)


def read_photo(path: Path, most_bytes: int) -> bytes:
    """The file; ``InvalidInputError`` if it is larger than what the service would take."""
    try:
        with path.open("rb") as file:  # what is no plain file, as /dev/stdin, has no size
            data = file.read(most_bytes + 1)
    except OSError as error:
        raise InvalidInputError([("photo", f"cannot be read: {error.strerror}")]) from error
    if len(data) > most_bytes:
        raise InvalidInputError([("photo", f"is larger than {most_bytes} bytes")])
    return data


def _text(path: str | Path) -> str:
    """A path as JSON can hold it: bytes that are no UTF-8 become U+FFFD."""
    return os.fsencode(path).decode(errors="replace")


def _write(path: Path, data: bytes) -> None:
    """The picture whole or, where the disk is full, as it was before."""
    part = path.with_name(f"{path.name}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            part.write_bytes(data)
            part.replace(path)
        finally:
            part.unlink(missing_ok=True)
    except OSError as error:
        raise InvalidInputError([("image", f"{_text(path)}: {error.strerror}")]) from error


@contextmanager
def _progress(photos: int) -> Iterator[Callable[[], None]]:
    """A bar on stderr when there are several photos; yields what advances it."""
    columns = (TextColumn("photos"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=notices, disable=photos < 2) as bars:
        task = bars.add_task("photos", total=photos)
        yield lambda: bars.advance(task)


def _complain(path: Path, error: RequestError) -> None:
    text = f"[red]error:[/red] {escape(str(path))}: {escape(error.detail)}"
    notices.print(text, highlight=False, soft_wrap=True)


def _print_json(outcome: Outcome, alone: bool) -> None:
    """The answer itself of a photo that was named alone, else a line as in a batch's answer."""
    if alone:
        if outcome.answer is not None:
            print_json(outcome.answer.model_dump_json())
        return
    name = _text(outcome.path)
    problem = None
    if outcome.error is not None:
        problem = problem_of(outcome.error, _text(outcome.path.name))
    item = schemas.BatchItem(name=name, answer=outcome.answer, problem=problem)
    typer.echo(item.model_dump_json().encode())  # JSON is UTF-8, whatever the terminal is of


def _print_people(path: Path, answer: schemas.PosesAnswer) -> None:
    size = f"{answer.image.width_px} x {answer.image.height_px} px"
    count = "1 person" if len(answer.people) == 1 else f"{len(answer.people)} people"
    output.print(f"{path}: {size}, {count}", highlight=False, markup=False, soft_wrap=True)
    for number, person in enumerate(answer.people, 1):
        output.print(_person_table(number, person))
        for warning in person.warnings:
            output.print(f"warning: {warning}", style="yellow", highlight=False)
    spent = ", ".join(f"{stage} {ms:.1f}" for stage, ms in answer.timings_ms.items())
    output.print(f"ms: {spent}", highlight=False)


def _person_table(number: int, person: schemas.Person) -> Table:
    match = person.exemplar
    title = f"person {number}" + (f": {match.id}, p = {match.probability:.2f}" if match else "")
    table = Table(title=title, title_justify="left")
    for heading in ("joint", "confidence", "x px", "y px", "x mm", "y mm", "z mm", "± mm"):
        table.add_column(heading, justify="left" if heading == "joint" else "right")
    joints_3d = person.joints_3d or (None,) * len(person.joints_2d)
    for flat, deep in zip(person.joints_2d, joints_3d, strict=True):
        mm = [deep.x_mm, deep.y_mm, deep.z_mm, deep.sigma_mm] if deep else [None] * 4
        seen = [flat.x_px, flat.y_px]
        table.add_row(
            flat.name,
            "" if flat.confidence is None else f"{flat.confidence:.2f}",
            *("" if value is None else f"{value:.1f}" for value in seen),
            *("" if value is None else f"{value:.0f}" for value in mm),
        )
    return table
