"""Make shards of recordings: a plan, work units that may be killed, and the folder they write.

In come an embodiment, a source and a tokenizer; out goes a verified shard set, the same bytes whoever
made it. `engines` runs the units here, in processes or on Ray; `rewrite` merges and splits sets. Next:
`hma_data.loading`.
"""
