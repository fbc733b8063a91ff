"""Send a run's figures to TensorBoard event files, trackio or wandb, if the recipe asks for it.

Event files lie in `tensorboard/` of the run's folder; `tensorboard --logdir RUN` shows them.
"""

import hashlib
import importlib
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from hma_data.errors import MissingDependencyError, OutputError

if TYPE_CHECKING:
    from hma_model.training.recipe import Recipe

FOLDER = "tensorboard"


class Tracker(Protocol):
    """A receiver of figures and pictures."""

    def scalars(self, step: int, values: Mapping[str, float]) -> None:
        """Record figures of a step by tag, such as `train/loss`."""
        ...

    def picture(self, step: int, tag: str, path: Path) -> None:
        """Record a PNG file."""
        ...

    def close(self) -> None:
        """End the record."""
        ...


def open_trackers(recipe: "Recipe", out: Path, step: int) -> list[Tracker]:
    """Open the trackers that a recipe names.

    Args:
        recipe: `track` names them.
        out: the run's folder.
        step: number of finished steps; later figures of an earlier, killed session are superseded.

    Raises:
        MissingDependencyError: a package is not installed.
        OutputError: an event file cannot be written.
    """
    made: list[Tracker] = []
    for name in recipe.track:
        if name == "tensorboard":
            made.append(EventFile(out / FOLDER, step))
        else:
            made.append(Remote(name, recipe, out))
    return made


class Remote:
    """A tracker for trackio or wandb, which have the same functions.

    Args:
        name: the name of the package.
        recipe: the recipe, which is recorded with the run.
        out: the run's folder; its name is the name of the run.
    """

    def __init__(self, name: str, recipe: "Recipe", out: Path) -> None:
        try:
            self._package: Any = importlib.import_module(name)
        except ImportError as fault:
            raise MissingDependencyError(
                f"recipe: track={name}", f"{name} is not installed", f"pip install {name}, or leave it out"
            ) from fault
        run = out.absolute().name
        given = {"project": recipe.project, "name": run, "config": recipe.values(), "resume": "allow"}
        if name == "wandb":  # wandb resumes a run by its id, trackio by its name
            folder = hashlib.sha256(str(out.absolute()).encode()).hexdigest()
            given["id"] = f"{run[:40]}-{folder[:12]}"
        self._package.init(**given)

    def scalars(self, step: int, values: Mapping[str, float]) -> None:
        """See `Tracker`."""
        self._package.log(dict(values), step=step)

    def picture(self, step: int, tag: str, path: Path) -> None:
        """See `Tracker`."""
        self._package.log({tag: self._package.Image(str(path))}, step=step)

    def close(self) -> None:
        """See `Tracker`."""
        self._package.finish()


class EventFile:
    """A TensorBoard event file, written with the protocol buffers of the `tensorboard` package.

    `torch.utils.tensorboard.SummaryWriter` is not used: it imports TensorFlow wherever that is installed.

    Args:
        folder: the folder, made if it does not exist; every session adds a file.
        step: figures of later steps in older files are superseded.
    """

    def __init__(self, folder: Path, step: int = 0) -> None:
        try:
            self._protos = importlib.import_module("tensorboard.compat.proto.event_pb2")
            records = importlib.import_module("tensorboard.summary.writer.record_writer")
        except ImportError as fault:
            raise MissingDependencyError(
                "recipe: track=tensorboard",
                "tensorboard is not installed",
                "uv sync --extra tensorboard, or leave it out",
            ) from fault
        try:
            folder.mkdir(exist_ok=True)
            count = len(list(folder.glob("events.out.tfevents.*")))
            self._path = folder / f"events.out.tfevents.{int(time.time()):010d}.hma.{count:04d}"
            self._records = records.RecordWriter(self._path.open("wb"))
        except OSError as fault:
            raise OutputError(folder, f"cannot be written: {fault.strerror}", "free space") from fault
        self._write(file_version="brain.Event:2")
        if count:  # tells readers to drop later steps of older files
            self._write(step=step + 1, session_log={"status": self._protos.SessionLog.START})

    def scalars(self, step: int, values: Mapping[str, float]) -> None:
        """See `Tracker`."""
        rows = [{"tag": tag, "simple_value": value} for tag, value in values.items()]
        self._write(step=step, summary={"value": rows})

    def picture(self, step: int, tag: str, path: Path) -> None:
        """See `Tracker`."""
        from PIL import Image

        content = path.read_bytes()
        with Image.open(path) as opened:
            width, height = opened.size
        image = {"height": height, "width": width, "colorspace": 3, "encoded_image_string": content}
        self._write(step=step, summary={"value": [{"tag": tag, "image": image}]})

    def close(self) -> None:
        """See `Tracker`."""
        self._records.close()

    def _write(self, **fields: Any) -> None:
        event = self._protos.Event(wall_time=time.time(), **fields)
        try:
            self._records.write(event.SerializeToString())
            self._records.flush()
        except OSError as fault:
            raise OutputError(self._path, f"cannot be written: {fault.strerror}", "free space") from fault
