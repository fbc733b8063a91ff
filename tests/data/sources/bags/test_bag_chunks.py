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
from hma_data.sources.bags.bag import Bag
from hma_data.sources.bags.container import decompress
from hma_data.sources.bags.mcap import McapFile
from tests.data.bag_files import CAMERA, KINDS, arm, make_recording, read, write_mcap
from tests.data.bag_files import as_cdr as cdr

RECORDING = make_recording(12)


@pytest.mark.parametrize(
    ("kind", "room"), [*((kind, 1) for kind in KINDS), ("ros1", 1 << 20), ("mcap-cdr-zstd", 1 << 20)]
)
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
@pytest.mark.parametrize("size", [16, 40])
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
