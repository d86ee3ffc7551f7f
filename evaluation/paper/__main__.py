"""Every table and figure of the paper, on a user's own data or on free mocap.

    posematch evaluate paper --data DIR
    posematch evaluate paper --data cmu --mocap cmu.npz [--cross-set set.npz] [--library DIR]

``DIR`` holds Human3.6M, HumanEva-I or both, in the forms that users have them in (see
``evaluation.paper.datasets``); what is not there is named and its tables are left out. Libraries
are made of the training frames as the cameras saw them, as in the paper; ``--library`` and
``--mlp`` add rows for a library of posematch's own and a network trained on it, which must not know
the people they are measured on; nor must the lifting network of the default method, ``--network``:
by default the one that ships, and with ``--data cmu``, whose people that one has seen, none. Prints
Markdown; ``--out`` keeps it, with the figures.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

from evaluation.networks import OFF, SHIPPED, network_named, network_of
from evaluation.paper.network import Network
from evaluation.paper.runs import Options, run_cmu, run_users_data
from evaluation.protocols import load_lifting_set
from library_store.arguments import SEED, integer, real
from library_store.library import load


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line: see the module."""
    parser = argparse.ArgumentParser(
        prog="posematch evaluate paper",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("--data", required=True, help="a folder, or the word cmu")
    add("--out", type=Path, default=Path("paper-tables"), help="report.md, figures, libraries")
    add("--entries", type=integer(0), default=200_000, help="training frames in a library; 0: all")
    add("--views", type=integer(0), default=5_000, help="test views a protocol, drawn; 0: all")
    add("--curve-views", type=integer(0), default=1_000, help="the same for figures 7 and 8")
    add("--seed", type=SEED, default=0, help="of everything that is drawn")
    add("--library", type=Path, help="a library of posematch's own, for further rows")
    add("--mlp", type=Path, help="what evaluation.paper.mlp trained on it, for further rows")
    add("--network", help="card of the lifting network, or off; default see above")
    add("--mocap", type=Path, help="with --data cmu: the generic npz of CMU's poses")
    add("--cross-set", type=Path, help="with --data cmu: people of another set (lifting npz)")
    add(
        "--noise-px",
        type=real(0),
        default=10.0,
        help="with --data cmu: what stands for a network",
    )
    chosen = parser.parse_args(arguments)
    for name in ("library", "mlp", "mocap", "cross_set"):
        path: Path | None = getattr(chosen, name)
        if path is not None and not path.exists():
            parser.error(f"--{name.replace('_', '-')} {path} does not exist")
    # A file that is no good is named now, not after the hours that the tables before it take.
    card = chosen.network or (OFF if chosen.data == "cmu" else SHIPPED)
    network = network_named(card)
    if chosen.library is not None:
        with closing(load(chosen.library)) as library:
            network = network_of(card, library)
    if chosen.mlp is not None:
        Network.load(chosen.mlp)
    if chosen.cross_set is not None:
        load_lifting_set(chosen.cross_set)
    options = Options(
        out=chosen.out,
        entries=chosen.entries or None,
        views=chosen.views or None,
        curve_views=chosen.curve_views or None,
        seed=chosen.seed,
        library=chosen.library,
        mlp=chosen.mlp,
        network=network,
    )
    if chosen.data == "cmu":
        if chosen.mocap is None:
            parser.error("--data cmu needs --mocap")
        place = chosen.mocap
        done = run_cmu(place, chosen.cross_set, chosen.noise_px, options)
    else:
        place = Path(chosen.data)
        if not place.is_dir():
            parser.error(f"--data {place} is no folder")
        done = run_users_data(place, options)
    if not done:
        sys.exit(f"posematch evaluate paper: no table can be made of what is in {place}")


if __name__ == "__main__":
    main()
