"""Fixtures of the data tests that are made once: a converted toy recording, and bags of every kind."""

import multiprocessing
from pathlib import Path

import pytest

from hma_data.registry.embodiment import Embodiment
from tests.conftest import ARM_YAML, contents, convert_toy
from tests.data.bag_files import KINDS, Recording, make_recording


@pytest.fixture(scope="session", autouse=True)
def preloaded() -> None:
    """Let processes of a fork server fork from one that has torch and the loader already."""
    multiprocessing.set_forkserver_preload(["hma_data.loading.dataset"])


@pytest.fixture(scope="session")
def recording() -> Recording:
    return make_recording()


@pytest.fixture(scope="session")
def bags(tmp_path_factory: pytest.TempPathFactory, recording: Recording) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("bags")
    made = {}
    for kind, write in KINDS.items():
        (folder / kind).mkdir()
        made[kind] = write(folder / kind, recording)
    return made


@pytest.fixture(scope="session")
def toy_set(toy_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The shards that `convert_toy` makes of `toy_recording`; not to be changed."""
    out = tmp_path_factory.mktemp("toy") / "set"
    convert_toy(Embodiment.from_yaml(ARM_YAML), toy_file, out)
    return out


@pytest.fixture
def whole(toy_arm: Embodiment, toy_recording: Path, tmp_path: Path) -> dict[str, bytes]:
    """The files of an undisturbed conversion: what every disturbed one must end with."""
    convert_toy(toy_arm, toy_recording, tmp_path / "whole")
    return contents(tmp_path / "whole")
