"""List the recording formats: the one list that registry and sources use.

A format that an installed package adds is known too. For a built-in name, packages are not looked at.
"""

from hma_data.plugins import SOURCE_GROUP, installed

FORMATS = {  # name -> package: RECOGNITION in it, open() in its module `source`; asked in this order
    "rlds": "hma_data.sources.rlds",
    "rosbag": "hma_data.sources.bags",
    "hdf5": "hma_data.sources.hdf5",
    "lerobot": "hma_data.sources.lerobot",
    "hands": "hma_data.sources.hands",
}
MORE = f"an installed package may add formats by entry points of {SOURCE_GROUP}"


def known_formats() -> list[str]:
    """Return the built-in formats, then those of installed packages."""
    return [*FORMATS, *(name for name in installed(SOURCE_GROUP) if name not in FORMATS)]


def is_known(name: str) -> bool:
    """Check whether there is a source of that format."""
    return name in FORMATS or name in installed(SOURCE_GROUP)
