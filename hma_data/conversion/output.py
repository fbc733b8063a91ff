"""Guard the folder that a conversion writes: it holds one conversion's shard set and nothing else.

The folder is locked while the conversion runs. A folder of a store is claimed for the plan instead.
"""

import json
import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from hma_data.conversion.extend import ways
from hma_data.conversion.plan import Plan, differences
from hma_data.cpu import in_order
from hma_data.errors import HMAError, OtherPlanError, OutputError, StorageAwayError
from hma_data.registry.embodiment import Embodiment
from hma_data.shards.manifest import (
    EMBODIMENT,
    EPISODES,
    FILES_BESIDE,
    MANIFEST,
    QUARANTINE,
    SPLITS,
    WORKING,
    Manifest,
    damaged_files,
    derive,
    plan_hashes,
    shard_sizes,
)
from hma_data.shards.schema import PLAN_HASH, Footer, flag_totals, read_metadata
from hma_data.storage.files import PART, remove_parts
from hma_data.storage.locks import LOCK
from hma_data.storage.remote import RemotePath, create_bytes, is_remote, parquet_file, put_bytes

_, JOURNAL, PLAN = WORKING
READERS, JOURNAL_S = 16, 20.0  # in a store: footers read at a time, seconds between writes of a journal
OURS = {*SPLITS, MANIFEST, EPISODES, EMBODIMENT, QUARANTINE}


@dataclass(frozen=True)
class Share:
    """One job's part of a conversion: every `count`-th shard from `index` on; other jobs do the rest."""

    index: int
    count: int

    @property
    def name(self) -> str:
        """Return the name of the share, for files that each share has of its own."""
        return f"{self.index}-of-{self.count}"


@dataclass(frozen=True)
class Finished:
    """What a conversion has made.

    Attributes:
        manifest: of the set, or of what a LeRobotDataset was made from.
        news: what the YAML says now that a finished set did not say yet, in words; empty if nothing.
        refused: lines of quarantine.jsonl.
        flags: name -> count over all episodes.
        bytes: of all files.
    """

    manifest: Manifest
    news: str = ""
    refused: Sequence[Mapping[str, Any]] = ()
    flags: Mapping[str, int] = field(default_factory=dict)
    bytes: int = 0

    @classmethod
    def of(cls, folder: Path, manifest: Manifest, size: int, news: str = "") -> "Finished":
        """Return what was made in a folder, of `size` bytes."""
        refused = [json.loads(line) for line in (folder / QUARANTINE).read_text("utf-8").splitlines()]
        flags = flag_totals(parquet_file(folder / EPISODES).read(columns=["flags"])["flags"])
        return cls(manifest, news, refused, flags, size)


