"""A shard set from flat files: those of `hma shards export`, or of the paper's code.

The layout is described in `hma_data.shards.memmap`. N rows of a split.
"""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from hma_data.embodiment import Embodiment
from hma_data.errors import ShardError, UsageError
from hma_data.paths import StrPath, as_path
from hma_data.plan import Settings
from hma_data.shards.manifest import Manifest
from hma_data.shards.memmap import (
    EXTRA,
    EXTRA_DTYPES,
    METADATA,
    SEGMENTS,
    VIDEO,
    OnProgress,
    quiet,
    video_dtype,
)
from hma_data.shards.remake import Job, Read, Ready, remake
from hma_data.shards.schema import EpisodeRow, mask_columns, token_column
from hma_data.tokenizers.base import TokenizerSpec


@dataclass(frozen=True)
class Mapped:
    """One folder of flat files, opened.

    Attributes:
        columns: name -> (N, width) or (N,), mapped, in the shards' own order of values.
        starts: (E+1,) first row of each episode.
        rows: what is known of each episode.
    """

    folder: Path
    metadata: dict[str, Any]
    columns: dict[str, NDArray[Any]]
    starts: NDArray[np.int64]
    rows: list[EpisodeRow]


def import_memmap(
    folder: StrPath,
    out: StrPath,
    *,
    embodiment: Embodiment | None = None,
    tokenizer: TokenizerSpec | None = None,
    val_fraction: float = 0.05,
    seed: int = 0,
    workers: int = 1,
    on_progress: OnProgress = quiet,
) -> Manifest:
    """A shard set from flat files: of `export`, or of the paper's code.

    Args:
        folder: str or path of one such folder, or of a folder with `train` and `val` of them.
        out: str or path of the new set, or its URI.
        embodiment, tokenizer: needed where the folder does not say.
        val_fraction, seed: divide episodes that came without a split.

    Raises:
        ShardError: the files do not fit together.
        UsageError: the embodiment or tokenizer is neither given nor stated.
    """
    folder = as_path(folder)
    parts = _parts(folder)
    first = _read_metadata(next(iter(parts.values())))
    robot = embodiment or _stated_embodiment(next(iter(parts.values())))
    spec = tokenizer or _stated_tokenizer(first, folder)
    strided = first.get("frames") == "strided"
    mapped = [_open(place, split, robot, spec, strided) for split, place in parts.items()]
    order = sorted(
        (row.episode_index, part, number)
        for part, its in enumerate(mapped)
        for number, row in enumerate(its.rows)
    )
    episodes = [
        Ready(mapped[part].rows[number], (part, number), mapped[part].rows[number].group)
        for _, part, number in order
    ]
    camera = str(first.get("camera", robot.primary_camera.name))
    settings = Settings(
        frames="strided" if strided else "all", cameras=(camera,), val_fraction=val_fraction, seed=seed
    )
    source = str(first.get("source", folder.name))

    def opened() -> Read:
        def read(item: Ready) -> dict[str, NDArray[Any]]:
            part, number = item.key
            its = mapped[part]
            own = slice(int(its.starts[number]), int(its.starts[number + 1]))
            return {name: np.array(values[own]) for name, values in its.columns.items()}

        return read

    made_by = {"import": "memmap"}
    return remake(
        Job(robot, spec, settings, episodes, opened, source, (), made_by), out, workers, on_progress
    )


def _parts(folder: Path) -> dict[str, Path]:
    """Split -> its folder; the empty split for a folder that is one itself."""
    if (folder / METADATA).is_file():
        return {"": folder}
    found: dict[str, Path] = {}
    for split in ("train", "val"):
        places = [path.parent for path in sorted(folder.glob(f"*{split}/{METADATA}"))]
        if len(places) > 1:
            names = ", ".join(place.name for place in places[:3])
            raise ShardError(folder, f"holds several sets for {split}: {names}", "give one of them")
        if places:
            found[split] = places[0]
    return found or {"": folder}


def _read_metadata(place: Path) -> dict[str, Any]:
    path = place / METADATA
    try:
        values = json.loads(path.read_bytes())
        needed = {"num_images": int, "h": int, "w": int, "action_dim": int}
        for name, kind in needed.items():
            if type(values[name]) is not kind or values[name] < 1:
                raise ShardError(path, f"{name} must be a whole number above 0, is {values[name]!r}")
        return dict(values)
    except FileNotFoundError as fault:
        raise ShardError(path, "is not there", "give a folder with video.bin and metadata.json") from fault
    except (OSError, ValueError, KeyError, TypeError) as fault:
        said = f"has no {fault}" if isinstance(fault, KeyError) else f"cannot be read: {fault}"
        raise ShardError(
            path, said, "give a folder that the paper's code or hma shards export wrote"
        ) from fault


def _stated_embodiment(place: Path) -> Embodiment:
    path = place / EXTRA / "embodiment.yaml"
    if not path.is_file():
        raise UsageError("--embodiment", f"{place} does not say which robot it is of", "give its id or YAML")
    return Embodiment.load(path)


def _stated_tokenizer(metadata: dict[str, Any], folder: Path) -> TokenizerSpec:
    if "tokenizer" not in metadata:
        name = metadata.get("encoder_name_or_path", "unknown")
        raise UsageError(
            "--tokenizer",
            f"{folder} does not say which it was made with, only {name!r}",
            "give --tokenizer magvit2 for the paper's discrete data, svd-vae for its continuous",
        )
    try:
        return TokenizerSpec.from_json(metadata["tokenizer"])
    except (TypeError, ValueError, KeyError, AttributeError) as fault:
        raise ShardError(folder / METADATA, f"has a damaged tokenizer: {fault}") from fault


