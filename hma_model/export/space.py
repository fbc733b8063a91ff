"""Publish an exported page as a static Space of the Hugging Face Hub."""

import json
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from hma_data.errors import HubError
from hma_data.hub.repository import Repository
from hma_data.storage.paths import REPOSITORY, is_repository
from hma_data.storage.yaml_io import write_yaml
from hma_model.checkpoint.folder import README
from hma_model.checkpoint.model_card import licence, line
from hma_model.export.folder import FORMAT, MANIFEST
from hma_model.hub.stores import read_object

_NEW = {".gitattributes", README, "index.html", "style.css"}  # what the hub puts into a static Space
_OTHER = "name another Space"
# With these a page may use threads; the hub sends them for a Space that asks for them.
_ISOLATED = {
    "cross-origin-embedder-policy": "require-corp",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "cross-origin",
}


class Space:
    """A static Space, which may not exist yet.

    Args:
        name: organisation/name.
        private: make a new one private.

    Raises:
        HubError: there is one that is not static or holds something else, or the hub cannot be reached.
    """

    def __init__(self, name: str, private: bool | None = None) -> None:
        if not REPOSITORY.fullmatch(name):
            raise HubError(f"--space {name}", "is not ORG/NAME", "name a Space of the hub")
        self._name = name
        self._store = Repository(name, write=True, kind="space", private=private)
        self._require_own()

    def publish(self, page: Path, checkpoint: str, cards: Iterable[Mapping[str, Any]]) -> str:
        """Replace the Space's files by those of a page; return its address.

        Args:
            page: a folder of `hma export`.
            checkpoint: where the checkpoint was published.
            cards: of its robots.
        """
        title = str(json.loads((page / MANIFEST).read_text())["model"])
        front = {
            "title": title,
            "emoji": "🤖",
            "colorFrom": "green",
            "colorTo": "blue",
            "sdk": "static",
            "app_file": "index.html",
            "pinned": False,
            "short_description": "Drive robots in a world model, in your browser",
            "tags": ["robotics", "world-model", "hma"],
            **({"models": [checkpoint.removeprefix("hf://")]} if is_repository(checkpoint) else {}),
            **licence(card.get("license") for card in cards),
            "custom_headers": _ISOLATED,
        }
        about = f"The page of `hma export`: {line(title)} runs in the browser; nothing is sent anywhere."
        readme = f"---\n{write_yaml(front).strip()}\n---\n\n{about}\n"
        parts = {path.relative_to(page).as_posix(): path for path in page.rglob("*") if path.is_file()}

        def changes() -> dict[str, Path | bytes | None]:
            older = dict.fromkeys(name for name in self._require_own() if name != ".gitattributes")
            return {**older, **parts, README: readme.encode()}

        return self._store.publish(changes, "Add the page")

    def _require_own(self) -> dict[str, int]:
        """Return the files of the Space; raise HubError unless it is a static one with an export, or new."""
        files = self._store.files()
        if README in files and (sdk := self._sdk()) != "static":
            raise HubError(self._store.name, f"is a Space of sdk {sdk!r}, not of static", _OTHER)
        if MANIFEST in files:
            about = read_object(self._store, MANIFEST)
            if about.get("format") == FORMAT:
                return files
        if foreign := sorted(files.keys() - _NEW):
            raise HubError(self._store.name, f"holds something else: {foreign[0]}", _OTHER)
        return files

    def _sdk(self) -> str | None:
        """Return the sdk that the header of README.md states, by which the hub runs a Space."""
        header, _, _ = self._store.read(README).decode(errors="replace").partition("\n---")
        found = re.search(r"""^sdk:\s*["']?([\w-]+)""", header, re.MULTILINE)
        return found[1] if found else None
