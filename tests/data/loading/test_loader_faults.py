"""What is wrong with shard sets is said when it is met, naming the file."""

import json
import shutil
from collections.abc import Callable
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from hma_data.errors import ShardError, UsageError
from hma_data.loading.dataset import MixtureDataset, WindowDataset
from hma_data.shards import writer
from recipes.bench.loader import make_set
from tests.data.loading.test_pools import SMALL

FIRST = "train/shard-00000.parquet"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("faults")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(writer, "ROW_GROUP", 300)
        for i in range(2):
            make_set(folder / str(i), i, SMALL)
    return folder


@pytest.fixture
def sets(made: Path, tmp_path: Path) -> list[Path]:
    return [Path(shutil.copytree(made / str(i), tmp_path / str(i))) for i in range(2)]


def rewrite(folder: Path, change: Callable[[str, np.ndarray], np.ndarray], shard: str = FIRST) -> None:
    file = pq.ParquetFile(folder / shard)
    size = file.metadata.row_group(0).num_rows
    table = file.read()
    for i, field in enumerate(table.schema):
        if pa.types.is_fixed_size_list(field.type):
            values = table[field.name].combine_chunks().flatten().to_numpy().reshape(len(table), -1)
            values = change(field.name, values.copy())
            flat = pa.array(values.ravel(), field.type.value_type)
            column = pa.FixedSizeListArray.from_arrays(flat, values.shape[1])
            table = table.set_column(i, pa.field(field.name, column.type, nullable=False), column)
    (folder / shard).unlink()
    pq.write_table(table, folder / shard, row_group_size=size)


