"""Write the metrics of a training run, and show its progress.

`metrics.jsonl` has one line a step (`"kind": "train"`) and one line an evaluation (`"kind": "eval"`). A
terminal shows a live table; any other output gets a plain line every few seconds.
"""

import json
import math
import os
import sys
import time
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, TextIO

from hma_data.console import human_seconds
from hma_data.errors import OutputError
from hma_data.storage.files import finite, write_atomic
from hma_data.storage.paths import StrPath, as_path
from hma_model.evaluation.metrics import perplexity
from hma_model.evaluation.sample_images import FOLDER as PICTURES
from hma_model.training.trackers import Tracker

if TYPE_CHECKING:
    from rich.console import Group
    from rich.live import Live

METRICS, KINDS = "metrics.jsonl", ("train", "eval")
PLAIN_SECONDS = 10.0
SMOOTHING = 20  # steps over which a shown loss is averaged
PACING = 50  # steps from which the speed and the remaining time are estimated


def read_metrics(out: StrPath) -> list[dict[str, Any]]:
    """Read the complete lines of metrics.jsonl in a run's folder (str or path); none without the file."""
    path = as_path(out) / METRICS
    if not path.is_file():
        return []
    found: list[dict[str, Any]] = []
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        try:
            values = json.loads(line)
        except (ValueError, RecursionError):  # a killed run's last line
            continue
        if isinstance(values, dict) and isinstance(values.get("step"), int) and values.get("kind") in KINDS:
            found.append(values)
    return found


