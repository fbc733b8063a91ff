"""Tokenized parquet shards: schema, writer, reader, manifest, verification. The format is docs/format.md."""
