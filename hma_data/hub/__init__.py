"""Repositories of the Hugging Face Hub: names and bytes, moved by the hub's own client.

Nothing here knows checkpoints or shard sets.
"""
