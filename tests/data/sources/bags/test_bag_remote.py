"""Bags on object stores: read by ranges, no further than an episode needs."""

import os
import tempfile
from pathlib import Path

import fsspec
import numpy as np
import pytest
from fsspec.implementations.memory import MemoryFileSystem

from hma_data.conversion.job import convert
from hma_data.conversion.plan import Settings
from hma_data.errors import OutputError, StorageAwayError
from hma_data.shards.reader import ShardSet
from hma_data.sources.bags import segments
from hma_data.sources.bags.bag import find_bags
from hma_data.sources.common.places import existing_path
from hma_data.sources.detect import detect
from hma_data.storage import blocks, remote
from tests.conftest import BlockTokenizer
from tests.data.bag_files import SOURCE
from tests.data.bag_parts import KINDS, PLAIN, ZSTD, make_run, mcap, parted, ros1_without_index

GAP = parted("{gap_s: 1}")
WHOLE_FILE_KINDS = ("ros1-without-index", "mcap-without-chunks", "mcap-without-indexes")
LIDAR = ("/lidar", "std_msgs/msg/String", "string data")  # never decoded


@pytest.fixture(autouse=True)
def empty_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HMA_CACHE", str(tmp_path / "cache"))


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(blocks, "BLOCK", 4096)
    monkeypatch.setattr(blocks, "BLOCKS_AHEAD", 2)
    monkeypatch.setattr(blocks, "BLOCKS_KEPT", 16)


@pytest.fixture
def ranges(small: None, monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, int]]:
    found: list[tuple[int, int]] = []
    plain = MemoryFileSystem.cat_file

    def counted(self, path, start=None, end=None, **kwargs):
        data = plain(self, path, start, end, **kwargs)
        found.append((start or 0, (start or 0) + len(data)))
        return data

    monkeypatch.setattr(MemoryFileSystem, "cat_file", counted)
    return found


def put(path: Path, name: str) -> str:
    uri = f"memory://{name}/{path.name}"
    fsspec.filesystem("memory").put(str(path), uri, recursive=path.is_dir())
    return uri


def large_run(folder: Path, **options) -> Path:
    burst = np.random.default_rng(0).bytes(60_000)
    more = [(*LIDAR, at, burst) for at in np.linspace(0.2, 10, 12).tolist() for _ in range(6)]
    return mcap(folder, make_run(60, pause_after=(20, 40), side=64), more, chunk_size=20_000, **options)


def assert_same(ours, theirs) -> None:
    assert ours.id == theirs.id and ours.instruction == theirs.instruction
    stream, other = ours.streams["cam"], theirs.streams["cam"]
    np.testing.assert_array_equal(stream.timestamps, other.timestamps)
    every = range(len(other.timestamps))
    np.testing.assert_array_equal(stream.frames(every), other.frames(every))
    for one, two in zip(ours.actions, theirs.actions, strict=True):
        np.testing.assert_array_equal(one.timestamps, two.timestamps)
        np.testing.assert_array_equal(one.values, two.values)


@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_of_a_store_reads_like_that_of_a_disk(kind: str, small, tmp_path: Path, caplog) -> None:
    path = KINDS[kind](tmp_path, make_run(60, pause_after=(25, 40), side=24))
    uri = put(path, tmp_path.name)
    assert SOURCE.index(uri, GAP) == SOURCE.index(str(path), GAP)  # ids, frames, fingerprints
    for ref in SOURCE.index(uri, GAP):
        assert_same(SOURCE.read(uri, ref.id, GAP), SOURCE.read(str(path), ref.id, GAP))
    keys = [{key.key for key in SOURCE.inspect(place).keys} for place in (uri, str(path))]
    assert keys[0] == keys[1]
    assert ("has no index" in caplog.text) == (kind in WHOLE_FILE_KINDS)


@pytest.mark.parametrize("codec", [PLAIN, ZSTD])
def test_only_the_chunks_that_an_episode_needs_are_read(codec, ranges, tmp_path, monkeypatch) -> None:
    path = large_run(tmp_path, compression=codec)
    uri, size = put(path, tmp_path.name), path.stat().st_size
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    (tmp_path / "temporary").mkdir()
    refs = SOURCE.index(uri, GAP)
    indexing = sum(end - start for start, end in ranges)
    assert len(refs) == 3 and indexing < 0.4 * size  # the pictures' times; not the large topic
    ranges.clear()
    monkeypatch.setattr(segments, "_kept", {})  # as in another process
    assert SOURCE.index(uri, GAP) == refs
    assert sum(end - start for start, end in ranges) < 0.05 * size + 3 * 65536
    ranges.clear()
    episode = SOURCE.read(uri, refs[1].id, GAP)
    assert len(episode.streams["cam"].frames(range(20))) == 20
    read = sum(end - start for start, end in ranges)
    assert read < 0.2 * size  # each chunk once, for the times and then for the pictures
    touched = np.zeros(size, bool)
    for start, end in ranges:
        touched[start:end] = True
    assert touched.mean() < 0.25
    assert not list((tmp_path / "temporary").iterdir())


def test_the_index_of_a_file_comes_from_its_summary_alone(ranges, tmp_path) -> None:
    path = large_run(tmp_path)
    uri = put(path, tmp_path.name)
    assert [ref.frames for ref in SOURCE.index(uri, parted("null"))] == [60]
    read = sum(end - start for start, end in ranges)
    assert read < 0.06 * path.stat().st_size + 3 * 65536  # the fingerprint reads three samples of 64 KiB


