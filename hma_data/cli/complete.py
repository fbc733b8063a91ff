"""Complete names at the Tab key: robots, tokenizers, recipes. Paths are the shell's own work."""

from collections.abc import Iterable


def robots(incomplete: str) -> list[str]:
    """Return the ids of the registry that begin so."""
    from hma_data.registry.catalog import file_id, registry_files

    return _begun(map(file_id, registry_files()), incomplete)


def tokenizers(incomplete: str) -> list[str]:
    """Return the names of tokenizers, those of installed packages too, that begin so."""
    from hma_data.plugins import TOKENIZER_GROUP, installed
    from hma_data.tokenizers.catalog import CATALOG

    return _begun([*CATALOG, *installed(TOKENIZER_GROUP)], incomplete)


def recipes(incomplete: str) -> list[str]:
    """Return the names of shipped recipes of training that begin so."""
    from hma_data.storage.paths import shipped

    return _begun((path.stem for path in (shipped("recipes") / "train").glob("*.yaml")), incomplete)


def _begun(names: Iterable[str], incomplete: str) -> list[str]:
    return sorted({name for name in names if name.startswith(incomplete)})
