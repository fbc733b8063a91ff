"""A run's ground: its folder, its device, the signals that end it, and what its figures may depend on."""

import fcntl
import platform
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import torch

from hma_data.errors import OutputError, RecipeError
from hma_model.parallel import local_rank

RECIPE, ENVIRONMENT = "recipe.json", "environment.json"


def choose_device(name: str) -> torch.device:
    """The device of a recipe's `device`; auto takes an accelerator where there is one.

    Raises:
        RecipeError: the device is not there.
    """
    cuda, mps = torch.cuda.is_available(), torch.backends.mps.is_available()
    if name == "auto":
        name = "cuda" if cuda else "mps" if mps else "cpu"
    device = torch.device(f"cuda:{local_rank()}" if name == "cuda" else name)
    there = {"cuda": cuda and (device.index or 0) < torch.cuda.device_count(), "mps": mps, "cpu": True}
    if not there[device.type]:
        raise RecipeError("recipe: device", f"{name} is not there", "use device=auto or device=cpu")
    return device


def environment(device: torch.device) -> dict[str, Any]:
    """What the run's figures may depend on besides the recipe."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        release = version("hma-toolkit")
    except PackageNotFoundError:
        release = ""
    return {
        "hma_toolkit": release,
        "git_revision": _git_revision(),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else str(device),
        "threads": torch.get_num_threads(),
        "platform": platform.platform(),
    }


def _git_revision() -> str:
    command = ["git", "-C", str(Path(__file__).parent), "rev-parse", "HEAD"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=5, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""


@contextmanager
def own_folder(out: Path) -> Iterator[None]:
    """The run's folder, made if need be, and nobody else's while the block runs."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        others = [path.name for path in out.iterdir() if not path.name.startswith(".")]
        if others and not (out / RECIPE).is_file():
            raise OutputError(out, f"holds {others[0]} and no {RECIPE}", "train into a folder of its own")
        lock = (out / ".lock").open("w")
    except OSError as fault:
        raise OutputError(out, f"cannot be used: {fault.strerror}", "choose another folder") from fault
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as fault:
            raise OutputError(out, "another training is at work here", "wait for it or stop it") from fault
        yield


@contextmanager
def stop_on_signals() -> Iterator[threading.Event]:
    """An event that SIGTERM and the first SIGINT set; a second SIGINT ends the process as usual."""
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return

    def ask(number: int, frame: FrameType | None) -> None:
        stop.set()
        signal.signal(signal.SIGINT, before[signal.SIGINT])
        print("saving; a second Ctrl-C stops at once", file=sys.stderr)

    before = {number: signal.signal(number, ask) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
