"""Small shard sets for the tests of this folder: a mark that moves over the grid as its actions say."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from hma_data.registry.embodiment import Embodiment
from hma_data.shards.manifest import derive
from hma_data.shards.schema import EpisodeRow, Footer, arrow_schema, flags_text, token_column
from hma_data.shards.stats import Stats
from hma_data.shards.writer import ShardWriter
from hma_data.tokenizers.base import TokenizerSpec
from tests.model.robots import SPEC, yaml


def episode(
    rng: np.random.Generator, length: int, dims: int, grid: tuple[int, int] = (2, 3)
) -> tuple[np.ndarray, np.ndarray]:
    """Tokens (T, h, w) and actions (T, A): the first action's sign moves a mark by one every 2 rows."""
    cells = grid[0] * grid[1]
    signs = rng.choice([-1.0, 1.0], size=length)
    signs[1::2] = signs[: len(signs[1::2]) * 2 : 2]
    place = np.concatenate([[0], np.cumsum(signs)[:-1]]) // 2 + rng.integers(cells)
    tokens = np.full((length, cells), 9)
    tokens[np.arange(length), place.astype(int) % cells] = 50
    actions = np.concatenate([signs[:, None], rng.normal(size=(length, dims - 1))], axis=1)
    return tokens.reshape(length, *grid), actions.astype(np.float32)


def state(folder: Path, column: str, first: Sequence[Any] = (), last: Sequence[Any] = ()) -> None:
    """Let episodes.parquet state other values of a column for the first or the last episodes."""
    path = folder / "episodes.parquet"
    table = pq.read_table(path)
    at, kept = table.schema.get_field_index(column), table[column].to_pylist()
    values = [*first, *kept[len(first) : len(kept) - len(last)], *last]
    field = table.schema.field(at)
    pq.write_table(table.set_column(at, field, pa.array(values, field.type)), path)


def state_pauses(folder: Path, *pauses: dict[int, int]) -> None:
    """Let episodes.parquet state pauses of the first episodes: recorded frame -> steps to the next one."""
    state(folder, "flags", [flags_text(0, {}, one) for one in pauses])


def make_shards(
    folder: Path, name: str, dims: int = 2, episodes: int = 6, length: int = 24, seed: int = 0,
    spec: TokenizerSpec = SPEC, held_out: int = 1, space: str = "joint_position",
) -> Path:  # fmt: skip
    """A finished shard set of one embodiment; its last episodes are for validation."""
    rng = np.random.default_rng(seed)
    embodiment = Embodiment.from_yaml(yaml(name, dims, space=space))
    plan = {
        "embodiment": name,
        "embodiment_hash": embodiment.digest,
        "tokenizer": spec.to_json(),
        "hash": f"{seed:x}",
        "frame_stride": 1,
        "cameras": ["top"],
    }
    whole = [episode(rng, length, dims, spec.grid) for _ in range(episodes)]
    parts = {"train": range(episodes - held_out), "val": range(episodes - held_out, episodes)}
    parts = {split: numbers for split, numbers in parts.items() if numbers}
    for split, numbers in parts.items():
        path = f"{split}/shard-00000.parquet"
        with ShardWriter(folder / path, arrow_schema(spec, dims, 0), spec) as writer:
            rows = []
            for number in numbers:
                tokens, actions = whole[number]
                frames = tokens.astype(np.uint32)
                if spec.kind == "continuous":
                    frames = rng.normal(size=(length, spec.channels, *spec.grid)).astype(np.float16)
                start, clock = writer.rows, np.arange(length) / 10
                writer.add(number, {"timestamp": clock, token_column(spec)[0]: frames, "action": actions})
                place = (split, path, start, length, length)
                rows.append(EpisodeRow(number, f"e{number}", *place, "", None, "", 0, 0, 0, "{}", 0, ""))
            stats = Stats.of(np.concatenate([whole[number][1] for number in numbers]))
            writer.close(Footer(plan, path, split, tuple(rows), (), {"action": stats}))
    names = [f"{split}/shard-00000.parquet" for split in parts]
    derive(folder, names, embodiment, plan, "made").write(folder)
    return folder
