"""Measure a run on its held-out windows, and draw pictures of rollouts there."""

import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from hma_data.loading.dataset import Batch, WindowDataset
from hma_data.shards.reader import ShardSet
from hma_model.config import Objective
from hma_model.evaluation import losses
from hma_model.evaluation.metrics import perplexity
from hma_model.evaluation.rollout_video import write_sheets
from hma_model.network.model import HMA
from hma_model.training.recipe import Recipe


class HeldOut:
    """The held-out windows of a run, and what its evaluations have in common.

    Attributes:
        sets: the shard sets that have such windows, by robot.
        missing: the robots of the others.
    """

    def __init__(self, recipe: Recipe, sets: Mapping[str, ShardSet], objective: Objective) -> None:
        self._recipe, self._all, self._objective = recipe, sets, objective
        self.sets = {
            name: shards
            for name, shards in sets.items()
            if len(WindowDataset(shards, "val", recipe.frames, cameras=recipe.cameras))
        }
        self.missing = sorted(sets.keys() - self.sets.keys())
        self._baseline: losses.Means | None = None
        self._sheet_seconds = [0.0]  # of each evaluation's pictures

    def measure(self, model: HMA) -> dict[str, Any]:
        """Return the figures of an evaluation.

        For forward and full the loss is nats a token of each fully masked frame, given the true past and
        actions, with the loss of the training tokens' frequencies as a baseline. For passive, policy and
        inverse it is the training loss on held-out windows, under the same masks at every evaluation.
        """
        recipe, objective = self._recipe, self._objective
        video = objective.predicts_video and objective.sees_actions
        drawn = "forward" if video else objective.name
        found, accuracy = losses.validation_losses(model, self._batches(), recipe.seed, drawn)
        facts: dict[str, Any] = {
            "objective": objective.name,
            "loss": found.mean(),
            "loss_by_embodiment": found.by_embodiment(),
            "windows": len(found.samples),
        }
        if video and model.config.discrete:
            if self._baseline is None:
                self._baseline = losses.unconditional_baseline(
                    self._all.values(), self._batches(), model.config, recipe.cameras
                )
            facts["perplexity"] = perplexity(facts["loss"])
            facts["accuracy"] = accuracy.mean()
            facts["accuracy_by_embodiment"] = accuracy.by_embodiment()
            facts["baseline"] = self._baseline.mean()
            facts["baseline_by_embodiment"] = self._baseline.by_embodiment()
        return facts

    def draw(self, model: HMA, out: Path, step: int, spare: float) -> str:
        """Write pictures of rollouts if the time allows.

        Args:
            out: folder of the run.
            spare: seconds that pictures may have taken so far; infinite after the last step.

        Returns:
            The first time, what was wrong; else an empty text.
        """
        recipe, begun = self._recipe, time.monotonic()
        too_long = sum(self._sheet_seconds) + self._sheet_seconds[-1] >= spare
        if too_long or not (recipe.pictures and model.config.predicts_video):
            return ""
        facts = {"frames": recipe.frames, "count": recipe.pictures, "seed": recipe.seed}
        fault = write_sheets(model, self.sets, out, step, cameras=recipe.cameras, **facts)
        self._sheet_seconds.append(time.monotonic() - begun)
        return fault if len(self._sheet_seconds) == 2 else ""

    def _batches(self) -> Iterator[Batch]:
        recipe = self._recipe
        for shards in self.sets.values():
            yield from losses.windows(
                shards, "val", recipe.frames, recipe.eval_windows, recipe.batch_size, recipe.cameras
            )
