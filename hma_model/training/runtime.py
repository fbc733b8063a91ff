"""Manage a run's folder, device and signals, and describe its environment."""

import fcntl
import os
import platform
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from importlib.metadata import version
from pathlib import Path
from types import FrameType
from typing import Any

import torch

import hma_data
from hma_data.errors import HMAError, OutputError, RecipeError
from hma_model.config import HMAConfig
from hma_model.generation.packed import has_bfloat16
from hma_model.network.linear import Linear
from hma_model.network.trunks.transformer import PRODUCT_KEYS
from hma_model.training.recipe import Recipe

RECIPE, ENVIRONMENT = "recipe.json", "environment.json"
LOCK, START = ".lock", ".start"  # START: the checkpoint that the run starts from
# A transformer's width and a U-Net's finest channels from which steps in bf16 are faster on a processor with
# AVX512-BF16 (docs/results.md, Training). At width 64 a transformer's take as long.
LEAST_WIDTH, LEAST_CHANNELS = 128, 32
GAIN = 1.2  # how much faster products in bf16 must be to be chosen


def choose_device(name: str) -> torch.device:
    """Return the device of a recipe's `device`; auto takes an accelerator if there is one.

    Raises:
        RecipeError: the device does not exist here.
    """
    cuda, mps = torch.cuda.is_available(), torch.backends.mps.is_available()
    if name == "auto":
        name = "cuda" if cuda else "mps" if mps else "cpu"
    device = torch.device(f"cuda:{os.environ.get('LOCAL_RANK', 0)}" if name == "cuda" else name)
    there = {"cuda": cuda and (device.index or 0) < torch.cuda.device_count(), "mps": mps, "cpu": True}
    if not there[device.type]:
        raise RecipeError("recipe: device", f"this machine has no {name}", "use device=auto or device=cpu")
    return device


def choose_precision(
    recipe: Recipe, config: HMAConfig, device: torch.device, begun: str | None = None
) -> tuple[str, str]:
    """Return the precision of a run's products, fp32 or bf16, and the reason in words.

    Args:
        recipe: whose `precision` may be auto.
        config: of the network.
        device: of the run.
        begun: the precision with which the run began, if it is resumed.

    Raises:
        RecipeError: bf16 is asked for, and the device does not support bf16.
    """
    cuda, auto = device.type == "cuda", recipe.precision == "auto"
    processor = "GPU" if cuda else "processor"
    if cuda:
        there = torch.cuda.is_bf16_supported(including_emulation=False)
    else:
        there = device.type != "cpu" or has_bfloat16()
    asked = begun if auto else recipe.precision
    lacks = f"this {processor} does not support bf16"
    if asked == "bf16" and not there:
        remedy = "resume it on the machine where it started" if auto else "use precision=auto, or fp32"
        raise RecipeError("recipe: precision=bf16", lacks, remedy)
    if asked:
        return asked, "as at the start of the run" if auto else "as the recipe says"
    if not there:
        return "fp32", lacks
    if cuda:
        return "bf16", f"this {processor} supports bf16"
    if device.type != "cpu" or recipe.compile:
        return "fp32", f"bf16 was not measured {'compiled' if recipe.compile else f'on {device.type}'}"
    if not bfloat16_pays():
        return "fp32", f"this {processor} supports bf16, but is no faster in it"
    size, least = config.width, LEAST_WIDTH
    if config.trunk == "unet":
        size, least = config.levels[0], LEAST_CHANNELS
    if size < least:
        return "fp32", f"a network of width {size} is no faster in bf16 on a CPU"
    return "bf16", f"this {processor} supports bf16, and width {size} is faster in it"


@cache
def bfloat16_pays() -> bool:
    """Measure once whether a linear map on a CPU is clearly faster in bfloat16 than in float32.

    What the processor supports does not tell: with AVX512-BF16 and no AMX, an AMD EPYC gained, and an Intel
    Xeon took 1.7 times as long for a product.
    """
    linear, x = Linear(256, 256), torch.zeros(4096, 256)

    def seconds(half: bool) -> float:
        begun = time.perf_counter()
        with torch.autocast("cpu", torch.bfloat16, enabled=half):
            linear(x.bfloat16() if half else x)
        return time.perf_counter() - begun

    with torch.inference_mode():
        taken = [(seconds(half=False), seconds(half=True)) for _ in range(8)]
    return GAIN * min(half for _, half in taken) < min(full for full, _ in taken)


