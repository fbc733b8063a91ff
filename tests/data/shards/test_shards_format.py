"""docs/format.md is enough: a reader written from it alone, and other people's readers of parquet."""

import base64
import hashlib
import json
import math
import re
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from hma_data.conversion.plan import Settings
from hma_data.registry.components import Camera
from hma_data.registry.embodiment import _DECIDES
from hma_data.shards.reader import EpisodeReader, ShardSet
from hma_data.shards.schema import Footer, arrow_schema
from hma_data.shards.stats import Stats
from hma_data.shards.windows import WindowIndex
from hma_data.shards.writer import ShardWriter
from hma_data.tokenizers.base import TokenizerSpec
from tests.conftest import ARM_YAML, toy_shards

YAML = ARM_YAML.replace("cameras:", "state: {components: [{key: actions, dims: 2, slice: [0, 2]}]}\ncameras:")


# -- a reader written from docs/format.md; nothing of hma_data is used


def digest(value: Any) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:16]


def summary(parts: list[dict[str, Any]]) -> dict[str, Any]:
    n, mean, m2 = 0, 0.0, 0.0
    parts = [part for part in parts if part["count"]]
    for part in parts:
        total, delta = n + part["count"], np.array(part["mean"]) - mean
        m2 = m2 + np.array(part["m2"]) + delta**2 * (n * part["count"] / total)
        mean, n = mean + delta * (part["count"] / total), total
    low, high = (f([part[key] for part in parts], axis=0) for f, key in ((np.min, "min"), (np.max, "max")))
    return {"count": n, "mean": mean, "std": np.sqrt(m2 / n), "min": low, "max": high}


def quantile(sketch: dict[str, Any], q: float) -> list[float]:
    flat = np.frombuffer(zlib.decompress(base64.b64decode(sketch["values"])), "<f4")
    values = flat.reshape(-1, sketch["width"])
    weights = np.concatenate([np.full(m, 2.0**level) for level, m in enumerate(sketch["rows"])])
    found = []
    for column in values.T:
        order = np.argsort(column, kind="stable")
        reach = np.cumsum(weights[order]) - weights[order] / 2
        found.append(float(column[order][np.argmax(reach >= q * weights.sum())]))
    return found


class Reader:
    def __init__(self, folder: Path) -> None:
        text = (folder / "manifest.json").read_bytes()
        self.folder, self.manifest = folder, json.loads(text)
        seal = self.manifest["manifest_sha256"]
        assert hashlib.sha256(text.replace(seal.encode(), b"0" * 64, 1)).hexdigest() == seal
        assert self.manifest["schema_version"] == 1
        listed = {one["path"]: one["sha256"] for one in self.manifest["shards"]} | self.manifest["files"]
        for name, sha256 in listed.items():
            assert hashlib.sha256((folder / name).read_bytes()).hexdigest() == sha256, name
        plan = {key: value for key, value in self.manifest["plan"].items() if key != "hash"}
        assert digest(plan) == self.manifest["plan"]["hash"]
        self.episodes = pq.read_table(folder / "episodes.parquet").to_pylist()
        self.footers = [
            json.loads(pq.read_metadata(folder / s["path"]).metadata[b"hma"]) for s in self.manifest["shards"]
        ]

    @property
    def stride(self) -> int:
        robot = self.manifest["embodiment"]
        rate = robot.get("sync", {}).get("rate_hz") or robot["frequency_hz"]
        given = robot.get("stride") or max(1, math.floor(rate / robot.get("target_hz", 2) + 0.5))
        return given // self.manifest["plan"]["frame_stride"]

    def episode(self, row: dict[str, Any], camera: int = 0) -> dict[str, np.ndarray]:
        table = pq.read_table(self.folder / row["shard"])
        mine = table.slice(row["row_start"], row["length"])
        assert set(mine["episode_index"].to_pylist()) == {row["episode_index"]}
        assert mine["frame_index"].to_pylist() == list(range(row["length"]))
        values = {name: np.array(mine[name].to_pylist()) for name in mine.column_names}
        name = self.manifest["plan"]["cameras"][camera]
        return values | {"tokens": values[f"tokens_{name}" if camera else "tokens"]}

    def windows(self, split: str, frames: int, camera: int = 0) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        s, (h, w) = self.stride, self.manifest["tokenizer"]["grid"]
        for row in self.episodes:
            if row["split"] == split:
                values = self.episode(row, camera)
                for start in range(max(0, row["length"] - frames * s + 1)):
                    rows = slice(start, start + frames * s)
                    yield (
                        values["tokens"][rows][::s].reshape(frames, h, w),
                        values["action"][rows].reshape(frames, -1),
                    )


