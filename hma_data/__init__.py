"""Recordings of any robot in, tokenized parquet shards out.

Registry, sources, alignment, tokenizers, shards, mixtures, loader.
"""

__version__ = "0.1.0"
