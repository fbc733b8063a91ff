"""Convert recordings to a LeRobotDataset v3.0: each unit becomes a small one, and lerobot joins them.

The units lie beside the output, in `.NAME.parts`, each whole or absent. The dataset is joined there and gets
its name when it is whole, so the same command continues a job that was killed, and a dataset that is there
is finished. Beside lerobot's files it has the embodiment for its rows, episodes.parquet, quarantine.jsonl,
and conversion.json with the plan.

Frames keep their recorded size, upright and in RGB; crop and resize stay with the YAML. Numbers are those
that shards hold.

N rows of an episode, n of them in a batch, H×W pixels, A action dims.
"""

import json
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from hma_data.arrays import Images, Ints
from hma_data.conversion.engines import Report
from hma_data.conversion.output import Finished, Made, Share, other_plan
from hma_data.conversion.plan import EPISODES_TRIED, Plan, Settings, ShardUnit, read_clip
from hma_data.conversion.reading import (
    End,
    Frames,
    Item,
    Job,
    ReadEpisode,
    Tick,
    UnitNotes,
    frames_of,
    signs_of_life,
)
from hma_data.episodes.episode import Clip
from hma_data.episodes.images import prepare, upright
from hma_data.errors import EpisodeError, HMAError, OutputError, ShardError, SourceError, UsageError
from hma_data.registry.embodiment import ONE_INDEX, Embodiment
from hma_data.registry.export import camera_features, lerobot_features, packed_components
from hma_data.shards.manifest import EMBODIMENT, EPISODES, QUARANTINE, Derived, Manifest, ShardFile
from hma_data.shards.schema import FOOTER_KEY, Footer, Refused, RowLayout, mask_columns, to_numpy
from hma_data.sources.base import open_source
from hma_data.sources.lerobot.language import on_rows, write_language
from hma_data.sources.lerobot.writer import ORIGIN, DatasetWriter, join_datasets, load_lerobot, set_splits
from hma_data.storage.fetch import disk_is_full
from hma_data.storage.files import new_folder, remove_partial, sync_folder
from hma_data.storage.locks import LOCK
from hma_data.storage.remote import is_remote
from hma_data.tokenizers.base import TokenizerSpec

CONVERSION = "conversion.json"  # what the dataset was made from; last of a dataset's files
FOOTER, DATASET = "footer.json", "dataset"  # of a part
CHECKED = 256  # pixels a side of the frames that are checked for showing nothing, as most tokenizers have it
BATCH_BYTES = 32 << 20  # of the frames of a batch
MOST_FRAMES = 32  # of a batch
TIMES, SUCCESS = "recorded_time", "next.success"
# It stands in the plan where shards have their tokenizer: frames as they are.
AS_RECORDED = TokenizerSpec("recorded", 1, "continuous", CHECKED, (CHECKED, CHECKED), channels=3)


# -- the plan


def as_dataset(settings: Settings) -> Settings:
    """Return the settings with a dataset's own defaults: all cameras, no episode held out."""
    held_out = 0.0 if settings.val_fraction is None else settings.val_fraction
    return replace(settings, cameras=settings.cameras or ("all",), val_fraction=held_out)


def with_dataset(plan: Plan, uri: str, robot: Embodiment) -> Plan:
    """Return the plan with the facts that every row of the dataset shares.

    They are the rate, the size of each camera's frames, and which of the columns TIMES and SUCCESS there are.
    Sizes, and whether episodes say how they ended, are those of the first episodes that can be read.
    """
    layout = RowLayout.of_plan(plan.facts, robot)
    hz = robot.rate_hz / layout.frame_stride
    timed = robot.source.format not in ONE_INDEX or "timestamps" in (robot.source.layout or {})
    facts: dict[str, Any] = {
        "fps": max(1, round(hz)),
        "times": timed or not hz.is_integer() or "drop_idle" in plan.facts["settings"],
        **_seen(plan, uri, robot, layout),
    }
    return plan.with_facts({"to": "lerobot", "dataset": facts})


def dataset_plan(plan: Plan, uri: str, robot: Embodiment) -> Plan:
    """Return the plan of the dataset of the same episodes, cameras and units as a plan of shards."""
    return with_dataset(plan.with_facts({"tokenizer": AS_RECORDED.to_json()}), uri, robot)


