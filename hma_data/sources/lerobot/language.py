"""Read what a LeRobotDataset says in words about moments of its episodes, and write it into another one.

There are subtasks, plans and memories, which hold from a time on (`language_persistent`), and questions,
interjections and calls of tools at one time (`language_events`). Datasets from before these columns number
their subtasks in the rows (`subtask_index`, with the texts in meta/subtasks.parquet).

An item is a mapping of role, content, style, camera and tool_calls as lerobot has them, with `column`,
persistent or events, and `timestamp`, seconds from the episode's first row.

T rows of an episode.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hma_data.arrays import Floats
from hma_data.errors import EpisodeError, SourceError
from hma_data.sources.lerobot.metadata import Metadata
from hma_data.sources.lerobot.rows import Rows

Items = Sequence[Mapping[str, Any]]
PERSISTENT, EVENTS, SUBTASK = "language_persistent", "language_events", "subtask_index"
_STAGED = "plan"  # under this name lerobot's writer takes rows of any style


def language_of(meta: Metadata, rows: Rows, times: Floats) -> list[dict[str, Any]]:
    """Return the items of an episode in the order of their times (T,).

    Raises:
        EpisodeError: its columns of language are not as lerobot writes them.
    """
    try:
        start = float(times[0])
        found: list[dict[str, Any]] = []
        if PERSISTENT in rows.columns:  # the same in every row
            for item in rows.column(PERSISTENT)[0].as_py() or ():
                found.append(dict(item) | {"column": "persistent", "timestamp": item["timestamp"] - start})
        elif SUBTASK in rows.columns:
            found += _subtasks(meta, rows, times - start)
        if EVENTS in rows.columns:
            for time, items in zip(times - start, rows.column(EVENTS).to_pylist(), strict=True):
                found += [dict(item) | {"column": "events", "timestamp": float(time)} for item in items or ()]
        return sorted(found, key=lambda item: float(item["timestamp"]))
    except (KeyError, TypeError, ValueError) as fault:
        raise EpisodeError(rows.path, f"its language is not as lerobot writes it: {fault!r}") from fault


def _subtasks(meta: Metadata, rows: Rows, times: Floats) -> list[dict[str, Any]]:
    texts, numbers = meta.subtasks, rows.numbers(SUBTASK).reshape(-1)
    begins = np.flatnonzero(np.diff(numbers, prepend=numbers[0] - 1))
    return [
        {
            "column": "persistent",
            "timestamp": float(times[row]),
            "role": "assistant",
            "content": texts[int(numbers[row])],
            "style": "subtask",
            "camera": None,
            "tool_calls": None,
        }
        for row in begins
        if int(numbers[row]) in texts
    ]


def on_rows(items: Items, times: Floats, fps: float) -> list[dict[str, Any]]:
    """Return items with the times that they have in rows of `fps` a second.

    Args:
        times: (N,) seconds of the rows; an item goes to the first row at or after it, or to the last.
    """
    rows = np.searchsorted(times, [float(item["timestamp"]) - 1e-4 for item in items])
    last = len(times) - 1
    return [
        dict(item) | {"timestamp": min(int(row), last) / fps} for item, row in zip(items, rows, strict=True)
    ]


def write_language(folder: Path, by_episode: Mapping[int, Items]) -> None:
    """Add the items of episodes to a LeRobotDataset, by lerobot's own writer of these columns.

    Args:
        folder: of the dataset.
        by_episode: number of an episode -> its items, at times of rows.
    """
    from lerobot.annotations.steerable_pipeline.reader import iter_episodes
    from lerobot.annotations.steerable_pipeline.staging import EpisodeStaging
    from lerobot.annotations.steerable_pipeline.writer import LanguageColumnsWriter
    from lerobot.datasets import language
    from lerobot.datasets.io_utils import load_info, write_info

    staging = folder / "staging"
    records = list(iter_episodes(folder))
    stamps = {record.episode_index: np.asarray(record.frame_timestamps) for record in records}
    for episode, items in by_episode.items():
        rows = []
        for item in items:
            row = {key: value for key, value in item.items() if key != "column"}
            # An event is found by the very time of its row.
            nearest = int(np.abs(stamps[episode] - item["timestamp"]).argmin())
            rows.append(row | {"timestamp": float(stamps[episode][nearest])})
            own = language.PERSISTENT_STYLES if item["column"] == "persistent" else language.EVENT_ONLY_STYLES
            if item["style"] is not None:
                own.add(item["style"])  # a project may have styles of its own
        EpisodeStaging(staging, episode).write(_STAGED, rows)
    try:
        LanguageColumnsWriter().write_all(records, staging, folder)
    except ValueError as fault:
        said = f"has language data that lerobot's writer rejects: {fault}"
        raise SourceError("the recording", said, "correct it with lerobot-annotate") from fault
    for path in sorted(staging.rglob("*"), reverse=True):
        path.unlink() if path.is_file() else path.rmdir()
    staging.rmdir()
    info = load_info(folder)
    info.features = {**info.features, **language.language_feature_info()}
    write_info(info, folder)


def to_text(items: Items) -> str:
    """Return items as JSON; empty where there are none."""
    return json.dumps(list(items), ensure_ascii=False, default=str) if items else ""
