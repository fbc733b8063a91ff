"""Export a shard set to the layout of the paper's code: flat files that numpy maps into memory.

    <out>/<split>/video.bin            (N, h, w) uint32 ids, (N, c, h, w) float16 latents, or
                                       (N, H, W, 3) uint8 pixels
                  actions/actions.bin  (N, A) float32
                  segment_ids.bin      (N,) int32: the episode of each row, rising
                  metadata.json        shapes, dtype, rate and name, as liruiw/HMA writes and reads them
                                hma/                 data that this layout has no place for: episodes.parquet,
                                                     embodiment.yaml, timestamp.bin, state.bin, masks

N rows of a split; all numbers little-endian.
"""

import json
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.compute as pc
import pyarrow.parquet as pq

from hma_data.errors import OutputError, UsageError
from hma_data.shards.reader import EpisodeReader, ShardSet
from hma_data.shards.schema import token_column
from hma_data.shards.windows import episode_pieces
from hma_data.storage.files import new_folder, write_atomic
from hma_data.storage.paths import StrPath, as_path
from hma_data.tokenizers.base import TokenizerSpec

METADATA, VIDEO, ACTIONS, SEGMENTS = "metadata.json", "video.bin", "actions/actions.bin", "segment_ids.bin"
EXTRA = "hma"
EXTRA_DTYPES = {"timestamp": "<f8", "state": "<f4", "action_known": "|b1", "state_known": "|b1"}
OnProgress = Callable[[int, int], None]


def export(
    folder: StrPath,
    out: StrPath,
    *,
    split: str | None = None,
    camera: str | None = None,
    on_progress: OnProgress = lambda done, total: None,
) -> list[Path]:
    """Write the splits of a shard set as flat files; each folder appears when it is complete.

    Args:
        folder: str or path of the set, or its URI.
        out: str or path of a new folder.
        split: write only this split, into `out` itself; None writes each split that has episodes into a
            folder below `out`.
        camera: name of the camera, if the set has several; None takes the first.

    Returns:
        The folders written.

    Raises:
        UsageError: there is no such split or camera.
        OutputError: a folder is already there, or cannot be written.
    """
    shards, out = ShardSet(folder), as_path(out)
    number = shards.camera_index(camera)
    have = [name for name, counts in shards.manifest.splits.items() if counts["episodes"]]
    if split is not None and split not in have:
        raise UsageError("--split", f"{shards.folder} has no {split!r}", f"its splits: {', '.join(have)}")
    places = {split: out} if split else {name: out / name for name in have}
    for place in places.values():
        if place.exists() and (not place.is_dir() or any(place.iterdir())):
            raise OutputError(place, "already exists", "choose a new --out, or delete it")
    total = sum(shards.manifest.splits[name]["frames"] for name in places)
    done = 0
    for name, place in places.items():
        try:
            with new_folder(place) as part:
                for rows in _write_rows(shards, name, part, number):
                    done += rows
                    on_progress(done, total)
        except OSError as fault:
            remedy = "free space or choose another --out"
            raise OutputError(place, f"cannot be written: {fault.strerror or fault}", remedy) from fault
    return list(places.values())


def _write_rows(shards: ShardSet, split: str, part: Path, camera: int) -> Iterator[int]:
    """Write one split; yield the number of rows of each episode."""
    spec = shards.spec
    name = shards.manifest.cameras[camera]
    columns = [column for column in shards.columns([name]) if column != "episode_index"]
    tokens = token_column(spec)[0]
    table = shards.episodes.filter(pc.equal(shards.episodes["split"], split))
    reader = EpisodeReader(shards, columns)
    written = [tokens, *(column for column in columns if column in {"action", *EXTRA_DTYPES})]
    dtypes = {tokens: video_dtype(spec), "action": "<f4", **EXTRA_DTYPES}
    paths = {tokens: VIDEO, "action": ACTIONS} | {name: f"{EXTRA}/{name}.bin" for name in EXTRA_DTYPES}
    segments: list[int] = []  # rows of each piece, see `hma_data.shards.windows`
    (part / "actions").mkdir()
    (part / EXTRA).mkdir()
    with ExitStack() as opened:
        files = {column: opened.enter_context((part / paths[column]).open("wb")) for column in written}
        for row in table.to_pylist():
            values = reader.episode(row, name)
            values[tokens] = shards.tokens(values[tokens])
            if spec.dtype == "uint8":
                values[tokens] = values[tokens].transpose(0, 2, 3, 1)  # pixels are (N, H, W, 3) there
            for column, file in files.items():
                file.write(np.ascontiguousarray(values[column], dtypes[column]).tobytes())
            segments += map(len, episode_pieces(shards, row))
            yield row["length"]
    ids = np.repeat(np.arange(len(segments)), segments).astype("<i4")
    (part / SEGMENTS).write_bytes(ids.tobytes())
    pq.write_table(table, part / EXTRA / "episodes.parquet")
    write_atomic(part / EXTRA / "embodiment.yaml", shards.embodiment.to_yaml())
    values = _metadata(shards, sum(segments), camera)
    write_atomic(part / METADATA, json.dumps(values, indent=1) + "\n")


def video_dtype(spec: TokenizerSpec) -> str:
    """Return the dtype of video.bin that the paper's loaders expect."""
    if spec.kind == "discrete":
        return "<u4"
    return "|u1" if spec.dtype == "uint8" else "<f2"


def _metadata(shards: ShardSet, rows: int, camera: int) -> dict[str, Any]:
    """Return the values of metadata.json: the paper's fields, then ours."""
    spec, embodiment, manifest = shards.spec, shards.embodiment, shards.manifest
    h, w = spec.grid
    discrete = spec.kind == "discrete"
    return {
        "token_dtype": str(np.dtype(video_dtype(spec))),
        "action_dim": embodiment.action_dim * manifest.frame_stride,
        "s": h,
        "h": h,
        "w": w,
        "vocab_size": spec.vocab_size,
        "hz": embodiment.rate_hz / manifest.frame_stride,
        "encoder_name_or_path": spec.name,
        "encoder_type": "magvit" if discrete else "temporalvae",
        "num_images": rows,
        "name": embodiment.id,
        "latent_channels": None if discrete else spec.channels,
        "quantized": discrete,
        "stride": shards.row_stride,
        "camera": manifest.cameras[camera],
        "frames": manifest.plan.get("frames", "all"),
        "source": manifest.source,
        "tokenizer": spec.to_json(),
    }
