"""A world that knows the truth, and a viewer that keeps what it is shown."""

import copy
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from hma_data.lab import family
from hma_data.lab.simulator import LabSimulator
from hma_data.registry.embodiment import Embodiment
from hma_data.shards.reader import ShardSet
from hma_data.tokenizers.base import TokenizerSpec, get_tokenizer
from hma_model.checkpoint import io as checkpoint
from hma_model.checkpoint.folder import Checkpoint, action_stats
from hma_model.config import ActionSpace, HMAConfig
from hma_model.generation.unmask import Decoding
from hma_model.network.model import HMA
from hma_model.play.session import Frame
from hma_model.worlds.scenes import PROMPT_FRAMES, SCENE_SEED, Drivable, LabRobot
from hma_model.worlds.world import World
from tests.conftest import BlockTokenizer
from tests.model.robots import stats


class TrueWorld:
    """A model without error, for the scenes of simulators: each row is a simulator of its own.

    Attributes:
        steps: the rows of each step.
        sampling: passes, temperature and order of each step.
        begun: (frames, chunks) of each open and reset.
        blind: rows that show black.
    """

    one_pass = False

    def __init__(self) -> None:
        self.rows: dict[int, LabSimulator] = {}
        self.steps: list[dict[int, NDArray[np.float32]]] = []
        self.uncertainty = dict[int, float]()
        self.begun: list[tuple[NDArray[np.uint8], NDArray[np.float32]]] = []
        self.blind: set[int] = set()
        self.sampling: list[tuple[int, float, str]] = []
        self.decoding = Decoding(2, 0.0)
        self._count = 0

    def open(self, embodiment: str, frames: Any, chunks: Any = None, *, seed: int = 0) -> int:
        self._count += 1
        self.rows[self._count] = LabSimulator(embodiment)
        self.reset(self._count, frames, chunks)
        return self._count

    def reset(self, session: int, frames: Any, chunks: Any = None, *, seed: int | None = None) -> None:
        """Find the scene whose beginning is the prompt; another prompt leaves the simulator as it is."""
        self.begun.append((frames, chunks))
        simulator = self.rows[session]
        for number in range(4):
            first = LabSimulator(simulator.embodiment.id)
            if len(frames) == PROMPT_FRAMES and np.array_equal(first.reset(SCENE_SEED, number), frames[0]):
                for chunk in chunks:
                    self._advance(first, chunk)
                self.rows[session] = first

    drawing = World.drawing

    def meter(self, embodiment: str, **changes: Any) -> tuple[None, str]:
        return None, "it is never unsure"

    def fork(self, sessions: Sequence[int], n: int) -> "TrueWorld":
        other = copy.copy(self)
        rows = [self.rows[session].copy() for session in sessions for _ in range(n)]
        other.rows, other.steps = dict(enumerate(rows)), []
        return other

    def step(
        self, actions: Mapping[int, NDArray[np.float32]], *, decoded: bool = True
    ) -> dict[int, NDArray[np.uint8]]:
        self.steps.append(dict(actions))
        self.sampling.append((self.decoding.unmask_steps, self.decoding.temperature, self.decoding.order))
        for row, chunk in actions.items():
            self._advance(self.rows[row], chunk)
        images = {row: self.rows[row].picture() for row in actions}
        return {row: one * 0 if row in self.blind else one for row, one in images.items()}

    def image(self, session: int) -> NDArray[np.uint8]:
        return self.rows[session].picture()

    def close(self, session: int) -> None:
        del self.rows[session]

    def _advance(self, simulator: LabSimulator, chunk: NDArray[np.float32]) -> None:
        for action in chunk.reshape(-1, simulator.embodiment.action_dim):
            simulator.advance(action)


class Watcher:
    def __init__(self) -> None:
        self.frames: list[Frame] = []
        self.told: list[dict[str, Any]] = []
        self.stalled, self.behind = False, 0

    def show(self, frame: Frame, facts: dict[str, Any]) -> None:
        self.frames.append(frame)

    def tell(self, message: dict[str, Any]) -> None:
        self.told.append(message)


