"""Offer robots to drive, and scenes in which to begin.

A scene gives the prompt of a world model, and the action (A,) that leaves the robot as it is after it. It
then tells what truly happens under further actions: `advance` takes a chunk (K,), or None for the recorded
one, and returns it with the true image (H, W, 3) after it if that is known; None at a recording's end. The
laboratory's simulators know the truth for any actions; a recording knows it for its own actions alone; nobody
knows it for a robot that begins from images.

A robot has a `key` of letters, digits, `_`, `-`, `.` and `:`, which tells it from others, the A `dimensions`
of an action, and the names of the `cameras` that its images show side by side. Its `scene(number)` is there
for every number from 0 on.

P frames of a prompt, H×W pixels, A action dims, K = stride * A values of a chunk.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hma_data.arrays import Float32s, Floats, Images
from hma_data.episodes.images import resize
from hma_data.errors import UsageError
from hma_data.lab.simulator import SIZE, LabSimulator, simulated
from hma_data.loading.views import FIRST_CAMERA, Cameras
from hma_data.registry.components import Component
from hma_data.registry.embodiment import Embodiment
from hma_data.shards.reader import ShardSet
from hma_data.shards.windows import episode_pieces
from hma_model.checkpoint.folder import Checkpoint, require_tokenizer
from hma_model.worlds.images import (
    Prompt,
    fitted,
    image_shape,
    recorded_cameras,
    sample_image,
    seen_cameras,
)

if TYPE_CHECKING:
    from hma_data.loading.dataset import WindowDataset
    from hma_data.tokenizers.base import Tokenizer


PROMPT_FRAMES = 4  # frames; two would show velocities, more also show what stands still
LONGEST_WINDOW = 64  # frames of a window of a recording
RETURNING = ("joint_velocity", "joint_torque", "base_velocity", "joint_delta", "eef_delta")  # zero at rest


@dataclass(frozen=True)
class Dimension:
    """One value of an action.

    Attributes:
        low, high: range to drive in.
        kind: "rate" for a value that is zero at rest, "target" for one that stays where it was set, "switch"
            for a target with two states.
    """

    name: str
    unit: str
    low: float
    high: float
    kind: str


# -- the laboratory


class LabRobot:
    """A robot of the laboratory, with its simulator; its images have `size` pixels a side."""

    source = "simulator"

    def __init__(self, embodiment: Embodiment, stats: Mapping[str, Any], size: int = SIZE) -> None:
        self.key = embodiment.id
        self.embodiment = embodiment
        self.size = size
        self.dimensions = dimensions(embodiment, stats)
        self.seen = seen_range(stats)
        self.cameras = [embodiment.primary_camera.name]

    def scene(self, number: int) -> "LabScene":
        return LabScene(self.embodiment, self.dimensions, number, self.size)


class LabScene:
    """A scene of a simulator, begun by the recorder's own driver."""

    def __init__(
        self, embodiment: Embodiment, dims: tuple[Dimension, ...], number: int, size: int = SIZE
    ) -> None:
        self.stride = embodiment.stride
        self.size = size
        self.simulator = LabSimulator(embodiment.id)
        frames = [self._fitted(self.simulator.reset(seed=SCENE_SEED, episode=number))]
        chunks = []
        for _ in range(PROMPT_FRAMES - 1):
            chunk, frame = self.advance(None)
            frames.append(frame)
            chunks.append(chunk)
        self.prompt = Prompt(np.stack(frames), np.stack(chunks))
        self.action = at_rest(dims, self.prompt.chunks[-1][-embodiment.action_dim :])

    def advance(self, chunk: Float32s | None) -> tuple[Float32s, Images]:
        given = None if chunk is None else chunk.reshape(self.stride, -1)
        taken = []
        for step in range(self.stride):
            action = self.simulator.recorded() if given is None else given[step]
            self.simulator.advance(action)
            taken.append(action)
        return np.concatenate(taken).astype(np.float32), self._fitted(self.simulator.picture())

    def _fitted(self, image: Images) -> Images:
        return image if len(image) == self.size else resize(image[None], self.size)[0]


SCENE_SEED = 1_000_000  # of scenes; recordings for training have small seeds


def at_rest(dims: Sequence[Dimension], held: NDArray[Any]) -> Float32s:
    """Return the action (…, A) after which nothing moves on: no rate, and the targets that are held."""
    return np.where([dim.kind == "rate" for dim in dims], 0, held).astype(np.float32)


# -- recordings


