"""Write the metrics of a training run, show its progress, and pass the figures to trackers.

`metrics.jsonl` has one line a step (`"kind": "train"`) and one line an evaluation (`"kind": "eval"`). The
recipe may name trackers: TensorBoard's event files in `tensorboard/` of the run's folder (`tensorboard
--logdir RUN` shows them), trackio or wandb. An OSError is converted by the caller, see
`hma_model.training.runtime.run_errors`.
"""

import importlib
import json
import math
import os
import sys
import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, TextIO

from hma_data.console import Update, progress
from hma_data.errors import MissingDependencyError, install_command
from hma_data.storage.files import atomic_path, finite, short_sha256
from hma_data.storage.paths import StrPath, as_path
from hma_model.evaluation.rollout_video import SHEETS
from hma_model.training.recipe import Recipe

METRICS, KINDS, EVENTS = "metrics.jsonl", ("train", "eval"), "tensorboard"
SMOOTHING = 20  # steps over which a shown loss is averaged
LISTED = 6  # robots whose losses the progress names


def read_metrics(out: StrPath) -> Iterator[dict[str, Any]]:
    """Yield the complete lines of metrics.jsonl in a run's folder (str or path); none without the file.

    A line takes more than 2,000 bytes in memory, so those of a long run are not all kept.
    """
    path = as_path(out) / METRICS
    if not path.is_file():
        return
    with path.open(encoding="utf-8", errors="replace") as file:
        for line in file:
            try:
                values = json.loads(line)
            except ValueError:  # a killed run's last line
                continue
            whole = isinstance(values, dict) and isinstance(values.get("step"), int)
            if whole and values.get("kind") in KINDS:
                yield values


def _package(tracker: str, module: str, install: str) -> Any:
    try:
        return importlib.import_module(module)
    except ImportError as fault:
        where, said = f"recipe: track={tracker}", f"{tracker} is not installed"
        raise MissingDependencyError(where, said, f"{install}, or leave it out") from fault


class Remote:
    """A tracker for trackio or wandb, which have the same functions; the run has the name of its folder."""

    def __init__(self, name: str, recipe: Recipe, out: Path) -> None:
        self._package = _package(name, name, f"pip install {name}")
        run = out.absolute().name
        given = {"project": recipe.project, "name": run, "config": recipe.values(), "resume": "allow"}
        if name == "wandb":  # wandb resumes a run by its id, trackio by its name
            given["id"] = f"{run[:40]}-{short_sha256(str(out.absolute()), 12)}"
        self._package.init(**given)

    def scalars(self, step: int, values: Mapping[str, float]) -> None:
        """Record figures of a step by tag, such as `train/loss`."""
        self._package.log(dict(values), step=step)

    def picture(self, step: int, tag: str, path: Path) -> None:
        """Record a PNG file."""
        self._package.log({tag: self._package.Image(str(path))}, step=step)

    def close(self) -> None:
        """End the record."""
        self._package.finish()


class EventFile:
    """A TensorBoard event file, written with the protocol buffers of the `tensorboard` package.

    Every session adds a file to the folder; figures of steps after `step` in older files are superseded.
    `torch.utils.tensorboard.SummaryWriter` is not used: it imports TensorFlow wherever that is installed.
    """

    def __init__(self, folder: Path, step: int = 0) -> None:
        install = install_command("tensorboard")
        self._protos = _package("tensorboard", "tensorboard.compat.proto.event_pb2", install)
        records = _package("tensorboard", "tensorboard.summary.writer.record_writer", install)
        folder.mkdir(exist_ok=True)
        count = len(list(folder.glob("events.out.tfevents.*")))
        path = folder / f"events.out.tfevents.{int(time.time()):010d}.hma.{count:04d}"
        self._records = records.RecordWriter(path.open("wb"))
        self._write(file_version="brain.Event:2")
        if count:  # tells readers to drop later steps of older files
            self._write(step=step + 1, session_log={"status": self._protos.SessionLog.START})

    def scalars(self, step: int, values: Mapping[str, float]) -> None:
        """Record figures of a step by tag, such as `train/loss`."""
        rows = [{"tag": tag, "simple_value": value} for tag, value in values.items()]
        self._write(step=step, summary={"value": rows})

    def picture(self, step: int, tag: str, path: Path) -> None:
        """Record a PNG file."""
        from PIL import Image

        content = path.read_bytes()
        with Image.open(path) as opened:
            width, height = opened.size
        image = {"height": height, "width": width, "colorspace": 3, "encoded_image_string": content}
        self._write(step=step, summary={"value": [{"tag": tag, "image": image}]})

    def close(self) -> None:
        """End the record."""
        self._records.close()

    def _write(self, **fields: Any) -> None:
        self._records.write(self._protos.Event(wall_time=time.time(), **fields).SerializeToString())
        self._records.flush()


Tracker = EventFile | Remote


def open_trackers(recipe: Recipe, out: Path, step: int) -> list[Tracker]:
    """Open the trackers that a recipe names, for the run in folder `out` with `step` finished steps.

    Raises:
        MissingDependencyError: a package is not installed.
    """
    return [
        EventFile(out / EVENTS, step) if name == "tensorboard" else Remote(name, recipe, out)
        for name in recipe.track
    ]


