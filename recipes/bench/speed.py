"""Measure training steps of a model with random weights, 32 layers by default, and make such models.

A step computes the loss of a batch of random windows and its gradients, clips them, and updates the weights
with AdamW.

Each case runs in its own process. The fastest step after a warm-up counts, because other work on the machine
can only slow a step down.
"""

import os
import time
from statistics import median
from typing import TYPE_CHECKING, Any

from hma_data.errors import UsageError
from recipes.bench.harness import Bench, in_fresh_process, peak_rss_mib

if TYPE_CHECKING:
    import torch

    from hma_data.loading.rows import Batch
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
    "trunk": "transformer",  # transformer | unet (on raw-128 pixels in patches of 4, `kind` does not matter)
    "levels": [48, 96, 192],  # of a U-Net
    "grid": 0,  # side of the tokenizer's grid; 0: 16 of tokens, 32 of latents
    **NETWORK,
}
ATTENTION = ("attention", "flash", "fmha")  # in the names of operators and kernels
UNET: dict[str, Any] = {  # as in recipes/train/unet_tiny.yaml
    "grid": (128, 128),
    "channels": 3,
    "patch": 4,
    "latent_scale": 1 / 255,
    "training_pass": "pairs",
    "whole_share": 1.0,
    "video_loss": "regression",
    "shared_modulation": True,
    "copy_previous": True,
    "motion_weight": 6.0,
    "history_probability": 0.0,
}
TRUNKS, PRECISIONS = ("transformer", "unet"), ("fp32", "bf16")
KINDS = {"both": ["discrete", "continuous"], "discrete": ["discrete"], "continuous": ["continuous"]}
PRODUCTS = ("::mm", "addmm", "bmm", "gemm", "cutlass", "mkldnn")


def check_settings(bench: str, settings: dict[str, Any], **allowed: tuple[Any, ...]) -> None:
    """Raise UsageError for a setting that is not allowed."""
    allowed = {"kind": tuple(KINDS), "precision": PRECISIONS, **allowed}
    for key, value in settings.items():
        if value not in allowed.get(key, (value,)):
            names = ", ".join(str(one) for one in allowed[key] if one is not None)
            raise UsageError(f"bench {bench}", f"{key}={value} is not allowed", f"give one of {names}")
        if type(value) is int and value < 1 and key not in ("threads", "grid"):
            raise UsageError(f"bench {bench}", f"{key}={value} is not allowed", "give at least 1")


def numbers_of(bench: str, key: str, settings: dict[str, Any], usual: list[int]) -> list[int]:
    """Return the numbers of a setting, such as 0,1,2; the usual ones for None.

    Raises:
        UsageError: they are none.
    """
    if settings[key] is None:
        return usual
    try:
        return [int(part) for part in str(settings[key]).split(",")]
    except ValueError as fault:
        text = f"{key}={settings[key]} is no list of numbers"
        raise UsageError(f"bench {bench}", text, "write 0,1,2") from fault


def set_threads(settings: dict[str, Any]) -> None:
    """Set the number of torch's threads, if the settings give one."""
    import torch

    if settings["threads"]:
        torch.set_num_threads(settings["threads"])


def make_model(settings: dict[str, Any], kind: str = "discrete") -> "HMA":
    """Return a model with one embodiment and random weights, on the device of the settings."""
    import torch

    from hma_model.config import ActionSpace, HMAConfig
    from hma_model.network.model import HMA
    from hma_model.training.runtime import choose_device

    set_threads(settings)
    torch.manual_seed(0)
    network = {key: settings[key] for key in NETWORK} | {"training_pass": settings.get("pass", "window")}
    side = settings["grid"] or (32 if kind == "continuous" else 16)
    network["grid"] = (side, side)
    if settings["trunk"] == "unet":
        kind = "continuous"
        network |= {"trunk": "unet", "levels": tuple(settings["levels"]), **UNET}
    model = HMA(HMAConfig(kind=kind, frames=settings["window"], **network))
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


def finish(device: "torch.device") -> None:
    """Wait for the device."""
    import torch

    if device.type == "cuda":
        torch.cuda.synchronize(device)


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


def train(settings: dict[str, Any]) -> list[dict[str, Any]]:
    """Return one result for each kind; raise UsageError for a wrong setting."""
    allowed = {"pass": ("window", "pairs"), "precision": (*PRECISIONS, "both"), "trunk": TRUNKS}
    check_settings("train", settings, **allowed)
    kinds = ["continuous"] if settings["trunk"] == "unet" else KINDS[settings["kind"]]
    return [row for kind in kinds for row in in_fresh_process(measure_steps, settings, kind)]


