"""Publish and pull checkpoints, one embodiment at a time: the Hugging Face Hub, a folder, any fsspec URI.

In goes a checkpoint, out comes the trunk with the embodiments asked for. Next: `hma_model.training`.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hma_model.hub.datasets import pull_data as pull_data
    from hma_model.hub.datasets import push_data as push_data
    from hma_model.hub.publish import export_released as export_released
    from hma_model.hub.publish import from_pretrained as from_pretrained
    from hma_model.hub.publish import import_released as import_released
    from hma_model.hub.publish import list_embodiments as list_embodiments
    from hma_model.hub.publish import pull as pull
    from hma_model.hub.publish import push as push
    from hma_model.hub.publish import push_model as push_model

_LAZY = {
    "push": "hma_model.hub.publish",
    "pull": "hma_model.hub.publish",
    "list_embodiments": "hma_model.hub.publish",
    "from_pretrained": "hma_model.hub.publish",
    "push_model": "hma_model.hub.publish",
    "import_released": "hma_model.hub.publish",
    "export_released": "hma_model.hub.publish",
    "push_data": "hma_model.hub.datasets",
    "pull_data": "hma_model.hub.datasets",
}


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        from importlib import import_module

        return getattr(import_module(_LAZY[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
