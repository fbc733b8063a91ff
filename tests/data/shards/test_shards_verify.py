"""Verification finds whatever is wrong with a shard set, and says where and what to do."""

import hashlib
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hma_data.conversion.job import convert
from hma_data.conversion.plan import Settings
from hma_data.conversion.rewrite import restat
from hma_data.errors import ShardError
from hma_data.shards.manifest import EMBODIMENT, EPISODES, MANIFEST, Manifest, derive
from hma_data.shards.reader import ShardSet
from hma_data.shards.verify import verify
from tests.conftest import contents, toy_shards, write_toy
from tests.hostile import Edit, cut, flip, swap, whole

SMALL = Settings(val_fraction=0.3, shard_frames=40)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return toy_shards(tmp_path_factory.mktemp("made") / "set", [14, 15, 16, 17, 18], SMALL)


@pytest.fixture
def sound(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "set"))


def one(problems: list[str], *words: str) -> str:
    """The one problem, a single line that says all of `words` and what to do."""
    assert len(problems) == 1, problems
    assert "\n" not in problems[0]
    assert " — " in problems[0]
    for word in words:
        assert word in problems[0]
    return problems[0]


def test_a_sound_set_has_no_problems_however_it_is_verified(made: Path) -> None:
    assert verify(made) == []
    assert verify(made, workers=3) == []
    assert verify(made, quick=True) == []


@given(st.data())
def test_a_flipped_bit_in_any_byte_of_any_file_is_found(made: Path, data: st.DataObject) -> None:
    path = made / data.draw(st.sampled_from(sorted(contents(made))))
    content = path.read_bytes()
    if not content:
        return
    place = data.draw(st.integers(0, len(content) - 1))
    bit = data.draw(st.integers(0, 7))
    try:
        flip(place, 1 << bit)(path)
        problems = verify(made)
        assert any(path.name in problem for problem in problems)
        assert all("\n" not in problem for problem in problems)
    finally:
        path.write_bytes(content)


@pytest.mark.parametrize("name", ["episodes.parquet", "quarantine.jsonl", "embodiment.yaml"])
def test_a_missing_file_is_found_and_restat_brings_it_back(sound: Path, made: Path, name: str) -> None:
    (sound / name).unlink()
    assert all(name in problem and "restat" in problem for problem in verify(sound))
    assert verify(sound)
    restat(sound)
    assert verify(sound) == []
    assert (sound / name).read_bytes() == (made / name).read_bytes()


SHARD, FOREIGN = "train/shard-00001.parquet", "not in the manifest"
DAMAGE: dict[str, tuple[str, Edit, tuple[str, ...]]] = {  # the file, what is done to it, and what is said
    "no shard": ("val/shard-00000.parquet", Path.unlink, ("val/shard-00000.parquet", "missing", "convert")),
    "killed": ("train/.shard-00000.parquet.12.part", whole("?"), (".part", "killed")),
    **{f"cut at {kept}": (SHARD, cut(kept), (SHARD, "bytes", "convert")) for kept in (0, 3, 4, 100, -20, -1)},
    "a foreign folder": ("extra", Path.mkdir, ("extra", FOREIGN)),
    **{
        name: (name, whole("?"), (name, FOREIGN))
        for name in ("train/shard-00099.parquet", "val/x.txt", "a.txt")
    },
}


@pytest.mark.parametrize("case", DAMAGE)
def test_a_file_that_is_missing_cut_or_foreign_is_one_problem(sound: Path, case: str) -> None:
    name, spoil, said = DAMAGE[case]
    spoil(sound / name)
    one(verify(sound), *said)
    one(verify(sound, quick=True), *said)


def test_without_a_manifest_it_says_how_to_rebuild_it(sound: Path, made: Path) -> None:
    (sound / MANIFEST).unlink()
    one(verify(sound), "has no manifest.json", "hma convert", "hma shards restat")
    restat(sound)
    assert (sound / MANIFEST).read_bytes() == (made / MANIFEST).read_bytes()


