"""Read plain values from pickles without running code: numbers, texts, lists, dictionaries and numpy arrays.

numpy saves a dictionary as an array of one object, which is a pickle. The standard library's unpickler asks
`find_class` for every name that a pickle uses. Here it gets stand-ins for the few names that numpy writes,
and an error for any other name.
"""

import io
import math
import pickle
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy

from hma_data.errors import EpisodeError
from hma_data.storage.kinds import unreadable

MAX_BYTES = 256 << 20  # of a file
_NUMBERS = "biufc"  # kinds of dtypes whose bytes are read


def read_dict(path: Path) -> dict[Any, Any]:
    """Return the dictionary of an .npy file.

    Raises:
        EpisodeError: the file is missing or damaged, or holds anything but a dictionary of plain values.
    """
    try:
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise ValueError(f"it has {size:,} bytes, more than {MAX_BYTES:,}")
        with path.open("rb") as file:
            version = npy.read_magic(file)
            header = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
            shape, _, dtype = header(file)
            if shape or not dtype.hasobject:
                raise ValueError(f"it holds an array {shape} of {dtype}, not a dictionary")
            found = load_plain(file.read())
        if isinstance(found, np.ndarray) and found.size == 1:
            found = found.item()
        if not isinstance(found, dict):
            raise ValueError(f"it holds a {type(found).__name__}, not a dictionary")
        return found
    except OSError as fault:
        raise EpisodeError(path, *unreadable(path, "there is no such file", "")) from fault
    except Exception as fault:  # damaged bytes make numpy and pickle raise a dozen different types
        raise EpisodeError(path, f"cannot be read: {fault}", "copy or record it again") from fault


def load_plain(content: bytes) -> Any:
    """Return the value of a pickle.

    Raises:
        Exception: of many types, where it is damaged or uses a name that is not allowed.
    """
    return _PlainUnpickler(io.BytesIO(content)).load()


# The C unpickler keeps its memo in a list as long as the largest index, so that ten bytes can claim 32 GB.
# The one in Python keeps a dictionary.
class _PlainUnpickler(pickle._Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _STAND_INS:
            raise ValueError(f"it asks for {module}.{name}, which is neither a plain value nor an array")
        # A pickle may set attributes of what it names. A fresh partial keeps them from our own functions.
        return partial(_STAND_INS[module, name])


class _Dtype:
    """A dtype of numbers. The real one takes any state, also sizes and offsets that lead out of an array."""

    def __init__(self, name: Any, *_: Any) -> None:
        if not isinstance(name, str) or len(name) > 8:
            raise ValueError(f"it has a number type {str(name)[:40]!r}")
        self.dtype = np.dtype(name)
        if self.dtype.kind not in _NUMBERS + "O":
            raise ValueError(f"it has values of {self.dtype}, not numbers")

    def __setstate__(self, state: Any) -> None:
        _, order, *rest = state
        if order not in ("<", ">", "|", "=") or any(rest[:3]):
            raise ValueError("it has a compound number type")
        self.dtype = self.dtype.newbyteorder(order)


class _Array(np.ndarray):
    """An array that is filled after it was made, as pickles do."""

    def __setstate__(self, state: Any) -> None:
        _, shape, kind, is_fortran, content = state
        if isinstance(content, list):
            # numpy allocates what the shape claims, before it looks at the list.
            if math.prod(shape) != len(content):
                raise ValueError(f"it has an array {shape} of {len(content)} objects")
        else:
            _check_numbers(content, kind)
        super().__setstate__((1, shape, kind.dtype, is_fortran, content))


def _reconstruct(*_: Any) -> _Array:
    return _Array((0,), np.uint8)


def _from_buffer(content: Any, kind: Any, shape: Any, order: str = "C") -> np.ndarray:
    _check_numbers(content, kind)
    return np.frombuffer(content, kind.dtype).reshape(shape, order="F" if order == "F" else "C")


def _scalar(kind: Any, content: Any) -> Any:
    return _from_buffer(content, kind, (1,))[0].item()


def _check_numbers(content: Any, kind: Any) -> None:
    is_plain = isinstance(kind, _Dtype) and kind.dtype.kind in _NUMBERS
    if not is_plain or not isinstance(content, bytes | bytearray):
        raise ValueError("it has an array that is not of numbers")


def _encode(text: Any, codec: Any) -> bytes:
    if codec not in ("latin1", "latin-1") or not isinstance(text, str):
        raise ValueError(f"it has text in {codec!r}")
    return text.encode("latin-1")


def _ndarray(*_: Any) -> None:
    # Pickles give ndarray as an argument of `_reconstruct`. To call it would allocate any claimed size.
    raise ValueError("it makes an array without content")


_STAND_INS: dict[tuple[str, str], Any] = {
    ("numpy.core.multiarray", "_reconstruct"): _reconstruct,
    ("numpy._core.multiarray", "_reconstruct"): _reconstruct,
    ("numpy.core.multiarray", "scalar"): _scalar,
    ("numpy._core.multiarray", "scalar"): _scalar,
    ("numpy.core.numeric", "_frombuffer"): _from_buffer,
    ("numpy._core.numeric", "_frombuffer"): _from_buffer,
    ("numpy", "ndarray"): _ndarray,
    ("numpy", "dtype"): _Dtype,
    ("_codecs", "encode"): _encode,
    ("__builtin__", "bytes"): bytes,  # without arguments, by protocols 0 to 2
}
