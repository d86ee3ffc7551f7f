"""How long people's bones are: the captured subjects, and the population around them.

A sampled person has the proportions of the subject whose legs they have, changed by log-normal
factors: one of the whole body and one of each length. Adults' statures spread by 5.4 % about their
common mean (men 1,756 ± 69 mm, women 1,629 ± 64 mm: Gordon et al., 2012 Anthropometric Survey of
U.S. Army Personnel, Natick/TR-15/007). Some people are children, from 0.6 of an adult's stature (at
about four years) upwards: head and neck then have 0.77 of an adult's length, the legs 0.56 and the
trunk 0.63 (powers of the stature, set by us; Snyder et al., UM-HSRI-77-17, have such proportions).

The people of a library are *evened*: each as tall as the subject, all of the subjects' mean
proportions. Matching then compares postures alone; what another build does to a picture, lifting
knows by itself.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from library_store.anatomy import LENGTHS, Float
from library_store.proportions import draw_factors

_GROWTH = {"head": 0.5, "trunk": 0.9, "thigh": 1.15, "shank": 1.15}
"""Lengths grow with stature to this power; all others in proportion."""
_TALL = [LENGTHS.index(name) for name in ("head", "trunk", "thigh", "shank")]


@dataclass(frozen=True)
class Population:
    """Spreads about the captured subjects; ``children`` is the share of people not grown up."""

    stature_sd: float = 0.03
    bone_sd: float = 0.02
    children: float = 0.02
    least_stature: float = 0.6

    def draw(self, lengths_mm: Float, rng: np.random.Generator) -> Float:
        """Lengths (n, 8) mm of people who take after subjects of lengths (n, 8)."""
        n = len(lengths_mm)
        factors = draw_factors(n, rng, stature_sd=self.stature_sd, bone_sd=self.bone_sd)
        stature = np.where(
            rng.random(n) < self.children, rng.uniform(self.least_stature, 1.0, n), 1.0
        )
        powers = np.array([_GROWTH.get(name, 1.0) for name in LENGTHS])
        drawn: Float = lengths_mm * factors * stature[:, None] ** powers
        return drawn


def even_proportions(lengths_mm: Float) -> Float:
    """Lengths (n, 8) of people as tall as these (n, 8), all of their mean proportions."""
    mean = np.exp(np.log(lengths_mm).mean(axis=0))
    tall = lengths_mm[:, _TALL].sum(axis=1, keepdims=True) / mean[_TALL].sum()
    evened: Float = tall * mean
    return evened
