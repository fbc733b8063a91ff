"""Find the episodes of HDF5 recordings: their file, their group in it, and their id.

A uri is a file or a folder of files. A pattern such as `data/*` names the groups that are episodes; `/` says
that each file is one episode. Without a pattern, the file itself shows it. `Layout` holds every key that
`source.layout` may have.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from fnmatch import fnmatchcase
from pathlib import Path

import h5py

from hma_data.errors import EpisodeError, SourceError
from hma_data.registry.embodiment import Embodiment
from hma_data.sources.base import leaves, local_path, nothing_there
from hma_data.sources.hdf5.file import OpenFiles, child, explained, member

SUFFIXES = (".h5", ".hdf5", ".hdf")
PIXELS = {"0-1": 1.0, "0-255": 255.0, "0-65535": 65535.0}
AXES = ("THWC", "TCHW")
WHOLE_FILE = "/"
_EPISODE_NAME = re.compile(r"(demo|episode|ep|traj|trajectory|rollout)[_-]?\d+")


@dataclass(frozen=True)
class Layout:
    """The values of `source.layout` for HDF5.

    Attributes:
        episodes: pattern of the groups that are episodes, `/` for whole files; None: found from the file.
        timestamps: key of the seconds; None: frames come at the embodiment's rate.
        axes: of pictures; None: found from the shape.
        pixels: range of pictures that are not uint8; None: such arrays are not pictures.
        last_observation: `drop` where pictures and states have one row more than the actions, observed after
            the last action.
    """

    episodes: str | None = None
    timestamps: str | None = None
    axes: str | None = None
    pixels: str | None = None
    last_observation: str | None = None


_ALLOWED = {"axes": AXES, "pixels": tuple(PIXELS), "last_observation": ("drop",)}


@dataclass(frozen=True)
class Place:
    """The place of an episode: a file and the group in it."""

    file: Path
    group: str

    def __str__(self) -> str:
        return str(self.file) if self.group == WHOLE_FILE else f"{self.file}:{self.group}"


class Places:
    """Find episodes, and remember the episodes of each file."""

    def __init__(self, files: OpenFiles) -> None:
        self._files = files
        self._stems: dict[str, dict[str, Path]] = {}
        self._seen: dict[tuple[Path, str | None], dict[str, Place]] = {}

    def all(self, uri: str, pattern: str | None = None) -> dict[str, Place]:
        """Return every episode by its id, in natural order.

        A damaged file in a folder counts as one episode, so that it is quarantined by its name.

        Raises:
            SourceError: the only file is damaged, there are no episodes, or two have one id.
        """
        found: dict[str, Place] = {}
        for _, places in self.by_file(uri, pattern):
            found |= places
        return found

    def by_file(self, uri: str, pattern: str | None = None) -> Iterator[tuple[Path, dict[str, Place]]]:
        """Yield each file with its episodes, while the file is open.

        Opening many files a second time would take as long again.

        Raises:
            SourceError: as `all`.
        """
        self._seen.clear()
        stems = self._stems[uri] = _stems(uri)
        in_folder = local_path(uri).is_dir()
        taken: set[str] = set()
        for stem, file in stems.items():
            found: dict[str, Place] = {}
            try:
                places = self._inside(file, pattern)
            except SourceError:
                if len(stems) == 1:
                    raise
                places = {"": Place(file, WHOLE_FILE)}
            for name, place in places.items():
                episode_id = "/".join(part for part in (stem if in_folder else "", name) if part) or stem
                if episode_id in taken:
                    raise SourceError(place, f"is a second episode called {episode_id!r}", "rename one")
                taken.add(episode_id)
                found[episode_id] = place
            yield file, found
        if not taken:
            raise SourceError(uri, "holds no episodes", f"looked for groups {pattern or 'data/*'}")

    def find(self, uri: str, episode_id: str, pattern: str | None = None) -> Place:
        """Return the place of an id; open only the file that holds it.

        Raises:
            SourceError: no such episode.
            EpisodeError: its file is damaged.
        """
        stems = self._stems.get(uri) or self._stems.setdefault(uri, _stems(uri))
        parts = episode_id.split("/")
        if local_path(uri).is_dir():
            candidates = [("/".join(parts[:i]), "/".join(parts[i:])) for i in range(len(parts), 0, -1)]
        else:
            candidates = [(stem, name) for stem in stems for name in (episode_id, "")]
        for stem, name in candidates:
            if stem not in stems:
                continue
            try:
                places = self._inside(stems[stem], pattern)
            except SourceError as fault:
                raise EpisodeError(fault.where, fault.fault, fault.remedy) from fault
            if name in places and (name or stem == episode_id):
                return places[name]
        raise SourceError(uri, f"has no episode {episode_id!r}", "hma inspect lists what it has")

    def group(self, place: Place) -> h5py.Group:
        """Return the episode's group, in the open file."""
        handle = self._files.get(place.file)
        found = handle if place.group == WHOLE_FILE else member(handle, place.group, str(place))
        if not isinstance(found, h5py.Group):
            raise EpisodeError(place, "is not a group", "correct source.layout.episodes")
        return found

    def _inside(self, file: Path, pattern: str | None) -> dict[str, Place]:
        """Return the episodes of one file by name within it; the name of a whole file is empty."""
        if (file, pattern) not in self._seen:
            with explained(file, SourceError):
                self._seen[file, pattern] = _episodes(self._files.get(file), file, pattern)
        return self._seen[file, pattern]


