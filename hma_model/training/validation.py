"""Evaluate a run: the held-out loss of its main objective.

For forward and full: nats a token of each fully masked frame, given the true past and actions, with the loss
of the training tokens' frequencies as a baseline. For passive, policy and inverse: the training loss on
held-out windows, under masks that are the same at every evaluation.
"""

import time
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any

import torch

from hma_model.config import OBJECTIVES, Objective
from hma_model.evaluation.evaluate import Means, validation_losses
from hma_model.evaluation.metrics import perplexity

if TYPE_CHECKING:
    from hma_data.loading.dataset import Batch
    from hma_model.network.model import HMA


def main_objective(weights: Mapping[str, float]) -> Objective:
    """Return the objective that is drawn most often."""
    return OBJECTIVES[max(weights, key=lambda name: weights[name])]


def validate(
    model: "HMA",
    held_out: Callable[[], Iterable["Batch"]],
    baseline: Callable[[], Means],
    seed: int,
    step: int,
) -> dict[str, Any]:
    """Evaluate the model, and return the line of metrics.jsonl.

    Args:
        model: the model to evaluate.
        held_out: validation windows, the same at every call.
        baseline: returns the loss of the training frequencies on them; called only if it is comparable.
        seed: the seed of the masks.
        step: number of finished steps.
    """
    begun, objective = time.monotonic(), main_objective(model.config.objectives)
    video = objective.predicts_video and objective.sees_actions
    accuracy = Means()
    if video:
        losses, accuracy = validation_losses(model, held_out(), seed)
    else:
        losses = _losses_of(model, held_out(), objective.name, seed)
    facts: dict[str, Any] = {
        "step": step,
        "objective": objective.name,
        "loss": losses.mean(),
        "loss_by_embodiment": losses.by_embodiment(),
        "windows": sum(losses.counts.values()),
    }
    if video and model.config.kind == "discrete":
        least = baseline()
        facts["perplexity"] = perplexity(facts["loss"])
        facts["accuracy"] = accuracy.mean()
        facts["accuracy_by_embodiment"] = accuracy.by_embodiment()
        facts["baseline"] = least.mean()
        facts["baseline_by_embodiment"] = least.by_embodiment()
    return {**facts, "seconds": round(time.monotonic() - begun, 3)}


@torch.no_grad()
def _losses_of(model: "HMA", batches: Iterable["Batch"], objective: str, seed: int) -> Means:
    losses, training = Means(), model.training
    model.eval()
    for number, batch in enumerate(batches):
        generator = torch.Generator().manual_seed(seed * 1_000_003 + number)
        output = model(batch.to(model.device), objective, generator)
        losses.add(batch.embodiment, output.per_sample)
    model.train(training)
    return losses
