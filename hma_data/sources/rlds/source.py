"""Read RLDS / Open X-Embodiment datasets: TFDS folders, without TensorFlow.

An episode is one record, a tf.train.Example whose `steps/…` features run over the steps. The keys of an
embodiment are paths inside a step (`observation/image`, `action/world_vector`). An episode's id is its split
and its index in the split (`train/000012`). Numbers are decoded when an episode is read, pictures on demand.

T steps, H×W pixels.
"""

import hashlib
import logging
import math

from hma_data.episodes.episode import Episode, Floats, Pictures, Signal, rate_times
from hma_data.errors import EpisodeError, SourceError
from hma_data.registry.components import Component, Vector
from hma_data.registry.embodiment import Embodiment
from hma_data.sources.base import SAMPLE, EpisodeRef, Inspection, compose
from hma_data.sources.rlds.folder import Folder, Shard, episode_id, open_folder
from hma_data.sources.rlds.steps import (
    Steps,
    described,
    instruction,
    is_camera,
    listed,
    metadata,
    step_feature,
    success,
    text_feature,
)
from hma_data.sources.rlds.tf_example import Example
from hma_data.storage.fetch import info, mark
from hma_data.storage.paths import StrPath, as_text

SAMPLED_SHARDS, SAMPLED_REMOTE = 16, 2  # shards whose first record is read to estimate lengths

log = logging.getLogger(__name__)


def open() -> "RldsSource":
    """Return the source; see `hma_data.sources.base.Source`."""
    return RldsSource()


class RldsSource:
    """Read TFDS folders in the RLDS form."""

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
            check_keys(folder, embodiment)
        if wanted and wanted not in folder.splits:
            raise SourceError(uri, f"has no split {wanted!r}", f"its splits: {', '.join(folder.splits)}")
        for problem in folder.problems:
            log.warning("%s: %s", uri, problem)
        names = [wanted] if wanted else list(folder.splits)
        refs = []
        for name in names:
            own = None if len(names) == 1 else "train" if name == "train" else "val"
            rate = steps_per_byte(folder, name)
            for shard in folder.splits[name]:
                refs += _refs(folder, name, shard, own, rate)
        if not any(ref.fingerprint for ref in refs):
            raise SourceError(
                uri, "holds no readable episode", "its files are empty or damaged; copy them again"
            )
        return refs

    def read(self, uri: StrPath, episode_id: str, embodiment: Embodiment) -> Episode:
        """See Source.

        Raises:
            SourceError: the dataset cannot be read, or the embodiment's keys are not there.
            EpisodeError: this episode is damaged, or not as features.json says.
        """
        folder = open_folder(as_text(uri))
        check_keys(folder, embodiment)
        example, path = folder.example(episode_id)
        steps = Steps(folder, example, episode_id)
        hz = embodiment.frequency_hz
        times = rate_times(steps.count, hz if isinstance(hz, float) else embodiment.rate_hz)
        return Episode(
            id=episode_id,
            streams={
                camera.name: Pictures(times, steps.decoder(camera.key)) for camera in embodiment.cameras
            },
            actions=_signals(steps, embodiment.action, times),
            states=_signals(steps, embodiment.state, times),
            instruction=instruction(folder, steps, embodiment.source.instruction),
            success=success(folder, steps),
            source=path,
            metadata=metadata(folder, example),
        )

    def inspect(self, uri: StrPath, episodes: int = SAMPLE) -> Inspection:
        """See Source.

        Raises:
            SourceError: nothing readable there.
        """
        from hma_data.sources.rlds.inspect import inspect

        return inspect(as_text(uri), self.index(uri), episodes)


def _refs(folder: Folder, split: str, shard: Shard, own: str | None, rate: float) -> list[EpisodeRef]:
    """Return the episodes of a shard; an episode that is cut off or missing has no fingerprint."""
    if folder.remote and shard.records:
        return _remote_refs(folder, split, shard, own, rate)
    frames = folder.framing(shard)
    refs = []
    for position in range(folder.counted(shard)):
        there = position < len(frames)
        estimate = round(rate * int(frames.lengths[position])) if there else 1
        fingerprint = frames.fingerprint(position) if there else ""
        refs.append(EpisodeRef(episode_id(split, shard.first + position), max(1, estimate), own, fingerprint))
    return refs


def _remote_refs(folder: Folder, split: str, shard: Shard, own: str | None, rate: float) -> list[EpisodeRef]:
    """Return the episodes of a remote shard from its size and mark alone; no record is read."""
    found = info(folder.files, shard.path)
    folder.believe(shard, found["size"])
    fingerprint = hashlib.sha256(mark(found).encode()).hexdigest()[:24]
    records = shard.records or 1
    frames = max(1, round(rate * found["size"] / records))
    return [
        EpisodeRef(episode_id(split, shard.first + position), frames, own, fingerprint)
        for position in range(records)
    ]


def steps_per_byte(folder: Folder, split: str) -> float:
    """Return steps a byte, from the first record of some of a split's shards; 0 when none can be read."""
    shards = folder.splits[split]
    steps = size = 0
    sampled = SAMPLED_REMOTE if folder.remote else SAMPLED_SHARDS
    for shard in shards[:: math.ceil(len(shards) / sampled)]:
        name = episode_id(split, shard.first)
        try:
            if not len(folder.framing(shard, 1)):
                continue
            data = folder.records(shard).read(0, name)
            steps += Steps(folder, Example(data, name), name).count
            size += len(data)
        except EpisodeError as fault:
            log.warning("%s: %s", folder.uri, fault)  # reading it fails again, and it is quarantined
    return steps / size if size else 0.0


# -- the embodiment's keys


def check_keys(folder: Folder, embodiment: Embodiment) -> None:
    """Check that features.json has the embodiment's keys, with the stated widths.

    Raises:
        SourceError: a key is missing, of another kind, or of another width.
    """
    pictures = [key for key, feature in folder.step_features.items() if is_camera(feature)]
    for camera in embodiment.cameras:
        feature = step_feature(folder, camera.key)
        if camera.key not in pictures:
            raise SourceError(
                folder.uri,
                f"{camera.key} is {described(feature)} of {feature.dtype}, not a colour picture",
                f"its pictures: {listed(pictures)}",
            )
    parts = embodiment.action.components + (embodiment.state.components if embodiment.state else ())
    for part in parts:
        _check_component(folder, part)
    if embodiment.source.instruction:
        text_feature(folder, embodiment.source.instruction)


def _check_component(folder: Folder, part: Component) -> None:
    feature = step_feature(folder, part.key)
    if feature.kind != "number":
        raise SourceError(folder.uri, f"{part.key} is {described(feature)} of {feature.dtype}, not numbers")
    wanted = part.slice[1] if part.slice else part.dims
    if feature.width is not None and (feature.width < wanted or (not part.slice and feature.width > wanted)):
        raise SourceError(
            folder.uri,
            f"{part.key} has {feature.width} values a step, the embodiment says {wanted}",
            "correct dims or give slice in the YAML",
        )


def _signals(steps: Steps, vector: Vector | None, times: Floats) -> tuple[Signal, ...]:
    if vector is None:
        return ()
    found = {key: steps.numbers(key) for key in dict.fromkeys(part.key for part in vector.components)}
    pieces = [found[part.key] for part in vector.components]
    return (Signal(times, compose(vector, pieces, steps.name)),)
