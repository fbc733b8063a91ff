"""Read and write the paper's released checkpoints.

In comes their folder, out goes a checkpoint of ours, and back. Next: `hma_model.hub`.
"""
