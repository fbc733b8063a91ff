"""Set up AdamW for the model: weight decay, muP's rates, the schedule, and the average of the weights.

Matrices have weight decay; norms, biases, embeddings, positions and mask vectors have none. With muP,
matrices of which both sides grow with the width learn at lr / (width / base_width). Their decay is multiplied
by width / base_width, so that lr and decay found at one width suit another (Yang et al. 2022, table 8).
"""

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn
from torch.distributed.tensor import DTensor

from hma_data.tokenizers.training.muon import muon_step
from hma_model.network.model import HMA
from hma_model.network.stem import waves_of_stem
from hma_model.training.parallel import gathered, like, local, whole
from hma_model.training.recipe import Recipe

_MOMENTS = ("exp_avg", "exp_avg_sq", "step")
MUON_MOMENTUM = 0.95


class AdamWAndMuon(torch.optim.AdamW):
    """AdamW, but for the groups marked `muon`, whose matrices take steps of Muon."""

    @torch.no_grad()
    def step(self, closure: Any = None) -> None:  # type: ignore[override]
        """Take one step; `closure` is not called."""
        every = self.param_groups
        # AdamW steps all groups of `param_groups`, so those of Muon are out of its sight meanwhile.
        self.param_groups = [group for group in every if not group["muon"]]
        try:
            super().step()
        finally:
            self.param_groups = every
        for group in every:
            if group["muon"]:
                muon_step(group["params"], self.state, group["lr"], MUON_MOMENTUM, group["weight_decay"])


def make_optimizer(model: HMA, recipe: Recipe) -> AdamWAndMuon:
    """Return the optimizer of the trained parameters."""
    fused = model.device.type == "cuda"
    lr, muon_lr = learning_rate(recipe), recipe.muon_lr if recipe.optimizer == "muon" else None
    groups = parameter_groups(model, lr, recipe.weight_decay, muon_lr)
    return AdamWAndMuon(groups, lr=lr, betas=recipe.betas, eps=recipe.eps, fused=fused)


def learning_rate(recipe: Recipe) -> float:
    """Return the schedule's peak; the paper's rule scales lr by windows a step / 64, limited to 1 to 8."""
    if recipe.lr_rule == "paper":
        return recipe.lr * min(max(recipe.windows_per_step / 64, 1.0), 8.0)
    return recipe.lr


def lr_scale(step: int, recipe: Recipe, done: float = 0.0) -> float:
    """Return the factor of the peak in step `step`, counted from 0.

    In a run that ends by time, a cosine falls by `done`, the share of the run that is done.
    """
    if step < recipe.warmup:
        return (step + 1) / recipe.warmup
    if recipe.schedule == "constant_with_warmup":
        return 1.0
    along = done if recipe.ends_by_time else (step - recipe.warmup) / max(recipe.steps - 1 - recipe.warmup, 1)
    return recipe.lr_end + (1 - recipe.lr_end) * 0.5 * (1 + math.cos(math.pi * min(along, 1.0)))


def set_lr(optimizer: torch.optim.Optimizer, scale: float) -> float:
    """Set the lr of every group to `base_lr` times the scale, and return the largest, Muon's left out."""
    for group in optimizer.param_groups:
        group["lr"] = group["base_lr"] * scale
    return max(group["lr"] for group in optimizer.param_groups if not group["muon"])


