"""Read RLDS / Open X-Embodiment datasets: TFDS folders, without TensorFlow.

An episode is one record, a tf.train.Example whose `steps/…` features run over the steps. The keys of an
embodiment are paths inside a step (`observation/image`, `action/world_vector`). An episode's id is its split
and its index in the split (`train/000012`). Numbers are decoded when an episode is read, images on demand.

T steps.
"""

import logging
import math
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial

import numpy as np

from hma_data.arrays import Floats
from hma_data.episodes.episode import Episode, Pictures, Signal, rate_times
from hma_data.episodes.images import image_codec
from hma_data.errors import EpisodeError, SourceError, meant
from hma_data.registry.components import Component, Vector
from hma_data.registry.embodiment import Embodiment
from hma_data.sources.base import SAMPLE, EpisodeRef, Inspection, KeyInfo, read_vector
from hma_data.sources.common.checks import Finding
from hma_data.sources.common.survey import Series, Survey
from hma_data.sources.rlds.example import Example
from hma_data.sources.rlds.features import RldsFeature, Steps, scalar
from hma_data.sources.rlds.folder import RldsFolder, Shard, episode_id, open_folder
from hma_data.sources.rlds.records import remote_state
from hma_data.storage.files import short_sha256
from hma_data.storage.paths import StrPath, as_text

SAMPLED_SHARDS, SAMPLED_REMOTE = 16, 2  # shards whose first record is read to estimate lengths
INSTRUCTIONS = ("language_instruction", "natural_language_instruction")
MAX_VECTOR = 4096  # most values of an action or a state
COUNTED_EPISODES, COUNTED_BYTES = 1000, 256 << 20  # most episodes and bytes read for their lengths

log = logging.getLogger(__name__)


class RldsSource:
    """A reader of TFDS folders in the RLDS form."""

    def __init__(self) -> None:
        self._folders: dict[str, RldsFolder] = {}

    def episode_ids(self, uri: StrPath) -> list[str]:
        """See Source."""
        return [ref.id for ref in self.index(uri)]

    def index(self, uri: StrPath, embodiment: Embodiment | None = None) -> list[EpisodeRef]:
        """See Source. Frames are counted in a small folder, else estimated from the records' bytes.

        With `source.split`, only that split is indexed and refs carry no split. They carry none either where
        the dataset has only one split. Otherwise `train` becomes "train" and every other split "val".

        Raises:
            SourceError: nothing readable is there, no such split, or the embodiment's keys are not there.
        """
        uri = as_text(uri)
        folder = self._open(uri, again=True)
        wanted = embodiment.source.split if embodiment else None
        if embodiment:
            _check_keys(folder, embodiment)
        if wanted and wanted not in folder.splits:
            raise SourceError(uri, f"has no split {wanted!r}", f"its splits: {', '.join(folder.splits)}")
        for problem in folder.problems:
            log.warning("%s: %s", uri, problem)
        names, refs = [wanted] if wanted else list(folder.splits), []
        for name in names:
            own = None if len(names) == 1 else "train" if name == "train" else "val"
            rate = _steps_per_byte(folder, name)
            for shard in folder.splits[name]:
                refs += (_remote_refs if folder.remote else _refs)(name, shard, own, rate)
        if lengths := _lengths(folder, names, refs):
            refs = [replace(ref, frames=lengths.get(ref.id, ref.frames)) for ref in refs]
        if not any(ref.fingerprint for ref in refs):
            remedy = "its files are empty or damaged; copy them again"
            raise SourceError(uri, "holds no readable episode", remedy)
        return refs

    def read(self, uri: StrPath, episode_id: str, embodiment: Embodiment) -> Episode:
        """See Source.

        Raises:
            SourceError: the dataset cannot be read, or the embodiment's keys are not there.
            EpisodeError: this episode is damaged, or not as features.json says.
        """
        folder = self._open(as_text(uri))
        _check_keys(folder, embodiment)
        example, path = folder.example(episode_id)
        steps = Steps(example, folder.step_features, episode_id)
        _require_one_episode(steps)
        keys = [part.key for part in embodiment.action.components]
        padded = _ends_with_padding(steps, keys)
        hz = embodiment.frequency_hz
        times = rate_times(steps.count - padded, hz if isinstance(hz, float) else embodiment.rate_hz)
        cameras = {camera.name: steps.decoder(camera.key) for camera in embodiment.cameras}
        return Episode(
            id=episode_id,
            streams={name: Pictures(times, decode, reduces=True) for name, decode in cameras.items()},
            actions=_signals(steps, embodiment.action, times),
            states=_signals(steps, embodiment.state, times),
            instruction=_instruction(folder, steps, embodiment.source.instruction),
            success=_success(folder, steps),
            source=path,
            metadata={"flags": {"padded_steps": int(padded)}},
        )

    def expect(self, uri: StrPath, episode_ids: Sequence[str]) -> None:
        """See `RldsFolder.expect`."""
        self._open(as_text(uri)).expect(episode_ids)

    def inspect(self, uri: StrPath, episodes: int = SAMPLE) -> Inspection:
        """See Source.

        Raises:
            SourceError: nothing readable there.
        """
        refs = self.index(uri)
        return _inspect(self._open(as_text(uri)), refs, episodes)

    def _open(self, uri: str, again: bool = False) -> RldsFolder:
        if again or uri not in self._folders:
            self._folders[uri] = open_folder(uri)
        return self._folders[uri]


