"""Find the files of a recording: paths on this machine or in a store, their first bytes, links among them."""

import hashlib
import os
import re
from collections.abc import Collection
from pathlib import Path

from hma_data.errors import EpisodeError, SourceError
from hma_data.sources.common.checks import Finding
from hma_data.storage.kinds import unreadable
from hma_data.storage.remote import LargeFile, is_remote, place


def is_away(uri: str) -> bool:
    """Check whether a URI is of a store, not of this machine."""
    return "://" in uri and not uri.startswith("file://")


def local_path(uri: str) -> Path:
    """Return the local path of a plain path or file:// URI.

    Raises:
        SourceError: it does not exist, or it is a URI of remote storage.
    """
    plain = uri.removeprefix("file://")
    path = Path(plain).expanduser()
    try:
        if path.exists():
            return path
    except PermissionError as fault:
        raise SourceError(uri, *unreadable(path, str(fault), "")) from fault
    if "://" in plain:
        remedy = "copy it here: only RLDS, LeRobot and bags are read elsewhere"
        raise SourceError(uri, "is not on this machine", remedy)
    raise SourceError(uri, "does not exist", "check the path, or source.uri in the embodiment's YAML")


def existing_path(uri: str) -> Path:
    """Return the path of a recording on this machine or in a store.

    Raises:
        SourceError: it does not exist, or no store is known by that scheme.
        StorageError: the store refuses it; StorageAwayError: it does not answer.
    """
    if not is_away(uri):
        return local_path(uri)
    path = place(uri)
    if not path.exists():
        web = uri.startswith(("http://", "https://"))  # fsspec tells a silent server like an absent file
        fault = "does not exist, or its server does not answer" if web else "does not exist"
        raise SourceError(uri, fault, "check the URI, or source.uri in the embodiment's YAML")
    return path


def natural(name: str) -> list[tuple[int, int, str]]:
    """Return a sort key that puts clip_2 before clip_10."""
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in re.split(r"(\d+)", name)]


def named_files(uri: str, suffixes: Collection[str], what: str) -> dict[str, Path]:
    """Return the files with these endings at or below a local path, by their names there, in natural order.

    Hidden files are left out: macOS writes one beside each file that it copies.

    Raises:
        SourceError: there are none.
    """
    root = local_path(uri)
    folder = root.parent if root.is_file() else root
    files = [root] if root.is_file() else sorted(root.rglob("*"), key=lambda path: natural(str(path)))
    found = {
        path.relative_to(folder).as_posix(): path
        for path in files
        if path.suffix.lower() in suffixes and not path.name.startswith(".") and path.is_file()
    }
    if not found:
        raise nothing_there(uri, root, f"holds no {what}", f"looked for {', '.join(suffixes)}")
    return found


def require_inside(path: Path, folder: Path, remedy: str = "copy the file in") -> None:
    """Raise EpisodeError if a path leads out of the folder of its recording by a link or `..`.

    The Hugging Face Hub's cache keeps the files of a snapshot as links to its blobs, which may be followed.
    """
    inside, target = folder.resolve(), path.resolve()
    hub = next((above.parent for above in inside.parents if above.name == "snapshots"), None)
    homes = (inside, hub / "blobs") if hub else (inside,)
    if not any(target.is_relative_to(home) for home in homes):
        raise EpisodeError(path, "is a link to a file outside its folder", remedy)


def first_bytes(path: Path, count: int) -> bytes:
    """Return the first bytes of a file; empty when it cannot be read."""
    try:
        with LargeFile(path).open() as file:
            return file.read(count)
    except OSError:
        return b""


def file_fingerprint(path: Path) -> str:
    """Return 16 hex digits hashed from a file's size and its first, middle and last 64 KiB.

    Time stamps do not change it.
    """
    size = path.stat().st_size
    digest = hashlib.sha256(str(size).encode())
    with LargeFile(path).open() as file:
        for offset in (0, max(0, size // 2 - 32768), max(0, size - 65536)):
            file.seek(offset)
            digest.update(file.read(65536))
    return digest.hexdigest()[:16]


# -- links


def unfollowed(root: Path, told: Collection[Path] = ()) -> list[Finding]:
    """Return findings on the links under a folder that lead to a folder outside of it, or to nothing.

    A link to a folder may lead anywhere, even in a circle, so it is not followed. A recording behind a link
    is read when the user names that recording.

    Args:
        root: folder of the recordings; a file has no links.
        told: paths that are reported elsewhere.
    """
    if is_remote(root):  # stores have no links
        return []
    outside: list[Path] = []
    gone: list[Path] = []
    home = root.resolve()
    for folder, folders, files in os.walk(root):
        for path in (Path(folder, name) for name in sorted(folders + files)):
            if not path.is_symlink() or path in told or path.name.startswith("."):  # editors lock with links
                continue
            if path.is_dir() and not path.resolve().is_relative_to(home):
                outside.append(path)
            elif not path.exists():
                gone.append(path)
    found = []
    for links, remedy in ((outside, "give the path of that folder"), (gone, "copy the file in")):
        if links:
            target = f"a folder outside {root}, not followed"
            if links is gone:
                target = f"{gone[0].readlink()}, which is not there"
            more = f" (and {len(links) - 1:,} more such links)" if len(links) > 1 else ""
            said = f"{links[0]} is a link to {target}{more}"
            found.append(Finding("files", "warn", said, remedy, numbers={"links": len(links)}))
    return found


def nothing_there(uri: str, root: Path, fault: str, remedy: str) -> SourceError:
    """Return the error for a place without recordings; mention a link that was not followed, if any."""
    fault, remedy = unreadable(root, fault, remedy)
    links = unfollowed(root)
    if links:
        fault, remedy = f"{fault}; {links[0].message}", links[0].remedy
    return SourceError(uri, fault, remedy)
