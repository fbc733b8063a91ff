"""Sets made of sets: nothing is lost, the outcome depends on the episodes alone."""

import json
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest

from hma_data.conversion.job import convert
from hma_data.conversion.plan import Settings
from hma_data.conversion.rewrite import merge, split
from hma_data.errors import ShardError, UsageError
from hma_data.registry.embodiment import Embodiment
from hma_data.shards.reader import ShardSet
from hma_data.shards.verify import verify
from tests.conftest import ARM_YAML, BlockTokenizer, contents, toy_shards, write_toy

SMALL = Settings(val_fraction=0.3, shard_frames=40)


def make(folder: Path, lengths: list[int], settings: Settings = SMALL, yaml: str = ARM_YAML) -> Path:
    return toy_shards(folder, lengths, settings, yaml)


def episodes(folder: Path) -> dict[str, tuple]:
    """id -> everything stored of an episode but its number and place."""
    shards = ShardSet(folder)
    found = {}
    for row in shards.episodes.to_pylist():
        values = shards.episode_rows(row["episode_index"], ["timestamp", "tokens", "action"])
        for name in ("episode_index", "shard", "row_start", "split"):
            row.pop(name)
        found[row["id"]] = (row, *(value.tobytes() for value in values.values()))
    return found


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make(tmp_path_factory.mktemp("made") / "set", [14, 15, 16, 17, 18, 9, 30])


def test_split_is_what_converting_with_that_seed_gives(made: Path, tmp_path: Path) -> None:
    other = Settings(val_fraction=0.5, seed=3, shard_frames=40)
    expected = make(tmp_path / "set", [14, 15, 16, 17, 18, 9, 30], other)
    manifest = split(made, tmp_path / "split", val_fraction=0.5, seed=3)
    assert manifest.splits["val"]["episodes"] >= 1
    assert verify(tmp_path / "split") == []
    mine, theirs = contents(tmp_path / "split"), contents(expected)
    source = json.loads(theirs["manifest.json"])["source"]
    assert mine.keys() == theirs.keys()
    for name in mine:
        if name.endswith(".parquet") and "shard" in name:
            assert mine[name] == theirs[name], name
    assert source != manifest.source  # the recordings lay in two folders; all else is equal


@pytest.mark.parametrize("workers", [1, 3])
def test_split_gives_the_same_bytes_for_any_number_of_workers(made, tmp_path, workers) -> None:
    split(made, tmp_path / "a", seed=5)
    split(made, tmp_path / "b", seed=5, workers=workers)
    assert contents(tmp_path / "a") == contents(tmp_path / "b")
    assert episodes(tmp_path / "a") == episodes(made)
    (tmp_path / "a" / "embodiment.yaml").unlink()  # the same call writes it again
    split(made, tmp_path / "a", seed=5)
    assert contents(tmp_path / "a") == contents(tmp_path / "b")


def test_split_by_instruction_keeps_equal_instructions_together(made: Path, tmp_path: Path) -> None:
    split(made, tmp_path / "a", by="instruction", val_fraction=0.4)
    assert verify(tmp_path / "a") == []
    table = ShardSet(tmp_path / "a").episodes
    assert set(table["split"].to_pylist()) == {"train", "val"}  # none has an instruction: each is its own


def test_split_refuses_what_it_cannot_do(made: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="must be at least 0 and below 1"):
        split(made, tmp_path / "a", val_fraction=1.5)
    with pytest.raises(UsageError, match="holds the shard set"):
        split(made, made)
    with pytest.raises(UsageError, match="holds the shard set"):
        split(made, made / "train")
    assert not (tmp_path / "a").exists()


def test_merge_holds_every_episode_of_every_set_in_its_split(made: Path, tmp_path: Path) -> None:
    other = make(tmp_path / "other", [11, 12, 13])
    merge([made, other], tmp_path / "all")
    assert verify(tmp_path / "all") == []
    table = ShardSet(tmp_path / "all").episodes
    assert table["episode_index"].to_pylist() == list(range(10))
    assert len(set(table["id"].to_pylist())) == 10
    assert table["id"].to_pylist()[0] == "1/demo_0"
    assert table["id"].to_pylist()[-1] == "2/demo_2" or "demo_6" in table["id"].to_pylist()
    merged, before = episodes(tmp_path / "all"), {**episodes(other)}
    for name, stored in before.items():
        assert merged[f"2/{name}"][1:] == stored[1:]
    sources = set(table["source"].to_pylist())
    assert sources == {ShardSet(made).manifest.source, ShardSet(other).manifest.source}
    splits = [*ShardSet(made).episodes["split"].to_pylist(), *ShardSet(other).episodes["split"].to_pylist()]
    assert table["split"].to_pylist() == splits