@pytest.mark.parametrize(
    "text", [b"", b"[]", b"{}", b"null", b'"x"', b"\xff\xfe", b"[" * 100_000, b'{"schema_version": 7}', b"{"]
)
def test_a_manifest_of_anything_else_is_one_clear_error(sound: Path, made: Path, text: bytes) -> None:
    (sound / MANIFEST).write_bytes(text)
    one(verify(sound), "manifest.json")
    if b"7" not in text:
        restat(sound)
        assert (sound / MANIFEST).read_bytes() == (made / MANIFEST).read_bytes()


OUTSIDE = ("../../etc/passwd", "/etc/passwd", "train/../../x", "train/shard-1.parquet")


@pytest.mark.parametrize(
    ("written", "other", "said"),
    [
        *(("train/shard-00000.parquet", name, "not the name of a shard") for name in OUTSIDE),
        ('"train": {', '"../../x": {', "is damaged: it lacks"),
        ('"val": {', '"../../x": {', "is damaged: it lacks"),
        ('"sha256": "', '"sha256": "/../../../uv', r"'/../../../uv\w+' is not the sha256 of a shard"),
    ],
)
def test_a_manifest_that_names_what_is_in_no_set_is_refused(sound, written, other, said) -> None:
    swap(written, other)(sound / MANIFEST)
    with pytest.raises(ShardError, match=said):
        Manifest.load(sound)


@pytest.mark.parametrize("name", ["train/../../shard-00000.parquet", "val/shard-00000.parquet"])
def test_an_episode_in_a_shard_of_no_or_another_split_is_refused(sound: Path, name: str) -> None:
    table = pq.read_table(sound / EPISODES)
    moved = [name if split == "train" else "val/shard-00000.parquet" for split in table["split"].to_pylist()]
    pq.write_table(table.set_column(table.column_names.index("shard"), "shard", [moved]), sound / EPISODES)
    with pytest.raises(ShardError, match=r"episodes\.parquet: .*shard.*hma shards restat"):
        ShardSet(sound).index("train")


def test_a_manifest_of_another_run_is_found(sound: Path, tmp_path: Path, toy_arm, block_tokenizer) -> None:
    write_toy(tmp_path / "other.hdf5", [14, 15, 16, 17, 20])
    convert(toy_arm, str(tmp_path / "other.hdf5"), block_tokenizer, tmp_path / "other", settings=SMALL)
    (sound / MANIFEST).write_bytes((tmp_path / "other" / MANIFEST).read_bytes())
    assert any("shard-00000.parquet" in problem for problem in verify(sound))
    assert not verify(tmp_path / "other")


def reseal(folder: Path, change) -> None:
    values = json.loads((folder / MANIFEST).read_text())
    change(values)
    values["manifest_sha256"] = "0" * 64
    text = json.dumps(values)
    sealed = text.replace("0" * 64, hashlib.sha256(text.encode()).hexdigest(), 1)
    (folder / MANIFEST).write_text(sealed)


CHANGES = {
    "splits": lambda m: m["splits"]["train"].update(episodes=3),
    "quarantined": lambda m: m["totals"].update(quarantined=2),
    "stats": lambda m: m["stats"]["action"]["mean"].__setitem__(0, 0.123),
    "plan's hash": lambda m: m["plan"].update(recording="0123456789abcdef"),
    "row_groups": lambda m: m["shards"][0].update(row_groups=[1, 2]),
    "another tokenizer": lambda m: m["tokenizer"].update(version=2),
    "another embodiment": lambda m: m["embodiment"].update(target_hz=1.0),
}


@pytest.mark.parametrize("said", CHANGES)
def test_a_manifest_that_says_something_false_is_found(sound: Path, said: str) -> None:
    reseal(sound, lambda values: None)
    assert verify(sound) == []
    reseal(sound, CHANGES[said])
    assert any(said in problem for problem in verify(sound)), verify(sound)


def footer(path: Path) -> dict[bytes, bytes]:
    metadata = pq.read_metadata(path).metadata
    return {key: value for key, value in metadata.items() if key != b"ARROW:schema"}


def write(path: Path, table: pa.Table, metadata: dict[bytes, bytes]) -> None:
    with pq.ParquetWriter(path, table.schema) as writer:
        writer.write_table(table)
        writer.add_key_value_metadata(metadata)


