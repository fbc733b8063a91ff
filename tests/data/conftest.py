"""Fixtures of the data tests; the short recording of `bag_files` in every kind of bag, written once."""

import multiprocessing
from pathlib import Path

import pytest

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
