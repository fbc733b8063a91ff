"""How often each embodiment is drawn: the paper's inverse-exponential mixture.

p_i = n_i^(1/τ) / Σ_j n_j^(1/τ), n the number of training windows (paper section 3.2; the
released code draws with τ = 3 in training, 4 in validation). τ = 1 is proportional, τ → ∞
uniform. Draws are a pure function of (seed, step), so every rank and worker knows them all.

E embodiments, B samples a batch.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hma_data.errors import UsageError

Floats = NDArray[np.float64]


def probabilities(
    counts: Sequence[int] | NDArray[np.int64],
    temperature: float = 3.0,
    *,
    weights: Sequence[float] | None = None,
    groups: Sequence[str] | None = None,
    caps: Sequence[float] | None = None,
) -> Floats:
    """The probability (E,) of each embodiment; they sum to one.

    Args:
        counts: training windows of each.
        temperature: τ above; math.inf is uniform.
        weights: multiply the probabilities before they are normalized.
        groups: names; each group gets an equal share, shared inside it by the rule above.
        caps: no probability exceeds its cap; what is cut goes to the others in proportion.

    Raises:
        UsageError: a value out of range, no windows at all, or caps that leave less than one.
    """
    n = np.asarray(counts, np.float64)
    if not len(n) or n.max() <= 0 or n.min() < 0:
        raise UsageError("mixture", f"needs windows to draw from, has {[int(c) for c in n]}")
    if not temperature > 0:
        raise UsageError("mixture temperature", f"must be above 0, is {temperature}")
    share = np.zeros_like(n)
    present = n > 0
    share[present] = np.exp((np.log(n[present]) - np.log(n.max())) / temperature)  # no overflow at any count
    if weights is not None:
        factor = np.asarray(weights, np.float64)
        if len(factor) != len(n) or not np.isfinite(factor).all() or (factor < 0).any():
            raise UsageError(
                "mixture weights", f"must be {len(n)} numbers of at least 0, are {list(weights)}"
            )
        share *= factor
    if share.sum() <= 0:
        raise UsageError("mixture weights", "leave nothing to draw")
    if groups is not None:
        for name in dict.fromkeys(groups):
            members = np.array([group == name for group in groups])
            if share[members].sum() > 0:
                share[members] /= share[members].sum()
    share /= share.sum()
    return _capped(share, caps) if caps is not None else share


def _capped(share: Floats, caps: Sequence[float]) -> Floats:
    limit = np.asarray(caps, np.float64)
    if limit[share > 0].sum() < 1 - 1e-12:
        raise UsageError("mixture caps", f"sum to {limit[share > 0].sum():g}, so not everything can be drawn")
    fixed = np.zeros(len(share), bool)
    while True:
        over = ~fixed & (share > limit + 1e-15)
        if not over.any():
            return share
        fixed |= over
        share = np.where(fixed, limit, share)
        free = ~fixed
        if share[free].sum() > 0:
            share[free] *= (1 - limit[fixed].sum()) / share[free].sum()


@dataclass(frozen=True)
class Mixture:
    """Named embodiments with their probabilities, and the draw.

    Attributes:
        names: of the E embodiments.
        counts: (E,) training windows.
        p: (E,) probabilities.
        draw: per sample (the paper's text) or per batch (its code).
        seed: of the draw.
    """

    names: tuple[str, ...]
    counts: tuple[int, ...]
    p: Floats
    draw: Literal["per_sample", "per_batch"] = "per_sample"
    seed: int = 0

    @classmethod
    def of(
        cls,
        counts: Mapping[str, int],
        temperature: float = 3.0,
        *,
        weights: Mapping[str, float] | None = None,
        draw: Literal["per_sample", "per_batch"] = "per_sample",
        seed: int = 0,
    ) -> "Mixture":
        """The mixture over named counts; see `probabilities`."""
        unknown = set(weights or {}) - set(counts)
        if unknown:
            raise UsageError(
                "mixture weights", f"name {', '.join(sorted(unknown))}, which is not in the mixture"
            )
        factors = [(weights or {}).get(name, 1.0) for name in counts]
        p = probabilities(list(counts.values()), temperature, weights=factors)
        return cls(tuple(counts), tuple(counts.values()), p, draw, seed)

    def batch(self, step: int, size: int) -> NDArray[np.int64]:
        """(B,) which embodiment each sample of batch `step` comes from; the same wherever it is asked."""
        rng = np.random.Generator(np.random.Philox(key=[self.seed, step]))
        edges = np.cumsum(self.p)
        edges[-1] = 1.0
        draws = np.searchsorted(edges, rng.random(1 if self.draw == "per_batch" else size), side="right")
        return np.broadcast_to(draws, (size,)).astype(np.int64)


@dataclass
class Realised:
    """Counts what was drawn, to hold it against what was intended."""

    mixture: Mixture
    drawn: dict[str, int] = field(default_factory=dict)

    def add(self, names: Sequence[str]) -> None:
        """Samples of one batch."""
        for name in names:
            self.drawn[name] = self.drawn.get(name, 0) + 1

    def table(self) -> list[dict[str, float | str | int]]:
        """One row an embodiment: intended and realised share, samples, passes over its windows."""
        total = max(1, sum(self.drawn.values()))
        return [
            {
                "embodiment": name,
                "windows": count,
                "intended": float(p),
                "realised": self.drawn.get(name, 0) / total,
                "samples": self.drawn.get(name, 0),
                "passes": self.drawn.get(name, 0) / max(1, count),
            }
            for name, count, p in zip(self.mixture.names, self.mixture.counts, self.mixture.p)
        ]
