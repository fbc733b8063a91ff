"""Find, read and write the weights of tokenizers.

Weights that are not in the package are looked for in three places, in this order: the path that was
named; a file or folder of the tokenizer's name in $HMA_WEIGHTS; the Hugging Face Hub, at the revision that
`catalog` pins. Reading runs no code from the files: safetensors holds no code, and of a torch checkpoint
only tensors and plain values are unpickled (`weights_only`). A network takes all its weights or none.

The weights' file of an embedded tokenizer is safetensors of float16 parameters; its metadata holds the
format, the network's shape and the facts of the training.
"""

import hashlib
import json
import os
import pickle
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from pydantic import BaseModel
from safetensors.torch import save
from torch import Tensor, nn

from hma_data.errors import HMAError, TokenizerError
from hma_data.storage.files import file_sha256, opened_weights, read_json, write_atomic
from hma_data.storage.kinds import one_line, unreadable
from hma_data.tokenizers.base import OTHER
from hma_data.tokenizers.catalog import Entry, find_entry
from hma_data.tokenizers.shapes import read_shape

FOLDER = "HMA_WEIGHTS"  # environment variable: a folder of weights, named after the tokenizers
SUFFIXES = (".safetensors", ".ckpt", ".pt", ".pth")
NESTED = ("state_dict", "model_state_dict", "model")  # where trainers keep the weights in a checkpoint
HALVES = ("encoder", "decoder")  # in the names of files that come in pairs

Tensors = dict[str, Tensor]


# -- find


def find_weights(name: str, weights: str | None) -> Path:
    """Return the file or folder that holds a tokenizer's weights.

    Args:
        name: name of the tokenizer, as `get_tokenizer` takes it.
        weights: a path, or `hf://[datasets/]ORGANISATION/NAME[@REVISION]/FILE`; None takes the usual place.

    Raises:
        TokenizerError: nothing is there, or the hub cannot give it.
    """
    if weights and weights.startswith("hf://"):
        return _from_hub(name, _parse_uri(weights))
    if weights:
        path = Path(weights).expanduser()
        if not path.exists():
            raise TokenizerError(path, "no such file or folder", f"name the weights of {name}")
        return path
    if folder := os.environ.get(FOLDER):
        home = Path(folder).expanduser()
        stems = (name, f"{name}_{HALVES[0]}")
        files = (home / f"{stem}{suffix}" for stem in stems for suffix in SUFFIXES)
        for path in (*files, home / name):
            if path.exists():
                return path
    entry = find_entry(name)
    if not entry.repo:
        fault = "has no weights in the package and no pinned download"
        raise TokenizerError(name, fault, "give --weights PATH (weights=PATH)")
    return _from_hub(name, entry)


def _parse_uri(uri: str) -> Entry:
    """Return an entry of which only the fields that name the file matter."""
    form = r"hf://(datasets/)?([\w.-]+/[\w.-]+?)(?:@([\w.-]+))?/([\w./-]+)"
    found = re.fullmatch(form, uri)
    if not found or ".." in uri:
        remedy = "write hf://ORGANISATION/NAME@REVISION/FILE"
        raise TokenizerError(uri, "is not the address of a file on the hub", remedy)
    dataset, repo, revision, file = found.groups()
    return Entry(
        uri, "discrete", 0, (0, 0), "", "download", "", repo=repo, file=file, revision=revision or "main",
        repo_type="dataset" if dataset else "model",
    )  # fmt: skip


