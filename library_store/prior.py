"""A statistical prior over human poses, from which the default library is sampled.

The body is two parts (:mod:`library_store.anatomy`): the legs with the body's orientation, and the
trunk with arms and head. Each is a Gaussian mixture. A sampled person takes a component of the legs
and then, with probability ``coupling``, a component of the upper body that was seen with it; else
any one, so that legs and arms seen apart are recombined. Either part may be mirrored. Lengths are
drawn from a log-normal population. A share of people is laid down or turned anyhow, because
photographs have them and motion capture hardly does. Samples outside learned limits
(:mod:`library_store.limits`) are drawn again.

The parameters are one ``.npz`` with a JSON card beside it that names data, licence and measures.
"""

from __future__ import annotations

import hashlib
import io
import json
from dataclasses import dataclass
from pathlib import Path
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
from library_store.errors import LibraryError
from library_store.limits import Limits
from library_store.mixture import GaussianMixture

DEFAULT_PRIOR = Path(__file__).parent / "prior_data" / "cmu.npz"
"""The prior that the default library is sampled from."""

_UP = slice(N_LEGS - 3, N_LEGS)
_ROUNDS = 50


@dataclass(frozen=True)
class PriorCard:
    """Who a prior is: its name and version, the sources it was fitted on, and free notes."""

    name: str
    version: str
    licences: tuple[dict[str, str], ...]
    notes: dict[str, object]


