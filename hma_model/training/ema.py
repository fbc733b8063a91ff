"""Averaged weights: what is evaluated and published where a recipe asks for them.

After each step the average moves towards the weights by 1 - decay; in the first steps by more, so that it
does not hold on to where the run began (decay is at most (1 + step) / (10 + step)).
"""

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from hma_model.training.parallel import gathered, like, local


class Average:
    """Moving average of a network's parameters, each rank its part.

    Args:
        model: as it is trained.
        decay: of the average, 0 to 1.
    """

    def __init__(self, model: nn.Module, decay: float) -> None:
        self.decay = decay
        self._model = model
        self._own = {n: p.detach().clone() for n, p in model.named_parameters() if p.requires_grad}

    @torch.no_grad()
    def update(self, step: int) -> None:
        """Take in the weights after step `step`, counted from 1."""
        weight = 1 - min(self.decay, (1 + step) / (10 + step))
        moving = {n: p for n, p in self._model.named_parameters() if n in self._own}
        own = [local(value) for value in self._own.values()]
        torch._foreach_lerp_(own, [local(moving[name].detach()) for name in self._own], weight)

    @torch.no_grad()
    def load(self, state: Mapping[str, Tensor]) -> None:
        """Put back whole averages by parameter name; others keep what they are."""
        for name, own in self._own.items():
            if name in state:
                own.copy_(like(state[name], own))

    def state(self) -> dict[str, Tensor]:
        """The network's state with averages in place of parameters, whole; every rank must ask."""
        return {**gathered(self._model.state_dict().items()), **gathered(self._own.items())}
