"""What is in HDF5 recordings, without an embodiment: keys, lengths, what looks wrong."""

import math
import re
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import h5py
import numpy as np

from hma_data.errors import EpisodeError, HMAError
from hma_data.sources.base import Inspection, KeyInfo
from hma_data.sources.facts import one_channel, seconds_a_unit
from hma_data.sources.findings import Finding
from hma_data.sources.hdf5 import TEXT_KEYS, as_rgb, encoded, environment, picture_kind
from hma_data.sources.hdf5_file import OpenFiles, child, explained, numbers, rows, text, walk
from hma_data.sources.hdf5_layout import WHOLE_FILE, Place, Places
from hma_data.video import decode_image

LENGTHS, COMPARED, SHOWN = (
    1_000,
    50,
    5,
)  # episodes whose length is told, whose keys are compared; problems a kind
_LARGEST_NUMBERS = 10_000_000
_TIMES = re.compile(r"(.*/)?(time_?stamps?|times?|stamps?|t)(_s|_sec|_ns)?")
_RATES = ("control_freq", "control_frequency", "frequency_hz", "frequency", "fps", "hz", "rate")
_SIMULATORS = {1: "robosuite", 2: "gym", 3: "iGibson"}  # robomimic's env_args.type


def inspect(uri: str, places: Places, files: OpenFiles, episodes: int) -> Inspection:
    """See Source.inspect.

    Raises:
        SourceError: nothing that can be read.
    """
    found = places.all(uri)
    keys: dict[str, KeyInfo] = {}
    lengths: list[int] = []
    problems: list[str] = []
    facts: dict[str, str] = {}
    rate: float | None = None
    robots: Any = None
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
                    said = environment(files.get(place.file))
                    robots = said.get("robots")
                    keys = {info.key: info for info in _keys(group, place)}
                    facts = _facts(group, said, place)
                    rate, facts["rate"], facts["timestamps"] = _rate(group, said, keys, str(place))
                    problems += _value_problems(group, keys, str(place))
                if i < COMPARED:
                    problems += _shape_problems(episode_id, sizes, keys)
        except HMAError as fault:
            damaged += 1
            problems += [str(fault)] if damaged <= SHOWN else []
    if damaged > SHOWN:
        problems.append(f"{damaged} of the first {min(len(found), LENGTHS):,} episodes cannot be read")
    keys = {key: replace(info, hz=rate if info.count else None) for key, info in keys.items()}
    return Inspection(
        format="hdf5",
        uri=uri,
        episodes=len(found),
        keys=tuple(keys.values()),
        frames=sum(lengths) if len(lengths) == len(found) else None,
        lengths=tuple(lengths),
        hz=rate,
        robot=robots if isinstance(robots, str) else ", ".join(map(str, robots)) if robots else None,
        findings=tuple(Finding("recording", "warn", said) for said in problems),
        facts={name: fact for name, fact in facts.items() if fact},
    )


def _length(sizes: dict[str, int]) -> int:
    """The rows most keys agree on."""
    for key in ("actions", "action"):
        if key in sizes:
            return sizes[key]
    return max(sizes.values(), key=list(sizes.values()).count, default=0)


def _facts(group: h5py.Group, said: dict[str, Any], place: Place) -> dict[str, str]:
    """What is worth a line: the simulator and its controller, where episodes and words are."""
    data = child(group.file, "data")
    words = (name for name in TEXT_KEYS if name in group.attrs and text(group.attrs[name]))
    simulated = [group.attrs.get("sim"), group.file.attrs.get("sim")]
    simulator = ""
    if any(isinstance(value, bool | np.bool_) and value for value in simulated):
        simulator = "the attribute sim"
    elif isinstance(kind := said.get("type"), int) and kind in _SIMULATORS:
        simulator = f"{_SIMULATORS[kind]}, by env_args"
    elif "model_file" in group.attrs or (isinstance(data, h5py.Group) and "env_info" in data.attrs):
        simulator = "robosuite, by its attributes"
    return {
        "environment": str(said.get("env_name") or ""),
        "simulator": simulator,
        "controller": _controller(said),
        "layout": "one file an episode" if place.group == WHOLE_FILE else "",
        "instruction": next(words, ""),
    }


