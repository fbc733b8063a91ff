"""Write, read and verify tokenized parquet shards and their manifest. The format is docs/format.md."""
