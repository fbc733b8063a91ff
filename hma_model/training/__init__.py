"""Train: a recipe in, a run's folder with checkpoints out; killed at any moment, it goes on.

`loop` is the loop, `run` what it drives, `recipe` what it is told. Next: `hma_model.demo`, the whole road.
"""
