"""Provide the Heterogeneous Masked Autoregression world model: network, training, generation, publishing.

`from hma_model import HMA, HMAConfig, finetune, rollout` imports torch; the package itself does not.
"""

from typing import TYPE_CHECKING

from hma_data import lazy

if TYPE_CHECKING:
    from hma_model.config import HMAConfig as HMAConfig
    from hma_model.evaluation.rollouts import rollout as rollout
    from hma_model.hub.listing import list_embodiments as list_embodiments
    from hma_model.hub.publish import pull as pull
    from hma_model.hub.publish import push as push
    from hma_model.network.model import HMA as HMA
    from hma_model.training.loop import finetune as finetune
    from hma_model.training.loop import train as train

__all__ = ["HMA", "HMAConfig", "finetune", "list_embodiments", "pull", "push", "rollout", "train"]
__getattr__ = lazy(
    __name__,
    {
        "HMA": "hma_model.network.model",
        "HMAConfig": "hma_model.config",
        "finetune": "hma_model.training.loop",
        "train": "hma_model.training.loop",
        "rollout": "hma_model.evaluation.rollouts",
        "push": "hma_model.hub.publish",
        "pull": "hma_model.hub.publish",
        "list_embodiments": "hma_model.hub.listing",
    },
)
