"""Train: a recipe in, a run's folder with checkpoints out. A run that is killed at any moment can resume.

`loop` is the loop, `run` what it drives, `recipe` what it is told. Next: `hma_model.demo`, the whole road.
"""
