"""Write folders atomically; read and write JSON and safetensors files."""

import json
import math
import os
import shutil
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hma_data.errors import CheckpointError, HMAError
from hma_data.storage import json_io
from hma_data.storage.files import sync_folder

if TYPE_CHECKING:
    from torch import Tensor

MAX_JSON_BYTES = 16_000_000
_AGAIN = "have it saved or pushed again"


@contextmanager
def new_folder(folder: Path) -> Iterator[Path]:
    """Yield an empty folder to fill; it gets the given name when the block ends without an error.

    It replaces an older folder of that name. On an error the new folder is deleted and the older one stays as
    it was.
    """
    folder = Path(os.path.abspath(folder))  # noqa: PTH100, a link at the end must stay a link
    folder.parent.mkdir(parents=True, exist_ok=True)
    beside = _beside(folder)
    beside.mkdir()
    try:
        yield beside
        for path in (*beside.rglob("*"), beside):
            sync_folder(path)  # flushes a file as well
        _swap(beside, folder)
    finally:
        shutil.rmtree(beside, ignore_errors=True)
    sync_folder(folder.parent)


def remove_partial(folder: Path) -> None:
    """Delete the partial files and folders that killed writers left in a folder."""
    for path in folder.glob(".*.partial-*"):
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


def _beside(path: Path) -> Path:
    return path.with_name(f".{path.name}.partial-{uuid.uuid4().hex[:12]}")


def _swap(new: Path, final: Path) -> None:
    if not final.exists():
        new.rename(final)
        return
    old = _beside(final)
    final.rename(old)
    try:
        new.rename(final)
    except OSError:
        old.rename(final)
        raise
    shutil.rmtree(old, ignore_errors=True)


def to_json(values: Any) -> bytes:
    """Return indented JSON that ends with a newline; numbers that are not finite become null."""
    return (json.dumps(finite(values), indent=2, ensure_ascii=False, allow_nan=False) + "\n").encode()


def read_json(path: Path, error: type[HMAError] = CheckpointError) -> dict[str, Any]:
    """Read the object in a JSON file.

    Raises:
        error: the file is missing, unreadable, larger than 16 MB, or holds no JSON object.
    """
    try:
        if path.stat().st_size > MAX_JSON_BYTES:
            raise error(path, f"larger than {MAX_JSON_BYTES:,} bytes", "this is not a file of ours")
        content = path.read_bytes()
    except OSError as fault:
        raise error(path, f"cannot be read: {fault.strerror}") from fault
    return parse_json(content, path, error)


def parse_json(content: bytes, where: object, error: type[HMAError] = CheckpointError) -> dict[str, Any]:
    """Parse the object in JSON bytes, which must not repeat a key; see `read_json`."""
    try:
        values = json_io.parse_json(content)
    except (ValueError, RecursionError) as fault:
        raise error(where, f"is not valid JSON: {fault}", _AGAIN) from fault
    if not isinstance(values, dict):
        raise error(where, f"must hold a JSON object, holds {type(values).__name__}", _AGAIN)
    return values


def read_tensors(path: Path) -> dict[str, "Tensor"]:
    """Read all tensors of a safetensors file to the CPU.

    Raises:
        CheckpointError: the file is damaged, truncated or of another format.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    try:
        return load_file(path)
    except (SafetensorError, OSError) as fault:
        raise CheckpointError(path, f"is not whole safetensors: {fault}", "pull or save it again") from fault


def read_metadata(path: Path) -> dict[str, str]:
    """Read the metadata in the header of a safetensors file; see `read_tensors`."""
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="np") as file:  # the header alone needs no torch
            return file.metadata() or {}
    except (SafetensorError, OSError) as fault:
        raise CheckpointError(path, f"is not whole safetensors: {fault}", "pull or save it again") from fault


def write_tensors(path: Path, tensors: Mapping[str, "Tensor"], metadata: dict[str, str]) -> None:
    """Write a safetensors file; the same tensors give the same bytes, whatever device they are on."""
    from safetensors.torch import save_file

    plain = {name: tensors[name].detach().cpu().contiguous().clone() for name in sorted(tensors)}
    save_file(plain, path, metadata)
    with path.open("r+b") as file:  # safetensors writes the metadata in a different order each time
        length = int.from_bytes(file.read(8), "little")
        header = json.loads(file.read(length))
        values = {"__metadata__": dict(sorted(header.pop("__metadata__").items())), **header}
        content = json.dumps(values, ensure_ascii=False, separators=(",", ":")).encode().ljust(length)
        if len(content) == length:
            file.seek(8)
            file.write(content)


def finite(values: Any) -> Any:
    """Return the same plain values, with None for numbers that JSON cannot hold."""
    if isinstance(values, dict):
        return {str(key): finite(value) for key, value in values.items()}
    if isinstance(values, list | tuple):
        return [finite(value) for value in values]
    return None if isinstance(values, float) and not math.isfinite(values) else values
