"""Read the frames that a session starts from: shards, images, recordings, simulators.

P frames of a prompt, T frames of an episode, K = stride · action dim.
"""

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hma_data.arrays import Bools, Float32s, Ints
from hma_data.episodes.align import pauses, to_clip
from hma_data.episodes.images import prepared
from hma_data.errors import HMAError, UsageError
from hma_data.lab import record
from hma_data.lab.simulator import simulated
from hma_data.loading.views import Cameras
from hma_data.registry.embodiment import Embodiment
from hma_data.registry.export import packed_components
from hma_data.shards.manifest import MANIFEST
from hma_data.shards.reader import EpisodeReader, ShardSet
from hma_data.shards.windows import episode_pieces, pieces
from hma_data.sources.base import open_source
from hma_data.storage.paths import StrPath, as_path
from hma_model.checkpoint.folder import require_tokenizer
from hma_model.generation.commands import described, yaml_of
from hma_model.generation.decode import cameras_for, trained_cameras, trained_shards
from hma_model.network.model import HMA
from hma_model.worlds.images import Prompt, as_chunks, read_image, recorded_cameras, seen_cameras

PROMPT_FORMS = (
    "give an image or images, an image's file, a folder of shards or of a LeRobotDataset, an environment "
    "with render(), or a mapping; hma_model.simulate.read_prompt describes them"
)
LEROBOT = "meta/info.json"


@dataclass(frozen=True)
class EpisodePart:
    """The part of a recording or shard set that a prompt takes.

    Attributes:
        episode: number or id; None for the first.
        start: its first frame as recorded; None for the first from which on the frames cross no pause.
        frames: P; None for half the model's window.
    """

    episode: int | str | None = None
    start: int | None = None
    frames: int | None = None

    def number(self, ids: Sequence[str], where: StrPath) -> int:
        """Return the number of the episode among those of the ids."""
        found = ids.index(self.episode) if self.episode in ids else self.episode or 0
        if isinstance(found, str) or not 0 <= found < len(ids):
            remedy = f"give 0 to {len(ids) - 1}, or an id"
            raise UsageError(where, f"has no episode {self.episode!r}", remedy)
        return found

    def rows(self, model: HMA, parts: Sequence[range], stride: int, frame_stride: int = 1) -> Ints:
        """Return the rows (P,) of the frames, `stride` apart, in one of the pieces of an episode.

        Raises:
            UsageError: they do not fit the episode, or cross a pause.
        """
        count = default_frames(model) if self.frames is None else self.frames
        span = (count - 1) * stride
        start = 0 if self.start is None else self.start // frame_stride
        if self.start is None:
            start = next((part.start for part in parts if span < len(part)), 0)
        part = next((part for part in parts if start in part), range(0))
        if span < 0 or start + span not in part:
            fault = f"{count} frames, {stride} rows apart, from row {start} on do not fit an episode of "
            fault += f"{parts[-1].stop} rows"
            if len(parts) > 1:
                pauses = ", ".join(str(part.stop - 1) for part in parts[:-1])
                fault += f" that pauses after row {pauses}"
            raise UsageError("prompt", fault, "choose another start or fewer frames")
        return np.arange(start, start + span + 1, stride)


