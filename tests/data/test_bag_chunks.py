"""Chunks of bags: what is kept of them, what is unpacked in part, and that pictures come out the same."""

import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import CompressionType

from hma_data.episode import OneByOne
from hma_data.errors import EpisodeError
from hma_data.sources.bags import chunks, mcap, opened, ros1
from hma_data.sources.bags.chunks import Buffer, ChunkCache, reach
from hma_data.sources.bags.container import Wanted, decompress, decompress_begin
from hma_data.video import prepare, prepared
from tests.data import bag_parts
from tests.data.bag_files import CAMERA, KINDS, SOURCE, arm, make_recording, read, write_mcap
from tests.data.bag_files import as_cdr as cdr

RECORDING = make_recording(12)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("room", [1, 1 << 20])
def test_pictures_and_numbers_are_the_recorded_ones_with_and_without_room(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str, room: int
) -> None:
    monkeypatch.setattr(chunks, "CACHED_BYTES", room)
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


def _spied(monkeypatch: pytest.MonkeyPatch, module: Any, name: str) -> list[int]:
    begun: list[int] = []
    load = getattr(module, name)

    def spy(file: Any, chunk: Any, size: int, take: Any) -> memoryview:
        begun.append(size)
        found: memoryview = load(file, chunk, size, take)
        return found

    monkeypatch.setattr(module, name, spy)
    return begun


@pytest.mark.parametrize("codec", ["ros1-lz4", "ros1-bz2", "mcap-lz4", "mcap-zstd"])
def test_without_room_a_scan_unpacks_only_what_it_needs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, codec: str
) -> None:
    run = bag_parts.make_run(40, side=32, pause_after=(20,))
    kind, _, packing = codec.partition("-")
    if kind == "ros1":
        path = bag_parts.ros1(tmp_path, run, packing.upper(), chunk=4000)
        begun = _spied(monkeypatch, ros1, "_load_begin")
    else:
        path = bag_parts.mcap(tmp_path, run, compression=CompressionType[packing.upper()], chunk_size=4000)
        begun = _spied(monkeypatch, mcap, "load_begin")
    whole = {segments: _all(path, segments) for segments in ("", "{gap_s: 1}")}
    assert not begun
    monkeypatch.setattr(chunks, "CACHED_BYTES", 1)
    for segments, expected in whole.items():
        for found, value in zip(_all(path, segments), expected, strict=True):
            np.testing.assert_array_equal(found, value)
        assert begun and max(begun) < 5000  # chunks are of 6,500
        begun.clear()


def _all(path: Path, segments: str) -> list[np.ndarray]:
    opened._bags.clear()
    opened._tables.clear()
    robot = bag_parts.parted(segments or "{gap_s: 100}")
    found: list[np.ndarray] = []
    for ref in SOURCE.index(str(path), robot):
        episode = SOURCE.read(str(path), ref.id, robot)
        stream = episode.streams["cam"]
        found += [stream.timestamps, stream.frames(range(len(stream.timestamps)))]
        for signal in episode.actions:
            found += [signal.timestamps, signal.values]
    return found


def test_reach_is_to_the_end_of_the_last_message_asked_for() -> None:
    entries = {
        "/cam": np.array([[10, 0], [30, 5000]], np.uint64),
        "/n": np.array([[20, 4000], [40, 9000]], np.uint64),
    }
    both, cam = frozenset({"/cam", "/n"}), frozenset({"/cam"})
    assert reach(entries, Wanted(both, heads=cam), 9100, 31) == 9100
    assert reach(entries, Wanted(both, last_ns=25, heads=cam), 9100, 31) == 5000
    assert reach(entries, Wanted(cam, heads=cam), 9100, 31) == 5000 + 31 + 64
    assert reach(entries, Wanted(cam), 9100, 31) == 9000
    assert reach(entries, Wanted(frozenset({"/other"}), heads=cam), 9100, 31) == 0