@pytest.fixture(scope="module", params=["all", "strided"])
def made(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    settings = Settings(val_fraction=0.4, shard_frames=40, frames=request.param, cameras=("top", "side"))
    return toy_shards(tmp_path_factory.mktemp("made") / "set", [14, 25, 16, 17, 18, 600], settings, YAML)


def test_a_reader_from_the_page_gives_the_rows(made: Path) -> None:
    reader, shards = Reader(made), ShardSet(made)
    for row in reader.episodes:
        columns = EpisodeReader(shards, shards.columns())
        for camera, name in enumerate(("top", "side")):
            theirs = reader.episode(row, camera)
            for column, values in columns.episode(row, name).items():
                np.testing.assert_array_equal(theirs[column], values)


def test_a_reader_from_the_page_finds_the_same_windows(made: Path) -> None:
    reader, shards = Reader(made), ShardSet(made)
    for split in ("train", "val"):
        assert sum(1 for _ in reader.windows(split, 4)) == WindowIndex.of(shards, split, 4).count
    tokens, chunks = next(reader.windows("train", 4))
    assert tokens.shape == (4, 8, 8)
    assert chunks.shape == (4, reader.manifest["plan"]["frame_stride"] * reader.stride * 3)


def test_statistics_follow_from_the_footers_as_the_page_says(made: Path) -> None:
    reader = Reader(made)
    for name in ("action", "state"):
        said = reader.manifest["stats"][name]
        parts = [footer["stats"][name] for footer in reader.footers if footer["split"] == "train"]
        for key, value in summary(parts).items():
            np.testing.assert_allclose(said[key], value, rtol=1e-12, atol=1e-12)


def test_a_sketch_is_read_as_the_page_says() -> None:
    rows = np.random.default_rng(0).normal(size=(5000, 3)).astype(np.float32)
    stats = Stats.of(rows)
    for name, q in (("q01", 0.01), ("q50", 0.5), ("q90", 0.9)):
        assert quantile(stats.to_json()["sketch"], q) == stats.summary()["quantiles"][name]


def test_the_split_and_the_cut_follow_from_the_plan(made: Path) -> None:
    reader = Reader(made)
    settings = reader.manifest["plan"]["settings"]
    draws = {}
    for row in reader.episodes:
        text = f"{settings['seed']}/{row['group'] or row['id']}"
        draws[row["id"]] = int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "big") / 2**64
    held = {name for name, u in draws.items() if u < settings["val_fraction"]} or {min(draws, key=draws.get)}
    assert {row["id"] for row in reader.episodes if row["split"] == "val"} == held
    cut = [[f["name"], [row["episode_index"] for row in f["episodes"]]] for f in reader.footers]
    assert digest(cut) == reader.manifest["plan"]["shards"]
    recording = [[row["id"], row["fingerprint"]] for row in reader.episodes]
    assert digest(recording) == reader.manifest["plan"]["recording"]


def test_row_groups_hold_whole_episodes_where_they_fit(made: Path) -> None:
    for shard in Reader(made).manifest["shards"]:
        metadata = pq.read_metadata(made / shard["path"])
        sizes = [metadata.row_group(i).num_rows for i in range(metadata.num_row_groups)]
        assert sizes == shard["row_groups"]
        assert max(sizes) <= 2048


def counts(made: Path) -> tuple[int, int]:
    manifest = Reader(made).manifest
    return manifest["splits"]["train"]["rows"], manifest["splits"]["train"]["episodes"]


def first_tokens(made: Path) -> tuple[int, list[int]]:
    row = next(row for row in Reader(made).episodes if row["split"] == "train")
    return row["episode_index"], Reader(made).episode(row)["tokens"][0].tolist()


def test_duckdb_reads_it(made: Path) -> None:
    import duckdb

    rows, episodes = counts(made)
    shards = f"'{made}/train/*.parquet'"
    found = duckdb.sql(f"SELECT count(*), count(DISTINCT episode_index) FROM {shards}").fetchall()[0]
    assert found == (rows, episodes)
    index, tokens = first_tokens(made)
    query = f"SELECT tokens FROM {shards} WHERE episode_index = {index} AND frame_index = 0"
    assert list(duckdb.sql(query).fetchall()[0][0]) == tokens
    joined = duckdb.sql(
        f"SELECT e.id, count(*) FROM {shards} s JOIN '{made}/episodes.parquet' e USING (episode_index) "
        "GROUP BY e.id"
    ).fetchall()
    assert len(joined) == episodes


