"""Which lifting network is measured beside a library."""

from __future__ import annotations

from argparse import ArgumentParser
from pathlib import Path

from library_store.library import Library
from models.card import WEIGHTS_DIR
from models.pose_lifter import PoseLifter

OFF = "off"
SHIPPED = str(WEIGHTS_DIR / "lifter.json")


def add_network_option(parser: ArgumentParser) -> None:
    """``--network``, for :func:`network_of`."""
    parser.add_argument(
        "--network",
        default=SHIPPED,
        help="card of the lifting network, or off; default the one that ships",
    )


def network_named(card: str) -> PoseLifter | None:
    """The network of that card, None for ``off``."""
    if card == OFF:
        return None
    path = Path(card)
    return PoseLifter(path.stem, weights_dir=path.parent)


def network_of(card: str, library: Library) -> PoseLifter | None:
    """The network of that card, None for ``off``.

    ``SystemExit`` when it learned from another prior than the library was drawn from: it may know
    the very people that the library was made without.
    """
    network = network_named(card)
    if network is None:
        return None
    prior = library.manifest.build.get("prior")
    own = prior["sha256"] if isinstance(prior, dict) else None
    known = {each.card.measured.get("prior_sha256") for each in network.networks}
    if own is not None and known != {own}:
        raise SystemExit(
            f"{card} learned from another prior than library {library.manifest.name}: name the "
            "network that goes with it (--network CARD), or measure without one (--network off)"
        )
    return network
