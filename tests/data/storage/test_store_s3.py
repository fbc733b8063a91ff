"""Shard sets on S3, against moto's server on loopback: kills, lost connections, busy answers, no access."""

import random

import fsspec
import numpy as np
import pytest
import torch

from hma_data.errors import HMAError, ShardError, StorageError
from hma_data.shards.reader import ShardSet
from hma_data.shards.verify import verify
from hma_data.storage import remote as store
from hma_data.storage.remote import RemotePath, place, put_file
from tests.conftest import convert_toy as run
from tests.data.conversion.jobs import files
from tests.data.s3 import KEYS

pytestmark = pytest.mark.slow


@pytest.fixture
def out(s3_out: RemotePath) -> RemotePath:
    return s3_out


def test_s3_gets_the_bytes_that_a_folder_gets_and_gives_them_back(toy_arm, toy_file, out, whole, toy_set):
    run(toy_arm, toy_file, out)
    assert files(out) == whole
    assert verify(out) == []
    here = ShardSet(toy_set)
    for cache in (True, False):
        there = ShardSet(str(out), cache=cache)
        for index in here.episodes["episode_index"].to_pylist():
            for name, values in here.episode_rows(index).items():
                np.testing.assert_array_equal(there.episode_rows(index)[name], values)


def test_the_manifest_is_put_last(toy_arm, toy_recording, out, proxy) -> None:
    run(toy_arm, toy_recording, out)
    puts = [path for method, path, _ in proxy.log if method == "PUT" and not path.endswith(".plan")]
    assert puts[-1].endswith("manifest.json")
    assert sum("shard-" in path for path in puts) == len(ShardSet(out).manifest.shards)


def test_a_row_group_costs_one_request_after_the_footer(toy_arm, toy_recording, out, proxy) -> None:
    run(toy_arm, toy_recording, out)
    shards = ShardSet(out, cache=False)
    name = shards.manifest.shards[0].path
    shards.read(name, [0], shards.columns())
    proxy.log.clear()
    shards.read(name, [0], shards.columns())
    assert [(method, bool(asked)) for method, _, asked in proxy.log] == [("GET", True)]


@pytest.mark.slow
def test_a_large_shard_goes_up_in_parts_and_appears_whole(out, proxy, tmp_path) -> None:
    data = np.random.default_rng(0).bytes(120 << 20)
    (tmp_path / "large").write_bytes(data)
    cuts = iter([True])

    def once(method: str, path: str, number: int) -> str | None:
        return "drop" if method == "PUT" and "partNumber=2" in path and next(cuts, False) else None

    proxy.trouble = once
    put_file(tmp_path / "large", out / "large")
    assert sum("partNumber" in path for _, path, _ in proxy.log) >= 3
    assert (out / "large").stat().st_size == len(data)
    assert (out / "large").open("rb").read(100) == data[:100]


@pytest.mark.slow
def test_forked_readers_of_a_dataloader_see_the_same_batches(toy_arm, toy_file, out, toy_set) -> None:
    from hma_data.loading.dataset import WindowDataset

    run(toy_arm, toy_file, out)
    ours, theirs = WindowDataset(toy_set, "train", 4), WindowDataset(str(out), "train", 4)
    _ = theirs[0]  # the parent has connections already
    batches = torch.utils.data.DataLoader(
        theirs, batch_size=None, num_workers=1, multiprocessing_context="fork"
    )
    for found, expected in zip(list(batches)[:5], (ours[i] for i in range(5))):
        assert torch.equal(found.tokens, expected.tokens)


def test_busy_answers_and_lost_connections_change_nothing(toy_arm, toy_file, out, whole, proxy, monkeypatch):
    monkeypatch.setattr(store, "WAITS_S", (0.0,) * 9)
    draws = random.Random(1)
    failed: list[str] = []

    def sometimes(method: str, path: str, number: int) -> int | str | None:
        if draws.random() > 0.12:
            return None
        what = draws.choice([500, 503, "cut" if method == "GET" else "drop", "drop"])
        failed.append(str(what))
        return what

    proxy.trouble = sometimes
    run(toy_arm, toy_file, out)
    proxy.trouble = lambda *asked: None
    assert len(failed) >= 5
    assert files(out) == whole


def test_a_bucket_that_is_not_there_is_named(toy_arm, toy_recording, proxy) -> None:
    with pytest.raises(StorageError, match="s3://no-such-bucket/set/.plan: cannot be written: .*bucket"):
        run(toy_arm, toy_recording, place("s3://no-such-bucket/set"))
    with pytest.raises(ShardError, match="s3://no-such-bucket/set: is not a folder"):
        ShardSet("s3://no-such-bucket/set")


def test_missing_credentials_are_one_error(proxy, monkeypatch, tmp_path) -> None:
    for name in KEYS:
        monkeypatch.delenv(name)
    for name in ("AWS_CONFIG_FILE", "AWS_SHARED_CREDENTIALS_FILE"):
        monkeypatch.setenv(name, str(tmp_path / "none"))
    fsspec.get_filesystem_class("s3").clear_instance_cache()
    with pytest.raises(StorageError, match="NoCredentialsError.* — give credentials"):
        ShardSet("s3://some-bucket/set")


def test_a_shard_cut_short_is_an_error_and_no_hang(toy_arm, toy_recording, out, tmp_path) -> None:
    run(toy_arm, toy_recording, out)
    name = ShardSet(out).manifest.shards[0].path
    (tmp_path / "cut").write_bytes((out / name).read_bytes()[:-100])
    put_file(tmp_path / "cut", out / name)
    for cache in (True, False):
        with pytest.raises(HMAError, match=name):
            ShardSet(out, cache=cache).read(name, [0], ["action"])
    assert any("the manifest says" in problem for problem in verify(out))


def test_a_claim_whose_answer_was_lost_is_ones_own(toy_arm, toy_file, out, whole, proxy) -> None:
    lost = []

    def lose_first(method: str, path: str, number: int) -> str | None:
        if method == "PUT" and path.endswith("/.plan") and not lost:
            lost.append(path)
            return "lost"
        return None

    proxy.trouble = lose_first
    run(toy_arm, toy_file, out)
    assert lost and files(out) == whole
