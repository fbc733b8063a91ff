"""Show rollouts, as a video or a sheet: truth, prediction with its actions, prediction with other actions."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Unpack

import numpy as np
from numpy.typing import NDArray

from hma_data.episodes.sheets import grid, png_bytes, webp_bytes, with_actions, write_mp4, write_text
from hma_data.errors import HMAError, UsageError
from hma_data.loading.dataset import WindowDataset
from hma_data.loading.views import FIRST, Cameras
from hma_data.shards.reader import ShardSet
from hma_data.storage.files import write_atomic
from hma_data.storage.paths import StrPath, as_path
from hma_model.checkpoint.folder import require_tokenizer
from hma_model.evaluation.evaluate import Sampling, cameras_for, rollout, shuffled_actions, windows

if TYPE_CHECKING:
    from hma_data.tokenizers.base import Tokenizer
    from hma_model.network.model import HMA

SMALLEST = 192  # minimum width in pixels at which a picture is shown
SHEETS = "pictures"  # the folder of a run's sheets
COLUMNS = 8  # frames in a row of a sheet


@dataclass(frozen=True)
class RolloutVideo:
    """Frames (T, H, W, 3) uint8 at `fps`; the first `prompt` of them are true frames, not predictions."""

    frames: NDArray[np.uint8]
    fps: float
    prompt: int


def rollout_video(
    model: "HMA",
    tokenizer: "Tokenizer",
    shards: ShardSet,
    *,
    split: str = "val",
    window: int = 0,
    frames: int | None = None,
    prompt: int = 2,
    seed: int = 0,
    cameras: Cameras | None = None,
    **sampling: Unpack[Sampling],
) -> RolloutVideo:
    """Roll out from one window of a shard set, with its own actions and with those of another window.

    Args:
        model: in eval mode, with the shard set's embodiment.
        window: the number of the window among the windows of this length.
        frames: how many to predict; None fills the model's window.
        prompt: how many true frames to start from.
        seed: of the rollouts.
        cameras: as `WindowDataset` takes them; None takes those that the model was trained on.
        sampling: options of `HMA.generate`.

    Raises:
        CheckpointError: the model was trained on another tokenizer.
        UsageError: the split has no such window, or the cameras are not as many as the model takes.
    """
    require_tokenizer(model.config, shards.spec, shards.folder)
    length = prompt + frames if frames else max(model.config.frames, prompt + 1)
    dataset = WindowDataset(shards, split, length, cameras=cameras_for(model, shards, cameras))
    count = len(dataset)
    if window >= count:
        fault = f"has {count} windows of {length} frames in {split}, none with number {window}"
        raise UsageError(shards.folder, fault)
    batch = dataset.batch([window])
    other = dataset.batch([(window + count // 2) % count]).actions if count > 1 else None
    swapped = batch.actions.clone()
    swapped[:, prompt - 1 :] = (batch.actions.flip(1) if other is None else other)[:, prompt - 1 :]
    roll = partial(rollout, model, tokenizer, batch, prompt=prompt, seed=seed, **sampling)
    true = roll()
    changed = roll(actions=swapped, truth=true.truth)
    stats = shards.manifest.stats["action"]
    low, high = np.array(stats["min"]), np.array(stats["max"])
    own, foreign = (actions[0, :, : len(low)].numpy() for actions in (batch.actions, swapped))
    panels = {
        "truth": with_actions(true.truth[0], own, low, high),
        "true actions": with_actions(true.predicted[0], own, low, high),
        "other actions": with_actions(changed.predicted[0], foreign, low, high),
    }
    return RolloutVideo(_side_by_side(panels, prompt), shards.embodiment.effective_hz, prompt)


def _side_by_side(panels: dict[str, NDArray[np.uint8]], prompt: int) -> NDArray[np.uint8]:
    scale = max(1, -(-SMALLEST // next(iter(panels.values())).shape[2]))
    border = ((0, 0), (24, 6), (6, 6), (0, 0))
    enlarged = (frames.repeat(scale, 1).repeat(scale, 2) for frames in panels.values())
    padded = [np.pad(frames, border, constant_values=250) for frames in enlarged]
    film = np.concatenate(padded, axis=2)
    for t, sheet in enumerate(film):
        for i, name in enumerate(panels):
            label = f"{name}: prompt" if i and t < prompt else name
            write_text(sheet, label, (8 + i * padded[0].shape[2], 16), 0.46)
    return film


def write_video(path: StrPath, film: RolloutVideo) -> None:
    """Write an .mp4 or an animated .webp to a str or path, atomically.

    Raises:
        UsageError: the path has another suffix.
    """
    path = as_path(path)
    if path.suffix == ".mp4":
        write_mp4(path, film.frames, film.fps)
    elif path.suffix == ".webp":
        write_atomic(path, webp_bytes(film.frames, film.fps))
    else:
        raise UsageError("--out", f"{path} is neither .mp4 nor .webp")


def write_sheets(
    model: "HMA",
    sets: Mapping[str, ShardSet],
    out: Path,
    step: int,
    *,
    frames: int,
    count: int,
    seed: int,
    cameras: Cameras = FIRST,
) -> str:
    """Write `pictures/step-N-ID.png` for each robot.

    Args:
        model: the evaluated model.
        sets: shard sets with validation windows.
        out: the run's folder, and the number of its finished steps.
        frames, count: the frames of a window, and how many windows of each robot are shown.
        seed: of the rollouts.
        cameras: as `WindowDataset` takes them.

    Returns:
        The reason for no pictures if the tokenizer is not available here; else an empty string.
    """
    from hma_data.shards.preview import tokenizer_of

    if not sets:
        return ""
    try:
        tokenizer = tokenizer_of(next(iter(sets.values())))
    except HMAError as fault:
        return f"no pictures: {fault}"
    training = model.training
    model.eval()
    columns = np.unique(np.linspace(0, frames - 1, COLUMNS).astype(int))
    for name, shards in sets.items():
        (batch,) = windows(shards, "val", frames, count, count, cameras)
        true = rollout(model, tokenizer, batch, seed=seed)
        swapped = shuffled_actions(batch, true.prompt - 1, seed)
        other = rollout(model, tokenizer, batch, actions=swapped, seed=seed, truth=true.truth)
        films = {
            "truth": true.truth,
            f"predicted from frame {true.prompt}": true.predicted,
            "with other actions": other.predicted,
        }
        rows = [list(film[i, columns]) for i in range(len(batch)) for film in films.values()]
        sheet = png_bytes(grid(rows, list(films) * len(batch)))
        write_atomic(out / SHEETS / f"step-{step:08d}-{name}.png", sheet)
    model.train(training)
    return ""


def newest_sheets(out: Path, names: Iterable[str]) -> dict[str, bytes]:
    """Return the last sheet (PNG) of each robot that has one."""
    found = {name: sorted((out / SHEETS).glob(f"step-????????-{name}.png")) for name in names}
    return {name: paths[-1].read_bytes() for name, paths in found.items() if paths}