def attention_form(recipe: Recipe, config: HMAConfig, device: torch.device) -> str:
    """Return in words how a run computes attention (`hma_model.network.trunks.transformer.attend`)."""
    if config.trunk == "unet":
        return "no attention"
    if device.type == "cpu" and recipe.precision == "bf16" and not recipe.compile:
        masked = f"torch's float32 kernel for more than {PRODUCT_KEYS} masked keys"
        return f"attention: matrix products, which are faster in bf16; {masked}"
    return "attention: torch's fused kernels"


def environment(device: torch.device) -> dict[str, Any]:
    """Return the facts besides the recipe on which the run's figures may depend."""
    return {
        "hma_toolkit": version("hma-toolkit"),
        "git_revision": _git_revision(),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else str(device),
        "threads": torch.get_num_threads(),
        "platform": platform.platform(),
    }


def _git_revision() -> str:
    """Return the revision of the checkout, or the one that the wheel was built from; empty if unknown."""
    root = Path(hma_data.__file__).parents[1]
    with suppress(OSError):
        return (root / "hma_data/shipped/REVISION").read_text(encoding="utf-8")
    if not (root / ".git").exists():  # git would answer for a repository around the installation
        return ""
    with suppress(OSError, subprocess.SubprocessError):
        command = ["git", "-C", str(root), "rev-parse", "HEAD"]
        return subprocess.run(command, capture_output=True, text=True, timeout=5, check=True).stdout.strip()
    return ""


@contextmanager
def own_folder(out: Path) -> Iterator[None]:
    """Make the run's folder if necessary, and lock it while the block runs.

    If the block fails before it has written anything, a folder that was made here is removed again.

    Raises:
        OutputError: the folder cannot be made, holds something else, or another run uses it.
    """
    made = [path for path in (out, *out.parents) if not path.exists()]
    try:
        out.mkdir(parents=True, exist_ok=True)
        others = [path.name for path in out.iterdir() if not path.name.startswith(".")]
        if others and not (out / RECIPE).is_file():
            raise OutputError(out, f"holds {others[0]} and no {RECIPE}", "train into a folder of its own")
        begun = (out / LOCK).exists()
        lock = (out / LOCK).open("a")
    except OSError as fault:
        raise OutputError(out, f"cannot be used: {fault.strerror}", "choose another folder") from fault
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as fault:
            raise OutputError(out, "another training uses this folder", "wait for it or stop it") from fault
        except OSError:  # some file systems of clusters have no locks
            pass
        try:
            yield
        except HMAError:
            if not begun and {path.name for path in out.iterdir()} <= {LOCK, START}:
                shutil.rmtree(out / START, ignore_errors=True)
                with suppress(OSError):  # another run has written into one of these folders
                    (out / LOCK).unlink()
                    for path in made:
                        path.rmdir()
            raise


@contextmanager
def run_errors(out: Path) -> Iterator[None]:
    """Convert errors of the block, which trains into a folder, where a file cannot be written.

    Raises:
        OutputError: something cannot be written.
    """
    try:
        yield
    except OSError as fault:
        where, why = fault.filename or out, fault.strerror or str(fault)
        remedy = "free space or choose another folder; existing checkpoints are intact"
        raise OutputError(where, f"cannot be written: {why}", remedy) from fault


@contextmanager
def stop_on_signals() -> Iterator[threading.Event]:
    """Yield an event that SIGTERM and the first SIGINT set; a second SIGINT ends the process as usual."""
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return

    def ask(number: int, frame: FrameType | None) -> None:
        stop.set()
        signal.signal(signal.SIGINT, before[signal.SIGINT])
        if os.environ.get("RANK", "0") == "0":
            asked = number == signal.SIGINT
            print("saving" + "; a second Ctrl-C stops at once" * asked, file=sys.stderr, flush=True)

    before = {number: signal.signal(number, ask) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
