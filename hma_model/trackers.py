"""Where else a run's figures go: TensorBoard event files by default, trackio or wandb on request.

Event files need no package: a TFRecord frame around a small protobuf, in `tensorboard/` of the run's folder.
`pip install tensorboard && tensorboard --logdir RUN` shows them.
"""

import hashlib
import importlib
import struct
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from hma_data.errors import MissingDependencyError, OutputError

if TYPE_CHECKING:
    from hma_model.recipe import Recipe

FOLDER = "tensorboard"


class Tracker(Protocol):
    """Takes figures and pictures as they come."""

    def scalars(self, step: int, values: Mapping[str, float]) -> None:
        """Figures of a step by tag, such as `train/loss`."""
        ...

    def picture(self, step: int, tag: str, path: Path) -> None:
        """A PNG file."""
        ...

    def close(self) -> None:
        """Nothing more will come."""
        ...


def open_trackers(recipe: "Recipe", out: Path, step: int) -> list[Tracker]:
    """The trackers a recipe asks for.

    Args:
        recipe: `track` names them.
        out: the run's folder.
        step: steps done; what an earlier, killed session has written beyond it is superseded.

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
    """trackio or wandb, which share their functions.

    Args:
        name: of the package.
        recipe: kept with the run.
        out: the run's folder, whose name is the run's.
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
        if name == "wandb":  # knows a run that goes on by its id, trackio by its name
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
    """A TensorBoard event file.

    Args:
        folder: made where it is not there; every session adds a file.
        step: figures of later steps in older files are superseded.
    """

    def __init__(self, folder: Path, step: int = 0) -> None:
        now = time.time()
        try:
            folder.mkdir(exist_ok=True)
            count = len(list(folder.glob("events.out.tfevents.*")))
            self._path = folder / f"events.out.tfevents.{int(now):010d}.hma.{count:04d}"
            self._file = self._path.open("wb")
        except OSError as fault:
            raise OutputError(folder, f"cannot be written: {fault.strerror}", "free space") from fault
        self._write(_double(1, now) + _bytes(3, b"brain.Event:2"))
        if count:  # SessionLog.START: what comes after this step in older files is to be forgotten
            self._write(_double(1, now) + _integer(2, step + 1) + _bytes(7, _integer(1, 1)))

    def scalars(self, step: int, values: Mapping[str, float]) -> None:
        """See `Tracker`."""
        rows = b"".join(
            _bytes(1, _bytes(1, tag.encode()) + _float(2, value)) for tag, value in values.items()
        )
        self._event(step, rows)

    def picture(self, step: int, tag: str, path: Path) -> None:
        """See `Tracker`."""
        content = path.read_bytes()
        width, height = struct.unpack(">II", content[16:24])  # PNG's first chunk
        image = _integer(1, height) + _integer(2, width) + _integer(3, 3) + _bytes(4, content)
        self._event(step, _bytes(1, _bytes(1, tag.encode()) + _bytes(4, image)))

    def close(self) -> None:
        """See `Tracker`."""
        self._file.close()

    def _event(self, step: int, summary: bytes) -> None:
        self._write(_double(1, time.time()) + _integer(2, step) + _bytes(5, summary))

    def _write(self, event: bytes) -> None:
        length = struct.pack("<Q", len(event))
        record = length + struct.pack("<I", _masked_crc(length)) + event
        try:
            self._file.write(record + struct.pack("<I", _masked_crc(event)))
            self._file.flush()
        except OSError as fault:
            raise OutputError(self._path, f"cannot be written: {fault.strerror}", "free space") from fault


# -- TFRecord and protobuf, as far as an event needs them


def _masked_crc(content: bytes) -> int:
    import google_crc32c

    crc = int(google_crc32c.value(content))
    return ((crc >> 15 | crc << 17) + 0xA282EAD8) & 0xFFFFFFFF


def _varint(value: int) -> bytes:
    parts = bytearray()
    while value > 0x7F:
        parts.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*parts, value])


def _integer(field: int, value: int) -> bytes:
    return _varint(field << 3) + _varint(value)


def _double(field: int, value: float) -> bytes:
    return _varint(field << 3 | 1) + struct.pack("<d", value)


def _float(field: int, value: float) -> bytes:
    return _varint(field << 3 | 5) + struct.pack("<f", value)


def _bytes(field: int, value: bytes) -> bytes:
    return _varint(field << 3 | 2) + _varint(len(value)) + value
