"""Find, check and read the weights of the tokenizers that are not in the package.

Weights are looked for in three places, in this order: the path that was named; a file or folder of the
tokenizer's name in $HMA_WEIGHTS; the Hugging Face Hub, at the revision that `catalog` pins. Reading runs
no code from the files: safetensors holds no code, and of a torch checkpoint only tensors and plain values
are unpickled (`weights_only`). A network takes all its weights or none.
"""

import hashlib
import json
import os
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn

from hma_data.errors import TokenizerError
from hma_data.storage.files import file_sha256
from hma_data.tokenizers.catalog import Entry, find_entry

FOLDER = "HMA_WEIGHTS"  # environment variable: a folder of weights, named after the tokenizers
SUFFIXES = (".safetensors", ".ckpt", ".pt", ".pth")
NESTED = ("state_dict", "model_state_dict", "model")  # where trainers keep the weights in a checkpoint
HALVES = ("encoder", "decoder")  # in the names of files that come in pairs
MAX_JSON_BYTES = 1 << 20

Tensors = dict[str, Tensor]


# -- where


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
        raise TokenizerError(
            name, "has no weights in the package and no pinned download", "give --weights PATH (weights=PATH)"
        )
    return _from_hub(name, entry)


def _parse_uri(uri: str) -> Entry:
    form = r"hf://(datasets/)?([\w.-]+/[\w.-]+?)(?:@([\w.-]+))?/([\w./-]+)"
    found = re.fullmatch(form, uri)
    if not found or ".." in uri:
        raise TokenizerError(uri, "is no file on the hub", "write hf://ORGANISATION/NAME@REVISION/FILE")
    dataset, repo, revision, file = found.groups()
    kind = "dataset" if dataset else "model"
    # Only the fields that name the file matter here.
    return Entry(
        uri,
        "discrete",
        0,
        (0, 0),
        "",
        "download",
        "",
        repo=repo,
        file=file,
        revision=revision or "main",
        repo_type=kind,  # type: ignore[arg-type]
    )


def _from_hub(name: str, entry: Entry) -> Path:
    """Return the path of a pinned file in the hub's cache; download it if it is not there."""
    import httpx
    from huggingface_hub import errors

    size = f", {entry.bytes / 1e6:.0f} MB" if entry.bytes else ""
    wanted = f"{entry.file} of {entry.repo} at {entry.revision[:12]}{size}"
    remedy = "get the file elsewhere and give its path: --weights PATH (weights=PATH)"
    try:
        path = _cached(entry) or _download(entry)
    except errors.GatedRepoError as fault:
        gated = f"accept its licence on the repository's page and log in, or {remedy}"
        raise TokenizerError(name, f"needs {wanted}, which is gated", gated) from fault
    except (errors.HfHubHTTPError, errors.HFValidationError) as fault:
        if isinstance(fault, errors.LocalEntryNotFoundError):
            raise _unreachable(name, wanted, fault, remedy) from fault
        text = _one_line(fault)
        raise TokenizerError(name, f"needs {wanted}, which the hub did not give: {text}", remedy) from fault
    except (httpx.HTTPError, OSError) as fault:
        raise _unreachable(name, wanted, fault, remedy) from fault
    if entry.sha256 and file_sha256(Path(path)) != entry.sha256:
        raise TokenizerError(
            path, f"is not the file that was pinned for {name} (SHA-256 {entry.sha256[:12]}…)", "delete it"
        )
    return Path(path)


def _unreachable(name: str, wanted: str, fault: Exception, remedy: str) -> TokenizerError:
    reason = type(fault).__name__
    return TokenizerError(name, f"needs {wanted} from the hub, which is out of reach ({reason})", remedy)


def _cached(entry: Entry) -> str | None:
    """Return the file in the hub's cache if the revision is a commit; a branch or tag can move."""
    from huggingface_hub import try_to_load_from_cache

    if not re.fullmatch(r"[0-9a-f]{40}", entry.revision):
        return None
    found = try_to_load_from_cache(entry.repo, entry.file, revision=entry.revision, repo_type=entry.repo_type)
    return found if isinstance(found, str) else None


def _download(entry: Entry) -> str:
    from huggingface_hub import get_hf_file_metadata, hf_hub_download, hf_hub_url

    kind, revision = entry.repo_type, entry.revision
    # Ask once first: without a connection, the download would retry for half a minute and log each try.
    get_hf_file_metadata(hf_hub_url(entry.repo, entry.file, repo_type=kind, revision=revision))
    return hf_hub_download(entry.repo, entry.file, revision=revision, repo_type=kind)


def one_file(path: Path, names: Iterable[str], what: str) -> Path:
    """Return the path if it is a file, else the first of `names` in the folder.

    Raises:
        TokenizerError: none of them is there.
    """
    if path.is_file():
        return path
    names = tuple(names)
    for name in names:
        if (path / name).is_file():
            return path / name
    raise TokenizerError(path, f"holds none of {', '.join(names)}", f"name the file of {what}")


def pair_of(path: Path) -> list[Path]:
    """Return the encoder's and the decoder's file if the path is named after one of them; else an empty list.

    Raises:
        TokenizerError: the other file is not there.
    """
    named = re.search(r"(?<![A-Za-z])(encoder|decoder)", path.name)
    if not named:
        return []
    start, end = named.span()
    files = [path.with_name(path.name[:start] + half + path.name[end:]) for half in HALVES]
    for file in files:
        if not file.is_file():
            raise TokenizerError(file, f"is not there, but belongs with {path.name}", "put it there")
    return files


