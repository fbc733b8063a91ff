"""Name the modules of embodiments in a state, and check that a state fits the model that takes it."""

from collections.abc import Mapping

from torch import Tensor

from hma_data.errors import CheckpointError

MOST_NAMED = 3  # keys in an error


def module_key(embodiment: str) -> str:
    """Return a module name for an id, without dots and without a clash with a module's attributes."""
    return "id_" + embodiment.replace("%", "%25").replace(".", "%2E")


def check_fit(where: object, state: Mapping[str, Tensor], own: Mapping[str, Tensor]) -> None:
    """Check that a state has the names and shapes of the one that it replaces.

    Raises:
        CheckpointError: the states differ; it names the first keys that do not fit.
    """
    faults = [f"missing {name}" for name in sorted(own.keys() - state.keys())]
    faults += [f"unknown {name}" for name in sorted(state.keys() - own.keys())]
    faults += [
        f"{name} is {tuple(state[name].shape)}, not {tuple(tensor.shape)}"
        for name, tensor in sorted(own.items())
        if name in state and state[name].shape != tensor.shape
    ]
    if faults:
        if len(faults) > MOST_NAMED:
            faults[MOST_NAMED:] = [f"and {len(faults) - MOST_NAMED} more"]
        raise CheckpointError(where, "; ".join(faults), "load it into the configuration it was saved from")
