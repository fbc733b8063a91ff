"""muP: what a few steps do to activations is the same at every width, and without it is not."""

import json
from pathlib import Path

import pytest
import torch
from torch import Tensor
from typer.testing import CliRunner

from hma_model.cli import app
from hma_model.network.model import HMA
from recipes.bench.mup import SPACE, make_model, train, windows

WIDTHS = (64, 128, 256)


def _activations(model: HMA) -> dict[str, Tensor]:
    seen: dict[str, Tensor] = {}
    block = model.trunk.blocks[-1]
    places = {
        "stem": model.stem(SPACE.id), "modulation": model.stem(SPACE.id).modulation, "block": block,
        "space": block.space.qkv, "time": block.time, "mlp": block.mlp,
    }  # fmt: skip
    hooks = [
        place.register_forward_hook(lambda _, __, out, name=name: seen.update({name: out}))
        for name, place in places.items()
    ]
    batch = windows(8, torch.Generator().manual_seed(99))
    with torch.no_grad():
        seen["logits"] = model.video_logits(batch.tokens, batch.actions, SPACE.id)
    for hook in hooks:
        hook.remove()
    return seen


def _changes(width: int, mup: bool) -> dict[str, float]:
    """Root mean squares of how far four steps move each activation."""
    model = make_model(width, 2, mup, base_width=32)
    before = _activations(model)
    train(model, 0.01, 4, 8)
    after = _activations(model)
    return {name: (after[name] - before[name]).pow(2).mean().sqrt().item() for name in before}


@pytest.mark.parametrize("widths", [WIDTHS[:2], pytest.param(WIDTHS, marks=pytest.mark.slow)])
def test_steps_move_activations_as_far_at_every_width_with_mup(widths: tuple[int, ...]) -> None:
    for name in (with_mup := [_changes(width, True) for width in widths])[0]:
        sizes = [change[name] for change in with_mup]
        assert max(sizes) < 1.5 * min(sizes), name


@pytest.mark.slow
def test_steps_move_activations_farther_at_larger_widths_without_mup() -> None:
    narrow, wide = (_changes(width, False) for width in (WIDTHS[0], WIDTHS[-1]))
    for name in ("stem", "modulation", "block", "time", "logits"):
        assert wide[name] > 2 * narrow[name], name


def test_a_new_model_knows_as_little_at_every_width() -> None:
    for width in WIDTHS:
        logits = _activations(make_model(width, 2, True, base_width=32))["logits"]
        assert logits.std() < 0.2


def test_the_worlds_next_frame_follows_from_the_action() -> None:
    batch = windows(16, torch.Generator().manual_seed(0))
    flat = batch.tokens.flatten(2)
    for sample in range(16):
        for frame in range(3):
            move = int(batch.actions[sample, frame, 0])
            assert torch.equal(flat[sample, frame + 1], flat[sample, frame].roll(-move))


def test_the_bench_names_the_best_rate_of_each_width_and_draws_it(tmp_path: Path) -> None:
    plot = tmp_path / "rates.svg"
    words = ["widths=8,16", "rates=0.001,0.01", "steps=2", "layers=1", "batch=2", f"plot={plot}"]
    done = CliRunner().invoke(app, ["bench", "mup", *words, "--json"])
    rows = json.loads(done.stdout)["results"]
    assert len(rows) == 8 and plot.read_bytes().startswith(b"<?xml")
    for name in ("muP", "standard"):
        for width in (8, 16):
            mine = [row for row in rows if (row["parametrisation"], row["width"]) == (name, width)]
            (best,) = [row for row in mine if row["best"]]
            assert best["nats_a_token"] == pytest.approx(min(row["nats_a_token"] for row in mine))


def test_a_bad_list_of_widths_is_named() -> None:
    done = CliRunner().invoke(app, ["bench", "mup", "widths=a"])
    assert "'a' is no list of numbers" in str(done.exception)