class RunLog:
    """The log of a run, a context manager around its steps.

    Args:
        out: the run's folder.
        steps: the number of steps of the whole run.
        begin: the number of finished steps; later lines of an earlier, killed run are dropped.
        show: print progress to standard error.
        write: write metrics.jsonl; only the first rank does.
        trackers: the trackers that get the same figures.
        nats: losses are nats a token, so a perplexity can be shown.
    """

    def __init__(
        self, out: Path, steps: int, begin: int, show: bool = True, write: bool = True,
        trackers: Sequence[Tracker] = (), nats: bool = True,
    ) -> None:  # fmt: skip
        self._steps, self._begin, self._show, self._write_it = steps, begin, show, write
        self._trackers, self._nats = trackers, nats
        self._path = out / METRICS
        kept = [line for line in read_metrics(out) if line["step"] <= begin]
        if write:
            write_atomic(self._path, "".join(_line(values) for values in kept))
        self._recent: dict[str, deque[float]] = {}
        self._last: dict[str, Any] = {}
        evaluations = [line for line in kept if line["kind"] == "eval"]
        self._evaluation: dict[str, Any] = evaluations[-1] if evaluations else {}
        self._paces: deque[float] = deque(maxlen=PACING)  # seconds of steps of this session
        self._spent, self._shown, self._said = 0.0, 0.0, ""
        self._opened = time.monotonic()
        self._live: Live | None = None

    def __enter__(self) -> "RunLog":
        self._file: TextIO | None = self._path.open("a", encoding="utf-8") if self._write_it else None
        if self._show and sys.stderr.isatty():
            from rich.console import Console
            from rich.live import Live

            first = f"step {self._begin:,}/{self._steps:,}   the next step is the first of this session"
            self._live = Live(first, console=Console(stderr=True), refresh_per_second=4)
            self._live.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, fault: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._present(force=True)
        if self._live:
            self._live.__exit__(kind, fault, trace)
        if self._file:
            self._file.close()
        for tracker in self._trackers:
            tracker.close()

    def note(self, text: str) -> None:
        """Print a note for the user."""
        if self._live:
            self._live.console.print(text, markup=False, highlight=False)
        elif self._show:
            print(text, file=sys.stderr, flush=True)

    def step(self, facts: dict[str, Any]) -> None:
        """Add a line of kind train; `facts` has step, loss_by_embodiment, lr, step_seconds and more."""
        self._write({"kind": "train", **facts})
        self._track("train", facts, ("loss", "lr", "grad_norm", "step_seconds", "memory_mib", "skipped"))
        self._last = facts
        self._spent += facts["step_seconds"]
        first = facts["step"] == self._begin + 1  # it includes compilation and starting workers
        if facts["step"] == self._begin + 2:
            self._paces.clear()
        self._paces.append(facts["step_seconds"] - first * facts.get("data_seconds", 0.0))
        for name, loss in facts["loss_by_embodiment"].items():
            recent = self._recent.setdefault(name, deque(maxlen=SMOOTHING))
            if math.isfinite(loss):  # skipped steps are counted separately
                recent.append(loss)
        self._present()

    def evaluation(self, facts: dict[str, Any]) -> None:
        """Add a line of kind eval."""
        self._write({"kind": "eval", **facts})
        self._track("eval", facts, ("loss", "perplexity", "accuracy", "baseline"))
        self._evaluation = facts
        if not self._live:
            self._present(force=True)

    def sync(self) -> None:
        """Flush the lines to disk, because the checkpoint that is written next continues from them."""
        if self._file is None:
            return
        try:
            os.fsync(self._file.fileno())
        except OSError as fault:
            raise OutputError(self._path, f"cannot be written: {fault.strerror}", "free space") from fault

    def pictures(self, out: Path, step: int) -> None:
        """Pass the pictures of an evaluation to the trackers."""
        for path in sorted((out / PICTURES).glob(f"step-{step:08d}-*.png")) if self._trackers else ():
            for tracker in self._trackers:
                tracker.picture(step, f"rollout/{path.stem[14:]}", path)

    def _track(self, kind: str, facts: dict[str, Any], keys: Sequence[str]) -> None:
        if not self._trackers:
            return
        values = {f"{kind}/{key}": facts.get(key) for key in keys}
        for key in ("loss", "accuracy"):
            own = facts.get(f"{key}_by_embodiment", {})
            values.update({f"{kind}_{key}/{name}": value for name, value in own.items()})
        known = {tag: float(value) for tag, value in values.items() if value is not None}
        for tracker in self._trackers:
            tracker.scalars(facts["step"], known)

    def _write(self, values: dict[str, Any]) -> None:
        if self._file is None:
            return
        try:
            self._file.write(_line(values))
            self._file.flush()
        except OSError as fault:
            raise OutputError(self._path, f"cannot be written: {fault.strerror}", "free space") from fault

    def _present(self, force: bool = False) -> None:
        if not self._last or not self._show:
            return
        if self._live:
            self._live.update(self._table())
        elif force or time.monotonic() - self._shown >= PLAIN_SECONDS:
            text, self._shown = self._text(), time.monotonic()
            if text != self._said:
                print(text, file=sys.stderr, flush=True)
            self._said = text

    def _pace(self) -> tuple[float, str]:
        """Return windows a second of the last steps, and the remaining time, other work included."""
        done = max(self._last["step"] - self._begin, 1)
        seconds = max(sum(self._paces) / max(len(self._paces), 1), 1e-9)
        besides = max(time.monotonic() - self._opened - self._spent, 0.0) / done
        left = (self._steps - self._last["step"]) * (seconds + besides)
        return self._last["windows"] / seconds, human_seconds(left)

    def _smooth(self) -> dict[str, float]:
        return {n: sum(v) / len(v) if v else math.nan for n, v in sorted(self._recent.items())}

    def _text(self) -> str:
        rate, left = self._pace()
        losses = ", ".join(f"{name} {value:.3f}" for name, value in self._smooth().items())
        held = f", validation {_number(self._evaluation.get('loss'))}" if self._evaluation else ""
        skipped = f", {self._last['skipped']} steps left out" if self._last.get("skipped") else ""
        where = f"step {self._last['step']}/{self._steps}"
        return f"{where}: loss {losses}{held}, {rate:.1f} windows/s, {left} left{skipped}"

    def _table(self) -> "Group":
        from rich.box import SIMPLE
        from rich.console import Group
        from rich.table import Table

        rate, left = self._pace()
        table = Table("embodiment", "loss", "perplexity", "validation", "ignoring all", box=SIMPLE)
        held = self._evaluation.get("loss_by_embodiment", {})
        ignoring = self._evaluation.get("baseline_by_embodiment", {})
        for name, loss in self._smooth().items():
            known = [_number(values.get(name)) for values in (held, ignoring)]
            table.add_row(name, f"{loss:.3f}", _rounded(perplexity(loss)) if self._nats else "-", *known)
        last = self._last
        head = f"step {last['step']:,}/{self._steps:,}   {rate:.1f} windows/s   {left} left"
        rest = f"lr {last['lr']:.2e}   {last.get('memory_mib', 0):,.0f} MiB"
        skipped = f"   {last['skipped']} steps left out" if last.get("skipped") else ""
        return Group(f"{head}   {rest}{skipped}", table)


def _rounded(value: float) -> str:
    return f"{value:,.1f}" if value < 100 else f"{value:,.0f}"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def _line(values: dict[str, Any]) -> str:
    return json.dumps(finite(values), ensure_ascii=False, allow_nan=False) + "\n"
