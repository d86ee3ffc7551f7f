"""Which of several model cards to serve: the best for this machine and its budget."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from models.card import ModelCard, read_card
from models.errors import ModelError
from models.providers import ProviderChoice, cpu_features, present_providers, runtime_of
from models.session import cost_ms

Kind = Literal["pose", "people", "lift"]
"""What networks are there for, as their cards' outputs have it."""
AS_GOOD = 0.005
"""Accuracies that differ by less are one: then the cheaper network is the better one."""


@dataclass(frozen=True)
class Candidate:
    """A card and the least it costs on the providers present, CPU-ms an input."""

    card: ModelCard
    cost_ms: float


def cards_of(directory: Path, kind: Kind, *, needed: bool = True) -> list[ModelCard]:
    """All cards of one kind, by name.

    Raises ``ModelError`` for a bad card or, if one is ``needed``, no card at all.
    """
    paths = sorted(directory.glob("*.json"))
    # Hidden files are none: macOS puts one beside each that it copies to other disks.
    cards = [read_card(path) for path in paths if not path.name.startswith(".")]
    found = [card for card in cards if card.output.kind == kind]
    if needed and not found:
        raise ModelError(
            f"no model card of kind {kind!r} in {directory}; restore models/weights from the "
            "repository or point POSEMATCH_WEIGHTS_DIR at a directory that has one"
        )
    return found


def choose(
    directory: Path,
    kind: Literal["pose", "people"],
    *,
    provider: ProviderChoice = "auto",
    budget_ms: float = float("inf"),
    features: frozenset[str] | None = None,
) -> str:
    """Name of the best card for the providers present and this CPU.

    Of the cards whose accuracy and cost are known and within ``budget_ms`` (CPU-ms an input), the
    cheapest that is as good as the best. When none fits, the cheapest of all that suit; costs are
    those of the machine they were measured on, so this is a choice among cards, not a promise.
    """
    features = cpu_features() if features is None else features
    cards = cards_of(directory, kind)
    candidates = []
    for card in cards:
        runtimes = [runtime_of(card, p, features) for p in present_providers(provider)]
        costs = [cost_ms(card, runtime) for runtime in runtimes if runtime is not None]
        if costs:
            candidates.append(Candidate(card, min(costs)))
    if not candidates:
        raise ModelError(
            f"none of {', '.join(card.name for card in cards)} in {directory} suits "
            f"POSEMATCH_PROVIDER={provider} on this machine; name one in POSEMATCH_MODEL"
        )
    fitting = [c for c in candidates if c.card.accuracy is not None and c.cost_ms <= budget_ms]
    if not fitting:
        return min(candidates, key=lambda c: (c.cost_ms, c.card.name)).card.name
    best = max(c.card.accuracy or 0.0 for c in fitting)
    good = [c for c in fitting if (c.card.accuracy or 0.0) > best - AS_GOOD]
    return min(good, key=lambda c: (c.cost_ms, c.card.name)).card.name
