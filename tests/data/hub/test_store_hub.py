"""Shard sets on the Hugging Face Hub, written and read by `hf://datasets/…`, against a hub on loopback."""

import functools
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hma_data.conversion import publish
from hma_data.conversion.job import Conversion, convert
from hma_data.conversion.output import Share
from hma_data.conversion.plan import Settings
from hma_data.conversion.publish import HubOutput
from hma_data.errors import HubError, OutputError, ShardError, StorageAwayError
from hma_data.hub import repository as hub_repository
from hma_data.registry.embodiment import Embodiment
from hma_data.shards.reader import ShardSet
from hma_data.shards.verify import verify
from hma_data.storage import blocks
from hma_data.storage import remote as store
from hma_data.storage.files import cache_folder
from hma_data.storage.remote import place
from tests.conftest import SMALL, BlockTokenizer
from tests.hub_server import Hub, Repository
from tests.hub_state import EVERY

pytest_plugins = ["tests.hub_fixtures"]
OUT = "hf://datasets/team/arm/sets/one"


@pytest.fixture
def hub(server: Hub, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Hub]:
    from huggingface_hub import HfFileSystem

    monkeypatch.setattr(store, "WAITS_S", (0.0, 0.0, 0.0))
    monkeypatch.setenv("HMA_CACHE", str(tmp_path / "hma"))
    monkeypatch.setattr(publish, "FILES", 2)
    server.tokens["reader"] = "read"
    HfFileSystem.clear_instance_cache()
    yield server
    HfFileSystem.clear_instance_cache()


def run(arm: Embodiment, recording: Path, settings: Settings = SMALL, out: str = OUT, **options):
    return convert(arm, str(recording), BlockTokenizer(), Path(out), settings=settings, **options)


def dataset(hub: Hub) -> Repository:
    return hub.repositories["datasets/team/arm"]


def published(hub: Hub) -> dict[str, bytes]:
    files = dataset(hub).files
    return {
        name.removeprefix("sets/one/"): data for name, data in files.items() if name.startswith("sets/one/")
    }


def test_a_repository_gets_the_bytes_that_a_folder_gets_in_few_commits(toy_arm, toy_file, hub, whole) -> None:
    summary = run(toy_arm, toy_file)
    assert str(summary.out) == OUT
    assert published(hub) == whole
    _initial, *commits = dataset(hub).commits
    shards = sum("shard-" in name for name in whole)
    assert len(commits) == (shards + 1) // 2
    assert ["sets/one/manifest.json" in commit.files for commit in commits] == [
        *[False] * (len(commits) - 1),
        True,
    ]
    assert run(toy_arm, toy_file).made_shards == 0
    assert len(dataset(hub).commits) == len(commits) + 1


def test_a_set_on_the_hub_is_read_and_verified_by_its_uri(toy_arm, toy_file, hub, toy_set) -> None:
    run(toy_arm, toy_file)
    here = ShardSet(toy_set)
    for cache in (False, True):
        there = ShardSet(OUT, cache=cache)
        assert there.episodes.equals(here.episodes)
        for index in here.episodes["episode_index"].to_pylist()[:3]:
            for name, values in here.episode_rows(index).items():
                np.testing.assert_array_equal(there.episode_rows(index)[name], values)
    assert verify(Path(OUT)) == []
    with pytest.raises(ShardError, match="is not a folder"):
        ShardSet("hf://datasets/team/arm/none")


def test_verifying_lists_folders_equally_often_for_many_shards(toy_arm, toy_file, hub, monkeypatch) -> None:
    monkeypatch.setattr(blocks, "REQUESTS", 1)  # the client lists for each thread that reads
    monkeypatch.setattr(blocks, "_cache", functools.cache(blocks._cache.__wrapped__))
    found = []
    for frames in (60, 10):
        hub.repositories.clear()
        shutil.rmtree(cache_folder(), ignore_errors=True)
        run(toy_arm, toy_file, replace(SMALL, shard_frames=frames))
        hub.log.clear()
        assert verify(Path(OUT), workers=1) == []
        found.append((sum("shard-" in name for name in published(hub)), hub.count("/tree/")))
    (few, listings), (many, same) = found
    assert many > 2 * few and listings == same


