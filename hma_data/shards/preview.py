"""Look at a shard set: pictures decoded from its tokens, with the actions drawn."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hma_data.errors import ShardError, TokenizerError
from hma_data.shards.reader import ShardSet
from hma_data.sheets import Images, grid, with_actions, write_mp4, write_png
from hma_data.tokenizers.base import Tokenizer, get_tokenizer


@dataclass(frozen=True)
class Preview:
    """What was written."""

    sheet: Path
    video: Path
    episodes: tuple[str, ...]


def tokenizer_of(shards: ShardSet, weights: str | None = None, device: str = "cpu") -> Tokenizer:
    """The tokenizer that made a shard set.

    Raises:
        TokenizerError: the one here would give other tokens.
    """
    tokenizer = get_tokenizer(shards.spec.name, weights=weights, device=device)
    if tokenizer.spec != shards.spec:
        raise TokenizerError(
            shards.folder,
            f"was made by {shards.spec.name} with weights {shards.spec.weights_sha256[:12]}, here are "
            f"{tokenizer.spec.weights_sha256[:12]}",
            "give the weights it was made with, or convert again",
        )
    return tokenizer


def preview(
    folder: Path, out: Path, *, episodes: int = 4, columns: int = 8, weights: str | None = None
) -> Preview:
    """Write `sheet.png` and `preview.mp4` for the first episodes of a shard set.

    Raises:
        ShardError: it holds no episodes.
    """
    shards = ShardSet(folder)
    tokenizer = tokenizer_of(shards, weights)
    table = shards.episodes.slice(0, episodes).to_pylist()
    if not table:
        raise ShardError(folder, "holds no episodes", "its quarantine.jsonl says why")
    stats = shards.manifest.stats["action"]
    low, high = np.array(stats["min"]), np.array(stats["max"])
    rows: list[Images] = []
    labels: list[str] = []
    films: list[Images] = []
    for row in table:
        values = shards.episode_rows(row["episode_index"])
        column = "tokens" if shards.spec.kind == "discrete" else "latents"
        length = row["length"]
        tokens = shards.tokens(values[column][:length])
        picks = np.linspace(0, length - 1, min(columns, length)).astype(int)
        actions = values["action"][:length, -len(low) :]
        rows.append(with_actions(tokenizer.decode(tokens[picks]), actions[picks], low, high))
        labels.append(f"{row['id']}  {row['split']}  {length} frames  {row['instruction']}"[:110])
        films.append(with_actions(tokenizer.decode(tokens[:300]), actions[:300], low, high))
    sheet, video = out / "sheet.png", out / "preview.mp4"
    write_png(sheet, grid([list(row) for row in rows], labels))
    rate = shards.embodiment.rate_hz / shards.manifest.frame_stride
    write_mp4(video, np.concatenate(films), rate)
    return Preview(sheet, video, tuple(row["id"] for row in table))
