"""Make a tokenizer of any network: run it in batches of a fixed size, on a device, in a number format.

A kernel may sum in another order when the batch has another size or more threads share the work. Then
the last bits of a latent change, and these can change its sign or its rounding. For that reason all
batches are encoded at one size, the last one padded. On a CPU, one thread encodes each frame, and several
frames are encoded at a time. The same frame then gives the same tokens whatever the batch, the worker or
the number of cores. Networks run in float32 on a CPU, and in bfloat16 and channels-last on CUDA, except a
network that asks for float32.

B images of a batch, S side, c channels, h·w grid. Pixels inside are (B, 3, S, S) in [-1, 1].
"""

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from hma_data.arrays import Array, Images
from hma_data.errors import TokenizerError
from hma_data.tokenizers.base import OTHER, TokenizerSpec, check_frames, check_tokens

Step = Callable[[Tensor], Tensor]


class NetworkTokenizer:
    """A tokenizer with a network; see `hma_data.tokenizers.base.Tokenizer`."""

    def __init__(
        self,
        spec: TokenizerSpec,
        network: nn.Module,
        device: torch.device,
        encode: Step,
        decode: Step,
        *,
        light: bool = False,
    ) -> None:
        """Move the network to the device and set it to evaluation mode.

        Args:
            network: torch module with `encoder` and `decoder`.
            encode: pixels (B, 3, S, S) -> int64 ids (B, h, w), or latents (B, c, h, w).
            decode: ids or latents, as `encode` returns them, -> pixels (B, 3, S, S).
            light: whether the network is small: it runs in float32 and channels-last on any device, and on a
                CPU it also decodes each frame on one thread.
        """
        cuda = device.type == "cuda"
        self.spec, self.device, self.light = spec, device, light
        self.dtype = torch.bfloat16 if cuda and not light else torch.float32
        self.batch = 32 if cuda else 8 if device.type == "mps" else 1
        self.network = network.eval().requires_grad_(False).to(device, self.dtype)
        self._format = torch.channels_last if cuda or light else torch.contiguous_format
        for parameter in network.parameters():
            if parameter.ndim == 4:
                parameter.data = parameter.data.contiguous(memory_format=self._format)
        self._encode, self._decode = encode, decode

    def encode(self, frames: Images) -> Array:
        """Encode (N, S, S, 3) uint8 RGB to (N, h, w) ids, or to (N, c, h, w) float16 latents.

        Raises:
            TokenizerError: frames have another shape or dtype, or the network's output cannot be stored.
        """
        check_frames(frames, self.spec)
        tokens = np.empty((len(frames), *self.spec.cells), self.spec.dtype)
        return self._in_batches(self._encode_batch, frames, tokens, alone=True)

    def decode(self, tokens: Array) -> Images:
        """Decode what `encode` returns to (N, S, S, 3) uint8 RGB.

        Raises:
            TokenizerError: the tokens have another grid or dtype, ids are outside the vocabulary, or latents
                are not finite.
        """
        check_tokens(tokens, self.spec)
        size = self.spec.image_size
        frames = np.empty((len(tokens), size, size, 3), np.uint8)
        return self._in_batches(self._decode_batch, tokens, frames, alone=self.light)

    def _in_batches(self, step: Callable[[Any], Array], items: Array, out: Array, alone: bool) -> Array:
        """Fill `out` (N, …) with `step` of `items` (N, …), a batch at a time, and return it.

        With `alone`, on a CPU, several batches are computed at the same time, each on one thread.
        """
        starts = range(0, len(items), self.batch)
        parts = [items[start : start + self.batch] for start in starts]
        if not alone or self.device.type != "cpu":
            made: Iterable[Array] = map(step, parts)
        elif len(parts) < 2:
            with one_thread():
                made = [step(part) for part in parts]
        else:
            with single_threads(len(parts)) as pool:
                made = list(pool.map(step, parts))
        for start, part in zip(starts, made, strict=True):
            out[start : start + self.batch] = part
        return out

    @torch.inference_mode()
    def _encode_batch(self, frames: Images) -> Array:
        """Encode at most one batch of frames; check that the spec's dtype can store the result."""
        whole = frames  # repeated up to a whole batch
        if len(frames) < self.batch:
            whole = np.resize(frames, (self.batch, *frames.shape[1:]))
        pixels = self._moved(whole).permute(0, 3, 1, 2).float().mul_(2 / 255).sub_(1)
        pixels = pixels.to(self.dtype).contiguous(memory_format=self._format)
        made, spec = self._encode(pixels)[: len(frames)].cpu(), self.spec
        if spec.kind == "discrete":
            if made.min() < 0 or made.max() >= (spec.vocab_size or 0):
                fault = f"its network made id {made.max()}, the vocabulary ends at {spec.vocab_size}"
                raise TokenizerError(spec.name, fault, OTHER)
            return made.numpy()
        latents = made.float().numpy()
        if not np.abs(latents).max() <= np.finfo(np.float16).max:
            raise TokenizerError(spec.name, "its network made latents too large for float16", OTHER)
        return latents

    @torch.inference_mode()
    def pictures(self, tokens: Tensor) -> Tensor:
        """Decode ids (N, h, w) int64, or latents (N, c, h, w), in batches.

        They are not checked, because a check would wait for the device.

        Returns:
            (N, S, S, 3) uint8 RGB on the network's device.
        """
        parts, dtype = [], torch.int64 if self.spec.kind == "discrete" else self.dtype
        for part in tokens.split(self.batch):
            pixels = self.pixels(part.to(self.device, dtype)).float()
            whole = pixels.add(1).mul_(127.5).round_().clamp_(0, 255).to(torch.uint8)
            parts.append(whole.permute(0, 2, 3, 1))
        return torch.cat(parts)

    def pixels(self, tokens: Tensor) -> Tensor:
        """Decode ids (N, h, w) int64, or latents (N, c, h, w), to pixels (N, 3, S, S) of about [-1, 1]."""
        return self._decode(tokens)

    def _decode_batch(self, tokens: Array) -> Images:
        """Decode at most one batch of ids or latents."""
        values = tokens.astype(np.int64 if self.spec.kind == "discrete" else np.float32)
        made: Images = self.pictures(self._moved(values)).cpu().numpy()
        return made

    def _moved(self, part: Array) -> Tensor:
        return torch.from_numpy(part.copy()).to(self.device)  # torch takes no negative strides


