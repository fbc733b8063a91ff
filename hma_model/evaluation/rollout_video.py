"""Show rollouts, as a video or a sheet: truth, prediction with its actions, prediction with other actions.

B windows, T frames, H×W pixels of a panel, A action dims.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import zip_longest
from pathlib import Path
from typing import Unpack

import numpy as np

from hma_data.arrays import Bools, Float32s, Images
from hma_data.episodes.sheets import (
    gif_bytes,
    grid,
    png_bytes,
    webp_bytes,
    with_actions,
    write_mp4,
    write_text,
)
from hma_data.errors import HMAError, UsageError
from hma_data.loading.dataset import WindowDataset
from hma_data.loading.views import FIRST_CAMERA, Cameras
from hma_data.shards.preview import tokenizer_of
from hma_data.shards.reader import ShardSet
from hma_data.storage.files import write_atomic
from hma_data.storage.paths import StrPath, as_path
from hma_data.tokenizers.base import Tokenizer
from hma_model.arrays import evenly
from hma_model.checkpoint.folder import require_tokenizer
from hma_model.evaluation.actions import shuffled
from hma_model.evaluation.losses import no_window, windows
from hma_model.evaluation.rollouts import Sampling, rollout
from hma_model.generation.decode import cameras_for
from hma_model.network.model import HMA

PANEL_PX = 192  # minimum width in pixels at which a picture is shown
HOLD_SECONDS = 0.9  # seconds for which the end of a window stands, where another one follows
GIVEN_COLOUR, PREDICTED_COLOUR = (150, 150, 150), (0, 158, 115)  # borders of true frames and of predictions
CANDIDATES = 48  # windows from which the liveliest are chosen
SHEETS = "pictures"  # the folder of a run's sheets
SHEET_COLUMNS = 8  # frames in a row of a sheet
TITLE_PX, MARGIN_PX, BORDER_PX = 42, 6, 4  # above a picture, beside it, around it
DARK_PAPER = (13, 17, 23)  # what is added to mirrored white, so that it is the paper of dark pages


@dataclass(frozen=True)
class RolloutVideo:
    """Frames (T, H, W, 3) uint8 at `fps`; the first `prompt` of each window are true, not predictions.

    `actions` (B, T, K) are the windows' own, raw; NaN where they are unknown. `images` (H, W) bool are the
    pixels that show the robot, with their borders.
    """

    frames: Images
    fps: float
    prompt: int
    actions: Float32s
    images: Bools

    def dark(self) -> Images:
        """Return the frames for a dark page: what is drawn around the images is light on dark."""
        drawn = self.frames[:, ~self.images].astype(np.int16)  # (T, pixels, 3)
        # Mirroring the lightness of a colour keeps its hue, as inverting each channel would not.
        mirrored = drawn + 255 - drawn.max(axis=2, keepdims=True) - drawn.min(axis=2, keepdims=True)
        frames = self.frames.copy()
        frames[:, ~self.images] = np.clip(mirrored + DARK_PAPER, 0, 255)
        return frames


def rollout_video(
    model: HMA,
    tokenizer: Tokenizer,
    shards: ShardSet,
    *,
    split: str = "val",
    window: int | Sequence[int] = 0,
    other: Sequence[int] | None = None,
    frames: int | None = None,
    prompt: int = 2,
    seed: int = 0,
    cameras: Cameras | None = None,
    **sampling: Unpack[Sampling],
) -> RolloutVideo:
    """Roll out from windows of a shard set, with their own actions and with those of other windows.

    Args:
        model: in eval mode, with the shard set's embodiment.
        window: the number of the window among the windows of this length; several are shown in turn.
        other: for each the number of the window whose actions it gets; None takes one half the set away.
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
    chosen, count = [window] if isinstance(window, int) else list(window), len(dataset)
    if not count:
        raise no_window(shards, split, length)
    if max(chosen) >= count:
        fault = f"has {count} windows of {length} frames in {split}, none with number {max(chosen)}"
        raise UsageError(shards.folder, fault, f"they are 0 to {count - 1}")
    batch = dataset.batch(chosen)
    theirs = dataset.batch(other or [(number + count // 2) % count for number in chosen])
    if count == 1:
        theirs = replace(batch, actions=batch.actions.flip(1), action_mask=batch.action_mask.flip(1))
    swapped = replace(batch, actions=batch.actions.clone(), action_mask=batch.action_mask.clone())
    swapped.actions[:, prompt - 1 :] = theirs.actions[:, prompt - 1 :]
    swapped.action_mask[:, prompt - 1 :] = theirs.action_mask[:, prompt - 1 :]
    roll = partial(rollout, model, tokenizer, prompt=prompt, seed=seed, **sampling)
    true = roll(batch)
    changed = roll(swapped, truth=true.truth)
    panels = (
        ("recording", true.truth, batch.actions, length),
        ("model, same actions", true.predicted, batch.actions, prompt),
        ("model, other actions", changed.predicted, swapped.actions, prompt),
    )
    fps, parts = shards.embodiment.effective_hz, []
    for i in range(len(chosen)):
        columns = [
            _column(name, films[i], actions[i].numpy(), shards, given)
            for name, films, actions, given in panels
        ]
        parts.append(_with_time(np.concatenate(columns, axis=2), prompt))
        if len(chosen) > 1:
            parts.append(parts[-1][-1:].repeat(round(HOLD_SECONDS * fps), axis=0))
    actions = batch.actions.masked_fill(~batch.action_mask.unsqueeze(-1), float("nan"))
    frames_shown = np.concatenate(parts)
    images = _image_pixels(frames_shown.shape[1:3], true.truth.shape[2:4], len(panels))
    return RolloutVideo(frames_shown, fps, prompt, actions.numpy(), images)


def lively_windows(shards: ShardSet, length: int, prompt: int, count: int) -> tuple[list[int], list[int]]:
    """Choose windows in which much moves, and for each the window whose actions differ most from its own.

    Of evenly spaced windows those come first in which most tokens change after the prompt; an episode comes
    a second time only after all others.

    Args:
        shards: a shard set of discrete tokens.
        length, prompt: frames of a window, and those of its prompt.
        count: how many held-out windows.

    Returns:
        The numbers of the windows, and the numbers of those with other actions, for `rollout_video`.
    """
    dataset = WindowDataset(shards, "val", length)
    numbers = evenly(len(dataset), CANDIDATES)
    batch = dataset.batch(numbers)
    assert batch.tokens is not None and batch.episode is not None
    changed = (batch.tokens[:, prompt:] != batch.tokens[:, prompt - 1 : prompt]).float().mean(dim=(1, 2, 3))
    turns: dict[int, list[int]] = {}  # candidates by episode, the liveliest first
    for i in np.argsort(-changed.numpy(), kind="stable").tolist():
        turns.setdefault(int(batch.episode[i]), []).append(i)
    chosen = [i for turn in zip_longest(*turns.values()) for i in turn if i is not None][:count]
    actions = batch.actions[:, prompt - 1 :]
    scaled = (actions / actions.std(dim=(0, 1)).clamp(min=1e-6)).flatten(1)
    far = [int((scaled - scaled[i]).square().sum(dim=1).argmax()) for i in chosen]
    return [int(numbers[i]) for i in chosen], [int(numbers[i]) for i in far]


def _column(name: str, film: Images, actions: Float32s, shards: ShardSet, given: int) -> Images:
    """Return a panel's frames (T, H, W, 3): title, picture with a border, and its actions as bars.

    The border tells the first `given` frames, which are true, from those that the model predicts.
    """
    scale = _scale(film.shape[2])
    edge_px = (BORDER_PX, BORDER_PX)
    large = np.pad(film.repeat(scale, 1).repeat(scale, 2), ((0, 0), edge_px, edge_px, (0, 0)))
    for frames, colour in ((large[:given], GIVEN_COLOUR), (large[given:], PREDICTED_COLOUR)):
        frames[:, :BORDER_PX] = frames[:, -BORDER_PX:] = colour
        frames[:, :, :BORDER_PX] = frames[:, :, -BORDER_PX:] = colour
    stats = shards.manifest.stats["action"]
    low, high = np.array(stats["min"]), np.array(stats["max"])
    barred = with_actions(large, actions[:, : len(low)], low, high, shards.embodiment.action.names())
    beside = (MARGIN_PX, MARGIN_PX)
    padded = np.pad(barred, ((0, 0), (TITLE_PX, 4), beside, (0, 0)), constant_values=250)
    for t, sheet in enumerate(padded):
        if given == len(film):
            about = "decoded from tokens"
        else:
            about = "prompt: recorded, decoded" if t < given else "predicted"
        write_text(sheet, name, (8, 17), 0.5)
        write_text(sheet, about, (8, 34), 0.4)
    return padded


def _scale(width: int) -> int:
    return max(1, -(-PANEL_PX // width))


def _image_pixels(shown: Sequence[int], image: Sequence[int], panels: int) -> Bools:
    """Return (H, W), the pixels of a film's frame that are images (h, w) or their borders."""
    height, width = (side * _scale(image[1]) + 2 * BORDER_PX for side in image)
    found = np.zeros(shown, np.bool_)
    for left in range(MARGIN_PX, shown[1], shown[1] // panels):
        found[TITLE_PX : TITLE_PX + height, left : left + width] = True
    return found


def _with_time(film: Images, prompt: int) -> Images:
    """Add a line below the frames that grows with time, in the colours of the borders."""
    count, _, width = film.shape[:3]
    out = np.pad(film, ((0, 0), (0, 8), (0, 0), (0, 0)), constant_values=250)
    edges = np.linspace(6, width - 6, count + 1).astype(int)
    for t in range(count):
        out[t:, -6:-2, edges[t] : edges[t + 1]] = GIVEN_COLOUR if t < prompt else PREDICTED_COLOUR
    return out


def write_video(path: StrPath, film: RolloutVideo) -> None:
    """Write an .mp4, or an animated .webp or .gif, to a str or path, atomically.

    Raises:
        UsageError: the path has another suffix.
    """
    path = as_path(path)
    if path.suffix == ".mp4":
        write_mp4(path, film.frames, film.fps)
    elif path.suffix == ".webp":
        write_atomic(path, webp_bytes(film.frames, film.fps))
    elif path.suffix == ".gif":
        write_atomic(path, gif_bytes(film.frames, film.fps))
    else:
        raise UsageError("--out", f"{path} is none of .mp4, .webp and .gif")


def write_sheets(
    model: HMA,
    sets: Mapping[str, ShardSet],
    out: Path,
    step: int,
    *,
    frames: int,
    count: int,
    seed: int,
    cameras: Cameras = FIRST_CAMERA,
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
    if not sets:
        return ""
    try:
        tokenizer = tokenizer_of(next(iter(sets.values())))
    except HMAError as fault:
        return f"no pictures: {fault}"
    training = model.training
    model.eval()
    columns = evenly(frames, SHEET_COLUMNS)
    for name, shards in sets.items():
        (batch,) = windows(shards, "val", frames, count, count, cameras)
        true = rollout(model, tokenizer, batch, seed=seed)
        other = rollout(model, tokenizer, shuffled(batch, true.prompt - 1, seed), seed=seed, truth=true.truth)
        films = {
            "recorded, decoded from tokens": true.truth,
            f"predicted from frame {true.prompt}": true.predicted,
            "with other actions": other.predicted,
        }
        rows = [list(film[i, columns]) for i in range(len(batch)) for film in films.values()]
        sheet = png_bytes(grid(rows, list(films) * len(batch)))
        write_atomic(out / SHEETS / f"step-{step:08d}-{name}.png", sheet)
    model.train(training)
    return ""


def newest_sheets(out: Path) -> dict[str, Path]:
    """Return the last sheet of each robot that has one."""
    return {path.stem[14:]: path for path in sorted((out / SHEETS).glob("step-????????-*.png"))}
