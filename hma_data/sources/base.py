"""Define what a source is: one recording format, read episode by episode.

A source must be cheap to make, because every worker makes its own. Between calls it keeps no file open
that would not survive a fork. `open_source` finds a source by the name of its format; `detect` finds the
format of the files at a path. Formats are listed in `hma_data.registry.catalog`; installed packages may
add some.

T frames of an episode, A values of a vector.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from fnmatch import fnmatchcase
from importlib import import_module
from pathlib import Path, PurePosixPath
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from hma_data.episodes.episode import Episode
from hma_data.episodes.offset import Offset
from hma_data.errors import EpisodeError, HMAError, PluginError, SourceError
from hma_data.plugins import SOURCE_GROUP, installed
from hma_data.registry import FORMATS, MORE, known_formats
from hma_data.registry.components import Vector
from hma_data.registry.embodiment import Embodiment
from hma_data.sources.common.checks import Finding
from hma_data.sources.common.places import file_fingerprint as file_fingerprint  # sources of packages use it
from hma_data.sources.common.places import first_bytes, is_away, nothing_there
from hma_data.sources.common.places import local_path as local_path
from hma_data.storage.kinds import misplaced, own_layout, unreadable
from hma_data.storage.paths import StrPath, as_text
from hma_data.storage.remote import place

SAMPLE = 20  # episodes that inspect looks into
RECIPE = "docs/adding-a-robot.md, Pictures and tables"
PACKED = {  # the command that unpacks a file, by the end of its name
    ".tar": "tar xf", ".tar.gz": "tar xf", ".tgz": "tar xf", ".tar.bz2": "tar xf", ".tar.xz": "tar xf",
    ".tar.zst": "tar xf", ".zip": "unzip", ".7z": "7z x", ".gz": "gunzip", ".bz2": "bunzip2", ".xz": "unxz",
    ".zst": "unzstd", ".zstd": "unzstd", ".lz4": "unlz4",
}  # fmt: skip


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


@dataclass(frozen=True)
class TopicInfo:
    """The topic of a bag that holds a key, as measured from its messages.

    Attributes:
        name: of the topic.
        type: of its messages.
        gap_ms: the longest interval between two of them in which a camera saw something; of a camera, the
            longest interval; None for fewer than two.
        delay_ms: median from header stamp to receipt; None where messages carry no time.
        goes_back: whether header stamps go back in time.
        offsets: how the messages lie between the pictures of each camera; of topics with numbers only.
    """

    name: str
    type: str
    gap_ms: float | None = None
    delay_ms: float | None = None
    goes_back: bool = False
    offsets: tuple[Offset, ...] = ()


@dataclass(frozen=True)
class KeyInfo:
    """One key of a recording, as `hma inspect` lists it.

    Attributes:
        key: as an embodiment's YAML would name it.
        kind: camera, vector, text or other.
        shape: of one sample; pictures are (H, W, 3), or (H, W, 1) where they are recorded in grey.
        dtype: of the values as they are decoded.
        hz: measured or stated rate; None when unknown.
        names: of the values, where the recording has them.
        codec: of pictures: jpeg, png, raw, av1, h264.
        count: samples seen (of one episode, or of the whole recording when it is a topic).
        jitter_ms: standard deviation of the intervals.
        topic: the topic that holds the key; of bags only.
        constant: whether a vector never changes in the sampled episodes.
        still: indices of the values of a vector that never change in the sampled episodes.
        low, high: smallest and largest finite number in the sampled episodes; of pictures in mono16, their
            values before they are scaled.
        swapped: whether red and blue are swapped in the pictures: sure, no; None where it is unknown.
        skew_ms: p50, p95 and max distance from the first camera's frames, for a stream with its own clock.
        encoding: of a bag's pictures, as their messages state it: rgb8, mono8, mono16.
    """

    key: str
    kind: str
    shape: tuple[int, ...]
    dtype: str
    hz: float | None = None
    names: tuple[str, ...] | None = None
    codec: str | None = None
    count: int | None = None
    jitter_ms: float | None = None
    topic: TopicInfo | None = None
    constant: bool = False
    still: tuple[int, ...] = ()
    low: float | None = None
    high: float | None = None
    skew_ms: tuple[float, float, float] | None = None
    swapped: str | None = None
    encoding: str | None = None


@dataclass(frozen=True)
class Inspection:
    """The contents of a recording, found without an embodiment.

    Attributes:
        format: as `open_source` takes it.
        episodes: how many.
        frames: of all episodes together; None when counting them would need a full read.
        lengths: of the first episodes (at most 1,000).
        keys: each key once.
        robot: the robot's name in the recording.
        facts: other facts about the recording, by name.
        looked_at: how many episodes were sampled for their values and pictures.
        findings: what the checks found, in the order of the checks.
        checks: names of the checks that could be made; a check without a finding passed.
    """

    format: str
    uri: str
    episodes: int
    keys: tuple[KeyInfo, ...]
    frames: int | None = None
    lengths: tuple[int, ...] = ()
    hz: float | None = None
    robot: str | None = None
    facts: dict[str, str] = field(default_factory=dict)
    looked_at: int = 0
    findings: tuple[Finding, ...] = ()
    checks: tuple[str, ...] = ()

    @property
    def problems(self) -> tuple[str, ...]:
        """Return the findings that are errors or warnings, one sentence each."""
        return tuple(str(finding) for finding in self.findings if finding.severity != "info")

    def to_json(self) -> dict[str, Any]:
        """Return plain values for `--json`."""
        return asdict(self) | {"problems": list(self.problems)}


@runtime_checkable
class Source(Protocol):
    """A reader of one recording format. `uri` is the path (str or path object) or the URI of a recording."""

    def inspect(self, uri: StrPath, episodes: int = SAMPLE) -> Inspection:
        """Return what the recording holds; sample the values and pictures of `episodes` episodes."""
        ...

    def index(self, uri: StrPath, embodiment: Embodiment | None = None) -> Sequence[EpisodeRef]:
        """Return the episodes in a stable order, without decoding any; millions of them as `Records`."""
        ...

    def episode_ids(self, uri: StrPath) -> list[str]:
        """Return the ids of the episodes."""
        ...

    def read(self, uri: StrPath, episode_id: str, embodiment: Embodiment) -> Episode:
        """Return one episode; its pictures are decoded on demand."""
        ...


@runtime_checkable
class LaidOut(Protocol):
    """A source whose recordings have the layout that a YAML states."""

    def inspect_as(self, uri: StrPath, embodiment: Embodiment, episodes: int = SAMPLE) -> Inspection:
        """Return what the recording holds, as `Source.inspect`, with the episodes of the robot's layout."""
        ...


