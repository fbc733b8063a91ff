"""Plot training and rollouts as SVG; curves differ in dash and marker as well as in colour."""

import io
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Values = NDArray[np.floating[Any]]
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7")
STYLES = ("-", "--", "-.", ":")
MARKERS = ("o", "s", "^", "D")


def loss_curve(
    training: Sequence[tuple[int, float]], validation: Sequence[tuple[int, float]], baseline: float | None
) -> bytes:
    """Plot the training loss with its running mean, the validation loss, and the token-frequency baseline.

    Args:
        training, validation: (step, nats a token).
        baseline: nats a token; None leaves it out.
    """
    figure, axes = _axes("training step", "loss, nats a token")
    if training:
        steps, losses = np.array(training, float).T
        axes.plot(steps, losses, color=COLOURS[0], alpha=0.25, lw=0.8)
        axes.plot(
            *_running_mean(steps, losses, 30), color=COLOURS[0], lw=1.8, label="training (masked tokens)"
        )
    if validation:
        steps, losses = np.array(validation, float).T
        axes.plot(steps, losses, "s--", color=COLOURS[1], ms=5, label="validation (whole frames masked)")
    if baseline is not None:
        axes.axhline(baseline, color="#555555", ls=":", label="baseline: token frequencies alone")
    axes.legend(frameon=False, fontsize=9)
    return _svg(figure)


def losses_by_robot(
    training: Mapping[str, Sequence[tuple[int, float]]],
    validation: Mapping[str, Sequence[tuple[int, float]]],
    label: str,
) -> bytes:
    """Plot the losses of each robot: training as a running mean, evaluations as markers.

    Args:
        training, validation: robot -> (step, loss).
        label: the label of the losses' axis.
    """
    figure, axes = _axes("training step", label)
    for i, name in enumerate(sorted(training)):
        colour, style = COLOURS[i % len(COLOURS)], STYLES[i // len(COLOURS) % len(STYLES)]
        steps, losses = np.array(training[name], float).T
        axes.plot(*_running_mean(steps, losses, 40), color=colour, ls=style, lw=1.6, label=name)
        if validation.get(name):
            steps, losses = np.array(validation[name], float).T
            axes.plot(steps, losses, MARKERS[i % len(MARKERS)], color=colour, ms=5)
    axes.legend(frameon=False, fontsize=9, ncols=1 + len(training) // 8)
    return _svg(figure)


def course(points: Sequence[tuple[int, float]], label: str, log: bool = False) -> bytes:
    """Plot one figure over the steps of a run.

    Args:
        points: (step, value).
        label: the label of the value's axis, with its unit.
        log: draw the values on a logarithmic axis.
    """
    figure, axes = _axes("training step", label)
    steps, values = np.array(points or [(0, np.nan)], float).T
    axes.plot(steps, values, color=COLOURS[0], lw=1.2)
    if log and (values > 0).any():
        axes.set_yscale("log")
    return _svg(figure)


def psnr_over_horizon(curves: Mapping[str, Sequence[float]], seconds_per_frame: float) -> bytes:
    """Plot the PSNR of each predicted frame.

    Args:
        curves: name -> PSNR in dB of each frame after the prompt.
        seconds_per_frame: seconds between frames of the model.
    """
    figure, axes = _axes("seconds after the prompt", "PSNR, dB")
    for i, (name, values) in enumerate(curves.items()):
        time = seconds_per_frame * np.arange(1, len(values) + 1)
        axes.plot(time, values, color=COLOURS[i], ls=STYLES[i], marker=MARKERS[i], ms=5, label=name)
    axes.legend(frameon=False, fontsize=9)
    return _svg(figure)


def _running_mean(steps: Values, values: Values, parts: int) -> tuple[Values, Values]:
    """Return steps and running means; each mean covers a `parts`-th of all values."""
    width = max(1, len(values) // parts)
    return steps[width - 1 :], np.convolve(values, np.ones(width) / width, "valid")


def _axes(x: str, y: str) -> "tuple[Figure, Axes]":
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.2, 3.4), layout="constrained")
    axes = figure.subplots()
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)
    return figure, axes


def _svg(figure: "Figure") -> bytes:
    import matplotlib

    buffer = io.BytesIO()
    with matplotlib.rc_context({"svg.hashsalt": "hma", "svg.fonttype": "path"}):
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    return buffer.getvalue()
