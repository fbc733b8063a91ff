"""Measure generated frames and training steps of a model with random weights, 32 layers by default.

`generate`: the prompt leaves room for one more frame in the window, so each measured frame is the last of
`window`. With the cache, each frame follows the one before it. Without the cache, each frame is computed from
the prompt again. In a batch, the time of a frame is the time of the step divided by the batch size.

`train`: a step computes the loss of a batch of random windows and its gradients, clips them, and updates the
weights with AdamW.

`waiting`: steps and frames of a small model (4 layers of width 128), for each way in which threads wait for
one another (see `hma_data.cpu`), alone on the machine and beside processes that keep every core busy. The
cases are interleaved and measured several times; the median counts. The CPU seconds show the cost of
spinning.

Each case runs in its own process. The fastest step after a warm-up counts, because other work on the machine
can only slow a step down.
"""

import multiprocessing
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from statistics import median
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

from hma_data.bench import Bench, in_fresh_process, peak_rss_mib
from hma_data.cpu import usable_cores
from hma_data.errors import UsageError

if TYPE_CHECKING:
    import torch

    from hma_model.network.model import HMA

ROBOT = "arm"
NETWORK: dict[str, Any] = {
    "layers": 32,
    "width": 256,
    "heads": 8,
    "conditioning": "modulation",
    "action_tokens": 1,
    "diffusion_width": 1024,
}
COMMON: dict[str, Any] = {
    "window": 12,
    "precision": "fp32",  # fp32 | bf16 (when training: products in bf16, weights in fp32)
    "device": "auto",
    "compile": False,
    "action_dims": 35,  # of a chunk
    "threads": 0,  # 0: torch's choice
    **NETWORK,
}
WARMUP = 2  # generated frames before the measured ones
WAITS: dict[str, dict[str, str]] = {
    "PASSIVE": {"OMP_WAIT_POLICY": "PASSIVE"},
    "ACTIVE": {"OMP_WAIT_POLICY": "ACTIVE"},
    **{f"{count:,} spins": {"GOMP_SPINCOUNT": str(count)} for count in (1_000, 10_000, 50_000, 200_000)},
    "one thread": {"OMP_NUM_THREADS": "1"},
}
ATTENTION = ("attention", "flash", "fmha")  # in the names of operators and kernels
PRODUCTS = ("::mm", "addmm", "bmm", "gemm", "cutlass")
OPENMP = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "OMP_NUM_THREADS")


def _kinds(bench: str, settings: dict[str, Any], **allowed: tuple[Any, ...]) -> list[str]:
    """Return the kinds of model to measure; raise UsageError for a setting that is not allowed."""
    kinds = {"both": ["discrete", "continuous"], "discrete": ["discrete"], "continuous": ["continuous"]}
    allowed = {"kind": tuple(kinds), "precision": ("fp32", "bf16"), **allowed}
    for key, value in settings.items():
        if value not in allowed.get(key, (value,)):
            names = ", ".join(str(one) for one in allowed[key] if one is not None)
            raise UsageError(f"bench {bench}", f"{key}={value} is not allowed", f"give one of {names}")
        if type(value) is int and value < 1 and key != "threads":
            raise UsageError(f"bench {bench}", f"{key}={value} is not allowed", "give at least 1")
    return kinds[settings["kind"]]


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
    network = {key: settings[key] for key in NETWORK} | {"training_pass": settings.get("pass", "window")}
    model = HMA(HMAConfig(kind=kind, frames=settings["window"], grid=grid, **network))
    dims = settings["action_dims"]
    model.add_embodiment(ActionSpace(ROBOT, dims, 1, (0.0,) * dims, (1.0,) * dims, (True,) * dims))
    return model.to(choose_device(settings["device"]))


