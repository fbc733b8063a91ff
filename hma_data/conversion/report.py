"""Report how a conversion goes and how it ended."""

import re
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hma_data.console import human_count
from hma_data.conversion.engines import Notice, Retry
from hma_data.conversion.plan import HELD_OUT, VAL_FRACTION, Plan
from hma_data.conversion.reading import Seen, Tick
from hma_data.inspection.shard_findings import pause_finding, rate_finding, window_finding
from hma_data.shards.manifest import Manifest
from hma_data.shards.reader import ShardSet


@dataclass
class Progress:
    """The progress of a conversion, as the console shows it.

    Attributes:
        notices: lines for the user: workers that have no shard to make, or that no node can hold.
    """

    episodes: int = 0
    frames: int = 0
    bytes: int = 0
    quarantined: int = 0
    kept_shards: int = 0
    total_episodes: int = 0
    total_frames: int = 0
    retries: list[str] = field(default_factory=list)
    frame_sizes: dict[str, tuple[int, int]] = field(default_factory=dict)
    notices: list[str] = field(default_factory=list)
    started: float = field(default_factory=time.monotonic)


@dataclass(frozen=True)
class Summary:
    """The result of a conversion.

    Attributes:
        reasons: message (without the ids where there are several) -> number of episodes refused for it.
        flags: name -> count over all episodes, such as masked_actions; see docs/format.md.
        frame_sizes: camera -> (height, width) of its recorded frames; empty if no shard was made.
        left_out, outside: those of the plan.
        too_many: True where more than `max_quarantine` was refused; the command ends with exit code 1.
        changed: what the YAML says now that a finished set did not say yet; empty if nothing.
        warning: the fault of a rate that the recordings do not have; empty if there is none.
        notes: what else to mend before training, as `hma doctor` says it: no window, pauses.
        held_out: how many episodes are for validation, and by what rule; empty for a LeRobotDataset without.
        bytes: of the files.
        dataset: the result of the LeRobotDataset that was made beside the shards.
    """

    out: Path
    manifest: Manifest
    kept_shards: int
    made_shards: int
    seconds: float
    reasons: dict[str, int]
    flags: dict[str, int]
    too_many: bool
    frame_sizes: dict[str, tuple[int, int]] = field(default_factory=dict)
    left_out: int = 0
    outside: int = 0
    changed: str = ""
    warning: str = ""
    notes: tuple[str, ...] = ()
    held_out: str = ""
    bytes: int = 0
    dataset: "Summary | None" = None

    @property
    def outputs(self) -> "list[Summary]":
        """Return the results of all that was made."""
        return [self] if self.dataset is None else [self, self.dataset]


@dataclass(frozen=True)
class UnfinishedShare:
    """The result of a share of a conversion that leaves shards, or the manifest, to the other shares.

    Attributes:
        name: of the share.
        missing: number of shards that other shares have still to make.
    """

    name: str
    out: Path
    kept_shards: int
    made_shards: int
    missing: int
    seconds: float


class Counter:
    """A counter of what units report; when a unit is retried, its earlier counts are taken back."""

    def __init__(self, progress: Progress, on_progress: Callable[[Progress], None]) -> None:
        self._progress, self._on_progress = progress, on_progress
        self._by_unit: dict[int, dict[str, int]] = {}

    def __call__(self, unit: int, event: Tick | Seen | Retry | Notice) -> None:
        if isinstance(event, Seen):
            self._progress.frame_sizes.setdefault(event.camera, (event.height, event.width))
            return
        if isinstance(event, Notice):
            self._progress.notices.append(event.text)
            self._on_progress(self._progress)
            return
        counts = self._by_unit.setdefault(unit, dict.fromkeys(vars(Tick()), 0))
        if isinstance(event, Retry):
            self._progress.retries.append(event.reason)
            change = {name: -count for name, count in counts.items()}
        else:
            change = vars(event)
        for name, count in change.items():
            counts[name] += count
            setattr(self._progress, name, getattr(self._progress, name) + count)
        self._on_progress(self._progress)


def training_notes(folder: Path, out: Path, plan: Plan) -> list[str]:
    """Return what to mend before training.

    First another rate than the YAML states, empty if there is none; then no window, pauses, an empty val.
    """
    made = ShardSet(folder)
    off_rate = rate_finding(made)
    found = (window_finding(made), pause_finding(made))
    notes = [f"{out}: {off_rate}" if off_rate else ""]
    notes += [f"{out}: {one}" for one in found if one and one.severity != "info"]
    wanted = plan.episodes > 1 and plan.facts["settings"]["val_fraction"] != 0
    if wanted and not made.manifest.splits["val"]["episodes"]:
        said = (
            "its episodes are in quarantine.jsonl, or --limit, groups or the recording's own split left none"
        )
        notes.append(f"{out}: val is empty: {said}")
    return notes


def held_out_line(manifest: Manifest, plan: Plan) -> str:
    """Return how many episodes are held out for validation, and by what rule."""
    count = manifest.splits["val"]["episodes"]
    fraction = plan.facts["settings"]["val_fraction"]
    said = f"{count:,} of {human_count(manifest.episodes, 'episode')} held out for validation, "
    if plan.own_split:
        said += "by the recording's own split, which takes precedence over --val-fraction"
    elif fraction is None:
        said += f"{VAL_FRACTION:.0%}, at least {HELD_OUT} but at most a quarter; --val-fraction changes it"
    else:
        said += f"by --val-fraction {fraction:g}"
    if 0 < count < HELD_OUT:
        said += f"; fewer than {HELD_OUT} are too few to judge a model: record more episodes"
    return said


def refusal_reasons(refused: Iterable[Mapping[str, Any]]) -> dict[str, int]:
    """Return reason -> number of refused episodes; reasons that differ in the episode's id alone are one."""
    told: dict[str, list[str]] = {}
    for item in refused:
        text = plain = item["message"]
        if any(letter.isdigit() for letter in item["id"]):  # a numbered id would keep equal reasons apart
            text = re.sub(rf"(?<!\w){re.escape(item['id'])}(?!\w)", "<episode>", text)
        told.setdefault(text, []).append(plain)
    return {text if len(plain) > 1 else plain[0]: len(plain) for text, plain in told.items()}
