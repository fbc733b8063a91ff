"""Draw embodiments by the paper's inverse-exponential mixture.

p_i = n_i^(1/τ) / Σ_j n_j^(1/τ), where n is the number of training windows (paper section 3.2; the
released code draws with τ = 3 in training, 4 in validation). τ = 1 is proportional, τ → ∞ uniform.
Draws are a pure function of (seed, step), so every rank and worker can compute all of them.

E embodiments, B samples a batch.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np

from hma_data.arrays import Floats, Indices, Ints
from hma_data.errors import UsageError
from hma_data.storage.files import atomic_path
from hma_data.storage.paths import StrPath, as_path

Draw = Literal["per_sample", "per_batch"]
BLUE, ORANGE, GREY = "#0072b2", "#e69f00", "#666666"  # told apart without colour vision
LONGEST_NAME = 34
TEMPERATURES = {"train": 3.0, "val": 4.0}  # τ of the paper's code, by split


def epoch_caps(counts: Sequence[int], max_epochs: float, samples: int) -> Floats:
    """Return the probabilities (E,) above which `samples` draws pass over a set more than `max_epochs` times.

    Raises:
        UsageError: so many samples cannot be drawn.
    """
    if not max_epochs > 0 or samples < 1:
        fault = f"must be above 0, for at least 1 sample; it is {max_epochs} for {samples}"
        raise UsageError("mixture max_epochs", fault)
    windows = sum(counts)
    most = int(max_epochs * windows)
    if samples > max_epochs * windows:
        fault = f"{max_epochs:g} passes over {windows:,} windows are fewer than {samples:,} planned samples"
        remedy = f"allow {samples / max(1, windows):.3g} passes, or plan {most:,} samples"
        raise UsageError("mixture max_epochs", fault, remedy)
    return np.minimum(1.0, max_epochs * np.asarray(counts, np.float64) / samples)


def _capped(share: Floats, limit: Floats) -> Floats:
    if limit[share > 0].sum() < 1 - 1e-12:
        fault = f"sum to {limit[share > 0].sum():g}; probabilities must sum to 1"
        raise UsageError("mixture caps", fault, "raise a cap")
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
    draw: Draw = "per_sample"
    seed: int = 0

    @classmethod
    def of(
        cls,
        counts: Mapping[str, int],
        temperature: float = 3.0,
        *,
        weights: Mapping[str, float] | None = None,
        groups: Mapping[str, str] | None = None,
        caps: Mapping[str, float] | None = None,
        max_epochs: float | None = None,
        samples: int | None = None,
        draw: Draw = "per_sample",
        seed: int = 0,
    ) -> "Mixture":
        """Return the mixture over named counts.

        Args:
            counts: embodiment -> training windows.
            temperature: τ above; math.inf is uniform.
            weights: embodiment or group -> factor on its probability; 1 where not named.
            groups: embodiment -> group; an embodiment that is not named is a group of its own. Groups get
                equal shares, and the rule above divides the share of a group.
            caps: embodiment -> its largest probability; what is cut goes to the others in proportion.
            max_epochs: most passes over any one embodiment while `samples` are drawn in all.

        Raises:
            UsageError: a name is unknown, a value is out of range, there are no windows, or the caps sum to
                less than one.
        """
        weights, groups, caps = weights or {}, groups or {}, caps or {}
        group = {name: groups.get(name, name) for name in counts}
        labels = set(group.values()) if groups else set()
        allowed = {"groups": counts.keys(), "weights": counts.keys() | labels, "caps": counts.keys()}
        for what, named in (("groups", groups), ("weights", weights), ("caps", caps)):
            if unknown := sorted(named.keys() - allowed[what]):
                fault = f"name {', '.join(unknown)}, which the mixture does not have"
                raise UsageError(f"mixture {what}", fault)
        for what, factors in (("weights", weights), ("caps", caps)):
            if not all(0 <= factor < math.inf for factor in factors.values()):
                raise UsageError(f"mixture {what}", f"must be numbers of at least 0, not {dict(factors)}")
        if seed < 0:
            raise UsageError("mixture seed", f"must be at least 0, not {seed}")
        share = _shares(list(counts.values()), temperature)
        share *= np.array([weights.get(name, 1.0) for name in counts])
        for label in dict.fromkeys(group.values()) if groups else ():
            members = np.array([group[name] == label for name in counts])
            if share[members].sum() > 0:
                # Where a group has the name of a member, the weight of that name is the member's.
                within = label in counts and label in groups.values()
                factor = 1.0 if within else weights.get(label, 1.0)
                share[members] *= factor / share[members].sum()
        if share.sum() <= 0:
            raise UsageError("mixture weights", "leave nothing to draw", "give a weight above 0")
        share /= share.sum()
        if caps or max_epochs is not None:
            limits = np.array([caps.get(name, 1.0) for name in counts])
            if max_epochs is not None:
                limits = np.minimum(limits, epoch_caps(list(counts.values()), max_epochs, samples or 0))
            share = _capped(share, limits)
        return cls(tuple(counts), tuple(counts.values()), share, draw, seed)

    @cached_property
    def _edges(self) -> Floats:
        edges = np.cumsum(self.p)
        edges[-1] = 1.0
        return edges

    def batch(self, step: int, size: int) -> Ints:
        """Return the index (B,) of each sample's embodiment in batch `step`, the same in every process."""
        rng = np.random.Generator(np.random.Philox(key=[self.seed, step]))
        draws = np.searchsorted(
            self._edges, rng.random(1 if self.draw == "per_batch" else size), side="right"
        )
        return np.broadcast_to(draws, (size,)).astype(np.int64)

    def table(self, drawn: Indices) -> list[dict[str, float | str | int]]:
        """Return a table of what was drawn beside what was intended.

        Args:
            drawn: (E,) samples of each embodiment.

        Returns:
            One row per embodiment: intended and realised share, samples, passes over its windows.
        """
        total = max(1, int(np.sum(drawn)))
        return [
            {
                "embodiment": name,
                "windows": count,
                "intended": float(p),
                "realised": int(samples) / total,
                "samples": int(samples),
                "passes": int(samples) / max(1, count),
            }
            for name, count, p, samples in zip(self.names, self.counts, self.p, drawn, strict=True)
        ]


