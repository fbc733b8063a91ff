"""Shard sets in object stores are read as those of this machine: by ranges, or from copies kept here."""

import copy
import hashlib
import os
import shutil
import uuid
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from fsspec.implementations.memory import MemoryFileSystem

from hma_data.errors import ShardError, StorageAwayError, StorageError
from hma_data.shards import reader as shard_cache
from hma_data.shards.preview import describe
from hma_data.shards.reader import ShardSet
from hma_data.shards.verify import verify
from hma_data.storage import remote as store
from hma_data.storage.files import file_sha256
from hma_data.storage.remote import RemotePath, place, put_bytes, put_file, remote_file


def a_disk_with(monkeypatch: pytest.MonkeyPatch, free: int, total: int) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=free, total=total))


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(store, "WAITS_S", (0.0, 0.0, 0.0))
    a_disk_with(monkeypatch, free=1 << 40, total=1 << 41)
    monkeypatch.setenv("HMA_CACHE", str(tmp_path / "cache"))


@pytest.fixture
def bucket() -> RemotePath:
    path = place(f"memory://{uuid.uuid4().hex}")
    assert isinstance(path, RemotePath)
    return path


@pytest.fixture
def both(toy_set: Path, tmp_path: Path, bucket: RemotePath) -> tuple[Path, RemotePath]:
    shutil.copytree(toy_set, tmp_path / "set")
    for path in (tmp_path / "set").rglob("*"):
        if path.is_file():
            put_file(path, bucket / "set" / path.relative_to(tmp_path / "set"))
    return tmp_path / "set", bucket / "set"


def test_a_uri_is_a_path_that_is_joined_listed_and_pickled(bucket: RemotePath) -> None:
    put_bytes(b"one", bucket / "set/train/a.bin")
    put_bytes(b"", bucket / "set/.lock")
    folder = place(f"{bucket}/set")
    assert str(folder / "train" / "a.bin") == f"{bucket}/set/train/a.bin"
    assert [path.name for path in folder.iterdir()] == [".lock", "train"]
    assert list(folder.glob("train/[!.]*")) == [folder / "train/a.bin"]
    assert (folder / "train/a.bin").relative_to(folder).as_posix() == "train/a.bin"
    assert (folder / "train").is_dir() and not (folder / "train").is_file()
    assert (folder / "train/a.bin").stat().st_size == 3
    assert not (folder / "absent").exists()
    assert copy.deepcopy(folder) == folder == place(Path(str(folder)))


@pytest.mark.parametrize("name", ["here/there", "a:b", "C:/x", "/abs", "what:ever/x", "file:///some/set"])
def test_paths_and_file_uris_of_this_machine_stay_what_they_are(name: str) -> None:
    assert place(name) == Path(name.removeprefix("file://")) and not store.is_remote(place(name))


def test_a_scheme_that_no_store_has_is_refused() -> None:
    with pytest.raises(StorageError, match="foo://bucket/set: is in no known store"):
        place("foo://bucket/set")


def test_a_remote_path_is_never_taken_for_one_of_this_machine(bucket: RemotePath) -> None:
    with pytest.raises(TypeError, match="is not a local file"):
        open(bucket / "x")  # noqa: PTH123, SIM115
    with pytest.raises(StorageError, match="written as a whole"):
        (bucket / "x").open("w")


def test_any_read_of_a_range_file_gives_the_bytes_that_are_there(bucket: RemotePath) -> None:
    data = np.random.default_rng(0).bytes(3 << 20)
    put_bytes(data, bucket / "x")
    file, rng, at = remote_file(bucket / "x"), np.random.default_rng(1), 0
    for _ in range(200):
        if rng.random() < 0.5:
            at = file.seek(int(rng.integers(len(data) + 10)))
        count = int(rng.integers(1 << 17))
        assert file.read(count) == data[at : at + count]
        at = file.tell()
    assert file_sha256(bucket / "x") == hashlib.sha256(data).hexdigest()


def test_reading_is_tried_again_and_ends_in_one_error(bucket, monkeypatch) -> None:
    put_bytes(b"some bytes", bucket / "x")
    real, left = MemoryFileSystem.cat_file, [2]

    def stumbling(self, *args, **options):
        left[0] -= 1
        if left[0] >= 0:
            raise ConnectionResetError("cut")
        return real(self, *args, **options)

    monkeypatch.setattr(MemoryFileSystem, "cat_file", stumbling)
    assert (bucket / "x").read_bytes() == b"some bytes"
    left[0] = 1000
    with pytest.raises(
        StorageAwayError, match=r"/x: cannot be read: ConnectionResetError: cut — the network failed"
    ):
        (bucket / "x").read_bytes()


def test_a_listing_that_fails_is_asked_for_again_and_never_short(bucket, monkeypatch) -> None:
    folder, plain, failures = bucket / "some" / "set", MemoryFileSystem.ls, [ConnectionResetError("cut")] * 2
    put_bytes(b"a", folder / "train" / "a.bin")

    def stumbling(files, path, detail=True, **options):
        if failures and path.endswith("train"):
            raise failures.pop()
        return plain(files, path, detail=detail, **options)

    monkeypatch.setattr(MemoryFileSystem, "ls", stumbling)
    assert list(folder.glob("*/*.bin")) == [folder / "train" / "a.bin"] and not failures
    failures += [PermissionError("no")]
    with pytest.raises(StorageError, match="cannot be listed: .*no"):
        list(folder.glob("*/*.bin"))


