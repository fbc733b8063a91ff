"""Measure how well the tokens of a shard set keep what moves in its recordings."""

from collections.abc import Iterator

import numpy as np

from hma_data.episodes.images import prepare, upright
from hma_data.episodes.movement import Kept, MovingPart, framing
from hma_data.errors import HMAError
from hma_data.registry.components import Camera
from hma_data.shards.preview import tokenizer_of
from hma_data.shards.reader import EpisodeReader, ShardSet
from hma_data.shards.recorded import Recorded
from hma_data.shards.schema import token_column
from hma_data.sources.common.checks import Finding
from hma_data.sources.common.survey import sampled
from hma_data.storage.paths import StrPath
from hma_data.tokenizers.base import Tokenizer

EPISODES, FRAMES = 3, 12  # episodes compared, and frames of each, evenly spaced


def kept_findings(
    shards: ShardSet,
    weights: StrPath | None = None,
    device: str = "cpu",
    tokenizer: Tokenizer | None = None,
) -> Iterator[Finding]:
    """Yield for each camera how well what moves is kept by the tokens, in a few episodes of all splits.

    It is a warning where the moving parts are lost, or where the crop cuts them off. Where the recording or
    the tokenizer is not at hand, one finding says so.

    Args:
        weights, device: of the tokenizer, as `get_tokenizer` takes them.
        tokenizer: that decodes; None takes the set's own.
    """
    rows, spec = shards.episodes.take(sampled(len(shards.episodes), EPISODES)).to_pylist(), shards.spec
    try:
        opened = tokenizer or tokenizer_of(shards, weights, device)
        recorded = [(row, Recorded(shards, row)) for row in rows]
        for name in shards.manifest.cameras:
            kept, part = Kept(), MovingPart()
            camera, reader = shards.embodiment.camera(name), EpisodeReader(shards, shards.columns([name]))
            for row, recording in recorded:
                picks = np.array(sampled(row["length"], FRAMES))
                tokens = reader.episode(row, name)[token_column(spec)[0]][picks]
                raw = recording.raw(name, picks)
                seen = prepare(raw, camera, spec.image_size, spec.resize_filter)
                kept.add(seen, opened.decode(shards.tokens(tokens)))
                part.add(upright(raw, camera))
            yield _finding(camera, kept, part)
    except (HMAError, OSError, ImportError) as fault:
        said = f"token quality was not measured: {' '.join(str(fault).split())}"
        yield Finding("tokens", "info", said)


def _finding(camera: Camera, kept: Kept, part: MovingPart) -> Finding:
    """Return what was measured of a camera, and what to do where the robot is lost."""
    framed = framing(camera, part.box, *part.size)
    said = f"camera {camera.name}: {kept}"
    numbers = {"moving_share": kept.share, "psnr_moving_db": kept.psnr_db, "change_shown": kept.change_shown}
    if not kept.lost and not (framed and framed.cut_off):
        return Finding("tokens", "info", said, key=camera.key, numbers=numbers)
    said += "; the tokens lose the robot" if kept.lost else ""
    said += f"; {framed.fault}" if framed else ""
    remedy = f"set {framed.words} in the YAML" if framed else "use another tokenizer, see hma tokenizer list"
    remedy += ", and convert again with --overwrite; hma shards preview shows both"
    return Finding("tokens", "warn", said, remedy, camera.key, numbers)
