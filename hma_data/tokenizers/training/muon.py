"""Optimize matrices with Muon: momentum made orthogonal before each step (Jordan et al. 2024).

A convolution's weight (out, in, k, k) is treated as a matrix (out, in·k·k). A quintic Newton–Schulz
iteration approximates the orthogonal factor; about five rounds bring the singular values near 1.
"""

from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor

ROUNDS = 5
_A, _B, _C = 3.4445, -4.7750, 2.0315  # largest slope at zero that keeps values in (0, 1] near 1


def orthogonal(matrix: Tensor) -> Tensor:
    """Return approximately the nearest matrix whose singular values are 1; (R, C) -> (R, C)."""
    x = matrix / (matrix.norm() + 1e-7)
    tall = x.shape[0] > x.shape[1]
    x = x.T if tall else x
    for _ in range(ROUNDS):
        square = x @ x.T
        x = _A * x + (_B * square + _C * square @ square) @ x
    return x.T if tall else x


class Muon(torch.optim.Optimizer):
    """The Muon optimizer, for weights of two dimensions or more.

    `lr` is the spectral norm of a step, multiplied by √(rows/columns) for tall matrices. Each step shrinks
    the weights by lr·decay, which bounds their norm by 1/decay. Without `decay`, nothing bounds the norm of
    the weights in a network that has no normalisation.
    """

    def __init__(
        self, params: Iterable[Tensor], lr: float, momentum: float = 0.95, decay: float = 0.0
    ) -> None:
        super().__init__(params, {"lr": lr, "momentum": momentum, "decay": decay})

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> None:  # type: ignore[override]
        """Take one step; `closure` is not called."""
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
