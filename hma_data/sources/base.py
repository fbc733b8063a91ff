"""Define what a source is: one recording format, read episode by episode.

A source must be cheap to make, because every worker makes its own. Between calls it keeps no file open
that would not survive a fork. `open_source` finds a source by the name of its format;
`hma_data.sources.detect` finds the format of a recording. Formats are listed in `hma_data.registry`;
installed packages may add some.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Protocol, runtime_checkable

import numpy as np

from hma_data.arrays import Array, Float32s
from hma_data.episodes.episode import Episode
from hma_data.errors import EpisodeError, SourceError
from hma_data.plugins import SOURCE_GROUP, installed
from hma_data.registry import FORMATS, MORE_FORMATS, known_formats
from hma_data.registry.components import Vector
from hma_data.registry.embodiment import Embodiment

# Packages that add a source take these names from here.
from hma_data.sources.common.inspection import Inspection as Inspection
from hma_data.sources.common.inspection import KeyInfo as KeyInfo
from hma_data.sources.common.inspection import TopicInfo as TopicInfo
from hma_data.sources.common.places import file_fingerprint as file_fingerprint
from hma_data.sources.common.places import local_path as local_path
from hma_data.storage.paths import StrPath

SAMPLE = 20  # episodes that inspect looks into


@dataclass(frozen=True, slots=True)
class EpisodeRef:
    """An episode that has not been read yet.

    Attributes:
        id: unique and stable within the source.
        frames: how many it has, or an estimate; for planning shards without decoding.
        split: the source's own split, "train" or "val"; None where it has none.
        fingerprint: changes when the recording's bytes change (size and sample of content, not time stamps).
        group: shared by the episodes cut from one recording, which must stay in one split; empty means `id`.
        left_out: frames of that recording that belong to none of its episodes.
    """

    id: str
    frames: int
    split: str | None = None
    fingerprint: str = ""
    group: str = ""
    left_out: int = 0


@runtime_checkable
class Source(Protocol):
    """A reader of one recording format. `uri` is the path (str or path object) or the URI of a recording."""

    def inspect(self, uri: StrPath, episodes: int = SAMPLE) -> Inspection:
        """Return what the recording holds; sample the values and frames of `episodes` episodes."""

    def index(self, uri: StrPath, embodiment: Embodiment | None = None) -> Sequence[EpisodeRef]:
        """Return the episodes in a stable order, without decoding any; millions of them as `Records`."""

    def episode_ids(self, uri: StrPath) -> list[str]:
        """Return the ids of the episodes."""

    def read(self, uri: StrPath, episode_id: str, embodiment: Embodiment) -> Episode:
        """Return one episode; its frames are decoded on demand."""


@runtime_checkable
class LaidOut(Protocol):
    """A source whose recordings have the layout that a YAML states."""

    def inspect_as(self, uri: StrPath, embodiment: Embodiment, episodes: int = SAMPLE) -> Inspection:
        """Return what the recording holds, as `Source.inspect`, with the episodes of the robot's layout."""


@runtime_checkable
class Expecting(Protocol):
    """A source that is told which episodes will be read next, so that it can fetch them ahead."""

    def expect(self, uri: StrPath, episode_ids: Sequence[str]) -> None:
        """State the episodes that will be read, in their order; an error of it is ignored."""


@dataclass(frozen=True)
class Recognition:
    """The signs of a format's recordings; the format's package states them as `RECOGNITION`.

    `detect` asks every format by its first attribute, then every format by the next. What is left empty
    recognises nothing.

    Attributes:
        label: what such a recording is, for the error that lists what is known.
        uri: whether a name or URI is of this format, before anything is opened.
        layout: files inside the recording's folder, such as "meta/info.json".
        names: patterns of file names anywhere in the folder, such as "*.tfrecord*".
        endings: of file names, such as ".h5"; of a store's URI too.
        magic: what files begin with, at most 32 bytes.
        weak_endings: of file names in lower case, that count only where nothing else does.
    """

    label: str
    uri: Callable[[str], bool] = lambda uri: False
    layout: tuple[str, ...] = ()
    names: tuple[str, ...] = ()
    endings: tuple[str, ...] = ()
    magic: tuple[bytes, ...] = ()
    weak_endings: tuple[str, ...] = ()


def open_source(name: str) -> Source:
    """Return the source of a format, e.g. "rlds".

    Raises:
        SourceError: no such format.
        PluginError: the package that adds it is broken.
    """
    if name in FORMATS:
        source: Source = import_module(f"{FORMATS[name]}.source").open()
        return source
    plugin = installed(SOURCE_GROUP).get(name)
    if plugin is None:
        raise SourceError(
            name, "is not a source format", f"known: {', '.join(known_formats())}; {MORE_FORMATS}"
        )
    module = plugin.load()
    if not callable(getattr(module, "open", None)):
        raise plugin.broken(f"{plugin.entry_point.value} has no open()")
    opened = plugin.call("open()", module.open)
    if not isinstance(opened, Source):
        raise plugin.broken(
            f"open() gave {type(opened).__name__}, which is not an hma_data.sources.base.Source"
        )
    return opened


# -- vectors


def compose(vector: Vector, pieces: Sequence[Array], where: str) -> Float32s:
    """Return a vector over time, joined from the recorded values of its components.

    Slices, signs and offsets are applied only here.

    Args:
        vector: of the embodiment.
        pieces: for each component (T, n) or (T,) numbers as recorded.
        where: the episode, for the error.

    Returns:
        (T, A) float32.

    Raises:
        EpisodeError: a width, a length or a dtype does not fit.
    """
    parts = [
        component_values(part, piece, where) for part, piece in zip(vector.components, pieces, strict=True)
    ]
    lengths = {part.key: len(values) for part, values in zip(vector.components, parts, strict=True)}
    if len(set(lengths.values())) > 1:
        said = ", ".join(f"{key} {length}" for key, length in lengths.items())
        raise EpisodeError(where, f"its components differ in length: {said}")
    return np.concatenate(parts, axis=1)


def read_vector(vector: Vector, read: Callable[[str], Array], where: str) -> Float32s:
    """Return a vector over time; `read` returns the recorded values of a key, and is asked once for each."""
    values = {key: read(key) for key in dict.fromkeys(part.key for part in vector.components)}
    return compose(vector, [values[part.key] for part in vector.components], where)


def component_values(part: Any, piece: Array, where: str) -> Float32s:
    """Return the values (T, dims) float32 of one component; see `compose`."""
    if piece.dtype.kind not in "fiub":
        raise EpisodeError(where, f"{part.key} holds {piece.dtype}, not numbers")
    if piece.ndim < 1 or not len(piece):
        raise EpisodeError(where, f"{part.key} holds no values over time (shape {piece.shape})")
    values: Array = piece.reshape(len(piece), -1)
    width = values.shape[1]
    if part.slice:
        fault = f"{part.key} has {width} values, slice {list(part.slice)} needs {part.slice[1]}"
        if part.slice[1] > width:
            raise EpisodeError(where, fault, "correct slice in the YAML")
        values = values[:, part.slice[0] : part.slice[1]]
    elif width != part.dims:
        fault = f"{part.key} has {width} values, the embodiment says {part.dims}"
        raise EpisodeError(where, fault, "correct dims or give slice in the YAML")
    values = values.astype(np.float64) * np.asarray(part.sign) + np.asarray(part.offset)
    with np.errstate(over="ignore"):  # a value too large for float32 becomes infinite, and align refuses it
        return values.astype(np.float32)