def parameter_groups(
    model: HMA, lr: float, weight_decay: float, muon_lr: float | None = None
) -> list[dict[str, Any]]:
    """Return the groups of parameters, by weight decay, muP's scaling, sharding and optimizer.

    Each has its `base_lr`, its parameters' `names`, and whether Muon steps them: with `muon_lr`, the matrices
    of the blocks.
    """
    multiplier = model.config.width / model.config.base_width if model.config.mup else 1.0
    matrices = _growing_matrices(model) if multiplier != 1.0 else set()
    plain = _undecayed(model)
    groups: dict[tuple[bool, bool, bool, bool], dict[str, Any]] = {}
    for name, parameter in model.named_parameters():
        if not parameter.requires_grad:
            continue
        decays, scaled, sharded = name not in plain, name in matrices, isinstance(parameter, DTensor)
        factor = multiplier if scaled else 1.0
        rate, decay = lr / factor, weight_decay * factor if decays else 0.0
        muon = muon_lr is not None and name.startswith("trunk.blocks.") and parameter.ndim >= 2
        if muon_lr is not None and muon:
            rate = muon_lr
        fresh = {"params": [], "names": [], "lr": rate, "base_lr": rate, "weight_decay": decay, "muon": muon}
        group = groups.setdefault((decays, scaled, sharded, muon), fresh)
        group["params"].append(parameter)
        group["names"].append(name)
    return list(groups.values())


def _undecayed(model: nn.Module) -> set[str]:
    """Return the names of the parameters of norms, biases, embeddings, positions and masks."""
    names = set()
    for prefix, module in model.named_modules():
        own = isinstance(module, nn.LayerNorm | nn.GroupNorm | nn.RMSNorm | nn.Embedding)
        for name, parameter in module.named_parameters(recurse=False):
            if own or parameter.ndim < 2 or "weight" not in name:
                names.add(f"{prefix}.{name}" if prefix else name)
    return names


def _growing_matrices(model: HMA) -> set[str]:
    """Return the parameters with two sides that grow with the width, by comparison with a wider model."""
    with torch.device("meta"):
        wider = type(model)(model.config.replace(width=2 * model.config.width))
        for name, space in model.embodiments.items():
            wider.add_embodiment(space, waves=waves_of_stem(model.stem_state(name)))
    shapes = {name: parameter.shape for name, parameter in wider.named_parameters()}
    grown = {n: sum(a != b for a, b in zip(p.shape, shapes[n])) for n, p in model.named_parameters()}
    return {name for name, sides in grown.items() if sides >= 2}


def optimizer_state(optimizer: torch.optim.Optimizer) -> dict[str, Tensor]:
    """Return unsharded moments by name: `<parameter>/exp_avg` and so on; only updated parameters have any.

    Every rank must call it.
    """
    return {
        f"{name}/{moment}": whole(torch.as_tensor(optimizer.state[parameter][moment]))
        for group in optimizer.param_groups
        for name, parameter in zip(group["names"], group["params"])
        for moment in _MOMENTS
        if moment in optimizer.state.get(parameter, {})
    }


def load_optimizer_state(optimizer: torch.optim.Optimizer, state: Mapping[str, Tensor]) -> None:
    """Restore a result of `optimizer_state`; a parameter that it does not name begins without moments."""
    for group in optimizer.param_groups:
        for name, parameter in zip(group["names"], group["params"]):
            if f"{name}/exp_avg" in state and group["muon"]:
                optimizer.state[parameter] = {"exp_avg": like(state[f"{name}/exp_avg"].clone(), parameter)}
            elif f"{name}/step" in state:
                moments = {key: like(state[f"{name}/{key}"].clone(), parameter) for key in _MOMENTS[:2]}
                step_device = parameter.device if optimizer.defaults.get("fused") else "cpu"
                step = state[f"{name}/step"].clone().to(step_device)
                optimizer.state[parameter] = {**moments, "step": step}


class Average:
    """A moving average of a network's parameters; each rank averages its part.

    After each step it moves towards the weights by 1 - decay. In the first steps it moves by more, so that it
    soon forgets the initial weights (the decay is at most (1 + step) / (10 + step)).
    """

    def __init__(self, model: nn.Module, decay: float) -> None:
        self.decay = decay
        self._model = model
        every = model.named_parameters(remove_duplicate=False)  # a shared stem under each robot's name
        self._own = {name: p.detach().clone() for name, p in every if p.requires_grad}

    @torch.no_grad()
    def update(self, step: int) -> None:
        """Update the average with the weights after step `step`, counted from 1."""
        weight = 1 - min(self.decay, (1 + step) / (10 + step))
        moving = dict(self._model.named_parameters(remove_duplicate=False))
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