class RecordedRobot:
    """A robot of a shard set; its scenes are windows of held-out episodes, or of all if none is held out.

    Recorded actions that are unknown are NaN.
    """

    source = "recordings"

    def __init__(
        self, shards: ShardSet, tokenizer: Callable[[], "Tokenizer"], stats: Mapping[str, Any], cameras: Any
    ) -> None:
        self.embodiment = shards.embodiment
        self.key = f"{self.embodiment.id}:recordings"
        self.dimensions = dimensions(self.embodiment, stats)
        self._mean = np.array(stats["action"]["mean"])
        self._shards = shards
        self._tokenizer = tokenizer
        self._cameras = cameras
        self.cameras = seen_cameras(cameras, shards.manifest.cameras)

    @cached_property
    def _windows(self) -> "WindowDataset":
        from hma_data.loading.dataset import WindowDataset

        splits = self._shards.manifest.splits
        split = "val" if splits.get("val", {}).get("episodes") else "train"
        parts = [
            len(part) // self._shards.row_stride
            for row in self._shards.episodes.to_pylist()
            if row["split"] == split
            for part in episode_pieces(self._shards, row)
        ]
        lengths = sorted(length for length in parts if length > PROMPT_FRAMES)
        if not lengths:
            fault = f"has no episode longer than {PROMPT_FRAMES} frames without a pause"
            raise UsageError(self._shards.folder, fault, "give other shards")
        length = min(LONGEST_WINDOW, lengths[len(lengths) // 2])
        return WindowDataset(self._shards, split, length, cameras=self._cameras)

    def scene(self, number: int) -> "RecordedScene":
        """Return one of the windows; those of numbers that follow one another lie apart."""
        from hma_model.generation.decode import decode

        windows = self._windows
        batch = windows.batch([number * apart(len(windows)) % len(windows)])
        frames = decode(self._tokenizer(), batch.stored)[0]
        chunks, known = batch.actions[0].numpy().astype(np.float32), batch.action_mask[0].numpy()
        chunks[~known] = np.nan
        prompt = Prompt(frames[:PROMPT_FRAMES], chunks[: PROMPT_FRAMES - 1])
        before = prompt.chunks[known[: PROMPT_FRAMES - 1], -len(self.dimensions) :]
        held = before[-1] if len(before) else self._mean
        # The chunk after the last frame leads to no frame that is known.
        rest = frames[PROMPT_FRAMES:], chunks[PROMPT_FRAMES - 1 : -1]
        return RecordedScene(prompt, at_rest(self.dimensions, held), *rest)


def apart(count: int) -> int:
    """Return a step of about 0.382 of so many windows that comes to each of them once."""
    step = 1 + round(0.382 * count)
    while math.gcd(step, count) > 1:
        step += 1
    return step


class RecordedScene:
    """A prompt, and the frames (T, H, W, 3) and chunks (T, K) that were recorded after it, if any were."""

    def __init__(
        self,
        prompt: Prompt,
        action: Float32s,
        frames: Images | tuple[()] = (),
        chunks: Float32s | tuple[()] = (),
    ) -> None:
        self.prompt = prompt
        self.action = action
        self._rest = iter(zip(chunks, frames, strict=True))
        self._followed = True  # whether all actions were the recorded ones

    def advance(self, chunk: Float32s | None) -> tuple[Float32s, Images | None] | None:
        if chunk is not None:
            self._followed = False
            return chunk, None
        found = next(self._rest, None)
        return found if found is None or self._followed else (found[0], None)


# -- images


class ImageRobot:
    """A robot that begins from images (P, H, W, 3); from a single one it begins at rest.

    The actions before several images are unknown, and so is the resting action of a robot with targets.
    """

    source = "images"

    def __init__(
        self,
        embodiment: Embodiment,
        stats: Mapping[str, Any],
        images: Images,
        cameras: Cameras = FIRST_CAMERA,
    ) -> None:
        self.embodiment = embodiment
        self.key = f"{embodiment.id}:images"
        self.cameras = seen_cameras(cameras, recorded_cameras(embodiment))
        self.dimensions = dims = dimensions(embodiment, stats)
        means = stats["action"]["mean"]
        rest = [{"rate": 0.0, "switch": dim.low}.get(dim.kind, mean) for dim, mean in zip(dims, means)]
        self._action = np.array(rest, np.float32)
        before = np.full_like(self._action, np.nan)
        if len(images) == 1:
            images = images.repeat(PROMPT_FRAMES, axis=0)
            if all(dim.kind != "target" for dim in dims):
                before = self._action
        self._prompt = Prompt(images, np.tile(before, (len(images) - 1, embodiment.stride)))

    def scene(self, number: int) -> RecordedScene:
        """Return the one scene that there is; nobody knows what truly happens after the images."""
        return RecordedScene(self._prompt, self._action)


# -- what can be driven

Drivable = LabRobot | RecordedRobot | ImageRobot


def drivable(
    checkpoint: Checkpoint,
    sets: Iterable[ShardSet],
    tokenizer: Callable[[], "Tokenizer"],
    images: Sequence[Images] = (),
) -> dict[str, Drivable]:
    """Return the robots of a checkpoint that can be driven, by key.

    A robot without simulator and shards begins from the first image of its sample in the checkpoint.

    Args:
        sets: shard sets of its robots.
        tokenizer: returns the checkpoint's, which decodes them.
        images: (H, W, 3) of one size, in their order at the rate of the model's frames; every robot begins
            from them too.

    Raises:
        UsageError: there is none, or the checkpoint lacks the robot of a shard set.
        CheckpointError: the shard set has other tokens than the checkpoint was trained on.
        HMAError: the images do not fit the model.
    """
    found: dict[str, Drivable] = {}
    for shards in sets:
        name = shards.embodiment.id
        if name not in checkpoint.embodiments:
            known = ", ".join(checkpoint.embodiments)
            raise UsageError(
                shards.folder, f"{checkpoint.name} does not know the robot {name}", f"known: {known}"
            )
        require_tokenizer(checkpoint.config, shards.spec, shards.folder)
        cameras = checkpoint.cameras(name)
        robot = RecordedRobot(shards, tokenizer, checkpoint.stats(name), cameras)
        found[robot.key] = robot
    recorded = {robot.embodiment.id for robot in found.values()}
    for name in checkpoint.embodiments:
        embodiment = checkpoint.embodiment(name)
        stats = checkpoint.stats(name)
        cameras = checkpoint.cameras(name)
        begun = list(images)
        if simulated(name):
            found[name] = LabRobot(embodiment, stats, image_shape(checkpoint.config)[0])
        elif not begun and name not in recorded and (sample := sample_image(checkpoint, name)) is not None:
            begun = [sample]
        if len({image.shape for image in begun}) > 1:
            raise UsageError("--prompt", "its images differ in size", "give images of one size")
        if begun:
            shown = fitted(np.stack(begun), checkpoint.config, embodiment, cameras)
            imaged = ImageRobot(embodiment, stats, shown, cameras)
            found[imaged.key] = imaged
    if not found:
        remedy = "give shards of it, hma play CHECKPOINT SHARDS, or an image of it, --prompt IMAGE"
        raise UsageError(checkpoint.folder, "none of its robots has a simulator to start from", remedy)
    return found


def opening(robots: Mapping[str, Drivable], embodiment: str | None, source: str | None) -> str | None:
    """Return the key of the robot that a page opens with; None lets the page choose.

    Args:
        robots: by key.
        embodiment: its id, if a person named one.
        source: where it begins if possible, as of `Drivable.source`.

    Raises:
        UsageError: there is no such robot.
    """
    own = [key for key, robot in robots.items() if embodiment in (None, robot.embodiment.id)]
    if not own:
        known = ", ".join(dict.fromkeys(robot.embodiment.id for robot in robots.values()))
        raise UsageError("--embodiment", f"there is no robot {embodiment!r} to drive", f"known: {known}")
    wished = [key for key in own if robots[key].source == source]
    return (wished or own)[0] if embodiment or wished else None


def trained_on(checkpoint: Checkpoint) -> list[ShardSet]:
    """Return the shard sets of a training run whose robots have no simulator, as far as they are here.

    Args:
        checkpoint: one of the run's; of any other there are none.
    """
    return [one for one in checkpoint.shards() if not simulated(one.embodiment.id)]


def seen_range(stats: Mapping[str, Any]) -> tuple[Floats, Floats]:
    """Return the least and the greatest action (A,) seen in training; about them where nobody knows."""
    action = stats["action"]
    mean = np.array(action["mean"])
    std = np.array(action["std"])
    return np.array(action.get("min", mean - 2 * std)), np.array(action.get("max", mean + 2 * std))


def dimensions(embodiment: Embodiment, stats: Mapping[str, Any]) -> tuple[Dimension, ...]:
    """Return the values of a robot's action, with the range of the actions seen in training."""
    low, high = seen_range(stats)
    parts = [part for part in embodiment.action.components for _ in range(part.dims)]
    values = zip(embodiment.action.names(), parts, low.tolist(), high.tolist(), strict=True)
    return tuple(_dimension(embodiment.action.space, *value) for value in values)


def _dimension(space: str, name: str, part: Component, low: float, high: float) -> Dimension:
    unit = part.unit or ""
    if not part.normalize and part.range in ((0, 1), None) and (low, high) == (0, 1):
        return Dimension(name, unit, 0.0, 1.0, "switch")
    even = part.range is not None and part.range[0] == -part.range[1]
    if unit.endswith("/s") or space in RETURNING or (space == "mixed" and even and unit != "rad"):
        top = max(abs(low), abs(high))
        return Dimension(name, unit, -top, top, "rate")
    return Dimension(name, unit, low, high, "target")
