"""What a LeRobotDataset says about moments of its episodes is kept in shards and written back."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from hma_data.conversion.job import convert
from hma_data.conversion.plan import Settings
from hma_data.registry.embodiment import Embodiment
from hma_data.shards.reader import ShardSet
from hma_data.shards.verify import verify
from hma_data.sources.base import open_source
from tests.data.cameras import LENGTHS, arm, write_dataset

ALL = Settings(val_fraction=0.0)


def subtask(text: str, at: float) -> dict[str, Any]:
    return {"role": "assistant", "content": text, "style": "subtask", "timestamp": at, "tool_calls": None}


SAID = {
    0: [subtask("reach", 0.0), subtask("grasp é", 0.4)],
    2: [
        subtask("look", 0.0),
        {"role": "user", "content": "not there", "style": "interjection", "timestamp": 0.3},
        {"role": "assistant", "content": "{}", "style": "vqa", "timestamp": 0.3,
         "camera": "observation.images.top"},
    ],
}  # fmt: skip


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    # Only the tests that need it wait for the import, which takes seconds.
    from lerobot.annotations.steerable_pipeline.reader import iter_episodes
    from lerobot.annotations.steerable_pipeline.staging import EpisodeStaging
    from lerobot.annotations.steerable_pipeline.writer import LanguageColumnsWriter, speech_atom
    from lerobot.datasets.io_utils import load_info, write_info
    from lerobot.datasets.language import language_feature_info

    folder = write_dataset(tmp_path / "recorded")
    records = list(iter_episodes(folder))
    for episode, items in (SAID | {0: [*SAID[0], speech_atom(0.5, "got it")]}).items():
        stamps = np.array(records[episode].frame_timestamps)
        rows = [item | {"timestamp": float(stamps[round(item["timestamp"] * 10)])} for item in items]
        EpisodeStaging(tmp_path / "staging", episode).write("plan", rows)
    LanguageColumnsWriter().write_all(records, tmp_path / "staging", folder)
    info = load_info(folder)
    info.features = {**info.features, **language_feature_info()}
    write_info(info, folder)
    return folder


def said(folder: Path) -> list[tuple[Any, Any]]:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    columns = "language_persistent", "language_events"
    rows = LeRobotDataset("lab/robot", root=folder).hf_dataset.select_columns(list(columns))
    return [tuple(row[column] for column in columns) for row in rows]


@pytest.mark.slow  # of lerobot's import, and of encoding AV1
def test_shards_state_what_is_said_and_the_export_says_it_again(dataset: Path, tmp_path: Path) -> None:
    robot = arm("lerobot")
    shards = ShardSet(convert(robot, str(dataset), "raw-64", tmp_path / "shards", settings=ALL).out)
    assert verify(tmp_path / "shards") == []
    first, second, third = shards.episodes["language"].to_pylist()
    assert second == ""
    told = [(one["column"], one["style"], one["content"]) for one in json.loads(first)]
    assert told == [
        ("persistent", "subtask", "reach"), ("persistent", "subtask", "grasp é"), ("events", None, None),
    ]  # fmt: skip
    np.testing.assert_allclose([one["timestamp"] for one in json.loads(first)], [0, 0.4, 0.5], atol=1e-6)
    assert {one["camera"] for one in json.loads(third)} == {None, "observation.images.top"}
    convert(robot, str(dataset), "raw-64", tmp_path / "out", settings=ALL, to="lerobot")
    assert said(tmp_path / "out") == said(dataset)
    assert not (tmp_path / "out" / "staging").exists()


@pytest.mark.slow  # of lerobot's import, and of encoding AV1
def test_a_strided_export_moves_what_is_said_to_the_next_row(dataset: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    strided = Settings(frames="strided", val_fraction=0.0)
    convert(arm("lerobot"), str(dataset), "raw-64", out, settings=strided, to="lerobot")
    rows = said(out)
    held = [(one["content"], round(one["timestamp"], 3)) for one in rows[0][0]]
    assert held == [("reach", 0.0), ("grasp é", 0.4)]
    assert [len(events) for _, events in rows[: LENGTHS[0] // 2]] == [0, 0, 0, 1]  # 0.5 s, at 5 fps row 3


def test_a_set_without_language_has_no_column_of_it(tmp_path: Path) -> None:
    folder = write_dataset(tmp_path / "recorded")
    made = ShardSet(convert(arm("lerobot"), str(folder), "raw-64", tmp_path / "shards", settings=ALL).out)
    assert "language" not in made.episodes.column_names


def test_numbered_subtasks_of_older_datasets_are_read(tmp_path: Path, monkeypatch) -> None:
    folder = write_dataset(tmp_path / "recorded")
    data = folder / "data/chunk-000/file-000.parquet"
    table = pq.read_table(data)
    numbers = pa.array([int(frame >= 4) for frame in table["frame_index"].to_pylist()], pa.int64())
    pq.write_table(table.append_column("subtask_index", numbers), data)
    texts = pa.table({"subtask_index": [0, 1], "subtask": ["reach", "lift"]})
    pq.write_table(texts, folder / "meta" / "subtasks.parquet")
    robot = Embodiment.from_values(arm("lerobot").to_dict(), "test")
    made = ShardSet(convert(robot, str(folder), "raw-64", tmp_path / "shards", settings=ALL).out)
    for text in made.episodes["language"].to_pylist():
        told = [(one["content"], round(one["timestamp"], 3), one["style"]) for one in json.loads(text)]
        assert told == [("reach", 0.0, "subtask"), ("lift", 0.4, "subtask")]
    opened: list[str] = []
    plain = pq.ParquetFile

    def counted(path: Path, **options: Any) -> pq.ParquetFile:
        opened.append(path.name)
        return plain(path, **options)

    monkeypatch.setattr(pq, "ParquetFile", counted)
    source = open_source("lerobot")
    for name in source.episode_ids(str(folder)):
        read = source.read(str(folder), name, robot).metadata["language"]
        assert [one["content"] for one in read] == ["reach", "lift"]
    assert opened.count("subtasks.parquet") == 1
