"""Build a report as one self-contained HTML page: text, tables, pictures and plots in sections.

Pictures are embedded, so opening the page fetches nothing. The page is readable in light and dark mode. Plots
are SVG; their curves differ in dash and marker as well as in colour.
"""

import base64
import html
import io
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7")
STYLES = ("-", "--", "-.", ":")
MARKERS = ("o", "s", "^", "D")
SIX = (*COLOURS, "#56b4e9", "#555555")  # of plots with more curves

_STYLE = """
:root { --ink:#1d2430; --soft:#5b6675; --paper:#ffffff; --card:#f5f7fa; --line:#d9dfe7; --accent:#0072b2 }
@media (prefers-color-scheme: dark) {
  :root { --ink:#e6eaf0; --soft:#9aa6b5; --paper:#12161c; --card:#1b212a; --line:#323b48; --accent:#56b4e9 }
}
* { box-sizing:border-box }
body { margin:0 auto; max-width:1080px; padding:2rem 1.25rem 4rem; background:var(--paper);
  color:var(--ink); font:16px/1.55 system-ui, sans-serif }
h1 { font-size:1.9rem; margin:0 0 .3rem } h2 { font-size:1.25rem; margin:2.6rem 0 .4rem }
h1, h2, h3, p, figcaption, span { overflow-wrap:anywhere }
p { max-width:48rem } .soft, figcaption, th { color:var(--soft) } a { color:var(--accent) }
.figures { display:grid; grid-template-columns:repeat(auto-fit, minmax(160px, 1fr)); gap:.75rem;
  margin:1.4rem 0 }
.figures div { background:var(--card); border:1px solid var(--line); border-radius:10px;
  padding:.7rem .9rem }
.figures b { display:block; font-size:1.3rem; white-space:nowrap; font-variant-numeric:tabular-nums }
.figures span { color:var(--soft); font-size:.86rem }
.scroll { overflow-x:auto;  /* a shadow at the edge says that columns go on beyond it */
  background:linear-gradient(90deg, var(--paper) 50%, transparent) left / 3rem 100% no-repeat local,
    linear-gradient(270deg, var(--paper) 50%, transparent) right / 3rem 100% no-repeat local,
    linear-gradient(90deg, var(--line), transparent) left / 1rem 100% no-repeat scroll,
    linear-gradient(270deg, var(--line), transparent) right / 1rem 100% no-repeat scroll }
table { border-collapse:collapse; margin:.6rem 0; font-variant-numeric:tabular-nums }
th, td { text-align:left; padding:.34rem .9rem .34rem 0; border-bottom:1px solid var(--line);
  white-space:nowrap } th { white-space:normal }
td.n, th.n { text-align:right } td { vertical-align:top }
td small { color:var(--soft) } small { display:inline-block; line-height:1.35; font-weight:400 }
td:first-child small { white-space:normal; min-width:6.5rem }
.dense { font-size:.8rem } .dense th { font-size:.76rem } .dense th, .dense td { padding-right:.55rem }
.dense small { font-size:.66rem } th { font-weight:600; font-size:.86rem }
figure { margin:1rem 0 } figcaption { font-size:.9rem; margin-top:.3rem; max-width:48rem }
img { max-width:100%; height:auto; border-radius:8px; border:1px solid var(--line) }
.plot img { background:#fff; padding:.5rem }
dl { display:grid; grid-template-columns:fit-content(16rem) 1fr; gap:.2rem 1rem; font-size:.9rem }
dt { font-weight:600; min-width:8rem; overflow-wrap:anywhere }
dd { margin:0; color:var(--soft); overflow-wrap:anywhere }
h3 { font-size:1rem; margin:1.6rem 0 0 } h3 + p { margin:.1rem 0 .5rem }
.strips { display:grid; grid-template-columns:8.5rem 1fr; gap:.3rem .8rem; align-items:center }
.strips span { color:var(--soft); font-size:.86rem } .strips img { display:block; border-radius:4px }
@media (max-width:640px) { .strips, dl { grid-template-columns:1fr; gap:.15rem } .strips img, dd
  { margin-bottom:.5rem } table:not(.dense) { font-size:.75rem }
  table:not(.dense) :is(th, td) { padding-right:.4rem; font-size:inherit }
  table:not(.dense) td:first-child { white-space:normal; overflow-wrap:anywhere; min-width:5rem } }
pre { background:var(--card); border:1px solid var(--line); border-radius:10px; padding:.8rem 1rem;
  overflow-x:auto; font:13.5px/1.5 ui-monospace, monospace }
"""


