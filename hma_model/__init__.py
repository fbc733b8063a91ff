"""Provide the Heterogeneous Masked Autoregression world model: network, training, generation, publishing.

`from hma_model import HMA, HMAConfig` imports torch; the package itself does not.
"""

from typing import TYPE_CHECKING

from hma_data import lazy

if TYPE_CHECKING:
    from hma_model.config import HMAConfig as HMAConfig
    from hma_model.network.model import HMA as HMA

__all__ = ["HMA", "HMAConfig"]
__getattr__ = lazy(__name__, {"HMA": "hma_model.network.model", "HMAConfig": "hma_model.config"})
