"""Set up a model's trunk and readout to generate with: packed, compiled, in a chosen precision."""

import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import torch
from torch import Tensor, nn

from hma_data.errors import HMAError
from hma_data.tokenizers.network import one_thread
from hma_model.generation.packed import has_bfloat16, has_int8, packed, packs
from hma_model.generation.unmask import TokenFrame
from hma_model.network.head import TokenReadout
from hma_model.network.network import Network

PRECISIONS = {"float32": torch.float32, "bf16": torch.bfloat16, "int8": torch.qint8}
MOST_GRAPHS = 64  # of a model's passes: each number of rows and of tokens to unmask has one
# Operations of a pass's largest product, below which one thread computes: a second one brings little, and
# beside other work the two wait for each other (docs/results.md, Waiting threads).
ONE_THREAD = 150e6


class Engine:
    """The trunk and the readout of a model, as a rollout runs them.

    Args:
        model: whose weights are taken as they are now.
        precision: of the products, a key of `PRECISIONS`.
        compile: compile the trunk.

    Attributes:
        trunk, readout: the modules to call.
        compiled: the compiled trunk, for passes of one shape; None without.
        whole: the compiled trunk, readout and choice of tokens, `unmasked_by`; None without.
    """

    def __init__(self, model: Network, precision: str, compile: bool) -> None:
        self.config, self.device, self.precision = model.config, model.device, precision
        dtype, device = products_in(precision, model.device, compile), model.device
        if compile and (fault := compiler_fault(device)):
            warnings.warn(fault, RuntimeWarning, stacklevel=3)
            compile = False
        whole = model.dtype == torch.float32 and not torch.is_autocast_enabled(device.type)
        pack = whole and not compile and packs(device)
        trunk = model.get_submodule("trunk")
        self.trunk: nn.Module = packed(trunk, dtype) if pack else trunk
        # Scores of tokens stay float32; the diffusion head, most of a frame of latents, may be bfloat16.
        half = dtype == torch.bfloat16 and not model.config.discrete
        self.readout: nn.Module = (
            packed(model.readout, dtype if half else torch.float32) if pack else model.readout
        )
        self.compiled = _compiled(trunk, device) if compile else None
        self.whole = _compiled(self.unmasked_by, device) if compile else None
        self._casts = dtype == torch.bfloat16 and not pack

    def unmasked_by(self, frame: TokenFrame, count: int, *given: Any) -> Tensor:
        """Return a frame's tokens (B, S) after a pass of the trunk over `given` that unmasks `count`."""
        features = self.trunk(*given)[:, -1, : self.config.tokens_per_frame]
        assert isinstance(self.readout, TokenReadout)
        return frame.unmasked(self.readout, features, count)

    @contextmanager
    def computing(self, rows: int) -> Iterator[None]:
        """Set torch up for the passes over frames of so many rows."""
        config, device = self.config, self.device.type
        largest = 4 * rows * config.tokens_per_frame * config.width**2 * config.mlp_ratio
        with ExitStack() as stack:
            if device == "cpu" and largest < ONE_THREAD:
                stack.enter_context(one_thread())
            if self._casts:
                stack.enter_context(torch.autocast(device, torch.bfloat16))
            if self.compiled is None:
                stack.enter_context(torch.inference_mode())
            yield


def products_in(precision: str, device: torch.device, compile: bool) -> torch.dtype:
    """Return the type of a precision; raise HMAError if it is unknown, or the device has no such products."""
    if precision not in PRECISIONS:
        raise HMAError("precision", f"{precision!r} is unknown", f"give {' or '.join(PRECISIONS)}")
    if precision == "bf16" and device.type == "cpu" and not has_bfloat16():
        raise HMAError("precision", "this processor does not support bf16", "use float32")
    if precision == "int8" and (compile or not packs(device) or not has_int8()):
        fault = "int8 needs a processor with AVX-512 VNNI, and no --compile"
        raise HMAError("precision", fault, "use float32 or bf16")
    return PRECISIONS[precision]


def compiler_fault(device: torch.device) -> str:
    """Return what torch.compile lacks for a device, and what becomes of it; empty if it can work."""
    from torch._inductor.cpp_builder import get_cpp_compiler  # these take a second to import
    from torch._inductor.exc import InvalidCxxCompiler
    from torch.utils._triton import has_triton

    missing = "" if device.type != "cuda" or has_triton() else "triton"
    try:
        get_cpp_compiler()
    except InvalidCxxCompiler:
        missing = "a C++ compiler (g++, or the one that CXX names)"
    return missing and f"compile: {missing} is missing, so nothing is compiled, which is slower"


def _compiled(function: Callable[..., Tensor], device: torch.device) -> Callable[..., Tensor]:
    """Return a function compiled for passes of a fixed shape; a result is valid until the next pass."""
    mode = "reduce-overhead" if device.type == "cuda" else "default"
    compiled = torch.compile(function, dynamic=False, mode=mode)

    def call(*arguments: object) -> Tensor:
        torch.compiler.cudagraph_mark_step_begin()
        with torch._dynamo.config.patch(recompile_limit=MOST_GRAPHS):  # beyond it, code runs uncompiled
            return compiled(*arguments)

    return call
