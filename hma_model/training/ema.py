"""Average the weights during training, for evaluation and publication, if the recipe asks for it.

After each step the average moves towards the weights by 1 - decay. In the first steps it moves by more, so
that it soon forgets the initial weights (decay is at most (1 + step) / (10 + step)).
"""

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from hma_model.training.parallel import gathered, like, local


class Average:
    """A moving average of a network's parameters; each rank averages its part.

    Args:
        model: the network in training.
        decay: the decay of the average, 0 to 1.
    """

    def __init__(self, model: nn.Module, decay: float) -> None:
        self.decay = decay
        self._model = model
        self._own = {n: p.detach().clone() for n, p in model.named_parameters() if p.requires_grad}

    @torch.no_grad()
    def update(self, step: int) -> None:
        """Update the average with the weights after step `step`, counted from 1."""
        weight = 1 - min(self.decay, (1 + step) / (10 + step))
        moving = {n: p for n, p in self._model.named_parameters() if n in self._own}
        own = [local(value) for value in self._own.values()]
        torch._foreach_lerp_(own, [local(moving[name].detach()) for name in self._own], weight)

    @torch.no_grad()
    def load(self, state: Mapping[str, Tensor]) -> None:
        """Restore unsharded averages by parameter name; a parameter that is not named keeps its average."""
        for name, own in self._own.items():
            if name in state:
                own.copy_(like(state[name], own))

    def state(self) -> dict[str, Tensor]:
        """Return the unsharded state of the network with averaged parameters; every rank must call it."""
        return {**gathered(self._model.state_dict().items()), **gathered(self._own.items())}
