"""Keep trained readers of images on disk, so that the next command does not train them again.

A kept file has the digest of all that it was made of in its name: the simulator and the training as code, the
tokenizer's weights, and what the caller names. A damaged one is made again. It lies in `$HMA_CACHE/readers`
and may be deleted.
"""

import hashlib
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from hma_data.errors import HMAError
from hma_data.storage.files import cache_folder, short_sha256
from hma_data.storage.kept import keep_arrays, kept_arrays
from hma_data.tokenizers.base import Tokenizer

Arrays = dict[str, NDArray[Any]]

NETWORK = "network."  # begins the names of a network's weights
CODE = (  # the modules on which readers depend
    "hma_data/lab/**/*.py",
    "hma_data/episodes/images.py",
    "hma_model/evaluation/*.py",
    "hma_model/policies/judge.py",
)


def kept(kind: str, tokenizer: Tokenizer, facts: Mapping[str, Any], make: Callable[[], Arrays]) -> Arrays:
    """Return named arrays, which are made only if no earlier command has kept them.

    Those of a tokenizer without a network are not kept: nothing tells what it shows.

    Args:
        kind: of the arrays; part of the file's name.
        tokenizer: of the images that they were learned from.
        facts: all else that they depend on, as values whose `repr` tells them apart.
        make: makes the arrays.
    """
    if not isinstance(network := getattr(tokenizer, "network", None), nn.Module):
        return make()
    told = f"{kind} {sorted(facts.items())} {tokenizer.spec.digest} {_code()} {torch.__version__}"
    digest = short_sha256(f"{told} {weights_sha256(network)}", 32)
    path = cache_folder() / "readers" / f"{kind}-{digest}"
    if (found := kept_arrays(path)) is not None:
        return found
    made = make()
    with suppress(HMAError):  # a full disk or a folder that cannot be written costs the time alone
        keep_arrays(path, made)
    return made


def kept_reader(
    kind: str,
    tokenizer: Tokenizer,
    facts: Mapping[str, Any],
    make: Callable[[], Any],
    values: Sequence[str],
    network_of: Callable[[int], nn.Module],
) -> dict[str, Any]:
    """Return the `network` in eval mode and the named arrays of an object that `make` trains.

    Args:
        kind, tokenizer, facts: as of `kept`.
        make: returns an object with the attributes `network`, `error` (n,) and `values`.
        values: names of the arrays.
        network_of: returns a network for n values.
    """

    def arrays() -> Arrays:
        made = make()
        weights = {NETWORK + name: value.numpy() for name, value in made.network.state_dict().items()}
        return weights | {name: np.asarray(getattr(made, name)) for name in values}

    found = kept(kind, tokenizer, facts, arrays)
    network = network_of(len(found["error"]))
    network.load_state_dict({name: torch.from_numpy(found[NETWORK + name]) for name in network.state_dict()})
    return {"network": network.eval()} | {name: found[name] for name in values}


def weights_sha256(network: nn.Module) -> str:
    """Return the SHA-256 of a network's weights and their names."""
    digest = hashlib.sha256()
    for name, tensor in network.state_dict().items():
        values = tensor.detach().cpu().contiguous()
        digest.update(f"{name} {values.dtype} {tuple(values.shape)}".encode())
        digest.update(values.reshape(-1).view(torch.uint8).numpy())
    return digest.hexdigest()


@cache
def _code() -> str:
    files = [path for pattern in CODE for path in sorted(Path(__file__).parents[2].glob(pattern))]
    return short_sha256(b"".join(path.read_bytes() for path in files), 64)