def _shares(counts: Sequence[int], temperature: float) -> Floats:
    """Return n^(1/τ) of each embodiment, relative to the largest: there is no overflow at any count."""
    n = np.asarray(counts, np.float64)
    if not len(n) or n.max() <= 0 or n.min() < 0:
        raise UsageError("mixture", f"needs windows to draw from, but the counts are {list(counts)}")
    if not temperature > 0:
        raise UsageError("mixture temperature", f"must be above 0, not {temperature}")
    share = np.zeros_like(n)
    present = n > 0
    share[present] = np.exp((np.log(n[present]) - np.log(n.max())) / temperature)
    return share


def plot_mixture(mixture: Mixture, temperature: float, path: StrPath) -> None:
    """Plot the probabilities as bars beside those of proportional sampling, with the largest set on top.

    Args:
        path: str or path of the file to write; its suffix decides the format: .png, .svg, .pdf.
    """
    from matplotlib.figure import Figure

    path = as_path(path)
    order = np.argsort(-np.array(mixture.counts), kind="stable")
    counts, p = np.array(mixture.counts)[order], mixture.p[order]
    proportional = counts / max(1, counts.sum())
    row, few = np.arange(len(order)), len(order) <= 12
    figure = Figure(figsize=(8, 1.2 + (0.42 if few else 0.27) * len(order)), layout="constrained")
    axes = figure.subplots()
    axes.barh(row - 0.2, p, 0.4, color=BLUE, label=f"drawn, τ = {temperature:g}")
    style: dict[str, Any] = {"color": ORANGE, "hatch": "////", "edgecolor": "white", "linewidth": 0}
    axes.barh(row + 0.2, proportional, 0.4, label="share of windows", **style)
    largest = np.maximum(p, proportional)
    for i, count in enumerate(counts):
        text = f"{p[i]:.3f}; {count:,} windows"
        end = (float(largest[i]), i)
        axes.annotate(text, end, (4, 0), textcoords="offset points", va="center", fontsize=7, color=GREY)
    axes.set_yticks(row, [_short(mixture.names[i]) for i in order], fontsize=9 if few else 7)
    axes.set_ylim(len(order) - 0.4, -0.6)
    axes.set_xlim(0, 1.45 * largest.max())
    axes.set_xticks([tick for tick in axes.get_xticks() if tick <= min(1.0, 1.45 * largest.max())])
    axes.set_xlabel("probability of a sample")
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize=8, loc="lower left", bbox_to_anchor=(0, 1), ncols=2)
    with atomic_path(path) as part:
        figure.savefig(part, format=path.suffix.lstrip(".").lower() or "png", dpi=150)


def _short(name: str) -> str:
    """Return the name, without its middle where it is long: both ends distinguish robots."""
    if len(name) <= LONGEST_NAME:
        return name
    half = LONGEST_NAME // 2
    return f"{name[:half]}…{name[1 - half :]}"
