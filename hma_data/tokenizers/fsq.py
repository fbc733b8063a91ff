"""`fsq-16` and `fsq-8`: the embedded tokenizer, its weights inside the package.

One network and one file of weights serve both: 16 pixels a token, 18 bits a token, at 256×256
(16×16 tokens) and at 128×128 (8×8 tokens). How it was trained: recipes/tokenizer/fsq.yaml.

Frames go through the network in micro-batches of a fixed size, the last one padded, because a
kernel may sum in another order at another batch size: the same frame then gives the same ids in
whatever company it comes.
"""

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from hma_data.errors import TokenizerError
from hma_data.files import write_atomic
from hma_data.tokenizers.base import TokenizerSpec, check_frames, check_tokens
from hma_data.tokenizers.fsq_network import STRIDE, FsqAutoencoder, FsqConfig

WEIGHTS = Path(__file__).parent / "weights" / "fsq.safetensors"
FORMAT = "hma-fsq-1"
VERSION = 1
MAX_BYTES = 1 << 30


def save_weights(path: Path, config: FsqConfig, tensors: dict[str, Tensor], facts: dict[str, Any]) -> None:
    """Write parameters as float16 with the network's shape and `facts` in the metadata, atomically."""
    halves = {name: tensor.detach().half().contiguous() for name, tensor in sorted(tensors.items())}
    metadata = {"format": FORMAT, "config": json.dumps(config.to_json()), "training": json.dumps(facts)}
    write_atomic(path, _sorted_header(save(halves, metadata)))


def _sorted_header(content: bytes) -> bytes:
    """The same safetensors file with its header in one order: the library's varies from run to run."""
    end = 8 + int.from_bytes(content[:8], "little")
    header = json.dumps(json.loads(content[8:end]), sort_keys=True, separators=(",", ":")).encode()
    header += b" " * (-len(header) % 8)
    return len(header).to_bytes(8, "little") + header + content[end:]


def read_weights(path: Path) -> tuple[FsqConfig, dict[str, Tensor], str]:
    """A weights' file: the network's shape, its parameters (float32), the file's SHA-256.

    Raises:
        TokenizerError: no such file, not safetensors, truncated, or of another network.
    """
    remedy = "take the file that `hma tokenizer train` writes, or leave --weights out"
    try:
        if path.stat().st_size > MAX_BYTES:
            raise TokenizerError(
                path, f"larger than {MAX_BYTES} bytes: not weights of this tokenizer", remedy
            )
        sha256 = hashlib.sha256(path.read_bytes()).hexdigest()
        with safe_open(path, "pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name).float() for name in file.keys()}  # noqa: SIM118
    except OSError as fault:
        raise TokenizerError(path, f"weights cannot be read: {fault.strerror or fault}", remedy) from fault
    except SafetensorError as fault:
        raise TokenizerError(path, f"is no whole safetensors file: {fault}", remedy) from fault
    if metadata.get("format") != FORMAT:
        raise TokenizerError(path, f"holds no {FORMAT} weights (format {metadata.get('format')!r})", remedy)
    try:
        config = FsqConfig.from_json(json.loads(metadata["config"]))
    except (KeyError, TypeError, ValueError) as fault:
        raise TokenizerError(path, f"its metadata describes no network: {fault}", remedy) from fault
    return config, tensors, sha256


class FsqTokenizer:
    """Discrete tokens of square pictures; see `hma_data.tokenizers.base.Tokenizer`.

    Attributes:
        spec: what decides the tokens.
        network: `encoder`, `quantizer`, `decoder` (torch modules, evaluation mode).
        micro_batch: frames a pass through the network.
    """

    def __init__(self, spec: TokenizerSpec, network: FsqAutoencoder, device: torch.device) -> None:
        self.spec, self.device = spec, device
        self.network = network.eval().requires_grad_(False).to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]
        pixels = spec.image_size**2
        self.micro_batch = max(1, (4 if device.type == "cpu" else 64) * 256**2 // pixels)

    @torch.inference_mode()
    def encode(self, frames: NDArray[np.uint8]) -> NDArray[np.uint32]:
        """(N, S, S, 3) uint8 RGB -> (N, S/16, S/16) uint32 ids.

        Raises:
            TokenizerError: frames of another shape or dtype.
        """
        check_frames(frames, self.spec)
        ids = np.empty((len(frames), *self.spec.grid), np.uint32)
        for start in range(0, len(frames), self.micro_batch):
            part = self._padded(frames[start : start + self.micro_batch])
            pixels = part.permute(0, 3, 1, 2).float().mul_(2 / 255).sub_(1)
            levels = self.network.quantizer.to_levels(self.network.encoder(pixels))
            made = self.network.quantizer.to_ids(levels).cpu().numpy()
            ids[start : start + self.micro_batch] = made[: len(ids) - start]
        return ids

    @torch.inference_mode()
    def decode(self, tokens: NDArray[Any]) -> NDArray[np.uint8]:
        """(N, S/16, S/16) ids of any integer dtype -> (N, S, S, 3) uint8 RGB.

        Raises:
            TokenizerError: another grid, no integers, or ids outside the vocabulary.
        """
        check_tokens(tokens, self.spec)
        size = self.spec.image_size
        frames = np.empty((len(tokens), size, size, 3), np.uint8)
        quantizer = self.network.quantizer
        for start in range(0, len(tokens), self.micro_batch):
            part = self._padded(tokens[start : start + self.micro_batch].astype(np.int64))
            codes = quantizer.from_levels(quantizer.to_digits(part))
            pixels = self.network.decoder(codes.contiguous(memory_format=torch.channels_last))
            whole = pixels.add_(1).mul_(127.5).round_().clamp_(0, 255).to(torch.uint8)
            made = whole.permute(0, 2, 3, 1).cpu().numpy()
            frames[start : start + self.micro_batch] = made[: len(frames) - start]
        return frames

    def _padded(self, part: NDArray[Any]) -> Tensor:
        """The part on the device, repeated up to a whole micro-batch."""
        if len(part) < self.micro_batch:
            part = np.resize(part, (self.micro_batch, *part.shape[1:]))
        return torch.from_numpy(np.ascontiguousarray(part)).to(self.device)


def load(name: str, *, weights: str | None, device: str, image_size: int) -> FsqTokenizer:
    """The tokenizer of that name; `hma_data.tokenizers.base.get_tokenizer` calls this.

    Raises:
        TokenizerError: the weights cannot be used, or there is no such device.
    """
    path = Path(weights).expanduser() if weights else WEIGHTS
    config, tensors, sha256 = read_weights(path)
    network = FsqAutoencoder(config)
    try:
        network.load_state_dict(tensors)
    except RuntimeError as fault:
        text = " ".join(str(fault).split())
        raise TokenizerError(path, f"weights do not fit the network: {text:.160}") from fault
    try:
        place = torch.device(device)
        torch.empty(1, device=place)
    except (RuntimeError, AssertionError) as fault:
        reason = str(fault).splitlines()[0]
        raise TokenizerError(name, f"cannot run on device {device!r}: {reason}", "use cpu") from fault
    spec = TokenizerSpec(
        name=name,
        version=VERSION,
        kind="discrete",
        image_size=image_size,
        grid=(image_size // STRIDE, image_size // STRIDE),
        vocab_size=int(np.prod(config.factored)),
        factored=config.factored,
        dtype="uint32",
        weights_sha256=sha256,
    )
    return FsqTokenizer(spec, network, place)