def _seen(plan: Plan, uri: str, robot: Embodiment, layout: RowLayout) -> dict[str, Any]:
    source = open_source(robot.source.format)
    sizes: dict[str, list[int]] = {}
    success, fault = False, ""
    for _, ref in islice((item for unit in plan.units for item in unit.episodes), EPISODES_TRIED):
        try:
            clip = read_clip(source, uri, ref.id, robot, layout.cameras)
            success = success or clip.episode.success is not None
            if not sizes and len(clip):
                sizes = {name: _size(clip, name, robot) for name in layout.cameras}
        except (HMAError, OSError, ValueError) as refused:
            fault = str(refused)
    if not sizes:
        raise SourceError(uri, f"none of the first episodes can be read: {fault or 'they are empty'}")
    return {"sizes": sizes, "success": success}


def _size(clip: Clip, camera: str, robot: Embodiment) -> list[int]:
    frames = upright(clip.frames_at(camera, np.zeros(1, np.int64)), robot.camera(camera))
    return [int(side) for side in frames.shape[1:3]]


@dataclass(frozen=True)
class Columns:
    """The features of the dataset of a plan, and which of our values each holds."""

    layout: RowLayout
    facts: dict[str, Any]

    @cached_property
    def keys(self) -> dict[str, str]:
        """Return camera -> feature: the recording's own for a LeRobotDataset."""
        keys = camera_features(self.layout.embodiment)
        return {name: keys[name] for name in self.layout.cameras}

    @cached_property
    def features(self) -> dict[str, dict[str, Any]]:
        """Return the features, as lerobot takes them."""
        robot, stride = self.layout.embodiment, self.layout.frame_stride
        plain = lerobot_features(robot)
        found: dict[str, dict[str, Any]] = {
            key: plain[key] for key in ("action", "observation.state") if key in plain
        }
        if stride > 1:
            names = [f"{name}+{step}" for step in range(stride) for name in robot.action.names()]
            found["action"] = found["action"] | {"shape": (len(names),), "names": names}
        for name, key in self.keys.items():
            found[key] = plain[key] | {"shape": (*self.facts["sizes"][name], 3)}
        for mask in mask_columns(robot):
            found[mask] = {"dtype": "bool", "shape": (1,), "names": None}
        if self.facts["success"]:
            found[SUCCESS] = {"dtype": "bool", "shape": (1,), "names": None}
        if self.facts["times"]:
            found[TIMES] = {"dtype": "float64", "shape": (1,), "names": None}
        return found

    def row(self, episode: ReadEpisode, row: int, pictures: dict[str, Images]) -> dict[str, Any]:
        """Return the values of a row of an episode; its picture of each camera is (H, W, 3)."""
        clip, stride = episode.clip, self.layout.frame_stride
        at = int(episode.kept[row])
        steps = slice(at, at + stride)
        known = clip.action_known is None or bool(clip.action_known[steps].all())
        action = clip.actions[steps].reshape(-1)
        ends = row == len(episode.kept) - 1
        values: dict[str, Any] = {
            "action": action if known else np.zeros_like(action),
            "action_known": np.array([known]),
            "state_known": np.array([clip.state_known is None or clip.state_known[at]]),
            SUCCESS: np.array([ends and clip.episode.success is True]),
            TIMES: np.array([clip.timestamps[at]]),
        }
        if clip.states is not None:
            values["observation.state"] = clip.states[at]
        values |= {key: pictures[name] for name, key in self.keys.items()}
        kept = {key: value for key, value in values.items() if key in self.features}
        return kept | {"task": clip.episode.instruction}

    def embodiment(self) -> Embodiment:
        """Return the embodiment that describes the dataset's rows: it makes the same shards of them."""
        robot, stride = self.layout.embodiment, self.layout.frame_stride
        values = robot.to_dict()
        action = packed_components(values["action"], "action")
        if stride > 1:
            action = _repeated(action, robot.action_dim, stride)
        cameras = [
            {key: value for key, value in camera.items() if key in ("name", "resize", "crop")}
            | {"key": self.keys[camera["name"]], "size": self.facts["sizes"][camera["name"]]}
            for camera in values["cameras"]
            if camera["name"] in self.keys
        ]
        rate = f"{robot.rate_hz / stride:g} Hz of the recording, a whole number in a LeRobotDataset"
        values |= {
            "frequency_hz": self.facts["fps"],
            "stride": robot.stride if stride == 1 else 1,
            "action": {"space": robot.action.space, "components": action},
            "cameras": cameras,
            "source": {"format": "lerobot"},
            "provenance": {**robot.provenance, "frequency_hz": rate, "recording": "hma convert --to lerobot"},
        }
        if robot.state:
            values["state"] = {"components": packed_components(values["state"], "observation.state")}
        sync = values.pop("sync", {})
        if sync.get("primary") in self.keys:
            values["sync"] = {"primary": sync["primary"]}
        return Embodiment.from_values(values, f"embodiment {robot.id} as a LeRobotDataset")


