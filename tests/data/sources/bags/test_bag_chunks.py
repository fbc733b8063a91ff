"""Chunks of bags: which are kept, up to what size, and that pictures come out the same."""

import weakref
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import CompressionType

from hma_data.episodes.episode import OneByOne
from hma_data.episodes.images import prepare, prepared
from hma_data.errors import EpisodeError
from hma_data.sources.bags import container
from hma_data.sources.bags import segments as segmenting
from hma_data.sources.bags.bag import Bag
from hma_data.sources.bags.container import ChunkCache, decompress
from hma_data.sources.bags.mcap import McapFile
from tests.data import bag_parts
from tests.data.bag_files import CAMERA, KINDS, SOURCE, arm, make_recording, read, write_mcap
from tests.data.bag_files import as_cdr as cdr

RECORDING = make_recording(12)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("room", [1, 1 << 20])
def test_pictures_and_numbers_are_the_recorded_ones_with_and_without_room(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str, room: int
) -> None:
    monkeypatch.setattr(container, "CACHED_BYTES", room)
    episode = read(KINDS[kind](tmp_path, RECORDING), arm())
    stream = episode.streams["front"]
    np.testing.assert_array_equal(stream.frames(range(12)), RECORDING.pictures)
    for indices in ([0], [11, 3, 3], [2, 9]):
        np.testing.assert_array_equal(stream.frames(indices), RECORDING.pictures[indices])
        assert isinstance(stream, OneByOne)
        for index, one in zip(indices, stream.each(indices), strict=True):
            np.testing.assert_array_equal(one, RECORDING.pictures[index])
    np.testing.assert_array_equal(episode.actions[0].values, RECORDING.commands.astype(np.float32))
    np.testing.assert_array_equal(episode.actions[1].values, RECORDING.joints[:, [2, 0]].astype(np.float32))


@pytest.mark.parametrize("kind", ["ros1", "mcap-cdr-zstd", "mcap-json", "ros2-sqlite3"])
@pytest.mark.parametrize("size", [16, 24, 40])
def test_squares_made_one_by_one_are_those_of_whole_batches(tmp_path: Path, kind: str, size: int) -> None:
    for rule in ("short_side_crop", "letterbox", "stretch"):
        robot = arm(
            **{"key: /cam/image.raw}": f"key: /cam/image.raw, resize: {rule}, color: bgr, rotate: 90}}"}
        )
        folder = tmp_path / rule
        folder.mkdir()
        stream = read(KINDS[kind](folder, RECORDING), robot).streams["front"]
        for indices in ([0, 1, 2, 3], [7, 7, 7], [5, 1, 11, 1], [4]):
            expected = prepare(stream.frames(indices), robot.cameras[0], size)
            np.testing.assert_array_equal(prepared(stream, indices, robot.cameras[0], size), expected)


@pytest.mark.parametrize("codec", ["ros1-lz4", "ros1-bz2", "mcap-lz4", "mcap-zstd"])
def test_without_room_chunks_are_unpacked_again_to_the_same(tmp_path, monkeypatch, codec) -> None:
    run = bag_parts.make_run(40, side=32, pause_after=(20,))
    kind, _, packing = codec.partition("-")
    if kind == "ros1":
        path = bag_parts.ros1(tmp_path, run, packing.upper(), chunk=4000)
    else:
        path = bag_parts.mcap(tmp_path, run, compression=CompressionType[packing.upper()], chunk_size=4000)
    for segments in ("", "{gap_s: 1}"):
        monkeypatch.setattr(container, "CACHED_BYTES", 64 << 20)
        whole = _all(path, segments)
        monkeypatch.setattr(container, "CACHED_BYTES", 1)
        for found, value in zip(_all(path, segments), whole, strict=True):
            np.testing.assert_array_equal(found, value)


def _all(path: Path, segments: str) -> list[np.ndarray]:
    segmenting._bags.clear()
    segmenting._tables.clear()
    robot = bag_parts.parted(segments or "{gap_s: 100}")
    found: list[np.ndarray] = []
    for ref in SOURCE.index(str(path), robot):
        episode = SOURCE.read(str(path), ref.id, robot)
        stream = episode.streams["cam"]
        found += [stream.timestamps, stream.frames(range(len(stream.timestamps)))]
        for signal in episode.actions:
            found += [signal.timestamps, signal.values]
    return found


def test_the_chunks_used_last_are_kept_up_to_a_size(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(container, "CACHED_BYTES", 1000)
    cache, unpacked = ChunkCache(), list[int]()

    def chunk(offset: int, size: int = 300) -> bytes:
        def load() -> bytes:
            unpacked.append(offset)
            return bytes([offset]) * size

        return bytes(cache.get(Path("x"), offset, load))

    for offset in (0, 1, 2, 0, 3, 0, 2, 1):
        assert chunk(offset) == bytes([offset]) * 300
    assert unpacked == [0, 1, 2, 3, 1]  # 1 had to go for 3
    assert len(chunk(9, 5000)) == 5000  # one is kept, however large
    assert unpacked == [0, 1, 2, 3, 1, 9] and len(chunk(9, 5000)) == 5000 and unpacked[-2:] == [1, 9]


def test_sizes_that_are_claimed_take_no_memory() -> None:
    import resource

    import zstandard

    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(ValueError, match="unpacks to"):
        decompress("zstd", zstandard.compress(bytes(10)), 500 << 20)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100 << 10  # KiB
    with pytest.raises(ValueError, match="claims"):
        decompress("zstd", b"", 1 << 50)


def test_chunks_of_a_bag_go_with_it(tmp_path: Path) -> None:
    bag = Bag(write_mcap(tmp_path / "run.mcap", RECORDING, cdr(), compression=CompressionType.ZSTD))
    (file,) = bag.files()
    assert isinstance(file, McapFile) and list(bag.records())
    kept = weakref.ref(file._chunks)
    del bag, file
    assert kept() is None


@pytest.mark.parametrize("codec", ["zstd", "lz4", "bz2", ""])
def test_a_chunk_is_unpacked_to_the_size_it_announces(codec: str) -> None:
    import bz2

    import lz4.frame
    import zstandard

    data = np.random.default_rng(0).integers(0, 9, 50_000, np.uint8).tobytes()
    pack = {"zstd": zstandard.compress, "lz4": lz4.frame.compress, "bz2": bz2.compress, "": bytes}[codec]
    assert decompress(codec, pack(data), len(data)) == data
    for wrong in (len(data) - 1, len(data) + 1):
        with pytest.raises(ValueError, match="unpacks to"):
            decompress(codec, pack(data), wrong)


def test_pictures_that_change_size_are_refused(tmp_path: Path) -> None:
    how = cdr()
    plain, count = how[CAMERA], iter(range(99))

    def encode(item: Any) -> bytes:
        smaller = item._replace(value=item.value[:-2]) if next(count) == 5 else item
        return plain.encode(smaller)

    how[CAMERA] = plain._replace(encode=encode)
    stream = read(write_mcap(tmp_path / "run.mcap", RECORDING, how), arm()).streams["front"]
    camera = arm().cameras[0]
    with pytest.raises(EpisodeError, match="change size"):
        stream.frames(range(12))
    with pytest.raises(EpisodeError, match="change size"):
        prepared(stream, range(12), camera, 16)
    np.testing.assert_array_equal(stream.frames([5])[0], RECORDING.pictures[5][:-2])