@runtime_checkable
class Expecting(Protocol):
    """A source that is told which episodes will be read next, so that it can fetch them ahead."""

    def expect(self, uri: StrPath, episode_ids: Sequence[str]) -> None:
        """State the episodes that will be read, in their order; an error of it is ignored."""
        ...


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


Recognitions = Mapping[str, Recognition]


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
        raise SourceError(name, "is not a source format", f"known: {', '.join(known_formats())}; {MORE}")
    module = plugin.load()
    if not callable(getattr(module, "open", None)):
        raise plugin.broken(f"{plugin.entry_point.value} has no open()")
    opened = plugin.call("open()", module.open)
    if not isinstance(opened, Source):
        raise plugin.broken(
            f"open() gave {type(opened).__name__}, which is not an hma_data.sources.base.Source"
        )
    return opened


def detect(uri: StrPath) -> str:
    """Return the format of the recording at `uri`, found by the names and first bytes of its files.

    Formats of installed packages are asked after the built-in ones.

    Args:
        uri: str or path of the recording, or its URI.

    Raises:
        SourceError: nothing is there, or its format is unknown.
        PluginError: the format is unknown, and a package that might know it is broken.
    """
    uri = as_text(uri)
    if not uri:
        raise SourceError("", "the recording's path is empty", "name a file, a folder or a URI")
    ours = _of_toolkit()
    if found := _by_uri(uri, ours):
        return found
    if is_away(uri):
        return _by_uri(uri, _of_packages()[0]) or _by_listing(uri, ours) or "rlds"
    path = local_path(uri)
    files = [path] if path.is_file() else sorted(item for item in path.rglob("*") if item.is_file())[:2000]
    if found := by_files(path, files, ours):
        return found
    theirs, broken = _of_packages()
    if found := _by_uri(uri, theirs) or by_files(path, files, theirs):
        return found
    if broken:
        raise broken[0]
    known = [recognition.label for recognition in (*ours.values(), *theirs.values())]
    if other := misplaced(path, "a recording"):
        raise SourceError(uri, *other)
    expected = f"expected {', '.join(known[:-1])}, or {known[-1]}"
    if own := own_layout(files):
        expected += f"; its files ({own}) can be packed into HDF5: {RECIPE}"
    remedy = _unpack_first(files) or expected
    if files:
        fault, remedy = unreadable(files[0], "is not a recording of a known format", remedy)
        raise nothing_there(uri, path, fault, remedy)
    raise nothing_there(uri, path, "holds no files", remedy)


def recognitions() -> Recognitions:
    """Return how the formats are recognised: the built-in ones, then those of installed packages."""
    return {**_of_packages()[0], **_of_toolkit()}


