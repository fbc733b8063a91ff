"""Count the floating-point work of a computation, and measure how fast the machine does such work.

The work consists of the matrix products and convolutions. The rate is that of its matrix products alone, one
shape after the other on warm data, by the faster of torch's kernel and oneDNN's packed one,
on one thread or on all.

M rows, K values of a row, N values of a result.
"""

import time
from collections import Counter
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import torch

type Shape = tuple[str, int, int, int]  # what: "product" or "other"; M, K, N

REPEATS, SECONDS = 5, 0.004  # of a shape's measurement: how often, and how long each


def products_of(start: Callable[[], Callable[[], None]]) -> Counter[Shape]:
    """Return the floating-point operations of the call that `start` prepares, by the shape of the product."""
    import torch
    from torch.utils._python_dispatch import TorchDispatchMode
    from torch.utils.flop_counter import flop_registry

    found: Counter[Shape] = Counter()
    inputs = {torch.ops.aten.mm: 0, torch.ops.aten.addmm: 1, torch.ops.mkldnn._linear_pointwise: 0}
    inputs[torch.ops.quantized.linear_dynamic] = 0

    class Watch(TorchDispatchMode):
        def __torch_dispatch__(self, call: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
            packet, kwargs = call._overloadpacket, kwargs or {}
            if packet not in inputs and packet not in flop_registry:
                with self:  # in inference mode, operators that consist of others arrive whole
                    parted = call.decompose(*args, **kwargs)
                if parted is not NotImplemented:
                    return parted
            out = call(*args, **kwargs)
            if packet in inputs:
                k, n = args[inputs[packet]].shape[-1], out.shape[-1]
                m = out.numel() // n
                found["product", m, k, n] += 2 * m * k * n
            elif packet in flop_registry:
                found["other", 0, 0, 0] += int(flop_registry[packet](*args, **kwargs, out_val=out))
            return out

    step = start()
    with Watch():
        step()
    return found


def rate_of(products: Counter[Shape], device: "torch.device", precision: str = "fp32") -> float:
    """Return the rate in gflop/s at which the machine computes the matrix products among them."""
    work, seconds = 0.0, 0.0
    for (what, m, k, n), flop in products.items():
        if what == "product":
            work += flop
            seconds += flop / (2 * m * k * n) * _seconds(m, k, n, device, precision)
    return work / seconds / 1e9


def _seconds(m: int, k: int, n: int, device: "torch.device", precision: str) -> float:
    """Return the seconds of one product."""
    import torch

    from hma_data.tokenizers.network import one_thread
    from hma_model.generation.packed import PackedLinear, QuantizedLinear, has_bfloat16, packs

    dtype = torch.bfloat16 if precision == "bf16" else torch.float32
    linear = torch.nn.Linear(k, n, device=device, dtype=dtype)
    x = torch.randn(m, k, device=device, dtype=dtype)
    with torch.inference_mode():
        kinds: list[Callable[[torch.Tensor], torch.Tensor]] = [linear]
        if packs(device) and (dtype == torch.float32 or has_bfloat16()):
            kinds.append(QuantizedLinear(linear) if precision == "int8" else PackedLinear(linear, dtype))
        seconds = min(_best(kind, x) for kind in kinds)
        if device.type == "cpu":
            with one_thread():
                seconds = min(seconds, *(_best(kind, x) for kind in kinds))
        return seconds


def _best(product: Callable[["torch.Tensor"], "torch.Tensor"], x: "torch.Tensor") -> float:
    from recipes.bench.speed import finish

    count, best = 1, float("inf")
    for _ in range(REPEATS):
        product(x)
        finish(x.device)
        began = time.perf_counter()
        for _ in range(count):
            product(x)
        finish(x.device)
        best = min(best, (time.perf_counter() - began) / count)
        count = max(1, int(SECONDS / best))
    return best
