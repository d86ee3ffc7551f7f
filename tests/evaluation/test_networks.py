"""Measured beside a library is a network that has not met the people it was made without."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from evaluation.networks import OFF, SHIPPED, network_of
from library_store.library import Library
from library_store.prior import PosePrior


def library(build: dict[str, Any]) -> Library:
    return cast(Library, SimpleNamespace(manifest=SimpleNamespace(name="some", build=build)))


def test_a_network_of_another_prior_is_refused() -> None:
    own = library({"prior": {"sha256": PosePrior.load().sha256}})
    other = library({"prior": {"sha256": "0" * 64}})
    found = network_of(SHIPPED, own)
    assert found is not None
    assert found.card.name == Path(SHIPPED).stem
    with pytest.raises(SystemExit, match="--network"):
        network_of(SHIPPED, other)
    assert network_of(OFF, other) is None
    assert network_of(SHIPPED, library({"prior": None})) is not None, "captured poses alone"
