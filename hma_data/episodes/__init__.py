"""Hold recorded data: `Episode` as a source yields it, `Clip` on the embodiment's clock.

In come streams with times of their own, out go frames, actions and states on one grid, with their skew.
`images` decodes and crops pictures, `sheets` draws them for people. Next: `hma_data.sources`, which yields
episodes.
"""
