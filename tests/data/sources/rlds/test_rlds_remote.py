"""RLDS on object stores: the shards of the next episodes are fetched while one is decoded."""

from pathlib import Path

import fsspec
import numpy as np
import pytest
from fsspec.implementations.memory import MemoryFileSystem

from hma_data.errors import EpisodeError
from hma_data.sources.base import Expecting, open_source
from hma_data.sources.rlds import records
from hma_data.sources.rlds.folder import open_folder
from hma_data.storage import blocks
from tests.data.sources.rlds.test_rlds import record, toy, write

EPISODES, LENGTH = 6, 8  # of each shard; steps


@pytest.fixture
def ranges(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, int, int]]:
    monkeypatch.setattr(blocks, "BLOCK", 1024)
    monkeypatch.setattr(blocks, "BLOCKS_AHEAD", 4)
    monkeypatch.setattr(records, "READ_AHEAD", 64)
    found: list[tuple[str, int, int]] = []
    plain = MemoryFileSystem.cat_file

    def counted(self, path, start=None, end=None, **kwargs):
        data = plain(self, path, start, end, **kwargs)
        if "tfrecord" in path:
            found.append((path[-14:-9], start or 0, (start or 0) + len(data)))
        return data

    monkeypatch.setattr(MemoryFileSystem, "cat_file", counted)
    return found


def upload(tmp_path: Path, shards: int = 3) -> tuple[Path, str]:
    files = {
        f"toy-train.tfrecord-{shard:05d}-of-{shards:05d}": [
            record(shard * EPISODES + i, LENGTH) for i in range(EPISODES)
        ]
        for shard in range(shards)
    }
    folder, uri = write(tmp_path / "d", files), f"memory://{tmp_path.name}"
    for path in folder.iterdir():
        fsspec.filesystem("memory").pipe(f"{uri}/{path.name}", path.read_bytes())
    return folder, uri


def file_size(folder: Path) -> int:
    return next(folder.glob("*tfrecord-00000*")).stat().st_size


def settled() -> None:
    for future in list(blocks._cache(blocks.os.getpid())._blocks.values()):
        future.result()


def test_expected_episodes_are_those_of_the_disk_and_each_byte_comes_once(tmp_path, ranges) -> None:
    folder, uri = upload(tmp_path)
    source = open_source("rlds")
    assert isinstance(source, Expecting)
    names = [f"train/{i:06d}" for i in range(3 * EPISODES)]
    source.expect(uri, names)
    for name in names:
        ours, theirs = open_folder(uri).example(name)[0], open_folder(str(folder)).example(name)[0]
        assert ours.blobs("steps/observation/image") == theirs.blobs("steps/observation/image")
        np.testing.assert_array_equal(ours.numbers("steps/action/move"), theirs.numbers("steps/action/move"))
    settled()
    assert len(ranges) == len(set(ranges))
    whole = sum(path.stat().st_size for path in folder.glob("*tfrecord*"))
    assert sum(stop - start for _, start, stop in ranges) <= whole


def test_the_next_shard_is_on_its_way_before_this_one_ends_and_no_more(tmp_path, ranges) -> None:
    folder, uri = upload(tmp_path)
    size = file_size(folder)
    open_folder(uri).expect([f"train/{i:06d}" for i in range(3 * EPISODES)])
    reached = []
    for i in range(EPISODES):
        open_folder(uri).example(f"train/{i:06d}")
        settled()
        ahead = sum(stop - start for _, start, stop in ranges)
        assert ahead <= (i + 1) * size / EPISODES + (blocks.BLOCKS_AHEAD + 3) * blocks.BLOCK
        reached.append(max(number for number, _, _ in ranges))
    assert reached[0] == "00000" and reached[-1] == "00001"


def test_a_few_episodes_of_a_shard_do_not_fetch_the_rest(tmp_path, ranges) -> None:
    folder, uri = upload(tmp_path, shards=1)
    open_folder(uri).expect(["train/000000", "train/000005"])
    open_folder(uri).example("train/000000")
    settled()
    assert sum(stop - start for _, start, stop in ranges) < 0.5 * file_size(folder)


def test_what_is_on_this_machine_is_not_fetched(tmp_path) -> None:
    folder = open_folder(str(toy(tmp_path / "d")))
    folder.expect(["train/000000", "elsewhere/1"])
    with pytest.raises(EpisodeError, match="elsewhere/1"):
        folder.example("elsewhere/1")
