"""Save and load models: a trunk, and a stem and a head for each embodiment (DESIGN section 9).

In goes a model, out comes a folder, which is also the layout of the hub. Next: `hma_model.generation`.
"""

from typing import TYPE_CHECKING

from hma_data import lazy

if TYPE_CHECKING:
    from hma_model.checkpoint.folder import Checkpoint as Checkpoint
    from hma_model.checkpoint.folder import resolve as resolve
    from hma_model.checkpoint.io import load as load
    from hma_model.checkpoint.io import save as save

__getattr__ = lazy(
    __name__,
    {
        "Checkpoint": "hma_model.checkpoint.folder",
        "load": "hma_model.checkpoint.io",
        "resolve": "hma_model.checkpoint.folder",
        "save": "hma_model.checkpoint.io",
    },
)
