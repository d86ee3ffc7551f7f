"""``posematch model``: the networks' cards, checks, export, and training on one's own images."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from typing import Annotated, get_args

import typer
from rich.markup import escape
from rich.table import Table

from app.commands.console import output, print_json
from app.engine import chosen_networks
from app.settings import Settings, load_settings
from library_store.arguments import MAX_SEED
from models import ModelCard, ModelError, ProviderChoice
from models.caffe import LICENCE, JointOrder
from models.caffe import import_caffe as import_network
from models.card import read_card, write_card
from models.choice import Kind, cards_of
from models.cost import with_cost
from models.pose_lifter import lifter_names
from models.session import OnnxModel

commands = typer.Typer(
    help="The networks: cards, checks, export, training on your own images.",
    no_args_is_help=True,
    rich_markup_mode=None,
)
TRAINING_PACKAGES = {"torch", "onnx", "matplotlib"}

Name = Annotated[
    str | None,
    typer.Argument(help="A card's name in POSEMATCH_WEIGHTS_DIR; default: all there are."),
]


def _card_name(value: str | None) -> str | None:
    """Refuse, before hours of training, what cannot be a file's name or asked for."""
    if value is not None and (value == "auto" or not re.fullmatch(r"\w[\w.-]*", value)):
        raise typer.BadParameter("letters, digits and . _ - are wanted, and not the word auto")
    return value


@commands.command("card")
def print_card(
    name: Name = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the card itself.")] = False,
) -> None:
    """Print what a network is, what it learned from, what it costs and how good it is.

    The ones that would serve here are marked with a star.
    """
    settings = load_settings()
    if name is not None:
        card = _card(settings, name)
        if as_json:
            print_json(card.model_dump_json())
        else:
            output.print(_card_table(card))
        return
    chosen = (*chosen_networks(settings), *lifter_names(settings.lifter, settings.weights_dir))
    cards = _all_cards(settings)
    if as_json:
        print_json(json.dumps([card.model_dump(mode="json") for card in cards]))
        return
    table = Table()
    for heading in ("", "network", "version", "accuracy", "GFLOP", "parameters", "CPU-ms"):
        table.add_column(heading)
    for card in cards:
        table.add_row(
            "*" if card.name in chosen else "",
            escape(card.name),
            escape(card.version),
            "unknown" if card.accuracy is None else f"{card.accuracy:.3f}",
            f"{card.gflop:.2f}",
            f"{card.parameters:,}",
            _costs(card),
        )
    output.print(table)


@commands.command("check")
def check(
    name: Name = None,
    provider: Annotated[
        ProviderChoice | None, typer.Option(help="Default POSEMATCH_PROVIDER.")
    ] = None,
    save: Annotated[bool, typer.Option(help="Write the cost into the card.")] = False,
) -> None:
    """Load a network as the service would, run it, and say what it costs here.

    Checked are the card, the file's SHA-256, whether onnxruntime and the provider can run it, its
    inputs, outputs and batches. Exit code: 0 when all is well, 1 when not.
    """
    settings = load_settings()
    wanted = provider or settings.provider
    table = Table()
    for heading in ("network", "runs on", "input", "CPU-ms an input", "as its card has it"):
        table.add_column(heading)
    for card in _all_cards(settings) if name is None else [_card(settings, name)]:
        runs_on = "cpu" if card.output.kind == "lift" else wanted
        model = OnnxModel(settings.weights_dir, card.name, provider=runs_on)
        measured = with_cost(card, model)
        stated = card.cost_ms.get(str(model.runtime))
        table.add_row(
            f"{escape(card.name)} {escape(card.version)}",
            str(model.runtime),
            _input(card),
            f"{measured.cost_ms[str(model.runtime)]:.2f}",
            "-" if stated is None else f"{stated:.2f}",
        )
        if save:
            write_card(settings.weights_dir / f"{card.name}.json", measured)
    output.print(table)


