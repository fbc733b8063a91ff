"""Read the same windows through other projects' loaders, for `hma bench loader peers=NAME,…`.

Each peer stores the frames of one set in its own format: a sample is a frame, its tokens and the chunk of
actions from it to the next frame of the model's grid. A window is T samples, and windows are drawn at random
from all. The first batch is compared with ours.
"""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Samples = Callable[
    [NDArray[np.int64]], tuple[NDArray[Any], NDArray[Any]]
]  # (n,) -> tokens (n, S), chunks (n, K)
CHUNK_MB = 64


def run_peer(name: str, folder: Path, settings: dict[str, Any]) -> dict[str, Any]:
    """Return the figures of a peer; name what is missing if it is not installed."""
    try:
        return {"case": f"peer {name}", **_measure(name, folder, settings)}
    except ImportError as fault:
        return {
            "case": f"peer {name}",
            "left_out": f"{fault.name} is not installed: pip install {PACKAGES.get(name, name)}",
        }


def _measure(name: str, folder: Path, settings: dict[str, Any]) -> dict[str, Any]:
    from hma_data.loading.dataset import WindowDataset

    ours: Any = WindowDataset(folder, "train", settings["window"])
    rows = _rows_of(ours)
    store, began = folder.with_name(f"{folder.name}-{name}"), time.perf_counter()
    read = PEERS[name](store, rows)
    written = time.perf_counter() - began
    rng = np.random.default_rng(0)
    first = rng.integers(0, len(ours), settings["batch"])
    tokens, actions = _windows(read, ours, first)
    batch = ours.batch(first)
    if not (batch.tokens.flatten(2).equal(tokens) and batch.actions.equal(actions)):
        raise RuntimeError(f"{name} gives other windows than ours")
    made, began, worked = 0, time.perf_counter(), time.process_time()
    while made < settings["peer_windows"]:
        made += len(_windows(read, ours, rng.integers(0, len(ours), settings["batch"]))[0])
    return {
        "frames": len(rows[0]),
        "write_seconds": round(written, 2),
        "mib_on_disk": round(sum(path.stat().st_size for path in store.rglob("*")) / 2**20, 1),
        "windows_per_second": round(made / (time.perf_counter() - began)),
        "windows_per_cpu_second": round(made / (time.process_time() - worked)),
    }


def _rows_of(ours: Any) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return tokens (N, S) and chunks (N, K) of every frame; zeros follow the last action."""
    shards, stride = ours.shards, ours.index.row_stride
    parts = [shards.read(name, range(len(groups)), ["tokens", "action"])
             for name, groups in zip(shards.shards("train"), shards.row_groups("train"))]  # fmt: skip
    tokens, actions = (np.concatenate([part[key] for part in parts]) for key in ("tokens", "action"))
    padded = np.concatenate([actions, np.zeros((stride, actions.shape[1]), actions.dtype)])
    return tokens, np.stack([padded[i : i + len(actions)] for i in range(stride)], 1).reshape(len(tokens), -1)


def _windows(read: Samples, ours: Any, windows: NDArray[np.int64]) -> tuple[Any, Any]:
    """Return tokens (B, T, S) int64 and actions (B, T, K) as torch tensors."""
    import torch

    rows = ours.index.first_rows(windows)[:, None] + ours.index.offsets
    tokens, chunks = read(rows.ravel())
    shape = (*rows.shape, -1)
    return torch.from_numpy(tokens.reshape(shape).astype(np.int64)), torch.from_numpy(chunks.reshape(shape))


# -- the peers: each writes its format and returns a function that reads samples by number


def _samples(rows: tuple[NDArray[Any], NDArray[Any]], number: int) -> dict[str, Any]:
    return {"tokens": rows[0][number], "chunk": rows[1][number]}


def _table(rows: tuple[NDArray[Any], NDArray[Any]]) -> Any:
    import pyarrow as pa

    tokens, chunks = rows
    columns = [(pa.uint32(), tokens), (pa.float32(), chunks)]
    arrays = [
        pa.FixedSizeListArray.from_arrays(pa.array(values.ravel(), kind), values.shape[1])
        for kind, values in columns
    ]
    return pa.table(arrays, names=["tokens", "chunk"])


def _of_table(table: Any) -> tuple[NDArray[Any], NDArray[Any]]:
    from hma_data.shards.schema import to_numpy

    return to_numpy(table["tokens"]), to_numpy(table["chunk"])


def _lance(store: Path, rows: Any) -> Samples:
    import lance

    data = lance.write_dataset(_table(rows), str(store))
    return lambda numbers: _of_table(data.take(numbers.tolist(), columns=["tokens", "chunk"]))


def _datasets(store: Path, rows: Any) -> Samples:
    import datasets

    datasets.disable_progress_bars()
    datasets.Dataset(_table(rows)).save_to_disk(str(store))
    data = datasets.load_from_disk(str(store)).with_format("arrow")
    return lambda numbers: _of_table(data[numbers.tolist()])


def _litdata(store: Path, rows: Any) -> Samples:
    from litdata import StreamingDataset
    from litdata.streaming import Cache

    cache = Cache(str(store), chunk_bytes=f"{CHUNK_MB}MB")
    for number in range(len(rows[0])):
        cache[number] = _samples(rows, number)
    cache.done()
    cache.merge()
    return _one_by_one(StreamingDataset(str(store), shuffle=False))


def _streaming(store: Path, rows: Any) -> Samples:
    from streaming import MDSWriter, StreamingDataset

    columns = {"tokens": f"ndarray:uint32:{rows[0].shape[1]}", "chunk": f"ndarray:float32:{rows[1].shape[1]}"}
    with MDSWriter(out=str(store), columns=columns, size_limit=CHUNK_MB * 2**20) as writer:
        for number in range(len(rows[0])):
            writer.write(_samples(rows, number))
    return _one_by_one(StreamingDataset(local=str(store), batch_size=1))


def _one_by_one(data: Any) -> Samples:
    def read(numbers: NDArray[np.int64]) -> tuple[NDArray[Any], NDArray[Any]]:
        items = [data[number] for number in numbers.tolist()]
        return np.stack([item["tokens"] for item in items]), np.stack([item["chunk"] for item in items])

    return read


PACKAGES = {"lance": "pylance", "streaming": "mosaicml-streaming"}  # of other names than their modules
PEERS: dict[str, Callable[[Path, Any], Samples]] = {
    "datasets": _datasets,
    "lance": _lance,
    "litdata": _litdata,
    "streaming": _streaming,
}
