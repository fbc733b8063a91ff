"""Record in wheels and source archives which revision they were built from; hatchling runs it."""

import subprocess
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

KEPT = "REVISION"  # in a source archive, which has no history
SHIPPED = "hma_data/shipped/REVISION"


class RevisionHook(BuildHookInterface[Any]):
    """Adds a file with the revision. An editable installation asks git instead."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        if version == "editable" or not (revision := _revision(Path(self.root))):
            return
        with NamedTemporaryFile("w", delete=False) as file:
            file.write(revision)
        self._file = Path(file.name)
        build_data["force_include"][file.name] = SHIPPED if self.target_name == "wheel" else KEPT

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        if file := getattr(self, "_file", None):
            file.unlink()


def _revision(root: Path) -> str:
    if (root / KEPT).is_file():
        return (root / KEPT).read_text()
    if not (root / ".git").exists():  # git would answer for a repository around it
        return ""
    command = ["git", "-C", str(root), "rev-parse", "HEAD"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return ""
