"""Find the format of a recording, by the names and first bytes of its files.

Every format states its signs as `Recognition`. Formats of installed packages are asked after the built-in
ones.
"""

from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from importlib import import_module
from pathlib import Path, PurePosixPath

from hma_data.errors import HMAError, PluginError, SourceError
from hma_data.plugins import SOURCE_GROUP, installed
from hma_data.registry import FORMATS
from hma_data.sources.base import Recognition
from hma_data.sources.common.places import first_bytes, is_away, local_path, nothing_there
from hma_data.storage.kinds import misplaced, own_layout, unreadable
from hma_data.storage.paths import StrPath, as_text
from hma_data.storage.remote import place

RECIPE = "docs/adding-a-robot.md, Images and tables"
PACKED = {  # the command that unpacks a file, by the end of its name
    ".tar": "tar xf", ".tar.gz": "tar xf", ".tgz": "tar xf", ".tar.bz2": "tar xf", ".tar.xz": "tar xf",
    ".tar.zst": "tar xf", ".zip": "unzip", ".7z": "7z x", ".gz": "gunzip", ".bz2": "bunzip2", ".xz": "unxz",
    ".zst": "unzstd", ".zstd": "unzstd", ".lz4": "unlz4",
}  # fmt: skip
Recognitions = Mapping[str, Recognition]


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
    by_ending = (k for k, v in known.items() if any(item.endswith(v.endings) for item in names))
    return _by_pattern(names, known) or next(by_ending, None)


def _by_pattern(names: Sequence[str], known: Recognitions) -> str | None:
    """Return the format that has a pattern of one of the files' names."""
    for name, recognition in known.items():
        if any(fnmatchcase(item, pattern) for item in names for pattern in recognition.names):
            return name
    return None


def by_files(path: Path, files: Sequence[Path], known: Recognitions) -> str | None:
    """Return the format that the files of a recording on this machine show."""
    for name, recognition in known.items():
        if any((path / place).is_file() for place in recognition.layout):
            return name
    if found := _by_pattern([file.name for file in files], known):
        return found
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
        known = detect(uri) if here.exists() else name
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