def test_blocks_ahead_are_fetched_before_they_are_read() -> None:
    asked: list[int] = []

    def fetch(start: int, end: int) -> bytes:
        asked.append(start // blocks.BLOCK)
        return bytes(end - start)

    file = blocks.Blocks(fetch, 100 * blocks.BLOCK + 7)
    file.expect([(3 * blocks.BLOCK + 5, 5 * blocks.BLOCK), (50 * blocks.BLOCK, 200 * blocks.BLOCK)])
    assert file.read(4 * blocks.BLOCK - 3, 4 * blocks.BLOCK + 3) == bytes(6)
    assert file.read(file.size - 9, file.size + 100) == bytes(9)
    for number in range(90, 100):
        file.block(number)
    assert set(asked) == {3, 4, *range(50, 50 + blocks.BLOCKS_AHEAD), *range(90, 101)}
    assert len(asked) == len(set(asked))  # each block once


def test_pictures_that_were_read_twice_take_no_memory(small, tmp_path: Path) -> None:
    """Of bags of any length, a process holds the pictures of an episode, not the last 256 MiB of them."""
    uri = put(large_run(tmp_path), tmp_path.name)
    cache = blocks._cache(os.getpid())
    before = cache._bytes
    episode = SOURCE.read(uri, SOURCE.index(uri, GAP)[0].id, GAP)
    held = cache._bytes
    first = episode.streams["cam"].frames(range(20))
    assert cache._bytes == before < held
    np.testing.assert_array_equal(episode.streams["cam"].frames(range(20)), first)  # fetched again


def test_a_store_that_stops_answering_is_not_the_bag_s_fault(small, tmp_path, monkeypatch) -> None:
    path = large_run(tmp_path)
    uri = put(path, tmp_path.name)
    episode = SOURCE.read(uri, SOURCE.index(uri, GAP)[0].id, GAP)
    monkeypatch.setattr(remote, "WAITS_S", (0.0,))
    monkeypatch.setattr(blocks, "PART_BYTES", 0)
    blocks._cache(os.getpid()).keep((-1, ""), b"")  # drops what was kept
    plain = MemoryFileSystem.cat_file

    def gone(self, path, *args, **kwargs):
        raise ConnectionResetError("gone")

    monkeypatch.setattr(MemoryFileSystem, "cat_file", gone)
    with pytest.raises(StorageAwayError, match="run.mcap"):
        episode.streams["cam"].frames(range(20))
    monkeypatch.setattr(MemoryFileSystem, "cat_file", plain)
    assert len(episode.streams["cam"].frames(range(20))) == 20  # a failed block is asked for again


def test_a_folder_of_a_store_is_listed_like_one_of_a_disk(tmp_path) -> None:
    for name, kind in {"a/one": "mcap-zstd", "b": "sqlite", "b/c": "ros1"}.items():
        (tmp_path / "bags" / name).mkdir(parents=True)
        KINDS[kind](tmp_path / "bags" / name, make_run(10))
    uri = put(tmp_path / "bags", tmp_path.name)
    here, there = (find_bags(existing_path(place)) for place in (str(tmp_path / "bags"), uri))
    assert list(there) == list(here) == ["a/one/run", "b/c/run", "b/run"]
    assert detect(f"{uri}/a/one") == "rosbag" and SOURCE.episode_ids(f"{uri}/a/one") == ["run"]


def test_a_copy_that_has_no_space_is_refused(tmp_path, monkeypatch) -> None:
    uri = put(KINDS["sqlite"](tmp_path, make_run(10)), tmp_path.name)
    monkeypatch.setattr("shutil.disk_usage", lambda folder: type("Usage", (), {"free": 100})())
    with pytest.raises(OutputError, match="write it as MCAP"):
        SOURCE.read(uri, "run", GAP)


def contents(folder: Path) -> list:
    shards = ShardSet(folder)
    episodes = shards.episodes.drop_columns("source").to_pylist()
    rows = [shards.episode_rows(episode["episode_index"]) for episode in episodes]
    return [episodes, *({name: values.tolist() for name, values in row.items()} for row in rows)]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["mcap-zstd", "ros1"])
def test_s3_gives_the_shards_of_the_local_bag(kind, small, s3_out, proxy, tmp_path) -> None:
    path = KINDS[kind](tmp_path, make_run(30, (10, 20), side=32))
    (s3_out / path.name).files.put_file(str(path), (s3_out / path.name).key)
    settings = Settings(val_fraction=0.4, shard_frames=20)
    convert(GAP, str(path), BlockTokenizer(), tmp_path / "here", settings=settings)
    proxy.log.clear()
    convert(GAP, str(s3_out / path.name), BlockTokenizer(), tmp_path / "there", settings=settings)
    assert contents(tmp_path / "there") == contents(tmp_path / "here")
    gets = [asked for method, path, asked in proxy.log if method == "GET" and asked]
    assert all(asked != f"bytes=0-{path.stat().st_size - 1}" for asked in gets)
    proxy.trouble = lambda method, path, number: "cut" if number % 17 == 0 else None
    convert(GAP, str(s3_out / path.name), BlockTokenizer(), tmp_path / "again", settings=settings)
    assert contents(tmp_path / "again") == contents(tmp_path / "there")


def test_a_bag_without_an_index_is_one_line(small, tmp_path, caplog) -> None:
    uri = put(ros1_without_index(tmp_path, make_run(10)), tmp_path.name)
    SOURCE.read(uri, "run", parted("null"))
    [line] = [record.message for record in caplog.records if "has no index" in record.message]
    assert uri in line and "rosbag reindex" in line
