"""Draw the plots of reports, as SVG.

Curves differ in dash and marker as well as in colour, so that they can be told apart without colour vision.
"""

import io
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7")
STYLES = ("-", "--", "-.", ":")
MARKERS = ("o", "s", "^", "D")
CURVE_POINTS = 2000  # of a loss curve, about; a run may have millions of steps
Points = Sequence[tuple[int, float]] | NDArray[np.float64]  # (N, 2): training steps, and a value at each
SIX_COLOURS = (*COLOURS, "#56b4e9", "#555555")  # of plots with more curves


def loss_curves(training: Mapping[str, Points], validation: Mapping[str, Points], label: str) -> bytes:
    """Plot losses over training, one curve a robot: training as a running mean, evaluations as markers.

    Args:
        training, validation: robot -> its losses.
        label: the label of the losses' axis.
    """
    figure, axes = labelled_axes("training step", label)
    for i, name in enumerate(sorted(training)):
        colour, style = COLOURS[i % len(COLOURS)], STYLES[i // len(COLOURS) % len(STYLES)]
        steps, losses = np.array(training[name], float).T
        width = max(1, len(losses) // 40)  # of the running mean
        every = max(1, len(losses) // CURVE_POINTS)
        means = sliding_window_view(losses, width)[::every].mean(axis=1)
        axes.plot(steps[width - 1 :: every], means, color=colour, ls=style, lw=1.6, label=name)
        if name in validation:
            steps, losses = np.array(validation[name], float).T
            axes.plot(steps, losses, MARKERS[i % len(MARKERS)], color=colour, ms=5)
    axes.legend(frameon=False, fontsize=9, ncols=1 + len(training) // 8)
    return svg_bytes(figure)


def course(points: Points, label: str, log: bool = False) -> bytes:
    """Plot values over training, on a logarithmic axis if `log` is set."""
    figure, axes = labelled_axes("training step", label)
    steps, values = np.array(points if len(points) else [(0, np.nan)], float).T
    axes.plot(steps, values, color=COLOURS[0], lw=1.2)
    if log and (values > 0).any():
        axes.set_yscale("log")
    return svg_bytes(figure)


def over_horizon(
    curves: Mapping[str, tuple[Sequence[float], Sequence[Sequence[float]]]],
    seconds_per_frame: float,
    unit: str,
) -> bytes:
    """Plot means of each predicted frame, with a band for their intervals.

    Args:
        curves: name -> (the mean, and the ends of its interval, of each frame after the prompt).
        seconds_per_frame: seconds between frames of the model.
        unit: the label of the values' axis.
    """
    figure, axes = labelled_axes("seconds after the prompt", unit)
    for i, (name, (values, ends)) in enumerate(curves.items()):
        time = seconds_per_frame * np.arange(1, len(values) + 1)
        colour, (low, high) = SIX_COLOURS[i % len(SIX_COLOURS)], np.array(ends, float).T
        style, marker = STYLES[i % len(STYLES)], MARKERS[i % len(MARKERS)]
        axes.plot(time, values, color=colour, ls=style, marker=marker, ms=5, label=name)
        axes.fill_between(time, low, high, color=colour, alpha=0.15, lw=0)
    handles = axes.get_legend_handles_labels()
    figure.legend(*handles, loc="outside upper left", frameon=False, fontsize=9, ncols=2)
    return svg_bytes(figure)


def labelled_axes(x: str, y: str, size: tuple[float, float] = (7.2, 3.4)) -> "tuple[Figure, Axes]":
    """Return a figure of that size in inches with one plot, and the plot's axes."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots()
    label_axes(axes, x, y)
    return figure, axes


def label_axes(axes: "Axes", x: str, y: str = "") -> None:
    """Label the axes of a plot, and give them the look of our plots."""
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)


def svg_bytes(figure: "Figure") -> bytes:
    """Return a figure as the bytes of an SVG, which are the same for the same figure."""
    import matplotlib

    buffer = io.BytesIO()
    with matplotlib.rc_context({"svg.hashsalt": "hma", "svg.fonttype": "path"}):
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    return buffer.getvalue()
