"""Provide the Heterogeneous Masked Autoregression world model: network, training, generation, publishing.

`from hma_model import HMA, HMAConfig, finetune, rollout` imports torch; the package itself does not.
"""

from typing import TYPE_CHECKING

from hma_data import lazy

if TYPE_CHECKING:
    from hma_model.config import HMAConfig as HMAConfig
    from hma_model.evaluation.rollouts import rollout as rollout
    from hma_model.network.model import HMA as HMA
    from hma_model.training.loop import finetune as finetune
    from hma_model.training.loop import train as train

__all__ = ["HMA", "HMAConfig", "finetune", "rollout", "train"]
__getattr__ = lazy(
    __name__,
    {
        "HMA": "hma_model.network.model",
        "HMAConfig": "hma_model.config",
        "finetune": "hma_model.training.loop",
        "train": "hma_model.training.loop",
        "rollout": "hma_model.evaluation.rollouts",
    },
)
