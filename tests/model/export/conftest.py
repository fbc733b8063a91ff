"""Fixtures: exports of a tiny checkpoint of each trunk, made once in a session."""

from collections.abc import Callable
from pathlib import Path

import pytest

from hma_model.cli.export import export_checkpoint
from tests.model.export.checkpoints import save_colors, save_pixels, save_tokens


def exported(folder: Path, save: Callable[[Path], object]) -> Path:
    save(folder / "model")
    export_checkpoint(str(folder / "model"), [], folder / "page", None)
    return folder / "page"


@pytest.fixture(scope="session")
def tokens(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return exported(tmp_path_factory.mktemp("tokens"), save_tokens)


@pytest.fixture(scope="session")
def colors(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return exported(tmp_path_factory.mktemp("colors"), save_colors)


@pytest.fixture(scope="session")
def pixels(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return exported(tmp_path_factory.mktemp("pixels"), save_pixels)
