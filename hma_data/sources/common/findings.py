"""Define a finding: one result of a check on a recording or a shard set, readable by programs.

Findings on links are made here. A link to a folder may lead anywhere, even in a circle, so it is not
followed when a folder is searched for recordings. A recording behind a link is read when the user names it.
"""

import os
from collections.abc import Collection, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

from hma_data.errors import SourceError

Severity = Literal["error", "warn", "info"]
SEVERITIES: tuple[Severity, ...] = ("info", "warn", "error")


@dataclass(frozen=True)
class Finding:
    """One result of a check.

    Attributes:
        check: its name, stable for programs.
        severity: error: unusable or wrong; warn: look before training; info: good to know.
        message: what was found, with the numbers.
        remedy: what to do; may be empty.
        key: the key of the recording that is affected; empty where the finding is about all of it.
        numbers: the numbers in the message, as plain values.
    """

    check: str
    severity: Severity
    message: str
    remedy: str = ""
    key: str = ""
    numbers: Mapping[str, Any] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """Return plain values for `--json`."""
        return asdict(self)

    def __str__(self) -> str:
        return f"{self.message} — {self.remedy}" if self.remedy else self.message


# -- links


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
        said = f"{outside[0]} is a link to a folder outside {root}, not followed"
        found.append(_of_links(outside, "warn", said, "name it itself"))
    if gone:
        said = f"{gone[0]} is a link to {gone[0].readlink()}, which is not there"
        found.append(_of_links(gone, "warn", said, "copy the file in"))
    if inside:
        said = f"{inside[0]} is a link to a folder inside {root}, whose recordings are read once"
        found.append(_of_links(inside, "info", said))
    return found


def _of_links(links: list[Path], severity: Severity, said: str, remedy: str = "") -> Finding:
    more = f" (and {len(links) - 1:,} more such links)" if len(links) > 1 else ""
    return Finding("files", severity, said + more, remedy, numbers={"links": len(links)})


def nothing_there(uri: str, root: Path, fault: str, remedy: str) -> SourceError:
    """Return the error for a place without recordings; mention a link that was not followed, if any."""
    passed = [finding for finding in unfollowed(root) if finding.severity != "info"]
    if not passed:
        return SourceError(uri, fault, remedy)
    return SourceError(uri, f"{fault}; {passed[0].message}", passed[0].remedy)