@contextmanager
def one_thread() -> Iterator[None]:
    """Let torch use one thread in the block."""
    threads = torch.get_num_threads()
    if threads > 1:
        torch.set_num_threads(1)
    try:
        yield
    finally:
        if threads > 1:
            torch.set_num_threads(threads)


@contextmanager
def single_threads(tasks: int) -> Iterator[ThreadPoolExecutor]:
    """Give a pool for so many tasks, as wide as torch may use threads, each of which computes alone."""
    threads = torch.get_num_threads()
    try:
        with ThreadPoolExecutor(min(threads, tasks), initializer=lambda: torch.set_num_threads(1)) as pool:
            yield pool
    finally:
        # The number is each thread's own, but new threads start with the last one that was set.
        torch.set_num_threads(threads)


def open_device(name: str, device: str) -> torch.device:
    """Return the torch device of that name, after a trial allocation on it.

    Raises:
        TokenizerError: this machine has no such device.
    """
    try:
        place = torch.device(device)
        torch.empty(1, device=place)
    except (RuntimeError, AssertionError) as fault:
        reason = str(fault).splitlines()[0].split(". ")[0]  # what follows is where drivers are had
        remedy = "use --device cpu" + (", or install the driver" if "driver" in reason else "")
        raise TokenizerError(name, f"cannot run on device {device!r}: {reason}", remedy) from fault
    return place
