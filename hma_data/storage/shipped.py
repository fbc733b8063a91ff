"""Find the files that come with the package: registry, recipes.

In a checkout they lie at its top level; in a wheel they are inside `hma_data/shipped/`.
"""

from pathlib import Path

_PACKAGE = Path(__file__).resolve().parents[1]


def shipped(name: str) -> Path:
    """Return the folder `registry` or `recipes` of this installation."""
    packed = _PACKAGE / "shipped" / name
    return packed if packed.is_dir() else _PACKAGE.parent / name
