"""Muon: momentum whose matrices are made orthogonal before each step (Jordan et al. 2024).

A convolution's weight (out, in, k, k) counts as a matrix (out, in·k·k). The orthogonal factor is
approached by a quintic Newton–Schulz iteration; about five rounds bring singular values near 1.
"""

from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor

ROUNDS = 5
_A, _B, _C = 3.4445, -4.7750, 2.0315  # steepest at zero while values in (0, 1] stay near 1


def orthogonal(matrix: Tensor) -> Tensor:
    """(R, C) -> about the nearest matrix whose singular values are 1, of the same shape."""
    x = matrix / (matrix.norm() + 1e-7)
    tall = x.shape[0] > x.shape[1]
    x = x.T if tall else x
    for _ in range(ROUNDS):
        square = x @ x.T
        x = _A * x + (_B * square + _C * square @ square) @ x
    return x.T if tall else x


class Muon(torch.optim.Optimizer):
    """For weights of two dimensions or more; `lr` is the spectral norm of a step (× √(rows/columns)).

    Without `decay` nothing holds the weights' norm in a network without normalisation: it is bounded
    by 1/decay, as each step shrinks the weights by lr·decay.
    """

    def __init__(
        self, params: Iterable[Tensor], lr: float, momentum: float = 0.95, decay: float = 0.0
    ) -> None:
        super().__init__(params, {"lr": lr, "momentum": momentum, "decay": decay})

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> None:  # type: ignore[override]
        """One step; `closure` is not called."""
        for group in self.param_groups:
            for parameter in group["params"]:
                if parameter.grad is not None:
                    self._step_one(parameter, parameter.grad, group)

    def _step_one(self, parameter: Tensor, grad: Tensor, group: dict[str, Any]) -> None:
        state = self.state[parameter]
        if "momentum" not in state:
            state["momentum"] = torch.zeros_like(grad)
        state["momentum"].lerp_(grad, 1 - group["momentum"])
        ahead = grad.lerp(state["momentum"], group["momentum"])
        flat = ahead.reshape(len(ahead), -1)
        update = orthogonal(flat) * max(1.0, flat.shape[0] / flat.shape[1]) ** 0.5
        parameter.mul_(1 - group["lr"] * group["decay"])
        parameter.add_(update.view(parameter.shape), alpha=-group["lr"])