class ShardHolder:
    """The shard set that a conversion makes: its units while the conversion runs, and what they become.

    `hma_data.conversion.lerobot.LeRobotHolder` does the same for a LeRobotDataset.

    Attributes:
        folder: of the units; one job at a time writes it.
    """

    def __init__(self, folder: Path, embodiment: Embodiment, uri: str) -> None:
        self.folder = folder
        self._embodiment, self._uri = embodiment, uri

    def clear(self) -> None:
        """Delete the shard set; keep what lies beside it.

        The next `hma hub push-data` writes README.md anew, but it may also be the user's own.
        """
        out = self.folder
        _refuse_foreign(out)
        if isinstance(out, RemotePath):
            for name in out.listing().keys() - FILES_BESIDE:
                (out / name).unlink(missing_ok=True)
            return
        for item in out.iterdir():
            if item.name not in FILES_BESIDE and not item.name.startswith(LOCK):
                shutil.rmtree(item) if item.is_dir() else item.unlink()

    def base(self) -> Manifest | None:
        """Return the set's manifest; None where there is none."""
        _refuse_foreign(self.folder)
        return Manifest.load(self.folder) if (self.folder / MANIFEST).is_file() else None

    def finished(self, plan: Plan, base: Manifest | None, shared: bool) -> set[str]:
        """Return the names of the plan's shards that are there and whole; claim a folder of a store for it.

        Args:
            base: the set that the plan extends; its shards may be there too.
            shared: True where other jobs may be writing: unfinished files are then not deleted.
        """
        out = self.folder
        _refuse_foreign(out)
        if isinstance(out, RemotePath):
            _refuse_claimed(out, plan)
        if not shared:
            remove_parts(out)
        kept = {shard.path for shard in base.shards} if base else set()
        planned = {unit.name for unit in plan.units}
        done: set[str] = set()

        def look(name: str) -> dict[bytes, bytes]:
            return read_metadata(out / name).metadata or {}

        readers = READERS if is_remote(out) else 1
        for name, metadata in in_order(look, sorted(shard_sizes(out).keys() - kept), readers):
            if name in planned and metadata.get(PLAN_HASH) == plan.facts["hash"].encode():
                done.add(name)
                continue
            footer = Footer.from_metadata(metadata, str(out / name))
            if base and footer.plan.get("extends") and plan_hashes(base.plan) & plan_hashes(footer.plan):
                (out / name).unlink()  # of an unfinished extension that differs from this one
            else:
                raise other_plan(out, plan.facts, footer.plan)
        if not done and base is None and (out / MANIFEST).is_file():
            refuse_other(out, plan)
        if isinstance(out, RemotePath) and done != planned:
            create_bytes(json.dumps(plan.facts).encode(), out / PLAN)
            _refuse_claimed(out, plan)  # two jobs may have come at once
        return done

    @contextmanager
    def noting(self, share: "Share | None") -> Iterator[Callable[["Made"], None]]:
        """Give what notes the hash of each shard."""
        with Journal(self.folder, share) as journal:
            yield journal.add

    def finish(self, plan: Plan, base: Manifest | None, changed: bool) -> Finished:
        """Write what is derived from the shards, all of which are there; `changed`: some may be new."""
        manifest, news = self._derived(plan, base, changed)
        return Finished.of(self.folder, manifest, sum(shard.bytes for shard in manifest.shards), news)

    def _derived(self, plan: Plan, base: Manifest | None, changed: bool) -> tuple[Manifest, str]:
        """Return the manifest, and in words what of the YAML a finished set did not say yet.

        The manifest and the other files derived from footers are written, unless nothing has changed. A
        finished set is written anew too where the YAML has changed: its shards stay, and readers take
        target_hz and stride from the manifest.
        """
        folder, embodiment, news = self.folder, self._embodiment, ""
        remove_parts(folder)  # of workers that died
        before = Manifest.load(folder) if (folder / MANIFEST).is_file() else None
        kept = base.shards if base else ()
        if before is not None:
            news = yaml_change(before.embodiment, embodiment)
            if not changed and not damaged_files(folder, before):
                if not news and before.plan["hash"] == plan.facts["hash"]:
                    remove_notes(folder)
                    return before, ""
                kept = before.shards  # their hashes are known
        names = list(dict.fromkeys([*(shard.path for shard in kept), *(unit.name for unit in plan.units)]))
        known = {shard.path: shard.sha256 for shard in kept} | known_hashes(folder)
        derived = derive(folder, names, embodiment, plan.facts, self._uri, hashes=known)
        manifest = derived.write(folder)
        remove_notes(folder)
        return manifest, news


def yaml_change(before: Embodiment, now: Embodiment) -> str:
    """Return what of the YAML has changed, in words; empty if it is the same."""
    old, new = before.to_dict(), now.to_dict()
    keys = [key for key in {**old, **new} if old.get(key) != new.get(key)]
    return f"new from the YAML: {', '.join(keys)}" if keys else ""


# -- what is there


def _refuse_foreign(out: Path) -> None:
    names = {item.name for item in out.iterdir()} - OURS - FILES_BESIDE
    foreign = sorted(name for name in names if not (name.endswith(PART) or name.startswith(WORKING)))
    if foreign:
        fault = f"holds what is not of a shard set: {', '.join(foreign[:3])}"
        raise OutputError(out, fault, "move it out, or choose an empty or new --out")


