"""Where the records of a file lie, and remote files read a range at a time."""

import threading
import tracemalloc
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import fsspec
import numpy as np
import pytest
from fsspec.implementations.memory import MemoryFileSystem

from hma_data.errors import EpisodeError, MissingDependencyError, StorageError
from hma_data.sources.base import Expecting, open_source
from hma_data.sources.rlds import records
from hma_data.sources.rlds.folder import open_folder
from hma_data.sources.rlds.records import RecordFraming, masked_crc, scan_tfrecord
from hma_data.storage import blocks
from hma_data.storage import remote as store
from tests.data import rlds_files
from tests.data.hub_cache import as_snapshot
from tests.data.rlds_files import tensor
from tests.data.sources.rlds.test_rlds import record as recorded
from tests.data.sources.rlds.test_rlds import toy, write

RLDS = open_source("rlds")
STEPS = {"a": tensor((2,)), "pad": tensor((4000,))}


def record(index: int, pad: int = 0) -> dict:
    return {"steps/a": np.full(4, index, np.float32), "steps/pad": np.zeros(pad, np.float32)}


def dataset(folder: Path, episodes: int = 100, shards: int = 1, pad: int = 0) -> Path:
    each = episodes // shards
    names = [f"toy-train.tfrecord-{i:05d}-of-{shards:05d}" for i in range(shards)]
    return rlds_files.write(
        folder, {n: [record(i * each + j, pad) for j in range(each)] for i, n in enumerate(names)}, STEPS
    )


def shard(folder: Path) -> Path:
    return next(folder.glob("*.tfrecord*"))


def number(folder: Path | str, name: str) -> float:
    return float(open_folder(str(folder)).example(name)[0].numbers("steps/a")[0])


def test_links_of_the_hub_cache_and_to_the_whole_folder_are_followed(tmp_path):
    snapshot = as_snapshot(dataset(tmp_path / "toy", 4), tmp_path / "cache")
    (tmp_path / "link").symlink_to(snapshot)
    for place in (snapshot, tmp_path / "link"):
        assert number(place, "train/000003") == 3


class Handler(SimpleHTTPRequestHandler):
    """Files by range; `asked` are the ranges answered."""

    asked: list[tuple[str, int]]
    ranges = True

    def log_message(self, *args):
        pass

    def do_GET(self):
        path = Path(self.translate_path(self.path))
        if not path.is_file():
            self.send_error(404)
            return
        data, status = path.read_bytes(), 200
        span = self.headers.get("Range")
        if span and self.ranges:
            first, last = span.removeprefix("bytes=").split("-")
            data, status = data[int(first) : int(last) + 1], 206
        type(self).asked.append((path.name, len(data)))
        self.send_response(status)
        self.send_header("Content-Length", str(len(data)))
        self.send_header("Accept-Ranges", "bytes" if self.ranges else "none")
        self.end_headers()
        self.wfile.write(data)


@pytest.fixture
def served(tmp_path, monkeypatch):
    monkeypatch.setattr(store, "WAITS_S", (0.0, 0.0, 0.0))

    class Own(Handler):
        asked: list = []  # noqa: RUF012 - one for each test

    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Own, directory=str(tmp_path)))
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield tmp_path, f"http://127.0.0.1:{server.server_port}/d", Own
    server.shutdown()
    server.server_close()


def test_over_http_only_the_bytes_that_are_needed_come(served):
    folder, uri, handler = served
    dataset(folder / "d", 40, 4, pad=8000)
    whole = sum(item.stat().st_size for item in (folder / "d").glob("*.tfrecord*"))
    refs = RLDS.index(uri)
    assert [ref.id for ref in refs] == [f"train/{i:06d}" for i in range(40)]
    assert number(uri, "train/000000") == 0
    assert sum(size for name, size in handler.asked if "tfrecord" in name) < whole / 5
    assert number(uri, "train/000033") == 33


def test_a_remote_index_grows_no_further_than_asked(served):
    folder, uri, handler = served
    dataset(folder / "d", 100, 1, pad=20_000)
    assert [number(uri, f"train/{i:06d}") for i in (3, 40)] == [3, 40]
    handler.asked.clear()
    assert number(uri, "train/000030") == 30
    assert len([name for name, _ in handler.asked if "tfrecord" in name]) == 1


def test_one_record_more_costs_no_pass_over_those_that_are_known():
    count, stored = 100_000, 2 * rlds_files.frame(b"abcd")
    offsets = np.arange(count) * 20 + 12
    known = RecordFraming(offsets, np.full(count, 4), np.zeros(count, np.uint32), whole=False)
    tracemalloc.start()
    found = scan_tfrecord(
        lambda start, end: stored[start % 20 : start % 20 + end - start],
        "x.tfrecord",
        20 * (count + 5),
        known,
        count + 1,
    )
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    np.testing.assert_array_equal(found.offsets, np.arange(count + 1) * 20 + 12)
    assert (found.lengths[-1], found.checks[-1], found.whole) == (4, masked_crc(b"abcd"), False)
    assert peak < 40 * count  # bytes: copies of the arrays, and no list of their numbers


def test_a_server_without_ranges_is_named(served):
    folder, uri, handler = served
    dataset(folder / "d", 4, pad=8000)
    handler.ranges = False
    with pytest.raises(StorageError, match="the server ignores range requests: copy the files here"):
        number(uri, "train/000002")


@pytest.fixture
def memory(tmp_path):
    folder = dataset(tmp_path / "d", 12, 3)
    files, root = fsspec.filesystem("memory"), f"/{tmp_path.name}"
    for path in folder.iterdir():
        files.pipe(f"{root}/{path.name}", path.read_bytes())
    return f"memory:/{root}"


def test_no_permission_is_not_tried_again(memory, monkeypatch):
    calls = []

    def cat_file(self, path, **options):
        calls.append(path)
        raise PermissionError("forbidden")

    open_folder(memory)
    monkeypatch.setattr(MemoryFileSystem, "cat_file", cat_file)
    with pytest.raises(StorageError, match=r"forbidden.*check the credentials"):
        number(memory, "train/000007")
    assert len(calls) == 1


def test_a_folder_that_may_not_be_read_is_not_called_missing(memory, monkeypatch):
    def info(self, path, **options):
        raise PermissionError("forbidden for Bearer hf_SECRET")

    monkeypatch.setattr(MemoryFileSystem, "info", info)
    with pytest.raises(StorageError, match=r"forbidden.*check the credentials") as found:
        open_folder(f"{memory}/inside")
    assert "SECRET" not in f"{found.value}{found.value.__cause__}"


@pytest.mark.parametrize(
    ("protocol", "package", "install"),
    [
        ("gs", "gcsfs", "uv sync --inexact --extra remote"),
        ("s3", "s3fs", "uv sync --inexact --extra remote"),
        ("http", "aiohttp", "uv sync --inexact --extra remote"),
        ("abfs", "adlfs", "pip install adlfs"),
    ],
)
def test_a_driver_that_is_missing_is_named_with_its_install_line(monkeypatch, protocol, package, install):
    def missing(*args, **options):
        raise ImportError(f"Install {package} to access {protocol}")

    monkeypatch.setattr(fsspec.core, "url_to_fs", missing)
    with pytest.raises(MissingDependencyError, match=install):
        RLDS.index(f"{protocol}://bucket/{package}/x")


# -- shards fetched while they are read


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
            recorded(shard * EPISODES + i, LENGTH) for i in range(EPISODES)
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
