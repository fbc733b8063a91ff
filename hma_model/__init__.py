"""Provide the Heterogeneous Masked Autoregression world model: network, training, generation, publishing.

`from hma_model import HMA, HMAConfig` imports torch; the package itself does not.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hma_model.config import HMAConfig as HMAConfig
    from hma_model.network.model import HMA as HMA

_LAZY = {"HMA": "hma_model.network.model", "HMAConfig": "hma_model.config"}


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        from importlib import import_module

        return getattr(import_module(_LAZY[name]), name)
    raise AttributeError(f"module 'hma_model' has no attribute {name!r}")
