"""Show a rollout as a film: truth, prediction with its actions, prediction with other actions."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hma_data.episodes.sheets import webp_bytes, with_actions, write_mp4, write_text
from hma_data.errors import UsageError
from hma_data.loading.dataset import WindowDataset
from hma_data.shards.reader import ShardSet
from hma_data.storage.files import atomic_path
from hma_data.storage.paths import StrPath, as_path
from hma_model.checkpoint.io import require_tokenizer
from hma_model.evaluation.evaluate import rollout

if TYPE_CHECKING:
    from hma_data.tokenizers.base import Tokenizer
    from hma_model.network.model import HMA

SMALLEST = 192  # minimum width in pixels at which a picture is shown


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
    unmask_steps: int = 2,
    temperature: float = 0.0,
    sample_steps: int | None = None,
    seed: int = 0,
) -> RolloutVideo:
    """Roll out from one window of a shard set, with its own actions and with those of another window.

    Args:
        model: in eval mode, with the shard set's embodiment.
        window: the number of the window among the windows of this length.
        frames: how many to predict; None fills the model's window.
        prompt: how many true frames to start from.
        unmask_steps, temperature, sample_steps, seed: settings of the rollouts, as in `HMA.generate`.

    Raises:
        CheckpointError: the model was trained on another tokenizer.
        UsageError: the split has no such window.
    """
    require_tokenizer(model.config, shards.spec, shards.folder)
    length = prompt + frames if frames else max(model.config.frames, prompt + 1)
    windows = WindowDataset(shards, split, length)
    if window >= len(windows):
        raise UsageError(
            shards.folder,
            f"has {len(windows)} windows of {length} frames in {split}, none with number {window}",
        )
    batch = windows.batch([window])
    other = windows.batch([(window + len(windows) // 2) % len(windows)]).actions if len(windows) > 1 else None
    swapped = batch.actions.clone()
    swapped[:, prompt - 1 :] = (batch.actions.flip(1) if other is None else other)[:, prompt - 1 :]
    options: dict[str, Any] = {
        "prompt": prompt, "unmask_steps": unmask_steps, "temperature": temperature,
        "sample_steps": sample_steps, "seed": seed,
    }  # fmt: skip
    true = rollout(model, tokenizer, batch, **options)
    changed = rollout(model, tokenizer, batch, actions=swapped, truth=true.truth, **options)
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
    first = next(iter(panels.values()))
    scale = max(1, -(-SMALLEST // first.shape[2]))
    border = ((0, 0), (24, 6), (6, 6), (0, 0))
    enlarged = {name: frames.repeat(scale, 1).repeat(scale, 2) for name, frames in panels.items()}
    padded = [np.pad(frames, border, constant_values=250) for frames in enlarged.values()]
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
        with atomic_path(path) as part:
            part.write_bytes(webp_bytes(film.frames, film.fps))
    else:
        raise UsageError("--out", f"{path} is neither .mp4 nor .webp")