def default_frames(model: HMA) -> int:
    """Return P of a prompt from a recording: half the model's window, at least one."""
    return max(1, model.config.frames // 2)


def read_prompt(model: HMA, embodiment: str, prompt: Any = None, *, seed: int = 0) -> Prompt:
    """Return the frames and chunks of a prompt.

    Args:
        model: whose embodiment is to be prompted.
        embodiment: its id.
        prompt: one of
            None: what comes along, see `starting_window`;
            images (H, W, 3) or (P, H, W, 3) uint8, or the str or path of an image's file, or several;
            the str or path of a shard set, or of a LeRobotDataset: the first frames of its first episode;
            a mapping: "shards" or "lerobot": that folder, and if wanted "episode": number or id, "start": its
            first frame as recorded, "frames": P; they may cross no pause;
            a mapping: "frames": images at the model's rate, and "chunks": (P - 1, K);
            an environment whose render() returns an image.
        seed: of a simulated prompt.

    Raises:
        HMAError: the prompt cannot be read.
    """
    if prompt is None:
        return starting_window(model, embodiment, seed)
    if isinstance(prompt, Mapping):
        return _of_mapping(model, embodiment, prompt)
    if hasattr(prompt, "render"):
        prompt = prompt.render()
        if prompt is None:
            raise HMAError("prompt", "its render() returned no image", 'make it with render_mode="rgb_array"')
    if isinstance(prompt, str | PathLike):
        folder = as_path(prompt)
        if (folder / MANIFEST).is_file():
            return _of_shards(model, embodiment, folder, EpisodePart())
        if (folder / LEROBOT).is_file():
            return _of_lerobot(model, embodiment, folder, EpisodePart())
        prompt = [folder]
    if isinstance(prompt, Sequence) and prompt and isinstance(prompt[0], str | PathLike):
        prompt = [read_image(path, PROMPT_FORMS) for path in prompt]
    images = _array(prompt)
    return _of_frames(model, embodiment, images[None] if images.ndim in (2, 3) else images)


def starting_window(model: HMA, embodiment: str, seed: int = 0) -> Prompt:
    """Return a prompt that comes along: the first frames of an episode, which the seed names.

    A laboratory robot is simulated: episode 0 of `hma_data.lab.record` with this seed. Another one starts
    from an episode of the shards that it was trained on, if these are still here. The episode is long enough
    for a prompt, and held out if any such one is.

    Raises:
        HMAError: the model lacks the embodiment, or there is neither a simulator nor such shards.
    """
    robot = described(model, embodiment)
    if robot is not None and simulated(embodiment):
        with tempfile.TemporaryDirectory() as folder:
            return _of_recording(model, robot, record(embodiment, folder, 1, seed), EpisodePart())
    if (shards := trained_shards(model, embodiment)) is not None:
        fit = {row["id"]: row["split"] for row, _ in long_pieces(shards, default_frames(model))}
        held = [name for name, split in fit.items() if split == "val"] or list(fit)
        episode = held[seed % len(held)] if held else None  # the first one says the fault
        return _of_shards(model, embodiment, shards.folder, EpisodePart(episode))
    fault = "none is included: it has no simulator here, and the shards of its training are not here"
    raise HMAError(f"prompt of {embodiment}", fault, PROMPT_FORMS)


def long_pieces(shards: ShardSet, frames: int) -> list[tuple[dict[str, Any], range]]:
    """Return the pieces of episodes without a pause that hold so many frames: the episode's row, and rows."""
    return [
        (row, part)
        for row in shards.episodes.to_pylist()
        for part in episode_pieces(shards, row)
        if len(part) > (frames - 1) * shards.row_stride
    ]


def _of_mapping(model: HMA, embodiment: str, prompt: Mapping[str, Any]) -> Prompt:
    given = dict(prompt)
    for key, read in (("shards", _of_shards), ("lerobot", _of_lerobot)):
        if key in given and not given.keys() - {key, *vars(EpisodePart())}:
            folder = given.pop(key)
            if not isinstance(folder, str | PathLike):
                raise HMAError("prompt", f"{key} is {folder!r}, not a folder", PROMPT_FORMS)
            return read(model, embodiment, folder, EpisodePart(**given))
    if "frames" not in given or given.keys() - {"frames", "chunks"}:
        raise HMAError("prompt", f"has the keys {', '.join(map(str, given))}", PROMPT_FORMS)
    return _of_frames(model, embodiment, _array(given["frames"]), given.get("chunks"))


def _array(images: Any) -> NDArray[Any]:
    """Return images as one array; that a number is no image, `fitted` says."""
    try:
        return np.atleast_1d(images)
    except ValueError as fault:
        raise HMAError("prompt", "its images differ in size", "give images of one size") from fault


def _of_frames(model: HMA, embodiment: str, frames: NDArray[Any], chunks: ArrayLike | None = None) -> Prompt:
    if chunks is None:
        described(model, embodiment)  # raises if the model lacks it
        width = model.embodiments[embodiment].chunk_dim
        chunks = np.full((max(0, len(frames) - 1), width), np.nan)
    return Prompt(frames, as_chunks(chunks))


# -- episodes


def _of_shards(model: HMA, embodiment: str, folder: StrPath, part: EpisodePart) -> Prompt:
    shards = ShardSet(folder)
    require_fit(model, embodiment, shards)
    rows = shards.episodes.to_pylist()
    chosen = rows[part.number([row["id"] for row in rows], shards.folder)]
    every = shards.manifest.frame_stride
    at = part.rows(model, episode_pieces(shards, chosen), shards.row_stride, every)
    return SeenShards(shards, cameras_for(model, shards)).window(chosen, at)


def require_fit(model: HMA, embodiment: str, shards: ShardSet) -> None:
    """Check that an embodiment of a model can go on from the frames of shards; raise HMAError if not."""
    require_tokenizer(model.config, shards.spec, shards.folder)
    described(model, embodiment)
    space = model.embodiments[embodiment]
    robot = shards.embodiment
    if (robot.stride, robot.action_dim) != (space.stride, space.action_dim):
        fault = f"is of {robot.id}, with {robot.stride} actions of {robot.action_dim} values in a chunk"
        raise HMAError(shards.folder, fault, f"{embodiment} takes {space.stride} of {space.action_dim}")


class SeenShards:
    """The episodes of a shard set as a model sees them: the views of its cameras side by side.

    Args:
        cameras: those that the model was trained on.

    Attributes:
        cameras: names of the views.
    """

    def __init__(self, shards: ShardSet, cameras: Cameras) -> None:
        self.shards = shards
        self.cameras = seen_cameras(cameras, shards.manifest.cameras)
        self._reader = EpisodeReader(shards, shards.columns(self.cameras))

    def episode(self, row: Mapping[str, Any]) -> tuple[NDArray[Any], dict[str, NDArray[Any]]]:
        """Return the frames (T, …) of an episode, a row of episodes.parquet, and its columns."""
        views = []
        for name in self.cameras:
            columns = self._reader.episode(row, name)
            (stored,) = (columns[key] for key in columns if key in ("tokens", "latents"))
            views.append(self.shards.tokens(stored))
        return np.concatenate(views, axis=-2), columns

    def window(self, row: Mapping[str, Any], at: Ints) -> Prompt:
        """Return the frames at some rows (P,) of an episode, and the chunks between them."""
        frames, columns = self.episode(row)
        known = columns.get("action_known")
        return Prompt(frames[at], _chunks(columns["action"], known, at, self.shards.row_stride))


def _of_lerobot(model: HMA, embodiment: str, folder: StrPath, part: EpisodePart) -> Prompt:
    robot = yaml_of(model, embodiment)
    if robot.source.format != "lerobot":
        robot = _as_lerobot(robot, folder)
    return _of_recording(model, robot, as_path(folder), part)


def _as_lerobot(robot: Embodiment, folder: StrPath) -> Embodiment:
    """Return an embodiment that finds its action and its cameras in a LeRobotDataset.

    A camera has the key that ends with its name; those without one have the other keys in their order.
    """
    keys = [key.key for key in open_source("lerobot").inspect(folder, 1).keys if key.kind == "camera"]
    if len(keys) < len(robot.cameras):
        raise HMAError(folder, f"has {len(keys)} cameras, {robot.id} has {len(robot.cameras)}", PROMPT_FORMS)
    named = {key.rpartition(".")[2]: key for key in keys}
    paired = {camera.name: named[camera.name] for camera in robot.cameras if camera.name in named}
    rest = (key for key in keys if key not in paired.values())
    cameras = [
        {"name": camera.name, "key": paired.get(camera.name) or next(rest), "resize": camera.resize}
        for camera in robot.cameras
    ]
    values = robot.to_dict()
    for key in ("state", "quality"):  # of the other recordings
        values.pop(key, None)
    values |= {
        "action": {"space": robot.action.space, "components": packed_components(values["action"], "action")},
        "cameras": cameras,
        "sync": {"primary": robot.sync.primary},
        "source": {"format": "lerobot"},
    }
    return Embodiment.from_values(values, f"{folder}, as {robot.id}")


def _of_recording(model: HMA, robot: Embodiment, recording: Path, part: EpisodePart) -> Prompt:
    """Return frames of an episode of a recording, in the format that the robot's YAML names."""
    source = open_source(robot.source.format)
    ids = source.episode_ids(recording)
    clip = to_clip(source.read(recording, ids[part.number(ids, recording)], robot), robot)
    at = part.rows(model, pieces(pauses(clip.timestamps), len(clip), robot.stride), robot.stride)
    spec = model.config.spec
    views = [
        prepared(
            clip.episode.streams[name],
            clip.frame_indices[name][at],
            robot.camera(name),
            spec.image_size,
            spec.resize_filter,
        )
        for name in seen_cameras(trained_cameras(model, robot.id), recorded_cameras(robot))
    ]
    chunks = _chunks(clip.actions, clip.action_known, at, robot.stride)
    return Prompt(np.concatenate(views, axis=2), chunks)


def _chunks(actions: NDArray[Any], known: Bools | None, at: Ints, stride: int) -> Float32s:
    """Return the chunks (P - 1, K) between the rows (P,) of an episode's actions (T, ...)."""
    spans = at[:-1, None] + np.arange(stride)
    chunks = actions[spans].reshape(len(at) - 1, int(np.prod(actions.shape[1:])) * stride)
    if known is not None:
        chunks[~known[spans].all(axis=1)] = np.nan
    return chunks
