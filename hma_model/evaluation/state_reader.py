"""Read numbers off pictures by small networks: the places of parts, or the values of a recorded state.

Convolutions make maps of a picture. The softmax of a map is a distribution over the picture, and its mean is
a point (Levine et al. 2016; Sun et al. 2018, integral regression). Places are points that a linear layer
corrects from one another: about 3,600 weights. Other values, such as angles, take a hidden layer over more
points. That layer is no substitute for the first: of three robots it read own parts 1.2 to 7 times as far
off, and lost loose ones (22 to 35 px of 128, where places are read to 1 or 2). Both learn from pictures as a
tokenizer shows them, with slight noise.

N pictures (N, 64, 64, 3), M maps, P parts. Pixels, points and places are -1 to 1.
"""

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor, nn

from hma_data.arrays import Floats, Images
from hma_data.episodes.images import resize

Tell = Callable[[str], None]  # is called with how far it is
INPUT_SIDE, MAP_SIDE = 64, 32  # pixels of the images that a network sees, and cells of its maps
CHANNELS, SHARPNESS = 16, 4.0
POINTS, HIDDEN_WIDTH = 16, 128  # of a network for values that are no places
BATCH_SIZE = 32
NOISE = 0.03  # in images of -1 to 1
NEGLIGIBLE = 1e-30  # a gradient of a map
UNREADABLE_SHARE = 0.5  # of a value's spread; a network with a larger error does not read it


class MapNetwork(nn.Module):
    """The maps of pictures, and the points that they mean."""

    def __init__(self, count: int, kernel: int) -> None:
        super().__init__()
        self.maps = nn.Sequential(
            nn.Conv2d(3, CHANNELS, 5, stride=2, padding=2),
            nn.GELU(),
            nn.Conv2d(CHANNELS, CHANNELS, 3, padding=2, dilation=2),
            nn.GELU(),
            nn.Conv2d(CHANNELS, count, kernel, padding=kernel // 2),
        )
        line = (torch.arange(MAP_SIDE) + 0.5) * (2 / MAP_SIDE) - 1
        self.register_buffer("grid", torch.stack(torch.meshgrid(line, line, indexing="xy"), -1).view(-1, 2))

    def points(self, pictures: Tensor) -> tuple[Tensor, Tensor]:
        """Return the points (N, 2·M) of pictures (N, 3, 64, 64), and how high each map reaches (N, M)."""
        maps = self.maps(pictures).flatten(2)
        if maps.requires_grad:
            # gradients far from a peak are subnormal, and convolutions of such numbers take 15 times as long
            maps.register_hook(lambda gradient: gradient.masked_fill(gradient.abs() < NEGLIGIBLE, 0.0))
        return ((maps * SHARPNESS).softmax(-1) @ self.grid).flatten(1), maps.amax(-1)


class PlaceNetwork(MapNetwork):
    """A network that finds parts: places (N, 2·P)."""

    def __init__(self, parts: int) -> None:
        super().__init__(parts, kernel=1)
        self.correct = nn.Linear(2 * parts, 2 * parts)
        # at first the places stay as they are read; training learns only what to correct
        nn.init.eye_(self.correct.weight)
        nn.init.zeros_(self.correct.bias)

    def forward(self, pictures: Tensor) -> Tensor:
        return self.correct(self.points(pictures)[0])


class StateNetwork(MapNetwork):
    """A network that reads values (N, S), in standard deviations from their mean."""

    def __init__(self, values: int) -> None:
        super().__init__(POINTS, kernel=3)
        self.head = nn.Sequential(
            nn.Linear(3 * POINTS, HIDDEN_WIDTH), nn.GELU(), nn.Linear(HIDDEN_WIDTH, values)
        )

    def forward(self, pictures: Tensor) -> Tensor:
        return self.head(torch.cat(self.points(pictures), dim=1))


def trained(
    make: Callable[[], nn.Module],
    small: Images,
    targets: Floats,
    seed: int,
    steps: int,
    rate: float,
    beta: float,
    tell: Tell,
) -> nn.Module:
    """Return a network trained from noisy pictures to targets (N, …), by a smooth L1 loss of that beta."""
    with torch.random.fork_rng(devices=[]):  # the caller's random numbers go on as if nothing was drawn
        torch.manual_seed(seed)
        network = make()
    inputs = pixels(small)
    wanted = torch.tensor(targets, dtype=torch.float32)
    generator = torch.Generator().manual_seed(seed)
    optimizer = torch.optim.AdamW(network.parameters(), lr=rate, weight_decay=1e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, rate, total_steps=steps)
    for step in range(steps):
        chosen = torch.randint(0, len(inputs), (BATCH_SIZE,), generator=generator)
        noisy = inputs[chosen] + NOISE * torch.randn(
            BATCH_SIZE, 3, INPUT_SIDE, INPUT_SIDE, generator=generator
        )
        loss = nn.functional.smooth_l1_loss(network(noisy), wanted[chosen], beta=beta)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        tell(f"learning to estimate the state from images: step {step + 1} of {steps}")
    return network.eval()


@torch.no_grad()
def outputs(network: nn.Module, small: Images) -> Floats:
    """Return what a network reads off pictures."""
    parts = np.array_split(small, len(small) // 64 + 1)
    return torch.cat([network(pixels(part)) for part in parts]).double().numpy()


def resized(pictures: Images) -> Images:
    """Return pictures (N, 64, 64, 3) of pictures (…, H, W, 3)."""
    return resize(pictures.reshape(-1, *pictures.shape[-3:]), INPUT_SIDE, "stretch")


def pixels(small: Images) -> Tensor:
    return torch.from_numpy(small).permute(0, 3, 1, 2).float() / 127.5 - 1