def natural(name: str) -> list[tuple[int, int, str]]:
    """Return a sort key that puts demo_2 before demo_10."""
    return [(0, int(part), "") if part.isdigit() else (1, 0, part) for part in re.split(r"(\d+)", name)]


def layout_of(embodiment: Embodiment | None) -> Layout:
    """Return the layout that the YAML states; all defaults without an embodiment.

    Raises:
        SourceError: a key or a value is not known for HDF5.
    """
    said = (embodiment.source.layout or {}) if embodiment else {}
    where = f"embodiment {embodiment.id}" if embodiment else ""
    known = [entry.name for entry in fields(Layout)]
    for key, value in said.items():
        if key not in known:
            fault = f"source.layout.{key} is not known for hdf5"
            raise SourceError(where, fault, f"known: {', '.join(known)}")
        if key in _ALLOWED and value not in _ALLOWED[key]:
            allowed = f"allowed: {', '.join(_ALLOWED[key])}"
            raise SourceError(where, f"source.layout.{key} is {value!r}", allowed)
    layout = Layout(**said)
    pattern = layout.episodes
    return replace(layout, episodes=pattern and (pattern.strip("/") or WHOLE_FILE))


def _episodes(handle: h5py.File, file: Path, pattern: str | None) -> dict[str, Place]:
    pattern = pattern or _guess_pattern(handle)
    if pattern == WHOLE_FILE:
        return {"": Place(file, WHOLE_FILE)}
    parts = pattern.split("/")
    fixed = next((i for i, part in enumerate(parts) if re.search(r"[*?\[]", part)), len(parts) - 1)
    found: dict[str, Place] = {}
    for group in sorted(_matching(handle, parts), key=natural):
        name = "/".join(map(_safe, group.split("/")[fixed:]))
        if name in found:
            raise SourceError(file, f"two of its groups would be called {name!r}", "rename one")
        found[name] = Place(file, group)
    return found


def _guess_pattern(handle: h5py.File) -> str:
    data = child(handle, "data")
    if isinstance(data, h5py.Group):
        inside = [found for name in data if (found := child(data, name)) is not None]
        if all(isinstance(found, h5py.Group) for found in inside):
            return "data/*"
    groups = [name for name in handle if isinstance(child(handle, name), h5py.Group)]
    if groups and len(groups) == len(handle) and all(_EPISODE_NAME.fullmatch(name) for name in groups):
        return "*"
    return WHOLE_FILE


def _matching(group: h5py.Group, parts: list[str]) -> list[str]:
    """Return the paths of the groups that match a pattern, one part a level."""
    found = []
    for name in group:
        if fnmatchcase(name, parts[0]) and isinstance(group.get(name, getlink=True), h5py.HardLink):
            item = group[name]
            if isinstance(item, h5py.Group):
                found += (
                    [name] if len(parts) == 1 else [f"{name}/{rest}" for rest in _matching(item, parts[1:])]
                )
    return found


def _safe(name: str) -> str:
    return re.sub(r"[^\w.-]", "_", name).lstrip(".") or "_"


def _stems(uri: str) -> dict[str, Path]:
    """Return the HDF5 files of a uri by their names without suffix, relative to the folder."""
    path = local_path(uri)
    if path.is_file():
        return {_safe(path.stem): path}
    found: dict[str, Path] = {}
    for file in sorted(path.rglob("*"), key=lambda item: natural(str(item.relative_to(path)))):
        if file.suffix.lower() not in SUFFIXES or not file.is_file():
            continue
        if leaves(file, path):
            raise SourceError(
                file, "is a link that leaves the folder", "copy the file in, or convert its folder"
            )
        stem = "/".join(map(_safe, file.relative_to(path).with_suffix("").parts))
        if stem in found:
            raise SourceError(file, f"has the name of {found[stem].name} but for its suffix", "rename one")
        found[stem] = file
    if not found:
        raise nothing_there(uri, path, "holds no HDF5 files", f"looked for {', '.join(SUFFIXES)}")
    return found