def _controller(said: dict[str, Any]) -> str:
    """robosuite's, e.g. OSC_POSE; with `absolute` where it takes poses, not changes of them."""
    found: Any = said.get("controller_configs")
    if isinstance(found, list) and found:
        found = found[0]
    parts = found.get("body_parts") if isinstance(found, dict) else None
    if isinstance(parts, dict):  # since robosuite 1.5
        arms = [part for part in parts.values() if isinstance(part, dict) and "type" in part]
        found = next(iter(arms), None)
    if not isinstance(found, dict) or not isinstance(found.get("type"), str):
        return ""
    absolute = found.get("control_delta") is False or found.get("input_type") == "absolute"
    return f"{found['type']} absolute" if absolute else str(found["type"])


def _rate(
    group: h5py.Group, said: dict[str, Any], keys: dict[str, KeyInfo], where: str
) -> tuple[float | None, str, str]:
    """Hz, what says so, and the key of times in seconds where there is one."""
    stated, holder = _stated_rate(group, said)
    key = next((key for key, info in keys.items() if _is_times(key, info)), None)
    if key is None:
        return stated, holder, ""
    values = numbers(group, key, where).reshape(-1)
    unit = seconds_a_unit(values) if values.dtype.kind in "fiu" else None
    if unit is None:
        return stated, holder, ""
    measured = 1 / (float(np.median(np.diff(values.astype(np.float64)))) * unit)
    seconds = key if unit == 1.0 else ""
    return (stated, holder, seconds) if stated else (measured, f"measured from {key}", seconds)


def _is_times(key: str, info: KeyInfo) -> bool:
    return info.kind == "vector" and info.shape == (1,) and bool(_TIMES.fullmatch(key.lower()))


def _stated_rate(group: h5py.Group, said: dict[str, Any]) -> tuple[float | None, str]:
    places: list[tuple[str, Any]] = [("the file's env_args", said)]
    holders = (group, group.parent, group.file)
    places += [(f"the attributes of {holder.name}", holder.attrs) for holder in holders]
    for place, holder in places:
        for name in _RATES:
            value = holder.get(name)
            number = value.item() if isinstance(value, np.generic) else value
            if isinstance(number, int | float) and not isinstance(number, bool) and 0 < number < math.inf:
                return float(number), f"{name} in {place}"
    return None, ""


def _keys(group: h5py.Group, place: Place) -> Iterator[KeyInfo]:
    for key, item in walk(group):
        count = item.shape[0] if item.shape else None
        kind, shape, codec = _kind(item, f"{place} {key}")
        yield KeyInfo(key, kind, shape, str(item.dtype), codec=codec, count=count)


def _kind(item: h5py.Dataset, where: str) -> tuple[str, tuple[int, ...], str | None]:
    """Kind, shape of one sample, codec."""
    shape = item.shape or ()
    pictures = picture_kind(item) if shape and shape[0] else None
    if pictures == "raw":
        shape = as_rgb(rows(item, [0])).shape[1:]
        return "camera", (*shape[:2], 1) if _is_grey(item.shape) else shape, "raw"
    if pictures == "encoded":
        first = rows(item, [0])[0]
        start = bytes(encoded(first)[:8]) if isinstance(first, bytes | np.ndarray | np.void) else b""
        codec = "jpeg" if start[:2] == b"\xff\xd8" else "png" if start[:4] == b"\x89PNG" else None
        if codec:
            shape = decode_image(encoded(first), where).shape
            return "camera", (*shape[:2], 1) if one_channel(bytes(encoded(first))) else shape, codec
    if item.dtype.kind in "OS":
        return "text", shape[1:], None
    if item.dtype.kind in "fiub" and 1 <= len(shape) <= 3:
        return "vector", shape[1:] or (1,), None
    return "other", shape[1:], None


def _is_grey(shape: tuple[int, ...]) -> bool:
    """Of raw pictures (T, H, W), (T, H, W, C) or (T, C, H, W)."""
    return len(shape) == 3 or (shape[3] if shape[3] in (1, 3, 4) else shape[1]) == 1


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
