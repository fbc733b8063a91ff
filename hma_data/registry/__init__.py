"""Describe robots: an embodiment is one YAML of the registry.

In comes YAML, out goes a validated `Embodiment`. `catalog` lists the embodiments, `export` writes the formats
of other projects. Next: `hma_data.episodes`, what a robot recorded.

`FORMATS` is the one list of recording formats that registry and sources use. A format that an installed
package adds is known too; for a built-in name, no package is looked at.
"""

from hma_data.plugins import SOURCE_GROUP, installed

FORMATS = {  # name -> package: RECOGNITION in it, open() in its module `source`; asked in this order
    "rlds": "hma_data.sources.rlds",
    "rosbag": "hma_data.sources.bags",
    "hdf5": "hma_data.sources.hdf5",
    "lerobot": "hma_data.sources.lerobot",
    "rh20t": "hma_data.sources.rh20t",
    "hands": "hma_data.sources.hands",
}
MORE_FORMATS = f"an installed package may add formats by entry points of {SOURCE_GROUP}"


def known_formats() -> list[str]:
    """Return the built-in formats, then those of installed packages."""
    return [*FORMATS, *(name for name in installed(SOURCE_GROUP) if name not in FORMATS)]
