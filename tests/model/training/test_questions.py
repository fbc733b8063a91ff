"""The script of the paper's questions: its rows, its intervals, and the baseline it compares with."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy import stats

from hma_data.shards.reader import ShardSet
from hma_data.storage.paths import shipped
from hma_data.tokenizers.base import TokenizerSpec
from hma_model.evaluation.rollouts import rollout
from hma_model.training.recipe import load_recipe
from recipes.bench.quality import PLAIN
from tests.model.shards import make_shards

sys.path.insert(0, str(shipped("recipes") / "lab"))
import dit  # type: ignore[import-not-found]
import questions  # type: ignore[import-not-found]

ROWS = [(question, row) for question, rows in questions.QUESTIONS.items() for row in rows]


@pytest.mark.parametrize(("question", "row"), ROWS, ids=lambda item: getattr(item, "name", item))
def test_every_row_is_a_recipe(question: str, row: Any) -> None:
    recipe = load_recipe(row.recipe, [*PLAIN, *row.overrides, "cpu_seconds=3"])
    assert (recipe.cpu_seconds, recipe.frames) == (3, questions.FRAMES)


def test_intervals_are_those_of_students_t(tmp_path: Path) -> None:
    values = [1.0, 2.0, 4.0]
    lines = [{"row": "one", "seed": seed, "gain": value, "loss": ""} for seed, value in enumerate(values)]
    for line in lines:
        questions.append(tmp_path / "q.csv", line)
    found = questions.summary(questions.read(tmp_path / "q.csv"))["one"]
    low, high = stats.t.interval(0.95, 2, loc=stats.tmean(values), scale=stats.sem(values))
    mean, half = found["gain"]
    assert (mean - half, mean + half) == pytest.approx((low, high), rel=1e-3)
    assert questions.table(lines).splitlines()[-1] == f"| one | 3 | {mean:.2f} ± {half:.2f} |"


def test_the_baseline_learns_and_keeps_the_prompt_out_of_its_frames(tmp_path: Path) -> None:
    spec = TokenizerSpec("lab", 1, "continuous", 16, (4, 4), channels=2, latent_scale=3.0, dtype="float16")
    shards = ShardSet(make_shards(tmp_path / "arm", "arm", spec=spec))
    torch.manual_seed(0)
    model = dit.DiT(shards, frames=4, width=32, layers=1, heads=2, patch=2)
    batch = next(iter(dit.MixtureDataset([shards], 4, 4, seed=3)))
    given = batch.latents.float(), batch.actions

    def loss() -> float:
        drawn = (torch.Generator().manual_seed(seed) for seed in range(8))
        with torch.no_grad():
            return sum(float(model.loss(*given, one)) for one in drawn)

    before = loss()
    model, steps = dit.train(model, shards, cpu_seconds=1e9, seed=0, lr=3e-3, steps=40)
    assert steps == 40 and loss() < 0.95 * before
    made = model.generate(
        given[0][:, :1], given[1], frames=3, generator=torch.Generator().manual_seed(0), steps=4
    )
    assert made.shape == given[0][:, 1:].shape and bool(made.isfinite().all())
    assert rollout(model, Blank(spec), batch, prompt=1).finite.all()  # type: ignore[arg-type]


@dataclass
class Blank:
    spec: TokenizerSpec

    def decode(self, latents: np.ndarray) -> np.ndarray:
        return np.zeros((len(latents), 16, 16, 3), np.uint8)
