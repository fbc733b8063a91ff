"""What is in RLDS folders, without an embodiment: keys, lengths, what looks wrong."""

import logging
import math

import numpy as np

from hma_data.errors import EpisodeError, SourceError
from hma_data.sources.base import EpisodeRef, Inspection, KeyInfo
from hma_data.sources.findings import Finding
from hma_data.sources.rlds_steps import MAX_VECTOR, Steps, is_camera
from hma_data.sources.tfds_folder import Folder, open_folder

INSPECTED_EPISODES, INSPECTED_BYTES = 1000, 256 << 20

log = logging.getLogger(__name__)


def inspect(uri: str, refs: list[EpisodeRef], episodes: int) -> Inspection:
    """See Source.inspect. Reads up to 1,000 episodes or 256 MiB.

    Raises:
        SourceError: nothing readable there.
    """
    folder = open_folder(uri)
    lengths: list[int] = []
    problems = list(folder.problems)
    odd: dict[str, str] = {}
    first: Steps | None = None
    budget = INSPECTED_BYTES
    for ref in refs[:INSPECTED_EPISODES]:
        if budget < 0:
            break
        try:
            steps = Steps(folder, folder.example(ref.id)[0], ref.id)
            budget -= steps.example.size
            lengths.append(steps.count)
            odd = oddities(steps) | odd
            first = first or steps
        except EpisodeError as fault:
            problems.append(str(fault))
    if first is None:
        raise SourceError(uri, f"holds no readable episode: {problems[-1]}", "copy its files again")
    seen = len(lengths) == len(refs)
    return Inspection(
        format="rlds",
        uri=uri,
        episodes=len(refs),
        keys=tuple(key_info(first, key) for key in folder.step_features),
        frames=sum(lengths) if seen else None,
        lengths=tuple(lengths),
        findings=tuple(Finding("recording", "warn", said) for said in (*problems, *odd.values())),
        facts=facts(folder),
    )


def facts(folder: Folder) -> dict[str, str]:
    """What is worth a line about the dataset."""
    found = {"dataset": folder.name, "version": folder.version}
    found["splits"] = ", ".join(
        f"{name} {sum(folder.counted(shard) for shard in shards)}" for name, shards in folder.splits.items()
    )
    outside = [name for name in folder.features if not name.startswith("steps/")]
    found["episode keys"] = ", ".join(outside)
    return {name: value for name, value in found.items() if value}


def key_info(steps: Steps, key: str) -> KeyInfo:
    """One key as this episode holds it."""
    feature = steps.features[key]
    shape = tuple(size or 0 for size in (*feature.nesting[1:], *feature.shape))
    kind, codec, constant = "other", None, False
    try:
        if is_camera(feature):
            kind, shape, codec = "camera", steps.decoder(key)(0).shape, _codec(steps, key)
            if feature.shape[-1:] == (1,):
                shape = (*shape[:2], 1)
        elif feature.kind == "text":
            kind = "text"
        elif feature.kind == "number":
            values = steps.numbers(key)
            shape = values.shape[1:]
            constant = len(values) > 1 and bool((values == values[0]).all())
            kind = "vector" if math.prod(shape) <= MAX_VECTOR else "other"
    except EpisodeError as fault:
        log.warning("%s", fault)  # listed as features.json states it
    return KeyInfo(key, kind, shape, feature.dtype, codec=codec, count=steps.count, constant=constant)


def _codec(steps: Steps, key: str) -> str:
    """By the first bytes of the first picture; TFDS keeps files as given, whatever features.json states."""
    if steps.features[key].kind != "picture":
        return "raw"
    head = bytes(steps.blobs(key)[0][:8])
    if head.startswith(b"\xff\xd8"):
        return "jpeg"
    return "png" if head.startswith(b"\x89PNG") else steps.features[key].codec or "unknown"


def oddities(steps: Steps) -> dict[str, str]:
    """What looks wrong in an episode that can be read: key -> a sentence."""
    found = {}
    for key, feature in steps.features.items():
        if (
            feature.kind != "number"
            or feature.dtype[:5] != "float"
            or not 0 < (feature.width or 0) <= MAX_VECTOR
        ):
            continue
        try:
            bad = ~np.isfinite(steps.numbers(key))
        except EpisodeError as fault:
            found[key] = str(fault)
            continue
        if bad.any():
            found[key] = f"{steps.name}: {key} is not finite at step {int(np.argwhere(bad)[0, 0])}"
    return found
