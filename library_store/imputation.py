"""Masked queries to an engine that knows complete descriptors only: guess, search, rank.

A missing wrist could be in many places, so it is guessed many times: from the entries of a sample
of the library that are nearest over the visible joints, as they are spread over the places the
library knows. The engine is asked for the neighbours of every guess at once, and what it finds is
ranked by the masked distance.
"""

from __future__ import annotations

import numpy as np

from library_store.descriptor import N_JOINTS, Float, describe, normalise
from library_store.masked import Correlation, missing_limbs
from library_store.neighbours import Descriptors, largest

SAMPLE = 50_000
"""Entries that guesses are taken from."""
_LEAST, _MOST = 8, 64


def n_guesses(n: int, weights: Float) -> int:
    """How many guesses a query with these weights (14,) takes in a library of ``n`` entries.

    Twice as many for every missing limb joint, up to three, and for every eight times the entries.
    """
    wanted = min(_LEAST * 2.0 ** missing_limbs(weights), _MOST)
    return int(wanted * max(1.0, n / 200_000.0) ** (1.0 / 3.0))


def guesses(sample: Descriptors, query: Float, weights: Float, n: int) -> Descriptors:
    """At most ``n`` complete descriptors (n, 28) of a query (14, 2), normalised on its weights.

    A joint of weight 1/2 or more is taken as it is, one of weight 0 from the sample (S, 28), and
    those between are blended.
    """
    similarity = Correlation(query, weights)(sample)
    nearest = np.sort(largest(similarity, n))
    nearest = nearest[np.argsort(-similarity[nearest], kind="stable")]
    # In the query's frame: the visible joints have the same mean and size.
    shares = np.broadcast_to(weights, (len(nearest), N_JOINTS))
    poses = normalise(sample[nearest].reshape(-1, N_JOINTS, 2), shares)
    trust = np.clip(2.0 * weights, 0.0, 1.0)[:, None]
    known = np.where(trust > 0, query, 0.0)
    return describe(trust * known + (1.0 - trust) * poses)
