"""Dictionaries that numpy stored: equal to numpy's own reading, and nothing of the file runs."""

import pickle
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from hma_data.errors import EpisodeError
from hma_data.sources.common.pickles import read_dict
from tests.hostile import Edit, Row, Touch, untouched


def write(path: Path, value: object, protocol: int) -> Path:
    with path.open("wb") as file:
        facts = {"descr": "|O", "fortran_order": False, "shape": ()}
        np.lib.format.write_array_header_1_0(file, facts)
        pickle.dump(np.array(value, dtype=object), file, protocol=protocol)
    return path


def equal(a, b) -> bool:
    if isinstance(b, dict):
        return isinstance(a, dict) and list(a) == list(b) and all(equal(a[k], b[k]) for k in b)
    if isinstance(b, list | tuple):
        return type(a) is type(b) and len(a) == len(b) and all(map(equal, a, b))
    if isinstance(b, np.ndarray):  # numpy may swap bytes while it reads
        alike = a.dtype.newbyteorder("=") == b.dtype.newbyteorder("=") and a.shape == b.shape
        return alike and np.array_equal(a, b, equal_nan=b.dtype.kind in "fc")
    return a == b or (a != a and b != b)


NUMBERS = st.one_of(
    st.integers(-(2**70), 2**70), st.floats(), st.booleans(), st.none(), st.text(max_size=5),
    st.binary(max_size=5), st.floats(width=32).map(np.float32), st.integers(-9, 9).map(np.int64),
    arrays.arrays(
        st.sampled_from(["<f8", ">f4", "<i8", "|u1", "|b1", ">i2"]),
        arrays.array_shapes(max_dims=3, max_side=4),
    ),
)  # fmt: skip
VALUES = st.recursive(
    NUMBERS,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=4), inner, max_size=4),
)


@given(
    value=st.dictionaries(st.text(max_size=4) | st.integers(), VALUES, max_size=4), protocol=st.integers(0, 5)
)
def test_a_dictionary_is_read_as_numpy_reads_it(value, protocol, tmp_path_factory):
    path = write(tmp_path_factory.mktemp("npy") / "x.npy", value, protocol)
    assert equal(read_dict(path), np.load(path, allow_pickle=True).item())


def test_shared_values_and_fortran_order_are_read(tmp_path):
    shared = np.asfortranarray(np.arange(6.0).reshape(2, 3))
    value = {"a": shared, "b": [shared, shared], "c": shared.T}
    for protocol in range(6):
        assert equal(read_dict(write(tmp_path / "x.npy", value, protocol)), value)


@pytest.mark.parametrize("protocol", range(6))
def test_code_in_a_file_is_refused_and_does_not_run(protocol, tmp_path):
    path = write(tmp_path / "x.npy", {"a": Touch(tmp_path / "ran")}, protocol)
    with pytest.raises(EpisodeError, match=r"posix\.system|nt\.system"):
        read_dict(path)
    assert not (tmp_path / "ran").exists()


def pickled(content: bytes) -> Edit:
    def edit(path: Path) -> None:
        with path.open("wb") as file:
            np.lib.format.write_array_header_1_0(file, {"descr": "|O", "fortran_order": False, "shape": ()})
            file.write(content)

    return edit


HOSTILE: dict[str, Row] = {
    "a call of a name": (pickled(b"cnumpy\nndarray\n(I99999999999\ntR."), "cannot be read"),
    "an array without content": (pickled(b"cnumpy\nndarray\n((I2\nttR."), "makes an array without content"),
    "a dtype of bytes": (pickled(b"cnumpy\ndtype\n(S'V9'\ntR."), "numbers"),
    "eval": (pickled(b"cbuiltins\neval\n(S'1'\ntR."), r"builtins\.eval"),
    "an instance": (pickled(b"(i__main__\nx\n."), "__main__.x"),
    "a name on the stack": (pickled(b"\x80\x02}\x8c\x01a\x93."), "cannot be read"),
    "a dtype alone": (pickled(b"\x80\x02cnumpy\ndtype\n."), "not a dictionary"),
    "a list inside itself": (pickled(b"\x80\x02]q\x00h\x00a."), "holds a list"),
    "an extension": (pickled(b"\x80\x02\x82\x01."), "cannot be read"),
    "nothing": (pickled(b""), "cannot be read"),
    "a memo of 32 GB in the C unpickler": (pickled(b"\x80\x02]r\xff\xff\xff\xff."), "not a dictionary"),
    "an attribute of a function": (pickled(b"c_codecs\nencode\n}S'a'\nI1\nsb."), "cannot be read"),
    "no end": (pickled(b"\x80\x02}"), "cannot be read"),
    "numbers": (lambda path: np.save(path, np.arange(3)), "not a dictionary"),
    "objects": (lambda path: np.save(path, np.array([1, 2], dtype=object)), "not a dictionary"),
    "no file": (untouched, "no such file"),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_an_odd_file_is_one_clear_error(case, tmp_path):
    spoil, said, *_ = HOSTILE[case]
    spoil(tmp_path / "x.npy")
    with pytest.raises(EpisodeError, match=said) as found:
        read_dict(tmp_path / "x.npy")
    assert "\n" not in str(found.value)


def test_damaged_files_never_end_in_another_error(tmp_path):
    whole = write(tmp_path / "x.npy", {"a": [{"t": 1, "v": np.arange(3.0)}]}, 4).read_bytes()
    rng = np.random.default_rng(0)
    for size in range(0, len(whole), 7):
        (tmp_path / "x.npy").write_bytes(whole[:size])
        with pytest.raises(EpisodeError):
            read_dict(tmp_path / "x.npy")
    for _ in range(300):
        spoilt = bytearray(whole)
        for place in rng.integers(len(whole), size=3):
            spoilt[place] = rng.integers(256)
        (tmp_path / "x.npy").write_bytes(spoilt)
        with suppress(EpisodeError):
            read_dict(tmp_path / "x.npy")
