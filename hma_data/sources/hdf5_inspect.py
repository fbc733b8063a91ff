"""What is in HDF5 recordings, without an embodiment: keys, lengths, what looks wrong."""

from collections.abc import Iterator
from typing import Any

import h5py
import numpy as np

from hma_data.errors import EpisodeError, HMAError
from hma_data.sources.base import Inspection, KeyInfo
from hma_data.sources.hdf5 import as_rgb, encoded, environment, picture_kind
from hma_data.sources.hdf5_file import OpenFiles, explained, numbers, rows, walk
from hma_data.sources.hdf5_layout import Place, Places
from hma_data.video import decode_image

LENGTHS, COMPARED, SHOWN = (
    1_000,
    50,
    5,
)  # episodes whose length is told, whose keys are compared; problems a kind
_LARGEST_NUMBERS = 10_000_000


def inspect(uri: str, places: Places, files: OpenFiles) -> Inspection:
    """See Source.inspect.

    Raises:
        SourceError: nothing that can be read.
    """
    found = places.all(uri)
    keys: dict[str, KeyInfo] = {}
    lengths: list[int] = []
    problems: list[str] = []
    facts: dict[str, Any] = {}
    damaged = 0
    for i, (episode_id, place) in enumerate(found.items()):
        if i >= LENGTHS:
            break
        try:
            with explained(place):
                group = places.group(place)
                sizes = {key: item.shape[0] for key, item in walk(group) if item.shape}
                lengths.append(_length(sizes))
                if not keys:
                    facts = environment(files.get(place.file))
                    keys = {info.key: info for info in _keys(group, place, facts.get("control_freq"))}
                    problems += _value_problems(group, keys, str(place))
                if i < COMPARED:
                    problems += _shape_problems(episode_id, sizes, keys)
        except HMAError as fault:
            damaged += 1
            problems += [str(fault)] if damaged <= SHOWN else []
    if damaged > SHOWN:
        problems.append(f"{damaged} of the first {min(len(found), LENGTHS):,} episodes cannot be read")
    rate = facts.get("control_freq")
    robots = facts.get("robots")
    return Inspection(
        format="hdf5",
        uri=uri,
        episodes=len(found),
        keys=tuple(keys.values()),
        frames=sum(lengths) if len(lengths) == len(found) else None,
        lengths=tuple(lengths),
        hz=float(rate) if isinstance(rate, int | float) else None,
        robot=robots if isinstance(robots, str) else ", ".join(map(str, robots)) if robots else None,
        problems=tuple(problems),
        facts={"environment": str(facts["env_name"])} if "env_name" in facts else {},
    )


def _length(sizes: dict[str, int]) -> int:
    """The rows most keys agree on."""
    for key in ("actions", "action"):
        if key in sizes:
            return sizes[key]
    return max(sizes.values(), key=list(sizes.values()).count, default=0)


def _keys(group: h5py.Group, place: Place, rate: Any) -> Iterator[KeyInfo]:
    hz = float(rate) if isinstance(rate, int | float) else None
    for key, item in walk(group):
        count = item.shape[0] if item.shape else None
        kind, shape, codec = _kind(item, f"{place} {key}")
        yield KeyInfo(key, kind, shape, str(item.dtype), hz if count else None, codec=codec, count=count)


def _kind(item: h5py.Dataset, where: str) -> tuple[str, tuple[int, ...], str | None]:
    """Kind, shape of one sample, codec."""
    shape = item.shape or ()
    pictures = picture_kind(item) if shape and shape[0] else None
    if pictures == "raw":
        return "camera", as_rgb(rows(item, [0])).shape[1:], "raw"
    if pictures == "encoded":
        first = rows(item, [0])[0]
        start = bytes(encoded(first)[:8]) if isinstance(first, bytes | np.ndarray | np.void) else b""
        codec = "jpeg" if start[:2] == b"\xff\xd8" else "png" if start[:4] == b"\x89PNG" else None
        if codec:
            return "camera", decode_image(encoded(first), where).shape, codec
    if item.dtype.kind in "OS":
        return "text", shape[1:], None
    if item.dtype.kind in "fiub" and 1 <= len(shape) <= 3:
        return "vector", shape[1:] or (1,), None
    return "other", shape[1:], None


def _shape_problems(episode_id: str, sizes: dict[str, int], keys: dict[str, KeyInfo]) -> list[str]:
    """Keys one episode has and another lacks, and series of different length."""
    length = _length(sizes)
    series = {key for key, info in keys.items() if info.kind in ("camera", "vector")}
    odd = [f"{key} has {sizes[key]}" for key in sorted(series & set(sizes)) if sizes[key] != length]
    absent = sorted(series - set(sizes))
    found = [f"{episode_id}: has no {', '.join(absent)}"] if absent else []
    return found + ([f"{episode_id}: of {length} frames, {', '.join(odd[:8])}"] if odd else [])


def _value_problems(group: h5py.Group, keys: dict[str, KeyInfo], where: str) -> list[str]:
    """Numbers of the first episode that are not finite, and actions that never change."""
    found = []
    for key, info in keys.items():
        if info.kind != "vector" or np.prod(info.shape, dtype=float) * (info.count or 0) > _LARGEST_NUMBERS:
            continue
        try:
            values = numbers(group, key, where).reshape(info.count or 0, -1)
        except EpisodeError as fault:
            found.append(str(fault))
            continue
        if values.dtype.kind == "f" and not np.isfinite(values).all():
            found.append(f"{where}: {key} holds values that are not finite")
        if key.rsplit("/", 1)[-1] in ("action", "actions") and len(values) > 1:
            still = np.flatnonzero((values == values[0]).all(axis=0))
            if len(still):
                found.append(f"{where}: {key} never changes in dims {', '.join(map(str, still))}")
    return found
