"""Check a shard set: every hash, row count and invariant. Nothing is changed."""

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from hma_data.errors import HMAError
from hma_data.files import PART, file_sha256
from hma_data.shards.manifest import EPISODES, QUARANTINE, Manifest, episode_table, merged_stats
from hma_data.shards.schema import Footer, arrow_schema, read_footer, to_numpy, token_column
from hma_data.stats import Stats


def verify(folder: Path) -> list[str]:
    """Everything wrong with a shard set, a line each; empty when it is sound."""
    try:
        manifest = Manifest.load(folder)
    except HMAError as fault:
        return [str(fault)]
    found: list[str] = []
    footers: list[Footer] = []
    for shard in manifest.shards:
        path = folder / shard.path
        if not path.is_file():
            found.append(f"{path}: is missing")
        elif file_sha256(path) != shard.sha256:
            found.append(f"{path}: its bytes changed since the manifest was written (sha256 differs)")
        else:
            try:
                footer, row_groups = read_footer(path, str(path))
                footers.append(footer)
                if tuple(row_groups) != shard.row_groups:
                    found.append(f"{path}: row groups {row_groups} differ from the manifest's")
                found += _shard_problems(path, footer, manifest)
            except (HMAError, pa.ArrowInvalid) as fault:
                found.append(str(fault))
    found += _strays(folder, manifest)
    if not found:
        found += _set_problems(folder, manifest, footers)
    return found


def _shard_problems(path: Path, footer: Footer, manifest: Manifest) -> list[str]:
    found: list[str] = []
    if footer.plan["hash"] != manifest.plan["hash"]:
        theirs, ours = footer.plan["hash"], manifest.plan["hash"]
        return [f"{path}: was made by another plan ({theirs}) than the manifest's ({ours})"]
    if any(row.split != footer.split or not path.as_posix().endswith(row.shard) for row in footer.episodes):
        found.append(f"{path}: its episodes name another shard or split")
    embodiment, spec = manifest.embodiment, manifest.tokenizer
    strided = manifest.plan["frames"] == "strided"
    schema = arrow_schema(
        spec,
        embodiment.chunk_dim if strided else embodiment.action_dim,
        embodiment.state.dims if embodiment.state else 0,
        len(manifest.cameras),
    )
    with pq.ParquetFile(path) as file:
        if not file.schema_arrow.equals(schema, check_metadata=False):
            return [
                *found,
                f"{path}: columns {file.schema_arrow.names} are not those of the manifest's embodiment",
            ]
        found += _row_problems(path, file, footer, manifest)
    return found


def _row_problems(path: Path, file: pq.ParquetFile, footer: Footer, manifest: Manifest) -> list[str]:
    """Rows against the footer: whole episodes, frames counting up, tokens in range, finite numbers."""
    found: list[str] = []
    column = token_column(manifest.tokenizer)[0]
    episode, frame, time = [], [], []
    actions = Stats.empty(manifest.embodiment.action_dim)
    for group in range(file.metadata.num_row_groups):
        table = file.read_row_group(group)
        tokens = to_numpy(table[column])
        if manifest.tokenizer.vocab_size and tokens.size and tokens.max() >= manifest.tokenizer.vocab_size:
            last = manifest.tokenizer.vocab_size - 1
            found.append(f"{path}: row group {group} has token {tokens.max()}, the vocabulary ends at {last}")
        for name in ("action", "state"):
            if name in table.column_names and not np.isfinite(to_numpy(table[name])).all():
                found.append(f"{path}: row group {group} has {name} values that are not finite")
        episode.append(to_numpy(table["episode_index"]))
        frame.append(to_numpy(table["frame_index"]))
        time.append(to_numpy(table["timestamp"]))
        actions.merge(Stats.of(to_numpy(table["action"]).reshape(-1, manifest.embodiment.action_dim)))
    cameras = len(manifest.cameras)
    expected_episode = np.concatenate(
        [np.full(row.rows, row.episode_index) for row in footer.episodes] or [np.zeros(0)]
    )
    expected_frame = np.concatenate(
        [np.tile(np.arange(row.length), cameras) for row in footer.episodes] or [np.zeros(0)]
    )
    episodes, frames = np.concatenate(episode or [np.zeros(0)]), np.concatenate(frame or [np.zeros(0)])
    if not np.array_equal(episodes, expected_episode) or not np.array_equal(frames, expected_frame):
        return [*found, f"{path}: rows are not the episodes and frames its footer names"]
    times = np.concatenate(time or [np.zeros(0)])
    if (np.diff(times)[np.diff(frames) > 0] < 0).any():
        found.append(f"{path}: timestamps go back within an episode")
    said = footer.stats["action"]
    kept_all = manifest.plan["frames"] == "all" and cameras == 1
    if kept_all and (
        said.count != actions.count or not np.allclose(said.mean, actions.mean, rtol=1e-9, atol=1e-12)
    ):
        found.append(f"{path}: action statistics in the footer are not those of its rows")
    return found


def _strays(folder: Path, manifest: Manifest) -> list[str]:
    listed = {shard.path for shard in manifest.shards}
    return [
        f"{path}: is not in the manifest"
        for path in sorted(
            [*folder.glob("train/*"), *folder.glob("val/*"), *folder.glob("train/.*"), *folder.glob("val/.*")]
        )
        if path.relative_to(folder).as_posix() not in listed or path.name.endswith(PART)
    ]


def _set_problems(folder: Path, manifest: Manifest, footers: list[Footer]) -> list[str]:
    """The files derived from the footers still say what the footers say."""
    found: list[str] = []
    rows = [row for footer in footers for row in footer.episodes]
    if len({row.id for row in rows}) != len(rows):
        found.append(f"{folder}: an episode stands in it twice, or in both splits")
    try:
        if not pq.read_table(folder / EPISODES).equals(episode_table(footers, manifest.source)):
            found.append(f"{folder / EPISODES}: differs from the shards' footers")
    except (OSError, pa.ArrowInvalid) as fault:
        found.append(f"{folder / EPISODES}: cannot be read: {fault}")
    try:
        refused = {json.loads(line)["id"] for line in (folder / QUARANTINE).read_text().splitlines()}
        if refused != {item.id for footer in footers for item in footer.quarantine}:
            found.append(f"{folder / QUARANTINE}: differs from the shards' footers")
    except (OSError, ValueError, KeyError) as fault:
        found.append(f"{folder / QUARANTINE}: cannot be read: {fault}")
    stats = {name: merged.summary() for name, merged in merged_stats(footers).items()}
    if json.loads(json.dumps(stats)) != manifest.stats:
        found.append(f"{folder}: the manifest's statistics are not those of the train shards")
    return found
