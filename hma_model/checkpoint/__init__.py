"""Save and load models: a trunk, and a stem and a head for each embodiment (DESIGN section 9).

In goes a model, out comes a folder, which is also the layout of the hub. Next: `hma_model.generation`.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hma_model.checkpoint.folder import Checkpoint as Checkpoint
    from hma_model.checkpoint.io import load as load
    from hma_model.checkpoint.io import resolve as resolve
    from hma_model.checkpoint.io import save as save

_LAZY = {
    "Checkpoint": "hma_model.checkpoint.folder",
    "load": "hma_model.checkpoint.io",
    "resolve": "hma_model.checkpoint.io",
    "save": "hma_model.checkpoint.io",
}


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        from importlib import import_module

        return getattr(import_module(_LAZY[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
