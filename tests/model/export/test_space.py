"""A page as a folder and as a static Space: whole or as it was, and nothing of others is replaced."""

import json
import shutil
from importlib import import_module
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

from hma_data.errors import HubError, OutputError
from hma_model.evaluation.metrics import psnr
from hma_model.export import folder
from hma_model.export.folder import FORMAT, MANIFEST
from hma_model.export.space import Space
from hma_model.export.starts import Start
from tests.command import hma
from tests.conftest import contents
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


def test_a_push_makes_a_static_space_of_the_page_and_replaces_an_older_one(server, tokens, monkeypatch):
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


# -- the folder


@pytest.fixture
def page(tmp_path: Path) -> Path:
    made = tmp_path / "page"
    (made / "robots").mkdir(parents=True)
    (made / "manifest.json").write_text('{"format": "hma-export"}')
    for name in ("index.html", "page.css", "step.onnx"):
        (made / name).write_text("older")
    return made


@pytest.fixture
def export(monkeypatch: pytest.MonkeyPatch) -> Any:
    def full(*given: Any, **named: Any) -> None:
        raise OSError(28, "No space left on device")

    for name in ("require_exportable", "World"):
        monkeypatch.setattr(folder, name, lambda *given: None)
    monkeypatch.setattr(folder, "StepGraph", full)
    nothing: Any = None
    return lambda out: folder.export_folder(nothing, nothing, [], out, name="it", half=False)


def test_a_full_disk_is_one_clear_error_and_leaves_the_older_export(page: Path, export: Any) -> None:
    older = contents(page)
    with pytest.raises(OutputError, match="page: cannot be written: No space left on device — free space"):
        export(page)
    assert contents(page) == older and list(page.parent.iterdir()) == [page]
    with pytest.raises(OutputError, match="cannot be written: File exists"):
        export(page / "step.onnx" / "page")


@pytest.mark.parametrize("name", [".git", "notes.txt", "robots/notes.txt", "robots/arm/notes.txt"])
def test_an_export_with_files_of_the_user_is_not_replaced(name: str, page: Path, export: Any) -> None:
    (page / name).parent.mkdir(parents=True, exist_ok=True)
    (page / name).write_text("mine")
    with pytest.raises(OutputError, match=f"not of the export: {name} — .*move them out"):
        export(page)
    (page / "manifest.json").unlink()
    with pytest.raises(OutputError, match="holds something else than an export"):
        export(page)
    assert (page / name).read_text() == "mine"


def test_true_images_of_a_replay_lie_in_rows(tmp_path: Path) -> None:
    images = np.kron(np.random.default_rng(0).integers(0, 256, (23, 4, 4, 3)), np.ones((1, 16, 16, 1)))
    images = images.astype(np.uint8)
    start = Start(*[np.zeros(1)] * 4, np.zeros((22, 3), np.float32), images)
    made = folder.write_replays(tmp_path, [start, start])
    assert made is not None and np.load(tmp_path / "replays.npy").shape == (2, 22, 3)
    for number in range(2):
        picture = cv2.imread(str(tmp_path / f"replay-{number}.webp"), cv2.IMREAD_COLOR_RGB)
        rows = picture.reshape(-1, 64, made["columns"], 64, 3).swapaxes(1, 2)
        shown = rows.reshape(-1, 64, 64, 3)[:23]
        assert all(psnr(own, true) > 25 for own, true in zip(shown, images, strict=True))
