"""Benchmark the model: `hma bench generate`, `play`, `train`, `mup`, `waiting`, `drift`, `quality`."""
