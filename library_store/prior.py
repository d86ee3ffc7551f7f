"""A prior over human poses, from which the default library is sampled.

It is recombined motion capture in a compact form. Its *exemplars* are some 17,000 poses, thinned
from the capture and taken apart (:mod:`library_store.anatomy`) into the legs with the body's
orientation and the trunk with arms and head. A sampled person has the legs of one exemplar, and an
upper body of the same or of another one, whose arms may come from a third and a fourth: how often
is :class:`Composition`. Either part may be mirrored, every number is jittered, lengths are drawn
from a population (:mod:`library_store.population`). Shares of people sit or reach for something
(:mod:`library_store.compose`), lean, lie, or are turned anyhow, because photographs have them and
motion capture hardly does. Samples outside learned limits (:mod:`library_store.limits`) are drawn
again.

The exemplars are bytes in one ``.npz`` with a JSON card beside it that names data, licence and
measures.
"""

from __future__ import annotations

import hashlib
import io
import json
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Literal
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from library_store.anatomy import (
    N_LEGS,
    BodyParts,
    Float,
    decode,
    mirror_legs,
    mirror_upper,
    unit,
)
from library_store.compose import reaching_arms, sitting_legs
from library_store.errors import LibraryError
from library_store.limits import Limits
from library_store.population import Population, even_proportions

DEFAULT_PRIOR = Path(__file__).parent / "prior_data" / "cmu.npz"
"""The prior that the default library is sampled from."""

Kind = Literal["captured", "recombined", "limbs", "sitting", "reaching", "lying", "turned"]
"""What was done to a sampled person, the last of these that applies: see :class:`Composition`."""
KINDS: tuple[Kind, ...] = (
    "captured",
    "recombined",
    "limbs",
    "sitting",
    "reaching",
    "lying",
    "turned",
)

_UP = slice(N_LEGS - 3, N_LEGS)
_ARMS = (slice(8, 14), slice(14, 20))
_ROUNDS = 50
_LEVELS = 256


@dataclass(frozen=True)
class PriorCard:
    """Who a prior is: its name and version, the sources it was fitted on, and free notes."""

    name: str
    version: str
    licences: tuple[dict[str, str], ...]
    notes: dict[str, object]


@dataclass(frozen=True)
class Composition:
    """How people are put together; shares are of all people, independent of each other.

    ``other_upper``: the upper body is another exemplar's; ``other_arms``: so are its arms, both of
    a third; ``each_arm``: or each of another. ``sitting``: the legs are composed, ``reaching``: an
    arm or both; ``tilted``: the body leans further to any side, by an angle of standard deviation
    ``tilt_deg``; ``lying``: it is turned to the horizontal; ``turned``: it is turned anyhow.
    ``jitter``: standard deviation of the noise on the coordinates of unit directions.
    """

    other_upper: float = 0.4
    other_arms: float = 0.15
    each_arm: float = 0.15
    sitting: float = 0.06
    reaching: float = 0.06
    tilted: float = 0.3
    tilt_deg: float = 40.0
    lying: float = 0.05
    turned: float = 0.05
    jitter: float = 0.02


@dataclass(frozen=True)
class Exemplars:
    """Captured poses taken apart.

    ``legs`` (E, 15) and ``upper`` (E, 23) as in :mod:`library_store.anatomy`; ``subjects`` (E,),
    whose they are; ``lengths_mm`` (S, 8), the usual lengths of each subject.
    """

    legs: Float
    upper: Float
    subjects: NDArray[np.int64]
    lengths_mm: Float


@dataclass(frozen=True)
class Drawn:
    """Sampled people: ``poses`` (n, 14, 3) mm and ``kinds`` (n,), indices into ``KINDS``."""

    poses: Float
    kinds: NDArray[np.int64]