def edit(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    values = json.loads((folder / "manifest.json").read_text())
    change(values)
    (folder / "manifest.json").write_text(json.dumps(values))


@pytest.mark.parametrize(
    ("column", "value", "fault"),
    [
        ("action", np.inf, "1 rows have actions that are not finite; the first is episode 2 frame 7"),
        ("tokens", 262_144, "token 262144 is outside the vocabulary, 0 to 262143"),
    ],
)
def test_numbers_that_would_spoil_a_training_are_refused(sets: list[Path], column, value, fault) -> None:
    def spoil(name: str, values: np.ndarray) -> np.ndarray:
        if name == column:
            values[2 * 60 + 7, 1] = value
        return values

    rewrite(sets[1], spoil)
    with pytest.raises(ShardError, match=fault) as raised:
        WindowDataset(sets[1], "train", 6).batch([0])
    assert raised.value.where == f"{sets[1]}/{FIRST}"


def truncated(path: Path) -> None:
    data = path.read_bytes()
    path.unlink()
    path.write_bytes(data[: len(data) // 2])


@pytest.mark.parametrize("damage", [Path.unlink, truncated])
@pytest.mark.parametrize("workers", [0, 1])
def test_a_shard_that_goes_while_training_stops_it_with_its_name(sets, damage, workers) -> None:
    data = MixtureDataset(sets, 16, 6, pool=1, memory_mib=1)
    batches = data.batches(workers)
    taken = len(list(islice(batches, 2)))
    for folder in sets:
        for shard in sorted((folder / "train").iterdir())[1:]:
            damage(shard)
    with pytest.raises(ShardError, match=r"train/shard-0000[123].parquet: cannot be read"):
        for _ in batches:
            taken += 1
    assert data.state_dict()["step"] == taken


def test_a_shard_that_is_back_lets_the_same_run_go_on(sets: list[Path], made: Path) -> None:
    whole = [b.tokens for b in islice(MixtureDataset(sets[:1], 16, 6, pool=1), 60)]
    data = MixtureDataset(sets[:1], 16, 6, pool=1)
    shards = sorted((sets[0] / "train").iterdir())[1:]
    away = [shard.rename(shard.with_suffix(".gone")) for shard in shards]
    found = []
    with pytest.raises(ShardError):
        found += [b.tokens for b in islice(data, 60)]
    for shard, other in zip(shards, away, strict=True):
        other.rename(shard)
    step = data.state_dict()["step"]
    rest = [b.tokens for b in islice(data, 60 - step)]
    assert all((a == b).all() for a, b in zip(whole[step:], rest, strict=True))


@pytest.mark.parametrize("column", ["tokens", "action"])
def test_one_flipped_bit_of_a_column_is_found(sets: list[Path], column: str) -> None:
    path = sets[0] / FIRST
    group = pq.ParquetFile(path).metadata.row_group(0)
    chunks = [group.column(i) for i in range(group.num_columns)]
    (chunk,) = (one for one in chunks if one.path_in_schema.split(".")[0].startswith(column))
    data = bytearray(path.read_bytes())
    begin = min(place for place in (chunk.dictionary_page_offset, chunk.data_page_offset) if place)
    data[begin + chunk.total_compressed_size // 2] ^= 1  # of literals: decompression does not notice
    path.unlink()
    path.write_bytes(bytes(data))
    with pytest.raises(ShardError, match=f"{FIRST}: "):
        WindowDataset(sets[0], "train", 6).batch(range(200))


def test_sets_of_two_tokenizers_are_refused_naming_both(sets: list[Path]) -> None:
    edit(sets[1], lambda values: values["tokenizer"].update(weights_sha256="0" * 64))
    with pytest.raises(ShardError, match="a mixture needs one tokenizer") as raised:
        MixtureDataset(sets, 4, 6)
    assert str(sets[0]) in str(raised.value) and str(sets[1]) in str(raised.value)


def test_rows_that_cannot_give_the_stride_are_refused(sets: list[Path]) -> None:
    edit(sets[0], lambda values: values["plan"].update(frame_stride=3))
    with pytest.raises(ShardError, match="keeps one of every 3 recorded frames, but the stride is 2"):
        MixtureDataset(sets, 4, 6)


def test_a_set_without_shards_is_refused(sets: list[Path]) -> None:
    edit(sets[0], lambda values: values.update(shards=[]))
    pq.write_table(pq.read_table(sets[0] / "episodes.parquet").slice(0, 0), sets[0] / "episodes.parquet")
    with pytest.raises(ShardError, match="has no window of 6 frames.*leave this embodiment out"):
        MixtureDataset(sets, 4, 6)


def test_a_lost_episodes_file_is_refused(sets: list[Path]) -> None:
    (sets[0] / "episodes.parquet").unlink()
    with pytest.raises(ShardError, match="episodes.parquet: cannot be read"):
        MixtureDataset(sets, 4, 6)


@pytest.mark.parametrize(
    "wrong",
    [
        {"batch_size": 0},
        {"frames": 0},
        {"rank": 2, "world": 2},
        {"lanes": 0},
        {"pool": 0},
        {"weights": {"leg": 2.0}},
    ],
)
def test_settings_that_cannot_be_are_refused(made: Path, wrong: dict[str, Any]) -> None:
    with pytest.raises(UsageError):
        MixtureDataset([made / "0", made / "1"], **({"batch_size": 4, "frames": 6} | wrong))


@pytest.mark.parametrize("windows", [[-1], [10**9], []])
def test_windows_that_are_not_there_are_an_index_error(made: Path, windows: list[int]) -> None:
    with pytest.raises(IndexError, match="window"):
        WindowDataset(made / "0", "train", 6).batch(windows)


def test_a_state_of_another_run_is_refused_with_what_differs(made: Path) -> None:
    data = MixtureDataset([made / "0", made / "1"], 4, 6)
    for key, value in {"lanes": 3, "counts": [1, 2], "p": [0.1, 0.9], "frames": 7}.items():
        with pytest.raises(UsageError, match=f"sampler state: was saved with {key}"):
            data.load_state_dict(data.state_dict() | {key: value})
    with pytest.raises(UsageError, match="sampler state: was saved with names None"):
        data.load_state_dict({})
