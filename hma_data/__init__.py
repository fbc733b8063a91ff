"""Convert recordings of any robot to tokenized parquet shards, and read them in training.

The packages, in the order of the data: storage, hub, registry, episodes, sources, tokenizers, shards,
inspection, conversion, loading, lab and cli. A package imports only from those before it.
The names below are imported on use, so that `import hma_data` costs nothing.
"""

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hma_data.conversion.job import convert as convert
    from hma_data.conversion.settings import Settings as Settings
    from hma_data.inspection.inspect import inspect_recording as inspect_recording
    from hma_data.inspection.view import view_recording as view_recording
    from hma_data.loading.dataset import MixtureDataset as MixtureDataset
    from hma_data.loading.dataset import WindowDataset as WindowDataset
    from hma_data.loading.dataset import open_sets as open_sets
    from hma_data.registry.embodiment import find as find
    from hma_data.shards.preview import preview as preview
    from hma_data.sources.base import open_source as open_source
    from hma_data.tokenizers.base import get_tokenizer as get_tokenizer

__all__ = [
    "MixtureDataset",
    "Settings",
    "WindowDataset",
    "convert",
    "find",
    "get_tokenizer",
    "inspect_recording",
    "open_sets",
    "open_source",
    "preview",
    "view_recording",
]


def lazy(package: str, modules: Mapping[str, str]) -> Callable[[str], Any]:
    """Return the `__getattr__` of a package whose public names are imported on use.

    Args:
        package: the name of the package.
        modules: public name -> the module that defines it.
    """

    def load(name: str) -> Any:
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        from importlib import import_module

        return getattr(import_module(modules[name]), name)

    return load


__getattr__ = lazy(
    __name__,
    {
        "find": "hma_data.registry.embodiment",
        "open_source": "hma_data.sources.base",
        "get_tokenizer": "hma_data.tokenizers.base",
        "convert": "hma_data.conversion.job",
        "Settings": "hma_data.conversion.settings",
        "inspect_recording": "hma_data.inspection.inspect",
        "preview": "hma_data.shards.preview",
        "view_recording": "hma_data.inspection.view",
        "open_sets": "hma_data.loading.dataset",
        "MixtureDataset": "hma_data.loading.dataset",
        "WindowDataset": "hma_data.loading.dataset",
    },
)
__version__ = "0.2.0"
