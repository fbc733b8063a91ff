"""Read RLDS / Open X-Embodiment datasets: TFDS folders, without TensorFlow.

An episode is one record, a tf.train.Example whose `steps/…` features run over the steps. The keys of an
embodiment are paths inside a step (`observation/image`, `action/world_vector`). An episode's id is its split
and its index in the split (`train/000012`). Numbers are decoded when an episode is read, pictures on demand.

T steps.
"""

import hashlib
import logging
import math
from difflib import get_close_matches
from typing import Any

from hma_data.episodes.episode import Episode, Floats, Pictures, Signal, rate_times
from hma_data.errors import EpisodeError, SourceError
from hma_data.registry.components import Component, Vector
from hma_data.registry.embodiment import Embodiment
from hma_data.sources.base import SAMPLE, EpisodeRef, Inspection, compose
from hma_data.sources.rlds.features import Feature, Steps, scalar
from hma_data.sources.rlds.folder import Folder, Shard, episode_id, open_folder
from hma_data.sources.rlds.tf_example import Example
from hma_data.storage.fetch import info, mark
from hma_data.storage.paths import StrPath, as_text

SAMPLED_SHARDS, SAMPLED_REMOTE = 16, 2  # shards whose first record is read to estimate lengths
INSTRUCTIONS = ("language_instruction", "natural_language_instruction")
MAX_VECTOR = 4096  # most values of an action or a state

log = logging.getLogger(__name__)


class RldsSource:
    """A reader of TFDS folders in the RLDS form."""

    def episode_ids(self, uri: StrPath) -> list[str]:
        """See Source."""
        return [ref.id for ref in self.index(uri)]

    def index(self, uri: StrPath, embodiment: Embodiment | None = None) -> list[EpisodeRef]:
        """See Source. Frames are estimated from the records' bytes.

        With `source.split`, only that split is indexed and refs carry no split. They carry none either where
        the dataset has only one split. Otherwise `train` becomes "train" and every other split "val".

        Raises:
            SourceError: nothing readable is there, no such split, or the embodiment's keys are not there.
        """
        uri = as_text(uri)
        folder = open_folder(uri)
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
                refs += (_remote_refs if folder.remote and shard.stated else _refs)(name, shard, own, rate)
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
        folder = open_folder(as_text(uri))
        _check_keys(folder, embodiment)
        example, path = folder.example(episode_id)
        steps = Steps(example, folder.step_features, episode_id)
        hz = embodiment.frequency_hz
        times = rate_times(steps.count, hz if isinstance(hz, float) else embodiment.rate_hz)
        cameras = {camera.name: steps.decoder(camera.key) for camera in embodiment.cameras}
        return Episode(
            id=episode_id,
            streams={name: Pictures(times, decode) for name, decode in cameras.items()},
            actions=_signals(steps, embodiment.action, times),
            states=_signals(steps, embodiment.state, times),
            instruction=_instruction(folder, steps, embodiment.source.instruction),
            success=_success(folder, steps),
            source=path,
            metadata=_metadata(folder, example),
        )

    def inspect(self, uri: StrPath, episodes: int = SAMPLE) -> Inspection:
        """See Source.

        Raises:
            SourceError: nothing readable there.
        """
        from hma_data.sources.rlds.inspect import inspect

        return inspect(as_text(uri), self.index(uri), episodes)


open = RldsSource


def _refs(split: str, shard: Shard, own: str | None, rate: float) -> list[EpisodeRef]:
    """Return the episodes of a shard; an episode that is cut off or missing has no fingerprint."""
    frames = shard.framing()
    refs = []
    for position in range(shard.count()):
        there = position < len(frames)
        estimate = round(rate * int(frames.lengths[position])) if there else 1
        fingerprint = frames.fingerprint(position) if there else ""
        refs.append(EpisodeRef(episode_id(split, shard.first + position), max(1, estimate), own, fingerprint))
    return refs


def _remote_refs(split: str, shard: Shard, own: str | None, rate: float) -> list[EpisodeRef]:
    """Return the episodes of a remote shard from its size and mark alone; no record is read."""
    found = info(shard.files, shard.path)
    fingerprint = hashlib.sha256(mark(found).encode()).hexdigest()[:24]
    records = shard.stated or 1
    frames = max(1, round(rate * found["size"] / records))
    ids = (episode_id(split, shard.first + position) for position in range(records))
    return [EpisodeRef(name, frames, own, fingerprint) for name in ids]