def test_a_commit_of_others_is_seen_where_the_set_is_named_again(toy_arm, toy_file, hub) -> None:
    run(toy_arm, toy_file)
    assert verify(Path(OUT)) == []
    name = next(name for name in dataset(hub).files if "shard-" in name)
    whole = dataset(hub).files[name]
    for content, said in ((None, "is missing"), (whole + b" ", "bytes, the manifest says"), (whole, "")):
        dataset(hub).commit({name: content})
        (problem,) = verify(Path(OUT)) or [""]
        assert said in problem and bool(said) == bool(problem)


def test_a_listing_that_was_cut_between_its_pages_is_made_anew(toy_arm, toy_file, hub) -> None:
    run(toy_arm, toy_file)
    there = place(OUT)
    names = there.listing()
    hub.habits.page = 2
    for answered in range(1, 5):
        there = place(OUT)
        hub.gone_after = len(hub.log) + answered
        with pytest.raises(StorageAwayError):
            there.listing()
        hub.gone_after = None
        assert there.listing() == names


def test_a_range_is_read_without_bytes_after_it(toy_arm, toy_file, hub) -> None:
    run(toy_arm, toy_file)
    dataset(hub).commit({"sets/one/large.bin": bytes(3_000_000)})
    assert len(store.fetch_range(place(f"{OUT}/large.bin"), 10, 1_000_010)) == 1_000_000
    assert hub.sent("large.bin") == {"sets/one/large.bin": 1_000_000}


def test_lost_staging_makes_the_same_shards_and_uploads_none_again(toy_arm, toy_file, hub, whole) -> None:
    run(toy_arm, toy_file)
    before = len(dataset(hub).commits)
    shutil.rmtree(cache_folder() / "staging")
    run(toy_arm, toy_file)
    assert published(hub) == whole and len(dataset(hub).commits) == before


def test_an_upload_lists_the_repository_once_however_many_commits_it_makes(toy_arm, toy_file, hub) -> None:
    run(toy_arm, toy_file, replace(SMALL, shard_frames=10))
    output, there = HubOutput.of(place(OUT)), published(hub)
    hub.repositories.clear()
    output.prepare()
    hub.log.clear()
    output.upload()
    assert published(hub) == there
    assert len(dataset(hub).commits) == 1 + (sum("shard-" in name for name in there) + 1) // 2 == 7
    assert hub.count("/tree/") == 0  # `prepare` did


def test_a_listing_is_kept_after_own_commits_and_made_anew_after_those_of_others(hub) -> None:
    hub.create("team/arm", "datasets")
    ours = hub_repository.Repository("team/arm", write=True, kind="dataset")
    assert set(ours.files()) == {".gitattributes"}
    ours.publish(lambda: ours.files() and {"a.bin": b"a", "b.txt": b"b", "c.txt": b"c"}, "three")
    ours.publish(lambda: ours.files() and {"a.bin": None, "b.txt": b"bb"}, "two")
    assert ours.files().items() >= {"b.txt": 2, "c.txt": 1}.items() and not ours.holds("a.bin")
    assert ours.has("b.txt", b"bb") and not ours.has("b.txt", b"b") and hub.count("/tree/") == 1
    dataset(hub).commit({"b.txt": b"theirs"})
    assert ours.holds("b.txt") and ours.has("b.txt", b"theirs") and hub.count("/tree/") == 2


def test_a_commit_of_others_with_the_same_files_hides_none_of_their_others(hub) -> None:
    hub.create("team/arm", "datasets")
    ours = hub_repository.Repository("team/arm", write=True, kind="dataset")

    def changes() -> dict[str, bytes]:
        ours.files()
        dataset(hub).commit({"a.bin": b"a", "theirs.txt": b"theirs"})
        return {"a.bin": b"a"}

    ours.publish(changes, "ours")
    assert [commit.message for commit in dataset(hub).commits] == ["initial commit", "by hand"]
    assert ours.holds("theirs.txt")


def test_another_conversion_is_refused_before_anything_is_made_and_overwrite_replaces_it(
    toy_arm, toy_file, hub, whole
) -> None:
    run(toy_arm, toy_file, replace(SMALL, seed=3, shard_frames=30))
    dataset(hub).commit({"README.md": b"# mine"})
    shutil.rmtree(cache_folder() / "staging")
    with pytest.raises(OutputError, match=f"{OUT}: belongs to another conversion; different: settings"):
        run(toy_arm, toy_file)
    assert not list((cache_folder() / "staging").rglob("shard-*"))
    run(toy_arm, toy_file, overwrite=True)
    assert published(hub) == whole
    assert dataset(hub).files["README.md"] == b"# mine"


