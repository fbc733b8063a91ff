"""A page as a static Space: its header, what it replaces, and which Spaces are refused."""

import json
import shutil
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
import yaml

from hma_data.errors import HubError
from hma_model.export.folder import FORMAT, MANIFEST
from hma_model.export.space import Space
from tests.command import hma
from tests.hub_server import Hub
from tests.model.export.checkpoints import save_tokens

pytest_plugins = ["tests.hub_fixtures"]
NAME = "team/drive"


@pytest.fixture(scope="module")
def tokens(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("tokens")
    save_tokens(folder / "model")
    (folder / "page").mkdir()
    (folder / "page" / "index.html").write_text("a page")
    (folder / "page" / MANIFEST).write_text(json.dumps({"format": FORMAT, "model": "model"}))
    return folder / "page"


def space(server: Hub) -> dict[str, bytes]:
    return server.repositories[f"spaces/{NAME}"].files


def test_a_push_makes_a_static_space_of_the_page_and_replaces_an_older_one(
    server: Hub, tokens: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def copy(checkpoint: str, data: list[Path], out: Path, *rest: Any) -> None:
        shutil.copytree(tokens, out)

    monkeypatch.setattr(import_module("hma_model.cli.export"), "export_checkpoint", copy)
    words = ("hub", "push", tokens.with_name("model"), "team/model", "--page", "--space", NAME)
    ended = hma(*words)
    assert ended.returncode == 0, ended.stderr
    assert f"the page runs at {server.url}/spaces/{NAME}" in ended.stdout
    page = {path.relative_to(tokens).as_posix() for path in tokens.rglob("*") if path.is_file()}
    assert space(server).keys() == page | {"README.md", ".gitattributes"}  # the hub's style.css is gone
    assert space(server)["index.html"] == (tokens / "index.html").read_bytes()
    front = yaml.safe_load(space(server)["README.md"].decode().split("---\n")[1])
    assert (front["sdk"], front["app_file"], front["models"]) == ("static", "index.html", ["team/model"])
    assert front["custom_headers"]["cross-origin-embedder-policy"] == "require-corp"
    assert len(front["short_description"]) <= 60
    assert "page/index.html" in server.model("team/model").files
    server.repositories[f"spaces/{NAME}"].commit({"old.js": b"of an older page"})
    assert hma(*words).returncode == 0 and "old.js" not in space(server)


@pytest.mark.parametrize(
    ("files", "fault"),
    [
        ({"README.md": b"---\ntitle: x\nsdk: gradio\n---\n"}, "is a Space of sdk 'gradio', not of static"),
        ({"README.md": b"---\nsdk: static\n---\n", "app.js": b"theirs"}, "holds something else: app.js"),
    ],
)
def test_a_space_of_somebody_else_is_refused_before_anything_is_sent(server, tokens, files, fault) -> None:
    server.create(NAME, "spaces").commit(files)
    ended = hma("hub", "push", tokens.with_name("model"), "team/model", "--page", "--space", NAME)
    assert ended.returncode == 1
    assert ended.stderr.strip() == f"error: hf://spaces/{NAME}: {fault} — name another Space"
    assert "models/team/model" not in server.repositories


def test_a_space_needs_the_page_and_a_name(server: Hub, tokens: Path, tmp_path: Path) -> None:
    ended = hma("hub", "push", tokens.with_name("model"), tmp_path / "hub", "--space", NAME)
    assert ended.returncode != 0 and "add --page" in ended.stderr
    with pytest.raises(HubError, match="is not ORG/NAME"):
        Space("drive")
