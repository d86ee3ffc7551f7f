"""Model cards: what a weights file is, what it takes, what it was trained on and how good it is."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Annotated, Literal, Self, get_args

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from models.errors import ModelError
from models.heatmaps import N_FEATURES

WEIGHTS_DIR = Path(__file__).parent / "weights"
"""The weights that ship with the project."""


class _Frozen(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class ConfidenceCalibration(_Frozen):
    """Logistic model of P(joint within 0.2 torso lengths); see heatmaps.confidence_features."""

    coefficients: list[list[float]] = Field(description="per joint: intercept, then per feature")
    fitted_on: str
    expected_calibration_error: float


class SpreadCalibration(_Frozen):
    """68% error radius = factor x spread (heat map) per joint, in the crop's pixels."""

    factor: list[float]
    fitted_on: str
    coverage: float = Field(description="share of held-out errors within the radius")


class PoseOutput(_Frozen):
    """How a pose network is fed and read."""

    kind: Literal["pose"]
    joint_names: list[str]
    input_px: int = Field(gt=0, description="side of the square crop the network sees")
    crop_scale: float = Field(gt=0, description="crop's side over the joints' box's longer side")
    stride_px: float = Field(gt=0, description="input pixels per heat map cell")
    target_sigma_cells: float = Field(ge=0, description="blur of the training targets")
    maps: Literal["logits", "beliefs"]
    border_grey: int = Field(0, ge=0, le=255, description="what crops have beyond the photo's edge")
    depths: bool = Field(
        False, description="a second output: joints' depths less the hips', over the crop's side"
    )
    looks: Literal[1, 2, 3] = Field(1, description="how often a doubtful crop is looked at")
    confidence: ConfidenceCalibration | None = None
    spread: SpreadCalibration | None = None

    @model_validator(mode="after")
    def _looks_add_logits(self) -> Self:
        if self.looks > 1 and self.maps != "logits":
            raise ValueError(f"looks are averaged as logits: looks {self.looks} needs maps logits")
        return self

    @model_validator(mode="after")
    def _all_joints_are_calibrated(self) -> Self:
        n = len(self.joint_names)
        if self.confidence is not None:
            rows = self.confidence.coefficients
            if len(rows) != n or any(len(row) != 1 + N_FEATURES for row in rows):
                raise ValueError(f"confidence needs {1 + N_FEATURES} coefficients for {n} joints")
        if self.spread is not None and len(self.spread.factor) != n:
            raise ValueError(f"spread needs a factor for each of {n} joints")
        return self

    @property
    def side_px(self) -> int:
        """Longer side of what the network sees."""
        return self.input_px


class DetectorOutput(_Frozen):
    """How a person network is fed and read."""

    kind: Literal["people"]
    long_side_px: int = Field(gt=0, description="the photo is shrunk until its longer side is this")
    stride_px: int = Field(gt=0)
    unit_px: float = Field(gt=0, description="distances are logarithms of multiples of this")
    threshold: float = Field(ge=0, le=1, description="least score of a person")

    @property
    def side_px(self) -> int:
        """Longer side of what the network sees."""
        return self.long_side_px


class LiftOutput(_Frozen):
    """A network that lifts joints to 3D, by itself, in units of what it is given."""

    kind: Literal["lift"]
    joint_names: list[str]
    reads_confidence: bool = Field(
        False, description="takes how probably each joint is right, not only whether it is there"
    )
    reads_depths: bool = Field(
        False, description="takes depths that a pose network read off the picture"
    )
    found: str | None = Field(
        None, description="name of the card of the network for joints that are not all sure"
    )

    @model_validator(mode="after")
    def _depths_come_from_a_network(self) -> Self:
        if self.reads_depths and not self.reads_confidence:
            raise ValueError("only a network that reads confidence reads depths")
        return self

    @property
    def n_columns(self) -> int:
        """What it takes of a joint: x, y and whether it is there, the depth and whether known."""
        return 5 if self.reads_depths else 3

    @property
    def side_px(self) -> None:
        """It sees no picture."""
        return None


Provider = Literal["cuda", "openvino", "cpu"]
Precision = Literal["fp32", "bf16", "int8"]


