"""Settings that the tests of this folder share."""

from collections.abc import Iterator
from functools import partialmethod

import pytest
import torch

from hma_data.loading.dataset import MixtureDataset
from tests.model import processes


@pytest.fixture(autouse=True, scope="module")
def one_thread() -> Iterator[None]:
    """Compute with one thread: on tensors this small, more threads only wait for one another."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture
def quick_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Processes that decode batches are forked from the tests' server, which spares them torch's import."""
    processes.serve()
    quick = partialmethod(MixtureDataset.batches, context="forkserver")
    monkeypatch.setattr(MixtureDataset, "batches", quick)