def digest_of(paths: Iterable[Path]) -> str:
    """Return the SHA-256 of one file; for several, the SHA-256 of their concatenated digests."""
    digests = [file_sha256(path) for path in paths]
    return digests[0] if len(digests) == 1 else hashlib.sha256("".join(digests).encode()).hexdigest()


# -- what


def read_tensors(path: Path) -> Tensors:
    """Read all tensors of a safetensors file or of a torch checkpoint, by name, in their stored dtypes.

    Raises:
        TokenizerError: it is not such a file, is truncated, or holds values that only code could make.
    """
    try:
        with path.open("rb") as file:
            start = file.read(9)
    except OSError as fault:
        raise TokenizerError(path, f"weights cannot be read: {fault.strerror or fault}") from fault
    if start[8:] == b"{":
        return _read_safetensors(path)
    if start.startswith((b"PK", b"\x80")):
        return _read_torch(path)
    raise TokenizerError(
        path, "is neither safetensors nor a torch checkpoint", "name the file that holds the weights"
    )


def _read_safetensors(path: Path) -> Tensors:
    try:
        with safe_open(path, "pt") as file:
            return {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError, ValueError) as fault:
        raise TokenizerError(
            path, f"is no whole safetensors file: {_one_line(fault)}", "fetch it again"
        ) from fault


def _read_torch(path: Path) -> Tensors:
    import pickle

    try:
        try:
            values = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
        except RuntimeError:  # a file written before torch 1.6 cannot be mapped
            values = torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as fault:
        raise TokenizerError(
            path,
            f"holds more than tensors and plain values, and was not unpickled: {_refused(fault)}",
            "save its state_dict as safetensors where it can be trusted",
        ) from fault
    except Exception as fault:  # a damaged file can raise anything
        text = f"{type(fault).__name__}: {_one_line(fault)}"
        raise TokenizerError(path, f"is no whole torch checkpoint ({text})", "fetch it again") from fault
    for key in NESTED:
        if isinstance(values, Mapping) and isinstance(values.get(key), Mapping):
            values = values[key]
    tensors = (
        {str(k): v for k, v in values.items() if isinstance(v, Tensor)} if isinstance(values, Mapping) else {}
    )
    if not tensors:
        raise TokenizerError(path, f"holds no weights by name, but a {type(values).__name__}")
    return tensors


def _refused(fault: Exception) -> str:
    """Return the name that the unpickler refused, taken from its long message."""
    text = _one_line(fault, 4000)
    found = re.search(r"GLOBAL ([\w.]+)", text) or re.search(r"WeightsUnpickler error: ([^.]{1,120})", text)
    return found.group(1) if found else text[:120]


def read_config(folder: Path) -> dict[str, Any]:
    """Return the `config.json` of a folder; empty if there is none.

    Raises:
        TokenizerError: it is not a JSON object.
    """
    path = folder / "config.json"
    if not path.is_file():
        return {}
    try:
        if path.stat().st_size > MAX_JSON_BYTES:
            raise ValueError(f"larger than {MAX_JSON_BYTES} bytes")
        values = json.loads(path.read_text("utf-8"))
        if not isinstance(values, dict):
            raise ValueError("not an object")
    except (OSError, ValueError, RecursionError) as fault:
        raise TokenizerError(path, f"is no JSON object: {_one_line(fault)}", "remove or repair it") from fault
    return values


def fill(network: nn.Module, tensors: Mapping[str, Tensor], where: object) -> None:
    """Give a network (which may be on the meta device) all its weights as float32.

    Raises:
        TokenizerError: a weight is missing, unexpected, of another shape, or not finite.
    """
    expected = {name: tuple(p.shape) for name, p in network.state_dict().items()}
    remedy = "these are the weights of another network"
    if missing := sorted(expected.keys() - tensors.keys()):
        raise TokenizerError(where, f"lacks {_some(missing)}", remedy)
    if unexpected := sorted(tensors.keys() - expected.keys()):
        raise TokenizerError(where, f"has {_some(unexpected)}, unknown to the network", remedy)
    for name, shape in expected.items():
        if tuple(tensors[name].shape) != shape:
            fault = f"{name} has shape {tuple(tensors[name].shape)}, the network takes {shape}"
            raise TokenizerError(where, fault, remedy)
    state = {name: tensor.to(torch.float32, copy=True).contiguous() for name, tensor in tensors.items()}
    for name, tensor in state.items():
        if not torch.isfinite(tensor).all():
            raise TokenizerError(where, f"{name} holds values that are not finite", "fetch it again")
    network.load_state_dict(state, assign=True)


@contextmanager
def shapes_of(where: object, what: str) -> Iterator[None]:
    """Turn a missing or unsuitable tensor, met while sizes are derived, into one TokenizerError."""
    try:
        yield
    except KeyError as fault:
        raise TokenizerError(
            where, f"lacks {fault.args[0]}: not the weights of {what}", "name other weights"
        ) from fault
    except (ValueError, IndexError, TypeError, RuntimeError, ZeroDivisionError) as fault:
        raise TokenizerError(
            where, f"describes no {what}: {_one_line(fault)}", "these are the weights of another network"
        ) from fault


def numbers(names: Iterable[str], prefix: str) -> list[int]:
    """Return the numbers n of `<prefix>n.…` among names, ascending."""
    found = {name[len(prefix) :].split(".", 1)[0] for name in names if name.startswith(prefix)}
    return sorted(int(number) for number in found if number.isdecimal())


def _some(names: list[str]) -> str:
    more = f" and {len(names) - 3} more" if len(names) > 3 else ""
    return ", ".join(names[:3]) + more


def _one_line(fault: object, length: int = 160) -> str:
    return " ".join(str(fault).split())[:length]
