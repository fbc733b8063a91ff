"""Plots of the data side: axes with units, readable in light and dark and without colour vision."""

from pathlib import Path

import numpy as np

from hma_data.files import atomic_path
from hma_data.mixture import Mixture

BLUE, ORANGE, GREY = "#0072b2", "#e69f00", "#888888"


def plot_mixture(mixture: Mixture, temperature: float, path: Path) -> None:
    """Bars of the probabilities beside what proportional sampling would give.

    Args:
        path: its suffix decides the format: .png, .svg, .pdf.
    """
    from matplotlib.figure import Figure

    names, count = mixture.names, len(mixture.names)
    proportional = np.array(mixture.counts) / max(1, sum(mixture.counts))
    figure = Figure(figsize=(7, 1.2 + 0.42 * count), layout="constrained")
    axes = figure.subplots()
    place = np.arange(count)
    axes.barh(place - 0.19, mixture.p, 0.36, color=BLUE, label=f"drawn, τ = {temperature:g}")
    axes.barh(
        place + 0.19,
        proportional,
        0.36,
        color=ORANGE,
        hatch="//",
        edgecolor="white",
        label="share of windows",
    )
    for i, (p, n) in enumerate(zip(mixture.p, mixture.counts)):
        axes.text(p, i - 0.19, f" {p:.3f}", va="center", fontsize=8)
        axes.text(proportional[i], i + 0.19, f" {n:,} windows", va="center", fontsize=8, color=GREY)
    axes.set_yticks(place, names)
    axes.invert_yaxis()
    axes.set_xlim(0, min(1.0, 1.25 * max(mixture.p.max(), proportional.max())))
    axes.set_xlabel("probability of a sample")
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize=8, loc="lower left", bbox_to_anchor=(0, 1), ncols=2)
    with atomic_path(path) as part:
        figure.savefig(part, format=path.suffix.lstrip(".") or "png", dpi=150)