@dataclass(frozen=True)
class PosePrior:
    """p(X). ``sha256`` is that of the file."""

    exemplars: Exemplars
    composition: Composition
    population: Population
    limits: Limits
    card: PriorCard
    sha256: str = field(default="")

    @classmethod
    def load(cls, path: Path = DEFAULT_PRIOR) -> PosePrior:
        """Read ``path`` (.npz) and its card (.json); ``LibraryError`` when either is unusable."""
        try:
            blob = path.read_bytes()
            with np.load(io.BytesIO(blob), allow_pickle=False) as arrays:
                table = {name: arrays[name] for name in arrays.files}
            fields = json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))
            settings = {
                name: dict(zip(table[f"{name}_names"], table[name].tolist(), strict=True))
                for name in ("composition", "population")
            }
            return cls(
                exemplars=Exemplars(
                    legs=_from_bytes(table, "legs"),
                    upper=_from_bytes(table, "upper"),
                    subjects=table["subjects"].astype(np.int64),
                    lengths_mm=table["lengths_mm"].astype(np.float64),
                ),
                composition=Composition(**settings["composition"]),
                population=Population(**settings["population"]),
                limits=Limits(
                    low=table["limits_low"].astype(np.float64),
                    high=table["limits_high"].astype(np.float64),
                ),
                card=PriorCard(
                    name=fields["name"],
                    version=fields["version"],
                    licences=tuple(fields["licences"]),
                    notes=fields,
                ),
                sha256=hashlib.sha256(blob).hexdigest(),
            )
        except (OSError, ValueError, KeyError, TypeError, EOFError, BadZipFile) as error:
            raise LibraryError(
                f"the pose prior {path} (with its card {path.stem}.json) cannot be "
                f"read: {error}; restore both files from the repository or the package"
            ) from error

    def sample(self, n: int, rng: np.random.Generator, *, evened: bool = False) -> Float:
        """Draw ``n`` poses: (n, 14, 3) float64 mm, root-centred, Y up, heading along +Z.

        ``evened``: all grown people have the same proportions (:mod:`library_store.population`).
        The same generator state gives the same poses. Raises ``RuntimeError`` if the limits refuse
        nearly everything, which only a broken prior does.
        """
        return self.draw(n, rng, evened=evened).poses

    def draw(self, n: int, rng: np.random.Generator, *, evened: bool = False) -> Drawn:
        """:meth:`sample`, and what was done to each person."""
        accepted: list[Drawn] = []
        missing = n
        for _ in range(_ROUNDS):
            tried = self._draw(missing + missing // 4 + 8, rng, evened=evened)
            rows = np.flatnonzero(self.limits.allow(tried.poses))[:missing]
            accepted.append(Drawn(tried.poses[rows], tried.kinds[rows]))
            missing -= len(rows)
            if not missing:
                return Drawn(
                    np.concatenate([some.poses for some in accepted]),
                    np.concatenate([some.kinds for some in accepted]),
                )
        raise RuntimeError(f"the limits of prior {self.card.name} refuse nearly every sample")

    def acceptance(self, n: int, rng: np.random.Generator) -> float:
        """The share of ``n`` drawn poses that keep the limits."""
        return float(self.limits.allow(self._draw(n, rng).poses).mean())

    def _draw(self, n: int, rng: np.random.Generator, *, evened: bool = False) -> Drawn:
        """``n`` poses that are not yet held against the limits."""
        shares, kinds = self.composition, np.zeros(n, dtype=np.int64)
        cuts = np.cumsum([shares.each_arm, shares.other_arms, shares.other_upper])
        level = 3 - np.searchsorted(cuts, rng.random(n), side="right")
        kinds[level == 1], kinds[level > 1] = KINDS.index("recombined"), KINDS.index("limbs")

        # Exemplars of the legs, the trunk, the right and the left arm, each perhaps mirrored.
        whose = rng.integers(len(self.exemplars.legs), size=(4, n))
        flip = rng.random((4, n)) < 0.5
        for part in range(1, 4):
            same = level < part
            whose[part, same], flip[part, same] = whose[part - 1, same], flip[part - 1, same]
        legs = self._legs(whose[0], flip[0])
        upper = self._upper(whose[1], flip[1])
        for part, arm in zip((2, 3), _ARMS, strict=True):
            rows = np.flatnonzero(level > 1)
            upper[rows, arm] = self._upper(whose[part, rows], flip[part, rows])[:, arm]
        legs += shares.jitter * rng.standard_normal(legs.shape)
        upper += shares.jitter * _UPPER_JITTER * rng.standard_normal(upper.shape)
        subjects = self.exemplars.subjects[whose[0]]
        usual, population = self.exemplars.lengths_mm, self.population
        if evened:
            usual, population = even_proportions(usual), replace(population, bone_sd=0.0)
        lengths = population.draw(usual[subjects], rng)

        rows = _some(n, shares.tilted, rng)
        legs[rows, _UP] = _tilt(unit(legs[rows, _UP]), shares.tilt_deg, rng)
        rows = _some(n, shares.sitting, rng)
        legs[rows], kinds[rows] = sitting_legs(len(rows), rng), KINDS.index("sitting")
        rows = _some(n, shares.reaching, rng)
        upper[rows] = reaching_arms(upper[rows], lengths[rows], rng)
        kinds[rows] = KINDS.index("reaching")
        rows = _some(n, shares.lying, rng)
        legs[rows, _UP], kinds[rows] = _lying(len(rows), rng), KINDS.index("lying")
        rows = _some(n, shares.turned, rng)
        legs[rows, _UP], kinds[rows] = _anyhow(len(rows), rng), KINDS.index("turned")
        return Drawn(decode(BodyParts(legs=legs, upper=upper), lengths), kinds)

    def _legs(self, whose: NDArray[np.int64], flip: NDArray[np.bool_]) -> Float:
        legs = self.exemplars.legs[whose]
        return np.where(flip[:, None], mirror_legs(legs), legs)

    def _upper(self, whose: NDArray[np.int64], flip: NDArray[np.bool_]) -> Float:
        upper = self.exemplars.upper[whose]
        return np.where(flip[:, None], mirror_upper(upper), upper)


_UPPER_JITTER = np.array([0.5] * 8 + [1.0] * 15)
"""The trunk and the shoulders move less than the limbs: relative jitter of the upper body."""


def save_prior(prior: PosePrior, path: Path) -> None:
    """Write ``path`` (.npz, the same bytes for the same numbers) and its card (.json)."""
    table: dict[str, NDArray[np.generic]] = {
        **_to_bytes("legs", prior.exemplars.legs),
        **_to_bytes("upper", prior.exemplars.upper),
        "subjects": prior.exemplars.subjects.astype(np.uint8),
        "lengths_mm": prior.exemplars.lengths_mm.astype(np.float32),
        "limits_low": prior.limits.low.astype(np.float32),
        "limits_high": prior.limits.high.astype(np.float32),
    }
    for name in ("composition", "population"):
        settings = asdict(getattr(prior, name))
        table[f"{name}_names"] = np.array(list(settings))
        table[name] = np.array(list(settings.values()))
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(path, allow_pickle=False, **table)
    text = json.dumps(prior.card.notes, indent=2, ensure_ascii=False) + "\n"
    path.with_suffix(".json").write_text(text, encoding="utf-8")


def _to_bytes(name: str, parts: Float) -> dict[str, NDArray[np.generic]]:
    """Columns as bytes between their least and greatest value: directions to within 0.3 degrees."""
    low, high = parts.min(axis=0), parts.max(axis=0)
    step = np.maximum(high - low, 1e-9) / (_LEVELS - 1)
    return {
        name: np.round((parts - low) / step).astype(np.uint8),
        f"{name}_low": low.astype(np.float32),
        f"{name}_step": step.astype(np.float32),
    }


def _from_bytes(table: dict[str, NDArray[np.generic]], name: str) -> Float:
    low, step = (table[f"{name}_{what}"].astype(np.float64) for what in ("low", "step"))
    parts: Float = table[name].astype(np.float64) * step + low
    return parts


def _some(n: int, share: float, rng: np.random.Generator) -> NDArray[np.int64]:
    return np.flatnonzero(rng.random(n) < share)


def _tilt(up: Float, sd_deg: float, rng: np.random.Generator) -> Float:
    """Unit vectors (n, 3) turned by N(0, ``sd_deg``) about axes square to them."""
    aside = rng.standard_normal(up.shape)
    aside = unit(aside - (aside * up).sum(-1, keepdims=True) * up)
    angle = np.radians(rng.normal(0.0, sd_deg, (len(up), 1)))
    tilted: Float = np.cos(angle) * up + np.sin(angle) * aside
    return tilted


def _anyhow(n: int, rng: np.random.Generator) -> Float:
    """Directions (n, 3) of up in the pelvis frame, uniform."""
    return unit(rng.standard_normal((n, 3)))


def _lying(n: int, rng: np.random.Generator) -> Float:
    """Directions (n, 3) of up for people who lie on any side: square to the trunk, ± 15 degrees."""
    level = unit(rng.standard_normal((n, 3)) * np.array([1.0, 0.0, 1.0]))
    return unit(level + np.array([0.0, 1.0, 0.0]) * rng.normal(0.0, 0.26, (n, 1)))
