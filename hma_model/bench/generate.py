"""Measure how long a generated frame takes, with the cache over time and without it (`hma bench generate`).

Weights and tokens are random; the model has 32 layers of width 256 by default. The prompt leaves room for one
more frame in the window, so each measured frame is the last of `window`. With the cache, each frame follows
the one before it. Without the cache, each frame is computed from the prompt again. In a batch, the time of a
frame is the time of the step divided by the batch size. Each case runs in its own process. The fastest time
counts, because other work on the machine can only slow a step down.
"""

import time
from collections.abc import Callable
from statistics import median
from typing import TYPE_CHECKING, Any

from hma_data.errors import UsageError
from hma_model import bench
from hma_model.bench import ROBOT, device_name, finish, in_fresh_process, make_model, memory, random_frames

if TYPE_CHECKING:
    import torch
    from numpy.typing import NDArray

    from hma_model.network.model import HMA

ABOUT = "seconds a generated frame, with a cache over time and with full recomputation"
DEFAULTS: dict[str, Any] = {
    **bench.DEFAULTS,
    "cache": None,  # true | false; None measures both
    "frames": 5,  # measured, after a warm-up
    "batch": 1,
    "unmask_steps": 2,
    "ddim_steps": 100,
    "decode": False,  # to pixels, by the embedded tokenizer
}
_TOKENIZERS = {"discrete": "fsq-16", "continuous": "vae-8"}  # kind -> the tokenizer that decodes it
_WARMUP = 2


def run(settings: dict[str, Any]) -> list[dict[str, Any]]:
    """Return one result for each kind, with the cache and without it.

    Raises:
        UsageError: a setting has a value that is not allowed.
    """
    kinds = bench.kinds("generate", settings, cache=(None, True, False))
    if settings["window"] < 2:
        raise UsageError("bench generate", "a window of 1 has no prompt", "give window=2 or more")
    caches = [True, False] if settings["cache"] is None else [settings["cache"]]
    return [in_fresh_process(measure, settings, kind, cache) for kind in kinds for cache in caches]


def measure(settings: dict[str, Any], kind: str, cache: bool) -> dict[str, Any]:
    """Return the figures of one case."""
    model = make_model(settings, kind).eval()
    if settings["precision"] == "bf16":
        model.bfloat16()
    seconds = _step_seconds(model, settings, cache)
    frame = min(seconds) / settings["batch"]
    told = ("precision", "batch", "unmask_steps", "window", "decode", "compile")
    return {
        "kind": kind,
        "device": device_name(model.device),
        "cache": cache,
        **{key: settings[key] for key in told},
        "ddim_steps": settings["ddim_steps"] if kind == "continuous" else None,
        "seconds_per_frame": round(frame, 6),
        "median_seconds_per_frame": round(median(seconds) / settings["batch"], 6),
        "frames_per_second": round(1 / frame, 3),
        **memory(model.device),
    }


def _step_seconds(model: "HMA", settings: dict[str, Any], cache: bool) -> list[float]:
    """Return the seconds of each measured step of the batch, with decoding if the settings ask for it."""
    import torch

    from hma_model.generation.rollout import Rollout

    batch, known = settings["batch"], settings["window"] - 1
    count = _WARMUP + settings["frames"]
    rollout = Rollout(
        model, ROBOT, batch, unmask_steps=settings["unmask_steps"], sample_steps=settings["ddim_steps"],
        cache=cache, compile=settings["compile"],
    )  # fmt: skip
    prompt = random_frames(model, batch, known)
    actions = torch.randn(batch, known + count, settings["action_dims"])
    decode = _decoder(model.config.kind, str(model.device)) if settings["decode"] else None
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


def _decoder(kind: str, device: str) -> "Callable[[torch.Tensor], NDArray[Any]]":
    from hma_data.tokenizers.base import get_tokenizer

    tokenizer = get_tokenizer(_TOKENIZERS[kind], device=device)
    dtype = "uint32" if kind == "discrete" else "float16"
    return lambda frame: tokenizer.decode(frame.cpu().numpy().astype(dtype))
