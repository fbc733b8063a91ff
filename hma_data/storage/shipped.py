"""Where the files that come with the package are: registry, recipes.

In a checkout they lie at its top level; in a wheel they are inside `hma_data/shipped/`.
"""

from pathlib import Path

_PACKAGE = Path(__file__).resolve().parents[1]


def shipped(name: str) -> Path:
    """The folder `registry` or `recipes` that this installation brought along."""
    packed = _PACKAGE / "shipped" / name
    return packed if packed.is_dir() else _PACKAGE.parent / name
