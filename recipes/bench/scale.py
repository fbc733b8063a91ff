"""Measure `scale`: planning, writing, reading, resuming and mixing shard sets of millions of episodes.

The episodes are made up, with lengths as in the paper's mixture: 3 million trajectories have 2.5 billion
frames. The shards have true footers and true numbers of rows, but one empty column instead of pictures and
numbers. A set has 1/k of the episodes of the largest, where k is its place.

Each step runs in a process of its own, so that its memory is measured alone. Making the recording and its
shards is not measured.
"""

import json
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hma_data.errors import UsageError
from recipes.bench.harness import Bench, in_fresh_process, make_robot, peak_rss_mib

if TYPE_CHECKING:
    from hma_data.conversion.plan import Plan, ShardUnit
    from hma_data.registry.embodiment import Embodiment
    from hma_data.shards.stats import Stats
    from hma_data.sources.base import EpisodeRef
    from hma_data.storage.records import Records
    from hma_data.tokenizers.base import TokenizerSpec

MEDIAN, SIGMA, LONGEST = 250, 1.59, 20_000  # frames of an episode: log-normal, 837 on average
SOURCE = "made-up"


def run(settings: dict[str, Any]) -> list[dict[str, Any]]:
    """Run the steps, each over all embodiments."""
    if not all(count for _, count, *_ in _robots(settings)):
        fault = (
            f"{settings['episodes']} episodes leave none for some of {settings['embodiments']} embodiments"
        )
        raise UsageError("bench scale", fault, "give more episodes, or fewer embodiments")
    with tempfile.TemporaryDirectory(dir=settings["folder"] or None) as folder:
        in_fresh_process(_make, folder, settings)
        return [in_fresh_process(_measured, step, folder, settings) for step in STEPS]


def _measured(step: str, folder: str, settings: dict[str, Any]) -> dict[str, Any]:
    work = STEPS[step]
    work(Path(folder) / "none", {"episodes": 40, "embodiments": 1})  # imports
    began = time.perf_counter()
    work(Path(folder), settings)
    seconds = time.perf_counter() - began
    figures = {"episodes": settings["episodes"], "seconds": round(seconds, 2)}
    return {"step": step, **figures, "peak_rss_mib": peak_rss_mib()}


def _robots(settings: dict[str, Any]) -> Iterator[tuple[int, int, "Embodiment", "TokenizerSpec"]]:
    """Yield each embodiment: its place, number of episodes, description and tokenizer."""
    from hma_data.tokenizers.base import TokenizerSpec

    share = 1 / np.arange(1, settings["embodiments"] + 1)
    ends = np.round(np.cumsum(share) / share.sum() * settings["episodes"]).astype(int)
    spec = TokenizerSpec("random", 1, "discrete", 256, (16, 16), 262_144)
    for number, count in enumerate(np.diff(ends, prepend=0).tolist()):
        yield number, count, make_robot(f"robot_{number}", "hdf5", "actions", "obs/image"), spec


def _planned(settings: dict[str, Any]) -> Iterator[tuple["Embodiment", "TokenizerSpec", "Plan"]]:
    """Yield each embodiment with the plan of its made-up recording."""
    from hma_data.conversion.plan import Settings, make_plan

    for number, count, robot, spec in _robots(settings):
        yield robot, spec, make_plan(_recording(number, count), robot, spec, Settings(), SOURCE)


def _recording(number: int, count: int) -> "Records[EpisodeRef]":
    """Return the episodes of a recording, as the index of a source does."""
    import pyarrow as pa
    import pyarrow.compute as pc

    from hma_data.sources.base import EpisodeRef
    from hma_data.storage.records import Records

    drawn = MEDIAN * np.exp(SIGMA * np.random.default_rng(number).standard_normal(count))
    frames = pa.array(np.clip(drawn, 10, LONGEST).astype(np.int64))
    digits = pc.utf8_lpad(pa.array(np.arange(count)).cast(pa.string()), 7, "0")
    ids = pc.binary_join_element_wise("episode", digits, "_")
    marks = pc.binary_join_element_wise(digits, pc.utf8_lpad(frames.cast(pa.string()), 9, "0"), "")
    table = pa.table({"id": ids, "frames": frames, "fingerprint": marks})
    return Records.of_table(EpisodeRef, table)


