"""Describe robots: an embodiment is one YAML of the registry.

In comes YAML, out goes a validated `Embodiment`. `catalog` lists the registry and the recording formats;
`export` writes the formats of other projects. Next: `hma_data.episodes`, what a robot recorded.
"""
