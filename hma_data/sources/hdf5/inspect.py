"""Inspect HDF5 recordings without an embodiment: their keys, their lengths, and what looks wrong."""

import re
from collections import Counter
from collections.abc import Container, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import h5py
import numpy as np

from hma_data.arrays import Array
from hma_data.episodes.images import decode_image, image_codec
from hma_data.errors import EpisodeError, HMAError
from hma_data.registry.components import Hdf5Layout
from hma_data.sources.common import checks
from hma_data.sources.common.checks import Finding, is_times, seconds_a_unit
from hma_data.sources.common.inspection import Inspection, KeyInfo
from hma_data.sources.common.places import local_path
from hma_data.sources.common.survey import MAX_LENGTHS, MAX_VALUES, Series, Survey, listed
from hma_data.sources.hdf5.file import (
    TEXT_KEYS,
    WHOLE_FILE,
    EpisodeFinder,
    EpisodeGroup,
    RecordedRows,
    dataset,
    explained,
    inside,
    is_plausible,
    is_single,
    json_of,
    masks_of,
    numbers,
    rows,
    text,
    walk,
)
from hma_data.sources.hdf5.images import CHANNELS, ImageRows, encoded, image_kind, pixels_of
from hma_data.sources.hdf5.videos import is_video, video_keys, videos_beside

_RATES = ("control_freq", "control_frequency", "frequency_hz", "frequency", "fps", "hz", "rate")
MAX_HZ = 1e6
_ENDS = ("episode_ends", "episode_lengths", "terminals", "timeouts", "dones")  # of episodes end to end
_BESIDE = ("compress_len",)  # not rows over time: the bytes of ALOHA's JPEGs, (cameras, T)
_MEASURED = "measured from"
SIMULATORS = (1, 2, 3)  # robomimic's env_args.type: robosuite, gym, iGibson


@dataclass(frozen=True)
class _First:
    """The facts of the first readable episode, which stand for all."""

    name: str
    keys: dict[str, KeyInfo]
    facts: dict[str, str]
    pixels: dict[str, str]  # camera -> range, where it is not uint8
    rate: float | None
    robots: Any


def inspect(uri: str, finder: EpisodeFinder, episodes: int, pattern: str | None = None) -> Inspection:
    """See Source.inspect; `pattern` names the groups that are episodes, by default the file shows it.

    Raises:
        SourceError: nothing can be read.
    """
    found = finder.all(uri, pattern)
    order = list(found)
    survey, first = Survey(len(order)), _First("", {}, {}, {}, None, None)
    chosen = survey.sample(order, episodes)
    survey.links(local_path(uri))
    lengths: dict[str, int] = {}
    held: Counter[str] = Counter()
    for name in dict.fromkeys([*order[:MAX_LENGTHS], *chosen]):
        place = found[name]
        with survey.reading(name), explained(place):
            group = finder.group(place)
            sizes = {key: item.shape[0] for key, item in walk(group) if item.shape}
            recorded = RecordedRows(group, _length(sizes))
            lengths[name] = recorded.rows
            if not lengths[name]:
                raise EpisodeError(name, "has no frames")
            if unused := max(sizes.values()) - recorded.of(max(sizes.values())):
                said = f"{name}: {unused:,} rows beyond the {recorded.rows:,} that it states are left out"
                survey.note(Finding("rows", "info", said, numbers={"rows": unused}))
            sizes = {key: recorded.of(size) for key, size in sizes.items()}
            if not first.keys:
                first = _first(name, group, place)
                _end_to_end(name, group, place, survey)
            elif first.rate is None and name in chosen:  # the first one's times may be damaged
                timed = _first(name, group, place)
                first = timed if timed.rate else first
            held.update(sizes)
            series = [key for key, info in first.keys.items() if info.kind in ("camera", "vector")]
            series = [key for key in series if not is_video(key)]
            survey.lengths(name, lengths[name], sizes, series)
            if name in chosen:
                opened = partial(_series, name, place, finder, first, recorded)
                keys = {key: partial(opened, key) for key in series if key in sizes}
                measured = first.facts["rate"].startswith(_MEASURED)
                source = f"{first.name} at" if measured else "the recording states"
                survey.look(name, keys, first.rate, source)
    for file in {found[name].file for name in chosen}:
        masks: dict[str, set[str]] = {}
        with suppress(HMAError), explained(file):  # what a damaged file lacks is told of its episodes
            masks = masks_of(finder.files.get(file))
        demos = {place.group.rsplit("/", 1)[-1] for place in found.values() if place.file == file}
        for mask, names in masks.items():
            if absent := sorted(names - demos):
                said = f"mask/{mask} names {listed(absent)}, which {file.name} does not have"
                survey.note(Finding("keys", "warn", said, numbers={"demos": len(absent)}))
    lacking = [key for key, count in held.items() if key not in first.keys and 2 * count >= len(lengths)]
    if lacking:
        survey.note(Finding("keys", "warn", f"{first.name}: has no {listed(lacking)}, which others have"))
    keys_told = [replace(info, hz=first.rate if info.count else None) for info in first.keys.values()]
    robots = first.robots
    robot = robots if isinstance(robots, str) else ", ".join(map(str, robots)) if robots else None
    every = [lengths[name] for name in order if name in lengths]
    return survey.inspection("hdf5", uri, keys_told, every, first.facts, hz=first.rate, robot=robot)


