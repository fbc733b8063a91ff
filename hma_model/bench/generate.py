"""Measure how long a generated frame takes, with the cache over time and without it (`hma bench generate`).

Weights and tokens are random; the model has 32 layers of width 256 by default. The prompt leaves room for one
more frame in the window, so each measured frame is the last of `window`. With the cache, each frame follows
the one before it. Without the cache, each frame is computed from the prompt again. In a batch, the time of a
frame is the time of the step divided by the batch size. Each case runs in its own process. The fastest time
counts, because other work on the machine can only slow a step down.
"""

import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from statistics import median
from typing import TYPE_CHECKING, Any

from hma_data.errors import UsageError

if TYPE_CHECKING:
    import torch
    from numpy.typing import NDArray

    from hma_model.config import HMAConfig
    from hma_model.network.model import HMA

ABOUT = "seconds a generated frame, with a cache over time and with full recomputation"
DEFAULTS: dict[str, Any] = {
    "kind": "both",  # discrete | continuous | both
    "cache": None,  # true | false; None measures both
    "frames": 5,  # measured, after a warm-up
    "batch": 1,
    "window": 12,
    "unmask_steps": 2,
    "ddim_steps": 100,
    "precision": "fp32",  # fp32 | bf16
    "device": "auto",
    "compile": False,
    "decode": False,  # to pixels, by the embedded tokenizer
    "layers": 32,
    "width": 256,
    "heads": 8,
    "conditioning": "modulation",
    "action_tokens": 1,
    "action_dims": 35,  # of a chunk
    "diffusion_width": 1024,
    "threads": 0,  # 0: torch's choice
}
PRECISIONS = ("fp32", "bf16")
_KINDS = {"discrete": "fsq-16", "continuous": "vae-8"}  # each kind, and the tokenizer that decodes it
_NETWORK = ("layers", "width", "heads", "conditioning", "action_tokens", "diffusion_width")
_WARMUP = 2
ROBOT = "arm"


def run(settings: dict[str, Any]) -> list[dict[str, Any]]:
    """Return one result for each kind, with the cache and without it.

    Raises:
        UsageError: a setting has a value that is not allowed.
    """
    kinds = list(_KINDS) if settings["kind"] == "both" else [settings["kind"]]
    caches = [True, False] if settings["cache"] is None else [settings["cache"]]
    check("generate", settings, kind=(*_KINDS, "both"), cache=(None, True, False), precision=PRECISIONS)
    if settings["window"] < 2:
        raise UsageError("bench generate", "a window of 1 has no prompt", "give window=2 or more")
    return [in_fresh_process(measure, settings, kind, cache) for kind in kinds for cache in caches]


def check(bench: str, settings: dict[str, Any], **allowed: tuple[Any, ...]) -> None:
    """Refuse values outside `allowed`, and counts below 1."""
    for key, values in allowed.items():
        if settings[key] not in values:
            names = ", ".join(str(value) for value in values if value is not None)
            raise UsageError(
                f"bench {bench}", f"{key}={settings[key]} is not allowed", f"give one of {names}"
            )
    for key, value in settings.items():
        if type(value) is int and value < 1 and key != "threads":
            raise UsageError(f"bench {bench}", f"{key}={value} is not allowed", "give at least 1")


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
    config = HMAConfig(
        kind=kind, frames=settings["window"], grid=(32, 32) if kind == "continuous" else (16, 16),
        **{key: settings[key] for key in _NETWORK},
    )  # fmt: skip
    model = HMA(config)
    dims = settings["action_dims"]
    model.add_embodiment(ActionSpace(ROBOT, dims, 1, (0.0,) * dims, (1.0,) * dims, (True,) * dims))
    return model.to(choose_device(settings["device"]))


def measure(settings: dict[str, Any], kind: str, cache: bool) -> dict[str, Any]:
    """Return the figures of one case."""
    model = make_model(settings, kind).eval()
    if settings["precision"] == "bf16":
        model.bfloat16()
    seconds = _step_seconds(model, settings, cache)
    frame = min(seconds) / settings["batch"]
    return {
        "kind": kind,
        "device": device_name(model.device),
        **{key: settings[key] for key in ("precision", "batch", "unmask_steps", "window")},
        "cache": cache,
        "decode": settings["decode"],
        "compile": settings["compile"],
        "ddim_steps": settings["ddim_steps"] if kind == "continuous" else None,
        "seconds_per_frame": round(frame, 6),
        "median_seconds_per_frame": round(median(seconds) / settings["batch"], 6),
        "frames_per_second": round(1 / frame, 3),
        **memory(model.device),
        **(_limit(model, settings, min(seconds)) if model.device.type == "cuda" and cache else {}),
    }