@dataclass(frozen=True)
class PosePrior:
    """p(X): mixtures over the parts, their co-occurrence, lengths and limits.

    ``partners``: (K legs, K upper), row sums 1, how often an upper body goes with the legs.
    ``log_lengths``: a single Gaussian over log lengths in mm. ``lying`` and ``anyhow``: shares of
    people whose body is turned to the horizontal, or uniformly. ``sha256`` is that of the file.
    """

    legs: GaussianMixture
    upper: GaussianMixture
    partners: Float
    log_lengths: GaussianMixture
    limits: Limits
    coupling: float
    lying: float
    anyhow: float
    card: PriorCard
    sha256: str

    @classmethod
    def load(cls, path: Path = DEFAULT_PRIOR) -> PosePrior:
        """Read ``path`` (.npz) and its card (.json); ``LibraryError`` when either is unusable."""
        try:
            blob = path.read_bytes()
            with np.load(io.BytesIO(blob), allow_pickle=False) as arrays:
                table = {name: arrays[name].astype(np.float64) for name in arrays.files}
            fields = json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))
            card = PriorCard(
                name=fields["name"],
                version=fields["version"],
                licences=tuple(fields["licences"]),
                notes=fields,
            )
            return cls(
                legs=_unpack(table, "legs"),
                upper=_unpack(table, "upper"),
                log_lengths=_unpack(table, "log_lengths"),
                partners=_rows_to_one(table["partners"]),
                limits=Limits(low=table["limits_low"], high=table["limits_high"]),
                coupling=float(table["coupling"]),
                lying=float(table["lying"]),
                anyhow=float(table["anyhow"]),
                card=card,
                sha256=hashlib.sha256(blob).hexdigest(),
            )
        except (OSError, ValueError, KeyError, EOFError, BadZipFile) as error:
            raise LibraryError(
                f"the pose prior {path} (with its card {path.with_suffix('.json').name}) cannot be "
                f"read: {error}; restore both files from the repository or the package"
            ) from error

    def sample(self, n: int, rng: np.random.Generator) -> Float:
        """Draw ``n`` poses: (n, 14, 3) float64 mm, root-centred, Y up, heading along +Z.

        The same generator state gives the same poses. Raises ``RuntimeError`` if the limits refuse
        nearly everything, which only a broken prior does.
        """
        accepted: list[Float] = []
        missing = n
        for _ in range(_ROUNDS):
            drawn = self._draw(missing + missing // 4 + 8, rng)
            accepted.append(drawn[self.limits.allow(drawn)][:missing])
            missing -= len(accepted[-1])
            if not missing:
                return np.concatenate(accepted)
        raise RuntimeError(f"the limits of prior {self.card.name} refuse nearly every sample")

    def acceptance(self, n: int, rng: np.random.Generator) -> float:
        """The share of ``n`` drawn poses that is kept: directions about unit, limits observed."""
        drawn = self._draw(n, rng)
        return float(self.limits.allow(drawn).sum() / n)

    def _draw(self, n: int, rng: np.random.Generator) -> Float:
        """At most ``n`` poses that are not yet held against the limits."""
        legs_of = _choose(np.broadcast_to(self.legs.weights, (n, self.legs.n_components)), rng)
        coupled = rng.random(n) < self.coupling
        chances = np.where(coupled[:, None], self.partners[legs_of], self.upper.weights)
        upper_of = _choose(chances, rng)
        legs, upper = self.legs.draw(legs_of, rng), self.upper.draw(upper_of, rng)
        flip_legs, other_flip = rng.random((2, n)) < 0.5
        flip_upper = np.where(coupled, flip_legs, other_flip)
        legs = np.where(flip_legs[:, None], mirror_legs(legs), legs)
        upper = np.where(flip_upper[:, None], mirror_upper(upper), upper)
        legs[:, _UP] = self._turn(legs, rng)
        first = np.zeros(n, dtype=np.int64)
        lengths = np.exp(self.log_lengths.draw(first, rng))
        possible = _near_unit(legs, range(0, N_LEGS - 3, 3)) & _near_unit(upper, range(8, 23, 3))
        parts = BodyParts(legs=legs[possible], upper=upper[possible])
        return decode(parts, lengths[possible])

    def _turn(self, legs: Float, rng: np.random.Generator) -> Float:
        """The direction of up (n, 3) in the pelvis frame, with some people laid down or turned."""
        n = len(legs)
        anyhow = unit(rng.standard_normal((n, 3)))
        # Lying on any side: up is square to the trunk, give or take 15 degrees.
        lying = anyhow * np.array([1.0, 0.0, 1.0])
        lying = unit(lying) + np.array([0.0, 1.0, 0.0]) * rng.normal(0.0, 0.26, (n, 1))
        kind = rng.random((n, 1))
        turned = np.where(kind < self.lying + self.anyhow, anyhow, unit(legs[:, _UP]))
        return np.where(kind < self.lying, unit(lying), turned)


def save_prior(prior: PosePrior, path: Path) -> None:
    """Write ``path`` (.npz, the same bytes for the same numbers) and its card (.json)."""
    table: dict[str, NDArray[np.generic]] = {
        "partners": prior.partners.astype(np.float16),
        "limits_low": prior.limits.low.astype(np.float32),
        "limits_high": prior.limits.high.astype(np.float32),
        "coupling": np.array(prior.coupling),
        "lying": np.array(prior.lying),
        "anyhow": np.array(prior.anyhow),
    }
    for part in ("legs", "upper", "log_lengths"):
        mixture: GaussianMixture = getattr(prior, part)
        rows, columns = np.tril_indices(mixture.means.shape[1])
        table[f"{part}_weights"] = mixture.weights.astype(np.float32)
        table[f"{part}_means"] = mixture.means.astype(np.float32)
        table[f"{part}_factors"] = mixture.factors[:, rows, columns].astype(np.float16)
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(path, allow_pickle=False, **table)
    text = json.dumps(prior.card.notes, indent=2, ensure_ascii=False) + "\n"
    path.with_suffix(".json").write_text(text, encoding="utf-8")


def _unpack(table: dict[str, Float], part: str) -> GaussianMixture:
    means = table[f"{part}_means"]
    k, d = means.shape
    rows, columns = np.tril_indices(d)
    factors = np.zeros((k, d, d))
    factors[:, rows, columns] = table[f"{part}_factors"]
    weights = table[f"{part}_weights"]
    return GaussianMixture(weights=weights / weights.sum(), means=means, factors=factors)


def _rows_to_one(counts: Float) -> Float:
    rows: Float = counts / counts.sum(axis=1, keepdims=True)
    return rows


def _choose(chances: Float, rng: np.random.Generator) -> NDArray[np.int64]:
    """One column per row of chances (n, K), whose rows sum to 1: (n,)."""
    thresholds = np.cumsum(chances, axis=1)
    spin = rng.random((len(chances), 1)) * thresholds[:, -1:]
    chosen: NDArray[np.int64] = (thresholds <= spin).sum(axis=1)
    return chosen


def _near_unit(parts: Float, starts: range) -> NDArray[np.bool_]:
    """Whether every sampled direction is about unit: one that is not lies between two modes."""
    lengths = np.stack([np.linalg.norm(parts[:, at : at + 3], axis=1) for at in starts])
    return np.asarray(((lengths > 0.75) & (lengths < 1.25)).all(axis=0))
