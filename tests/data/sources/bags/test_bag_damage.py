"""Bags cut off, flipped, bombs, and what reading leaves behind."""

import contextlib
import shutil
import sqlite3
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from hma_data.errors import EpisodeError, HMAError
from hma_data.sources.bags import container
from tests.data import bag_parts
from tests.data.bag_files import (
    KINDS,
    SOURCE,
    Recording,
    arm,
    read,
)


def touch_everything(path: Path) -> None:
    """Whatever a job would do with the bag."""
    SOURCE.index(str(path), arm())
    with contextlib.suppress(HMAError):
        SOURCE.inspect(str(path))
    episode = read(path, arm())
    episode.streams["front"].frames(range(len(episode.streams["front"].timestamps)))


def touch_every_part(path: Path) -> None:
    """Whatever a job would do with the episodes of the bag."""
    embodiment = bag_parts.parted("{gap_s: 1}")
    for ref in SOURCE.index(str(path), embodiment):
        stream = SOURCE.read(str(path), ref.id, embodiment).streams["cam"]
        stream.frames(range(len(stream.timestamps)))


SINGLE = ["ros1", "ros1-bz2", "ros1-lz4", "mcap-cdr-zstd", "mcap-json", "mcap-without-chunks",
          "mcap-protobuf", "ros2-sqlite3"]  # fmt: skip
PARTED = [f"of two episodes, {kind}" for kind in bag_parts.KINDS]
PATIENT = settings(max_examples=12, suppress_health_check=list(HealthCheck))


@pytest.fixture(scope="module")
def whole(bags: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The bytes of a bag of each kind, of one episode and of two."""
    paths = {kind: bags[kind] for kind in SINGLE}
    run = bag_parts.make_run(20, pause_after=(10,))
    for kind, make in bag_parts.KINDS.items():
        paths[f"of two episodes, {kind}"] = make(tmp_path_factory.mktemp("parted"), run)
    return {kind: (path / "run.db3" if path.is_dir() else path).read_bytes() for kind, path in paths.items()}


@pytest.mark.parametrize("kind", [*SINGLE, *PARTED])
@PATIENT
@given(share=st.floats(0, 1, exclude_max=True))
def test_a_bag_cut_off_anywhere_is_refused(kind, share, whole, tmp_path) -> None:
    path = tmp_path / "cut.bag"
    path.write_bytes(whole[kind][: int(len(whole[kind]) * share)])
    touch = touch_every_part if kind in PARTED else touch_everything
    if "without-index" in kind and "ros1" in kind:  # nothing tells that a whole chunk is missing
        with contextlib.suppress(EpisodeError):
            touch(path)
        return
    with pytest.raises(EpisodeError) as fault:
        touch(path)
    assert "\n" not in str(fault.value)


@pytest.mark.parametrize("kind", [*SINGLE, *PARTED])
@PATIENT
@given(share=st.floats(0, 1, exclude_max=True), bit=st.integers(0, 7), fill=st.booleans())
def test_a_flipped_bit_gives_an_answer_or_our_error(kind, share, bit, fill, whole, tmp_path) -> None:
    data = bytearray(whole[kind])
    at = int(len(data) * share)
    if fill:
        data[at : at + 8] = b"\xff" * 8
    else:
        data[at] ^= 1 << bit
    path = tmp_path / "flipped.bag"
    path.write_bytes(data)
    try:
        (touch_every_part if kind in PARTED else touch_everything)(path)
    except HMAError as fault:
        assert "\n" not in str(fault)


def test_a_bag_that_holds_less_than_its_index_counts_is_refused(bags, tmp_path) -> None:
    zipped = tmp_path / "zipped"
    shutil.copytree(bags["ros2-sqlite3-file-zstd"], zipped)
    metadata = zipped / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace("message_count: 10\n", "message_count: 12\n"))
    with pytest.raises(EpisodeError, match=r"its index counts 12 messages of /cam/image\.raw, it holds 10"):
        read(zipped, arm())


def test_a_chunk_that_unpacks_to_more_than_it_says_is_refused(bags, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(container, "MAX_CHUNK", 4000)
    for kind in ("ros1-bz2", "mcap-cdr-zstd", "mcap-ros1-lz4"):
        with pytest.raises(EpisodeError, match="more than 4,000"):
            read(bags[kind], arm())
    for codec, packed in {"zstd": _zstd(10**6), "bz2": _bz2(10**6), "lz4": _lz4(10**6)}.items():
        with pytest.raises(ValueError, match="unpacks to"):
            container.decompress(codec, packed, 1000)


def _zstd(size: int) -> bytes:
    import zstandard

    return zstandard.compress(bytes(size))


def _bz2(size: int) -> bytes:
    import bz2

    return bz2.compress(bytes(size))


def _lz4(size: int) -> bytes:
    import lz4.frame

    return lz4.frame.compress(bytes(size))


def test_an_sqlite_log_that_was_not_merged_is_read_too(tmp_path: Path, recording: Recording) -> None:
    folder = KINDS["ros2-sqlite3"](tmp_path, recording)
    database = folder / "run.db3"
    base = sqlite3.connect(database)
    base.execute("PRAGMA journal_mode=WAL")
    base.execute(
        "INSERT INTO messages (topic_id, timestamp, data) SELECT topic_id, timestamp + 1, data FROM messages"
    )
    base.commit()
    killed = tmp_path / "killed"
    shutil.copytree(folder, killed)  # as a recorder that was killed leaves it: the rows are in the log
    base.close()
    assert (killed / "run.db3-wal").stat().st_size > 0
    assert SOURCE.index(str(killed), arm())[0].frames == 2 * len(recording.pictures)


def test_reading_leaves_nothing_beside_the_bag(bags: dict[str, Path]) -> None:
    for kind in ("ros2-sqlite3", "ros2-sqlite3-file-zstd"):
        before = sorted(bags[kind].iterdir())
        touch_everything(bags[kind])
        assert sorted(bags[kind].iterdir()) == before


def test_pictures_are_not_kept_in_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import tracemalloc

    path = bag_parts.ros1(tmp_path, bag_parts.make_run(100, side=64))
    monkeypatch.setattr(container, "CACHED_BYTES", 1 << 16)
    tracemalloc.start()
    stream = SOURCE.read(str(path), "run", bag_parts.parted("null")).streams["cam"]
    kept = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    assert kept < path.stat().st_size / 2
    assert stream.frames([99]).shape == (1, 64, 64, 3)


def test_a_wrong_checksum_is_refused_whether_chunks_are_packed_or_not(tmp_path: Path) -> None:
    for kind in ("mcap-plain", "mcap-zstd"):
        folder = tmp_path / kind
        folder.mkdir()
        path = bag_parts.KINDS[kind](folder, bag_parts.make_run(20))
        data = bytearray(path.read_bytes())
        chunk = data.index(b"\x06", 60)
        while int.from_bytes(data[chunk + 1 : chunk + 9], "little") > 9000:
            chunk = data.index(b"\x06", chunk + 1)
        data[chunk + 9 + 24] ^= 1  # its checksum
        path.write_bytes(data)
        with pytest.raises(EpisodeError, match="checksum"):
            stream = SOURCE.read(str(path), "run", bag_parts.parted("{gap_s: 1}")).streams["cam"]
            stream.frames(range(20))