def require_there(uri: StrPath) -> None:
    """Raise SourceError if a local recording does not exist; a URI or a name of the hub is not looked at."""
    uri = as_text(uri)
    if uri and not is_away(uri) and not _by_uri(uri, recognitions()):
        local_path(uri)


def require_utf8(uri: StrPath) -> None:
    """Raise SourceError if a recording's path is not UTF-8 text: YAML files and shards could not state it."""
    text = as_text(uri)
    try:
        text.encode()
    except UnicodeEncodeError as fault:
        shown = text.encode(errors="backslashreplace").decode()
        raise SourceError(shown, "its name is not UTF-8 text", "rename it") from fault


def _of_toolkit() -> Recognitions:
    return {name: import_module(package).RECOGNITION for name, package in FORMATS.items()}


def _of_packages() -> tuple[Recognitions, list[PluginError]]:
    """Return how the formats of installed packages are recognised, and the errors of broken packages."""
    found: dict[str, Recognition] = {}
    broken: list[PluginError] = []
    for name, plugin in installed(SOURCE_GROUP).items():
        if name in FORMATS:
            continue
        try:
            recognition = getattr(plugin.load(), "RECOGNITION", None)
            if not isinstance(recognition, Recognition | None):
                raise plugin.broken(f"its RECOGNITION is a {type(recognition).__name__}")
        except PluginError as fault:
            broken.append(fault)
            continue
        if recognition:
            found[name] = recognition
    return found, broken


def _by_uri(uri: str, known: Recognitions) -> str | None:
    """Return the format that a name or URI alone shows."""
    suffix = PurePosixPath(uri).suffix if is_away(uri) else ""
    by_name = (name for name, recognition in known.items() if recognition.uri(uri))
    by_ending = (name for name, recognition in known.items() if suffix in recognition.endings)
    return next(by_name, None) or next(by_ending, None)


def _by_listing(uri: str, known: Recognitions) -> str | None:
    """Return the format that the names directly below a folder of a store show."""
    try:
        names = [path.name for path in place(uri).iterdir()]
    except HMAError:  # a server that lists nothing
        return None
    for name, recognition in known.items():
        if any(fnmatchcase(item, pattern) for item in names for pattern in recognition.names):
            return name
    return next((k for k, v in known.items() if any(item.endswith(v.endings) for item in names)), None)


def by_files(path: Path, files: Sequence[Path], known: Recognitions) -> str | None:
    """Return the format that the files of a recording on this machine show."""
    for name, recognition in known.items():
        if any((path / place).is_file() for place in recognition.layout):
            return name
    for name, recognition in known.items():
        if any(fnmatchcase(file.name, pattern) for file in files for pattern in recognition.names):
            return name
    for file in files:
        head = first_bytes(file, 32)
        for name, recognition in known.items():
            if file.name.endswith(recognition.endings) or head.startswith(recognition.magic):
                return name
    for name, recognition in known.items():
        if any(file.suffix.lower() in recognition.weak_endings for file in files):
            return name
    return None


def of_another_format(uri: str, name: str, fault: SourceError) -> SourceError:
    """Return the error of a recording that could not be read; name the format that it seems to have.

    Args:
        name: the format that was stated.
        fault: the error of reading it as that format; returned as it is where no other format is detected.
    """
    here = Path(uri.removeprefix("file://")).expanduser()
    if found := misplaced(here, "a recording"):
        return SourceError(fault.where, *found)
    try:
        known = detect(uri) if Path(uri.removeprefix("file://")).expanduser().exists() else name
    except SourceError:
        known = name
    if known == name:
        return fault
    remedy = f"it looks like {known}, source.format in the YAML says {name}"
    return SourceError(fault.where, fault.fault, remedy)


def _unpack_first(files: Sequence[Path]) -> str:
    """Return how to unpack the first packed file; empty where there is none."""
    for file in files:
        for suffix, tool in PACKED.items():
            if file.name.lower().endswith(suffix):
                return f"{file.name} is packed: unpack it first, as with `{tool} {file.name}`"
    return ""


def compose(vector: Vector, pieces: Sequence[NDArray[Any]], where: str) -> NDArray[np.float32]:
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


def component_values(part: Any, piece: NDArray[Any], where: str) -> NDArray[np.float32]:
    """Return the values (T, dims) float32 of one component; see `compose`."""
    if piece.dtype.kind not in "fiub":
        raise EpisodeError(where, f"{part.key} holds {piece.dtype}, not numbers")
    if piece.ndim < 1 or not len(piece):
        raise EpisodeError(where, f"{part.key} holds no values over time (shape {piece.shape})")
    values: NDArray[Any] = piece.reshape(len(piece), -1)
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
