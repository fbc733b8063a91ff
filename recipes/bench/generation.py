"""Measure generated frames, of models with random weights and of the embedded one (`hma bench generate`).

Without `kind`, the results are a table, of which `rows` chooses some: the discrete model of 32 layers with
one and with 16 rollouts, with decoding to pixels and without; the continuous one with 4 sampling steps and
with the paper's 100; and the embedded model with decoding. `hma bench play` measures what a person at
`hma play` gets of it. With `kind`, the other settings choose the case.

The prompt leaves room for one more frame in the window, so each measured frame is the last of `window`. With
the cache, each frame follows the one before it. Without the cache, each frame is computed from the prompt
again. In a batch, the time of a frame is the time of the step divided by the batch size.

`gflop_per_frame` counts the products of a frame; `limit_gflop_per_second` is the rate at which this machine
does them when it does nothing else (recipes/bench/flops.py); `share_of_limit` is the share of a frame's time
that they would then take. Each case runs in its own process. The fastest step after a warm-up counts.
"""

import time
from collections.abc import Callable
from statistics import median
from typing import TYPE_CHECKING, Any

from hma_data.errors import UsageError
from recipes.bench.harness import Bench, in_fresh_process
from recipes.bench.speed import (
    COMMON,
    KINDS,
    check_settings,
    device_name,
    finish,
    make_model,
    memory,
    random_frames,
    set_threads,
)

if TYPE_CHECKING:
    import torch

    from hma_model.generation.rollout import Rollout
    from hma_model.network.model import HMA

WARMUP = 1  # generated frames before the measured ones
CHOSEN = ("kind", "batch", "decode", "cache", "ddim_steps")
PAPER_STEPS = 100  # of the diffusion head
TABLE = {
    name: {key: value for key, value in zip(CHOSEN, case) if value is not None}
    for name, case in {
        "embedded": ("embedded", 1, True, True, None),
        "discrete": ("discrete", 1, False, True, None),
        "discrete-pictures": ("discrete", 1, True, True, None),
        "discrete-uncached": ("discrete", 1, False, False, None),
        "discrete-16": ("discrete", 16, False, True, None),
        "discrete-16-pictures": ("discrete", 16, True, True, None),
        "continuous-4": ("continuous", 1, False, True, 4),
        "continuous-100": ("continuous", 1, False, True, PAPER_STEPS),
    }.items()
}


def generate(settings: dict[str, Any]) -> list[dict[str, Any]]:
    """Return one result for each case; raise UsageError for a wrong setting."""
    flags = (None, True, False)
    precisions = ("fp32", "bf16", "int8")
    kinds = ("all", "embedded", *KINDS)
    check_settings("generate", settings, kind=kinds, cache=flags, decode=flags, precision=precisions)
    if settings["window"] < 2:
        raise UsageError("bench generate", "a window of 1 has no prompt", "give window=2 or more")
    if not isinstance(settings["batch"], int | None):
        raise UsageError("bench generate", f"batch={settings['batch']} is not allowed", "give a number")
    return [in_fresh_process(measure_frames, settings | case) for case in cases(settings)]


