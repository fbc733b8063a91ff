"""What is in a LeRobotDataset, without an embodiment: its metadata held against the files that are there."""

import numpy as np

from hma_data.errors import EpisodeError, HMAError
from hma_data.sources.base import Inspection, KeyInfo
from hma_data.sources.findings import Finding
from hma_data.sources.lerobot_meta import Metadata, Span
from hma_data.sources.lerobot_rows import StillPictures, rows_of
from hma_data.sources.video_file import frame_table

PROBED = 10  # videos that are opened


def inspect(uri: str, meta: Metadata, episodes: int) -> Inspection:
    """See Source.inspect."""
    lengths = [row["length"] for row in meta.episodes.values()]
    return Inspection(
        format="lerobot",
        uri=uri,
        episodes=len(lengths),
        keys=_keys(meta),
        frames=sum(lengths),
        lengths=tuple(lengths[:1_000]),
        hz=meta.fps,
        robot=meta.robot,
        findings=tuple(Finding("recording", "warn", said) for said in _problems(meta)),
        facts={"version": meta.version, "tasks": str(len(meta.tasks))},
    )


def _keys(meta: Metadata) -> tuple[KeyInfo, ...]:
    found = []
    for feature in meta.features.values():
        kind = "vector" if feature.dtype.startswith(("float", "int", "uint", "bool")) else "other"
        shape, codec = feature.shape, feature.codec
        if feature.is_camera:
            kind, codec = "camera", codec or _codec(meta, feature.name)
            if len(shape) == 3 and shape[0] in (1, 3) and shape[2] not in (1, 3):  # stated as C, H, W
                shape = (shape[1], shape[2], shape[0])
        elif feature.dtype in ("string", "large_string"):
            kind = "text"
        found.append(KeyInfo(feature.name, kind, shape, feature.dtype, meta.fps, feature.names, codec))
    return tuple(found)


def _codec(meta: Metadata, key: str) -> str | None:
    """As the first episode has it; None where it cannot be seen."""
    index = next(iter(meta.episodes))
    try:
        if meta.features[key].dtype == "video":
            return frame_table(meta.folder.path(meta.video(index, key).path)).codec
        rows = rows_of(meta.folder.path(meta.data_path(index)), index)
        return StillPictures(rows, key, np.zeros(len(rows)), meta.folder).codec()
    except HMAError:
        return None


def _problems(meta: Metadata) -> list[str]:
    found = []
    lengths = [row["length"] for row in meta.episodes.values()]
    for name, actual in (("total_episodes", len(lengths)), ("total_frames", sum(lengths))):
        stated = meta.info.get(name)
        if isinstance(stated, int) and stated != actual:
            found.append(f"info.json says {name} {stated:,}, the episodes listed make {actual:,}")
    if meta.folder.repo:
        return found  # what is on the Hub is not fetched to be looked at
    try:
        found += _absent(meta, "parquet files", {meta.data_path(index): None for index in meta.episodes})
    except EpisodeError as fault:
        found.append(str(fault))
    for key, feature in meta.features.items():
        if feature.dtype == "video":
            try:
                spans = {index: meta.video(index, key) for index in meta.episodes}
            except EpisodeError as fault:
                found.append(str(fault))
                continue
            found += _absent(meta, f"videos of {key}", {span.path: None for span in spans.values()})
            found += _miscounted(meta, spans)
    return found


def _absent(meta: Metadata, what: str, paths: dict[str, None]) -> list[str]:
    missing = [path for path in paths if not meta.folder.path(path).is_file()]
    return [f"{len(missing):,} of {len(paths):,} {what} are missing, {missing[0]} first"] if missing else []


def _miscounted(meta: Metadata, spans: dict[int, Span]) -> list[str]:
    """Videos whose number of frames is not that of the rows, among the first that are there."""
    rows: dict[str, int] = {}
    for index, span in spans.items():
        rows[span.path] = rows.get(span.path, 0) + meta.episodes[index]["length"]
    present = [path for path in rows if meta.folder.path(path).is_file()][:PROBED]
    found = []
    for path in present:
        try:
            frames = len(frame_table(meta.folder.path(path)))
        except EpisodeError as fault:
            found.append(str(fault))
            continue
        if frames != rows[path]:
            found.append(f"{path} has {frames:,} frames for {rows[path]:,} rows")
    return found
