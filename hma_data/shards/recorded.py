"""Read the recordings that a shard set was made of once more, to compare them with what its tokens keep.

N frames, H×W pixels as recorded, S pixels a side as the tokenizer saw them.
"""

from typing import Any

from hma_data.arrays import Images, Ints
from hma_data.episodes.align import to_clip
from hma_data.episodes.images import prepare
from hma_data.errors import EpisodeError
from hma_data.shards.reader import ShardSet
from hma_data.sources.base import open_source


class Recorded:
    """The recording of one episode of a shard set.

    Args:
        row: of the episode, from `shards.episodes`.

    Raises:
        HMAError: the recording is not where the set says, or has another length by now.
    """

    def __init__(self, shards: ShardSet, row: dict[str, Any]) -> None:
        self._shards, robot, manifest = shards, shards.embodiment, shards.manifest
        uri = str(row.get("source") or manifest.source)
        self.clip = to_clip(open_source(robot.source.format).read(uri, row["id"], robot), robot)
        if len(manifest.layout.kept(len(self.clip))) != row["length"]:
            raise EpisodeError(row["id"], f"has another length in {uri} than in {shards.folder}")

    def raw(self, camera: str, rows: Ints) -> Images:
        """Return the frames (N, H, W, 3) of rows of the episode, as they were recorded."""
        return self.clip.frames_at(camera, rows * self._shards.manifest.frame_stride)

    def frames(self, camera: str, rows: Ints) -> Images:
        """Return the frames (N, S, S, 3) of rows of the episode, as the tokenizer saw them."""
        robot, spec = self._shards.embodiment, self._shards.spec
        return prepare(self.raw(camera, rows), robot.camera(camera), spec.image_size, spec.resize_filter)
