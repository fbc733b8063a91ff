"""Benchmark the model: `hma bench generate`, `train`, `mup`, `waiting`.

Here is what these benchmarks share: the settings of a network, and models with random weights.
"""

from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import TYPE_CHECKING, Any

from hma_data.bench import peak_rss_mib
from hma_data.errors import UsageError

if TYPE_CHECKING:
    import torch

    from hma_model.network.model import HMA

KINDS = ("discrete", "continuous")
ROBOT = "arm"
NETWORK: dict[str, Any] = {
    "layers": 32,
    "width": 256,
    "heads": 8,
    "conditioning": "modulation",
    "action_tokens": 1,
    "diffusion_width": 1024,
}
DEFAULTS: dict[str, Any] = {
    "kind": "both",  # discrete | continuous | both
    "window": 12,
    "precision": "fp32",  # fp32 | bf16
    "device": "auto",
    "compile": False,
    "action_dims": 35,  # of a chunk
    "threads": 0,  # 0: torch's choice
    **NETWORK,
}


def check(bench: str, settings: dict[str, Any], **allowed: tuple[Any, ...]) -> None:
    """Raise UsageError for a value outside `allowed`, and for a count below 1."""
    for key, values in allowed.items():
        if settings[key] not in values:
            names = ", ".join(str(value) for value in values if value is not None)
            fault = f"{key}={settings[key]} is not allowed"
            raise UsageError(f"bench {bench}", fault, f"give one of {names}")
    for key, value in settings.items():
        if type(value) is int and value < 1 and key != "threads":
            raise UsageError(f"bench {bench}", f"{key}={value} is not allowed", "give at least 1")


def kinds(bench: str, settings: dict[str, Any], **allowed: tuple[Any, ...]) -> tuple[str, ...]:
    """Check the settings, and return the kinds of model to measure."""
    check(bench, settings, kind=(*KINDS, "both"), precision=("fp32", "bf16"), **allowed)
    return KINDS if settings["kind"] == "both" else (settings["kind"],)


def in_fresh_process(task: Callable[..., dict[str, Any]], *arguments: Any) -> dict[str, Any]:
    """Return the task's result, computed in a new process where nothing has taken memory yet."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as fresh:
        return fresh.submit(task, *arguments).result()


def make_model(settings: dict[str, Any], kind: str = "discrete") -> "HMA":
    """Return a model with one embodiment and random weights, on the device of the settings."""
    import torch

    from hma_model.config import ActionSpace, HMAConfig
    from hma_model.network.model import HMA
    from hma_model.training.runtime import choose_device

    if settings["threads"]:
        torch.set_num_threads(settings["threads"])
    torch.manual_seed(0)
    grid = (32, 32) if kind == "continuous" else (16, 16)
    network = {key: settings[key] for key in NETWORK}
    model = HMA(HMAConfig(kind=kind, frames=settings["window"], grid=grid, **network))
    dims = settings["action_dims"]
    model.add_embodiment(ActionSpace(ROBOT, dims, 1, (0.0,) * dims, (1.0,) * dims, (True,) * dims))
    return model.to(choose_device(settings["device"]))


def random_frames(
    model: "HMA", batch: int, frames: int, generator: "torch.Generator | None" = None
) -> "torch.Tensor":
    """Return random tokens (B, T, h, w), or latents (B, T, c, H, W), on the model's device."""
    import torch

    config = model.config
    if config.kind == "discrete":
        made = torch.randint(0, config.vocab_size, (batch, frames, *config.grid), generator=generator)
    else:
        made = torch.randn(batch, frames, config.channels, *config.grid, generator=generator)
    return made.to(model.device)


def device_name(device: "torch.device") -> str:
    """Return the name of a GPU, or the type of another device."""
    import torch

    return torch.cuda.get_device_name(device) if device.type == "cuda" else str(device)


def memory(device: "torch.device") -> dict[str, float]:
    """Return the peak memory of the process and, on a GPU, the peak memory allocated there, in MiB."""
    import torch

    figures = {"peak_rss_mib": peak_rss_mib()}
    if device.type == "cuda":
        figures["peak_gpu_mib"] = round(torch.cuda.max_memory_allocated(device) / 2**20, 1)
    return figures


def finish(device: "torch.device") -> None:
    """Wait for the device."""
    import torch

    if device.type == "cuda":
        torch.cuda.synchronize(device)