def measure_steps(settings: dict[str, Any], kind: str) -> list[dict[str, Any]]:
    """Return the figures of one case of `train`; of both precisions, their steps alternate."""
    precisions = PRECISIONS if settings["precision"] == "both" else (settings["precision"],)
    ways = list[Steps]()
    for precision in precisions:
        model = make_model(settings, kind).train()
        model.trunk.checkpointing = settings["checkpointing"]
        if settings["compile"]:
            model.trunk.compile()
        ways.append(Steps(model, settings | {"precision": precision}))
    for _ in range(1 + settings["steps"]):
        for steps in ways:
            steps.once()
    return [{"kind": kind, **steps.figures()} for steps in ways]


def step_seconds(model: "HMA", settings: dict[str, Any]) -> list[float]:
    """Return the seconds of each measured training step."""
    steps = Steps(model, settings)
    for _ in range(1 + settings["steps"]):
        steps.once()
    return steps.seconds[1:]


class Steps:
    """Training steps of one model in one precision; the first is a warm-up."""

    def __init__(self, model: "HMA", settings: dict[str, Any]) -> None:
        import torch

        self.model, self.settings = model, settings
        fused = model.device.type == "cuda"
        adamw = torch.optim.AdamW(model.parameters(), lr=1e-4, fused=fused)
        self.optimizer = adamw if settings["optimizer"] else None
        self.generator = torch.Generator().manual_seed(0)
        self.seconds, self.cpu_seconds = list[float](), list[float]()

    def once(self) -> None:
        """Make one step, and keep its time."""
        import torch

        model, half = self.model, self.settings["precision"] == "bf16"
        batch = _windows(model, self.settings, self.generator)
        finish(model.device)
        began, cpu_began = time.perf_counter(), time.process_time()
        with torch.autocast(model.device.type, torch.bfloat16, enabled=half):
            loss = model(batch, generator=self.generator).loss
        loss.backward()
        if self.optimizer is not None:
            torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
            self.optimizer.step()
        model.zero_grad()
        finish(model.device)
        self.seconds.append(time.perf_counter() - began)
        self.cpu_seconds.append(time.process_time() - cpu_began)

    def figures(self) -> dict[str, Any]:
        """Return the figures of all steps after the warm-up."""
        settings, seconds = self.settings, self.seconds[1:]
        told = ("trunk", "precision", "batch", "window", "pass", "optimizer", "compile", "checkpointing")
        return {
            "device": device_name(self.model.device),
            **{key: settings[key] for key in told},
            "seconds_per_step": round(min(seconds), 4),
            "median_seconds_per_step": round(median(seconds), 4),
            "cpu_seconds_per_step": round(min(self.cpu_seconds[1:]), 4),
            "windows_per_second": round(settings["batch"] / min(seconds), 4),
            **_shares(self),
            **memory(self.model.device),
        }


def _shares(steps: Steps) -> dict[str, float]:
    """Return the shares of a step's time in matrix products, in attention, and in everything else.

    They are the profiler's self times of operators, on a GPU those of kernels.
    """
    from torch.profiler import ProfilerActivity, profile

    os.environ.setdefault("KINETO_LOG_LEVEL", "99")  # it calls a machine without a GPU an error
    cuda = steps.model.device.type == "cuda"
    device = ProfilerActivity.CUDA if cuda else ProfilerActivity.CPU
    with profile(activities=[device], acc_events=True) as found:
        steps.once()
    spent = {"products": 0.0, "attention": 0.0, "other": 0.0}
    for one in found.key_averages():
        name = one.key.lower()
        kind = "attention" if any(word in name for word in ATTENTION) else "other"
        if kind == "other" and any(word in name for word in PRODUCTS):
            kind = "products"
        spent[kind] += one.self_device_time_total if cuda else one.self_cpu_time_total
    return {f"share_of_{kind}": round(time / sum(spent.values()), 3) for kind, time in spent.items()}


def _windows(model: "HMA", settings: dict[str, Any], generator: "torch.Generator") -> "Batch":
    import torch

    from hma_data.loading.rows import Batch

    b, t = settings["batch"], model.config.frames
    frames = random_frames(model, b, t, generator)
    robot, space = next(iter(model.embodiments.items()))
    actions = torch.randn(b, t, space.chunk_dim, generator=generator)
    discrete = model.config.kind == "discrete"
    return Batch(
        embodiment=[robot] * b,
        actions=actions.to(model.device),
        action_mask=torch.ones(b, t, dtype=torch.bool, device=model.device),
        tokens=frames if discrete else None,
        latents=None if discrete else frames,
    )


TRAIN = Bench(
    "time and memory of a training step",
    {
        "kind": "discrete",
        **COMMON,  # precision may also be both, whose steps alternate
        "steps": 3,  # measured, after a warm-up
        "batch": 2,
        "pass": "window",  # window | pairs, see HMAConfig.training_pass
        "checkpointing": False,  # recompute each block in the backward pass
        "optimizer": True,
    },
    train,
)
