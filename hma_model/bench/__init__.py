"""Benchmark the model: `hma bench generate`, `train`, `mup`, `waiting`, `drift`, `quality`."""
