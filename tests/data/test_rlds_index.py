"""The index of records kept on disk, and remote files read a range at a time."""

import json
import os
import struct
import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import fsspec
import numpy as np
import pytest
from fsspec.implementations.memory import MemoryFileSystem
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from hma_data.errors import EpisodeError, MissingDependencyError, SourceError
from hma_data.sources.base import open_source
from hma_data.sources.rlds import record_file
from hma_data.sources.rlds.folder import open_folder
from hma_data.sources.rlds.record_index import Framing, index_path, load_index, save_index
from hma_data.storage import fetch as fetching
from tests.data import rlds_files
from tests.data.rlds_files import encode, frame, tensor

RLDS = open_source("rlds")
FILES = fsspec.filesystem("file")
STEPS = {"a": tensor((2,)), "pad": tensor((4000,))}


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("HMA_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache" / "rlds"


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


def reopened(path: Path) -> record_file.RecordFile:
    """As another process would open it."""
    record_file._open.cache_clear()
    return record_file.open_records(FILES, str(path))


def number(folder: Path | str, name: str) -> float:
    return float(open_folder(str(folder)).example(name)[0].numbers("steps/a")[0])


# -- kept on disk


def test_a_second_process_reads_the_index_and_scans_nothing(tmp_path, cache, monkeypatch):
    path = shard(dataset(tmp_path / "d"))
    first = reopened(path).framing()
    assert len(list(cache.iterdir())) == 1
    monkeypatch.setattr("hma_data.sources.rlds.tfrecord._walk", None)
    again = reopened(path)
    np.testing.assert_array_equal(again.framing().offsets, first.offsets)
    assert again.read(70, "e") == encode(record(70))


def test_a_short_file_leaves_no_index(tmp_path, cache):
    assert len(reopened(shard(dataset(tmp_path / "d", 5))).framing()) == 5
    assert not cache.exists()


def test_a_cache_that_cannot_be_written_is_done_without(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("HMA_CACHE", str(tmp_path / "file"))
    assert len(reopened(shard(dataset(tmp_path / "d"))).framing()) == 100


def test_another_file_of_that_name_is_indexed_anew(tmp_path, cache):
    path = shard(dataset(tmp_path / "d"))
    reopened(path).framing()
    path.write_bytes(b"".join(frame(encode(record(500 + i))) for i in range(80)))
    again = reopened(path)
    assert len(again.framing()) == 80
    assert again.read(79, "e") == encode(record(579))
    assert len(list(cache.iterdir())) == 2


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_a_damaged_index_is_made_again(tmp_path, cache, data):
    folder = tmp_path / "d"
    path = shard(folder if folder.exists() else dataset(folder))
    reopened(path).framing()
    kept = next(item for item in cache.iterdir() if item.suffix == ".index")
    content = bytearray(kept.read_bytes())
    at = data.draw(st.integers(0, len(content) - 1))
    if data.draw(st.booleans()):
        content[at] ^= data.draw(st.integers(1, 255))
    else:
        content = content[:at]
    kept.write_bytes(content)
    again = reopened(path)
    assert [again.read(i, "e") for i in (0, 99)] == [encode(record(i)) for i in (0, 99)]
    kept.unlink()


def test_a_wrong_index_with_a_right_checksum_is_noticed_and_made_again(tmp_path, cache):
    path = shard(dataset(tmp_path / "d"))
    true = reopened(path).framing()
    file = reopened(path)
    for wrong in (true.offsets + 3, true.offsets[::-1].copy(), true.offsets + 10**6):
        save_index(file._name, file._mark, Framing(wrong, true.lengths, true.checks))
        assert reopened(path).read(41, "e") == encode(record(41))
    np.testing.assert_array_equal(reopened(path).framing().offsets, true.offsets)


def test_an_index_is_bound_to_path_and_mark(tmp_path, cache):
    frames = Framing(np.array([12]), np.array([5]), np.array([7], np.uint32), "cut off", False)
    save_index("file:///a", "one", frames)
    found = load_index("file:///a", "one", 100)
    assert found and (found.fault, found.whole, found.checks.tolist()) == ("cut off", False, [7])
    assert load_index("file:///a", "two", 100) is None
    index_path("file:///a", "one").rename(index_path("file:///b", "one"))
    assert load_index("file:///b", "one", 100) is None  # another file's
    assert load_index("file:///a", "one", 10) is None


def test_damaged_data_are_an_error_however_the_index_came(tmp_path):
    path = shard(dataset(tmp_path / "d"))
    offset = int(reopened(path).framing().offsets[50])
    content = bytearray(path.read_bytes())
    content[offset + 3] ^= 1
    stamp = path.stat()
    path.write_bytes(content)
    os.utime(path, ns=(stamp.st_atime_ns, stamp.st_mtime_ns))
    with pytest.raises(EpisodeError, match="checksum"):
        reopened(path).read(50, "train/000050")
    assert reopened(path).read(51, "e") == encode(record(51))


# -- links


@pytest.mark.parametrize("name", ["toy-train.tfrecord-00000-of-00002", "features.json", "dataset_info.json"])
def test_a_link_out_of_the_folder_is_refused(tmp_path, name):
    folder = dataset(tmp_path / "d", 4, 2)
    (folder / name).rename(tmp_path / "elsewhere")
    (folder / name).symlink_to(tmp_path / "elsewhere")
    if name.endswith("json"):
        with pytest.raises(SourceError, match="link to a file outside"):
            RLDS.index(str(folder))
        return
    assert [bool(ref.fingerprint) for ref in RLDS.index(str(folder))] == [False, False, True, True]
    with pytest.raises(EpisodeError, match="link to a file outside"):
        number(folder, "train/000000")
    assert number(folder, "train/000003") == 3


def test_links_of_the_hub_cache_and_to_the_whole_folder_are_followed(tmp_path):
    folder = dataset(tmp_path / "hub" / "snapshots" / "abc" / "toy", 4)
    blobs = tmp_path / "hub" / "blobs"
    blobs.mkdir()
    for i, item in enumerate(list(folder.iterdir())):
        item.rename(blobs / str(i))
        item.symlink_to(blobs / str(i))
    (tmp_path / "link").symlink_to(folder)
    for place in (folder, tmp_path / "link"):
        assert number(place, "train/000003") == 3


# -- remote


class Handler(SimpleHTTPRequestHandler):
    """Files by range; `asked` are the ranges answered, `fail` answers 503 that many times."""

    asked: list[tuple[str, int]]
    fail: list[int]
    ranges = True

    def log_message(self, *args):
        pass

    def do_GET(self):
        if self.fail[0]:
            self.fail[0] -= 1
            self.send_error(503)
            return
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
    """(folder that is served, its URI, the handler)."""
    monkeypatch.setattr(fetching, "WAITS_S", (0.0, 0.0, 0.0))

    class Own(Handler):
        asked: list = []  # noqa: RUF012 - one for each test
        fail = [0]  # noqa: RUF012

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


def test_a_remote_index_grows_no_further_than_asked_and_is_kept(served, cache):
    folder, uri, handler = served
    dataset(folder / "d", 100, 1, pad=20_000)
    assert [number(uri, f"train/{i:06d}") for i in (3, 40)] == [3, 40]
    record_file._open_remote.cache_clear()
    handler.asked.clear()
    assert number(uri, "train/000030") == 30
    assert len([name for name, _ in handler.asked if "tfrecord" in name]) == 1


def test_what_passes_by_itself_is_tried_again_and_what_does_not_is_one_error(served):
    folder, uri, handler = served
    dataset(folder / "d", 4)
    open_folder(uri)
    handler.fail[0] = 2
    assert number(uri, "train/000002") == 2
    handler.fail[0] = 1000
    with pytest.raises(SourceError, match=r"cannot be read.*503.*network failed again and again"):
        number(uri, "train/000003")
    assert handler.fail[0] >= 1000 - 2 * (len(fetching.WAITS_S) + 1)
    handler.fail[0] = 0
    shard(folder / "d").unlink()
    with pytest.raises(SourceError, match="cannot be read"):
        number(uri, "train/000003")


def test_a_server_without_ranges_is_named(served):
    folder, uri, handler = served
    dataset(folder / "d", 4, pad=8000)
    handler.ranges = False
    with pytest.raises(SourceError, match=r"range|cannot be read"):
        number(uri, "train/000002")


def test_a_server_that_is_not_there_is_one_error(monkeypatch):
    monkeypatch.setattr(fetching, "WAITS_S", (0.0, 0.0, 0.0))
    with pytest.raises(SourceError):
        RLDS.index("http://127.0.0.1:9/nothing")


@pytest.fixture
def memory(tmp_path):
    """A dataset on fsspec's file system in memory."""
    folder = dataset(tmp_path / "d", 12, 3)
    files, root = fsspec.filesystem("memory"), f"/{tmp_path.name}"
    for path in folder.iterdir():
        files.pipe(f"{root}/{path.name}", path.read_bytes())
    return f"memory:/{root}"


def test_a_connection_that_breaks_is_tried_again(memory, monkeypatch):
    true, broken = MemoryFileSystem.cat_file, []

    def cat_file(self, path, start=None, end=None, **options):
        if len(broken) < 3 and "tfrecord" in path:
            broken.append(path)
            raise ConnectionResetError("reset by peer")
        return true(self, path, start, end, **options)

    monkeypatch.setattr(MemoryFileSystem, "cat_file", cat_file)
    monkeypatch.setattr(fetching, "WAITS_S", (0.0, 0.0, 0.0))
    assert number(memory, "train/000007") == 7
    assert len(broken) == 3


def test_no_permission_is_not_tried_again(memory, monkeypatch):
    calls = []

    def cat_file(self, path, **options):
        calls.append(path)
        raise PermissionError("forbidden")

    open_folder(memory)
    monkeypatch.setattr(MemoryFileSystem, "cat_file", cat_file)
    with pytest.raises(SourceError, match=r"forbidden.*your access"):
        number(memory, "train/000007")
    assert len(calls) == 1


def test_a_remote_file_cut_short_is_an_episode_error(memory):
    files = fsspec.filesystem("memory")
    path = memory.removeprefix("memory:/") + "/toy-train.tfrecord-00001-of-00003"
    files.pipe(path, files.cat(path)[:-5])
    assert number(memory, "train/000006") == 6
    with pytest.raises(EpisodeError, match="cut off"):
        number(memory, "train/000007")


@pytest.mark.parametrize(
    ("protocol", "package"), [("gs", "gcsfs"), ("s3", "s3fs"), ("http", "aiohttp"), ("abfs", "adlfs")]
)
def test_a_driver_that_is_missing_is_named_with_its_install_line(monkeypatch, protocol, package):
    def missing(*args, **options):
        raise ImportError(f"Install {package} to access {protocol}")

    monkeypatch.setattr(fsspec.core, "url_to_fs", missing)
    with pytest.raises(MissingDependencyError, match=f"pip install {package}"):
        RLDS.index(f"{protocol}://bucket/{package}/x")


# -- shapes of files


def test_a_record_longer_than_protobuf_allows_is_refused_unread(tmp_path):
    folder = dataset(tmp_path / "d", 3)
    path = shard(folder)
    length = struct.pack("<Q", 3 << 30)
    with path.open("r+b") as file:
        file.write(length + struct.pack("<I", rlds_files.masked_crc(length)))
        file.truncate((3 << 30) + 100)  # sparse
    with pytest.raises(EpisodeError, match="more than an Example can have"):
        number(folder, "train/000000")


@pytest.mark.parametrize(
    ("name", "split"),
    [
        ("toy-test-hard.tfrecord-00000-of-00001", "test-hard"),
        ("toy-val-00000-of-00001.tfrecord", "val"),
        ("val_00000-of-00001.tfrecord", "val"),
        ("toy-val.tfrecord", "val"),
    ],
)
def test_a_split_is_told_by_the_name_of_its_file(tmp_path, name, split):
    folder = dataset(tmp_path / "d", 2)
    shard(folder).rename(folder / name)
    (folder / "dataset_info.json").write_text(json.dumps({"name": "toy", "splits": []}))
    assert RLDS.episode_ids(str(folder)) == [f"{split}/000000", f"{split}/000001"]


QUICK = settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
JSON = st.recursive(
    st.none() | st.booleans() | st.integers(-5, 2**70) | st.floats() | st.text(max_size=4),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=6), inner, max_size=3),
    max_leaves=8,
)


