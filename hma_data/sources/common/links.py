"""Links that are not followed when a folder is searched for recordings, so that none is left out in silence.

A link to a folder may lead anywhere, and in circles. Recordings behind one are read when it is named itself.
"""

import os
from collections.abc import Collection
from pathlib import Path

from hma_data.errors import SourceError
from hma_data.sources.common.findings import Finding


def unfollowed(root: Path, told: Collection[Path] = ()) -> list[Finding]:
    """One finding for each kind of link under a folder that is passed over.

    Args:
        root: of the recordings; a file has none.
        told: paths that are spoken of elsewhere.
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
    """The error of a place without recordings; tells of a link that was not followed, where there is one."""
    passed = [finding for finding in unfollowed(root) if finding.severity != "info"]
    if not passed:
        return SourceError(uri, fault, remedy)
    return SourceError(uri, f"{fault}; {passed[0].message}", passed[0].remedy)


def _more(links: list[Path]) -> str:
    return f" (and {len(links) - 1:,} more such links)" if len(links) > 1 else ""
