"""Inspect RLDS folders without an embodiment: their keys, their lengths, and what looks wrong."""

import math

from hma_data.errors import EpisodeError, SourceError
from hma_data.sources.base import EpisodeRef, Inspection, KeyInfo
from hma_data.sources.common import checks
from hma_data.sources.common.checks import Finding, is_times, seconds_of
from hma_data.sources.common.survey import Survey, sampled
from hma_data.sources.rlds.features import Steps
from hma_data.sources.rlds.folder import Folder, open_folder
from hma_data.sources.rlds.source import MAX_VECTOR, is_camera

INSPECTED_EPISODES, INSPECTED_BYTES = 1000, 256 << 20  # most episodes and bytes read for their lengths


def inspect(uri: str, refs: list[EpisodeRef], episodes: int) -> Inspection:
    """See Source.inspect. The lengths are those of up to 1,000 episodes or 256 MiB.

    Raises:
        SourceError: nothing readable there.
    """
    folder = open_folder(uri)
    survey = Survey(len(refs))
    survey.made |= {"files", "rows"}  # a column of another length than the episode cannot be read
    for problem in folder.problems:
        survey.note(Finding("files", "warn", problem))
    chosen = sampled(len(refs), episodes)
    lengths, first = _survey(folder, refs, chosen, survey)
    if first is None:
        found = survey.findings(())
        why = next((one for one in reversed(found) if one.check == "files"), found[0])
        raise SourceError(uri, f"holds no readable episode: {why}", "copy its files again")
    keys = tuple(survey.key(_key_info(first, key, survey)) for key in folder.step_features)
    return Inspection(
        format="rlds",
        uri=uri,
        episodes=len(refs),
        keys=keys,
        frames=sum(lengths) if len(lengths) == len(refs) else None,
        lengths=lengths,
        facts=_facts(folder),
        looked_at=len(survey.looked),
        findings=survey.findings(keys),
        checks=survey.checks(),
    )


def _survey(
    folder: Folder, refs: list[EpisodeRef], chosen: list[int], survey: Survey
) -> tuple[tuple[int, ...], Steps | None]:
    """Sample the chosen episodes; return the lengths of the episodes read, and the first of them."""
    wanted = set(chosen)
    more = range(0 if folder.remote else min(len(refs), INSPECTED_EPISODES))
    lengths: dict[int, int] = {}
    first: Steps | None = None
    budget = INSPECTED_BYTES
    pairs = max(1, checks.PAIRS // max(len(chosen), 1))
    for i in [*chosen, *(i for i in more if i not in wanted)]:
        if budget < 0 and i not in wanted:
            break
        name = refs[i].id
        try:
            steps = Steps(folder.example(name)[0], folder.step_features, name)
        except EpisodeError as fault:
            survey.fault(name, fault)
            continue
        budget -= steps.example.size
        lengths[i] = steps.count
        first = first or steps
        if i in wanted:
            survey.episode(name)
            _look(steps, survey, pairs)
    return tuple(lengths[i] for i in sorted(lengths)), first


def _look(steps: Steps, survey: Survey, pairs: int) -> None:
    """Hand the numbers, times and some pictures of one episode to the survey."""
    for key, feature in steps.features.items():
        try:
            if is_camera(feature):
                decode, codec = steps.decoder(key), _codec(steps, key)
                for run in checks.runs(checks.choose(steps.count, pairs)):
                    for start, frames in checks.stacked([decode(int(i)) for i in run]):
                        survey.pictures(steps.name, key, frames, run[start : start + len(frames)], codec)
            elif feature.kind == "number" and 0 < (feature.width or 0) <= MAX_VECTOR:
                values = steps.numbers(key)
                survey.numbers(steps.name, key, values)
                seconds = seconds_of(values) if is_times(key, values.shape[1:]) else None
                if seconds is not None:
                    survey.times(steps.name, key, seconds)
        except EpisodeError as fault:
            survey.fault(steps.name, fault, key)


def _facts(folder: Folder) -> dict[str, str]:
    splits = [f"{name} {sum(shard.count() for shard in shards)}" for name, shards in folder.splits.items()]
    outside = [name for name in folder.features if not name.startswith("steps/")]
    found = {"dataset": folder.name, "version": folder.version}
    found |= {"splits": ", ".join(splits), "episode keys": ", ".join(outside)}
    return {name: value for name, value in found.items() if value}


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
    """Return the codec of a key's first picture; TFDS stores files as given, whatever is stated."""
    if steps.features[key].kind != "picture":
        return "raw"
    head = bytes(steps.blobs(key)[0][:8])
    if head.startswith(b"\xff\xd8"):
        return "jpeg"
    return "png" if head.startswith(b"\x89PNG") else steps.features[key].codec or "unknown"
