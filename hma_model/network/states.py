"""Name the modules of embodiments in a state, and check that a state fits the model that takes it."""

from collections.abc import Mapping, Sequence

from torch import Tensor

from hma_data.errors import CheckpointError

MOST_NAMED = 3  # names in an error


def module_key(embodiment: str) -> str:
    """Return a module name for an id, without dots and without a clash with a module's attributes."""
    return "id_" + embodiment.replace("%", "%25").replace(".", "%2E")


def some_of(names: Sequence[str]) -> str:
    """Return the first few names, and how many more there are."""
    more = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
    return ", ".join(names[:MOST_NAMED]) + more


def check_fit(where: object, state: Mapping[str, Tensor], own: Mapping[str, Tensor]) -> None:
    """Check that a state has the names and shapes of the one that it replaces.

    Raises:
        CheckpointError: the states differ; it names the first keys that do not fit.
    """
    missing, extra = sorted(own.keys() - state.keys()), sorted(state.keys() - own.keys())
    shapes = [
        f"{name} is {tuple(state[name].shape)}, not {tuple(tensor.shape)}"
        for name, tensor in sorted(own.items())
        if name in state and state[name].shape != tensor.shape
    ]
    kinds = {"missing ": missing, "unknown ": extra, "": shapes}
    if faults := [f"{what}{some_of(found)}" for what, found in kinds.items() if found]:
        raise CheckpointError(where, "; ".join(faults), "load it into the configuration it was saved from")