def cases(settings: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the kind, batch size, decoding and so on of each case; of a row of the table, also its name.

    Raises:
        UsageError: the table has no such row.
    """
    given = {key: settings[key] for key in CHOSEN if settings[key] not in (None, "all")}
    if settings["kind"] == "all":
        names = TABLE if settings["rows"] == "all" else [name.strip() for name in settings["rows"].split(",")]
        for name in names:
            if name not in TABLE:
                known = ", ".join(TABLE)
                raise UsageError("bench generate", f"the table has no row {name!r}", f"rows: {known}")
        return [{"row": name, **TABLE[name]} for name in names if given.items() <= TABLE[name].items()]
    caches = [True, False] if settings["cache"] is None else [settings["cache"]]
    kinds = KINDS.get(settings["kind"], [settings["kind"]])
    usual = {"batch": 1, "decode": settings["kind"] == "embedded"}
    return [usual | given | {"kind": kind, "cache": cache} for kind in kinds for cache in caches]


def measure_frames(settings: dict[str, Any]) -> dict[str, Any]:
    """Return the figures of one case."""
    kind = settings["kind"]
    settings = settings | {"ddim_steps": settings["ddim_steps"] or PAPER_STEPS}
    model = (embedded(settings) if kind == "embedded" else make_model(settings, kind)).eval()
    made = Frames(model, settings)
    seconds = made.seconds()
    frame = min(seconds) / settings["batch"]
    from recipes.bench import flops

    products = flops.products_of(made.step)
    gflop = sum(products.values()) / 1e9 / settings["batch"]
    rate = flops.rate_of(products, model.device, settings["precision"])
    told = ("precision", "batch", "unmask_steps", "decode", "compile")
    return {
        **({"row": settings["row"]} if "row" in settings else {}),
        "kind": kind,
        "device": device_name(model.device),
        "cache": settings["cache"],
        **{key: settings[key] for key in told},
        "window": model.config.frames,
        "ddim_steps": settings["ddim_steps"] if model.config.kind == "continuous" else None,
        "seconds_per_frame": round(frame, 6),
        "median_seconds_per_frame": round(median(seconds) / settings["batch"], 6),
        "frames_per_second": round(1 / frame, 3),
        "gflop_per_frame": round(gflop, 3),
        "limit_gflop_per_second": round(rate, 1),
        "share_of_limit": round(gflop / rate / frame, 3),
        **memory(model.device),
    }


def embedded(settings: dict[str, Any]) -> "HMA":
    """Return the bundled transformer, on the device of the settings."""
    from hma_model.network.model import HMA
    from hma_model.training.runtime import choose_device

    set_threads(settings)
    return HMA.from_pretrained("embedded-fsq", device=choose_device(settings["device"]))


class Frames:
    """Frames that follow a random prompt, decoded if the settings ask for it."""

    def __init__(self, model: "HMA", settings: dict[str, Any]) -> None:
        import torch

        self.model, self.settings = model, settings
        self.robot, space = next(iter(model.embodiments.items()))
        self.known, self.batch = model.config.frames - 1, settings["batch"]
        self.prompt = random_frames(model, self.batch, self.known)
        self.actions = torch.randn(self.batch, self.known + 1, space.chunk_dim)
        self.tokenizer = self._tokenizer() if settings["decode"] else None

    def seconds(self) -> list[float]:
        """Return the seconds of each measured step; slow ones are fewer, but at least one."""
        seconds = list[float]()
        for index in range(WARMUP + self.settings["frames"]):
            if not self.settings["cache"] or not index:
                self.rollout = self._rollout(self.settings["compile"])
            began = time.perf_counter()
            self._show(self.rollout.step(self.actions[:, -1]))
            finish(self.model.device)
            if index >= WARMUP:
                seconds.append(time.perf_counter() - began)
            if sum(seconds) > self.settings["seconds"]:
                break
        return seconds

    def step(self) -> Callable[[], None]:
        """Return a call that makes one more frame after `seconds`, without a compiler."""
        rollout = self.rollout
        if not self.settings["cache"] or self.settings["compile"]:
            rollout = self._rollout(False)
            if self.settings["cache"]:
                rollout.step(self.actions[:, -1])

        def step() -> None:
            frames = rollout.step(self.actions[:, -1])
            if self.tokenizer is not None:
                self.tokenizer.network.decode(frames)  # in this thread, where its products are seen

        return step

    def _rollout(self, compile: bool) -> "Rollout":
        from hma_model.generation.rollout import Rollout

        way = self.settings
        rollout = Rollout(
            self.model, self.robot, self.batch, unmask_steps=way["unmask_steps"],
            sample_steps=way["ddim_steps"], cache=way["cache"], compile=compile,
            precision="float32" if way["precision"] == "fp32" else way["precision"],
        )  # fmt: skip
        rollout.prompt(self.prompt, self.actions)
        return rollout

    def _tokenizer(self) -> Any:
        from hma_data.tokenizers.base import reopened

        usual = "fsq-16" if self.model.config.kind == "discrete" else "vae-8"
        return reopened({"name": usual, **self.model.config.tokenizer}, str(self.model.device))

    def _show(self, frames: "torch.Tensor") -> Any:
        """Return the pictures of frames if they are to be decoded."""
        from hma_model.generation.decode import decode

        return frames if self.tokenizer is None else decode(self.tokenizer, frames.unsqueeze(1))


GENERATE = Bench(
    "seconds per generated frame, compared with the time of its matrix products alone",
    {
        "kind": "all",  # all (a table) | discrete | continuous | both | embedded
        "rows": "all",  # of the table, e.g. embedded,discrete-16
        **COMMON,  # precision may also be int8
        "cache": None,  # true | false; None measures both
        "frames": 10,  # measured, after a warm-up
        "seconds": 20.0,  # after which no further frame of a case is measured
        "batch": None,  # None: 1, or those of the table
        "unmask_steps": 2,
        "ddim_steps": None,  # of the diffusion head; None: 100, or those of the table
        "decode": None,  # to pixels; None: false, with kind=embedded true
    },
    generate,
)
