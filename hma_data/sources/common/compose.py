"""Join the recorded values of a vector's components into the vector, with slices, signs and offsets.

T frames of an episode, A values of a vector.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hma_data.errors import EpisodeError
from hma_data.registry.components import Vector


def compose(vector: Vector, pieces: Sequence[NDArray[Any]], where: str) -> NDArray[np.float32]:
    """Return a vector over time, joined from the recorded values of its components.

    Slices, signs and offsets are applied only here.

    Args:
        vector: of the embodiment.
        pieces: for each component (T, n) or (T,) numbers as recorded.
        where: the episode, for the error.

    Returns:
        (T, A) float32.

    Raises:
        EpisodeError: a width, a length or a dtype does not fit.
    """
    parts = [
        component_values(part, piece, where) for part, piece in zip(vector.components, pieces, strict=True)
    ]
    lengths = {part.key: len(values) for part, values in zip(vector.components, parts, strict=True)}
    if len(set(lengths.values())) > 1:
        said = ", ".join(f"{key} {length}" for key, length in lengths.items())
        raise EpisodeError(where, f"its components differ in length: {said}")
    return np.concatenate(parts, axis=1)


def component_values(part: Any, piece: NDArray[Any], where: str) -> NDArray[np.float32]:
    """Return the values (T, dims) float32 of one component; see `compose`."""
    if piece.dtype.kind not in "fiub":
        raise EpisodeError(where, f"{part.key} holds {piece.dtype}, not numbers")
    if piece.ndim < 1 or not len(piece):
        raise EpisodeError(where, f"{part.key} holds no values over time (shape {piece.shape})")
    values: NDArray[Any] = piece.reshape(len(piece), -1)
    width = values.shape[1]
    if part.slice:
        fault = f"{part.key} has {width} values, slice {list(part.slice)} needs {part.slice[1]}"
        if part.slice[1] > width:
            raise EpisodeError(where, fault, "correct slice in the YAML")
        values = values[:, part.slice[0] : part.slice[1]]
    elif width != part.dims:
        fault = f"{part.key} has {width} values, the embodiment says {part.dims}"
        raise EpisodeError(where, fault, "correct dims or give slice in the YAML")
    values = values.astype(np.float64) * np.asarray(part.sign) + np.asarray(part.offset)
    with np.errstate(over="ignore"):  # a value too large for float32 becomes infinite, and align refuses it
        return values.astype(np.float32)
