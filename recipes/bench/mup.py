"""Test whether the best learning rate at one width is also the best at another (`hma bench mup`).

Small models of several widths learn a synthetic world at several learning rates, with muP and without it. The
world consists of patterns of tokens that actions move along a line. With muP the best rate should stay the
same as the width grows (Yang et al. 2022, arXiv 2203.03466); without muP it moves. `plot=FILE.svg` draws the
losses over the rates.

B batch, T frames, h,w token grid.
"""

import math
from pathlib import Path
from statistics import fmean
from typing import TYPE_CHECKING, Any

from hma_data.errors import UsageError
from hma_data.storage.files import write_atomic
from hma_model.config import ActionSpace, HMAConfig
from recipes.bench.harness import Bench

if TYPE_CHECKING:
    import torch

    from hma_data.loading.rows import Batch
    from hma_model.network.model import HMA

SPACE = ActionSpace("mover", 1, 1, (0.0,), (1.0,), (True,))
_GRID, _FRAMES, _DIGITS, _PATTERNS = (4, 4), 4, (16, 16), 16
_TAIL = 0.2  # the share of the steps, at the end, over which the loss is averaged


def run(settings: dict[str, Any]) -> list[dict[str, Any]]:
    """Return a row for each parametrisation, width and rate: the mean final loss (None if it diverged)."""
    widths, rates = _numbers(settings["widths"], int), _numbers(settings["rates"], float)
    rows: list[dict[str, Any]] = []
    for mup in (True, False):
        for width in widths:
            losses = {rate: _final_loss(settings, width, rate, mup, widths[0]) for rate in rates}
            finite = {rate: loss for rate, loss in losses.items() if math.isfinite(loss)}
            best = min(finite, key=lambda rate: finite[rate]) if finite else None
            rows += [
                {
                    "parametrisation": "muP" if mup else "standard",
                    "width": width,
                    "lr": rate,
                    "nats_a_token": round(loss, 4) if math.isfinite(loss) else None,
                    "best": rate == best,
                }
                for rate, loss in losses.items()
            ]
    if settings["plot"]:
        draw(rows, Path(settings["plot"]))
    return rows


def _final_loss(settings: dict[str, Any], width: int, rate: float, mup: bool, base_width: int) -> float:
    ends = []
    for seed in range(settings["seeds"]):
        model = make_model(width, settings["layers"], mup, base_width, seed)
        losses = train(model, rate, settings["steps"], settings["batch"], seed)
        whole = len(losses) == settings["steps"]
        ends.append(fmean(losses[-max(1, int(_TAIL * len(losses))) :]) if whole else math.nan)
    return fmean(ends)


def _numbers(text: Any, kind: type) -> list[Any]:
    try:
        values = [kind(part) for part in str(text).split(",")]
    except ValueError as fault:
        raise UsageError("bench mup", f"{text!r} is no list of numbers", "write 32,64,128") from fault
    if not values or min(values) <= 0:
        raise UsageError("bench mup", f"{text!r} holds numbers that are not positive", "write 32,64,128")
    return values


def windows(batch: int, generator: "torch.Generator") -> "Batch":
    """Return a batch in which the action (B, T, 1) of -1, 0 or 1 shifts each frame to the next."""
    import torch

    from hma_data.loading.rows import Batch

    cells = _GRID[0] * _GRID[1]
    patterns = torch.randint(0, 256, (_PATTERNS, cells), generator=torch.Generator().manual_seed(0))
    moves = torch.randint(-1, 2, (batch, _FRAMES), generator=generator)
    start = torch.randint(0, cells, (batch, 1), generator=generator)
    offset = start + torch.nn.functional.pad(moves[:, :-1], (1, 0)).cumsum(1)
    index = (torch.arange(cells) + offset.unsqueeze(-1)) % cells
    chosen = patterns[torch.randint(0, _PATTERNS, (batch,), generator=generator)]
    tokens = chosen.unsqueeze(1).expand(-1, _FRAMES, -1).gather(2, index)
    return Batch(
        embodiment=[SPACE.id] * batch,
        actions=moves.unsqueeze(-1).float(),
        action_mask=torch.ones(batch, _FRAMES, dtype=torch.bool),
        tokens=tokens.unflatten(2, _GRID),
    )


def make_model(width: int, layers: int, mup: bool, base_width: int, seed: int = 0) -> "HMA":
    """Return a model of the synthetic world."""
    import torch

    from hma_model.network.model import HMA

    torch.manual_seed(seed)
    config = HMAConfig(
        layers=layers, width=width, heads=4, frames=_FRAMES, grid=_GRID, factored=_DIGITS, mup=mup,
        base_width=base_width, label_smoothing=0.0, corrupt_max=0.0, history_probability=0.0,
    )  # fmt: skip
    model = HMA(config)
    model.add_embodiment(SPACE)
    return model.train()


def train(model: "HMA", rate: float, steps: int, batch: int, seed: int = 0) -> list[float]:
    """Train with AdamW at a constant rate until a loss is not finite; return all losses in nats a token."""
    import torch

    from hma_model.training.optim import parameter_groups

    generator = torch.Generator().manual_seed(seed)
    optimizer = torch.optim.AdamW(parameter_groups(model, rate, 0.0), betas=(0.9, 0.95))
    losses = []
    for _ in range(steps):
        out = model(windows(batch, generator), "forward", generator)
        losses.append(out.loss.item())
        if not math.isfinite(losses[-1]):
            break
        optimizer.zero_grad()
        out.loss.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()
    return losses


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """Draw the loss over the learning rate: one curve a width, its best rate ringed; muP on the left."""
    from matplotlib.figure import Figure

    from hma_model.evaluation.plots import COLOURS, MARKERS, STYLES, label_axes, svg_bytes

    figure = Figure(figsize=(9.0, 3.6), layout="constrained")
    panels = figure.subplots(1, 2, sharey=True)
    drawn = sorted((row for row in rows if row["nats_a_token"] is not None), key=lambda row: row["lr"])
    for axes, name in zip(panels, ("muP", "standard")):
        for i, width in enumerate(sorted({row["width"] for row in rows})):
            chosen = [row for row in drawn if (row["parametrisation"], row["width"]) == (name, width)]
            points = [(row["lr"], row["nats_a_token"]) for row in chosen]
            best = [(row["lr"], row["nats_a_token"]) for row in chosen if row["best"]]
            look = {"color": COLOURS[i % 4], "ls": STYLES[i % 4], "marker": MARKERS[i % 4]}
            axes.plot(*zip(*points), ms=5, label=f"width {width}", **look)
            axes.plot(*zip(*best), ls="", marker="o", ms=13, mfc="none", color=COLOURS[i % 4])
        axes.set_xscale("log", base=2)
        axes.set_title(name, fontsize=10)
        label_axes(axes, "learning rate", "loss at the end, nats a token" if name == "muP" else "")
    panels[0].legend(frameon=False, fontsize=9)
    write_atomic(path, svg_bytes(figure))


BENCH = Bench(
    "loss by learning rate and width, with and without muP",
    {
        "widths": "32,64,128",
        "rates": "0.0005,0.001,0.002,0.004,0.008,0.016,0.032",
        "steps": 120,
        "layers": 2,
        "batch": 8,
        "seeds": 1,
        "plot": "",
    },
    run,
)