def test_polars_reads_it(made: Path) -> None:
    import polars

    table = polars.read_parquet(f"{made}/train/*.parquet")
    assert (len(table), table["episode_index"].n_unique()) == counts(made)
    index, tokens = first_tokens(made)
    mine = table.filter(polars.col("episode_index") == index)
    assert mine["tokens"][0].to_list() == tokens


def test_hugging_face_datasets_reads_it(made: Path, tmp_path: Path) -> None:
    import datasets

    files = {split: f"{made}/{split}/*.parquet" for split in ("train", "val")}
    loaded = datasets.load_dataset("parquet", data_files=files, cache_dir=str(tmp_path))
    assert loaded["train"].num_rows == counts(made)[0]
    assert loaded["train"][0]["tokens"] == first_tokens(made)[1]


def test_random_tokens_of_18_bits_cost_less_than_600_bytes_a_frame(tmp_path: Path) -> None:
    """256 tokens, 7 action values: nothing in them can be compressed but the 14 bits above 18."""
    spec = TokenizerSpec("any", 1, "discrete", 256, (16, 16), 2**18, (512, 512))
    rng = np.random.default_rng(0)
    frames = 4096
    path = tmp_path / "train" / "shard-00000.parquet"
    plan = {"embodiment": "a", "embodiment_hash": "", "tokenizer": spec.to_json(), "hash": "0"}
    actions = rng.normal(size=(frames, 7)).astype(np.float32)
    with ShardWriter(path, arrow_schema(spec, 7, 0), spec) as writer:
        for start in range(0, frames, 128):
            tokens = rng.integers(0, 2**18, (128, 16, 16), dtype=np.uint32)
            own = actions[start : start + 128]
            writer.add(start // 128, {"timestamp": np.arange(128) / 5, "tokens": tokens, "action": own})
        stats = {"action": Stats.of(actions)}
        writer.close(Footer(plan, "train/shard-00000.parquet", "train", (), (), stats))
    metadata = pq.read_metadata(path)
    columns = [
        metadata.row_group(g).column(c)
        for g in range(metadata.num_row_groups)
        for c in range(metadata.num_columns)
    ]
    tokens_only = sum(c.total_compressed_size for c in columns if c.path_in_schema.startswith("tokens"))
    assert tokens_only / frames < 590  # 576 are the information
    # all but the random actions, which are incompressible too
    assert (path.stat().st_size - 4 * actions.size) / frames < 600


def test_row_groups_of_large_frames_hold_fewer_of_them(tmp_path: Path) -> None:
    spec = TokenizerSpec("pixels", 1, "continuous", 256, (256, 256), channels=3, dtype="uint8")
    path = tmp_path / "shard.parquet"
    plan = {"embodiment": "a", "embodiment_hash": "", "tokenizer": spec.to_json(), "hash": "0"}
    pictures = np.arange(100, dtype=np.uint8)[:, None, None, None] + np.zeros((3, 256, 256), np.uint8)
    with ShardWriter(path, arrow_schema(spec, 1, 0), spec) as writer:
        for episode, length in enumerate((30, 50, 10, 100)):
            actions = np.zeros((length, 1), np.float32)
            time = np.arange(length) / 10
            writer.add(episode, {"timestamp": time, "latents": pictures[:length], "action": actions})
        stats = {"action": Stats.of(np.zeros((190, 1), np.float32))}
        writer.close(Footer(plan, "train/shard-00000.parquet", "train", (), (), stats))
    file = pq.ParquetFile(path)
    groups = [file.metadata.row_group(i).num_rows for i in range(file.num_row_groups)]
    assert groups == [80, 10, 85, 15]
    stored = file.read_row_group(3, ["latents"]).column(0).combine_chunks().flatten().to_numpy()
    np.testing.assert_array_equal(stored.reshape(15, -1)[:, 0], np.arange(85, 100))


def test_the_page_names_the_keys_that_the_hash_of_an_embodiment_is_of() -> None:
    page = (Path(__file__).parents[3] / "docs/format.md").read_text()
    (row,) = (line for line in page.splitlines() if line.startswith("| `embodiment_hash` |"))
    named = set(re.findall(r"`(\w+)`", row)) - {"embodiment", "embodiment_hash", "size"}
    assert named == {*_DECIDES, *_DECIDES["source"]}
    assert _DECIDES["cameras"]["__all__"] == set(Camera.model_fields) - {"size"}