def _from_hub(name: str, entry: Entry) -> Path:
    """Return the path of a file in the hub's cache; download the file if it is not there."""
    import httpx
    from huggingface_hub import get_hf_file_metadata, hf_hub_download, hf_hub_url
    from huggingface_hub.errors import GatedRepoError, HFValidationError

    place: dict[str, Any] = {"revision": entry.revision, "repo_type": entry.repo_type}
    pinned = re.fullmatch(r"[0-9a-f]{40}", entry.revision)  # a branch or a tag can move, a commit cannot
    try:
        found = entry.cached() if pinned else None
        if found is None:
            # Ask first: without a connection, the download would retry for half a minute and log each try.
            get_hf_file_metadata(hf_hub_url(entry.repo, entry.file, **place))
            found = hf_hub_download(entry.repo, entry.file, **place)
    except (httpx.HTTPError, HFValidationError, OSError) as fault:
        size = f", {entry.bytes / 1e6:.0f} MB" if entry.bytes else ""
        wanted = f"needs {entry.file} of {entry.repo} at {entry.revision[:12]}{size}"
        remedy = "get the file elsewhere and give its path: --weights PATH (weights=PATH)"
        if isinstance(fault, GatedRepoError):
            remedy = f"accept its licence on the repository's page and log in, or {remedy}"
        text = f"{wanted}, which could not be downloaded: {type(fault).__name__}: {one_line(fault)}"
        raise TokenizerError(name, text, remedy) from fault
    if entry.sha256 and file_sha256(Path(found)) != entry.sha256:
        text = f"is not the file that was pinned for {name} (SHA-256 {entry.sha256[:12]}…)"
        raise TokenizerError(found, text, "delete it")
    return Path(found)


def one_file(path: Path, names: Sequence[str], what: str) -> Path:
    """Return the path if it is a file, else the first of `names` in the folder; raise if there is none."""
    for file in (path, *(path / name for name in names)):
        if file.is_file():
            return file
    raise TokenizerError(path, f"holds none of {', '.join(names)}", f"name the file of {what}")


def pair_of(path: Path) -> list[Path]:
    """Return the encoder's and the decoder's file if the path is named after one of them; else an empty list.

    Raise TokenizerError if the other file is not there.
    """
    named = re.search(r"(?<![A-Za-z])(encoder|decoder)", path.name)
    if not named:
        return []
    start, end = named.span()
    files = [path.with_name(path.name[:start] + half + path.name[end:]) for half in HALVES]
    for file in files:
        if not file.is_file():
            raise TokenizerError(file, f"is missing, but belongs with {path.name}", "put it there")
    return files


def digest_of(paths: Iterable[Path]) -> str:
    """Return the SHA-256 of one file; for several, the SHA-256 of their concatenated digests."""
    digests = [file_sha256(path) for path in paths]
    return digests[0] if len(digests) == 1 else hashlib.sha256("".join(digests).encode()).hexdigest()


# -- read


def read_tensors(path: Path, error: type[HMAError] = TokenizerError) -> Tensors:
    """Read all tensors of a safetensors file or of a torch checkpoint, by name, in their stored dtypes.

    Raises:
        error: it is not such a file, is truncated, or holds values that only code could make.
    """
    try:
        with path.open("rb") as file:
            start = file.read(9)
        if start[8:] == b"{":
            return _read_safetensors(path, error)
        # Only a zip archive can be memory-mapped; torch wrote others before version 1.6.
        values = torch.load(path, map_location="cpu", weights_only=True, mmap=start.startswith(b"PK"))
    except pickle.UnpicklingError as fault:
        text = "is not a torch checkpoint, or holds more than tensors and plain values; it was not unpickled"
        remedy = "save its state_dict as safetensors where it can be trusted"
        raise error(path, *unreadable(path, text, remedy)) from fault
    except HMAError:
        raise
    except Exception as fault:  # torch raises many kinds of errors on a damaged file
        text = f"is not a complete safetensors file or torch checkpoint: {type(fault).__name__}"
        raise error(path, *unreadable(path, f"{text}: {one_line(fault)}", "download it again")) from fault
    for key in NESTED:
        if isinstance(values, Mapping) and isinstance(values.get(key), Mapping):
            values = values[key]
    named = values.items() if isinstance(values, Mapping) else ()
    tensors = {str(name): value for name, value in named if isinstance(value, Tensor)}
    if not tensors:
        raise error(path, f"holds a {type(values).__name__} without weights by name", "name another file")
    return tensors


