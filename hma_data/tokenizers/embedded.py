"""What the tokenizers with weights in the package share: the weights' file, and passes of a fixed size.

A weights' file is safetensors: float16 parameters, and in the metadata its format, the network's
shape and how it was trained. Frames go through a network in micro-batches of a fixed size, the last
one padded, because a kernel may sum in another order at another batch size: the same frame then
gives the same tokens in whatever company it comes.

N items, M items a pass.
"""

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol, Self

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

from hma_data.errors import TokenizerError
from hma_data.files import write_atomic

MAX_BYTES = 1 << 30
REMEDY = "take the file that `hma tokenizer train` writes, or leave --weights out"


class Config(Protocol):
    """A network's shape as a weights' file holds it."""

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        ...

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> Self:
        """What `to_json` wrote; raises TypeError, ValueError or KeyError on anything else."""
        ...


def save_weights(
    path: Path, form: str, config: Config, tensors: dict[str, Tensor], facts: dict[str, Any]
) -> None:
    """Write parameters as float16 with the network's shape and `facts` in the metadata, atomically."""
    halves = {name: tensor.detach().half().contiguous() for name, tensor in sorted(tensors.items())}
    metadata = {"format": form, "config": json.dumps(config.to_json()), "training": json.dumps(facts)}
    write_atomic(path, _sorted_header(save(halves, metadata)))


def _sorted_header(content: bytes) -> bytes:
    """The same safetensors file with its header in one order: the library's varies from run to run."""
    end = 8 + int.from_bytes(content[:8], "little")
    header = json.dumps(json.loads(content[8:end]), sort_keys=True, separators=(",", ":")).encode()
    header += b" " * (-len(header) % 8)
    return len(header).to_bytes(8, "little") + header + content[end:]


def read_weights[C: Config](path: Path, form: str, config: type[C]) -> tuple[C, dict[str, Tensor], str]:
    """A weights' file: the network's shape, its parameters (float32), the file's SHA-256.

    Raises:
        TokenizerError: no such file, not safetensors, truncated, or of another network.
    """
    try:
        if path.stat().st_size > MAX_BYTES:
            raise TokenizerError(
                path, f"larger than {MAX_BYTES} bytes: not weights of this tokenizer", REMEDY
            )
        sha256 = hashlib.sha256(path.read_bytes()).hexdigest()
        with safe_open(path, "pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name).float() for name in file.keys()}  # noqa: SIM118
    except OSError as fault:
        raise TokenizerError(path, f"weights cannot be read: {fault.strerror or fault}", REMEDY) from fault
    except SafetensorError as fault:
        raise TokenizerError(path, f"is no whole safetensors file: {fault}", REMEDY) from fault
    if metadata.get("format") != form:
        raise TokenizerError(path, f"holds no {form} weights (format {metadata.get('format')!r})", REMEDY)
    try:
        return config.from_json(json.loads(metadata["config"])), tensors, sha256
    except (KeyError, TypeError, ValueError) as fault:
        raise TokenizerError(path, f"its metadata describes no network: {fault}", REMEDY) from fault


def load_network(network: nn.Module, tensors: dict[str, Tensor], path: Path, device: torch.device) -> None:
    """Fill a network and bring it to the device, for inference.

    Raises:
        TokenizerError: the parameters are not this network's.
    """
    try:
        network.load_state_dict(tensors)
    except RuntimeError as fault:
        text = " ".join(str(fault).split())
        raise TokenizerError(path, f"weights do not fit the network: {text:.160}") from fault
    network.eval().requires_grad_(False).to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]


def open_device(name: str, device: str) -> torch.device:
    """The device of that name.

    Raises:
        TokenizerError: there is none.
    """
    try:
        place = torch.device(device)
        torch.empty(1, device=place)
    except (RuntimeError, AssertionError) as fault:
        reason = str(fault).splitlines()[0]
        raise TokenizerError(name, f"cannot run on device {device!r}: {reason}", "use cpu") from fault
    return place


def micro_batch(image_size: int, device: torch.device) -> int:
    """M, the frames of a pass: as many as keep a CPU's caches or a GPU busy."""
    return max(1, (4 if device.type == "cpu" else 64) * 256**2 // image_size**2)


def run_in_passes(
    step: Callable[[Tensor], Tensor], items: NDArray[Any], out: NDArray[Any], size: int, device: torch.device
) -> None:
    """Fill `out` (N, …) with `step` of `items` (N, …), M = `size` at a time, the last pass padded."""
    for start in range(0, len(items), size):
        part = items[start : start + size]
        count = len(part)
        if count < size:
            part = np.resize(part, (size, *part.shape[1:]))
        made = step(torch.from_numpy(np.ascontiguousarray(part)).to(device))
        out[start : start + count] = made.cpu().numpy()[:count]


def to_pixels(frames: Tensor) -> Tensor:
    """(M, S, S, 3) uint8 -> (M, 3, S, S) float32 in [-1, 1], channels last in memory."""
    return frames.permute(0, 3, 1, 2).float().mul_(2 / 255).sub_(1)


def to_frames(pixels: Tensor) -> Tensor:
    """(M, 3, S, S) about [-1, 1] -> (M, S, S, 3) uint8; the argument is overwritten."""
    whole = pixels.add_(1).mul_(127.5).round_().clamp_(0, 255).to(torch.uint8)
    return whole.permute(0, 2, 3, 1)