def _open(place: Path, split: str, robot: Embodiment, spec: TokenizerSpec, strided: bool) -> Mapped:
    metadata = _read_metadata(place)
    rows, (h, w) = metadata["num_images"], spec.grid
    if (metadata["h"], metadata["w"]) != (h, w):
        fault = f"has a grid of {metadata['h']}×{metadata['w']}, tokenizer {spec.name} has {h}×{w}"
        raise ShardError(place / METADATA, fault, "give the --tokenizer it was made with")
    width = robot.chunk_dim if strided else robot.action_dim
    if metadata["action_dim"] != width:
        fault = f"has {metadata['action_dim']} action values, embodiment {robot.id} has {width}"
        raise ShardError(place / METADATA, fault, "give the embodiment it was recorded with")
    channels = spec.channels or 1
    shape: tuple[int, ...] = (h, w)
    if spec.kind == "continuous":
        shape = (h, w, channels) if spec.dtype == "uint8" else (channels, h, w)
    dtype = str(metadata.get("token_dtype", video_dtype(spec)))
    allowed = ("uint16", "uint32") if spec.kind == "discrete" else (str(np.dtype(video_dtype(spec))),)
    if dtype not in allowed:
        fault = f"token_dtype is {dtype!r}, of {spec.name} it is {' or '.join(allowed)}"
        raise ShardError(place / METADATA, fault)
    video = _map(place / VIDEO, dtype, (rows, *shape))
    columns: dict[str, NDArray[Any]] = {
        token_column(spec)[0]: _channels_first(video) if spec.dtype == "uint8" else video,
        "action": _map_actions(place, rows, width),
    }
    segments = np.asarray(_map(place / SEGMENTS, "<i4", (rows,)))
    if (np.diff(segments) < 0).any():
        raise ShardError(place / SEGMENTS, "its episode numbers go back", "give a folder written in order")
    starts = np.concatenate([[0], np.flatnonzero(np.diff(segments)) + 1, [rows]]).astype(np.int64)
    columns |= _extra_columns(place, robot, starts, strided)
    return Mapped(place, metadata, columns, starts, _episode_rows(place, split, starts, segments))


def _channels_first(video: NDArray[Any]) -> NDArray[Any]:
    return video.transpose(0, 3, 1, 2)


def _map(path: Path, dtype: str, shape: tuple[int, ...]) -> NDArray[Any]:
    expected = int(np.prod(shape, dtype=np.int64)) * np.dtype(dtype).itemsize
    try:
        size = path.stat().st_size
        if size != expected:
            fault = f"has {size:,} bytes, {METADATA} implies {expected:,} ({dtype} {shape})"
            raise ShardError(path, fault, "it was not written to its end, or belongs to another folder")
        return np.memmap(path, dtype, mode="r", shape=shape)
    except OSError as fault:
        raise ShardError(path, f"cannot be read: {fault.strerror or fault}") from fault


def _map_actions(place: Path, rows: int, width: int) -> NDArray[Any]:
    """All files of `actions/` side by side in the order of their names, as the paper's loader reads them."""
    paths = sorted((place / "actions").iterdir()) if (place / "actions").is_dir() else []
    if not paths:
        raise ShardError(place / "actions", "holds no files", "this data has no actions to convert")
    widths = [path.stat().st_size // (4 * rows) for path in paths]
    if sum(widths) != width:
        raise ShardError(place / "actions", f"has {sum(widths)} values a row, {METADATA} says {width}")
    files = [_map(path, "<f4", (rows, n)) for path, n in zip(paths, widths)]
    return files[0] if len(files) == 1 else np.concatenate(files, axis=1)


def _extra_columns(
    place: Path, robot: Embodiment, starts: NDArray[np.int64], strided: bool
) -> dict[str, NDArray[Any]]:
    """Times, states and masks: as they were exported, or what follows from the rate."""
    rows = int(starts[-1])
    widths = {"timestamp": (), "state": (robot.state.dims,) if robot.state else None}
    names = ["timestamp", *(["state"] if robot.state else []), *mask_columns(robot)]
    found: dict[str, NDArray[Any]] = {}
    for name in names:
        path = place / EXTRA / f"{name}.bin"
        if path.is_file():
            found[name] = _map(path, EXTRA_DTYPES[name], (rows, *(widths.get(name) or ())))
    if "timestamp" not in found:
        within = np.arange(rows) - np.repeat(starts[:-1], np.diff(starts))
        hz = robot.rate_hz / (robot.stride if strided else 1)
        found["timestamp"] = within / hz
    if robot.state and "state" not in found:
        raise ShardError(
            place, f"has no states, embodiment {robot.id} has", "give an embodiment without a state"
        )
    return found


def _episode_rows(
    place: Path, split: str, starts: NDArray[np.int64], segments: NDArray[np.int32]
) -> list[EpisodeRow]:
    path = place / EXTRA / "episodes.parquet"
    lengths = np.diff(starts)
    if path.is_file():
        try:
            rows = [EpisodeRow(**row) for row in pq.read_table(path).to_pylist()]
        except (OSError, pa.ArrowException, TypeError) as fault:
            raise ShardError(path, f"cannot be read: {fault}", "export again") from fault
        if [row.length for row in rows] != lengths.tolist():
            raise ShardError(path, f"does not fit {SEGMENTS}", "export again")
        return [replace(row, split=row.split if split else "") for row in rows]
    blank = EpisodeRow(0, "", split, "", 0, 0, 0, "", None, "", 0.0, 0.0, 0.0, "{}", 0, "")
    ids = segments[starts[:-1]]
    prefix = f"{split}-" if split else ""
    return [
        replace(blank, episode_index=number, id=f"{prefix}segment-{name:06d}", rows=int(n), length=int(n))
        for number, (name, n) in enumerate(zip(ids, lengths))
    ]
