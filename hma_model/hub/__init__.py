"""Publish and pull checkpoints, one embodiment at a time: the Hugging Face Hub, a folder, any fsspec URI.

In goes a checkpoint, out comes the trunk with the embodiments asked for. Next: `hma_model.worlds`.
"""

from typing import TYPE_CHECKING

from hma_data import lazy

if TYPE_CHECKING:
    from hma_model.hub.datasets import pull_data as pull_data
    from hma_model.hub.datasets import push_data as push_data
    from hma_model.hub.listing import list_embodiments as list_embodiments
    from hma_model.hub.publish import from_pretrained as from_pretrained
    from hma_model.hub.publish import pull as pull
    from hma_model.hub.publish import push as push
    from hma_model.hub.publish import push_model as push_model
    from hma_model.released.conversion import export_released as export_released
    from hma_model.released.conversion import import_released as import_released

_PUBLISH = ("push", "pull", "from_pretrained", "push_model")
__getattr__ = lazy(
    __name__,
    {
        **dict.fromkeys(_PUBLISH, "hma_model.hub.publish"),
        "list_embodiments": "hma_model.hub.listing",
        **dict.fromkeys(("push_data", "pull_data"), "hma_model.hub.datasets"),
        **dict.fromkeys(("import_released", "export_released"), "hma_model.released.conversion"),
    },
)
