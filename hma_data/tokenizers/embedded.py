"""Write and read the weights' files of the tokenizers that are in the package.

A file is safetensors. It holds float16 parameters; its metadata holds the format, the network's shape
and the facts of the training.
"""

import hashlib
import json
from pathlib import Path
from typing import Any, Protocol, Self

from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from hma_data.errors import TokenizerError
from hma_data.storage.files import write_atomic

MAX_BYTES = 1 << 30
REMEDY = "take the file that `hma tokenizer train` writes, or leave --weights out"


class Config(Protocol):
    """A network's shape as a weights' file holds it."""

    def to_json(self) -> dict[str, Any]:
        """Return plain values."""
        ...

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> Self:
        """Return the config that `to_json` wrote; raise TypeError, ValueError or KeyError on other values."""
        ...


def save_weights(
    path: Path, form: str, config: Config, tensors: dict[str, Tensor], facts: dict[str, Any]
) -> None:
    """Write parameters as float16 with the network's shape and `facts` in the metadata, atomically."""
    halves = {name: tensor.detach().half().contiguous() for name, tensor in sorted(tensors.items())}
    metadata = {"format": form, "config": json.dumps(config.to_json()), "training": json.dumps(facts)}
    write_atomic(path, _sorted_header(save(halves, metadata)))


def _sorted_header(content: bytes) -> bytes:
    """Sort the header of a safetensors file; the order in which the library writes it varies."""
    end = 8 + int.from_bytes(content[:8], "little")
    header = json.dumps(json.loads(content[8:end]), sort_keys=True, separators=(",", ":")).encode()
    header += b" " * (-len(header) % 8)
    return len(header).to_bytes(8, "little") + header + content[end:]


def read_weights[C: Config](path: Path, form: str, config: type[C]) -> tuple[C, dict[str, Tensor], str]:
    """Read a weights' file; return the network's shape, its parameters (float32) and the file's SHA-256.

    Raises:
        TokenizerError: there is no such file, or it is not safetensors, truncated, or of another network.
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
