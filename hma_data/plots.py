"""Plots of the data side: axes with units, readable in light and dark and without colour vision."""

from typing import Any

import numpy as np

from hma_data.files import atomic_path
from hma_data.mixture import Mixture
from hma_data.paths import StrPath, as_path

BLUE, ORANGE, GREY = "#0072b2", "#e69f00", "#666666"
LONGEST_NAME = 34


def plot_mixture(mixture: Mixture, temperature: float, path: StrPath) -> None:
    """Bars of the probabilities beside what proportional sampling would give; the largest set on top.

    Args:
        path: str or path of the file to write; its suffix decides the format: .png, .svg, .pdf.
    """
    from matplotlib.figure import Figure

    path = as_path(path)
    order = np.argsort(-np.array(mixture.counts), kind="stable")
    counts, p = np.array(mixture.counts)[order], mixture.p[order]
    proportional = counts / max(1, counts.sum())
    place, few = np.arange(len(order)), len(order) <= 12
    figure = Figure(figsize=(8, 1.2 + (0.42 if few else 0.27) * len(order)), layout="constrained")
    axes = figure.subplots()
    axes.barh(place - 0.2, p, 0.4, color=BLUE, label=f"drawn, τ = {temperature:g}")
    style: dict[str, Any] = {"color": ORANGE, "hatch": "////", "edgecolor": "white", "linewidth": 0}
    axes.barh(place + 0.2, proportional, 0.4, label="share of windows", **style)
    largest = np.maximum(p, proportional)
    for i, count in enumerate(counts):
        text = f"{p[i]:.3f}; {count:,} windows"
        place_of = (float(largest[i]), i)
        axes.annotate(text, place_of, (4, 0), textcoords="offset points", va="center", fontsize=7, color=GREY)
    axes.set_yticks(place, [_short(mixture.names[i]) for i in order], fontsize=9 if few else 7)
    axes.set_ylim(len(order) - 0.4, -0.6)
    axes.set_xlim(0, 1.45 * largest.max())
    axes.set_xticks([tick for tick in axes.get_xticks() if tick <= min(1.0, 1.45 * largest.max())])
    axes.set_xlabel("probability of a sample")
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize=8, loc="lower left", bbox_to_anchor=(0, 1), ncols=2)
    with atomic_path(path) as part:
        figure.savefig(part, format=path.suffix.lstrip(".").lower() or "png", dpi=150)


def _short(name: str) -> str:
    """The name, its middle left out where it is long: both ends tell robots apart."""
    if len(name) <= LONGEST_NAME:
        return name
    half = LONGEST_NAME // 2
    return f"{name[:half]}…{name[1 - half :]}"
