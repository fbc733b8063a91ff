"""The folder of an export: whole or as it was, and nothing of the user's is replaced."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from hma_data.errors import OutputError
from hma_model.evaluation.metrics import psnr
from hma_model.export import folder
from hma_model.export.starts import Start
from tests.conftest import contents


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


@pytest.mark.parametrize("name", [".git", "notes.txt", "robots.zip"])
def test_an_export_with_files_of_the_user_is_not_replaced(name: str, page: Path, export: Any) -> None:
    (page / name).write_text("mine")
    with pytest.raises(OutputError, match=f"not of the export: {name} — .*move them out"):
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
