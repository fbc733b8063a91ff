"""Load shards into training: the mixture, shuffled pools of row groups, windows, batches.

In come shard sets, out go batches that are the same in any process and after any resume.
Next: `hma_model`, which trains on them.
"""
