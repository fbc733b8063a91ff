"""Sum the losses of a step over passes and ranks, and measure peak memory."""

import resource
import sys
from typing import TYPE_CHECKING

import torch

from hma_model.config import OBJECTIVES
from hma_model.training.parallel import World

if TYPE_CHECKING:
    from hma_model.network.objectives import Output


class StepMetrics:
    """Sums of losses, kept on the device of the losses, so that a step needs only one transfer.

    Args:
        names: the ids of the embodiments.
        device: the device of the losses.
    """

    def __init__(self, names: list[str], device: torch.device) -> None:
        self._names = sorted(names)
        self._place = {name: i for i, name in enumerate(self._names)}
        self._loss = torch.zeros(1, device=device)
        self._sums = torch.zeros(2, len(names), device=device)
        self._objectives = torch.zeros(len(OBJECTIVES), device=device)

    def add(self, embodiment: list[str], output: "Output") -> None:
        """Add the loss of a pass, the loss of each sample, and the objective."""
        index = torch.tensor([self._place[name] for name in embodiment], device=self._sums.device)
        losses = output.per_sample.to(self._sums)
        self._loss += output.loss.detach().to(self._loss)
        self._sums.index_add_(1, index, torch.stack([losses, torch.ones_like(losses)]))
        self._objectives[list(OBJECTIVES).index(output.objective)] += 1

    def whole(self, world: World, passes: int) -> tuple[float, dict[str, float], list[str]]:
        """Return the mean loss over all ranks, the mean by embodiment, and the objectives of the step."""
        flat = world.sum(torch.cat([self._loss, self._sums.flatten(), self._objectives])).tolist()
        count = len(self._names)
        sums, counts, objectives = flat[1 : 1 + count], flat[1 + count : 1 + 2 * count], flat[1 + 2 * count :]
        by_name = {name: s / n for name, s, n in zip(self._names, sums, counts) if n}
        return flat[0] / passes, by_name, sorted(n for n, used in zip(OBJECTIVES, objectives) if used)


def peak_memory_mib(device: torch.device) -> float:
    """Return the peak memory in MiB of the GPU's tensors, or of the process on another device."""
    if device.type == "cuda":
        return round(torch.cuda.max_memory_allocated(device) / 2**20, 1)
    unit = 2**20 if sys.platform == "darwin" else 2**10
    return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit, 1)
