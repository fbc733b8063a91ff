"""Move files to and from repositories of the Hugging Face Hub, with the hub's own client.

This package deals with names and bytes only; it knows neither checkpoints nor shard sets.
"""
