"""Read dictionaries that `numpy.save` stored, without pickle: no code of the file runs.

numpy writes a dictionary as an array of one object, which is a pickle. `pickletools` only lists its
operations. Those that make plain values (dict, list, tuple, number, text, bytes, None) and numpy's own arrays
and numbers are followed here; any other, and any other name, is refused.

Source: numpy's NEP 1 (the .npy format), and the standard library's `pickletools`.
"""

import pickletools
from collections.abc import Callable
from pathlib import Path
from tokenize import TokenError
from typing import Any

import numpy as np
from numpy.lib import format as npy

from hma_data.errors import EpisodeError
from hma_data.storage.kinds import unreadable

MAX_BYTES = 256 << 20  # of a file
_MULTIARRAY = ("numpy.core.multiarray", "numpy._core.multiarray")
_NUMERIC = ("numpy.core.numeric", "numpy._core.numeric")
_KINDS = "biufc"  # of arrays whose bytes are read
_MARK = object()
# Of pickletools and of numpy's reading of a damaged header
_FAULTS = (ValueError, LookupError, TypeError, OverflowError, MemoryError, SyntaxError, TokenError)


class _Name(str):
    """What a pickle may name: a key of `_CALLS`, or ndarray, which is only an argument."""


class _Array:
    """An array before its content is known, and the places of the memo that have it."""

    def __init__(self) -> None:
        self.places: list[int] = []


class _Type:
    """A number type, whose byte order is stated later."""

    def __init__(self, dtype: np.dtype[Any]) -> None:
        self.dtype = dtype


_NAMES = {
    **{(module, "_reconstruct"): _Name("reconstruct") for module in _MULTIARRAY},
    **{(module, "scalar"): _Name("scalar") for module in _MULTIARRAY},
    **{(module, "_frombuffer"): _Name("frombuffer") for module in _NUMERIC},
    ("numpy", "ndarray"): _Name("ndarray"),
    ("numpy", "dtype"): _Name("dtype"),
    ("_codecs", "encode"): _Name("encode"),
    ("__builtin__", "bytes"): _Name("no bytes"),
}


