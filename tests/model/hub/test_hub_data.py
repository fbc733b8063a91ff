"""Shard sets on the hub: one commit, resumed, read back the same, and what the viewer is told."""

import shutil
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hma_data.conversion import publish
from hma_data.errors import HubError, ShardError
from hma_data.shards.reader import ShardSet
from hma_data.tokenizers.shapes import palette_spec
from hma_model.hub.datasets import pull_data, push_data
from hma_model.hub.stores import FolderStore
from tests.conftest import SMALL, contents, toy_shards
from tests.hub_server import Hub
from tests.model.shards import make_shards

pytest_plugins = ["tests.hub_fixtures"]
REPO = "team/arm"


@pytest.fixture
def shards(tmp_path: Path) -> Path:
    return make_shards(tmp_path / "shards", "arm")


def dataset(server: Hub):
    return server.repositories[f"datasets/{REPO}"]


@pytest.mark.parametrize("target", [REPO, f"hf://datasets/{REPO}", "folder", "memory://data/arm"])
def test_what_is_pushed_and_pulled_is_the_same(server, shards, tmp_path, target):
    target = str(tmp_path / target) if target == "folder" else target
    push_data(shards, target)
    out = pull_data(target, tmp_path / "out")
    assert contents(out) == contents(shards)


def test_a_published_set_is_read_in_place_by_its_uri(server, shards):
    from huggingface_hub import HfFileSystem

    push_data(shards, REPO)
    server.log.clear()
    HfFileSystem.clear_instance_cache()
    there, here = ShardSet(f"hf://datasets/{REPO}"), ShardSet(shards)
    assert there.episodes.equals(here.episodes)
    rows = [one.read("val/shard-00000.parquet", [0], ["action"])["action"] for one in (there, here)]
    assert np.array_equal(*rows)
    assert "train/shard-00000.parquet" not in server.sent()
    HfFileSystem.clear_instance_cache()


def test_empty_files_that_a_hub_does_not_send_are_there(server, shards, tmp_path):
    from huggingface_hub import HfFileSystem

    from hma_data.shards.preview import describe

    server.habits.empty = False
    push_data(shards, REPO)
    HfFileSystem.clear_instance_cache()
    assert (shards / "quarantine.jsonl").read_bytes() == b""
    assert contents(pull_data(REPO, tmp_path / "out")) == contents(shards)
    assert describe(Path(f"hf://datasets/{REPO}"))["totals"]["episodes"]
    HfFileSystem.clear_instance_cache()


def test_a_small_set_is_one_commit(server, shards):
    assert push_data(shards, REPO) == f"{server.url}/datasets/{REPO}"
    assert [commit.message for commit in dataset(server).commits] == ["initial commit", "Add arm"]


def test_a_large_set_is_few_commits_with_the_manifest_in_the_last(server, shards, monkeypatch):
    monkeypatch.setattr(publish, "FILES", 1)
    push_data(shards, REPO)
    commits = dataset(server).commits
    assert [commit.message for commit in commits[1:]] == ["Add shards of arm, 1 of 2", "Add arm"]
    assert ["manifest.json" in commit.files for commit in commits] == [False, False, True]


@pytest.mark.parametrize("target", ["folder", "memory://data/many"])
def test_a_folder_is_listed_as_often_however_many_batches_are_pushed(tmp_path, monkeypatch, target):
    monkeypatch.setattr(publish, "FILES", 1)
    sizes, counts = FolderStore._sizes, []
    monkeypatch.setattr(FolderStore, "_sizes", lambda store: counts.append(store.name) or sizes(store))
    for frames in (1000, 20):
        folder = toy_shards(tmp_path / f"toy{frames}", [20] * 6, replace(SMALL, shard_frames=frames))
        out = f"{target}{frames}" if "://" in target else str(tmp_path / f"{target}{frames}")
        push_data(folder, out)
    few, many = Counter(counts).values()
    assert few == many


def test_a_push_that_was_cut_goes_on_with_what_is_missing(server, shards, monkeypatch):
    monkeypatch.setattr(publish, "FILES", 1)
    server.fail("PUT /lfs/", times=1, status=403)
    with pytest.raises(HubError):
        push_data(shards, REPO)
    push_data(shards, REPO)
    server.log.clear()
    push_data(shards, REPO)
    assert server.count("PUT ") == 0
    assert "manifest.json" in dataset(server).files


def test_an_unfinished_push_is_no_shard_set(server, shards, tmp_path, monkeypatch):
    monkeypatch.setattr(publish, "FILES", 1)
    server.create(REPO, "datasets")
    server.before_commit = [lambda: server.fail("POST .*preupload", 403, times=9)]
    with pytest.raises(HubError, match="may not write here"):
        push_data(shards, REPO)
    assert "train/shard-00000.parquet" in dataset(server).files
    with pytest.raises(HubError, match=r"has no manifest\.json.*has its push finished"):
        pull_data(REPO, tmp_path / "out")


def test_a_set_of_other_colours_is_not_pushed_over_another(server, tmp_path):
    for seed, name in enumerate(("own", "other")):
        colors = np.random.default_rng(seed).integers(0, 256, (3, 3), np.uint8)
        make_shards(tmp_path / name, "arm", spec=palette_spec("palette-64", 64, colors))
    push_data(tmp_path / "own", REPO)
    with pytest.raises(HubError, match="holds the shard set of arm under palette-64 .*, not of arm under"):
        push_data(tmp_path / "other", REPO)


