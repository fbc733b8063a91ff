"""AdamW as the model needs it: what decays, how muP scales, how the learning rate moves.

Matrices decay; norms, biases, embeddings, positions and mask vectors do not. With muP the matrices of which
both sides grow with the width learn at lr / (width / base_width), and their decay is raised by as much, so
that lr and decay found at one width serve at another (Yang et al. 2022, table 8).
"""

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from hma_data.errors import CheckpointError
from hma_model.training.parallel import is_sharded, like, whole

if TYPE_CHECKING:
    from hma_model.network.model import HMA
    from hma_model.training.recipe import Recipe

_MOMENTS = ("exp_avg", "exp_avg_sq", "step")


def make_optimizer(model: "HMA", recipe: "Recipe") -> torch.optim.AdamW:
    """AdamW over all parameters of the model; each group carries its `base_lr` and parameters' `names`."""
    lr = learning_rate(recipe)
    groups = parameter_groups(model, lr, recipe.weight_decay)
    fused = model.device.type == "cuda"
    return torch.optim.AdamW(groups, lr=lr, betas=recipe.betas, eps=recipe.eps, fused=fused)


def learning_rate(recipe: "Recipe") -> float:
    """The schedule's peak; the paper's rule multiplies lr by the windows a step over 64, from 1 to 8."""
    if recipe.lr_rule == "paper":
        return recipe.lr * min(max(recipe.windows_per_step / 64, 1.0), 8.0)
    return recipe.lr


def lr_scale(step: int, recipe: "Recipe") -> float:
    """What the peak is multiplied by in step `step`, counted from 0."""
    if step < recipe.warmup:
        return (step + 1) / recipe.warmup
    if recipe.schedule == "constant_with_warmup":
        return 1.0
    along = (step - recipe.warmup) / max(recipe.steps - 1 - recipe.warmup, 1)
    return recipe.lr_end + (1 - recipe.lr_end) * 0.5 * (1 + math.cos(math.pi * min(along, 1.0)))


def set_lr(optimizer: torch.optim.Optimizer, scale: float) -> float:
    """Scale every group from its `base_lr`; returns the largest."""
    for group in optimizer.param_groups:
        group["lr"] = group["base_lr"] * scale
    return max(group["lr"] for group in optimizer.param_groups)


def parameter_groups(model: "HMA", lr: float, weight_decay: float) -> list[dict[str, Any]]:
    """Groups of AdamW: with and without decay, and with muP the matrices apart."""
    multiplier = model.config.width / model.config.base_width if model.config.mup else 1.0
    matrices = _growing_matrices(model) if multiplier != 1.0 else set()
    plain = _undecayed(model)
    groups: dict[tuple[bool, bool, bool], dict[str, Any]] = {}
    for name, parameter in model.named_parameters():
        if not parameter.requires_grad:
            continue
        decays, scaled, sharded = name not in plain, name in matrices, is_sharded(parameter)
        base_lr = lr / multiplier if scaled else lr
        decay = weight_decay * (multiplier if scaled else 1.0) if decays else 0.0
        empty: dict[str, Any] = {"params": [], "names": []}
        group = groups.setdefault(
            (decays, scaled, sharded), {**empty, "lr": base_lr, "base_lr": base_lr, "weight_decay": decay}
        )
        group["params"].append(parameter)
        group["names"].append(name)
    return list(groups.values())


def _undecayed(model: nn.Module) -> set[str]:
    """Names of norms', biases', embeddings', positions' and mask parameters."""
    names = set()
    for prefix, module in model.named_modules():
        own = isinstance(module, nn.LayerNorm | nn.GroupNorm | nn.RMSNorm | nn.Embedding)
        for name, parameter in module.named_parameters(recurse=False):
            if own or parameter.ndim < 2 or "weight" not in name:
                names.add(f"{prefix}.{name}" if prefix else name)
    return names


def _growing_matrices(model: "HMA") -> set[str]:
    """Parameters with two sides that grow with the width, found by comparing with a model twice as wide."""
    with torch.device("meta"):
        wider = type(model)(model.config.replace(width=2 * model.config.width))
        for space in model.embodiments.values():
            wider.add_embodiment(space)
    shapes = {name: parameter.shape for name, parameter in wider.named_parameters()}
    return {
        name
        for name, parameter in model.named_parameters()
        if sum(a != b for a, b in zip(parameter.shape, shapes[name])) >= 2
    }


def optimizer_state(optimizer: torch.optim.Optimizer) -> dict[str, Tensor]:
    """Whole moments by parameter name: `<name>/exp_avg` and so on; parameters never updated have none.

    Every rank must ask.
    """
    return {
        f"{name}/{moment}": whole(torch.as_tensor(optimizer.state[parameter][moment]))
        for group in optimizer.param_groups
        for name, parameter in zip(group["names"], group["params"])
        if optimizer.state.get(parameter)
        for moment in _MOMENTS
    }


def load_optimizer_state(
    optimizer: torch.optim.Optimizer, state: Mapping[str, Tensor], where: object
) -> None:
    """Put back what `optimizer_state` gave.

    Raises:
        CheckpointError: moments of unknown parameters, or of other shapes.
    """
    known = {n: p for g in optimizer.param_groups for n, p in zip(g["names"], g["params"])}
    for key in state:
        name, _, moment = key.rpartition("/")
        fits = moment == "step" or (name in known and state[key].shape == known[name].shape)
        if name not in known or moment not in _MOMENTS or not fits:
            raise CheckpointError(where, f"optimizer state {key!r} fits no parameter", "train from the start")
    for name, parameter in known.items():
        if f"{name}/step" in state:
            moments = {key: like(state[f"{name}/{key}"].clone(), parameter) for key in _MOMENTS[:2]}
            step_device = parameter.device if optimizer.defaults.get("fused") else "cpu"
            step = state[f"{name}/step"].clone().to(step_device)
            optimizer.state[parameter] = {**moments, "step": step}
