"""Benchmark the model: `hma bench drift`, `generate`, `play` and `train`. Others lie in `recipes/bench`."""