def _steps_per_byte(folder: Folder, split: str) -> float:
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


def is_camera(feature: Feature) -> bool:
    """Check whether a feature holds a colour picture a step, encoded or as a tensor."""
    if feature.dtype != "uint8" or len(feature.nesting) != 1:
        return False
    colours = feature.kind == "number" and len(feature.shape) == 3 and feature.shape[2] == 3
    return feature.kind == "picture" or colours


def _check_keys(folder: Folder, embodiment: Embodiment) -> None:
    """Raise a SourceError where features.json lacks a key of the embodiment, or has it with another width."""
    for camera in embodiment.cameras:
        feature = _step_feature(folder, camera.key)
        if not is_camera(feature):
            pictures = [key for key, found in folder.step_features.items() if is_camera(found)]
            fault = f"{camera.key} is {_described(feature)} of {feature.dtype}, not a colour picture"
            raise SourceError(folder.uri, fault, f"its pictures: {', '.join(pictures) or 'none'}")
    for part in embodiment.action.components + (embodiment.state.components if embodiment.state else ()):
        _check_component(folder, part)
    if embodiment.source.instruction:
        _text_feature(folder, embodiment.source.instruction)


def _check_component(folder: Folder, part: Component) -> None:
    feature = _step_feature(folder, part.key)
    if feature.kind != "number":
        raise SourceError(folder.uri, f"{part.key} is {_described(feature)} of {feature.dtype}, not numbers")
    wanted = part.slice[1] if part.slice else part.dims
    if feature.width is not None and (feature.width < wanted or (not part.slice and feature.width > wanted)):
        fault = f"{part.key} has {feature.width} values a step, the embodiment says {wanted}"
        raise SourceError(folder.uri, fault, "correct dims or give slice in the YAML")


def _step_feature(folder: Folder, key: str) -> Feature:
    """Return the feature at a path inside a step; name the nearest keys where there is none."""
    found = folder.step_features
    if key in found:
        return found[key]
    near = get_close_matches(key, found, n=3) or [name for name in found if name.endswith("/" + key)]
    remedy = f"did you mean {', '.join(near)}?" if near else f"its keys: {', '.join(found) or 'none'}"
    raise SourceError(folder.uri, f"has no key {key!r} in its steps", remedy)


def _text_feature(folder: Folder, key: str) -> Feature:
    """Return the feature of the instruction, from inside the steps or from the whole episode."""
    inside = key in folder.step_features or key not in folder.features
    feature = _step_feature(folder, key) if inside else folder.features[key]
    if feature.kind == "text":
        return feature
    if inside and feature.kind == "number" and feature.dtype.startswith(("int", "uint")):  # codes of letters
        return feature
    raise SourceError(folder.uri, f"source.instruction: {key} is {_described(feature)}, not text")


def _described(feature: Feature) -> str:
    if feature.kind == "picture":
        return "a sequence of pictures a step" if len(feature.nesting) > 1 else "a picture"
    return {"number": "a tensor", "text": "text"}.get(feature.kind, "a feature")


# -- one episode


def _signals(steps: Steps, vector: Vector | None, times: Floats) -> tuple[Signal, ...]:
    if vector is None:
        return ()
    found = {key: steps.numbers(key) for key in dict.fromkeys(part.key for part in vector.components)}
    pieces = [found[part.key] for part in vector.components]
    return (Signal(times, compose(vector, pieces, steps.name)),)


def _instruction(folder: Folder, steps: Steps, key: str | None) -> str:
    """Return the instruction of the first step."""
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


def _success(folder: Folder, steps: Steps) -> bool | None:
    """Return the stated success; without one, True where the last step is terminal and has a reward > 0."""
    stated = folder.features.get("episode_metadata/success")
    if stated:
        value = scalar(steps.example, stated)
        return bool(value) if isinstance(value, bool | int) else None
    if any(key not in steps.features for key in ("reward", "is_terminal")):
        return None
    ends = [steps.numbers(key)[-1] for key in ("reward", "is_terminal")]
    return True if all(end.size == 1 and end > 0 for end in ends) else None


def _metadata(folder: Folder, example: Example) -> dict[str, Any]:
    found = {
        name.removeprefix("episode_metadata/"): scalar(example, feature)
        for name, feature in folder.features.items()
        if not name.startswith("steps/")
    }
    return {name: value for name, value in found.items() if value is not None}
