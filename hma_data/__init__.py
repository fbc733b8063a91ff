"""Recordings of any robot in, tokenized parquet shards out: registry, sources, alignment, tokenizers, shards, mixtures."""

__version__ = "0.1.0"
