"""Define the Muon optimizer (Jordan et al. 2024): steps are the momentum of a matrix, made orthogonal.

R rows, C columns.
"""

from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor

ROUNDS = 5  # of the Newton–Schulz iteration; they bring the singular values near 1
_A, _B, _C = 3.4445, -4.7750, 2.0315  # largest slope at zero that keeps values in (0, 1] near 1


def orthogonal(matrices: Tensor) -> Tensor:
    """Return approximately the nearest matrices whose singular values are 1; (..., R, C) -> (..., R, C)."""
    x = matrices / (matrices.norm(dim=(-2, -1), keepdim=True) + 1e-7)
    tall = x.shape[-2] > x.shape[-1]
    x = x.mT if tall else x
    for _ in range(ROUNDS):
        square = x @ x.mT
        x = _A * x + (_B * square + _C * square @ square) @ x
    return x.mT if tall else x


@torch.no_grad()
def muon_step(
    parameters: list[Tensor], state: dict[Any, dict[str, Any]], lr: float, momentum: float, decay: float
) -> None:
    """Take a step of Muon; parameters of the same shape share their products.

    Args:
        parameters: each with at least two axes; (out, in, k, k) is treated as a matrix (out, in·k·k). Those
            without a gradient are left out.
        state: holds each parameter's momentum as `exp_avg`.
        lr: the spectral norm of a step, multiplied by √(R/C) for tall matrices.
        momentum: the share of the momentum that a step keeps.
        decay: a step shrinks the weights by lr·decay, which bounds their norm by 1/decay.
    """
    alike: dict[torch.Size, list[Tensor]] = {}
    for parameter in parameters:
        if parameter.grad is not None:
            alike.setdefault(parameter.shape, []).append(parameter)
    for shape, chosen in alike.items():
        moving = [state[p].setdefault("exp_avg", torch.zeros_like(p)) for p in chosen]
        flat = []
        for parameter, average in zip(chosen, moving, strict=True):
            assert parameter.grad is not None
            average.lerp_(parameter.grad, 1 - momentum)
            flat.append(parameter.grad.lerp(average, momentum).reshape(len(parameter), -1))
        updates = orthogonal(torch.stack(flat)) * max(1.0, flat[0].shape[0] / flat[0].shape[1]) ** 0.5
        for parameter, update in zip(chosen, updates, strict=True):
            parameter.mul_(1 - lr * decay).add_(update.view(shape), alpha=-lr)


class Muon(torch.optim.Optimizer):
    """The Muon optimizer for parameters with at least two axes; `muon_step` explains its settings."""

    def __init__(
        self, params: Iterable[Tensor], lr: float, momentum: float = 0.95, decay: float = 0.0
    ) -> None:
        super().__init__(params, {"lr": lr, "momentum": momentum, "decay": decay})

    def step(self, closure: Callable[[], float] | None = None) -> None:  # type: ignore[override]
        """Take one step; `closure` is not called."""
        for group in self.param_groups:
            muon_step(group["params"], self.state, group["lr"], group["momentum"], group["decay"])