def test_an_interrupted_pull_goes_on_file_by_file(server, shards, tmp_path):
    push_data(shards, REPO)
    server.fail("GET /cdn/.*train", after=500, times=99)
    with pytest.raises(HubError, match="connection was cut"):
        pull_data(REPO, tmp_path / "out")
    assert not (tmp_path / "out/train/shard-00000.parquet").exists()
    assert not (tmp_path / "out/manifest.json").exists()
    server.faults.clear()
    server.log.clear()
    pull_data(REPO, tmp_path / "out")
    assert [name for name in server.sent() if "shard-" in name] == ["train/shard-00000.parquet"]
    assert contents(tmp_path / "out") == contents(shards)


def test_a_set_made_anew_replaces_the_old_one_whole(server, shards, tmp_path):
    push_data(shards, REPO)
    shutil.rmtree(shards)
    make_shards(shards, "arm", episodes=4, held_out=0, seed=5)
    push_data(shards, REPO)
    assert "val/shard-00000.parquet" not in dataset(server).files
    assert contents(pull_data(REPO, tmp_path / "out")) == contents(shards)


def test_a_pull_removes_what_a_killed_one_has_left(shards: Path, tmp_path: Path) -> None:
    left = tmp_path / "out/train/.shard-00000.parquet.999999999.part"
    left.parent.mkdir(parents=True)
    left.touch()
    assert contents(pull_data(str(shards), tmp_path / "out")) == contents(shards)


def test_another_robots_set_is_not_overwritten(server, shards, tmp_path):
    push_data(shards, REPO)
    before = dataset(server).files
    with pytest.raises(
        HubError, match=r"holds the shard set of arm under raw, not of hand.*push to another address"
    ):
        push_data(make_shards(tmp_path / "hand", "hand"), REPO)
    assert dataset(server).files == before


def test_a_dataset_of_something_else_is_left_alone(server, shards):
    server.create(REPO, "datasets").commit({"data/x.csv": b"1"})
    with pytest.raises(HubError, match=r"holds something else: data/x\.csv"):
        push_data(shards, REPO)


SHARD = "train/shard-00000.parquet"


@pytest.mark.parametrize(
    ("name", "said"),
    [
        (SHARD, r"is not the file that manifest\.json names"),
        *(
            (one, ".*hma shards restat")
            for one in ("embodiment.yaml", "episodes.parquet", "quarantine.jsonl")
        ),
        ("manifest.json", ".*hma shards restat"),
    ],
)
def test_a_set_with_another_file_than_its_manifest_names_is_not_published(server, shards, name, said):
    path = shards / name
    path.write_bytes(path.read_bytes()[:-1] + (b"x" if name == SHARD else b"\n\n"))
    with pytest.raises(ShardError, match=f"{name}.*{said}"):
        push_data(shards, REPO)
    assert server.log == []


def test_a_push_finds_that_another_robots_set_came_meanwhile(server, shards, tmp_path):
    hand = make_shards(tmp_path / "hand", "hand")
    server.create(REPO, "datasets")
    server.before_commit = [lambda: push_data(hand, REPO)]
    with pytest.raises(HubError, match="holds the shard set of hand"):
        push_data(shards, REPO)
    assert b"hand" in dataset(server).files["manifest.json"]


HOSTILE = {  # a file on the hub, what becomes of it, and what the error says
    **{
        name: (name, lambda content: content + b"\n", rf"{name}: is not the file that manifest\.json names")
        for name in ("episodes.parquet", "embodiment.yaml", "quarantine.jsonl")
    },
    "a shard": (SHARD, lambda _: b"other", r"is not the shard that manifest\.json names"),
    "a name elsewhere": (
        "manifest.json", lambda content: content.replace(b"train/shard-00000", b"../../escaped"),
        "is not the name of a shard",
    ),
    "a key twice": (
        "manifest.json", lambda content: content.replace(b"{", b'{"shards": [],', 1),
        r"manifest\.json: is damaged: key 'shards' is given twice",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", HOSTILE)
def test_a_hostile_set_is_refused_on_pulling(server, shards, tmp_path, case):
    name, change, said = HOSTILE[case]
    push_data(shards, REPO)
    dataset(server).commit({name: change(dataset(server).files[name])})
    with pytest.raises(ShardError, match=said):
        pull_data(REPO, tmp_path / "out")
    assert not (tmp_path / "out/manifest.json").exists() and not list(tmp_path.rglob("*escaped*"))


def test_another_set_in_the_folder_is_not_overwritten(server, shards, tmp_path):
    push_data(shards, REPO)
    with pytest.raises(HubError, match="holds another shard set"):
        pull_data(REPO, make_shards(tmp_path / "hand", "hand"))


@pytest.mark.parametrize("name", ["hf://datasets/x", "hf://datasets/a/b/c"])
def test_a_wrong_name_is_refused(server, shards, name):
    with pytest.raises(HubError, match="is not hf://datasets/ORGANISATION/NAME"):
        push_data(shards, name)