open = RldsSource


def _refs(split: str, shard: Shard, own: str | None, rate: float) -> list[EpisodeRef]:
    """Return the episodes of a shard; an episode that is cut off or missing has no fingerprint."""
    frames = shard.framing()
    refs = []
    for position in range(shard.count):
        there = position < len(frames)
        estimate = round(rate * int(frames.lengths[position])) if there else 1
        fingerprint = frames.fingerprint(position) if there else ""
        refs.append(EpisodeRef(episode_id(split, shard.first + position), max(1, estimate), own, fingerprint))
    return refs


def _remote_refs(split: str, shard: Shard, own: str | None, rate: float) -> list[EpisodeRef]:
    """Return the episodes of a remote shard from its size and mark alone; no record is read."""
    size, state = remote_state(shard.path)
    fingerprint = short_sha256(state, 24)
    frames = max(1, round(rate * size / max(shard.count, 1)))
    ids = (episode_id(split, shard.first + position) for position in range(shard.count))
    return [EpisodeRef(name, frames, own, fingerprint) for name in ids]


def _lengths(folder: RldsFolder, splits: list[str], refs: list[EpisodeRef]) -> dict[str, int]:
    """Return the lengths of the readable episodes; none of a folder that is remote or too large to read."""
    if folder.remote or len(refs) > COUNTED_EPISODES:
        return {}
    shards = [shard for split in splits for shard in folder.splits[split]]
    if sum(int(shard.framing().lengths.sum()) for shard in shards) > COUNTED_BYTES:
        return {}
    lengths = {}
    for ref in refs:
        with suppress(EpisodeError):  # reading it fails again, and it is quarantined
            lengths[ref.id] = Steps(folder.example(ref.id)[0], folder.step_features, ref.id).count
    return lengths


def _steps_per_byte(folder: RldsFolder, split: str) -> float:
    """Return steps a byte, from the first record of some of a split's shards; 0 when none can be read."""
    shards = folder.splits[split]
    steps = size = 0
    sampled = SAMPLED_REMOTE if folder.remote else SAMPLED_SHARDS
    for shard in shards[:: math.ceil(len(shards) / sampled)]:
        name = episode_id(split, shard.first)
        try:
            if not len(shard.framing(1)):
                continue
            data = shard.records.read(0, name)
            steps += Steps(Example(data, name), folder.step_features, name).count
            size += len(data)
        except EpisodeError as fault:
            log.warning("%s: %s", folder.uri, fault)  # reading it fails again, and it is quarantined
    return steps / size if size else 0.0


# -- the embodiment's keys


def is_camera(feature: RldsFeature) -> bool:
    """Check whether a feature holds a colour image a step, encoded or as a tensor."""
    if feature.dtype != "uint8" or len(feature.nesting) != 1:
        return False
    colours = feature.kind == "number" and len(feature.shape) == 3 and feature.shape[2] == 3
    return feature.kind == "image" or colours


def _check_keys(folder: RldsFolder, embodiment: Embodiment) -> None:
    """Raise a SourceError where features.json lacks a key of the embodiment, or has it with another width."""
    for camera in embodiment.cameras:
        feature = _step_feature(folder, camera.key)
        if not is_camera(feature):
            images = [key for key, found in folder.step_features.items() if is_camera(found)]
            fault = f"{camera.key} holds {feature.kind} values ({feature.dtype}), not colour images"
            raise SourceError(folder.uri, fault, f"its images: {', '.join(images) or 'none'}")
    for part in embodiment.components:
        _check_component(folder, part)
    if embodiment.source.instruction:
        _text_feature(folder, embodiment.source.instruction)