class Page:
    """A page; every method but `html` adds to its end.

    Args:
        title: the title of the page.
        lead: a sentence below the title.
    """

    def __init__(self, title: str, lead: str) -> None:
        self._title = title
        self._parts = [f"<h1>{_text(title)}</h1><p class=soft>{_text(lead)}</p>"]

    def figures(self, values: Sequence[tuple[str, str]]) -> None:
        """Add key figures as tiles: (value, description)."""
        tiles = [f"<div><b>{_text(value)}</b><span>{_text(name)}</span></div>" for value, name in values]
        self._parts.append(f"<div class=figures>{''.join(tiles)}</div>")

    def section(self, title: str, text: str = "") -> None:
        """Add a heading and a paragraph."""
        self._parts.append(f"<h2>{_text(title)}</h2>" + (f"<p>{_text(text)}</p>" if text else ""))

    def text(self, text: str) -> None:
        """Add a paragraph."""
        self._parts.append(f"<p>{_text(text)}</p>")

    def table(self, columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
        """Add a table; columns of numbers are aligned to the right. A second line of a cell is small."""
        numeric = [all(isinstance(row[i], int | float) for row in rows) for i in range(len(columns))]
        styles = [" class=n" if right else "" for right in numeric]
        lines = ["".join(f"<th{s}>{_cell(name)}</th>" for name, s in zip(columns, styles, strict=True))]
        for row in rows:
            lines.append("".join(f"<td{s}>{_cell(v)}</td>" for v, s in zip(row, styles, strict=True)))
        body = "".join(f"<tr>{line}</tr>" for line in lines)
        style = " class=dense" if len(columns) > 10 else ""
        self._parts.append(f"<div class=scroll><table{style}>{body}</table></div>")

    def picture(self, data: bytes, kind: str, caption: str) -> None:
        """Add an embedded picture.

        Args:
            data: the file's bytes.
            kind: png, webp or svg+xml; an SVG is a plot and gets a white background.
            caption: the text below it, which is also its alternative text.
        """
        source = f"data:image/{kind};base64,{base64.b64encode(data).decode()}"
        style = " class=plot" if kind == "svg+xml" else ""
        self._parts.append(
            f'<figure{style}><img src="{source}" alt="{html.escape(caption)}">'
            f"<figcaption>{_text(caption)}</figcaption></figure>"
        )

    def definitions(self, pairs: Sequence[tuple[str, str]]) -> None:
        """Add a list of terms with what they mean."""
        items = "".join(f"<dt>{_text(name)}</dt><dd>{_text(words)}</dd>" for name, words in pairs)
        self._parts.append(f"<dl>{items}</dl>")

    def strips(self, title: str, text: str, rows: Sequence[tuple[str, bytes]]) -> None:
        """Add wide WebP pictures below each other, each beside its name."""
        lines = [
            f'<span>{_text(name)}</span><img loading=lazy alt="{html.escape(f"{title}: {name}")}" '
            f'src="data:image/webp;base64,{base64.b64encode(data).decode()}">'
            for name, data in rows
        ]
        head = f"<h3>{_text(title)}</h3><p class=soft>{_text(text)}</p>"
        self._parts.append(f"{head}<div class=strips>{''.join(lines)}</div>")

    def commands(self, text: str) -> None:
        """Add lines for a shell."""
        self._parts.append(f"<pre>{_text(text.strip())}</pre>")

    def html(self) -> str:
        """Return the whole page."""
        head = (
            "<meta charset=utf-8>"
            '<meta name=viewport content="width=device-width, initial-scale=1">'
            f"<title>{_text(self._title)}</title><style>{_STYLE}</style>"
        )
        body = "".join(self._parts)
        return f"<!doctype html><html lang=en><head>{head}</head><body>{body}</body></html>\n"


def _text(value: str) -> str:
    return html.escape(value, quote=False)


def _cell(value: Any) -> str:
    if value is None:
        return "–"
    if isinstance(value, float):
        return f"{value:.3g}" if abs(value) < 1000 else f"{value:,.0f}"
    if isinstance(value, int) and not isinstance(value, bool):
        return f"{value:,}"
    figure, _, below = _text(str(value)).partition("\n")
    return f"{figure}<br><small>{below}</small>" if below else figure


def loss_curves(
    training: Mapping[str, Sequence[tuple[int, float]]],
    validation: Mapping[str, Sequence[tuple[int, float]]],
    label: str,
) -> bytes:
    """Plot losses over training, one curve a robot: training as a running mean, evaluations as markers.

    Args:
        training, validation: robot -> (step, loss).
        label: the label of the losses' axis.
    """
    figure, axes = _axes("training step", label)
    for i, name in enumerate(sorted(training)):
        colour, style = COLOURS[i % len(COLOURS)], STYLES[i // len(COLOURS) % len(STYLES)]
        steps, losses = np.array(training[name], float).T
        width = max(1, len(losses) // 40)  # of the running mean
        mean = np.convolve(losses, np.ones(width) / width, "valid")
        axes.plot(steps[width - 1 :], mean, color=colour, ls=style, lw=1.6, label=name)
        if validation.get(name):
            steps, losses = np.array(validation[name], float).T
            axes.plot(steps, losses, MARKERS[i % len(MARKERS)], color=colour, ms=5)
    axes.legend(frameon=False, fontsize=9, ncols=1 + len(training) // 8)
    return svg_bytes(figure)


def held_out_losses(curves: Mapping[str, Sequence[tuple[float, float]]], baseline: float, unit: str) -> bytes:
    """Plot held-out losses over the time spent in training.

    Args:
        curves: name -> (seconds, nats).
        baseline: the loss of the token frequencies, as a dotted line.
        unit: what the nats are of, as `token_words` has it.
    """
    figure, axes = _axes("seconds of training", f"held-out loss, nats a {unit}")
    for i, (name, points) in enumerate(curves.items()):
        seconds, nats = np.array(points, float).T
        axes.plot(seconds, nats, color=COLOURS[i], ls=STYLES[i], marker=MARKERS[i], ms=5, label=name)
    axes.axhline(baseline, color="#555555", ls=":", label="token frequencies alone")
    axes.set_xlim(left=0)
    axes.set_ylim(bottom=0)
    axes.legend(frameon=False, fontsize=9)
    return svg_bytes(figure)


def course(points: Sequence[tuple[int, float]], label: str, log: bool = False) -> bytes:
    """Plot the values of (step, value) points, on a logarithmic axis if `log` is set."""
    figure, axes = _axes("training step", label)
    steps, values = np.array(points or [(0, np.nan)], float).T
    axes.plot(steps, values, color=COLOURS[0], lw=1.2)
    if log and (values > 0).any():
        axes.set_yscale("log")
    return svg_bytes(figure)


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
    figure, axes = _axes("seconds after the prompt", unit)
    for i, (name, (values, ends)) in enumerate(curves.items()):
        time = seconds_per_frame * np.arange(1, len(values) + 1)
        colour, (low, high) = SIX[i % len(SIX)], np.array(ends, float).T
        style, marker = STYLES[i % len(STYLES)], MARKERS[i % len(MARKERS)]
        axes.plot(time, values, color=colour, ls=style, marker=marker, ms=5, label=name)
        axes.fill_between(time, low, high, color=colour, alpha=0.15, lw=0)
    handles = axes.get_legend_handles_labels()
    figure.legend(*handles, loc="outside upper left", frameon=False, fontsize=9, ncols=2)
    return svg_bytes(figure)


def _axes(x: str, y: str) -> "tuple[Figure, Axes]":
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.2, 3.4), layout="constrained")
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