def tiny_model(robot: str, *objectives: str) -> HMA:
    """Return a model of the tokenizer fsq-8 that knows nothing of a robot of the family.

    Its action heads are stirred if it has objectives, so that what they say depends on what they see.
    """
    torch.manual_seed(0)
    own, tokenizer = family.embodiment(robot), get_tokenizer("fsq-8")
    config = HMAConfig(
        layers=1, width=32, heads=2, frames=4, grid=(8, 8), factored=(8,) * 6, training_pass="pairs",
        tokenizer=tokenizer.spec.to_json(),
        objectives=dict.fromkeys(objectives or ("forward",), 1.0),
    )  # fmt: skip
    return _of_robot(HMA(config), own, bool(objectives))


class BlockLatents(BlockTokenizer):
    """The mean colours of 8×8 blocks of a 64-pixel image as latents."""

    spec = TokenizerSpec("latents", 1, "continuous", 64, (8, 8), channels=3, dtype="float16")

    def encode(self, frames: NDArray[np.uint8]) -> NDArray[np.float16]:
        blocks = frames.reshape(-1, 8, 8, 8, 8, 3).astype(np.float32).mean(axis=(2, 4)) / 17
        return blocks.transpose(0, 3, 1, 2).astype(np.float16)

    def decode(self, latents: NDArray[np.float16]) -> NDArray[np.uint8]:
        levels = np.clip(latents.astype(np.float32) * 17, 0, 255).astype(np.uint8).transpose(0, 2, 3, 1)
        return levels.repeat(8, axis=1).repeat(8, axis=2)


def latent_model(robot: str) -> HMA:
    torch.manual_seed(0)
    config = HMAConfig(
        kind="continuous", layers=1, width=32, heads=2, frames=4, grid=(8, 8), channels=3, patch=4,
        latent_scale=0.2, diffusion_width=32, diffusion_depth=1, training_pass="pairs",
        tokenizer=BlockLatents.spec.to_json(),
    )  # fmt: skip
    model = HMA(config)
    torch.nn.init.normal_(model.readout.diffusion.output.weight, std=0.3)
    return _of_robot(model, family.embodiment(robot), False)


def _of_robot(made: HMA, own: Embodiment, stirred: bool) -> HMA:
    stats = {"action": {"mean": [0.0] * own.action_dim, "std": [30.0] * own.action_dim}}
    made.add_embodiment(ActionSpace.of(own, action_stats(stats, own.id)))
    for parameter in made.heads.parameters() if stirred else ():
        torch.nn.init.normal_(parameter, std=0.3)
    return made.eval()


def lab_robots(*names: str) -> dict[str, Drivable]:
    """Return robots of the laboratory, with the embedded checkpoint's statistics or their ranges."""
    robots: dict[str, Drivable] = {}
    for name in names:
        checkpoint = Checkpoint.open("embedded", [name])
        if name in checkpoint.embodiments:
            robots[name] = LabRobot(checkpoint.embodiment(name), checkpoint.stats(name))
        else:
            low, high = family.Body.of(name).ranges
            ends = {"mean": (low + high) / 2, "std": (high - low) / 4, "min": low, "max": high}
            stats = {"action": {key: values.tolist() for key, values in ends.items()}}
            robots[name] = LabRobot(family.embodiment(name), stats)
    return robots


SMALL_HEAD: dict[str, Any] = {"channels": 3, "diffusion_width": 32, "diffusion_depth": 1}


def trained_on(views: Any, shards: ShardSet, folder: Path, objective: str = "forward", frames=12) -> Any:
    """Return a world of a saved model whose robot was trained on these cameras."""
    spec, count = shards.spec, 1 if isinstance(views, str) else len(views)
    sizes = {"factored": spec.factored} if spec.kind == "discrete" else SMALL_HEAD
    config = HMAConfig(
        kind=spec.kind, layers=1, width=16, heads=2, grid=(8, 8), views=count, frames=frames,
        tokenizer=spec.to_json(), objectives={objective: 1.0}, **sizes,
    )  # fmt: skip
    model, robot = HMA(config), shards.embodiment
    model.add_embodiment(robot, checkpoint.action_stats(stats(2), robot.id))
    described = {"stats": {robot.id: stats(2)}, "cards": {robot.id: {"data": {"cameras": views}}}}
    checkpoint.save(model, folder, embodiment_yaml={robot.id: robot.to_yaml()}, **described)
    return SimpleNamespace(model=HMA.from_pretrained(folder), tokenizer=None)