def _check_component(folder: RldsFolder, part: Component) -> None:
    feature = _step_feature(folder, part.key)
    if feature.kind != "number":
        fault = f"{part.key} holds {feature.kind} values ({feature.dtype}), not numbers"
        raise SourceError(folder.uri, fault)
    wanted = part.slice[1] if part.slice else part.dims
    if feature.width is not None and (feature.width < wanted or (not part.slice and feature.width > wanted)):
        fault = f"{part.key} has {feature.width} values per step, the embodiment says {wanted}"
        raise SourceError(folder.uri, fault, "correct dims or give slice in the YAML")


def _step_feature(folder: RldsFolder, key: str) -> RldsFeature:
    """Return the feature at a path inside a step; name the nearest keys where there is none."""
    found = folder.step_features
    if key in found:
        return found[key]
    ends = [name for name in found if name.endswith("/" + key)]
    remedy = meant(key, found) or meant(key, ends, cutoff=0) or f"its keys: {', '.join(found) or 'none'}"
    raise SourceError(folder.uri, f"has no key {key!r} in its steps", remedy)


def _text_feature(folder: RldsFolder, key: str) -> RldsFeature:
    """Return the feature of the instruction, from inside the steps or from the whole episode."""
    inside = key in folder.step_features or key not in folder.features
    feature = _step_feature(folder, key) if inside else folder.features[key]
    if feature.kind == "text":
        return feature
    if inside and feature.kind == "number" and feature.dtype.startswith(("int", "uint")):  # codes of letters
        return feature
    fault = f"source.instruction: {key} holds {feature.kind} values ({feature.dtype}), not text"
    raise SourceError(folder.uri, fault)


# -- one episode


def _signals(steps: Steps, vector: Vector | None, times: Floats) -> tuple[Signal, ...]:
    if vector is None:
        return ()
    # Without the padding that a last step may have; see `_ends_with_padding`.
    values = read_vector(vector, lambda key: steps.numbers(key)[: len(times)], steps.name)
    return (Signal(times, values),)


def _require_one_episode(steps: Steps) -> None:
    """Raise EpisodeError if a record holds several episodes, one after the other."""
    if "is_first" not in steps.features:
        return
    first = steps.numbers("is_first").reshape(-1) != 0
    again = np.flatnonzero(first[1:]) + 1
    if len(again) and not first.all():
        fault = f"is_first again at step {again[0]}: the record holds {len(again) + 1} episodes"
        raise EpisodeError(steps.name, fault, "write each as a record of its own")


def _ends_with_padding(steps: Steps, keys: Iterable[str]) -> bool:
    """Check whether the action of the last step is padding.

    RLDS says that a step with `is_last` is only an observation, and leaves its action undefined: some writers
    put zeros or NaN there.
    """
    if "is_last" not in steps.features or steps.count < 2 or not steps.numbers("is_last").reshape(-1)[-1]:
        return False
    values = [steps.numbers(key).reshape(steps.count, -1) for key in dict.fromkeys(keys)]
    floats = [value for value in values if value.dtype.kind == "f"]
    if not all(np.isfinite(value[-1]).all() for value in floats):
        return all(np.isfinite(value[:-1]).all() for value in floats)
    moved = any(value[:-1].any() for value in floats)
    return moved and not any(value[-1].any() for value in floats)


def _instruction(folder: RldsFolder, steps: Steps, key: str | None) -> str:
    if key is None:
        places = [f"{place}{name}" for place in ("", "observation/") for name in INSTRUCTIONS]
        outside = [f"episode_metadata/{name}" for name in INSTRUCTIONS]
        key = next((place for place in places if place in folder.step_features), None)
        key = key or next((place for place in outside + places if place in folder.features), None)
    if key is None:
        return ""
    feature = _text_feature(folder, key)
    if key not in folder.step_features:
        return str(scalar(steps.example, feature) or "")
    if feature.kind == "text":
        return steps.text(key)
    codes = steps.numbers(key)[0].ravel()  # language_table: bytes of UTF-8, padded with zeros
    return bytes(int(code) & 0xFF for code in codes if code).decode(errors="replace")


