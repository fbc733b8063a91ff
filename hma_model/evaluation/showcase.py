"""Choose the windows that a report shows: the best, the median and the worst by the last frame's PSNR.

W windows, T frames, S pixels a side.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

from hma_data.errors import HMAError
from hma_data.loading.dataset import Batch
from hma_data.shards.preview import tokenizer_of
from hma_data.shards.reader import ShardSet
from hma_data.shards.recorded import Recorded
from hma_model.evaluation.losses import windows
from hma_model.generation.decode import decode

if TYPE_CHECKING:
    from hma_model.evaluation.suite import Part

Images = NDArray[np.uint8]


@dataclass(frozen=True)
class Showcase:
    """Some windows of a shard set, as several checkpoints predict them.

    Attributes:
        names: of the windows: best, median, worst.
        numbers: of the windows, among those that were evaluated.
        titles: where each window is from.
        truth: (W, T, S, S, 3), decoded from the true tokens.
        recorded: the same as recorded; None where the recording is not at hand.
        made: (W, T, S, S, 3) by checkpoint and kind of rollout; the prompt is true.
        unread: why the recording is not shown; empty if it is.
    """

    names: tuple[str, ...]
    numbers: tuple[int, ...]
    titles: tuple[str, ...]
    truth: Images
    recorded: Images | None
    made: dict[tuple[str, str], Images]
    unread: str


def choose(parts: "Sequence[Part]") -> Showcase:
    """Return the best, the median and the worst window of the first part, as all parts predict them.

    Args:
        parts: of one shard set.
    """
    found, shards = parts[0].found, ShardSet(parts[0].data)
    names = found["cameras"].split(", ")
    cameras = names if len(names) > 1 else names[0]
    batches = windows(shards, found["split"], found["frames"], found["windows"], found["windows"], cameras)
    (batch,), tokenizer = batches, tokenizer_of(shards)
    order = np.argsort(np.nan_to_num(parts[0].by_window["true.psnr_last"], nan=-1.0), kind="stable")[::-1]
    places = {int(order[at]): name for at, name in ((0, "best"), (len(order) // 2, "median"), (-1, "worst"))}
    numbers = list(places)
    stored = batch.latents if batch.tokens is None else batch.tokens
    assert stored is not None and batch.episode is not None and batch.frame is not None
    truth = decode(tokenizer, stored[numbers])
    made: dict[tuple[str, str], Images] = {}
    for part in parts:
        for kind, predicted in part.predicted.items():
            values = torch.from_numpy(predicted[numbers].astype(stored.numpy().dtype)).nan_to_num(0, 0, 0)
            frames = decode(tokenizer, values)
            made[part.checkpoint, kind] = np.concatenate([truth[:, : found["prompt"]], frames], axis=1)
    titles = tuple(f"episode {int(batch.episode[n])}, frame {int(batch.frame[n])}" for n in numbers)
    recorded, unread = None, ""
    try:
        recorded = np.stack([recorded_frames(shards, batch, number) for number in numbers])
    except (HMAError, OSError, ImportError) as fault:
        unread = " ".join(str(fault).split())
    if recorded is not None and recorded.shape != truth.shape:
        recorded, unread = None, "the model sees several cameras"
    return Showcase(tuple(places.values()), tuple(numbers), titles, truth, recorded, made, unread)


def recorded_frames(shards: ShardSet, batch: Batch, row: int) -> Images:
    """Return the recorded pictures (T, S, S, 3) of a window, as the tokenizer saw them.

    Raises:
        HMAError: the recording is not where the shard set says, or cannot be read.
    """
    assert batch.episode is not None and batch.frame is not None
    seen = 0 if batch.camera is None else int(batch.camera[row])
    number = int(batch.episode[row])
    (episode,) = (one for one in shards.episodes.to_pylist() if one["episode_index"] == number)
    rows = int(batch.frame[row]) + np.arange(batch.actions.shape[1]) * shards.row_stride
    return Recorded(shards, episode).frames(shards.manifest.cameras[seen], rows)