def test_merge_refuses_to_train_on_what_another_set_holds_out(made: Path, tmp_path: Path) -> None:
    split(made, tmp_path / "again", val_fraction=0.5, seed=3)
    with pytest.raises(ShardError, match=r"all: would have \d+ episodes in train that are also in val"):
        merge([made, tmp_path / "again"], tmp_path / "all")
    assert not (tmp_path / "all").exists()


def test_merge_gives_the_same_bytes_wherever_the_sets_lie(made: Path, tmp_path: Path) -> None:
    merge([made, made], tmp_path / "a")
    elsewhere = shutil.copytree(made, tmp_path / "moved" / "set")
    merge([elsewhere, made], tmp_path / "b", workers=2)
    assert contents(tmp_path / "a") == contents(tmp_path / "b")


def test_quarantine_is_carried_along(tmp_path: Path) -> None:
    folder = tmp_path / "set"
    write_toy(folder.with_suffix(".hdf5"), [14, 15, 16])
    with h5py.File(folder.with_suffix(".hdf5"), "r+") as file:
        file["data/demo_1/actions"][3] = np.nan
    convert(
        Embodiment.from_yaml(ARM_YAML),
        str(folder.with_suffix(".hdf5")),
        BlockTokenizer(),
        folder,
        settings=SMALL,
        max_quarantine=1,
    )
    manifest = merge([folder, folder], tmp_path / "all")
    assert manifest.quarantined == 2
    assert [item["id"] for item in ShardSet(tmp_path / "all").refused()] == ["1/demo_1", "2/demo_1"]
    assert verify(tmp_path / "all") == []


@pytest.mark.parametrize(
    "change", [("dims: 3, names: [a, b, c]", "dims: 3, names: [a, b, d]"), ("target_hz: 5", "target_hz: 2")]
)
def test_merge_refuses_another_embodiment(made: Path, tmp_path: Path, change: tuple[str, str]) -> None:
    other = make(tmp_path / "other", [11, 12], yaml=ARM_YAML.replace(*change))
    with pytest.raises(ShardError, match="embodiment|stride"):
        merge([made, other], tmp_path / "all")
    assert not (tmp_path / "all").exists()


def test_a_set_without_states_merges_with_one_that_has_them(tmp_path: Path) -> None:
    state = "state: {components: [{key: actions, dims: 3, names: [a, b, c]}]}\n"
    full = make(tmp_path / "full", [14, 15, 16], yaml=ARM_YAML + state)
    bare = make(tmp_path / "bare", [11, 12, 13])
    assert ShardSet(full).embodiment.state is not None
    for number, both in enumerate(([full, bare], [bare, full])):
        merge(both, tmp_path / str(number))
        assert verify(tmp_path / str(number)) == []
        merged = ShardSet(tmp_path / str(number))
        assert merged.embodiment.state is None and set(merged.manifest.stats) == {"action"}
        found = episodes(tmp_path / str(number))
        for place, folder in enumerate(both, start=1):
            for name, stored in episodes(folder).items():
                assert found[f"{place}/{name}"][1:] == stored[1:]


def test_several_cameras_and_strided_rows_survive(tmp_path: Path) -> None:
    settings = Settings(frames="strided", cameras=("top", "side"), val_fraction=0.3, shard_frames=20)
    folder = make(tmp_path / "set", [14, 15, 16, 17], settings)
    merge([folder, folder], tmp_path / "all")
    split(tmp_path / "all", tmp_path / "again", val_fraction=0.5)
    assert verify(folder) == []
    assert verify(tmp_path / "all") == []
    assert verify(tmp_path / "again") == []
    assert episodes(tmp_path / "again") == episodes(tmp_path / "all")


def test_a_set_extended_beyond_its_limit_is_split_whole(tmp_path: Path) -> None:
    write_toy(tmp_path / "toy.hdf5", [14, 15, 16, 17])
    arm, recording = Embodiment.from_yaml(ARM_YAML), str(tmp_path / "toy.hdf5")
    for limit, extend in ((2, False), (4, True)):
        settings = Settings(val_fraction=0.3, limit=limit)
        convert(arm, recording, BlockTokenizer(), tmp_path / "set", settings=settings, extend=extend)
    split(tmp_path / "set", tmp_path / "again", seed=2)
    assert verify(tmp_path / "set") == []
    assert verify(tmp_path / "again") == []
    assert episodes(tmp_path / "again") == episodes(tmp_path / "set")
    assert len(episodes(tmp_path / "set")) == 4
