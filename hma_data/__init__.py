"""Convert recordings of any robot to tokenized parquet shards, and read them in training.

The package holds the registry, sources, alignment, tokenizers, shards, mixtures and the loader.
"""

__version__ = "0.1.0"
