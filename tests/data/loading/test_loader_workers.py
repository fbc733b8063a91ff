"""The stream of batches: the same with any workers, in any DataLoader, over stops and ranks."""

import copy
import threading
from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import pytest
import torch
from torch.utils.data import DataLoader

from hma_data.loading.dataset import Batch, MixtureDataset, WindowDataset, as_batch
from hma_data.shards import writer
from hma_data.shards.reader import ShardSet
from recipes.bench.loader import make_set
from tests.data.loading.test_pools import SMALL

FRAMES, SIZE = 6, 8
WORKERS = "forkserver"  # forking this process, which has threads, may stop the child for ever


@pytest.fixture(scope="module")
def sets(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("workers")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(writer, "ROW_GROUP", 300)
        return [
            make_set(folder / str(i), i, SMALL | {"frames": frames, "shard_frames": frames})
            for i, frames in enumerate((3_000, 600))
        ]


def dataset(sets: Sequence[str | Path], **others: Any) -> MixtureDataset:
    return MixtureDataset(sets, **({"batch_size": SIZE, "frames": FRAMES, "seed": 4, "pool": 2} | others))


def seen(batches: Iterator[Batch], count: int) -> list[list[tuple[str, int, int]]]:
    return [windows_of(batch) for batch in islice(batches, count)]


def windows_of(batch: Batch) -> list[tuple[str, int, int]]:
    assert batch.episode is not None and batch.frame is not None
    return list(zip(batch.embodiment, batch.episode.tolist(), batch.frame.tolist(), strict=True))


@pytest.mark.parametrize(("workers", "begun"), [(2, 3), (9, 0)])
def test_any_number_of_workers_gives_the_same_batches(sets: list[Path], workers: int, begun: int) -> None:
    data, alone = dataset(sets, lanes=3), dataset(sets, lanes=3)
    assert seen(iter(data), begun) == seen(iter(alone), begun)
    found, expected = list(islice(data.batches(workers), 110)), list(islice(alone, 110))
    assert seen(iter(found), 110) == seen(iter(expected), 110)
    for one, other in zip(found, expected, strict=True):
        assert one.tokens is not None and other.tokens is not None
        assert torch.equal(one.tokens, other.tokens) and torch.equal(one.actions, other.actions)
    assert data.state_dict() == alone.state_dict()


def test_workers_end_with_their_batches(sets: list[Path]) -> None:
    before = set(threading.enumerate())
    batches = dataset(sets).batches(2)
    next(batches)
    begun = [thread for thread in threading.enumerate() if thread not in before]
    assert begun
    batches.close()  # type: ignore[attr-defined]
    for thread in begun:
        thread.join(60)
        assert not thread.is_alive()


def test_a_run_stopped_with_some_workers_goes_on_with_others(sets: list[Path]) -> None:
    whole = seen(iter(dataset(sets)), 30)
    state, found = dataset(sets).state_dict(), []
    for workers, count in ((2, 7), (0, 5), (3, 9), (1, 9)):
        data = dataset(sets)
        data.load_state_dict(copy.deepcopy(state))
        found += seen(data.batches(workers), count)
        state = data.state_dict()
    assert found == whole


def test_a_state_is_small_and_plain(sets: list[Path]) -> None:
    import json

    data = dataset(sets)
    list(islice(data, 9))
    text = json.dumps(data.state_dict())
    assert len(text) < 2_000
    other = dataset(sets)
    other.load_state_dict(json.loads(text))
    assert seen(iter(other), 3) == seen(iter(data), 3)


def test_the_state_of_one_rank_serves_another(sets: list[Path]) -> None:
    whole = seen(iter(dataset(sets, rank=1, world=2)), 12)
    first = dataset(sets, rank=0, world=2)
    list(islice(first, 7))
    second = dataset(sets, rank=1, world=2)
    second.load_state_dict(first.state_dict())
    assert seen(iter(second), 5) == whole[7:]


@pytest.mark.slow
def test_a_dataloader_gives_the_same_batches_after_some_were_taken_here(sets: list[Path]) -> None:
    whole = seen(iter(dataset(sets)), 12)
    data = dataset(sets)
    list(islice(data, 3))
    loader = DataLoader(data, batch_size=None, num_workers=2, multiprocessing_context=WORKERS)
    assert seen(iter(loader), 9) == whole[3:]


def test_workers_that_persist_go_on_with_new_windows(sets: list[Path]) -> None:
    loader = DataLoader(
        dataset(sets),
        batch_size=None,
        num_workers=2,
        persistent_workers=True,
        multiprocessing_context=WORKERS,
    )
    first = seen(iter(loader), 4)
    again = seen(iter(loader), 4)
    assert first == seen(iter(dataset(sets)), 4)
    assert not {tuple(b) for b in first} & {tuple(b) for b in again}


def test_a_dataloader_shuffles_windows_by_number(sets: list[Path]) -> None:
    windows = WindowDataset(sets[1], "train", FRAMES)
    order = torch.Generator().manual_seed(0)
    loader = DataLoader(
        windows,
        batch_size=7,
        shuffle=True,
        generator=order,
        num_workers=1,
        multiprocessing_context=WORKERS,
        collate_fn=as_batch,
    )
    found = [window for batch in loader for window in windows_of(batch)]
    assert len(found) == len(set(found)) == len(windows)
    assert sorted(found) == sorted(windows_of(windows.batch(range(len(windows)))))


@pytest.mark.parametrize("draw", ["per_sample", "per_batch"])
def test_what_was_taken_follows_the_mixture_and_is_counted(sets: list[Path], draw: Any) -> None:
    data = dataset(sets, draw=draw, temperature=1.0, batch_size=16)
    names = [name for batch in seen(iter(data), 300) for name, _, _ in batch]
    rows = {str(row["embodiment"]): row for row in data.realised()}
    for name, row in rows.items():
        assert row["samples"] == names.count(name)
        assert row["realised"] == pytest.approx(row["intended"], abs=0.02 if draw == "per_sample" else 0.08)
        assert row["passes"] == row["samples"] / row["windows"]


def test_a_set_in_a_store_gives_the_same_batches_as_the_folder(sets: list[Path]) -> None:
    import fsspec

    store = fsspec.filesystem("memory")
    uris = []
    for folder in sets:
        store.put(str(folder), f"/loader-{folder.name}", recursive=True)
        uris.append(f"memory://loader-{folder.name}")
    try:
        assert seen(iter(dataset(uris)), 20) == seen(iter(dataset(sets)), 20)
        windows = WindowDataset(uris[1], "train", FRAMES)
        assert windows_of(windows.batch([5, 3])) == windows_of(
            WindowDataset(sets[1], "train", FRAMES).batch([5, 3])
        )
    finally:
        for uri in uris:
            store.rm(uri, recursive=True)


def stateful(sets: list[Path], workers: int) -> Any:
    from torchdata.stateful_dataloader import StatefulDataLoader

    context = WORKERS if workers else None
    return StatefulDataLoader(
        dataset(sets), batch_size=None, num_workers=workers, multiprocessing_context=context
    )


@pytest.mark.parametrize(("workers", "stop"), [(0, 4), (3, 1)])
def test_torchdatas_loader_saves_and_goes_on(sets: list[Path], workers: int, stop: int) -> None:
    whole = seen(iter(dataset(sets)), 16)
    first = stateful(sets, workers)
    begun = seen(iter(first), stop)
    second = stateful(sets, workers)
    second.load_state_dict(first.state_dict())
    assert begun + seen(iter(second), 16 - stop) == whole


def test_sixty_four_ranks_take_every_window_once(sets: list[Path]) -> None:
    shards = ShardSet(sets[0])
    taken: list[Any] = []
    for rank in range(64):
        data = dataset([shards], rank=rank, world=64, lanes=1, batch_size=1)
        share = data._sequence(0, 0).length
        assert 0.8 < share * 64 / data.mixture.counts[0] < 1.2
        taken += [window for batch in seen(iter(data), share) for window in batch]
    assert len(taken) == len(set(taken)) == data.mixture.counts[0]