def _repeated(components: list[dict[str, Any]], dims: int, stride: int) -> list[dict[str, Any]]:
    """Return the components of a chunk of `stride` actions of `dims` values."""
    found = []
    for step in range(stride):
        for part in components:
            start, stop = part["slice"]
            own = part | {"slice": [start + step * dims, stop + step * dims]}
            if "names" in part:
                own["names"] = [f"{name}+{step}" for name in part["names"]]
            found.append(own)
    return found


# -- in the worker


def part_folder(folder: Path, unit: str) -> Path:
    """Return the folder of a unit's part; `unit` is its name in the plan."""
    return folder / unit.removesuffix(".parquet").replace("/", "-")


class LeRobotOutput:
    """The output of a conversion to a LeRobotDataset: of each unit a part.

    Attributes:
        batch: rows whose frames are decoded together.
    """

    def __init__(self, job: Job) -> None:
        load_lerobot()
        self._job, self._layout = job, job.layout
        self._columns = Columns(self._layout, job.facts["dataset"])
        pixels = max(height * width for height, width in job.facts["dataset"]["sizes"].values())
        self.batch = min(MOST_FRAMES, max(1, BATCH_BYTES // (3 * pixels)))

    def frames(self, episode: ReadEpisode, report: Report | None) -> Iterator[Frames]:
        """Yield the frames of an episode, upright (n, H, W, 3); add what they show to its flags."""
        clip, facts = episode.clip, self._job.facts["dataset"]

        def show(name: str, start: int, rows: Ints) -> tuple[Images, Images]:
            camera = self._job.embodiment.camera(name)
            raw = clip.frames_at(name, rows)
            frames = np.ascontiguousarray(upright(raw, camera))
            height, width = facts["sizes"][name]
            if frames.shape[1:3] != (height, width):
                own = f"{frames.shape[2]}×{frames.shape[1]}"
                fault = (
                    f"camera {name} has frames of {own} pixels, the dataset's first episode {width}×{height}"
                )
                remedy = "convert such episodes into a dataset of their own, with --only"
                raise EpisodeError(episode.ref.id, fault, remedy)
            return frames, prepare(raw, camera, CHECKED)

        yield from frames_of(self._job, episode, self.batch, report, show)
        episode.language = on_rows(episode.language, clip.timestamps[episode.kept], facts["fps"])

    def has(self, unit: ShardUnit) -> bool:
        """Check whether the part of a unit is there."""
        return part_folder(self._job.out, unit.name).is_dir()

    def make(self, unit: ShardUnit, items: Iterator[Item], report: Report) -> Made:
        """Write the part of a unit; without a usable episode it holds no dataset."""
        with self.making(unit, report) as part:
            for item in items:
                part.add(item)
        return Made(unit.name, _bytes(part_folder(self._job.out, unit.name)), "")

    @contextmanager
    def making(self, unit: ShardUnit, report: Report) -> Iterator["PartWriter"]:
        """Give the part of a unit, which is made of the items added to it; whole or not at all."""
        final = part_folder(self._job.out, unit.name)
        with space_explained(final.parent), new_folder(final) as folder:
            part = PartWriter(self._job, unit, self._columns, folder, report)
            try:
                yield part
            finally:
                part.close()
            (folder / FOOTER).write_bytes(part.notes.footer().to_metadata()[FOOTER_KEY])


class PartWriter:
    """The part of a unit while it is written.

    Attributes:
        notes: of the episodes that are written or refused.
    """

    def __init__(self, job: Job, unit: ShardUnit, columns: Columns, folder: Path, report: Report) -> None:
        self.notes = UnitNotes(job, unit)
        self._job, self._columns, self._folder, self._report = job, columns, folder, report
        self._writer: DatasetWriter | None = None
        self._begun: ReadEpisode | None = None
        self._waiting: dict[str, Images] = {}  # frames of the next rows, by camera
        self._rows = self._total = 0  # of the episode that was begun, and of those that are saved

    def add(self, item: Item) -> None:
        """Add the next item of the unit."""
        if isinstance(item, Frames):
            self._add_frames(item)
        elif isinstance(item, End):
            assert self._begun is not None and self._writer is not None
            with signs_of_life(self._report):
                self._writer.save_episode()
            self.notes.add(self._begun, self._total, self._report)
            self._total += self._rows
            self._begun = None
        else:
            if self._begun is not None and self._rows and self._writer is not None:
                self._writer.drop_episode()  # what came of it is void
            self._rows, self._waiting = 0, {}
            self._begun = item if isinstance(item, ReadEpisode) else None
            if isinstance(item, Refused):
                self.notes.refuse(item, self._report)

    def close(self) -> None:
        """Complete the files."""
        if self._writer is not None:
            with signs_of_life(self._report):
                self._writer.close()

    def _add_frames(self, item: Frames) -> None:
        self._waiting[item.camera] = item.frames
        if len(self._waiting) < len(self._columns.layout.cameras):
            return
        assert self._begun is not None
        if self._writer is None:
            robot, fps = self._job.embodiment, self._columns.facts["fps"]
            features = self._columns.features
            self._writer = DatasetWriter(self._folder / DATASET, robot.id, fps, features, robot.robot)
        count = len(item.frames)
        for row in range(count):
            pictures = {name: frames[row] for name, frames in self._waiting.items()}
            self._writer.add_row(self._columns.row(self._begun, self._rows + row, pictures))
        self._rows += count
        self._report(Tick(frames=count * len(self._waiting)))
        self._waiting = {}


@contextmanager
def space_explained(where: Path) -> Iterator[None]:
    """Raise an OutputError where the disk is full or cannot be written; lerobot raises several errors."""
    try:
        yield
    except HMAError:
        raise
    except Exception as fault:
        if disk_is_full(fault) or isinstance(fault, PermissionError):
            said = getattr(fault, "strerror", None) or fault
            remedy = "free space and run the same command again, or choose another --out"
            raise OutputError(where, f"cannot be written: {said}", remedy) from fault
        raise


def _bytes(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


# -- in the job


class LeRobotHolder:
    """The LeRobotDataset that a conversion makes, and the parts it is joined of; as `ShardHolder`.

    Args:
        out: the dataset's folder.
        embodiment: of the recording.
        uri: of the recording.
    """

    def __init__(self, out: Path, embodiment: Embodiment, uri: str) -> None:
        if is_remote(out):
            fault = "is not a local folder, and lerobot writes only to those"
            remedy = "write one, and upload it with hf upload or LeRobotDataset.push_to_hub"
            raise UsageError(str(out), fault, remedy)
        self.out, self._robot, self._uri = out.resolve() if out.is_symlink() else out, embodiment, uri
        self.folder = self.out.absolute().with_name(f".{self.out.absolute().name}.parts")

    def clear(self) -> None:
        """Delete the dataset and the parts; refuse what else is there."""
        self._conversion()
        shutil.rmtree(self.out, ignore_errors=True)
        for item in self.folder.iterdir() if self.folder.is_dir() else ():
            if not item.name.startswith(LOCK):
                shutil.rmtree(item) if item.is_dir() else item.unlink()

    def base(self) -> Manifest | None:
        """Return None: a LeRobotDataset is not extended."""
        return None

    def finished(self, plan: Plan, base: Manifest | None, shared: bool) -> set[str]:
        """Return the names of the units whose part, or whose dataset, is there."""
        planned = {unit.name for unit in plan.units}
        if dataset := self._dataset():
            if dataset.plan["hash"] != plan.facts["hash"]:
                raise other_plan(self.out, plan.facts, dataset.plan)
            return planned
        if not shared:
            remove_partial(self.folder)
            shutil.rmtree(self.folder / DATASET, ignore_errors=True)
        done = set()
        for name in planned:
            part = part_folder(self.folder, name)
            if not part.is_dir():
                continue
            footer = _footer(part)
            if footer.plan["hash"] != plan.facts["hash"]:
                raise other_plan(self.out, plan.facts, footer.plan)
            done.add(name)
        return done

    @contextmanager
    def noting(self, share: Share | None) -> Iterator[Callable[[Made], None]]:
        """Give what notes a unit: nothing needs to, a part says all about itself."""
        yield lambda made: None

    def finish(self, plan: Plan, base: Manifest | None, changed: bool) -> Finished:
        """Join the parts to the dataset; where no episode is usable, write none."""
        dataset = self._dataset()
        if dataset is None:
            derived = self._derived(plan)
            if not len(derived.episodes):
                return Finished(derived.manifest, refused=[asdict(item) for item in derived.refused])
            try:
                with space_explained(self.out):
                    dataset = self._join(plan, derived)
            finally:
                shutil.rmtree(self.folder / DATASET, ignore_errors=True)
        shutil.rmtree(self.folder, ignore_errors=True)
        return Finished.of(self.out, dataset, _bytes(self.out))

    def _derived(self, plan: Plan) -> Derived:
        derived = Derived(plan.facts, self._robot, self._uri)
        for unit in plan.units:
            footer = _footer(part_folder(self.folder, unit.name))
            rows = sum(footer.table["rows"].to_pylist())
            file = ShardFile(unit.name, unit.split, rows, len(footer.episodes), 0, "", ())
            derived.add(file, footer)
        return derived

    def _join(self, plan: Plan, derived: Derived) -> Manifest:
        whole = self.folder / DATASET
        shutil.rmtree(whole, ignore_errors=True)
        parts = [part_folder(self.folder, unit.name) / DATASET for unit in plan.units]
        try:
            join_datasets([part for part in parts if part.is_dir()], whole, self._robot.id)
        except ValueError as fault:  # of PyAV, pyarrow and JSON alike
            remedy = "delete that folder and run the same command again"
            raise ShardError(self.folder, f"holds a damaged part: {fault}", remedy) from fault
        manifest = replace(derived.manifest, shards=())
        episodes = _numbered(derived.episodes)
        held_out = manifest.splits["val"]["episodes"]
        if held_out:
            total = len(derived.episodes)
            set_splits(whole, {"train": f"0:{total - held_out}", "val": f"{total - held_out}:{total}"})
        said = {
            row["episode_index"]: json.loads(row["language"])
            for row in episodes.to_pylist()
            if row.get("language")
        }
        if said:
            write_language(whole, said)
        layout = manifest.layout
        embodiment = Columns(layout, plan.facts["dataset"]).embodiment()
        (whole / EMBODIMENT).write_text(embodiment.to_yaml(), encoding="utf-8")
        if "made_by" in plan.facts:
            (whole / ORIGIN).write_text(json.dumps(plan.facts["made_by"], indent=1), encoding="utf-8")
        pq.write_table(episodes, whole / EPISODES, compression="zstd")
        (whole / QUARANTINE).write_text(derived.quarantine, encoding="utf-8")
        (whole / CONVERSION).write_text(manifest.to_text(), encoding="utf-8")
        for path in (*whole.rglob("*"), whole):
            sync_folder(path)
        if self.out.is_dir():
            self.out.rmdir()  # it is empty
        whole.rename(self.out)
        sync_folder(self.out.parent)
        return manifest

    def _dataset(self) -> Manifest | None:
        """Return what the dataset in `out` says of its conversion; None where there is none."""
        path = self._conversion()
        if path is None:
            return None
        return Manifest.from_text(path.read_bytes(), path, "--overwrite writes the dataset again")

    def _conversion(self) -> Path | None:
        """Return the file of a dataset of ours in `out`; None where nothing is there."""
        if not self.out.exists() or (self.out.is_dir() and not any(self.out.iterdir())):
            return None
        path = self.out / CONVERSION
        if not path.is_file() or not (self.out / "meta" / "info.json").is_file():
            raise OutputError(self.out, "holds something else", "choose an empty or new folder")
        return path


def _footer(part: Path) -> Footer:
    return Footer.from_metadata({FOOTER_KEY: (part / FOOTER).read_bytes()}, str(part / FOOTER))


def _numbered(episodes: pa.Table) -> pa.Table:
    """Return the table in the order of the dataset, with the numbers and the first rows that it has there."""
    table = episodes.sort_by([("split", "ascending"), ("episode_index", "ascending")])
    rows = to_numpy(table["rows"])
    own = {
        "episode_index": np.arange(len(table), dtype=np.int32),
        "row_start": np.cumsum(rows) - rows,
        "shard": [""] * len(table),
    }
    for name, values in own.items():
        field = table.schema.field(name)
        table = table.set_column(table.schema.get_field_index(name), field, pa.array(values, field.type))
    return table