def _make(folder: str, settings: dict[str, Any]) -> None:
    """Write the shards of every set, their journal and a note of their plan, as a conversion leaves them."""
    from hma_data.conversion.output import Journal
    from hma_data.shards.stats import Stats

    for robot, _, plan in _planned(settings):
        out = Path(folder) / robot.id
        for split in ("train", "val"):
            (out / split).mkdir(parents=True)
        numbers = np.random.default_rng(0).standard_normal((20_000, robot.action_dim), dtype=np.float32)
        stats = Stats.of(numbers)
        with Journal(out, None) as journal:
            for unit in plan.units:
                journal.add(_shard(out, unit, plan, stats))
        note = {"facts": plan.facts, "names": [unit.name for unit in plan.units]}
        out.with_suffix(".json").write_text(json.dumps(note))


def _shard(out: Path, unit: "ShardUnit", plan: "Plan", stats: "Stats") -> Any:
    """Write a shard of one empty column, with the row groups and the footer of its episodes."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    from hma_data.conversion.output import Made
    from hma_data.shards.schema import ROW_GROUP, EpisodeRow, Footer
    from hma_data.storage.files import file_sha256

    rows, begun = [], 0
    for number, ref in unit.episodes:
        skew = (11.2, 18.5, 21.0, '{"main": [11.2, 18.5, 21.0], "actions": [0.0, 0.0, 0.0]}')
        said = "pick up the blue block and place it in the bowl"
        place = (unit.name, begun, ref.frames, ref.frames, said, None, ref.fingerprint)
        rows.append(EpisodeRow(number, ref.id, unit.split, *place, *skew, 0, "", content=ref.fingerprint))
        begun += ref.frames
    with pq.ParquetWriter(out / unit.name, pa.schema([("empty", pa.null())])) as writer:
        writer.write_table(pa.table({"empty": pa.nulls(begun)}), row_group_size=ROW_GROUP)
        footer = Footer(plan.facts, unit.name, unit.split, tuple(rows), (), {"action": stats})
        writer.add_key_value_metadata(footer.to_metadata())
    path = out / unit.name
    return Made(unit.name, path.stat().st_size, file_sha256(path))


def _plan(folder: Path, settings: dict[str, Any]) -> None:
    """Make the plan of each set."""
    for _ in _planned(settings):
        pass


def _write(folder: Path, settings: dict[str, Any]) -> None:
    """Write the manifest, the episodes and the other files of each set from the footers of its shards."""
    from hma_data.conversion.output import known_hashes
    from hma_data.shards.manifest import derive

    for _, _, robot, _ in _robots(settings):
        out = folder / robot.id
        if out.is_dir():
            note = json.loads(out.with_suffix(".json").read_text())
            derive(out, note["names"], robot, note["facts"], SOURCE, known_hashes(out)).write(out)


def _read(folder: Path, settings: dict[str, Any]) -> None:
    """Read the manifest of each set, and its episodes as the loader and as a user reads them."""
    from hma_data.shards.reader import ShardSet

    for _, _, robot, _ in _robots(settings):
        if (folder / robot.id).is_dir():
            shards = ShardSet(folder / robot.id)
            len(shards.index("train").start), len(shards.index("val").start), len(shards.episodes)


def _resume(folder: Path, settings: dict[str, Any]) -> None:
    """Plan each recording again, look which shards are there and whole, and check the derived files."""
    from hma_data.conversion.output import ShardHolder
    from hma_data.shards.manifest import Manifest, damaged_files

    for robot, _, plan in _planned(settings):
        out = folder / robot.id
        if out.is_dir():
            manifest = Manifest.load(out)
            done = ShardHolder(out, robot, SOURCE).finished(plan, None, False)
            if len(done) < len(plan.units) or damaged_files(out, manifest):
                raise RuntimeError(f"{out} is not whole")


def _mixture(folder: Path, settings: dict[str, Any]) -> None:
    """Open the mixture of all sets, and divide their windows among the readers."""
    from hma_data.loading.dataset import MixtureDataset
    from hma_data.loading.pools import UnitAssignment

    if folder.is_dir():
        data = MixtureDataset([folder / robot.id for *_, robot, _ in _robots(settings)], 32)
        for decoder in data._decoders.values():
            UnitAssignment.of(decoder.index, data.lanes)


STEPS: dict[str, Callable[[Path, dict[str, Any]], None]] = {
    "plan": _plan,
    "write": _write,
    "read": _read,
    "resume": _resume,
    "mixture": _mixture,
}
BENCH = Bench(
    "planning, manifest, resume and mixture of shard sets with millions of synthetic episodes",
    {"episodes": 100_000, "embodiments": 40, "folder": ""},
    run,
)