@commands.command("export")
def export(
    checkpoint: Annotated[Path, typer.Argument(exists=True, dir_okay=False, help="A last.pt.")],
    out: Annotated[Path, typer.Option(help="Directory for the ONNX file and its card.")],
    version: Annotated[str, typer.Option(help="Of the weights; users see it in every answer.")],
    kind: Annotated[str, typer.Option(help="cpm or person.")] = "cpm",
    name: Annotated[
        str | None, typer.Option(help="Of the card; default the kind.", callback=_card_name)
    ] = None,
    input_px: Annotated[
        int | None, typer.Option(min=32, help="A multiple of 32; default as trained.")
    ] = None,
) -> None:
    """Make a training run's checkpoint into an ONNX file and its card.

    Serve it with POSEMATCH_WEIGHTS_DIR=OUT, and POSEMATCH_MODEL=NAME if it is a pose network.
    """
    if kind not in {"cpm", "person"}:
        raise typer.BadParameter("cpm or person", param_hint="--kind")
    try:
        from models.training import export as training
    except ModuleNotFoundError as error:
        raise _needs_training(error) from error
    network: training.Kind = "cpm" if kind == "cpm" else "person"
    card = training.export(checkpoint, out, network, version=version, name=name, size_px=input_px)
    OnnxModel(out, card.name)
    _complete(out, load_settings().weights_dir, card)
    output.print(f"{out / card.file}, {card.name}.json", highlight=False, markup=False)


@commands.command("finetune")
def finetune(
    out: Annotated[Path, typer.Option(help="Directory for the new weights and their card.")],
    coco: Annotated[
        Path | None, typer.Option(exists=True, dir_okay=False, help="A COCO keypoints JSON.")
    ] = None,
    images: Annotated[
        Path | None,
        typer.Option(exists=True, file_okay=False, help="Folder of its file_names."),
    ] = None,
    human36m: Annotated[
        Path | None,
        typer.Option(exists=True, file_okay=False, help="Human3.6M: S*/MyPoseFeatures, S*/Videos."),
    ] = None,
    subject: Annotated[
        list[str] | None, typer.Option(help="Of Human3.6M, like S1; several; default: all.")
    ] = None,
    frames_apart: Annotated[
        int, typer.Option(min=1, help="Every so many frames of Human3.6M, which has 50 a second.")
    ] = 25,
    start: Annotated[str, typer.Option(help="Card to start from (fp32).")] = "cpm",
    name: Annotated[str, typer.Option(help="Of the new card.", callback=_card_name)] = "finetuned",
    steps: Annotated[int, typer.Option(min=1)] = 500,
    minutes: Annotated[float | None, typer.Option(min=0.1, help="End by then.")] = None,
    lr: Annotated[float, typer.Option(min=1e-7, max=1e-1, help="Learning rate.")] = 3e-4,
    hold_out: Annotated[float, typer.Option(min=0.01, max=0.9, help="Share of images.")] = 0.15,
    seed: Annotated[int, typer.Option(min=0, max=MAX_SEED)] = 0,
    threads: Annotated[int, typer.Option(min=1)] = 2,
) -> None:
    """Train the pose network further on your own labelled images.

    Labels are a COCO keypoints file with the folder of its images, or Human3.6M as unpacked. Whole
    images (takes) are held out and measured before and after. Needs the extra `train`.

    \b
    posematch model finetune --coco person_keypoints.json --images photos --out ours
    """  # noqa: D301
    if (coco is None) == (human36m is None):
        raise typer.BadParameter("give either --coco or --human36m", param_hint="labels")
    if (coco is None) != (images is None):
        raise typer.BadParameter("--coco and --images belong together", param_hint="--images")
    settings = load_settings()
    try:
        from models.training import finetune as training
        from models.training.users_coco import read_coco
        from models.training.users_h36m import read_human36m
    except ModuleNotFoundError as error:
        raise _needs_training(error) from error
    if coco is not None and images is not None:
        crops, source = read_coco(coco, images), f"{coco.name} (the user's own labels)"
    else:
        assert human36m is not None
        crops = read_human36m(human36m, tuple(subject or ()), frames_apart)
        source = f"Human3.6M, {', '.join(subject or ['all subjects'])} (academic use only)"
    result = training.finetune(
        crops,
        weights_dir=settings.weights_dir,
        start=start,
        out=out,
        name=name,
        source=source,
        settings=training.FinetuneSettings(
            steps=steps,
            minutes=minutes,
            lr=lr,
            hold_out=hold_out,
            seed=seed,
            threads=threads,
        ),
    )
    _complete(out, settings.weights_dir, result.card)
    table = Table(title=f"{result.n_trained} people trained on, {result.n_held_out} held out")
    for heading in ("PCK@0.2 of those held out", "%"):
        table.add_column(heading)
    table.add_row(f"before ({escape(start)})", f"{100 * result.before:.1f}")
    table.add_row(f"after ({escape(name)})", f"{100 * result.after:.1f}")
    output.print(table)
    output.print(f"{out / result.card.file}", highlight=False, markup=False, soft_wrap=True)


