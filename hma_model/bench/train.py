"""Measure the time and memory of a training step (`hma bench train`).

A step computes the loss of a batch of random windows and its gradients, clips them, and updates the weights
with AdamW. The model has 32 layers of width 256 by default. The fastest step after a warm-up counts, because
other work on the machine can only slow a step down.
"""

import time
from statistics import median
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

from hma_model import bench
from hma_model.bench import ROBOT, device_name, finish, in_fresh_process, make_model, memory, random_frames

if TYPE_CHECKING:
    import torch

    from hma_model.network.model import HMA

ABOUT = "seconds and memory of a training step"
DEFAULTS: dict[str, Any] = {
    **bench.DEFAULTS,  # bf16: products in bf16, weights in fp32
    "kind": "discrete",
    "steps": 3,  # measured, after a warm-up
    "batch": 2,
    "checkpointing": False,  # recompute each block in the backward pass
    "optimizer": True,
}


def run(settings: dict[str, Any]) -> list[dict[str, Any]]:
    """Return one result for each kind.

    Raises:
        UsageError: a setting has a value that is not allowed.
    """
    return [in_fresh_process(measure, settings, kind) for kind in bench.kinds("train", settings)]


def measure(settings: dict[str, Any], kind: str) -> dict[str, Any]:
    """Return the figures of one case."""
    model = make_model(settings, kind).train()
    model.trunk.checkpointing = settings["checkpointing"]
    if settings["compile"]:
        model.trunk.compile()
    seconds = _step_seconds(model, settings)
    told = ("precision", "batch", "window", "optimizer", "compile", "checkpointing")
    return {
        "kind": kind,
        "device": device_name(model.device),
        **{key: settings[key] for key in told},
        "seconds_per_step": round(min(seconds), 4),
        "median_seconds_per_step": round(median(seconds), 4),
        "windows_per_second": round(settings["batch"] / min(seconds), 4),
        **memory(model.device),
    }


def _step_seconds(model: "HMA", settings: dict[str, Any]) -> list[float]:
    import torch

    fused = model.device.type == "cuda"
    optimizer = torch.optim.AdamW(model.parameters(), lr=1e-4, fused=fused) if settings["optimizer"] else None
    generator = torch.Generator().manual_seed(0)
    seconds = []
    for _ in range(1 + settings["steps"]):
        batch = _windows(model, settings, generator)
        finish(model.device)
        began = time.perf_counter()
        with torch.autocast(model.device.type, torch.bfloat16, enabled=settings["precision"] == "bf16"):
            loss = model(batch, generator=generator).loss
        loss.backward()
        if optimizer is not None:
            torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
            optimizer.step()
        model.zero_grad()
        finish(model.device)
        seconds.append(time.perf_counter() - began)
    return seconds[1:]


def _windows(model: "HMA", settings: dict[str, Any], generator: "torch.Generator") -> Any:
    import torch

    b, t = settings["batch"], settings["window"]
    frames = random_frames(model, b, t, generator)
    actions = torch.randn(b, t, settings["action_dims"], generator=generator)
    discrete = model.config.kind == "discrete"
    return SimpleNamespace(
        embodiment=[ROBOT] * b,
        actions=actions.to(model.device),
        action_mask=torch.ones(b, t, dtype=torch.bool, device=model.device),
        tokens=frames if discrete else None,
        latents=None if discrete else frames,
    )