def read_dict(path: Path) -> dict[Any, Any]:
    """Return the dictionary of an .npy file.

    Raises:
        EpisodeError: there is no such file, it is damaged, holds no dictionary, or other objects than plain
            values and arrays of numbers.
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
            found = _Reader().read(file.read())
        if isinstance(found, list) and len(found) == 1:  # the content of the array of one object
            [found] = found
        if not isinstance(found, dict):
            raise ValueError(f"it holds a {type(found).__name__}, not a dictionary")
        return found
    except OSError as fault:
        raise EpisodeError(path, *unreadable(path, "there is no such file", "")) from fault
    except _FAULTS as fault:
        raise EpisodeError(path, f"cannot be read: {fault}", "copy or record it again") from fault


class _Reader:
    """Follows the operations of a pickle; its stack and memo hold plain values."""

    def __init__(self) -> None:
        self._stack: list[Any] = []
        self._memo: dict[int, Any] = {}

    def read(self, content: bytes) -> Any:
        for operation, argument, _ in pickletools.genops(content):
            step = _STEPS.get(operation.name)
            if step is None:
                raise ValueError(f"it has the pickle operation {operation.name}, which is not followed")
            step(self, argument)
        [found] = self._stack
        if isinstance(found, _Array | _Type | _Name):
            raise ValueError("it ends before its content")
        return found

    def push(self, value: Any) -> None:
        self._stack.append(value)

    def pop(self) -> Any:
        if not self._stack or self._stack[-1] is _MARK:
            raise ValueError("it takes more than it has")
        return self._stack.pop()

    def since_mark(self) -> list[Any]:
        taken: list[Any] = []
        while self._stack[-1] is not _MARK:
            taken.append(self._stack.pop())
        self._stack.pop()
        return taken[::-1]

    def top(self, kind: type) -> Any:
        if not self._stack or not isinstance(self._stack[-1], kind):
            raise ValueError(f"it adds to something that is no {kind.__name__}")
        return self._stack[-1]

    def keep(self, place: int | None) -> None:
        place = len(self._memo) if place is None else place
        self._memo[place] = self._stack[-1]
        if isinstance(self._stack[-1], _Array):
            self._stack[-1].places.append(place)

    def extend(self, values: list[Any]) -> None:
        self.top(list).extend(values)

    def update(self, values: list[Any]) -> None:
        self.top(dict).update(_paired(values))

    def name(self, module: Any, name: Any) -> None:
        if (module, name) not in _NAMES:
            raise ValueError(f"it asks for {module}.{name}, which is neither a plain value nor an array")
        self.push(_NAMES[module, name])

    def call(self) -> None:
        given = self.pop()
        called = self.pop()
        if not isinstance(called, _Name) or called not in _CALLS or not isinstance(given, tuple):
            raise ValueError("it calls something that makes no plain value")
        self.push(_CALLS[called](*given))

    def build(self) -> None:
        """Give an array its content, or a number type its byte order."""
        state, built = self.pop(), self.pop()
        if isinstance(built, _Type):
            _, order, *rest = state
            if order not in ("<", ">", "|", "=") or any(rest[:3]):
                raise ValueError("it has a compound number type")
            built.dtype = built.dtype.newbyteorder(order)
            self.push(built)
        elif isinstance(built, _Array):
            _, shape, dtype, fortran, content = state
            whole = content if isinstance(content, list) else _filled(content, dtype, shape, bool(fortran))
            self.push(whole)
            self._memo.update(dict.fromkeys(built.places, whole))
        else:
            raise ValueError(f"it changes a {type(built).__name__}")


def _paired(values: list[Any]) -> dict[Any, Any]:
    return dict(zip(values[::2], values[1::2], strict=True))


def _filled(content: Any, kind: Any, shape: Any, fortran: bool) -> Any:
    if not isinstance(content, bytes) or not isinstance(kind, _Type) or kind.dtype.kind not in _KINDS:
        raise ValueError("it has an array that is not of numbers")
    return np.frombuffer(content, kind.dtype).reshape(shape, order="F" if fortran else "C")


def _dtype(name: Any, *_: Any) -> _Type:
    if not isinstance(name, str) or len(name) > 8:
        raise ValueError(f"it has a number type {str(name)[:40]!r}")
    found = np.dtype(name)
    if found.kind not in _KINDS + "O":
        raise ValueError(f"it has values of {found}, not numbers")
    return _Type(found)


def _scalar(kind: Any, content: Any) -> Any:
    return _filled(content, kind, (1,), False)[0].item()


def _encoded(text: Any, codec: Any) -> bytes:
    if codec not in ("latin1", "latin-1") or not isinstance(text, str):
        raise ValueError(f"it has text in {codec!r}")
    return text.encode("latin-1")


_CALLS: dict[str, Callable[..., Any]] = {
    "reconstruct": lambda *_: _Array(),
    "dtype": _dtype,
    "scalar": _scalar,
    "encode": _encoded,
    "no bytes": lambda: b"",
    "frombuffer": lambda content, kind, shape, order="C": _filled(content, kind, shape, order == "F"),
}
_PLAIN = (
    "INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1", "LONG4", "FLOAT", "BINFLOAT", "STRING",
    "BINSTRING", "SHORT_BINSTRING", "UNICODE", "BINUNICODE", "SHORT_BINUNICODE", "BINUNICODE8", "BINBYTES",
    "SHORT_BINBYTES", "BINBYTES8",
)  # fmt: skip
_Step = Callable[[_Reader, Any], None]
_STEPS: dict[str, _Step] = {
    **dict.fromkeys(_PLAIN, lambda r, value: r.push(value)),
    **dict.fromkeys(("PROTO", "FRAME", "STOP"), lambda r, _: None),
    **dict.fromkeys(("PUT", "BINPUT", "LONG_BINPUT", "MEMOIZE"), lambda r, place: r.keep(place)),
    **dict.fromkeys(("GET", "BINGET", "LONG_BINGET"), lambda r, place: r.push(r._memo[place])),
    "BYTEARRAY8": lambda r, value: r.push(bytes(value)),
    "NONE": lambda r, _: r.push(None),
    "NEWTRUE": lambda r, _: r.push(True),
    "NEWFALSE": lambda r, _: r.push(False),
    "MARK": lambda r, _: r.push(_MARK),
    "POP": lambda r, _: r.pop(),
    "EMPTY_DICT": lambda r, _: r.push({}),
    "EMPTY_LIST": lambda r, _: r.push([]),
    "EMPTY_TUPLE": lambda r, _: r.push(()),
    "TUPLE": lambda r, _: r.push(tuple(r.since_mark())),
    "TUPLE1": lambda r, _: r.push((r.pop(),)),
    "TUPLE2": lambda r, _: r.push((r.pop(), r.pop())[::-1]),
    "TUPLE3": lambda r, _: r.push((r.pop(), r.pop(), r.pop())[::-1]),
    "APPEND": lambda r, _: r.extend([r.pop()]),
    "APPENDS": lambda r, _: r.extend(r.since_mark()),
    "SETITEM": lambda r, _: r.update([r.pop(), r.pop()][::-1]),
    "SETITEMS": lambda r, _: r.update(r.since_mark()),
    "LIST": lambda r, _: r.push(r.since_mark()),
    "DICT": lambda r, _: r.push(_paired(r.since_mark())),
    "GLOBAL": lambda r, named: r.name(*named.split(" ", 1)),
    "STACK_GLOBAL": lambda r, _: r.name(*(r.pop(), r.pop())[::-1]),
    "REDUCE": lambda r, _: r.call(),
    "BUILD": lambda r, _: r.build(),
}