def _read_safetensors(path: Path, error: type[HMAError] = TokenizerError) -> Tensors:
    with opened_weights(path, error, "pt") as file:
        return {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118


def stated_scale(folder: Path, default: float) -> float:
    """Return the `scaling_factor` that a folder's `config.json` states; `default` if it states none."""
    path = folder / "config.json"
    scale = read_json(path, TokenizerError).get("scaling_factor", default) if path.is_file() else default
    if not isinstance(scale, int | float) or not 0 < scale < 1e6:
        raise TokenizerError(path, f"states no usable scaling_factor: {scale!r}", "repair it")
    return float(scale)


def fill(network: nn.Module, tensors: Mapping[str, Tensor], where: object) -> None:
    """Give a network (which may be on the meta device) all its weights as float32.

    Raises:
        TokenizerError: a weight is missing, unexpected, of another shape, or not finite.
    """
    state = {name: tensor.to(torch.float32, copy=True).contiguous() for name, tensor in tensors.items()}
    for name, tensor in state.items():
        if not torch.isfinite(tensor).all():
            raise TokenizerError(where, f"{name} holds values that are not finite", "download it again")
    try:
        network.load_state_dict(state, assign=True)
    except RuntimeError as fault:
        raise TokenizerError(where, f"does not fit the network: {one_line(fault, 300)}", OTHER) from fault


@contextmanager
def shapes_of(where: object, what: str) -> Iterator[None]:
    """Turn a missing or unsuitable tensor, met while a network is derived, into one TokenizerError."""
    try:
        yield
    except (KeyError, IndexError, ValueError, TypeError, RuntimeError, ZeroDivisionError) as fault:
        text = f"lacks {fault.args[0]}" if isinstance(fault, KeyError) else one_line(fault)
        raise TokenizerError(where, f"does not hold the weights of {what}: {text}", OTHER) from fault


def numbers(names: Iterable[str], prefix: str) -> list[int]:
    """Return the numbers n of `<prefix>n.…` among names, ascending."""
    found = {name[len(prefix) :].split(".", 1)[0] for name in names if name.startswith(prefix)}
    return sorted(int(number) for number in found if number.isdecimal())


# -- the embedded tokenizers' files


def save_weights(
    path: Path,
    form: str,
    config: BaseModel,
    tensors: dict[str, Tensor],
    facts: dict[str, Any],
    tokens_sha256: str = "",
) -> None:
    """Write parameters as float16 with the network's shape and `facts` in the metadata, atomically.

    `tokens_sha256` is the digest of the file whose encoder these weights keep: both make the same tokens.
    """
    halves = {name: tensor.detach().half().contiguous() for name, tensor in sorted(tensors.items())}
    metadata = {"format": form, "config": json.dumps(config.model_dump()), "training": json.dumps(facts)}
    if tokens_sha256:
        metadata["tokens_sha256"] = tokens_sha256
    content = save(halves, metadata)
    # The library writes the header in an order that varies; sort it, so that equal weights are equal files.
    end = 8 + int.from_bytes(content[:8], "little")
    header = json.dumps(json.loads(content[8:end]), sort_keys=True, separators=(",", ":")).encode()
    header += b" " * (-len(header) % 8)
    write_atomic(path, len(header).to_bytes(8, "little") + header + content[end:])


def read_weights[C: BaseModel](path: Path, form: str, config: type[C]) -> tuple[C, Tensors, str]:
    """Read a weights' file; return the network's shape, its parameters (float16) and its tokens' digest.

    The digest is the file's SHA-256, or that of the file whose encoder it kept.

    Raises:
        TokenizerError: there is no such file, or it is not safetensors, truncated, or of another network.
    """
    shape, sha256 = read_shape(path, form, config)
    return shape, _read_safetensors(path), sha256
