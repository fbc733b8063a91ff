"""Describe robots: an embodiment is one YAML of the registry.

In comes YAML, out goes a validated `Embodiment`; `catalog` finds it by id over the search path, `export`
writes the words of other projects. Next: `hma_data.episodes`, what a robot recorded.
"""