def test_an_index_that_misplaces_messages_is_no_wrong_number(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = bag_parts.make_run(40, side=32)
    path = bag_parts.mcap(tmp_path, run, compression=CompressionType.ZSTD, chunk_size=4000)
    data = bytearray(path.read_bytes())
    _halve_offsets(data)
    path.write_bytes(data)
    monkeypatch.setattr(chunks, "CACHED_BYTES", 1)
    with pytest.raises(EpisodeError, match="index"):
        _all(path, "")


def _halve_offsets(data: bytearray) -> None:
    """Of every message index in an MCAP file."""
    at = 8
    while at + 9 < len(data) - 8:
        opcode, length = data[at], int.from_bytes(data[at + 1 : at + 9], "little")
        if opcode == 0x07:
            for entry in range(at + 15, at + 9 + length, 16):
                offset = int.from_bytes(data[entry + 8 : entry + 16], "little")
                data[entry + 8 : entry + 16] = (offset // 2).to_bytes(8, "little")
        at += 9 + length


def test_memory_that_is_looked_at_is_not_used_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(chunks, "CACHED_BYTES", 1 << 20)
    monkeypatch.setattr(chunks, "_kept", chunks._Kept())
    cache, size = ChunkCache(), 300_000

    def filled(value: int) -> memoryview:
        def load(take: chunks.Take) -> memoryview:
            memory = take(size)
            memory[:] = bytes([value]) * size
            return memory

        return cache.get(Path("x"), value, load)

    views = {value: filled(value) for value in range(0, 20, 4)}
    for value in range(40):
        assert filled(value)[0] == value
        assert chunks._kept.bytes <= 1 << 20
    assert all(bytes(view) == bytes([value]) * size for value, view in views.items())
    assert chunks._kept.bytes <= 1 << 20


def test_memory_of_a_bag_is_used_for_the_next(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(chunks, "_kept", chunks._Kept())

    def load(take: chunks.Take) -> memoryview:
        return take(300_000)

    for number in range(5):
        cache = ChunkCache()
        for offset in range(3):
            cache.get(Path("x"), offset, load)
        del cache
        assert chunks._kept.bytes == 3 * 5 * (1 << 16), number
    cache = ChunkCache()
    held = cache.get(Path("x"), 0, load)
    del cache
    assert chunks._kept.bytes == 2 * 5 * (1 << 16) and len(held) == 300_000  # what is looked at is not kept


def test_a_bag_collected_amid_the_reading_of_another_waits_for_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The collector may find a bag in any line, in the ones that hold the lock too."""
    monkeypatch.setattr(chunks, "_kept", chunks._Kept())
    lost = [ChunkCache()]
    lost[0].get(Path("x"), 0, lambda take: take(300_000))

    class Collecting(type(Path())):  # type: ignore[misc]
        def __hash__(self) -> int:
            lost.clear()
            return super().__hash__()

    def read() -> None:
        cache = ChunkCache()
        cache.get(Collecting("y"), 0, lambda take: take(300_000))

    reader = threading.Thread(target=read, daemon=True)
    reader.start()
    reader.join(20)
    assert not reader.is_alive() and not lost
    chunks._kept.memory(1)
    assert chunks._kept.bytes == 5 * (1 << 16)  # the memory of the one was used for the other


def test_sizes_that_are_claimed_take_no_memory() -> None:
    import resource

    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(ValueError, match="unpacks to"):
        ChunkCache().get(Path("x"), 0, _bomb)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100 << 10  # KiB
    with pytest.raises(ValueError, match="claims"):
        ChunkCache().scratch(1 << 50)


def _bomb(take: chunks.Take) -> memoryview:
    import zstandard

    memory = take(500 << 20)
    decompress("zstd", zstandard.compress(bytes(10)), memory)
    return memory


def test_chunks_of_a_bag_go_with_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(chunks, "_kept", chunks._Kept())
    path = write_mcap(tmp_path / "run.mcap", RECORDING, cdr(), compression=CompressionType.ZSTD)
    episode = read(path, arm())
    assert chunks._kept.bytes > 0
    del episode
    assert chunks._kept.bytes == 0


def test_a_buffer_tells_a_file_that_ends_too_soon(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"0123456789")
    with path.open("rb") as file:
        buffer = Buffer()
        assert bytes(buffer.read(file, 4)) == b"0123"
        with pytest.raises(EOFError, match="3 bytes before"):
            buffer.read(file, 9)
        with pytest.raises(ValueError, match="claims"):
            buffer.read(file, 1 << 40)


@pytest.mark.parametrize("codec", ["zstd", "lz4", "bz2", ""])
def test_the_beginning_of_a_chunk_is_that_of_the_whole(codec: str) -> None:
    import bz2

    import lz4.frame
    import zstandard

    data = np.random.default_rng(0).integers(0, 9, 500_000, np.uint8).tobytes()
    pack = {"zstd": zstandard.compress, "lz4": lz4.frame.compress, "bz2": bz2.compress, "": bytes}[codec]
    packed = pack(data)
    whole = memoryview(bytearray(len(data)))
    decompress(codec, packed, whole)
    assert whole == data
    for size in (1, 1000, 499_999):
        begin = memoryview(bytearray(size))
        decompress_begin(codec, packed, begin)
        assert begin == data[:size]
    for wrong in (len(data) - 1, len(data) + 1):
        with pytest.raises(ValueError, match="unpacks to"):
            decompress(codec, packed, memoryview(bytearray(wrong)))
    with pytest.raises(ValueError, match="unpacks to"):
        decompress_begin(codec, packed, memoryview(bytearray(len(data) + 1)))


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