class ModelCard(_Frozen):
    """The JSON beside a weights file."""

    name: str
    version: str
    file: str
    sha256: str
    description: str
    precision: Literal["fp32", "int8"] = Field(
        "fp32", description="of the file's arithmetic; a provider may run fp32 in bf16"
    )
    providers: tuple[Provider, ...] = Field(
        get_args(Provider), description="what the file is made for and tested with"
    )
    cpu_features: tuple[str, ...] = Field(
        (), description="CPUs without any of these run the file slower than its fp32 twin"
    )
    parameters: int
    multiply_adds: int = Field(description="per input image or crop of the default size")
    accuracy: float | None = Field(
        None, description="what cards of a kind are compared by: PCK@0.2 on lspet_val, or recall"
    )
    cost_ms: dict[str, float] = Field(
        default_factory=dict,
        description="CPU-ms an input, one thread, by 'provider/precision'; posematch model check",
    )
    cost_cpu: dict[str, str] = Field(
        default_factory=dict, description="the CPU that each of cost_ms was measured on"
    )
    output: Annotated[PoseOutput | DetectorOutput | LiftOutput, Field(discriminator="kind")]
    training_data: list[str]
    licence: str
    limits: list[str]
    measured: dict[str, float | str]

    @property
    def gflop(self) -> float:
        """Billions of floating-point (or integer) operations an input takes, all convolutions."""
        return 2 * self.multiply_adds / 1e9


def read_card(path: Path) -> ModelCard:
    """Read and check a card; ``ModelError`` names the file and what is wrong with it."""
    try:
        card = ModelCard.model_validate_json(path.read_bytes())
    except FileNotFoundError:
        others = ", ".join(sorted(card.stem for card in path.parent.glob("*.json")))
        raise ModelError(
            f"model card {path} is missing"
            + (f" (there are: {others})" if others else "")
            + "; restore it from the repository, choose another model with POSEMATCH_MODEL "
            "or point POSEMATCH_WEIGHTS_DIR at a directory that has it"
        ) from None
    except OSError as error:
        raise ModelError(f"model card {path} cannot be read: {error.strerror}") from error
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"]) or "the file"
        raise ModelError(f"model card {path} is not valid at {where}: {first['msg']}") from None
    if card.name != path.stem:
        raise ModelError(
            f"model card {path} is of a model named {card.name!r}: models are asked for by the "
            f"names of their cards, so rename the file to {card.name}.json or the model in it"
        )
    return card


def printable(name: str) -> str:
    """A file's name as cards can have it: bytes that are no UTF-8 become question marks."""
    return name.encode(errors="replace").decode()


def write_card(path: Path, card: ModelCard) -> None:
    """Write a card as people read it, checked once more; the old one stays until it is whole."""
    _write([(path, _text(card))])


def write_network(directory: Path, data: bytes, card: ModelCard) -> ModelCard:
    """Write the weights' bytes and their card; returns the card with their sha256.

    Both are written whole beside the files they replace: a disk that is full leaves the old pair.
    """
    card = card.model_copy(update={"sha256": hashlib.sha256(data).hexdigest()})
    directory.mkdir(parents=True, exist_ok=True)
    _write([(directory / card.file, data), (directory / f"{card.name}.json", _text(card))])
    return card


def _text(card: ModelCard) -> bytes:
    checked = ModelCard.model_validate(card.model_dump())
    return (checked.model_dump_json(indent=2) + "\n").encode()


def _write(files: list[tuple[Path, bytes]]) -> None:
    parts = [path.with_name(f"{path.name}.part") for path, _ in files]
    try:
        for part, (_, data) in zip(parts, files, strict=True):
            part.write_bytes(data)
        for part, (path, _) in zip(parts, files, strict=True):
            part.replace(path)
    finally:
        for part in parts:
            part.unlink(missing_ok=True)


def read_weights(path: Path, card: ModelCard) -> bytes:
    """The weights' bytes, checked against the card's sha256; ``ModelError`` when they differ."""
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise ModelError(
            f"model weights {path} are missing; restore the file from the repository"
        ) from None
    except OSError as error:
        raise ModelError(f"model weights {path} cannot be read: {error.strerror}") from error
    if hashlib.sha256(data).hexdigest() != card.sha256:
        raise ModelError(
            f"model weights {path} do not match their card (sha256 differs): the file is corrupt "
            "or belongs to another version; restore both from the repository"
        )
    return data