@pytest.mark.parametrize("cache", [True, False])
def test_a_remote_set_reads_as_the_local_one(both: tuple[Path, RemotePath], cache: bool) -> None:
    here, there = ShardSet(both[0]), ShardSet(str(both[1]), cache=cache)
    assert there.manifest == here.manifest
    assert there.episodes.equals(here.episodes)
    assert there.refused() == here.refused()
    for index in here.episodes["episode_index"].to_pylist():
        expected, found = here.episode_rows(index), there.episode_rows(index)
        for name, values in expected.items():
            np.testing.assert_array_equal(found[name], values)
    assert sorted(path.name for path in (shard_cache.cache_folder() / "shards").glob("*")) == (
        sorted(f"{shard.sha256}.parquet" for shard in here.manifest.shards) if cache else []
    )


def damaged_shard(folder: RemotePath) -> str:
    name = ShardSet(folder).manifest.shards[0].path
    data = bytearray((folder / name).read_bytes())
    data[100] ^= 1
    put_bytes(bytes(data), folder / name)
    return name


def test_info_and_verify_take_uris(both: tuple[Path, RemotePath]) -> None:
    assert {**describe(Path(str(both[1]))), "folder": ""} == {**describe(both[0]), "folder": ""}
    assert verify(Path(str(both[1]))) == []
    put_bytes(b"stray", both[1] / "train/stray.txt")
    name = damaged_shard(both[1])
    problems = verify(both[1])
    assert any("sha256 differs" in problem and name in problem for problem in problems)
    assert any("train/stray.txt: is not in the manifest" in problem for problem in problems)


def test_a_set_that_is_not_there_is_one_clear_error(bucket: RemotePath) -> None:
    with pytest.raises(ShardError, match=f"{bucket}/none: is not a folder"):
        ShardSet(f"{bucket}/none")
    put_bytes(b"x", bucket / "begun/train/shard-00000.parquet")
    with pytest.raises(ShardError, match=f"{bucket}/begun: has no manifest.json"):
        ShardSet(f"{bucket}/begun")


def test_a_copy_with_other_bytes_than_the_manifest_says_is_refused(both: tuple[Path, RemotePath]) -> None:
    name = damaged_shard(both[1])
    with pytest.raises(ShardError, match="its bytes are not those of the manifest"):
        ShardSet(both[1]).read(name, [0], ["action"])
    assert not list((shard_cache.cache_folder() / "shards").iterdir())


def test_the_cache_keeps_to_its_bound_and_drops_what_was_not_used_for_longest(both, monkeypatch) -> None:
    shards = ShardSet(both[1])
    total = sum(shard.bytes for shard in shards.manifest.shards)
    folder = shard_cache.cache_folder() / "shards"
    folder.mkdir(parents=True)
    for age, name in enumerate(("newer", "older")):
        (folder / f"{name}.parquet").write_bytes(b"0" * 1000)
        used = (folder / name).parent.stat().st_mtime - 2 * shard_cache.IN_USE_S - age * 100
        os.utime(folder / f"{name}.parquet", (used, used))
    monkeypatch.setenv("HMA_CACHE_GB", str((total + 1500) / 1e9))
    for shard in shards.manifest.shards:
        shards.read(shard.path, [0], ["action"])
    assert (folder / "newer.parquet").exists() and not (folder / "older.parquet").exists()
    assert sum(path.stat().st_size for path in folder.iterdir()) <= total + 1500


@pytest.mark.parametrize(
    ("free", "total", "kept"),
    [
        (22 * 10**9, 252 * 10**9, True),  # a large disk, nearly full, has room for a few shards all the same
        (5 * 10**9, 252 * 10**9, False),
        (2 * 10**9, 10 * 10**9, True),
        (10**9, 10 * 10**9, False),
    ],
)
def test_some_of_the_disk_is_left_free(both, monkeypatch, free, total, kept) -> None:
    a_disk_with(monkeypatch, free, total)
    shards = ShardSet(both[1])
    shards.read(shards.manifest.shards[0].path, [0], ["action"])
    assert bool(list((shard_cache.cache_folder() / "shards").glob("*.parquet"))) == kept


def test_a_set_larger_than_the_cache_or_with_none_is_read_by_ranges(both, monkeypatch) -> None:
    for stated in ("0", "0.000001"):
        monkeypatch.setenv("HMA_CACHE_GB", stated)
        shards = ShardSet(both[1])
        name = shards.manifest.shards[0].path
        np.testing.assert_array_equal(
            shards.read(name, [0], ["action"])["action"],
            ShardSet(both[0]).read(name, [0], ["action"])["action"],
        )
    assert not (shard_cache.cache_folder() / "shards").exists()