def _random_frames(
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


def _finish(device: "torch.device") -> None:
    """Wait for the device."""
    import torch

    if device.type == "cuda":
        torch.cuda.synchronize(device)


def _device_name(device: "torch.device") -> str:
    """Return the name of a GPU, or the type of another device."""
    import torch

    return torch.cuda.get_device_name(device) if device.type == "cuda" else str(device)


def _memory(device: "torch.device") -> dict[str, float]:
    """Return the peak memory of the process and, on a GPU, the peak memory allocated there, in MiB."""
    import torch

    figures = {"peak_rss_mib": peak_rss_mib()}
    if device.type == "cuda":
        figures["peak_gpu_mib"] = round(torch.cuda.max_memory_allocated(device) / 2**20, 1)
    return figures


# -- generate


def generate(settings: dict[str, Any]) -> list[dict[str, Any]]:
    """Return one result for each kind, with the cache and without; raise UsageError for a wrong setting."""
    kinds = _kinds("generate", settings, cache=(None, True, False))
    if settings["window"] < 2:
        raise UsageError("bench generate", "a window of 1 has no prompt", "give window=2 or more")
    caches = [True, False] if settings["cache"] is None else [settings["cache"]]
    return [in_fresh_process(measure_frames, settings, kind, cache) for kind in kinds for cache in caches]


def measure_frames(settings: dict[str, Any], kind: str, cache: bool) -> dict[str, Any]:
    """Return the figures of one case of `generate`."""
    model = make_model(settings, kind).eval()
    if settings["precision"] == "bf16":
        model.bfloat16()
    seconds = _frame_seconds(model, settings, cache)
    frame = min(seconds) / settings["batch"]
    told = ("precision", "batch", "unmask_steps", "window", "decode", "compile")
    return {
        "kind": kind,
        "device": _device_name(model.device),
        "cache": cache,
        **{key: settings[key] for key in told},
        "ddim_steps": settings["ddim_steps"] if kind == "continuous" else None,
        "seconds_per_frame": round(frame, 6),
        "median_seconds_per_frame": round(median(seconds) / settings["batch"], 6),
        "frames_per_second": round(1 / frame, 3),
        **_memory(model.device),
    }


def _frame_seconds(model: "HMA", settings: dict[str, Any], cache: bool) -> list[float]:
    """Return the seconds of each measured step of the batch, with decoding if the settings ask for it."""
    import torch

    from hma_data.tokenizers.base import get_tokenizer
    from hma_model.generation.rollout import Rollout

    discrete = model.config.kind == "discrete"
    batch, known = settings["batch"], settings["window"] - 1
    count = WARMUP + settings["frames"]
    rollout = Rollout(
        model, ROBOT, batch, unmask_steps=settings["unmask_steps"], sample_steps=settings["ddim_steps"],
        cache=cache, compile=settings["compile"],
    )  # fmt: skip
    prompt = _random_frames(model, batch, known)
    actions = torch.randn(batch, known + count, settings["action_dims"])
    name, dtype = ("fsq-16", "uint32") if discrete else ("vae-8", "float16")
    tokenizer = get_tokenizer(name, device=str(model.device)) if settings["decode"] else None
    rollout.prompt(prompt, actions)
    seconds = []
    for index in range(known - 1, known - 1 + (count if cache else 1 + settings["frames"])):
        if not cache:
            rollout.prompt(prompt, actions)
        began = time.perf_counter()
        frame = rollout.step(actions[:, index])
        if tokenizer is not None:
            tokenizer.decode(frame.cpu().numpy().astype(dtype))
        _finish(model.device)
        seconds.append(time.perf_counter() - began)
    return seconds[-settings["frames"] :]


# -- train


def train(settings: dict[str, Any]) -> list[dict[str, Any]]:
    """Return one result for each kind; raise UsageError for a wrong setting."""
    return [
        in_fresh_process(measure_steps, settings, kind)
        for kind in _kinds("train", settings, **{"pass": ("window", "pairs")})
    ]


def measure_steps(settings: dict[str, Any], kind: str) -> dict[str, Any]:
    """Return the figures of one case of `train`."""
    model = make_model(settings, kind).train()
    model.trunk.checkpointing = settings["checkpointing"]
    if settings["compile"]:
        model.trunk.compile()
    seconds = _step_seconds(model, settings)
    told = ("precision", "batch", "window", "pass", "optimizer", "compile", "checkpointing")
    return {
        "kind": kind,
        "device": _device_name(model.device),
        **{key: settings[key] for key in told},
        "seconds_per_step": round(min(seconds), 4),
        "median_seconds_per_step": round(median(seconds), 4),
        "windows_per_second": round(settings["batch"] / min(seconds), 4),
        **_shares(model, settings),
        **_memory(model.device),
    }


def _shares(model: "HMA", settings: dict[str, Any]) -> dict[str, float]:
    """Return the shares of a step's time in matrix products, in attention, and in everything else.

    They are the profiler's self times of operators, on a GPU those of kernels.
    """
    from torch.profiler import ProfilerActivity, profile

    cuda = model.device.type == "cuda"
    with profile(activities=[ProfilerActivity.CUDA if cuda else ProfilerActivity.CPU]) as found:
        _step_seconds(model, {**settings, "steps": 0})
    spent = {"products": 0.0, "attention": 0.0, "other": 0.0}
    for one in found.key_averages():
        name = one.key.lower()
        kind = "attention" if any(word in name for word in ATTENTION) else "other"
        if kind == "other" and any(word in name for word in PRODUCTS):
            kind = "products"
        spent[kind] += one.self_device_time_total if cuda else one.self_cpu_time_total
    return {f"share_of_{kind}": round(time / sum(spent.values()), 3) for kind, time in spent.items()}


def _step_seconds(model: "HMA", settings: dict[str, Any]) -> list[float]:
    """Return the seconds of each measured training step."""
    import torch

    fused = model.device.type == "cuda"
    optimizer = torch.optim.AdamW(model.parameters(), lr=1e-4, fused=fused) if settings["optimizer"] else None
    generator = torch.Generator().manual_seed(0)
    seconds = []
    for _ in range(1 + settings["steps"]):
        batch = _windows(model, settings, generator)
        _finish(model.device)
        began = time.perf_counter()
        with torch.autocast(model.device.type, torch.bfloat16, enabled=settings["precision"] == "bf16"):
            loss = model(batch, generator=generator).loss
        loss.backward()
        if optimizer is not None:
            torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
            optimizer.step()
        model.zero_grad()
        _finish(model.device)
        seconds.append(time.perf_counter() - began)
    return seconds[1:]


def _windows(model: "HMA", settings: dict[str, Any], generator: "torch.Generator") -> Any:
    import torch

    b, t = settings["batch"], settings["window"]
    frames = _random_frames(model, b, t, generator)
    actions = torch.randn(b, t, settings["action_dims"], generator=generator)
    discrete = model.config.kind == "discrete"
    return SimpleNamespace(
        embodiment=[ROBOT] * b,
        actions=actions.to(model.device),
        action_mask=torch.ones(b, t, dtype=torch.bool, device=model.device),
        tokens=frames if discrete else None,
        latents=None if discrete else frames,
    )


# -- waiting


def waiting(settings: dict[str, Any]) -> list[dict[str, Any]]:
    """Measure each way of waiting, alone and beside busy processes; raise UsageError for a wrong setting."""
    beside = {"busy": (True,), "nothing": (False,), "both": (False, True)}
    _kinds("waiting", settings, kind=("discrete",), beside=tuple(beside))
    cases = [(wait, busy) for busy in beside[settings["beside"]] for wait in WAITS]
    rounds: dict[tuple[str, bool], list[dict[str, float]]] = {case: [] for case in cases}
    for _ in range(settings["rounds"]):
        for wait, busy in cases:
            with _environment(WAITS[wait]), _busy_cores(usable_cores() if busy else 0):
                found = in_fresh_process(measure_both, settings)
            rounds[wait, busy].append(found)
            rate = f"{found['steps_per_second']:.2f} steps/s"
            print(f"{wait}, {'busy cores' if busy else 'alone'}: {rate}", file=sys.stderr, flush=True)
    return [
        {
            "wait": wait,
            "beside": "busy cores" if busy else "nothing",
            **{key: round(median(one[key] for one in found), 4) for key in found[0]},
        }
        for (wait, busy), found in rounds.items()
    ]


def measure_both(settings: dict[str, Any]) -> dict[str, float]:
    """Return the speed of training and generation, and the CPU seconds that each took on all cores."""
    begun = time.process_time()
    step = median(_step_seconds(make_model(settings).train(), settings))
    trained = time.process_time()
    frame = median(_frame_seconds(make_model(settings).eval(), settings, True))
    return {
        "seconds_per_step": step,
        "steps_per_second": 1 / step,
        "training_cpu_seconds": trained - begun,
        "frames_per_second": settings["batch"] / frame,
        "generation_cpu_seconds": time.process_time() - trained,
    }


@contextmanager
def _environment(values: dict[str, str]) -> Iterator[None]:
    """Set exactly these variables of OpenMP for processes that start in the block."""
    before = dict(os.environ)
    for key in OPENMP:
        os.environ.pop(key, None)
    os.environ.update(values)
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)


