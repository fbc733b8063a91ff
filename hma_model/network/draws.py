"""Draw random numbers by given generators, on their devices, so that a run can be repeated exactly."""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

# Several draw equal parts of axis 0; a tensor holds numbers that were drawn before.
type Generators = torch.Generator | Sequence[torch.Generator] | Tensor | None


def uniform(shape: Sequence[int], generator: Generators, device: torch.device | str = "cpu") -> Tensor:
    """Return float32 numbers in [0, 1), drawn on the generator's device and moved to `device`."""
    return _draw(torch.rand, shape, generator, device)


def randn(shape: Sequence[int], generator: Generators, device: torch.device | str) -> Tensor:
    """Return standard normal float32 numbers, drawn on the generator's device and moved to `device`."""
    return _draw(torch.randn, shape, generator, device)


def _draw(
    draw: Callable[..., Tensor], shape: Sequence[int], generator: Generators, device: torch.device | str
) -> Tensor:
    if isinstance(generator, Tensor):
        return generator.view(tuple(shape))
    if generator is None or isinstance(generator, torch.Generator):
        return draw(tuple(shape), generator=generator, device=device_of(generator)).to(device)
    part = (shape[0] // len(generator), *shape[1:])
    return torch.cat([draw(part, generator=one, device=one.device) for one in generator]).to(device)


def device_of(generator: torch.Generator | None) -> torch.device | str:
    """Return the device on which a generator draws; without one, torch draws on the CPU."""
    return "cpu" if generator is None else generator.device


def nearby(generator: torch.Generator | None, device: torch.device) -> torch.Generator | None:
    """Return a generator for many draws for a device: one of the device's own if the given one is another's.

    Millions of numbers drawn on the CPU and moved would take a GPU longer than its passes.
    """
    if generator is None or generator.device.type == device.type:
        return generator
    seed = int(torch.randint(2**62, (), generator=generator, device=generator.device))
    return torch.Generator(device).manual_seed(seed)
