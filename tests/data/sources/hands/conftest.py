"""A video of hands, encoded once in a session."""

from pathlib import Path

import pytest

from tests.data.videos import encode

LENGTH = 30


@pytest.fixture(scope="session")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return encode(tmp_path_factory.mktemp("clip") / "a.mp4", range(LENGTH))


@pytest.fixture
def folder(tmp_path: Path, clip: Path) -> Path:
    (tmp_path / "set").mkdir()
    (tmp_path / "set" / "a.mp4").write_bytes(clip.read_bytes())
    return tmp_path / "set"
