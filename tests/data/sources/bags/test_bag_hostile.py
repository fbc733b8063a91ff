"""Bags that are cut off, damaged or hostile, and what reading leaves behind."""

import contextlib
import re
import shutil
import sqlite3
from importlib import import_module
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hma_data.errors import EpisodeError
from hma_data.sources.bags import container
from tests.data import bag_files, bag_parts
from tests.data.bag_files import CAMERA, COMMAND, KINDS, SOURCE, Recording, arm
from tests.data.sources.test_damage_anywhere import SINGLE
from tests.hostile import Row, check_refused, cut, linked_away, of, read_all, swap, untouched, use_all

PARTED = bag_parts.parted("{gap_s: 1}")


def wrong_checksum(path: Path) -> None:
    data = bytearray(path.read_bytes())
    chunk = data.index(b"\x06", 60)
    while int.from_bytes(data[chunk + 1 : chunk + 9], "little") > 9000:
        chunk = data.index(b"\x06", chunk + 1)
    data[chunk + 9 + 24] ^= 1
    path.write_bytes(data)


def killed(path: Path) -> None:
    """Leave the bag as a recorder does that is killed while it writes a chunk."""
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2 - 7])
    path.rename(f"{path}.active")


@pytest.mark.parametrize("kind", [3, 7, 0x15])  # a parameter list, XCDR2
def test_messages_that_are_not_plain_cdr_are_refused(kind: int, recording, tmp_path) -> None:
    def other(encoded: bag_files.Encoded) -> bag_files.Encoded:
        return encoded._replace(encode=lambda item: bytes([0, kind]) + encoded.encode(item)[2:])

    how = {topic: other(encoded) for topic, encoded in bag_files.as_cdr().items()}
    path = bag_files.write_mcap(tmp_path / "run.mcap", recording, how)
    said = rf"a message on /\S+ has the encapsulation {kind:#06x}, not plain CDR — record again"
    with pytest.raises(EpisodeError, match=said):
        read_all(path, arm())
    assert re.search(said, " | ".join(SOURCE.inspect(str(path)).problems))


COUNTS = swap("message_count: 10\n", "message_count: 12\n")
HOSTILE: dict[str, Row] = {  # none of the recording can be used: it is one bag, of the kind before the colon
    "ros1: empty": (of("run.bag", cut(0)), r"run\.bag: is empty"),
    "ros1: no bag": (of("run.bag", Path.unlink), "holds no bags"),
    "ros1: a link": (of("run.bag", linked_away), "link to a file outside"),
    "ros2-sqlite3: a link": (of("run/run.db3", linked_away), "link to a file outside"),
    "ros2-mcap: no file": (of("run/run.mcap", Path.unlink), r"names run\.mcap, which is not in the folder"),
    "ros2-sqlite3-file-zstd: fewer": (
        of("run/metadata.yaml", COUNTS), rf"its index counts 12 messages of {CAMERA}, it holds 10"
    ),
    "mcap-json: no such topic": (untouched, f"did you mean '{CAMERA}", {f"{CAMERA}}}": f"{CAMERA}x}}"}),
    "mcap-json: no images": (untouched, "not images", {f"front, key: {CAMERA}": f"front, key: {COMMAND}"}),
    "parts, mcap-plain: a checksum": (of("run.mcap", wrong_checksum), "checksum"),
    "parts, mcap-zstd: a checksum": (of("run.mcap", wrong_checksum), "checksum"),
    "parts, ros1-without-index: killed": (
        of("run.bag", killed), r"run\.bag\.active.*cut off.*rosbag reindex"
    ),
    **{
        f"{kind}: more in a chunk than it says": (untouched, "more than 4,000")
        for kind in ("ros1-bz2", "mcap-cdr-zstd", "mcap-ros1-lz4")
    },
}  # fmt: skip


@pytest.mark.parametrize("case", HOSTILE)
def test_a_hostile_bag_is_one_line(case: str, bags: dict[str, Path], tmp_path: Path, monkeypatch) -> None:
    kind = case.split(": ")[0]
    folder = tmp_path / "set"
    folder.mkdir()
    row = HOSTILE[case]
    robot = PARTED
    if kind.startswith("parts"):
        bag_parts.KINDS[kind.split(", ")[1]](folder, bag_parts.make_run(40))
    else:
        robot = arm(**dict(*row[2:]))
        (shutil.copytree if bags[kind].is_dir() else shutil.copy)(bags[kind], folder / bags[kind].name)
    if "more in a chunk" in case:
        monkeypatch.setattr(container, "MAX_CHUNK", 4000)
    check_refused(row, folder, robot, tmp_path / "out", one=False)


@pytest.fixture(scope="module")
def whole(bags: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    paths = {kind: bags[kind] for kind in SINGLE}
    run = bag_parts.make_run(20, pause_after=(10,))
    for kind, make in bag_parts.KINDS.items():
        paths[f"parts, {kind}"] = make(tmp_path_factory.mktemp("parted"), run)
    return {kind: (path / "run.db3" if path.is_dir() else path).read_bytes() for kind, path in paths.items()}


@pytest.mark.parametrize("kind", [*SINGLE, *(f"parts, {kind}" for kind in bag_parts.KINDS)])
@settings(max_examples=12)
@given(share=st.floats(0, 1, exclude_max=True))
def test_a_bag_cut_off_anywhere_is_refused(kind, share, whole, tmp_path) -> None:
    path = tmp_path / "cut.bag"
    path.write_bytes(whole[kind][: int(len(whole[kind]) * share)])
    robot = PARTED if kind.startswith("parts") else arm()
    if kind == "parts, ros1-without-index":  # nothing tells that a whole chunk is missing
        with contextlib.suppress(EpisodeError):
            read_all(path, robot)
        return
    with pytest.raises(EpisodeError) as fault:
        read_all(path, robot)
    assert "\n" not in str(fault.value)


@pytest.mark.parametrize("codec", ["zstd", "bz2", "lz4"])
def test_a_chunk_that_unpacks_to_more_than_it_says_is_refused(codec: str) -> None:
    module = import_module({"zstd": "zstandard", "lz4": "lz4.frame"}.get(codec, codec))
    with pytest.raises(ValueError, match="unpacks to"):
        container.decompress(codec, module.compress(bytes(10**6)), 1000)


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
        use_all(bags[kind], arm())
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