def device_name(device: "torch.device") -> str:
    """Return the name of a GPU, or the type of another device."""
    import torch

    return torch.cuda.get_device_name(device) if device.type == "cuda" else str(device)


def memory(device: "torch.device") -> dict[str, float]:
    """Return the peak memory of the process and, on a GPU, the peak memory allocated there, in MiB."""
    import torch

    from hma_data.bench import peak_rss_mib

    figures = {"peak_rss_mib": peak_rss_mib()}
    if device.type == "cuda":
        figures["peak_gpu_mib"] = round(torch.cuda.max_memory_allocated(device) / 2**20, 1)
    return figures


def _step_seconds(model: "HMA", settings: dict[str, Any], cache: bool) -> list[float]:
    """Return the seconds of each measured step of the batch, with decoding if the settings ask for it."""
    import torch

    from hma_model.generation.rollout import Rollout

    config, batch, known = model.config, settings["batch"], settings["window"] - 1
    count = _WARMUP + settings["frames"]
    rollout = Rollout(
        model, ROBOT, batch, unmask_steps=settings["unmask_steps"], sample_steps=settings["ddim_steps"],
        cache=cache, compile=settings["compile"],
    )  # fmt: skip
    prompt = _prompt(config, batch, known).to(model.device)
    actions = torch.randn(batch, known + count, settings["action_dims"])
    decode = _decoder(config.kind, str(model.device)) if settings["decode"] else None
    rollout.prompt(prompt, actions)
    seconds = []
    for index in range(known - 1, known - 1 + (count if cache else 1 + settings["frames"])):
        if not cache:
            rollout.prompt(prompt, actions)
        began = time.perf_counter()
        frame = rollout.step(actions[:, index])
        if decode is not None:
            decode(frame)
        finish(model.device)
        seconds.append(time.perf_counter() - began)
    return seconds[-settings["frames"] :]


def _prompt(config: "HMAConfig", batch: int, frames: int) -> "torch.Tensor":
    import torch

    if config.kind == "discrete":
        return torch.randint(0, config.vocab_size, (batch, frames, *config.grid))
    return torch.randn(batch, frames, config.channels, *config.grid)


def _decoder(kind: str, device: str) -> "Callable[[torch.Tensor], NDArray[Any]]":
    from hma_data.tokenizers.base import get_tokenizer

    tokenizer = get_tokenizer(_KINDS[kind], device=device)
    dtype = "uint32" if kind == "discrete" else "float16"
    return lambda frame: tokenizer.decode(frame.cpu().numpy().astype(dtype))


def finish(device: "torch.device") -> None:
    """Wait for the device."""
    import torch

    if device.type == "cuda":
        torch.cuda.synchronize(device)


def _limit(model: "HMA", settings: dict[str, Any], seconds: float) -> dict[str, float]:
    """Compare the time of a step with the time to read weights and cache once in each pass.

    The diffusion head of the continuous model is left out: its steps limit it, not memory.
    """
    config, size = model.config, next(model.trunk.parameters()).element_size()
    weights = sum(parameter.numel() for parameter in model.trunk.blocks.parameters()) * size
    kept = (
        2 * config.layers * config.frames * config.tokens_per_frame * config.width * settings["batch"] * size
    )
    moved = settings["unmask_steps"] * (weights + kept)
    bandwidth = _bandwidth(model.device)
    return {
        "read_mib_per_frame": round(moved / 2**20, 1),
        "copy_gb_per_second": round(bandwidth / 1e9, 1),
        "share_of_memory_bound": round(moved / bandwidth / seconds, 4),
    }


def _bandwidth(device: "torch.device") -> float:
    """Return how many bytes a second a copy within the device's memory reads and writes."""
    import torch

    source = torch.empty(2**28, device=device)
    target = torch.empty_like(source)
    best = float("inf")
    for _ in range(5):
        finish(device)
        began = time.perf_counter()
        target.copy_(source)
        finish(device)
        best = min(best, time.perf_counter() - began)
    return 2 * source.numel() * source.element_size() / best