class RunLog:
    """The log of a run, a context manager around its steps.

    Args:
        out: the run's folder.
        steps, begin: the steps of the whole run, and how many are finished; lines of later steps, which an
            earlier, killed session has written, are dropped.
        show: print progress to standard error.
        write: write metrics.jsonl; only the first rank does.
        trackers: the trackers that get the same figures.
    """

    def __init__(
        self, out: Path, steps: int, begin: int, show: bool = True, write: bool = True,
        trackers: Sequence[Tracker] = (),
    ) -> None:  # fmt: skip
        self._steps, self._total, self._show, self._write_it = steps, steps, show, write
        self._trackers = trackers
        self._path = out / METRICS
        self._recent: dict[str, deque[float]] = {}
        self._last: dict[str, Any] = {}
        self._evaluation: dict[str, Any] = {}
        if write:
            self._keep(read_metrics(out), begin)
        self._file: TextIO | None = None
        self._update: Update | None = None
        self._closing = ExitStack()

    def _keep(self, lines: Iterator[dict[str, Any]], begin: int) -> None:
        """Write the lines of finished steps anew, and note the last evaluation among them."""
        with atomic_path(self._path) as part, part.open("w", encoding="utf-8") as file:
            for line in lines:
                if line["step"] <= begin:
                    file.write(_line(line))
                    self._evaluation = line if line["kind"] == "eval" else self._evaluation

    def __enter__(self) -> "RunLog":
        for tracker in self._trackers:
            self._closing.callback(tracker.close)
        if self._write_it:
            self._file = self._closing.enter_context(self._path.open("a", encoding="utf-8"))
        if self._show:
            self._update = self._closing.enter_context(progress("training", self._steps, "steps"))
        return self

    def __exit__(self, *fault: Any) -> None:
        self._closing.__exit__(*fault)

    def note(self, text: str) -> None:
        """Print a note for the user."""
        if self._show:
            print(text, file=sys.stderr, flush=True)

    def step(self, facts: dict[str, Any]) -> None:
        """Add a line of kind train; `facts` has step, loss_by_embodiment, lr, step_seconds and more."""
        self._write({"kind": "train", **facts})
        self._track("train", facts, ("loss", "lr", "grad_norm", "step_seconds", "memory_mib", "skipped"))
        self._last = facts
        for name, loss in facts["loss_by_embodiment"].items():
            recent = self._recent.setdefault(name, deque(maxlen=SMOOTHING))
            if math.isfinite(loss):  # skipped steps are counted separately
                recent.append(loss)
        if self._update:  # CPU seconds may end the run sooner than its steps, as the share that is done tells
            step, done = facts["step"], facts.get("done")
            self._total = min(self._steps, round(step / min(done, 1))) if done else self._steps
            self._update(step, self._words(), self._total)

    def evaluation(self, facts: dict[str, Any]) -> None:
        """Add a line of kind eval."""
        self._write({"kind": "eval", **facts})
        self._track("eval", facts, ("loss", "perplexity", "accuracy", "baseline"))
        self._evaluation = facts
        self.note(f"step {facts['step']}: {self._words()}")
        if self._update:
            self._update(facts["step"], self._words(), self._total)

    def sync(self) -> None:
        """Flush the lines to disk, because the checkpoint that is written next continues from them."""
        if self._file:
            os.fsync(self._file.fileno())

    def pictures(self, out: Path, step: int) -> None:
        """Pass the pictures of an evaluation to the trackers."""
        for path in sorted((out / SHEETS).glob(f"step-{step:08d}-*.png")):
            for tracker in self._trackers:
                tracker.picture(step, f"rollout/{path.stem[14:]}", path)

    def _track(self, kind: str, facts: dict[str, Any], keys: Sequence[str]) -> None:
        values = {f"{kind}/{key}": facts.get(key) for key in keys}
        for key in ("loss", "accuracy"):
            own = facts.get(f"{key}_by_embodiment", {})
            values.update({f"{kind}_{key}/{name}": value for name, value in own.items()})
        known = {tag: float(value) for tag, value in values.items() if value is not None}
        for tracker in self._trackers:
            tracker.scalars(facts["step"], known)

    def _write(self, values: dict[str, Any]) -> None:
        if self._file:
            self._file.write(_line(values))
            self._file.flush()

    def _words(self) -> str:
        """Return the losses of the last steps and of the last evaluation in words."""
        losses = _listed({n: sum(v) / len(v) if v else math.nan for n, v in sorted(self._recent.items())})
        found = self._evaluation.get("loss")
        held = "" if not self._evaluation else f", validation {'-' if found is None else f'{found:.3f}'}"
        skipped = f", {self._last['skipped']} steps skipped" if self._last.get("skipped") else ""
        return f"loss {losses}{held}{skipped}"


def _listed(losses: dict[str, float]) -> str:
    """Return the losses by name; of more than a line holds, their mean, the lowest and the highest."""
    if len(losses) <= LISTED:
        return ", ".join(f"{name} {value:.3f}" for name, value in losses.items())
    ends = [
        f"{name} {losses[name]:.3f}"
        for name in (min(losses, key=losses.__getitem__), max(losses, key=losses.__getitem__))
    ]
    mean = sum(losses.values()) / len(losses)
    return f"{mean:.3f} over {len(losses)} robots ({ends[0]} to {ends[1]})"


def _line(values: dict[str, Any]) -> str:
    return json.dumps(finite(values), ensure_ascii=False, allow_nan=False) + "\n"
