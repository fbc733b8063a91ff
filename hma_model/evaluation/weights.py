"""Open the file of a network that somebody else trained: TorchScript, or tensors alone.

A file is named with its SHA-256, `FILE#SHA256`. TorchScript is code, and a metric of other weights is
another metric; so a file without the hash, or with another one, is refused. Tensors are read from
safetensors, or from a file of `torch.save` without running code of it. A file of a store is kept in the
cache's folder `networks`.
"""

import re
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from hma_data.errors import UsageError
from hma_data.storage.files import cache_folder, file_sha256, write_atomic
from hma_data.storage.paths import StrPath, as_text
from hma_data.storage.remote import is_remote, place

SHA256 = re.compile(r"[0-9a-f]{64}")


@dataclass(frozen=True)
class Weights:
    """An opened file.

    Attributes:
        name: of the file.
        sha256: of its bytes.
        tensors: by name; empty for TorchScript.
        script: the TorchScript module, in eval mode.
    """

    name: str
    sha256: str
    tensors: dict[str, Tensor]
    script: Any = None


def open_weights(file: StrPath, option: str) -> Weights:
    """Open `FILE#SHA256`, a str or path; `option` names it in errors.

    Raises:
        UsageError: there is no such file, it is not the one of the hash, or it holds no network.
    """
    name, _, stated = as_text(file).partition("#")
    path = _local(name, stated.lower(), option)
    found = file_sha256(path)
    if not stated:
        remedy = f"compare with its publisher's, and give {option} {name}#{found}"
        raise UsageError(option, f"{name} comes without its SHA-256, which is {found}", remedy)
    if found != stated.lower():
        raise UsageError(option, f"{name} has the SHA-256 {found}, not {stated}", "get the file again")
    try:
        if _is_script(path):
            script = torch.jit.load(path, map_location="cpu").eval()
            return Weights(Path(name).name, found, {}, script)
        return Weights(Path(name).name, found, _tensors(path))
    except Exception as fault:
        reason = str(fault).strip().splitlines()[0] if str(fault).strip() else type(fault).__name__
        remedy = "give TorchScript, safetensors, or a state dict of torch.save"
        raise UsageError(option, f"{name} cannot be read: {reason}", remedy) from fault


def _local(name: str, stated: str, option: str) -> Path:
    path = place(name)
    if not is_remote(path):
        path = path.expanduser()
        if not path.is_file():
            raise UsageError(option, f"{name}: no such file", "give the path or URI of the network's weights")
        return path
    if not SHA256.fullmatch(stated):
        raise UsageError(option, f"{name} comes without its SHA-256", f"give {option} {name}#SHA256")
    kept = cache_folder() / "networks" / stated
    if not kept.is_file():
        kept.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(kept, path.read_bytes())
    return kept


def _is_script(path: Path) -> bool:
    if not zipfile.is_zipfile(path):
        return False
    with zipfile.ZipFile(path) as file:
        return any("/code/" in name for name in file.namelist())


def _tensors(path: Path) -> dict[str, Tensor]:
    with path.open("rb") as file:
        head = file.read(9)
    if head[8:] == b"{":  # the header of safetensors: its length, and JSON
        from safetensors.torch import load_file

        values: Any = load_file(path)
    else:
        values = torch.load(path, map_location="cpu", weights_only=True)
    values = values.get("state_dict", values)
    tensors = {key.removeprefix("module."): item for key, item in values.items() if isinstance(item, Tensor)}
    return {key: item.float() if item.is_floating_point() else item for key, item in tensors.items()}