def _first(name: str, group: h5py.Group, place: EpisodeGroup) -> _First:
    said, pixels = _environment(group.file), _pixels(group)
    keys = {info.key: info for info in _keys(group, place, pixels)}
    facts = _facts(group, said, place)
    facts["pixels"] = next(iter(pixels.values()), "")
    if all(info.kind != "camera" for info in keys.values()):
        facts["videos beside it"] = listed(videos_beside(place.file))
        films = video_keys(place.file) if place.group == WHOLE_FILE else ()
        keys |= {info.key: info for info in films}
    rate, facts["rate"], facts["timestamps"] = _rate(group, said, keys, str(place))
    return _First(name, keys, facts, pixels, rate, said.get("robots"))


def _end_to_end(name: str, group: h5py.Group, place: EpisodeGroup, survey: Survey) -> None:
    """Warn where a whole file is taken for one episode, but states that it holds several."""
    for key, item in walk(group) if place.group == WHOLE_FILE else ():
        last = key.rsplit("/", 1)[-1]
        if last not in _ENDS or len(item.shape or ()) != 1 or item.size > MAX_VALUES:
            continue
        ends = item[()].astype(bool)  # a run of True counts once
        count = len(item) if last.startswith("episode") else int(np.diff(ends, prepend=False)[ends].sum())
        if count > 1:
            said = f"{name} is read as one episode, but {key} marks {count:,}"
            remedy = (
                "write each as a group of its own, data/demo_0, data/demo_1, …, or windows cross their ends"
            )
            survey.note(Finding("rows", "warn", said, remedy, key, {"episodes": count}))
            return


def _environment(handle: h5py.File) -> dict[str, Any]:
    """Return the simulator's facts, stated by robomimic (`env_args`) or robosuite (`env_info`)."""
    data = handle.get("data")
    if not isinstance(data, h5py.Group):
        return {}
    found = json_of(data, "env_args") or json_of(data, "env_info")
    inner = found.get("env_kwargs")
    return {**found, **inner} if isinstance(inner, dict) else found


def _series(
    name: str, place: EpisodeGroup, finder: EpisodeFinder, first: _First, recorded: RecordedRows, key: str
) -> Series:
    """Return how a key of an episode is read."""
    info, group = first.keys[key], finder.group(place)
    size = dataset(group, key, name).size
    if info.kind == "camera":
        layout = Hdf5Layout.model_validate({"pixels": first.pixels.get(key)})
        images = ImageRows(finder, place, key, layout)
        return Series(None, images.each, recorded.of(images.rows), codec=info.codec)

    def values() -> Array:
        with explained(f"{name} {key}"):
            found = numbers(group, key, name)
        return found[: recorded.of(len(found))]

    return Series(values) if size <= MAX_VALUES else Series()