def derive_anew(folder: Path) -> None:
    old = Manifest.load(folder)
    names = [shard.path for shard in old.shards]
    derive(folder, names, old.embodiment, old.plan, old.source).write(folder)


def with_values(table: pa.Table, column: str, change) -> pa.Table:
    place, kind = table.schema.get_field_index(column), table.schema.field(column).type
    array = table[column].combine_chunks()
    nested = pa.types.is_fixed_size_list(kind)
    values = np.array((array.flatten() if nested else array).to_numpy(zero_copy_only=False))
    change(values)
    flat = pa.array(values, kind.value_type if nested else kind)
    new = pa.FixedSizeListArray.from_arrays(flat, type=kind) if nested else flat
    return table.set_column(place, table.schema.field(column), new)


def narrow(table: pa.Table) -> pa.Table:
    flat = pa.array(np.zeros(len(table) * 2, np.float32))
    place = table.schema.get_field_index("action")
    return table.set_column(place, "action", pa.FixedSizeListArray.from_arrays(flat, 2))


def put(column: str, place: int, value: float) -> Callable[[pa.Table], pa.Table]:
    return lambda table: with_values(table, column, lambda values: values.__setitem__(place, value))


WRONG = {
    "vocabulary": put("tokens", 5, 4096),
    "not finite": put("action", 4, np.nan),
    "statistics": put("action", 4, 99),
    "frame_index": put("frame_index", 3, 9),
    "episode_index": put("episode_index", 0, 3),
    "go back": put("timestamp", 3, 0.0),
    "row by row": lambda table: table.slice(1),
    "columns": narrow,
}


@pytest.mark.parametrize("said", WRONG)
def test_rows_that_are_wrong_are_found(sound: Path, said: str) -> None:
    path = sound / "train" / "shard-00000.parquet"
    write(path, WRONG[said](pq.read_table(path)), footer(path))
    derive_anew(sound)
    problems = verify(sound)
    assert any(said in problem and "shard-00000" in problem for problem in problems), problems


def test_episodes_of_one_recording_in_both_splits_are_found(sound: Path) -> None:
    for path in [*sound.glob("train/*"), *sound.glob("val/*")]:
        metadata = footer(path)
        values = json.loads(metadata[b"hma"])
        for row in values["episodes"]:
            row["group"] = "one"
        write(path, pq.read_table(path), metadata | {b"hma": json.dumps(values).encode()})
    derive_anew(sound)
    assert any("both splits" in problem for problem in verify(sound))


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("train/shard-00001.parquet", "hma convert"),
        (EMBODIMENT, r"embodiment.yaml: cannot be read: No such file .* hma convert"),
    ],
)
def test_restat_refuses_what_lacks_a_file_where_the_manifest_is_lost_too(sound, name, said) -> None:
    for lost in (MANIFEST, name):
        (sound / lost).unlink()
    with pytest.raises(ShardError, match=said):
        restat(sound)


def test_the_command_that_helps_names_a_folder_with_a_space_as_a_shell_takes_it(sound: Path) -> None:
    folder = sound.rename(sound.with_name("my set"))
    (folder / MANIFEST).write_text("{")
    one(verify(folder), "is damaged", f"hma shards restat '{folder}' rebuilds")


def test_restat_refuses_a_damaged_shard(sound: Path) -> None:
    shard = sound / "train" / "shard-00001.parquet"
    cut(-30)(shard)
    with pytest.raises(ShardError, match="shard-00001"):
        restat(sound)


def test_a_damaged_page_is_known_where_the_manifest_is_lost(sound: Path) -> None:
    (sound / MANIFEST).unlink()
    shard = sound / "train" / "shard-00001.parquet"
    columns = pq.read_metadata(shard).row_group(0)
    tokens = next(
        columns.column(i)
        for i in range(columns.num_columns)
        if columns.column(i).path_in_schema.startswith("tokens")
    )
    flip(tokens.data_page_offset + tokens.total_compressed_size - 1)(shard)
    with pytest.raises(ShardError, match="shard-00001"):
        restat(sound)
    assert not (sound / MANIFEST).exists()
