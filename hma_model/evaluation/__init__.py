"""Measure and show what a model predicts: metrics, rollouts beside the truth, plots and pages.

In come a model and a shard set, out go figures and pictures. Next: `hma_model.released` and `hma_model.hub`.
"""
