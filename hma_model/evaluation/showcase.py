"""Choose the windows that a report shows: the best, the median and the worst by the last frame's PSNR.

T frames, S pixels a side.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hma_data.episodes.align import to_clip
from hma_data.episodes.images import prepare
from hma_data.errors import HMAError
from hma_data.loading.dataset import Batch
from hma_data.shards.reader import ShardSet
from hma_data.sources.base import open_source
from hma_model.evaluation.evaluate import Measured
from hma_model.evaluation.rollouts import decode

if TYPE_CHECKING:
    from hma_data.tokenizers.base import Tokenizer

PLACES = ("best", "median", "worst")
Images = NDArray[np.uint8]


@dataclass(frozen=True)
class Showcase:
    """Some windows of a part.

    Attributes:
        names: of the windows: best, median, worst.
        psnr_last: (W,) dB of the last frame.
        titles: where each window is from.
        films: (W, T, S, S, 3) by what they show: `recorded` (absent where the recording is not at hand),
            `reconstruction`, and the rollouts `true`, `shuffled` and `none`.
        unread: why the recording is not shown; empty if it is.
    """

    names: tuple[str, ...]
    psnr_last: NDArray[np.float64]
    titles: tuple[str, ...]
    films: dict[str, Images]
    unread: str = ""

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the same as arrays of a .npz file."""
        words = {
            "names": np.array(self.names),
            "titles": np.array(self.titles),
            "unread": np.array(self.unread),
        }
        return (
            words | {"psnr_last": self.psnr_last} | {f"film_{key}": film for key, film in self.films.items()}
        )

    @classmethod
    def of(cls, arrays: dict[str, NDArray[Any]]) -> "Showcase":
        """Return the showcase of the arrays of a file."""
        films = {key.removeprefix("film_"): film for key, film in arrays.items() if key.startswith("film_")}
        names, titles = (tuple(map(str, arrays[key])) for key in ("names", "titles"))
        return cls(names, arrays["psnr_last"], titles, films, str(arrays["unread"]))


def choose(measured: Measured, tokenizer: "Tokenizer", shards: ShardSet) -> Showcase:
    """Return the best, the median and the worst window of a part; fewer if it has fewer."""
    ranked = measured.by_window["true.psnr_last"]
    order = np.argsort(np.nan_to_num(ranked, nan=-1.0), kind="stable")[::-1]
    chosen = dict.fromkeys(int(order[place]) for place in (0, len(order) // 2, len(order) - 1))
    names = PLACES if len(chosen) == 3 else PLACES[:: len(PLACES) - 1][: len(chosen)]
    offsets = np.cumsum([0, *(len(batch) for batch in measured.batches)])
    films: dict[str, list[Images]] = {}
    recorded: list[Images] = []
    titles, unread = [], ""
    for number in chosen:
        at = int(np.searchsorted(offsets, number, side="right")) - 1
        row, batch = number - int(offsets[at]), measured.batches[at]
        stored = batch.latents if batch.tokens is None else batch.tokens
        assert stored is not None and batch.episode is not None and batch.frame is not None
        true = decode(tokenizer, stored[row : row + 1])
        films.setdefault("reconstruction", []).append(true)
        for kind, parts in measured.predicted.items():
            made = decode(tokenizer, parts[at][row : row + 1].nan_to_num(0, 0, 0))
            begin = true.shape[1] - made.shape[1]
            films.setdefault(kind, []).append(np.concatenate([true[:, :begin], made], axis=1))
        titles.append(f"episode {int(batch.episode[row])}, frame {int(batch.frame[row])}")
        try:
            recorded.append(recorded_frames(shards, batch, row))
        except (HMAError, OSError, ImportError) as fault:
            unread = " ".join(str(fault).split())
    shown = {kind: np.concatenate(parts) for kind, parts in films.items()}
    if not unread and recorded[0].shape == shown["reconstruction"].shape[1:]:
        shown = {"recorded": np.stack(recorded)} | shown
    return Showcase(names, ranked[list(chosen)], tuple(titles), shown, unread)


def recorded_frames(shards: ShardSet, batch: Batch, row: int) -> Images:
    """Return the recorded pictures (T, S, S, 3) of a window, as the tokenizer saw them.

    Raises:
        HMAError: the recording is not where the shard set says, or cannot be read.
    """
    assert batch.episode is not None and batch.frame is not None
    robot, spec, manifest = shards.embodiment, shards.spec, shards.manifest
    camera = robot.primary_camera if len(manifest.cameras) == 1 else robot.camera(manifest.cameras[0])
    number = int(batch.episode[row])
    (episode,) = (one for one in shards.episodes.to_pylist() if one["episode_index"] == number)
    uri = episode.get("source") or manifest.source
    clip = to_clip(open_source(robot.source.format).read(str(uri), episode["id"], robot), robot)
    begin, length = int(batch.frame[row]) * manifest.frame_stride, batch.actions.shape[1]
    rows = begin + np.arange(length) * robot.stride
    seen = clip.frames_at(camera.name, rows)
    return prepare(seen, camera, spec.image_size, spec.resize_filter)