def _pixels(group: h5py.Group) -> dict[str, str]:
    """Return camera -> range of the colours that are not uint8, for `layout.pixels`, which is one for all."""
    found: dict[str, str] = {}
    for key, item in walk(group):
        if item.shape and item.shape[0] and is_plausible(item):
            stated = pixels_of(item, sorted({0, item.shape[0] // 2, item.shape[0] - 1}))
            found |= {key: stated} if stated else {}
    first = next(iter(found.values()), "")
    return {key: stated for key, stated in found.items() if stated == first}


def _length(sizes: dict[str, int]) -> int:
    """Return the rows of the actions; without actions, the row count that most keys share."""
    for key in ("actions", "action"):
        if key in sizes:
            return sizes[key]
    return max(sizes.values(), key=list(sizes.values()).count, default=0)


def _facts(group: h5py.Group, said: dict[str, Any], place: EpisodeGroup) -> dict[str, str]:
    """Return facts about the recording: simulator, layout, and the key of the instruction."""
    data = group.file.get("data")
    stated = [holder.attrs.get("sim") for holder in (group, group.file)]
    simulated = (
        any(isinstance(value, bool | np.bool_) and value for value in stated)
        or said.get("type") in SIMULATORS
        or "model_file" in group.attrs
        or (isinstance(data, h5py.Group) and "env_info" in data.attrs)
    )
    return {
        "environment": str(said.get("env_name") or ""),
        "simulator": "yes, by its attributes" if simulated else "",
        "layout": "one file an episode" if place.group == WHOLE_FILE else "",
        "instruction": next((name for name in TEXT_KEYS if text(group.attrs.get(name))), ""),
    }


def _rate(
    group: h5py.Group, said: dict[str, Any], keys: dict[str, KeyInfo], where: str
) -> tuple[float | None, str, str]:
    """Return Hz, what states it, and the key of times whose unit is clear; empty where there is none."""
    stated, holder = _stated_rate(group, said)
    counts = {key: info.count for key, info in keys.items() if info.count}
    rows = _length(counts)  # times of another sensor may lie beside those of the frames
    near = [key for key, count in counts.items() if abs(count - rows) <= 1 and keys[key].kind == "vector"]
    key = next((key for key in near if is_times(key, keys[key].shape)), None)
    if key is None:
        return stated, holder, ""
    buffer = numbers(group, key, where).reshape(-1)
    values = buffer[: RecordedRows(group, len(buffer)).rows]
    unit = seconds_a_unit(values, key) if values.dtype.kind in "fiu" else None
    if unit is None:
        return stated, holder, ""
    measured = 1 / (float(np.median(np.diff(values.astype(np.float64)))) * unit)
    return (stated, holder, key) if stated else (measured, f"{_MEASURED} {key}", key)


def _stated_rate(group: h5py.Group, said: dict[str, Any]) -> tuple[float | None, str]:
    """Return Hz as an attribute or a dataset of one value states it, and where; None where none does."""
    places: list[tuple[str, Any]] = [("the file's env_args", said)]
    for holder in (group, group.parent, group.file):
        single = {name: item[()] for name in _RATES if is_single(item := inside(holder, name), group)}
        places += [(f"the attributes of {holder.name}", holder.attrs), (holder.name, single)]
    for place, holder in places:
        for name in _RATES:
            if hz := _hertz(holder.get(name)):
                return hz, f"{name} in {place}"
    return None, ""


def _hertz(value: Any) -> float | None:
    """Return the rate that a number or a text such as `20 Hz` states; None where it states none."""
    if isinstance(value, np.ndarray | np.generic) and value.size == 1:
        value = value.item()
    words = re.fullmatch(r"(\d+(?:\.\d*)?) ?(hz|fps)?", text(value).lower())
    number = float(words[1]) if words else value
    is_number = isinstance(number, int | float) and not isinstance(number, bool)
    return float(number) if is_number and 0 < number < MAX_HZ else None


def _keys(group: h5py.Group, place: EpisodeGroup, pixels: Container[str]) -> Iterator[KeyInfo]:
    for key, item in walk(group):
        count = item.shape[0] if item.shape else None
        kind, shape, codec = _kind(item, f"{place} {key}", key in pixels)
        is_rate = count == 1 and key.rsplit("/", 1)[-1] in _RATES
        kind = "other" if is_rate or key in _BESIDE else kind
        yield KeyInfo(key, kind, shape, str(item.dtype), codec=codec, count=count)


def _kind(item: h5py.Dataset, where: str, has_colours: bool) -> tuple[str, tuple[int, ...], str | None]:
    """Return kind, shape of one sample, and codec; `has_colours` tells images of other numbers than uint8."""
    shape: tuple[int, ...] = item.shape or ()
    images = image_kind(item) if shape and shape[0] and is_plausible(item) else None
    if has_colours or images == "raw":
        is_last = len(shape) == 3 or shape[3] in CHANNELS
        sides = shape[1:3] if is_last else shape[2:]
        channels = 1 if len(shape) == 3 else shape[3 if is_last else 1]
        return "camera", (*sides, 1 if channels == 1 else 3), "raw"
    if images == "encoded":
        first = rows(item, [0])[0]
        if codec := image_codec(encoded(first)):
            shape = decode_image(encoded(first), where).shape
            return "camera", (*shape[:2], 1) if checks.one_channel(bytes(encoded(first))) else shape, codec
    if item.dtype.kind in "OS":
        return "text", shape[1:], None
    if item.dtype.kind in "fiub" and 1 <= len(shape) <= 3:
        return "vector", shape[1:] or (1,), None
    return "other", shape[1:], None