def refuse_other(out: Path, plan: Plan) -> None:
    """Raise OutputError unless the set in a folder is of this plan, or of one that it extends."""
    theirs = Manifest.load(out).plan
    if theirs["hash"] not in plan_hashes(plan.facts):
        raise other_plan(out, plan.facts, theirs)


def _refuse_claimed(out: RemotePath, plan: Plan) -> None:
    """Raise OutputError where another plan is being written into this folder of a store."""
    try:
        theirs = json.loads((out / PLAN).read_bytes())
        other = theirs["hash"] != plan.facts["hash"]
    except FileNotFoundError:
        return
    except (ValueError, KeyError, TypeError) as damage:
        remedy = "delete it and run the same command again"
        raise OutputError(out / PLAN, "is damaged: it states no plan", remedy) from damage
    if other:
        fault = f"another conversion is being written there; different: {differences(plan.facts, theirs)}"
        remedy = f"wait for it, or choose another --out; if no such job runs any more, delete {out / PLAN}"
        raise OutputError(out, fault, remedy)


def other_plan(out: Path, ours: dict[str, Any], theirs: dict[str, Any]) -> OtherPlanError:
    """Return the error for a folder that holds the set of another plan."""
    remedy = "choose another --out, or --overwrite to start over"
    if ways(ours) == ways(theirs) and "to" not in ours:
        remedy = "--extend adds the episodes that are new, --overwrite starts over"
    fault = f"belongs to another conversion; different: {differences(ours, theirs)}"
    return OtherPlanError(out, fault, remedy)


# -- the journal


@dataclass(frozen=True)
class Made:
    """A finished shard: the values that the manifest needs and the footer cannot hold."""

    name: str
    bytes: int
    sha256: str


class Journal:
    """The hashes of this job's shards, one line each, so that finishing does not read the shards again.

    Lines are only appended. A store cannot append: there, the whole journal is written from time to time
    and when the block ends.
    """

    def __init__(self, out: Path, share: Share | None) -> None:
        self._path = out / (f"{JOURNAL}-{share.name}" if share else JOURNAL)
        self._lines: list[str] = []
        self._due = time.monotonic() + JOURNAL_S

    def __enter__(self) -> "Journal":
        if is_remote(self._path) and self._path.is_file():
            self._lines = self._path.read_text(encoding="utf-8").splitlines(keepends=True)
        return self

    def __exit__(self, kind: object, fault: BaseException | None, trace: object) -> None:
        if not isinstance(fault, StorageAwayError):  # otherwise it would wait for the store once more
            self._put()

    def add(self, made: Made) -> None:
        """Add the line of a shard."""
        line = json.dumps(asdict(made)) + "\n"
        if not is_remote(self._path):
            with self._path.open("a", encoding="utf-8") as file:
                file.write(line)
            return
        self._lines.append(line)
        if time.monotonic() > self._due:
            self._put()

    def _put(self) -> None:
        if isinstance(self._path, RemotePath) and self._lines:
            with suppress(HMAError, OSError):  # without a journal, finishing reads the shards again
                put_bytes("".join(self._lines).encode(), self._path)
        self._due = time.monotonic() + JOURNAL_S


def known_hashes(out: Path) -> dict[str, str]:
    """Return shard -> sha256 for the shards in all journals whose size is unchanged; others must be read."""
    found: dict[str, str] = {}
    sizes = shard_sizes(out)
    for path in sorted(out.glob(f"{JOURNAL}*")):
        for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
            with suppress(ValueError, TypeError):  # a line cut short by a kill
                made = Made(**json.loads(line))
                if sizes.get(made.name) == made.bytes:
                    found[made.name] = made.sha256
    return found


def remove_notes(out: Path) -> None:
    """Delete the journals and the claim of a set once its manifest is written."""
    for path in [*out.glob(f"{JOURNAL}*"), out / PLAN]:
        path.unlink(missing_ok=True)
