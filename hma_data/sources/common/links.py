"""Report the links that are skipped when a folder is searched for recordings.

A link to a folder may lead anywhere, even in a circle, so it is not followed. A recording behind a link is
read when the user names that recording.
"""

import os
from collections.abc import Collection
from pathlib import Path

from hma_data.errors import SourceError
from hma_data.sources.common.findings import Finding


def unfollowed(root: Path, told: Collection[Path] = ()) -> list[Finding]:
    """Return one finding for each kind of unfollowed link under a folder.

    Args:
        root: folder of the recordings; a file has no links.
        told: paths that are reported elsewhere.
    """
    outside: list[Path] = []
    inside: list[Path] = []
    gone: list[Path] = []
    home = root.resolve()
    for folder, folders, files in os.walk(root):
        for path in (Path(folder, name) for name in sorted(folders + files)):
            if not path.is_symlink() or path in told:
                continue
            if path.is_dir():
                (inside if path.resolve().is_relative_to(home) else outside).append(path)
            elif not path.exists() and not path.name.startswith("."):  # editors lock with such links
                gone.append(path)
    found = []
    if outside:
        said = f"{outside[0]} is a link to a folder outside {root}, not followed{_more(outside)}"
        found.append(Finding("files", "warn", said, "name it itself", numbers={"links": len(outside)}))
    if gone:
        said = f"{gone[0]} is a link to {gone[0].readlink()}, which is not there{_more(gone)}"
        found.append(Finding("files", "warn", said, "copy the file in", numbers={"links": len(gone)}))
    if inside:
        said = f"{inside[0]} is a link to a folder inside {root}, whose recordings are read once"
        found.append(Finding("files", "info", said + _more(inside), numbers={"links": len(inside)}))
    return found


def nothing_there(uri: str, root: Path, fault: str, remedy: str) -> SourceError:
    """Return the error for a place without recordings; mention a link that was not followed, if any."""
    passed = [finding for finding in unfollowed(root) if finding.severity != "info"]
    if not passed:
        return SourceError(uri, fault, remedy)
    return SourceError(uri, f"{fault}; {passed[0].message}", passed[0].remedy)


def _more(links: list[Path]) -> str:
    return f" (and {len(links) - 1:,} more such links)" if len(links) > 1 else ""