@commands.command("import-caffe")
def import_caffe(
    prototxt: Annotated[
        Path, typer.Argument(exists=True, dir_okay=False, help="pose_deploy_centerMap.prototxt.")
    ],
    caffemodel: Annotated[
        Path, typer.Argument(exists=True, dir_okay=False, help="pose_iter_*.caffemodel.")
    ],
    out: Annotated[Path, typer.Option(help="Directory for the ONNX file and its card.")],
    name: Annotated[str, typer.Option(help="Of the card.", callback=_card_name)] = "cpm-original",
    joints: Annotated[
        JointOrder,
        typer.Option(help="Order of its maps: cpm as published, or that of LSP or MPII."),
    ] = "cpm",
    licence: Annotated[
        str | None, typer.Option(help="Of the weights, for the card; default: non-commercial.")
    ] = None,
) -> None:
    """Make the paper's own network from its published Caffe files; needs neither Caffe nor torch.

    \b
    posematch model import-caffe pose_deploy_centerMap.prototxt pose_iter_985000_addLEEDS.caffemodel --out original
    POSEMATCH_WEIGHTS_DIR=original POSEMATCH_MODEL=cpm-original posematch serve
    """  # noqa: D301, E501
    settings = load_settings()
    card = import_network(
        prototxt, caffemodel, out, name=name, joints=joints, licence=licence or LICENCE
    )
    _complete(out, settings.weights_dir, card)
    output.print(_card_table(card))


def _complete(directory: Path, source: Path, made: ModelCard) -> None:
    """Copy networks of the other kinds beside a new one, so that the directory can be served.

    None of its own kind: the new one is what is to be served.
    """
    if directory.resolve() == source.resolve():
        return
    for kind in get_args(Kind):
        if kind == made.output.kind:
            continue
        for card in cards_of(source, kind, needed=kind != "lift"):
            # The card comes last: a copy that was broken off is made anew.
            if not (directory / f"{card.name}.json").exists():
                for file in (card.file, f"{card.name}.json"):
                    shutil.copy(source / file, directory / file)


def _needs_training(error: ModuleNotFoundError) -> Exception:
    """What to tell whoever has not installed the extra; other errors stay what they are."""
    if (error.name or "").partition(".")[0] not in TRAINING_PACKAGES:
        return error
    return ModelError(
        f"training and export need {error.name}: install posematch with its extra, "
        "pip install 'posematch[train]'"
    )


def _card(settings: Settings, name: str) -> ModelCard:
    return read_card(settings.weights_dir / f"{name}.json")


def _all_cards(settings: Settings) -> list[ModelCard]:
    where = settings.weights_dir
    lifters = cards_of(where, "lift", needed=False)
    return [*cards_of(where, "pose"), *cards_of(where, "people"), *lifters]


def _input(card: ModelCard) -> str:
    side_px = card.output.side_px
    return "2D joints" if side_px is None else f"{side_px} px"


def _costs(card: ModelCard, *, where: bool = False) -> str:
    """What an input costs by runtime; ``where``: and on which CPU that was."""
    told = []
    for runtime, cost in card.cost_ms.items():
        cpu = card.cost_cpu.get(runtime, "unknown CPU")
        told.append(f"{cost:.1f} {runtime}" + (f" ({cpu})" if where else ""))
    return ", ".join(told) or "unknown"


def _card_table(card: ModelCard) -> Table:
    table = Table(show_header=False)
    rows = {
        "name": f"{card.name} {card.version}",
        "what it is": card.description,
        "file": f"{card.file}, sha256 {card.sha256}",
        "precision": card.precision,
        "providers": ", ".join(card.providers),
        "CPU features": ", ".join(card.cpu_features) or "any",
        "input": _input(card),
        "cost": f"{card.gflop:.2f} GFLOP, {card.multiply_adds / 1e9:.2f} GMAC, "
        f"{card.parameters:,} parameters",
        "CPU-ms an input": _costs(card, where=True),
        "learned from": "\n".join(card.training_data),
        "licence": card.licence,
        "limits": "\n".join(card.limits),
        "measured": "\n".join(f"{key}: {value}" for key, value in card.measured.items()),
    }
    for key, value in rows.items():
        table.add_row(key, escape(value))
    return table