@contextmanager
def _busy_cores(count: int) -> Iterator[None]:
    """Keep `count` cores busy in the block."""
    context = multiprocessing.get_context("spawn")
    processes = [context.Process(target=_spin, daemon=True) for _ in range(count)]
    for process in processes:
        process.start()
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.join()


def _spin() -> None:
    parent = os.getppid()
    while os.getppid() == parent:
        sum(range(100_000))


GENERATE = Bench(
    "seconds a generated frame, with a cache over time and with full recomputation",
    {
        "kind": "both",  # discrete | continuous | both
        **COMMON,
        "cache": None,  # true | false; None measures both
        "frames": 5,  # measured, after a warm-up
        "batch": 1,
        "unmask_steps": 2,
        "ddim_steps": 100,
        "decode": False,  # to pixels, by the embedded tokenizer
    },
    generate,
)
TRAIN = Bench(
    "seconds and memory of a training step",
    {
        "kind": "discrete",
        **COMMON,
        "steps": 3,  # measured, after a warm-up
        "batch": 2,
        "pass": "window",  # window | pairs, see HMAConfig.training_pass
        "checkpointing": False,  # recompute each block in the backward pass
        "optimizer": True,
    },
    train,
)
WAITING = Bench(
    "training steps and frames a second by how threads wait for one another",
    {
        **GENERATE.defaults,
        **TRAIN.defaults,
        "rounds": 3,  # of all cases
        "steps": 6,  # of training, in each round
        "frames": 10,  # generated, in each round
        "beside": "both",  # nothing | busy (processes on every core) | both
        "layers": 4,
        "width": 128,
        "heads": 4,
        "window": 8,
    },
    waiting,
)