def test_a_branch_gets_the_set_and_main_none_of_it(toy_arm, toy_file, hub, whole) -> None:
    out = "hf://datasets/team/arm@dev/sets/one"
    run(toy_arm, toy_file, out=out)
    there = dataset(hub).at("dev").files
    assert {name: there[f"sets/one/{name}"] for name in whole} == whole
    assert set(dataset(hub).files) == {".gitattributes"}
    before = len(dataset(hub).commits)
    run(toy_arm, toy_file, out=out)
    assert len(dataset(hub).commits) == before
    with pytest.raises(OutputError, match=r"@dev/sets/one: belongs to another conversion"):
        run(toy_arm, toy_file, replace(SMALL, seed=3), out=out)


def test_a_lack_of_rights_is_known_before_anything_is_made(toy_arm, toy_recording, hub, monkeypatch) -> None:
    monkeypatch.delenv("HF_TOKEN")
    with pytest.raises(HubError, match=f"{OUT}: needs a token to be written — log in with hf auth login"):
        run(toy_arm, toy_recording)
    hub.create("team/arm", "datasets")
    for token, said in (("reader", "may not write here"), ("wrong", "token is not valid.*hf auth login")):
        monkeypatch.setenv("HF_TOKEN", token)
        with pytest.raises(HubError, match=said):
            run(toy_arm, toy_recording)
    assert not list(cache_folder().rglob("shard-*"))


@pytest.mark.parametrize(("number", "told"), [(1, True), (2, False)])
def test_a_commit_whose_answer_was_lost_is_not_made_twice(toy_arm, toy_file, hub, whole, number, told):
    hub.habits.tells_oids = told
    plain, lost = hub.create("team/arm", "datasets").commit, []

    def commit(files, message="by hand"):
        made = plain(files, message)
        lost.append(message)
        if len(lost) == number:
            raise ConnectionResetError
        return made

    dataset(hub).commit = commit
    run(toy_arm, toy_file)
    assert published(hub) == whole and len(lost) == len(set(lost))
    assert len(dataset(hub).commits) == 1 + (sum("shard-" in name for name in whole) + 1) // 2


@pytest.mark.parametrize("step", EVERY)
def test_an_upload_cut_at_any_request_is_ended_by_the_same_command(
    toy_arm, toy_file, hub, whole, monkeypatch, step
) -> None:
    run(toy_arm, toy_file)
    output, commits = HubOutput.of(place(OUT)), len(dataset(hub).commits)
    for at in range(0, 200, step):
        hub.repositories.clear()
        hub.objects.clear()
        hub.gone_after = len(hub.log) + at
        try:
            output.prepare()
            output.upload()
            break
        except HubError as fault:
            assert OUT in str(fault) and fault.remedy
        hub.gone_after = None
        output.prepare()
        output.upload()
        assert published(hub) == whole
        assert len(dataset(hub).commits) == commits
    assert 20 < at < 200 - step


def test_two_jobs_of_one_conversion_at_once_make_it_together(
    toy_arm, toy_file, hub, whole, monkeypatch, tmp_path
) -> None:
    def other() -> None:
        monkeypatch.setenv("HMA_CACHE", str(tmp_path / "hma of another machine"))
        run(toy_arm, toy_file)
        monkeypatch.setenv("HMA_CACHE", str(tmp_path / "hma"))

    hub.before_commit = [lambda: None, other]
    run(toy_arm, toy_file)
    assert published(hub) == whole
    assert len(dataset(hub).commits) == 1 + (sum("shard-" in name for name in whole) + 1) // 2


def test_what_a_hub_cannot_take_is_told(toy_arm, toy_recording, hub) -> None:
    with pytest.raises(OutputError, match="names no dataset of the hub"):
        run(toy_arm, toy_recording, out="hf://team/arm")
    with pytest.raises(OutputError, match="takes whole conversions only"):
        Conversion(toy_arm, toy_recording, BlockTokenizer(), Path(OUT), settings=SMALL).run_share(Share(0, 2))
