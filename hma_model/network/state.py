"""Check names and shapes of a model's parts before they are loaded."""

from collections.abc import Mapping

from torch import Tensor

from hma_data.errors import CheckpointError
from hma_model.config import ActionSpace


def module_key(embodiment: str) -> str:
    """Return a module name for an id, without dots and without a clash with a module's attributes."""
    return "id_" + embodiment.replace("%", "%25").replace(".", "%2E")


def check_fit(where: str, state: Mapping[str, Tensor], own: Mapping[str, Tensor]) -> None:
    """Check that a state has the names and shapes of the one that it replaces.

    Raises:
        CheckpointError: the states differ; it names every key that is missing, unknown or of another shape.
    """
    missing, extra = sorted(own.keys() - state.keys()), sorted(state.keys() - own.keys())
    shapes = [
        f"{name} is {tuple(state[name].shape)}, not {tuple(own[name].shape)}"
        for name in sorted(own.keys() & state.keys())
        if state[name].shape != own[name].shape
    ]
    faults = [f"missing {', '.join(missing)}"] if missing else []
    faults += [f"unknown {', '.join(extra)}"] if extra else []
    faults += [f"shapes differ: {'; '.join(shapes)}"] if shapes else []
    if faults:
        raise CheckpointError(where, "; ".join(faults), "load it into the configuration it was saved from")


def space_of_stem(embodiment: str, stem: Mapping[str, Tensor]) -> ActionSpace:
    """Return the action space for which a stem's state was made.

    Raises:
        CheckpointError: the state is not that of a stem.
    """
    try:
        mean, std, mask = (stem[f"normalizer.{name}"] for name in ("mean", "std", "normalize"))
        chunk_dim = stem["input.weight"].shape[1]
    except KeyError as error:
        raise CheckpointError(
            f"{embodiment}: stem", f"missing {error.args[0]}", "is it a stem's state?"
        ) from error
    values = tuple(mean.tolist()), tuple(std.tolist()), tuple(mask.bool().tolist())
    rule = "divide" if "normalizer.divide" in stem else "zero"
    return ActionSpace(embodiment, mean.numel(), chunk_dim // mean.numel(), *values, zero_variance=rule)