def _success(folder: RldsFolder, steps: Steps) -> bool | None:
    """Return the stated success; without one, True where the last step is terminal and has the reward 1.

    A reward that takes other values than 0 and 1 grows on the way, and tells nothing.
    """
    stated = folder.features.get("episode_metadata/success")
    if stated:
        value = scalar(steps.example, stated)
        return bool(value) if isinstance(value, bool | int) else None
    if any(key not in steps.features for key in ("reward", "is_terminal")):
        return None
    rewards, ends = (steps.numbers(key).reshape(steps.count, -1) for key in ("reward", "is_terminal"))
    sparse = rewards.shape[1] == 1 and np.isin(rewards, (0, 1)).all()
    return True if sparse and rewards[-1] and ends[-1].all() else None


# -- inspection


def _inspect(folder: RldsFolder, refs: list[EpisodeRef], episodes: int) -> Inspection:
    """Return the inspection of a folder. The lengths are those of up to 1,000 episodes or 256 MiB.

    Raises:
        SourceError: nothing readable there.
    """
    survey = Survey(len(refs))
    survey.made |= {"files", "rows"}  # a column of another length than the episode cannot be read
    for problem in folder.problems:
        survey.note(Finding("files", "warn", problem))
    names = [ref.id for ref in refs]
    chosen = survey.sample(names, episodes)
    more = names[: 0 if folder.remote else COUNTED_EPISODES]
    lengths: dict[str, int] = {}
    first: Steps | None = None
    budget = COUNTED_BYTES
    for name in dict.fromkeys([*chosen, *more]):
        if budget < 0 and name not in chosen:
            break
        with survey.reading(name):
            steps = Steps(folder.example(name)[0], folder.step_features, name)
            _require_one_episode(steps)
            budget -= steps.example.size
            lengths[name] = steps.count
            first = first or steps
            if name in chosen:
                survey.look(name, {key: partial(_series, steps, key, survey) for key in steps.features})
    if first is None:
        found = survey.findings(())
        why = next((one for one in reversed(found) if one.check == "files"), found[0])
        raise SourceError(folder.uri, f"holds no readable episode: {why}", "copy its files again")
    keys = [_key_info(first, key, survey) for key in folder.step_features]
    splits = [f"{name} {sum(shard.count for shard in shards)}" for name, shards in folder.splits.items()]
    facts = {
        "dataset": folder.name,
        "version": folder.version,
        "splits": ", ".join(splits),
        "episode keys": ", ".join(name for name in folder.features if not name.startswith("steps/")),
    }
    in_order = [lengths[name] for name in names if name in lengths]
    return survey.inspection("rlds", folder.uri, keys, in_order, facts)


def _series(steps: Steps, key: str, survey: Survey) -> Series:
    """Return how a key of an episode is read, without padding in place of the last action."""
    feature = steps.features[key]
    if is_camera(feature):
        decode = steps.decoder(key)
        frames = lambda run: [decode(int(i)) for i in run]  # noqa: E731
        return Series(frames=frames, count=steps.count, codec=_codec(steps, key))
    if feature.kind != "number" or not 0 < (feature.width or 0) <= MAX_VECTOR:
        return Series()
    values = steps.numbers(key)
    if "action" in key and _ends_with_padding(steps, [key]):
        said = f"{key}: the action of the last step (is_last) is padding; the step is left out"
        survey.note(Finding("padding", "info", said, key=key))
        values = values[:-1]
    return Series(numbers=lambda: values)


def _key_info(steps: Steps, key: str, survey: Survey) -> KeyInfo:
    """Describe one key as this episode holds it; as features.json states it where it cannot be read."""
    feature = steps.features[key]
    shape = tuple(size or 0 for size in (*feature.nesting[1:], *feature.shape))
    kind, codec = "other", None
    try:
        if is_camera(feature):
            kind, shape, codec = "camera", steps.decoder(key)(0).shape, _codec(steps, key)
            if feature.shape[-1:] == (1,):
                shape = (*shape[:2], 1)
        elif feature.kind == "text":
            kind = "text"
        elif feature.kind == "number":
            shape = steps.numbers(key).shape[1:]
            kind = "vector" if math.prod(shape) <= MAX_VECTOR else "other"
    except EpisodeError as fault:
        if feature.kind == "number" and feature.width is None:  # may have any length: not a fault
            survey.note(Finding("rows", "info", str(fault), key=key))
        else:
            survey.fault(steps.name, fault, key)
    return KeyInfo(key, kind, shape, feature.dtype, codec=codec, count=steps.count)


def _codec(steps: Steps, key: str) -> str:
    """Return the codec of a key's first image; TFDS stores files as given, whatever is stated."""
    if steps.features[key].kind != "image":
        return "raw"
    return image_codec(steps.blobs(key)[0]) or steps.features[key].codec or "unknown"