@QUICK
@given(data=st.data(), name=st.sampled_from(["features.json", "dataset_info.json"]))
def test_a_description_with_anything_in_it_is_read_or_refused(tmp_path, data, name):
    folder = tmp_path / "d"
    if not folder.exists():
        dataset(folder, 4, 2)
        for item in folder.glob("*.json"):
            item.with_suffix(".true").write_text(item.read_text())
    for item in folder.glob("*.true"):
        item.with_suffix(".json").write_text(item.read_text())
    tree = json.loads((folder / name).read_text())
    spot, steps = tree, data.draw(st.integers(0, 8))
    for turn in range(steps):
        keys = list(spot) if isinstance(spot, dict) else list(range(len(spot)))
        key = data.draw(st.sampled_from(keys))
        if turn < steps - 1 and isinstance(spot[key], dict | list) and spot[key]:
            spot = spot[key]
            continue
        spot[key] = data.draw(JSON)
        break
    (folder / name).write_text(json.dumps(tree))
    try:
        for ref in RLDS.index(str(folder)):
            number(folder, ref.id)
    except (SourceError, EpisodeError) as fault:
        assert str(fault)


@pytest.mark.parametrize("count", [10**15, 2**70, -3, 1e400, "many", None])
def test_a_count_of_records_that_cannot_be_is_refused(tmp_path, memory, count):
    folder = tmp_path / "d"
    text = json.dumps({"name": "toy", "splits": [{"name": "train", "shardLengths": [count, "4", "4"]}]})
    (folder / "dataset_info.json").write_text(text)
    fsspec.filesystem("memory").pipe(memory.removeprefix("memory:/") + "/dataset_info.json", text.encode())
    open_folder.__globals__["_remote"].cache_clear()
    for place in (str(folder), memory):
        with pytest.raises(SourceError, match="cannot have|are not numbers"):
            RLDS.index(place)
